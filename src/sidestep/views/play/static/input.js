// What does the person at the page want to drive: keys, pointer (mouse, pen, finger) or gamepad?

const DRIVE = {
  ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1],
  KeyW: [1, 0], KeyS: [-1, 0], KeyA: [0, 1], KeyD: [0, -1],
};
const DEAD = 0.18; // of a stick's way

export function wheelsOf(forward, turn) {
  const clip = (value) => Math.max(-1, Math.min(1, value));
  return [clip(forward - turn), clip(forward + turn)];
}

// Whether keys belong to the control that has the focus.
export function isTaken(event) {
  const { tagName, type } = event.target;
  if (event.ctrlKey || event.metaKey || event.altKey) return true;
  const arrows = event.code.startsWith("Arrow");
  if (tagName === "SELECT") return true;
  if (tagName === "INPUT") return arrows || event.code === "Space" || type === "text";
  return (tagName === "BUTTON" || tagName === "A") && (event.code === "Space" || event.code === "Enter");
}

export class Input {
  // `drive(message)` is called with what to send when it changes; `own` is what is wanted right now.
  constructor(drive) {
    this.drive = drive;
    this.keys = new Set();
    this.own = null;
    this.pad = null;
    this.goal = null;
    this.said = "";
    addEventListener("keyup", (event) => this.release(event.code));
    addEventListener("blur", () => this.letGo());
  }

  press(code) {
    if (!(code in DRIVE)) return false;
    this.keys.add(code);
    this.say();
    return true;
  }

  release(code) {
    if (this.keys.delete(code)) this.say();
  }

  letGo() {
    this.keys.clear();
    this.goal = null;
    this.say();
  }

  toward(goal) {
    this.goal = goal;
    this.say();
  }

  // Gamepads tell nothing by themselves: ask at every picture. Returns buttons that were just pressed.
  poll() {
    const pads = navigator.getGamepads?.() ?? [];
    const pad = [...pads].find((one) => one?.connected);
    if (!pad) {
      if (this.pad) {
        this.pad = null;
        this.say();
      }
      return [];
    }
    const axis = (value) => (Math.abs(value) < DEAD ? 0 : Math.round(value * 20) / 20);
    const held = (button) => (pad.buttons[button]?.pressed ? 1 : 0);
    const forward = axis(-pad.axes[1]) + held(12) - held(13);
    const turn = axis(-pad.axes[0]) + held(14) - held(15);
    const wanted = forward || turn ? [forward, turn] : null;
    const down = pad.buttons.map((button) => button.pressed);
    const pressed = down.map((is, i) => (is && !this.down?.[i] ? i : -1)).filter((i) => i >= 0);
    this.down = down;
    if (JSON.stringify(wanted) !== JSON.stringify(this.pad)) {
      this.pad = wanted;
      this.say();
    }
    return pressed;
  }

  say() {
    let message;
    if (this.keys.size || this.pad) {
      let [forward, turn] = this.pad ?? [0, 0];
      for (const code of this.keys) {
        forward += DRIVE[code][0];
        turn += DRIVE[code][1];
      }
      const sign = (value) => Math.max(-1, Math.min(1, value));
      this.own = wheelsOf(sign(forward), sign(turn));
      message = { type: "drive", wheels: this.own };
    } else if (this.goal) {
      this.own = null;
      message = { type: "drive", toward: this.goal.map((value) => Math.round(value * 1000) / 1000) };
    } else {
      this.own = [0, 0];
      message = { type: "drive" };
    }
    const text = JSON.stringify(message);
    if (text !== this.said) {
      this.said = text;
      this.drive(message);
    }
  }
}
