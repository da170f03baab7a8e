"""The default pipeline: a flight in, a diagnosis out. Every step is one call; the numbers are made in the files it calls."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from rotorwatch.answer import (
    by_method,
    common_mode,
    conclusion,
    from_takeoff,
    health,
    ledger,
    picture,
    places,
    slow,
    traces,
    trim,
    unjudged,
    unseen,
    wording,
)
from rotorwatch.answer.ledger import Merged
from rotorwatch.base import discovery
from rotorwatch.base.arrays import median
from rotorwatch.base.progress import READ, portion
from rotorwatch.engine.diagnoser import Written, fly
from rotorwatch.engine.front.decisions import MATTERS
from rotorwatch.engine.host import events, residual_evidence
from rotorwatch.engine.host.hypotheses import list_hypotheses
from rotorwatch.engine.host.program import TickOutput, threshold
from rotorwatch.engine.motion import deviations, mixing, ticks, trust, turning
from rotorwatch.engine.motion.airborne import Gap, airborne, gaps
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.missed import without_missed
from rotorwatch.engine.motion.ticks import JUDGE, READY_KNOWN_S, READY_S, Ticks, observe
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, identity
from rotorwatch.flight.diagnosis import Diagnosis, Event, Source
from rotorwatch.flight.kinds import CONTACT, EVIDENCE, LOSS, TURNED
from rotorwatch.flight.method_series import MethodSeries
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.logs import plausible
from rotorwatch.methods.published import detectors
from rotorwatch.witnesses import excitation_response, hindsight, leaning, near_ground, reports
from rotorwatch.witnesses.aerobatic import judge as aerobatic
from rotorwatch.witnesses.healthy import baselines, outputs, population
from rotorwatch.witnesses.healthy.baselines import Given
from rotorwatch.witnesses.upset import find as upset
from rotorwatch.witnesses.upset import pegged

if TYPE_CHECKING:
    from rotorwatch.methods.published.published import Tuning

AEROBATIC = (
    "the vehicle does not hover in this flight: it is assessed by its angular motion over seconds, so a loss is detected later than in "
    "hover (docs/aerobatic.md)"
)
NOT_COMPARED = (
    "flights of a vehicle that does not hover are not compared with healthy ones: the balance of its rotors follows its maneuvers, "
    "so damage present at take-off is not assessed"
)
PREPARED, ESTIMATED, JUDGED = 0.4, 0.85, 0.97  # share of the work when that is done
LEANS_S = 15.0  # before a lasting push is that large, it turns the vehicle as well
LONGEST_UP_US = 1e14  # a start later than that counts from 1970, not from the autopilot's boot


@dataclass(eq=False, repr=False)
class Prepared:
    """A flight before it is judged.

    known: the vehicle brings what healthy flights of it say, from `source`; dynamics: of them, None where they do not fit this log.
    air: its flights ((start, end), ...) s, up to an impact; table: its ticks, None without a flight; ready_s: after take-off, in which
    trim and noise are learned; hovers: False where the default method judges angular motion alone. assumptions, warnings: of what was done
    so far. missing: commands that the log lacks in the air. matters: loss of one rotor that a healthy flight must have shown.
    """

    flight: Flight
    vehicle: Vehicle
    known: bool
    dynamics: dict | None
    source: str
    air: Spans
    upsets: tuple[upset.Judged, ...]
    table: Ticks | None
    ready_s: float
    hovers: bool
    assumptions: tuple[str, ...]
    warnings: tuple[str, ...]
    missing: tuple[Gap, ...] = ()
    matters: float = MATTERS


@dataclass(frozen=True, eq=False, repr=False)
class Estimated:
    """What an estimator left behind. table: the ticks as they count for it; last: the default estimator's state, for hindsight; own: it is
    the default one; written: by the diagnoser which the flight went through, None where it did not. itself: what a published method says
    by itself; assumptions: its own."""

    table: Ticks
    out: TickOutput
    last: Any = None
    own: bool = True
    written: Written | None = None
    itself: MethodSeries | None = None
    assumptions: tuple[str, ...] = ()

    @functools.cached_property
    def limit(self) -> float:
        """The statistic's, from which on a loss is announced."""
        if not self.own:
            from rotorwatch.methods.published import decide

            return 0.5 * decide.SIGMAS**2
        return threshold(self.out.theta.shape[1], self.table.dt)


