"""A link: the frames of an endpoint sorted by vehicle, recorded, and turned into samples; and the requests to each vehicle."""

from __future__ import annotations

import math
import re
import time
from collections import deque
from collections.abc import Callable, Iterable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rotorwatch import airframes
from rotorwatch.errors import LinkError, VehicleError
from rotorwatch.flight import Flight
from rotorwatch.flight.output_functions import motor_outputs
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.flight.vehicle_kind import OTHERS
from rotorwatch.live import mavlink, requests
from rotorwatch.live.clock import Restarted
from rotorwatch.live.endpoint import Endpoint
from rotorwatch.live.framing import Frames, Outgoing, Sender
from rotorwatch.live.outliers import Outliers
from rotorwatch.live.record import Record
from rotorwatch.live.routes import FADED_S, NEEDS, SIGNALS, SILENT_S, UNKNOWN_S, WORDS, Route, Routes
from rotorwatch.live.watched import Losing, Notify, Watched
from rotorwatch.logs.px4_topics import MAV_TYPES
from rotorwatch.logs.tlog import BY_NUMBER, FORMAT, Outputs, rotor_outputs

BEAT_S, HELLO_S = 1.0, 0.5
ANEW_S, ANEW_MOST_S = 1.0, 60.0  # before a vehicle is watched again after an error: doubled each time
VEHICLES = 100  # of a link; five times the capacity of one process
ALL_S = 0.05  # between two checks of silent vehicles
MISSED_S, UNANSWERED_S = 3.0, 10.0  # before missing inputs are reported: without requests, and with them
FEW = 10  # vehicles of a link up to which missing inputs of each are reported
PEERS = 200  # with incomplete frames kept
ONE_ID = "give each vehicle its own id (SYSID_THISMAV, MAV_SYS_ID)"
TWO_SENDERS = f"two vehicles appear to send with the same id: {ONE_ID}"
NO_AUTOPILOT = 8
COMMAND_ACK, MESSAGE_INTERVAL, SYS_STATUS = 77, 244, 1
ASKS, ASKED = (76, 110, 412), 100  # COMMAND_LONG, FILE_TRANSFER_PROTOCOL, REQUEST_EVENT; of those kept


def _words(needs: Iterable[str]) -> str:
    return " and ".join(WORDS[need] for need in needs)


def _missing(what: str, asked: bool) -> str:
    """The missing message, and a remedy. asked: it was requested of the vehicle."""
    if what != "parameters":
        helps = "the vehicle has to send them here" + ("." if asked else ", or omit --listen-only so that they are requested.")
        return f"no {WORDS[what]} come ({' or '.join(NEEDS[what][:2])}); {helps}"
    why = "the parameters, which define the airframe and which output drives which rotor, have not arrived; "
    if asked:
        return why + "they were requested, so let a ground station fetch them, or give --vehicle FILE."
    return why + "omit --listen-only so that they are requested, let a ground station fetch them, or give --vehicle FILE."


