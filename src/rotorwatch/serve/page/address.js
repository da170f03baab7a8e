// Filters and order of the list stand in the page's address, by the names of the API: such an address can be linked, and survives a reload.
import { make } from "./dom.js";

export const NAMES = ["search", "verdict", "aircraft", "since", "until", "min_loss", "min_duration", "sort"];
const NEWEST = "-date";
let state = {};

const control = (name) => document.getElementById(name);

/** onChange: called after every change, by the page's controls or by going back and forth. */
export function start(onChange) {
  read();
  let wait;
  control("search").addEventListener("input", () => {
    clearTimeout(wait);
    wait = setTimeout(() => change({ search: control("search").value }, onChange, true), 200);
  });
  control("find").addEventListener("submit", (event) => {
    event.preventDefault();
    clearTimeout(wait);
    change({ search: control("search").value }, onChange, true);
  });
  for (const name of NAMES.slice(1)) control(name).addEventListener("change", () => change({ [name]: control(name).value }, onChange));
  control("clear").addEventListener("click", () => {
    change(Object.fromEntries(NAMES.filter((name) => name !== "sort").map((name) => [name, ""])), onChange);
    control("search").focus();
  });
  addEventListener("popstate", () => {
    read();
    onChange();
  });
}

/** What is asked for, as parameters of the API. */
export function asked() {
  return new URLSearchParams(state);
}

/** Whether anything but the order is asked for. */
export function filtered() {
  return Object.keys(state).some((name) => name !== "sort");
}

export function sort() {
  return state.sort ?? NEWEST;
}

/** Ask for other values; empty: all. typing: the address is replaced, so that going back does not go through every letter. */
export function change(values, onChange, typing = false) {
  Object.assign(state, values);
  tidy();
  const query = asked().toString();
  const to = `${location.pathname}${query ? `?${query}` : ""}${location.hash}`;
  if (to !== location.pathname + location.search + location.hash) history[typing ? "replaceState" : "pushState"](null, "", to);
  show();
  onChange();
}

/** The aircraft that can be chosen. */
export function aircraft(list) {
  const own = state.aircraft;
  const options = list.map((one) => make("option", { value: one.name }, `${one.name} (${one.flights})`));
  control("aircraft").replaceChildren(make("option", { value: "" }, "any"), ...options);
  set(control("aircraft"), own ?? "");
}

function read() {
  const given = new URLSearchParams(location.search);
  state = Object.fromEntries(NAMES.filter((name) => given.get(name)).map((name) => [name, given.get(name)]));
  tidy();
  show();
  control("filters").open ||= Object.keys(state).some((name) => name !== "search") || matchMedia("(min-width: 721px)").matches;
}

function tidy() {
  if (state.sort === NEWEST) state.sort = "";
  for (const name of NAMES) if (!state[name]?.trim()) delete state[name];
}

function show() {
  for (const name of NAMES) if (document.activeElement !== control(name) || name !== "search") set(control(name), state[name] ?? (name === "sort" ? NEWEST : ""));
  control("clear").hidden = !filtered();
}

/** Show a value, also one that was linked and that the control would not offer. */
function set(element, value) {
  if (element.tagName === "SELECT" && ![...element.options].some((option) => option.value === value)) element.append(make("option", { value }, value));
  if (element.name === "since" || element.name === "until") element.type = !value || /^\d{4}-\d\d-\d\d$/.test(value) ? "date" : "text";
  if (element.value !== value) element.value = value;
}
