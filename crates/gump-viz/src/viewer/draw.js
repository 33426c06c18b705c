// Drawing: the camera, the traffic of one take or of all. How a road and an agent look is in
// traffic.js.

const LIGHTS = [null, 'green', 'yellow', 'red', 'other'];
const FAST = 20; // m/s, the end of the scale of speeds
const UNLIKELY = 0.5; // the start of the scale of plausibility, which few agents fall below

// Slow to fast; luminance rises, so that it reads without colour too.
const RAMP = {
  light: ['#440154', '#3b528b', '#21918c', '#5ec962', '#f0d51c'],
  dark: ['#6a5acd', '#4a7fd0', '#2bb0a6', '#7ad151', '#fde725'],
};

// The colour a share of the way along a ramp, as red, green, blue.
function rampColour(stops, share) {
  const x = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const i = Math.min(Math.floor(x), stops.length - 2), parse = hex => [1, 3, 5].map(k => parseInt(hex.slice(k, k + 2), 16));
  const [a, b] = [parse(stops[i]), parse(stops[i + 1])];
  return a.map((c, k) => Math.round(c + (b[k] - c) * (x - i)));
}

const scaled = (share, dark) => `rgb(${rampColour(RAMP[dark ? 'dark' : 'light'], share).join(',')})`;

// By class, by speed or by plausibility, as is chosen; what has no such number is grey.
function agentColour(ui, agent, speed, colours) {
  const { kind, plausibility } = facts.agents[agent];
  if (ui.colour === 'plausibility') return plausibility === null ? colours.other : scaled((plausibility - UNLIKELY) / (1 - UNLIKELY), ui.dark);
  if (ui.colour === 'speed' && ['vehicle', 'pedestrian', 'bicycle'].includes(kind)) return scaled(speed / FAST, ui.dark);
  return kindColour(agent, colours);
}

// What a take is called.
const takeName = (world, take) => (take === 0 ? 'recorded' : take === 'all' ? `simulated, all ${world.takes.length - 1}` : `simulated ${world.takes[take].name}`);

function kindColour(agent, colours) {
  if (agent === facts.ego) return colours.ego;
  return colours[facts.agents[agent].kind] || colours.other;
}

// Where an agent is at time t, between frames too; null if it is absent. Before the present a
// future is what was recorded.
function stateAt(world, takeIndex, agent, t) {
  const take = world.takes[t < 0 ? 0 : takeIndex];
  const x = Math.min(Math.max((t - take.first) / take.dt, 0), take.frames - 1);
  const i = Math.floor(x + 1e-6), row = agent * take.frames, a = row + i;
  if (Number.isNaN(take.x[a])) return null;
  const b = i + 1 < take.frames && !Number.isNaN(take.x[a + 1]) ? a + 1 : a, s = Math.max(x - i, 0);
  const mix = channel => channel[a] + (channel[b] - channel[a]) * s;
  return { x: mix(take.x), y: mix(take.y), heading: mix(take.heading), speed: mix(take.speed) };
}

// Of all futures at once the first is told of.
function heatTake(ui, world) { return ui.shown === 'all' ? Math.min(1, world.takes.length - 1) : ui.shown; }

function lightAt(world, takeIndex, light, t) {
  const take = world.takes[t < 0 ? 0 : takeIndex];
  const i = Math.min(Math.max(Math.floor((t - take.first) / take.dt + 1e-6), 0), take.frames - 1);
  return LIGHTS[take.lights[light * take.frames + i]];
}

class Scene {
  constructor(canvas, world) {
    Object.assign(this, { canvas, world, road: layRoad(world.features), camera: { x: 0, y: 0, scale: 5, angle: 0 } });
    this.context = canvas.getContext('2d', { alpha: false });
    this.candidates = facts.candidates.map(({ path }) => path.map(p => p.map(c => c * facts.centi)));
    this.overlay = { key: '', canvas: document.createElement('canvas') };
  }

  resize(panes = 1) {
    const ratio = window.devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = this.canvas;
    // Of several panes this is the first; `at` goes from one to the next.
    Object.assign(this, { ratio, width: w / panes, height: h, left: 0 });
    const [pw, ph] = [Math.round(w * ratio), Math.round(h * ratio)];
    if (this.canvas.width !== pw || this.canvas.height !== ph) Object.assign(this.canvas, { width: pw, height: ph });
  }

  aim(context) {
    aim(context, this.camera, this.camera.scale * this.ratio, (this.left + this.width / 2) * this.ratio, this.height * this.ratio / 2);
  }

  worldAt(px, py) {
    const { x, y, scale, angle } = this.camera, dx = (px - this.width / 2) / scale, dy = (py - this.height / 2) / scale;
    const c = Math.cos(angle), s = Math.sin(angle);
    return [x + c * dx + s * dy, y + s * dx - c * dy];
  }

  // A length in metres that is shown with so many pixels at least.
  get px() { return (metres, least) => Math.max(metres, least / this.camera.scale); }

