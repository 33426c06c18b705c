// Draws the drive: the road and everyone on it as traffic.js does, with what the engine says of the
// ways of agents.

import { PALETTES, aim, drawAgent, drawLight, drawRoad, layRoad } from './traffic.js';

const HEAD = 5;
const AGENT = 8;
const WAY = 9;

/** Kinds of agents and states of lights, by number. */
const KINDS = ['vehicle', 'pedestrian', 'bicycle', 'other'];
const LIGHTS = ['other', 'red', 'yellow', 'green'];
const MARKINGS = { 'broken white': 'brokenWhite', white: 'solidWhite', 'broken yellow': 'brokenYellow', yellow: 'solidYellow', plain: 'solidWhite' };
/** Eight colours that stay apart on both grounds. */
export const FUTURES = ['#e69f00', '#0072b2', '#009e73', '#cc79a7', '#d55e00', '#7b5fc0', '#56b4e9', '#8a8d2a'];

const dark = matchMedia('(prefers-color-scheme: dark)');
const colours = () => PALETTES[dark.matches ? 'dark' : 'light'];

function line(points, path = new Path2D()) {
  for (let i = 0; i < points.length; i += 2) {
    if (i) path.lineTo(points[i], points[i + 1]);
    else path.moveTo(points[i], points[i + 1]);
  }
  return path;
}

/** The road as the engine tells it, as features that traffic.js lays out. */
function features(road) {
  const feature = (kind, points, width = 0) => ({
    kind, width, xs: points.filter((_, i) => i % 2 === 0), ys: points.filter((_, i) => i % 2 === 1),
  });
  return [
    ...road.drivable.map(points => feature('surface', points)),
    ...road.lanes.map(lane => feature(lane.kind === 'turn' ? 'turn' : 'lane', lane.points, Math.round(lane.width * 2) / 2)),
    feature('route', road.route, 3),
    ...road.areas.map(area => feature(area.kind, area.points)),
    ...road.lines.map(line => feature(MARKINGS[line.kind], line.points)),
    ...road.edges.map(points => feature('edge', points)),
    ...road.stop_signs.map(at => feature('stopSign', at)),
  ];
}

