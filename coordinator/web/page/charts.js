// Three small charts: lines over time, areas stacked over time, and a histogram.

import { Sheet } from "./canvas.js";
import { figure, make, put } from "./dom.js";
import { colour } from "./theme.js";

export const SPAN_S = 120;
const GAP_S = 3; // samples further apart are not joined
const FONT = "11px system-ui, sans-serif";

class Chart {
  constructor(title, class_name = "") {
    this.canvas = make("canvas", { role: "img", "aria-label": title });
    this.value = make("b", {}, "–");
    this.element = make("figure", { class: class_name }, make("figcaption", {}, title, this.value), this.canvas);
    this.title = title;
    this.sheet = new Sheet(this.canvas);
  }

  /** Show TEXT next to the title, and to those who do not see the chart. */
  setText(text) {
    put(this.value, text);
    this.canvas.setAttribute("aria-label", `${this.title}: ${text}`);
  }

  begin() {
    const { context, width, height } = this.sheet;
    context.clearRect(0, 0, width, height);
    context.font = FONT;
    context.lineJoin = "round";
    return context;
  }

  /** Write the scale: HIGH at the top, LOW at the bottom. */
  scale(high, low) {
    const { context, height } = this.sheet;
    context.fillStyle = colour("dim");
    context.textAlign = "left";
    context.textBaseline = "top";
    context.fillText(high, 5, 4);
    context.textBaseline = "bottom";
    context.fillText(low, 5, height - 3);
  }

  release() {
    this.sheet.release();
  }
}

/** One line of SERIES. RANGE: {low, high} to hold at least, {span} the least difference of both ends. */
export class LineChart extends Chart {
  constructor(title, series, range, digits = 0, line_colour = "c1") {
    super(title);
    this.series = series;
    this.range = range;
    this.digits = digits;
    this.colour = line_colour;
  }

  draw(now_s) {
    if (!this.sheet.visible) return;
    const context = this.begin();
    const { width, height } = this.sheet;
    const [low, high] = this.#limits(now_s);
    const x = (t) => width * (1 - (now_s - t) / SPAN_S);
    const y = (v) => height - 4 - ((height - 8) * (v - low)) / (high - low);
    context.strokeStyle = colour("grid");
    context.lineWidth = 1;
    context.beginPath();
    for (const share of [0, 0.5, 1]) {
      const at = Math.round(y(low + (high - low) * share)) + 0.5;
      context.moveTo(0, at);
      context.lineTo(width, at);
    }
    context.stroke();
    context.strokeStyle = colour(this.colour);
    context.lineWidth = 1.6;
    context.beginPath();
    let before_s = -Infinity;
    this.#each(now_s, (t, v) => {
      if (t - before_s > GAP_S) context.moveTo(x(t), y(v));
      else context.lineTo(x(t), y(v));
      before_s = t;
    });
    context.stroke();
    this.scale(figure(high, this.digits), figure(low, this.digits));
  }

  #each(now_s, use) {
    const { series } = this;
    for (let i = 0; i < series.length; i++) {
      const at = series.at(i);
      const [t, v] = [series.times_s[at], series.lines[0][at]];
      if (t > now_s - SPAN_S - GAP_S && !Number.isNaN(v)) use(t, v);
    }
  }

  #limits(now_s) {
    let [low, high] = [this.range.low ?? Infinity, this.range.high ?? -Infinity];
    this.#each(now_s, (_, v) => {
      low = Math.min(low, v);
      high = Math.max(high, v);
    });
    if (low > high) return [0, this.range.span ?? 1];
    const lacking = (this.range.span ?? 0) - (high - low);
    if (lacking > 0) {
      high += this.range.low === undefined ? lacking / 2 : lacking;
      low -= this.range.low === undefined ? lacking / 2 : 0;
    }
    return [low, high];
  }
}

/** The lines of SERIES stacked, as shares of 1; the scale ends at 100 %, 50 % or 10 %, as is needed. */
export class StackChart extends Chart {
  constructor(title, series, colours) {
    super(title);
    this.series = series;
    this.colours = colours;
  }

  draw(now_s) {
    if (!this.sheet.visible) return;
    const context = this.begin();
    const { width, height } = this.sheet;
    const samples = this.#samples(now_s);
    const most = samples.reduce((m, s) => Math.max(m, s.sums.at(-1)), 0);
    const top = [0.05, 0.1, 0.25, 0.5, 1].find((t) => most <= t * 0.95) ?? Math.max(1, most);
    const x = (t) => width * (1 - (now_s - t) / SPAN_S);
    const y = (v) => height - (height * v) / top;
    context.strokeStyle = colour("grid");
    context.beginPath();
    for (const share of [0.25, 0.5, 0.75]) {
      const at = Math.round(height * share) + 0.5;
      context.moveTo(0, at);
      context.lineTo(width, at);
    }
    context.stroke();
    for (const run of runs(samples)) {
      for (let line = this.colours.length - 1; line >= 0; line--) {
        context.fillStyle = colour(this.colours[line]);
        context.beginPath();
        context.moveTo(x(run[0].t), y(0));
        for (const sample of run) context.lineTo(x(sample.t), y(sample.sums[line]));
        context.lineTo(x(run.at(-1).t), y(0));
        context.fill();
      }
    }
    this.scale(`${figure(top * 100)} %`, `${SPAN_S / 60} min ago`);
  }

  #samples(now_s) {
    const { series } = this;
    const samples = [];
    for (let i = 0; i < series.length; i++) {
      const at = series.at(i);
      const t = series.times_s[at];
      if (t < now_s - SPAN_S - GAP_S || Number.isNaN(series.lines[0][at])) continue;
      let sum = 0;
      samples.push({ t, sums: series.lines.map((line) => (sum += line[at] || 0)) });
    }
    return samples;
  }
}

/** Split samples where time jumps. */
function runs(samples) {
  const found = [];
  for (const sample of samples) {
    if (found.length && sample.t - found.at(-1).at(-1).t <= GAP_S) found.at(-1).push(sample);
    else found.push([sample]);
  }
  return found;
}

/** Bars of what RECENT counts; BAD: so many bins from the left are drawn as bad, then WARN as doubtful. */
export class Histogram extends Chart {
  constructor(title, labels, bad, warn) {
    super(title, "whole");
    this.labels = labels;
    this.bad = bad;
    this.warn = warn;
    this.bins = [];
  }

  draw() {
    if (!this.sheet.visible) return;
    const context = this.begin();
    const { width, height } = this.sheet;
    const bins = this.bins;
    const sum = bins.reduce((a, b) => a + b, 0);
    const most = Math.max(1, ...bins);
    const step = width / Math.max(1, this.labels.length);
    context.textAlign = "center";
    for (let i = 0; i < this.labels.length; i++) {
      const value = bins[i] ?? 0;
      // Few late commands among many are what one looks for: a bar that is there can be seen.
      const tall = value ? Math.max(3, ((height - 20) * value) / most) : 0;
      context.fillStyle = colour(i < this.bad ? "bad" : i < this.bad + this.warn ? "warn" : "c1");
      context.fillRect(i * step + 1.5, height - 15 - tall, step - 3, tall);
      context.fillStyle = colour("dim");
      context.textBaseline = "bottom";
      context.fillText(this.labels[i], (i + 0.5) * step, height - 2);
    }
    if (!sum) {
      context.textBaseline = "top";
      context.fillText("no motion yet", width / 2, 12);
    }
  }
}
