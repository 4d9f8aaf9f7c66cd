// The toolpath with the live head. What is passed is painted once into a layer of its own and only added to; a turn of
// the camera paints it anew. So a long print costs no more at each step than a short one.

import { Camera } from "./camera.js";
import { Sheet } from "./canvas.js";
import { $ } from "./dom.js";
import { take_gestures } from "./gestures.js";
import { colour } from "./theme.js";

const SHADES = 16; // of height
const LAYER_MM = 0.02; // in 2D: what is this close to the head's height is its layer
const OBJECT_MM = 10; // the square of an object that has only a centre
const SPAN_LEAST_MM = 20; // a part that is just begun is not shown larger than life

export class View {
  #path;
  #axes = null; // [low x, y, z, high x, y, z]
  #head = null;
  #now_s = 0;
  #state = "standing";
  #passed = 0;
  #painted = { key: "", count: 0 };
  #due = false;
  #fit_part = true;
  #travels = false;
  #colours = {};
  #layer = document.createElement("canvas");
  #objects = [];
  on_object = () => {}; // gets the name of an object that was tapped

  constructor(path) {
    this.#path = path;
    this.camera = new Camera();
    this.sheet = new Sheet($("path"), () => this.redraw());
    take_gestures($("path"), this.camera, () => this.redraw(), (x, y) => this.#tap(x, y));
    this.#choose("view-2d", "view-3d", (flat) => (this.camera.flat = flat));
    this.#choose("fit-part", "fit-bed", (part) => (this.#fit_part = part));
    $("travels").addEventListener("click", () => {
      this.#travels = !this.#travels;
      $("travels").setAttribute("aria-pressed", String(this.#travels));
      this.redraw();
    });
    this.colours();
  }

  set axes(axes) {
    this.#axes = axes;
    this.redraw();
  }

  /** Show these ({name, center, polygon, is_excluded, is_current}) on the bed. */
  set objects(objects) {
    this.#objects = objects;
    this.redraw();
  }

  /** Show the head at PLACE ({x, y, z}) at print time NOW_S. STATE: moving, standing (all is done) or stopped. */
  head(place, now_s, state) {
    this.#head = place;
    this.#now_s = now_s;
    this.#state = state;
    this.redraw();
  }

  /** Take the colours anew: they have changed. */
  colours() {
    for (const name of ["grid", "edge", "line", "dim", "head", "path-low", "path-high", "path-ahead", "path-travel", "sunk"]) {
      this.#colours[name] = colour(name);
    }
    this.#colours.ramp = ramp(this.#colours["path-low"], this.#colours["path-high"], SHADES);
    this.#painted.key = "";
    this.redraw();
  }

  redraw() {
    if (this.#due) return;
    this.#due = true;
    requestAnimationFrame(() => {
      this.#due = false;
      if (this.sheet.visible) this.#draw();
    });
  }

  #choose(first, second, use) {
    for (const [id, value] of [[first, true], [second, false]]) {
      $(id).addEventListener("click", () => {
        $(first).setAttribute("aria-pressed", String(value));
        $(second).setAttribute("aria-pressed", String(!value));
        use(value);
        this.camera.reset();
        this.redraw();
      });
    }
  }

  // ---------------------------------------------------------------------------------------------- painting

  #draw() {
    const { context, width, height } = this.sheet;
    const box = this.#box();
    this.#passed = this.#state === "standing" ? this.#path.count : this.#path.passed(this.#now_s);
    this.camera.fit(box, width, height);
    const m = this.camera.matrix(width, height);
    context.clearRect(0, 0, width, height);
    this.#bed(context, m);
    this.#draw_objects(context, m);
    this.#paint_passed(m, box);
    context.save();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.#layer, 0, 0);
    context.restore();
    this.#ahead(context, m);
    this.#draw_head(context, m);
  }

  #box() {
    const axes = this.#axes ?? [0, 0, 0, 200, 200, 200];
    const part = this.#path.box;
    if (!this.#fit_part || !part) return [axes[0], axes[1], axes[2], axes[3], axes[4], axes[2]];
    const box = [...part];
    box[2] = Math.min(box[2], axes[2]);
    for (const i of [0, 1]) {
      const lacking = SPAN_LEAST_MM - (box[i + 3] - box[i]);
      if (lacking > 0) {
        box[i] -= lacking / 2;
        box[i + 3] += lacking / 2;
      }
    }
    return box;
  }

  #bed(context, m) {
    if (!this.#axes) return;
    const [x0, y0, z0, x1, y1] = this.#axes;
    const at = (x, y) => [m.xx * x + m.xy * y + m.xz * z0 + m.left, m.yx * x + m.yy * y + m.yz * z0 + m.top];
    const line = (a, b) => {
      context.moveTo(...at(...a));
      context.lineTo(...at(...b));
    };
    for (const [step, shade] of [[10, "grid"], [50, "line"]]) {
      context.strokeStyle = this.#colours[shade];
      context.lineWidth = 1;
      context.beginPath();
      for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) line([x, y0], [x, y1]);
      for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) line([x0, y], [x1, y]);
      context.stroke();
    }
    context.strokeStyle = this.#colours.edge;
    context.lineWidth = 1.5;
    context.beginPath();
    line([x0, y0], [x1, y0]);
    line([x1, y0], [x1, y1]);
    line([x1, y1], [x0, y1]);
    line([x0, y1], [x0, y0]);
    context.stroke();
  }

