// Vehicles while they fly: a card for each, redrawn at each message of the server.
import { draw, make, mark, percent, say } from "./dom.js";

const WORDS = {
  LOST: ["✕", "Loss of control", "fault"],
  FAULT: ["✕", "Fault", "fault"],
  MAYBE: ["?", "Ambiguous", "ambiguous"],
  OK: ["✓", "No fault", "healthy"],
  GROUND: ["–", "On the ground", "idle"],
  BLIND: ["…", "No assessment now", "idle"],
  SILENT: ["!", "No data received", "inconclusive"],
  ERROR: ["!", "Not watched", "inconclusive"],
};
const POINTS = 1200; // of a band; as on the server, every second one goes then
const HEIGHT = 220, LEFT = 44, BOTTOM = 24, TOP = 8, RIGHT = 8;
const DASHES = { solid: "", dashed: "6 3", dotted: "2 3", dotdash: "2 3 6 3", dashdot: "6 3 2 3" };

const cards = new Map();
const announced = new Set(); // faults that were read out: of this page, so that a reload says them again once

export function state(data) {
  for (const [key, card] of cards) {
    if (!data.vehicles.some((v) => v.key === key)) {
      card.root.remove();
      cards.delete(key);
    } else card.forget();
  }
  const body = document.querySelector("#messages tbody");
  body.replaceChildren();
  data.said.forEach(message);
  tick(data);
}

export function tick(data) {
  endpoints(data.endpoints);
  for (const v of data.vehicles) {
    let card = cards.get(v.key);
    if (!card) {
      card = new Card(v.key);
      cards.set(v.key, card);
      document.getElementById("vehicles").append(card.root);
    }
    card.show(v);
  }
  overview(data.vehicles);
}

export function begun(data) {
  cards.get(data.key)?.forget();
}

export function message(line) {
  const at = new Date(line.at * 1000).toLocaleTimeString([], { hour12: false });
  const row = make("tr", {}, make("td", { class: "n" }, at), make("td", {}, line.vehicle), make("td", {}, line.text));
  const body = document.querySelector("#messages tbody");
  body.prepend(row);
  while (body.rows.length > 100) body.lastElementChild.remove();
  document.getElementById("messages").hidden = false;
}

function endpoints(list) {
  const text = list.length
    ? list.map((e) => `${e.name}: ${e.text}`).join("; ")
    : "No vehicle is watched: give an endpoint when you start the server, as in rotorwatch serve udp:14550.";
  say(document.getElementById("endpoints"), text);
}

/** With several vehicles: all of them in a line, so that one in trouble is seen without scrolling. */
function overview(vehicles) {
  const nav = document.getElementById("overview");
  nav.hidden = vehicles.length < 2;
  const list = nav.firstElementChild;
  while (list.children.length > vehicles.length) list.lastElementChild.remove();
  while (list.children.length < vehicles.length) list.append(make("li", {}, make("a", {})));
  vehicles.forEach((v, k) => {
    const [sign, word, tint] = WORDS[v.state];
    const link = list.children[k].firstElementChild;
    mark(link, "href", `#vehicle-${v.key}`);
    mark(link, "class", tint);
    say(link, `${sign} ${v.name}: ${word.toLowerCase()}`);
  });
}

class Card {
  constructor(key) {
    this.key = key;
    this.title = make("h3", { id: `vehicle-${key}-name` });
    this.word = make("p", { class: "word" });
    this.sentence = make("p", { class: "sentence" });
    this.map = make("div", { class: "map" });
    this.events = make("ol", { class: "events" });
    this.rows = make("tbody");
    const head = ["rotor", "where", "loss", "95 % interval"].map((t, k) => make("th", { scope: "col", class: k > 1 ? "n" : null }, t));
    this.table = make("table", { class: "rotors" }, make("caption", { class: "unseen" }, "Rotors now"), make("thead", {}, make("tr", {}, ...head)), this.rows);
    this.chart = make("div", { class: "chart" });
    this.link = make("p", { class: "note" });
    this.root = make(
      "article",
      { class: "vehicle", id: `vehicle-${key}`, "aria-labelledby": `vehicle-${key}-name` },
      make("div", { class: "verdict" }, this.word, this.title, this.sentence),
      make("div", { class: "top" }, make("div", {}, this.table, this.link), this.map),
      this.chart,
      this.events,
    );
    this.forget();
  }

