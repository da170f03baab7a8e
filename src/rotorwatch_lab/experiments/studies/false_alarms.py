"""False-alarm rate of the default diagnoser on real noise: surrogate flights made from healthy ones.

A healthy flight is split, axis by axis, into what its motion explains and what is left over, y = G m + c r + e (plant:
`systems.wrench_balance`). Residuals e and motion (r, dr/dt, load) then become a new flight with the same statistics:

    activity  what changes faster than the flight's liveliness does is divided by this liveliness, which the surrogate
              gets back with another start: gusts and manoeuvres come in bursts, and bursts make false alarms
    phases    all channels get the same random phases, so that amplitude spectra and cross-spectra stay (Prichard &
              Theiler, Phys. Rev. Lett. 73(7), 1994), alternating with a rank-wise return to each channel's own
              values, so that their tails stay, too (Schreiber & Schmitz, Phys. Rev. Lett. 77(4), 1996; for several
              channels Physica D 142, 2000)
    mirrors   signs of roll, pitch and yaw are drawn at random, each in torque, rate and acceleration alike

Mean and trend are kept; rotor thrusts follow from the wrench, T = B^+ y. What surrogates cannot show is a single event
whose shape matters, a hard turn say. Therefore every flight is also assessed as it was flown, take-off included, and with
its yaw mirrored (on a quad, all other mirror images are one of these two with the rotors renumbered).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.base import many
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import (
    ASSESS,
    HOVER_LEARN_S,
    LAG_S,
    LEARN,
    Ticks,
    aerobatic,
    airborne,
    allocation,
    events,
    list_hypotheses,
    observe,
    program,
)
from rotorwatch_lab.compiling.run import CHUNK
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.inject import ready_s

PROMISED_PER_HOUR = 0.1
FLIGHT_S = 100.0  # length of a surrogate flight, roughly: as short as flights are, each starts without knowledge
SHORTEST_S = 20.0  # of a healthy flight's assessed part that surrogates can be made from
TOUCHDOWN_S = 2.0  # before the end of a hop: cut throttle is no noise
JOIN_S, TREND_S, ACTIVITY_S = 2.0, 2.0, 8.0
GAP_TICKS = 3  # missing ticks in a row that are bridged by a straight line
ITERATIONS = 10
IMAGES = {"as flown": (1.0, 1.0, 1.0), "yaw mirrored": (1.0, 1.0, -1.0)}
QUANTILES, PEAK_S = (0.5, 0.9, 0.99), 5.0
SHIFTS = (-4.0, -2.0, 0.0, 2.0, 4.0)  # nats added to the threshold


@dataclass(frozen=True)
class Source:
    """A healthy flight to make surrogates from, T ticks of its longest assessed stretch.

    table: all of its ticks. slow, fast (T, 13): residuals e of roll, pitch, yaw, thrust; rates; angular accelerations;
    load; side forces: all without their means, e without its trend, fast divided by activity (T,). level (13,): the means; slope
    (4,): trend of e per tick; gains (4, 3): G, c and l of each axis. missing: share of its ticks without a measurement.
    part: which ticks of the table these are.
    """

    name: str
    vehicle: Vehicle
    table: Ticks
    slow: np.ndarray
    fast: np.ndarray
    activity: np.ndarray
    level: np.ndarray
    slope: np.ndarray
    gains: np.ndarray
    missing: float
    part: slice


def source(flight: Flight, vehicle: Vehicle) -> Source:
    """Split a healthy flight into motion and residuals. Raises ConfigError if less than 20 s of it can be evaluated."""
    air = airborne(flight)
    table = observe(flight, vehicle, air, ready_s(vehicle))
    part = _longest(table, air) if table is not None else slice(0, 0)
    if table is None or (part.stop - part.start) * table.dt < SHORTEST_S:
        name = flight.name or "the flight"
        raise ConfigError(f"{name} has no {SHORTEST_S:.0f} s of assessed flight without gaps to make surrogates from; leave it out.")
    n = table.thrust.shape[1]
    known = np.asarray(table.valid[part, :3].all(axis=1))
    y, rate, rate_dot, load = (_bridged(v[part], known) for v in (table.wrench, table.rate, table.rate_dot, table.load[:, None]))
    side = _bridged(np.zeros((len(y), 2)) if table.side is None else table.side[part], known)
    regressors = _regressors(rate, rate_dot, load, side, n)
    one = np.ones((len(y), 1))
    gains = np.zeros((4, 3))
    for a in range(4):
        gains[a] = np.linalg.lstsq(np.column_stack([regressors[:, a], one]), y[:, a], rcond=None)[0][:3]
    e = y - (gains * regressors).sum(axis=2)
    # The line from start to end is removed, so that the ends meet and the finite spectrum does not leak.
    edge = max(1, round(TREND_S / table.dt))
    slope = (e[-edge:].mean(axis=0) - e[:edge].mean(axis=0)) / (len(e) - edge)
    e = e - slope * (np.arange(len(e)) - 0.5 * (len(e) - 1))[:, None]
    channels = np.column_stack([e, rate, rate_dot, load, side])
    level = channels.mean(axis=0)
    channels = channels - level
    window = max(3, round(ACTIVITY_S / table.dt))
    slow = _smooth(channels, window)
    fast = channels - slow
    change = fast - np.roll(fast, 1, axis=0)
    power = np.mean(change**2 / np.maximum(np.mean(change**2, axis=0), 1e-30), axis=1)
    activity = np.sqrt(np.maximum(_smooth(power[:, None], window)[:, 0], 0.01))
    missing = float(1.0 - known.mean())
    fast = fast / activity[:, None]
    return Source(flight.name, vehicle, table, slow, fast, activity, level, slope, gains, missing, part)


def losses(table: Ticks, vehicle: Vehicle) -> tuple[tuple[Event, ...], program.TickOutput]:
    """Losses that the default estimator announces at these ticks, and its outputs."""
    B = vehicle.effectiveness()
    _, out = program.estimate(table, B, (vehicle.identified or {}).get("dynamics"))
    return events.read(out, table, B), out


def _regressors(rate, rate_dot, load, side, n: int) -> np.ndarray:
    """(T, 4, 3): what G, c and l of each axis multiply in the wrench balance."""
    none = np.zeros((len(rate), 1))
    motion, rates = np.column_stack([rate_dot, n * load]), np.column_stack([rate, none])
    return np.stack([motion, rates, np.column_stack([-side[:, 1:], side[:, :1], none, none])], axis=2)


def _smooth(values: np.ndarray, window: int) -> np.ndarray:
    """(T, k) smoothed by a raised cosine of `window` ticks; periodic at the ends."""
    shape = np.zeros(len(values))
    shape[np.arange(window) - window // 2] = np.hanning(window + 2)[1:-1]
    gain = np.fft.rfft(shape / shape.sum())
    return np.fft.irfft(np.fft.rfft(values, axis=0) * gain[:, None], len(values), axis=0)


def _bridged(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(T, k) with straight lines where not `known` (T,)."""
    at = np.arange(len(values))
    return np.column_stack([np.interp(at, at[known], column[known]) for column in values.T])


