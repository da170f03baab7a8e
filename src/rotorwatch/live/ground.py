"""Alerts to a vehicle's ground stations, over its own link: STATUSTEXT in plain words, and NAMED_VALUE_FLOAT of each rotor's loss.

Both messages only inform; nothing here commands a vehicle. They come from an onboard computer of the vehicle's own system, as from a
companion computer, so that routers forward them and ground stations show them with the vehicle's other texts. STATUSTEXT,
NAMED_VALUE_FLOAT: https://mavlink.io/en/messages/common.html
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from rotorwatch.engine.bindings.event_rows import packed
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.events import calls, words
from rotorwatch.engine.events.texts import GIVES
from rotorwatch.engine.events.words import CRITICAL, NOTICE, WARNING
from rotorwatch.flight.kinds import Span, Weight, kind_of
from rotorwatch.live.alert_states import WITHDRAWN
from rotorwatch.live.framing import Outgoing, outgoing
from rotorwatch.live.link import Link
from rotorwatch.live.watch import Source

PAUSE_S = 2.0  # between two texts of one vehicle
A_MINUTE = 10  # texts of one vehicle in a minute
STEP = 0.1  # change of a loss that is sent again: a smaller one would fill a pilot's screen
SLOW_S, FAST_S = 5.0, 1.0  # between two values of a rotor, on serial ports and elsewhere
CAUSES = {  # of a loss of control without a rotor, in few characters
    "disarmed": "motors stopped", "knock": "collision", "controller": "wrong commands", "saturated": "no thrust left",
    "power": "power failed",
}  # fmt: skip


@dataclass
class _Vehicle:
    """sent: event -> (rotors, alternatives, over, losses) as last sent; waiting: event -> the latest alert."""

    sent: dict[int, tuple] = field(default_factory=dict)
    waiting: dict[int, dict] = field(default_factory=dict)
    texts: list[float] = field(default_factory=list)  # when they were sent
    values: float = -math.inf


class Ground:
    """Informs the ground stations of all vehicles that are watched over links."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        """clock: s, of any origin."""
        self._clock = clock
        self._vehicles: dict[str, _Vehicle] = {}

    def take(self, alert: dict) -> None:
        """Queue an alert. Only the latest of each event is kept, so that fast changes are sent once."""
        if alert["type"] == "vehicle":  # a new flight restarts the numbers of events
            self._vehicles[alert["vehicle"]] = _Vehicle(texts=self._of(alert["vehicle"]).texts)
        elif alert["type"] == "event":
            self._of(alert["vehicle"]).waiting[alert["number"]] = alert
        elif alert["type"] == "notice" and "rotor" in alert:  # of its ESC; event numbers begin with 1
            self._of(alert["vehicle"]).waiting[-alert["rotor"]] = alert

    def _of(self, name: str) -> _Vehicle:
        return self._vehicles.setdefault(name, _Vehicle())

    def step(self, sources: Sequence[Source]) -> None:
        """Send the due texts and values."""
        now = self._clock()
        for source in sources:
            if not isinstance(source, Link):
                continue
            for watched in source.vehicles:
                vehicle = self._of(watched.name)
                if vehicle.waiting:
                    self._texts(source, watched.name, vehicle, now)
                every = SLOW_S if source.endpoint.slow else FAST_S
                if now - vehicle.values >= every and watched.session is not None and watched.session.flying:
                    known = watched.session.losses()
                    if known is not None:
                        vehicle.values = now
                        for number, loss in enumerate(known[0].tolist(), 1):
                            source.broadcast(watched.name, value(source.boot_ms(watched.name), number, loss))

    def leave(self) -> None:
        """Pending texts are dropped: the link is closing."""

    def _texts(self, link: Link, name: str, vehicle: _Vehicle, now: float) -> None:
        vehicle.texts = [t for t in vehicle.texts if t > now - 60.0]
        for number, alert in list(vehicle.waiting.items()):
            if not worth_sending(vehicle.sent.get(number), alert):
                del vehicle.waiting[number]
        if not vehicle.waiting or len(vehicle.texts) >= A_MINUTE:
            return
        if vehicle.texts and now - vehicle.texts[-1] < PAUSE_S:
            return
        number, alert = min(vehicle.waiting.items(), key=lambda item: (text_of(item[1])[1], item[0]))
        del vehicle.waiting[number]
        vehicle.sent[number] = gist(alert)
        vehicle.texts.append(now)
        link.broadcast(name, text(alert))


def gist(alert: dict) -> tuple:
    """The parts of an alert whose change is worth a text."""
    if alert["type"] == "notice":
        return (alert["text"],), (), False, False, (), 0.0
    event = alert["event"]
    over = _over(event), alert["state"] == WITHDRAWN
    who = tuple(event["rotors"]), (event.get("cause"), *map(tuple, event["alternatives"]))
    return *who, *over, tuple(event["loss"]), event.get("gives", 0.0)


def _over(event: dict) -> bool:
    """Knocks have no duration, and an event that ended with the impact is not over."""
    return kind_of(event["kind"]).span is not Span.MOMENT and event["end_s"] is not None and not event.get("impact_s")


def worth_sending(reported: tuple | None, alert: dict) -> bool:
    """True if an alert is worth a text: it is new, or the loss has moved by STEP since it was sent, or a stuck rotor's thrust by GIVES."""
    if "texts" in alert.get("event", ()):
        return False  # the autopilot itself has informed the ground stations
    new = gist(alert)
    if reported is None:
        return not new[3]  # withdrawn before it was sent
    if reported[:4] != new[:4]:
        return True
    before, gives = reported[5], new[5]
    if before or gives:  # the loss of a rotor that follows no command is not sent
        return not (before and gives) or abs(gives - before) > GIVES * before
    return any(abs(a - b) >= STEP for a, b in zip(reported[4], new[4]))


