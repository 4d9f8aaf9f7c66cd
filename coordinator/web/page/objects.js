// The objects of a program that can be left out (EXCLUDE_OBJECT): a list, and their outlines on the toolpath.

import { $, make, mark, put, show } from "./dom.js";

const SURE_MS = 4000;

export class Objects {
  #link;
  #view;
  #may = false;
  #key = "";
  #sure = 0; // timer

  constructor(link, view) {
    this.#link = link;
    this.#view = view;
    view.on_object = (name) => this.#point_at(name);
  }

  set may(may) {
    this.#may = may;
  }

  show(fields) {
    const objects = fields.get("modules.exclude_object.objects") ?? [];
    const excluded = new Set(fields.get("modules.exclude_object.excluded_objects") ?? []);
    const current = fields.get("modules.exclude_object.current_object");
    const may = this.#may && this.#link.up;
    const key = JSON.stringify([objects.map((object) => object.name), [...excluded], current, may]);
    if (key === this.#key) return;
    this.#key = key;
    show($("objects"), objects.length > 0);
    this.#view.objects = objects.map(({ name, center, polygon }) => ({
      name, center, polygon, is_excluded: excluded.has(name), is_current: name === current,
    }));
    $("object-list").replaceChildren(
      ...objects.map(({ name }) => {
        const is_out = excluded.has(name);
        const button = make("button", { type: "button", class: "small" }, is_out ? "left out" : "Leave out");
        button.disabled = is_out || !may;
        button.addEventListener("click", () => this.#leave_out(button, name));
        const label = make("span", { class: "grow" }, name, name === current ? make("small", {}, " is printed now") : null);
        return make("li", { class: "row", "data-name": name }, label, button);
      }),
    );
  }

  /** Show the entry of the object that was touched on the toolpath. */
  #point_at(name) {
    $("objects").open = true;
    const entry = [...$("object-list").children].find((item) => item.dataset.name === name);
    entry?.querySelector("button").focus();
    entry?.scrollIntoView({ block: "nearest" });
  }

  /** Leave it out when asked twice: there is no way back. */
  async #leave_out(button, name) {
    clearTimeout(this.#sure);
    if (button.dataset.sure !== "true") {
      mark(button, "sure", "true");
      put(button, "Really?");
      this.#sure = setTimeout(() => {
        mark(button, "sure", "false");
        put(button, "Leave out");
      }, SURE_MS);
      return;
    }
    try {
      await this.#link.call("gcode.run", { script: `EXCLUDE_OBJECT NAME=${quoted(name)}` });
      show($("objects-message"), false);
    } catch (error) {
      put($("objects-message"), error.message);
      show($("objects-message"), true);
    }
  }
}

/** Return NAME as a value in g-code; a program's objects have names that fit in one kind of quotes. */
function quoted(name) {
  return name.includes('"') ? `'${name}'` : `"${name}"`;
}
