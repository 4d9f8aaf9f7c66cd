// One client of the machine's interface (docs/ipc.md): hello, requests, watching, notifications; comes back by itself.
// Events: "up" (detail: the hello's result), "down" (detail: {message, retry_ms}), "refused" (this browser has to sign
// in), "notification" (detail: {event, values}).

const RETRY_MS = [250, 500, 1000, 2000, 3000];
const PING_MS = 3000; // asked so often whether anybody is there
const SILENCE_MS = 8000; // nothing heard for so long: the connection is dead, whatever the browser thinks
const REQUESTS_MAX = 200; // without an answer; further ones fail at once
const SIGN_IN_CODES = new Set(["no_token", "bad_token"]);
const UNAUTHORIZED = 401;

export class Refusal extends Error {
  constructor(code, message) {
    super(message);
    this.code = code;
  }
}

function unreachable() {
  return new Refusal("offline", "the machine cannot be reached at the moment");
}

export class Link extends EventTarget {
  #client;
  #key;
  #socket = null;
  #opened = false;
  #up = false;
  #next_id = 1;
  #open = new Map(); // id → {resolve, reject}
  #watches = new Map(); // key → {fields, rate_hz, on_update, subscription, sequence}
  #events = [];
  #tries = 0;
  #retry = 0; // timer
  #heard_ms = 0;
  #fault = null; // why the server ended it

  constructor(client) {
    super();
    this.#client = client;
    setInterval(() => this.#look(), PING_MS);
  }

  get up() {
    return this.#up;
  }

  /** Connect now, with the KEY of another session if one is given. */
  connect(key) {
    if (key !== undefined) this.#key = key;
    clearTimeout(this.#retry);
    this.#close();
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/socket`);
    this.#socket = socket;
    this.#opened = false;
    this.#fault = null;
    this.#heard_ms = performance.now();
    socket.onopen = () => {
      if (socket === this.#socket) this.#opened = true;
      this.#hello(socket);
    };
    socket.onmessage = (message) => {
      if (socket === this.#socket) this.#receive(message.data);
    };
    socket.onclose = () => {
      if (socket === this.#socket) this.#lost();
    };
  }

  /** Ask; resolves to the result, rejects with a Refusal. */
  call(method, params = {}) {
    if (!this.#up) return Promise.reject(unreachable());
    return this.#request(method, params);
  }

  /** Watch FIELDS (globs); ON_UPDATE(values, removed, snapshot). Goes on after a loss, with a snapshot. */
  watch(key, fields, rate_hz, on_update) {
    this.unwatch(key);
    const watch = { fields, rate_hz, on_update, subscription: null, sequence: 0 };
    this.#watches.set(key, watch);
    if (this.#up) this.#begin(watch);
  }

  unwatch(key) {
    const watch = this.#watches.get(key);
    this.#watches.delete(key);
    if (watch?.subscription && this.#up) {
      this.#request("api.unwatch", { subscription: watch.subscription }).catch(() => {});
    }
  }

  /** Ask for notifications, now and after every loss. */
  listen(events) {
    this.#events = events;
    if (this.#up) this.#request("api.listen", { events }).catch(() => {});
  }

  // ------------------------------------------------------------------------------------------------- inside

  #emit(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  #request(method, params) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return Promise.reject(unreachable()); // its close event is on the way
    if (this.#open.size >= REQUESTS_MAX) return Promise.reject(new Refusal("busy", "too many requests wait"));
    const id = this.#next_id++;
    return new Promise((resolve, reject) => {
      this.#open.set(id, { resolve, reject });
      this.#socket.send(JSON.stringify({ id, method, params }));
    });
  }

  async #hello(socket) {
    let hello;
    try {
      hello = await this.#request("api.hello", { version: 1, client: this.#client, token: this.#key ?? "" });
    } catch {
      return; // the close that follows has the reason
    }
    if (socket !== this.#socket) return;
    this.#up = true;
    this.#tries = 0;
    if (this.#events.length) this.listen(this.#events);
    for (const watch of this.#watches.values()) this.#begin(watch);
    this.#emit("up", hello);
  }

  async #begin(watch) {
    watch.subscription = null;
    try {
      const taken = await this.#request("api.watch", { fields: watch.fields, rate_hz: watch.rate_hz });
      if (![...this.#watches.values()].includes(watch)) {
        this.#request("api.unwatch", { subscription: taken.subscription }).catch(() => {});
        return;
      }
      watch.subscription = taken.subscription;
      watch.sequence = taken.sequence;
      watch.on_update(taken.values, [], true);
    } catch (error) {
      if (error.code !== "offline") console.warn(`watching: ${error.message}`);
    }
  }

  #receive(text) {
    this.#heard_ms = performance.now();
    for (const line of text.split("\n")) {
      if (line) this.#take(JSON.parse(line));
    }
  }

  #take(message) {
    if (message.event === "state") this.#update(message);
    else if (message.event) this.#emit("notification", message);
    else if (message.id === undefined) this.#fault = message.error ?? null;
    else {
      const request = this.#open.get(message.id);
      this.#open.delete(message.id);
      if (!request) return;
      if (message.error) request.reject(new Refusal(message.error.code, message.error.message));
      else request.resolve(message.result);
    }
  }

  #update(message) {
    for (const watch of this.#watches.values()) {
      if (watch.subscription !== message.subscription) continue;
      if (message.since !== watch.sequence && !message.snapshot) {
        this.#request("api.unwatch", { subscription: message.subscription }).catch(() => {});
        this.#begin(watch); // one was lost
        return;
      }
      watch.sequence = message.sequence;
      watch.on_update(message.values, message.removed, message.snapshot);
    }
  }

  #look() {
    if (!this.#socket) return;
    if (performance.now() - this.#heard_ms > SILENCE_MS) this.#lost();
    else if (this.#up) this.#request("api.ping", {}).catch(() => {});
  }

  #close() {
    const socket = this.#socket;
    this.#socket = null;
    this.#up = false;
    if (socket) socket.close();
    const lost = new Refusal("offline", "the connection was lost before the answer came");
    for (const request of this.#open.values()) request.reject(lost);
    this.#open.clear();
  }

  async #lost() {
    const opened = this.#opened;
    this.#close();
    const has_to_sign_in = this.#fault ? SIGN_IN_CODES.has(this.#fault.code) : !opened && (await is_stranger());
    if (this.#socket) return; // another attempt was made meanwhile
    if (has_to_sign_in) {
      this.#emit("refused");
      return;
    }
    const retry_ms = RETRY_MS[Math.min(this.#tries++, RETRY_MS.length - 1)];
    this.#retry = setTimeout(() => this.connect(), retry_ms);
    this.#emit("down", { message: this.#fault?.message ?? "", retry_ms });
  }
}

/** Return whether the server is there and does not know this browser: of a WebSocket the browser does not say why. */
async function is_stranger() {
  try {
    return (await fetch("/session", { cache: "no-store" })).status === UNAUTHORIZED;
  } catch {
    return false;
  }
}
