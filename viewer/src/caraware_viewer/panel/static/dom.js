// Elements, requests with the key of the address, and the errors that the page shows.

export const byId = (id) => document.getElementById(id);

/** An element with properties and children; texts stay texts. */
export function h(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Replaces the options of a select, and keeps the choice if it still exists. */
export function setOptions(select, values, labels = values) {
  const wanted = JSON.stringify([values, labels]);
  if (select.dataset.options === wanted) return;
  const chosen = select.value;
  select.replaceChildren(...values.map((value, index) => h("option", { value, textContent: labels[index] })));
  if (values.includes(chosen)) select.value = chosen;
  select.dataset.options = wanted;
}

/** A word as a shell needs it. */
export const quoted = (word) => (/^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\"'\"'")}'`);

/** Words of a line, with the quotation marks of a shell. */
export function words(line) {
  const found = [];
  let word = null;
  for (let at = 0, quote = null; at < line.length; at += 1) {
    const sign = line[at];
    if (quote !== null) {
      if (sign === quote) quote = null;
      else word += sign;
    } else if (sign === "'" || sign === '"') {
      quote = sign;
      word ??= "";
    } else if (/\s/.test(sign)) {
      if (word !== null) found.push(word);
      word = null;
    } else word = (word ?? "") + sign;
  }
  return word === null ? found : [...found, word];
}

/** Shows an error at the top until it is closed. */
export function showError(text) {
  byId("banner-text").textContent = text;
  byId("banner").hidden = false;
}

// The fragment never leaves the browser; every request carries it as a header, which no other page can send.
const key = () => decodeURIComponent(location.hash.slice(1));

async function request(path, options = {}) {
  const headers = { Authorization: `Bearer ${key()}`, ...(options.body ? { "Content-Type": "application/json" } : {}) };
  const response = await fetch(path, { ...options, headers, cache: "no-store" });
  if (!response.ok) {
    const document = await response.json().catch(() => ({}));
    throw new Error(document.error ?? `${response.status} ${response.statusText}`);
  }
  return response;
}

export const get = async (path, parameters = {}) =>
  (await request(`${path}?${new URLSearchParams(parameters)}`)).json();

export const getPicture = async (path, parameters) =>
  URL.createObjectURL(await (await request(`${path}?${new URLSearchParams(parameters)}`)).blob());

export const post = async (path, document = {}) =>
  (await request(path, { method: "POST", body: JSON.stringify(document) })).json();