  sees(x, y) { return Math.hypot(x - this.camera.x, y - this.camera.y) < Math.hypot(this.width, this.height) / 2 / this.camera.scale + 12; }

  // Where a point of the world is on the canvas, in CSS pixels.
  onCanvas(x, y) {
    const { scale, angle } = this.camera, dx = x - this.camera.x, dy = y - this.camera.y, c = Math.cos(angle), s = Math.sin(angle);
    return [this.left + this.width / 2 + scale * (c * dx + s * dy), this.height / 2 + scale * (s * dx - c * dy)];
  }

  // One take, or two beside each other.
  draw(ui, colours) {
    const c = this.context;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colours.ground;
    c.fillRect(0, 0, this.canvas.width, this.canvas.height);
    const panes = ui.left === null ? [ui.shown] : [ui.left, ui.shown];
    panes.forEach((shown, i) => {
      this.left = i * this.width;
      c.save();
      c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
      c.beginPath(); c.rect(this.left, 0, this.width, this.height); c.clip();
      this.drawPane({ ...ui, shown }, colours);
      c.restore();
    });
    this.left = 0;
    if (panes.length < 2) return;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = colours.text; c.globalAlpha = 0.5; c.fillRect(this.width - 1, 0, 2, this.height); c.globalAlpha = 1;
  }

  drawPane(ui, colours) {
    const c = this.context;
    this.aim(c);
    c.lineJoin = c.lineCap = 'round';
    drawRoad(c, this.road, colours, this.px, this.camera.scale > 2.5 ? (x, y) => this.sees(x, y) : null);
    const shown = this.shown(ui);
    if (ui.trails) {
      if (ui.shown === 'all') this.drawOverlay(ui, colours);
      else this.drawTrails(c, ui, shown[0], colours);
    }
    this.drawCandidates(c, ui, colours);
    this.drawLights(c, ui, shown[0], colours);
    if (shown.length > 1 && ui.t >= 0) this.drawGhosts(c, ui, shown, colours);
    else this.drawAgents(c, ui, shown[0], colours);
    const heat = heatAt(this.world, heatTake(ui, this.world), ui.selected, ui.t);
    if (heat) drawHeat(c, heat, ui.dark);
    if (ui.ends.length) drawRuler(c, this, ui.ends, ui.ends.length > 1 ? measure(this.world, shown[0], ui.ends, ui.t) : null, colours);
  }

  shown(ui) { return ui.shown === 'all' ? this.world.takes.map((_, i) => i).slice(1) : [ui.shown]; }

  // The last two seconds fade, what comes is a thin line.
  drawTrails(c, ui, takeIndex, colours) {
    const { takes } = this.world, end = takes[takeIndex].first + (takes[takeIndex].frames - 1) * takes[takeIndex].dt;
    facts.agents.forEach((_, a) => {
      const now = stateAt(this.world, takeIndex, a, ui.t);
      if (!now) return;
      c.strokeStyle = agentColour(ui, a, now.speed, colours);
      c.lineWidth = this.px(0.35, a === ui.selected ? 2 : 1.2);
      const line = (from, to, alpha) => {
        c.globalAlpha = alpha; c.beginPath();
        let pen = false;
        for (let t = from; t < to + 0.099; t += 0.1) {
          const s = stateAt(this.world, takeIndex, a, Math.min(t, to));
          if (!s) { if (pen) break; continue; }
          if (pen) c.lineTo(s.x, s.y); else c.moveTo(s.x, s.y);
          pen = true;
        }
        c.stroke();
      };
      if (now.speed > 0.2 || a === ui.selected) for (let k = 0; k < 4; k++) line(Math.max(ui.t - 2 + k * 0.5, takes[0].first), ui.t - 1.5 + k * 0.5, 0.12 + 0.12 * k);
      if (ui.t < end) line(ui.t, end, 0.45);
    });
    c.globalAlpha = 1;
  }

  // All futures over one another, kept until camera or theme change.
  drawOverlay(ui, colours) {
    const { overlay, canvas } = this, { x, y, scale, angle } = this.camera;
    // The width is that of a pane: with two panes of the canvas the middle of the first moves left.
    const key = [this.left, this.width, x, y, scale, angle, canvas.width, canvas.height, ui.dark, ui.selected, ui.colour].join();
    if (overlay.key !== key) {
      overlay.key = key;
      Object.assign(overlay.canvas, { width: canvas.width, height: canvas.height });
      const c = overlay.canvas.getContext('2d');
      this.aim(c);
      c.lineJoin = c.lineCap = 'round';
      this.overlayPaths = this.overlayPaths || this.world.takes.slice(1).map(take => facts.agents.map((_, a) => futurePath(take, a)));
      const fade = Math.max(0.06, 0.6 / Math.sqrt(this.overlayPaths.length));
      for (const paths of this.overlayPaths) paths.forEach((entry, a) => {
        if (!entry) return;
        c.strokeStyle = ui.colour === 'plausibility' ? agentColour(ui, a, 0, colours) : kindColour(a, colours);
        c.globalAlpha = ui.selected < 0 || a === ui.selected ? fade * (a === ui.selected ? 2 : 1) : fade * 0.35;
        c.lineWidth = this.px(0.3, a === facts.ego || a === ui.selected ? 1.6 : 1.1);
        c.stroke(entry);
      });
    }
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    this.context.drawImage(overlay.canvas, 0, 0);
    this.aim(this.context);
  }

