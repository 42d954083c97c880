// The page: shows runs, processes and commands once a second, and turns every action into a `caraware` command.

import { byId, get, getPicture, h, post, quoted, setOptions, showError, words } from "./dom.js";
import { buildForm, fault, lineOf, startArguments } from "./form.js";
import { listenToMap, nearestEdge, showMap, showUsers, shownMap, toCanvas } from "./map.js";

const POLL_MS = 1000;
const USERS_MS = 250;
const TABS = ["control", "processes", "curriculum", "view", "logs", "plots"];

let state = { runs: [], live: [], commands: [], sensors: [], runs_directory: "runs" };
let keys = { presets: [], keys: [] };
let chosenRun = null;
let tab = "control";
let users = [];
/** A vehicle that has just been started, until it is on the road. */
let wantedVehicle = null;
let mapOf = null;
let details = null;
const ticked = new Set();
const opened = new Set();
const knownAlive = new Set();
/** Commands whose end has been looked at, and those that were there before this page. */
const ended = new Set();
/** What to do with a command's end, by its number. */
const whenEnded = new Map();
/** Number of the command that shows a run in a browser, by the run. */
const views = new Map();

// --- commands -------------------------------------------------------------------------------------------------------

const runsOption = () => (state.runs_directory === "runs" ? [] : ["--runs", state.runs_directory]);

/** Runs a command; the list of commands shows it. Returns its number, or null. */
async function run(argumentsOfIt, onEnd) {
  try {
    const command = await post("/api/commands", { arguments: argumentsOfIt });
    for (const other of opened) if (ended.has(other)) opened.delete(other);
    opened.add(command.id);
    if (onEnd) whenEnded.set(command.id, onEnd);
    poll();
    return command.id;
  } catch (error) {
    showError(`${lineOf(argumentsOfIt)}\n${error.message}`);
    return null;
  }
}

/** What commands call a run: its name, or its directory where two live runs share the name. */
function called(run) {
  const isShared = state.live.filter((one) => one.run === run.name).length > 1;
  const live = liveOf(run);
  return isShared && live ? live.directory : run.name;
}

function control(action, onEnd) {
  const one = runOf(chosenRun);
  if (one) run(["control", "--run", called(one), ...action], onEnd);
}

/** The environment that map and vehicles are of, counted from 0. */
const environment = () => Number(byId("environment").value || 0);

/** The option that names the environment; none in a run that has one. */
const ofEnvironment = () => (byId("environment-label").hidden ? [] : ["--env", String(environment())]);

const runOf = (id) => state.runs.find((one) => one.id === id);
const liveOf = (run) => state.live.find((one) => one.directory === run.id || (one.run === run.name && run.alive));

function outcome(command) {
  if (command.exit_code === null) return ["busy", `running ${command.wall_s.toFixed(0)} s`];
  if (command.exit_code === 0) return ["good", "done"];
  if (command.exit_code === 130 || command.exit_code === -2) return ["", "ended by Ctrl-C"];
  return ["failed", `failed (${command.exit_code})`];
}

function commandItem(command) {
  const [className, text] = outcome(command);
  const item = h("li", { id: `command-${command.id}` });
  const output = h("pre", { className: "output", hidden: !opened.has(command.id) });
  const interrupt = h("button", { type: "button", textContent: "Ctrl-C", title: "ends the command in order" });
  interrupt.addEventListener("click", () => attempt(post(`/api/commands/${command.id}/interrupt`)));
  const toggle = h("button", { type: "button", textContent: "output" });
  toggle.addEventListener("click", () => {
    if (!opened.delete(command.id)) opened.add(command.id);
    output.hidden = !opened.has(command.id);
    if (!output.hidden) attempt(showOutput(command.id));
  });
  const copy = h("button", { type: "button", textContent: "copy" });
  copy.addEventListener("click", () => attempt(navigator.clipboard.writeText(command.line)));
  const status = h("span", { className: `status ${className}`, textContent: text });
  interrupt.hidden = command.exit_code !== null;
  item.append(h("code", { textContent: `$ ${command.line}` }), " ", status, " ", interrupt, toggle, copy, output);
  return item;
}

