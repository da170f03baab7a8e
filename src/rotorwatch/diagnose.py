"""The default pipeline: a flight in, a diagnosis out. Every step is one call; the numbers are made in the files it calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from os import PathLike
from typing import Any, NamedTuple

from rotorwatch import detectors
from rotorwatch.answer import by_method, common_mode, picture, traces
from rotorwatch.base import discovery
from rotorwatch.base.progress import READ, portion
from rotorwatch.case.conductor import Case
from rotorwatch.case.estimated import Estimated
from rotorwatch.case.verdict import Answer
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.program import TickOutput
from rotorwatch.engine.driver import fly
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.engine.motion import mixing, turning
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.missed import without_missed
from rotorwatch.engine.motion.tick_table import ASSESS, Ticks
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, identity
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.method_series import MethodSeries
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.logs import plausible
from rotorwatch.witnesses.aerobatic import assess as aerobatic
from rotorwatch.witnesses.healthy import baselines
from rotorwatch.witnesses.healthy.baselines import Given

PREPARED, OTHERS_PREPARED, ESTIMATED, ASSESSED = 0.84, 0.5, 0.85, 0.97  # share of the work when that is done; by other estimators
LONGEST_UP_US = 1e14  # a start later than that counts from 1970, not from the autopilot's boot


class Estimation(NamedTuple):
    """The result of an entry point of the group `rotorwatch.estimation`: run(estimator, table, B, dynamics, tuning, progress), which
    runs an estimator over the ticks of a flight.

    out: on every tick, in the default estimator's form. series: the method's own estimate; None where no tick was assessed. notes:
    assumptions, a sentence each. limit: log-likelihood ratio from which a loss is announced.
    """

    out: TickOutput
    series: MethodSeries | None
    notes: tuple[str, ...]
    limit: float


class _Clock:
    """Seconds of each stage: `timing` of a diagnosis."""

    def __init__(self):
        self.began, self.timing = time.perf_counter(), {}

    def lap(self, name: str) -> None:
        spent = time.perf_counter() - self.began - sum(self.timing.values())
        self.timing[name] = self.timing.get(name, 0.0) + spent

    def stop(self) -> dict[str, float]:
        self.timing["total_s"] = time.perf_counter() - self.began
        return self.timing


def diagnose(
    flight: Flight | str | PathLike,
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Given | Iterable[Given] = (),
    estimator: Any = "default",
    progress: Callable | None = None,
    tuning: Any = None,
    matters: float = MATTERS,
) -> Diagnosis:
    """Which rotor lost effectiveness, how much, since when and how sure.

    flight: a Flight or a log file. vehicle: a Vehicle or its file; identified from the log when None. baseline: healthy
    flights of the same build, which make damage that was there from take-off assessable and shorten the blind time; one of them, or many.
    Those that are not healthy or not of this build are set aside, and `warnings` say so (witnesses/healthy/baselines.py).
    estimator: the default method, or another one by name, as a class, or as an instance, whose keywords are kept (`discovery.estimator`);
    tuning: of a published one (`rotorwatch.tune`).
    matters: a loss of one rotor, 0 to 1; where a larger one could have gone unseen, the verdict is `inconclusive`, not `healthy`.
    progress: called as progress(share, text). Raises LogError, VehicleError or ConfigError with one sentence.
    """
    clock, tell = _Clock(), progress or (lambda share, text="": None)
    if estimator != "default":
        estimator = estimator if isinstance(estimator, str) else discovery.estimator(estimator)
        discovery.estimator(estimator)
    elif tuning is not None:
        raise ConfigError("The default estimator learns its noise in flight; name the estimator that the tuning is for.")
    if not isinstance(flight, Flight):
        from rotorwatch import logs

        flight = logs.read(flight, portion(tell, 0.0, READ, "reading"))
    flight = plausible.checked(flight)
    clock.lap("read_s")
    vehicle = baselines.vehicle_of(vehicle)
    if not 0.0 < matters <= 1.0:
        raise ConfigError(f"A loss that matters is a share above 0 and up to 1, not {matters:g}.")
    prepared = PREPARED if estimator == "default" else OTHERS_PREPARED
    case = prepare(flight, vehicle, baseline, clock, portion(tell, READ, prepared, "preparing"), matters)
    if estimator != "default" and not case.hovers:
        raise ConfigError(f"{aerobatic.named(flight)} does not hover: the published methods model hover only; leave out the estimator.")
    if case.table is None:
        return _diagnosis(case, case.answer(), clock)
    tell(prepared, "preparing the estimator (built the first time)")
    done = estimated(case, estimator, tuning, portion(tell, prepared, ESTIMATED, "estimating"))
    case = case.by(done)
    clock.lap("estimate_s")
    answer = case.answer(progress=portion(tell, ESTIMATED, ASSESSED, "assessing"))
    if done.series is not None:
        answer = answer._replace(end=by_method.reported(answer.end, done.series))
    clock.lap("events_s")
    diagnosis = _diagnosis(case, answer, clock, estimator=discovery.title(estimator), **_beside(case, done, answer, clock))
    tell(1.0, "done")
    return diagnosis


def prepare(
    flight: Flight,
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Given | Iterable[Given] = (),
    clock: _Clock | None = None,
    progress: Callable[[float], object] | None = None,
    matters: float = MATTERS,
) -> Case:
    """A log with its vehicle, flights and losses of control, fed to the engine. Arguments as of `diagnose`; progress: called with the
    finished share, 0..1."""
    clock, tell = clock or _Clock(), progress or (lambda share: None)
    craft, source, notes = baselines.settle(flight, baselines.vehicle_of(vehicle), baseline, diagnose)
    clock.lap("baseline_s")
    flight, on_rates = turning.with_rates(flight)
    air = airborne(flight) if flight.has("motors") else ()
    tell(0.1)
    flight = mixing.aligned(without_missed(flight, air), craft, air)
    tell(0.2)
    assumptions, warnings = [on_rates] if on_rates else [], (*flight.warnings, *notes)
    case = Case(flight, craft, source=source, assumptions=assumptions, warnings=warnings, matters=matters)
    air = case.departures.of_log(flight, air, portion(tell, 0.2, 0.4))
    tell(0.4)
    clock.lap("prepare_s")
    case.feed_log(air, portion(tell, 0.4, 1.0))
    clock.lap("estimate_s")
    return case


def estimated(
    case: Case, estimator: Any = "default", tuning: Any = None, progress: Callable | None = None, whole: bool = False
) -> Estimated:
    """The outputs of an estimator at the ticks of a log that has some; a vehicle that does not hover has a method of its own. whole: with
    all outputs of each tick (`engine.driver.RECORDED`)."""
    assert case.estimated is not None
    if whole and case.hovers and estimator == "default":
        flown = fly(case.flight, case.vehicle, case.air, case.ready_s, case.dynamics, progress, whole=True)
        assert flown is not None
        return Estimated(flown[1].table, flown[1].out, written=flown[0])
    if estimator == "default" or not case.hovers:
        return case.estimated
    run = discovery.first("rotorwatch.estimation", "An estimator other than the default one")
    table, tell = case.estimated.table, progress or (lambda share: None)
    found: Estimation = run(estimator, table, case.B, case.dynamics, tuning, tell)
    return Estimated(table, found.out, default=False, series=found.series, assumptions=found.notes, own_limit=found.limit)


def _beside(case: Case, done: Estimated, answer: Answer, clock: _Clock) -> dict[str, Any]:
    """What the report shows beside the answer, by the fields of `Diagnosis`."""
    table, out, B, end = done.table, done.out, case.B, answer.end
    comparison = detectors.detect(case.flight, case.vehicle, case.air)
    clock.lap("comparison_s")
    assessed = (table.mode == ASSESS) & table.valid.any(axis=1)
    common = common_mode.thrust_shift(out.biases[assessed, 3]) if not answer.doubts and case.hovers else {}
    times, hyp = (case.air, case.ready_s, done.limit), list_hypotheses(B.shape[1])
    trace = traces.compose(case.flight, out, table, hyp, B, *times, end.events, answer.evidence, end.rotors)
    facts = {"whole_flight": answer.facts.get("whole_flight"), "compared": tuple(c.to_dict() for c in answer.facts.get("compared", ()))}
    return {"common_mode": common, "comparison": comparison, **facts, "trace": trace, "own": done.series}


def _diagnosis(case: Case, answer: Answer, clock: _Clock, **more) -> Diagnosis:
    flight, craft, end, balance = case.flight, case.vehicle, answer.end, answer.facts.get("imbalance")
    if balance is not None:
        end = end._replace(rotors=tuple(replace(r, imbalance=found) for r, found in zip(end.rotors, balance.to_dict())))
    return Diagnosis(
        flight=_facts(flight, craft, case.air, case.table), verdict=end.verdict, reason=end.reason, rotors=end.rotors, events=end.events,
        baseline=case.source, assumptions=(*case.assumptions, *answer.assumptions), warnings=(*case.warnings, *answer.warnings),
        timing=clock.stop(), headline=end.headline, main=end.main, advice=end.advice, story=end.story,
        fit_to_fly=end.fit_to_fly, causes=end.causes,
        picture=picture.compose(flight, craft, end.events, end.main, case.air), aircraft=identity.identify(flight).text,
        doubts=answer.doubts, balance=balance, **{"common_mode": {}, **more},
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
        "profile": profile + (f"; assessed every {table.dt:.2f} s" if table is not None else ""),
    }
