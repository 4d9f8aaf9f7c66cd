// Light, dark, or night (red on black, for a dark room); "auto" follows the system.

import { $ } from "./dom.js";

const KEY = "canductor.colours";
const dark = matchMedia("(prefers-color-scheme: dark)");

/** Set the colours and let the user choose; ON_CHANGE after every change. */
export function choose_colours(on_change) {
  const select = $("theme");
  select.value = read() ?? "auto";
  if (!select.value) select.value = "auto";
  const apply = () => {
    const colours = select.value === "auto" ? (dark.matches ? "dark" : "light") : select.value;
    document.documentElement.dataset.colours = colours;
    const ground = getComputedStyle(document.documentElement).getPropertyValue("--card").trim();
    document.querySelector('meta[name="theme-color"]').content = ground;
    on_change();
  };
  select.addEventListener("change", () => {
    write(select.value);
    apply();
  });
  dark.addEventListener("change", apply);
  apply();
}

/** Return the value of a colour of the style sheet. */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function read() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // a browser that keeps nothing
  }
}

function write(value) {
  try {
    localStorage.setItem(KEY, value);
  } catch {
    return;
  }
}
