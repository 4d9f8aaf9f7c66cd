// Puts the page together: two connections (one for the emergency stop alone), the fields, and who shows them.

import { bus_cards } from "./buses.js";
import { Console } from "./console.js";
import { $, duration, figure, mark, percent, put, show } from "./dom.js";
import { Fields } from "./fields.js";
import { Heat } from "./heat.js";
import { History } from "./history.js";
import { Job } from "./job.js";
import { Link } from "./link.js";
import { Login } from "./login.js";
import { Macros } from "./macros.js";
import { Move } from "./move.js";
import { node_cards } from "./nodes.js";
import { Objects } from "./objects.js";
import { Path } from "./path.js";
import { Stop } from "./stop.js";
import { table_cards } from "./tables.js";
import { choose_colours } from "./theme.js";
import { Upload } from "./upload.js";
import { View } from "./view.js";

const FAST = ["machine.", "job.", "position."];
const SLOW = ["nodes.", "buses.", "tables.", "modules."];
const SAMPLE_MS = 500;
const HIDDEN_MS = 3000; // a tab that is hidden for so long gets nothing more until it is seen

const login = new Login((key) => {
  link.connect(key);
  stop.connect(key);
});
const link = new Link("the live page");
const stop = new Stop(link);
const fields = new Fields();
const path = new Path(link);
const view = new View(path);
const heat = new Heat(link);
const history = new History(link);
const job = new Job(link, heat, () => history.list());
const move = new Move(link);
const macros = new Macros(link);
const objects = new Objects(link, view);
const upload = new Upload(link, (file) => job.choose(file));
const terminal = new Console(link);
const nodes = node_cards();
const buses = bus_cards();
const tables = table_cards();
let may = false;
let heard = null; // Date of the last update
let down = null; // {since, next_ms}
let due = false;

// ------------------------------------------------------------------------------------------------ connection

link.addEventListener("up", async (event) => {
  may = event.detail.scope !== "watch";
  down = null;
  login.hide();
  show($("offline"), false);
  mark(document.body, "offline", "false");
  for (const part of [job, terminal, heat, move, macros, objects, upload]) part.may = may;
  if (!document.hidden) watch();
  try {
    const info = await link.call("machine.info");
    introduce(info);
    await terminal.begin(info.started_s);
    await job.list();
    await history.list();
    await macros.list();
  } catch (error) {
    if (error.code !== "offline" && error.code !== "not_ready") console.warn(error.message);
  }
});

link.addEventListener("down", (event) => {
  down ??= { since: new Date(), reason: event.detail.message };
  terminal.may = upload.may = false;
  show_down();
});

link.addEventListener("refused", () => {
  terminal.may = false;
  mark(document.body, "offline", "true");
  login.refused();
});

function watch() {
  const hear = (prefixes) => (values, removed, snapshot) => {
    fields.take(prefixes, values, removed, snapshot);
    heard = new Date();
    redraw();
  };
  link.watch("fast", FAST.map((prefix) => `${prefix}*`), 10, hear(FAST));
  link.watch("slow", SLOW.map((prefix) => `${prefix}*`), 2, hear(SLOW));
}

let hiding = 0;
document.addEventListener("visibilitychange", () => {
  clearTimeout(hiding);
  if (!document.hidden) watch();
  else {
    hiding = setTimeout(() => {
      link.unwatch("fast");
      link.unwatch("slow");
    }, HIDDEN_MS);
  }
});

function introduce(info) {
  put($("name"), info.name);
  document.title = info.name;
  put($("about"), `canductor ${info.version} on ${info.host}${may ? "" : " · this browser may only watch"}`);
  const axes = info.machine?.axes;
  if (axes) view.axes = ["low_mm", "high_mm"].flatMap((end) => ["x", "y", "z"].map((axis) => axes[axis][end]));
}

// ----------------------------------------------------------------------------------------------------- state

function redraw() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    show_machine();
    show_position();
    const state = fields.get("machine.state");
    job.show(fields, state);
    move.show(fields, state);
    macros.show();
    objects.show(fields);
  });
}

function show_machine() {
  const state = fields.get("machine.state", "offline");
  const cause = fields.get("machine.cause", "");
  put($("state"), down ? "no connection" : state);
  mark($("state"), "state", down ? "offline" : state);
  const stopped = !down && (state === "shutdown" || state === "error");
  show($("stopped"), stopped);
  if (stopped) {
    put($("stopped-title"), state === "shutdown" ? "Stopped." : "It could not be started.");
    put($("stopped-cause"), sentence(cause));
    $("restart").disabled = !may;
  }
  const waits = fields.get("machine.waits_for");
  const shown = waits ?? (state === "paused" ? cause : "");
  show($("waits"), !down && !stopped && Boolean(shown));
  put($("waits"), shown ? sentence(`motion waits: ${shown}`) : "");
}

function sentence(text) {
  return text ? `${text[0].toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}` : "";
}

function show_position() {
  const at = fields.get("position.commanded");
  for (const axis of "xyze") put($(`pos-${axis}`), at ? figure(at[axis], axis === "e" ? 1 : 2) : "–");
  put($("speed"), figure(fields.get("position.velocity_mm_s"), 1));
  const program = fields.get("position.gcode");
  put($("pos-program"), program ? ["x", "y", "z"].map((axis) => figure(program[axis], 1)).join("  ") : "–");
  put($("homed"), fields.get("position.homed") || "none");
  const [speed, flow] = [fields.get("position.speed_factor"), fields.get("position.extrude_factor")];
  put($("factors"), `speed ${percent(speed)}, flow ${percent(flow)}`);
  const stopped = ["shutdown", "error"].includes(fields.get("machine.state"));
  const motion = stopped ? "stopped" : fields.get("position.moving") ? "moving" : "standing";
  if (at) view.head(at, fields.get("position.print_time_s", 0), motion);
}

function show_down() {
  mark(document.body, "offline", "true");
  const since = down.since.toLocaleTimeString([], { hour12: false });
  const old = heard ? ` What is shown is ${duration((Date.now() - heard) / 1000)} old.` : "";
  const why = down.reason ? ` (${down.reason})` : "";
  put($("offline"), `No connection to the machine since ${since}${why}. Trying again.${old}`);
  show($("offline"), true);
  show_machine();
  job.show(fields, null);
  move.show(fields, null);
  macros.show();
}

$("restart").addEventListener("click", async () => {
  $("restart").disabled = true;
  try {
    await link.call("machine.restart");
  } catch (error) {
    put($("stopped-cause"), error.message);
  }
});

// --------------------------------------------------------------------------------------------------- figures

setInterval(() => {
  if (down) show_down();
  if (document.hidden) return;
  const now_s = performance.now() / 1000;
  if (link.up && heard) {
    nodes.sample(fields, now_s);
    buses.sample(fields, now_s);
    tables.sample(fields, now_s);
    heat.sample(fields, now_s);
  }
  nodes.show(fields, now_s);
  buses.show(fields, now_s);
  tables.show(fields, now_s);
  heat.show(fields, now_s);
}, SAMPLE_MS);

choose_colours(() => view.colours());
login.begin();
