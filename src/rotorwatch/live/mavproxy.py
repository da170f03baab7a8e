"""A MAVProxy module: `module load rotorwatch` evaluates the vehicles that MAVProxy receives, and shows events in its console and on its
map.

MAVProxy calls `init` of the package (https://ardupilot.org/mavproxy/docs/development/gettingstarted.html). Its loop hands over frames and
takes finished texts back; all else runs in a thread. MAVProxy is only imported in its own process.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rotorwatch.live.endpoint import Endpoint
from rotorwatch.live.guard import Guard, trouble

if TYPE_CHECKING:
    from rotorwatch.flight.vehicle import Vehicle
    from rotorwatch.live.link import Link

NAME = "mavproxy"
FRAMES, SENT, NEWS = 20_000, 200, 500  # queue limits; the oldest are dropped
WAIT_S, SHOW_S, MAP_S = 0.05, 0.5, 1.0
AGAIN_S = 5.0  # before the thread is restarted after an error
LAST_S = 4.0  # at the end; MAVProxy waits 5 s
AT_ONCE = 10  # texts and messages in one turn of MAVProxy's loop
PLACES, APART_MS = 3600, 500  # kept of each vehicle, and the time between two
MARKERS = 100  # on the map
LAYER = 3  # of the map: above its missions
COLOURS = {"LOST": "red", "FAULT": "red", "ERROR": "red", "MAYBE": "orange", "SILENT": "orange", "OK": "green"}
CRITICAL, WARNING = 2, 4


@dataclass(frozen=True)
class News:
    """A text to show. key, label: of its marker on the map; place: (latitude, longitude) [deg], None where unknown; gone: remove the
    marker."""

    text: str
    severity: int
    key: str = ""
    label: str = ""
    place: tuple[float, float] | None = None
    gone: bool = False


class Handed(Endpoint):
    """Frames handed over by MAVProxy. A peer is the number of one of its links. sent: (peer, frame) for MAVProxy to send."""

    def __init__(self, slow: bool = False):
        super().__init__(NAME)
        self.open, self.slow = True, slow
        self.sent: deque[tuple[int, bytes]] = deque(maxlen=SENT)
        self._frames: deque[tuple[int, bytes]] = deque(maxlen=FRAMES)
        self._some = threading.Event()

    def put(self, link: int, frame: bytes) -> None:
        """Add a frame without blocking."""
        self._frames.append((link, frame))
        self._some.set()

    def receive(self, wait_s: float = 0.0) -> list[tuple[Any, bytes]]:
        self._some.wait(wait_s)
        self._some.clear()
        frames = []
        while self._frames and len(frames) < 500:
            frames.append(self._frames.popleft())
        if self._frames:
            self._some.set()
        return frames

    def send(self, data: bytes, peer: Any = None) -> None:
        if peer is not None:  # broadcasts are heartbeats; MAVProxy sends its own
            self.sent.append((peer, data))


class Places:
    """Positions of vehicles, by their own clocks. Written by MAVProxy's loop, read by the thread."""

    def __init__(self):
        self._tracks: dict[int, deque[tuple[int, float, float]]] = {}

    def add(self, system: int, boot_ms: int, latitude: float, longitude: float) -> None:
        """Add a position [deg]."""
        track = self._tracks.setdefault(system, deque(maxlen=PLACES))
        if track and boot_ms < track[-1][0]:
            track.clear()  # a reboot
        if (not track or boot_ms - track[-1][0] >= APART_MS) and (latitude or longitude):
            track.append((boot_ms, latitude, longitude))

    def find(self, system: int, boot_ms: int) -> tuple[float, float] | None:
        """The position nearest to that time; None where unknown."""
        track = list(self._tracks.get(system, ()))
        if not track:
            return None
        return min(track, key=lambda place: abs(place[0] - boot_ms))[1:]


