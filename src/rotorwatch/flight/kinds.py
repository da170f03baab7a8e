"""The kinds of events, one row each: texts, meaning for a rotor, and duration.

All code that depends on the meaning of an event uses this table, so that a new kind is a row here and the code that finds it. A sentence is
a template; `answer/wording.py` lists its fields.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

LOSS, OVERRIDE, CONTACT, LOST = "loss_of_effectiveness", "output_override", "contact", "loss_of_control"
ORDER, DESYNC = "motor_order", "desync"
SLOW, HIGH, LOW = "slow_motor", "high_current", "low_current"
TURNED = "turned_mount"
REPORTED = "autopilot_report"
EVIDENCE, FROM_TAKEOFF = "unexplained_evidence", "damage_from_takeoff"
AT_LIMIT, HEAVY, UNEVEN = "outputs_at_limit", "little_thrust_left", "yaw_imbalance"
STANDS_APART, EXHAUSTED = "output_stands_apart", "too_little_without_rotor"
UNKNOWN = -1  # number of a kind that the table lacks


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
_NOW = Words("{noun} since {at}", "one of several explanations since {at}")
_PAST = Words("{noun} at {at}", "maybe {noun} at {at}")
_ADVICE = Words(
    "Do not fly again before {who} has been looked at: motor, propeller, ESC, mount and output.",
    "",
    "Look the vehicle over before the next flight.",
)
_WATCH = Words("{noun} of {who} at {ago}{over}", nameless="{noun} at {ago}{over}")


class Kind(NamedTuple):
    """number: in compiled definitions (engine/front/events.py) and on boards; a new kind takes the next one wherever its row is, and no
    number is ever reused. name: in JSON. noun: in tables and titles. meaning: in a few words (docs/json.md). weight, span: see there.
    weakens: its rotors lack a share of their thrust, its `loss`. by_outputs: it assumes that the logged outputs drive the motors, and is
    dropped where they may not. brief: follows its rotors on a ground station's screen, in 30 letters. headline: for a pilot. reason: of the
    verdict. began: as the beginning of a loss of control. now, past: a rotor's note while it lasts, and after it; for an event with several
    explanations, without such words in `now`, only its own rotors are suspects.
    advice: recommended action. watch: a line on the screen while the vehicle flies."""

    number: int
    name: str
    noun: str
    meaning: str = ""
    weight: Weight = Weight.OUTSIDE
    span: Span = Span.STAYS
    weakens: bool = False
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


_WRONG_WAY = "propellers or motors turn the wrong way round."


def _notice(number: int, name: str, noun: str, meaning: str, verb: str, part: str) -> Kind:
    """A kind that ESC telemetry alone shows. verb: the motor's behaviour; part: the part to inspect."""
    why = "before the next flight: its ESC telemetry changed in flight, though no thrust was missed."
    past, advice = Words(f"{verb} since {{at}}"), Words(f"Look at {part} {{who}} {why}")
    return Kind(number, name, noun, meaning, Weight.NOTICE, brief=verb, headline=Words(verb), past=past, advice=advice)


def _setup(number: int, name: str, noun: str, meaning: str, brief: str, advice: str) -> Kind:
    """A kind of finding from outputs on the vehicle's build, load and setup: of no rotor, with its number in its reason."""
    return Kind(number, name, noun, meaning, Weight.NOTICE, brief=brief, headline=Words("{Why}."), advice=Words(advice))


