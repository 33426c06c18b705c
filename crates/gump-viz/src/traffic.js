// A scene from above on a canvas: the road, lights and agents. The viewer and the page of gump-web
// both draw with it, in the colours of films and pictures (`theme.rs`, which a test compares).
//
// After `aim` a context is in metres, y up. `px(metres, least)` is a length in metres that is shown
// with so many pixels at least.

export const PALETTES = {
  light: {
    ground: '#f6f5f2', road: '#dfe1e4', route: '#f3e0ba', crosswalk: '#fafaf8', direction: '#c0c5cc', whiteLine: '#ffffff',
    yellowLine: '#e3c155', edge: '#9ca3ad', text: '#3a3f47', ego: '#e69f00', vehicle: '#0072b2', pedestrian: '#cc79a7',
    bicycle: '#009e73', other: '#8b9099', outline: '#232830', wedge: '#ffffff', red: '#d55e00', yellow: '#f0e442', green: '#35e06e',
  },
  dark: {
    ground: '#111317', road: '#24282f', route: '#453922', crosswalk: '#565d68', direction: '#3c434d', whiteLine: '#78808b',
    yellowLine: '#97833d', edge: '#5b636f', text: '#c5cbd3', ego: '#e69f00', vehicle: '#56b4e9', pedestrian: '#cc79a7',
    bicycle: '#009e73', other: '#7c828c', outline: '#0b0d10', wedge: '#0b0d10', red: '#d55e00', yellow: '#f0e442', green: '#35e06e',
  },
};

// Markings: what they are called, which colour, dashes in metres.
const LINES = [['brokenWhite', 'whiteLine', [2, 3]], ['solidWhite', 'whiteLine', []], ['brokenYellow', 'yellowLine', [2, 3]], ['solidYellow', 'yellowLine', []]];

// Has the camera's place at (cx, cy) device pixels, at `scale` device pixels per metre; its angle
// is the heading that points up, less a quarter turn.
export function aim(context, { x, y, angle }, scale, cx, cy) {
  const c = Math.cos(angle) * scale, s = Math.sin(angle) * scale;
  context.setTransform(c, s, s, -c, cx - c * x - s * y, cy - s * x + c * y);
}

// Paths, one per way of drawing, of features [{kind, width, xs, ys}]: surface, lane, turn (a lane
// without chevrons), route, crosswalk, bump, stopLine, edge, stopSign and the markings above.
export function layRoad(features) {
  const road = { surface: new Path2D(), lanes: new Map(), routes: new Map(), zebras: [], bumps: new Path2D(), stops: new Path2D(), edges: new Path2D(), lines: {}, signs: [], chevrons: [] };
  for (const [kind] of LINES) road.lines[kind] = new Path2D();
  const closed = { surface: road.surface, bump: road.bumps, stopLine: road.stops };
  const byWidth = (map, feature) => {
    if (!map.has(feature.width)) map.set(feature.width, new Path2D());
    trace(map.get(feature.width), feature, false);
  };
  for (const feature of features) {
    const { kind, xs, ys } = feature;
    if (!xs.length) continue;
    if (closed[kind]) trace(closed[kind], feature, true);
    else if (kind === 'crosswalk') road.zebras.push({ outline: trace(new Path2D(), feature, true), bars: zebraBars(xs, ys) });
    else if (kind === 'route') byWidth(road.routes, feature);
    else if (kind === 'stopSign') road.signs.push([xs[0], ys[0]]);
    else if (kind === 'edge') trace(road.edges, feature, false);
    else if (road.lines[kind]) trace(road.lines[kind], feature, false);
    else {
      byWidth(road.lanes, feature);
      if (kind === 'lane') road.chevrons.push(...along(xs, ys, 18));
    }
  }
  return road;
}

function trace(path, { xs, ys }, close) {
  // All rings run one way, or overlapping ones would cut holes into each other.
  const order = close && ringArea(xs, ys) < 0 ? [...xs.keys()].reverse() : xs.keys();
  let first = true;
  for (const i of order) { if (first) path.moveTo(xs[i], ys[i]); else path.lineTo(xs[i], ys[i]); first = false; }
  if (close) path.closePath();
  return path;
}

function ringArea(xs, ys) {
  let area = 0;
  for (let i = 0, j = xs.length - 1; i < xs.length; j = i++) area += xs[j] * ys[i] - xs[i] * ys[j];
  return area;
}

// Bars across the way people walk, which is the longest side.
function zebraBars(xs, ys) {
  let longest = [1, 0], best = 0;
  for (let i = 0, j = xs.length - 1; i < xs.length; j = i++) {
    const d = [xs[i] - xs[j], ys[i] - ys[j]], n = Math.hypot(...d);
    if (n > best) { best = n; longest = [d[0] / n, d[1] / n]; }
  }
  const [ux, uy] = longest, s = xs.map((x, i) => x * ux + ys[i] * uy), w = xs.map((x, i) => ys[i] * ux - x * uy);
  const low = Math.min(...w), high = Math.max(...w), bars = new Path2D(), point = (a, b) => [a * ux - b * uy, a * uy + b * ux];
  for (let a = Math.min(...s); a < Math.max(...s); a += 1.2) {
    bars.moveTo(...point(a, low)); bars.lineTo(...point(a, high)); bars.lineTo(...point(a + 0.6, high)); bars.lineTo(...point(a + 0.6, low));
    bars.closePath();
  }
  return bars;
}

