// Answers in the server's place: the same messages, from the engine in this page. `views/play/visitor.py` is the
// live page's clock, with the same times.

import { Engine } from "./engine.js";
import { Session } from "./session.js";

const ENDING = 1800; // ms between the end of an episode and the next
const LATE = 250; // ms beyond which the clock does not catch up
const IDLE = 100; // ms between two looks at a world that stands still

export class Connection {
  constructor(handlers) {
    this.handlers = handlers;
    this.edits = [];
    this.said = "";
    this.due = 0;
    this.ended = null;
    Engine.load().then(([about, engine]) => {
      this.session = new Session(about, engine);
      document.body.dataset.plans = "no";
      handlers.hello(about.hello);
      this.flush();
      this.tick();
    }, (error) => handlers.error({ text: `The page's engine did not load: ${error.message}` }));
  }

  send(message) {
    this.edits.push(message);
    if (this.session) queueMicrotask(() => this.flush());
  }

  // Apply what the visitor asked for, and show it.
  flush() {
    const { session, handlers } = this;
    const edits = this.edits.splice(0);
    let shown = edits.length > 0;
    for (const edit of edits) {
      // Who drives already sees it in the next period.
      if (edit.type === "drive" && session.pursuer === "you") shown = edits.length > 1;
      const text = session.apply(edit);
      if (text) handlers.error({ text });
    }
    this.sayChoices();
    if (shown || !session.frames) handlers.frame(session.frame());
  }

  sayChoices() {
    const setup = this.session.setup();
    const text = JSON.stringify(setup);
    if (text === this.said) return;
    this.said = text;
    this.handlers.setup(setup);
  }

  tick() {
    const { session, handlers } = this;
    const now = performance.now();
    if (!session.outcome) {
      this.ended = null;
    } else if (this.ended === null) {
      this.ended = now;
      handlers.frame(session.frame());
    } else if (now - this.ended >= ENDING && !session.paused) {
      session.restart();
      handlers.frame(session.frame());
    }
    if (!session.moving) {
      this.due = now;
    } else if (now >= this.due) {
      handlers.frame(session.advance());
      this.sayChoices();
      this.due = Math.max(this.due + (1000 * session.period) / session.pace, now - LATE);
    }
    const wait = session.moving ? this.due - performance.now() : IDLE;
    setTimeout(() => this.tick(), Math.max(Math.min(wait, IDLE), 0));
  }
}
