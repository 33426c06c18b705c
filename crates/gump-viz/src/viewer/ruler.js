// The ruler: a line between two ends, each a place {x, y} or an {agent}, whose box then counts. An
// end on an agent goes with it.

// The gap at time t of a take: metres, the two points it is between, and words; null if an agent
// is not there.
function measure(world, take, [from, to], t) {
  const ends = [from, to].map(end => ruledAt(world, take, end, t));
  if (ends.includes(null)) return null;
  const [a, b] = ends, gap = gapBetween(a.corners, b.corners);
  const names = [from, to].map(end => (end.agent === undefined ? null : agentName(end.agent)));
  const metres = `${gap.metres.toFixed(2)} m`, centres = `${Math.hypot(a.x - b.x, a.y - b.y).toFixed(2)} m`;
  if (names[0] && names[1]) return { ...gap, label: gap.metres ? `gap ${metres}` : 'boxes overlap', words: `${names[0]} to ${names[1]}: ${gap.metres ? `gap ${metres}` : 'boxes overlap'}, centres ${centres}` };
  const box = names[0] || names[1];
  return { ...gap, label: metres, words: box ? `${metres} to the box of ${box}` : metres };
}

const agentName = agent => `${agent === facts.ego ? 'ego, ' : ''}${facts.agents[agent].kind.replace(/_/g, ' ')} ${facts.agents[agent].id}`;

// An end as a convex outline of one or four corners, and its middle.
function ruledAt(world, take, end, t) {
  if (end.agent === undefined) return { ...end, corners: [[end.x, end.y]] };
  const s = stateAt(world, take, end.agent, t), { length, width } = facts.agents[end.agent];
  if (!s) return null;
  const ux = Math.cos(s.heading), uy = Math.sin(s.heading);
  const corners = [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([i, j]) => [i * length / 2, j * width / 2]).map(([l, w]) => [s.x + l * ux - w * uy, s.y + l * uy + w * ux]);
  return { x: s.x, y: s.y, corners };
}

// The closest points of two convex outlines; 0 metres if they overlap.
function gapBetween(a, b) {
  const middle = ring => [0, 1].map(k => ring.reduce((sum, p) => sum + p[k], 0) / ring.length);
  const areApart = a.length + b.length === 2 || separates(a, b) || separates(b, a);
  if (!areApart) return { metres: 0, from: middle(a), to: middle(b) };
  let best = { metres: Infinity };
  const consider = (p, ring, flip) => ring.forEach((q, i) => {
    const near = nearestOf(p, q, ring[(i + 1) % ring.length]), metres = Math.hypot(p[0] - near[0], p[1] - near[1]);
    if (metres < best.metres) best = { metres, from: flip ? near : p, to: flip ? p : near };
  });
  for (const p of a) consider(p, b, false);
  for (const p of b) consider(p, a, true);
  return best;
}

// Whether an edge of a counter-clockwise outline has all of the other one on its outer side.
function separates(ring, other) {
  return ring.length > 2 && ring.some(([x, y], i) => {
    const [x2, y2] = ring[(i + 1) % ring.length];
    return other.every(p => (x2 - x) * (p[1] - y) - (y2 - y) * (p[0] - x) <= 0);
  });
}

function nearestOf([x, y], [x0, y0], [x1, y1]) {
  const dx = x1 - x0, dy = y1 - y0, square = dx * dx + dy * dy;
  const share = square ? Math.min(Math.max(((x - x0) * dx + (y - y0) * dy) / square, 0), 1) : 0;
  return [x0 + share * dx, y0 + share * dy];
}

// On the pane that the scene is aimed at, in CSS pixels: a line, its ends, how long it is.
function drawRuler(c, scene, ends, found, colours) {
  c.save();
  c.setTransform(scene.ratio, 0, 0, scene.ratio, 0, 0);
  c.lineCap = 'round';
  const [a, b] = found ? [found.from, found.to].map(p => scene.onCanvas(...p)) : [];
  const dots = found ? [a, b] : ends.filter(end => end.agent === undefined).map(({ x, y }) => scene.onCanvas(x, y));
  for (const [width, colour] of [[5, colours.ground], [2, colours.text]]) {
    c.strokeStyle = c.fillStyle = colour; c.lineWidth = width;
    if (found) { c.beginPath(); c.moveTo(...a); c.lineTo(...b); c.stroke(); }
    for (const [x, y] of dots) { c.beginPath(); c.arc(x, y, 1.5 + width / 2, 0, 2 * Math.PI); c.fill(); }
  }
  if (found) drawRulerLabel(c, scene, found.label, a, b, colours);
  c.restore();
}

// Beside the line's middle, and within the pane.
function drawRulerLabel(c, scene, label, a, b, colours) {
  c.font = '600 13px system-ui, sans-serif'; c.textBaseline = 'middle'; c.textAlign = 'center';
  const w = c.measureText(label).width + 14, h = 22, held = (x, low, high) => Math.min(Math.max(x, low), high);
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]], n = Math.hypot(dx, dy) || 1;
  const x = held((a[0] + b[0]) / 2 + Math.abs(dy) / n * (w / 2 + 8), scene.left + w / 2 + 4, scene.left + scene.width - w / 2 - 4);
  const y = held((a[1] + b[1]) / 2 + Math.abs(dx) / n * 20, h / 2 + 4, scene.height - h / 2 - 4);
  c.fillStyle = colours.text;
  c.beginPath();
  if (c.roundRect) c.roundRect(x - w / 2, y - h / 2, w, h, 6); else c.rect(x - w / 2, y - h / 2, w, h);
  c.fill();
  c.fillStyle = colours.ground; c.fillText(label, x, y + 0.5);
}