class LinkedVehicle:
    """A vehicle on a link. watched: processes its samples."""

    def __init__(self, watched: Watched, key: tuple[int, int], autopilot: str, kind: int, link: Link, peer: Any):
        self.watched, self._key, self._link = watched, key, link
        self.messages = mavlink.Messages(autopilot, kind)
        self.status: dict[str, Any] | None = None  # the fields of its last SYS_STATUS
        self._parameters, self._identity = requests.Parameters(*key), requests.Identity(*key)
        self._begun: dict[str, float] | None = None
        self._unfit = False  # its cached parameters
        self._outputs = Outputs(())
        self._silent = self._mixed = False
        self.only_beats = True  # only heartbeats so far
        self._first = now = link.clock()
        self.routes = Routes(Route(peer, self._rates(), now), now)
        self._outliers, self._losing = Outliers(), Losing()
        self._missed: tuple[str, ...] = ()
        self._anew_s, self._anew_at = ANEW_S, math.inf

    def _rates(self) -> requests.Rates:
        return requests.Rates(*self._key, self.messages.autopilot, self._link.endpoint.slow)

    def hear(self, peer: Any, identity: int, arrival: float) -> bool:
        """Register a frame with its id from that peer; return whether it is of the followed address."""
        route = self.routes.find(peer)
        if route is None:
            route = Route(peer, self._rates(), arrival)
            if not self.watched.health.others:
                self.watched.say(
                    f"it is also received from a second address ({route}), which is ignored while {self.routes.followed} sends the "
                    f"required data; if it is another vehicle, {ONE_ID}"
                )
            if not self.routes.add(route, arrival):
                self.watched.health.others += 1
                return False
        route.hear(identity, arrival)
        self.watched.health.last_frame = arrival
        self.only_beats = self.only_beats and identity == 0
        if self._silent:
            self._silent = False
            self.watched.say("the vehicle is received again")
            self.routes.usable = dict.fromkeys(self.routes.usable, arrival)  # its messages show from now on
        if route is self.routes.followed:
            return True
        self.watched.health.others += 1
        return False

    def _fails(self, now: float) -> str:
        """The reason why the followed address does not suffice for the evaluation; empty where it does."""
        routes = self.routes
        if self._mixed:
            return "two vehicles appear to send there"
        if self.watched.session is not None:
            return "" if routes.used(now) else "it sends no usable motor outputs or angular rates"
        if not routes.followed.carries(now):
            return "it sends no motor outputs or angular rates"
        unknown = self._begun is None and not self._parameters.count and now - routes.since > UNKNOWN_S
        return "it does not send its parameters" if unknown else ""

    def _reroute(self, now: float) -> None:
        """Follow another address where this one does not send the inputs of the evaluation."""
        session, routes, why = self.watched.session, self.routes, self._fails(now)
        doubted = session is not None and bool(session.doubt)
        if doubted:
            routes.doubt(now)
        other = routes.better(now, bool(why))
        if other is not None:
            why = why or ("its data are inconsistent" if doubted else "it arrived with a different clock")
            self.watched.say(f"it is now received through {other} instead of {routes.followed}: {why}")
        elif why and (self._link.talks or routes.followed.silent(now)):
            other = routes.next(now)
        if other is None:
            return
        routes.follow(other, now)
        if not self._parameters.complete:
            self._parameters = requests.Parameters(*self._key)
        if self._identity.key is None:
            self._identity = requests.Identity(*self._key)
        if doubted:
            self._anew()

    def counted(self, sequence: int) -> bool:
        """True if a frame with this running number is new."""
        health, route = self.watched.health, self.routes.followed
        step = 1 if route.sequence is None else (sequence - route.sequence) % 256
        route.senders.count(sequence)
        if step == 0 or step > 128:
            health.twice += 1
            return step != 0
        health.lost += step - 1
        health.taken += 1
        route.sequence = sequence
        return True

    def _one_sender(self) -> bool:
        """True if all frames are of one sender: a mixture of two senders cannot be evaluated."""
        several = self.routes.followed.senders.several
        if several and not self._mixed:
            self.watched.say(f"{TWO_SENDERS}; nothing is assessed until only one is left", "error")
            self.watched.session = None
        elif self._mixed and not several:
            self.watched.say("only one vehicle has this id again; watching restarts")
            self._anew()
        self._mixed = several
        return not several

    def take(self, identity: int, frame: bytes, arrival: float) -> None:
        """Process a frame of the autopilot. Errors affect this vehicle alone."""
        try:
            self._on(identity, frame, arrival)
        except Exception as why:
            self.watched.fail(why)

    def _on(self, identity: int, frame: bytes, arrival: float) -> None:
        if not self._one_sender():
            return
        layout = mavlink.layouts().get(identity)
        if layout is None:
            self._answer(identity, frame)
            return
        if identity == SYS_STATUS:
            self.status = mavlink.fields(mavlink.row(frame, layout))
        try:
            self.messages.add(layout, frame, arrival)
        except Restarted as why:
            self._restart(why.reboot)
            self.routes.restarted(arrival)
            self.messages.add(layout, frame, arrival)
        if layout.name == "PARAM_VALUE":
            row = mavlink.row(frame, layout)
            self._parameters.received(int(row["param_index"]), int(row["param_count"]), arrival)

    def _answer(self, identity: int, frame: bytes) -> None:
        answer = mavlink.decoded(identity, frame)
        if answer is None:
            return
        if identity == COMMAND_ACK:
            self.routes.followed.rates.answered(answer["command"], answer["result"])
        elif identity == MESSAGE_INTERVAL:
            self.routes.followed.rates.interval(answer["message_id"], answer["interval_us"])
        elif identity == requests.VERSION_ID:
            self._identity.received(answer["uid"], answer["uid2"], answer["flight_sw_version"], self.messages.autopilot)

    def _restart(self, reboot: bool) -> None:
        """Its clock restarted: a new flight."""
        self.watched.finish()
        health = self.watched.health
        health.reboots, health.jumps = health.reboots + reboot, health.jumps + (not reboot)
        self.watched.say("the vehicle has rebooted; watching restarts" if reboot else "the vehicle's clock was set; watching restarts")
        self._anew()

    def _anew(self) -> None:
        messages = mavlink.Messages(self.messages.autopilot, self.messages.vehicle)
        messages.inherit(self.messages)
        self.messages, self._first, self._outliers = messages, self._link.clock(), Outliers()
        self.routes.followed.sequence = None
        for route in self.routes:
            route.rates = self._rates()
        if self._begun is not None:
            self._begin(self._begun)

    def step(self, now: float) -> None:
        """Evaluate new samples, and request missing messages."""
        try:
            self._recover(now)
            self._step(now)
        except Exception as why:
            self.watched.fail(why)

    def _recover(self, now: float) -> None:
        """After an internal error, watch the vehicle from scratch: the error may not recur."""
        if not self.watched.broken:
            self._anew_at = math.inf
        elif self._anew_at == math.inf:
            self._anew_at = now + self._anew_s
            self._anew_s = min(2.0 * self._anew_s, ANEW_MOST_S)
        elif now >= self._anew_at:
            self._anew_at, self.watched.broken = math.inf, False
            self.watched.say("watching restarts after an error")
            self._anew()

    def _step(self, now: float) -> None:
        if now - self.watched.health.last_frame > SILENT_S and not self._silent:
            self._silent = True
            self.watched.say(f"nothing has been received for {SILENT_S:.0f} s")
        if text := self._losing.look(self.watched.health, now):
            self.watched.say(text)
        self._reroute(now)
        if self._mixed:
            return
        self._know(now)
        self._miss(now)
        if self._begun is None or self.messages.clock.start is None:
            return
        session = self.watched.session
        if session is None or not self.messages.pending or not self.messages.reached(session.due_s):
            return
        if self.routes.followed.senders.suspected:
            return  # a mixture of two senders cannot be evaluated: wait until that is decided
        signals, messages = self.messages.take(self._outputs, session.flying)
        self.routes.usable.update((need, now) for name, need in SIGNALS.items() if name in signals)
        if "motors" in signals:
            motors = self._outliers.take(signals.pop("motors"))
            if motors is not None:
                signals["motors"] = motors
        if signals or messages:
            self.watched.add(signals, messages)
            self.watched.advance()

    def _know(self, now: float) -> None:
        """Get parameters, from the vehicle or the cache; with them, it is watched."""
        if self._link.talks and not self._silent:
            self._parameters.step(now, self._send)
            self._identity.step(now, self._send)
            rates = self.routes.followed.rates
            if now - max(self._first, self.routes.since) > HELLO_S and not rates.done:
                rates.step(now, self._send, self.messages.rates_hz())
        if self._parameters.complete and not self._parameters.used:
            self._parameters.used = True
            there = self.messages.parameters()
            if self._identity.key:
                requests.store(self._identity.key, there)
            session = self.watched.session
            if self._begun is None or (there != self._begun and not (session is not None and session.flying)):
                self._begin(there)
            elif there != self._begun and self._airframe(there) != self._airframe(self._begun):
                self.watched.withdraw()
                self.watched.say(
                    "its parameters differ from the stored ones: it is another vehicle, or they were changed; watching restarts"
                )
                self._begin(there)
            return
        if self._begun is not None:
            return
        there = requests.cached(self._identity.key) if self._identity.key and not self._unfit else {}
        if there and self._airframe(there) is None:
            self._unfit, there = True, {}
            self.watched.say("the stored parameters do not match this vehicle; its own are requested")
        if not there and (self._parameters.given_up or self._link.known is not None or not self._link.talks):
            there = self.messages.parameters()
            if not mavlink.known(there, self.messages.autopilot) and self._link.known is None:
                return  # its heartbeat does not give the frame, and may name another kind of vehicle
        if there or self._link.known is not None:
            self._begin(there)

    def _miss(self, now: float) -> None:
        """Report inputs that do not come, or no longer come, and a remedy."""
        talks, usable = self._link.talks, self.routes.usable
        gone, lost = ([need for need in NEEDS if now - usable.get(need, now) > after] for after in (SILENT_S, FADED_S))
        self.watched.gone = f"no {_words(gone)} that can be used" if gone else ""
        if self._silent or (not usable and self.messages.clock.start is None and len(self._link.vehicles) > FEW):
            return  # many ids with heartbeats alone are no vehicles, and would cause many notices
        missing = lost
        if now - self._first >= (UNANSWERED_S if talks else MISSED_S):
            coming = talks and self._parameters.count and not self._parameters.given_up
            first = [] if self._begun is not None or coming else ["parameters"]
            never = [n for n, names in NEEDS.items() if not (n in usable or self.messages.heard(*names))]
            missing = [*first, *never[:1], *lost]
        if tuple(missing) == self._missed:
            return
        before, self._missed = self._missed, tuple(missing)
        if lost:
            self.watched.say(
                f"no {_words(lost)} that can be used have arrived for {FADED_S:.0f} s: nothing is assessed until they arrive again",
                missing=missing,
            )
        elif missing:
            self.watched.say(f"nothing can be assessed yet: {' '.join(_missing(what, talks) for what in missing)}", missing=missing)
        elif set(before) & set(NEEDS):
            self.watched.say("motor outputs and angular rates are arriving now")

    def _begin(self, parameters: dict[str, float]) -> None:
        self._begun = parameters
        self._outputs = self._wired(parameters)
        if not motor_outputs(parameters):
            self.watched.say(BY_NUMBER)
        self.watched.begin(self._about(parameters, self._outputs))

    def _wired(self, parameters: dict[str, float]) -> Outputs:
        """The outputs of its rotors."""
        known = self._link.known
        return rotor_outputs(self.messages, parameters, 0 if known is None else len(known.rotors))

    def _about(self, parameters: dict[str, float], outputs: Outputs) -> Flight:
        """The known facts of a flight with these parameters, without signals."""
        return Flight(
            FORMAT, self.messages.autopilot, {}, 0.0, vehicle_type=MAV_TYPES.get(self.messages.vehicle, ("", 0))[0],
            parameters=parameters, name=self.watched.name, facts=mavlink.facts(self.messages, parameters, outputs),
        )  # fmt: skip

    def _airframe(self, parameters: dict[str, float]) -> tuple | None:
        """Everything in these parameters that affects the evaluation of the vehicle; None where they contradict its other messages."""
        outputs, vehicle = self._wired(parameters), self._link.known
        if vehicle is None:
            try:
                vehicle = airframes.identify(self._about(parameters, outputs))
            except VehicleError:
                return None
            if len(vehicle.rotors) != len(outputs.numbers):
                return None
        return outputs, vehicle.rotors, vehicle.curve

    def _send(self, message: Outgoing) -> None:
        self._link.send(message, self.routes.followed.peer)

    def waits_for(self) -> str:
        """The data still missing, in a few words."""
        if self._begun is not None:
            return ""
        return f"parameters, {self._parameters.share:.0%}" if self._parameters.count else "parameters"

    def restore_rates(self) -> None:
        """Restore the original message rates."""
        if self._link.talks:
            for route in self.routes:
                route.rates.restore(lambda message, peer=route.peer: self._link.send(message, peer))

    @property
    def empty(self) -> bool:
        """True if it has sent nothing that could be evaluated."""
        return self.watched.session is None or self.watched.session.vehicle is None


