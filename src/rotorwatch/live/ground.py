"""Alerts in the words of a ground station: which are worth a text, the text, and its severity.

STATUSTEXT, NAMED_VALUE_FLOAT: https://mavlink.io/en/messages/common.html
"""

from __future__ import annotations

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

STEP = 0.1  # change of a loss that is sent again: a smaller one would fill a pilot's screen
CAUSES = {  # of a loss of control without a rotor, in few characters
    "disarmed": "motors stopped", "knock": "collision", "controller": "wrong commands", "saturated": "no thrust left",
    "power": "power failed",
}  # fmt: skip


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
