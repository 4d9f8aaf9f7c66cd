// The corners of the tool's path, as many as the machine keeps; asked for bit by bit while it moves.

const POINTS_MAX = 24_000;
const ASK_MS = 500;
const EXPECTED = new Set(["offline", "not_ready", "stopped"]); // there is no path at the moment

export class Path {
  #link;
  #generation = 0;
  #asking = false;
  x = new Float32Array(POINTS_MAX);
  y = new Float32Array(POINTS_MAX);
  z = new Float32Array(POINTS_MAX);
  extrudes = new Uint8Array(POINTS_MAX);
  times_s = new Float64Array(POINTS_MAX);
  count = 0;
  epoch = 0; // rises when what was known is void
  box = null; // of what was extruded: [low x, y, z, high x, y, z]

  constructor(link) {
    this.#link = link;
    link.addEventListener("up", () => (this.#generation = 0)); // another coordinator may count as the last one did
    setInterval(() => {
      if (!document.hidden && link.up) this.ask();
    }, ASK_MS);
  }

  async ask() {
    if (this.#asking) return;
    this.#asking = true;
    try {
      while (this.#take(await this.#link.call("motion.path", { generation: this.#generation, first: this.count })));
    } catch (error) {
      if (!EXPECTED.has(error.code)) console.warn(`path: ${error.message}`);
    } finally {
      this.#asking = false;
    }
  }

  /** Return how many points the tool has passed at print time NOW_S; binary search. */
  passed(now_s) {
    let [low, high] = [0, this.count];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times_s[middle] <= now_s) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** Take an answer; return whether there is more to ask for. */
  #take(part) {
    if (part.generation !== this.#generation) {
      this.#generation = part.generation;
      this.count = 0;
      this.epoch++;
      this.box = null;
    }
    const many = Math.min(part.x.length, POINTS_MAX - part.first);
    for (let i = 0; i < many; i++) this.#put(part.first + i, part, i);
    this.count = part.first + many;
    return many > 0 && this.count < Math.min(part.count, POINTS_MAX);
  }

  #put(at, part, i) {
    this.x[at] = part.x[i];
    this.y[at] = part.y[i];
    this.z[at] = part.z[i];
    this.times_s[at] = part.print_time_s[i];
    this.extrudes[at] = part.extrudes[i] ? 1 : 0;
    if (!part.extrudes[i]) return;
    if (at > 0) this.#widen(at - 1);
    this.#widen(at);
  }

  #widen(at) {
    const point = [this.x[at], this.y[at], this.z[at]];
    this.box ??= [...point, ...point];
    for (let axis = 0; axis < 3; axis++) {
      this.box[axis] = Math.min(this.box[axis], point[axis]);
      this.box[axis + 3] = Math.max(this.box[axis + 3], point[axis]);
    }
  }
}