async function showOutput(number) {
  const output = document.querySelector(`#command-${number} .output`);
  if (!output) return null;
  const command = await get(`/api/commands/${number}`);
  const text = command.output.join("\n");
  if (output.textContent !== text) {
    output.textContent = text;
    output.scrollTop = output.scrollHeight;
  }
  output.dataset.lines = command.lines;
  return command;
}

async function showCommands() {
  const list = byId("commands");
  for (const command of [...state.commands].reverse()) {
    let item = byId(`command-${command.id}`);
    if (!item) list.prepend((item = commandItem(command)));
    const [className, text] = outcome(command);
    const status = item.querySelector(".status");
    status.className = `status ${className}`;
    status.textContent = text;
    item.querySelector("button").hidden = command.exit_code !== null;
    const output = item.querySelector(".output");
    output.hidden = !opened.has(command.id);
    if (opened.has(command.id) && Number(output.dataset.lines ?? -1) !== command.lines) {
      await showOutput(command.id);
    }
    if (command.exit_code !== null && !ended.has(command.id)) {
      ended.add(command.id);
      const onEnd = whenEnded.get(command.id);
      whenEnded.delete(command.id);
      if (!onEnd && !opened.has(command.id)) continue;
      const { output: lines } = await get(`/api/commands/${command.id}`);
      if (className === "failed") showError(`$ ${command.line}\n${lines.slice(-12).join("\n")}`);
      onEnd?.(lines, command.exit_code);
    }
  }
}

// --- runs -----------------------------------------------------------------------------------------------------------

function button(text, onClick, title = "") {
  const element = h("button", { type: "button", textContent: text, title });
  element.addEventListener("click", onClick);
  return element;
}

function runState(one) {
  if (one.alive) return ["busy", "alive"];
  const error = one.error ? `, ${one.error}` : "";
  return [one.result === "failed" ? "failed" : "", `${one.result ?? "ended without a report"}${error}`];
}

function runButtons(one) {
  const found = [];
  if (one.alive) found.push(button("stop", () => run(["stop", called(one)]), "ends the run in order, with a report; a trainer writes a checkpoint first"));
  if (!one.alive && one.mode === "train" && one.result !== "completed") {
    found.push(button("resume", () => run(["train", "--resume", one.name, ...runsOption()]), "continues where it stopped"));
  }
  if (!one.alive && one.checkpoint) {
    found.push(button("play", () => run(["play", one.name, ...runsOption()]), "shows what the run has learnt"));
  }
  if (!one.alive && one.recording) found.push(button("replay", () => run(["replay", one.name, ...runsOption()])));
  return found;
}

function showRuns() {
  const body = byId("runs").tBodies[0];
  const drawn = JSON.stringify([state.runs, chosenRun, state.live.map((one) => one.directory)]);
  if (body.dataset.drawn === drawn) return;
  body.dataset.drawn = drawn;
  body.replaceChildren(...state.runs.map((one) => {
    const tick = h("input", { type: "checkbox", checked: ticked.has(one.id), title: "compare" });
    tick.addEventListener("change", () => {
      if (tick.checked) ticked.add(one.id);
      else ticked.delete(one.id);
      byId("compare").disabled = ticked.size < 2;
    });
    const name = h("td", { textContent: one.name });
    name.addEventListener("click", () => choose(one.id));
    const [className, text] = runState(one);
    const row = h("tr", { className: one.id === chosenRun ? "chosen" : "" }, h("td", {}, tick), name,
      h("td", { textContent: one.mode }), h("td", { className, textContent: text }), h("td", {}, ...runButtons(one)));
    row.dataset.run = one.id;
    return row;
  }));
}

