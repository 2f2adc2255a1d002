// The visitor's world, period by period, and what the page is told of it: as `views/play/session.py` does for the
// live page. What happens in a period is the engine's; here is only who asked for what, and the score.

const PLACE = ["evader", "pursuers", "obstacles", "target", "time", "evader_velocity", "wheel_speeds"];
const BY_STRATEGY = 0;
const BY_WHEELS = 1;
const BY_POINT = 2;
const YOU = "you";
const TRIES = 10000; // draws of a start

const rounded = (value) => (Array.isArray(value) ? value.map(rounded)
  : Number.isFinite(value) ? Math.round(value * 1e5) / 1e5 : 0);
const random = (low, high) => low + (high - low) * Math.random();

export class Session {
  constructor(about, engine) {
    this.about = about;
    this.engine = engine;
    this.period = about.hello.period;
    this.shield = about.shield;
    this.pursuer = about.pursuer;
    this.paused = false;
    this.pace = 1;
    this.show = { rows: false, plan: false };
    this.tallies = {};
    this.frames = 0;
    this.driven = {};
    this.look(about.hello.defaults);
    this.restart();
  }

  // What the visitor asks for.

  // Apply a message of the page. Returns what cannot be done now, or nothing.
  apply(message) {
    switch (message.type) {
      case "drive":
        this.driven = message;
        if ((message.wheels || message.toward) && this.pursuer !== YOU) this.pick({ pursuer: YOU });
        break;
      case "pause": this.paused = message.paused; break;
      case "step": if (this.ready && this.paused && !this.outcome) this.step(); break;
      case "pace": this.pace = message.pace; break;
      case "reset": this.restart(message.again); break;
      case "pick": this.pick(message); break;
      case "set": this.slide(message); break;
      case "show": this.show = message; break;
      case "move":
        if (!this.paused) return "pause first, then drag";
        this.move(message);
        break;
      case "restore":
        this.slide({ values: message.values, defaults: true });
        this.pick(message);
        if (message.scene) this.begin({ ...this.standing(), ...message.scene, evader: message.scene.evader[0], target: message.scene.target[0] });
        break;
    }
    return null;
  }

  get table() {
    return this.engine.get("serve").indexOf(1);
  }

  // The name of a shield's functions.
  get program() {
    return this.shield === "joint" ? `joint ${this.table}` : this.shield;
  }

  get ready() {
    return this.engine.has(`step ${this.program}`);
  }

  get moving() {
    return this.ready && !this.paused && !this.outcome;
  }

  pick({ shield, pursuer }) {
    if (shield && shield !== this.shield) {
      this.shield = shield;
      this.survived = 0;
      this.cut = true;
      this.fresh = true;
    }
    if (pursuer && pursuer !== this.pursuer) {
      this.pursuer = pursuer;
      this.survived = 0;
    }
  }

  // Take these numbers, and see what they mean.
  look(numbers) {
    this.numbers = numbers;
    this.engine.set("numbers", this.about.numbers.map((name) => numbers[name]));
    this.engine.run("look");
  }

  slide({ values = {}, defaults = false }) {
    const before = this.numbers;
    const numbers = { ...(defaults ? this.about.hello.defaults : before), ...values };
    if (Object.keys(numbers).every((name) => numbers[name] === before[name])) return;
    this.look(numbers);
    if (numbers.obstacle_speed !== before.obstacle_speed) this.engine.set("obstacles", this.engine.get("drifting"));
    if (this.engine.get("touching")) {
      this.restart();
      return;
    }
    this.survived = 0;
    this.cut = true;
    this.fresh = true;
  }

  move({ what, index = 0, to, heading }) {
    const parts = { ...this.place(), time: 0 };
    if (what === "evader" || what === "target") {
      parts[what] = to;
    } else {
      const robot = parts[`${what}s`][index];
      robot[0] = to[0];
      robot[1] = to[1];
      if (what === "pursuer" && heading !== undefined) robot[2] = Math.atan2(Math.sin(heading), Math.cos(heading));
    }
    this.begin(parts);
  }

  // The world.

  place() {
    return Object.fromEntries(PLACE.map((name) => [name, this.engine.get(name)]));
  }

  // What a link does not say: everything stands still.
  standing() {
    return { time: 0, evader_velocity: [0, 0], wheel_speeds: Array(this.about.hello.counts[0]).fill([0, 0]) };
  }

