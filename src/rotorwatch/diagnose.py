"""The default pipeline: a flight in, a diagnosis out. Every step is one call; the numbers are made in the files it calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from os import PathLike
from typing import Any, NamedTuple

from rotorwatch import detectors
from rotorwatch.answer import by_method, common_mode, conclusion, ledger, picture, places, traces, unjudged, wording
from rotorwatch.base import discovery
from rotorwatch.base.progress import READ, portion
from rotorwatch.case.departures import Departures
from rotorwatch.case.verdict import Estimated, Judgement, LogCase, judge
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.program import TickOutput
from rotorwatch.engine.driver import fly
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.engine.motion import mixing, tick_table, turning
from rotorwatch.engine.motion.air_spans import airborne, gaps
from rotorwatch.engine.motion.missed import without_missed
from rotorwatch.engine.motion.tick_table import JUDGE, READY_KNOWN_S, READY_S, Ticks
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, identity
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.method_series import MethodSeries
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.logs import plausible
from rotorwatch.witnesses import witness
from rotorwatch.witnesses.aerobatic import judge as aerobatic
from rotorwatch.witnesses.healthy import baselines
from rotorwatch.witnesses.healthy.baselines import Given
from rotorwatch.witnesses.witness import Stage, View

AEROBATIC = (
    "the vehicle does not hover in this flight: it is assessed by its angular motion over seconds, so a loss is detected later than in "
    "hover (docs/aerobatic.md)"
)
NOT_COMPARED = (
    "flights of a vehicle that does not hover are not compared with healthy ones: the balance of its rotors follows its maneuvers, "
    "so damage present at take-off is not assessed"
)
PREPARED, OTHERS_PREPARED, ESTIMATED, JUDGED = 0.84, 0.5, 0.85, 0.97  # share of the work when that is done; by other estimators
LONGEST_UP_US = 1e14  # a start later than that counts from 1970, not from the autopilot's boot


class Estimation(NamedTuple):
    """The result of an entry point of the group `rotorwatch.estimation`: run(estimator, table, B, dynamics, tuning, progress), which
    runs an estimator over the ticks of a flight.

    out: on every tick, in the default estimator's form. series: the method's own estimate; None where no tick was judged. notes:
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
    flights of the same build, which make damage that was there from take-off judgeable and shorten the blind time; one of them, or many.
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
    log = prepare(flight, vehicle, baseline, clock, portion(tell, READ, prepared, "preparing"))
    log = log._replace(matters=matters)
    if estimator != "default" and not log.hovers:
        raise ConfigError(f"{aerobatic.named(flight)} does not hover: the published methods model hover only; leave out the estimator.")
    if log.table is None:
        return _no_flight(log, clock)
    tell(prepared, "preparing the estimator (built the first time)")
    done = estimated(log, estimator, tuning, portion(tell, prepared, ESTIMATED, "estimating"))
    clock.lap("estimate_s")
    last = judge(log, done, portion(tell, ESTIMATED, JUDGED, "judging"))
    clock.lap("events_s")
    diagnosis = _conclude(log, done, last, discovery.title(estimator), clock)
    tell(1.0, "done")
    return diagnosis


def prepare(
    flight: Flight,
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Given | Iterable[Given] = (),
    clock: _Clock | None = None,
    progress: Callable[[float], object] | None = None,
) -> LogCase:
    """A log with its vehicle, flights and losses of control, fed to the engine. Arguments as of `diagnose`; progress: called with the
    finished share, 0..1."""
    clock, tell = clock or _Clock(), progress or (lambda share: None)
    craft, source, notes = baselines.settle(flight, baselines.vehicle_of(vehicle), baseline, diagnose)
    clock.lap("baseline_s")
    flight, on_rates = turning.with_rates(flight)
    dynamics = (craft.identified or {}).get("dynamics")
    air = airborne(flight) if flight.has("motors") else ()
    tell(0.1)
    flight = mixing.aligned(without_missed(flight, air), craft, air)
    tell(0.2)
    departures = Departures(craft)
    air = departures.of_log(flight, air, portion(tell, 0.2, 0.4))
    tell(0.4)
    missing = gaps(flight, air) if air else ()
    log = LogCase(
        flight,
        craft,
        bool(craft.identified),
        dynamics,
        source,
        air,
        departures.found,
        assumptions=(*craft.assumptions, *([on_rates] if on_rates else [])),
        warnings=(*flight.warnings, *notes, *wording.not_commanded(missing, len(craft.rotors))),
        missing=missing,
    )
    clock.lap("prepare_s")
    log = _flown(log, portion(tell, 0.4, 1.0))
    clock.lap("estimate_s")
    return log


