// What an agent might do next: a map of where it might be, bars of its speed and of its turn.

// Seldom to often, from the colour of the road to what stands out on it most; luminance falls on
// light ground and rises on dark.
const HEAT = {
  light: ['#d9b3cf', '#b8559a', '#7b1fa2', '#3a0a5e'],
  dark: ['#5c2a6e', '#b63679', '#fb8861', '#fcfdbf'],
};

// The map that holds at time t for an agent in a take; nothing if none was kept.
function heatAt(world, take, agent, t) {
  return world.heat.find(map => map.agent === agent && map.take === take && map.draws && map.from <= t + 1e-6 && t + 1e-6 < map.from + map.ahead);
}

// A pixel per cell, smoothed over its neighbours, because draws are few, with a margin of three;
// row 0 is farthest ahead.
function heatImage(map, dark) {
  if (map.image && map.image.dark === dark) return map.image;
  const span = key => { const all = map.cells.map(cell => cell[key]); return [Math.min(...all) - 3, Math.max(...all) + 3]; };
  const [left, ahead] = [span('left'), span('ahead')], w = left[1] - left[0] + 1, h = ahead[1] - ahead[0] + 1;
  const weight = new Float32Array(w * h), kernel = [1, 4, 6, 4, 1];
  for (const cell of map.cells) for (let i = -2; i < 3; i++) for (let j = -2; j < 3; j++) {
    weight[(ahead[1] - cell.ahead + i) * w + left[1] - cell.left + j] += cell.count * kernel[i + 2] * kernel[j + 2];
  }
  const canvas = Object.assign(document.createElement('canvas'), { width: w, height: h }), c = canvas.getContext('2d');
  const picture = c.createImageData(w, h), most = Math.max(...weight), ramp = HEAT[dark ? 'dark' : 'light'];
  weight.forEach((x, i) => {
    // Square roots show tails that would vanish beside the peak.
    const share = Math.sqrt(x / most);
    picture.data.set([...rampColour(ramp, share), 255 * Math.min(1, 1.6 * share)], 4 * i);
  });
  c.putImageData(picture, 0, 0);
  map.image = { canvas, dark, left: (left[1] + 1) * facts.cell, ahead: (ahead[1] + 1) * facts.cell, w: w * facts.cell, h: h * facts.cell };
  return map.image;
}

// On the road, over the agent, which has hardly left by then; the context is in metres, y up.
function drawHeat(c, map, dark) {
  const image = heatImage(map, dark);
  c.save();
  c.translate(map.x, map.y);
  c.rotate(map.heading - Math.PI / 2);
  c.scale(1, -1);
  c.drawImage(image.canvas, -image.left, -image.ahead, image.w, image.h);
  c.restore();
}

function canvasOf(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight, c = canvas.getContext('2d');
  Object.assign(canvas, { width: Math.round(w * ratio), height: Math.round(h * ratio) });
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.font = '11px system-ui, sans-serif';
  return [c, w, h];
}

// The map alone, ahead is up; `went` is where the agent came out in this future.
function drawHeatMap(canvas, map, went, colours, dark) {
  const [c, w, h] = canvasOf(canvas), image = heatImage(map, dark), bottom = 16;
  const scale = Math.min((w - 60) / Math.max(image.w, 2), (h - bottom - 8) / Math.max(image.h, 2));
  const [cx, cy] = [w / 2 - (image.w / 2 - image.left) * scale, 4 + (h - bottom - 8) / 2 - (image.h / 2 - image.ahead) * scale];
  c.drawImage(image.canvas, cx - image.left * scale, cy - image.ahead * scale, image.w * scale, image.h * scale);
  c.fillStyle = c.strokeStyle = colours.text;
  if (went) {
    const dx = went.x - map.x, dy = went.y - map.y, [ux, uy] = [Math.cos(map.heading), Math.sin(map.heading)];
    const [px, py] = [cx - (dy * ux - dx * uy) * scale, cy - (dx * ux + dy * uy) * scale];
    c.beginPath();
    for (const [a, b] of [[-5, 0], [5, 0], [0, -5], [0, 5]]) if (a < 0 || b < 0) c.moveTo(px + a, py + b); else c.lineTo(px + a, py + b);
    // A halo, because it may lie on any colour of the map.
    c.lineWidth = 4; c.strokeStyle = colours.ground; c.stroke();
    c.lineWidth = 1.5; c.strokeStyle = colours.text; c.stroke();
  }
  // A metre or more to measure by.
  const metres = [0.5, 1, 2, 5, 10, 20].find(m => m * scale > 28) || 50, y = h - 6;
  c.globalAlpha = 0.75; c.lineWidth = 1; c.beginPath();
  c.moveTo(6, y - 3); c.lineTo(6, y); c.lineTo(6 + metres * scale, y); c.lineTo(6 + metres * scale, y - 3); c.stroke();
  c.textAlign = 'left'; c.fillText(`${metres} m`, 11 + metres * scale, y + 2);
  c.textAlign = 'right'; c.fillText('ahead \u2191', w - 4, 12);
  c.globalAlpha = 1;
}

// Shares of draws: [{from, to, share}], with the bars' unit below and the value that came out marked.
function drawBars(canvas, { unit, first, counts }, offset, draws, value, text, colours, dark) {
  const [c, w, h] = canvasOf(canvas), left = 38, right = 6, top = 6, bottom = 16, n = Math.max(counts.length, 8);
  const start = first - Math.floor((n - counts.length) / 2), most = Math.max(...counts), width = (w - left - right) / n;
  const px = x => left + ((x + offset) / unit - start) * width;
  c.fillStyle = HEAT[dark ? 'dark' : 'light'][dark ? 2 : 1];
  counts.forEach((count, i) => {
    const tall = (h - top - bottom) * count / most;
    c.fillRect(left + (first + i - start) * width + 0.5, h - bottom - tall, Math.max(width - 1, 1), tall);
  });
  c.fillStyle = c.strokeStyle = colours.text;
  if (Number.isFinite(value) && px(value) >= left && px(value) <= w - right) { c.lineWidth = 1.5; c.beginPath(); c.moveTo(px(value), top - 3); c.lineTo(px(value), h - bottom); c.stroke(); }
  c.globalAlpha = 0.75; c.textBaseline = 'middle'; c.textAlign = 'right';
  c.fillText(`${Math.round(100 * most / draws)} %`, left - 5, top + 3);
  c.fillText('0 %', left - 5, h - bottom - 2);
  c.textBaseline = 'alphabetic';
  c.textAlign = 'left'; c.fillText(text(start * unit - offset), left, h - 3);
  c.textAlign = 'right'; c.fillText(text((start + n) * unit - offset), w - right, h - 3);
  c.globalAlpha = 0.2; c.lineWidth = 1; c.beginPath(); c.moveTo(left, h - bottom + 0.5); c.lineTo(w - right, h - bottom + 0.5); c.stroke();
  c.globalAlpha = 1;
}
