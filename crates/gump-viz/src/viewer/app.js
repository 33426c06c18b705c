// The page: state, controls, playback.

const $ = id => document.getElementById(id);
const errors = [];
window.addEventListener('error', event => errors.push(String(event.message)));
window.addEventListener('unhandledrejection', event => errors.push(String(event.reason)));

const dark = window.matchMedia('(prefers-color-scheme: dark)');
const ui = { t: 0, playing: false, speed: 1, shown: 0, colour: 'class', follow: -1, heading: false, trails: true, selected: -1, candidate: -1, dark: dark.matches };
let world, scene, span, stale = true, charted = '';

// Ways of colouring that this page has numbers for.
const COLOURS = ['class', 'speed', ...(facts.agents.some(agent => agent.realism !== null) ? ['realism'] : [])];

const colours = () => facts.themes[ui.dark ? 'dark' : 'light'];
const redraw = () => { stale = true; };
const plural = (n, what) => `${n} ${what}${n === 1 ? '' : 's'}`;

function begin(unpacked) {
  world = unpacked;
  scene = new Scene($('view'), world);
  const ends = world.takes.map(take => take.first + (take.frames - 1) * take.dt);
  span = [world.takes[0].first, Math.max(...ends, 0)];
  Object.assign($('time'), { min: span[0], max: span[1], step: 'any', value: 0 });
  $('present').style.left = `${100 * (0 - span[0]) / Math.max(span[1] - span[0], 1e-9)}%`;
  const n = world.takes.length - 1;
  $('note').textContent = facts.note || `${plural(facts.agents.length, 'agent')}, ${n ? plural(n, 'future') : 'the log'}`;
  buildTakes(n);
  buildCandidates();
  for (const b of document.querySelectorAll('[data-colour]')) b.hidden = !COLOURS.includes(b.dataset.colour);
  listen();
  if (n) ui.shown = 1;
  fit();
  restore();
  dress();
  requestAnimationFrame(tick);
}

// A link may say what to show: viewer.html#t=4&shown=all&colour=speed&agent=3&follow=1.
function restore() {
  const said = new URLSearchParams(location.hash.slice(1)), n = world.takes.length;
  if (Number.isFinite(Number(said.get('t')))) seek(Number(said.get('t')));
  if (said.get('shown') === 'all' && n > 2) ui.shown = 'all';
  else if (said.has('shown') && world.takes[Number(said.get('shown'))]) ui.shown = Number(said.get('shown'));
  if (COLOURS.includes(said.get('colour'))) ui.colour = said.get('colour');
  if (said.has('agent')) ui.selected = facts.agents.findIndex(agent => agent.id === said.get('agent'));
  if (said.has('follow')) ui.follow = ui.selected < 0 ? facts.ego : ui.selected;
}

const isLong = name => name.length > 4;

function button(text, title, act) {
  const b = document.createElement('button');
  Object.assign(b, { textContent: text, title, onclick: act });
  return b;
}

function buildTakes(n) {
  const add = (where, text, title, shown) => {
    const b = button(text, title, () => show(shown));
    b.dataset.shown = shown;
    $(where).append(b);
  };
  add('shown', 'log', 'What was recorded (L)', 0);
  if (n) add('shown', n > 1 ? `all ${n} futures` : 'the future', 'All over one another (A)', n > 1 ? 'all' : 1);
  $('futures-title').hidden = $('futures').hidden = n < 2;
  // A long name is told of when it is shown; its button has its number.
  if (n > 1) for (let i = 1; i <= n; i++) add('futures', isLong(world.takes[i].name) ? i : world.takes[i].name, `Future ${world.takes[i].name}`, i);
}

