// The page: what arrives is drawn, what the visitor does is sent.

import { Chart } from "./chart.js";
import { Connection } from "./connection.js";
import { Input, isTaken } from "./input.js";
import { fromLink, toLink } from "./link.js";
import { Motion } from "./motion.js";
import { Panel } from "./panel.js";
import { Pictures } from "./pictures.js";
import { Scene } from "./scene.js";
import { readColours } from "./theme.js";

const byId = (id) => document.getElementById(id);
const canvas = byId("scene");
const scene = new Scene(canvas);
const chart = new Chart(byId("chart"));
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const touch = matchMedia("(pointer: coarse)");

const state = { hello: null, setup: null, frame: null, full: false, restore: null, chosen: null, dragging: null };
let motion = null;
let colours = readColours();
let bannerUntil = 0;

const input = new Input((message) => connection.send(message));
const panel = new Panel({
  send: (message) => connection.send(message),
  theme: () => { colours = readColours(); },
  link: () => toLink(state.setup, state.hello.defaults, state.frame),
  focus: () => canvas.focus({ preventScroll: true }),
});

const connection = new Connection({
  hello(message) {
    state.hello = message;
    motion = new Motion(message.period);
    panel.greet(message);
    const link = state.restore ?? fromLink(location.hash, message);
    if (link) connection.send(link);
    panel.sendShow();
    input.said = "";
    state.full = false;
    document.body.dataset.connected = "yes";
  },
  setup(message) {
    if (message.ready && !state.setup?.ready) pictures.rest();
    state.setup = message;
    state.restore = null;
    panel.take(message);
    byId("task").textContent = task(message);
    document.body.dataset.ready = message.ready ? "yes" : "no";
    byId("warming").hidden = message.ready;
    const warming = WARMING[message.states[message.shield]] ?? WARMING.warming;
    const instead = byId("warming-none");
    byId("warming").dataset.state = message.states[message.shield];
    byId("warming-title").textContent = warming.title.replace("SHIELD", message.shield);
    byId("warming-text").textContent = warming.text.replace("SHIELD", message.shield);
    instead.textContent = warming.offer;
    instead.value = warming.instead;
    instead.hidden = message.shield === warming.instead || message.states[warming.instead] !== "ready";
    if (!message.paused) state.chosen = null;
    hint();
  },
  frame(message) {
    const now = performance.now();
    const before = state.frame;
    motion.take(message, now);
    scene.trails.take(message, state.setup?.numbers.evader_speed ?? 1);
    chart.take(message, state.setup?.numbers.evader_speed ?? 1);
    if (message.cut && message.pace === 0) {
      chart.clear();
      scene.trails.clear();
    }
    state.frame = message;
    showScore(message);
    if (message.reached && message.pace > 0) scene.spark(before?.target ?? message.target, colours.target, now);
    if (message.over && before?.over !== message.over) ended(message, now);
    if (!message.over && before?.over) byId("banner").hidden = true;
    document.body.dataset.over = message.over ?? "";
  },
  error(message) {
    say("", message.text, 2500);
  },
  lost(full) {
    state.full = full;
    if (state.setup) {
      state.restore = fromLink(new URL(toLink(state.setup, state.hello.defaults, null)).hash, state.hello);
    }
    document.body.dataset.connected = "no";
    say(full ? "No room just now" : "Connection lost", full ? "Others are playing; trying again." : "Trying again.", 6e5);
  },
});

// Said while a shield cannot run, with another one that can.
const WARMING = {
  warming: {
    title: "Warming up the shield SHIELD",
    text: "It is being compiled: half a minute the first time on this computer, a moment from then on.",
    instead: "none", offer: "Meanwhile, catch it without a shield",
  },
  failed: {
    title: "This shield could not be compiled", text: "The server's log says why. Choose another one.",
    instead: "none", offer: "Meanwhile, catch it without a shield",
  },
  missing: {
    title: "No clearance table for these numbers",
    text: "On this page SHIELD goes by such tables, and looks ahead only in the installed package.",
    instead: "game", offer: "Take the shield game",
  },
};

function task(setup) {
  if (setup.pursuer === "you") return "You drive the pursuer. Catch the blue robot.";
  return `${setup.pursuer} hunts the blue robot. Drive to take over.`;
}

function hint() {
  const { setup } = state;
  if (!setup) return;
  const phone = touch.matches;
  byId("hint").textContent = setup.paused
    ? phone ? "Paused: drag anything." : "Paused: drag robots, obstacles and the target, or choose with , and . and move with the arrow keys."
    : phone ? "Hold a finger where the pursuer is to go." : "W A S D or arrow keys drive; or hold the mouse where to go.";
}

function say(title, text, time) {
  const banner = byId("banner");
  banner.querySelector("b").textContent = title;
  banner.querySelector("span").textContent = text;
  banner.dataset.kind = "";
  banner.hidden = false;
  bannerUntil = performance.now() + time;
}

