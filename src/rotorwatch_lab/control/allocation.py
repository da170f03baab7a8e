"""Control allocation with weak rotors: a demanded thrust and moment becomes a command of each rotor, within what rotors can do.

A rotor at command u (share of its full thrust, 0 to 1) with effectiveness e (1 healthy, 0 dead; 1 - loss) gives B e u, with B (4, n):
thrust, roll, pitch and yaw moment of every rotor at full command. A demand v is met as well as it can be:

    argmin over 0 <= u <= 1 of |W S^-1 (B (e u) - v)|^2 + eps |u - u0|^2

S: half of what all rotors together give, row by row, so that 1 is about the authority of each channel. W: priorities; a channel
with a small weight gives way where not all can be had (weighted least squares as in Harkegard, Efficient active set algorithms for
solving constrained least squares problems in aircraft control allocation, CDC 2002, and Smeur, Hoeppener and De Wagter, Prioritized
control allocation for quadrotors subject to saturation, IMAV 2017). u0: the answer without bounds and with the smallest commands,
argmin of |W S^-1 (B (e u) - v)|^2 + eps |u|^2, clipped.

What is believed of e comes as an estimate, as bounds, or as several sets of weak rotors with their probabilities (`Belief`), and
the expected squared error is what is made small:

    "estimate"    e is the mean
    "bounds"      e is independent from rotor to rotor, has that mean and lies within lower and upper; of all such distributions the
                  worst: variance (upper - mean)(mean - lower) (Bhatia and Davis, American Mathematical Monthly 107, 2000), which adds
                  that times |W S^-1 b_i|^2 u_i^2. A rotor of uncertain effectiveness is commanded less
    "posterior"   e is candidate k with weight k: sum_k weight_k |W S^-1 (B (e_k u) - v)|^2, between the candidates

Each is solved exactly: `box`, and for candidates, whose rows are too many for it, `maths.bounded`.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.core import Array
from rotorwatch.errors import ConfigError
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch_lab.control import box
from rotorwatch_lab.maths import bounded

WEIGHTS = (1.0, 1.0, 1.0, 0.03)
EPS = 1e-6
METHODS = ("bounded", "pseudo-inverse")
DRIVEN_BY = ("estimate", "bounds", "posterior")
TILT = np.array([0.0, 1.0, 1.0, 0.0])
GRANTED = 1e-3  # of a channel's authority: a smaller error is none
OK, HELD = 0, 1


class Belief(namedtuple("Belief", "mean lower upper candidates weights")):
    """Belief about each rotor's effectiveness, all in [0, 1]. mean, lower, upper (n,); candidates (k, n) with weights (k,), not necessarily
    of sum 1. `believed` fills in defaults."""


class Held(NamedTuple):
    """The allocator's state. u (n,): the last commands, which stay where a demand is no number."""

    u: Array


class Allocation(namedtuple("Allocation", "u wrench error worst granted status")):
    """u (n,): commands, shares of full thrust. wrench (4,): what they should give, by the mean effectiveness, in the units of B.
    error (4,): demand minus that. worst (4,): the largest |error| of each channel, whatever lies between lower and upper. granted (4,):
    1.0 where the error is nothing, else 0.0 (integrators stop). status: 0, or 1 where demand or belief were no numbers and the last
    commands stay."""


def effectiveness(x, y, spin, thrust_max, drag_ratio) -> np.ndarray:
    """B (4, n) [N, N m] of rotors at x forward, y right (n,) [m], spin +1 counter-clockwise from above, thrust_max [N], drag_ratio [m].

    FRD: thrust T at (x, y) pointing up gives roll -y T, pitch x T and yaw spin drag_ratio T.
    """
    x, y, spin = (np.asarray(v, float) for v in (x, y, spin))
    return np.stack([np.ones_like(x), -y, x, drag_ratio * spin]) * np.asarray(thrust_max, float)