function buildCandidates() {
  $('candidates').hidden = !facts.candidates.length;
  const best = facts.candidates.map((c, i) => ({ ...c, i })).sort((a, b) => (b.score ?? -Infinity) - (a.score ?? -Infinity));
  for (const { name, score, chosen, i } of best) {
    const item = document.createElement('li'), b = button('', 'Show it on the road', () => chooseCandidate(i));
    const words = document.createElement('span'), number = document.createElement('b');
    words.textContent = name + (chosen ? ' (chosen)' : '');
    number.textContent = score === null ? '-' : score.toFixed(3);
    b.append(words, number);
    b.dataset.candidate = i;
    item.append(b);
    $('candidates').querySelector('ol').append(item);
  }
}

// With the future of the same name, if there is one.
function chooseCandidate(i) {
  ui.candidate = ui.candidate === i ? -1 : i;
  const take = world.takes.findIndex((take, k) => k > 0 && take.name === facts.candidates[i].name);
  if (ui.candidate >= 0 && take > 0) ui.shown = take;
  dress();
}

function show(shown) { ui.shown = shown; dress(); }

function choose(agent) { ui.selected = agent; dress(); }

// The view of someone who has just opened the page.
function fit() {
  scene.resize();
  const s = stateAt(world, 0, facts.ego, 0) || { x: 0, y: 0 };
  Object.assign(scene.camera, { x: s.x, y: s.y, angle: 0, scale: Math.max(Math.min(scene.width, scene.height), 200) / 100 });
  ui.heading = false; ui.follow = -1;
  redraw();
}

function zoom(factor, px = scene.width / 2, py = scene.height / 2) {
  const before = scene.worldAt(px, py);
  scene.camera.scale = Math.min(Math.max(scene.camera.scale * factor, 0.3), 120);
  const after = scene.worldAt(px, py);
  if (ui.follow < 0) { scene.camera.x += before[0] - after[0]; scene.camera.y += before[1] - after[1]; }
  redraw();
}

function seek(t) { ui.t = Math.min(Math.max(t, span[0]), span[1]); redraw(); }

function play(on) {
  ui.playing = on;
  if (on && ui.t >= span[1] - 1e-6) ui.t = span[0];
  dress();
}

const actions = {
  play: () => play(!ui.playing),
  nearer: () => zoom(1.3),
  farther: () => zoom(1 / 1.3),
  fit: () => { fit(); dress(); },
  follow: () => { ui.follow = ui.follow < 0 ? (ui.selected < 0 ? facts.ego : ui.selected) : -1; if (ui.follow < 0) ui.heading = false; dress(); },
  heading: () => {
    ui.heading = !ui.heading;
    if (ui.heading && ui.follow < 0) ui.follow = ui.selected < 0 ? facts.ego : ui.selected;
    if (!ui.heading) scene.camera.angle = 0;
    dress();
  },
  trails: () => { ui.trails = !ui.trails; dress(); },
};

// Everything but the canvas follows the state.
function dress() {
  for (const b of document.querySelectorAll('[data-shown]')) press(b, b.dataset.shown === String(ui.shown));
  for (const b of document.querySelectorAll('[data-colour]')) press(b, b.dataset.colour === ui.colour);
  for (const b of document.querySelectorAll('[data-candidate]')) press(b, b.dataset.candidate === String(ui.candidate));
  for (const [name, on] of [['follow', ui.follow >= 0], ['heading', ui.heading], ['trails', ui.trails]]) press(document.querySelector(`[data-do=${name}]`), on);
  const named = ui.shown > 0 && isLong(world.takes[ui.shown].name);
  $('futures-title').textContent = named ? `Futures: ${world.takes[ui.shown].name}` : 'Futures';
  $('play').classList.toggle('on', ui.playing);
  $('play').setAttribute('aria-label', ui.playing ? 'Pause' : 'Play');
  $('speed').value = String(ui.speed);
  dressLegend();
  dressAgent();
  charted = '';
  redraw();
}

function press(b, on) { b.setAttribute('aria-pressed', on); }

