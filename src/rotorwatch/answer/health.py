"""The health of every rotor: a grade of its loss, and whether and how fast the loss grows.

Grades are of the 95 % interval of the loss, not of its middle: one that spans two grades gets both, one that spans more gets none. The
trend is of the residual wrench, per hover thrust, on roll, pitch and yaw,

    z = (b + B T theta) / mean T,      growth of rotor i's loss by s a minute:  dz/dt = s B_i T_i / mean T

b, theta: biases and losses as estimated, T: thrusts commanded; dividing by the mean removes a sagging battery, and thrust itself, which
battery and air change for all rotors alike, is left out. The slopes d of z and their variances are those of `answer/trend.py`, over
block means since the last event, take-off or knock: a step is no trend. For each rotor s is weighted least squares on d. A drift is a
rotor's when it lies along that rotor's direction, and along no other's; wind and a shifting load point anywhere, and a drift of no single
rotor is "unclear". Intervals are for all rotors at once (Scheffe): with d within its 95 % ellipsoid about 0, none shows a trend.

Source of the aim: Zhang, Zhang, Li, Qin and Xu, ATSUKF-based actuator health assessment method for quad-copter unmanned aerial vehicles,
Drones 7 (2023) 12, section 2.2: a loss of 0 is healthy, of 1 failed, anything between partly degraded; it prints no scale between them.
Intervals: H. Scheffe, A method for assessing all contrasts in the analysis of variance, Biometrika 40 (1953) 87-104.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.answer import trend as line
from rotorwatch.answer.wording import SCALE
from rotorwatch.engine.estimator.plant import USUAL_S
from rotorwatch.engine.intake.ticks import CARRIES
from rotorwatch.engine.motion.tick_table import ASSESS, Ticks
from rotorwatch.flight.diagnosis import Event, Trend

UNGRADED = "not assessed"
LEAST_S = 30.0  # of flight, below which no trend is estimated
BLOCKS = 40  # at most
LEAST_THRUST = 0.05  # hover thrusts: a rotor commanded less shows nothing
ALIKE = 0.95  # cosine of the drifts of two rotors, above which a growing loss of one cannot be distinguished from one of the other
CHI2_3, CHI2_2 = 7.815, 5.991  # 95 % of chi-squared with 3 and 2 degrees of freedom


def grade(low: float, high: float, trend: Trend | None = None) -> str:
    """'worn' of a loss between low and high; 'healthy to worn' where it may be either, 'not assessed' where it may be more. trend: adds the
    growth that no loss includes yet."""
    beyond = trend.beyond if trend else (0.0, 0.0)
    ends = (min(max(bound + extra, 0.0), 1.0) for bound, extra in zip((low, high), beyond))
    first, last = (sum(loss >= least for _, least in SCALE) - 1 for loss in ends)
    names = [name for name, _ in SCALE[first : last + 1]]
    return names[0] if len(names) == 1 else f"{names[0]} to {names[1]}" if len(names) == 2 else UNGRADED


def trends(out, table: Ticks, B: np.ndarray, found: Sequence[Event]) -> tuple[Trend | None, ...]:
    """The trend of each rotor's loss since the last event; None where it cannot be estimated.

    out: the estimator's stacked outputs (theta (T, n), biases (T, 4)); B (4, n): effectiveness; found: events of the flight."""
    nothing = (None,) * B.shape[1]
    use = (table.mode == ASSESS) & table.valid[:, :3].all(axis=1) & ~table.upset
    use &= (table.time >= _steady_from(table, found)) & (table.thrust.mean(axis=1) > CARRIES)
    rows = np.flatnonzero(use)
    if rows.size < line.LEAST or table.time[rows[-1]] - table.time[rows[0]] < LEAST_S:
        return nothing
    time, T = table.time[rows], table.thrust[rows]
    wrench = (out.biases[rows] + (T * out.theta[rows]) @ B.T)[:, :3]
    count = int(min(BLOCKS, rows.size // 2))
    step = (time[-1] - time[0] + table.dt) / count
    block = np.minimum(((time - time[0]) / step).astype(int), count - 1)
    size = np.bincount(block, minlength=count)
    some = size >= 0.5 * size.max()
    if some.sum() < line.LEAST:
        return nothing

    def mean(values):
        return np.bincount(block, values, minlength=count)[some] / size[some]

    usual = mean(T.mean(axis=1))
    when, minutes = (mean(time) - time[0]) / 60.0, float(time[-1] - time[0]) / 60.0
    z = np.column_stack([mean(w) / usual for w in wrench.T])
    slopes = line.slopes(when, z, step / 60.0)
    theta, early = out.theta[rows], slice(0, max(1, rows.size // 4))
    # A rotor that compensates theta is commanded T = c / (1 - theta), and T theta grows by T^2 / c times the growth of theta.
    need = np.maximum((T[early] * (1.0 - theta[early])).mean(axis=0), LEAST_THRUST)
    columns = B[:3] * (np.maximum(T.mean(axis=0), LEAST_THRUST) ** 2 / need / T.mean())
    d, sd = np.array([s.slope for s in slopes]), np.array([s.sd for s in slopes])
    left = (z - z.mean(axis=0) - np.outer(when - when.mean(), d)) / sd
    scatter = (left @ (columns / sd[:, None])).std(axis=0) / ((columns / sd[:, None]) ** 2).sum(axis=0)
    weak, known = (theta > 0.0).any(axis=0), theta[-1] - theta[0]
    span = float(time[0]), float(time[-1])
    each = zip(_per_rotor(d, sd, columns, weak), weak, known, scatter)
    rests = T.mean(axis=0) < LEAST_THRUST
    return tuple(
        None if row is None or rests[i] else _trend(row, minutes, span, w, float(k), float(s)) for i, (row, w, k, s) in enumerate(each)
    )


def _trend(row, minutes: float, span, weak: bool, known: float, scatter: float) -> Trend:
    """The trend of a rotor: growth s a minute with its interval, of which `known` is in the estimated loss; a loss changes by 1 at most."""
    s, reach, word = row
    low, high = max(s - reach, -1.0 / minutes), min(s + reach, 1.0 / minutes)
    if not weak:
        high = max(high, 0.0)  # a rotor without a loss cannot recover
    word = word or ("growing" if low > 0.0 else "shrinking" if high < 0.0 else "no trend")
    if word == "unclear":
        low, high = min(low, 0.0), max(high, 0.0)
    most = high * minutes
    if word == "no trend":  # weather that masks a growth would have to mirror it: the interval is taken as it is
        most = min(most, max(s, 0.0) * minutes + 2.0 * scatter)
    beyond = max(low * minutes - known, 0.0), max(most - max(known, 0.0), 0.0)
    return Trend(float(min(max(s, low), high)), (float(low), float(high)), span[0], span[1], word, beyond)


def _steady_from(table: Ticks, found: Sequence[Event]) -> float:
    """Start of the data without any step, landing or knock [s]."""
    marks = [t for e in found for t in (e.detected_s, e.end_s) if t is not None]
    assessed = np.flatnonzero(table.mode == ASSESS)
    for k in np.flatnonzero((table.mode[1:] == ASSESS) & (table.mode[:-1] != ASSESS)) + 1:
        marks.append(float(table.time[k]))
    marks.append(float(table.time[assessed[0]]) if assessed.size else 0.0)
    last = float(table.time[assessed[-1]]) if assessed.size else 0.0
    return max(t for t in marks if t <= last or t == marks[-1]) + USUAL_S


def _per_rotor(d: np.ndarray, sd: np.ndarray, columns: np.ndarray, weak: np.ndarray) -> list:
    """(growth, reach of its interval, word or None) of each rotor, or None where it cannot be estimated, for a drift d (3,) with deviations
    sd. columns (3, n): drift by growth of 1; weak (n,): rotors with a loss, which may recover."""
    y, A = d / sd, columns / sd[:, None]
    information = np.maximum((A**2).sum(axis=0), 1e-12)
    alone = A.T @ y / information
    reach = np.sqrt(CHI2_3 / information)
    if y @ y <= CHI2_3:
        return [(s, r, None) for s, r in zip(alone, reach)]
    rest = ((y[:, None] - A * alone) ** 2).sum(axis=0)
    mine = np.flatnonzero((rest < CHI2_2) & ((alone > 0.0) | weak))
    if mine.size != 1:
        return [(s, r, "unclear") for s, r in zip(alone, reach)]
    i, out = int(mine[0]), []
    for j in range(len(alone)):
        alike = abs(A[:, i] @ A[:, j]) / np.sqrt(information[i] * information[j])
        if j == i:
            out.append((alone[i], reach[i], None))
        elif alike > ALIKE:
            out.append(None)
        else:
            pair = A[:, [i, j]]
            covariance = np.linalg.inv(pair.T @ pair)
            out.append(((covariance @ pair.T @ y)[1], np.sqrt(CHI2_3 * covariance[1, 1]), None))
    return out
