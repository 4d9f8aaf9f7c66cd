// The emergency stop: a connection of its own that carries nothing else, open from the start. What the page draws,
// asks or waits for cannot stand before it, and the server carries it out while it is received. It is also sent on
// the other connection; whichever is faster wins, the second has no effect.

import { $, mark, put, show } from "./dom.js";
import { Link } from "./link.js";

const GIVE_UP_MS = 10_000; // a stop that could not be sent is not sent later than this: it would surprise
const CONFIRM_MS = 2000; // then the user is warned not to rely on it
const SHOWN_MS = 8000;

export class Stop {
  #own;
  #other;
  #pressed_ms = null; // a stop that could not be sent yet
  #given_up = 0; // timer
  #hiding = 0; // timer
  may = true;

  constructor(other) {
    this.#other = other;
    this.#own = new Link("the live page");
    this.#own.addEventListener("up", (event) => {
      this.may = event.detail.scope !== "watch";
      this.#show();
      if (this.#pressed_ms !== null) this.#send();
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
    this.#own.connect(key);
  }

  press() {
    if (!this.may) {
      this.#announce("refused", "This browser may only watch: the stop was not sent.");
      return;
    }
    this.#pressed_ms = performance.now();
    clearTimeout(this.#given_up);
    this.#announce("sending", "Stopping…");
    if (this.#own.up || this.#other.up) {
      this.#send();
      return;
    }
    this.#announce("unsent", "NOT stopped: the machine cannot be reached. Use the switch on the machine.");
    this.#own.connect();
    this.#given_up = setTimeout(() => {
      this.#pressed_ms = null;
      this.#announce("unsent", "NOT stopped: the machine could not be reached, and the stop is not sent any more. Press again.");
    }, GIVE_UP_MS);
  }

  #send() {
    const began_ms = this.#pressed_ms;
    this.#pressed_ms = null;
    clearTimeout(this.#given_up);
    if (began_ms === null || performance.now() - began_ms > GIVE_UP_MS) return;
    const links = [this.#own, this.#other].filter((link) => link.up);
    const asked = links.map((link) => link.call("machine.emergency_stop"));
    const late = setTimeout(() => {
      this.#announce("unsent", "NOT confirmed yet. Use the switch on the machine.");
    }, CONFIRM_MS);
    const settled = () => clearTimeout(late);
    Promise.any(asked).finally(settled).then(
      () => this.#announce("done", `All nodes were told to stop, ${Math.ceil(performance.now() - began_ms)} ms after you asked.`),
      (failure) => this.#announce("unsent", `NOT confirmed: ${failure.errors[0].message}. Use the switch on the machine.`),
    );
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
