"""The default pipeline: a flight in, a diagnosis out. Every step is one call; the numbers are made in the files it calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from os import PathLike
from typing import Any

import numpy as np

from rotorwatch.aerobatic import desync
from rotorwatch.aerobatic import judge as aerobatic
from rotorwatch.answer import common_mode, conclusion, health, picture, places, traces, unseen
from rotorwatch.base import discovery
from rotorwatch.default import asked, events, hindsight, hypotheses, leftover
from rotorwatch.default.announcement import threshold
from rotorwatch.default.program import estimate
from rotorwatch.errors import ConfigError
from rotorwatch.esc import consistency
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.healthy import baselines, population
from rotorwatch.healthy.baselines import Given
from rotorwatch.motion import ticks, trust
from rotorwatch.motion.airborne import airborne, gaps
from rotorwatch.motion.ticks import JUDGE, READY_KNOWN_S, READY_S, Ticks, observe
from rotorwatch.published import decide, detectors, published
from rotorwatch.published.published import Tuning
from rotorwatch.upset import find as upset

AEROBATIC = (
    "the vehicle is flown by commanded rates and does not hover: it is judged by its angular motion over seconds, so that a loss is seen "
    "later than in hover (docs/aerobatic.md)"
)
LONGEST_UP_US = 1e14  # a start later than that counts from 1970, not from the autopilot's boot


def diagnose(
    flight: Flight | str | PathLike,
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Given | Iterable[Given] = (),
    estimator: Any = "default",
    progress: Callable | None = None,
    tuning: Tuning | None = None,
) -> Diagnosis:
    """Which rotor lost effectiveness, how much, since when and how sure.

    flight: a Flight or a log file. vehicle: a Vehicle or its file; identified from the log when None. baseline: healthy
    flights of the same build, which make damage that was there from take-off judgeable and shorten the blind time; one of them, or many.
    Those that are not healthy or not of this build are set aside, and `warnings` say so (healthy/baselines.py).
    estimator: the default method, or another one by name, as a class, or as an instance, whose keywords are kept (`discovery.estimator`);
    tuning: of a published one (`rotorwatch.tune`).
    progress: called as progress(share, text). Raises LogError, VehicleError or ConfigError with one sentence.
    """
    began = time.perf_counter()
    timing: dict[str, float] = {}
    tell = progress or (lambda share, text="": None)

    def lap(name):
        timing[name] = time.perf_counter() - began - sum(timing.values())

    own = isinstance(estimator, str) and estimator == "default"
    if not own:
        estimator = estimator if isinstance(estimator, str) else discovery.estimator(estimator)
        discovery.estimator(estimator)
    elif tuning is not None:
        raise ConfigError(
            "The default estimator learns its noise in flight; name the estimator that the tuning is for."
        )
    if not isinstance(flight, Flight):
        from rotorwatch import logs

        flight = logs.read(flight, lambda share: tell(0.3 * share, "reading"))
    known_vehicle = baselines.vehicle_of(vehicle)
    lap("read_s")
    craft, source, told = baselines.settle(flight, known_vehicle, baseline)
    lap("baseline_s")
    known = bool(craft.identified)
    dynamics = (craft.identified or {}).get("dynamics")
    # Without a gyro every take-off swing looks like a torque that is missing: no short blind time then.
    ready_s = READY_KNOWN_S if dynamics and flight.has("gyro") else READY_S
    air = airborne(flight) if flight.has("motors") else ()
    upsets = upset.judged(flight, craft, air)
    air = upset.until_impact(flight, air, upsets)
    table = observe(flight, craft, air, ready_s)
    warnings = [*flight.warnings, *told]
    warnings += [
        f"No motor outputs are logged from {start:.1f} s to {end:.1f} s, in the air: what happened in that time is only told by what "
        "was different after it."
        for start, end in gaps(flight, air)
    ]
    assumptions = list(craft.assumptions)
    if table is not None and dynamics and dynamics.get("dt") != table.dt:
        assumptions.append(
            f"the healthy flights were logged at another rate (judged every {dynamics.get('dt', 0):.2f} s): their noise is not "
            "this flight's, which therefore learns its own for as long as without them"
        )
        dynamics, ready_s = None, READY_S
        table = observe(flight, craft, air, ready_s)
    lap("prepare_s")
    ready_s = ticks.ready_after(ready_s, table.dt if table is not None else 0.0)
    if not known:
        source = "the flight's own first healthy part"
        assumptions.append(
            f"the flight's first {ready_s:.0f} s in the air are its trim: damage that was there from take-off is judged by what healthy "
            "vehicles of any build need, and better with --baseline or --vehicle"
        )
    facts = _facts(flight, craft, air, table)
    names, n = places.names(craft.rotors), len(craft.rotors)
    if table is None:
        why = "no motor outputs" if not flight.has("motors") else "no flight: the vehicle never took off"
        doubts = (f"the log shows {why}; nothing can be judged.",)
        found = upset.events(upsets, (), n)
        end = conclusion.conclude(found, None, n, doubts=() if found else doubts, places=names, hops=air)
        timing["total_s"] = time.perf_counter() - began
        return _answer(end, flight, craft, facts, {}, source, assumptions, warnings, timing, doubts=doubts)
    assumptions += table.notes
    B = craft.effectiveness()

    def estimating(share):
        tell(0.3 + 0.6 * share, "estimating")

    tell(0.3, "preparing the estimator (built the first time)")
    last, hyp = None, hypotheses.make(n)
    limit = float(threshold(hyp, table.dt))
    hovers, logged = not (own and aerobatic.applies(flight)), table
    if not hovers:
        table, out = aerobatic.estimate(flight, craft, air, table)
        assumptions.append(AEROBATIC)
    elif own:
        last, out = estimate(table, B, dynamics, estimating)
    else:
        out = published.judge(estimator, table, B, dynamics, tuning, estimating)
        assumptions += published.notes(discovery.title(estimator))
        limit = 0.5 * decide.SIGMAS**2
    lap("estimate_s")
    losses = events.read(out, table, B)
    if own and hovers:
        losses, settled = asked.settle(losses, table, B, dynamics)
        assumptions += settled
    if last is not None and not known:  # healthy flights would have told what happened in the blind time
        losses = hindsight.join(losses, hindsight.find(last, table, B))
    overrides = events.overrides(flight, craft, air, table)
    faint = tuple(e for e in events.unexplained(losses, overrides) if not events.accuses(e))
    found = upset.events(upsets, events.Report(B).add(table, air).finish(air).events(losses, overrides), n)
    found, notes = consistency.check(flight, craft, air, table, found)
    warnings += notes
    if not hovers:
        found = tuple(sorted((*found, *desync.find(flight, craft, air, found)), key=lambda e: e.detected_s))
    lap("events_s")
    doubts = trust.doubts(flight, craft, air, logged)
    whole = None if doubts else _whole_flight(flight, craft, air)
    other = None if doubts or known or not hovers else population.judge(flight, craft, air, _undisturbed(table, found))
    comparison = detectors.detect(flight, craft, air)
    lap("comparison_s")
    judged = (table.mode == JUDGE) & table.valid.any(axis=1)
    spells = (*leftover.find(out, table, hyp, limit, found, B), *leftover.faint(faint, found, float(table.time[-1])))
    hidden, hidden_pair = _hidden(out, table, B)
    end = conclusion.conclude(
        found, whole, n, hidden=hidden, hidden_pair=hidden_pair, judged_s=float(judged.sum() * table.dt), places=names,
        doubts=doubts, leftover=spells, hops=air, trends=() if doubts or not hovers else health.trends(out, table, B, found),
        population=other,
    )  # fmt: skip
    common = {} if doubts or not hovers else common_mode.thrust_shift(out.biases[judged, 3])
    tell(1.0, "done")
    timing["total_s"] = time.perf_counter() - began
    return _answer(
        end, flight, craft, facts, common, source, assumptions, warnings, timing, estimator=discovery.title(estimator),
        comparison=comparison, whole_flight=whole, doubts=doubts,
        trace=traces.make(flight, out, table, hyp, B, air, ready_s, limit, end.events, spells, end.rotors),
    )  # fmt: skip


def _answer(
    end: conclusion.Conclusion, flight, craft, facts, common, source, assumptions, warnings, timing, **more
) -> Diagnosis:
    return Diagnosis(
        facts, end.verdict, end.reason, end.rotors, end.events, common, source, tuple(assumptions), tuple(warnings), timing,
        headline=end.headline, main=end.main, advice=end.advice, story=end.story,
        picture=picture.make(flight, craft, end.events, end.main, end.story), **more,
    )  # fmt: skip


def _facts(flight: Flight, vehicle: Vehicle, air, table: Ticks | None) -> dict:
    rates = {n: flight[n].rate_hz for n in ("motors", "control", "gyro", "accel") if n in flight.signals}
    profile = ", ".join(f"{name} {rate:.0f} Hz" for name, rate in rates.items())
    return {
        "name": flight.name,
        "format": flight.format,
        "autopilot": flight.autopilot,
        "firmware": flight.firmware,
        "frame": vehicle.name,
        "geometry": [{"x": r.x, "y": r.y, "spin": r.spin} for r in vehicle.rotors],
        "rotors": len(vehicle.rotors),
        "duration_s": round(flight.duration, 3),
        "boot_s": round(flight.start_us * 1e-6, 3) if 0 < flight.start_us < LONGEST_UP_US else None,
        "utc_start": flight.facts.get("utc_start"),
        "airborne_s": [round(air[0][0], 3), round(air[-1][1], 3)] if air else [],
        "hops": [[round(a, 3), round(b, 3)] for a, b in air],
        "profile": profile + (f"; judged every {table.dt:.2f} s" if table is not None else ""),
    }


def _whole_flight(flight: Flight, vehicle: Vehicle, air):
    """Damage present from take-off, against the baseline in the vehicle; None without one."""
    stored = (vehicle.identified or {}).get("whole_flight")
    if not stored:
        return None
    from rotorwatch.healthy import whole_flight

    features = whole_flight.features(flight, vehicle, air)
    return whole_flight.judge(features, [whole_flight.Features.from_dict(f) for f in stored], vehicle).to_dict()


def _undisturbed(table: Ticks, found) -> float:
    """Time in s of the first event or upset: what is seen before it was there from take-off."""
    return min([np.inf, *(e.onset_s for e in found), *table.time[table.upset & (table.mode > ticks.GROUND)][:1]])


def _hidden(out, table: Ticks, B: np.ndarray) -> tuple[np.ndarray, float]:
    """(n,) largest loss of each rotor that could have gone unseen in flight: too small to be measured, or taken for a disturbance; and the
    same of two opposite rotors."""
    judged = table.mode == JUDGE
    if not judged.any():
        return np.ones(out.theta.shape[1]), 1.0
    measured, seen = 1.96 * np.median(out.detectable[judged], axis=0), unseen.of(out.biases, table, B)
    single = np.minimum(1.0, np.maximum(measured, seen.losses()) + events.MODEL_SD)
    return single, min(1.0, seen.pair(events.opposites(B)))
