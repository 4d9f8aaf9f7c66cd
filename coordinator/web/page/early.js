// Sets the colours before anything is painted, so that a page that opens in a dark room does not flash.
(() => {
  let chosen = null;
  try {
    chosen = localStorage.getItem("canductor.colours");
  } catch {
    chosen = null; // a browser that keeps nothing
  }
  const system = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  document.documentElement.dataset.colours = chosen && chosen !== "auto" ? chosen : system;
})();
