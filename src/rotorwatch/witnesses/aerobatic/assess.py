"""Loss of effectiveness of a vehicle that never hovers, from its residual torque over seconds.

Windows become blocks of BLOCK_S: residual torque z (3,), thrust T (n,). A loss theta of rotor i since block j makes

    z_a = trim_a + slope_a (sum T - mean) + B_ai T_i theta [k >= j] + noise_a

Noise: as wide on each axis as the flight's own blocks scatter, with correlation ALIKE from block to block. The alternatives are steps of
the trim in any direction, as air and payload cause. Each onset of each rotor has its marginal likelihood ratio; their sum is compared with
the Shiryaev-Roberts threshold (engine/estimator/announcement.py), and must be CLEAR above that of the steps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.base.arrays import median
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.program import TickOutput, blank
from rotorwatch.engine.driver import observe
from rotorwatch.engine.estimator import hypotheses
from rotorwatch.engine.estimator.posterior import PLACES
from rotorwatch.engine.events.decisions import FALSE_ALARM_PERIOD_S
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, READY_KNOWN_S, Ticks
from rotorwatch.engine.motion.tick_table import LEARN as LEARNING
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.aerobatic.firmware import flown_by_rates
from rotorwatch.witnesses.aerobatic.response import EDGE_S, WINDOW_S, Response, respond

BLOCK_S = 1.0
LEAST_HZ = 100.0  # of motors and gyro, for two samples in a window
CARRIES = (0.5, 2.0)  # times the thrust of hover
HOVERING = 0.8  # share of ticks in the air for which a hovering flight is carried, and does not tumble
LEARN, LEARN_LEAST = 10, 4  # blocks for learning trim and scatter; of a short flight half, at least the second
FIRM = 10  # blocks before and after an onset
READY_S = LEARN_LEAST * BLOCK_S + 2.0 * EDGE_S  # in the air, before anything is assessed
ALIKE = 0.35  # correlation of successive blocks' noise: 0.1 to 0.75 in roll, 0.0 to 0.3 else (docs/aerobatic.md)
LOSS_SD, STEP_SD = 0.25, 0.08  # prior of a loss; of a step of the trim, full thrusts of a rotor
SCATTER, PRIOR_BLOCKS = ((0.3, 0.25, 0.2), 5.0)  # of the mean thrust: prior of the noise, and its weight in blocks
OUTLIER = 3.0  # standard deviations, from which a block counts less
LOOK_BACK = 60  # blocks
WHOLE = 0.9  # share of a block's windows that fly
NOTHING = -20.0  # the statistic without data
CURVE_SD = 0.2  # of theta (1 - theta): error by the assumed thrust curve, from linear to quadratic in the command


class Blocks(NamedTuple):
    """K blocks of a flight. start, end (K,) s; missing (K, 3); thrust (K, n)."""

    start: np.ndarray
    end: np.ndarray
    missing: np.ndarray
    thrust: np.ndarray


def blocks(seen: Response, air: Spans) -> Blocks:
    """The blocks of all flights ((start, end), ...) s, one after the other."""
    size, parts = round(BLOCK_S / WINDOW_S), []
    for start, end in air:
        first = int(np.searchsorted(seen.time, start))
        count = max(0, (int(np.searchsorted(seen.time, end)) - first) // size)
        rows = np.arange(first, first + count * size).reshape(count, size)
        rows = rows[seen.flies[rows].mean(axis=1) >= WHOLE]
        ends = seen.time[rows[:, -1]]
        parts.append((ends - BLOCK_S, ends, seen.missing[rows].mean(axis=1), seen.thrust[rows].mean(axis=1)))
    return Blocks(*(np.concatenate(column) for column in zip(*parts)))


class Weak(NamedTuple):
    """A rotor with a known loss from block `onset` up to block `end`; None: it still lasts."""

    rotor: int
    onset: int
    end: int | None = None


class Look(NamedTuple):
    """Result of the blocks up to the last: statistic (above 0: announced); rotor, onset (block) of the most likely loss; share (n,) of each
    rotor; loss, sd (n,) of the rotors known to be weak; most (n,): upper bound of each rotor's loss."""

    statistic: float
    rotor: int
    onset: int
    share: np.ndarray
    loss: np.ndarray
    sd: np.ndarray
    most: np.ndarray


