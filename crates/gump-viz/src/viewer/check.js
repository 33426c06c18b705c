// What the browser test runs: opened as viewer.html#check, the page tries itself and reports into
// an element #report. Nothing of it runs otherwise.

if (location.hash === '#check') {
  const wait = milliseconds => new Promise(done => setTimeout(done, milliseconds));
  const ready = async () => { while (!scene && !errors.length) await wait(10); };
  const differs = (a, b) => a.length !== b.length || a.some((byte, i) => byte !== b[i]);
  const picture = () => { paint(); return scene.canvas.toDataURL(); };
  const state = (take, agent, t) => { const s = stateAt(world, take, agent, t); return s && [s.x + facts.origin[0], s.y + facts.origin[1], s.heading, s.speed]; };
  const press = key => document.dispatchEvent(new KeyboardEvent('keydown', { key, bubbles: true }));

  const check = async () => {
    await ready();
    const packed = fromBase64(SCENES[0].data), report = {};
    report.inflates_alike = !differs(await inflate(packed), inflateHere(packed));
    report.takes = world.takes.length;
    report.dark = ui.dark;
    report.agents = facts.agents.length;
    seek(span[0]); play(true);
    // A browser without a window draws when it likes: here the clock is ours.
    for (let i = 0; i < 30; i++) advance(1 / 60);
    report.played_s = ui.t - span[0];
    play(false); seek(span[1]);
    const pictures = new Set();
    for (let k = 0; k < world.takes.length; k++) { show(k); pictures.add(picture()); }
    report.different_takes = pictures.size;
    report.ends = world.takes.map((take, k) => state(k, facts.ego, take.first + (take.frames - 1) * take.dt));
    const changes = keys => { const before = picture(); keys.forEach(press); return picture() !== before; };
    report.changes = { all: changes(['a']), colour: changes(['c']), ego: changes(['e']), follow: changes(['f', 'Home']), up: changes(['u']), heading: changes(['h']), trails: changes(['l', 't']), beside: changes(['b']), alone: changes(['b', 'l']), zoom: changes(['+']), fit: changes(['0']) };
    // All futures in one pane, then in one of two: the lines that are kept are those of the new pane.
    const kept_alike = () => { const kept = picture(); scene.overlay.key = ''; return picture() === kept; };
    seek(0); show('all'); paint(); press('b');
    report.overlay_fits_its_pane = kept_alike();
    press('b'); show('all');
    report.overlay_fits_its_pane &&= kept_alike();
    seek(0); show(1); choose(facts.ego); paint();
    // Heat in the panel and on the road; none of another future.
    const inked = canvas => { const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height); let n = 0; for (let i = 3; i < data.length; i += 4) n += data[i] > 0; return n; };
    report.heat = [...document.querySelectorAll('#heat canvas')].map(inked);
    const hot = picture(), kept = world.heat;
    world.heat = []; report.heat_on_road = picture() !== hot; world.heat = kept;
    show(2); paint(); report.heat_elsewhere = !$('heat').hidden;
    show(1);
    const looks = ways.map(colour => { ui.colour = colour; dress(); return picture(); });
    report.colours = [ways, new Set(looks).size];
    press('c'); paint();
    report.charts = $('agent').querySelectorAll(':scope > figure canvas').length;
    $('candidates').querySelector('button').click();
    report.candidate_shows = [ui.candidate, ui.shown, $('futures-title').textContent];
    report.candidates = $('candidates').querySelectorAll('li').length;
    report.parts = [...document.querySelectorAll('[data-parts]:not([hidden]) dt')].map(dt => `${dt.textContent} ${dt.nextSibling.textContent}`);
    report.marks = $('marks').querySelectorAll('li').length;
    seek(1.5); choose(facts.ego); paint();
    report.tip = $('tip').hidden ? '' : $('tip').textContent;
    report.address = written();
    // Where the chosen agent is told of can be seen without scrolling, on a phone too.
    report.panel_in_sight = $('agent').getBoundingClientRect().top < window.innerHeight - 40;
    report.ruler = checkRuler(picture);
    report.scenes = await checkScenes();
    report.wide = document.documentElement.scrollWidth > window.innerWidth;
    return report;
  };
  // A pointer of the browser is not there to be captured: the canvas gets events alone.
  const point = (kind, pointerType, [x, y], more = {}) => {
    const { left, top } = scene.canvas.getBoundingClientRect();
    scene.canvas.dispatchEvent(new PointerEvent(`pointer${kind}`, { pointerId: 1, pointerType, clientX: left + x, clientY: top + y, bubbles: true, ...more }));
  };
  const tap = (...at) => { point('down', 'touch', at); point('up', 'touch', at); };
  const drag = (from, to, more) => { point('down', 'mouse', from, more); point('move', 'mouse', to, more); point('up', 'mouse', to, more); };

  // By a drag from agent to agent, by taps, with shift from place to place; Escape clears.
  const checkRuler = picture => {
    scene.canvas.setPointerCapture = () => {};
    press('Escape'); show(0); seek(0); fit(); zoom(0.6); paint();
    const said = () => { paint(); return $('measure').hidden ? '' : $('measure').textContent; };
    const where = id => { const s = stateAt(world, 0, facts.agents.findIndex(agent => agent.id === id), 0); return scene.onCanvas(s.x, s.y); };
    const [ego, other] = [where('0'), where('9')], plain = picture(), found = {};
    document.querySelector('[data-do=ruler]').click();
    found.asks = said();
    drag(ego, other);
    found.agents = said();
    found.drawn = picture() !== plain;
    found.address = written();
    seek(1); found.later = said(); seek(0);
    press('Escape');
    found.cleared = said();
    press('r');
    tap(...ego); found.half = said();
    tap(...other); found.taps = said();
    press('Escape');
    const place = [ego[0] + 80, ego[1]];
    drag(place, [place[0] + 10 * scene.camera.scale, place[1]], { shiftKey: true });
    found.places = said();
    press('Escape');
    found.still = picture() === plain && ui.selected < 0;
    return found;
  };

  // From the list, by key and by the buttons over the road; each scene has a name in the address.
  const checkScenes = async () => {
    const names = [], shown = async () => { await wait(50); paint(); remember(); names.push([document.querySelector('h1').textContent, facts.agents.length, sceneName(at)]); };
    $('scenes').querySelectorAll('button')[1].click(); await shown();
    press('PageDown'); await shown();
    document.querySelector('[data-do=earlier]').click(); await shown();
    press('PageUp'); await shown();
    return { listed: $('scenes').querySelectorAll('button').length, pressed: $('scenes').querySelectorAll('[aria-pressed=true]').length, names, address: written() };
  };

  check().catch(error => ({ error: String(error.stack || error) })).then(report => {
    const out = document.createElement('pre');
    out.id = 'report';
    out.textContent = JSON.stringify({ ...report, errors });
    document.body.append(out);
  });
}