function choose(id) {
  if (id === chosenRun) return;
  chosenRun = id;
  mapOf = null;
  users = [];
  details = null;
  showMap(null);
  byId("map-status").textContent = "";
  byId("log").textContent = "";
  setOptions(byId("environment"), []);
  setOptions(byId("vehicle"), []);
  wantedVehicle = null;
  byId("log-line").textContent = "";
  byId("curriculum").replaceChildren();
  byId("plots").replaceChildren();
  showFrame();
  showRuns();
  showRun();
  attempt(showDetails());
}

function showRun() {
  const one = runOf(chosenRun);
  byId("run").hidden = !one;
  if (!one) return;
  const live = liveOf(one);
  const [, text] = runState(one);
  byId("run-title").textContent = `${one.name}: ${one.mode}, ${text}`;
  for (const name of TABS) byId(`tab-${name}`).hidden = name !== tab;
  for (const element of byId("tabs").children) element.classList.toggle("chosen", element.dataset.tab === tab);
  for (const element of document.querySelectorAll("#tab-control button, #view-start")) element.disabled = !live;
  byId("handover-form").hidden = one.mode !== "train";
  const environments = (live?.environments ?? []).map((row) => String(row.environment));
  if (live) setOptions(byId("environment"), environments);
  byId("environment-label").hidden = environments.length < 2;
  byId("time").textContent = environments.length < 2 ? "Time" : "Time, in all environments";
  if (tab === "processes") showProcesses(one, live);
}

function showProcesses(one, live) {
  byId("ps-line").textContent = lineOf(["ps", called(one)]);
  const columns = ["process", "state", "pid", "tick", "ticks_per_s", "lag", "drops", "restarts", "memory_mib", "waits_for"];
  const titles = ["process", "state", "pid", "tick", "ticks/s", "lag", "drops", "restarts", "memory, MiB", "waits for"];
  byId("processes").tHead.replaceChildren(h("tr", {}, ...titles.map((textContent) => h("th", { textContent }))));
  const supervisor = { process: "supervisor", state: "running", pid: live?.supervisor_pid, memory_mib: live?.supervisor_memory_mib };
  const rows = live ? [supervisor, ...live.processes] : [];
  byId("processes").tBodies[0].replaceChildren(...rows.map((row) => {
    const element = h("tr", {}, ...columns.map((column) => {
      const value = row[column] ?? "";
      const text = typeof value === "number" && !Number.isInteger(value) ? value.toFixed(0) : String(value);
      return h("td", { className: typeof value === "number" ? "number" : "", textContent: text });
    }));
    element.dataset.process = row.process;
    return element;
  }));
  const environments = (live?.environments ?? []).map((row) => h("p", {
    textContent: `environment ${row.environment}: episode ${row.episode}, ${row.sim_time_s.toFixed(1)} s, ${row.cavs} of ` +
      `${row.road_users} road users sensing, ${row.arrived} arrived, ${row.steps_per_s.toFixed(0)} steps/s, ` +
      `${row.real_time_factor.toFixed(1)} × real time` }));
  const training = live?.training;
  const learned = training ? [h("p", { textContent: `trainer: ${training.updates} updates, ${training.metrics}, reward ` +
    `${training.reward.toFixed(3)}, σ ${training.policy_std.toFixed(3)}` })] : [];
  byId("environments").replaceChildren(...environments, ...learned);
}

/** Logs, plots, checkpoints and curriculum of the chosen run. */
async function showDetails() {
  const id = chosenRun;
  if (!runOf(id)) return;
  const found = await get("/api/run", { run: id });
  if (id !== chosenRun) return;
  details = found;
  setOptions(byId("log-name"), found.logs);
  const names = found.checkpoints.map((path) => path.split("/").pop());
  setOptions(byId("handover-checkpoint"), ["", ...found.checkpoints], ["the newest parameters", ...names]);
  if (tab === "curriculum") showCurriculum(found.curriculum);
  if (tab === "logs") await showLog();
  if (tab === "plots") await showPlots(byId("plots"), [id]);
}

