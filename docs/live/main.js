// The page: what is on the screen, and a tenth of a second after another.

import { FUTURES, View } from './draw.js';
import { Engine } from './engine.js';
import { Hands } from './input.js';
import * as link from './link.js';

const $ = id => document.getElementById(id);
const TICK_MS = 100;
/** Numbers of an input: driver, pedal, wheel, temperature, gear. */
const INPUT = 5;
/** Draws of what others may do; one is made anew in each tenth of a second. */
const DRAWS = 5;
const ALL_DRAWS = Array.from({ length: DRAWS }, (_, k) => k);
/** A scene as JSON is a few megabytes; more than this would not fit beside the engine. */
const LARGEST_FILE = 64 << 20;
const PARTS = {
  no_ego_at_fault_collisions: 'No at-fault collision',
  drivable_area_compliance: 'Stays on the road',
  driving_direction_compliance: 'Drives with the traffic',
  ego_is_making_progress: 'Makes progress',
  ego_progress_along_expert_route: 'Progress compared with the recorded driver',
  time_to_collision_within_bound: 'Keeps time to collision',
  speed_limit_compliance: 'Keeps the speed limit',
  ego_is_comfortable: 'Is comfortable',
};

const state = {
  manifest: null,
  scene: null, // { id, name, bytes? }
  seed: 1,
  density: 1,
  mode: 'loading', // loading, ready, driving, paused, ended
  before: null,
  now: null,
  trail: null,
  fans: [],
  events: [],
  driven: 0,
  shown: 0,
  script: null,
  input: [0, 0, 0, 20, 0],
  futures: null,
  watched: null,
  watchedFrom: 0,
  answered: 0,
  busy: false,
};

const engine = new Engine();
const view = new View($('view'));
const hands = new Hands({ wheel: $('touch-wheel'), gas: $('touch-gas'), brake: $('touch-brake') });

function trouble(error) {
  $('trouble-text').textContent = error.message ?? String(error);
  $('trouble').hidden = false;
  $('loading').textContent = '';
}
addEventListener('error', event => trouble(new Error(`The page has a fault: ${event.message}`)));
addEventListener('unhandledrejection', event => trouble(event.reason));
$('trouble-close').onclick = () => { $('trouble').hidden = true; };

// ---- Starting -------------------------------------------------------------------------------

async function begin() {
  const response = await fetch('./manifest.json').catch(() => null);
  if (!response?.ok) throw new Error('The list of scenes (manifest.json) could not be fetched. Load the page again.');
  state.manifest = await response.json();
  for (const scene of state.manifest.scenes) {
    $('scene').append(new Option(scene.title, scene.id));
  }
  $('loading').textContent = 'Loading the engine and the network …';
  await engine.ask('begin', { manifest: state.manifest });
  const asked = link.read(location.hash);
  state.seed = asked.seed ?? 1;
  state.density = asked.density ?? 1;
  $('seed').value = String(state.seed);
  $('density').value = String(state.density);
  tellSettings();
  if (new URLSearchParams(location.search).has('bench')) return bench();
  let id = asked.scene ?? state.manifest.scenes[0].id;
  if (id.startsWith('file:')) {
    trouble(new Error(`This link was made with a file of somebody’s own (${id.slice(5)}). Open that file here; until then there is another scene.`));
    id = state.manifest.scenes[0].id;
    delete asked.drive;
  } else if (!state.manifest.scenes.some(scene => scene.id === id)) {
    trouble(new Error(`This link names a scene that this page does not have (${id}).`));
    id = state.manifest.scenes[0].id;
    delete asked.drive;
  }
  await openShipped(id);
  if (asked.drive) {
    const numbers = await engine.ask('inputs', { code: asked.drive });
    state.script = Array.from({ length: numbers.length / INPUT }, (_, i) => [...numbers.subarray(INPUT * i, INPUT * (i + 1))]);
    $('go').textContent = 'Watch this drive';
  }
  performance.mark('ready');
}

async function openShipped(id) {
  const scene = state.manifest.scenes.find(scene => scene.id === id);
  $('scene').value = id;
  $('origin').textContent = scene.notice;
  await open({ id, name: scene.id, path: scene.file });
}

