// One card for each bus: load by class over time, and what went wrong.

import { SPAN_S, StackChart } from "./charts.js";
import { count, make, mark, percent, put, show } from "./dom.js";
import { Series } from "./fields.js";
import { Cards } from "./nodes.js";

const CLASSES = [
  ["motion", "motion", "c1"],
  ["control", "control", "c2"],
  ["bulk", "bulk", "c3"],
  ["acks", "acks received", "c4"],
  ["data", "data received", "c5"],
  ["weak", "others", "c6"],
];
const SERIAL_COUNTERS = [
  ["bytes_sent", "Bytes sent"],
  ["bytes_received", "Bytes received"],
];
const COUNTERS = [
  ["frames_sent", "Sent"],
  ["frames_received", "Received"],
  ["send_waits", "Waits"],
  ["frames_malformed", "Malformed", true],
  ["frames_dropped", "Dropped", true],
];

class BusCard {
  #figures = {};
  #keys = {};

  constructor(name) {
    this.path = `buses.${name}`;
    this.load = new Series(CLASSES.length, 2 * SPAN_S + 20);
    this.title = make("h3", {}, name);
    this.about = make("small");
    this.chart = new StackChart("Load by class", this.load, CLASSES.map(([, , colour]) => colour));
    const keys = make("ul", { class: "keys" });
    for (const [key, label, colour] of CLASSES) {
      this.#keys[key] = make("b", {}, "–");
      const dot = make("i");
      dot.style.background = `var(--${colour})`;
      keys.append(make("li", {}, dot, `${label} `, this.#keys[key]));
    }
    const figures = make("dl", { class: "figures" });
    for (const [key, label] of [...COUNTERS, ...SERIAL_COUNTERS]) {
      this.#figures[key] = make("dd", {}, "–");
      figures.append(make("div", {}, make("dt", {}, label), this.#figures[key]));
    }
    this.keys = keys;
    const head = make("header", {}, this.title, this.about);
    this.element = make("article", { class: "card unit bus" }, head, this.chart.element, keys, figures);
  }

  sample(fields, now_s) {
    this.load.push(now_s, CLASSES.map(([key]) => fields.get(`${this.path}.load_${key}`) ?? NaN));
  }

  show(fields) {
    const get = (name) => fields.get(`${this.path}.${name}`);
    const name = get("name") ?? "";
    put(this.title, name.split("/").at(-1) || name);
    this.title.title = name;
    const bitrate = get("bitrate");
    put(this.about, bitrate ? `${name} · ${count(bitrate / 1000)} kbit/s` : `${name} · its bit rate is not known, so there is no load`);
    show(this.chart.element, Boolean(bitrate));
    show(this.keys, Boolean(bitrate));
    this.element.style.order = bitrate ? 0 : 1;
    this.chart.setText(bitrate ? percent(get("load_total"), 1) : "–");
    for (const [key] of CLASSES) put(this.#keys[key], bitrate ? percent(get(`load_${key}`), 1) : "–");
    const is_serial = !get("frames_received") && get("bytes_received") > 0; // its frames are not counted, its bytes are
    for (const [key, , is_bad] of COUNTERS) {
      put(this.#figures[key], count(get(key)));
      if (is_bad) mark(this.#figures[key], "level", get(key) ? "bad" : "");
      show(this.#figures[key].parentElement, !is_serial || key === "send_waits");
    }
    for (const [key] of SERIAL_COUNTERS) {
      put(this.#figures[key], count(get(key)));
      show(this.#figures[key].parentElement, is_serial);
    }
  }

  draw(now_s) {
    this.chart.draw(now_s);
  }

  release() {
    this.chart.release();
  }
}

export const bus_cards = () => new Cards("buses", "buses", BusCard);