  drawCandidates(c, ui, colours) {
    const line = (path, colour, width, alpha) => {
      c.strokeStyle = colour; c.lineWidth = this.px(width / 8, width); c.globalAlpha = alpha;
      c.beginPath();
      path.forEach(p => c.lineTo(...p));
      c.stroke();
    };
    this.candidates.forEach((path, i) => {
      const strong = i === ui.candidate || (ui.candidate < 0 && facts.candidates[i].chosen);
      line(path, colours.text, strong ? 3 : 1.2, strong ? 0.95 : 0.35);
    });
    c.globalAlpha = 1;
  }

  // The ego is told by its rim, whatever its colour says.
  rim(c, agent, s, colours) {
    outline(c, facts.agents[agent], s, this.px, 1.5 / this.camera.scale);
    c.strokeStyle = colours.ego; c.lineWidth = this.px(0.35, 2.5); c.stroke();
  }

  drawLights(c, ui, takeIndex, colours) {
    facts.lights.forEach(([x, y], l) => {
      const colour = lightAt(this.world, takeIndex, l, ui.t);
      if (colour) drawLight(c, { x: x * facts.centi, y: y * facts.centi }, colours[colour], colours, this.px);
    });
  }

  drawAgents(c, ui, takeIndex, colours) {
    facts.agents.forEach((agent, a) => {
      const s = stateAt(this.world, takeIndex, a, ui.t);
      if (!s || !this.sees(s.x, s.y)) return;
      drawAgent(c, agent, s, agentColour(ui, a, s.speed, colours), colours, this.px);
      if (a === facts.ego) this.rim(c, a, s, colours);
      if (a === ui.selected) { outline(c, agent, s, this.px, 5 / this.camera.scale); c.strokeStyle = colours.text; c.lineWidth = 2 / this.camera.scale; c.stroke(); }
    });
  }

  // The same instant in every future: what they agree on is solid.
  drawGhosts(c, ui, shown, colours) {
    const fade = Math.max(0.08, 0.9 / Math.sqrt(shown.length));
    facts.agents.forEach((agent, a) => {
      for (const take of shown) {
        const s = stateAt(this.world, take, a, ui.t);
        if (!s || !this.sees(s.x, s.y)) continue;
        outline(c, agent, s, this.px);
        c.globalAlpha = fade;
        c.fillStyle = agentColour(ui, a, s.speed, colours);
        c.fill();
        if (a === facts.ego && ui.colour !== 'class') { c.globalAlpha = Math.min(1, 2 * fade); this.rim(c, a, s, colours); }
        if (a === ui.selected) { outline(c, agent, s, this.px); c.globalAlpha = 0.8; c.strokeStyle = colours.text; c.lineWidth = 1 / this.camera.scale; c.stroke(); }
      }
    });
    c.globalAlpha = 1;
  }

  // The agent at a point of the canvas, or the nearest within reach of a finger; -1 if none.
  pick(ui, px, py, reach = 14) {
    const [x, y] = this.worldAt(px, py);
    let found = -1, best = reach / this.camera.scale;
    for (const take of ui.t < 0 ? [0] : this.shown(ui)) facts.agents.forEach(({ length, width }, a) => {
      const s = stateAt(this.world, take, a, ui.t);
      if (!s) return;
      const dx = x - s.x, dy = y - s.y, c = Math.cos(s.heading), k = Math.sin(s.heading);
      const d = Math.hypot(Math.max(Math.abs(c * dx + k * dy) - length / 2, 0), Math.max(Math.abs(c * dy - k * dx) - width / 2, 0));
      if (d < best) { best = d; found = a; }
    });
    return found;
  }
}

// Where an agent goes in a future; nothing if it stays.
function futurePath(take, agent) {
  const path = new Path2D(), row = agent * take.frames;
  let far = 0, first = -1, last = -1;
  for (let i = 0; i < take.frames; i++) {
    const x = take.x[row + i], y = take.y[row + i];
    if (Number.isNaN(x)) { last = -1; continue; }
    if (first < 0) first = i;
    far = Math.max(far, Math.hypot(x - take.x[row + first], y - take.y[row + first]));
    if (last < 0) path.moveTo(x, y);
    else if (i % 2 === 0 || i === take.frames - 1) path.lineTo(x, y);
    last = i;
  }
  return far > 0.5 ? path : null;
}