async function openFile(file) {
  if (file.size > LARGEST_FILE) {
    throw new Error(`${file.name} is too large: it has ${Math.ceil(file.size / 2 ** 20)} MB, and the page opens files of up to 64 MB.`);
  }
  const bytes = new Uint8Array(await file.arrayBuffer());
  await open({ id: `file:${file.name}`, name: file.name, bytes });
  let own = [...$('scene').options].find(option => option.dataset.own);
  if (!own) {
    own = new Option('', '');
    own.dataset.own = '1';
    $('scene').append(own);
  }
  own.value = `file:${file.name}`;
  own.textContent = file.name;
  $('scene').value = own.value;
  $('origin').textContent = 'A file of yours; it has not left this page.';
}

/** Opens a scene at its start; what was before stays if it cannot be opened. */
async function open(scene) {
  const was = state.mode;
  setMode('opening');
  let picture;
  try {
    picture = await engine.ask('open', {
      scene: scene.bytes, path: scene.path, name: scene.name, seed: state.seed, density: state.density,
    });
  } catch (error) {
    setMode(was === 'driving' ? 'paused' : was);
    throw error;
  }
  state.scene = { ...scene, bytes: picture.bytes };
  state.script = null;
  state.events = [];
  closeFutures();
  $('score').hidden = true;
  $('driver').value = '0';
  state.fans = [];
  state.input = [0, 0, 0, 20, 0];
  hands.takeOver(0);
  view.lay(picture.road);
  take(picture);
  state.before = null;
  setMode('ready');
  $('go').textContent = 'Drive';
  $('loading').textContent = `${picture.road.agents - 1} others, recorded for ${picture.road.recorded_s.toFixed(0)} s.`;
}

async function anew() {
  if (state.scene) await open(state.scene);
}

/** These draws, if any are to be seen. */
const fans = draws => ($('fans').checked ? draws : []);

function take(picture) {
  state.before = state.now;
  state.now = picture.numbers;
  state.trail = picture.trail;
  for (const [draw, ways] of picture.fans) state.fans[draw] = ways;
  state.events = JSON.parse(picture.events);
  state.driven = picture.driven;
  state.shown = picture.frame;
  state.answered = performance.now();
  view.dirty = true;
  $('time').max = String(picture.driven);
  $('time').value = String(picture.frame);
  $('time-value').textContent = `${(picture.frame / 10).toFixed(1)} s`;
  tellSpeed();
}

/** The ego's speed, metres per second, negative backwards. */
const speed = () => state.now?.[1] ?? 0;

function tellSpeed() {
  $('speed').textContent = String(Math.round(Math.abs(speed()) * 3.6));
  const reverse = Boolean(state.mode === 'driving' ? state.input[4] : speed() < 0);
  $('gear').textContent = reverse ? 'R' : 'D';
  $('gear').title = $('gear').ariaLabel = reverse ? 'Reverse gear' : 'Forward gear';
  $('gear').classList.toggle('reverse', reverse);
  // On a touch screen the pedals say what they do next.
  $('touch-brake').textContent = hands.backs(speed()) ? 'Reverse' : 'Brake';
  $('touch-gas').textContent = speed() < 0 && reverse ? 'Brake' : 'Gas';
}

function setMode(mode) {
  state.mode = mode;
  const started = !['loading', 'opening', 'ready'].includes(mode);
  $('start').hidden = started;
  $('go').disabled = mode !== 'ready';
  for (const id of ['scene', 'open']) $(id).disabled = mode === 'loading' || mode === 'opening';
  $('pause').disabled = !started || mode === 'ended';
  $('pause').textContent = !started || mode === 'driving' ? 'Pause' : 'Resume';
  for (const id of ['time', 'branch', 'end']) $(id).disabled = !started;
  document.body.dataset.mode = mode;
}

// ---- Driving --------------------------------------------------------------------------------

function go() {
  if (state.mode !== 'ready') return;
  hands.hasStirred();
  setMode('driving');
  $('view').focus();
}

function input() {
  const { wheel, pedal } = hands.move(TICK_MS / 1000);
  const reverse = Number(hands.shift(speed()));
  const stirred = hands.hasStirred();
  if (state.script) {
    const next = stirred ? null : state.script[state.driven];
    if (next) {
      $('driver').value = String(next[0]);
      $('temperature').value = String(next[3] / 20);
      tellSettings();
      return next;
    }
    state.script = null;
    if (!stirred) {
      setMode('paused');
      tell('The drive of the link ends here');
      return null;
    }
    tell('You drive now');
    $('driver').value = '0';
  } else if (stirred && $('driver').value !== '0') {
    $('driver').value = '0';
    tell('You drive now');
  }
  const temperature = Math.round(Number($('temperature').value) * 20);
  return [Number($('driver').value), Math.round(pedal * 100), Math.round(wheel * 100), temperature, $('driver').value === '0' ? reverse : 0];
}

