// The machine's macros, a button each.

import { $, make, mark, put, show } from "./dom.js";

const MACROS_MAX = 200;

export class Macros {
  #link;
  #may = false;

  constructor(link) {
    this.#link = link;
  }

  set may(may) {
    this.#may = may;
  }

  /** Ask which there are; those whose name begins with _ are for other macros. */
  async list() {
    const { macros } = await this.#link.call("gcode.macros");
    const shown = macros.filter((macro) => !macro.name.startsWith("_")).slice(0, MACROS_MAX);
    const buttons = shown.map((macro) => {
      const button = make("button", { type: "button", title: macro.help }, macro.name);
      button.addEventListener("click", () => this.#run(button, macro.name));
      return button;
    });
    $("macro-buttons").replaceChildren(...buttons);
    show($("macros"), buttons.length > 0);
  }

  show() {
    const may = this.#may && this.#link.up;
    for (const button of $("macro-buttons").children) button.disabled = !may || button.dataset.runs === "true";
  }

  async #run(button, name) {
    mark(button, "runs", "true");
    this.show();
    try {
      await this.#link.call("gcode.run", { script: name });
      show($("macros-message"), false);
    } catch (error) {
      put($("macros-message"), `${name}: ${error.message}`);
      show($("macros-message"), true);
    }
    mark(button, "runs", "false");
  }
}
