"""Losses injected into healthy flights: real noise with a known fault, diagnosed by the default method.

A rotor that loses the share l of its thrust is commanded more until the vehicle moves as before. Rotor thrusts f, mixer
M and effectiveness B give the commands f + d that the rate controller ends up with: the same wrench, through the mixer,

    B (1 - L) (f + d) = B f,   d = M c    =>    d = M (B (1 - L) M)^-1 B L f,       L = diag(l)

For a quad that is d_i = l_i / (1 - l_i) f_i on the faulty rotors alone. The controller gets there with a first-order
response: d grows as 1 - exp(-(t - onset) / response_s), while the measured motion stays what it was. A real loss also
moves the vehicle until the controller has made up for it, which is easier to see: the experiment errs on the hard side.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import ASSESS, READY_KNOWN_S, READY_S, airborne, allocation, prepare
from rotorwatch_lab.experiments import counting, tools

RESPONSE_S = 0.7  # how fast rate and attitude controllers of real quads make up for a loss
AFTER_READY_S, BEFORE_END_S = 3.0, 12.0  # where onsets may lie within a flight
PART = 6  # injections done at a time by one process


def inject(
    flight: Flight,
    vehicle: Vehicle,
    rotors: int | Sequence[int],
    loss: float | Sequence[float],
    onset: float,
    response_s: float = RESPONSE_S,
) -> Flight:
    """The flight as it would look had `rotors` lost `loss` at `onset`.

    flight: a healthy one. vehicle: its airframe. rotors: 1-based. loss: 0 to 1, one for all or one each. onset: s from the log's first
    record. response_s: time constant with which the motors follow [s]. Signals ``motors`` and ``control`` are rewritten after the onset,
    everything else stays. A command beyond its limit is cut off there, and a warning of the flight gives the share: this flight could not
    have continued so. ``facts["injected"]`` holds what was done. Raises ConfigError for rotors, losses or times that the flight does not
    have.
    """
    share = _losses(flight, vehicle, rotors, loss)
    motors = flight.signals["motors"]
    if not (np.isfinite(onset) and len(motors) and motors.time[0] <= onset < motors.time[-1]):
        raise ConfigError(f"onset {onset:g} s lies outside the motor commands of the flight; choose a time within them.")
    if not (np.isfinite(response_s) and response_s > 0):
        raise ConfigError(f"response time {response_s:g} s: give a positive number of seconds.")
    answer = _answer(vehicle, share)

    def raised(thrust: np.ndarray, time: np.ndarray) -> np.ndarray:
        grown = -np.expm1(-np.maximum(time - onset, 0.0) / response_s)
        return np.maximum(thrust + grown[:, None] * (thrust @ answer.T), 0.0)

    signals = dict(flight.signals)
    signals["motors"], limited = _motors(flight, vehicle, raised, onset)
    warnings = list(flight.warnings)
    if "control" in signals:
        control = _control(flight, vehicle, raised, onset)
        if control is None:
            del signals["control"]
            warnings.append("The rate controller's output was left out: without a known mixer no loss can be put into it.")
        else:
            signals["control"] = control
    for k in np.flatnonzero(limited > 0.001):
        warnings.append(
            f"The injected loss drives rotor {k + 1} to its limit in {limited[k]:.1%} of the commands after "
            f"{onset:.1f} s: the vehicle could not have flown as it did."
        )
    injection = {
        "rotors": [int(k) + 1 for k in np.flatnonzero(share)],
        "loss": [float(v) for v in share[share > 0]],
        "onset_s": float(onset),
        "at_limit": [float(v) for v in limited],
    }
    return replace(flight, signals=signals, warnings=tuple(warnings), facts={**flight.facts, "injected": injection})


def _losses(flight: Flight, vehicle: Vehicle, rotors, loss) -> np.ndarray:
    """(n,) loss of every rotor; ConfigError unless the request makes sense."""
    n = len(vehicle.rotors)
    if not flight.has("motors") or flight.rotor_count != n:
        raise ConfigError(f"the flight has commands of {flight.rotor_count} rotors, the vehicle {n}: nothing to put a loss into.")
    faulty, much = np.atleast_1d(rotors), np.atleast_1d(np.asarray(loss, float))
    if faulty.dtype.kind not in "iu" or not faulty.size or len(set(faulty.tolist())) != faulty.size or faulty.min() < 1 or faulty.max() > n:
        raise ConfigError(f"rotors {rotors}: give different rotor numbers from 1 to {n}.")
    if much.ndim != 1 or much.size not in (1, faulty.size):
        raise ConfigError(f"{much.size} losses for {faulty.size} rotors: give one for all, or one each.")
    if not np.all((much > 0) & (much < 1)):
        raise ConfigError(f"loss {loss}: give shares above 0 and below 1; no vehicle flies as before with a dead rotor.")
    share = np.zeros(n)
    share[faulty - 1] = much
    return share


def _answer(vehicle: Vehicle, share: np.ndarray) -> np.ndarray:
    """(n, n): extra thrust d per thrust f with which the controller compensates for losses `share` (n,)."""
    B = vehicle.effectiveness()
    M = vehicle.mixer if vehicle.mixer is not None else np.linalg.pinv(B)
    return M @ np.linalg.pinv(B @ np.diag(1.0 - share) @ M) @ B @ np.diag(share)


def _motors(flight: Flight, vehicle: Vehicle, raised: Callable, onset: float) -> tuple[Signal, np.ndarray]:
    """Signal ``motors`` with the raised thrusts, and the share (n,) of later samples that would exceed the limit."""
    motors, curve = flight["motors"], vehicle.curve
    thrust = allocation.motor_thrusts(flight, vehicle).values
    span = curve.u_max - curve.u_min
    before = np.clip((motors.values - curve.u_min) / span, 0.0, 1.0)
    # Both drives hold the same battery ratio, which their quotient is free of.
    old, new = allocation.drive(curve.expo, thrust), allocation.drive(curve.expo, raised(thrust, motors.time))
    after = before * np.divide(new, old, out=np.ones_like(old), where=old > 1e-9)
    change = (motors.time > onset)[:, None] & motors.valid & (after != before)
    values = np.where(change, curve.u_min + span * np.minimum(after, 1.0), motors.values)
    later = max(1, int((motors.time > onset).sum()))
    return replace(motors, values=values), ((after > 1.0) & change).sum(axis=0) / later


def _control(flight: Flight, vehicle: Vehicle, raised: Callable, onset: float) -> Signal | None:
    """Signal ``control`` that the mixer turns into the raised thrusts; None when the mixer is not known."""
    control = flight["control"]
    if vehicle.mixer is None:
        return None
    check = allocation.compare(flight, vehicle)
    weights = np.concatenate([vehicle.mixer.T, np.zeros((1, len(vehicle.rotors)))])[None]
    if len(check.time):
        weights = check.gain[:, None, None] * weights  # the mixer with the gain it was seen to have
    newest = np.clip(np.searchsorted(check.known, control.time, side="right") - 1, 0, len(weights) - 1)
    values = control.values.copy()
    commanded, believed = vehicle.curve.expo, allocation.mixer_curve(vehicle).expo
    later = np.flatnonzero((control.time > onset) & control.whole)
    for part in np.array_split(later, len(later) // 8192 + 1):  # weights of all rows: much memory
        if not part.size:
            continue
        W = weights[newest[part], :4]
        demand = np.einsum("tc,tcr->tr", values[part], W)
        thrust = _thrust(commanded, allocation.drive(believed, np.clip(demand, 0.0, None)))
        wanted = _thrust(believed, allocation.drive(commanded, raised(thrust, control.time[part])))
        more = np.where(demand > 0, wanted - demand, 0.0)
        values[part] += np.einsum("tr,trc->tc", more, np.linalg.pinv(W))
    return replace(control, values=values)


def _thrust(expo: float, drive: np.ndarray) -> np.ndarray:
    return (1.0 - expo) * drive + expo * drive * drive


def campaign(
    paths: Sequence[Flight | str | PathLike],
    losses: Sequence[float] = (0.2, 0.3, 0.4),
    repeats: int = 3,
    seed: int = 0,
    progress: Callable | None = None,
    jobs: int | None = 1,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> dict[str, Any]:
    """Inject every loss into every rotor of every healthy flight, `repeats` times each, and count the detections.

    Onsets are drawn at random, from 3 s after assessing begins to 12 s before the hop ends. The answer:

    table      a row for each loss: injections; detected: share found, of those right, as `counting` says, and
               ambiguous_with_truth: several sets, this rotor among them;
               median_delay_s, p90_delay_s from onset to announcement; of the right ones loss_rms and loss_bias 2 s
               after the announcement, coverage: share whose 95 % interval at the end holds the loss; false_alarms:
               alarms before the onset, or after it without this rotor; at_limit: injections that reach a rotor's limit
    healthy    flights, hours assessed and false_alarms of the flights as they are
    flights    number of flights long enough for an injection
    trials     one entry for each injection

    progress: called as progress(share, text). jobs, scheduler: as for `many.run`; the answer is the same. keep: a
    folder for what is finished, from which the same call goes on; for logs given by path. Raises LogError, VehicleError
    or ConfigError with one sentence.
    """
    if not paths:
        raise ConfigError("Give at least one healthy flight to put losses into.")
    if not losses or not all(0 < v < 1 for v in losses):
        raise ConfigError("Losses to inject are above 0 and below 1; no vehicle flies as before with a dead rotor.")
    if repeats < 1:
        raise ConfigError(f"repeats {repeats}: give 1 or more.")
    report = progress or (lambda share, text="": None)
    rng = np.random.default_rng(seed)
    sources = [path if isinstance(path, Flight) else str(path) for path in paths]
    shared = {"scheduler": scheduler, "keep": keep}
    surveys = tools.gathered(_survey, sources, jobs, lambda s, text: report(0.05 * s, text), "healthy flights", **shared)
    # Onsets are drawn here, in the order of the flights, so that the distribution of work changes nothing.
    parts: list[tuple] = []
    for source, survey in zip(sources, surveys, strict=True):
        plan = [(r, loss) for r in range(1, survey.rotors + 1) for loss in losses for _ in range(repeats) if survey.room]
        drawn = [(rotor, loss, draw(survey.room, rng)) for rotor, loss in plan]
        parts += [(source, drawn[k : k + PART]) for k in range(0, len(drawn), PART)]
    trials = tools.gathered(_trials, parts, jobs, lambda s, text: report(0.05 + 0.95 * s, text), "injecting", **shared)
    if not trials:
        raise ConfigError("No flight is long enough: losses need 23 s in the air without a baseline.")
    healthy = {
        "flights": len(surveys),
        "hours": sum(s.assessed_s for s in surveys) / 3600.0,
        "false_alarms": sum(s.alarms for s in surveys),
    }
    table = [_row(loss, [t for t in trials if t["loss"] == loss]) for loss in losses]
    return {
        "table": table, "healthy": healthy, "flights": sum(bool(s.room) for s in surveys), "seed": seed, "trials": trials,
    }  # fmt: skip


class _Survey(NamedTuple):
    """A healthy flight: where onsets may lie in it, how long it was assessed, and how many false alarms it has."""

    rotors: int
    room: list[tuple[float, float]]
    assessed_s: float
    alarms: int


def _survey(source: Flight | str) -> list[_Survey]:
    flight, vehicle, air = _flown(source)
    alarms, assessed_s = _assess(flight, vehicle)
    room = [(start + ready_s(vehicle) + AFTER_READY_S, end - BEFORE_END_S) for start, end in air]
    return [_Survey(len(vehicle.rotors), [(a, b) for a, b in room if b > a], assessed_s, len(alarms))]


def _trials(part: tuple[Flight | str, list[tuple[int, float, float]]]) -> list[dict]:
    """Outcomes of injections (rotor, loss, onset) into one flight."""
    flight, vehicle, _ = _flown(part[0])
    trials = []
    for rotor, loss, onset in part[1]:
        faulty = inject(flight, vehicle, rotor, loss, onset)
        outcome = _outcome(_assess(faulty, vehicle)[0], rotor, loss, onset)
        limit = max(faulty.facts["injected"]["at_limit"])
        trials.append({"flight": flight.name, "rotor": rotor, "loss": loss, **outcome, "at_limit": limit})
    return trials


def _flown(source: Flight | str) -> tuple[Flight, Vehicle, Any]:
    """A flight, its vehicle, and when it was in the air; a log is read once for consecutive parts."""
    if isinstance(source, str):
        return _read(source)
    return source, airframes.identify(source), airborne(source)


@functools.lru_cache(maxsize=1)
def _read(path: str) -> tuple[Flight, Vehicle, Any]:
    flight = logs.read(path)
    return flight, airframes.identify(flight), airborne(flight)


def ready_s(vehicle: Vehicle) -> float:
    """Time from take-off until the evaluation begins [s]: shorter where the vehicle's dynamics are known from healthy flights."""
    return READY_KNOWN_S if vehicle.identified else READY_S


