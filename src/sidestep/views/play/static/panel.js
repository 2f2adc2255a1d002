// The controls: what can be chosen, and what has been.

import { THEMES, setTheme, themeOf, watchTheme } from "./theme.js";

const byId = (id) => document.getElementById(id);
const SHIELDS = {
  none: "No shield: the robot just drives at its target. Anybody catches it.",
  paper: "The paper's shield believes that the pursuer drives straight on. Come at it from the front and you have it.",
  game: "Built on the solved pursuit game, for every motion that the pursuer can make. Obstacles it may still hit.",
  joint: "The game's shield that also looks ahead for a way past the obstacles.",
};
// Said of the shields that are built on the game, by what the numbers allow.
const CHANCES = {
  caught: "With these numbers the best pursuer wins: no shield can prevent that.",
  held: "With these numbers nobody should catch it: try.",
  open: "With these numbers the robot wins the game, but no guarantee holds at this rate: try.",
  unsure: "With these numbers the robot wins the game: try.",
};
const LEGEND = [
  ["evader", "robot"], ["pursuer", "pursuer, capture circle"], ["hull", "capture set K"], ["level", "level h"],
  ["wish", "nominal velocity"], ["correction", "shield corrects"], ["plan", "escape plan"], ["target", "target"], ["obstacle", "obstacle"],
];
const SHOWS = ["capture", "velocities", "rows", "plan", "trails"];

function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

function radios(group, name, values, picked) {
  group.replaceChildren(...values.map((value) => {
    const input = make("input", { type: "radio", name, value, id: `${name}-${value}` });
    input.addEventListener("change", () => picked(value));
    return make("label", { htmlFor: input.id }, input, make("span", { textContent: value }));
  }));
}

export class Panel {
  constructor(page) {
    this.page = page;
    this.show = { capture: true, velocities: true, rows: false, plan: true, trails: true };
    this.setup = null;
    this.moved = {};
    this.pointerAt = 0;
    addEventListener("pointerup", () => { this.pointerAt = performance.now(); }, true);
    byId("pause").addEventListener("click", () => this.togglePause());
    byId("step").addEventListener("click", () => this.step());
    byId("slow").addEventListener("click", () => this.toggleSlow());
    byId("again").addEventListener("click", () => page.send({ type: "reset", again: true }));
    byId("reset").addEventListener("click", () => page.send({ type: "reset" }));
    byId("more").addEventListener("click", () => this.toggle());
    byId("defaults").addEventListener("click", () => page.send({ type: "set", values: {}, defaults: true }));
    byId("link").addEventListener("click", () => this.copyLink());
    for (const name of SHOWS) {
      const box = byId(`show-${name}`);
      box.addEventListener("change", () => {
        this.show[name] = box.checked;
        this.sendShow();
        this.back();
      });
    }
    byId("legend").replaceChildren(...LEGEND.map(([kind, words]) =>
      make("li", {}, make("i", { className: kind }), words)));
    radios(byId("themes"), "theme", THEMES, (theme) => setTheme(theme, page.theme));
    byId(`theme-${themeOf()}`).checked = true;
    setTheme(themeOf(), page.theme);
    watchTheme(page.theme);
    setInterval(() => this.flush(), 60);
  }

  // Keys drive again after a control was used with the pointer; with the keyboard it keeps the focus.
  back() {
    if (performance.now() - this.pointerAt < 400) this.page.focus();
  }

  greet(hello) {
    this.hello = hello;
    radios(byId("shields"), "shield", hello.shields, (shield) => {
      this.page.send({ type: "pick", shield });
      this.back();
    });
    for (const label of byId("shields").children) label.append(make("em", { textContent: "" }));
    const select = byId("pursuer");
    select.replaceChildren(...hello.pursuers.map((name) =>
      make("option", { value: name, textContent: name === "you" ? "you, at this page" : name })));
    select.onchange = () => {
      this.page.send({ type: "pick", pursuer: select.value });
      this.back();
    };
    byId("sliders").replaceChildren(...hello.sliders.map((slider) => this.slider(slider)));
    byId("downloads").replaceChildren(...hello.formats.map((format) =>
      make("a", { className: "button", href: `/episode/${hello.token}.${format}`, download: `sidestep-episode.${format}`,
        textContent: `Episode .${format}`, id: `download-${format}` })));
  }

