// One session's live socket: credit, reconnection with growing pauses, silence; decodes nothing and draws nothing.

const CREDIT_WINDOW = 8; // binary messages under way at most
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 15000;
const QUIET_MS = 5000; // a scanning session speaks about twice a second
const DEAD_MS = 20000;
// closings that a new attempt cannot mend, by WebSocket close code (docs/live-stream.md)
const FINAL_CLOSINGS = { 1000: "finished", 4404: "absent" };

// States told to onState({state, ...}): connecting, open, quiet, waiting {seconds, attempt}, finished, absent, closed.
export class LiveConnection {
  #socket = null;
  #timer = null;
  #quietTimer = null;
  #lastHeard = 0;
  #attempt = 0;
  #closed = false;
  #isScanning = () => false;

  constructor(url, { onBinary, onText, onState, isScanning, open, setTimer, clearTimer, now, random }) {
    this.url = url;
    this.onBinary = onBinary;
    this.onText = onText;
    this.onState = onState;
    this.#isScanning = isScanning ?? this.#isScanning;
    this.open = open ?? ((address) => new WebSocket(address));
    this.setTimer = setTimer ?? ((action, ms) => setTimeout(action, ms));
    this.clearTimer = clearTimer ?? ((timer) => clearTimeout(timer));
    this.now = now ?? (() => performance.now());
    this.random = random ?? Math.random;
  }

  connect() {
    this.#closed = false;
    this.#drop();
    this.onState({ state: "connecting", attempt: this.#attempt });
    const socket = this.open(this.url);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    const current = (action) => (event) => {
      if (socket === this.#socket) action(event);
    };
    socket.onopen = current(() => {
      this.#heard();
      this.onState({ state: "open" });
      this.grant(CREDIT_WINDOW);
      this.#watch();
    });
    socket.onmessage = current(({ data }) => {
      this.#heard();
      this.#attempt = 0; // only a service that speaks resets the pauses
      if (typeof data === "string") this.onText(data);
      else this.onBinary(data);
    });
    socket.onclose = current(({ code, reason }) => this.#lost(code, reason));
  }

  // Allow the service `messages` more binary messages.
  grant(messages) {
    if (this.#socket?.readyState === 1) this.#socket.send(JSON.stringify({ credit: messages }));
  }

  // Give this socket up and fetch a full snapshot through a new one, after a pause.
  restart(why) {
    if (!this.#closed) this.#lost(4000, why);
  }

  // Try at once instead of waiting for the pause to end.
  retryNow() {
    if (!this.#closed && this.#timer !== null) this.connect();
  }

  close() {
    this.#closed = true;
    this.#drop();
    this.onState({ state: "closed" });
  }

  #heard() {
    this.#lastHeard = this.now();
  }

  #watch() {
    let wasQuiet = false;
    const look = () => {
      const silence = this.now() - this.#lastHeard;
      const quiet = this.#isScanning() && silence > QUIET_MS;
      if (quiet && silence > DEAD_MS) {
        this.restart("the service fell silent");
        return;
      }
      if (quiet) this.onState({ state: "quiet", seconds: Math.round(silence / 1000) });
      else if (wasQuiet) this.onState({ state: "open" });
      wasQuiet = quiet;
      this.#quietTimer = this.setTimer(look, 1000);
    };
    this.#quietTimer = this.setTimer(look, 1000);
  }

  #lost(code, reason) {
    this.#drop();
    const final = FINAL_CLOSINGS[code];
    if (final) {
      this.#closed = true;
      this.onState({ state: final, reason });
      return;
    }
    this.#attempt += 1;
    const full = Math.min(LONGEST_PAUSE_MS, FIRST_PAUSE_MS * 2 ** (this.#attempt - 1));
    const pause = full * (0.75 + 0.25 * this.random()); // viewers must not all come back in the same instant
    this.onState({ state: "waiting", seconds: pause / 1000, attempt: this.#attempt, reason });
    this.#timer = this.setTimer(() => this.connect(), pause);
  }

  #drop() {
    this.clearTimer(this.#timer);
    this.clearTimer(this.#quietTimer);
    this.#timer = this.#quietTimer = null;
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
  }
}
