"""Ablation of the default method: every constant left out, halved and doubled, over a fixed set of flights.

The set: simulated flights of a plan, flights in which several things happen (sequences.py), losses put into real healthy flights, and
surrogates of those. Every variant assesses the same flights as the method as it is, so that what counts is the difference: of n states,
b are right only with the variant and c only without it, and

    difference = (b - c) / n,        sd = sqrt(b + c - (b - c)^2 / n) / n          (McNemar's, for shares of the same things)

A constant is any number in capitals in a file of DEFINITIONS, unless it is made of others alone; constants.py says what each means, and
which value leaves it out. The definition is built anew with it.
"""

from __future__ import annotations

import ast
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Event
from rotorwatch.toolkit import ASSESS, DEFINITIONS, ENGINE, READY_S, Estimated, Ticks, airborne, events, prepare, program
from rotorwatch.toolkit import Case as LogCase
from rotorwatch_lab.campaign import batch, sequences
from rotorwatch_lab.campaign.constants import TABLE
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.experiments import inject, tools
from rotorwatch_lab.experiments.studies import false_alarms

# Names, counts and values that follow from others, which nobody chose; and thresholds of decisions that are not the estimator's.
NOT_CHOSEN = {
    f"{file}.{name}"
    for file, names in {
        "plant": "PER_AXIS B1 B2 B3 GAIN DAMPING SIDEWAYS AIR SHARE THETA YAW_GAIN LOAD_GAIN ONE_ARM",
        "noise": "WHITE FAST SLOW DRIFT LAGS LAG_COUNT ITERATIONS",
        "bank": "GROUP GROUPS SHORT LONG SLOW_S YAW_ERROR DAMPING_ERROR FIRST_LOSS",
        "hypotheses": "SINGLE PAIR RECOVERY ONE_THRUST DISTURBANCE DISTURBANCES DISTURBANCE_COUNT ALL_TORQUES NOTHING LEFT SERIES",
        "opposite": "LEAST_ROTORS PARTS",
        "posterior": "NEVER OLD_S",
        "losses": "WITHIN_95 CANCELS",
        "decisions": "FALSE_ALARM_PERIOD_S SURE CERTAIN LIKELY SAME_S FALSE_ALARM FALSE_FAULT FALSE_FAULT_OF_ANY DAMAGED MENTIONED "
        "MATTERS GRAVE WORN",
    }.items()
    for name in names.split()
}
# Constants of `losses` that the estimator takes from there: where it does.
TAKEN = {"PAIR_WEIGHT": "hypotheses", "YOUNG_S": "posterior"}
WORDS = ("off", "half", "double")
SOON_S = 10.0  # a fault that is announced within so much counts as found
FAULT = 0.05  # a change of loss that counts as one


def constants() -> dict[str, Any]:
    """Chosen constants of the method: "file.NAME" -> value."""
    chosen = {}
    for file, home in DEFINITIONS.items():
        module = import_module(home)
        for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.Assign) or not _has_number(node.value):
                continue
            for target in node.targets:
                for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                    key, value = f"{file}.{getattr(name, 'id', '')}", getattr(module, getattr(name, "id", ""), None)
                    number = isinstance(value, int | float | tuple) and not isinstance(value, bool)
                    if key.split(".")[1].isupper() and number and key not in NOT_CHOSEN and _numbers(value):
                        chosen[key] = value
    return dict(sorted(chosen.items()))


def _has_number(node: ast.expr) -> bool:
    """True if the expression holds a number; an expression of other constants alone follows from them."""
    return any(isinstance(part, ast.Constant) and isinstance(part.value, int | float) for part in ast.walk(node))


def _numbers(value: Any) -> bool:
    return all(isinstance(v, int | float) for v in (value if isinstance(value, tuple) else (value,)))


def _scaled(value: Any, factor: float) -> Any:
    return tuple(v * factor for v in value) if isinstance(value, tuple) else value * factor


