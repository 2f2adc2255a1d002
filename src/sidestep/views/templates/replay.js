// Replays the episodes in the page. `Scene` is the live page's.

const box = document.getElementById("replay");
const one = (selector) => box.querySelector(selector);
const stage = one(".stage");
const NAMES = [
  "evader", "evaderLight", "evaderFaint", "evaderText", "pursuer", "pursuerLight", "pursuerFaint", "obstacle",
  "obstacleFaint", "obstacleHatch", "target", "targetFaint", "correction", "plan", "wish", "level", "grid",
  "gridStrong", "arena", "ink", "soft", "paper", "metal", "tyre", "tread", "shadow", "rowsDisc",
];
const REST = 1.2; // s that the end is held before it begins again
const TRAIL = 14; // s
const NEAR = 2.5; // m

function unpacked([low, step, text]) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Float64Array.from({ length: bytes.length / 2 }, (_, i) => low + step * view.getUint16(2 * i, true));
}

class Replay {
  constructor(told) {
    Object.assign(this, told);
    this.series = Object.fromEntries(Object.entries(told.series).map(([name, packed]) => [name, unpacked(packed)]));
    this.length = this.series.x.length - 1; // control periods
    this.seconds = this.length * this.period;
  }

  // A series of states at `time` (s), in between by a straight line.
  state(name, time) {
    const values = this.series[name];
    const at = Math.min(Math.max(time / this.period, 0), this.length);
    const index = Math.min(Math.floor(at), this.length - 1);
    return values[index] + (at - index) * (values[index + 1] - values[index]);
  }

  // A series of what was done, held for a control period.
  held(name, time) {
    const index = Math.floor(time / this.period + 1e-6);
    return this.series[name][Math.min(Math.max(index, 0), this.length - 1)];
  }

  places(time) {
    const numbers = (count) => Array.from({ length: count }, (_, i) => i);
    return {
      evader: [this.state("x", time), this.state("y", time)],
      pursuers: numbers(this.pursuers).map((i) => ["x", "y", "h"].map((axis) => this.state(`p${i}${axis}`, time))),
      obstacles: this.obstacles.map((speed, i) => [this.state(`o${i}x`, time), this.state(`o${i}y`, time), ...speed]),
      target: this.target,
    };
  }

  frame(time, pace) {
    const wheel = (i, side) => this.held(`w${i}${side}`, time);
    return {
      time,
      pace,
      nominal: [this.held("nx", time), this.held("ny", time)],
      action: [this.held("ax", time), this.held("ay", time)],
      intervention: this.held("correction", time),
      status: this.held("lost", time) > 0.5 ? "infeasible" : "ok",
      wheels: Array.from({ length: this.pursuers }, (_, i) => [wheel(i, "l"), wheel(i, "r")]),
    };
  }

  // The paths up to `time`, as the scene's trails.
  trails(time) {
    const end = Math.min(Math.floor(time / this.period + 1e-6), this.length);
    const begin = Math.max(0, end - Math.round(TRAIL / this.period));
    const speed = this.numbers.evader_speed;
    const evader = [];
    const pursuers = Array.from({ length: this.pursuers }, () => []);
    for (let i = begin; i <= end; i++) {
      const share = Math.min(this.series.correction[Math.min(i, this.length - 1)] / speed, 1);
      evader.push([this.series.x[i], this.series.y[i], i * this.period, share]);
      pursuers.forEach((trail, k) => trail.push([this.series[`p${k}x`][i], this.series[`p${k}y`][i], i * this.period]));
    }
    return { evader, pursuers };
  }
}

// Keeps what matters in view: a target or an obstacle far away would make everybody tiny.
class NearCamera extends Camera {
  follow(bodies, free, seconds) {
    const [x, y] = bodies[0];
    super.follow(bodies.filter((body) => Math.hypot(body[0] - x, body[1] - y) < NEAR), free, seconds);
  }
}

// How near the evader is to capture and collision over the whole episode, the corrections under it.
class Strip {
  constructor(canvas) {
    this.canvas = canvas;
  }

  x(replay, time) {
    return 8 + (time / replay.seconds) * (this.canvas.clientWidth - 16);
  }

