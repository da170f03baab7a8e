"""Excitation study: flights with ambiguous losses, without and with an excitation of the commands.

    from rotorwatch_lab.campaign import excitation_flights
    result = excitation_flights.run(flights=120)
    print(excitation_flights.markdown(result))

Every flight is flown and diagnosed without excitation. Where the answer is `ambiguous`, the rotor sets to distinguish follow from the log
(`planning.question.pose`), the excitation is designed for them (`control.excitation`), and the flight is flown again with
it: up to its start it is the same to the last bit. Healthy flights are excited as well.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Event
from rotorwatch.toolkit import READY_S, airborne, ambiguous_sets, diagnose, events, excitation_response, observe, program
from rotorwatch_lab.control import excitation
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.planning.question import Question, pose, suspects
from rotorwatch_lab.simulation import logbook, loop, prepare, scenario
from rotorwatch_lab.simulation.excited import EXCITED
from rotorwatch_lab.simulation.scenario import Scenario

FRAMES = ("hexa-x", "hexa-plus", "octa-x", "octa-plus")
ONSET_S, ENDS_S = 16.0, 14.0  # onset of the loss; from the onset to the end
WAITS_S = 1.0  # from the answer to the excitation
WITHIN_S = 3.0
WIDTH = 16  # flights side by side
WORST = 0.5  # loss that is assumed where nothing was announced
LOSSES, LARGER = (0.15, 0.45), (0.3, 0.7)
WINDS_M_S = 4.0
HEALTHY = 0.25  # share of flights


@functools.cache
def _alike(frame: str) -> tuple:
    return ambiguous_sets(airframes.named(f"px4-{frame}").effectiveness())


def families(frame: str) -> tuple[tuple[int, ...], ...]:
    """Sets of two rotors (1-based) that have the same effect as another set."""
    return tuple(sorted({s for both in _alike(frame) for s in both if len(s) == 2}))


def draw(flight: int, frame: str, seed: int) -> Scenario:
    """The scenario of a flight: vehicles from 0.8 to 8 kg, winds up to WINDS_M_S, LOSSES of two rotors alike; LARGER ones
    where many pairs have the same effect, of which smaller losses are not noticed."""
    rng = np.random.default_rng([seed, flight])
    mass = float(np.exp(rng.uniform(np.log(0.8), np.log(8.0))))
    pairs = families(frame)
    weak = pairs[rng.integers(len(pairs))] if rng.uniform() >= HEALTHY else ()
    loss = round(float(rng.uniform(*(LOSSES if len(pairs) < 4 else LARGER))), 3)
    return scenario.from_table(
        {
            "name": f"asked {flight}", "duration_s": ONSET_S + ENDS_S, "seed": int(rng.integers(2**31 - 1)), "rate_hz": 200.0,
            "autopilot": "px4",
            "airframe": {
                "frame": frame, "mass_kg": mass, "arm_m": 0.3 * (mass / 2.0) ** (1.0 / 3.0),
                "thrust_to_weight": float(rng.uniform(1.9, 2.6)), "lag_s": float(rng.uniform(0.02, 0.05)),
            },
            "trajectory": {"altitude_m": 5.0, "land": False},
            "wind": {"speed_m_s": float(rng.uniform(0.0, WINDS_M_S)), "from_deg": float(rng.uniform(-180.0, 180.0))},
            "logging": {"profile": "fast"},
            "faults": [{"kind": "loss", "rotor": r, "onset_s": ONSET_S, "strength": loss} for r in weak],
        }
    )  # fmt: skip


def fly(scenarios: Sequence[Scenario], signals: Sequence[excitation.Signal]) -> list[tuple[Any, Any]]:
    """(record, flight as logged) of each; equal numbers of rotors, rates and durations."""
    plans = [prepare.plan(s)._replace(schedule=signal) for s, signal in zip(scenarios, signals, strict=True)]
    first = scenarios[0]
    flown = loop.fly_each(EXCITED, plans, first.duration_s, first.rate_hz, first.record_hz, logbook.needed)
    return [(r, logbook.flight(s, p, r)) for s, p, r in zip(scenarios, plans, flown, strict=True)]


def assessed(flight: Any, end_s: float = np.inf) -> tuple[Any, Any, Any, np.ndarray, tuple[Event, ...]]:
    """(ticks, last carry, outputs, B, losses) of the default estimator up to end_s, before the excitation response is evaluated."""
    vehicle = airframes.identify(flight)
    air = airborne(flight)
    table, B = observe(flight, vehicle, air, READY_S), vehicle.effectiveness()
    if table is None:
        raise ConfigError("This flight never took off, so no excitation can be designed for it.")
    table = excitation_response.until(table, int(np.searchsorted(table.time, end_s)))
    carry, out = program.estimate(table, B)
    return table, carry, out, B, events.read(out, table, B)


def designed(question: Question, limits: excitation.Limits | None, B: np.ndarray, exactly: bool = False):
    """The design that resolves the question soonest within WITHIN_S; where that is too short, or `exactly`, the most informative one of
    WITHIN_S. None where the null space cannot distinguish the candidates."""
    give = (B, list(question.candidates.values()), question.hover, question.noise, question.gain, question.dt, limits)
    for way in ({"length_s": WITHIN_S},) if exactly else ({"longest_s": WITHIN_S}, {"length_s": WITHIN_S}):
        try:
            return excitation.design(*give, **way)
        except ConfigError:
            continue
    return None


def designed_unprompted(frame: str, carry, out, table, B: np.ndarray, limits: excitation.Limits | None = None):
    """The design for a flight in which nothing was announced: which of the sets that explain a change of trim is weak, else which of a few
    pairs that hover does not distinguish, or none? For WITHIN_S."""
    sets = suspects(carry, out, table, B)
    if not sets:
        alike = _alike(frame)
        first = next(one for one, _ in alike if len(one) == 2)
        for pair in (first, *(other for one, other in alike if one == first and len(other) == 2)):
            indices = tuple(k - 1 for k in pair)
            sets[indices] = np.where(np.isin(np.arange(B.shape[1]), indices), WORST, 0.0)
    return designed(pose(sets, carry, table, B), limits=limits, B=B, exactly=True)


def attitude_change(one_: Any, other: Any) -> float:
    """Largest angle [degrees] between the attitudes of two records."""
    dot = np.abs((one_.q * other.q).sum(axis=1))
    return float(np.degrees(2.0 * np.arccos(np.clip(dot, 0.0, 1.0))).max())


def batch(frame: str, flights: Sequence[int], seed: int, limits: excitation.Limits | None = None) -> list[dict]:
    """The rows of flights of one frame.

    broken: weak rotors, none of a healthy flight; loss: of each. before: what the default method's events come to without the
    excitation, after: verdict of the diagnosis with it; named: the rotors named after it. right: these are the broken ones; wrong: others
    are named. asked: it was excited. length_s, amplitude (share of full thrust): of the excitation; turned_deg: by how much it moved the
    attitude; information: on the least known question; needed: what it takes to answer.
    """
    scenarios = [draw(k, frame, seed) for k in flights]
    n = airframes.named(f"px4-{frame}").effectiveness().shape[1]
    before = fly(scenarios, [excitation.none(n)] * len(scenarios))
    answers, designs, signals = [], [], []
    for _, flight in before:
        table, carry, out, B, losses = assessed(flight)
        unsure = [e for e in losses if e.alternatives]
        sure = [e for e in losses if not e.alternatives]
        answers.append("fault" if sure else "ambiguous" if unsure else "healthy")
        design, start = None, ONSET_S + 4.0
        if not sure:
            if unsure:
                start = max(e.detected_s for e in unsure) + WAITS_S
                design = designed(pose(excitation_response.candidates(unsure[0], B), carry, table, B), limits=limits, B=B)
            else:
                table, carry, out, B, _ = assessed(flight, start)
                design = designed_unprompted(frame, carry, out, table, B, limits)
        designs.append(design)
        signals.append(excitation.none(n) if design is None else design.signal._replace(start=np.array(start)))
    after = fly(scenarios, signals)
    rows = []
    for k, s, old, (was, _), (record, flight), design in zip(flights, scenarios, answers, before, after, designs, strict=True):
        broken = tuple(sorted(f["rotor"] for f in s.faults))
        new, named = old, ()
        if design is not None:
            answer = diagnose(flight)
            sure = [e for e in answer.events if e.means.lasting_fault and not e.alternatives]
            new, named = answer.verdict, tuple(sorted({r for e in sure for r in e.rotors}))
        row = {
            "flight": k, "frame": frame, "mass_kg": float(s.airframe["mass_kg"]), "wind_m_s": float(s.wind["speed_m_s"]),
            "broken": broken, "loss": float(s.faults[0]["strength"]) if broken else 0.0, "before": old, "after": new, "named": named,
            "asked": design is not None, "right": new == ("fault" if broken else "healthy") and named == broken,
            "wrong": bool(named) and named != broken,
            **dict.fromkeys(("length_s", "amplitude", "turned_deg", "information", "needed")),
        }  # fmt: skip
        if design is not None:
            size = np.abs(design.signal.first) + np.abs(design.signal.second)
            row |= {"length_s": float(design.signal.length), "amplitude": float(size.max()), "turned_deg": attitude_change(was, record)}
            row |= {"information": float(design.information.min()), "needed": design.needed}
        rows.append(row)
    return rows


def run(
    flights: int = 120,
    frames: Sequence[str] = FRAMES,
    seed: int = 1,
    limits: excitation.Limits | None = None,
    progress: Callable[[float, str], None] | None = None,
    jobs: int | None = 1,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> dict[str, Any]:
    """Fly that many flights, frames in turn: {"flights", "seed", "measures" (`measures`), "by_frame", "rows"}. jobs, scheduler: as for
    `many.run`. keep: a folder for finished parts, from which the same call resumes. Raises ConfigError."""
    unknown = [f for f in frames if f not in FRAMES]
    if unknown or not frames:
        raise ConfigError(f"frames must be some of {', '.join(FRAMES)}, not {', '.join(unknown) or 'none'}.")
    if flights < 1:
        raise ConfigError(f"flights must be at least 1, not {flights}.")
    parts = []
    for part in tools.batches(flights, len(frames), WIDTH):
        cell = part[0] % len(frames)
        padding = WIDTH - len(part) if cell + len(frames) * WIDTH < flights else 0  # one program for all batches
        parts.append((frames[cell], [*part, *[part[-1]] * padding], len(part), seed, limits))
    rows = tools.gathered(_part, parts, jobs, progress, "flying", scheduler, keep)
    each = {frame: measures([r for r in rows if r["frame"] == frame]) for frame in frames}
    return {"flights": flights, "seed": seed, "measures": measures(rows), "by_frame": each, "rows": rows}


def _part(work: tuple[str, list[int], int, int, excitation.Limits | None]) -> list[dict]:
    frame, filled, count, seed, limits = work
    return batch(frame, filled, seed, limits)[:count]


def measures(rows: Sequence[dict]) -> dict[str, Any]:
    """Shares with 95 % intervals. ambiguous: faulty flights that are ambiguous as they are; resolved: of these, the broken rotors are
    named and no others after the excitation; within: the same within WITHIN_S of excitation that turns the vehicle by less than one degree;
    wrong: others are named. noticed: of flights without an answer, those that have one after it. false: healthy flights
    whose excitation led to an answer. length_s, turned_deg: medians and largest."""
    faulty, healthy = [r for r in rows if r["broken"]], [r for r in rows if not r["broken"]]
    open_ = [r for r in faulty if r["before"] == "ambiguous" and r["asked"]]
    silent = [r for r in faulty if r["before"] == "healthy" and r["asked"]]

    def small(r: dict) -> bool:
        return r["right"] and r["length_s"] <= WITHIN_S + 1e-9 and r["turned_deg"] < 1.0

    def spread(values: list[float]) -> dict[str, float] | None:
        return {"median": float(np.median(values)), "largest": float(np.max(values))} if values else None

    return {
        "faulty": len(faulty), "healthy": len(healthy), "ambiguous": len(open_), "unnoticed": len(silent),
        "fault_before": sum(r["before"] == "fault" for r in faulty),
        "resolved": tools.share([r["right"] for r in open_]), "within": tools.share([small(r) for r in open_]),
        "wrong": tools.share([r["wrong"] for r in open_]), "noticed": tools.share([r["after"] != "healthy" for r in silent]),
        "noticed_wrong": tools.share([r["wrong"] for r in silent]),
        "false": tools.share([r["after"] != r["before"] or r["wrong"] for r in healthy]),
        "length_s": spread([r["length_s"] for r in open_ if r["length_s"]]),
        "turned_deg": spread([r["turned_deg"] for r in rows if r["turned_deg"] is not None and r["before"] != "fault"]),
    }  # fmt: skip


def markdown(result: dict[str, Any]) -> str:
    """The measures, all flights and frame by frame."""

    cell = tools.interval

    def pair(value: dict[str, float] | None, digits: int) -> str:
        return "-" if value is None else f"{value['median']:.{digits}f}, {value['largest']:.{digits}f}"

    lines: dict[str, Callable[[dict], str]] = {
        "faulty, healthy flights": lambda m: f"{m['faulty']}, {m['healthy']}",
        "ambiguous without an excitation": lambda m: str(m["ambiguous"]),
        "... of these resolved by it": lambda m: cell(m["resolved"]),
        f"... within {WITHIN_S:g} s and 1 degree": lambda m: cell(m["within"]),
        "... wrong rotors named": lambda m: cell(m["wrong"]),
        "unnoticed without, asked anyway": lambda m: str(m["unnoticed"]),
        "... noticed by it": lambda m: cell(m["noticed"]),
        "... wrong rotors named then": lambda m: cell(m["noticed_wrong"]),
        "healthy flights, answer changed by it": lambda m: cell(m["false"]),
        "length of the excitation, s: median, longest": lambda m: pair(m["length_s"], 1),
        "turn by it, degrees: median, largest": lambda m: pair(m["turned_deg"], 2),
    }
    columns = {"all": result["measures"], **result["by_frame"]}
    return tools.side_by_side(f"{result['flights']} flights", columns, lines)