async function tick() {
  if (state.mode !== 'driving' || state.busy) return;
  const asked = input();
  if (!asked) return;
  state.busy = true;
  try {
    const known = state.events.length;
    const picture = await engine.ask('tick', { input: asked, fans: fans([(state.driven + 1) % DRAWS]) });
    // Another scene may have been opened meanwhile.
    if (state.mode === 'opening' || state.mode === 'ready') return;
    state.input = asked;
    if (state.mode !== 'driving') state.before = null;
    take(picture);
    for (const event of state.events.slice(known)) tell(event.what[0].toUpperCase() + event.what.slice(1));
  } catch (error) {
    // A rule that cannot drive here hands over; anything else is the end of the drive.
    if (asked[0] > 1) $('driver').value = '0';
    setMode('paused');
    trouble(error);
  } finally {
    state.busy = false;
  }
  bars();
}
setInterval(tick, TICK_MS);

function bars() {
  const [, pedal, wheel] = state.input;
  const set = (id, share) => {
    $(id).style.left = `${50 + Math.min(0, share) * 50}%`;
    $(id).style.width = `${Math.abs(share) * 50}%`;
  };
  set('wheel', -wheel / 100);
  set('pedal', pedal / 100);
}

function tell(what) {
  const item = document.createElement('li');
  item.textContent = what;
  $('events').append(item);
  setTimeout(() => item.remove(), 2500);
}

async function pause() {
  if (state.mode === 'driving') return setMode('paused');
  if (state.mode !== 'paused') return undefined;
  await resume();
  return setMode('driving');
}

/** The drive goes on from the moment that is shown; what came after it is gone. */
async function resume() {
  closeFutures();
  if (state.shown < state.driven) {
    // A link's drive goes on as it was, whatever was looked at in between.
    take(await engine.ask('rewind', { frame: state.shown, fans: fans(ALL_DRAWS) }));
    hands.takeOver(speed());
  }
  state.before = null;
}

let looking = false;
async function look() {
  if (state.mode === 'driving') setMode('paused');
  if (state.mode === 'ended') setMode('paused');
  $('score').hidden = true;
  if (looking) return;
  looking = true;
  let frame;
  do {
    frame = Number($('time').value);
    const driven = Number($('time').max);
    take(await engine.ask('look', { frame, fans: fans(ALL_DRAWS) }));
    if (frame < driven) state.fans = [];
    state.before = null;
  } while (Number($('time').value) !== frame);
  looking = false;
}

// ---- Eight futures --------------------------------------------------------------------------

let branching = 0;

async function branch() {
  if (!['driving', 'paused', 'ended'].includes(state.mode)) return;
  setMode('paused');
  closeFutures();
  branching += 1;
  const mine = branching;
  $('score').hidden = true;
  $('panel').hidden = true;
  $('futures').hidden = false;
  $('futures-rows').replaceChildren();
  $('futures-progress').hidden = false;
  await engine.ask('branch', { frame: state.shown });
  let answer;
  do {
    answer = await engine.ask('branchOn');
    if (mine !== branching) return;
    $('futures-progress').value = answer.progress;
  } while (!answer.ways);
  $('futures-progress').hidden = true;
  state.futures = answer.ways;
  state.watched = null;
  view.dirty = true;
  $('futures-rows').replaceChildren(...answer.table.map(row));
}

function row({ metres, collided_s, off_road_s }, k) {
  const tr = document.createElement('tr');
  tr.tabIndex = 0;
  const cell = (text, bad) => {
    const td = document.createElement('td');
    td.textContent = text;
    if (bad) td.className = 'bad';
    tr.append(td);
    return td;
  };
  const dot = document.createElement('span');
  dot.className = 'dot';
  dot.style.background = FUTURES[k];
  cell('').append(dot);
  cell(`${metres.toFixed(0)} m`);
  cell(collided_s === null ? '–' : `${collided_s.toFixed(1)} s`, collided_s !== null);
  cell(off_road_s === null ? '–' : `${off_road_s.toFixed(1)} s`, off_road_s !== null);
  const choose = () => {
    state.watched = state.watched === k ? null : k;
    state.watchedFrom = performance.now();
    for (const other of $('futures-rows').children) other.classList.toggle('chosen', other === tr && state.watched === k);
    view.dirty = true;
  };
  tr.onclick = choose;
  tr.onkeydown = event => { if (event.key === 'Enter') choose(); };
  return tr;
}

function closeFutures() {
  branching += 1;
  state.futures = null;
  state.watched = null;
  $('futures').hidden = true;
  view.dirty = true;
}