class Watcher:
    """The thread that evaluates the frames. news: texts to show; states: vehicle -> (state, a few words)."""

    def __init__(self, handed: Handed, places: Places, talks: bool = True, known: Path | None = None):
        self.news: deque[News] = deque(maxlen=NEWS)
        self.states: dict[str, tuple[str, str]] = {}
        self._handed, self._places, self._talks, self._known = handed, places, talks, known
        self._link: Link | None = None
        self._reported: dict[tuple[str, int], tuple] = {}
        self._flights: dict[str, int] = {}
        self._stop = threading.Event()
        self._again = 0.0
        self._begin()

    def _begin(self) -> None:
        self._thread = threading.Thread(target=self._work, name="rotorwatch", daemon=True)
        self._thread.start()

    def revive(self) -> None:
        """Restart after an error."""
        now = time.monotonic()
        if not self._thread.is_alive() and not self._stop.is_set():
            if not self._again:
                self._again = now + AGAIN_S
            elif now > self._again:
                self._again = 0.0
                self._begin()

    def leave(self) -> None:
        """End; waits up to LAST_S."""
        self._stop.set()
        self._thread.join(LAST_S)

    def _work(self) -> None:
        try:  # slow imports must not block MAVProxy's loop
            from rotorwatch.flight.vehicle_file import read
            from rotorwatch.live.link import Link
            from rotorwatch.live.watch import Guarded

            known: Vehicle | None = None if self._known is None else read(self._known)
            self._link = Link(self._handed, self._publish, known, None, self._talks, float("inf"))
            source = Guarded(NAME, self._link, self._publish)
        except Exception as why:
            self._say(f"rotorwatch cannot start: {trouble(why)}", CRITICAL)
            self._stop.set()
            return
        guard, last_shown = Guard(lambda text: self._say(f"rotorwatch: {text}", WARNING)), 0.0
        try:
            while not self._stop.is_set() and source.poll(WAIT_S):
                if time.monotonic() - last_shown > SHOW_S:
                    last_shown = time.monotonic()
                    guard.run("the state", self._look)
        except Exception as why:
            self._say(f"rotorwatch: {trouble(why)}", CRITICAL)
        finally:
            source.leave()

    def _look(self) -> None:
        from rotorwatch.live.view import line

        assert self._link is not None
        states = {}
        for watched, waits_for in self._link.shown():
            seen = line(watched, waits_for)
            states[_number(watched.name)] = seen.state, next(iter(seen.events), seen.blind)
        self.states = states

    def _say(self, text: str, severity: int) -> None:
        self.news.append(News(text, severity))

    def _publish(self, alert: dict) -> None:
        """An alert of docs/watch.md as news."""
        from rotorwatch.live import ground

        name = alert["vehicle"]
        vehicle = f"vehicle {_number(name)}" if name != NAME else "MAVProxy"
        if alert["type"] == "vehicle":
            self._flights[name] = self._flights.get(name, 0) + 1  # a new flight restarts the numbers of events
            self._reported = {key: reported for key, reported in self._reported.items() if key[0] != name}
            self._say(f"rotorwatch: {vehicle}: {alert['frame']}, {alert['rotors']} rotors", ground.NOTICE)
            return
        if alert["type"] != "event":
            severity = ground.text_of(alert)[1] if "rotor" in alert else WARNING if alert["type"] == "error" else ground.NOTICE
            self._say(f"rotorwatch: {vehicle}: {alert['text']}", severity)
            return
        reported = name, alert["number"]
        if not ground.worth_sending(self._reported.get(reported), alert) and alert["state"] != "final":
            return
        announced = reported in self._reported
        self._reported[reported] = ground.gist(alert)
        if alert["state"] == "withdrawn" and not announced:
            return
        event = alert["event"]
        text, severity = ground.text_of(alert)
        self.news.append(
            News(
                f"{text} ({vehicle}, {alert['state']}, {event['onset_s']:.1f} s): {event['reason']}", severity,
                f"rotorwatch {_number(name)}.{self._flights.get(name, 0)}.{alert['number']}",
                text.removeprefix("rotorwatch: "), self._place(name, event["onset_s"]), alert["state"] == "withdrawn",
            )
        )  # fmt: skip

    def _place(self, name: str, time_s: float) -> tuple[float, float] | None:
        if self._link is None:
            return None
        return self._places.find(int(_number(name).split(".")[0]), self._link.boot_ms(name, time_s))