def _assess(flight: Flight, vehicle: Vehicle) -> tuple[tuple[counting.Alarm, ...], float]:
    """The alarms of `diagnose`, and the seconds evaluated."""
    ready = prepare(flight, vehicle)
    if ready.table is None:
        return (), 0.0
    assessed_s = float((ready.table.mode == ASSESS).sum() * ready.table.dt)
    return counting.alarms(ready.answer().end.events), assessed_s


def draw(room: list[tuple[float, float]], rng: np.random.Generator) -> float:
    """A time, uniform over the intervals."""
    lengths = np.array([b - a for a, b in room])
    k = rng.choice(len(room), p=lengths / lengths.sum())
    return float(rng.uniform(*room[k]))


def _outcome(raised: Sequence[counting.Alarm], rotor: int, loss: float, onset: float) -> dict:
    """Outcome of one injection."""
    counted = counting.count(raised, (rotor,), onset)
    result: dict[str, Any] = {"onset_s": onset, "detected": counted.found, "false_alarms": len(counted.false) + len(counted.wrong)}
    if not counted.found:
        return result
    (_, sets, event), right = counted.own[0], counted.right
    result |= {
        "named": list(sets[0]),
        "alternatives": [list(s) for s in sets[1:]],
        "right": right,
        "ambiguous_with_truth": counted.named and len(sets) > 1,
        "delay_s": counted.delay_s,
    }
    if right and event is not None and event.loss:
        low, high = event.interval[0]
        result |= {"loss_2s": event.extra["loss_2s"][0], "loss_end": event.loss[0], "covered": bool(low <= loss <= high)}
    return result


def _row(loss: float, trials: list[dict]) -> dict:
    """Row of the table: all injections of one size."""
    detected = [t for t in trials if t["detected"]]
    right = [t for t in detected if t["right"]]
    sized = [t for t in right if "loss_2s" in t]
    delays = [t["delay_s"] for t in detected]
    error = np.array([t["loss_2s"] - loss for t in sized])
    return {
        "loss": loss,
        "injections": len(trials),
        "detected": len(detected) / len(trials),
        "right": len(right) / len(detected) if detected else None,
        "ambiguous_with_truth": sum(t["ambiguous_with_truth"] for t in detected) / len(detected) if detected else None,
        "median_delay_s": float(np.median(delays)) if detected else None,
        "p90_delay_s": float(np.quantile(delays, 0.9)) if detected else None,
        "loss_rms": float(np.sqrt(np.mean(error**2))) if sized else None,
        "loss_bias": float(error.mean()) if sized else None,
        "coverage": float(np.mean([t["covered"] for t in sized])) if sized else None,
        "false_alarms": sum(t["false_alarms"] for t in trials),
        "at_limit": sum(t["at_limit"] > 0.001 for t in trials),
    }
