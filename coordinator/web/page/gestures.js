// Mouse, fingers, wheel and keys on the toolpath.

const KEY_PX = 24;
const TAP_PX = 5; // a finger that moves less has tapped

/** ON_TAP gets the place of a click or tap, px from the canvas' corner. */
export function take_gestures(canvas, camera, redraw, on_tap) {
  const fingers = new Map();
  let tap = null; // where a single finger came down, until it has moved
  const middle = () => {
    const box = canvas.getBoundingClientRect();
    return [box.left + box.width / 2, box.top + box.height / 2];
  };
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event);
    tap = fingers.size === 1 ? event : null;
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    if (tap && Math.hypot(event.clientX - tap.clientX, event.clientY - tap.clientY) > TAP_PX) tap = null;
    if (fingers.size === 1) {
      camera.drag(event.clientX - before.clientX, event.clientY - before.clientY, event.shiftKey || event.buttons === 2);
    } else if (fingers.size === 2) {
      const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
      const apart = (a) => Math.hypot(a.clientX - other.clientX, a.clientY - other.clientY) || 1;
      const [mx, my] = middle();
      camera.scale(apart(event) / apart(before), (event.clientX + other.clientX) / 2 - mx, (event.clientY + other.clientY) / 2 - my);
    }
    fingers.set(event.pointerId, event);
    redraw();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      fingers.delete(event.pointerId);
      if (!tap || end === "pointercancel") return;
      const box = canvas.getBoundingClientRect();
      on_tap(event.clientX - box.left, event.clientY - box.top);
      tap = null;
    });
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      // A page that is scrolled past must scroll: the wheel zooms only a view that has the focus, or with Ctrl.
      if (!event.ctrlKey && document.activeElement !== canvas) return;
      event.preventDefault();
      const [mx, my] = middle();
      camera.scale(Math.exp(-event.deltaY * 0.002), event.clientX - mx, event.clientY - my);
      redraw();
    },
    { passive: false },
  );
  canvas.addEventListener("keydown", (event) => {
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (ways[event.key]) camera.drag(ways[event.key][0] * KEY_PX, ways[event.key][1] * KEY_PX, event.shiftKey);
    else if (event.key === "+" || event.key === "=") camera.scale(1.25, 0, 0);
    else if (event.key === "-") camera.scale(0.8, 0, 0);
    else if (event.key === "0") camera.reset();
    else return;
    event.preventDefault();
    redraw();
  });
}