// ---- The end --------------------------------------------------------------------------------

async function end() {
  if (!['driving', 'paused'].includes(state.mode)) return;
  setMode('paused');
  await resume();
  const summary = await engine.ask('summary');
  setMode('ended');
  $('panel').hidden = true;
  $('total').textContent = summary.total.toFixed(2);
  const rows = summary.parts.map(([name, value]) => {
    const tr = document.createElement('tr');
    for (const text of [PARTS[name] ?? name.replaceAll('_', ' '), value === null ? '–' : value.toFixed(2)]) {
      const td = document.createElement('td');
      td.textContent = text;
      tr.append(td);
    }
    if (value !== null && value < 0.5) tr.lastChild.className = 'bad';
    return tr;
  });
  $('parts').replaceChildren(...rows);
  const counted = (n, one, many) => `${n} ${n === 1 ? one : many}`;
  const realism = summary.realism === null ? summary.realism_missing ?? 'Realism could not be measured here.' : `Realism of the first 8 s (Waymo’s metric, this one drive): ${summary.realism.toFixed(3)}.`;
  $('summary').textContent = `${summary.metres.toFixed(0)} m in ${summary.seconds.toFixed(1)} s, ${counted(summary.collisions, 'collision', 'collisions')}, ${counted(summary.off_roads, 'time', 'times')} off the road, ${counted(summary.red_lights, 'red light', 'red lights')}. ${realism}`;
  $('score-hint').textContent = `Progress is compared with the recorded driver over ${summary.compared_seconds.toFixed(1)} s; everything else is judged over the whole drive.`;
  $('score').hidden = false;
}

async function share() {
  const { code } = await engine.ask('code');
  const fragment = link.write({ scene: state.scene.id, seed: state.seed, density: state.density, drive: code });
  history.replaceState(null, '', fragment);
  try {
    await navigator.clipboard.writeText(location.href);
    $('share').textContent = 'Copied';
  } catch {
    $('share').textContent = 'It is in the address';
  }
  setTimeout(() => { $('share').textContent = 'Copy the link'; }, 2500);
}

// ---- The bench ------------------------------------------------------------------------------

async function bench() {
  const out = document.createElement('pre');
  out.id = 'bench';
  out.style.cssText = 'margin:0;padding:12px;overflow:auto;text-align:left;font-size:13px';
  $('start').prepend(out);
  $('go').hidden = true;
  out.textContent = 'Measuring …\n';
  const results = [];
  for (const scene of state.manifest.scenes) {
    const opened = performance.now();
    await openShipped(scene.id);
    const openMs = performance.now() - opened;
    const { times, memory, fingerprint } = await engine.ask('bench', { halfSeconds: 40 });
    const warm = times.slice(4).sort((a, b) => a - b);
    const at = share => warm[Math.floor(share * (warm.length - 1))];
    const result = {
      scene: scene.id, agents: state.now[3], open_ms: Math.round(openMs),
      median_ms: Number(at(0.5).toFixed(1)), p90_ms: Number(at(0.9).toFixed(1)),
      memory_mb: Number((memory / 2 ** 20).toFixed(1)), fingerprint,
    };
    results.push(result);
    out.textContent += `${result.scene}: ${result.agents} agents, half a second of traffic in ${result.median_ms} ms (90 %: ${result.p90_ms} ms), opened in ${result.open_ms} ms, engine ${result.memory_mb} MB\n`;
  }
  out.dataset.results = JSON.stringify(results);
  out.textContent += 'Done.';
}

// ---- What is on the page --------------------------------------------------------------------

function tellSettings() {
  $('temperature-value').textContent = Number($('temperature').value).toFixed(2);
  $('density-value').textContent = `${Math.round(Number($('density').value) * 100)} %`;
}

function restartWith(name, value) {
  const was = state[name];
  state[name] = value;
  anew().catch(error => {
    state[name] = was;
    $(name).value = String(was);
    tellSettings();
    trouble(error);
  });
}