  time(replay, x) {
    return Math.min(Math.max((x - 8) / (this.canvas.clientWidth - 16), 0), 1) * replay.seconds;
  }

  draw(replay, time, colours) {
    const { canvas } = this;
    const ratio = Math.min(devicePixelRatio || 1, 2.5);
    const { clientWidth: width, clientHeight: height } = canvas;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const [top, floor, bars] = [20, height - 28, height - 8];
    const most = 0.5;
    // Millimetres and metres in one strip.
    const y = (h) => floor - Math.sqrt(Math.min(Math.max(h, 0), most) / most) * (floor - top);
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "right";
    pen.fillStyle = colours.soft;
    for (const [level, words] of [[0, ""], [0.01, "1 cm"], [0.1, "10 cm"], [0.5, "50 cm"]]) {
      pen.strokeStyle = level ? colours.gridStrong : colours.pursuer;
      pen.setLineDash(level ? [] : [4, 3]);
      pen.beginPath();
      pen.moveTo(8, y(level));
      pen.lineTo(width - 8, y(level));
      pen.stroke();
      pen.fillText(words, width - 8, y(level) - 2);
    }
    pen.setLineDash([]);
    const lines = [["collision", colours.obstacle, [5, 3]], ["capture", colours.evader, []]];
    for (const [name, colour, dash] of lines) {
      const values = replay.series[name];
      if (!values) continue;
      pen.strokeStyle = colour;
      pen.lineWidth = 1.8;
      pen.setLineDash(dash);
      pen.beginPath();
      values.forEach((value, i) => pen.lineTo(this.x(replay, (i + 1) * replay.period), y(value)));
      pen.stroke();
    }
    pen.setLineDash([]);
    const step = Math.max(((width - 16) / replay.length) * 1.05, 1);
    replay.series.correction.forEach((value, i) => {
      const share = Math.min(value / (2 * replay.numbers.evader_speed), 1);
      if (share <= 0.002) return;
      const tall = 3 + 12 * Math.sqrt(share);
      pen.fillStyle = replay.series.lost[i] > 0.5 ? colours.pursuer : colours.correction;
      pen.fillRect(this.x(replay, i * replay.period), bars - tall, step, tall);
    });
    pen.textAlign = "left";
    let left = 8;
    for (const [name, colour] of [["capture", colours.evaderText], ["collision", colours.obstacle]]) {
      if (!replay.series[name]) continue;
      const words = `${name === "capture" ? "—" : "- -"} to ${name}`;
      pen.fillStyle = colour;
      pen.fillText(words, left, 12);
      left += pen.measureText(words).width + 16;
    }
    pen.fillStyle = colours.soft;
    pen.fillText("√ scale", left, 12);
    pen.strokeStyle = colours.ink;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(this.x(replay, time), 16);
    pen.lineTo(this.x(replay, time), height - 4);
    pen.stroke();
  }
}

class Player {
  constructor(replays) {
    this.replays = replays;
    this.scene = new Scene(one(".scene"));
    this.scene.camera = new NearCamera();
    this.strip = new Strip(one(".strip"));
    this.pace = 1;
    this.playing = false;
    this.scrub = one(".scrub");
    this.build();
    this.readColours();
    this.choose(0);
  }

  build() {
    const chooser = one(".episode select");
    const groups = new Map();
    this.replays.forEach((replay, index) => {
      if (!groups.has(replay.group)) {
        const group = document.createElement("optgroup");
        group.label = replay.group;
        chooser.append(group);
        groups.set(replay.group, group);
      }
      groups.get(replay.group).append(new Option(`${replay.group}, episode ${replay.number}: ${replay.words}`, index));
    });
    chooser.value = "0"; // a page that is loaded again keeps what was chosen
    chooser.addEventListener("change", () => this.choose(Number(chooser.value)));
    one(".play").addEventListener("click", () => this.setPlaying(!this.playing));
    one(".back").addEventListener("click", () => this.step(-1));
    one(".on").addEventListener("click", () => this.step(1));
    const pace = one(".pace select");
    pace.value = "1";
    pace.addEventListener("change", () => (this.pace = Number(pace.value)));
    this.scrub.addEventListener("input", () => {
      this.setPlaying(false);
      this.seek(Number(this.scrub.value) * this.replay.period);
    });
    const strip = one(".strip");
    const point = (event) => {
      this.setPlaying(false);
      this.seek(this.strip.time(this.replay, event.clientX - strip.getBoundingClientRect().left));
    };
    strip.addEventListener("pointerdown", (event) => {
      strip.setPointerCapture(event.pointerId);
      point(event);
    });
    strip.addEventListener("pointermove", (event) => event.buttons && point(event));
    stage.addEventListener("keydown", (event) => {
      const typed = event.target.closest("input, select, button");
      if (event.key === " " && typed?.tagName !== "BUTTON" && typed?.tagName !== "SELECT") {
        event.preventDefault();
        this.setPlaying(!this.playing);
      }
    });
    const redraw = () => {
      this.readColours();
      this.draw(performance.now());
    };
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
    new ResizeObserver(redraw).observe(stage);
  }

