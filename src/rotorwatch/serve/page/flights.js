// The list of flights: found, sorted, chosen and opened.
import * as address from "./address.js";
import * as chosen from "./chosen.js";
import { fetched, make, percent, say, SIGNS } from "./dom.js";
import * as keys from "./keys.js";
import * as uploads from "./uploads.js";

const PAGE = 50, MOST = 200; // flights that are shown first; of one answer
const SOON_MS = 50;
let shown = 0;
let soon = null;
let queries = 0;

const body = () => document.querySelector("#list tbody");

export function start() {
  uploads.start(refresh);
  address.start(() => load(0, PAGE));
  chosen.start(refresh);
  keys.start();
  for (const button of document.querySelectorAll("#list [data-sort]"))
    button.addEventListener("click", () => {
      const first = button.dataset.sort, now = address.sort();
      address.change({ sort: now !== first ? first : first.startsWith("-") ? first.slice(1) : `-${first}` }, () => load(0, PAGE));
    });
  document.getElementById("more").addEventListener("click", () => load(shown, PAGE));
  about();
  load(0, PAGE);
  names();
}

/** A flight is new or gone, here or in another tab. Many at once are looked up once. */
export function refresh() {
  soon ??= setTimeout(() => {
    soon = null;
    load(0, Math.max(shown, PAGE));
    names();
  }, SOON_MS);
}

/** A flight is gone. */
export function gone({ hash }) {
  chosen.forget(hash);
  refresh();
}

async function about() {
  const answer = await fetched("/api/about", trouble);
  if (!answer) return;
  uploads.limit(answer.most);
  chosen.mayDelete(answer.may_delete);
  say(document.getElementById("version"), `rotorwatch ${answer.version}.`);
}

async function names() {
  const answer = await fetched("/api/aircraft", trouble);
  if (answer) address.aircraft(answer.aircraft);
}

/** refused: the list would be another one than what is asked for. */
function trouble(text, refused = false) {
  say(document.getElementById("found"), text);
  if (!refused) return;
  for (const id of ["list", "more"]) document.getElementById(id).hidden = true;
}

/** `count` flights from number `offset` on, in place of those or after those that are shown. */
async function load(offset, count) {
  const mine = ++queries, flights = [];
  let total = 0;
  do {
    const asked = address.asked();
    asked.set("limit", Math.min(count - flights.length, MOST));
    asked.set("offset", offset + flights.length);
    const found = await fetched(`/api/flights?${asked}`, trouble);
    if (!found || mine !== queries) return; // a later query is on its way
    flights.push(...found.flights);
    total = found.total;
    if (!found.flights.length) break;
  } while (flights.length < Math.min(count, total - offset));
  const rows = flights.map(row);
  if (offset) body().append(...rows);
  else replace(rows);
  shown = offset + rows.length;
  document.getElementById("list").hidden = !shown;
  document.getElementById("more").hidden = shown >= total;
  for (const button of document.querySelectorAll("#list [data-sort]")) {
    const sort = address.sort(), own = button.dataset.sort.replace("-", "");
    const way = sort === own ? "ascending" : sort === `-${own}` ? "descending" : null;
    if (way) button.parentElement.setAttribute("aria-sort", way);
    else button.parentElement.removeAttribute("aria-sort");
  }
  const many = `${total.toLocaleString("en")} flight${total === 1 ? "" : "s"}`;
  if (total) trouble(address.filtered() ? `${many} found` : many);
  else trouble(!address.filtered() ? "No flight yet: drop a log above." : address.asked().get("search") ? "No flight has all these words." : "No flight matches.");
  if (offset && rows.length) rows[0].querySelector("a").focus();
}

/** New rows for old; the focus stays with its flight, or where that is gone with the one that took its place. */
function replace(rows) {
  const at = document.activeElement?.closest?.("#list tbody tr");
  const place = at?.rowIndex - 1, part = at && keys.parts(at).indexOf(document.activeElement);
  body().replaceChildren(...rows);
  if (!at) return;
  const to = rows.find((one) => one.dataset.hash === at.dataset.hash) ?? rows[Math.min(place, rows.length - 1)];
  if (to) (keys.parts(to)[part] ?? keys.parts(to)[1]).focus();
  else document.getElementById("search").focus();
}

function row(f) {
  const began = f.utc ? new Date(f.utc).toISOString().slice(0, 16).replace("T", " ") : "–";
  const loss = f.loss ? percent(f.loss) : "–", duration = `${(f.duration_s ?? 0).toFixed(0)} s`;
  const at = f.onset_s === null ? null : Math.round(100 * f.onset_s) / 100;
  const inName = make("span", { class: "unseen" }, ` in ${f.name}`);
  const moment = at === null ? null : make("a", { href: `/flights/${f.hash}#t=${at}`, class: "moment" }, `see it at ${at.toFixed(2)} s`, inName);
  const box = make("input", { type: "checkbox", "aria-label": `Choose ${f.name}` });
  chosen.bind(box, f);
  const brief = [f.utc && `${began} UTC`, f.aircraft_name, f.loss ? `worst loss ${loss}` : null, duration].filter(Boolean);
  return make(
    "tr",
    { "data-hash": f.hash },
    make("td", { class: "choice" }, make("label", {}, box)),
    make("td", { class: `outcome ${f.verdict}` }, SIGNS[f.verdict] ?? f.verdict),
    make(
      "td",
      {},
      make("a", { href: `/flights/${f.hash}`, class: "name" }, make("bdi", {}, f.name)),
      make("div", { class: "why" }, f.headline, moment && " ", moment),
      make("div", { class: "why brief" }, make("bdi", {}, brief.join(" · "))),
    ),
    make("td", { class: "wide" }, began),
    make("td", { class: "wide craft" }, make("bdi", {}, f.aircraft_name ?? "–"), make("div", { class: "why" }, f.frame)),
    make("td", { class: "n wide" }, loss),
    make("td", { class: "n wide" }, duration),
  );
}