function dressLegend() {
  const kinds = new Set(facts.agents.map((agent, a) => (a === facts.ego ? 'ego' : ['vehicle', 'pedestrian', 'bicycle'].includes(agent.kind) ? agent.kind : 'other')));
  const items = ['ego', 'vehicle', 'pedestrian', 'bicycle', 'other'].filter(kind => kinds.has(kind));
  const legend = $('legend');
  legend.replaceChildren();
  if (ui.colour !== 'class') {
    const bar = document.createElement('i');
    bar.className = 'ramp';
    bar.style.background = `linear-gradient(90deg, ${RAMP[ui.dark ? 'dark' : 'light'].join(',')})`;
    const [low, high] = ui.colour === 'speed' ? ['0', `${FAST} m/s`] : [`realism \u2264 ${UNLIKE}`, '1'];
    legend.append(low, bar, high);
    return;
  }
  for (const kind of items) {
    const label = document.createElement('span'), swatch = document.createElement('i');
    swatch.style.background = colours()[kind];
    label.append(swatch, kind);
    legend.append(label);
  }
}

function dressAgent() {
  const box = $('agent');
  box.replaceChildren();
  const heading = document.createElement('h2');
  box.append(heading);
  if (ui.selected < 0) {
    heading.textContent = 'Agent';
    const hint = document.createElement('p');
    hint.textContent = 'Click an agent to see its state over time.';
    box.append(hint);
    return;
  }
  const agent = facts.agents[ui.selected];
  heading.textContent = `${ui.selected === facts.ego ? 'Ego, ' : ''}${agent.kind.replace('_', ' ')} ${agent.id}`;
  const state = document.createElement('dl');
  state.id = 'state';
  box.append(state);
  if (world.heat.some(map => map.agent === ui.selected)) buildHeat(box);
  for (const { name } of quantities(world, ui.selected)) {
    const figure = document.createElement('figure'), caption = document.createElement('figcaption'), canvas = document.createElement('canvas');
    caption.textContent = name;
    canvas.onpointerdown = canvas.onpointermove = event => {
      if (!event.buttons) return;
      const x = (event.offsetX - 38) / (canvas.clientWidth - 42);
      seek(span[0] + x * (span[1] - span[0]));
    };
    figure.append(caption, canvas);
    box.append(figure);
  }
}

// Where the agent might be next, then how fast, then how it might turn.
function buildHeat(box) {
  const title = document.createElement('h3'), none = document.createElement('p'), holder = document.createElement('div');
  title.id = 'heat-title'; none.id = 'heat-none'; holder.id = 'heat';
  for (const name of ['where: + is what came out', 'speed, m/s: the line is what came out', 'turn, degrees, left is +']) {
    const figure = document.createElement('figure'), caption = document.createElement('figcaption');
    caption.textContent = name;
    figure.append(caption, document.createElement('canvas'));
    holder.append(figure);
  }
  box.append(title, none, holder);
}

function drawHeatPanel() {
  const holder = $('heat');
  if (!holder) return;
  const take = heatTake(ui, world), map = heatAt(world, take, ui.selected, ui.t);
  holder.hidden = !map; $('heat-none').hidden = Boolean(map);
  if (!map) {
    const kept = world.heat.filter(map => map.agent === ui.selected), takes = [...new Set(kept.map(map => world.takes[map.take].name))];
    $('heat-title').textContent = 'What it might do next';
    $('heat-none').textContent = `Kept for future ${takes.join(', ')} from the present on.`;
    return;
  }
  const where = ui.shown === 'all' ? `future ${world.takes[take].name}, ` : '';
  $('heat-title').textContent = `What it might do by +${(map.from + map.ahead).toFixed(1)} s: ${where}${map.draws} draws`;
  const [place, speed, turn] = holder.querySelectorAll('canvas'), went = stateAt(world, take, ui.selected, map.from + map.ahead);
  const degrees = went ? ((went.heading - map.heading) * 180 / Math.PI % 360 + 540) % 360 - 180 : NaN;
  drawHeatMap(place, map, went, colours(), ui.dark);
  drawBars(speed, map.speeds, 0, map.draws, went ? went.speed : NaN, x => x.toFixed(1), colours(), ui.dark);
  drawBars(turn, map.turns, facts.turnBar / 2, map.draws, degrees, x => `${x.toFixed(0)}\u00b0`, colours(), ui.dark);
}

