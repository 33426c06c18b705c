// The page: state, controls, playback.

const $ = id => document.getElementById(id);
const errors = [];
window.addEventListener('error', event => errors.push(String(event.message)));
window.addEventListener('unhandledrejection', event => errors.push(String(event.reason)));

const dark = window.matchMedia('(prefers-color-scheme: dark)');
const ui = { t: 0, playing: false, speed: 1, shown: 0, colour: 'class', follow: -1, heading: false, trails: true, selected: -1, hovered: -1, pane: 0, left: null, up: 'ego', candidate: -1, ruling: false, ends: [], dark: dark.matches };
let world, scene, span, stale = true, charted = '';
// Which scene is shown, and which was asked for last.
let at = -1, asked = 0;
// Ways of colouring that this scene has numbers for.
let ways = [];

const colours = () => PALETTES[ui.dark ? 'dark' : 'light'];
const redraw = () => { stale = true; };
const plural = (n, what) => `${n} ${what}${n === 1 ? '' : 's'}`;

async function begin() {
  if (!SCENES.length) { $('note').textContent = 'There are no scenes in this file.'; return; }
  buildScenes();
  listen();
  ui.shown = SCENES[sceneOf(address())].facts.takes.length > 1 ? 1 : 0;
  await open(sceneOf(address()));
  restore();
  dress();
  window.addEventListener('hashchange', async () => {
    if (location.hash.slice(1) === remembered) return;
    await open(sceneOf(address()));
    restore();
    dress();
  });
  requestAnimationFrame(tick);
}

// Shows a scene; scenes are unpacked when they are first asked for.
async function open(k) {
  asked = k;
  const found = SCENES[k];
  found.world = found.world || unpack(await inflate(fromBase64(found.data)), found.facts);
  if (asked === k && at !== k) enter(k);
}

function enter(k) {
  at = k;
  ({ facts, world } = SCENES[k]);
  scene = new Scene($('view'), world);
  const n = world.takes.length - 1, ends = world.takes.map(take => take.first + (take.frames - 1) * take.dt);
  span = [world.takes[0].first, Math.max(...ends, 0)];
  // What is shown stays, where this scene has it too.
  if (ui.shown === 'all' ? n < 2 : ui.shown > n) ui.shown = Math.min(n, 1);
  Object.assign(ui, { t: 0, selected: -1, hovered: -1, left: null, candidate: -1, ends: [] });
  ways = ['class', 'speed', ...(facts.agents.some(agent => agent.plausibility !== null) ? ['plausibility'] : [])];
  if (!ways.includes(ui.colour)) ui.colour = 'class';
  Object.assign($('time'), { min: span[0], max: span[1], step: 'any', value: 0 });
  $('present').style.left = `${100 * (0 - span[0]) / Math.max(span[1] - span[0], 1e-9)}%`;
  document.title = document.querySelector('h1').textContent = facts.id;
  $('note').textContent = facts.note || `${plural(facts.agents.length, 'agent')}, ${n ? plural(n, 'simulated future') : 'recorded'}`;
  buildTakes(n);
  buildCandidates();
  for (const b of document.querySelectorAll('[data-colour]')) b.hidden = !ways.includes(b.dataset.colour);
  $('pair').hidden = !n;
  buildMarks();
  fit();
}

// What the address calls a scene: its id, or its number where ids repeat.
function sceneName(k) {
  const { id } = SCENES[k].facts;
  return SCENES.filter(other => other.facts.id === id).length > 1 ? String(k + 1) : id;
}

const sceneOf = said => Math.max(SCENES.findIndex((_, k) => sceneName(k) === said.get('scene')), 0);

function nextScene(by) {
  const n = SCENES.length;
  if (n < 2) return;
  play(false);
  open((asked + by + n) % n).then(dress).catch(fail);
}

// The list of scenes: each with what is told of it, or with who is in it where all are told alike.
function buildScenes() {
  const n = SCENES.length, notes = new Set(SCENES.map(({ facts }) => facts.note));
  $('scenes').hidden = $('turn').hidden = n < 2;
  if (n < 2) return;
  $('scenes').querySelector('h2').textContent = plural(n, 'scene');
  $('scenes').querySelector('ol').append(...SCENES.map(({ facts: { id, note, agents, takes } }, k) => {
    const item = document.createElement('li'), b = button('', '', () => { play(false); open(k).then(dress).catch(fail); });
    const name = document.createElement('span'), more = document.createElement('small');
    name.textContent = id;
    more.textContent = notes.size > 1 && note ? note : `${plural(agents.length, 'agent')}, ${plural(takes.length - 1, 'future')}`;
    b.dataset.scene = k;
    b.append(name, more);
    item.append(b);
    return item;
  }));
}

