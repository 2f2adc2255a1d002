// Draws the world: floor, sets, robots, velocities, rows, trails. Metres are turned into pixels by a camera
// that keeps everything in view.

const SECONDS = 1.3; // an arrow is as long as the way in this time
const ROW_SECONDS = 2; // the same for the half-planes
const EVADER = 0.065; // m, radius of the drawn robot; its size does not enter the problem
const TRAIL = 14; // s

// Radius (m) of the capture set K and the speed ratio that its tips follow from. With custom robots it is that of
// the problem which covers theirs, as in all figures.
function captureSet({ capture_set, capture_distance, evader_speed, pursuer_speed }) {
  return capture_set ?? [capture_distance, Math.min(evader_speed / pursuer_speed, 1)];
}

export class Camera {
  constructor() {
    this.x = 0;
    this.y = 0;
    this.scale = 0;
    this.held = false;
  }

  // Follow the bodies (list of [x, y, room in m]) into the free part of the canvas (px).
  follow(bodies, free, seconds) {
    let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [x, y, room] of bodies) {
      left = Math.min(left, x - room);
      right = Math.max(right, x + room);
      low = Math.min(low, y - room);
      high = Math.max(high, y + room);
    }
    const scale = Math.min(free.width / Math.max(right - left, 1.7), free.height / Math.max(high - low, 1.7));
    const goal = { x: (left + right) / 2, y: (low + high) / 2, scale };
    this.cx = free.left + free.width / 2;
    this.cy = free.top + free.height / 2;
    if (!this.scale) Object.assign(this, goal);
    if (this.held) return;
    const share = 1 - Math.exp(-seconds / 0.9);
    for (const name of ["x", "y", "scale"]) this[name] += (goal[name] - this[name]) * share;
  }

  px(x, y) {
    return [this.cx + (x - this.x) * this.scale, this.cy - (y - this.y) * this.scale];
  }

  world(px, py) {
    return [(px - this.cx) / this.scale + this.x, this.y - (py - this.cy) / this.scale];
  }
}

export class Trails {
  constructor() {
    this.clear();
  }

  clear() {
    this.evader = [];
    this.pursuers = [];
  }

