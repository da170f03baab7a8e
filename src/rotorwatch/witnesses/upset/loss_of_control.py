"""Loss of control: attitude or rates deviate from the commanded ones and do not return; or the vehicle falls without thrust.

Commanded ("wanted") is the autopilot's target: the direction of thrust (attitude_wanted), which aerobatics turn as well, or, without it,
the rates (rates_wanted). Where a log has neither, only an inverted vehicle counts as out of control.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.base.progress import portion
from rotorwatch.engine.intake.airborne import LEVER_M
from rotorwatch.engine.motion.air_spans import commands, output_range
from rotorwatch.engine.spin.turning import SPUN, SPUN_S
from rotorwatch.flight import Flight, Signal

# Degrees between the actual direction of thrust and any recent target, and for how long. Healthy vehicles of public logs,
# aerobatics and gusts of 18 m/s included, stay below 20 degrees, but for half a second of 57 in one manual flight.
ERROR_DEG, LASTS_S = 40.0, 0.4
AWAY_DEG, AWAY_S = 20.0, 2.0  # less, for longer: in public logs only vehicles that no longer follow their commands
LOST_S = 1.2  # control regained sooner was not lost: a knock or a hard turn that the vehicle recovered from
TUMBLED_DEG = 100.0  # two samples this far from all targets: it tumbled, however it came to rest
SPINS = 20.0  # rad/s of yaw, faster than anyone commands; SPUN is beyond the commanded rate
ANSWERS_S = 0.6  # within which a vehicle under control reaches the commanded attitude or rates
BLOCK = 1 << 16  # samples compared at a time
Progress = Callable[[float], object] | None
BACK = np.linspace(0.0, ANSWERS_S, 7)
TURNS_S, TURNED_RAD = 10.0, 0.2  # within which a vehicle turns to a commanded heading; accuracy of headings
RATE_ERROR = 6.0  # rad/s of roll or pitch between the commanded and the actual rate
OVER_DEG = 100.0  # of tilt, for logs without targets
BACK_DEG, BACK_S = 15.0, 2.0  # closer than this for this long: control has come back
MASTERED_S = 0.5  # the same, for a quick recovery before another turn: the vehicle was under control between them
FRESH_S = 0.5  # greatest age of a commanded attitude
FALLS, FALLS_S = 0.35, 0.25  # load factor [g] below which a vehicle falls, with outputs at idle for this long
SINKS_M_S, NEARLY_FULL = 4.0, 0.85  # down, with all outputs above this share of their range
REST = 0.015  # share of the range up to which an output is at idle
POWERED = 0.1  # share of the range of commands
HITS_G = 2.0  # g from the side or from above, twice as much from below: more than any rotor gives; an impact
# Soon after an impact on the ground a vehicle lies still for this long; its height does not fall on. Where the log ends sooner, the
# ground is assumed to have ended it.
RESTS_RAD_S, BIAS_RAD_S, RESTS_S, RESTS_SOON_S, CUT_S = 0.3, 3.0, 0.5, 5.0, 1.5
LAG_S, SOON_S, STAYS_S, FALLS_ON_M, DEAD_STILL, STRIKES_G = 0.4, 1.0, 3.0, 1.5, 0.03, 8.0
GONE_S = 2.0
HIT_S = 0.2  # a blow this soon after the onset is its cause
SHORT_S = 3.0  # length of a flight that ended in its take-off
LOW_M = 1.5  # above the place of take-off or rest: a blow there is the ground's
CRASHES_M_S, STOPS_M_S = 5.0, 1.0  # down before a blow, in any direction after: no landing, whatever the attitude
FAST_M_S, STAYS_M_S = 2.0, 0.3  # down before a blow, in any direction after it: a fall to the ground


class LossOfControl(NamedTuple):
    """onset: when the vehicle began to deviate from its target; lost: when that was certain; end: when control came back, else None;
    impact: the first blow after that, of the ground or of its own spin, else None; ground: when it hit the ground, None where unknown [all
    s]. what: in words. falls: outputs went to idle in the air. landed: it had landed before, so that the ground pushed it as well as its
    rotors."""

    onset: float
    lost: float
    end: float | None
    impact: float | None
    what: str
    falls: bool = False
    landed: bool = False
    ground: float | None = None


def thrust_axis(q: np.ndarray) -> np.ndarray:
    """(n, 3) body z axis in the world, of quaternions (n, 4) body to world."""
    w, x, y, z = q.T
    return np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)


def without_heading(q: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) body to world without their rotation about the world's vertical axis: the tilt in the vehicle's heading frame."""
    w, x, y, z = q.T
    c, s = w, -z  # the turn back, but for its length
    size = np.maximum(np.hypot(c, s), 1e-9)
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=1) / size[:, None]


