// Small charts of one agent over time.

// What a chart shows of its curves: from a round number to a round number, and the step they are
// multiples of.
function rangeOf(curves, { range, base, fixed, zero }) {
  if (fixed) return [...fixed, (fixed[1] - fixed[0]) / 2];
  let low = Infinity, high = -Infinity;
  for (const { points } of curves) for (const [, y] of points) if (Number.isFinite(y)) { low = Math.min(low, y); high = Math.max(high, y); }
  if (!(low <= high)) [low, high] = [0, range];
  if (zero) [low, high] = [Math.min(low, 0), Math.max(high, 0)];
  // Noise is not to fill the chart: it shows so many units at least, and from zero where that is near.
  if (base === 0 && low >= 0 && low < 2 * range) low = 0;
  if (high - low < range) {
    const middle = (low + high) / 2;
    [low, high] = base === 0 && low >= 0 && middle < range / 2 ? [0, range] : [middle - range / 2, middle + range / 2];
  }
  const tens = 10 ** Math.floor(Math.log10((high - low) / 4)), step = [1, 2, 5, 10].map(k => k * tens).find(step => 4.001 * step >= high - low);
  return [Math.floor(low / step + 1e-6) * step, Math.ceil(high / step - 1e-6) * step, step];
}

// Curves: [{points: [[t, y]...], colour, width, alpha, dash}]. Times and values share one scale.
function drawChart(canvas, curves, [from, to], now, colours, quantity) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight, c = canvas.getContext('2d');
  Object.assign(canvas, { width: Math.round(w * ratio), height: Math.round(h * ratio) });
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  const [low, high, step] = rangeOf(curves, quantity), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-6));
  const left = 38, right = 4, top = 6, bottom = 16;
  const px = t => left + (t - from) / Math.max(to - from, 1e-9) * (w - left - right);
  const py = y => top + (high - y) / (high - low) * (h - top - bottom);
  c.font = '11px system-ui, sans-serif';
  c.fillStyle = c.strokeStyle = colours.text;
  c.globalAlpha = 0.75; c.textAlign = 'right'; c.textBaseline = 'middle';
  c.fillText(high.toFixed(digits), left - 5, top + 3);
  // Zero has a line of its own where the curve crosses it, or where it means something.
  if (quantity.zero ? low <= 0 && high >= 0 : low < 0 && high > 0) {
    if (Math.min(py(0) - top, h - bottom - py(0)) > 12) c.fillText('0', left - 5, py(0));
    c.globalAlpha = 0.35; c.fillRect(left, py(0), w - left - right, 1); c.globalAlpha = 0.75;
  }
  c.fillText(low.toFixed(digits), left - 5, h - bottom - 2);
  c.textBaseline = 'alphabetic'; c.textAlign = 'left'; c.fillText(`${from.toFixed(0)} s`, left, h - 3);
  c.textAlign = 'right'; c.fillText(`${to.toFixed(0)} s`, w - right, h - 3);
  c.globalAlpha = 0.2; c.lineWidth = 1;
  for (const y of [top, h - bottom]) { c.beginPath(); c.moveTo(left, y + 0.5); c.lineTo(w - right, y + 0.5); c.stroke(); }
  for (const { points, colour, width, alpha, dash } of curves) {
    Object.assign(c, { strokeStyle: colour, lineWidth: width, globalAlpha: alpha, lineJoin: 'round' });
    c.setLineDash(dash || []);
    c.beginPath();
    let pen = false;
    for (const [t, y] of points) {
      if (!Number.isFinite(y)) { pen = false; continue; }
      if (pen) c.lineTo(px(t), py(y)); else c.moveTo(px(t), py(y));
      pen = true;
    }
    c.stroke();
  }
  c.setLineDash([]);
  c.globalAlpha = 0.8; c.strokeStyle = colours.text; c.lineWidth = 1;
  c.beginPath(); c.moveTo(px(now), top); c.lineTo(px(now), h - bottom); c.stroke();
}

// What can be charted of an agent: a name, its unit, how much is shown at least, and for a take the points.
function quantities(world, agent) {
  const points = (take, value) => Array.from({ length: take.frames }, (_, i) => [take.first + i * take.dt, value(take, agent * take.frames + i, take.first + i * take.dt)]);
  // Headings go on past half a turn; a future may have begun a whole turn away from the log.
  const turns = take => {
    const { first, frames, heading } = world.takes[take], logged = stateAt(world, 0, agent, first), start = heading[agent * frames];
    return take > 0 && logged && !Number.isNaN(start) ? 360 * Math.round((logged.heading - start) / (2 * Math.PI)) : 0;
  };
  const list = [
    { name: 'speed', unit: 'm/s', range: 5, base: 0, of: take => points(world.takes[take], (k, i) => k.speed[i]) },
    { name: 'heading', unit: '\u00b0', range: 20, of: take => { const more = turns(take); return points(world.takes[take], (k, i) => k.heading[i] * 180 / Math.PI + more); } },
  ];
  if (world.takes.length > 1) list.push({
    name: 'distance from the recording', unit: 'm', range: 2, base: 0, of: take => {
      if (take === 0) return [];
      const { first, dt, frames } = world.takes[0];
      return points(world.takes[take], (k, i, t) => {
        if (t > first + (frames - 1) * dt + 1e-6) return NaN;
        const logged = stateAt(world, 0, agent, t);
        return logged ? Math.hypot(k.x[i] - logged.x, k.y[i] - logged.y) : NaN;
      });
    },
  });
  const own = world.metrics.filter(track => track.agent === agent);
  for (const name of facts.metrics.filter(name => own.some(track => track.name === name))) list.push({
    name: name.split(', ')[0], unit: name.split(', ')[1] || '', range: 2, zero: name.startsWith('beyond '), fixed: name.endsWith(', 0 to 1') ? [0, 1] : null, of: take => {
      const track = own.find(track => track.name === name && track.take === take), { first, dt } = world.takes[take];
      return track ? track.values.map((v, i) => [first + (track.first + i) * dt, v]) : [];
    },
  });
  return list;
}