def applies(flight: Flight, table: Ticks | None) -> bool:
    """True if a flight of these ticks does not hover: its rotors hardly ever carry its weight, or it tumbles, and its log is fast enough to
    show its rotation. Without any motion in the log, the firmware decides."""
    if not flight.has("gyro") or table is None:
        return flown_by_rates(flight)
    fast = min(flight[name].rate_hz for name in ("motors", "gyro")) >= LEAST_HZ
    up = table.mode > GROUND
    if not up.any() or not (fast or flown_by_rates(flight)):
        return False
    carried = table.thrust[up].mean(axis=1)
    hovers = (carried > CARRIES[0]) & (carried < CARRIES[1]) & ~table.upset[up]
    return float(hovers.mean()) < HOVERING


def decline(flight: Flight, why: str, vehicle: Vehicle | None = None) -> None:
    """Raise ConfigError where a method made for hover is applied to a flight that does not. why: end of the sentence; vehicle: as given,
    None: as the log names it."""
    if flown_by_rates(flight) or min((flight[n].rate_hz for n in ("motors", "gyro") if flight.has(n)), default=0.0) >= LEAST_HZ:
        craft = vehicle or airframes.identify(flight)
        if applies(flight, observe(flight, craft, airborne(flight), READY_KNOWN_S)):
            raise ConfigError(f"{named(flight)} does not hover: {why}")


def named(flight: Flight) -> str:
    """The log, as a sentence begins with it."""
    return flight.name or "The log"


def lacks(flight: Flight) -> tuple[str, ...]:
    """Sentences on signals that such a flight's log lacks and that the analysis needs; empty where it lacks none."""
    if flight.angular_rate() is not None:
        return ()
    return (
        "the log has no gyro, and a vehicle that does not hover is assessed by its angular motion; log the gyro (Betaflight: "
        "set blackbox_disable_gyro = OFF).",
    )


