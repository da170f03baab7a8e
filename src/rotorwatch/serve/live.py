"""The watch loop in a thread of its own, and its data for the page: rotors, bands over time, events, links."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.answer import places
from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.fleet.store import Entry
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.live import view
from rotorwatch.live import watch as loop
from rotorwatch.live.endpoint import KINDS, is_endpoint, open_endpoint
from rotorwatch.live.guard import Guard
from rotorwatch.live.link import Link
from rotorwatch.live.replay import Replay
from rotorwatch.live.watch import Source
from rotorwatch.live.watched import Notify, Watched
from rotorwatch.report import colours, drawing
from rotorwatch.serve import landed
from rotorwatch.serve.hub import Hub
from rotorwatch.serve.landed import Landings

STEP_S = 0.2  # between two points of a band, in the vehicle's time, until there are too many
POINTS = 600  # of a band; at twice as many every second one is dropped, so that the whole flight stays in view
MESSAGES = 100  # latest messages sent to a new page
LAST_WORD_S = 60.0  # for unprocessed messages when the server is stopped
LASTS_S = 60.0  # after running this long, a loop restarts at once after an error
COUNTS = ("taken", "lost", "twice", "damaged", "reboots", "jumps")
EVENTS = 30  # newest events shown of a vehicle


def open_source(endpoint: str, notify: Notify, vehicle: Vehicle | None, speed: float, record: Path | None, listen_only: bool) -> Source:
    """An endpoint of `rotorwatch watch`, or a replayed log. Raises RotorwatchError with a sentence."""
    if is_endpoint(endpoint):
        return Link(open_endpoint(endpoint), notify, vehicle, record, not listen_only, math.inf)
    from rotorwatch.base.files import no_address
    from rotorwatch.logs import read

    no_address(endpoint)
    path = Path(endpoint)
    if not path.exists():
        raise ConfigError(f"{endpoint}: no such log; give a log file, or an endpoint: {KINDS}.")
    return Replay(read(path), Watched(path.name.encode("utf-8", "backslashreplace").decode(), notify, vehicle), speed)


class Band:
    """Loss of each rotor over a flight: rows (time, loss (n), lower (n), upper (n)), or (time,) where nothing was assessed."""

    def __init__(self):
        self.rows: list[tuple] = []
        self._step, self._blind = STEP_S, False

    def add(self, time_s: float, losses: tuple[np.ndarray, np.ndarray, np.ndarray] | None) -> tuple | None:
        """The new point to draw, or None. losses: loss, lower, upper, each (n,); None when nothing is assessed."""
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
    """A vehicle as shown on the page."""

    def __init__(self, key: int, watched: Watched):
        self.key, self.watched = key, watched
        self.band, self._landings = Band(), Landings()
        self.frame: dict[str, Any] | None = None
        self._fresh: list[tuple] = []
        self._due = False
        self._assessed: tuple[np.ndarray, ...] | None = None
        self._session: Any = None
        self._sampled = -np.inf

    def over(self, all_is_over: bool = False) -> list[Entry]:
        """Entries of flights that have ended since the last call. all_is_over: the session has ended."""
        session = self._session
        if session is None or session.vehicle is None:
            return []
        hops = self._landings.over(session, all_is_over)
        return [landed.entry(session, landed.answer(self.watched.name, session, self.band.rows, hop)) for hop in hops]

    @property
    def another(self) -> bool:
        """True if a flight has begun that `sample` has not processed yet."""
        return self.watched.session is not self._session

    def sample(self) -> bool:
        """Store the current losses when there are new ones; return whether this is another flight than before."""
        session = self.watched.session
        another = self.another
        if another:
            self._session, self.band, self._fresh, self._landings = session, Band(), [], Landings()
            self.frame, self._assessed, self._sampled = None, None, -np.inf
        if session is None or session.now - self._sampled < STEP_S:
            return another
        self._sampled = session.now
        blind = session.blind()
        losses = None if blind and not blind.startswith("thrust") else session.losses()
        self._assessed = losses or self._assessed
        row = self.band.add(session.now, losses)
        if row is not None:
            self._fresh.append(row)
        return another

    def changes(self) -> dict[str, Any]:
        """Changes since the last message: points of the band, and the rotors' places."""
        changes: dict[str, Any] = {"points": self._fresh}
        self._fresh = []
        if self._due:
            changes["frame"] = self.frame
            self._due = False
        return changes

    def _placed(self) -> None:
        """Set the rotors' places, once known."""
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
        """Its current state, as shown on the page."""
        line, session, health = view.line(self.watched, waits_for), self.watched.session, self.watched.health
        self._placed()
        frame = self.frame
        events = sorted(self.watched.changes.now.items(), key=lambda item: -item[1].detected_s)[:EVENTS]
        lasting = view.lasting(e for _, e in events)
        bad = sorted({r for e in lasting if not e.alternatives for r in e.rotors})
        maybe = {r for e in lasting if e.alternatives for s in (e.rotors, *e.alternatives) for r in s}
        open_ = sorted(maybe - set(bad))
        numbers = range(1, len(frame["rotors"]) + 1) if frame else ()
        return {
            "key": self.key,
            "name": line.name,
            "state": line.state,
            "blind": line.blind,
            "notice": self.watched.notice,
            "link": line.link,
            "esc": line.esc,
            "counts": {name: getattr(health, name) for name in COUNTS},
            "now": round(session.now, 2) if session is not None and math.isfinite(session.now) else None,
            "losses": None if self._assessed is None else [np.round(part, 3).tolist() for part in self._assessed],
            "looks": [list(look) for look in colours.chosen(numbers, bad, open_).values()],
            "named": bad,
            "suspects": open_,
            "events": [
                {
                    "number": number, "text": view.words(e), "reason": e.reason, "onset_s": round(e.onset_s, 2),
                    "detected_s": round(e.detected_s, 2), "end_s": None if e.end_s is None else round(e.end_s, 2),
                    "kind": "fault" if e in lasting and not e.alternatives else "maybe" if e in lasting else "other",
                }
                for number, e in events
            ],
        }  # fmt: skip


