// Reading what pack.rs wrote.

// The scenes of this file: what each says of itself, and its bytes as text.
const SCENES = [...document.querySelectorAll('script[type="application/json"]')].map(said => ({ facts: JSON.parse(said.textContent), data: said.nextElementSibling.textContent }));
// What the scene that is shown says of itself.
let { facts } = SCENES[0] || { facts: null };

function fromBase64(text) {
  const letters = atob(text.trim());
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  if (typeof DecompressionStream === 'undefined') return inflateHere(bytes);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate-raw'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// RFC 1951, for browsers that cannot do it themselves.
function inflateHere(bytes) {
  let out = new Uint8Array(bytes.length * 4), length = 0, at = 0, held = 0, have = 0;
  const bits = n => {
    while (have < n) { held |= bytes[at++] << have; have += 8; }
    const value = held & ((1 << n) - 1);
    held >>>= n; have -= n;
    return value;
  };
  const put = byte => {
    if (length === out.length) { const old = out; out = new Uint8Array(length * 2); out.set(old); }
    out[length++] = byte;
  };
  // How many codes there are of each length, and symbols in the order of their codes.
  const table = lengths => {
    const counts = new Uint16Array(16), symbols = [];
    for (let l = 1; l < 16; l++) lengths.forEach((n, s) => { if (n === l) { counts[l]++; symbols.push(s); } });
    return { counts, symbols };
  };
  const symbol = ({ counts, symbols }) => {
    let code = 0, first = 0, index = 0;
    for (let l = 1; l < 16; l++) {
      code |= bits(1);
      if (code - first < counts[l]) return symbols[index + code - first];
      index += counts[l]; first = (first + counts[l]) << 1; code <<= 1;
    }
    throw new Error('the data is damaged');
  };
  const bases = (n, extra, first) => {
    const list = [];
    for (let i = 0, base = first; i < n; i++) { list.push(base); base += 1 << extra(i); }
    return list;
  };
  const lengthExtra = i => (i < 8 || i === 28 ? 0 : (i >> 2) - 1), distanceExtra = i => (i < 4 ? 0 : (i >> 1) - 1);
  const lengthBase = bases(28, lengthExtra, 3).concat(258), distanceBase = bases(30, distanceExtra, 1);
  const fixed = [table([...Array(288).keys()].map(i => (i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8))), table(Array(30).fill(5))];
  const order = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
  const dynamic = () => {
    const nLiterals = bits(5) + 257, nDistances = bits(5) + 1, nCodes = bits(4) + 4, lengths = Array(19).fill(0);
    for (let i = 0; i < nCodes; i++) lengths[order[i]] = bits(3);
    const codes = table(lengths), all = [];
    while (all.length < nLiterals + nDistances) {
      const s = symbol(codes);
      if (s < 16) { all.push(s); continue; }
      const value = s === 16 ? all[all.length - 1] : 0;
      for (let n = s === 16 ? 3 + bits(2) : s === 17 ? 3 + bits(3) : 11 + bits(7); n > 0; n--) all.push(value);
    }
    return [table(all.slice(0, nLiterals)), table(all.slice(nLiterals))];
  };
  for (let last = 0; !last;) {
    last = bits(1);
    const kind = bits(2);
    if (kind === 0) {
      held = have = 0;
      const n = bytes[at] | (bytes[at + 1] << 8);
      at += 4;
      for (let i = 0; i < n; i++) put(bytes[at++]);
      continue;
    }
    const [literals, distances] = kind === 1 ? fixed : dynamic();
    for (let s; (s = symbol(literals)) !== 256;) {
      if (s < 256) { put(s); continue; }
      const n = lengthBase[s - 257] + bits(lengthExtra(s - 257)), d = symbol(distances);
      const from = length - distanceBase[d] - bits(distanceExtra(d));
      for (let i = 0; i < n; i++) put(out[from + i]);
    }
  }
  return out.slice(0, length);
}

// What features are, by the number that pack.rs gives them.
const KINDS = ['surface', 'lane', 'route', 'crosswalk', 'bump', 'stopLine', 'brokenWhite', 'solidWhite', 'brokenYellow', 'solidYellow', 'edge', 'stopSign', 'turn'];

// Road and traffic: features [{kind, width, xs, ys}], takes with one row of frames per agent
// (NaN where it is absent) and per light, metrics over time, and what agents might do next.
function unpack(bytes, facts) {
  let at = 0;
  // Products instead of shifts: numbers may have more than 32 bits.
  const unsigned = () => {
    for (let n = 0, weight = 1; ; weight *= 128) {
      const byte = bytes[at++];
      n += (byte & 127) * weight;
      if (byte < 128) return n;
    }
  };
  const signed = () => { const n = unsigned(); return n % 2 ? -(n + 1) / 2 : n / 2; };
  const line = (into, from, n, unit) => {
    for (let i = 0, last = 0, slope = 0; i < n; i++) {
      slope += signed();
      last += slope;
      into[from + i] = last * unit;
    }
    return into;
  };
  const features = [];
  for (let i = 0; i < facts.features; i++) {
    const kind = unsigned(), width = unsigned() * facts.centi, n = unsigned();
    features.push({ kind: KINDS[kind], width, xs: line([], 0, n, facts.centi), ys: line([], 0, n, facts.centi) });
  }
  const nAgents = facts.agents.length, nLights = facts.lights.length;
  const takes = facts.takes.map(({ name, first, dt, frames }) => {
    const row = () => new Float32Array(nAgents * frames).fill(NaN);
    const take = { name, first, dt, frames, x: row(), y: row(), heading: row(), speed: row(), lights: new Uint8Array(nLights * frames) };
    const channels = [[take.x, facts.centi], [take.y, facts.centi], [take.heading, 2 * Math.PI / facts.headings], [take.speed, facts.centi]];
    for (let a = 0; a < nAgents; a++) {
      let frame = a * frames;
      for (let runs = unsigned(); runs > 0; runs--) {
        frame += unsigned();
        const n = unsigned();
        for (const [channel, unit] of channels) line(channel, frame, n, unit);
        frame += n;
      }
    }
    for (let l = 0; l < nLights; l++) {
      let frame = l * frames;
      for (let runs = unsigned(); runs > 0; runs--) {
        const colour = unsigned(), n = unsigned();
        take.lights.fill(colour, frame, frame += n);
      }
    }
    return take;
  });
  const metrics = Array.from({ length: unsigned() }, () => {
    const track = { name: facts.metrics[unsigned()], agent: unsigned(), take: unsigned(), first: unsigned(), values: [] };
    for (let runs = unsigned(); runs > 0; runs--) {
      for (let gap = unsigned(); gap > 0; gap--) track.values.push(NaN);
      const n = unsigned();
      line(track.values, track.values.length, n, facts.centi);
    }
    return track;
  });
  const bars = unit => ({ unit, first: signed(), counts: Array.from({ length: unsigned() }, unsigned) });
  const heat = Array.from({ length: unsigned() }, () => {
    const map = { agent: unsigned(), take: unsigned(), from: unsigned() / 1000, ahead: unsigned() / 1000, draws: unsigned(), cells: [] };
    if (!map.draws) return map;
    Object.assign(map, { x: signed() * facts.centi, y: signed() * facts.centi, heading: signed() * 2 * Math.PI / facts.headings });
    let left = 0, ahead = 0;
    for (let n = unsigned(); n > 0; n--) map.cells.push({ left: left += signed(), ahead: ahead += signed(), count: unsigned() });
    return Object.assign(map, { speeds: bars(facts.speedBar), turns: bars(facts.turnBar) });
  });
  if (at !== bytes.length) throw new Error(`read ${at} of ${bytes.length} bytes`);
  return { features, takes, metrics, heat };
}
