"""The controllers of the helicopter's flights: an H-infinity attitude loop for an interval of the actuators' coefficients, a PI position
loop around it, and, for the flights in the loop of the paper's figure 5, feedback linearisation.

Attitude loop, with xi = (p, q, r, roll, pitch, integrals of roll and pitch, leaky integral of r), errors against what the position loop
asks for, and u the commands of tail, longitudinal and lateral cyclic:

    dxi/dt = A xi + B diag(gamma) u + E w,   z = (weighted attitude, integrals and rate; rho u),   u = K xi

linearised in hover; gamma anywhere in its interval, w three angular accelerations, PUSH. Where the interval of the tail's gamma
holds 0 no controller can move yaw, so its integral leaks: it is bounded without control. Displacements delta are constant: they make no
loop unstable, and what is known of them, with gamma, is taken off the commands as far as it is known:

    U_trim,in = U_trim + g (U_trim - g U_trim - d) / (g^2 + h^2)

with g and d the middles of gamma's and delta's bounds, h the half-width of gamma, SURE at least.
Source: Qi et al. 2015, flight test ("a standard H-infinity controller"; its weights are not printed and chosen here).
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments.studies.ruav_flight import ATTITUDE, DT, hover
from rotorwatch_lab.maths import h_infinity

N_XI, LEAK_S = 8, 3.0
# z: attitude [per rad], its integral [per rad s], leaky yaw [per rad]; a full command of tail, longitudinal, lateral.
ATTITUDE_WEIGHT, INTEGRAL_WEIGHT, YAW_WEIGHT = 6.0, 4.0, 1.0
RHO = np.array([1.0, 6.0, 6.0])
PUSH = np.array([1.0, 1.0, 0.15])  # rad/s^2 that disturb roll, pitch and yaw
SCALE = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 0.3, 1.0])
SLACK = 0.05
SURE = 0.05  # an actuator whose gain is of that size, or less sure than it is large, hardly has to make up for its displacement
SLOW_SAMPLE_S = 0.08  # loops are stable even when sampled so slowly: room for lags of servos and blades, which the model neglects
# Position loop: m/s per m, m/s at most, rad/s^2 of velocity, its integral, attitude at most [rad], rad/s per rad of heading, its most
POSITION, SPEED, VELOCITY, VELOCITY_I, TILT, HEADING, TURN = 0.15, 1.0, 0.5, 0.05, 0.15, 0.2, 0.08


class Attitude(NamedTuple):
    """The attitude loop's plant: A (8, 8), B (8, 3) with healthy actuators, E (8, 3), C (8, 8), D (8, 3)."""

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    C: np.ndarray
    D: np.ndarray


def attitude_plant(system, slower: float = 1.0) -> Attitude:
    """See the module. slower: factor on the weights of commands."""
    by_x, by_u = hover(system)
    A, B, E = np.zeros((N_XI, N_XI)), np.zeros((N_XI, 3)), np.zeros((N_XI, 3))
    C, D = np.zeros((N_XI, N_XI)), np.zeros((N_XI, 3))
    A[:3, :3], B[:3], E[:3] = by_x[3:, 3:], by_u[3:, 1:4], np.diag(PUSH)
    A[3, 0] = A[4, 1] = A[5, 3] = A[6, 4] = A[7, 2] = 1.0
    A[3, 2], A[4, 2], A[7, 7] = ATTITUDE[1], -ATTITUDE[0], -1.0 / LEAK_S
    C[0, 3] = C[1, 4] = ATTITUDE_WEIGHT
    C[2, 5] = C[3, 6] = INTEGRAL_WEIGHT
    C[4, 7] = YAW_WEIGHT
    D[5:] = slower * np.diag(RHO)
    return Attitude(A, B, E, C, D)


def design(plant: Attitude, low, high) -> h_infinity.Synthesis:
    """The controller for gamma of tail, longitudinal and lateral within low (3,) and high (3,). Raises ConfigError when these are bounds
    that exclude every controller."""
    sides = [sorted({float(a), float(b)}) for a, b in zip(low, high, strict=True)]
    B = np.array([plant.B * np.array(gains) for gains in product(*sides)])
    return h_infinity.state_feedback(plant.A, B, plant.E, plant.C, plant.D, dt=SLOW_SAMPLE_S, scale=SCALE, slack=SLACK)


class Designs:
    """Controllers by interval, each made once. grid: bounds are rounded outwards to it, so a controller is designed again when a bound
    has moved by that much; what was excluded is remembered as None."""

    def __init__(self, system, grid: float = 0.1, slower: float = 1.0):
        self.system, self.plant, self.grid = system, attitude_plant(system, slower), grid
        self.made: dict[tuple, h_infinity.Synthesis | None] = {}

    def key(self, low, high) -> tuple:
        """The interval rounded outwards, within [0, 1]."""
        low = np.clip(np.floor(np.asarray(low) / self.grid + 1e-9), 0, round(1 / self.grid))
        high = np.clip(np.ceil(np.asarray(high) / self.grid - 1e-9), low, round(1 / self.grid))
        return tuple(int(k) for k in (*low, *high))

    def is_due(self, wanted: tuple, made_for: tuple, loose: float) -> bool:
        """True if the interval (of `key`) is not within the one a controller was designed for, or one side could be tighter by `loose`."""
        inward = [*(w - m for w, m in zip(wanted[:3], made_for[:3])), *(m - w for w, m in zip(wanted[3:], made_for[3:]))]
        return min(inward) < 0 or max(inward) * self.grid > loose - 1e-9

    def of(self, key: tuple) -> h_infinity.Synthesis | None:
        """The controller for that rounded interval, or None if none exists."""
        if key not in self.made:
            bounds = self.grid * np.array(key, float)
            try:
                self.made[key] = design(self.plant, bounds[:3], bounds[3:])
            except ConfigError as why:
                if "exclude every controller" not in str(why):
                    raise
                self.made[key] = None
        return self.made[key]


def trim_command(trim, gain, half, displacement, wanted=None):
    """(4,) the command that puts the actuators to wanted (4,), None: to trim, as far as the middle of gamma's bounds (gain), their
    half-width and delta's middle say so. The middles belong together - gamma and delta are known best where they are flown - so gain
    is not to be clipped."""
    wanted = trim if wanted is None else wanted
    return trim + gain * (wanted - gain * trim - displacement) / (gain**2 + half.clip(SURE) ** 2)


def position_loop(pos, heading, velocity, turning, integral):
    """((roll, pitch, turn rate, climb command) wanted, new integral (3,)): PI on velocity inside P on position.

    pos (3,): north, east, down [m] off the place to be; velocity (3,): body axes, near level; turning: yaw rate [rad/s], by which body axes
    turn away under the velocity.
    """
    from jax import numpy as jnp

    c, s = jnp.cos(heading), jnp.sin(heading)
    body = jnp.stack([c * pos[0] + s * pos[1], -s * pos[0] + c * pos[1], pos[2]])
    error = jnp.clip(-POSITION * body, -SPEED, SPEED) - velocity
    integral = integral + DT * error
    push = VELOCITY * error + VELOCITY_I * integral
    roll = ATTITUDE[0] + jnp.clip((push[1] + turning * velocity[0]) / G0, -TILT, TILT)
    pitch = ATTITUDE[1] - jnp.clip((push[0] - turning * velocity[1]) / G0, -TILT, TILT)
    return roll, pitch, jnp.clip(-HEADING * heading, -TURN, TURN), push[2], integral