def _longest(table: Ticks, air) -> slice:
    """The longest stretch of assessed ticks, touch-down left out, with torque measured but for short gaps."""
    aloft = allocation.within(table.time, tuple((start, end - TOUCHDOWN_S) for start, end in air))
    known = np.flatnonzero((table.mode == ASSESS) & table.valid[:, :3].all(axis=1) & aloft)
    good = np.zeros(len(table.time) + 2, bool)
    good[known + 1] = True
    for k in np.flatnonzero((np.diff(known) > 1) & (np.diff(known) <= GAP_TICKS + 1)):
        good[known[k] + 1 : known[k + 1] + 1] = not table.restart[known[k] + 1 : known[k + 1] + 1].any()
    edges = np.flatnonzero(np.diff(good.astype(int)))
    if not edges.size:
        return slice(0, 0)
    starts, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - starts))
    return slice(int(starts[k]), int(ends[k]))


def phases(values: np.ndarray, rng: np.random.Generator, iterations: int = ITERATIONS) -> np.ndarray:
    """(T, k) surrogate of k channels: common random phases, and each channel's own values in a new order.

    Each round returns to the original amplitudes and phase differences, with the one common phase per frequency that is
    nearest to the last round, and then to the original values by rank.
    """
    count = len(values)
    wanted = np.fft.rfft(values, axis=0)
    ranked = np.sort(values, axis=0)
    spectrum_phase = np.exp(-1j * np.angle(wanted))
    turn = np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, (len(wanted), 1)))
    channels = values
    for k in range(max(1, iterations)):
        if k:
            together = (np.fft.rfft(channels, axis=0) * spectrum_phase).sum(axis=1, keepdims=True)
            size = np.abs(together)
            turn = np.where(size > 0, together / np.where(size > 0, size, 1.0), 1.0)
        turn[0] = 1.0
        if count % 2 == 0:  # the highest frequency is real
            turn[-1] = np.where(turn[-1].real < 0, -1.0, 1.0)
        channels = np.fft.irfft(wanted * turn, count, axis=0)
        channels = np.take_along_axis(ranked, np.argsort(np.argsort(channels, axis=0), axis=0), axis=0)
    return channels