const angle = (from, to) => Math.atan2(Math.sin(to - from), Math.cos(to - from));

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext('2d');
    this.northUp = false;
    /** Metres from the left of the view to its right, or from top to bottom if that is less. */
    this.metres = 90;
    this.at = { x: 0, y: 0, turn: 0 };
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    this.ratio = ratio;
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    this.dirty = true;
  }

  zoom(factor) {
    this.metres = Math.max(25, Math.min(600, this.metres * factor));
    this.dirty = true;
  }

  /** Lays a road out. */
  lay(road) {
    this.road = layRoad(features(road));
    this.lights = road.lights;
    this.at = { x: 0, y: 0, turn: null };
    this.dirty = true;
  }

  /** The picture between two moments, `t` of the way from the first to the second. */
  draw({ before, now, t = 1, fans, trail, futures, watched, watchedAt }) {
    const { pen, canvas } = this;
    const c = colours();
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.fillStyle = c.ground;
    pen.fillRect(0, 0, canvas.width, canvas.height);
    if (!now || !this.road) return;
    this.follow(before, now, t);
    const scale = Math.min(canvas.width, canvas.height * 1.15) / this.metres;
    this.scale = scale;
    // The ego drives up the lower part of the view.
    const centre = [canvas.width / 2, canvas.height * (this.northUp ? 0.5 : 0.66)];
    aim(pen, { ...this.at, angle: this.northUp ? 0 : this.at.turn - Math.PI / 2 }, scale, ...centre);
    const far = Math.hypot(canvas.width, canvas.height) / scale;
    drawRoad(pen, this.road, c, this.px, this.metres < 200 ? (x, y) => Math.hypot(x - this.at.x, y - this.at.y) < far : null);
    this.signals(c, now);
    if (trail?.length > 2) {
      pen.strokeStyle = c.ego;
      pen.globalAlpha = 0.45;
      pen.lineWidth = 0.5;
      pen.stroke(line(trail));
      pen.globalAlpha = 1;
    }
    for (const ways of fans) if (ways) this.fans(c, ways);
    if (futures) this.futures(c, futures, watched);
    if (futures && watched !== null && watched !== undefined) this.ghosts(c, futures[watched], watchedAt, watched);
    else this.everyone(c, before, now, t);
  }

  follow(before, now, t) {
    const row = now[2];
    if (row < 0) return;
    const i = HEAD + AGENT * row;
    let [x, y, heading] = [now[i], now[i + 1], now[i + 2]];
    if (before && t < 1 && before[2] >= 0) {
      const j = HEAD + AGENT * before[2];
      x = before[j] + (x - before[j]) * t;
      y = before[j + 1] + (y - before[j + 1]) * t;
      heading = before[j + 2] + angle(before[j + 2], heading) * t;
    }
    // The view turns a little later than the car, or every touch of the wheel would swing the road.
    const turn = this.at.turn === null ? heading : this.at.turn + angle(this.at.turn, heading) * 0.12;
    this.at = { x, y, turn };
  }

  /** A length in metres that is shown with so many pixels at least. */
  get px() {
    return (metres, least) => Math.max(metres, least * this.ratio / this.scale);
  }

  signals(c, now) {
    const first = HEAD + AGENT * now[3];
    for (let i = 0; i < now[4]; i += 1) {
      const at = this.lights[i];
      if (!at) continue;
      const [x, y, heading, width] = at;
      drawLight(this.pen, { x, y, heading, width }, c[LIGHTS[now[first + i]]], c, this.px);
    }
  }

  fans(c, fans) {
    const { pen } = this;
    pen.globalAlpha = 0.28;
    pen.lineCap = 'round';
    for (let i = 0; i < fans.length; i += WAY) {
      const [x0, y0, x1, y1] = fans.subarray(i + 1, i + 5);
      // Who stands has nothing to show.
      if (Math.hypot(x1 - x0, y1 - y0) < 0.15) continue;
      pen.strokeStyle = c[KINDS[fans[i]]];
      pen.lineWidth = fans[i] === 0 ? 0.5 : 0.3;
      pen.beginPath();
      pen.moveTo(x0, y0);
      for (let k = i + 3; k < i + WAY; k += 2) pen.lineTo(fans[k], fans[k + 1]);
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  everyone(c, before, now, t) {
    const known = new Map();
    if (before && t < 1) {
      for (let k = 0; k < before[3]; k += 1) {
        const j = HEAD + AGENT * k;
        known.set(before[j + 7], j);
      }
    }
    for (let k = 0; k < now[3]; k += 1) {
      const i = HEAD + AGENT * k;
      let [x, y, heading] = [now[i], now[i + 1], now[i + 2]];
      const j = known.get(now[i + 7]);
      if (j !== undefined) {
        x = before[j] + (x - before[j]) * t;
        y = before[j + 1] + (y - before[j + 1]) * t;
        heading = before[j + 2] + angle(before[j + 2], heading) * t;
      }
      const isEgo = k === now[2];
      this.box(c, x, y, heading, now[i + 3], now[i + 4], now[i + 5], isEgo ? c.ego : c[KINDS[now[i + 5]]]);
    }
  }

  box(c, x, y, heading, length, width, kind, colour) {
    drawAgent(this.pen, { kind: KINDS[kind], length, width }, { x, y, heading }, colour, c, this.px);
  }

  /** The ways of everyone in eight futures: the ego's in the future's colour, others' thin. */
  futures(c, futures, watched) {
    const { pen } = this;
    const chosen = watched !== null && watched !== undefined;
    pen.lineCap = 'round';
    futures.forEach((ways, k) => {
      const [agents, moments] = ways;
      const size = 3 + 3 * moments;
      for (let a = agents - 1; a >= 0; a -= 1) {
        if (chosen && k !== watched && a > 0) continue;
        const first = 2 + a * size;
        pen.strokeStyle = a === 0 ? FUTURES[k] : c[KINDS[ways[first]]];
        pen.globalAlpha = a === 0 ? (chosen && k !== watched ? 0.35 : 0.9) : chosen ? 0.5 : 0.16;
        pen.lineWidth = a === 0 ? 0.7 : 0.25;
        pen.beginPath();
        for (let m = 0; m < moments; m += 1) pen.lineTo(ways[first + 3 + 3 * m], ways[first + 4 + 3 * m]);
        pen.stroke();
      }
    });
    pen.globalAlpha = 1;
  }

  /** Everyone in one of the futures, so many half seconds into it. */
  ghosts(c, ways, at, k) {
    const [agents, moments] = ways;
    const size = 3 + 3 * moments;
    const m = Math.min(Math.floor(at), moments - 2);
    const t = Math.min(1, at - m);
    for (let a = 0; a < agents; a += 1) {
      const first = 2 + a * size;
      const i = first + 3 + 3 * m;
      const x = ways[i] + (ways[i + 3] - ways[i]) * t;
      const y = ways[i + 1] + (ways[i + 4] - ways[i + 1]) * t;
      const heading = ways[i + 2] + angle(ways[i + 2], ways[i + 5]) * t;
      this.box(c, x, y, heading, ways[first + 1], ways[first + 2], ways[first], a === 0 ? FUTURES[k] : c[KINDS[ways[first]]]);
    }
  }
}
