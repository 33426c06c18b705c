// Holds the engine, away from the page: whoever drives never waits for the network.
//
// Every message has a number, what to do, and what that needs; every answer has the number and
// either what came of it or a sentence about what went wrong.

import init, { Game } from './engine/gump_web.js';

let memory = null;
let weights = null;
let game = null;

/** Whether the browser runs programs with vectors of 128 bits; the engine is built with them. */
function hasVectors() {
  const vectorFunction = [
    0, 0x61, 0x73, 0x6d, 1, 0, 0, 0,
    1, 5, 1, 0x60, 0, 1, 0x7b,
    3, 2, 1, 0,
    10, 22, 1, 20, 0, 0xfd, 0x0c, ...new Array(16).fill(0), 0x0b,
  ];
  return typeof WebAssembly === 'object' && WebAssembly.validate(new Uint8Array(vectorFunction));
}

async function fetched(path, what) {
  let response;
  try {
    response = await fetch(path);
  } catch {
    throw new Error(`${what} could not be fetched: the server of this page does not answer.`);
  }
  if (!response.ok) {
    throw new Error(`${what} could not be fetched: the server answers ${response.status} for ${path}.`);
  }
  return new Uint8Array(await response.arrayBuffer());
}

/** What the page needs to draw after anything that moves the game. */
function picture(frame, wants) {
  return {
    driven: game.driven(),
    frame,
    numbers: game.numbers(frame),
    trail: game.trail(),
    fans: frame === game.driven() ? (wants.fans ?? []).map(draw => [draw, game.fan(draw)]) : [],
    events: game.events(),
  };
}

function opened(scene, name, seed, density) {
  const next = new Game(scene, name, weights, seed, density);
  if (game) game.free();
  game = next;
}

const doing = {
  async begin({ manifest }) {
    if (!hasVectors()) {
      throw new Error('This browser cannot run the engine: it has no WebAssembly with 128-bit SIMD. Chrome 91, Firefox 89, Safari 16.4 and newer have it.');
    }
    const [program, bytes] = await Promise.all([
      fetched(`./engine/gump_web_bg.wasm`, 'The engine'),
      fetched(manifest.weights.file, 'The weights of the network'),
    ]);
    try {
      ({ memory } = await init({ module_or_path: program }));
    } catch (error) {
      throw new Error(`The engine does not start in this browser: ${error.message}.`);
    }
    if (Game.checksum(bytes) !== manifest.weights.sha256) {
      throw new Error('The weights of the network were damaged on their way: their checksum is not the one in the manifest. Load the page again.');
    }
    weights = bytes;
  },

  async open({ scene, path, name, seed, density }) {
    const bytes = scene ?? await fetched(path, 'The scene');
    opened(bytes, name, seed, density);
    return { road: JSON.parse(game.road()), bytes, ...picture(0, {}) };
  },

  tick({ input, fans }) {
    const began = performance.now();
    const [driver, pedal, wheel, temperature, reverse] = input;
    game.tick(driver, pedal, wheel, temperature, Boolean(reverse));
    return { ...picture(game.driven(), { fans }), ms: performance.now() - began };
  },

  look({ frame, fans }) {
    return picture(frame, { fans });
  },

  rewind({ frame, fans }) {
    game.rewind(frame);
    return picture(frame, { fans });
  },

  inputs({ code }) {
    return Game.inputs_of(code);
  },

  branch({ frame }) {
    game.branch(frame);
  },

  branchOn() {
    const until = performance.now() + 60;
    let more = true;
    while (more && performance.now() < until) more = game.branch_on();
    if (more) return { progress: game.branch_progress() };
    const ways = Array.from({ length: 8 }, (_, k) => game.branch_numbers(k));
    return { progress: 1, ways, table: JSON.parse(game.branch_table()) };
  },

  summary() {
    return JSON.parse(game.summary());
  },

  code() {
    return { code: game.code(), fingerprint: game.fingerprint() };
  },

  /** Half seconds of the network driving everyone, milliseconds each; the first ones warm up. */
  bench({ halfSeconds }) {
    const times = [];
    for (let i = 0; i < halfSeconds; i += 1) {
      const began = performance.now();
      for (let k = 0; k < 5; k += 1) game.tick(1, 0, 0, 20, false);
      times.push(performance.now() - began);
    }
    return { times, memory: memory.buffer.byteLength, fingerprint: game.fingerprint() };
  },
};

// One thing after another, in the order in which it was asked.
let last = Promise.resolve();
onmessage = ({ data }) => {
  last = last.then(async () => {
    try {
      const result = await doing[data.what](data);
      postMessage({ id: data.id, result });
    } catch (error) {
      postMessage({ id: data.id, error: error.message ?? String(error), broken: error instanceof WebAssembly.RuntimeError });
    }
  });
};