class Guarded(loop.Guarded):
    """The terminal's source; after each step the feed samples the drawn data."""

    def __init__(self, name: str, source: Source, feed: Feed, make: Callable[[], Source] | None = None):
        """make: reopens it; None where that is impossible."""
        super().__init__(name, source, feed.notify)
        self._feed, self._make = feed, make
        self.lists = isinstance(source, Link)  # a replayed log can be uploaded to the list

    def poll(self, wait_s: float) -> bool:
        continues = not self._feed.stopped and super().poll(wait_s)
        self.ended = not continues
        self._feed.sample(self)
        return continues

    def leave(self) -> None:
        super().leave()
        self._feed.sample(self, all_is_over=True)

    def again(self) -> None:
        """Reopen it, after it was closed because of an error."""
        if self._make is None or (self.ended and isinstance(self.why, RotorwatchError)):
            return
        try:
            self.source, self.ended, self.trouble = self._make(), False, ""
        except Exception as why:
            self._fail(why)

    def about(self) -> dict[str, str]:
        """The endpoint's name and state, as shown on the pages."""
        count = len(self.vehicles)
        state = "has ended" if self.ended else "is watched" if count else "waits for a vehicle"
        if isinstance(self.source, Link):
            if self.source.damaged and not self.source.frames:
                state = "data arrive but are not MAVLink"
            if self.source.trouble:
                state += f"; {self.source.trouble}"
        return {"name": self.name, "text": self.trouble or state}


