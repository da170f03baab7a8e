"""The kinds of events, one row each: texts, meaning for a rotor, and duration.

All code that depends on the meaning of an event uses this table, so that a new kind is a row and the code that finds it. The row of an
event that one witness alone finds is in that witness's file; all others are here. A sentence is a template; `answer/wording.py` lists its
fields.
"""

from __future__ import annotations

import importlib
from enum import Enum
from typing import Any, NamedTuple

LOSS, OVERRIDE, CONTACT, LOST = "loss_of_effectiveness", "output_override", "contact", "loss_of_control"
ORDER, TURNED = "motor_order", "turned_mount"
EVIDENCE, FROM_TAKEOFF = "unexplained_evidence", "damage_from_takeoff"
# Of these a witness holds the row: witnesses/aerobatic, esc, reports.py, healthy, balance and rivals.py.
DESYNC = "desync"
SLOW, HIGH, LOW = "slow_motor", "high_current", "low_current"
REPORTED = "autopilot_report"
AT_LIMIT, HEAVY, UNEVEN = "outputs_at_limit", "little_thrust_left", "yaw_imbalance"
STANDS_APART, EXHAUSTED = "output_stands_apart", "too_little_without_rotor"
GIVEN_UP, CAPPED, OSCILLATES = "output_given_up", "outputs_capped", "outputs_oscillate"
SLOW_RESPONSE = "slow_response"
OUT_OF_BALANCE, UNBALANCED = "out_of_balance", "became_out_of_balance"
UNKNOWN = -1  # number of a kind that the table lacks

# What no hypothesis holds happens too: of 250 events of the open world that evidence alone makes surer than 99.9 %, 244 name broken rotors
# only (docs/results.md#stated-probabilities). No answer says that it is surer.
SUREST = 0.975


class Weight(Enum):
    """Severity. FAULT: a rotor, its motor or its output is faulty, and the verdict rests on it. UPSET: the vehicle is in trouble, and the
    answer is about that where no fault is found. NOTICE: of a motor that still gives its thrust. OUTSIDE: not of the vehicle. OPEN: it
    counts for the verdict, but has no known time; it appears in the words of an answer, not among its events."""

    FAULT, UPSET, NOTICE, OUTSIDE, OPEN = range(5)


class Span(Enum):
    """Duration. MOMENT: none. SPELLS: momentary spells, and its end is that of the last one. LASTS: its rotors do not follow their commands
    from its onset to its end. STAYS: nothing in the flight ends it."""

    MOMENT, SPELLS, LASTS, STAYS = range(4)


class Words(NamedTuple):
    """Sentences on an event: with one set of rotors, with several possible sets, and without a rotor; None: as for one set."""

    sure: str = ""
    unsure: str | None = None
    nameless: str | None = None

    def template(self, event: Any) -> str:
        """The template for an event."""
        if event.alternatives and self.unsure is not None:
            return self.unsure
        return self.sure if event.rotors or self.nameless is None else self.nameless


# Defaults for a row.
_HEADLINE = Words("{noun} of {who} at {at}{until}{again}.", "{noun} at {at}: {candidates}.", "{noun} at {at}.")
_BEGAN = Words("At {at} {noun} of {who}{over}.", "At {at} {noun}: {candidates}.", "At {at} {noun}{over}.")
_NOW = Words("{noun} since {at}", "one of several candidates since {at}")
_PAST = Words("{noun} at {at}", "maybe {noun} at {at}")
_ADVICE = Words(
    "Do not fly again until {who} has been inspected: motor, propeller, ESC, mount and output.",
    "",
    "Inspect the vehicle before the next flight.",
)
_WATCH = Words("{noun} of {who} at {ago}{over}", nameless="{noun} at {ago}{over}")


class Kind(NamedTuple):
    """number: in compiled definitions (engine/events/events.py) and on boards; a new kind takes the next one wherever its row is, and no
    number is ever reused. name: in JSON. noun: in tables and titles. meaning: in a few words (docs/json.md). weight, span: see there.
    weakens: its rotors lack a share of their thrust, its `loss`. impairs: they give all of it, but not as they should. by_outputs: it
    assumes that the logged outputs drive the motors, and is dropped where they may not. brief: follows its rotors on a ground station's
    screen, in 30 letters. headline: for a pilot. reason: of the verdict. began: as the beginning of a loss of control. now, past: a
    rotor's note while it lasts, and after it; for an event with several explanations, without such words in `now`, only its own rotors
    are suspects. advice: recommended action. watch: a line on the screen while the vehicle flies."""

    number: int
    name: str
    noun: str
    meaning: str = ""
    weight: Weight = Weight.OUTSIDE
    span: Span = Span.STAYS
    weakens: bool = False
    impairs: bool = False
    by_outputs: bool = True
    brief: str = ""
    headline: Words = _HEADLINE
    reason: str = "{why}"
    began: Words = _BEGAN
    now: Words = _NOW
    past: Words = _PAST
    advice: Words = _ADVICE
    watch: Words = _WATCH

    @property
    def accuses(self) -> bool:
        """True if it indicates a fault of a rotor, its motor or its output."""
        return self.weight is Weight.FAULT

    @property
    def wrong(self) -> bool:
        """True if something is wrong with the flight: shown first, and in the colour of a fault."""
        return self.weight in (Weight.FAULT, Weight.UPSET)

    @property
    def lasts(self) -> bool:
        """True if it lasts until it ends."""
        return self.span is Span.LASTS

    @property
    def lasting_fault(self) -> bool:
        """True if its rotors do not follow their commands from its onset to its end."""
        return self.accuses and self.lasts

    def ongoing(self, end_s: float | None) -> bool:
        """True if an event that ended at `end_s` s (None: it lasts) is still wrong."""
        return self.wrong and (self.span is Span.STAYS or (self.lasts and end_s is None))