def _number(name: str) -> str:
    """System (and component) of a vehicle's name."""
    return name.rpartition("/")[2]


class Shown:
    """Output in MAVProxy: lines and a field of its console, markers on its maps. Only its own loop may call this."""

    def __init__(self, console: Callable[[], Any], maps: Callable[[], Iterable[Any]]):
        self._console, self._maps = console, maps
        self._markers: dict[str, tuple[tuple[float, float], str, int]] = {}
        self._drawn: set[int] = set()
        self._states: dict[str, tuple[str, str]] = {}

    def line(self, news: News) -> None:
        """A line of the console."""
        self._console().writeln(news.text, fg=_colour(news.severity))

    def marker(self, one: News) -> None:
        """A marker where the position is known; it stays where its event began."""
        if one.gone:
            self._markers.pop(one.key, None)
            for map_ in self._maps():
                map_.remove_object(one.key)
        elif one.key and (one.place is not None or one.key in self._markers):
            place = self._markers[one.key][0] if one.key in self._markers else one.place
            assert place is not None
            if len(self._markers) >= MARKERS and one.key not in self._markers:
                self._away(next(iter(self._markers)))
            self._markers[one.key] = place, one.label, one.severity
            for map_ in self._maps():
                self._mark(map_, one.key)

    def states(self, found: dict[str, tuple[str, str]]) -> None:
        """A field for each vehicle."""
        if found != self._states:
            self._states = dict(found)
            for number, (state, words) in found.items():
                text = f"RW {number}: {state}{f' {words}' if words and state != 'OK' else ''}"[:60]
                self._console().set_status(f"rotorwatch {number}", text, row=6, fg=COLOURS.get(state, "black"))

    def maps(self) -> None:
        """Draw all markers on newly opened maps."""
        there = {id(map_): map_ for map_ in self._maps()}
        for number, map_ in there.items():
            if number not in self._drawn:
                for key in self._markers:
                    self._mark(map_, key)
        self._drawn = set(there)

    def clear(self) -> None:
        """Remove all markers."""
        for key in list(self._markers):
            self._away(key)

    def _away(self, key: str) -> None:
        del self._markers[key]
        for map_ in self._maps():
            map_.remove_object(key)

    def _mark(self, map_: Any, key: str) -> None:
        from MAVProxy.modules.mavproxy_map import mp_slipmap  # type: ignore

        place, label, severity = self._markers[key]
        colour = (255, 0, 0) if severity <= CRITICAL else (255, 165, 0) if severity <= WARNING else (160, 160, 160)
        map_.add_object(mp_slipmap.SlipIcon(key, place, map_.icon("flag.png"), layer=LAYER, label=label, colour=colour))


def _colour(severity: int) -> str:
    return "red" if severity <= CRITICAL else "orange" if severity <= WARNING else "black"


def init(mpstate: Any, listen_only: bool = False, vehicle: str | None = None) -> Any:
    """The module, for MAVProxy. listen_only: send nothing to the vehicles; vehicle: a vehicle file of all of them."""
    from MAVProxy.modules.lib import mp_module  # type: ignore

    return _module(mp_module.MPModule)(mpstate, listen_only, vehicle)


