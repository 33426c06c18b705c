// Draws the road and everyone on it. Metres become pixels by the canvas's own transformation; the
// road is laid out once as paths.

const HEAD = 5;
const AGENT = 8;
const WAY = 9;

const LIGHT = {
  ground: '#f6f5f2', road: '#dfe1e4', route: '#f3e0ba', crosswalk: '#fafaf8', white: '#ffffff',
  yellow: '#e3c155', edge: '#9ca3ad', lane: '#cdd1d7', text: '#3a3f47', ego: '#e69f00',
  kinds: ['#0072b2', '#cc79a7', '#009e73', '#8b9099'], outline: '#232830', wedge: '#ffffff',
  lights: ['#8b9099', '#d62f1f', '#e8b400', '#009e73'],
};
const DARK = {
  ground: '#111317', road: '#24282f', route: '#453922', crosswalk: '#565d68', white: '#78808b',
  yellow: '#97833d', edge: '#5b636f', lane: '#353b45', text: '#c5cbd3', ego: '#e69f00',
  kinds: ['#56b4e9', '#cc79a7', '#2fbf96', '#7c828c'], outline: '#0b0d10', wedge: '#0b0d10',
  lights: ['#7c828c', '#ff5d45', '#f0e442', '#1fc795'],
};
/** Eight colours that stay apart on both grounds. */
export const FUTURES = ['#e69f00', '#0072b2', '#009e73', '#cc79a7', '#d55e00', '#7b5fc0', '#56b4e9', '#8a8d2a'];

const dark = matchMedia('(prefers-color-scheme: dark)');
const colours = () => (dark.matches ? DARK : LIGHT);

function line(points, path = new Path2D()) {
  for (let i = 0; i < points.length; i += 2) {
    if (i) path.lineTo(points[i], points[i + 1]);
    else path.moveTo(points[i], points[i + 1]);
  }
  return path;
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
    const all = (shapes, of) => {
      const path = new Path2D();
      for (const shape of shapes) line(of(shape), path);
      return path;
    };
    const closed = (shapes, of) => {
      const path = new Path2D();
      for (const shape of shapes) {
        line(of(shape), path);
        path.closePath();
      }
      return path;
    };
    const lanes = new Map();
    for (const lane of road.lanes) {
      const width = Math.round(lane.width * 2) / 2;
      if (!lanes.has(width)) lanes.set(width, new Path2D());
      line(lane.points, lanes.get(width));
    }
    const lines = kind => all(road.lines.filter(shape => shape.kind === kind), shape => shape.points);
    const kinds = new Set(road.lines.map(shape => shape.kind));
    this.road = {
      lanes,
      drivable: closed(road.drivable, points => points),
      centres: all(road.lanes, lane => lane.points),
      crosswalks: closed(road.areas.filter(area => area.kind === 'crosswalk'), area => area.points),
      bumps: closed(road.areas.filter(area => area.kind === 'bump'), area => area.points),
      edges: all(road.edges, points => points),
      lines: [...kinds].map(kind => [kind, lines(kind)]),
      route: line(road.route),
      stopSigns: road.stop_signs,
      lights: road.lights,
    };
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
    const turn = this.northUp ? 0 : Math.PI / 2 - this.at.turn;
    const [cos, sin] = [Math.cos(turn) * scale, Math.sin(turn) * scale];
    pen.setTransform(cos, -sin, -sin, -cos, centre[0] - cos * this.at.x + sin * this.at.y, centre[1] + sin * this.at.x + cos * this.at.y);
    this.ground(c);
    this.signs(c, now);
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

  ground(c) {
    const { pen, road } = this;
    pen.lineCap = 'round';
    pen.lineJoin = 'round';
    pen.fillStyle = c.road;
    pen.fill(road.drivable);
    pen.strokeStyle = c.road;
    for (const [width, path] of road.lanes) {
      pen.lineWidth = width;
      pen.stroke(path);
    }
    pen.strokeStyle = c.route;
    pen.lineWidth = 1.6;
    pen.stroke(road.route);
    pen.fillStyle = c.crosswalk;
    pen.globalAlpha = 0.7;
    pen.fill(road.crosswalks);
    pen.fillStyle = c.yellow;
    pen.globalAlpha = 0.3;
    pen.fill(road.bumps);
    pen.globalAlpha = 1;
    pen.strokeStyle = c.lane;
    pen.lineWidth = 0.12;
    pen.stroke(road.centres);
    pen.lineCap = 'butt';
    for (const [kind, path] of road.lines) {
      pen.strokeStyle = kind.includes('yellow') ? c.yellow : c.white;
      pen.setLineDash(kind.startsWith('broken') ? [3, 4] : []);
      pen.lineWidth = 0.2;
      pen.stroke(path);
    }
    pen.setLineDash([]);
    pen.strokeStyle = c.edge;
    pen.lineWidth = 0.35;
    pen.stroke(road.edges);
  }

  signs(c, now) {
    const { pen, road } = this;
    const first = HEAD + AGENT * now[3];
    for (let i = 0; i < now[4]; i += 1) {
      const at = road.lights[i];
      if (!at) continue;
      const [x, y, heading, width] = at;
      const half = Math.max(width, 2) / 2 - 0.2;
      const [across, along] = [-Math.sin(heading) * half, Math.cos(heading) * half];
      pen.strokeStyle = c.lights[now[first + i]];
      pen.lineWidth = 0.8;
      pen.beginPath();
      pen.moveTo(x - across, y - along);
      pen.lineTo(x + across, y + along);
      pen.stroke();
    }
    pen.fillStyle = c.lights[1];
    for (const [x, y] of road.stopSigns) {
      pen.beginPath();
      pen.arc(x, y, 0.7, 0, 2 * Math.PI);
      pen.fill();
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
      pen.strokeStyle = c.kinds[fans[i]];
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
      this.box(c, x, y, heading, now[i + 3], now[i + 4], now[i + 5], isEgo ? c.ego : c.kinds[now[i + 5]]);
    }
  }

  box(c, x, y, heading, length, width, kind, colour) {
    const { pen } = this;
    pen.save();
    pen.translate(x, y);
    pen.rotate(heading);
    pen.fillStyle = colour;
    pen.strokeStyle = c.outline;
    pen.lineWidth = Math.min(0.12, 1.5 / this.scale);
    pen.beginPath();
    if (kind === 1) pen.arc(0, 0, Math.max(length, width, 0.7) / 2, 0, 2 * Math.PI);
    else if (pen.roundRect) pen.roundRect(-length / 2, -width / 2, length, width, Math.min(length, width) * 0.22);
    else pen.rect(-length / 2, -width / 2, length, width);
    pen.fill();
    pen.stroke();
    if (kind === 0) {
      pen.fillStyle = c.wedge;
      pen.globalAlpha = 0.85;
      pen.beginPath();
      pen.moveTo(length * 0.38, 0);
      pen.lineTo(length * 0.14, width * 0.32);
      pen.lineTo(length * 0.14, -width * 0.32);
      pen.fill();
      pen.globalAlpha = 1;
    }
    pen.restore();
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
        pen.strokeStyle = a === 0 ? FUTURES[k] : c.kinds[ways[first]];
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
      this.box(c, x, y, heading, ways[first + 1], ways[first + 2], ways[first], a === 0 ? FUTURES[k] : c.kinds[ways[first]]);
    }
  }
}