_WRONG_WAY = "propellers or motors turn in the wrong direction."


ROWS = (
    Kind(
        0, LOSS, "loss of effectiveness", "a rotor lost effectiveness", Weight.FAULT, Span.LASTS, weakens=True,
        headline=Words("{who} {lost} {when}{until}{cause}{again}.", "Loss of thrust at {at}: {candidates}."),
        reason="{plain_who} {lost_effect} {when}{until}: {why}",
        began=Words("At {at} {who} {lost}{over}.", "At {at} thrust was lost: {candidates}."),
        now=Words("weak since {at}", "one of several candidates since {at}"),
        past=Words("was weak from {at} to {end}", "may have been weak from {at} to {end}"),
        advice=Words("Do not fly again until {who} has been inspected: {parts}.", ""),
        watch=Words("{who} {lacks} since {ago}{over}{others}"),
    ),
    Kind(
        1, OVERRIDE, "output overridden", "an output does not follow the mixer: stuck, off, replaced", Weight.FAULT, Span.LASTS,
        headline=Words("The output of {who} did not follow the mixer {from_on}{until}{again}."),
        began=Words("At {at} the output of {candidates} stopped following the mixer{over}."),
        now=Words("its output has not followed the mixer since {at}"),
        past=Words("its output did not follow the mixer from {at} to {end}"),
        advice=Words(
            "Do not fly again until it is clear why the output of {who} departed from the mixer: output functions and passthrough, "
            "motor test, failsafe, a second controller.", "",
        ),
    ),
    Kind(
        2, CONTACT, "contact or collision", "a blow, a collision, contact with the ground", Weight.OUTSIDE, Span.MOMENT, by_outputs=False,
        advice=Words("Inspect the vehicle for damage: it was struck or made contact at {all_times}."),
    ),
    Kind(
        3, LOST, "loss of control", "the vehicle departed controlled flight and did not recover", Weight.UPSET, Span.STAYS,
        by_outputs=False, brief="LOSS OF CONTROL",
        headline=Words("The vehicle departed controlled flight at {at}."),
        now=Words("may have caused the loss of control at {at}"),
        watch=Words("{noun} at {ago}, {who}{others}: {lost_why}", nameless="{noun} at {ago}{others}: {lost_why}"),
    ),
    Kind(
        4, ORDER, "motors in the wrong order", "outputs go to the wrong motors, or yaw is reversed", Weight.FAULT, Span.STAYS,
        brief="wrong motor order",
        headline=Words(
            "The outputs of motors {numbers} are swapped.", "Loss of thrust at {at}: {candidates}.",
            f"Yaw is reversed: {_WRONG_WAY}",
        ),
        began=Words(
            "From its first movement at {at} it turned as if the outputs of motors {numbers} were swapped: {who}.",
            nameless=f"From its first movement at {{at}} it yawed against its commands: {_WRONG_WAY}",
        ),
        now=Words("its output appears to drive motor {other}"),
        past=Words(""),
        advice=Words(
            "Before flying, check with the motor test which output drives which motor, and swap the outputs of motors {numbers} "
            "(ArduPilot: {servos}; PX4: the actuator page) or their wires.",
            nameless="Before flying, check the direction of every motor and its propeller against the frame diagram, with the motor "
            "test.",
        ),
    ),
    Kind(
        9, TURNED, "twisted motor mount", "more yaw command than before: a motor mount or an arm has twisted", Weight.NOTICE,
        brief="motor mount twisted",
        headline=Words(
            "is on a mount that has twisted", nameless="A motor mount or an arm appears to have twisted, which yaws the vehicle: {why}."
        ),
        past=Words("its mount twisted at {at}"),
        advice=Words(
            "Inspect the mount and the arm of {who} before the next flight.",
            nameless="Inspect every motor mount and arm before the next flight: one has twisted, or a propeller's drag has changed.",
        ),
    ),
    Kind(16, EVIDENCE, "unexplained evidence", "evidence against rotors that no event explains", Weight.OPEN, Span.SPELLS),
    Kind(
        17, FROM_TAKEOFF, "damage present at take-off", "the balance of commands differs from that of healthy flights or vehicles",
        Weight.OPEN, Span.STAYS,
    ),
)  # fmt: skip
_TABLE = {row.name: row for row in ROWS}


def register(*rows: Kind) -> None:
    """Add the kinds of a witness, in its own file. Raises TypeError for a name or a number that another kind has."""
    for row in rows:
        taken = next((k for k in _TABLE.values() if row.name == k.name or row.number == k.number), None)
        if taken is not None and taken != row:
            raise TypeError(f"the kind {row.name} ({row.number}) is taken by {taken.name} ({taken.number})")
        _TABLE[row.name] = row


def table() -> dict[str, Kind]:
    """Name -> kind, of all kinds in the order of their numbers, those of every witness included."""
    importlib.import_module("rotorwatch.witnesses.witness").registered()  # each witness registers its kinds as it is loaded
    return dict(sorted(_TABLE.items(), key=lambda item: item[1].number))


def kind_of(name: str) -> Kind:
    """The row of a kind; for an unknown kind, one with its name as its words."""
    return _TABLE.get(name) or table().get(name) or Kind(UNKNOWN, name, name.replace("_", " "))


def number(name: str) -> int:
    """The number of a kind in compiled definitions. Raises KeyError for one that the table lacks."""
    return (_TABLE if name in _TABLE else table())[name].number