function ended(frame, now) {
  const caught = frame.over === "captured";
  const time = frame.score.survived.toFixed(1);
  const who = state.setup?.pursuer === "you" ? "You caught it" : "Caught";
  say(caught ? who : "It hit an obstacle", caught ? `after ${time} s` : `after ${time} s; that counts against it too`, 1700);
  byId("banner").dataset.kind = frame.over;
  scene.spark(frame.evader, caught ? colours.pursuer : colours.obstacle, now);
}

function showScore(frame) {
  const tally = frame.score.tallies[state.setup?.shield] ?? { captured: 0, collided: 0, reached: 0, longest: 0 };
  const put = (id, text) => {
    const place = byId(id);
    if (place.textContent !== text) place.textContent = text;
  };
  put("score-captured", String(tally.captured));
  put("score-reached", String(tally.reached));
  put("score-survived", `${frame.score.survived.toFixed(1)}\u202fs`);
  put("score-longest", `${tally.longest.toFixed(1)}\u202fs`);
  panel.tallies(frame.score.tallies);
}

// The part of the canvas that nothing lies over.
function freeRoom() {
  const whole = canvas.getBoundingClientRect();
  const below = byId("score").getBoundingClientRect().bottom - whole.top;
  const strip = byId("strip").getBoundingClientRect();
  const bar = byId("transport").getBoundingClientRect();
  const narrow = whole.width < 760;
  const verdict = byId("verdict").getBoundingClientRect();
  const words = byId("hint").getBoundingClientRect();
  const foot = Math.min(...[strip, bar, words].filter((box) => box.height).map((box) => box.top));
  const low = foot - whole.top - 6;
  const warming = byId("warming").getBoundingClientRect();
  // In between, the verdict hangs at the left below the score, and robots pass beside it.
  const beside = !narrow && verdict.top - whole.top > below;
  const boxes = [verdict, warming].filter((box) => box.height && !(beside && box === verdict));
  const head = Math.max(below + 2, ...boxes.map((box) => box.bottom - whole.top));
  const top = head + 8;
  state.ruler = narrow ? [16, head + 24] : [24, strip.top - whole.top - 10];
  return { left: 14, top, width: whole.width - 28, height: Math.max(low - top, 80) };
}

function draw(now) {
  if (bannerUntil && now > bannerUntil) {
    bannerUntil = 0;
    byId("banner").hidden = true;
  }
  for (const button of input.poll()) {
    if (button === 9) panel.togglePause();
    if (button === 3) connection.send({ type: "reset" });
  }
  const { frame, setup, hello } = state;
  if (!frame || !setup || !hello) return;
  const yours = setup.pursuer === "you";
  motion.own = yours && !input.goal ? input.own : null;
  const places = motion.at(now, setup.numbers.pursuer_half_axle, setup.numbers.pursuer_speed);
  if (state.dragging) place(places, state.dragging);
  scene.still = calm.matches;
  scene.camera.held = Boolean(state.dragging);
  const free = freeRoom();
  scene.draw({
    places, frame, numbers: setup.numbers, colours, show: panel.show, free, ruler: state.ruler, arena: hello.arena,
    reach: hello.reach, counts: hello.counts, own: yours ? motion.own : null, yours,
    goal: yours && !setup.paused ? input.goal : null, chosen: setup.paused ? state.chosen : null,
  }, now);
  chart.draw(colours);
  state.places = places;
  if (setup.paused) canvas.dataset.evader = JSON.stringify(scene.camera.px(...places.evader).map(Math.round));
}

// What is being dragged is drawn where the pointer is.
function place(places, { what, index, to, heading }) {
  const robot = { evader: places.evader, target: places.target, pursuer: places.pursuers[index],
    obstacle: places.obstacles[index] }[what];
  robot[0] = to[0];
  robot[1] = to[1];
  if (heading !== null && what === "pursuer") robot[2] = heading;
}

function bodies() {
  const { places } = state;
  if (!places) return [];
  return [
    { what: "evader", index: 0, at: places.evader, room: 0.12 },
    ...places.pursuers.map((at, index) => ({ what: "pursuer", index, at, room: state.setup.numbers.pursuer_half_axle })),
    { what: "target", index: 0, at: places.target, room: 0.12 },
    ...places.obstacles.map((at, index) => ({ what: "obstacle", index, at, room: state.setup.numbers.collision_distance })),
  ];
}

function pointed(event) {
  const box = canvas.getBoundingClientRect();
  return scene.camera.world(event.clientX - box.left, event.clientY - box.top);
}

const near = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

function sendMove(drag) {
  const message = { type: "move", what: drag.what, index: drag.index, to: drag.to.map((v) => Math.round(v * 1e4) / 1e4) };
  if (drag.heading !== null) message.heading = Math.atan2(Math.sin(drag.heading), Math.cos(drag.heading));
  connection.send(message);
}

