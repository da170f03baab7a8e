// Flights that are chosen in the list: two are compared, one is downloaded, any are deleted.
import { make, say } from "./dom.js";

const chosen = new Map(); // hash -> flight, in the order in which they were chosen
let deletes = false, refresh = () => {}, asked = []; // asked: flights of the open question

const get = (id) => document.getElementById(id);
const name = (flight) => make("li", {}, make("bdi", {}, flight.name), make("span", { class: "why" }, ` ${flight.headline}`));

/** onDeleted: called when flights are gone. */
export function start(onDeleted) {
  refresh = onDeleted;
  get("unchoose").addEventListener("click", () => {
    none();
    get("search").focus();
  });
  get("delete").addEventListener("click", () => question([...chosen.values()]));
  get("sure-no").addEventListener("click", () => get("sure").close());
  get("sure-yes").addEventListener("click", remove);
}

/** Whether this server deletes. */
export function mayDelete(may) {
  deletes = may;
  for (const element of document.querySelectorAll(".deletes")) element.hidden = !may;
  show();
}

/** The box of a row. */
export function bind(box, flight) {
  box.checked = chosen.has(flight.hash);
  box.flight = flight;
  box.addEventListener("change", () => {
    if (box.checked) chosen.set(flight.hash, flight);
    else chosen.delete(flight.hash);
    show();
  });
}

export function forget(hash) {
  if (chosen.delete(hash)) show();
}

/** Choose no flight; whether any was chosen. */
export function none() {
  const any = chosen.size > 0;
  chosen.clear();
  for (const box of document.querySelectorAll("#list .choice input")) box.checked = false;
  show();
  return any;
}

/** Open the comparison, or say what is missing. */
export function compare() {
  show();
  if (chosen.size === 2) location.assign(get("compare").href);
  else {
    get("chosen").hidden = false;
    say(get("chosen-count"), `Choose two flights to compare them; ${chosen.size || "none"} chosen.`);
  }
}

/** Ask whether flights are to be deleted: those that are chosen, or this one. */
export function erase(flight) {
  if (deletes) question(chosen.size ? [...chosen.values()] : [flight]);
}

function show() {
  const [a, b] = chosen.keys(), count = chosen.size;
  get("chosen").hidden = !count;
  document.body.classList.toggle("choosing", count > 0);
  say(get("chosen-count"), !count ? "" : count === 1 ? "1 flight chosen; with a second one they can be compared." : `${count} flights chosen`);
  get("compare").hidden = count !== 2;
  if (count === 2) get("compare").href = `/compare?a=${a}&b=${b}`;
  get("download").hidden = count !== 1;
  if (count === 1) get("download").href = `/flights/${a}/download`;
  get("delete").hidden = !count || !deletes;
}

function question(flights) {
  asked = flights;
  say(get("sure-title"), flights.length === 1 ? "Delete this flight?" : `Delete these ${flights.length} flights?`);
  get("sure-list").replaceChildren(...flights.map(name));
  say(get("sure-trouble"), "");
  get("sure").showModal();
  get("sure-no").focus();
}

async function remove() {
  get("sure-yes").disabled = true;
  let trouble = "", count = 0;
  for (const flight of asked) {
    try {
      const answer = await fetch(`/api/flights/${flight.hash}`, { method: "DELETE" });
      if (answer.ok || answer.status === 404) count++; // 404: somebody else was quicker
      else trouble = `${flight.name}: ${(await answer.json()).error}`;
      if (answer.ok || answer.status === 404) chosen.delete(flight.hash);
    } catch {
      trouble = "The server does not answer; is it still running?";
    }
    if (trouble) break;
  }
  get("sure-yes").disabled = false;
  show();
  if (trouble) {
    say(get("sure-trouble"), `${trouble} ${count ? `${count} of ${asked.length} were deleted.` : "Nothing was deleted."}`);
    asked = asked.slice(count);
  } else {
    get("sure").close(); // the focus goes back to where it was; the button is hidden now
    if (document.activeElement === document.body) get("search").focus({ preventScroll: true });
    say(get("alarm"), count === 1 ? `${asked[0].name} is deleted.` : `${count} flights are deleted.`);
  }
  if (count) refresh();
}