def _module(base: type) -> type:
    """The class of the module. base: MAVProxy's own class of modules."""

    class RotorwatchModule(base):
        def __init__(self, mpstate: Any, listen_only: bool, vehicle: str | None):
            super().__init__(mpstate, "rotorwatch", "which rotor of a vehicle lost effectiveness", public=True, multi_vehicle=True)
            kinds = {type(master).__name__ for master in mpstate.mav_master}
            talks = not listen_only and not kinds & {"mavlogfile", "mavmmaplog"}
            self._handed, self._places = Handed("mavserial" in kinds), Places()
            self._guard = Guard(lambda text: self.console.writeln(f"rotorwatch: {text}", fg="red"))
            self._shown = Shown(lambda: self.console, self._maps)
            self._watcher = Watcher(self._handed, self._places, talks, None if vehicle is None else Path(vehicle).expanduser())
            self._waiting: News | None = None
            self._next = self._next_map = 0.0
            self.add_command("rotorwatch", self._command, "events of rotors", ["status", "clear"])
            if talks and getattr(self.settings, "streamrate", -1) != -1:
                self.console.writeln(
                    "rotorwatch: MAVProxy requests its streamrate every 15 s; `set streamrate -1` leaves the rates to rotorwatch"
                )

        def mavlink_packet(self, m: Any) -> None:
            """A message of any vehicle."""
            self._guard.run("taking messages", self._take, m)

        def idle_task(self) -> None:
            """Called by MAVProxy's loop."""
            self._guard.run("sending", self._send)
            self._guard.run("showing", self._show)

        def unload(self) -> None:
            """MAVProxy ends, or unloads the module."""
            self._watcher.leave()
            for work in (self._send_all, self._show, self._shown.clear):
                self._guard.run("the end", work)
            self.remove_command("rotorwatch")
            super().unload()

        def _take(self, m: Any) -> None:
            kind = m.get_type()
            if kind == "BAD_DATA" or kind.startswith("UNKNOWN"):
                return
            system = m.get_srcSystem()
            if kind == "GLOBAL_POSITION_INT":
                self._places.add(system, m.time_boot_ms, m.lat * 1e-7, m.lon * 1e-7)
            self._handed.put(self._link_of(m, kind, system), bytes(m.get_msgbuf()))

        def _link_of(self, m: Any, kind: str, system: int) -> int:
            """The number of the link that it came by: each numbers its frames itself."""
            masters = self.mpstate.mav_master
            for number, master in enumerate(masters if len(masters) > 1 else ()):
                state = master.sysid_state.get(system)
                last = None if state is None else state.messages.get(kind)
                part = getattr(m, "_instance_field", None)
                if last is m or (part and (getattr(last, "_instances", None) or {}).get(getattr(m, part, None)) is m):
                    return number
            return 0

        def _send(self) -> None:
            for _ in range(min(AT_ONCE, len(self._handed.sent))):
                link, frame = self._handed.sent.popleft()
                if link < len(self.mpstate.mav_master):
                    self.mpstate.mav_master[link].write(frame)

        def _send_all(self) -> None:
            while self._handed.sent:
                self._send()

        def _show(self) -> None:
            for _ in range(min(AT_ONCE, len(self._watcher.news) + (self._waiting is not None))):
                if self._waiting is None:
                    self._waiting = self._watcher.news.popleft()
                self._shown.line(self._waiting)  # retried where the console fails
                one, self._waiting = self._waiting, None
                self._guard.run("the map", self._shown.marker, one)
            now = time.monotonic()
            if now > self._next:
                self._next = now + SHOW_S
                self._watcher.revive()
                self._shown.states(self._watcher.states)
            if now > self._next_map:
                self._next_map = now + MAP_S
                self._guard.run("the map", self._shown.maps)

        def _maps(self) -> list[Any]:
            return [one.map for one in self.module_matching("map*") if getattr(one, "map", None) is not None]

        def _command(self, args: list[str]) -> None:
            if args == ["clear"]:
                self._guard.run("clear", self._shown.clear)
            elif args in ([], ["status"]):
                states = self._watcher.states or {"": ("no vehicle", "is known yet")}
                for number, (state, words) in states.items():
                    self.console.writeln(f"rotorwatch: {f'vehicle {number}: ' if number else ''}{state} {words}".rstrip())
            else:
                self.console.writeln("usage: rotorwatch <status|clear>")

    return RotorwatchModule