def surrogate(source: Source, rng: np.random.Generator, flight_s: float = FLIGHT_S) -> Ticks:
    """A surrogate flight of about `flight_s`: learning as after a take-off, then evaluated to its end."""
    dt, n = source.table.dt, source.table.thrust.shape[1]
    # Whole chunks of the compiled program: no tick is computed in vain.
    count = CHUNK * max(1, round(flight_s / dt / CHUNK))
    join = max(2, round(JOIN_S / dt))
    channels = _piece(source, rng)
    while len(channels) < count:  # independent pieces, faded into each other at constant power
        piece = _piece(source, rng)
        angle = 0.5 * np.pi * (np.arange(join) + 0.5)[:, None] / join
        mixed = np.cos(angle) * channels[-join:] + np.sin(angle) * piece[:join]
        channels = np.concatenate([channels[:-join], mixed, piece[join:]])
    channels = channels[:count]
    e, rate, rate_dot, load, side = np.split(channels + source.level, [4, 7, 10, 11], axis=1)
    # The trend goes to and fro: continued, it would leave the range that it had in flight.
    length = len(source.slow)
    drift = source.slope * (np.abs((np.arange(count) + rng.integers(2) * length) % (2 * length) - length) - 0.5 * length)[:, None]
    wrench = (source.gains * _regressors(rate, rate_dot, load, side, n)).sum(axis=2) + drift + e
    learning = ready_s(source.vehicle) - HOVER_LEARN_S
    time = dt * np.arange(count)
    accelerometer = bool(np.median(source.table.valid[source.table.mode == ASSESS, 3]))
    table = Ticks(
        time,
        time - LAG_S - 0.5 * dt,
        np.ones((count, n)),
        wrench,
        rate,
        rate_dot,
        load[:, 0],
        (rng.random(count) >= source.missing)[:, None] & [True, True, True, accelerometer],
        np.where(time < learning, LEARN, ASSESS).astype(np.int32),
        np.arange(count) == 0,
        np.full(count, float(np.median(source.table.hover[source.table.mode == ASSESS]))),
        dt,
        np.zeros(count, bool),
        side=side,
    )
    return mirrored(table, source.vehicle, rng.choice([-1.0, 1.0], 3))


def _piece(source: Source, rng: np.random.Generator) -> np.ndarray:
    """Surrogate channels as long as the source; they are periodic, so channels and activity may start anywhere."""
    count, k = source.slow.shape
    channels = phases(np.concatenate([source.slow, source.fast], axis=1), rng)
    return channels[:, :k] + np.roll(source.activity, rng.integers(count))[:, None] * channels[:, k:]


def mirrored(table: Ticks, vehicle: Vehicle, signs) -> Ticks:
    """The flight with roll, pitch and yaw turned by `signs` (3,) of +1 and -1; thrusts T = B^+ y, none below zero."""
    B, signs = vehicle.effectiveness(), np.asarray(signs, float)
    thrust = np.maximum(table.wrench * [*signs, 1.0] @ np.linalg.pinv(B).T, 0.0)
    # A push to the right rolls and a push forward pitches: they turn with the torque that they make.
    side = None if table.side is None else table.side * signs[[1, 0]]
    turned = {"rate": table.rate * signs, "rate_dot": table.rate_dot * signs, "side": side}
    return replace(table, thrust=thrust, wrench=thrust @ B.T, **turned)