def learning(known: Blocks) -> int:
    """Number of blocks at the beginning of a whole flight from which trim and scatter are learned."""
    return min(LEARN, max(LEARN_LEAST, len(known.end) // 2))


def examine(known: Blocks, B: np.ndarray, variance: np.ndarray, weak: list[Weak], learn: int = LEARN) -> Look:
    """The blocks of a flight so far, of a vehicle with effectiveness B (4, n). variance (3,): of `scatter`; learn: as of `learning`."""
    z, T = known.missing, known.thrust
    K, n = T.shape
    precision = _precision(z, variance)
    shape = B[:3].T[None, :, :] * T[:, :, None]  # (K, n, 3): torque lost with the whole rotor
    # Trim and slope of each axis, and the known losses, are fitted with every hypothesis.
    total = T.sum(axis=1) - T.sum(axis=1).mean()
    X = np.zeros((K, 3, 6 + len(weak)))
    for a in range(3):
        X[:, a, 2 * a], X[:, a, 2 * a + 1] = 1.0, total
    for m, past in enumerate(weak):
        X[past.onset : past.end, :, 6 + m] = shape[past.onset : past.end, past.rotor]
    prior_precision = np.r_[[1e-3] * 6, np.full(len(weak), 1.0 / LOSS_SD**2)]
    Q = np.linalg.inv(np.einsum("kaq,ka,kap->qp", X, precision, X) + np.diag(prior_precision))
    fitted = Q @ np.einsum("kaq,ka,ka->q", X, precision, z)

    def since(x: np.ndarray) -> np.ndarray:
        return np.cumsum(x[::-1], axis=0)[::-1]

    # Information and moment of a signature from block j on, with the nuisance parameters projected out.
    weighted = precision[:, None, :] * shape
    left = z - X @ fitted
    information = since(np.einsum("kia,kia->ki", weighted, shape))
    crossed = since(np.einsum("kia,kaq->kiq", weighted, X))
    information -= np.einsum("kiq,qp,kip->ki", crossed, Q, crossed)
    moment = since(np.einsum("kia,ka->ki", weighted, left))
    ratio, size = _ratio(moment, information, LOSS_SD)
    active = {past.rotor for past in weak if past.end is None}
    for i in range(n):  # for a weak rotor, the hypothesis is recovery
        wrong = size[:, i] > 0.0 if i in active else size[:, i] < 0.0
        ratio[wrong, i] = np.minimum(ratio[wrong, i], -5.0)
    steps = since(precision)
    crossed = since(precision[:, :, None] * X)
    steps -= np.einsum("kaq,qp,kap->ka", crossed, Q, crossed)
    other = _ratio(since(precision * left), steps, STEP_SD)[0].sum(axis=1)
    first, last = max(learn // 2, K - LOOK_BACK), K - 1
    ratio, other = ratio[first:last], other[first:last]
    each = np.logaddexp.reduce(ratio, axis=0)
    limit = np.log(FALSE_ALARM_PERIOD_S / BLOCK_S * n)
    fault = float(np.logaddexp.reduce(each))
    statistic = min(fault - limit, fault - float(np.logaddexp.reduce(other)) - hypotheses.CLEAR)
    rotor = int(np.argmax(each))
    loss, sd = np.zeros(n), np.zeros(n)
    for m, past in enumerate(weak):
        if past.end is None:
            loss[past.rotor], sd[past.rotor] = np.clip(fitted[6 + m], 0.0, 1.0), np.sqrt(Q[6 + m, 6 + m])
    share = np.exp(each - each.max())
    onset = first + int(np.argmax(ratio[:, rotor]))
    return Look(statistic, rotor, onset, share / share.sum(), loss, sd, _most(moment, information))


def _most(moment: np.ndarray, information: np.ndarray) -> np.ndarray:
    """(n,) upper end of 95 % intervals, the largest of all onsets with FIRM blocks before and after them, or a third of all blocks."""
    edge = min(FIRM, len(moment) // 3)
    known = np.maximum(information[edge : len(moment) - edge], 1e-9)
    size = np.maximum(moment[edge : len(moment) - edge] / known, 0.0)
    return np.minimum((size + WITHIN_95 / np.sqrt(known)).max(axis=0), 1.0)


def scatter(known: Blocks) -> np.ndarray:
    """(3,) noise variance of a block, from differences of neighbours, which steps do not widen, and a prior."""
    change = np.diff(known.missing, axis=0)
    seen = (1.4826 * median(np.abs(change), axis=0)) ** 2 / (2.0 * (1.0 - ALIKE)) if len(change) else np.zeros(3)
    expected = (np.array(SCATTER) * known.thrust.mean()) ** 2
    return (len(change) * seen + PRIOR_BLOCKS * expected) / (len(change) + PRIOR_BLOCKS)


def _precision(z: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(K, 3) weight of each block and axis; less for outliers."""
    far = ((z - median(z, axis=0)) ** 2 / variance).max(axis=1)
    return np.minimum(1.0, OUTLIER**2 / np.maximum(far, 1e-9))[:, None] / (variance * (1.0 + ALIKE) / (1.0 - ALIKE))


def _ratio(moment: np.ndarray, information: np.ndarray, sd: float) -> tuple[np.ndarray, np.ndarray]:
    """Log marginal likelihood ratio of a signature whose size is N(0, sd^2), and its size."""
    total = np.maximum(information, 0.0) + 1.0 / sd**2
    return 0.5 * moment**2 / total - 0.5 * np.log(total * sd**2), moment / total


def estimate(flight: Flight, vehicle: Vehicle, air: Spans, table: Ticks) -> tuple[Ticks, TickOutput]:
    """The ticks `table` as used here, and the outputs at them, in the default estimator's form. Where the flight is too short, or its
    motion does not respond to its outputs, no tick is assessed."""
    B = vehicle.effectiveness()
    out, seen = blank(len(table.time), list_hypotheses(B.shape[1])), respond(flight, vehicle, air)
    out.statistic[:], out.detectable[:] = NOTHING, 1.0 / WITHIN_95
    known = None if seen is None else blocks(seen, air)
    if known is None or len(known.end) <= LEARN_LEAST:
        return _observed(table, air, np.inf), out
    learn = learning(known)
    _follow(out, known, table, B, learn)
    return _observed(table, air, known.end[learn]), out


def _observed(table: Ticks, air: Spans, since: float) -> Ticks:
    """The ticks whatever the attitude and rates, without knocks and thrust; assessed from `since` s on."""
    mode = np.full(len(table.time), GROUND, np.int32)
    for start, end in air:
        mode[(table.time >= start) & (table.time <= end)] = LEARNING
        mode[(table.time > max(start + EDGE_S, since)) & (table.time <= end)] = ASSESS
    nothing, turns = np.zeros(len(table.time), bool), np.array([True, True, True, False])
    valid = (mode > GROUND)[:, None] & turns & (True if table.seen is None else table.seen[:, None])
    return replace(table, mode=mode, upset=nothing, contact=None, contacts=(), valid=valid)


def _follow(out: TickOutput, known: Blocks, table: Ticks, B: np.ndarray, learn: int) -> None:
    """Examine block by block; known losses carry over landings."""
    weak: list[Weak] = []
    variance = scatter(known)
    for k in range(learn, len(known.end)):
        first = int(np.searchsorted(table.time, known.end[k]))
        so_far = Blocks(*(x[: k + 1] for x in known))
        now = examine(so_far, B, variance, weak, learn)
        out.statistic[first:] = now.statistic
        if now.statistic > 0.0 and first < len(table.time):
            active = {fault.rotor for fault in weak if fault.end is None}
            over = [fault for fault in weak if fault.end is None and fault.rotor == now.rotor]
            weak = [fault for fault in weak if fault not in over]
            weak += [fault._replace(end=now.onset) for fault in over] or [Weak(now.rotor, now.onset)]
            age = np.searchsorted(table.command_time, (known.end[k], known.start[now.onset]))
            _announce(out, first, now, active, float(age[0] - age[1]))
            now = examine(so_far, B, variance, weak, learn)
        out.theta[first:], out.detectable[first:] = now.loss, now.most / WITHIN_95
        out.theta_sd[first:] = np.sqrt(now.sd**2 + (CURVE_SD * now.loss * (1.0 - now.loss)) ** 2)
    for k in np.flatnonzero(table.restart):  # losses that still last at a take-off are announced again for that flight
        if out.active[k, 0].any():
            out.announced[k], out.onsets[k:] = True, np.arange(len(table.time) - k)[:, None]


def _announce(out: TickOutput, first: int, now: Look, active: set[int], age: float) -> None:
    """Write that a rotor fails, or that one of the `active` ones works again, `age` ticks before the tick `first`."""
    rows = slice(first, None)
    sets, share = [active ^ {now.rotor}], [now.share[now.rotor]]
    if now.rotor not in active:  # the alternatives to this rotor
        others = [int(i) for i in np.argsort(-now.share) if i != now.rotor and i not in active][: PLACES - 1]
        sets, share = [*sets, *(active | {i} for i in others)], [*share, *now.share[others]]
    out.announced[first], out.best[rows] = True, now.rotor
    out.probability[rows] = 0.0  # simultaneous losses of two rotors are not tested
    out.probability[rows, : now.share.size] = now.share
    out.active[rows], out.share[rows] = False, 0.0
    for place, (rotors, p) in enumerate(zip(sets, share)):
        out.active[rows, place, sorted(rotors)] = True
        out.share[rows, place] = p / sum(share)
    out.onsets[rows] = (age + np.arange(len(out.onsets) - first))[:, None]
