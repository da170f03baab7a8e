"""A multirotor whose commands follow a belief about its rotors, instead of the autopilot's fixed mixer.

What is believed, and from when on, is a `Schedule` of a few entries; `closed_loop` writes it from an estimator's output. Up to the first
entry the vehicle flies as any other. From then on

    turning 0    the autopilot's demands (throttle, roll, pitch, yaw) go through `control.allocation`
    turning 1    where full control of hover is lost: `control.spinning` holds a turning hover; thrust and
                 tilt still follow the position loop
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.control import spinning
from rotorwatch_lab.control.allocation import Allocator, Belief
from rotorwatch_lab.simulation import control, rotation
from rotorwatch_lab.simulation.multirotor import Drives, Multirotor, Plan

Array = Any
PLACES = 4  # explanations of the default diagnosis
TURN = 0.3  # rad
MOST_TILT = 0.25  # rad: how far from upright a turning vehicle tilts at most


class Entry(NamedTuple):
    """Belief from `since` [s] on. mean, lower, upper (n,): effectiveness of each rotor; candidates (PLACES, n) with weights (PLACES,):
    possible values and their probabilities; turning: 0 or 1; hover and gains: of `spinning`, zeros where unused."""

    since: Array
    mean: Array
    lower: Array
    upper: Array
    candidates: Array
    weights: Array
    turning: Array
    hover: spinning.Hover
    gains: spinning.Gains


def entry(n: int, since: float = np.inf, mean=None, lower=None, upper=None, hover=None, gains=None, candidates=None, weights=None) -> Entry:
    """An entry; without arguments one that never begins. hover, gains: for a vehicle that has to turn. candidates, weights: default to the
    mean alone."""
    mean = np.ones(n) if mean is None else np.asarray(mean, float)
    if candidates is None or weights is None:
        candidates, weights = np.tile(mean, (PLACES, 1)), np.arange(PLACES) == 0
    turns = hover is not None and gains is not None
    if hover is None or gains is None:
        hover = spinning.Hover(np.zeros(n), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(n))
        gains = spinning.Gains(np.zeros((n, 5 + n)), np.zeros((2, 3)), 0.0)
    return Entry(
        np.array(since), mean, mean if lower is None else np.asarray(lower, float),
        mean if upper is None else np.asarray(upper, float), np.asarray(candidates, float), np.asarray(weights, float),
        np.array(float(turns)), hover, gains,
    )  # fmt: skip


def schedule(n: int, entries: list[Entry], size: int) -> Entry:
    """`size` entries stacked along a first axis, the last of them never beginning."""
    filled = [*entries, *[entry(n)] * (size - len(entries))]
    return load_jax().tree.map(lambda *leaves: np.stack([np.asarray(leaf, float) for leaf in leaves]), *filled)


class Reconfigured(Multirotor):
    """The `loop.Aircraft` of vehicles of one frame that follow a `Plan` with a schedule. Equal for the same frame and rule."""

    def __init__(self, B: np.ndarray, by: str = "estimate", method: str = "bounded"):
        """B (4, n): thrust, roll, pitch, yaw of each rotor (`control.allocation.rows`), healthy; by, method: of the `Allocator`."""
        self.allocator = Allocator(B, by=by, method=method)
        self.made = (np.asarray(B, float).tolist(), by, method)
        self._key = (np.asarray(B, float).tobytes(), by, method)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and other._key == self._key

    def aimed(self, plan: Plan, now, t, body) -> control.Target:
        """From the first entry on the way to the tilt setpoint is the shortest, whatever the heading, and no more than TURN of heading at
        a time: where yaw is given up its error must not turn into roll and pitch (reduced attitude)."""
        jnp, target = load_jax().numpy, now.target
        here, there = rotation.axes(body.q), rotation.axes(target.q)
        # Body z in the world: now, and its setpoint.
        a, b = (jnp.stack([R[0][2], R[1][2], R[2][2]]) for R in (here, there))
        cross = jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
        dot = (a * b).sum(axis=0)
        half = jnp.concatenate([jnp.maximum(1.0 + dot, 1e-3)[None], cross])
        level = rotation.multiply(rotation.unit(half), body.q)
        left = rotation.multiply(rotation.conjugate(level), target.q)  # about body z
        angle = 2.0 * jnp.arctan2(jnp.where(left[0] < 0.0, -left[3], left[3]), jnp.abs(left[0]))
        q = rotation.multiply(level, rotation.heading(jnp.clip(angle, -TURN, TURN)))
        begun = plan.schedule.since[0] <= t
        return target._replace(q=jnp.where(begun, q, target.q))

    def effectiveness(self, plan: Plan, t):
        """Effectiveness expected by the active entry."""
        jnp = load_jax().numpy
        return jnp.where(plan.schedule.since[0] <= t, self._expected(_entry_at(plan.schedule, t)), 1.0)

    def _expected(self, entry: Entry):
        """(n,) the mean, or that of the candidates."""
        return entry.weights @ entry.candidates if self.allocator.by == "posterior" else entry.mean

    def mixed(self, plan: Plan, now, t, body, gyro, turning, drives: Drives) -> tuple:
        """Demands of the mixer, the allocator or the turning hover, as scheduled."""
        jnp, pilot, throttle = load_jax().numpy, plan.pilot, now.target.throttle
        healthy, free = control.mix(pilot.mixer, turning, throttle)
        begun, one = plan.schedule.since[0] <= t, _entry_at(plan.schedule, t)
        wanted = self.allocator.B @ (throttle + pilot.mixer[:, :3] @ turning)
        belief = Belief(self._expected(one), one.lower, one.upper, one.candidates, one.weights)
        allocated = self.allocator.step(self.allocator.init(), wanted, belief)[1]
        # A throttle or yaw that is not had must not stop what holds the vehicle level.
        granted = allocated.granted[1:3].min()
        if self.allocator.by != "estimate":
            # What is in doubt is met half way on purpose, and the integrators make up for the rest as long as no command is at a limit.
            granted = jnp.maximum(granted, ((allocated.u > 0.0) & (allocated.u < 1.0)).all().astype(granted.dtype))

        # Down, as the position loop wants it, in body axes, no further from the hover's than MOST_TILT.
        R, upright = rotation.axes(body.q), rotation.axes(now.target.q)
        down = rotation.to_body(R, jnp.stack([upright[0][2], upright[1][2], upright[2][2]]))
        level = rotation.to_body(R, jnp.asarray([0.0, 0.0, 1.0], down.dtype))
        apart = down - level
        apart = apart * jnp.minimum(1.0, MOST_TILT / jnp.maximum(jnp.sqrt((apart * apart).sum()), 1e-6))
        lift = throttle / pilot.hover / jnp.maximum(one.hover.down[2], 0.3)
        spun = spinning.feedback(one.hover, one.gains, drives.f, gyro, level + apart, jnp.clip(lift, 0.5, 1.5))

        turns = one.turning > 0.5
        ours = jnp.where(turns, spun, allocated.u)
        return jnp.where(begun, ours, healthy), jnp.where(begun, jnp.where(turns, 0.0, granted), free)


def _entry_at(schedule: Entry, t) -> Entry:
    """The last entry that has begun, or the first."""
    k = load_jax().numpy.maximum((schedule.since <= t).sum() - 1, 0)
    return load_jax().tree.map(lambda a: a[k], schedule)