function drawAgentPanel() {
  if (ui.selected < 0) return;
  drawHeatPanel();
  const take = ui.shown === 'all' ? 0 : ui.shown, s = stateAt(world, take, ui.selected, ui.t), { length, width, realism, deeds } = facts.agents[ui.selected];
  const degrees = h => ((h * 180 / Math.PI) % 360 + 540) % 360 - 180;
  const rows = s ? [
    ['speed', `${s.speed.toFixed(1)} m/s, ${(s.speed * 3.6).toFixed(0)} km/h`], ['heading', `${degrees(s.heading).toFixed(0)}\u00b0`],
    ['position', `${(s.x + facts.origin[0]).toFixed(1)}, ${(s.y + facts.origin[1]).toFixed(1)} m`], ['size', `${length.toFixed(1)} \u00d7 ${width.toFixed(1)} m`],
    ...(realism === null ? [] : [['realism', `${realism.toFixed(2)} of 1`]]),
    ...(deeds === null ? [] : [['in futures', deeds]]),
  ] : [['', 'not there at this time']];
  $('state').replaceChildren(...rows.flatMap(([name, value]) => {
    const dt = document.createElement('dt'), dd = document.createElement('dd');
    dt.textContent = name; dd.textContent = value;
    return [dt, dd];
  }));
  const ink = kindColour(ui.selected, colours()), takes = ui.shown === 'all' ? world.takes.map((_, i) => i).slice(1) : [ui.shown];
  const canvases = $('agent').querySelectorAll(':scope > figure canvas');
  quantities(world, ui.selected).forEach(({ digits, of }, i) => {
    const curves = [{ points: of(0), colour: colours().text, width: 1.5, alpha: takes[0] === 0 ? 0.9 : 0.5, dash: takes[0] === 0 ? [] : [4, 3] }];
    for (const k of takes) if (k > 0) curves.push({ points: of(k), colour: ink, width: takes.length > 1 ? 1 : 2, alpha: takes.length > 1 ? Math.max(0.15, 1 / Math.sqrt(takes.length)) : 1 });
    drawChart(canvases[i], curves, span, ui.t, colours(), digits);
  });
}

function step(frames) { play(false); const dt = world.takes[0].dt; seek(Math.round(ui.t / dt + frames) * dt); }

function nextFuture(by) {
  const n = world.takes.length;
  show(ui.shown === 'all' ? (by > 0 ? 1 : n - 1) : (ui.shown + by + n) % n);
}

// The next agent that is there now.
function nextAgent(by) {
  const n = facts.agents.length, take = ui.shown === 'all' ? 0 : ui.shown;
  for (let k = 1, a = ui.selected < 0 && by < 0 ? n : ui.selected; k <= n; k++) {
    a = (a + by + n) % n;
    if (stateAt(world, take, a, ui.t)) { choose(a); return; }
  }
}

function faster(by) {
  const options = [...$('speed').options].map(o => Number(o.value)), i = options.indexOf(ui.speed) + by;
  ui.speed = options[Math.min(Math.max(i, 0), options.length - 1)];
  dress();
}

const KEYS = {
  ' ': actions.play, ArrowLeft: e => step(e.shiftKey ? -1 / world.takes[0].dt : -1), ArrowRight: e => step(e.shiftKey ? 1 / world.takes[0].dt : 1),
  Home: () => seek(span[0]), End: () => seek(span[1]), ArrowUp: () => nextFuture(-1), ArrowDown: () => nextFuture(1),
  l: () => show(0), a: () => show(world.takes.length > 2 ? 'all' : world.takes.length - 1), c: () => { ui.colour = COLOURS[(COLOURS.indexOf(ui.colour) + 1) % COLOURS.length]; dress(); },
  n: () => nextAgent(1), p: () => nextAgent(-1), e: () => choose(facts.ego), f: actions.follow, h: actions.heading, t: actions.trails,
  '+': actions.nearer, '=': actions.nearer, '-': actions.farther, 0: actions.fit, ',': () => faster(-1), '.': () => faster(1),
  Escape: () => choose(-1), '?': () => { $('keys').open = !$('keys').open; },
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === 'SELECT') return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  // A focused button keeps its own space bar.
  if (!KEYS[key] || (key === ' ' && event.target.tagName === 'BUTTON')) return;
  event.preventDefault();
  KEYS[key](event);
}

