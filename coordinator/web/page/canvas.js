// A canvas that is as sharp as the screen and redrawn only when it is seen.

const seen = new WeakSet();
const watcher = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (entry.isIntersecting) seen.add(entry.target);
    else seen.delete(entry.target);
  }
});
const RATIO_MAX = 2; // sharper costs a phone more than it shows

export class Sheet {
  constructor(canvas, on_resize = () => {}) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.width = 0;
    this.height = 0;
    watcher.observe(canvas);
    this.observer = new ResizeObserver(() => {
      this.fit();
      on_resize();
    });
    this.observer.observe(canvas);
  }

  get visible() {
    return this.width > 0 && seen.has(this.canvas);
  }

  fit() {
    const ratio = Math.min(devicePixelRatio || 1, RATIO_MAX);
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.ratio = ratio;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  release() {
    watcher.unobserve(this.canvas);
    this.observer.disconnect();
  }
}
