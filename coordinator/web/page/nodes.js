// One card for each node: clock, lead, queue, load, link.

import { Histogram, LineChart, SPAN_S } from "./charts.js";
import { $, count, figure, make, mark, percent, put, show } from "./dom.js";
import { Series } from "./fields.js";

const CAPACITY = 2 * SPAN_S + 20; // samples, two a second
const RECENT = 20; // the histogram is of the last 10 s, and of the whole print while nothing moved since
const LABELS = ["late", "<1", "1", "2", "4", "8", "16", "32", "64", "128", "256", "512", "1 s", "2 s", "4 s", "8 s"];
const LEAD_WARN_MS = 64;

class NodeCard {
  #figures = {};
  #bins = []; // of the last RECENT looks
  #offset_s = null; // the first one seen

  constructor(name) {
    this.path = `nodes.${name}`;
    this.offset = new Series(1, CAPACITY);
    this.drift = new Series(1, CAPACITY);
    this.queue = new Series(1, CAPACITY);
    this.load = new Series(1, CAPACITY);
    this.title = make("h3", {}, name);
    this.state = make("span", { class: "pill" });
    this.about = make("small");
    this.failure = make("p", { class: "message", hidden: "" });
    this.charts = {
      drift: new LineChart("Drift, ppm", this.drift, { span: 2 }, 1, "c2"),
      offset: new LineChart("Offset gained, ms", this.offset, { span: 1 }, 2, "c2"),
      queue: new LineChart("Queue", this.queue, { low: 0, span: 10 }, 0, "c1"),
      load: new LineChart("Load, %", this.load, { low: 0, span: 10 }, 0, "c4"),
      lead: new Histogram("Lead of commands, ms", LABELS, 1, 5),
    };
    const figures = make("dl", { class: "figures" });
    for (const [key, label] of [
      ["lead", "Least lead"], ["error", "Clock error"], ["sent", "Sent"], ["repeated", "Sent again"],
      ["trip", "Round trip"], ["task", "Task round"], ["invalid", "Invalid bytes"], ["source", "Clock by"],
    ]) {
      this.#figures[key] = make("dd", {}, "–");
      figures.append(make("div", {}, make("dt", {}, label), this.#figures[key]));
    }
    const charts = make("div", { class: "charts" }, ...Object.values(this.charts).map((chart) => chart.element));
    const head = make("header", {}, this.title, this.state, this.about);
    this.element = make("article", { class: "card unit node" }, head, this.failure, figures, charts);
    this.element.dataset.node = name;
  }

  sample(fields, now_s) {
    const get = (name) => fields.get(`${this.path}.${name}`);
    const offset_s = get("clock_offset_s");
    if (offset_s !== null) this.#offset_s ??= offset_s;
    const moved_ms = offset_s === null ? NaN : (offset_s - this.#offset_s) * 1e3;
    if (Math.abs(moved_ms) > 60_000) this.#offset_s = offset_s; // it was restarted: another clock
    this.offset.push(now_s, [moved_ms]);
    this.drift.push(now_s, [get("clock_drift_ppm") ?? NaN]);
    this.queue.push(now_s, [get("queue_commands") ?? NaN]);
    const awake = get("load_awake");
    this.load.push(now_s, [awake === null ? NaN : awake * 100]);
    this.#bins.push(get("lead_histogram") ?? []);
    if (this.#bins.length > RECENT) this.#bins.shift();
  }

  show(fields) {
    const get = (name) => fields.get(`${this.path}.${name}`);
    put(this.title, get("name") ?? "");
    put(this.state, get("state_text") ?? "");
    mark(this.state, "state", get("state") ?? "");
    put(this.about, about(get));
    const failure = get("failure");
    show(this.failure, failure !== null);
    put(this.failure, failure ?? "");
    this.#show_figures(get);
    this.#show_charts(get);
  }

  #show_figures(get) {
    const fields = this.#figures;
    const lead = get("lead_ms");
    const least = get("lead_min_ms");
    put(fields.lead, lead === null ? (least === null ? "–" : `${figure(least)} ms`) : lead < 0 ? "late" : `${figure(lead)} ms +`);
    mark(fields.lead, "level", lead !== null && lead < 0 ? "bad" : lead !== null && lead < LEAD_WARN_MS ? "warn" : "");
    put(fields.error, get("clock_error_us") === null ? "–" : `± ${figure(get("clock_error_us"))} µs`);
    put(fields.sent, count(get("commands_sent")));
    put(fields.repeated, `${count(get("retransmitted_blocks"))} blocks`);
    mark(fields.repeated, "level", get("retransmitted_blocks") ? "warn" : "");
    put(fields.trip, `${figure(get("round_trip_ms"), 2)} ms`);
    put(fields.task, get("load_task_us") === null ? "–" : `${figure(get("load_task_us"), 1)} µs`);
    put(fields.invalid, count(get("invalid_bytes")));
    mark(fields.invalid, "level", get("invalid_bytes") ? "warn" : "");
    put(fields.source, get("clock_source") ?? "–");
  }

  #show_charts(get) {
    const { charts } = this;
    charts.drift.setText(figure(get("clock_drift_ppm"), 1));
    const offset_s = get("clock_offset_s");
    charts.offset.setText(offset_s === null ? "–" : `${figure((offset_s - this.#offset_s) * 1e3, 2)}`);
    charts.offset.element.title = offset_s === null ? "" : `since the page was opened; in all its clock is ${offset_s.toFixed(6)} s ahead of the computer's`;
    charts.queue.setText(`${count(get("queue_commands"))}, most ${count(get("queue_commands_max"))}`);
    charts.load.setText(percent(get("load_awake"), 1));
    const all = this.#bins.at(-1) ?? [];
    const before = this.#bins[0] ?? [];
    const recent = all.map((value, i) => value - (before[i] ?? 0));
    const moved = recent.some((value) => value > 0);
    charts.lead.bins = moved ? recent : all;
    const least = get("lead_min_ms");
    charts.lead.setText(`${moved ? "last 10 s" : "since the start"}${least === null ? "" : `, least ${figure(least)} ms`}`);
  }

  draw(now_s) {
    for (const chart of Object.values(this.charts)) chart.draw(now_s);
  }

  release() {
    for (const chart of Object.values(this.charts)) chart.release();
  }
}

function about(get) {
  const clock = get("clock_freq_hz");
  return [
    get("mcu"),
    clock ? `${figure(clock / 1e6)} MHz` : null,
    get("firmware") ? `${get("firmware")} ${get("firmware_version") ?? ""}`.trim() : null,
    get("nodeid") === null ? "serial line" : `id ${get("nodeid")}`,
    get("policy") ? `if lost: ${get("policy")}` : null,
  ].filter(Boolean).join(" · ");
}

/** Cards of one kind below PREFIX, made and taken away as they come and go. */
export class Cards {
  #cards = new Map();

  constructor(prefix, into, Card) {
    this.prefix = prefix;
    this.into = $(into);
    this.Card = Card;
  }

  sample(fields, now_s) {
    const names = fields.names(this.prefix);
    for (const [name, card] of this.#cards) {
      if (names.includes(name)) continue;
      card.release();
      card.element.remove();
      this.#cards.delete(name);
    }
    for (const name of names) {
      if (!this.#cards.has(name)) {
        const card = new this.Card(name);
        this.#cards.set(name, card);
        this.into.append(card.element);
      }
      this.#cards.get(name).sample(fields, now_s);
    }
  }

  show(fields, now_s) {
    for (const card of this.#cards.values()) {
      card.show(fields);
      card.draw(now_s);
    }
  }
}

export const node_cards = () => new Cards("nodes", "nodes", NodeCard);