def rows(vehicle: Vehicle) -> np.ndarray:
    """B (4, n) of a vehicle whose weights and sizes are not known: `Vehicle.effectiveness`, thrust first; no units."""
    return vehicle.effectiveness()[[3, 0, 1, 2]]


def believed(mean, lower=None, upper=None, candidates=None, weights=None) -> Belief:
    """A `Belief` from what there is: bounds default to the mean, candidates to the mean alone, weights to equal ones."""
    mean = jnp.asarray(mean, float)
    lower, upper = (mean if bound is None else jnp.asarray(bound, float) for bound in (lower, upper))
    candidates = mean[None] if candidates is None else jnp.asarray(candidates, float)
    weights = jnp.ones(candidates.shape[0]) if weights is None else jnp.asarray(weights, float)
    return Belief(mean, lower, upper, candidates, weights)


class Allocator:
    """Demands to commands for one vehicle: `init() -> state`, `step(state, demand, belief) -> (state, Allocation)`, both pure."""

    name = "allocator"

    def __init__(self, B: Any, *, by: str = "estimate", method: str = "bounded", weights: Any = WEIGHTS, eps: float = EPS):
        """B (4, n): thrust, roll, pitch and yaw moment of each rotor at full command (`effectiveness`, or `rows` of a `Vehicle`), healthy.
        by: "estimate", "bounds" or "posterior"; method: "bounded", or "pseudo-inverse", which knows the estimate only. weights (4,):
        priorities of thrust, roll, pitch, yaw. eps: what departing from u0 costs. Raises ConfigError."""
        B = np.asarray(B, float)
        if B.ndim != 2 or B.shape[0] != 4 or B.shape[1] < 1:
            raise ConfigError(f"B must have the shape (4, number of rotors), not {B.shape}.")
        checks.finite("B", B)
        if by not in DRIVEN_BY or method not in METHODS:
            raise ConfigError(f"by must be one of {', '.join(DRIVEN_BY)}, method one of {', '.join(METHODS)}.")
        if method == "pseudo-inverse" and by != "estimate":
            raise ConfigError('the pseudo-inverse is driven by an estimate only: leave out `by`, or take method="bounded".')
        self.by, self.method, self.B, self.n = by, method, B, B.shape[1]
        self.weights = checks.positive("weights", checks.shape("weights", np.asarray(weights, float), 4))
        self.eps = float(checks.positive("eps", eps))
        size = np.abs(B).sum(axis=1) / 2.0
        self.size = np.where(size > 0.0, size, 1.0)
        self.scale = self.weights / self.size
        self.C = self.scale[:, None] * B

    def init(self) -> Held:
        """All rotors at rest."""
        return Held(jnp.zeros(self.n))

    def step(self, state: Held, demand, belief: Belief) -> tuple[Held, Allocation]:
        """Commands for demand (4,): thrust, roll, pitch, yaw in the units of B (thrust up positive)."""
        return self.step_counting(state, demand, belief)[:2]

    def step_counting(self, state: Held, demand, belief: Belief) -> tuple[Held, Allocation, Array]:
        """`step`, and the turns of `box` that it took, int32; 0 where it is solved otherwise."""
        demand = jnp.asarray(demand, float)
        usable = jnp.isfinite(demand).all()
        for leaf in belief:
            usable = usable & jnp.isfinite(leaf).all()
        demand = jnp.where(usable, demand, 0.0)
        belief = Belief(*(jnp.where(usable, leaf, 0.0) for leaf in belief))
        mean, lower, upper = (jnp.clip(e, 0.0, 1.0) for e in belief[:3])
        lower, upper = jnp.minimum(lower, mean), jnp.maximum(upper, mean)
        b = self.scale * demand
        if self.method == "pseudo-inverse":
            u, turns = self._desaturated(self.C * mean, b), jnp.int32(0)
        elif self.by == "posterior":
            candidates, weights = jnp.clip(belief.candidates, 0.0, 1.0), jnp.maximum(belief.weights, 0.0)
            u, turns = self._between(b, candidates, weights, mean), jnp.int32(0)
        else:
            u, turns = box.solve(*self.problem(b, mean, lower, upper))
        u = jnp.where(usable, u, state.u)
        wrench = self.B @ (mean * u)
        error = demand - wrench
        # Linear in each effectiveness: the ends are where a channel is furthest off.
        surplus, deficit = (upper - mean) * u, (mean - lower) * u
        up, down = np.maximum(self.B, 0.0), np.maximum(-self.B, 0.0)
        worst = jnp.maximum(jnp.abs(error - up @ surplus - down @ deficit), jnp.abs(error + up @ deficit + down @ surplus))
        granted = (jnp.abs(error) <= GRANTED * self.size) & usable
        status = jnp.where(usable, OK, HELD).astype(jnp.int32)
        return Held(u), Allocation(u, wrench, error, worst, granted.astype(float), status), turns

    def problem(self, b, mean, lower, upper):
        """(A, b, c, d) of `box.solve` for a scaled demand b (4,) and effectiveness (n,)."""
        A = self.C * mean
        variance = (upper - mean) * (mean - lower) * (self.C**2).sum(axis=0)
        d = self.eps + (variance if self.by == "bounds" else 0.0 * variance)
        return A, b, self.eps * self._wish(A, b) / d, d

    def _free(self, A, b):
        """The smallest commands (n,) for b (4,), without bounds."""
        return box.unbounded(A, b, jnp.zeros(self.n), jnp.full(self.n, self.eps))

    def _wish(self, A, b):
        """The reference command u0."""
        return jnp.clip(self._free(A, b), 0.0, 1.0)

    def _between(self, b, candidates, weights, mean):
        """The least expected squared error over candidates (k, n) with weights (k,); over the mean where all weights are 0."""
        total = weights.sum()
        none = total <= 0.0
        share = jnp.where(none, 0.0, weights / jnp.where(none, 1.0, total))
        expected = jnp.where(none, mean, share @ candidates)
        second = jnp.where(none, mean[:, None] * mean, (candidates.T * share) @ candidates)
        preferred = self._wish(self.C * expected, b)
        H = (self.C.T @ self.C) * second + self.eps * np.eye(self.n)
        return bounded.quadratic(H, (b @ self.C) * expected + self.eps * preferred, 0.0, 1.0)

    def _desaturated(self, A, b):
        """Commands (n,) of the pseudo-inverse of A for b (4,), brought into [0, 1]: the thrust moves so that roll and pitch fit, they
        shrink together only when no thrust makes room for them, and yaw takes the room that is left. ArduPilot's and PX4's order."""
        d = jnp.full(self.n, self.eps)
        # Around the first answer once more: what eps takes away is squared, and the smallest commands stay the smallest.
        lift, tilt, yaw = (box.unbounded(A, part, self._free(A, part), d) for part in (np.eye(4)[0], b * TILT, b * np.eye(4)[3]))
        pushes = lift > 1e-9
        per = 1.0 / jnp.where(pushes, lift, 1.0)
        slope = tilt * per
        # A thrust c fits a share k of the tilt when -k slope_i <= c <= per_j - k slope_j for all rotors i, j.
        difference = slope - slope[:, None]
        narrow = (difference > 1e-12) & pushes & pushes[:, None]
        k = jnp.minimum(jnp.where(narrow, per / jnp.where(narrow, difference, 1.0), 1.0).min(), 1.0)
        low = jnp.where(pushes, -k * slope, -jnp.inf).max()
        high = jnp.where(pushes, per - k * slope, jnp.inf).min()
        u = jnp.clip(jnp.minimum(jnp.maximum(b[0], low), high) * lift + k * tilt, 0.0, 1.0)
        room = jnp.where(yaw > 0.0, 1.0 - u, u)
        size = jnp.abs(yaw)
        turns = jnp.where(size > 1e-12, room / jnp.where(size > 1e-12, size, 1.0), 1.0).min()
        return jnp.clip(u + jnp.minimum(turns, 1.0) * yaw, 0.0, 1.0)
