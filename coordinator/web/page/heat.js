// Temperatures and fans: what they are, over the last minutes, and what they shall be.

import { Sheet } from "./canvas.js";
import { $, figure, make, percent, put, show } from "./dom.js";
import { Series } from "./fields.js";
import { colour } from "./theme.js";

const SPAN_S = 600;
const SAMPLE_S = 1;
const GAP_S = 5; // samples further apart are not joined
const STEP_C = 50; // the scale ends at a multiple of this
const COLOURS = ["c1", "c6", "c5", "c4", "c2", "c3"];
const FONT = "11px system-ui, sans-serif";
const PREFIXES = ["heater_generic_", "temperature_sensor_", "temperature_fan_", "fan_generic_", "heater_fan_", "controller_fan_"];
const PWM_MAX = 255;

/** Return what the fields of the module NAME make of it: heater, sensor, temperature fan or fan; null: none of them. */
export function kind_of(fields, name) {
  const has = (field) => fields.has(`modules.${name}.${field}`);
  if (has("temperature")) return has("power") && has("target") ? "heater" : has("speed") ? "temperature fan" : "sensor";
  return has("speed") && has("rpm") ? "fan" : null;
}

/** Return the name people gave it, without that of its section. */
export function own_name(name) {
  if (name === "heater_bed") return "bed";
  const prefix = PREFIXES.find((start) => name.startsWith(start));
  return prefix ? name.slice(prefix.length) : name;
}

/** Return the line of g-code that sets module NAME of KIND to VALUE (°C, or a speed from 0 to 1); null: it cannot be set. */
export function line_to_set(kind, name, value) {
  const own = own_name(name);
  if (kind === "heater") return `SET_HEATER_TEMPERATURE HEATER=${name === "heater_bed" ? name : own} TARGET=${value}`;
  if (kind === "temperature fan") return `SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=${own} TARGET=${value}`;
  if (name === "fan") return `M106 S${Math.round(value * PWM_MAX)}`;
  return name.startsWith("fan_generic_") ? `SET_FAN_SPEED FAN=${own} SPEED=${value}` : null;
}

/** Return what a program waits for, such as "heating: extruder, 134 of 210 °C"; "" when it waits for no temperature. */
export function waits_for(fields) {
  const wanted = fields.get("modules.heaters.waiting_for");
  if (!wanted) return "";
  const found = fields.names("modules").find((name) => name === wanted.name || own_name(name) === own_name(wanted.name.replace(" ", "_")));
  const now = fields.get(`modules.${found}.temperature`);
  const cools = wanted.maximum !== null && now !== null && now > wanted.maximum;
  const target = cools ? wanted.maximum : (wanted.minimum ?? wanted.maximum);
  return `${cools ? "cooling" : "heating"}: ${own_name(wanted.name)}, ${figure(now)} of ${figure(target)} °C`;
}

class Row {
  constructor(kind, name, line_colour, set) {
    this.kind = kind;
    this.name = name;
    this.colour = line_colour;
    this.series = new Series(2, SPAN_S / SAMPLE_S + 20);
    const label = own_name(name);
    const dot = make("i", { "aria-hidden": "true" });
    if (line_colour) dot.style.background = `var(--${line_colour})`;
    this.value = make("b", {}, "–");
    this.detail = make("small");
    this.element = make("div", { class: "heat-row", "data-name": name }, line_colour ? dot : null, make("span", { class: "grow" }, label), this.value, this.detail);
    if (kind === "heater" || kind === "temperature fan") this.#add_target(label, set);
    else if (kind === "fan" && line_to_set(kind, name, 0)) this.#add_slider(label, set);
  }

  #add_target(label, set) {
    this.input = make("input", { type: "number", min: 0, step: 1, inputmode: "decimal", "aria-label": `Target of ${label}, °C`, placeholder: "°C" });
    this.button = make("button", { type: "submit", class: "small" }, "Set");
    const form = make("form", { class: "row", novalidate: "" }, this.input, this.button);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const target = this.input.valueAsNumber;
      if (Number.isFinite(target)) set(line_to_set(this.kind, this.name, target));
      this.input.value = "";
    });
    this.element.append(form);
  }

  #add_slider(label, set) {
    this.input = make("input", { type: "range", min: 0, max: 100, step: 5, "aria-label": `Speed of ${label}, %` });
    this.input.addEventListener("change", () => set(line_to_set(this.kind, this.name, this.input.valueAsNumber / 100)));
    this.element.append(this.input);
  }

  show(fields, may) {
    const get = (field) => fields.get(`modules.${this.name}.${field}`);
    if (this.kind === "fan") {
      put(this.value, percent(get("speed")));
      put(this.detail, get("rpm") === null ? "" : `${figure(get("rpm"))} rpm`);
      if (this.input && document.activeElement !== this.input) this.input.value = Math.round(get("speed") * 100);
    } else {
      put(this.value, `${figure(get("temperature"), 1)} °C`);
      const target = get("target");
      const power = get("power") ?? get("speed");
      put(this.detail, target === null ? "" : target > 0 ? `to ${figure(target)} °C, ${percent(power)}` : "off");
    }
    if (this.input) this.input.disabled = !may;
    if (this.button) this.button.disabled = !may;
  }
}