def variants(only: Sequence[str] = (), words: Sequence[str] = WORDS) -> dict[str, dict[str, Any]]:
    """Name of a variant -> the constants it changes; "as it is" first. only: prefixes of names; words: a subset of WORDS. Raises
    ConfigError if no name matches."""
    known = constants()
    changes: dict[str, dict[str, Any]] = {"as it is": {}}
    for name, value in known.items():
        if only and not any(name.startswith(o) for o in only):
            continue
        for word, factor in (("half", 0.5), ("double", 2.0)):
            if word in words:
                changes[f"{name} {word}"] = {name: _scaled(value, factor)}
        off = TABLE[name].off
        if off is not None and "off" in words:
            changes[f"{name} off"] = {name: tuple(off for _ in value) if isinstance(value, tuple) else off}
    if only and len(changes) == 1:
        raise ConfigError(f"No constant's name begins with {' or '.join(only)}; they are {', '.join(known)}.")
    return changes


@contextmanager
def changed(values: Mapping[str, Any]) -> Iterator[None]:
    """Context in which the method has other constants, and those that follow from them."""
    others = {}
    for key, value in values.items():
        file, _, name = key.partition(".")
        if key == "decisions.CLEAR":
            others |= {"hypotheses.CLEAR": float(np.log(value)), "posterior.ALIKE": -float(np.log(value))}
        elif file == "losses" and name in TAKEN:
            others[f"{TAKEN[name]}.{name}"] = value
    with ENGINE.changed({**values, **others}):
        yield


def _read_only(key: str) -> bool:
    """True for constants that are read after the estimator alone."""
    file, _, name = key.partition(".")
    return key == "decisions.CREDIBLE" or (file == "losses" and name not in TAKEN)


def assess(table: Ticks, B: np.ndarray, values: Mapping[str, Any]) -> program.TickOutput:
    """Ticks of the method with other constants."""
    with changed(values):
        return program.estimate(table, B)[1]


@dataclass(frozen=True)
class Case:
    """A flight, ready to be diagnosed. kind: its part of the set; theta (T, n): true losses at its ticks; lost_s: time of its crash, or
    None; ready: input of `diagnose` before the estimator, None for surrogates, which are no logs."""

    kind: str
    ticks: Ticks
    B: np.ndarray
    theta: np.ndarray
    lost_s: float | None = None
    ready: LogCase | None = None


def _flown(kind: str, plan: Plan | sequences.Sequences, numbers: Sequence[int]) -> list[Case]:
    flights = batch.fly(plan, numbers, sequences.WIDTH)
    return [Case(kind, f.ticks, f.vehicle.effectiveness(), f.theta, f.lost_s, f.ready) for f in flights]


def _injected(path: str, losses: Sequence[float], seed: int) -> list[Case]:
    """A healthy flight unchanged, and with a loss of each rotor and each size."""
    flight = logs.read(path)
    vehicle, air, rng = airframes.identify(flight), airborne(flight), np.random.default_rng(seed)
    B, plain = vehicle.effectiveness(), prepare(flight, vehicle)
    if plain.table is None:
        return []
    n = B.shape[1]
    cases = [Case("real, healthy", plain.table, B, np.zeros((len(plain.table.time), n)), ready=plain)]
    room = [(a + READY_S + inject.AFTER_READY_S, b - inject.BEFORE_END_S) for a, b in air]
    room = [(a, b) for a, b in room if b > a]
    for rotor, loss in itertools.product(range(1, n + 1), losses) if room else ():
        onset = inject.draw(room, rng)
        ready = prepare(inject.inject(flight, vehicle, rotor, loss, onset), vehicle)
        if (table := ready.table) is not None:
            theta = (table.time >= onset)[:, None] * loss * np.eye(n)[rotor - 1]
            cases.append(Case("real, injected", table, B, theta, ready=ready))
    return cases


def _surrogates(path: str, hours: float, seed: int) -> list[Case]:
    flight = logs.read(path)
    vehicle = airframes.identify(flight)
    try:
        source = false_alarms.source(flight, vehicle)
    except ConfigError:
        return []  # too short
    B, rng, cases, flown = vehicle.effectiveness(), np.random.default_rng(seed), [], 0.0
    while flown < hours:
        table = false_alarms.surrogate(source, rng)
        cases.append(Case("surrogate", table, B, np.zeros((len(table.time), B.shape[1]))))
        flown += (table.mode == ASSESS).sum() * table.dt / 3600.0
    return cases


def _said(case: Case, out: program.TickOutput) -> tuple[Event, ...]:
    """Losses that `diagnose` reports; for a surrogate the estimator's announcements."""
    if case.ready is None:
        return events.read(out, case.ticks, case.B)
    reported = case.ready.by(Estimated(case.ticks, out)).answer().end.events
    return tuple(e for e in reported if e.means.weakens)