class Feed:
    """All endpoints, watched from `start` to `stop`; hub: sends to the pages. ended: called with each flight that was received over a link
    and has ended; it must not block."""

    def __init__(self, ended: Callable[[Entry], None] = lambda entry: None):
        self.ended = ended
        self.hub = Hub(self.state)
        self.stopped = False
        self.background = Guard(self._error)
        self._sources: list[Guarded] = []
        self._shown: dict[int, Shown] = {}
        self._messages: deque[dict[str, Any]] = deque(maxlen=MESSAGES)
        self._endpoints: list[dict[str, str]] = []
        self._vehicles: list[tuple[Shown, dict[str, Any]]] = []
        self._thread: threading.Thread | None = None
        self._keys = 0
        self.failed = ""  # reason why the loop ended by itself

    def open(self, endpoint: str, *about: Any) -> None:
        """Add an endpoint; `about`: the rest of `open_source`'s arguments. Raises RotorwatchError."""
        name = endpoint if is_endpoint(endpoint) else Path(endpoint).name
        make = partial(open_source, endpoint, self.notify, *about)
        self._sources.append(Guarded(name, make(), self, make if is_endpoint(endpoint) else None))

    def start(self) -> None:
        """Start watching in a thread, if there are endpoints."""
        if self._sources and self._thread is None:
            self._endpoints = [source.about() for source in self._sources]
            self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        """The loop. An error that escapes it is published, and links are reopened: flights until then have been listed."""
        pause = loop.FIRST_S
        while True:
            began = time.monotonic()
            try:
                loop.watch(self._sources, lambda _: self._show(), guard=self.background)
                return
            except BaseException as why:
                text = " ".join(f"{type(why).__name__}: {why}".split())[:200]
                error = f"an internal error of rotorwatch ({text})"
                self.failed = f"Watching stopped after {error}; please report it. It restarts."
                self._error(self.failed)
            pause = loop.FIRST_S if time.monotonic() - began > LASTS_S else min(2.0 * pause, loop.LONGEST_S)
            time.sleep(0.0 if self.stopped else pause)
            if self.stopped:
                return
            for source in self._sources:
                source.again()

    def _error(self, text: str) -> None:
        """Report an error outside the diagnosis in the log and on the pages."""
        with suppress(Exception):  # standard error may be closed
            print(f"rotorwatch: {text}", file=sys.stderr, flush=True)
        self.notify({"type": "error", "vehicle": "rotorwatch", "text": text})

    def stop(self) -> None:
        """Stop watching: links are left in their original state, pages are disconnected."""
        if self.stopped:
            return
        self.stopped = True
        if self._thread is not None:
            self._thread.join(LAST_WORD_S)
        else:
            for source in self._sources:
                source.leave()
        self.hub.close()

    def notify(self, alert: dict[str, Any]) -> None:
        """Show an alert of `watch` in the list of messages."""
        if alert["type"] == "event":
            text = view.announced(alert)
        elif alert["type"] == "vehicle":
            text = f"{alert['frame']}, {alert['rotors']} rotors"
        else:
            text = str(alert.get("text", ""))
        line = {"at": round(time.time()), "type": alert["type"], "vehicle": str(alert.get("vehicle", "")), "text": text}
        with self.hub.lock:
            self._messages.append(line)
            self.background.run("the page", self.hub.publish, "said", line)

    def sample(self, source: Guarded, all_is_over: bool = False) -> None:
        """Store the time series of its vehicles, and the ended flights of links."""
        with self.hub.lock:
            for watched in source.vehicles:
                view = self._shown.get(id(watched))
                if view is None:
                    self._keys += 1
                    view = self._shown[id(watched)] = Shown(self._keys, watched)
                if source.lists:
                    self.background.run(f"the list of flights of {watched.name}", self._list, view, all_is_over)
                self.background.run(f"what is drawn of {watched.name}", self._sample, view)

    def _list(self, shown: Shown, all_is_over: bool) -> None:
        for entry in shown.over(all_is_over or shown.another):
            self.ended(entry)

    def _sample(self, shown: Shown) -> None:
        if shown.sample():
            self.hub.publish("begun", {"key": shown.key})

    def _show(self) -> None:
        with self.hub.lock:
            vehicles: list[tuple[Shown, dict[str, Any]]] = []
            there = {id(watched) for source in self._sources for watched in source.vehicles}
            self._shown = {key: view for key, view in self._shown.items() if key in there}
            for source in self._sources:
                for watched, waits_for in source.shown():
                    view = self._shown.get(id(watched))
                    if view is not None:
                        # An error in one must not affect the others.
                        what = partial(lambda one, why: vehicles.append((one, one.now(why))), view, waits_for)
                        self.background.run(f"what is shown of {watched.name}", what)
            self._endpoints = [source.about() for source in self._sources]
            self._vehicles = vehicles
            vehicles_now = [{**now, **view.changes()} for view, now in vehicles]
            self.hub.publish("tick", {"endpoints": self._endpoints, "vehicles": vehicles_now})

    def state(self) -> dict[str, Any]:
        """The whole state for a new page, as of the last tick, since the watching thread is at work meanwhile."""
        vehicles = [{**now, "frame": view.frame, "points": view.band.rows} for view, now in self._vehicles]
        return {"endpoints": self._endpoints, "vehicles": vehicles, "said": list(self._messages)}