def text_of(alert: dict) -> tuple[str, int]:
    """(a text of plain ASCII, severity) of an alert: engine/events/words.py. A loss of control is critical as well."""
    if alert["type"] == "notice":
        stopped = "stopped" in alert["text"]
        text = f"rotorwatch: ESC: rotor {alert['rotor']} {'stopped' if stopped else 'turns again'}"
        return text, CRITICAL if stopped else NOTICE
    event: Any = SimpleNamespace(**alert["event"], extra=alert["event"])
    withdrawn = alert["state"] == WITHDRAWN
    kind = kind_of(event.kind)
    what, upset = kind.brief or kind.noun, kind.weight is Weight.UPSET
    if "trouble" in alert["event"]:
        what += f": {alert['event']['trouble']}"
    if upset:
        numbers = "+".join(map(str, event.rotors))
        who = f"rotor{'s' if len(event.rotors) > 1 else ''} {numbers}" if numbers else CAUSES.get(alert["event"].get("cause"), "")
        what, event.rotors = ", ".join(filter(None, (what, who))), ()
    if not _over(alert["event"]):
        event.end_s = None
    words_ = ENGINE.new(words.Words)
    severity = ENGINE.call(calls.in_words, packed([event]), withdrawn, what, words_)
    text = bytes(words_["at"].reshape(-1)[: int(words_["length"][0])].tolist()).decode("ascii")
    return text, CRITICAL if upset and severity == WARNING else severity


def text(alert: dict) -> Outgoing:
    """The STATUSTEXT of an alert."""
    sent, severity = text_of(alert)
    return outgoing("STATUSTEXT", severity=severity, text=sent.encode())


def value(boot_ms: int, rotor: int, loss: float) -> Outgoing:
    """The NAMED_VALUE_FLOAT of a rotor's loss, 0 to 1."""
    return outgoing("NAMED_VALUE_FLOAT", time_boot_ms=boot_ms, name=f"rw_loss{rotor}".encode(), value=loss)