  /** Another flight begins, or the whole state comes again. */
  forget() {
    this.points = [];
    this.frame = null;
    this.map.replaceChildren();
    this.chart.replaceChildren();
    this.rows.replaceChildren();
    this.discs = [];
    this.lines = [];
  }

  show(v) {
    if (v.frame && JSON.stringify(v.frame) !== JSON.stringify(this.frame)) this.place(v.frame);
    for (const row of v.points) this.point(row);
    const [sign, word, tint] = WORDS[v.state];
    mark(this.root, "data-state", v.state);
    mark(this.root.firstElementChild, "class", `verdict ${tint}`);
    say(this.word, `${sign} ${word}`);
    say(this.title, v.name + (this.frame ? ` – ${this.frame.name}, ${this.frame.rotors.length} rotors` : ""));
    const lasting = v.events.filter((e) => e.kind !== "other");
    say(this.sentence, lasting.length ? capital(lasting.map((e) => e.text).join("; ")) : v.blind ? capital(v.blind) : "All rotors give their commanded thrust.");
    const received = v.counts.taken ? `, ${v.counts.taken.toLocaleString("en")} ${v.now === null ? "messages" : `messages or samples, ${v.now.toFixed(0)} s`}` : "";
    say(this.link, `Link: ${v.link}${received}${lasting.length && v.blind ? `; blind: ${v.blind}` : ""}${v.esc ? `; ${v.esc}` : ""}${v.notice ? `; ${v.notice}` : ""}`);
    this.rotors(v);
    this.happened(v);
    this.bands(v);
    this.alarm(v, lasting);
  }

  /** The airframe from above: as in the report. */
  place(frame) {
    this.frame = frame;
    const half = frame.half;
    const tip = `tip-${this.key}`;
    const svg = draw("svg", { class: "airframe", viewBox: `${-half} ${-half - 14} ${2 * half} ${2 * half + 14}`, role: "img" });
    this.maptitle = draw("title", {}, `Airframe from above: ${frame.name}`);
    svg.append(
      this.maptitle,
      draw("defs", {}, draw("marker", { id: tip, viewBox: "0 0 8 8", refX: 4, refY: 4, markerWidth: 6, markerHeight: 6, orient: "auto" }, draw("path", { class: "tip", d: "M0 0 L8 4 L0 8z" }))),
      ...frame.rotors.map((r) => draw("line", { class: "arm", x1: 0, y1: 0, x2: r.x, y2: r.y })),
      draw("path", { class: "nose", d: `M0 ${-half - 10} l8 14 h-16z` }),
      draw("circle", { class: "body", r: 15 }),
    );
    this.discs = frame.rotors.map((r) => {
      const radius = frame.radius, aside = 0.82 * radius, up = -0.57 * radius;
      const [start, end, sweep] = r.spin > 0 ? [aside, -aside, 0] : [-aside, aside, 1];
      const lost = draw("circle", { class: "lost", r: radius - 5, style: { "fill-opacity": "0" } });
      const number = draw("text", { class: "number", style: { "font-size": `${0.42 * radius}px` }, y: 0 }, String(r.rotor));
      const loss = draw("text", { class: "loss", style: { "font-size": `${0.33 * radius}px` }, y: 0.38 * radius });
      const group = draw(
        "g",
        { class: "rotor", transform: `translate(${r.x} ${r.y})` },
        draw("circle", { class: "disc", r: radius - 5 }),
        lost,
        draw("path", { class: "spin", "marker-end": `url(#${tip})`, d: `M${start} ${up} A${radius} ${radius} 0 0 ${sweep} ${end} ${up}` }),
        number,
        loss,
      );
      svg.append(group);
      return { group, lost, loss };
    });
    this.map.replaceChildren(svg);
    this.rows.replaceChildren(
      ...frame.rotors.map((r) => make("tr", {}, make("th", { scope: "row" }, make("span", { class: "chip" }), String(r.rotor)), make("td", {}, r.place), make("td", { class: "n" }), make("td", { class: "n" }))),
    );
    this.axes(frame);
  }

