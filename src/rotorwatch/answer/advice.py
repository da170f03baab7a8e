"""What to do next, in sentences: which parts to look at, what to log, what to fly. It follows from the answer and changes nothing in it."""

from __future__ import annotations

from collections.abc import Sequence

from rotorwatch.answer.wording import BASELINE, explanations, listed, motor, rotors, seconds, sentence
from rotorwatch.default.hypotheses import TOTAL_LOSS
from rotorwatch.flight.diagnosis import Event, RotorState

MOTORS = {
    "slow_motor": "Look at motor, ESC, their connectors and supply wires of",
    "high_current": "Look at the motor bearings of",
    "low_current": "Look at the propeller of",
}
PARTS = {
    "propeller": "its propeller first (nicked, bent, loose on its shaft); the motor turns as commanded",
    "motor_or_esc": "its motor, ESC, connectors and supply wires first; it turns slower than commanded",
    "bearing": "its motor's bearings first; it draws more current than its speed needs",
}


def of(
    verdict: str,
    events: Sequence[Event],
    main: int | None,
    states: Sequence[RotorState],
    compared: bool,
    places: Sequence[str],
    doubts: Sequence[str],
    stays: bool = True,
    missing: bool = False,
) -> tuple[str, ...]:
    """Sentences, the most urgent first. compared: with healthy flights, or it cannot
    be. stays: the main event was not over before the landing. missing: commands, up to the end of the flight."""
    out: list[str] = []
    event = None if main is None else events[main]
    broken = [s.rotor for s in states if s.status in ("degraded", "failed")]
    suspects = [s.rotor for s in states if s.status == "suspect"]
    if doubts or missing:
        out += [sentence(d) for d in doubts[1:]]
        out.append("Log the outputs that reach the motors; `rotorwatch info LOG` lists what a log holds and lacks.")
    elif verdict == "inconclusive" and (event is None or event.kind != "loss_of_control"):
        out.append(
            "Fly at least 20 s in the air; `rotorwatch info LOG` lists what this log holds and what to log next time."
        )
    if event is not None and event.kind in ("motor_order", "loss_of_control"):
        out.append(_upset(event))
    elif event is not None and event.kind == "desync":
        out.append(_desynced(event, places))
    elif event is not None and not event.alternatives:
        who = rotors(event.rotors, places)
        if event.kind == "output_override":
            places_to_look = "output functions and passthrough, motor test, failsafe, a second controller"
            looked_at = f"it is clear why the output of {who} left the mixer: {places_to_look}"
        else:
            looked_at = f"{who} has been looked at: {_parts(event, stays)}"
        out.append(f"Do not fly again before {looked_at}.")
    elif broken:
        parts = "nicked, bent or loose propeller, motor bearing, ESC"
        out.append(f"Look at {rotors(broken, places)} before the next flight: {parts}.")
    rest = [r for r in (*broken, *suspects) if event is None or event.alternatives or r not in event.rotors]
    if rest and not (broken and event is None and not suspects):
        out.append(f"Look at {rotors(sorted(set(rest)), places)}{', too' if out else ' before the next flight'}.")
    if verdict == "ambiguous" and (event is None or event.kind != "desync"):
        out.append(
            "To distinguish the explanations: swap the propellers of the suspects with others and see whether the loss moves along, or fly "
            "with brisk turns and rolls and a healthy flight of this build as --baseline."
        )
    why = "its ESC telemetry changed in flight, though no thrust was missed"
    noticed = [e for e in events if e.kind in MOTORS]
    out += [f"{MOTORS[e.kind]} {rotors(e.rotors, places)} before the next flight: {why}." for e in noticed]
    why = "its loss grew all the time, as a bearing, a hot motor or a propeller that comes loose does"
    growing = [s.rotor for s in states if s.trend and s.trend.word == "growing" and s.status == "healthy"]
    out += [f"Look at {rotors([rotor], places)} before the next flight: {why}." for rotor in growing]
    knocks = [seconds(e.onset_s) for e in events if e.kind == "contact"]
    if knocks:
        out.append(f"Look the vehicle over for damage: it was knocked at {listed(knocks[:5])}.")
    if verdict != "inconclusive" and not compared:
        out.append(BASELINE)
    return tuple(out)


CAUSES = {
    "disarmed": "Find out who or what stopped the motors: the switch, a failsafe, the arming checks; the log's messages say which.",
    "knock": "Look the vehicle over for damage, and fly away from what it touched.",
    "controller": "Look at sensors, vibration, calibration, the estimator's messages and the pilot's inputs around that time.",
    "saturated": "The vehicle had no thrust left: take weight off, charge the battery, wait for less wind, or fit stronger motors.",
    "power": "Look at the battery, its connectors and wires, and the power module.",
    "unknown": "Look at everything that moves or carries current before the next flight; log faster: `rotorwatch info LOG` shows how.",
    "rotor": "Look at propellers, motors and ESCs before the next flight.",
}


def _upset(event: Event) -> str:
    """What to do about motors in the wrong order, or about a loss of control that no certain rotor caused."""
    if event.kind == "loss_of_control":
        return CAUSES.get(event.extra.get("cause", ""), CAUSES["unknown"])
    if not event.rotors:
        return "Do not fly before each motor's direction and its propeller have been checked against the frame's drawing: motor test."
    i, j = event.rotors
    return (
        f"Do not fly before the motor test has shown which motor answers to which output: swap the outputs of motors {i} and {j} "
        f"(ArduPilot: SERVO{i}_FUNCTION and SERVO{j}_FUNCTION; PX4: the actuator page), or their wires."
    )


def _desynced(event: Event, places: Sequence[str]) -> str:
    """What makes a motor lose step."""
    more = "" if event.extra.get("rpm") else "; log its speed next time (bidirectional DShot, eRPM)"
    who = motor([r for own in explanations(event) for r in own], places)
    return (
        f"Do not fly again before {who} and its ESC have been looked at: motor timing, demag compensation, ESC firmware, PWM "
        f"frequency, a worn bearing or loose bell, solder joints{more}."
    )


def _parts(event: Event, stays: bool) -> str:
    if len(event.rotors) == 1 and event.extra.get("cause") in PARTS:
        return PARTS[event.extra["cause"]]
    if not stays:
        return "it came back by itself, so look first for a loose connector, a cold joint, an ESC that lost its motor, a hot motor"
    if max(event.loss) > TOTAL_LOSS:
        return "propeller missing or loose, motor, ESC, and the wires between them"
    return "nicked, bent or loose propeller, motor bearing, ESC, and their connectors"
