// The list of flights: logs are dropped, judged by the server, and found again.
import { make, percent, say } from "./dom.js";

const SIGNS = { healthy: "✓ Healthy", fault: "✕ Fault found", ambiguous: "? Ambiguous", inconclusive: "? Inconclusive" };
const PAGE = 50;
let most = Infinity;
let shown = 0;
let queries = 0;

export function start() {
  const pick = (event) => {
    send([...event.target.files]);
    event.target.value = "";
  };
  document.getElementById("choose").addEventListener("change", pick);
  document.getElementById("choose-folder").addEventListener("change", pick);
  const drop = document.getElementById("drop");
  addEventListener("dragover", (event) => {
    event.preventDefault();
    drop.classList.add("over");
  });
  addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) drop.classList.remove("over");
  });
  addEventListener("drop", async (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    send(await dropped(event.dataTransfer));
  });
  let wait;
  document.getElementById("search").addEventListener("input", () => {
    clearTimeout(wait);
    wait = setTimeout(refresh, 200);
  });
  document.getElementById("find").addEventListener("submit", (event) => {
    event.preventDefault();
    refresh();
  });
  document.getElementById("more").addEventListener("click", () => load(shown));
  about();
  refresh();
}

/** A flight is new, here or in another tab. */
export function refresh() {
  load(0, Math.max(shown, PAGE));
}

async function about() {
  const answer = await fetched("/api/about");
  if (!answer) return;
  most = answer.most;
  say(document.getElementById("version"), `rotorwatch ${answer.version}.`);
}

async function load(offset, limit = PAGE) {
  const mine = ++queries;
  const search = document.getElementById("search").value;
  const found = await fetched(`/api/flights?${new URLSearchParams({ search, limit: String(Math.min(limit, 200)), offset: String(offset) })}`);
  if (!found || mine !== queries) return; // a later query is on its way
  const body = document.querySelector("#list tbody");
  const rows = found.flights.map(row);
  if (offset) body.append(...rows);
  else body.replaceChildren(...rows);
  shown = offset + rows.length;
  document.getElementById("list").hidden = !shown;
  document.getElementById("more").hidden = shown >= found.total;
  const count = `${found.total.toLocaleString("en")} flight${found.total === 1 ? "" : "s"}`;
  say(document.getElementById("found"), found.total ? (search ? `${count} found` : count) : search ? "No flight has all these words." : "No flight yet: drop a log above.");
  if (offset && rows.length) rows[0].querySelector("a").focus();
}

async function fetched(address) {
  try {
    const answer = await fetch(address);
    if (answer.status === 401) location.reload();
    const data = await answer.json();
    if (answer.ok) return data;
    say(document.getElementById("found"), data.error);
  } catch {
    say(document.getElementById("found"), "The server does not answer; is it still running?");
  }
  return null;
}

function row(f) {
  const began = f.utc ? new Date(f.utc).toISOString().slice(0, 16).replace("T", " ") + " UTC" : "–";
  return make(
    "tr",
    {},
    make("td", { class: `outcome ${f.verdict}` }, SIGNS[f.verdict] ?? f.verdict),
    make("td", {}, make("a", { href: `/flights/${f.hash}` }, make("bdi", {}, f.name)), make("div", { class: "why" }, f.headline)),
    make("td", { class: "wide" }, began),
    make("td", { class: "wide" }, f.aircraft_name ? `${f.aircraft_name}, ${f.frame}` : f.frame),
    make("td", { class: "n wide" }, `${(f.duration_s ?? 0).toFixed(0)} s`),
  );
}

/** All files of what was dropped, folders looked through. */
async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...transfer.files];
  const files = [];
  for (const stack = [...entries].reverse(); stack.length; ) {
    const entry = stack.pop();
    if (entry.isFile) files.push(await new Promise((take, fail) => entry.file(take, fail)));
    else {
      const reader = entry.createReader();
      for (let more; (more = await new Promise((take, fail) => reader.readEntries(take, fail))).length; ) stack.push(...more);
    }
  }
  return files;
}

let line = Promise.resolve(); // one after the other

function send(files) {
  const hidden = files.filter((file) => file.name.startsWith("."));
  for (const file of files) {
    if (hidden.includes(file)) continue;
    const text = make("span", {}, "waiting");
    const item = make("li", {}, make("bdi", { class: "name" }, file.name), ": ", text);
    const list = document.getElementById("uploads");
    list.prepend(item);
    while (list.children.length > 30 && list.lastElementChild.dataset.done) list.lastElementChild.remove();
    line = line.then(() => upload(file, item, text)).catch(() => {});
  }
}

function upload(file, item, text) {
  const done = (words, kind) => {
    say(text, words);
    item.dataset.done = kind;
    item.className = kind;
    say(document.getElementById("alarm"), `${file.name}: ${words}`);
  };
  if (file.size > most) {
    done(`this is more than the ${most / 2 ** 20} MB that are taken here; start the server with a larger --max-upload.`, "refused");
    return Promise.resolve();
  }
  const bar = make("progress", { max: 1, value: 0, "aria-label": `Sending ${file.name}` });
  item.append(" ", bar);
  return new Promise((finished) => {
    const request = new XMLHttpRequest();
    request.open("POST", "/api/flights");
    request.setRequestHeader("X-Rotorwatch-Name", encodeURIComponent(file.name.toWellFormed?.() ?? file.name));
    request.setRequestHeader("Content-Type", "application/octet-stream");
    request.responseType = "json";
    say(text, "sending");
    request.upload.addEventListener("progress", (event) => {
      if (event.lengthComputable) bar.value = event.loaded / event.total;
      if (event.loaded === event.total) {
        bar.removeAttribute("value");
        say(text, "judging");
      } else say(text, `sending, ${percent(event.loaded / event.total)}`);
    });
    request.addEventListener("loadend", () => {
      bar.remove();
      const answer = request.response;
      if (request.status === 200 || request.status === 201) {
        done(`${SIGNS[answer.verdict] ?? answer.verdict}: ${answer.headline}${request.status === 200 ? " (judged before)" : ""} `, answer.verdict);
        item.append(make("a", { href: `/flights/${answer.hash}`, "aria-label": `Report of ${file.name}` }, "Report"));
        refresh();
      } else done(answer?.error ?? "the server did not answer; send the log again when it runs.", "refused");
      finished();
    });
    request.send(file);
  });
}
