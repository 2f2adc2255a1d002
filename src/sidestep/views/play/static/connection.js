// The socket to the server: what comes is handed on, what goes out is small, and a lost one is opened again.

const FULL = 4013;

export class Connection {
  constructor(handlers) {
    this.handlers = handlers;
    this.tries = 0;
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/live`);
    this.socket = socket;
    socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      this.tries = 0;
      if (message.type === "frame") this.send({ type: "seen", frame: message.frame });
      this.handlers[message.type]?.(message);
    };
    socket.onclose = (event) => {
      const full = event.code === FULL;
      this.handlers.lost(full);
      const wait = full ? 5000 : Math.min(500 * 2 ** this.tries, 8000);
      this.tries += 1;
      setTimeout(() => this.open(), wait);
    };
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }
}
