"""Which rotor is out of balance: against the others, against earlier flights, against the same flight before.

Others. What balancing leaves of an unbalance is a vector in the propeller's plane; with two independent normal components its square is
exponential, and of n rotors of one make the square of one over the mean square of the others is F(2, 2 (n - 1)), whose tail is
P(F > f) = (1 + f / (n - 1))^-(n - 1). A rotor is out of balance where that is rarer than UNLIKE shared by the n rotors, and where it shakes
the vehicle by more than SHAKES.

Earlier flights. The logarithm of a rotor's figure scatters from flight to flight by about SCATTER (one quadrotor, 23 flights: 11 to 19 %);
that counts as WORTH flights, and the flights' own scatter updates it, so that a new figure has Student's t distribution. A rotor is out of
balance where its figure is higher than all but FALSE of these, and unlike the others: above STANDS times their median. (A rotor that was
the best balanced one and now is like the others needs no work. One in four balanced rotors is above STANDS, by the model of the others:
of four, the two conditions together are met by FALSE of the healthy flights.)

The same flight. The logarithm of the amplitude is a + b ln w + d [t >= tau], by least squares for every tau: b takes up how the frame's
resonance follows the speed. The rotor became out of balance at the tau of the largest d over its standard deviation (a generalised
likelihood ratio: Basseville and Nikiforov, Detection of abrupt changes, 1993, section 2.4.3), where that exceeds STEP_SD and the figure
after it is STANDS times the one before, after what the other rotors' changed by is taken off: a sensor that came loose is no rotor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.events.losses import WITHIN_95
from rotorwatch.stats.tails import student_cdf
from rotorwatch.witnesses.balance.imbalances import MICRO, Figure, Heard, history, independence, mean

FALSE = 0.01  # of healthy flights have a finding against earlier ones: a notice that asks for a look at a propeller
UNLIKE = 0.0002  # of healthy vehicles have one against their others, in every flight; with 0.001 two of 700 whose frames scatter had one
SHAKES = 4.9  # m/s^2, mean over time: below it PX4's Flight Review calls vibration low (green)
SCATTER, WORTH = 0.15, 4.0
STANDS = 1.5
STEP_SD = 5.0
SIDEBANDS = 0.25  # of what another rotor got at the same time: less may be the sidebands of a tone whose speed is not known well enough
MOST_BLOCKS = 400  # of windows, for the search of a step
SIDE = 8  # blocks on each side of a step
STEADY = 1e-3  # standard deviation of the logarithm of the speed, below which a dependence on it is not fitted
LEAST_AFTER_S = 2.0  # a knock shakes for a second or two


class Finding(NamedTuple):
    """A rotor that is, or became, out of balance. rotors: more than one where their speeds are too alike to tell which. onset, certain: s,
    of a change in flight; None where it was there from take-off. times: how much more than in `against`: others, flights or before."""

    rotors: tuple[int, ...]
    figure: Figure
    times: float
    against: str
    onset: float | None = None
    certain: float | None = None
    probability: float = 1.0


def findings(found: Heard, earlier: Sequence[Mapping[str, Any]] = ()) -> list[Finding]:
    """The rotors that are out of balance in what a flight's sensor hears; earlier: figures of healthy flights of the vehicle."""
    n = len(found.figures)
    past = history(earlier, found.channel.unit, n)
    made: list[Finding] = []
    steps = _steps(found)
    for k, figure in enumerate(found.figures):
        if figure is None or figure.together[0] != k + 1:
            continue
        others = list({f.together: f.value for f in found.figures if f is not None and f.together != figure.together}.values())
        one = (
            steps.get(k) or _against_flights(figure, past[k], others) or (None if past[k].size else _against_others(found, figure, others))
        )
        made += [one] if one else []
    return made


def _against_others(found: Heard, figure: Figure, others: Sequence[float]) -> Finding | None:
    if len(others) < 2 or not found.channel.accel or len(figure.together) > 1:
        return None
    size = len(others)
    rms = float(np.sqrt(np.mean(np.square(others))))
    least = figure.low / max(rms, figure.noise, 1e-9)
    p = (1.0 + least**2 / size) ** -size
    if p >= UNLIKE / (size + 1) or figure.value / MICRO * figure.speed**2 < SHAKES:
        return None
    return Finding(figure.together, figure, figure.value / max(rms, 1e-9), "others", probability=1.0 - p)


def _against_flights(figure: Figure, past: np.ndarray, others: Sequence[float]) -> Finding | None:
    if not past.size or not others or len(figure.together) > 1:
        return None
    floor = max(figure.noise, 1e-9)
    logs = np.log(np.maximum(past, floor))
    own = float(np.square(logs - logs.mean()).sum()) if logs.size > 1 else 0.0
    dof = WORTH + logs.size - 1.0
    measured = np.log(max(figure.value, floor) / max(figure.low, 0.1 * figure.value, 1e-9)) / WITHIN_95
    sd = float(np.sqrt((WORTH * SCATTER**2 + own) / dof * (1.0 + 1.0 / logs.size) + measured**2))
    higher = float(np.log(max(figure.value, floor)) - logs.mean())
    p = 1.0 - student_cdf(higher / sd, dof)
    like = max(float(median(np.array(others))), floor)
    if p >= FALSE or figure.value < STANDS * like:
        return None
    return Finding(figure.together, figure, float(np.exp(higher)), "flights", probability=1.0 - p)