class _Clock:
    """Seconds of each stage: `timing` of a diagnosis."""

    def __init__(self):
        self.began, self.timing = time.perf_counter(), {}

    def lap(self, name: str) -> None:
        self.timing[name] = time.perf_counter() - self.began - sum(self.timing.values())

    def stop(self) -> dict[str, float]:
        self.timing["total_s"] = time.perf_counter() - self.began
        return self.timing


def diagnose(
    flight: Flight | str | PathLike,
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Given | Iterable[Given] = (),
    estimator: Any = "default",
    progress: Callable | None = None,
    tuning: Tuning | None = None,
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
        raise ConfigError(
            "The default estimator learns its noise in flight; name the estimator that the tuning is for."
        )
    if not isinstance(flight, Flight):
        from rotorwatch import logs

        flight = logs.read(flight, portion(tell, 0.0, READ, "reading"))
    flight = plausible.checked(flight)
    clock.lap("read_s")
    vehicle = baselines.vehicle_of(vehicle)
    if estimator != "default":
        aerobatic.decline(flight, "the published methods model hover only; leave out the estimator.", vehicle)
    if not 0.0 < matters <= 1.0:
        raise ConfigError(f"A loss that matters is a share above 0 and up to 1, not {matters:g}.")
    ready = prepare(flight, vehicle, baseline, clock, portion(tell, READ, PREPARED, "preparing"))
    ready = replace(ready, matters=matters)
    if ready.table is None:
        return _no_flight(ready, clock)
    tell(PREPARED, "preparing the estimator (built the first time)")
    done = estimated(ready, estimator, tuning, portion(tell, PREPARED, ESTIMATED, "estimating"))
    clock.lap("estimate_s")
    last = judge(ready, done, portion(tell, ESTIMATED, JUDGED, "judging"))
    clock.lap("events_s")
    diagnosis = _conclude(ready, done, last, discovery.title(estimator), clock)
    tell(1.0, "done")
    return diagnosis


def prepare(
    flight: Flight,
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Given | Iterable[Given] = (),
    clock: _Clock | None = None,
    progress: Callable[[float], object] | None = None,
) -> Prepared:
    """The vehicle, what is known of it, when it flew, and the ticks to be judged. Arguments as of `diagnose`; progress: called with the
    finished share, 0..1."""
    clock, tell = clock or _Clock(), progress or (lambda share: None)
    craft, source, notes = baselines.settle(flight, baselines.vehicle_of(vehicle), baseline, diagnose)
    clock.lap("baseline_s")
    flight, on_rates = turning.with_rates(flight)
    known, dynamics = bool(craft.identified), (craft.identified or {}).get("dynamics")
    # Without a gyro every take-off swing looks like a torque that is missing: no short blind time then.
    turns = flight.has("gyro")
    ready_s = READY_KNOWN_S if dynamics and turns else READY_S
    air = airborne(flight) if flight.has("motors") else ()
    tell(0.1)
    flight = mixing.aligned(without_missed(flight, air), craft, air)
    tell(0.2)
    upsets = upset.judged(flight, craft, air, portion(tell, 0.2, 0.5))
    tell(0.5)
    air = upset.until_impact(flight, air, upsets)
    ready_s = ticks.ready_of(ready_s, air) if turns else ready_s
    moves = flight.angular_rate() is not None  # commands alone tell of no motion
    table = observe(flight, craft, air, ready_s, portion(tell, 0.5, 1.0)) if moves else None
    hovers = not aerobatic.applies(flight, table)
    warnings = [*flight.warnings, *notes]
    missing = gaps(flight, air) if air else ()
    warnings += wording.not_commanded(missing, len(craft.rotors))
    assumptions = [*craft.assumptions, *([on_rates] if on_rates else [])]
    if table is not None and dynamics and dynamics.get("dt") != table.dt:
        assumptions.append(
            f"the healthy flights were logged at another rate (assessed every {dynamics.get('dt', 0):.2f} s): their noise does not "
            "apply to this flight, which learns its own for as long as without them"
        )
        dynamics, ready_s = None, ticks.ready_of(READY_S, air) if turns else READY_S
        table = observe(flight, craft, air, ready_s)
    ready_s = ticks.ready_after(ready_s, table.dt if table is not None else 0.0)
    if not known:
        source = "the first healthy part of this flight"
    if not hovers:
        assumptions += [AEROBATIC, NOT_COMPARED]
    elif not known:
        assumptions.append(
            f"the flight's first {ready_s:.0f} s in the air are its trim: damage present at take-off is assessed by what healthy "
            "vehicles of any build need, and better with --baseline or --vehicle"
        )
    assumptions += table.notes if table is not None else ()
    clock.lap("prepare_s")
    return Prepared(
        flight,
        craft,
        known,
        dynamics,
        source,
        air,
        upsets,
        table,
        ready_s,
        hovers,
        tuple(assumptions),
        tuple(warnings),
        missing,
    )


def _no_flight(ready: Prepared, clock: _Clock) -> Diagnosis:
    n, never = len(ready.vehicle.rotors), sorted({rotor for gap in ready.missing for rotor in gap.rotors})
    why = unjudged.NEVER if ready.flight.has("motors") else unjudged.SILENT
    if ready.flight.has("motors") and ready.flight.angular_rate() is None:
        why = unjudged.MOTIONLESS
    elif ready.air:
        why = unjudged.silent(f"no command for {wording.rotors(never)}" if never else "too few motor outputs")
    told = reports.claims(ready.flight, ready.air or ((0.0, ready.flight.duration),), _left(ready))
    if not ready.air:  # of a log without a flight only why the autopilot ended it
        told = tuple(e for e in told if e.extra["trouble"] in conclusion.GRAVE)
    found = ledger.merge(told, events.Report(ready.vehicle.effectiveness()), ready.upsets, n).events
    names = places.names(ready.vehicle.rotors)
    end = conclusion.conclude(conclusion.Evidence(found, n, places=names, hops=ready.air, unjudged=why))
    return _answer(end, ready, {}, clock, doubts=() if any(e.means.wrong for e in found) else (why.why,))


def _left(ready: Prepared) -> tuple[float, ...]:
    """When control was lost [s]."""
    return tuple(judged.onset for judged in ready.upsets)


def estimated(
    ready: Prepared,
    estimator: Any = "default",
    tuning: Tuning | None = None,
    progress: Callable | None = None,
    whole: bool = False,
) -> Estimated:
    """The ticks of a flight that has some, through the estimator; those of a vehicle that does not hover through its own way. whole: with
    the outputs of each tick that a diagnosis does not read (`engine.diagnoser.WRITTEN`)."""
    table, progress = cast(Ticks, ready.table), progress or (lambda share: None)
    B = ready.vehicle.effectiveness()
    if not ready.hovers:
        return Estimated(*aerobatic.estimate(ready.flight, ready.vehicle, ready.air, table))
    if estimator == "default":
        one, judged = fly(ready.flight, ready.vehicle, ready.air, ready.ready_s, ready.dynamics, progress, whole)
        return Estimated(judged.table, judged.out, one.learned, written=one)
    from rotorwatch.methods.published import published

    out, itself = published.judge(estimator, table, B, ready.dynamics, tuning, progress)
    return Estimated(
        table, out, own=False, itself=itself, assumptions=tuple(published.notes(discovery.title(estimator)))
    )


class _Found(NamedTuple):
    """merged: the events of a flight: losses, overridden outputs, contacts, control that was lost, desyncs; with what ESCs say of them.
    claims: what its trim claims that is no event. assumptions, warnings: sentences on how they were found."""

    merged: Merged
    claims: tuple[Event, ...]
    assumptions: tuple[str, ...]
    warnings: tuple[str, ...]


def _find(ready: Prepared, done: Estimated) -> _Found:
    """What is found in a flight."""
    flight, craft, air, table, B = ready.flight, ready.vehicle, ready.air, done.table, ready.vehicle.effectiveness()
    one = done.written
    claims, assumptions = events.read(done.out, table, B, one and one.losses), ()
    if done.own and ready.hovers:
        claims, assumptions = excitation_response.resolve(claims, table, B, ready.dynamics)
    if done.last is not None and not ready.known:  # healthy flights would have told what happened in the blind time
        claims = (*claims, *hindsight.find(done.last, table, B))
    overridden = deviations.overrides(flight, craft, air) if one is None else deviations.in_flight(one.overrides, air)
    claims = (*claims, *map(events.overridden, overridden))
    warnings = [*reports.end(flight, air)]
    grown = None
    if done.own and ready.hovers:
        shown = trim.look(done.out, table, B) if one is None else one.trim
        grown, claims = trim.growth(shown), (*claims, *trim.mounts(shown))
    claims = (*claims, *reports.claims(flight, air, _left(ready)))
    if (
        ready.hovers and (contact := leaning.find(flight, table)) is not None
    ):  # what it leans on is no rotor's doing, nor a mount's
        claims = (
            *(c for c in claims if c.kind not in (LOSS, TURNED) or c.onset_s < contact.onset_s - LEANS_S),
            contact,
        )
    low = tuple(c for c in claims if ready.hovers and c.kind == LOSS and near_ground.explains(flight, air, c))
    claims, warnings = tuple(c for c in claims if c not in low), [*warnings, *map(near_ground.warning, low)]
    report = events.Report(B).add(table, air).finish(air) if one is None else one.report
    merged = ledger.merge(claims, report, ready.upsets, B.shape[1], grown)
    if not any(e.means.accuses for e in merged.events):  # what needs no learning, where learning had no time
        struck = [e.onset_s for e in merged.events if e.kind == CONTACT]
        if dead := pegged.find(flight, craft, air, struck):
            merged = ledger.merge((*claims, *dead), report, ready.upsets, B.shape[1], grown)
    warnings += [text for text, lasts in wording.together(merged.shared) if not lasts]
    found = merged.events
    if "esc" in flight.signals:
        from rotorwatch.witnesses.esc import consistency

        found, notes = consistency.check(flight, craft, air, table, found)
        warnings += notes
    if not ready.hovers or aerobatic.flown_by_rates(flight):
        from rotorwatch.witnesses.aerobatic import desync

        found = tuple(sorted((*found, *desync.find(flight, craft, air, found)), key=lambda e: e.detected_s))
    return _Found(merged._replace(events=found), slow.suspected(grown), tuple(assumptions), tuple(warnings))


class Judgement(NamedTuple):
    """The answer, and what it rests on. evidence: what no event explains; whole: the comparison with healthy flights, or None.
    assumptions, warnings: sentences that judging adds to those of the flight."""

    end: conclusion.Conclusion
    doubts: tuple[str, ...]
    evidence: tuple[Event, ...]
    whole: dict | None
    assumptions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def judge(ready: Prepared, done: Estimated, progress: Callable[[float], object] | None = None) -> Judgement:
    """The answer to a flight that an estimator has seen. `diagnose` shows it, and campaigns count it. progress: called with the finished
    share, 0..1."""
    flight, craft, air, tell = ready.flight, ready.vehicle, ready.air, progress or (lambda share: None)
    found, claims, assumptions, warnings = _find(ready, done)
    tell(0.1)
    table, out, B = done.table, done.out, ready.vehicle.effectiveness()
    n, hyp = B.shape[1], list_hypotheses(B.shape[1])
    doubts = trust.contradictions(flight, craft, air, cast(Ticks, ready.table), portion(tell, 0.1, 0.6))
    doubts += tuple(text for text, lasts in wording.together(found.shared) if lasts)
    doubts += () if ready.hovers else aerobatic.lacks(flight)
    trusted = not doubts and ready.hovers
    whole = _whole_flight(flight, craft, air) if trusted else None
    claims += from_takeoff.claims(whole, Source.FLIGHTS, air)
    if trusted and not ready.known:
        other = population.judge(flight, craft, air, _undisturbed(table, found.events))
        claims += from_takeoff.claims(other, Source.VEHICLES, air)
    tell(0.7)
    judged = (table.mode == JUDGE) & table.valid.any(axis=1)
    claims += residual_evidence.find(out, table, hyp, done.limit, found.events, B)
    claims += residual_evidence.faint(found.faint, found.events, float(table.time[-1]))
    steps, seen_events = unseen.bounds(out, table, B), found.events
    if done.own and ready.hovers:
        seen_events, claims = steps.doubted(found.events), claims + steps.suspected(found.events, float(table.time[-1]))
    leans = min((e.onset_s for e in seen_events if e.kind == CONTACT and e.end_s is None), default=np.inf) - LEANS_S
    claims = ledger.open_claims([c for c in claims if c.kind != EVIDENCE or c.onset_s < leans], seen_events)
    tell(0.8)
    if trusted:  # said last, for nothing that is judged rests on them
        setup = outputs.claims(flight, craft, table, air, ledger.undisturbed(seen_events, claims), seen_events)
        seen_events = ledger.joined(seen_events, setup)
    hidden, hidden_pair = _hidden(out, table, steps, B, ready.hovers)
    judged_s = float(judged.sum() * table.dt)
    seen = conclusion.Evidence(
        seen_events, n, hidden, hidden_pair, judged_s, claims, places.names(craft.rotors), air,
        health.trends(out, table, B, found.events) if trusted else (), ready.hovers and whole is None,
        tuple(g for g in ready.missing if g.lasts and g.start >= air[-1][0]), ready.matters,
        judged_until=_judged_until(table.time[judged], seen_events),
        blind_s=ready.ready_s if ready.hovers else aerobatic.READY_S,
    )  # fmt: skip
    if ready.hovers and (shaken := unjudged.shaken(flight, air)) is not None:
        seen = seen._replace(hidden=None, unjudged=shaken)
    elif not doubts and not (judged_s < conclusion.LEAST_S or seen.vague) and seen.patchy:
        seen = seen._replace(unjudged=unjudged.patchy(air, table, ready.hovers))
    elif not doubts and (judged_s < conclusion.LEAST_S or seen.vague):
        needed = (ready.ready_s if ready.hovers else aerobatic.READY_S) + conclusion.LEAST_S
        stepped = bool(np.max(steps.losses()) >= np.max(hidden))
        why = unjudged.find(air, table, judged_s, needed, ready.hovers, conclusion.LEAST_S, stepped)
        seen = seen._replace(unjudged=why)
    end = conclusion.conclude(seen, doubts)
    return Judgement(end, doubts, tuple(seen.residual_evidence), whole, assumptions, warnings)


def _judged_until(judged: np.ndarray, found: Sequence[Event]) -> float:
    """The last judged moment, of ticks at these times: a push that lasts to the end hides what it breaks."""
    leans = (e.onset_s for e in found if e.kind == CONTACT and e.end_s is None)
    return min([float(judged[-1]) if judged.size else np.inf, *leans])


def _conclude(ready: Prepared, done: Estimated, last: Judgement, title: str, clock: _Clock) -> Diagnosis:
    """The diagnosis. title: the estimator's."""
    flight, craft, air = ready.flight, ready.vehicle, ready.air
    table, out, B = done.table, done.out, ready.vehicle.effectiveness()
    end, doubts = last.end, last.doubts
    if done.itself is not None:
        end = by_method.told(end, done.itself)
    comparison = detectors.detect(flight, craft, air)
    clock.lap("comparison_s")
    judged = (table.mode == JUDGE) & table.valid.any(axis=1)
    common = common_mode.thrust_shift(out.biases[judged, 3]) if not doubts and ready.hovers else {}
    hyp = list_hypotheses(B.shape[1])
    trace = traces.compose(
        flight, out, table, hyp, B, air, ready.ready_s, done.limit, end.events, last.evidence, end.rotors
    )
    said = replace(
        ready,
        assumptions=(*ready.assumptions, *done.assumptions, *last.assumptions),
        warnings=(*ready.warnings, *last.warnings),
    )
    return _answer(
        end,
        said,
        common,
        clock,
        estimator=title,
        comparison=comparison,
        whole_flight=last.whole,
        doubts=doubts,
        trace=trace,
        own=done.itself,
    )


def _answer(end: conclusion.Conclusion, ready: Prepared, common: dict, clock: _Clock, **more) -> Diagnosis:
    flight, craft = ready.flight, ready.vehicle
    return Diagnosis(
        _facts(flight, craft, ready.air, ready.table), end.verdict, end.reason, end.rotors, end.events, common, ready.source,
        ready.assumptions, ready.warnings, clock.stop(), headline=end.headline, main=end.main, advice=end.advice,
        story=end.story, picture=picture.compose(flight, craft, end.events, end.main, ready.air),
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


def _whole_flight(flight: Flight, vehicle: Vehicle, air):
    """Damage present from take-off, against the baseline in the vehicle; None without one."""
    stored = (vehicle.identified or {}).get("whole_flight")
    if not stored:
        return None
    from rotorwatch.witnesses.healthy import whole_flight

    features = whole_flight.features(flight, vehicle, air)
    return whole_flight.judge(features, [whole_flight.Features.from_dict(f) for f in stored], vehicle).to_dict()


def _undisturbed(table: Ticks, found) -> float:
    """Time in s of the first event or upset: what is seen before it was there from take-off."""
    return min([np.inf, *(e.onset_s for e in found), *table.time[table.upset & (table.mode > ticks.GROUND)][:1]])


def _hidden(out, table: Ticks, seen: unseen.Unseen, B: np.ndarray, hovers: bool) -> tuple[np.ndarray, float]:
    """(n,) largest loss of each rotor that could have gone unseen in flight: too small to be measured, or taken for a disturbance; and the
    same of two opposite rotors."""
    judged = table.mode == JUDGE
    if not judged.any():
        return np.ones(out.theta.shape[1]), 1.0
    if not hovers:  # its bound is of all blocks so far; two opposite rotors at once are not looked for
        return np.minimum(1.0, 1.96 * out.detectable[judged][-1]), 0.0
    measured = 1.96 * median(out.detectable[judged], axis=0)
    single = np.minimum(1.0, np.maximum(measured, seen.losses()))
    return single, min(1.0, seen.pair(events.opposites(B)))