  #draw_objects(context, m) {
    for (const object of this.#objects) {
      const corners = this.#corners(object, m);
      context.strokeStyle = this.#colours[object.is_current ? "head" : object.is_excluded ? "dim" : "edge"];
      context.lineWidth = object.is_current ? 2 : 1.2;
      context.setLineDash(object.is_excluded ? [4, 4] : []);
      context.beginPath();
      corners.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.closePath();
      context.stroke();
    }
    context.setLineDash([]);
  }

  /** Return the corners of OBJECT on the screen: its polygon, or a square about its centre. */
  #corners(object, m) {
    const [cx, cy] = object.center ?? [0, 0];
    const half = OBJECT_MM / 2;
    const square = object.center ? [[cx - half, cy - half], [cx + half, cy - half], [cx + half, cy + half], [cx - half, cy + half]] : [];
    const z = this.#axes?.[2] ?? 0;
    return (object.polygon?.length ? object.polygon : square).map(([x, y]) => place(m, { x, y, z }));
  }

  #tap(x, y) {
    const m = this.camera.matrix(this.sheet.width, this.sheet.height);
    const found = this.#objects.find((object) => is_inside(this.#corners(object, m), x, y));
    if (found) this.on_object(found.name);
  }

  /** Bring the layer of what is passed up to date. */
  #paint_passed(m, box) {
    const { width, height, ratio } = this.sheet;
    const path = this.#path;
    const layer_z = this.camera.flat && this.#head ? Math.round(this.#head.z / LAYER_MM) : 0;
    const key = [path.epoch, this.camera.version, width, height, layer_z, this.#travels, ...box.map((v) => v.toFixed(2)),
      m.xx.toFixed(4), m.yx.toFixed(4), m.left.toFixed(1), m.top.toFixed(1)].join();
    if (key !== this.#painted.key || this.#passed < this.#painted.count) {
      this.#layer.width = Math.round(width * ratio);
      this.#layer.height = Math.round(height * ratio);
      this.#painted = { key, count: 0 };
    }
    const context = this.#layer.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.lineCap = "round";
    const [low, high] = [box[2], Math.max(box[5], box[2] + 1e-3)];
    const from = Math.max(1, this.#painted.count);
    let begin = from;
    while (begin < this.#passed) {
      const style = this.#style(begin, low, high, layer_z);
      let end = begin + 1;
      while (end < this.#passed && this.#style(end, low, high, layer_z) === style) end++;
      if (style !== "none") this.#stroke(context, m, begin, end, style);
      begin = end;
    }
    this.#painted.count = this.#passed;
  }

  /** Return how the way to point I is painted. */
  #style(i, low, high, layer_z) {
    const path = this.#path;
    if (!path.extrudes[i]) return this.#travels ? "travel" : "none";
    if (this.camera.flat) return Math.abs(path.z[i] - layer_z * LAYER_MM) <= LAYER_MM ? "now" : "below";
    return Math.min(SHADES - 1, Math.floor((SHADES * (path.z[i] - low)) / (high - low)));
  }

  #stroke(context, m, begin, end, style) {
    const path = this.#path;
    const scale = Math.hypot(m.xx, m.yx);
    context.globalAlpha = style === "below" ? 0.28 : 1;
    context.lineWidth = style === "travel" ? 0.7 : Math.min(2.2, Math.max(0.8, 0.35 * scale));
    context.strokeStyle = style === "travel" ? this.#colours["path-travel"]
      : style === "now" ? this.#colours["path-high"] : style === "below" ? this.#colours["path-low"] : this.#colours.ramp[style];
    context.beginPath();
    for (let i = begin - 1; i < end; i++) {
      const x = m.xx * path.x[i] + m.xy * path.y[i] + m.xz * path.z[i] + m.left;
      const y = m.yx * path.x[i] + m.yy * path.y[i] + m.yz * path.z[i] + m.top;
      if (i < begin) context.moveTo(x, y);
      else context.lineTo(x, y);
    }
    context.stroke();
    context.globalAlpha = 1;
  }

  /** Paint what is planned and not passed yet, from the head on. */
  #ahead(context, m) {
    const path = this.#path;
    if (this.#state !== "moving" || !this.#head || this.#passed >= path.count) return;
    context.strokeStyle = this.#colours["path-ahead"];
    context.lineWidth = 1.6;
    context.beginPath();
    context.moveTo(...place(m, this.#head));
    for (let i = this.#passed; i < path.count; i++) {
      context.lineTo(
        m.xx * path.x[i] + m.xy * path.y[i] + m.xz * path.z[i] + m.left,
        m.yx * path.x[i] + m.yy * path.y[i] + m.yz * path.z[i] + m.top,
      );
    }
    context.stroke();
  }

  #draw_head(context, m) {
    if (!this.#head) return;
    const [x, y] = place(m, this.#head);
    context.strokeStyle = this.#colours.head;
    context.fillStyle = this.#colours.head;
    if (!this.camera.flat) {
      const [, foot] = place(m, { ...this.#head, z: this.#axes?.[2] ?? 0 });
      context.globalAlpha = 0.55;
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(x, y);
      context.lineTo(x, foot);
      context.stroke();
      context.beginPath();
      context.ellipse(x, foot, 5, 2.4, 0, 0, 2 * Math.PI);
      context.stroke();
    }
    context.globalAlpha = 0.25;
    context.beginPath();
    context.arc(x, y, 11, 0, 2 * Math.PI);
    context.fill();
    context.globalAlpha = 1;
    context.beginPath();
    context.arc(x, y, 4.5, 0, 2 * Math.PI);
    context.fill();
    context.lineWidth = 1.5;
    context.strokeStyle = this.#colours.sunk;
    context.stroke();
  }
}

/** Return whether X, Y is inside the polygon CORNERS: a ray from there crosses its sides an odd number of times. */
function is_inside(corners, x, y) {
  let inside = false;
  for (let i = 0, j = corners.length - 1; i < corners.length; j = i++) {
    const [[ax, ay], [bx, by]] = [corners[i], corners[j]];
    if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) inside = !inside;
  }
  return inside;
}

function place(m, at) {
  return [m.xx * at.x + m.xy * at.y + m.xz * at.z + m.left, m.yx * at.x + m.yy * at.y + m.yz * at.z + m.top];
}

/** Return COUNT colours from LOW to HIGH, given as #rrggbb. */
function ramp(low, high, count) {
  const parts = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
  const [a, b] = [parts(low), parts(high)];
  return Array.from({ length: count }, (_, k) => {
    const mixed = a.map((value, i) => Math.round(value + ((b[i] - value) * k) / (count - 1)));
    return `rgb(${mixed.join(" ")})`;
  });
}