  rotors(v) {
    if (!this.frame) return;
    const assessed = v.losses !== null; // the last ones, while nothing can be assessed
    const words = [];
    this.frame.rotors.forEach((r, k) => {
      const loss = v.losses ? v.losses[0][k] : 0;
      const text = assessed ? percent(loss) : "?";
      const status = v.named.includes(r.rotor) ? "degraded" : v.suspects.includes(r.rotor) ? "suspect" : assessed ? "healthy" : "unobservable";
      const { group, lost, loss: label } = this.discs[k];
      mark(group, "class", `rotor ${status}`);
      group.style.setProperty("--rotor", v.looks[k][0]);
      lost.style.setProperty("fill-opacity", loss > 0.02 ? String((0.15 + 0.85 * loss).toFixed(2)) : "0");
      say(label, text);
      const row = this.rows.children[k];
      mark(row, "class", status);
      row.style.setProperty("--rotor", v.looks[k][0]);
      say(row.children[2], text);
      const [lower, upper] = assessed ? [v.losses[1][k], v.losses[2][k]] : [0, 0];
      say(row.children[3], !assessed ? "" : upper < 0.005 ? `below ${percent(0.01)}` : `${(100 * lower).toFixed(0)}–${percent(upper)}`);
      if (status !== "healthy") words.push(`rotor ${r.rotor}: ${status === "degraded" ? `lost ${text}` : status}`);
    });
    say(this.maptitle, `Airframe from above: ${this.frame.name}${words.length ? `; ${words.join(", ")}` : ""}`);
  }

  happened(v) {
    while (this.events.children.length > v.events.length) this.events.lastElementChild.remove();
    v.events.forEach((e, k) => {
      let item = this.events.children[k];
      if (!item) this.events.append((item = make("li", {}, make("h4"), make("p"))));
      mark(item, "class", { fault: "fault", maybe: "ambiguous", other: "" }[e.kind]);
      const ago = v.now === null ? "" : ` (${Math.max(v.now - e.onset_s, 0).toFixed(0)} s ago)`;
      say(item.children[0], `${capital(e.text)}${ago}`);
      say(item.children[1], `${capital(e.reason)}${/[.!?]$/.test(e.reason) ? "" : "."} Announced at ${e.detected_s.toFixed(1)} s.`);
    });
    this.events.hidden = !v.events.length;
  }

  point(row) {
    const last = this.points.length ? this.points[this.points.length - 1][0] : -Infinity;
    if (row[0] <= last) return; // sent twice: in the whole state and in the tick after it
    this.points.push(row);
    if (this.points.length >= POINTS) this.points = this.points.filter((p, k) => k % 2 === 0 || p.length === 1);
  }

  axes(frame) {
    const svg = draw("svg", { class: "bands", role: "img" });
    this.charttitle = draw("title", {}, "Loss of each rotor over time");
    this.ticks = draw("g", { class: "ticks" });
    this.marks = draw("g", { class: "marks" });
    svg.append(this.charttitle, this.ticks);
    this.lines = frame.rotors.map(() => [draw("path", { class: "band" }), draw("path", { class: "line" })]);
    for (const [band] of this.lines) svg.append(band);
    for (const [, line] of this.lines) svg.append(line);
    svg.append(this.marks);
    this.chart.replaceChildren(make("p", { class: "small" }, "Loss of each rotor over the flight, with its 95 % band"), svg);
  }

