// The emergency stop: a connection of its own that carries nothing else, open from the start. What the page draws,
// asks or waits for cannot stand before it, and the server carries it out while it is received. It is also sent on
// the other connection; whichever is faster wins, the second has no effect. Without a connection, or without an answer,
// it is sent as a request, too: a connection has to be opened first, which takes answers, and a program that hangs
// gives none. It finds the request without them.

import { $, mark, put, show } from "./dom.js";
import { Link, Refusal } from "./link.js";

const PATH = "/emergency-stop";
const DOUBT_MS = 150; // after so long without an answer the stop is sent as a request, too
const AGAIN_MS = 2000; // then another request is sent: the connection of the one before may be dead
const RETRY_MS = 250; // after a request that got nowhere
const GIVE_UP_MS = 10_000; // a stop that could not be sent is not sent later than this: it would surprise
const CONFIRM_MS = 2000; // then the user is warned not to rely on it
const SHOWN_MS = 8000;
const REFUSED = new Set([400, 401, 403]); // it is of no use to send the same again

/** One press of the button; it is over when it, or one after it, is confirmed or given up. */
class Press {
  began_ms = performance.now();
  sent = false; // on a connection
  requested = false;
  confirmed = false;
  over = false;
  #earlier; // they go on: who presses again and again must not end what is on its way
  #cancelled = new AbortController();
  #timers = [];

  constructor(earlier) {
    this.#earlier = earlier?.over ? null : earlier;
  }

  get signal() {
    return this.#cancelled.signal;
  }

  later(after_ms, act) {
    this.#timers.push(setTimeout(() => this.over || act(), after_ms));
  }

  /** Send it no more, by any way. */
  end() {
    this.over = true;
    for (const timer of this.#timers) clearTimeout(timer);
    this.#cancelled.abort();
    this.#earlier?.end();
    this.#earlier = null;
  }
}

export class Stop {
  #own;
  #other;
  #key;
  #press = null; // the last one
  #hiding = 0; // timer
  may = true;

  constructor(other) {
    this.#other = other;
    this.#own = new Link("the live page");
    this.#own.addEventListener("up", (event) => {
      this.may = event.detail.scope !== "watch";
      this.#show();
      if (this.#press && !this.#press.over) this.#send(this.#press);
      else if ($("stop-message").dataset.state === "unsent") this.#fade();
    });
    this.#own.addEventListener("down", () => this.#show());
    this.#own.addEventListener("refused", () => this.#show());
    $("stop").addEventListener("click", () => this.press());
    addEventListener("keydown", (event) => {
      if (event.ctrlKey && event.shiftKey && (event.key === "." || event.key === ":" || event.code === "Period")) {
        event.preventDefault();
        this.press();
      }
    });
  }

  connect(key) {
    this.#key = key;
    this.#own.connect(key);
  }

  press() {
    if (!this.may) {
      this.#announce("refused", "This browser may only watch: the stop was not sent.");
      return;
    }
    const press = new Press(this.#press);
    this.#press = press;
    this.#announce("sending", "Stopping…");
    press.later(CONFIRM_MS, () => this.#fail(press, "NOT confirmed yet. Use the switch on the machine."));
    press.later(GIVE_UP_MS, () => this.#give_up(press));
    if (this.#own.up || this.#other.up) {
      this.#send(press);
      press.later(DOUBT_MS, () => this.#request(press));
    } else {
      if (this.#key !== undefined) this.#own.connect(); // else it would only be refused
      this.#request(press);
    }
  }

  /** Send it on the connections that are open. */
  #send(press) {
    const links = [this.#own, this.#other].filter((link) => link.up);
    press.sent = true;
    Promise.any(links.map((link) => link.call("machine.emergency_stop"))).then(
      () => this.#confirm(press),
      (failure) => {
        this.#fail(press, `NOT confirmed: ${failure.errors[0].message}. Use the switch on the machine.`);
        this.#request(press);
      },
    );
  }

  /** Send it as a request, again and again. */
  #request(press) {
    if (press.over || press.requested) return;
    press.requested = true;
    let next = (after_ms) => {
      next = () => {};
      press.later(after_ms, () => {
        press.requested = false;
        this.#request(press);
      });
    };
    press.later(AGAIN_MS, () => next(0));
    request_stop(this.#key, press.signal).then(
      () => this.#confirm(press),
      (failure) => {
        if (failure instanceof Refusal) {
          next = () => {};
          this.#fail(press, `NOT stopped: ${failure.message}. Use the switch on the machine.`);
        } else {
          if (!press.sent) this.#fail(press, "NOT stopped: the machine cannot be reached. Use the switch on the machine.");
          next(RETRY_MS);
        }
      },
    );
  }

  #confirm(press) {
    press.end();
    if (press !== this.#press || press.confirmed) return;
    press.confirmed = true;
    this.#announce("done", `All nodes were told to stop, ${Math.ceil(performance.now() - press.began_ms)} ms after you asked.`);
  }

  #fail(press, text) {
    if (press === this.#press && !press.over) this.#announce("unsent", text);
  }

  #give_up(press) {
    this.#fail(press, "NOT confirmed, and the stop is not sent any more. Use the switch on the machine, or press again.");
    press.end();
  }

  #announce(state, text) {
    clearTimeout(this.#hiding);
    const line = $("stop-message");
    put(line, text);
    mark(line, "state", state);
    show(line, true);
    if (state === "done" || state === "refused") this.#fade();
  }

  #fade() {
    clearTimeout(this.#hiding);
    this.#hiding = setTimeout(() => show($("stop-message"), false), SHOWN_MS);
  }

  #show() {
    const button = $("stop");
    mark(button, "line", this.#own.up ? "up" : "down");
    button.title = this.may
      ? "Stops every node at once (Ctrl + Shift + .)"
      : "This browser may only watch";
    button.setAttribute("aria-disabled", String(!this.may));
  }
}

/** Stop the machine without a connection; rejects with a Refusal, or, if no answer comes, with another error. */
async function request_stop(key, signal) {
  const answer = await fetch(PATH, {
    method: "POST",
    body: JSON.stringify({ key: key ?? "" }),
    cache: "no-store",
    credentials: "same-origin",
    keepalive: true, // also when the page is closed at once
    signal,
  });
  const told = await answer.json();
  if (answer.ok && told.state) return;
  if (REFUSED.has(answer.status)) throw new Refusal(told.code, told.message);
  throw new Error(`the answer has the status ${answer.status}`);
}