function showCurriculum(stages) {
  const reached = stages.findLastIndex((stage) => stage.since.length > 0);
  const note = stages.length ? `stage ${reached + 1} of ${stages.length}` : "The run has no curriculum (curriculum.stages).";
  const rows = stages.map((stage, index) => {
    const since = stage.since.map((entry) => `lesson ${entry.lesson} (tick ${entry.tick})`).join(", ");
    const progress = index < reached ? "done" : index === reached ? "now" : "";
    return h("tr", { className: index === reached ? "chosen" : "" }, h("td", { textContent: String(index + 1) }),
      h("td", { className: progress === "now" ? "busy" : "good", textContent: progress }),
      h("td", { textContent: since || "–" }),
      h("td", { textContent: Object.entries(stage.settings).map(([name, value]) => `${name} ${JSON.stringify(value)}`).join(", ") }));
  });
  const head = h("tr", {}, ...["stage", "", "since", "settings"].map((textContent) => h("th", { textContent })));
  byId("curriculum").replaceChildren(h("p", { textContent: note }),
    ...(stages.length ? [h("table", {}, h("thead", {}, head), h("tbody", {}, ...rows))] : []));
}

async function showLog() {
  const name = byId("log-name").value;
  if (!name) return;
  const log = await get("/api/log", { run: chosenRun, name });
  const text = log.lines.join("\n");
  const element = byId("log");
  byId("log-line").textContent = `tail -n ${log.lines.length} ${quoted(log.path)}`;
  if (element.textContent === text) return;
  element.textContent = text;
  element.scrollTop = element.scrollHeight;
}

/** The plots of runs, one row for each name; those with an equal name side by side. */
async function showPlots(element, ids) {
  const found = await Promise.all(ids.map((id) => get("/api/run", { run: id })));
  const names = [...new Set(found.flatMap((one) => one.plots))];
  const pictures = [];
  for (const name of names) {
    for (const [index, id] of ids.entries()) {
      if (!found[index].plots.includes(name)) continue;
      const picture = h("img", { src: await getPicture("/api/plot", { run: id, name }), alt: `${name} of ${id}`, title: id });
      pictures.push(h("figure", {}, h("figcaption", { className: "help", textContent: `${id}: ${name}` }), picture));
    }
  }
  for (const old of element.querySelectorAll("img")) URL.revokeObjectURL(old.src);
  element.replaceChildren(...(pictures.length ? pictures : [h("p", { className: "help", textContent: "no plots yet" })]));
}

function compare() {
  const ids = [...ticked].filter(runOf);
  run(["compare", ...ids, ...runsOption()], async (lines) => {
    byId("comparison").hidden = false;
    byId("comparison").textContent = lines.join("\n");
    await attempt(showPlots(byId("comparison-plots"), ids));
  });
}

// --- map, vehicles, sensors -----------------------------------------------------------------------------------------

const placing = () => document.querySelector("input[name=place]:checked").value;

async function showRoadUsers() {
  const one = runOf(chosenRun);
  if (!one || !liveOf(one) || tab !== "control") return;
  const shown = { run: one.id, environment: environment() };
  const isLeft = () => shown.run !== chosenRun || shown.environment !== environment();
  if (mapOf !== JSON.stringify(shown)) {
    const loaded = await get("/api/map", shown);
    if (isLeft()) return;
    showMap(loaded);
    mapOf = JSON.stringify(shown);
  }
  const found = await get("/api/users", shown);
  if (isLeft()) return;
  users = found.users;
  byId("map").dataset.environment = shown.environment;
  byId("map-status").textContent = `tick ${found.tick}, episode ${found.episode}, ${users.length} road users`;
  const vehicles = users.filter((user) => user.kind !== "person").map((user) => user.id);
  const order = (a, b) => a.localeCompare(b, "en", { numeric: true });
  const select = byId("vehicle");
  const kept = select.value;
  // A vehicle that has left stays chosen until another one is.
  const gone = kept && kept !== "all" && !vehicles.includes(kept) ? [kept] : [];
  const listed = vehicles.sort(order);
  setOptions(select, [...gone, ...listed, "all"], [...gone.map((id) => `${id} (gone)`), ...listed, "all"]);
  if (wantedVehicle && vehicles.includes(wantedVehicle)) {
    select.value = wantedVehicle;
    wantedVehicle = null;
  }
  showVehicle();
}