function listen() {
  document.addEventListener('keydown', onKey);
  document.addEventListener('click', event => {
    const b = event.target.closest('[data-do], [data-colour]');
    if (!b) return;
    if (b.dataset.do) actions[b.dataset.do]();
    else { ui.colour = b.dataset.colour; dress(); }
  });
  $('time').oninput = event => seek(Number(event.target.value));
  $('speed').onchange = event => { ui.speed = Number(event.target.value); };
  dark.addEventListener('change', () => { ui.dark = dark.matches; dress(); });
  new ResizeObserver(() => { charted = ''; redraw(); }).observe($('stage'));
  listenToPointers($('view'));
}

// One finger or the mouse moves the ground, two zoom; a press without a move chooses.
function listenToPointers(canvas) {
  const held = new Map();
  let moved = 0;
  const at = event => [event.offsetX, event.offsetY];
  const apart = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  canvas.onpointerdown = event => { canvas.setPointerCapture(event.pointerId); held.set(event.pointerId, at(event)); if (held.size === 1) moved = 0; };
  canvas.onpointermove = event => {
    const before = held.get(event.pointerId);
    canvas.style.cursor = held.size ? 'grabbing' : scene.pick(ui, ...at(event)) < 0 ? 'grab' : 'pointer';
    if (!before) return;
    const now = at(event), old = held.size === 2 ? apart() : 0;
    held.set(event.pointerId, now);
    moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (moved < 5) return;
    if (held.size === 2) { const [a, b] = [...held.values()]; zoom(apart() / Math.max(old, 1), (a[0] + b[0]) / 2, (a[1] + b[1]) / 2); return; }
    const [from, to] = [scene.worldAt(...before), scene.worldAt(...now)];
    if (ui.follow >= 0) { ui.follow = -1; dress(); }
    scene.camera.x += from[0] - to[0]; scene.camera.y += from[1] - to[1];
    redraw();
  };
  canvas.onpointerup = canvas.onpointercancel = event => {
    held.delete(event.pointerId);
    if (event.type === 'pointerup' && !held.size && moved < 5) choose(scene.pick(ui, ...at(event)));
  };
  canvas.addEventListener('wheel', event => { event.preventDefault(); zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at(event)); }, { passive: false });
}

let last = 0;
function tick(time) {
  advance(Math.min((time - last) / 1000, 0.1));
  last = time;
  requestAnimationFrame(tick);
}

function advance(elapsed) {
  if (ui.playing) {
    ui.t += elapsed * ui.speed;
    if (ui.t >= span[1]) { ui.t = span[1]; play(false); }
    stale = true;
  }
  if (stale) paint();
}

function paint() {
  stale = false;
  scene.resize();
  if (ui.follow >= 0) {
    const s = stateAt(world, ui.shown === 'all' ? 0 : ui.shown, ui.follow, ui.t);
    if (s) Object.assign(scene.camera, { x: s.x, y: s.y }, ui.heading ? { angle: s.heading - Math.PI / 2 } : {});
  }
  scene.draw(ui, colours());
  $('time').value = ui.t;
  $('clock').textContent = `${ui.t < -0.0001 ? '\u2212' : '+'}${Math.abs(ui.t).toFixed(1)} s`;
  const key = `${ui.t.toFixed(3)},${$('agent').clientWidth}`;
  if (key !== charted) { charted = key; drawAgentPanel(); }
}

inflate(fromBase64($('data').textContent)).then(unpack).then(begin).catch(error => {
  errors.push(String(error));
  $('note').textContent = `This page cannot be shown: ${error}`;
  console.error(error);
});