// The address says what is shown: viewer.html#scene=ID&t=4&shown=all&beside=0&colour=speed&agent=3&follow=1&up=north&candidate=2&ruler=3,5.
const address = () => new URLSearchParams(location.hash.slice(1));

function written() {
  const said = new URLSearchParams();
  if (SCENES.length > 1) said.set('scene', sceneName(at));
  if (Math.abs(ui.t) > 0.049) said.set('t', ui.t.toFixed(1));
  said.set('shown', ui.shown);
  if (ui.left !== null) said.set('beside', ui.left);
  if (ui.colour !== 'class') said.set('colour', ui.colour);
  if (ui.selected >= 0) said.set('agent', facts.agents[ui.selected].id);
  if (ui.follow >= 0) said.set('follow', 1);
  if (ui.up !== 'ego') said.set('up', ui.up);
  if (ui.candidate >= 0) said.set('candidate', ui.candidate + 1);
  // Places are not worth their digits.
  if (ui.ends.length > 1 && ui.ends.every(end => end.agent !== undefined)) said.set('ruler', ui.ends.map(end => facts.agents[end.agent].id).join());
  return String(said);
}

function remember() {
  const said = written();
  if (remembered === said || location.hash === '#check') return;
  remembered = said;
  // Browsers refuse pages that write their address too often.
  try { history.replaceState(null, '', `#${remembered}`); } catch { remembered = ''; }
}
let remembered = '', rememberAt = 0;

function restore() {
  const said = address(), n = world.takes.length;
  if (Number.isFinite(Number(said.get('t')))) seek(Number(said.get('t')));
  if (said.get('shown') === 'all' && n > 2) ui.shown = 'all';
  else if (said.has('shown') && world.takes[Number(said.get('shown'))]) ui.shown = Number(said.get('shown'));
  if (ways.includes(said.get('colour'))) ui.colour = said.get('colour');
  const beside = said.get('beside');
  if (beside === 'all' ? n > 2 : said.has('beside') && world.takes[Number(beside)]) ui.left = beside === 'all' ? 'all' : Number(beside);
  if (said.has('up')) { ui.up = said.get('up') === 'north' ? 'north' : 'ego'; scene.camera.angle = upright(); }
  if (said.has('agent')) ui.selected = facts.agents.findIndex(agent => agent.id === said.get('agent'));
  const ends = (said.get('ruler') || '').split(',').map(id => ({ agent: facts.agents.findIndex(agent => agent.id === id) }));
  if (ends.length === 2 && ends.every(end => end.agent >= 0)) ui.ends = ends;
  if (facts.candidates[Number(said.get('candidate')) - 1]) ui.candidate = Number(said.get('candidate')) - 1;
  if (said.has('follow')) ui.follow = ui.selected < 0 ? facts.ego : ui.selected;
}

const isLong = name => name.length > 4;

function button(text, title, act) {
  const b = document.createElement('button');
  Object.assign(b, { textContent: text, title, onclick: act });
  return b;
}

// Whether every future is that of a planner's candidate.
const isPlanned = () => facts.candidates.length > 0 && world.takes.slice(1).every(take => facts.candidates.some(c => c.name === take.name));

function buildTakes(n) {
  const add = (where, text, title, shown) => {
    const b = button(text, title, () => show(shown));
    b.dataset.shown = shown;
    $(where).append(b);
  };
  $('shown').replaceChildren(); $('futures').replaceChildren();
  add('shown', 'recorded', 'The recording (L)', 0);
  if (n) add('shown', n > 1 ? `all ${n} ${isPlanned() ? 'candidates' : 'simulated'}` : 'simulated', n > 1 ? 'Overlay all (A)' : 'The future (A)', n > 1 ? 'all' : 1);
  $('futures-title').hidden = $('futures').hidden = n < 2;
  // A long name is told of when it is shown; its button has its number.
  if (n > 1) for (let i = 1; i <= n; i++) add('futures', isLong(world.takes[i].name) ? i : world.takes[i].name, `${isPlanned() ? 'Candidate' : 'Future'} ${world.takes[i].name}`, i);
}

