// From millimetres to the screen: from above (2D), or turned about the bed (3D), without perspective.

const RISE = { start: 0.58, least: 0.05, most: Math.PI / 2 - 0.02 };
const ZOOM = { least: 0.2, most: 60 };

export class Camera {
  flat = false;
  turn = -0.62; // about the vertical, rad
  rise = RISE.start;
  zoom = 1;
  shift_x = 0; // px
  shift_y = 0;
  version = 0; // rises with every change
  #centre = [0, 0, 0];
  #scale = 1;
  #rows = [1, 0, 0, 0, 1, 0];

  /** Show BOX ([low x, y, z, high x, y, z]) in WIDTH x HEIGHT. */
  fit(box, width, height) {
    this.#centre = [0, 1, 2].map((i) => (box[i] + box[i + 3]) / 2);
    this.#turn();
    let [wide, tall] = [1e-3, 1e-3];
    for (let corner = 0; corner < 8; corner++) {
      const d = [0, 1, 2].map((i) => box[i + (corner & (1 << i) ? 3 : 0)] - this.#centre[i]);
      const r = this.#rows;
      wide = Math.max(wide, Math.abs(r[0] * d[0] + r[1] * d[1] + r[2] * d[2]));
      tall = Math.max(tall, Math.abs(r[3] * d[0] + r[4] * d[1] + r[5] * d[2]));
    }
    this.#scale = Math.min((width - 48) / (2 * wide), (height - 64) / (2 * tall));
  }

  #turn() {
    const turn = this.flat ? 0 : this.turn;
    const rise = this.flat ? Math.PI / 2 : this.rise;
    const [c, s, up, side] = [Math.cos(turn), Math.sin(turn), Math.sin(rise), Math.cos(rise)];
    this.#rows = [c, -s, 0, s * up, c * up, side];
  }

  /** Return what takes x, y, z to the screen: six factors and two places. */
  matrix(width, height) {
    const k = this.#scale * this.zoom;
    const r = this.#rows.map((value) => value * k);
    const [cx, cy, cz] = this.#centre;
    const left = width / 2 + this.shift_x - (r[0] * cx + r[1] * cy + r[2] * cz);
    const top = height / 2 + this.shift_y + (r[3] * cx + r[4] * cy + r[5] * cz);
    return { xx: r[0], xy: r[1], xz: r[2], yx: -r[3], yy: -r[4], yz: -r[5], left, top };
  }

  reset() {
    this.zoom = 1;
    this.shift_x = this.shift_y = 0;
    this.version++;
  }

  /** Turn in 3D, shift in 2D, by pixels. */
  drag(dx, dy, shift) {
    if (this.flat || shift) {
      this.shift_x += dx;
      this.shift_y += dy;
    } else {
      this.turn += dx * 0.008;
      this.rise = Math.min(RISE.most, Math.max(RISE.least, this.rise + dy * 0.006));
    }
    this.version++;
  }

  /** Zoom by FACTOR about a place, px from the middle. */
  scale(factor, x, y) {
    const before = this.zoom;
    this.zoom = Math.min(ZOOM.most, Math.max(ZOOM.least, before * factor));
    const k = this.zoom / before;
    this.shift_x = x + (this.shift_x - x) * k;
    this.shift_y = y + (this.shift_y - y) * k;
    this.version++;
  }
}