  slider({ name, label, unit, low, high, step }) {
    const value = make("output", { htmlFor: `slider-${name}`, id: `value-${name}` });
    const range = make("input", { type: "range", id: `slider-${name}`, min: low, max: high, step: "any" });
    const digits = step < 0.001 ? 4 : 3;
    const put = (number) => {
      range.value = number;
      value.textContent = `${Number(number).toFixed(digits)} ${unit}`;
      range.setAttribute("aria-valuetext", value.textContent);
      range.style.setProperty("--share", `${(100 * (number - low)) / (high - low)}%`);
    };
    range.addEventListener("input", () => {
      const number = Math.min(Math.max(Math.round(range.value / step) * step, low), high);
      this.moved[name] = Number(number.toFixed(6));
      put(number);
    });
    range.addEventListener("keydown", (event) => {
      const way = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 10, PageDown: -10 }[event.code];
      if (!way) return;
      event.preventDefault();
      const number = Math.min(Math.max(Number(range.value) + way * step * (name === "evader_speed" ? 5 : 1), low), high);
      this.moved[name] = Number(number.toFixed(6));
      put(number);
    });
    range.addEventListener("change", () => this.back());
    range.put = put;
    return make("div", { className: "slider" }, make("label", { htmlFor: range.id, textContent: label }), value, range);
  }

  flush() {
    if (!Object.keys(this.moved).length) return;
    this.page.send({ type: "set", values: this.moved });
    this.moved = {};
  }

  take(setup) {
    this.setup = setup;
    byId(`shield-${setup.shield}`).checked = true;
    const plays = setup.ready && (setup.shield === "game" || setup.shield === "joint");
    const chances = plays ? ` ${CHANCES[setup.verdict.kind]}` : "";
    byId("shield-words").textContent = (setup.words ?? SHIELDS[setup.shield] ?? "") + chances;
    byId("pursuer").value = setup.pursuer;
    for (const [name, value] of Object.entries(setup.numbers)) {
      const range = byId(`slider-${name}`);
      if (!(name in this.moved) && !range.matches(":active")) range.put(value);
    }
    const pause = byId("pause");
    pause.setAttribute("aria-pressed", setup.paused);
    pause.title = setup.paused ? "Go on (space)" : "Pause (space)";
    byId("step").disabled = !setup.paused;
    byId("slow").setAttribute("aria-pressed", setup.pace < 1);
    document.body.dataset.paused = setup.paused ? "yes" : "no";
    this.verdict(setup.verdict);
  }

  verdict({ kind, largest, margin }) {
    const box = byId("verdict");
    const l = largest === null ? "any capture distance" : `capture distances up to ${(1000 * largest).toFixed(1)} mm`;
    const spare = margin === null ? "" : `, ${(1000 * margin).toFixed(1)} mm more`;
    const rate = this.hello ? `${Math.round(1 / this.hello.period)} decisions a second` : "this rate";
    const words = {
      caught: ["With these numbers it can be caught", largest > 0 ? `The best pursuer wins: l is ${(-1000 * margin).toFixed(1)} mm more than l_max.` : "The best pursuer wins."],
      held: ["With these numbers it cannot be caught", `Certified at ${rate}, obstacles apart. The game allows ${l}${spare}.`],
      open: ["With these numbers it can stay free", `The game allows ${l}${spare}. Not certified at ${rate}.`],
      unsure: ["With these numbers it can stay free", `The game allows ${l}${spare}.`],
    }[kind];
    box.dataset.kind = kind === "unsure" ? "open" : kind;
    box.querySelector("b").textContent = words[0];
    box.querySelector("span").textContent = words[1];
  }

  tallies(tallies) {
    for (const label of byId("shields").children) {
      const tally = tallies[label.querySelector("input").value];
      const text = `${tally?.captured ?? 0} caught`;
      const place = label.querySelector("em");
      if (place.textContent !== text) place.textContent = text;
    }
  }

  sendShow() {
    this.page.send({ type: "show", rows: this.show.rows, plan: this.show.plan });
  }

  togglePause() {
    if (this.setup) this.page.send({ type: "pause", paused: !this.setup.paused });
  }

  toggleSlow() {
    if (this.setup) this.page.send({ type: "pace", pace: this.setup.pace < 1 ? 1 : 0.25 });
  }

  step() {
    if (!this.setup) return;
    if (!this.setup.paused) this.page.send({ type: "pause", paused: true });
    this.page.send({ type: "step" });
  }

  toggle(open = byId("more").getAttribute("aria-expanded") !== "true") {
    byId("more").setAttribute("aria-expanded", open);
    document.body.classList.toggle("open", open);
  }

  async copyLink() {
    const link = this.page.link();
    history.replaceState(null, "", link);
    try {
      await navigator.clipboard.writeText(link);
      byId("kept").textContent = "The link is copied: whoever opens it begins here.";
    } catch {
      byId("kept").textContent = "The link is in the address bar.";
    }
  }
}