  bands(v) {
    if (!this.frame || !this.lines.length) return;
    const assessed = this.points.filter((p) => p.length > 1);
    this.chart.hidden = assessed.length < 2;
    if (assessed.length < 2) return;
    const width = Math.max(this.chart.clientWidth, 200);
    mark(this.lines[0][0].ownerSVGElement, "viewBox", `0 0 ${width} ${HEIGHT}`);
    const start = this.points[0][0], end = Math.max(v.now ?? 0, start + 10);
    const most = assessed.reduce((top, p) => Math.max(top, ...p[1], ...p[3].map((x) => Math.min(x, 0.3))), 0.1);
    const top = most > 0.5 ? 1 : most > 0.2 ? 0.5 : 0.2;
    const x = (t) => LEFT + ((t - start) / (end - start)) * (width - LEFT - RIGHT);
    const y = (loss) => HEIGHT - BOTTOM - (Math.min(loss, top) / top) * (HEIGHT - BOTTOM - TOP);
    const at = (p, value) => `${x(p[0]).toFixed(1)} ${y(value).toFixed(1)}`;
    const runs = []; // stretches that were assessed
    for (const p of this.points) {
      if (p.length === 1) runs.push([]);
      else (runs.length ? runs[runs.length - 1] : (runs.push([]), runs[0])).push(p);
    }
    this.lines.forEach(([band, line], k) => {
      const [tint, dash] = v.looks[k];
      const drawn = runs.filter((run) => run.length > 1);
      mark(band, "d", drawn.map((run) => `M${run.map((p) => at(p, p[3][k])).join("L")}L${[...run].reverse().map((p) => at(p, p[2][k])).join("L")}z`).join(""));
      mark(line, "d", drawn.map((run) => `M${run.map((p) => at(p, p[1][k])).join("L")}`).join(""));
      band.style.setProperty("fill", tint);
      line.style.setProperty("stroke", tint);
      mark(line, "stroke-dasharray", DASHES[dash]);
    });
    const ticks = [];
    for (const share of [0, 0.5, 1]) {
      ticks.push(draw("line", { x1: LEFT, x2: width - RIGHT, y1: y(share * top), y2: y(share * top) }));
      ticks.push(draw("text", { x: LEFT - 6, y: y(share * top) + 4, "text-anchor": "end" }, percent(share * top)));
    }
    const step = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 3600].find((s) => (end - start) / s <= 7) ?? 7200;
    for (let t = Math.ceil(start / step) * step; t <= end; t += step) ticks.push(draw("text", { x: x(t), y: HEIGHT - 6, "text-anchor": "middle" }, `${t} s`));
    this.ticks.replaceChildren(...ticks);
    this.marks.replaceChildren(
      ...v.events.filter((e) => e.onset_s >= start).map((e) => draw("line", { class: e.kind, x1: x(e.onset_s), x2: x(e.onset_s), y1: TOP, y2: HEIGHT - BOTTOM })),
    );
    const latest = assessed[assessed.length - 1];
    const highest = latest[1].indexOf(Math.max(...latest[1]));
    say(this.charttitle, `Loss of each rotor from ${start.toFixed(0)} to ${end.toFixed(0)} s; the largest now is ${percent(latest[1][highest])}, of rotor ${highest + 1}`);
  }

  /** Read a new fault out, once. */
  alarm(v, lasting) {
    for (const e of lasting) {
      const name = `${v.key} ${e.number} ${e.kind}`;
      if (announced.has(name)) continue;
      announced.add(name);
      document.getElementById("alarm").textContent = `${v.name}: ${e.kind === "fault" ? "fault" : "ambiguous"}: ${e.text}`;
    }
  }
}

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
