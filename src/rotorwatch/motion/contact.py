"""Knocks: forces and torques on the vehicle that its rotors cannot make, whatever became of them.

Rotors push along the body's axis and turn it with what they push. A sideways force that begins within a tick, a lift that nobody
commanded, or an angular acceleration beyond what the commands and the loss of any two rotors explain comes from outside: another
vehicle, an obstacle, the ground. What follows - tumbling, saturated outputs, a bent arm - must not be read as the loss of a rotor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

G0 = 9.80665
SIDEWAYS, UPWARD = 0.5, 0.8  # g, against the half second before; drag and gusts change by less than 0.2 g in a tick
BEFORE_S = 0.5
SHAKES = 2.5  # ... and so many times the vibration: sampled slowly, it looks at times like a steady push
# Hover thrusts for each rad/s^2 and rotor that a small vehicle (arms of 5 cm) takes in roll, pitch and yaw: none turns for less.
LEAST_GAIN = np.array([0.0015, 0.0015, 0.03])
TURNS = 5.0  # rad/s^2, in the same tick or the one before: what hits a vehicle turns it as well, vibration does not
TOGETHER_S = 1.0  # knocks within that are one


@dataclass(frozen=True)
class Contact:
    """time s; size: of the force in g, or of the torque in hover thrusts of one rotor; unit says which; what: in words."""

    time: float
    size: float
    unit: str
    what: str


@dataclass
class Shaken:
    """What `vibration` goes on with: sum and number of the squares so far, and the time of the last sample in it."""

    total: float = 0.0
    count: int = 0
    time: float = -np.inf


def look_back(dt: float) -> int:
    """Ticks before one that it is held against."""
    return max(2, round(BEFORE_S / dt))


def struck(
    time, side, load, shake, thrust, torque, rate_dot, fresh, dt: float, known: int = 0, before: tuple[Contact, ...] = (),
    last: float = -np.inf,
) -> tuple[np.ndarray, tuple[Contact, ...], float]:  # fmt: skip
    """(T - known,) bool, ticks in which something outside pushed the vehicle, the contacts they belong to, and the time of the last.

    side (T, 2): sideways specific force [m/s^2], mean of the tick; load (T,): specific force up / g; shake (T,): `vibration` so far. All
    None without accelerometer.
    thrust (T, n), torque (T, 3): commanded, in hover thrusts; rate_dot (T, 3) rad/s^2; fresh (T,) bool: in the air, all of them known.
    known: of the first so many ticks it has been said before, which gave the contacts `before`, the last at `last`; they only are what
    the others are held against. Causal: a tick is judged by itself and the half second before it.
    """
    n, new = thrust.shape[1], slice(known, None)
    turns = np.abs(rate_dot).max(axis=1)
    turns = np.maximum(turns, np.concatenate([[0.0], turns[:-1]])) > TURNS
    if not turns[new].any():  # nearly always; below, every kind of knock but the first asks for that
        spun = _unexplained(torque[new], rate_dot[new], n) - np.sort(thrust[new], axis=1)[:, -2:].sum(axis=1)[:, None]
        if not (fresh[new] & (spun.max(axis=1) > 0.0)).any():
            return np.zeros(len(turns) - known, bool), before, last
    turned = _unexplained(torque, rate_dot, n) - np.sort(thrust, axis=1)[:, -2:].sum(axis=1)[:, None]
    turned = np.where(fresh, turned.max(axis=1), 0.0)
    kinds = [(turned, 0.0, "hover thrusts of one rotor", "turned it")]
    if side is not None:
        back = look_back(dt)
        pushed = np.linalg.norm(_since(side, fresh, back), axis=1) / G0
        # More lift than before, and not because the motors, cut, still turn.
        lifted = _since(np.column_stack([load, load - thrust.mean(axis=1)]), fresh, back).min(axis=1)
        pushed, lifted = np.where(turns, pushed, 0.0), np.where(turns, lifted, 0.0)
        kinds += [(pushed, np.maximum(SIDEWAYS, SHAKES * shake / G0), "g", "pushed it sideways")]
        kinds += [(lifted, np.maximum(UPWARD, SHAKES * shake / G0), "g", "pushed it upwards")]
    excess = np.stack([size - limit for size, limit, _, _ in kinds])
    hit = np.asarray(np.any(excess > 0.0, axis=0))
    hit[:known] = False
    contacts, last = _contacts(time, hit, excess, kinds, before, last)
    return hit[known:], contacts, last


def vibration(time, force, at, shaken: Shaken | None = None) -> np.ndarray:
    """(T,) root mean square of what force (m, 3) [m/s^2], sampled at `time` (m,), has been away from its mean over the half second
    before, up to each of the times `at` (non-decreasing); what knocks add is cut off. shaken: what came before, which this goes on with."""
    shaken = Shaken() if shaken is None else shaken
    if len(time) < 2 or not len(at):
        return np.full(len(at), np.sqrt(shaken.total / shaken.count) if shaken.count else 0.0)
    total = np.zeros((len(time) + 1, force.shape[1]))
    np.cumsum(force, axis=0, out=total[1:])
    new = slice(time.searchsorted(shaken.time, "right"), max(time.searchsorted(at[-1], "right"), 1))
    when = time[new]
    now, first = np.arange(len(time))[new], time.searchsorted(when - BEFORE_S)
    mean = (total[now] - total[first]) / np.maximum(now - first, 1)[:, None]
    square = np.where(now > first, np.minimum(((force[new] - mean) ** 2).sum(axis=1), G0**2), 0.0)
    so_far = shaken.total + np.concatenate([[0.0], np.cumsum(square)])
    counts = shaken.count + np.arange(len(so_far))
    index = np.minimum(np.maximum(when.searchsorted(at, "right"), 1 if not shaken.count else 0), len(when))
    shaken.total, shaken.count = float(so_far[-1]), int(counts[-1])
    shaken.time = float(when[-1]) if len(when) else shaken.time
    return np.sqrt(so_far[index] / np.maximum(counts[index], 1))


def _unexplained(torque, rate_dot, n: int) -> np.ndarray:
    """(T, 3) torque that the motion takes at least, less what was commanded that way. Commands against the motion count for nothing:
    they may come a tick early."""
    return LEAST_GAIN * n * np.abs(rate_dot) - np.maximum(np.sign(rate_dot) * torque, 0.0)


def _since(value, fresh, back: int) -> np.ndarray:
    """(T, k) by how much each tick's value differs from the mean of the `back` ticks before it; 0 where one of them is not fresh."""
    total = np.concatenate([np.zeros((1, value.shape[1])), np.cumsum(np.where(fresh[:, None], value, 0.0), axis=0)])
    count = np.concatenate([[0], np.cumsum(fresh)])
    now = np.arange(len(value))
    first = np.maximum(now - back, 0)
    usable = fresh & (count[now] - count[first] == back)
    return np.where(usable[:, None], value - (total[now] - total[first]) / back, 0.0)


def _contacts(time, hit, excess, kinds, before, last: float) -> tuple[tuple[Contact, ...], float]:
    """Ticks close together are one contact, as large as its largest tick; and the time of the last one."""
    found: list[Contact] = list(before)
    for k in np.flatnonzero(hit):
        size, _, unit, what = kinds[int(np.argmax(excess[:, k]))]
        one = Contact(float(time[k]), float(size[k]), unit, what)
        if time[k] - last > TOGETHER_S:
            found.append(one)
        elif one.unit == found[-1].unit and one.size > found[-1].size:
            found[-1] = Contact(found[-1].time, one.size, unit, what)
        last = float(time[k])
    return tuple(found), last