def _flown(log: LogCase, progress: Callable[[float], object]) -> LogCase:
    """The log after the engine has been fed, and the method that judges it by default."""
    flight, dynamics, assumptions = log.flight, log.dynamics, list(log.assumptions)
    if flight.has("motors") and dynamics and dynamics.get("dt") != tick_table.length_of(flight):
        assumptions.append(
            f"the healthy flights were logged at another rate (assessed every {dynamics.get('dt', 0):.2f} s): their noise does not "
            "apply to this flight, which learns its own for as long as without them"
        )
        dynamics = None
    # Without a gyro every swing at take-off looks like a missing torque: no short blind time then.
    turns, moves = flight.has("gyro"), flight.angular_rate() is not None
    ready_s = READY_KNOWN_S if dynamics and turns else READY_S
    ready_s = tick_table.ready_of(ready_s, log.air) if turns else ready_s
    flown = fly(flight, log.vehicle, log.air, ready_s, dynamics, progress) if moves else None
    written, done = (None, None) if flown is None else (flown[0], Estimated(flown[1].table, flown[1].out, written=flown[0]))
    hovers = not aerobatic.applies(flight, None if done is None else done.table)
    ready_s = tick_table.ready_after(ready_s, 0.0 if done is None else done.table.dt)
    if done is not None and not hovers:
        done = Estimated(*aerobatic.estimate(flight, log.vehicle, log.air, done.table))
    if not hovers:
        assumptions += [AEROBATIC, NOT_COMPARED]
    elif not log.known:
        assumptions.append(
            f"the flight's first {ready_s:.0f} s in the air are its trim: damage present at take-off is assessed by what healthy "
            "vehicles of any build need, and better with --baseline or --vehicle"
        )
    assumptions += done.table.notes if done is not None else ()
    return log._replace(
        dynamics=dynamics, source=log.source if log.known else "the first healthy part of this flight", ready_s=ready_s,
        written=written, estimated=done, hovers=hovers, assumptions=tuple(assumptions),
    )  # fmt: skip


def _no_flight(log: LogCase, clock: _Clock) -> Diagnosis:
    n, never = len(log.vehicle.rotors), sorted({rotor for gap in log.missing for rotor in gap.rotors})
    why = unjudged.NEVER if log.flight.has("motors") else unjudged.SILENT
    if log.flight.has("motors") and log.flight.angular_rate() is None:
        why = unjudged.MOTIONLESS
    elif log.air:
        why = unjudged.silent(f"no command for {wording.rotors(never)}" if never else "too few motor outputs")
    B = log.vehicle.effectiveness()
    view = View(log.flight, log.vehicle, log.air or ((0.0, log.flight.duration),), (), B, hovers=log.hovers, lost=log.lost)
    told = witness.ask(Stage.CLAIMS, view)
    if not log.air:  # of a log without a flight only why the autopilot ended it
        told = tuple(e for e in told if e.extra.get("trouble") in conclusion.GRAVE)
    found = ledger.merge(told, event_rows.Report(B), log.upsets, n).events
    names = places.names(log.vehicle.rotors)
    end = conclusion.conclude(conclusion.Evidence(found, n, places=names, hops=log.air, unjudged=why))
    return _answer(end, log, {}, clock, doubts=() if any(e.means.wrong for e in found) else (why.why,))


def estimated(
    log: LogCase, estimator: Any = "default", tuning: Any = None, progress: Callable | None = None, whole: bool = False
) -> Estimated:
    """The outputs of an estimator at the ticks of a log that has some; a vehicle that does not hover has a method of its own. whole: with
    all outputs of each tick (`engine.driver.RECORDED`)."""
    assert log.estimated is not None
    if whole and log.hovers and estimator == "default":
        flown = fly(log.flight, log.vehicle, log.air, log.ready_s, log.dynamics, progress, whole=True)
        assert flown is not None
        return Estimated(flown[1].table, flown[1].out, written=flown[0])
    if estimator == "default" or not log.hovers:
        return log.estimated
    run = discovery.first("rotorwatch.estimation", "An estimator other than the default one")
    table, tell = log.estimated.table, progress or (lambda share: None)
    found: Estimation = run(estimator, table, log.vehicle.effectiveness(), log.dynamics, tuning, tell)
    return Estimated(table, found.out, default=False, series=found.series, assumptions=found.notes, own_limit=found.limit)


def _conclude(log: LogCase, done: Estimated, last: Judgement, title: str, clock: _Clock) -> Diagnosis:
    """The diagnosis. title: the estimator's."""
    flight, craft, air = log.flight, log.vehicle, log.air
    table, out, B = done.table, done.out, log.vehicle.effectiveness()
    end, doubts = last.end, last.doubts
    if done.series is not None:
        end = by_method.told(end, done.series)
    comparison = detectors.detect(flight, craft, air)
    clock.lap("comparison_s")
    judged = (table.mode == JUDGE) & table.valid.any(axis=1)
    common = common_mode.thrust_shift(out.biases[judged, 3]) if not doubts and log.hovers else {}
    hyp = list_hypotheses(B.shape[1])
    trace = traces.compose(flight, out, table, hyp, B, air, log.ready_s, done.limit, end.events, last.evidence, end.rotors)
    said = log._replace(assumptions=(*log.assumptions, *done.assumptions, *last.assumptions), warnings=(*log.warnings, *last.warnings))
    return _answer(
        end,
        said,
        common,
        clock,
        estimator=title,
        comparison=comparison,
        whole_flight=last.whole,
        compared=tuple(c.to_dict() for c in last.compared),
        doubts=doubts,
        trace=trace,
        own=done.series,
    )


def _answer(end: conclusion.Conclusion, log: LogCase, common: dict, clock: _Clock, **more) -> Diagnosis:
    flight, craft = log.flight, log.vehicle
    return Diagnosis(
        _facts(flight, craft, log.air, log.table), end.verdict, end.reason, end.rotors, end.events, common, log.source,
        log.assumptions, log.warnings, clock.stop(), headline=end.headline, main=end.main, advice=end.advice,
        story=end.story, picture=picture.compose(flight, craft, end.events, end.main, log.air),
        aircraft=identity.identify(flight).text, **more,
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