def held(signal: Signal, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The last sample of all columns before each time, and its age [s]; infinite where there is none."""
    return _held(*known(signal), at)


def known(signal: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of the samples with all columns valid."""
    whole = signal.wholes()
    return whole.time, whole.values


def _held(time: np.ndarray, values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not time.size:
        return np.zeros((at.size, values.shape[1])), np.full(at.size, np.inf)
    k = np.searchsorted(time, at, side="right") - 1
    age = np.where(k >= 0, at - time[np.maximum(k, 0)], np.inf)
    return values[np.maximum(k, 0)], age


def attitude_error(flight: Flight, progress: Progress = None) -> tuple[np.ndarray, np.ndarray, str]:
    """Times (m,) s, angle (m,) in degrees between the actual and the commanded direction of thrust, and a phrase for that quantity.

    NaN where unknown. A difference of rates counts as the angle that it makes within LASTS_S. Where all are below AWAY_DEG, some may be
    overestimated."""
    if flight.has("attitude"):
        time, q = known(flight["attitude"])
        angle, words = np.full(time.size, np.nan), "tilted {:.0f} degrees from its setpoint"
        if flight.has("attitude_wanted"):
            angle = _angle(flight["attitude_wanted"], time, q, progress)
        if flight.has("rates_wanted") and flight.angular_rate() is not None:
            both = np.isnan(angle) & _known_rates(flight, time)
            rate = np.minimum(_rate_error(flight, time) / RATE_ERROR * ERROR_DEG, 90.0)
            angle = np.where(both, rate, angle)
        if np.isnan(angle).all():
            tilt = np.degrees(np.arccos(np.clip(thrust_axis(q)[:, 2], -1.0, 1.0)))
            angle, words = np.where(tilt > OVER_DEG, tilt, 0.0), "tilted by {:.0f} degrees"
        return time, np.where(_spins(flight, time), np.fmax(angle, 90.0), angle), words
    return np.empty(0), np.empty(0), ""


def _angle(wanted: Signal, time: np.ndarray, q: np.ndarray, progress: Progress = None) -> np.ndarray:
    """(m,) degrees between the direction of thrust, of attitudes (m, 4), and the nearest target of the last ANSWERS_S, as a vehicle follows
    with delay. NaN without a fresh target. A vehicle on its way to another heading leans as commanded in its own frame, while that target
    points elsewhere in the world: there the nearer of the two directions counts."""
    at, asked = known(wanted)
    # The check for a turn takes longest, and only reduces the angle: done only where that may matter.
    angle = _blockwise(lambda when, own: _nearest(at, asked, when, own), time, q, progress=portion(progress, 0.0, 0.5))
    if not (angle > AWAY_DEG).any():
        return angle
    headings = np.unwrap(heading(asked))
    tell = portion(progress, 0.5, 1.0)
    return _blockwise(lambda when, own: _nearest(at, asked, when, own, headings), time, q, progress=tell)


def _blockwise(work: Callable[..., np.ndarray], time: np.ndarray, *rows: np.ndarray, progress: Progress = None) -> np.ndarray:
    """work(time, *rows), in blocks of BLOCK times. progress: called with the finished share, 0..1."""
    parts = []
    for start in range(0, time.size, BLOCK):
        part = slice(start, start + BLOCK)
        parts.append(work(time[part], *(x[part] for x in rows)))
        if progress:
            progress(min(1.0, part.stop / time.size))
    return np.concatenate(parts) if parts else np.zeros(0)


def _nearest(at: np.ndarray, asked: np.ndarray, time: np.ndarray, q: np.ndarray, headings: np.ndarray | None = None) -> np.ndarray:
    least, fresh = np.full(time.size, -1.0), _held(at, asked, time)[1] <= FRESH_S
    turns = None if headings is None else _turns(at, headings, time, q)
    axis, level = thrust_axis(q), thrust_axis(without_heading(q))
    for back in BACK:
        was, age = _held(at, asked, time - back)
        cosine = (axis * thrust_axis(was)).sum(axis=1)
        if turns is not None:
            in_heading_frame = (level * thrust_axis(without_heading(was))).sum(axis=1)
            cosine = np.where(turns, np.maximum(cosine, in_heading_frame), cosine)
        least = np.where(age <= FRESH_S, np.maximum(least, cosine), least)
    return np.where(fresh, np.degrees(np.arccos(np.clip(least, -1.0, 1.0))), np.nan)


def heading(q: np.ndarray) -> np.ndarray:
    """(n,) rad by which quaternions (n, 4) body to world turn about the world's vertical axis."""
    return 2.0 * np.arctan2(q[:, 3], q[:, 0])


def _turns(at: np.ndarray, headings: np.ndarray, time: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(m,) bool: the heading of attitudes (m, 4) is one of the targets of the last TURNS_S, or between them."""
    if not at.size:
        return np.zeros(time.size, bool)

    def then(when: np.ndarray) -> np.ndarray:
        return headings[np.maximum(np.searchsorted(at, when, side="right") - 1, 0)]

    now = then(time)
    low, high = np.zeros(time.size), np.zeros(time.size)
    for back in np.arange(0.25, TURNS_S + 0.1, 0.25):
        before = then(time - back) - now
        np.minimum(low, before, out=low)
        np.maximum(high, before, out=high)
    apart = (heading(q) - now + np.pi) % (2.0 * np.pi) - np.pi
    return (apart > low - TURNED_RAD) & (apart < high + TURNED_RAD)


def _known_rates(flight: Flight, time: np.ndarray) -> np.ndarray:
    if flight.angular_rate() is None or not flight.has("rates_wanted"):
        return np.zeros(time.size, bool)
    return held(flight["rates_wanted"], time)[1] <= FRESH_S


def _rate_error(flight: Flight, time: np.ndarray) -> np.ndarray:
    """(m,) rad/s of roll and pitch between the actual rate and the nearest target of the last ANSWERS_S."""
    rates = held(cast(Signal, flight.angular_rate()), time)[0][:, :2]
    wanted = (held(flight["rates_wanted"], time - back)[0][:, :2] for back in BACK)
    return np.min([np.linalg.norm(rates - was, axis=1) for was in wanted], axis=0)


def _spins(flight: Flight, time: np.ndarray) -> np.ndarray:
    """(m,) bool: the vehicle yaws faster than anyone commands, or than commanded for long."""
    if (turning := flight.angular_rate()) is None:
        return np.zeros(time.size, bool)
    at, rates = known(turning)

    def yaw(when: np.ndarray) -> np.ndarray:
        rate, age = _held(at, rates[:, 2:], when)
        return np.where(age <= FRESH_S, np.abs(rate[:, 0]), 0.0)

    speed = _blockwise(yaw, time)
    if flight.has("rates_wanted") and (speed > SPUN).any():
        asked, age = held(flight["rates_wanted"], time)
        speed = np.where((age <= FRESH_S) & (speed <= SPINS), speed - np.abs(asked[:, 2]), speed)
    return (speed > SPINS) | _long(time, speed > SPUN, SPUN_S)


def find(flight: Flight, air, progress: Progress = None) -> tuple[LossOfControl, ...]:
    """The losses of control of a flight, one at most in each of the intervals `air` ((start, end), ...) s in which it was in the air.
    progress: called with the finished share, 0..1."""
    time, angle, words = attitude_error(flight, progress)
    powered, losses = _powered(flight), []
    for start, end in _from_the_ground(powered, time, angle, air) or powered:
        spans = [
            _to_the_ground(flight, d, start, end)
            for d in (
                _departs(flight, time, angle, words, start, end),
                _falls(flight, start, end),
                _sinks(flight, start, end),
                _strikes(flight, start, end),
            )
            if d
        ]
        over = None if spans or not air else _turns_over(flight, powered, start, end)
        if spans or over:
            losses.append(over or min(spans, key=lambda d: d.onset))
    return tuple(losses)


def _to_the_ground(flight: Flight, d: LossOfControl, start: float, end: float) -> LossOfControl:
    """With the time at which the vehicle hit the ground, if it did."""
    if d.impact is None:
        return d
    at, until = d.impact - HIT_S, end + 30.0 if d.end is None else d.end
    while (blow := hit(flight, at + HIT_S, until)) is not None:
        if stops(flight, blow, start):
            return d._replace(ground=blow, end=d.end if _flies_again(flight, d.end, start) else None)
        at = blow
    return d


def _flies_again(flight: Flight, back: float | None, start: float) -> bool:
    """True if a vehicle that hit the ground, and is at its target again at `back` s, is airborne and not a wreck on the ground."""
    if back is None:
        return False
    above = (height(flight, back + later, start) for later in range(6))
    return any(m is not None and m > LOW_M for m in above)


def stops(flight: Flight, blow: float, start: float) -> bool:
    """True if a blow was an impact on the ground, of a vehicle that took off at `start`: its record ends there; or it lies still soon
    after; or it does not fall on, and lies still, stays below the height of take-off, or was hit harder than anything in the air does [all
    s]."""
    turning = flight.angular_rate()
    last = turning.time[-1] if turning is not None and len(turning) else flight.duration
    if last - blow < CUT_S:
        return True
    spread = np.zeros(0)
    if turning is not None:
        after = turning.between(blow + HIT_S, blow + RESTS_SOON_S)
        spread = _spreads(after.time[after.whole], after.values[after.whole])
    above = [height(flight, blow + later, start) for later in (LAG_S, LAG_S + SOON_S, LAG_S + SOON_S + STAYS_S)]
    if (spread < DEAD_STILL).any():
        return True
    if None in above:
        return bool((spread < RESTS_RAD_S).any())
    then, soon, later = (max(m or 0.0, 0.0) for m in above)  # after an impact the estimated height may be below the ground
    if max(then - soon, soon - later) > FALLS_ON_M:
        return False
    return soon < LOW_M and (later < LOW_M or bool((spread < RESTS_RAD_S).any()) or load(flight, blow) > STRIKES_G)


def load(flight: Flight, at: float) -> float:
    """The largest specific force in the tenth of a second after a time [g]; 0 where unknown."""
    part = flight["accel"].between(at, at + 0.1).values if flight.has("accel") else np.zeros((0, 3))
    return float(np.linalg.norm(part, axis=1).max(initial=0.0)) / G0


def _spreads(time: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """(k,) rad/s, for each window of RESTS_S: spread of the angular rates (n, 3) in it, independent of the gyro's bias; infinite where they
    exceed any bias."""
    edges = np.arange(time[0], time[-1] - RESTS_S, 0.5 * RESTS_S) if time.size else np.zeros(0)
    parts = [rates[slice(*np.searchsorted(time, (a, a + RESTS_S)))] for a in edges]
    known = [len(x) > 2 and np.abs(x).max() < BIAS_RAD_S for x in parts]
    return np.array([np.ptp(x, axis=0).max() if fine else np.inf for x, fine in zip(parts, known)])


def _from_the_ground(powered: list[tuple[float, float]], time: np.ndarray, angle: np.ndarray, air) -> tuple[tuple[float, float], ...]:
    """`air`, from the first command to the motors if the vehicle departed before it counted as in the air."""
    if not air:
        return ()
    (start, end), *later = air
    before = [a for a, b in powered if a < start <= b]
    left = before and (angle[(time >= before[0]) & (time <= start)] > ERROR_DEG).any()
    return ((before[0] if left else start, end), *later)


def _powered(flight: Flight) -> list[tuple[float, float]]:
    """Spans in which the motors of a vehicle that never flew were commanded: it may have turned over on the ground."""
    if not flight.has("motors"):
        return []
    time, share = commands(flight)
    on = np.concatenate([[False], share > POWERED, [False]])
    starts, stops = np.flatnonzero(on[1:] & ~on[:-1]), np.flatnonzero(~on[1:] & on[:-1]) - 1
    return [(float(time[a]), float(time[b])) for a, b in zip(starts, stops) if time[b] - time[a] > LASTS_S]


def _turns_over(flight: Flight, powered: list[tuple[float, float]], start: float, end: float) -> LossOfControl | None:
    """An inverted vehicle after a flight from `start` to `end` s while its motors still push: after a landing, or in its take-off."""
    if not flight.has("attitude"):
        return None
    until = max((b for a, b in powered if a <= end <= b), default=end)
    attitude = flight["attitude"].between(end, until)
    ok = attitude.whole
    t, up = attitude.time[ok], thrust_axis(attitude.values[ok])[:, 2]
    tilt = np.degrees(np.arccos(np.clip(up, -1.0, 1.0)))
    over = np.flatnonzero(tilt > OVER_DEG)
    if not over.size or until - t[over[0]] < LOST_S:
        return None
    k = int(over[0])
    return LossOfControl(
        _began(t, tilt, k), float(min(t[k] + LASTS_S, t[-1])), None, None, "turned over on the ground", landed=end - start > SHORT_S
    )


def _departs(flight, time, angle, words, start, end) -> LossOfControl | None:
    inside = slice(np.searchsorted(time, start), np.searchsorted(time, end + LASTS_S, side="right"))
    t, a = time[inside], angle[inside]
    if not (known_angle := np.isfinite(a)).all():
        t, a = t[known_angle], a[known_angle]
    if t.size < 3:
        return None
    out = (a > ERROR_DEG) | _long(t, (a > AWAY_DEG) & (a <= ERROR_DEG))
    for k in np.flatnonzero(out & ~np.concatenate([[False], out[:-1]])):
        if t[k] > end:
            return None
        onset, back = _began(t, a, int(k)), _back(t, a, int(k))
        impact = hit(flight, onset, end + 30.0 if back is None else back)
        soon = _back(t, a, int(k), MASTERED_S)
        # A flight that ended at its take-off may have ended on its side.
        last = t[-1] if end - start > SHORT_S else time[np.isfinite(angle)][-1]
        lasts = (last if soon is None else soon) - t[k]
        if impact is not None and _ground(flight, impact, onset, start, end):
            return None
        until = t[-1] if soon is None else soon
        over = (a[k:] > TUMBLED_DEG) & (t[k:] <= until)
        if not (over[1:] & over[:-1]).any() and lasts < (LOST_S if impact is None or impact - onset <= HIT_S else LASTS_S):
            continue
        certain = np.flatnonzero(out[k:] & (t[k:] - t[k] >= LASTS_S))
        lost = float(t[k + certain[0]]) if certain.size else float(min(t[k] + LASTS_S, t[-1]))
        largest = float(a[k:][t[k:] <= (lost + 1.0 if back is None else back)].max())
        return LossOfControl(onset, lost, back, impact, words.format(largest))
    return None


def _long(t: np.ndarray, away: np.ndarray, seconds: float = AWAY_S) -> np.ndarray:
    """(m,) bool: the samples of every run of `away` that lasts so many seconds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], away, [False]])))
    lasting = np.zeros(away.size, bool)
    for a, b in zip(edges[::2], edges[1::2]):
        lasting[a:b] = t[b - 1] - t[a] >= seconds
    return lasting