function buildCandidates() {
  $('candidates').hidden = !facts.candidates.length;
  $('candidates').querySelector('ol').replaceChildren();
  const best = facts.candidates.map((c, i) => ({ ...c, i })).sort((a, b) => (b.score ?? -Infinity) - (a.score ?? -Infinity));
  for (const { name, score, chosen, i } of best) {
    const item = document.createElement('li'), b = button('', 'Show it on the road', () => chooseCandidate(i));
    const words = document.createElement('span'), number = document.createElement('b');
    words.textContent = name + (chosen ? ' (chosen)' : '');
    number.textContent = score === null ? '-' : score.toFixed(3);
    b.append(words, number);
    const made = document.createElement('dl');
    made.hidden = true;
    made.dataset.parts = i;
    for (const [part, value] of facts.candidates[i].parts) {
      const dt = document.createElement('dt'), dd = document.createElement('dd');
      dt.textContent = part.replace(/_/g, ' '); dd.textContent = value === null ? '-' : value.toFixed(3);
      made.append(dt, dd);
    }
    b.dataset.candidate = i;
    item.append(b, made);
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

// The angle of the camera that has the ego of the present, or north, point up.
function upright() {
  const s = stateAt(world, 0, facts.ego, 0);
  return ui.up === 'ego' && s ? s.heading - Math.PI / 2 : 0;
}

// The view of someone who has just opened the page.
function fit() {
  scene.resize();
  const s = stateAt(world, 0, facts.ego, 0) || { x: 0, y: 0 };
  Object.assign(scene.camera, { x: s.x, y: s.y, angle: upright(), scale: Math.max(Math.min(scene.width, scene.height), 200) / 100 });
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
    if (!ui.heading) scene.camera.angle = upright();
    dress();
  },
  up: () => { ui.up = ui.up === 'ego' ? 'north' : 'ego'; ui.heading = false; scene.camera.angle = upright(); dress(); },
  beside: () => {
    const n = world.takes.length;
    // Beside the recording comes a future, beside a future the recording, until another is chosen.
    if (ui.left === null) { ui.left = ui.shown; ui.shown = ui.shown === 0 ? Math.min(1, n - 1) : 0; } else ui.left = null;
    dress();
  },
  trails: () => { ui.trails = !ui.trails; dress(); },
  ruler: () => { ui.ruling = !ui.ruling; ui.ends = []; dress(); },
  earlier: () => nextScene(-1),
  later: () => nextScene(1),
};

// Everything but the canvas follows the state.
function dress() {
  for (const b of document.querySelectorAll('[data-shown]')) press(b, b.dataset.shown === String(ui.shown));
  for (const b of document.querySelectorAll('[data-colour]')) press(b, b.dataset.colour === ui.colour);
  for (const b of document.querySelectorAll('[data-scene]')) {
    const isShown = b.dataset.scene === String(at);
    if (isShown && b.getAttribute('aria-pressed') === 'false') reveal(b);
    press(b, isShown);
  }
  $('turn').querySelector('span').textContent = `${at + 1} of ${SCENES.length}`;
  for (const b of document.querySelectorAll('[data-candidate]')) press(b, b.dataset.candidate === String(ui.candidate));
  for (const made of document.querySelectorAll('[data-parts]')) made.hidden = made.dataset.parts !== String(ui.candidate) || !made.children.length;
  for (const [name, on] of [['follow', ui.follow >= 0], ['heading', ui.heading], ['trails', ui.trails], ['up', ui.up === 'ego'], ['beside', ui.left !== null], ['ruler', ui.ruling]]) press(document.querySelector(`[data-do=${name}]`), on);
  const named = ui.shown > 0 && isLong(world.takes[ui.shown].name);
  const title = isPlanned() ? 'Candidates' : 'Futures';
  $('futures-title').textContent = named ? `${title}: ${world.takes[ui.shown].name}` : title;
  $('panes').classList.toggle('two', ui.left !== null);
  const [one, other] = $('panes').children;
  one.textContent = ui.left === null ? '' : takeName(world, ui.left);
  other.textContent = takeName(world, ui.shown);
  $('play').classList.toggle('on', ui.playing);
  $('play').setAttribute('aria-label', ui.playing ? 'Pause' : 'Play');
  $('speed').value = String(ui.speed);
  dressLegend();
  dressAgent();
  charted = '';
  redraw();
}

// Scrolls a list to one of its buttons, and nothing else: the page stays where it is on a phone.
function reveal(b) {
  const list = b.closest('ol'), top = b.offsetTop;
  if (top < list.scrollTop || top + b.offsetHeight > list.scrollTop + list.clientHeight) list.scrollTop = top - list.clientHeight / 2;
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
    const [low, high] = ui.colour === 'speed' ? ['0', `${FAST} m/s`] : [`plausibility \u2264 ${UNLIKELY}`, '1'];
    const ego = document.createElement('span'), rim = document.createElement('i');
    rim.style.cssText = `background: none; border: 3px solid ${colours().ego}`;
    ego.append(rim, 'ego');
    legend.append(low, bar, high, ego);
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
  box.classList.toggle('chosen', ui.selected >= 0);
  const heading = document.createElement('h2');
  box.append(heading);
  if (ui.selected < 0) {
    heading.textContent = 'Agent';
    const hint = document.createElement('p');
    hint.textContent = 'Click or tap an agent to see its state over time.';
    box.append(hint);
    return;
  }
  const agent = facts.agents[ui.selected];
  heading.textContent = `${ui.selected === facts.ego ? 'Ego, ' : ''}${agent.kind.replace('_', ' ')} ${agent.id}`;
  const state = document.createElement('dl');
  state.id = 'state';
  box.append(state);
  if (world.heat.some(map => map.agent === ui.selected)) buildHeat(box);
  const all = quantities(world, ui.selected);
  if (world.takes.length > 1) {
    const key = document.createElement('p');
    const beside = ui.left > 0 && ui.left !== ui.shown ? ` Dotted: ${takeName(world, ui.left)}, at the left.` : '';
    key.textContent = `${ui.shown === 0 ? 'Solid: recorded.' : 'Dashed: recorded. Solid: simulated.'}${beside} The upright line is now.`;
    box.append(key);
  }
  for (const { name, unit, of } of all) {
    // The recording is nowhere away from itself: no empty chart of that.
    if (ui.shown === 0 && !(ui.left > 0) && !of(0).length) continue;
    const figure = document.createElement('figure'), caption = document.createElement('figcaption'), canvas = document.createElement('canvas');
    caption.textContent = unit ? `${name}, ${unit}` : name;
    canvas.dataset.name = name;
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
  for (const name of ['position: + marks the sample drawn', 'speed, m/s: the line marks the sample drawn', 'turn, degrees, left is +']) {
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
    $('heat-title').textContent = 'Predictive samples';
    $('heat-none').textContent = `Kept for simulated future ${takes.join(', ')} from the present on.`;
    return;
  }
  const where = ui.shown === 'all' ? `future ${world.takes[take].name}, ` : '';
  $('heat-title').textContent = `Predictive samples for +${(map.from + map.ahead).toFixed(1)} s: ${where}${map.draws} samples`;
  const [place, speed, turn] = holder.querySelectorAll('canvas'), went = stateAt(world, take, ui.selected, map.from + map.ahead);
  const degrees = went ? ((went.heading - map.heading) * 180 / Math.PI % 360 + 540) % 360 - 180 : NaN;
  drawHeatMap(place, map, went, colours(), ui.dark);
  drawBars(speed, map.speeds, 0, map.draws, went ? went.speed : NaN, x => x.toFixed(1), colours(), ui.dark);
  drawBars(turn, map.turns, facts.turnBar / 2, map.draws, degrees, x => `${x.toFixed(0)}\u00b0`, colours(), ui.dark);
}

function drawAgentPanel() {
  if (ui.selected < 0) return;
  drawHeatPanel();
  const take = heatTake(ui, world), s = stateAt(world, take, ui.selected, ui.t), { length, width, plausibility, deeds } = facts.agents[ui.selected];
  const degrees = h => ((h * 180 / Math.PI) % 360 + 540) % 360 - 180;
  const rows = s ? [
    ['speed', `${s.speed.toFixed(1)} m/s, ${(s.speed * 3.6).toFixed(0)} km/h`], ['heading', `${degrees(s.heading).toFixed(0)}\u00b0`],
    ['position', `${(s.x + facts.origin[0]).toFixed(1)}, ${(s.y + facts.origin[1]).toFixed(1)} m`], ['size', `${length.toFixed(1)} \u00d7 ${width.toFixed(1)} m`],
    ...(plausibility === null ? [] : [['plausibility', `${plausibility.toFixed(2)} of 1`]]),
    ...(deeds === null ? [] : [['implausible', deeds]]),
  ] : [['', 'not there at this time']];
  $('state').replaceChildren(...rows.flatMap(([name, value]) => {
    const dt = document.createElement('dt'), dd = document.createElement('dd');
    dt.textContent = name; dd.textContent = value;
    return [dt, dd];
  }));
  const ink = kindColour(ui.selected, colours()), takes = ui.shown === 'all' ? world.takes.map((_, i) => i).slice(1) : [ui.shown];
  const canvases = [...$('agent').querySelectorAll(':scope > figure canvas')];
  quantities(world, ui.selected).forEach(quantity => {
    const { name, of } = quantity, canvas = canvases.find(canvas => canvas.dataset.name === name);
    if (!canvas) return;
    const curves = [{ points: of(0), colour: colours().text, width: 1.5, alpha: takes[0] === 0 ? 0.9 : 0.5, dash: takes[0] === 0 ? [] : [4, 3] }];
    for (const k of takes) if (k > 0) curves.push({ points: of(k), colour: ink, width: takes.length > 1 ? 1 : 2, alpha: takes.length > 1 ? Math.max(0.15, 1 / Math.sqrt(takes.length)) : 1 });
    if (ui.left > 0 && ui.left !== ui.shown) curves.push({ points: of(ui.left), colour: ink, width: 1.5, alpha: 1, dash: [1.5, 2.5] });
    drawChart(canvas, curves, span, ui.t, colours(), quantity);
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
  l: () => show(0), a: () => show(world.takes.length > 2 ? 'all' : world.takes.length - 1), c: () => { ui.colour = ways[(ways.indexOf(ui.colour) + 1) % ways.length]; dress(); },
  n: () => nextAgent(1), p: () => nextAgent(-1), e: () => choose(facts.ego), f: actions.follow, h: actions.heading, t: actions.trails, u: actions.up, r: actions.ruler, PageUp: actions.earlier, PageDown: actions.later, b: () => { if (world.takes.length > 1) actions.beside(); },
  '+': actions.nearer, '=': actions.nearer, '-': actions.farther, 0: actions.fit, ',': () => faster(-1), '.': () => faster(1),
  Escape: () => { if (ui.ruling || ui.ends.length) { ui.ruling = false; ui.ends = []; dress(); } else choose(-1); }, '?': () => { $('keys').open = !$('keys').open; },
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
  dark.addEventListener('change', () => { ui.dark = dark.matches; buildMarks(); dress(); });
  new ResizeObserver(() => { charted = ''; redraw(); }).observe($('stage'));
  listenToPointers($('view'));
}

// One finger or the mouse moves the ground, two zoom; a press without a move chooses. With the ruler,
// or with shift, one finger or the mouse measures instead.
function listenToPointers(canvas) {
  const held = new Map();
  let moved = 0, start = null;
  // Both panes show the same ground: a point of the right one is as far from its own left edge.
  const at = event => { scene.resize(panes()); ui.pane = panes() > 1 && event.offsetX > scene.width ? 1 : 0; return [event.offsetX - ui.pane * scene.width, event.offsetY]; };
  const apart = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  canvas.onpointerdown = event => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, at(event));
    if (held.size === 1) moved = 0;
    start = held.size === 1 && (ui.ruling || event.shiftKey) ? endAt(event, at(event)) : null;
  };
  canvas.onpointermove = event => {
    const before = held.get(event.pointerId);
    const under = held.size ? -1 : pickAt(...at(event));
    if (event.pointerType === 'mouse' && under !== ui.hovered) { ui.hovered = under; redraw(); }
    canvas.style.cursor = ui.ruling || start ? 'crosshair' : held.size ? 'grabbing' : under < 0 ? 'grab' : 'pointer';
    if (!before) return;
    const now = at(event), old = held.size === 2 ? apart() : 0;
    held.set(event.pointerId, now);
    moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (moved < 5) return;
    if (held.size === 2) { const [a, b] = [...held.values()]; zoom(apart() / Math.max(old, 1), (a[0] + b[0]) / 2, (a[1] + b[1]) / 2); return; }
    if (start) { ui.ends = [start, endAt(event, now)]; redraw(); return; }
    const [from, to] = [scene.worldAt(...before), scene.worldAt(...now)];
    if (ui.follow >= 0) { ui.follow = -1; dress(); }
    scene.camera.x += from[0] - to[0]; scene.camera.y += from[1] - to[1];
    redraw();
  };
  canvas.onpointerup = canvas.onpointercancel = event => {
    held.delete(event.pointerId);
    if (event.type !== 'pointerup' || held.size || moved >= 5) return;
    // Two presses measure like a drag from the one to the other.
    if (start) { ui.ends = ui.ends.length === 1 ? [...ui.ends, start] : [start]; redraw(); } else choose(pickAt(...at(event)));
  };
  canvas.onpointerleave = () => { ui.hovered = -1; redraw(); };
  canvas.addEventListener('wheel', event => { event.preventDefault(); zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at(event)); }, { passive: false });
}

// An end of the ruler: the agent there, or the place; fingers are less exact than a mouse.
function endAt(event, [px, py]) {
  const agent = pickAt(px, py, event.pointerType === 'mouse' ? 4 : 14), [x, y] = scene.worldAt(px, py);
  return agent < 0 ? { x, y } : { agent };
}

// What the ruler says, in words, of the take at the right.
function tellRuler() {
  const found = ui.ends.length > 1 ? measure(world, heatTake(ui, world), ui.ends, ui.t) : null;
  const asks = ui.ends.length ? 'Now the other end.' : 'Drag from one place or agent to another.';
  $('measure').hidden = !ui.ruling && !ui.ends.length;
  $('measure').textContent = found ? found.words : ui.ends.length > 1 ? 'One of the agents is not there at this time.' : asks;
}

const panes = () => (ui.left === null ? 1 : 2);

// The agent at a point of the pane that was touched.
function pickAt(px, py, reach) { return scene.pick({ ...ui, shown: ui.pane || ui.left === null ? ui.shown : ui.left }, px, py, reach); }

// What an agent is, beside it: of the one under the mouse, or else of the chosen one.
function drawTip() {
  // Beside a ruler it would cover what is measured.
  const tip = $('tip'), isRuled = ui.ruling || ui.ends.length, a = isRuled ? -1 : ui.hovered >= 0 ? ui.hovered : ui.selected;
  const right = panes() > 1 && ui.pane === 1, shown = right || ui.left === null ? ui.shown : ui.left, take = shown === 'all' ? Math.min(1, world.takes.length - 1) : shown;
  const s = a < 0 ? null : stateAt(world, take, a, ui.t);
  tip.hidden = !s;
  if (!s) return;
  const { plausibility } = facts.agents[a], title = document.createElement('b');
  title.textContent = agentName(a);
  const lines = [`${s.speed.toFixed(1)} m/s, ${ui.t < 0 || take === 0 ? 'recorded' : takeName(world, take)}`, ...(plausibility === null ? [] : [`plausibility ${plausibility.toFixed(2)}`])];
  tip.replaceChildren(title, lines.join(', '));
  if (a === ui.selected && matchMedia('(max-width: 46rem)').matches) {
    const link = document.createElement('a');
    Object.assign(link, { href: '#agent', textContent: ' charts', onclick: event => { event.preventDefault(); $('agent').scrollIntoView({ behavior: 'smooth' }); } });
    tip.append(link);
  }
  scene.left = right ? scene.width : 0;
  const [x, y] = scene.onCanvas(s.x, s.y), w = tip.offsetWidth, h = tip.offsetHeight;
  scene.left = 0;
  const whole = scene.width * panes();
  tip.style.transform = `translate(${Math.round(Math.min(Math.max(x + 14, 4), whole - w - 4))}px, ${Math.round(Math.min(Math.max(y - h - 12, 4), scene.height - h - 4))}px)`;
}

// A row for everything that this page draws.
function buildMarks() {
  const list = $('marks').querySelector('ul'), has = kind => world.features.some(feature => feature.kind === kind), c = colours();
  const line = (colour, more = '') => `<path d="M1 7h22" stroke="${colour}" stroke-width="2" fill="none" ${more}/>`;
  const spot = colour => `<circle cx="12" cy="7" r="4.5" fill="${colour}"/>`;
  const box = (fill, more = '') => `<rect x="3" y="3" width="18" height="8" rx="1" fill="${fill}" ${more}/>`;
  const n = world.takes.length - 1;
  const rows = [
    [true, 'road', box(c.road)],
    [has('route'), "the ego's route", box(c.route)],
    [has('lane'), 'driving direction', `<path d="M8 3l6 4-6 4" stroke="${c.direction}" stroke-width="2" fill="none"/>`],
    [has('edge'), 'road edge', line(c.edge)],
    [['brokenWhite', 'solidWhite', 'brokenYellow', 'solidYellow'].some(has), 'lane marking', box(c.road) + line(c.whiteLine, 'stroke-dasharray="5 3"')],
    [has('crosswalk'), 'crosswalk', box(c.road) + [4, 10, 16].map(x => `<rect x="${x}" y="3" width="3" height="8" fill="${c.crosswalk}"/>`).join('')],
    [has('bump'), 'speed bump', box(c.yellowLine, 'opacity="0.5"')],
    [has('stopLine'), 'stop line', box(c.road) + line(c.whiteLine, 'stroke-width="4"')],
    [has('stopSign'), 'stop sign', `<path d="M9 2h6l4 4v3l-4 4h-6l-4-4v-3z" fill="${c.red}"/>`],
    [facts.lights.length, 'traffic light', [c.red, c.yellow, c.green].map((fill, i) => `<circle cx="${4 + 8 * i}" cy="7" r="3" fill="${fill}" stroke="${c.outline}" stroke-width="1.2"/>`).join('')],
    [true, 'ego (outlined)', box('none', `stroke="${c.ego}" stroke-width="3"`)],
    [true, 'front', `<path d="M8 3l10 4-10 4z" fill="${c.text}" opacity="0.7"/>`],
    [true, 'chosen agent', box('none', `stroke="${c.text}" stroke-width="1.6"`)],
    [true, 'fading: last 2 s', line(c.vehicle, 'stroke-width="4" opacity="0.6"')],
    [true, 'thin: future path', line(c.vehicle, 'opacity="0.6"')],
    [n > 1, 'pale boxes: one per future', box(c.vehicle, 'opacity="0.3"')],
    [facts.candidates.length, "planner's candidate; bold: chosen", line(c.text)],
    [world.heat.length, 'predicted positions', spot(scaled(0.7, ui.dark))],
  ];
  list.replaceChildren(...rows.filter(([is]) => is).map(([, name, drawn]) => {
    const item = document.createElement('li');
    item.innerHTML = `<svg viewBox="0 0 24 14" width="24" height="14" aria-hidden="true">${drawn}</svg>`;
    item.append(name);
    return item;
  }));
}

let last = 0;
function tick(time) {
  advance(Math.min((time - last) / 1000, 0.1));
  last = time;
  if (time > rememberAt && !ui.playing) { rememberAt = time + 400; remember(); }
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
  scene.resize(panes());
  if (ui.follow >= 0) {
    const s = stateAt(world, ui.shown === 'all' ? 0 : ui.shown, ui.follow, ui.t);
    if (s) Object.assign(scene.camera, { x: s.x, y: s.y }, ui.heading ? { angle: s.heading - Math.PI / 2 } : {});
  }
  scene.draw(ui, colours());
  drawTip();
  tellRuler();
  $('time').value = ui.t;
  $('clock').textContent = `${ui.t < -0.0001 ? '\u2212' : '+'}${Math.abs(ui.t).toFixed(1)} s`;
  const key = `${ui.t.toFixed(3)},${$('agent').clientWidth}`;
  if (key !== charted) { charted = key; drawAgentPanel(); }
}

function fail(error) {
  errors.push(String(error));
  $('note').textContent = `This page cannot be shown: ${error}`;
  console.error(error);
}

begin().catch(fail);
