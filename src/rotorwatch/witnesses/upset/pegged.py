"""A rotor at full command while the vehicle turns the other way: it gives no thrust, and the finding needs no learning.

A controller with one output at its end, against a rotation that continues, asks that rotor to stop it. With b_k the torque of rotor k on
roll, pitch and yaw, the vehicle turns with

    s = omega . b_k / |b_k|

If rotor k gave thrust, s would rise. It is found where output k stays at the upper end of this flight's outputs for `LEAST_S`, the torque
commanded along b_k has that sign, and s is below -AGAINST all the time, on every axis, without rising. A rotor stuck at a constant thrust
pushes the same way as a dead opposite one on roll and pitch, but not on yaw, where propellers turn in pairs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.air_spans import output_range
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import CONTACT, LOSS
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.witness import Events, View

LEAST_S, GAP_S = 0.8, 0.1  # least length, and longest gap in it
END = 0.97  # of the largest output of the flight, and least share of the range
HIGH = 0.7
AGAINST, EACH, RISES = 4.0, 0.5, 1.0  # rad/s along the torque, on each of its axes, and largest recovery
LEADS = 0.2  # share of the range, more than the others are commanded on average
GIVES = 0.5  # largest remaining share of thrust of such a rotor


def find(flight: Flight, vehicle: Vehicle, air: Spans, struck: Sequence[float] = ()) -> tuple[Event, ...]:
    """The losses of rotors at full command while the vehicle turned against them, at most one a flight. struck: times of blows to the
    vehicle [s]; rotation just after them is their effect."""
    turning = flight.angular_rate()
    if turning is None or not flight.has("motors"):
        return ()
    motors, (low, high) = flight["motors"], output_range(flight)
    rates, losses = turning.wholes(), []
    for start, end in air:
        part = motors.between(start, end + LEAST_S).wholes()
        if len(part) < 5 or len(rates) < 5:
            continue
        share = np.clip((part.values - low) / max(high - low, 1e-6), 0.0, 1.0)
        top = float(share.max())
        omega = np.stack([np.interp(part.time, rates.time, column) for column in rates.values.T], axis=1)
        for k, b in enumerate(vehicle.effectiveness()[:3].T):
            others = np.delete(share, k, axis=1).mean(axis=1)
            at_end = (share[:, k] >= max(HIGH, END * top)) & (share[:, k] > others + LEADS)
            along = omega * np.sign(b) * (np.abs(b) > 0.1)
            against = at_end & (along.sum(axis=1) < -AGAINST) & (along[:, np.abs(b) > 0.1] < -EACH).all(axis=1)
            for first, last in _spells(part.time, against):
                s = along[first : last + 1].sum(axis=1)
                begun = float(part.time[first])
                if s[-max(len(s) // 5, 1) :].mean() > s[: max(len(s) // 5, 1)].mean() + RISES:
                    continue
                if any(0.0 <= begun - t < 1.0 for t in struck):
                    continue
                losses.append(_event(k + 1, begun, float(part.time[last]), float(-s.min())))
                break
    return tuple(losses[:1])


def _spells(time: np.ndarray, so: np.ndarray) -> list[tuple[int, int]]:
    """(first, last) samples of the spells of at least `LEAST_S` in which `so` holds, with gaps of up to GAP_S."""
    rows, spells = np.flatnonzero(so), []
    if not rows.size:
        return []
    cuts = np.flatnonzero(np.diff(time[rows]) > GAP_S + 1.5 * float(median(np.diff(time))))
    for first, last in zip([0, *(cuts + 1)], [*cuts, rows.size - 1]):
        a, b = int(rows[first]), int(rows[last])
        if time[b] - time[a] >= LEAST_S and so[a : b + 1].mean() > 0.8:
            spells.append((a, b))
    return spells


def _event(rotor: int, onset: float, until: float, turned: float) -> Event:
    reason = (
        f"output {rotor} was at its upper end from {onset:.1f} to {until:.1f} s while the vehicle turned against it, by up to "
        f"{turned:.0f} rad/s along its torque"
    )
    return Event(
        LOSS, (rotor,), onset, onset + LEAST_S, None, (1.0,), ((GIVES, 1.0),), 0.99, (), reason, {"live": False, "loss_2s": [1.0]}
    )  # fmt: skip


def hear(view: View, claims: Events) -> Events:
    """Asked only where nothing else accuses a rotor: it needs no learning, where learning had no time."""
    events = view.merged(claims)
    if any(e.means.accuses for e in events):
        return claims
    struck = [e.onset_s for e in events if e.kind == CONTACT]
    return (*claims, *find(view.flight, view.vehicle, view.air, struck))