def _began(t: np.ndarray, a: np.ndarray, k: int) -> float:
    """Onset of the angle's growth past APART_DEG at k: the last sample at this flight's usual error."""
    calm = a[: max(k - 5, 1)]
    usual = max(2.0, 3.0 * float(median(calm))) if calm.size > 5 else 2.0
    close = np.flatnonzero(a[:k] <= min(usual, 0.5 * ERROR_DEG))
    return float(t[close[-1]] if close.size else t[0])


def _back(t: np.ndarray, a: np.ndarray, k: int, lasts: float = BACK_S) -> float | None:
    """Time at which control came back: the begin of `lasts` s within BACK_DEG; None where the flight ends before."""
    length = BLOCK >> 6
    while True:  # mostly soon
        run = _lasting(t[k : k + length], a[k : k + length] < BACK_DEG, lasts)
        if run is not None or k + length >= t.size:
            return None if run is None else float(t[k + run[0]])
        length *= 4


def _lasting(time: np.ndarray, so: np.ndarray, seconds: float) -> tuple[int, int] | None:
    """(first, last) of the first run of samples for which `so` (m,) holds for that many seconds; None without any."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], so, [False]])))
    first, last = edges[::2], edges[1::2] - 1
    long = np.flatnonzero(time[last] - time[first] >= seconds)
    if not long.size:
        return None
    a, b = int(first[long[0]]), int(last[long[0]])
    return a, a + int(np.argmax(time[a : b + 1] - time[a] >= seconds))


def _falls(flight: Flight, start: float, end: float) -> LossOfControl | None:
    """Outputs that go to idle while nothing carries the vehicle."""
    if not flight.has("motors", "accel"):
        return None
    motors = _around(flight["motors"], start - 1.0, end + 5.0)
    share = _shares(flight, motors).max(axis=1)
    time, force = known(flight["accel"])
    near = slice(np.searchsorted(time, start), np.searchsorted(time, end + 5.0, side="right"))
    time, force = time[near], force[near]
    if not time.size or not motors.time.size:
        return None

    def falling(when: np.ndarray, force: np.ndarray) -> np.ndarray:
        k = np.searchsorted(motors.time, when, side="right") - 1
        rest = (share[np.maximum(k, 0)] < REST) & (k >= 0)
        return (np.linalg.norm(force, axis=1) / G0 < FALLS) & rest

    run = _lasting(time, _blockwise(falling, time, force), FALLS_S)
    if run is None:
        return None
    since, when = (float(time[at]) for at in run)
    quiet = motors.time[(share < REST) & (motors.time <= when) & (motors.time > since - 1.0)]
    onset = min(since, float(quiet[0])) if quiet.size else since
    return LossOfControl(onset, when, None, hit(flight, when, end + 30.0), "falling without thrust", True)


def _sinks(flight: Flight, start: float, end: float) -> LossOfControl | None:
    """A vehicle that sinks fast and continues to, while its rotors are commanded nearly full thrust."""
    if not flight.has("motors", "velocity", "accel"):
        return None
    velocity = flight["velocity"]
    inside = (velocity.time >= start) & (velocity.time <= end) & velocity.whole
    time, down = velocity.time[inside], velocity.values[inside, 2]
    motors = _around(flight["motors"], start - 1.0, end)
    share, age = held(replace(motors, values=_shares(flight, motors)), time)
    push, known = held(_around(flight["accel"], start - 1.0, end), time)
    full = (share.mean(axis=1) > NEARLY_FULL) & (age <= FRESH_S) & (-push[:, 2] < G0) & (known <= FRESH_S)
    run = _lasting(time, full & (down > SINKS_M_S), LASTS_S)
    if run is None:
        return None
    since, when = (float(time[at]) for at in run)
    slow = np.flatnonzero((time < since) & (down < 0.2 * SINKS_M_S))
    onset = float(time[slow[-1]]) if slow.size else since
    words = f"sinking at {down[time == when][0]:.0f} m/s though nearly full thrust was commanded"
    return LossOfControl(onset, when, None, hit(flight, when, end + 30.0), words)


def _strikes(flight: Flight, start: float, end: float) -> LossOfControl | None:
    """A vehicle that hits the ground faster than any landing, though its estimated attitude was at the target."""
    if not flight.has("velocity"):
        return None
    velocity = flight["velocity"].between(start, end + 3.0)
    time, down = velocity.time, np.where(velocity.valid[:, 2], velocity.values[:, 2], 0.0)
    at = start
    while (blow := hit(flight, at, end + 1.0)) is not None:
        before, after = (time > blow - 0.5) & (time <= blow), (time > blow + 0.5) & (time < blow + 2.5)
        struck = down[before].max() if before.any() else 0.0
        if struck > CRASHES_M_S and (np.abs(velocity.values[after]) < STOPS_M_S).all():
            # It may have been commanded to descend before.
            slow = np.flatnonzero((time < blow - HIT_S) & (down < 0.2 * struck))
            onset = float(time[slow[-1]]) if slow.size else start
            return LossOfControl(onset, blow, None, blow, f"striking the ground at {struck:.0f} m/s")
        at = blow + 0.5
    return None


def _around(signal: Signal, start: float, end: float) -> Signal:
    """The samples from the last one before `start` [s] up to `end`, for holding values in that time. A flight may have many hops."""
    first, stop = np.searchsorted(signal.time, start), np.searchsorted(signal.time, end, side="right")
    return signal.part(slice(max(int(first) - 1, 0), int(stop)))


def _shares(flight: Flight, motors: Signal) -> np.ndarray:
    """(n, rotors) commands as shares of their range; 0 where there is none."""
    low, high = output_range(flight)
    return np.where(motors.valid, np.clip((motors.values - low) / max(high - low, 1e-6), 0.0, 1.0), 0.0)


def hit(flight: Flight, start: float, end: float) -> float | None:
    """First time after `start` [s] with a force that neither rotors nor the vehicle's own spin make; None where there is none, or no
    accelerometer."""
    if not flight.has("accel"):
        return None
    part = flight["accel"].between(start, end)
    turning = flight.angular_rate()
    spin = None if turning is None else known(turning.between(start - FRESH_S, end + FRESH_S))
    for first in range(0, len(part), BLOCK):
        force = part.values[first : first + BLOCK] / G0  # 0 where unknown
        most = np.full(len(force), HITS_G)
        if spin is not None:
            rates, age = _held(*spin, part.time[first : first + BLOCK])
            most += np.where(age < FRESH_S, LEVER_M * np.sum(rates * rates, axis=1) / G0, 0.0)
        blow = (np.hypot(force[:, 0], force[:, 1]) > most) | (force[:, 2] > most) | (-force[:, 2] > HITS_G + most)
        if blow.any():
            return float(part.time[first + int(np.argmax(blow))])
    return None


def until_impact(flight: Flight, air, left: tuple[LossOfControl, ...]) -> tuple[tuple[float, float], ...]:
    """The intervals `air` ((start, end), ...) s, each cut where the vehicle fell to the ground, or tumbles or spins on out of control for
    `GONE_S`: outputs and motion after that are no evidence on its rotors."""
    cut = []
    for start, end in air:
        ends = [d.impact for d in left if d.impact is not None and start <= d.onset <= end and d.impact - d.onset > HIT_S]
        ends += [d.lost + GONE_S for d in left if d.impact is None and d.end is None and start <= d.onset <= end]
        down = _struck_ground(flight, start, end)
        ends += [down] if down is not None else []
        cut.append((start, min([end, *ends])))
    return tuple(cut)


def _struck_ground(flight: Flight, start: float, end: float) -> float | None:
    """Time at which the vehicle came down fast and stayed where it hit, whatever its motors did then; None without such."""
    if not flight.has("velocity"):
        return None
    velocity = flight["velocity"].between(start, end + 2.0)
    down, when = velocity.values[:, 2], velocity.time
    if not velocity.valid.all() or when.size < 3:
        return None
    at = start + 1.0
    while (blow := hit(flight, at, end)) is not None:
        before = (when > blow - 0.5) & (when < blow)
        after = (when > blow + 2.0) & (when < blow + 5.0)
        still = after.sum() > 2 and when[-1] > blow + 4.0 and np.abs(velocity.values[after]).max() < STAYS_M_S
        if before.any() and down[before].max() > FAST_M_S and still:
            return blow
        at = blow + 0.5
    return None


def height(flight: Flight, at: float, ground: float) -> float | None:
    """m above the vehicle's height at time `ground` [s]; None where not logged."""
    if not flight.has("position"):
        return None
    (now, then), age = held(flight["position"], np.array([at, ground]))
    return float(then[2] - now[2]) if (age < 2.0).all() else None


def low(flight: Flight, at: float, start: float) -> bool:
    """True if the vehicle, as far as is known, is no higher than LOW_M above its place of take-off."""
    above = height(flight, at, start)
    return above is not None and above < LOW_M


def _ground(flight, impact, onset, start, end) -> bool:
    """True if the vehicle deviated because it touched the ground: a landing, or tipping over after one."""
    if impact - onset > HIT_S or end - onset > 3.0:
        return False
    above = height(flight, onset, start)
    return end - onset < 1.0 if above is None else above < LOW_M