ROWS = (
    Kind(
        0, LOSS, "loss of effectiveness", "a rotor lost effectiveness", Weight.FAULT, Span.LASTS, weakens=True,
        headline=Words("{who} {lost} {when}{until}{cause}{again}.", "Something lost thrust at {at}: {candidates}."),
        reason="{plain_who} {lost_effect} {when}{comma_until}: {why}",
        began=Words("At {at} {who} {lost}{over}.", "At {at} something lost thrust: {candidates}."),
        now=Words("weak since {at}", "one of several explanations since {at}"),
        past=Words("was weak from {at} to {end}", "may have been weak from {at} to {end}"),
        advice=Words("Do not fly again before {who} has been looked at: {parts}.", ""),
        watch=Words("{who} {lacks} since {ago}{over}{others}"),
    ),
    Kind(
        1, OVERRIDE, "output overridden", "an output does not follow the mixer: stuck, off, replaced", Weight.FAULT, Span.LASTS,
        headline=Words("The output of {who} stopped following the mixer at {at}{until}{again}."),
        began=Words("At {at} the output of {candidates} stopped following the mixer{over}."),
        now=Words("its output has not followed the mixer since {at}"),
        past=Words("its output did not follow the mixer from {at} to {end}"),
        advice=Words(
            "Do not fly again before it is clear why the output of {who} left the mixer: output functions and passthrough, motor test, "
            "failsafe, a second controller.", "",
        ),
    ),
    Kind(
        2, CONTACT, "knock or contact", "a knock, a collision, contact with the ground", Weight.OUTSIDE, Span.MOMENT, by_outputs=False,
        advice=Words("Look the vehicle over for damage: it was knocked at {all_times}."),
    ),
    Kind(
        3, LOST, "loss of control", "the vehicle left what was wanted and did not come back", Weight.UPSET, Span.STAYS,
        by_outputs=False, brief="LOSS OF CONTROL",
        headline=Words("The vehicle left control at {at}."),
        now=Words("may be why control was lost at {at}"),
        watch=Words("{noun} at {ago}, {who}{others}: {lost_why}", nameless="{noun} at {ago}{others}: {lost_why}"),
    ),
    Kind(
        4, ORDER, "motors in the wrong order", "outputs go to the wrong motors, or yaw is reversed", Weight.FAULT, Span.STAYS,
        brief="in the wrong order",
        headline=Words(
            "The outputs of motors {numbers} go to each other's motor.", "Something lost thrust at {at}: {candidates}.",
            f"The vehicle yaws against its commands: {_WRONG_WAY}",
        ),
        began=Words(
            "From its first movement at {at} on it turned as if the outputs of motors {numbers} went to each other's motor: {who}.",
            nameless=f"From its first movement at {{at}} on it yawed against its commands: {_WRONG_WAY}",
        ),
        now=Words("its output seems to go to motor {other}"),
        past=Words(""),
        advice=Words(
            "Do not fly before the motor test has shown which motor answers to which output: swap the outputs of motors {numbers} "
            "(ArduPilot: {servos}; PX4: the actuator page), or their wires.",
            nameless="Do not fly before each motor's direction and its propeller have been checked against the frame's drawing: motor "
            "test.",
        ),
    ),
    Kind(
        5, DESYNC, "motor lost step", "a motor lost step for moments: commanded up, it gave nothing for 30 to 500 ms and came back",
        Weight.FAULT, Span.SPELLS, brief="lost step",
        headline=Words("{motors} desynced {times} at {at}{stopped}."),
        past=Words("desynced at {at}{in_all}", "may have desynced at {at}{in_all}"),
        advice=Words(
            "Do not fly again before {motors} and its ESC have been looked at: motor timing, demag compensation, ESC firmware, PWM "
            "frequency, a worn bearing or loose bell, solder joints{log_speed}."
        ),
    ),
    _notice(
        6, SLOW, "motor slower than commanded", "a motor turns slower than commanded, by its ESC telemetry", "turns slower than commanded",
        "motor, ESC, their connectors and supply wires of",
    ),
    _notice(
        7, HIGH, "motor draws more current", "more current at the same speed than before: a bearing", "draws more current than before",
        "the motor bearings of",
    ),
    _notice(
        8, LOW, "motor draws less current", "less current at the same speed than before: a propeller", "draws less current than before",
        "the propeller of",
    ),
    Kind(
        9, TURNED, "turned motor mount", "the vehicle needs more yaw than before: a motor mount or an arm has turned", Weight.NOTICE,
        brief="a mount turned",
        headline=Words(
            "sits on a mount that has turned", nameless="A motor mount or an arm seems to have turned, and yaws the vehicle: {why}."
        ),
        past=Words("its mount has turned at {at}"),
        advice=Words(
            "Look at the mount and the arm of {who} before the next flight.",
            nameless="Look at every motor mount and arm before the next flight: one has turned, or a propeller's drag has changed.",
        ),
    ),
    Kind(
        10, REPORTED, "report of the autopilot", "what the autopilot itself reported in flight: battery, radio, position, estimator, ...",
        Weight.NOTICE, by_outputs=False, brief="reported trouble",
        headline=Words("", nameless="At {at} {why}."), watch=Words("{noun} of {who} at {ago}", nameless="{noun} at {ago}: {why}"),
        advice=Words("", nameless="At {at} {why}: find out why before the next flight."),
    ),
    _setup(
        11, AT_LIMIT, "outputs at their limit", "outputs stood at their limit for long", "outputs at their limit",
        "Give the vehicle more room: less weight, a fresh battery, less wind, gentler climbs. Where only some motors stand at their limit, "
        "look for a load off the middle and for twisted mounts.",
    ),
    _setup(
        12, HEAVY, "little thrust left", "hover takes nearly all of the thrust: too heavy, or a weak battery", "little thrust left",
        "Take weight off, charge the battery, or fit stronger motors before the next flight: a vehicle should lift twice its weight.",
    ),
    _setup(
        13, UNEVEN, "yaw imbalance", "rotors of one sense of rotation work harder since take-off: twisted mounts", "yaw imbalance",
        "Set every motor upright, and look for twisted arms; then compare propellers and ESC end points of both senses of rotation.",
    ),
    _setup(
        14, STANDS_APART, "output apart from the others", "an output stands off its place in the mixer since take-off: ESC end points",
        "output apart",
        "Calibrate the end points of all ESCs alike. If it stays, exchange this motor's propeller, and then the motor, with another one's, "
        "and see whether it moves along.",
    ),
    _setup(
        15, EXHAUSTED, "too little without a rotor", "a vehicle sank without a rotor, for the others did not carry it",
        "others at their limit",
        "Fly this vehicle lighter if it is to stay up without a rotor: `rotorwatch survive` says how heavy it may be.",
    ),
    Kind(16, EVIDENCE, "unexplained evidence", "evidence against rotors that no event explains", Weight.OPEN, Span.SPELLS),
    Kind(
        17, FROM_TAKEOFF, "damage from take-off", "the balance of commands is unlike that of healthy flights or vehicles",
        Weight.OPEN, Span.STAYS,
    ),
)  # fmt: skip
TABLE = {row.name: row for row in ROWS}


def kind_of(name: str) -> Kind:
    """The row of a kind; for an unknown kind, one with its name as its words."""
    return TABLE.get(name) or Kind(UNKNOWN, name, name.replace("_", " "))


def number(name: str) -> int:
    """The number of a kind of the table in compiled definitions."""
    return TABLE[name].number
