// The job: how far it is and what it waits for, and start, pause, resume, cancel of files of the job folder.

import { $, count, duration, make, mark, percent, put, show } from "./dom.js";
import { waits_for } from "./heat.js";

const ACTIVE = new Set(["printing", "pausing", "paused", "cancelling"]);
const SURE_MS = 4000;
const FILES_MAX = 1000;

export class Job {
  #link;
  #may = false;
  #state = "none";
  #sure = 0; // timer
  #pictured = ""; // the file whose picture is shown
  #arrived = ""; // the file to choose when it is in the list
  #asked_to_cancel = false;

  /** HEAT: the temperatures; ON_END is called when a job has ended. */
  constructor(link, heat, on_end) {
    this.#link = link;
    this.heat = heat;
    this.on_end = on_end;
    $("job-files").addEventListener("change", () => {
      this.#arrived = ""; // a person has chosen
      this.#picture($("job-files").value);
    });
    $("heat-leave").addEventListener("click", () => show($("still-hot"), false));
    $("heat-end").addEventListener("click", () => {
      this.heat.turn_off();
      show($("still-hot"), false);
    });
    $("job-pause").addEventListener("click", () => this.#call("job.pause"));
    $("job-resume").addEventListener("click", () => this.#call("job.resume"));
    $("job-cancel").addEventListener("click", () => this.#cancel());
    $("job-start").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#call("job.start", { file: $("job-files").value });
    });
    $("job-files").addEventListener("pointerdown", () => this.list());
    $("job-files").addEventListener("focus", () => this.list());
  }

  set may(may) {
    this.#may = may;
  }

  /** Ask which files there are. */
  async list() {
    let files = [];
    try {
      files = (await this.#link.call("job.list")).files.slice(0, FILES_MAX);
    } catch (error) {
      if (error.code !== "no_such_file") return;
    }
    const select = $("job-files");
    const names = files.map((file) => file.name);
    if (names.join("\n") === [...select.options].map((option) => option.value).join("\n")) return;
    const chosen = select.value;
    select.replaceChildren(
      ...files.map((file) => make("option", { value: file.name }, `${file.name} (${size(file.size_bytes)})`)),
    );
    if (!files.length) select.append(make("option", { value: "" }, "no files in the job folder"));
    if (names.includes(chosen)) select.value = chosen;
    if (!ACTIVE.has(this.#state)) this.#picture(select.value);
  }

  /** Show the list with FILE chosen, which has just arrived, unless another one is chosen meanwhile. */
  async choose(file) {
    this.#arrived = file;
    await this.list();
    if (file !== this.#arrived) return;
    $("job-files").value = file;
    this.#picture(file);
  }

  /** Show the slicer's picture of FILE, if it has one. */
  async #picture(file) {
    if (file === this.#pictured) return;
    this.#pictured = file;
    let found = { png: null };
    try {
      if (file) found = await this.#link.call("job.thumbnail", { file });
    } catch (error) {
      if (error.code === "offline") this.#pictured = "";
    }
    const image = found.png ? await decoded(found.png) : null;
    if (file !== this.#pictured) return;
    const canvas = $("job-picture");
    show(canvas, image !== null);
    if (!image) return;
    [canvas.width, canvas.height] = [image.width, image.height];
    canvas.getContext("2d").drawImage(image, 0, 0);
  }

  show(fields, machine_state) {
    const get = (name) => fields.get(`job.${name}`);
    const state = get("state") ?? "none";
    const progress = get("progress") ?? 0;
    const active = ACTIVE.has(state);
    if (ACTIVE.has(this.#state) && !active) this.#ended(fields, state);
    if (active && !ACTIVE.has(this.#state)) this.#picture(get("file"));
    this.#state = state;
    put($("job-file"), get("file") ?? "no job yet");
    const waits = waits_for(fields);
    show($("job-waits"), waits !== "");
    put($("job-waits"), waits);
    show($("job-state"), state !== "none");
    put($("job-state"), state);
    mark($("job-state"), "state", state);
    const message = get("message") ?? "";
    show($("job-message"), message !== "");
    put($("job-message"), message);
    $("job-progress").value = progress;
    put($("job-percent"), percent(progress));
    put($("job-time"), get("print_time_s") === null ? "–" : duration(get("print_time_s")));
    put($("job-left"), active && progress > 0.01 ? duration((get("print_time_s") * (1 - progress)) / progress) : "–");
    put($("job-row"), count(get("line")));
    $("top-bar").style.transform = `scaleX(${active ? progress : 0})`;
    put($("top-file"), active ? get("file") : "");
    put($("top-percent"), active ? percent(progress) : "");
    this.#enable(state, machine_state);
  }

  #enable(state, machine_state) {
    const may = this.#may && this.#link.up;
    $("job-pause").disabled = !(may && state === "printing");
    $("job-resume").disabled = !(may && (state === "paused" || state === "pausing"));
    $("job-cancel").disabled = !(may && ACTIVE.has(state) && state !== "cancelling");
    $("job-files").disabled = !may;
    $("job-print").disabled = !(may && machine_state === "ready" && !ACTIVE.has(state) && $("job-files").value);
  }

  #ended(fields, state) {
    this.on_end();
    const hot = this.heat.hot(fields);
    const ask = this.#asked_to_cancel && state === "cancelled" && hot.length > 0;
    this.#asked_to_cancel = false;
    if (!ask) return;
    put($("still-hot-text"), `The job was cancelled. Still heated: ${hot.join(", ")}.`);
    show($("still-hot"), true);
  }

  /** Cancel when asked twice: a print is hours. */
  #cancel() {
    const button = $("job-cancel");
    const settle = () => {
      clearTimeout(this.#sure);
      mark(button, "sure", "false");
      put(button, "Cancel");
    };
    if (button.dataset.sure === "true") {
      settle();
      this.#asked_to_cancel = true;
      this.#call("job.cancel");
      return;
    }
    mark(button, "sure", "true");
    put(button, "Really cancel?");
    this.#sure = setTimeout(settle, SURE_MS);
  }

  async #call(method, params) {
    const line = $("job-error");
    try {
      await this.#link.call(method, params);
      show(line, false);
    } catch (error) {
      put(line, error.message);
      show(line, true);
    }
  }
}

/** Return the picture PNG, given in base64; null when it is none. */
async function decoded(png) {
  const bytes = Uint8Array.from(atob(png), (letter) => letter.charCodeAt(0));
  try {
    return await createImageBitmap(new Blob([bytes], { type: "image/png" }));
  } catch {
    return null;
  }
}

function size(bytes) {
  return bytes < 1e6 ? `${Math.max(1, Math.round(bytes / 1e3))} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}