def _steps(found: Heard) -> dict[int, Finding]:
    """Rotors (from 0) whose figure rose in flight."""
    at = {k: step for k in range(len(found.figures)) if (step := _step(found, k)) is not None}
    made: dict[int, Finding] = {}
    for k, (onset, certain) in at.items():
        rises = {r: rise(found, r, onset) for r in range(len(found.figures))}
        own = rises.pop(k)
        rest = [one[0] for one in rises.values() if one is not None]
        figure = found.figures[k]
        if own is None or figure is None:
            continue
        grown, _, after = own
        common = max(float(median(np.array(rest))), 0.0) if rest else 0.0
        most = max(map(gained, rises.values()), default=0.0)
        if grown - common < np.log(STANDS) or gained(own) < SIDEBANDS * most:
            continue
        made[k] = Finding(figure.together, after, float(np.exp(grown)), "before", onset, certain)
    return made


def gained(change: tuple[float, Figure, Figure] | None) -> float:
    """Amplitude that a rotor got by a `rise`."""
    return 0.0 if change is None else change[2].value * float(np.sqrt(max(1.0 - np.exp(-2.0 * change[0]), 0.0)))


def _step(found: Heard, k: int) -> tuple[float, float] | None:
    """(onset, certain) s of a lasting rise of a rotor's amplitude; None without."""
    rows = np.flatnonzero(found.used[:, k])
    each = -(-len(rows) // MOST_BLOCKS)
    count = len(rows) // max(each, 1)
    if count < 2 * SIDE:
        return None
    rows = rows[: count * each].reshape(count, each)
    w = found.windows
    total = (w.power[rows, 0, k] + w.noise[rows, 0, k]).mean(axis=1)
    y = 0.5 * np.log(np.maximum(total, 1e-30))
    x = np.log(w.speed[rows, k].mean(axis=1))
    x = x - x.mean()
    ones = np.ones((count, 1))
    q = np.linalg.qr(np.hstack([ones, x[:, None]]) if x.std() > STEADY else ones)[0]
    steps = (np.arange(count) >= np.arange(SIDE, count - SIDE + 1)[:, None]).astype(float)  # (candidates, count)
    left = y - q @ (q.T @ y)
    clear = steps - (steps @ q) @ q.T
    size = np.maximum(np.square(clear).sum(axis=1), 1e-12)
    rise = clear @ left / size
    residual = np.maximum(float(left @ left) - rise**2 * size, 1e-12)
    sd = np.sqrt(residual / (count - q.shape[1] - 1) / size)
    best = int(np.argmax(rise / sd))
    rest = left - rise[best] * clear[best]
    t = rise[best] / sd[best] * np.sqrt(independence(rest))
    if t < STEP_SD:
        return None
    first = SIDE + best
    time = w.time[rows[:, 0]]
    if time[-1] - time[first] < LEAST_AFTER_S:
        return None
    scale = float(np.sqrt(np.square(rest).mean()))
    gone = np.cumsum((y - y[:first].mean())[first:]) / np.arange(1, count - first + 1)
    sure = gone / (scale * np.sqrt(1.0 / first + 1.0 / np.arange(1, count - first + 1))) >= STEP_SD
    lasting = np.flatnonzero(sure & (time[first:] - time[first] >= LEAST_AFTER_S))
    certain = float(time[first + lasting[0]]) if lasting.size else float(time[-1])
    return float(time[first]), certain


def rise(found: Heard, k: int, onset: float) -> tuple[float, Figure, Figure] | None:
    """(logarithm of the figure after `onset` over the one before, both figures) of a rotor (from 0); None where too little was heard."""
    figure, w = found.figures[k], found.windows
    if figure is None:
        return None
    k = figure.together[0] - 1
    before, after = (found.used[:, k] & side for side in (w.time < onset, w.time >= onset))
    if min(before.sum(), after.sum()) < SIDE:
        return None
    squares = []
    for part in (before, after):
        back = 0.5 / len(figure.together) / found.channel.left(w.speed[part, k] / (2.0 * np.pi)) ** 2
        squares.append([MICRO * np.sqrt(max(v, 0.0)) for v in mean(w.power[part, 0, k] * back, w.noise[part, 0, k] * back)])
    least = max(squares[0][0], 0.5 * figure.noise, 1e-9)
    first, later = (
        figure._replace(value=value, low=low, high=high, windows=int(part.sum()))
        for (value, low, high), part in zip(squares, (before, after))
    )
    return float(np.log(max(squares[1][0], 1e-9) / least)), first, later


def described(one: Finding, unit: str, places: str) -> tuple[str, dict[str, Any]]:
    """(reason, extra) of a finding's event."""
    value = f"{one.figure.value:.2f} ({one.figure.low:.2f} to {one.figure.high:.2f}) {unit}"
    than = {"others": "that of the other rotors", "flights": "that of its earlier flights", "before": "that before"}[one.against]
    reason = f"the vibration once per turn of {places} is {one.times:.1f} times {than}: {value}"
    return reason, {"ratio": round(one.times, 2), "against": one.against}