canvas.addEventListener("pointerdown", (event) => {
  if (event.button || !state.setup) return;
  event.preventDefault();
  canvas.focus({ preventScroll: true });
  canvas.setPointerCapture(event.pointerId);
  const at = pointed(event);
  if (!state.setup.paused) {
    input.toward(at);
    return;
  }
  const grip = touch.matches ? 22 / scene.camera.scale : 8 / scene.camera.scale;
  const box = canvas.getBoundingClientRect();
  const chosen = state.chosen;
  if (chosen?.what === "pursuer") {
    const pose = state.places.pursuers[chosen.index];
    const handle = scene.handle(pose, state.setup.numbers);
    if (near(handle, [event.clientX - box.left, event.clientY - box.top]) < 20) {
      state.dragging = { ...chosen, to: pose.slice(0, 2), heading: pose[2], turning: true };
      return;
    }
  }
  const hit = bodies().find((body) => near(body.at, at) <= body.room + grip);
  state.chosen = hit ? { what: hit.what, index: hit.index } : null;
  if (hit) {
    state.dragging = { what: hit.what, index: hit.index, to: hit.at.slice(0, 2), heading: null, turning: false,
      grip: [hit.at[0] - at[0], hit.at[1] - at[1]] };
  }
});

canvas.addEventListener("pointermove", (event) => {
  const drag = state.dragging;
  if (drag) {
    const at = pointed(event);
    if (drag.turning) drag.heading = Math.atan2(at[1] - drag.to[1], at[0] - drag.to[0]);
    else drag.to = [at[0] + drag.grip[0], at[1] + drag.grip[1]];
  } else if (input.goal) {
    input.pending = pointed(event);
  }
});
setInterval(() => {
  if (input.pending && input.goal) input.toward(input.pending);
  input.pending = null;
}, 25);

function released() {
  if (state.dragging) {
    sendMove(state.dragging);
    state.dragging = null;
  }
  input.pending = null;
  if (input.goal) input.toward(null);
}
canvas.addEventListener("pointerup", released);
canvas.addEventListener("pointercancel", released);
canvas.addEventListener("contextmenu", (event) => event.preventDefault());

function choose(step) {
  const all = bodies();
  const index = all.findIndex((body) => body.what === state.chosen?.what && body.index === state.chosen?.index);
  const { what, index: number } = all[(index + step + all.length) % all.length];
  state.chosen = { what, index: number };
}

function nudge(event) {
  const chosen = bodies().find((body) => body.what === state.chosen?.what && body.index === state.chosen?.index);
  if (!chosen) return false;
  const by = event.shiftKey ? 0.01 : 0.05;
  const way = { ArrowUp: [0, by], ArrowDown: [0, -by], ArrowLeft: [-by, 0], ArrowRight: [by, 0] }[event.code];
  const turn = { KeyQ: 0.1, KeyE: -0.1 }[event.code];
  if (!way && !(turn && chosen.what === "pursuer")) return false;
  const to = [chosen.at[0] + (way?.[0] ?? 0), chosen.at[1] + (way?.[1] ?? 0)];
  sendMove({ ...chosen, to, heading: turn ? chosen.at[2] + turn : null });
  return true;
}

const KEYS = {
  Space: () => panel.togglePause(),
  KeyN: () => panel.step(),
  KeyM: () => panel.toggleSlow(),
  KeyR: () => connection.send({ type: "reset" }),
  KeyB: () => connection.send({ type: "reset", again: true }),
};

addEventListener("keydown", (event) => {
  if (isTaken(event) || !state.setup) return;
  if (event.code === "Escape") panel.toggle(false);
  if (state.setup.paused) {
    if (event.code === "Comma" || event.code === "Period") choose(event.code === "Comma" ? -1 : 1);
    if (nudge(event)) {
      event.preventDefault();
      return;
    }
  }
  if (/^Digit[1-4]$/.test(event.code)) {
    const shield = state.hello.shields[Number(event.code.at(-1)) - 1];
    if (shield) connection.send({ type: "pick", shield });
    return;
  }
  if (event.code in KEYS) {
    event.preventDefault();
    if (!event.repeat || event.code === "KeyN") KEYS[event.code]();
  } else if (!state.setup.paused && input.press(event.code)) {
    event.preventDefault();
  }
});

byId("warming-none").addEventListener("click", (event) => connection.send({ type: "pick", shield: event.target.value }));
document.addEventListener("visibilitychange", () => {
  // A page that nobody sees need not be computed.
  if (document.hidden && state.setup && !state.setup.paused) {
    state.asleep = true;
    connection.send({ type: "pause", paused: true });
  } else if (!document.hidden && state.asleep) {
    state.asleep = false;
    connection.send({ type: "pause", paused: false });
  }
});
addEventListener("hashchange", () => {
  const link = state.hello && fromLink(location.hash, state.hello);
  if (link) connection.send(link);
});
const pictures = new Pictures(draw);
