// The page's beginning: one stream of messages from the server, which is taken up again by itself where it broke off.
import { say } from "./dom.js";
import * as flights from "./flights.js";
import * as live from "./live.js";

const stream = new EventSource("/api/live");
const on = (kind, what) => stream.addEventListener(kind, (event) => what(JSON.parse(event.data)));
let times = 0;
on("state", (data) => {
  live.state(data);
  if (times++) flights.refresh(); // the server is another one, or much was missed
});
on("tick", live.tick);
on("begun", live.begun);
on("said", live.message);
on("flight", flights.refresh);
on("deleted", flights.gone);
stream.addEventListener("open", () => {
  say(document.getElementById("connection"), "");
  document.body.classList.remove("lost");
});
stream.addEventListener("error", () => {
  say(document.getElementById("connection"), "The server does not answer; trying again …");
  document.body.classList.add("lost");
  // After some refusals (a restarted server that asks for another token) a browser gives up for good.
  if (stream.readyState === EventSource.CLOSED) setTimeout(() => location.reload(), 3000);
});
flights.start();