function showVehicle() {
  const id = byId("vehicle").value;
  const user = users.find((one) => one.id === id);
  showUsers(users, id);
  byId("vehicle-state").textContent = user
    ? `${user.kind}, ${user.speed_mps.toFixed(1)} m/s, sensors: ${user.sensors === null ? "none" : user.sensors.join(", ") || "all off"}`
    : id === "all" ? "all vehicles with sensors" : "not on the road";
}

function place(edge) {
  const id = byId("vehicle").value;
  if (!id || id === "all") showError("choose one vehicle first");
  else {
    // A vehicle that starts anew has a new id.
    control([...ofEnvironment(), placing(), id, edge], (lines) => {
      wantedVehicle = lines.join("\n").match(/leaves, (\S+) starts/)?.[1] ?? null;
    });
  }
}

// --- handover -------------------------------------------------------------------------------------------------------

const handoverKey = () => keys.keys.find((key) => key.path === byId("handover-key").value);

function showHandoverKey() {
  const key = handoverKey();
  byId("handover-help").textContent = key ? `${key.meaning} Allowed: ${key.allowed}. Preset: ${JSON.stringify(key.default)}.`
    : "The trainer's present code and settings.";
  byId("handover-value").disabled = !key;
}

function handOver() {
  const key = handoverKey();
  const value = byId("handover-value").value.trim();
  const wrong = key ? fault(key, value) : "";
  if (wrong) {
    showError(wrong);
    return;
  }
  const checkpoint = byId("handover-checkpoint").value;
  run(["handover", called(runOf(chosenRun)), ...(key ? ["--set", `${key.path}=${value}`] : []),
    ...(checkpoint ? ["--checkpoint", checkpoint] : []), ...(byId("handover-now").checked ? ["--now"] : [])]);
}

// --- rerun's viewer -------------------------------------------------------------------------------------------------

async function view() {
  const one = runOf(chosenRun);
  const live = one && liveOf(one);
  if (!live || views.has(one.id)) return;
  const number = await run(["view", called(one), ...ofEnvironment(), "--web"], () => {
    views.delete(one.id);
    showFrame();
  });
  if (number !== null) views.set(one.id, { number, address: null });
  showFrame();
}

function hideView() {
  const shown = views.get(chosenRun);
  if (shown) attempt(post(`/api/commands/${shown.number}/interrupt`));
}

/** Embeds the page of the viewer once the command has printed its address. */
function showFrame() {
  const shown = views.get(chosenRun);
  byId("view-status").textContent = !shown ? "rerun's viewer of the run, as `caraware view --web` opens it"
    : shown.address ?? "starting";
  byId("view-end").disabled = !shown;
  const frame = byId("view-frame").querySelector("iframe");
  if (shown?.address && frame?.src !== shown.address) {
    byId("view-frame").replaceChildren(h("iframe", { src: shown.address, title: "rerun" }));
  } else if (!shown?.address && frame) {
    frame.remove();
  }
}

async function findAddresses() {
  for (const shown of views.values()) {
    if (shown.address) continue;
    const { output } = await get(`/api/commands/${shown.number}`);
    const found = output.map((line) => line.match(/open (http:\/\/127\.0\.0\.1:\d+\/)/)).find((match) => match);
    if (found) shown.address = found[1];
  }
  showFrame();
}

// --- polling --------------------------------------------------------------------------------------------------------

/** Waits for a promise; shows its error. */
async function attempt(promise) {
  try {
    await promise;
  } catch (error) {
    showError(error.message);
  }
}

let isPolling = false;