const attempt = action => () => Promise.resolve(action()).catch(trouble);
$('go').onclick = go;
$('pause').onclick = attempt(pause);
$('branch').onclick = attempt(branch);
$('end').onclick = attempt(end);
$('share').onclick = attempt(share);
$('again').onclick = attempt(anew);
$('time').oninput = attempt(look);
$('open').onclick = () => $('file').click();
$('file').onchange = () => {
  const [file] = $('file').files;
  $('file').value = '';
  if (file) openFile(file).catch(trouble);
};
$('scene').onchange = () => {
  const own = state.scene?.id === $('scene').value;
  const was = state.scene?.id;
  (own ? anew() : openShipped($('scene').value)).catch(error => {
    $('scene').value = was ?? '';
    trouble(error);
  });
};
$('menu').onclick = () => {
  $('panel').hidden = !$('panel').hidden;
  $('menu').setAttribute('aria-expanded', String(!$('panel').hidden));
};
$('futures-close').onclick = closeFutures;
$('score-close').onclick = () => { $('score').hidden = true; };
$('temperature').oninput = tellSettings;
$('density').oninput = tellSettings;
$('density').onchange = () => restartWith('density', Number($('density').value));
$('seed').onchange = () => {
  const seed = Math.round(Number($('seed').value));
  const held = Number.isFinite(seed) ? Math.max(0, Math.min(2 ** 32 - 1, seed)) : 1;
  $('seed').value = String(held);
  restartWith('seed', held);
};
$('north').onchange = () => { view.northUp = $('north').checked; view.dirty = true; };
$('fans').onchange = () => { state.fans = []; view.dirty = true; };

const KEYS = {
  Space: () => (state.mode === 'ready' ? go() : pause()),
  Enter: go,
  KeyB: branch,
  KeyE: end,
  KeyR: anew,
  KeyF: () => $('fans').click(),
  KeyN: () => $('north').click(),
  Equal: () => view.zoom(0.8),
  NumpadAdd: () => view.zoom(0.8),
  Minus: () => view.zoom(1.25),
  NumpadSubtract: () => view.zoom(1.25),
  Escape: () => { closeFutures(); $('panel').hidden = true; $('trouble').hidden = true; },
};
addEventListener('keydown', event => {
  const action = KEYS[event.code];
  const busy = event.target instanceof Element && event.target.matches('input, select, button');
  if (!action || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  // On a control, space and enter are its own.
  if (busy && (event.code === 'Space' || event.code === 'Enter' || event.target.type === 'number')) return;
  event.preventDefault();
  Promise.resolve(action()).catch(trouble);
});

$('view').addEventListener('wheel', event => {
  event.preventDefault();
  view.zoom(event.deltaY > 0 ? 1.1 : 1 / 1.1);
}, { passive: false });
const fingers = new Map();
$('view').addEventListener('pointerdown', event => {
  fingers.set(event.pointerId, event);
  $('view').focus();
});
$('view').addEventListener('pointermove', event => {
  if (!fingers.has(event.pointerId)) return;
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
  };
  const two = fingers.size === 2;
  const was = two ? spread() : 0;
  fingers.set(event.pointerId, event);
  if (two && was > 0) view.zoom(was / Math.max(1, spread()));
});
for (const name of ['pointerup', 'pointercancel']) {
  $('view').addEventListener(name, event => fingers.delete(event.pointerId));
}

addEventListener('dragover', event => {
  event.preventDefault();
  document.querySelector('main').classList.add('drop');
});
addEventListener('dragleave', event => {
  if (!event.relatedTarget) document.querySelector('main').classList.remove('drop');
});
addEventListener('drop', event => {
  event.preventDefault();
  document.querySelector('main').classList.remove('drop');
  const [file] = event.dataTransfer.files;
  if (file) openFile(file).catch(trouble);
});
document.addEventListener('visibilitychange', () => {
  if (document.hidden && state.mode === 'driving') setMode('paused');
});
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => { view.dirty = true; });
if (matchMedia('(pointer: coarse)').matches) $('touch').hidden = false;
else addEventListener('touchstart', () => { $('touch').hidden = false; }, { once: true });

let painted = false;
function paint() {
  const since = performance.now() - state.answered;
  const moving = state.mode === 'driving' && since < 3 * TICK_MS;
  const ghosts = state.watched !== null;
  if (view.dirty || moving || ghosts) {
    view.dirty = false;
    view.draw({
      before: state.before, now: state.now, t: Math.min(1, since / TICK_MS), fans: state.futures ? [] : fans(state.fans),
      trail: state.trail, futures: state.futures, watched: state.watched,
      watchedAt: ((performance.now() - state.watchedFrom) / 500) % 16,
    });
    if (state.before && since < 1000) view.dirty = true;
    if (state.now && !painted) {
      painted = true;
      performance.mark('first-picture');
    }
  }
  requestAnimationFrame(paint);
}
requestAnimationFrame(paint);

// For tests and for who is curious: the scene as it is shown.
globalThis.gump = { state, engine, view };

begin().catch(trouble);
