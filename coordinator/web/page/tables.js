// One card for each axis that may have a compensation table: what is added to it now, and what its nodes keep.

import { $, count, figure, make, mark, put, show } from "./dom.js";
import { Cards } from "./nodes.js";

const FIGURES = [
  ["points", "Points"],
  ["correction", "Added"],
  ["side", "Direction"],
  ["nodes", "On nodes"],
];

class TableCard {
  #figures = {};

  constructor(axis) {
    this.path = `tables.${axis}`;
    this.state = make("span", { class: "pill" });
    this.problem = make("p", { class: "message", hidden: "" });
    const figures = make("dl", { class: "figures" });
    for (const [key, label] of FIGURES) {
      this.#figures[key] = make("dd", {}, "–");
      figures.append(make("div", {}, make("dt", {}, label), this.#figures[key]));
    }
    const head = make("header", {}, make("h3", {}, `axis ${axis}`), this.state);
    this.element = make("article", { class: "card unit" }, head, this.problem, figures);
    this.element.dataset.axis = axis;
  }

  sample() {}

  show(fields) {
    const get = (name) => fields.get(`${this.path}.${name}`);
    const points = get("points") ?? 0;
    put(this.state, !points ? "no table" : get("active") ? "corrected" : "waits for homing and standstill");
    mark(this.state, "state", points && get("active") ? "ready" : "");
    show(this.problem, Boolean(get("problem")));
    put(this.problem, get("problem") ?? "");
    put(this.#figures.points, count(points));
    const fading = get("taking_up_um") ? `, ${figure(get("taking_up_um"), 1)} µm of it fade` : "";
    put(this.#figures.correction, `${figure(get("correction_um"), 1)} µm${fading}`);
    put(this.#figures.side, get("side") || "–");
    const all = get("nodes_all");
    put(this.#figures.nodes, all ? `${get("nodes_ok")} of ${all} ok, ${get("nodes_active")} in use` : "none keeps it");
    mark(this.#figures.nodes, "level", all && get("nodes_ok") < all ? "bad" : "");
  }

  draw() {}

  release() {}
}

class TableCards extends Cards {
  sample(fields, now_s) {
    super.sample(fields, now_s);
    show($("tables-part"), fields.names("tables").length > 0);
  }
}

export const table_cards = () => new TableCards("tables", "tables", TableCard);