async function poll() {
  if (isPolling) return;
  isPolling = true;
  const connection = byId("connection");
  try {
    state = await get("/api/state");
    connection.textContent = state.error ?? `${state.live.length} live, ${state.runs.length} runs in ${state.runs_directory}`;
    connection.className = state.error ? "error" : "";
    setOptions(byId("sensor"), ["all", ...state.sensors]);
    chooseNewRun();
    showRuns();
    showRun();
    showLine();
    await showCommands();
    await findAddresses();
    await showDetails();
  } catch (error) {
    connection.textContent = error instanceof TypeError ? "the panel does not answer: has it ended?" : error.message;
    connection.className = "error";
  } finally {
    isPolling = false;
  }
}

/** Chooses the first run, and a run that begins while the chosen one is not alive. */
function chooseNewRun() {
  const alive = state.runs.filter((one) => one.alive);
  const begun = alive.filter((one) => !knownAlive.has(one.id));
  knownAlive.clear();
  for (const one of alive) knownAlive.add(one.id);
  if (begun.length && !runOf(chosenRun)?.alive) choose(begun[0].id);
  else if (!runOf(chosenRun) && state.runs.length) choose(state.runs[0].id);
}

async function pollUsers() {
  try {
    await showRoadUsers();
  } catch (error) {
    byId("map-status").textContent = error.message;
  }
  setTimeout(pollUsers, USERS_MS);
}

const showLine = () => {
  byId("start-line").textContent = lineOf(startArguments(runsOption()));
};

function listen() {
  byId("banner-close").addEventListener("click", () => { byId("banner").hidden = true; });
  byId("compare").addEventListener("click", compare);
  byId("start").addEventListener("submit", (event) => {
    event.preventDefault();
    run(startArguments(runsOption()));
  });
  byId("own").addEventListener("submit", (event) => {
    event.preventDefault();
    const typed = words(byId("own-line").value);
    run(typed[0] === "caraware" ? typed.slice(1) : typed);
  });
  byId("tabs").append(...TABS.map((name) => {
    const element = button(name, () => {
      tab = name;
      showRun();
      attempt(showDetails());
    });
    element.dataset.tab = name;
    return element;
  }));
  byId("pause").addEventListener("click", () => control(["pause"]));
  byId("resume").addEventListener("click", () => control(["resume"]));
  byId("step").addEventListener("click", () => control(["step", byId("step-ticks").value]));
  byId("reset").addEventListener("click", () => control(["reset"]));
  for (const onOff of ["on", "off"]) {
    const words = () => [...ofEnvironment(), "sensor", byId("vehicle").value, byId("sensor").value, onOff];
    byId(`sensor-${onOff}`).addEventListener("click", () => control(words()));
  }
  byId("environment").addEventListener("change", () => {
    // Each environment has vehicles of its own, under the same ids.
    wantedVehicle = null;
    setOptions(byId("vehicle"), []);
  });
  byId("vehicle").addEventListener("change", showVehicle);
  listenToMap(placing, (id) => { byId("vehicle").value = id; showVehicle(); }, place);
  byId("handover-key").addEventListener("change", showHandoverKey);
  byId("handover").addEventListener("click", handOver);
  byId("view-start").addEventListener("click", view);
  byId("view-end").addEventListener("click", hideView);
  byId("log-name").addEventListener("change", () => attempt(showLog()));
}

async function begin() {
  listen();
  await poll();
  try {
    keys = await get("/api/keys");
    buildForm(keys, showLine);
    const trainer = keys.keys.filter((key) => key.path.startsWith("trainer.")).map((key) => key.path);
    setOptions(byId("handover-key"), ["", ...trainer], ["nothing", ...trainer]);
    showHandoverKey();
    document.body.dataset.ready = "true";
  } catch (error) {
    showError(error.message);
  }
  setInterval(poll, POLL_MS);
  pollUsers();
}

/** For tests: where a road user and the middle of a road are on the canvas. */
window.panelMap = { toCanvas, nearestEdge, map: shownMap, users: () => users };

begin();
