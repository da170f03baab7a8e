// Logs that are dropped or chosen: sent one after the other, and what the server says of each.
import { make, percent, say, SIGNS } from "./dom.js";

let most = Infinity;
let listed = () => {};

/** onListed: called when a log has become a flight of the list. */
export function start(onListed) {
  listed = onListed;
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
}

/** bytes: what the server takes of a log at most. */
export function limit(bytes) {
  most = bytes;
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
    done(`larger than the limit of ${most / 2 ** 20} MB; start the server with a larger --max-upload.`, "refused");
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
        say(text, "assessing");
      } else say(text, `sending, ${percent(event.loaded / event.total)}`);
    });
    request.addEventListener("loadend", () => {
      bar.remove();
      const answer = request.response;
      if (request.status === 200 || request.status === 201) {
        done(`${SIGNS[answer.verdict] ?? answer.verdict}: ${answer.headline}${request.status === 200 ? ` (diagnosed before${answer.known_as ? ` as ${answer.known_as}` : ""})` : ""} `, answer.verdict);
        item.append(make("a", { href: `/flights/${answer.hash}`, "aria-label": `Report of ${file.name}` }, "Report"));
        listed();
      } else done(answer?.error ?? "the server did not answer; send the log again when it runs.", "refused");
      finished();
    });
    request.send(file);
  });
}
