// Where is everything between two frames? A frame says what every robot holds for one control period, so
// motion is known exactly; what a late frame or the visitor's own keys put off is made good smoothly.

const SMOOTH = 0.09; // s in which a jump fades
const LONGEST = 3; // periods that motion is continued without news

export function driven(pose, wheels, halfAxle, time) {
  const speed = (wheels[0] + wheels[1]) / 2;
  const turn = ((wheels[1] - wheels[0]) / (2 * halfAxle)) * time;
  const half = turn / 2;
  const chord = speed * time * (Math.abs(half) > 1e-6 ? Math.sin(half) / half : 1);
  return [pose[0] + chord * Math.cos(pose[2] + half), pose[1] + chord * Math.sin(pose[2] + half), pose[2] + turn];
}

function wrapped(angle) {
  return angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
}

export class Motion {
  constructor(period) {
    this.period = period;
    this.frame = null;
    this.drawn = null;
    this.offsets = new Map();
    this.own = null; // wheel shares that the visitor asks for right now, when pursuer 0 is theirs
  }

  // Take a frame that arrived at `now` (ms).
  take(frame, now) {
    const before = this.frame ? this.at(now) : null;
    this.frame = frame;
    this.since = now;
    this.integrated = frame.pursuers.map((pose) => pose.slice());
    this.last = now;
    this.offsets.clear();
    if (!before || frame.cut) return;
    const put = (name, was, is) => {
      const gap = was.map((value, i) => (i === 2 ? wrapped(value - is[i]) : value - is[i]));
      if (Math.hypot(gap[0], gap[1]) < 0.3) this.offsets.set(name, gap);
    };
    put("evader", before.evader, frame.evader);
    frame.pursuers.forEach((pose, i) => before.pursuers[i] && put(`p${i}`, before.pursuers[i], pose));
    frame.obstacles.forEach((one, i) => before.obstacles[i] && put(`o${i}`, before.obstacles[i].slice(0, 2), one));
  }

  // Positions at `now` (ms), as they are to be drawn.
  at(now, halfAxle = this.halfAxle, rim = this.rim) {
    const frame = this.frame;
    this.halfAxle = halfAxle;
    this.rim = rim;
    const pace = frame.pace || 0;
    const most = LONGEST * this.period;
    const time = Math.min(((now - this.since) / 1000) * pace, most);
    const moved = Math.min(((this.last - this.since) / 1000) * pace, most);
    const fade = Math.exp(-(now - this.since) / 1000 / SMOOTH);
    const off = (name, place) => {
      const gap = this.offsets.get(name);
      return gap ? place.map((value, i) => (gap[i] === undefined ? value : value + gap[i] * fade)) : place;
    };
    const action = frame.action || [0, 0];
    const evader = [frame.evader[0] + action[0] * time, frame.evader[1] + action[1] * time];
    const pursuers = frame.pursuers.map((pose, i) => {
      if (pace === 0 || !frame.wheels) return off(`p${i}`, pose);
      if (i === 0 && this.own) {
        // One's own robot answers at once: the wheels asked for, from the last moment drawn on.
        const wheels = this.own.map((share) => share * rim);
        this.integrated[0] = driven(this.integrated[0], wheels, halfAxle, Math.max(time - moved, 0));
        return off("p0", this.integrated[0]);
      }
      return off(`p${i}`, driven(pose, frame.wheels[i], halfAxle, time));
    });
    this.last = now;
    const obstacles = frame.obstacles.map((one, i) =>
      off(`o${i}`, [one[0] + one[2] * time, one[1] + one[3] * time]).concat(one.slice(2)));
    return { evader: off("evader", evader), pursuers, obstacles, target: frame.target };
  }
}