def outcomes(case: Case, out: program.TickOutput) -> dict[str, Any]:
    """Outcome of one flight: states (see sequences.py); false: announcements of healthy rotors; hours evaluated; delays of faults, None
    where not found soon; errors of the losses of weak rotors in right states, and whether their intervals held them."""
    table, theta = case.ticks, case.theta
    announced = _said(case, out)
    read_out: list[tuple[float, str]] = [(s.at, s.outcome) for s in sequences.states(case, announced)]

    def weak_at(t: float) -> set[int]:
        near = (table.time > t - SOON_S) & (table.time <= t + 1.0)
        return {int(i) + 1 for i in np.flatnonzero((theta[near] > sequences.WEAK).any(axis=0))}

    false = sum(not (set(itertools.chain(e.rotors, *e.alternatives)) & weak_at(e.detected_s)) for e in announced)
    delays = []
    rises = np.argwhere(np.diff(theta, axis=0) > FAULT)
    for k, rotor in rises:
        onset = float(table.time[k + 1])
        if table.mode[k + 1] != ASSESS or (case.lost_s is not None and case.lost_s < onset + 1.0):
            continue
        times = [e.detected_s - onset for e in announced if rotor + 1 in e.rotors and onset - 1.0 <= e.detected_s]
        delays.append(min((t for t in times if t <= SOON_S), default=None))
    errors, held = [], []
    for at, outcome in read_out:
        if outcome != "right":
            continue
        k = min(int(np.searchsorted(table.time, at)), len(theta) - 1)
        for e in announced:
            if e.onset_s <= at and (e.end_s is None or e.end_s > at):
                for rotor in e.rotors:
                    truth, guess = float(theta[k, rotor - 1]), float(out.theta[k, rotor - 1])
                    sd = float(events.sd_of(out.theta[k], out.theta_sd[k], case.B)[rotor - 1])
                    errors.append(guess - truth)
                    held.append(abs(guess - truth) <= 1.96 * sd)
    hours = float((table.mode == ASSESS).sum() * table.dt / 3600.0)
    return {"kind": case.kind, "states": [o for _, o in read_out], "false": false, "hours": hours, "delays": delays, "errors": errors,
            "held": held}  # fmt: skip


def _part(work: tuple) -> list[dict[str, list[dict]]]:
    """Outcomes of one part of the set: for each flight, variant -> outcome."""
    make, parameters, selected = work
    cases = make(*parameters)
    rows: list[dict[str, Any]] = [{} for _ in cases]
    plain = [assess(case.ticks, case.B, {}) for case in cases]
    for name, values in selected.items():
        reading = all(_read_only(key) for key in values)  # the ticks stay as they are
        for row, case, same in zip(rows, cases, plain):
            out = same if reading else assess(case.ticks, case.B, values)
            with changed(values):
                row[name] = outcomes(case, out)
    return rows