// Points with directions, evenly along a line.
function along(xs, ys, spacing) {
  const length = xs.slice(1).reduce((sum, x, i) => sum + Math.hypot(x - xs[i], ys[i + 1] - ys[i]), 0);
  const n = Math.floor(length / spacing), found = [];
  for (let i = 1, done = 0; i < xs.length; i++) {
    const dx = xs[i] - xs[i - 1], dy = ys[i] - ys[i - 1], step = Math.hypot(dx, dy);
    while (found.length < n && (found.length + 0.5) * length / n <= done + step && step > 0) {
      const s = ((found.length + 0.5) * length / n - done) / step;
      found.push([xs[i - 1] + dx * s, ys[i - 1] + dy * s, dx / step, dy / step]);
    }
    done += step;
  }
  return found;
}

// The road; chevrons only where `sees(x, y)`, and none without it.
export function drawRoad(c, road, colours, px, sees = null) {
  const widths = (map, colour) => {
    c.strokeStyle = colour;
    for (const [width, path] of map) { c.lineWidth = px(width, 1); c.stroke(path); }
  };
  c.lineJoin = 'round'; c.lineCap = 'butt';
  c.fillStyle = colours.road;
  c.fill(road.surface);
  widths(road.lanes, colours.road);
  widths(road.routes, colours.route);
  c.fillStyle = colours.crosswalk;
  for (const { outline, bars } of road.zebras) { c.save(); c.clip(outline); c.fill(bars); c.restore(); }
  c.globalAlpha = 0.5; c.fillStyle = colours.yellowLine; c.fill(road.bumps);
  c.globalAlpha = 0.7; c.fillStyle = colours.whiteLine; c.fill(road.stops);
  c.globalAlpha = 1;
  if (sees) drawChevrons(c, road, colours, px, sees);
  for (const [kind, colour, dash] of LINES) {
    c.strokeStyle = colours[colour]; c.lineWidth = px(0.16, 0.9); c.setLineDash(dash); c.stroke(road.lines[kind]);
  }
  c.setLineDash([]);
  c.strokeStyle = colours.edge; c.lineWidth = px(0.22, 1.1); c.stroke(road.edges);
  for (const [x, y] of road.signs) for (const [r, colour] of [[1.35, colours.wedge], [1, colours.red]]) {
    c.fillStyle = colour; c.beginPath();
    for (let i = 0; i < 8; i++) { const a = (i + 0.5) * Math.PI / 4, m = px(0.8, 3) * r; c.lineTo(x + m * Math.cos(a), y + m * Math.sin(a)); }
    c.fill();
  }
  c.lineCap = 'round';
}

function drawChevrons(c, road, colours, px, sees) {
  c.strokeStyle = colours.direction; c.lineWidth = px(0.18, 1); c.lineCap = 'round'; c.beginPath();
  for (const [x, y, dx, dy] of road.chevrons) {
    if (!sees(x, y)) continue;
    c.moveTo(x - 0.7 * dx - 0.7 * dy, y - 0.7 * dy + 0.7 * dx); c.lineTo(x, y); c.lineTo(x - 0.7 * dx + 0.7 * dy, y - 0.7 * dy - 0.7 * dx);
  }
  c.stroke();
  c.lineCap = 'butt';
}

// A light: a bar across its lane where heading and width are known, a disc otherwise.
export function drawLight(c, { x, y, heading, width }, fill, colours, px) {
  if (width > 0) {
    const half = Math.max(width, 2) / 2 - 0.2, [dx, dy] = [-Math.sin(heading) * half, Math.cos(heading) * half];
    c.lineCap = 'butt';
    c.beginPath(); c.moveTo(x - dx, y - dy); c.lineTo(x + dx, y + dy);
    for (const [w, colour] of [[px(1.1, 4.5), colours.outline], [px(0.8, 3), fill]]) { c.lineWidth = w; c.strokeStyle = colour; c.stroke(); }
    c.lineCap = 'round';
    return;
  }
  const r = Math.min(px(0.55, 2), 9 * px(0, 1));
  for (const [k, colour] of [[1.4, colours.outline], [1, fill]]) { c.fillStyle = colour; c.beginPath(); c.arc(x, y, r * k, 0, 2 * Math.PI); c.fill(); }
}

// Begins the path of an agent's outline, so many metres wider all around.
export function outline(c, { kind, length, width }, { x, y, heading }, px, margin = 0) {
  const l = px(length, 3) / 2 + margin, w = px(width, 3) / 2 + margin;
  c.save();
  c.translate(x, y); c.rotate(heading);
  c.beginPath();
  // Pedestrians are as round as their box allows.
  if (c.roundRect) c.roundRect(-l, -w, 2 * l, 2 * w, (kind === 'pedestrian' ? 1 : 0.44) * Math.min(l, w));
  else c.rect(-l, -w, 2 * l, 2 * w);
  c.restore();
}

// An agent where it is: its box, and a wedge at the front of what has one.
export function drawAgent(c, agent, state, fill, colours, px) {
  outline(c, agent, state, px);
  c.fillStyle = fill; c.fill();
  c.strokeStyle = colours.outline; c.lineWidth = px(0.08, 0.8); c.stroke();
  if (!['vehicle', 'bicycle'].includes(agent.kind) || agent.length < 10 * px(0, 1)) return;
  const { x, y, heading } = state, ux = Math.cos(heading), uy = Math.sin(heading), p = (a, b) => [x + a * ux - b * uy, y + a * uy + b * ux];
  const nose = agent.length / 2 - 0.14 * agent.width, base = nose - 0.55 * agent.width;
  c.fillStyle = colours.wedge; c.globalAlpha = 0.85; c.beginPath();
  c.moveTo(...p(nose, 0)); c.lineTo(...p(base, 0.32 * agent.width)); c.lineTo(...p(base, -0.32 * agent.width)); c.fill();
  c.globalAlpha = 1;
}