class Link:
    """A watched endpoint. known: the vehicle, where a file gives it. talks: whether it may send requests to the vehicle."""

    def __init__(
        self, endpoint: Endpoint, tell: Notify, known: Vehicle | None = None, record: Path | None = None, talks: bool = True,
        patience_s: float = 30.0, clock: Callable[[], float] = time.monotonic,
    ):  # fmt: skip
        """record: folder to record in. patience_s: longest wait for a first vehicle. clock: time of arrival [s]. Raises ConfigError for a
        folder that cannot be written."""
        self.clock = clock
        self.endpoint, self.known, self.talks = endpoint, known, talks
        self._notify, self._patience_s = tell, patience_s
        self._parsers: dict[Any, Any] = {}
        self._vehicles: dict[tuple[int, int], LinkedVehicle] = {}
        self._fresh: dict[LinkedVehicle, None] = {}  # vehicles with new frames since their last evaluation
        self._stepped = 0.0
        self._refused: set[int] = set()
        self._outside: dict[tuple[int, int], bytes] = {}  # heartbeats of vehicles beyond the limit
        self.frames = self._damaged_before = 0
        self._began, self._beat = clock(), 0.0
        self._sender = Sender(requests.SYSTEM, requests.COMPONENT)
        self._tellers: dict[int, Sender] = {}
        # (vehicle, peer, system and component that ask, message id, fields) of what others ask of us as one of a vehicle's components
        self.asked: deque[tuple[str, Any, tuple[int, int], int, dict[str, Any]]] = deque(maxlen=ASKED)
        self._first_version = False
        self.trouble = ""  # a non-fatal problem: a stopped recording
        self._record = self._open(record) if record is not None else None
        self._crowded = -math.inf

    @property
    def damaged(self) -> int:
        """Stretches of bytes without a valid frame."""
        return self._damaged_before + sum(parser.damaged for parser in self._parsers.values())

    @property
    def vehicles(self) -> tuple[Watched, ...]:
        return tuple(vehicle.watched for vehicle in self._vehicles.values())

    def shown(self) -> list[tuple[Watched, str]]:
        """Each vehicle with its missing data."""
        return [(vehicle.watched, vehicle.waits_for()) for vehicle in self._vehicles.values()]

    def _open(self, folder: Path) -> Record:
        name = re.sub(r"[^A-Za-z0-9]+", "-", self.endpoint.name).strip("-")
        path = folder / f"{name}-{datetime.now(timezone.utc):%Y%m%dT%H%M%S}.tlog"
        return Record(path, self._unrecorded)

    def _unrecorded(self, text: str) -> None:
        self.trouble = text
        self._notify({"type": "error", "vehicle": self.endpoint.name, "text": text})

    def poll(self, wait_s: float) -> bool:
        """Process everything received."""
        received = self.endpoint.receive(wait_s)
        for peer, data in received:
            self._take(peer, data)
        now = self.clock()
        if not received or now - self._stepped > ALL_S:
            self._stepped, self._fresh = now, dict.fromkeys(self._vehicles.values())
        if not self.endpoint.open:
            self._damaged_before = self.damaged
            self._parsers.clear()
            self.endpoint.again()
        if self.talks and now - self._beat > BEAT_S:
            self._beat = now
            self.send(requests.heartbeat())
        if self._record is not None:
            self._record.step()
        for vehicle in self._fresh:
            vehicle.step(now)
        self._fresh = {}
        if not self._vehicles and now - self._began > self._patience_s:
            raise LinkError(self._why_none())
        return True

    def _why_none(self) -> str:
        """The reason why no vehicle is watched."""
        if self.damaged and not self.frames:
            slow = "is the baud rate right, and " if self.endpoint.slow else ""
            return f"{self.endpoint.name}: data arrive but are not MAVLink; {slow}is MAVLink sent here?"
        others = ", ".join(sorted(OTHERS.get(k, "something unknown") for k in self._refused))
        return (
            f"{self.endpoint.name}: no heartbeat of a multirotor has arrived within {self._patience_s:.0f} s"
            f"{f' (only {others})' if others else ''}; check the address, and that the vehicle is on and sending here."
        )

    def send(self, message: Outgoing, peer: Any = None) -> None:
        """A message to one peer, or to all."""
        self.endpoint.send(self._sender.frame(message, self._first_version), peer)

    def broadcast(self, name: str, message: Outgoing, peer: Any = None) -> None:
        """Send a message to one peer, or to all listeners, as an onboard computer of the vehicle of this name. MAVLink 1 has no messages
        beyond number 255."""
        system = next((key[0] for key, vehicle in self._vehicles.items() if vehicle.watched.name == name), None)
        if system is None or not self.talks or (self._first_version and message.number > 255):
            return
        sender = self._tellers.setdefault(system, Sender(system, requests.COMPONENT))
        self.endpoint.send(sender.frame(message, self._first_version), peer)

    def status(self, name: str) -> dict[str, Any] | None:
        """The fields of the last SYS_STATUS of the vehicle of this name."""
        return next((vehicle.status for vehicle in self._vehicles.values() if vehicle.watched.name == name), None)

    def boot_ms(self, name: str, time_s: float | None = None) -> int:
        """The vehicle's own time, as in its messages; time_s: that of its flight, None for now."""
        clock = next((vehicle.messages.clock for vehicle in self._vehicles.values() if vehicle.watched.name == name), None)
        if clock is None or clock.start is None:
            return 0
        return int(clock.start * 1e-3 + (clock.now if time_s is None else time_s) * 1e3) % 2**32

    def _take(self, peer: Any, data: bytes) -> None:
        parser = self._parsers.get(peer)
        if parser is None:
            parser = self._parsers[peer] = Frames()
            if len(self._parsers) > PEERS:
                self._damaged_before += self._parsers.pop(next(iter(self._parsers))).damaged
        arrival, frames = self.clock(), parser.take(data)
        if frames:
            self.endpoint.answers(peer)
        for frame in frames:
            self.frames += 1
            if self._record is not None:
                self._record.add(frame)
            self._dispatch(peer, frame, arrival)

    def _dispatch(self, peer: Any, frame: bytes, arrival: float) -> None:
        sequence, system, component, identity = mavlink.header(frame)
        vehicle = self._vehicles.get((system, component))
        if vehicle is None:
            if identity in ASKS:
                self._hear(peer, frame, (system, component), identity)
            beat = frame if identity == 0 else self._outside.pop((system, component), None)
            if beat is not None:
                self._meet(peer, beat, system, component, identity != 0)
            return
        if not vehicle.hear(peer, identity, arrival):
            return
        self._fresh[vehicle] = None
        if vehicle.counted(sequence):
            vehicle.take(identity, frame, arrival)

    def _hear(self, peer: Any, frame: bytes, who: tuple[int, int], identity: int) -> None:
        """Keep what is asked of us as an onboard computer of a vehicle."""
        asked = mavlink.decoded(identity, frame)
        if asked is None or asked["target_component"] != requests.COMPONENT:
            return
        for (system, _), vehicle in self._vehicles.items():
            if system == asked["target_system"]:
                self.asked.append((vehicle.watched.name, peer, who, identity, asked))
                return

    def _meet(self, peer: Any, frame: bytes, system: int, component: int, more: bool) -> None:
        """A heartbeat of a new sender. more: it has sent other messages as well."""
        beat = mavlink.row(frame, mavlink.layouts()[0])
        autopilot, kind = int(beat["autopilot"]), int(beat["type"])
        if autopilot == NO_AUTOPILOT:
            return
        if kind not in MAV_TYPES:
            if kind not in self._refused:
                self._refused.add(kind)
                what = OTHERS.get(kind, f"of an unknown kind (MAV_TYPE {kind})")
                self._notify(
                    {"type": "notice", "vehicle": self._name(system, component), "text": f"this is {what}; only multirotors are supported"}
                )
            return
        if len(self._vehicles) >= VEHICLES and not self._room(more):
            self._outside[system, component] = frame
            return
        self._first_version = frame[0] == 0xFE
        name = self._name(system, component)
        words = mavlink.AUTOPILOTS.get(autopilot, f"MAVLink autopilot {autopilot}")
        watched = Watched(name, self._notify, self.known)
        watched.health.last_frame = self.clock()
        self._vehicles[system, component] = LinkedVehicle(watched, (system, component), words, kind, self, peer)
        watched.say(f"{words}, {MAV_TYPES[kind][0]}")

    def _room(self, more: bool) -> bool:
        """Make room for one more vehicle and return whether there is any: in place of a silent one without usable data; for one that sends
        more than heartbeats also of one that sends nothing else."""
        now = self.clock()
        for key, vehicle in self._vehicles.items():
            silent = now - vehicle.watched.health.last_frame > SILENT_S
            if vehicle.empty and (silent or (more and vehicle.only_beats)):
                vehicle.restore_rates()
                self._fresh.pop(vehicle, None)
                del self._vehicles[key]
                return True
        if now - self._crowded > 60.0:
            self._crowded = now
            text = f"more than {VEHICLES} vehicles are received here; the others are ignored"
            self._notify({"type": "error", "vehicle": self.endpoint.name, "text": text})
        return False

    def _name(self, system: int, component: int) -> str:
        return f"{self.endpoint.name}/{system}" + (f".{component}" if component != 1 else "")

    def leave(self) -> None:
        """Restore the rates, and close. The vehicles come first: there may be no time for more."""
        for vehicle in self._vehicles.values():
            vehicle.restore_rates()
        if self._record is not None:
            self._record.close()
        for vehicle in self._vehicles.values():
            health = vehicle.watched.health
            vehicle.watched.finish()
            vehicle.watched.say(f"{health.taken} messages received; {health.words() or 'none was lost'}")
        self.endpoint.close()
