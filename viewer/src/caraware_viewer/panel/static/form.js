// The form of a run: a field for each configuration key, from the table of `caraware keys --json`.

import { byId, h, quoted } from "./dom.js";

const NUMBERS = new Set(["float", "integer"]);
/** Kinds of `caraware keys --json` as the form names them. */
const TYPES = { float: "number", integer: "whole number", flag: "switch", choice: "one of", floats: "numbers", integers: "whole numbers",
  span: "shortest and longest", texts: "list", tables: "list" };
/** Longest list of allowed values that is shown. */
const LONG = 200;

let catalogue = { presets: [], keys: [] };
/** Values that differ from the preset's, as texts, by key. */
const changed = new Map();
let report = () => {};

/** A value as `--set` takes it. */
const asText = (value) => (value === null ? "" : typeof value === "string" ? value : toml(value));

function toml(value) {
  if (Array.isArray(value)) return `[${value.map(toml).join(", ")}]`;
  if (value === null || typeof value !== "object") return JSON.stringify(value);
  const entries = Object.entries(value).filter(([, one]) => one !== null);
  return `{${entries.map(([name, one]) => `${name} = ${toml(one)}`).join(", ")}}`;
}

const preset = () => catalogue.presets.find((one) => one.name === byId("start-preset").value) ?? { values: {} };
const presetValue = (key) => (key.path in preset().values ? preset().values[key.path] : key.default);

/** Why a text is no value of a key; empty if it is one. */
export function fault(key, text) {
  if (!NUMBERS.has(key.kind)) return "";
  const number = Number(text);
  if (text.trim() === "" || !Number.isFinite(number)) return `${key.path} is a number: ${key.allowed}`;
  if (key.kind === "integer" && !/^[+-]?\d+$/.test(text.trim())) return `${key.path} is a whole number: ${key.allowed}`;
  if (number < key.min || number > key.max) return `${key.path} allows ${key.allowed}${key.unit ? ` ${key.unit}` : ""}`;
  return "";
}

function field(key) {
  if (key.kind === "flag") return choice(["true", "false"]);
  if (key.kind === "choice") return choice(key.choices);
  const input = h("input", { placeholder: key.optional ? "unset" : "", spellcheck: false });
  // Not type=number, which shows and takes numbers by the language of the browser.
  if (NUMBERS.has(key.kind)) input.inputMode = "decimal";
  return input;
}

const choice = (values) => h("select", {}, ...values.map((value) => h("option", { value, textContent: value })));

function row(key) {
  const input = field(key);
  input.id = `key-${key.path}`;
  const name = key.path.slice(key.path.indexOf(".") + 1);
  const unit = key.unit ? ` ${key.unit}` : "";
  const allowed = key.allowed.length > LONG ? `${key.allowed.slice(0, LONG)} …` : key.allowed;
  const element = h("div", { className: "key" },
    h("label", {}, h("span", { textContent: name }), h("span", {}, input, unit)),
    h("div", { className: "help", textContent: key.meaning }),
    h("div", { className: "help", textContent: `${TYPES[key.kind] ?? key.kind}: ${allowed}${unit}; default ${asText(key.default) || "none"}` }));
  element.dataset.path = key.path;
  input.addEventListener("input", () => {
    if (input.value === asText(presetValue(key))) changed.delete(key.path);
    else changed.set(key.path, input.value);
    update();
  });
  return element;
}

/** Writes the values of the preset into the fields that are not changed, and marks those that are. */
function fill() {
  for (const key of catalogue.keys) {
    if (!changed.has(key.path)) byId(`key-${key.path}`).value = asText(presetValue(key));
  }
  update();
}

function update() {
  const faults = [];
  for (const key of catalogue.keys) {
    const input = byId(`key-${key.path}`);
    const isChanged = changed.has(key.path);
    const wrong = isChanged ? fault(key, input.value) : "";
    input.classList.toggle("wrong", wrong !== "");
    input.closest(".key").classList.toggle("changed", isChanged);
    if (wrong) faults.push(wrong);
  }
  for (const section of document.querySelectorAll("#keys details")) {
    section.classList.toggle("changed", section.querySelector(".key.changed") !== null);
  }
  byId("start-error").textContent = faults.join("; ");
  byId("start-button").disabled = faults.length > 0;
  byId("start-purpose").textContent = byId("start-file").value ? "" : preset().purpose ?? "";
  report();
}

function filter() {
  const wanted = byId("key-filter").value.trim().toLowerCase();
  for (const section of document.querySelectorAll("#keys details")) {
    let found = 0;
    for (const element of section.querySelectorAll(".key")) {
      const key = catalogue.keys.find((one) => one.path === element.dataset.path);
      element.hidden = wanted !== "" && !`${key.path} ${key.meaning}`.toLowerCase().includes(wanted);
      found += element.hidden ? 0 : 1;
    }
    section.hidden = found === 0;
    section.open = wanted !== "" && found > 0;
  }
}

/** The words after `caraware` that start the run of the form. */
export function startArguments(runsOption) {
  const file = byId("start-file").value.trim();
  const name = byId("start-name").value.trim();
  const sets = [...changed].flatMap(([path, value]) => ["--set", `${path}=${value}`]);
  return [byId("start-mode").value, file || byId("start-preset").value, ...sets, ...(name ? ["--name", name] : []), ...runsOption];
}

export const lineOf = (words) => ["caraware", ...words].map(quoted).join(" ");

/** Builds the form; calls `onChange` after every change of the command. */
export function buildForm(table, onChange) {
  catalogue = table;
  report = onChange;
  byId("start-preset").replaceChildren(...table.presets.map((one) => h("option", { value: one.name, textContent: one.name })));
  const sections = Map.groupBy ? Map.groupBy(table.keys, sectionOf) : grouped(table.keys);
  byId("keys").replaceChildren(...[...sections].map(([name, keys]) =>
    h("details", {}, h("summary", { textContent: `${name} (${keys.length})` }), ...keys.map(row))));
  byId("start-preset").addEventListener("change", fill);
  for (const id of ["start-mode", "start-file", "start-name"]) byId(id).addEventListener("input", update);
  byId("key-filter").addEventListener("input", filter);
  byId("keys-reset").addEventListener("click", () => {
    changed.clear();
    fill();
  });
  fill();
}

const sectionOf = (key) => key.path.slice(0, key.path.indexOf("."));

function grouped(keys) {
  const sections = new Map();
  for (const key of keys) sections.set(sectionOf(key), [...(sections.get(sectionOf(key)) ?? []), key]);
  return sections;
}
