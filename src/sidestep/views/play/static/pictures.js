// Has a picture drawn whenever the screen takes one, and rests where the browser has fallen behind.
//
// A browser that was late once, while the page loaded, say, may go on to show every picture one or two later than
// it could, for as long as one is drawn each time. A rest lets it catch up: from a key to the screen it was 48 ms
// before and 16 to 32 ms after, in Chromium at 60 Hz.

const REST = 60; // ms
const LATE = 36; // ms from an input to the screen: more than two pictures at 60 Hz
const INPUTS = 5; // in a row that must be late
const APART = 4000; // ms between two rests
const IN_VAIN = 3; // rests that changed nothing, after which the computer is taken to be slow

export class Pictures {
  // `draw(now)` is called for every picture.
  constructor(draw) {
    this.draw = draw;
    this.late = 0;
    this.vain = 0;
    this.rested = -Infinity;
    this.resting = false;
    if (globalThis.PerformanceObserver?.supportedEntryTypes?.includes("event")) {
      const observer = new PerformanceObserver((list) => {
        for (const entry of list.getEntries()) {
          if (entry.name === "keydown" || entry.name === "pointerdown") this.felt(entry.duration);
        }
      });
      observer.observe({ type: "event", durationThreshold: 16 });
    }
    this.next = (now) => {
      if (this.resting) setTimeout(() => requestAnimationFrame(this.next), REST);
      else requestAnimationFrame(this.next);
      this.resting = false;
      this.draw(now);
    };
    requestAnimationFrame(this.next);
  }

  // An input was on the screen after so many ms.
  felt(duration) {
    if (duration <= LATE) {
      this.late = this.vain = 0;
      return;
    }
    this.late += 1;
    const now = performance.now();
    if (this.late < INPUTS || this.vain >= IN_VAIN || now - this.rested < APART) return;
    this.vain += 1;
    this.rest(now);
  }

  // Leave out the next few pictures.
  rest(now = performance.now()) {
    this.rested = now;
    this.late = 0;
    this.resting = true;
  }
}
