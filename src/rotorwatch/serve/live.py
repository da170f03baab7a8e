"""The watch loop in a thread of its own, and what the page shows of it: rotors, bands over time, events, links."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.answer import places
from rotorwatch.errors import ConfigError
from rotorwatch.fleet.store import Entry
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live import view
from rotorwatch.live.endpoint import KINDS, is_endpoint, open_endpoint
from rotorwatch.live.link import Link
from rotorwatch.live.replay import Replay
from rotorwatch.live.watch import Source, watch
from rotorwatch.live.watched import Tell, Watched, trouble
from rotorwatch.report import colours, drawing
from rotorwatch.serve import landed
from rotorwatch.serve.hub import Hub
from rotorwatch.serve.landed import Landings

STEP_S = 0.2  # between two points of a band, of the vehicle's time, until there are too many
POINTS = 600  # of a band; when there are twice as many every second one goes, so that the whole flight stays in view
SAID = 100  # sentences that are kept
LAST_WORD_S = 60.0  # for what was heard and is not judged yet, when the server is stopped
EVENTS = 30  # of a vehicle that are shown, the newest
AGAIN_S = 5.0  # after an error of a link, until it is opened again

log = logging.getLogger(__name__)


def _failed(doing: str, why: Exception) -> str:
    """What is said of an error that nobody has foreseen; where it happened stands in the log."""
    log.error("%s failed", doing, exc_info=why)
    return f"an error in rotorwatch itself ({doing}: {type(why).__name__}: {why}); please report it"


def open_source(
    endpoint: str, tell: Tell, vehicle: Vehicle | None, speed: float, record: Path | None, listen_only: bool
) -> Source:
    """An endpoint of `rotorwatch watch`, or a log that is replayed. Raises RotorwatchError with a sentence."""
    if is_endpoint(endpoint):
        return Link(open_endpoint(endpoint), tell, vehicle, record, not listen_only, math.inf)
    from rotorwatch.files import no_address
    from rotorwatch.logs import read

    no_address(endpoint)
    path = Path(endpoint)
    if not path.exists():
        raise ConfigError(f"{endpoint}: no such log; give a log file, or an endpoint: {KINDS}.")
    return Replay(read(path), Watched(path.name.encode("utf-8", "backslashreplace").decode(), tell, vehicle), speed)


class Band:
    """Loss of each rotor over a flight: rows (time, loss (n), lower (n), upper (n)), or (time,) where nothing was judged."""

    def __init__(self):
        self.rows: list[tuple] = []
        self._step, self._blind = STEP_S, False

    def add(self, time_s: float, losses: tuple[np.ndarray, np.ndarray, np.ndarray] | None) -> tuple | None:
        """What is new to be drawn, or None. losses: loss, lower, upper, each (n,); None when nothing is judged."""
        if losses is None:
            if self._blind or not self.rows:
                return None
            self._blind, row = True, (round(time_s, 2),)
        else:
            if not self._blind and self.rows and time_s - self.rows[-1][0] < self._step:
                return None
            self._blind, row = False, (round(time_s, 2), *(np.round(part, 3).tolist() for part in losses))
        self.rows.append(row)
        if len(self.rows) >= 2 * POINTS:
            self.rows = [row for k, row in enumerate(self.rows) if k % 2 == 0 or len(row) == 1]
            self._step *= 2.0
        return row


class Shown:
    """One vehicle as the page knows it."""

    def __init__(self, key: int, watched: Watched):
        self.key, self.watched = key, watched
        self.band, self._landings = Band(), Landings()
        self.frame: dict[str, Any] | None = None
        self._fresh: list[tuple] = []
        self._due = False
        self._judged: tuple[np.ndarray, ...] | None = None
        self._session: Any = None
        self._sampled = -np.inf

    def over(self, all_is_over: bool = False) -> list[Entry]:
        """Flights that have ended since this was asked last, for the list. all_is_over: nothing more will be heard of this session."""
        session = self._session
        if session is None or session.vehicle is None:
            return []
        hops = self._landings.over(session, all_is_over)
        return [landed.entry(session, landed.answer(self.watched.name, session, self.band.rows, hop)) for hop in hops]

    @property
    def another(self) -> bool:
        """Whether another flight has begun that `sample` has not seen yet."""
        return self.watched.session is not self._session

    def sample(self) -> bool:
        """Keep the losses of this moment when there are new ones; whether this is another flight than before."""
        session = self.watched.session
        another = self.another
        if another:
            self._session, self.band, self._fresh, self._landings = session, Band(), [], Landings()
            self.frame, self._judged, self._sampled = None, None, -np.inf
        if session is None or session.now - self._sampled < STEP_S:
            return another
        self._sampled = session.now
        blind = session.blind()
        losses = None if blind and not blind.startswith("thrust") else session.losses()
        self._judged = losses or self._judged
        row = self.band.add(session.now, losses)
        if row is not None:
            self._fresh.append(row)
        return another

    def news(self) -> dict[str, Any]:
        """What pages that know it have not been told: points of the band, and where its rotors are."""
        news: dict[str, Any] = {"points": self._fresh}
        self._fresh = []
        if self._due:
            news["frame"] = self.frame
            self._due = False
        return news

    def _placed(self) -> None:
        """Where its rotors are, once that is known."""
        vehicle = None if self._session is None else self._session.vehicle
        if vehicle is None or self.frame is not None:
            return
        xy, radius, half = drawing.layout(vehicle.rotors)
        names = places.names(vehicle.rotors)
        rotors = [
            {"rotor": k + 1, "place": names[k], "x": round(float(x), 1), "y": round(float(y), 1), "spin": r.spin}
            for k, ((x, y), r) in enumerate(zip(xy, vehicle.rotors, strict=True))
        ]
        self.frame = {"name": vehicle.name, "radius": round(radius, 1), "half": round(half, 1), "rotors": rotors}
        self._due = True

    def now(self, waits_for: str) -> dict[str, Any]:
        """What can be said of it at this moment."""
        line, session, health = view.line(self.watched, waits_for), self.watched.session, self.watched.health
        self._placed()
        frame = self.frame
        told = sorted(self.watched.changes.now.items(), key=lambda item: -item[1].detected_s)[:EVENTS]
        lasting = view.lasting(e for _, e in told)
        bad = sorted({r for e in lasting if not e.alternatives for r in e.rotors})
        open_ = sorted(
            {r for e in lasting if e.alternatives for s in (e.rotors, *e.alternatives) for r in s} - set(bad)
        )
        numbers = range(1, len(frame["rotors"]) + 1) if frame else ()
        return {
            "key": self.key,
            "name": line.name,
            "state": line.state,
            "blind": line.blind,
            "notice": self.watched.notice,
            "link": line.link,
            "esc": line.esc,
            "counts": {
                name: getattr(health, name) for name in ("taken", "lost", "twice", "damaged", "reboots", "jumps")
            },
            "now": round(session.now, 2) if session is not None and math.isfinite(session.now) else None,
            "losses": None if self._judged is None else [np.round(part, 3).tolist() for part in self._judged],
            "looks": [list(look) for look in colours.chosen(numbers, bad, open_).values()],
            "named": bad,
            "suspects": open_,
            "events": [
                {
                    "number": number, "text": view.words(e), "reason": e.reason, "onset_s": round(e.onset_s, 2),
                    "detected_s": round(e.detected_s, 2), "end_s": None if e.end_s is None else round(e.end_s, 2),
                    "kind": "fault" if e in lasting and not e.alternatives else "maybe" if e in lasting else "other",
                }
                for number, e in told
            ],
        }  # fmt: skip


class Guarded:
    """A source that cannot take the others down. opened: opens it, and, if it is a link, opens it again after an error. trouble: what went
    wrong, in a sentence."""

    def __init__(self, name: str, opened: Callable[[], Source], feed: Feed):
        self.name, self.source, self._feed, self._opened = name, opened(), feed, opened
        self.ended, self.trouble = False, ""
        self._again = math.inf
        self.lists = isinstance(self.source, Link)  # a log that is replayed can be dropped into the list

    @property
    def vehicles(self) -> Sequence[Watched]:
        return self.source.vehicles

    def shown(self) -> Sequence[tuple[Watched, str]]:
        return self.source.shown()

    def poll(self, wait_s: float) -> bool:
        """As the source does; after an error a link is opened again, all else has ended with a sentence."""
        if self.trouble and not self.ended:
            self._open_again(wait_s)
            return not self.ended
        try:
            self.ended = self._feed.stopped or not self.source.poll(wait_s)
        except Exception as why:
            self._fail(why)
        self._feed.sample(self, all_is_over=bool(self.trouble))
        return not self.ended

    def _open_again(self, wait_s: float) -> None:
        self.ended = self._feed.stopped
        if time.monotonic() < self._again:
            time.sleep(wait_s)
            return
        with suppress(Exception):
            self.source.leave()
        try:
            self.source, self.trouble = self._opened(), ""
        except Exception as why:
            self._fail(why)

    def leave(self) -> None:
        try:
            self.source.leave()
        except Exception as why:
            self._fail(why)
        self._feed.sample(self, all_is_over=True)

    def _fail(self, why: Exception) -> None:
        said, self.trouble = self.trouble, trouble(why)
        self.ended, self._again = not self.lists, time.monotonic() + AGAIN_S
        if self.trouble != said:
            self._feed.tell({"type": "error", "vehicle": self.name, "text": self.trouble})

    def about(self) -> dict[str, str]:
        """What the page says of the endpoint."""
        count = len(self.vehicles)
        state = "has ended" if self.ended else "is watched" if count else "waits for a vehicle"
        if isinstance(self.source, Link) and self.source.damaged and not self.source.frames:
            state = "bytes come, but none of them are MAVLink"
        return {"name": self.name, "text": self.trouble or state}


class Feed:
    """All endpoints, watched from `start` to `stop`; hub: tells the pages of them. ended: called with each flight that was heard over a
    link and has ended; it must not wait. trouble: why nothing is watched any more, in a sentence; empty as long as all is well."""

    def __init__(self, ended: Callable[[Entry], None] = lambda entry: None):
        self.ended = ended
        self.hub = Hub(self.state)
        self.stopped = False
        self.trouble = ""
        self._sources: list[Guarded] = []
        self._shown: dict[int, Shown] = {}
        self._said: deque[dict[str, Any]] = deque(maxlen=SAID)
        self._endpoints: list[dict[str, str]] = []
        self._vehicles: list[tuple[Shown, dict[str, Any]]] = []
        self._thread: threading.Thread | None = None

    def open(self, endpoint: str, *about: Any) -> None:
        """Add an endpoint; `about`: the rest of `open_source`'s arguments. Raises RotorwatchError."""
        name = endpoint if is_endpoint(endpoint) else Path(endpoint).name
        self._sources.append(Guarded(name, lambda: open_source(endpoint, self.tell, *about), self))

    def start(self) -> None:
        """Watch in a thread, if there is anything to be watched."""
        if self._sources and self._thread is None:
            self._endpoints = [source.about() for source in self._sources]
            self._thread = threading.Thread(target=self._watch, daemon=True)
            self._thread.start()

    def _watch(self) -> None:
        try:
            watch(self._sources, self._show)
        except Exception as why:
            self.trouble = f"Nothing is watched any more: {_failed('watching', why)}."
            self.tell({"type": "error", "vehicle": "all", "text": self.trouble})

    def stop(self) -> None:
        """Watch no longer: links are left as they were found, pages are let go."""
        if self.stopped:
            return
        self.stopped = True
        if self._thread is not None:
            self._thread.join(LAST_WORD_S)
        else:
            for source in self._sources:
                source.leave()
        self.hub.close()

    def tell(self, alert: dict[str, Any]) -> None:
        """An alert of `watch`, as a sentence in the list of what was said."""
        self._apart(self._tell, alert)

    def _apart(self, what: Callable, *given: Any) -> None:
        """Do what is not judging; an error of it ends nothing, and is said once."""
        try:
            what(*given)
        except Exception as why:
            text = _failed(what.__name__.strip("_"), why)
            line = {"at": round(time.time()), "type": "error", "vehicle": "page", "text": text}
            if not any(one["text"] == text for one in self._said):
                self._said.append(line)
                self.hub.publish("said", line)

    def _tell(self, alert: dict[str, Any]) -> None:
        if alert["type"] == "event":
            event = alert["event"]
            text = f"{alert['state']}: {event['kind'].replace('_', ' ')} at {event['onset_s']:.1f} s; {event['reason']}"
        elif alert["type"] == "vehicle":
            text = f"{alert['frame']}, {alert['rotors']} rotors"
        else:
            text = str(alert.get("text", ""))
        line = {"at": round(time.time()), "type": alert["type"], "vehicle": str(alert.get("vehicle", "")), "text": text}
        with self.hub.lock:
            self._said.append(line)
            self.hub.publish("said", line)

    def sample(self, source: Guarded, all_is_over: bool = False) -> None:
        """Keep what is drawn over time of its vehicles, and the flights of links that have ended."""
        self._apart(self._sample, source, all_is_over)

    def _sample(self, source: Guarded, all_is_over: bool) -> None:
        with self.hub.lock:
            for watched in source.vehicles:
                shown = self._shown.get(id(watched))
                if shown is None:
                    shown = self._shown[id(watched)] = Shown(len(self._shown) + 1, watched)
                if source.lists:
                    for entry in shown.over(all_is_over or shown.another):
                        self.ended(entry)
                if shown.sample():
                    self.hub.publish("begun", {"key": shown.key})

    def _show(self, _: Sequence[Source]) -> None:
        self._apart(self._tick)

    def _tick(self) -> None:
        with self.hub.lock:
            vehicles = []
            for source in self._sources:
                for watched, waits_for in source.shown():
                    shown = self._shown.get(id(watched))
                    if shown is not None:
                        vehicles.append((shown, shown.now(waits_for)))
            self._endpoints = [source.about() for source in self._sources]
            self._vehicles = vehicles
            told = [{**now, **shown.news()} for shown, now in vehicles]
            self.hub.publish("tick", {"endpoints": self._endpoints, "vehicles": told})

    def state(self) -> dict[str, Any]:
        """All that a new page has to know; as of the last tick, since the thread that watches is at work meanwhile."""
        vehicles = [{**now, "frame": shown.frame, "points": shown.band.rows} for shown, now in self._vehicles]
        return {"endpoints": self._endpoints, "vehicles": vehicles, "said": list(self._said)}
