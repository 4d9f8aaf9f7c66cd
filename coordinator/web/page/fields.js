// What the page knows of the machine: the newest value of each field, and bounded series of some.

export class Fields {
  #values = new Map();

  /** Take an update of the fields that begin with one of PREFIXES; a snapshot voids what was known of those. */
  take(prefixes, values, removed, snapshot) {
    if (snapshot) {
      for (const path of this.#values.keys()) {
        if (prefixes.some((prefix) => path.startsWith(prefix))) this.#values.delete(path);
      }
    }
    for (const path of removed) this.#values.delete(path);
    for (const path in values) this.#values.set(path, values[path]);
  }

  get(path, otherwise = null) {
    return this.#values.get(path) ?? otherwise;
  }

  has(path) {
    return this.#values.has(path);
  }

  /** Return the names directly below PREFIX ("nodes"), sorted. */
  names(prefix) {
    const found = new Set();
    const start = `${prefix}.`;
    for (const path of this.#values.keys()) {
      if (path.startsWith(start)) found.add(path.slice(start.length, path.indexOf(".", start.length)));
    }
    return [...found].sort();
  }
}

/** The last CAPACITY samples of several lines at common times; NaN: no value. */
export class Series {
  constructor(lines, capacity) {
    this.capacity = capacity;
    this.times_s = new Float64Array(capacity);
    this.lines = Array.from({ length: lines }, () => new Float32Array(capacity));
    this.length = 0;
    this.next = 0;
  }

  push(time_s, values) {
    this.times_s[this.next] = time_s;
    this.lines.forEach((line, i) => (line[this.next] = values[i] ?? NaN));
    this.next = (this.next + 1) % this.capacity;
    this.length = Math.min(this.length + 1, this.capacity);
  }

  /** Return where sample I (0: the oldest) lies in the arrays. */
  at(i) {
    return (this.next - this.length + i + this.capacity) % this.capacity;
  }
}