export class Heat {
  #link;
  #may = false;
  #rows = [];
  #names = "";
  #sampled_s = -Infinity;

  constructor(link) {
    this.#link = link;
    this.canvas = $("heat-chart");
    this.sheet = new Sheet(this.canvas);
    $("heat-off").addEventListener("click", () => this.#run("TURN_OFF_HEATERS"));
  }

  set may(may) {
    this.#may = may;
  }

  /** Return the heaters whose target is above 0, by their own names. */
  hot(fields) {
    return this.#rows.filter((row) => row.kind === "heater" && fields.get(`modules.${row.name}.target`) > 0).map((row) => own_name(row.name));
  }

  turn_off() {
    return this.#run("TURN_OFF_HEATERS");
  }

  sample(fields, now_s) {
    if (now_s - this.#sampled_s < SAMPLE_S) return;
    this.#sampled_s = now_s;
    for (const row of this.#rows) {
      if (row.kind === "fan") continue;
      row.series.push(now_s, [fields.get(`modules.${row.name}.temperature`), fields.get(`modules.${row.name}.target`) || NaN]);
    }
  }

  show(fields, now_s) {
    const found = fields.names("modules").map((name) => [kind_of(fields, name), name]).filter(([kind]) => kind);
    const names = found.map(([kind, name]) => `${kind} ${name}`).join("\n");
    if (names !== this.#names) this.#build(found, names);
    show($("heat"), found.length > 0);
    const may = this.#may && this.#link.up;
    for (const row of this.#rows) row.show(fields, may);
    const hot = this.hot(fields);
    $("heat-off").disabled = !(may && hot.length);
    this.#draw(now_s);
    const measured = this.#rows.filter((row) => row.kind !== "fan");
    this.canvas.setAttribute("aria-label", `Temperatures over 10 minutes: ${measured.map((row) => `${own_name(row.name)} ${row.value.textContent}`).join(", ") || "none"}`);
  }

  #build(found, names) {
    this.#names = names;
    const order = ["heater", "temperature fan", "sensor", "fan"];
    found.sort((a, b) => order.indexOf(a[0]) - order.indexOf(b[0]));
    const known = new Map(this.#rows.map((row) => [`${row.kind} ${row.name}`, row]));
    let next = 0;
    this.#rows = found.map(([kind, name]) => {
      const line_colour = kind === "fan" ? null : COLOURS[next++ % COLOURS.length];
      return known.get(`${kind} ${name}`) ?? new Row(kind, name, line_colour, (line) => this.#run(line));
    });
    $("heat-rows").replaceChildren(...this.#rows.map((row) => row.element));
  }

  async #run(script) {
    try {
      await this.#link.call("gcode.run", { script });
      show($("heat-message"), false);
    } catch (error) {
      put($("heat-message"), error.message);
      show($("heat-message"), true);
    }
  }

  // ---------------------------------------------------------------------------------------------- painting

  #draw(now_s) {
    if (!this.sheet.visible) return;
    const { context, width, height } = this.sheet;
    const lines = this.#rows.filter((row) => row.kind !== "fan");
    const highest = lines.reduce((most, row) => Math.max(most, peak(row.series, now_s)), STEP_C - 1);
    const top = STEP_C * Math.ceil((highest + 1) / STEP_C);
    const x = (t) => width * (1 - (now_s - t) / SPAN_S);
    const y = (celsius) => height - 2 - ((height - 6) * celsius) / top;
    context.clearRect(0, 0, width, height);
    context.strokeStyle = colour("grid");
    context.lineWidth = 1;
    context.beginPath();
    const every = top > 4 * STEP_C ? 2 * STEP_C : STEP_C;
    for (let celsius = 0; celsius <= top; celsius += every) {
      context.moveTo(0, Math.round(y(celsius)) + 0.5);
      context.lineTo(width, Math.round(y(celsius)) + 0.5);
    }
    context.stroke();
    for (const row of lines) {
      context.strokeStyle = colour(row.colour);
      for (const [line, wide, dash] of [[1, 1, [5, 5]], [0, 1.8, []]]) {
        context.lineWidth = wide;
        context.setLineDash(dash);
        context.beginPath();
        trace(context, row.series, line, now_s, x, y);
        context.stroke();
      }
    }
    context.setLineDash([]);
    context.font = FONT;
    context.fillStyle = colour("dim");
    context.textBaseline = "top";
    context.textAlign = "left";
    context.fillText(`${top} °C`, 5, 5);
    context.textBaseline = "bottom";
    context.fillText(`${SPAN_S / 60} min ago`, 5, height - 4);
  }
}

function peak(series, now_s) {
  let most = 0;
  for (let i = 0; i < series.length; i++) {
    const at = series.at(i);
    if (series.times_s[at] < now_s - SPAN_S) continue;
    for (const line of series.lines) if (line[at] > most) most = line[at];
  }
  return most;
}

function trace(context, series, line, now_s, x, y) {
  let before_s = -Infinity;
  for (let i = 0; i < series.length; i++) {
    const at = series.at(i);
    const [t, value] = [series.times_s[at], series.lines[line][at]];
    if (t < now_s - SPAN_S - GAP_S || Number.isNaN(value)) continue;
    if (t - before_s > GAP_S) context.moveTo(x(t), y(value));
    else context.lineTo(x(t), y(value));
    before_s = t;
  }
}