def false_alarms(
    paths: Sequence[Flight | str | PathLike],
    hours: float = 20.0,
    seed: int = 0,
    progress: Callable | None = None,
    flight_s: float = FLIGHT_S,
    jobs: int | None = 1,
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> dict[str, Any]:
    """Assess `hours` of surrogate flights of healthy ones with the default diagnoser, and count its false alarms.

    The answer, every rate per flight hour with its exact 95 % Poisson interval (low, high):

    total       flights, hours assessed, alarms (all events of all flights), rate, low, high; promised: the stated rate
    table       the same for each healthy flight that surrogates were made of
    thresholds  for a threshold `shift` nats higher: first_alarms of a flight and the hours up to them
    flown       the healthy flights themselves, as flown and with yaw mirrored: few hours, but real ones
    evidence    how near to an alarm noise comes, to compare surrogates with the flights they stand for: 50, 90 and 99 %
                quantiles of the largest evidence in 5 s [nats above the threshold], up to the first alarm of a flight
    alarms      what was announced: flight, which surrogate (or as flown), time, rotors, loss

    progress: called as progress(share, text). jobs, scheduler: as for `many.run`, one healthy flight at a time; the answer is the same.
    keep: a folder for what is finished, from which the same call goes on; for logs given by path.
    Raises LogError, VehicleError or ConfigError with one sentence.
    """
    if not paths:
        raise ConfigError("Give at least one healthy flight to make surrogates from.")
    if not (np.isfinite(hours) and hours > 0):
        raise ConfigError(f"hours {hours:g}: give how many flight hours to simulate, above 0.")
    surrogates_of = functools.partial(_surrogates, hours=hours / len(paths), seed=seed, flight_s=flight_s)
    sources = [path if isinstance(path, Flight) else str(path) for path in paths]
    several = jobs != 1 or scheduler is not None or keep is not None

    def finished(count: int) -> None:
        if progress and several:
            progress(count / len(paths), "assessing surrogates")

    def report(i: int, share: float, name: str) -> None:
        if progress:
            progress((i + share) / len(paths), name)

    if not several:  # in this process the progress within a flight can be reported
        parts = [surrogates_of((i, source), report=functools.partial(report, i)) for i, source in enumerate(sources)]
    else:
        parts = list(many.ordered(surrogates_of, list(enumerate(sources)), jobs, scheduler, finished, keep))
    firsts = {shift: (sum(p.firsts[shift][0] for p in parts), sum(p.firsts[shift][1] for p in parts)) for shift in SHIFTS}
    evidence = {kind: [v for p in parts for v in p.evidence[kind]] for kind in ("surrogates", "flown")}
    rows = [p.row for p in parts]
    total = {k: sum(r[k] for r in rows) for k in ("flights", "hours", "alarms")}
    flown = {k: sum(p.flown[k] for p in parts) for k in ("flights", "hours", "alarms")}
    return {
        "table": rows,
        "total": {**total, **_rate(total["alarms"], total["hours"]), "promised": PROMISED_PER_HOUR},
        "thresholds": [{"shift": s, "first_alarms": k, "hours": h, **_rate(k, h)} for s, (k, h) in firsts.items()],
        "flown": {**flown, **_rate(flown["alarms"], flown["hours"])},
        "evidence": {k: [float(q) for q in np.quantile(v, QUANTILES)] for k, v in evidence.items()},
        "alarms": [alarm for p in parts for alarm in p.alarms],
        "seed": seed,
    }


class _Part(NamedTuple):
    """Result of surrogates of one healthy flight, and of the flight itself. firsts: shift -> (first alarms, hours up to them)."""

    row: dict[str, Any]
    flown: dict[str, Any]
    firsts: dict[float, tuple[int, float]]
    evidence: dict[str, list[float]]
    alarms: list[dict[str, Any]]


def _surrogates(
    numbered: tuple[int, Flight | str], hours: float, seed: int, flight_s: float, report: Callable[[float, str], None] | None = None
) -> _Part:
    """`hours` of surrogates of one flight; its number and the seed determine the random numbers. report: called with the finished share,
    name."""
    i, path = numbered
    flight = path if isinstance(path, Flight) else logs.read(path)
    aerobatic.decline(flight, "surrogates are made of the noise of hover; leave it out.")
    origin = source(flight, airframes.identify(flight))
    rng = np.random.default_rng([seed, i])
    firsts: dict[float, tuple[int, float]] = dict.fromkeys(SHIFTS, (0, 0.0))
    evidence: dict[str, list[float]] = {"surrogates": [], "flown": []}
    row, alarms = {"flight": flight.name, "flights": 0, "hours": 0.0, "alarms": 0}, []
    while row["hours"] < hours:
        table = surrogate(origin, rng, flight_s)
        found, out = losses(table, origin.vehicle)
        assessed_h = _hours(table)
        row |= {key: row[key] + more for key, more in (("flights", 1), ("hours", assessed_h), ("alarms", len(found)))}
        alarms += [_line(flight.name, f"surrogate {row['flights']}", e) for e in found]
        evidence["surrogates"] += _peaks(out, table.mode == ASSESS, table.dt)
        for shift, first in _first_alarms(table, origin.vehicle, out).items():
            count, upto = firsts[shift]
            upto += assessed_h if first is None else max(0.0, first) / 3600.0
            firsts[shift] = count + (first is not None), upto
        if report:
            report(min(1.0, row["hours"] / hours), flight.name)
    flown = {"flights": 0, "hours": 0.0, "alarms": 0}
    for image, signs in IMAGES.items():
        table = mirrored(origin.table, origin.vehicle, signs)
        found, out = losses(table, origin.vehicle)
        inside = np.zeros(len(table.time), bool)
        inside[origin.part] = True
        evidence["flown"] += _peaks(out, inside, table.dt)
        flown = {key: flown[key] + more for key, more in (("flights", 1), ("hours", _hours(table)), ("alarms", len(found)))}
        alarms += [_line(flight.name, image, e) for e in found]
    return _Part({**row, **_rate(row["alarms"], row["hours"])}, flown, firsts, evidence, alarms)


def describe(result: dict[str, Any]) -> str:
    """The result of `false_alarms` as text of at most 80 columns."""

    def line(name, count, hours, r):
        return f"{name[:30]:<30} {hours:7.2f} h {count:6d}   {r['rate']:7.2f}   {r['low']:7.2f} to {r['high']:.2f}"

    head = f"{'':<30} {'assessed':>9} {'alarms':>6} {'per hour':>9}   95 % interval"
    total, flown = result["total"], result["flown"]
    lines = [f"False alarms on surrogates of healthy flights (promised: {total['promised']} per hour)", "", head]
    lines += [line(r["flight"], r["alarms"], r["hours"], r) for r in result["table"]]
    lines += [line("all", total["alarms"], total["hours"], total), "", "First alarm of a flight, by threshold", head]
    for r in result["thresholds"]:
        lines.append(line(f"{r['shift']:+.0f} nats" if r["shift"] else "as it is", r["first_alarms"], r["hours"], r))
    lines += ["", "Evidence for a fault: nats above the threshold, largest in 5 s (50, 90, 99 %)"]
    lines += [f"{k:<30} " + " ".join(f"{q:8.1f}" for q in v) for k, v in result["evidence"].items()]
    lines += ["", "The flights themselves, as flown and with yaw mirrored", head]
    return "\n".join([*lines, line(f"{flown['flights']} flights", flown["alarms"], flown["hours"], flown)])


def _peaks(out, inside: np.ndarray, dt: float) -> list[float]:
    """The largest evidence in every 5 s of the ticks `inside`, up to the first alarm: nats above the threshold."""
    ticks_ = np.flatnonzero(inside)
    if out.announced.any():
        ticks_ = ticks_[ticks_ <= np.argmax(out.announced)]
    size = round(PEAK_S / dt)
    whole = out.statistic[ticks_[: len(ticks_) // size * size]].reshape(-1, size)
    return whole.max(axis=1).tolist()


def _hours(table: Ticks) -> float:
    return float((table.mode == ASSESS).sum() * table.dt / 3600.0)


def _rate(count: int, hours: float) -> dict:
    """Events per hour and the exact 95 % interval of a Poisson rate (Garwood, Biometrika 28, 1936)."""
    interval = tools.rate(count, max(hours, 1e-12))
    assert interval is not None
    return {"rate": interval["value"], "low": interval["low"], "high": interval["high"]}


def _line(name: str, what: str, e) -> dict:
    return {
        "flight": name,
        "what": what,
        "detected_s": e.detected_s,
        "rotors": list(e.rotors),
        "alternatives": [list(a) for a in e.alternatives],
        "loss": list(e.loss),
    }


def _first_alarms(table: Ticks, vehicle: Vehicle, out) -> dict[float, float | None]:
    """Seconds of assessed flight up to the first alarm, None without one, for each of SHIFTS."""
    assessed_s = np.cumsum(table.mode == ASSESS) * table.dt

    def first(flag) -> float | None:
        return float(assessed_s[np.argmax(flag)]) if flag.any() else None

    result = {}
    for shift in SHIFTS:
        # Without evidence above a threshold there is no alarm: only where there was, the diagnoser is run again.
        same = not shift or not (out.announced.any() if shift > 0 else crossed(table, out, shift).any())
        result[shift] = first(out.announced if same else announced(table, vehicle, shift))
    return result


def crossed(table: Ticks, out, shift: float) -> np.ndarray:
    """(T,) bool: the recorded evidence for a fault is above the shifted threshold."""
    hyp = list_hypotheses(out.theta.shape[1])
    evidence = np.logaddexp.reduce(out.log_odds[:, hyp.fault], axis=1)
    return (evidence > program.threshold(hyp.n, table.dt) + shift) & (table.mode == ASSESS)


def announced(table: Ticks, vehicle: Vehicle, shift: float) -> np.ndarray:
    """(T,) bool: announcements with the threshold `shift` nats higher."""
    B = vehicle.effectiveness()
    steps = program.steps(table.dt, B, (vehicle.identified or {}).get("dynamics"))
    steps.raise_threshold(shift)
    return steps.run(*program.inputs(table, B)).announced