  take(frame, speed) {
    if (frame.cut) this.clear();
    if (frame.pace === 0) return;
    const share = Math.min((frame.intervention || 0) / speed, 1);
    this.evader.push([...frame.evader, frame.time, share]);
    frame.pursuers.forEach((pose, i) => {
      this.pursuers[i] ??= [];
      this.pursuers[i].push([pose[0], pose[1], frame.time]);
    });
    for (const trail of [this.evader, ...this.pursuers]) {
      while (trail.length && trail[0][2] < frame.time - TRAIL) trail.shift();
    }
  }
}

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.camera = new Camera();
    this.trails = new Trails();
    this.sparks = [];
    this.treads = [];
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2.5);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    return [width, height];
  }

  // A ring that spreads from a place (m): something happened there.
  spark(place, colour, now) {
    this.sparks.push({ place, colour, since: now });
  }

  draw(view, now) {
    const { pen, camera } = this;
    const [width, height] = this.resize();
    const { places, frame, numbers, colours, show } = view;
    const seconds = Math.min((now - (this.before ?? now)) / 1000, 0.1);
    this.before = now;
    const [radius, ratio] = captureSet(numbers);
    const tip = radius / ratio;
    const bodies = [[...places.evader, 0.45], [...places.target, 0.2]];
    for (const pose of places.pursuers) bodies.push([pose[0], pose[1], Math.max(0.3, 0.8 * tip)]);
    for (const one of places.obstacles) bodies.push([one[0], one[1], numbers.collision_distance + 0.05]);
    camera.follow(bodies, view.free, seconds);
    const scale = camera.scale;
    pen.clearRect(0, 0, width, height);
    this.floor(width, height, view.arena, view.free, colours);
    if (show.trails) this.drawTrails(places, frame, colours);
    for (const one of places.obstacles) this.obstacle(one, numbers.collision_distance, colours);
    this.target(places.target, view.reach, colours, now);
    for (const pose of places.pursuers) {
      const at = camera.px(pose[0], pose[1]);
      if (show.capture) this.sets(at, pose[2], numbers, places.evader, view.free, colours);
      else this.disc(at, numbers.capture_distance * scale, colours.pursuerFaint, colours.pursuer);
    }
    const evader = camera.px(...places.evader);
    if (show.rows && frame.rows) this.rows(evader, frame.rows, numbers, view.counts[0], colours);
    places.pursuers.forEach((pose, i) => {
      const at = camera.px(pose[0], pose[1]);
      const wheels = (i === 0 && view.own) || (frame.wheels?.[i] ?? [0, 0]).map((w) => w / numbers.pursuer_speed);
      const rolled = (this.treads[i] ??= [0, 0]);
      if (frame.pace) wheels.forEach((share, side) => (rolled[side] += share * numbers.pursuer_speed * seconds));
      this.pursuer(at, pose[2], numbers.pursuer_half_axle * scale, rolled, colours, i === 0 && view.yours);
    });
    if (show.plan && frame.plan?.length) this.plan(places.evader, frame.plan, colours);
    this.evader(evader, frame, numbers, colours, now);
    if (show.velocities && frame.action) this.velocities(evader, frame, colours);
    if (view.goal) this.goal(view.goal, places.pursuers[0], colours);
    if (view.chosen) this.chosen(view.chosen, places, numbers, colours, now);
    this.drawSparks(now);
    this.ruler(view, colours);
  }

  floor(width, height, arena, free, colours) {
    const { pen, camera } = this;
    const [x0, y1] = camera.world(0, 0);
    const [x1, y0] = camera.world(width, height);
    const step = camera.scale > 110 ? 0.25 : 0.5;
    pen.lineWidth = 1;
    for (let k = Math.ceil(x0 / step); k * step <= x1; k++) this.line(k * step, y0, k * step, y1, k * step, colours);
    for (let k = Math.ceil(y0 / step); k * step <= y1; k++) this.line(x0, k * step, x1, k * step, k * step, colours);
    const [left, top] = camera.px(-arena / 2, arena / 2);
    const side = arena * camera.scale;
    this.clip(free);
    pen.strokeStyle = colours.arena;
    pen.lineWidth = 1.5;
    pen.setLineDash([2, 7]);
    pen.lineCap = "round";
    pen.beginPath();
    pen.roundRect(left, top, side, side, 14);
    pen.stroke();
    pen.restore();
  }

  // Long lines run only where nothing is written; `pen.restore()` ends it.
  clip(free) {
    this.pen.save();
    this.pen.beginPath();
    this.pen.rect(free.left, free.top, free.width, free.height);
    this.pen.clip();
  }

  line(xa, ya, xb, yb, at, colours) {
    const { pen, camera } = this;
    pen.strokeStyle = Math.abs(at - Math.round(at)) < 1e-6 ? colours.gridStrong : colours.grid;
    const [ax, ay] = camera.px(xa, ya);
    const [bx, by] = camera.px(xb, yb);
    pen.beginPath();
    pen.moveTo(Math.round(ax) + 0.5, Math.round(ay) + 0.5);
    pen.lineTo(Math.round(bx) + 0.5, Math.round(by) + 0.5);
    pen.stroke();
  }

  disc([x, y], radius, fill, stroke, dash = []) {
    const { pen } = this;
    pen.beginPath();
    pen.arc(x, y, Math.max(radius, 0), 0, 2 * Math.PI);
    if (fill) {
      pen.fillStyle = fill;
      pen.fill();
    }
    if (stroke) {
      pen.strokeStyle = stroke;
      pen.lineWidth = 1.3;
      pen.setLineDash(dash);
      pen.stroke();
      pen.setLineDash([]);
    }
  }

  // The capture set K: the convex hull of the disc of radius l and the two tips at l / rho; and the level of
  // h through the robot, which is the same set for l + h.
  hull([x, y], heading, radius, rho) {
    const { pen, camera } = this;
    const usable = Math.acos(rho);
    const r = radius * camera.scale;
    pen.save();
    pen.translate(x, y);
    pen.rotate(-heading);
    pen.beginPath();
    pen.moveTo(r / rho, 0);
    pen.arc(0, 0, r, usable, Math.PI - usable);
    pen.lineTo(-r / rho, 0);
    pen.arc(0, 0, r, Math.PI + usable, 2 * Math.PI - usable);
    pen.closePath();
    pen.restore();
  }

  sets(at, heading, numbers, evader, free, colours) {
    const { pen, camera } = this;
    const [l, rho] = captureSet(numbers);
    const [ex, ey] = camera.px(...evader);
    const usable = Math.acos(rho);
    const distance = Math.hypot(ex - at[0], ey - at[1]) / camera.scale;
    let bearing = Math.abs(Math.atan2(-(ey - at[1]), ex - at[0]) - heading) % Math.PI;
    bearing = Math.min(bearing, Math.PI - bearing);
    const level = distance * Math.cos(Math.max(usable - bearing, 0));
    if (level > l + 0.004 && level < l + 0.9) {
      this.clip(free);
      this.hull(at, heading, level, rho);
      pen.globalAlpha = Math.max(0.15, 1 - (level - l) / 0.9);
      pen.strokeStyle = colours.level;
      pen.lineWidth = 1.2;
      pen.setLineDash([1, 5]);
      pen.lineCap = "round";
      pen.stroke();
      pen.restore();
    }
    this.hull(at, heading, l, rho);
    pen.fillStyle = colours.pursuerFaint;
    pen.fill();
    pen.strokeStyle = colours.pursuer;
    pen.lineWidth = 1.4;
    pen.setLineDash([6, 4]);
    pen.stroke();
    pen.setLineDash([]);
    this.disc(at, numbers.capture_distance * camera.scale, colours.pursuerFaint, colours.pursuer);
  }

  pursuer([x, y], heading, b, rolled, colours, yours) {
    const { pen } = this;
    const length = Math.max(b * 0.78, 10);
    const wheelLong = Math.max(b * 0.62, 9);
    const wheelWide = Math.max(b * 0.19, 4);
    pen.save();
    pen.translate(x, y);
    pen.rotate(-heading);
    pen.shadowColor = colours.shadow;
    pen.shadowBlur = 8;
    pen.shadowOffsetY = 2;
    // Axle, then wheels at the true distance.
    pen.fillStyle = colours.metal;
    pen.fillRect(-1.5, -b, 3, 2 * b);
    for (const side of [-1, 1]) {
      pen.fillStyle = colours.tyre;
      pen.beginPath();
      pen.roundRect(-wheelLong / 2, side * b - wheelWide / 2, wheelLong, wheelWide, wheelWide * 0.4);
      pen.fill();
    }
    pen.shadowBlur = 0;
    pen.shadowOffsetY = 0;
    [1, 0].forEach((which, i) => {
      const side = i === 0 ? -1 : 1; // canvas y is down: the right wheel is at +b there
      const wheel = side === 1 ? 1 : 0;
      const pitch = wheelLong / 4;
      const shift = (((rolled[wheel] * this.camera.scale) % pitch) + pitch) % pitch;
      pen.strokeStyle = colours.tread;
      pen.lineWidth = 1;
      pen.beginPath();
      for (let at = -wheelLong / 2 + shift; at < wheelLong / 2; at += pitch) {
        if (at < -wheelLong / 2 + 1.5 || at > wheelLong / 2 - 1.5) continue;
        pen.moveTo(at, side * b - wheelWide / 2 + 1);
        pen.lineTo(at, side * b + wheelWide / 2 - 1);
      }
      pen.stroke();
    });
    const half = Math.max(b - wheelWide * 0.9, 6);
    pen.shadowColor = colours.shadow;
    pen.shadowBlur = 6;
    const paint = pen.createLinearGradient(0, -half, 0, half);
    paint.addColorStop(0, colours.pursuerLight);
    paint.addColorStop(1, colours.pursuer);
    pen.fillStyle = paint;
    pen.beginPath();
    pen.moveTo(length * 0.98, 0);
    pen.quadraticCurveTo(length * 0.86, -half * 0.5, length * 0.36, -half * 0.84);
    pen.quadraticCurveTo(-length * 0.7, -half * 0.95, -length * 0.72, -half * 0.4);
    pen.lineTo(-length * 0.72, half * 0.4);
    pen.quadraticCurveTo(-length * 0.7, half * 0.95, length * 0.36, half * 0.84);
    pen.quadraticCurveTo(length * 0.86, half * 0.5, length * 0.98, 0);
    pen.fill();
    pen.shadowBlur = 0;
    pen.strokeStyle = "#fffffff0";
    pen.lineWidth = Math.max(b * 0.09, 2);
    pen.lineJoin = pen.lineCap = "round";
    pen.beginPath();
    pen.moveTo(length * 0.06, -half * 0.36);
    pen.lineTo(length * 0.5, 0);
    pen.lineTo(length * 0.06, half * 0.36);
    pen.stroke();
    if (yours) {
      pen.fillStyle = "#ffffffe8";
      pen.beginPath();
      pen.arc(-length * 0.36, 0, Math.max(b * 0.1, 2.4), 0, 2 * Math.PI);
      pen.fill();
    }
    pen.restore();
  }

  evader([x, y], frame, numbers, colours, now) {
    const { pen } = this;
    const r = Math.max(EVADER * this.camera.scale, 8);
    const share = Math.min((frame.intervention || 0) / (2 * numbers.evader_speed), 1);
    if (share > 0.002) {
      const wide = 3 + 5 * Math.sqrt(share);
      pen.strokeStyle = frame.status === "infeasible" ? colours.pursuer : colours.correction;
      pen.lineWidth = wide;
      pen.beginPath();
      pen.arc(x, y, r + 3 + wide / 2, 0, 2 * Math.PI);
      if (frame.status === "infeasible") pen.setLineDash([4, 4]);
      pen.stroke();
      pen.setLineDash([]);
    }
    pen.save();
    pen.translate(x, y);
    const [ux, uy] = frame.action || [0, 0];
    const fast = Math.hypot(ux, uy) > 0.01;
    const wish = fast ? -Math.atan2(uy, ux) : (this.facing ?? 0);
    const gap = Math.atan2(Math.sin(wish - (this.facing ?? wish)), Math.cos(wish - (this.facing ?? wish)));
    this.facing = (this.facing ?? wish) + 0.25 * gap;
    pen.shadowColor = colours.shadow;
    pen.shadowBlur = 8;
    pen.shadowOffsetY = 2;
    pen.fillStyle = colours.tyre;
    for (let i = 0; i < 3; i++) {
      const angle = (i * 2 * Math.PI) / 3 + Math.PI / 6;
      pen.save();
      pen.rotate(angle);
      pen.beginPath();
      pen.roundRect(r * 0.78, -r * 0.42, r * 0.34, r * 0.84, r * 0.12);
      pen.fill();
      pen.restore();
    }
    const paint = pen.createRadialGradient(-r * 0.3, -r * 0.4, r * 0.1, 0, 0, r);
    paint.addColorStop(0, colours.evaderLight);
    paint.addColorStop(1, colours.evader);
    pen.fillStyle = paint;
    pen.beginPath();
    pen.arc(0, 0, r, 0, 2 * Math.PI);
    pen.fill();
    pen.shadowBlur = 0;
    pen.shadowOffsetY = 0;
    pen.rotate(this.facing);
    pen.fillStyle = "#fff";
    pen.beginPath();
    pen.ellipse(r * 0.36, 0, r * 0.3, r * 0.46, 0, 0, 2 * Math.PI);
    pen.fill();
    pen.fillStyle = "#0b1a26";
    pen.beginPath();
    pen.ellipse(r * 0.46, 0, r * 0.15, r * 0.24, 0, 0, 2 * Math.PI);
    pen.fill();
    pen.restore();
  }

  obstacle([x, y, vx, vy], radius, colours) {
    const { pen, camera } = this;
    const [cx, cy] = camera.px(x, y);
    const r = radius * camera.scale;
    pen.save();
    pen.beginPath();
    pen.arc(cx, cy, r, 0, 2 * Math.PI);
    pen.fillStyle = colours.obstacleFaint;
    pen.fill();
    pen.clip();
    pen.strokeStyle = colours.obstacleHatch;
    pen.lineWidth = 2;
    pen.beginPath();
    for (let at = -2 * r; at < 2 * r; at += 9) {
      pen.moveTo(cx + at - r, cy + r);
      pen.lineTo(cx + at + r, cy - r);
    }
    pen.stroke();
    pen.restore();
    this.disc([cx, cy], r, null, colours.obstacle);
    this.disc([cx, cy], Math.max(0.035 * camera.scale, 4), colours.obstacle, null);
    const speed = Math.hypot(vx, vy);
    if (speed > 1e-4) this.arrow([cx, cy], vx, vy, 4, colours.obstacle, 1.6);
  }

  target([x, y], reach, colours, now) {
    const { pen, camera } = this;
    const [cx, cy] = camera.px(x, y);
    const r = Math.max(reach * camera.scale, 7);
    const beat = this.still ? 0.5 : (now / 1600) % 1;
    pen.globalAlpha = 0.5 * (1 - beat);
    this.disc([cx, cy], r * (1 + 1.5 * beat), null, colours.target);
    pen.globalAlpha = 1;
    this.disc([cx, cy], r, colours.targetFaint, colours.target);
    // A flag: known by its shape too.
    const tall = Math.max(0.15 * camera.scale, 22);
    pen.strokeStyle = colours.target;
    pen.fillStyle = colours.target;
    pen.lineWidth = 2.4;
    pen.lineCap = pen.lineJoin = "round";
    pen.beginPath();
    pen.moveTo(cx, cy);
    pen.lineTo(cx, cy - tall);
    pen.stroke();
    const wave = this.still ? 0 : Math.sin(now / 320) * tall * 0.05;
    pen.beginPath();
    pen.moveTo(cx + 0.5, cy - tall);
    pen.quadraticCurveTo(cx + tall * 0.32, cy - tall * 1.02 + wave, cx + tall * 0.62, cy - tall * 0.76 - wave);
    pen.quadraticCurveTo(cx + tall * 0.3, cy - tall * 0.66 + wave, cx + 0.5, cy - tall * 0.48);
    pen.closePath();
    pen.fill();
    pen.lineCap = "butt";
  }

  arrow([x, y], vx, vy, seconds, colour, width, dash = [], head = true) {
    const { pen, camera } = this;
    const [dx, dy] = [vx * seconds * camera.scale, -vy * seconds * camera.scale];
    const length = Math.hypot(dx, dy);
    if (length < 3) return;
    const angle = Math.atan2(dy, dx);
    const tip = Math.min(4 + 2.2 * width, length);
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + dx - Math.cos(angle) * tip * 0.8, y + dy - Math.sin(angle) * tip * 0.8);
    pen.stroke();
    pen.setLineDash([]);
    pen.beginPath();
    pen.moveTo(x + dx, y + dy);
    for (const turn of [2.65, -2.65]) {
      pen.lineTo(x + dx + tip * 1.2 * Math.cos(angle + turn), y + dy + tip * 1.2 * Math.sin(angle + turn));
    }
    pen.closePath();
    if (head) pen.fill();
    else {
      pen.lineWidth = 1.4;
      pen.stroke();
    }
  }

  velocities(at, frame, colours) {
    const { nominal, action } = frame;
    const apart = Math.hypot(nominal[0] - action[0], nominal[1] - action[1]) > 0.004;
    if (apart) this.arrow(at, nominal[0], nominal[1], SECONDS, colours.wish, 2, [3, 4], false);
    const speed = Math.hypot(...action);
    if (speed < 1e-3) return;
    const out = Math.max(EVADER * this.camera.scale, 8) / speed;
    this.arrow([at[0] + out * action[0], at[1] - out * action[1]], action[0], action[1], SECONDS, colours.evaderText, 3);
  }

  // Half-planes n.u >= c of the velocity: what a row forbids is hatched, in a disc as large as the speed limit.
  rows([x, y], rows, numbers, pursuers, colours) {
    const { pen, camera } = this;
    const unit = ROW_SECONDS * camera.scale;
    const r = numbers.evader_speed * unit;
    pen.save();
    pen.beginPath();
    pen.arc(x, y, r, 0, 2 * Math.PI);
    pen.fillStyle = colours.rowsDisc;
    pen.fill();
    pen.clip();
    rows.forEach(([nx, ny, c], i) => {
      if (c < -numbers.evader_speed) return;
      const colour = i < pursuers ? colours.pursuer : colours.obstacle;
      pen.save();
      pen.translate(x, y);
      pen.rotate(-Math.atan2(ny, nx));
      const edge = c * unit;
      pen.beginPath();
      pen.rect(-2 * r, -2 * r, 2 * r + edge, 4 * r);
      pen.clip();
      pen.globalAlpha = 0.16;
      pen.fillStyle = colour;
      pen.fillRect(-2 * r, -2 * r, 4 * r, 4 * r);
      pen.globalAlpha = 0.6;
      pen.strokeStyle = colour;
      pen.lineWidth = 1.2;
      pen.beginPath();
      for (let at = -4 * r; at < 4 * r; at += i < pursuers ? 8 : 11) {
        pen.moveTo(edge, at);
        pen.lineTo(edge - 3 * r, at - (i < pursuers ? 3 * r : -3 * r));
      }
      pen.stroke();
      pen.globalAlpha = 1;
      pen.lineWidth = 3;
      pen.beginPath();
      pen.moveTo(edge - 1, -2 * r);
      pen.lineTo(edge - 1, 2 * r);
      pen.stroke();
      pen.restore();
    });
    pen.restore();
    this.disc([x, y], r, null, colours.evader);
  }

  plan(evader, plan, colours) {
    const { pen, camera } = this;
    plan.forEach(([x, y], i) => {
      if (i % 2 || i === 0) return;
      const [px, py] = camera.px(x, y);
      pen.globalAlpha = 0.95 - (0.75 * i) / plan.length;
      this.disc([px, py], Math.max(0.013 * camera.scale, 2.2), colours.plan, null);
    });
    pen.globalAlpha = 0.45;
    pen.strokeStyle = colours.plan;
    pen.lineWidth = 1.4;
    pen.beginPath();
    pen.moveTo(...camera.px(...evader));
    for (const [x, y] of plan.slice(1)) pen.lineTo(...camera.px(x, y));
    pen.stroke();
    pen.globalAlpha = 1;
  }

  drawTrails(places, frame, colours) {
    const { pen, camera } = this;
    const newest = frame.time;
    pen.lineCap = pen.lineJoin = "round";
    const stroke = (trail, end, colour, width, pick) => {
      for (let i = 0; i < trail.length; i++) {
        const next = trail[i + 1] ?? end;
        if (!pick(trail[i])) continue;
        pen.globalAlpha = 0.55 * Math.max(1 - (newest - trail[i][2]) / TRAIL, 0) ** 1.3;
        pen.strokeStyle = colour;
        pen.lineWidth = width;
        pen.beginPath();
        pen.moveTo(...camera.px(trail[i][0], trail[i][1]));
        pen.lineTo(...camera.px(next[0], next[1]));
        pen.stroke();
      }
    };
    this.trails.pursuers.forEach((trail, i) => {
      if (places.pursuers[i]) stroke(trail, places.pursuers[i], colours.pursuer, 2, () => true);
    });
    stroke(this.trails.evader, places.evader, colours.correction, 7, (point) => point[3] > 0.004);
    stroke(this.trails.evader, places.evader, colours.evader, 2.4, () => true);
    pen.globalAlpha = 1;
    pen.lineCap = "butt";
  }

  goal([x, y], pose, colours) {
    const { pen, camera } = this;
    const at = camera.px(x, y);
    const from = camera.px(pose[0], pose[1]);
    pen.strokeStyle = colours.pursuer;
    pen.globalAlpha = 0.6;
    pen.lineWidth = 1.5;
    pen.setLineDash([2, 6]);
    pen.beginPath();
    pen.moveTo(...from);
    pen.lineTo(...at);
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
    this.disc(at, 9, null, colours.pursuer);
    this.disc(at, 2.5, colours.pursuer, null);
  }

  chosen({ what, index }, places, numbers, colours, now) {
    const { pen, camera } = this;
    const place = { evader: places.evader, target: places.target, pursuer: places.pursuers[index],
      obstacle: places.obstacles[index] }[what];
    if (!place) return;
    const at = camera.px(place[0], place[1]);
    pen.lineDashOffset = this.still ? 0 : -now / 60;
    this.disc(at, Math.max(0.13 * camera.scale, 22), null, colours.ink, [5, 5]);
    pen.lineDashOffset = 0;
    if (what === "pursuer") {
      const handle = this.handle(place, numbers);
      pen.strokeStyle = colours.ink;
      pen.lineWidth = 1.2;
      pen.beginPath();
      pen.moveTo(...at);
      pen.lineTo(...handle);
      pen.stroke();
      this.disc(handle, 8, colours.paper, colours.ink);
    }
  }

  // Where (px) the heading of a pursuer is dragged.
  handle(pose, numbers) {
    const far = Math.max(numbers.pursuer_half_axle * 1.5, 40 / this.camera.scale);
    return this.camera.px(pose[0] + far * Math.cos(pose[2]), pose[1] + far * Math.sin(pose[2]));
  }

  drawSparks(now) {
    const { pen, camera } = this;
    this.sparks = this.sparks.filter((spark) => now - spark.since < 900);
    for (const spark of this.sparks) {
      const share = (now - spark.since) / 900;
      const at = camera.px(...spark.place);
      for (const part of [0, 0.25, 0.5]) {
        const ring = share - part * 0.4;
        if (ring <= 0) continue;
        pen.globalAlpha = 0.8 * (1 - share);
        pen.strokeStyle = spark.colour;
        pen.lineWidth = 5 * (1 - share) + 0.5;
        pen.beginPath();
        pen.arc(at[0], at[1], (this.still ? 30 : 12 + 90 * ring), 0, 2 * Math.PI);
        pen.stroke();
      }
      pen.globalAlpha = 1;
    }
  }

  ruler(view, colours) {
    const { pen, camera } = this;
    const long = camera.scale > 260 ? 0.25 : 0.5;
    const [x, y] = view.ruler;
    pen.strokeStyle = pen.fillStyle = colours.soft;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(x, y - 4);
    pen.lineTo(x, y);
    pen.lineTo(x + long * camera.scale, y);
    pen.lineTo(x + long * camera.scale, y - 4);
    pen.stroke();
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.fillText(long === 0.25 ? "25 cm" : "50 cm", x + (long * camera.scale) / 2, y - 6);
  }
}
