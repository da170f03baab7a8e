// The keyboard: everything can be reached by Tab; these keys are shorter ways. Single letters can be switched off, for those who speak to
// their computer.
import * as chosen from "./chosen.js";

const SWITCH = "rotorwatch-keys";
const get = (id) => document.getElementById(id);
const rows = () => [...document.querySelectorAll("#list tbody tr")];

/** What can have the focus in a row: its box, the report, the moment. */
export function parts(row) {
  return [...row.querySelectorAll("input, a")];
}

export function start() {
  const use = get("use-keys");
  use.checked = stored() !== "off";
  use.addEventListener("change", () => stored(use.checked ? "on" : "off"));
  get("show-keys").addEventListener("click", () => get("keys").showModal());
  get("keys-close").addEventListener("click", () => get("keys").close());
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const row = event.target.closest?.("#list tbody tr");
    const done = row ? inList(event, row) : elsewhere(event);
    if (done) event.preventDefault();
  });
}

/** Whether the key meant something in a row of the list. */
function inList(event, row) {
  const all = rows(), at = all.indexOf(row), own = parts(row), part = own.indexOf(event.target);
  const to = (next) => {
    if (next) (parts(next)[part] ?? parts(next)[1]).focus();
    return true;
  };
  const flight = own[0].flight;
  switch (event.key) {
    case "ArrowDown":
      if (at === all.length - 1 && !get("more").hidden) get("more").focus();
      return to(all[at + 1]);
    case "ArrowUp":
      return to(all[at - 1]);
    case "Home":
      return to(all[0]);
    case "End":
      return to(all.at(-1));
    case "ArrowRight":
    case "ArrowLeft":
      own[part + (event.key === "ArrowRight" ? 1 : -1)]?.focus();
      return true;
    case "Delete":
      chosen.erase(flight);
      return true;
    case "Escape":
      return chosen.none();
  }
  if (!get("use-keys").checked) return false;
  switch (event.key) {
    case "x":
      own[0].click();
      return true;
    case "c":
      chosen.compare();
      return true;
    case "d":
      location.assign(`/flights/${flight.hash}/download`);
      return true;
  }
  return elsewhere(event);
}

function elsewhere(event) {
  const search = get("search");
  if (event.target === search) {
    if (event.key === "ArrowDown" && rows().length) parts(rows()[0])[1].focus();
    else if (event.key === "Escape" && search.value) {
      search.value = "";
      search.dispatchEvent(new Event("input"));
    } else return false;
    return true;
  }
  if (event.target === get("more") && event.key === "ArrowUp") {
    parts(rows().at(-1))[1].focus();
    return true;
  }
  if (event.key === "Escape") return chosen.none();
  const types = event.target.matches?.("input:not([type=checkbox]), select, textarea");
  if (types || !get("use-keys").checked) return false;
  if (event.key === "?") get("keys").showModal();
  else if (event.key === "/") search.focus();
  else return false;
  return true;
}

/** What the browser remembers of the switch; some let no page remember anything. */
function stored(value) {
  try {
    if (value) localStorage.setItem(SWITCH, value);
    return localStorage.getItem(SWITCH);
  } catch {
    return null;
  }
}
