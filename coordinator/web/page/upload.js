// Files into the job folder: chosen, or dropped on the page.

import { $, mark, percent, put, show } from "./dom.js";

const PIECE_BYTES = 24_000; // of a file; a request takes 32,768 characters
const FILES_MAX = 20; // at once

export class Upload {
  #link;
  #may = false;
  #busy = false;
  #again = null; // the file that the folder has already

  /** ON_DONE gets the name of each file that has arrived. */
  constructor(link, on_done) {
    this.#link = link;
    this.on_done = on_done;
    $("upload").addEventListener("click", () => $("upload-file").click());
    $("upload-file").addEventListener("change", () => {
      this.#send_all([...$("upload-file").files]);
      $("upload-file").value = "";
    });
    $("upload-again").addEventListener("click", () => this.#send_all([this.#again], true));
    document.addEventListener("dragover", (event) => this.#drag(event));
    document.addEventListener("dragleave", () => mark(document.body, "drop", "false"));
    document.addEventListener("drop", (event) => {
      if (!this.#drag(event)) return;
      mark(document.body, "drop", "false");
      this.#send_all([...event.dataTransfer.files]);
    });
  }

  set may(may) {
    this.#may = may;
    this.#enable();
  }

  #enable() {
    $("upload").disabled = !this.#may || this.#busy;
  }

  #drag(event) {
    if (!event.dataTransfer.types.includes("Files")) return false;
    event.preventDefault(); // else the browser would open the file
    const can = this.#may && !this.#busy;
    event.dataTransfer.dropEffect = can ? "copy" : "none";
    mark(document.body, "drop", String(can));
    return can;
  }

  async #send_all(files, replace = false) {
    if (this.#busy) return;
    this.#busy = true;
    this.#enable();
    show($("upload-again"), false);
    for (const file of files.slice(0, FILES_MAX)) {
      try {
        await this.#send(file, replace);
        this.#say(`${file.name} is in the job folder`);
        this.on_done(file.name);
      } catch (error) {
        this.#say(`${file.name}: ${error.message}`);
        this.#again = file;
        show($("upload-again"), error.code === "file_exists");
        break;
      }
    }
    this.#busy = false;
    this.#enable();
  }

  async #send(file, replace) {
    const decoder = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });
    let offset = 0;
    for (let begin = 0; begin === 0 || begin < file.size; begin += PIECE_BYTES) {
      const bytes = await file.slice(begin, begin + PIECE_BYTES).arrayBuffer();
      const done = begin + PIECE_BYTES >= file.size;
      const text = decode(decoder, bytes, done);
      offset = (await this.#link.call("job.upload", { file: file.name, offset, text, done, replace })).size_bytes;
      this.#say(`sending ${file.name}: ${percent(Math.min(1, (begin + PIECE_BYTES) / file.size))}`);
    }
  }

  #say(text) {
    put($("upload-message"), text);
    show($("upload-message"), true);
  }
}

function decode(decoder, bytes, done) {
  try {
    return decoder.decode(bytes, { stream: !done });
  } catch {
    throw new Error("this is no text in UTF-8, so it is no g-code");
  }
}