  // A new start, or `again` the last one.
  restart(again = false) {
    if (again) {
      this.begin(this.start);
      return;
    }
    for (let k = 0; k < TRIES; k++) {
      this.engine.set("words", random(-(2 ** 31), 2 ** 31), random(-(2 ** 31), 2 ** 31));
      this.engine.run("draw");
      if (this.engine.get("accepted")) break;
    }
    this.begin(this.place());
  }

  begin(parts) {
    this.start = structuredClone(parts);
    for (const name of PLACE) this.engine.set(name, parts[name]);
    this.engine.set("held", [0, 0]);
    this.count = 0;
    this.waited = 0;
    this.survived = 0;
    this.outcome = null;
    this.known = false;
    this.cut = true;
    this.fresh = true;
  }

  // One control period.
  step() {
    const { engine, about, program } = this;
    const yours = this.pursuer === YOU;
    const { toward, wheels } = this.driven;
    engine.set("ask", this.count % about.decision_steps === 0);
    engine.set("strategy", about.strategies.indexOf(yours ? "nash" : this.pursuer));
    engine.set("mode", yours ? (toward ? BY_POINT : BY_WHEELS) : BY_STRATEGY);
    engine.set("command", toward ?? wheels ?? [0, 0]);
    engine.set("count", this.count % 2 ** 20);
    this.waited += this.period;
    engine.set("renew", this.waited > about.patience);
    const draws = engine.areas.draws;
    for (let k = 0; k < draws.length; k++) draws[k] = random(-1, 1);
    if (this.fresh) engine.run(`begin ${program}`);
    this.fresh = false;
    engine.run("ask");
    engine.run(`step ${program}`);
    this.known = true;
    this.count += 1;
    this.survived += this.period;
    this.judge();
  }

  judge() {
    const { engine } = this;
    const tally = (this.tallies[this.shield] ??= { captured: 0, collided: 0, reached: 0, longest: 0 });
    tally.longest = Math.max(tally.longest, this.survived);
    const happened = ["captured", "collided", "reached"].find((name) => engine.get(name) > 0);
    if (happened) tally[happened] += 1;
    if (happened === "captured" || happened === "collided") this.outcome = happened;
    if (happened === "reached" || this.waited > this.about.patience) this.waited = 0;
  }

  // What the page is told.

  // Advance by one period, if the world moves: the frame of its beginning, with the commands held in it.
  advance() {
    if (!this.moving) return this.frame();
    const begun = this.place();
    this.step();
    return this.frame(begun, this.pace);
  }

  frame(parts = this.place(), pace = 0) {
    const { engine } = this;
    this.frames += 1;
    const round = (value) => Math.round(value * 100) / 100;
    const tallies = Object.fromEntries(Object.entries(this.tallies).map(([name, tally]) =>
      [name, { ...tally, longest: round(tally.longest) }]));
    const frame = {
      type: "frame", frame: this.frames, pace, cut: this.cut, time: parts.time, over: this.outcome,
      score: { survived: round(this.survived), tallies },
    };
    for (const name of ["evader", "pursuers", "obstacles", "target"]) frame[name] = rounded(parts[name]);
    this.cut = false;
    if (!this.known) return frame;
    for (const name of ["action", "wheels", "h", "barriers", "intervention"]) frame[name] = rounded(engine.get(name));
    frame.nominal = rounded(engine.get("held"));
    frame.status = this.about.statuses[engine.get("status")];
    frame.reached = engine.get("reached") > 0;
    frame.looking = engine.get("looking") > 0;
    if (this.show.rows) {
      const offsets = engine.get("offsets");
      frame.rows = engine.get("normals").map((normal, i) => rounded([...normal, offsets[i]]));
    }
    if (this.show.plan) frame.plan = [];
    return frame;
  }

  get verdict() {
    const { defaults } = this.about.hello;
    if (Object.keys(defaults).every((name) => this.numbers[name] === defaults[name])) return this.about.verdict;
    const largest = this.engine.get("largest");
    const margin = largest - this.numbers.capture_distance;
    const finite = Number.isFinite(largest);
    return {
      kind: margin < 0 ? "caught" : "unsure", largest: finite ? rounded(largest) : null, margin: finite ? rounded(margin) : null,
    };
  }

  setup() {
    const { table, about } = this;
    const joint = table < 0 ? "missing" : "ready";
    return {
      type: "setup", shield: this.shield, pursuer: this.pursuer, paused: this.paused, pace: this.pace, numbers: this.numbers,
      verdict: this.verdict, states: { none: "ready", paper: "ready", game: "ready", joint }, ready: this.ready,
      show: { rows: this.show.rows, plan: this.show.plan },
      words: this.shield === "joint" ? about.tables[table]?.words ?? about.no_table : undefined,
    };
  }
}
