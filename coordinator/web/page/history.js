// The jobs that ended lately.

import { $, duration, figure, make } from "./dom.js";

const SHOWN_MAX = 50;

export class History {
  #link;

  constructor(link) {
    this.#link = link;
    $("history").addEventListener("toggle", () => this.list());
  }

  /** Ask again, if anybody looks. */
  async list() {
    if (!$("history").open || !this.#link.up) return;
    let jobs = [];
    try {
      ({ jobs } = await this.#link.call("job.history"));
    } catch {
      return; // it is asked again with the next connection
    }
    const entries = jobs.slice(0, SHOWN_MAX).map((job) => {
      const when = new Date(job.ended_s * 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" });
      const facts = `${when} · ${duration(job.elapsed_s)} · ${figure(job.filament_mm / 1000, 2)} m`;
      const state = make("span", { class: "pill", "data-state": job.state }, job.state);
      return make("li", { title: job.message }, make("b", {}, job.file), state, make("small", {}, facts));
    });
    $("history-jobs").replaceChildren(...(entries.length ? entries : [make("li", {}, "no job has ended yet")]));
  }
}
