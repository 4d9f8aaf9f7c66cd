// G-code in; replies and the machine's log out. Bounded: the oldest lines go.

import { $, make } from "./dom.js";

const LINES_MAX = 400;
const HISTORY_MAX = 50;

export class Console {
  #link;
  #last = 0; // number of the newest line of the log
  #history = [];
  #at = 0;
  #started = null;
  #heard = []; // texts of the log since a line was sent

  constructor(link) {
    this.#link = link;
    $("gcode").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send($("line").value.trim());
    });
    $("line").addEventListener("keydown", (event) => this.#recall(event));
    link.addEventListener("notification", (event) => {
      if (event.detail.event === "log") this.#take(event.detail.values);
      else if (event.detail.event === "api.lost") this.#fill();
    });
  }

  set may(may) {
    $("line").disabled = $("send").disabled = !may;
  }

  /** Show what was said meanwhile; STARTED distinguishes one run of the coordinator from another. */
  async begin(started) {
    if (this.#started !== null && this.#started !== started) {
      this.#last = 0;
      this.#add("state", "the coordinator was started again", new Date());
    }
    this.#started = started;
    this.#link.listen(["log"]);
    await this.#fill();
  }

  async #fill() {
    try {
      const reply = await this.#link.call("log.tail", { count: 200, after: this.#last });
      for (const line of reply.lines) this.#take(line);
    } catch (error) {
      if (error.code !== "offline") this.#add("bad", error.message, new Date());
    }
  }

  #take(line) {
    if (line.number <= this.#last) return;
    this.#last = line.number;
    this.#heard.push(line.text);
    if (this.#heard.length > LINES_MAX) this.#heard.shift();
    this.#add(line.kind, line.text, new Date(line.time));
  }

  #add(kind, text, time) {
    const log = $("log");
    const at_end = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
    const clock = time.toLocaleTimeString([], { hour12: false });
    log.append(make("li", { "data-kind": kind }, make("time", { datetime: time.toISOString() }, clock), make("span", {}, text)));
    while (log.childElementCount > LINES_MAX) log.firstElementChild.remove();
    if (at_end) log.scrollTop = log.scrollHeight;
  }

  async #send(script) {
    if (!script) return;
    $("line").value = "";
    this.#history.push(script);
    if (this.#history.length > HISTORY_MAX) this.#history.shift();
    this.#at = this.#history.length;
    this.#add("sent", `> ${script}`, new Date());
    this.#heard = [];
    try {
      const reply = await this.#link.call("gcode.run", { script });
      // The log has it already, unless the line ran while a job did.
      const unheard = (text) => !this.#heard.includes(text);
      for (const text of reply.replies.filter(unheard)) this.#add("reply", text, new Date());
      for (const text of reply.notices.filter(unheard)) this.#add("notice", text, new Date());
    } catch (error) {
      this.#add("bad", error.message, new Date());
    }
  }

  #recall(event) {
    const way = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    if (!way || !this.#history.length) return;
    event.preventDefault();
    this.#at = Math.min(this.#history.length, Math.max(0, this.#at + way));
    $("line").value = this.#history[this.#at] ?? "";
  }
}
