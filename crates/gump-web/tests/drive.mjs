// Lets the network drive in the engine that browsers get, and prints everyone's places at each half
// second: `node drive.mjs FOLDER HALF_SECONDS`, where FOLDER is docs/live.

import { readFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';
import { join, resolve } from 'node:path';

const [folder, halfSeconds] = [resolve(process.argv[2]), Number(process.argv[3])];
const { initSync, Game } = await import(pathToFileURL(join(folder, 'engine/gump_web.js')));
initSync({ module: readFileSync(join(folder, 'engine/gump_web_bg.wasm')) });

const scene = readFileSync(join(folder, 'scenes/crossing.tfrecord.gz'));
const weights = readFileSync(join(folder, 'gump-relative.safetensors'));
const game = new Game(scene, 'crossing', weights, 1, 1);
const answers = [];
for (let i = 0; i < halfSeconds; i += 1) {
  for (let k = 0; k < 5; k += 1) game.tick(1, 0, 0, 20, false);
  answers.push([...game.numbers(game.driven())]);
}
console.log(`ANSWERS ${JSON.stringify(answers)}`);