def run(
    plan: Plan,
    paths: Sequence[str] = (),
    flights: int = 96,
    hours: float = 1.0,
    losses: Sequence[float] = (0.2, 0.3),
    only: Sequence[str] = (),
    words: Sequence[str] = WORDS,
    jobs: int | None = None,
    progress: Callable | None = None,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> dict[str, Any]:
    """Evaluate every variant on the set: {"set", "variants": name -> measures, "differences": name -> from the method as it is}.

    plan: simulated flights; as many of it as of sequences, `flights` in all. paths: healthy logs, for losses put into them and `hours` of
    surrogates. only, words: see `variants`. progress: called as progress(share, text). jobs, scheduler: as for
    `many.run`. keep: a folder for what is finished, from which the same call goes on. Raises ConfigError, LogError.
    """
    selected = variants(only, words)
    seeds = range(len(paths))
    parts: list[tuple] = [(_injected, (str(p), tuple(losses), s), selected) for p, s in zip(paths, seeds)]
    parts += [(_surrogates, (str(p), hours / len(paths), s), selected) for p, s in zip(paths, seeds)]
    for kind, source in (("campaign", plan), ("sequences", sequences.Sequences())):
        numbers = tools.batches(flights // 2, len(source.cells), 4)
        parts += [(_flown, (kind, source, part), selected) for part in numbers]
    rows = tools.gathered(_part, parts, jobs, progress, "assessing", scheduler, keep)
    if not rows:
        raise ConfigError("No flight could be assessed: give more flights, or healthy logs of more than half a minute.")
    kinds = list(dict.fromkeys(next(iter(row.values()))["kind"] for row in rows))
    return {
        "set": {kind: sum(row["as it is"]["kind"] == kind for row in rows) for kind in kinds},
        "variants": {name: measures([row[name] for row in rows]) for name in selected},
        "differences": {
            name: differences([row["as it is"] for row in rows], [row[name] for row in rows]) for name in selected if selected[name]
        },
    }


def measures(flights: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """right, wrong: shares of states (ambiguous with the truth is right); found: share of faults; delay_s: median; rms: error of losses;
    coverage: of their intervals; false_per_h: announcements of healthy rotors."""
    states = [o for f in flights for o in f["states"]]
    delays = [d for f in flights for d in f["delays"]]
    seen = [d for d in delays if d is not None]
    errors, held = ([v for f in flights for v in f[key]] for key in ("errors", "held"))
    hours = sum(f["hours"] for f in flights)
    return {
        "right": float(np.mean([o in ("right", "ambiguous") for o in states])) if states else None,
        "wrong": float(np.mean([o == "wrong" for o in states])) if states else None,
        "found": len(seen) / len(delays) if delays else None,
        "delay_s": float(np.median(seen)) if seen else None,
        "rms": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
        "coverage": float(np.mean(held)) if held else None,
        "false_per_h": sum(f["false"] for f in flights) / hours if hours else None,
    }


def differences(before: Sequence[dict[str, Any]], after: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Paired differences of what is counted, after less before, with their standard deviation: right and wrong states, faults found, and
    false announcements (per flight)."""

    def pairs(key: str, fits: Callable) -> list[tuple]:
        return [(fits(a), fits(b)) for p, q in zip(before, after) for a, b in zip(p[key], q[key])]

    counted = {
        "right": pairs("states", lambda state: state in ("right", "ambiguous")),
        "wrong": pairs("states", lambda state: state == "wrong"),
        "found": pairs("delays", lambda delay: delay is not None),
        "false": [(p["false"], q["false"]) for p, q in zip(before, after)],
    }
    return {name: _paired(rows) for name, rows in counted.items() if rows}


def _paired(rows: Sequence[tuple]) -> dict[str, float]:
    change = np.array([float(b) - float(a) for a, b in rows])
    return {"difference": float(change.mean()), "sd": float(change.std() / np.sqrt(len(change))), "changed": int((change != 0).sum())}


def markdown(result: Mapping[str, Any]) -> str:
    """The table, a constant a line: what changes when it is left out, halved, doubled."""
    base = result["variants"]["as it is"]

    def percent(v):
        return "-" if v is None else f"{100 * v:.1f} %"

    text = (
        "set: " + ", ".join(f"{count} flights {kind}" for kind, count in result["set"].items()) + "\n"
        f"as it is: {percent(base['right'])} of the states right, {percent(base['wrong'])} wrong and sure, {percent(base['found'])} of "
        f"the faults found, median delay {base['delay_s'] or 0:.2f} s, error {base['rms'] or 0:.3f}, coverage {percent(base['coverage'])}, "
        f"{base['false_per_h'] or 0:.2f} false announcements an hour\n\n"
    )
    rows = []
    for name, d in result["differences"].items():
        now, (constant, _, variant) = result["variants"][name], name.rpartition(" ")
        false = d.get("false", {"changed": 0})
        total = 0 if not false["changed"] else round(false["difference"] * sum(result["set"].values()))
        rows.append([
            f"`{constant}`", variant, *(_points(d, key) for key in ("right", "wrong", "found")), f"{total:+d}",
            f"{now['delay_s'] or 0:.2f}", f"{now['rms'] or 0:.3f}", f"{100 * (now['coverage'] or 0):.0f} %",
        ])  # fmt: skip
    heads = ("constant", "variant", "right", "wrong", "found", "false alarms", "delay s", "error", "coverage")
    return text + tools.table(heads, rows)


def _points(differences: Mapping[str, Any], key: str) -> str:
    v = differences.get(key)
    if v is None:
        return "-"
    return "0" if not v["changed"] else f"{100 * v['difference']:+.1f} ± {196 * v['sd']:.1f}"