  readColours() {
    const style = getComputedStyle(stage);
    this.colours = Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  }

  choose(index) {
    this.setPlaying(false);
    this.replay = this.replays[index];
    this.scrub.max = this.replay.length;
    this.scene.facing = undefined;
    this.scene.treads = [];
    this.seek(Math.max(this.replay.moment - 4, 0));
  }

  setPlaying(playing) {
    if (playing === this.playing) return;
    this.playing = playing;
    one(".play").textContent = playing ? "Pause" : "Play";
    one(".play").setAttribute("aria-label", playing ? "Pause" : "Play");
    if (!playing) return;
    if (this.time >= this.replay.seconds) this.seek(0);
    this.rest = 0;
    this.before = performance.now();
    requestAnimationFrame((now) => this.tick(now));
  }

  tick(now) {
    if (!this.playing) return;
    const seconds = Math.min((now - this.before) / 1000, 0.1);
    this.before = now;
    this.time = Math.min(this.time + seconds * this.pace, this.replay.seconds);
    if (this.time >= this.replay.seconds) {
      this.rest += seconds;
      if (this.rest > REST) {
        this.setPlaying(false);
        return this.draw(now);
      }
    }
    this.draw(now);
    requestAnimationFrame((next) => this.tick(next));
  }

  step(periods) {
    this.setPlaying(false);
    const at = Math.round(this.time / this.replay.period) + periods;
    this.seek(Math.min(Math.max(at, 0), this.replay.length) * this.replay.period);
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.replay.seconds);
    this.scene.camera.scale = 0; // jump, do not glide
    this.draw(performance.now());
  }

  draw(now) {
    const { replay, scene, colours, time } = this;
    const canvas = scene.canvas;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !replay) return;
    const places = replay.places(time);
    const frame = replay.frame(time, this.playing ? this.pace : 0);
    const ended = time >= replay.seconds && replay.whole <= replay.start + replay.seconds + 1e-6;
    Object.assign(scene.trails, replay.trails(time));
    scene.still = true;
    scene.draw({
      places, frame, colours, numbers: replay.numbers, arena: replay.arena, reach: replay.reach,
      counts: [replay.pursuers, replay.obstacles.length],
      free: { left: 0, top: 0, width, height: height - 24 },
      show: { trails: true, capture: true, velocities: !ended },
      ruler: [14, height - 12],
    }, now);
    this.strip.draw(replay, time, colours);
    this.scrub.value = Math.round(time / replay.period);
    this.tell(replay, time, ended);
    box.dataset.time = time.toFixed(3);
  }

  tell(replay, time, ended) {
    const far = (name) => {
      if (!replay.series[name]) return [];
      const value = replay.held(name, time - replay.period);
      const size = Math.abs(value) < 0.05 ? `${(1000 * value).toFixed(1)} mm` : `${value.toFixed(2)} m`;
      return [`${size.replace("-", "−")} to ${name}`];
    };
    const words = [`${(replay.start + time).toFixed(2)} s`, ...far("capture"), ...far("collision")];
    if (ended) words.push(replay.outcome.replace("_", " "));
    one(".told").textContent = words.join(" · ");
    this.scrub.setAttribute("aria-valuetext", words.join(", "));
  }
}

const told = JSON.parse(document.getElementById("replay-data").textContent);
new Player(told.map((episode) => new Replay(episode)));
