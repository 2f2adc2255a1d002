// The state of the page as a link. It is in the fragment, which browsers keep to themselves.

const list = (values) => values.map((value) => +value.toFixed(4)).join(",");

export function toLink(setup, defaults, frame) {
  const parts = new URLSearchParams({ shield: setup.shield, pursuer: setup.pursuer });
  for (const [name, value] of Object.entries(setup.numbers)) {
    if (value !== defaults[name]) parts.set(name, String(value));
  }
  if (frame) {
    parts.set("evader", list(frame.evader));
    parts.set("target", list(frame.target));
    frame.pursuers.forEach((pose) => parts.append("p", list(pose)));
    frame.obstacles.forEach((one) => parts.append("o", list(one)));
  }
  return `${location.origin}${location.pathname}#${parts.toString().replaceAll("%2C", ",")}`;
}

// The message that restores what a link says, or null when it says nothing.
export function fromLink(hash, hello) {
  const parts = new URLSearchParams(hash.replace(/^#/, ""));
  if (![...parts.keys()].length) return null;
  const message = { type: "restore", values: {} };
  if (hello.shields.includes(parts.get("shield"))) message.shield = parts.get("shield");
  if (hello.pursuers.includes(parts.get("pursuer"))) message.pursuer = parts.get("pursuer");
  for (const slider of hello.sliders) {
    const value = Number.parseFloat(parts.get(slider.name));
    if (Number.isFinite(value)) message.values[slider.name] = Math.min(Math.max(value, slider.low), slider.high);
  }
  const read = (text, count) => {
    const values = (text || "").split(",").map(Number);
    return values.length === count && values.every(Number.isFinite) ? values : null;
  };
  const scene = {
    evader: [read(parts.get("evader"), 2)],
    target: [read(parts.get("target"), 2)],
    pursuers: parts.getAll("p").map((text) => read(text, 3)),
    obstacles: parts.getAll("o").map((text) => read(text, 4)),
  };
  const whole = Object.values(scene).flat().every(Boolean);
  const fits = scene.pursuers.length === hello.counts[0] && scene.obstacles.length === hello.counts[1];
  if (whole && fits) message.scene = scene;
  return message;
}
