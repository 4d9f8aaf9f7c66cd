// Moves by hand: home, jog, extrude, motors off.

import { $, put, show } from "./dom.js";

const SPEED_MM_S = { x: 60, y: 60, z: 8, e: 4 };

export class Move {
  #link;
  #may = false;
  #distance_mm = 10;

  constructor(link) {
    this.#link = link;
    for (const button of document.querySelectorAll("#move-step button")) {
      button.addEventListener("click", () => this.#choose(button));
    }
    for (const button of document.querySelectorAll("#move [data-jog]")) {
      const [axis, sign] = [button.dataset.jog[0], button.dataset.jog[1] === "+" ? 1 : -1];
      button.addEventListener("click", () => {
        this.#call("move.by", { [axis]: sign * this.#distance_mm, speed_mm_s: SPEED_MM_S[axis] });
      });
    }
    for (const button of document.querySelectorAll("#move [data-home]")) {
      button.addEventListener("click", () => this.#call("move.home", { axes: button.dataset.home }));
    }
    $("motors-off").addEventListener("click", () => this.#call("gcode.run", { script: "M84" }));
  }

  set may(may) {
    this.#may = may;
  }

  show(fields, machine_state) {
    const may = this.#may && this.#link.up && (machine_state === "ready" || machine_state === "paused");
    const homed = fields.get("position.homed") || "";
    for (const button of document.querySelectorAll("#move [data-jog]")) {
      const axis = button.dataset.jog[0];
      const lost = axis !== "e" && !homed.includes(axis.toUpperCase());
      button.disabled = !may || lost;
      button.title = may && lost ? `home ${axis.toUpperCase()} first` : "";
    }
    for (const button of document.querySelectorAll("#move [data-home], #motors-off")) button.disabled = !may;
  }

  #choose(chosen) {
    this.#distance_mm = Number(chosen.value);
    for (const button of document.querySelectorAll("#move-step button")) {
      button.setAttribute("aria-pressed", String(button === chosen));
    }
  }

  async #call(method, params) {
    try {
      await this.#link.call(method, params);
      show($("move-message"), false);
    } catch (error) {
      put($("move-message"), error.message);
      show($("move-message"), true);
    }
  }
}
