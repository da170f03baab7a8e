"""Hover while turning: where thrust and moments cannot balance at rest they may while the body turns, and feedback that holds it.

A relaxed hover is a motion with constant commands u and body rates omega that stays where it is on average (Mueller and D'Andrea, Relaxed
hover solutions for multicopters, International Journal of Robotics Research 35, 2016; Stability and control of a quadrocopter despite the
complete loss of one, two, or three propellers, ICRA 2014):

    tau(u, omega) = omega x (J omega + h(u) e_z)        the moments balance
    d = omega / |omega| or its opposite, d_z > 0        "down" stays where it is in the body
    T(u, omega) d_z = m g                               the height stays, and sideways forces turn with the body

tau, the momentum h of the rotors and the drag that limits how fast it turns are those of `simulation.dynamics` at no speed. Of all such
motions the one with the least power and commands away from their limits is taken. Around it the reduced attitude, body rates and
down in body axes without the heading, is held by a linear quadratic regulator that knows the rotors' lag.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.base.physics import G0
from rotorwatch.core import Array
from rotorwatch.errors import ConfigError
from rotorwatch_lab.control.airframe import Airframe

RATE_MOST = 35.0  # rad/s: gyros of autopilots measure 2,000 degrees a second
COMMANDS = (0.02, 0.95)  # what is left to control with
STARTS = (0.0, 12.0, 4.0, 22.0)  # rad/s
ITERATIONS = 60
BARRIER = 0.02  # how much distance from the limits counts against power
BALANCED = 1e-8  # of the weight
DEAD = 1e-3  # a rotor with less effectiveness is not used
RATE_UNIT, REST = 10.0, 1e-3  # rad/s
SLOWEST = 0.3  # 1/s: a regulator whose errors fade more slowly holds nothing
# Sizes of errors that weigh the same: rates across the axis, along it [rad/s], down [rad], commands.
RATE_SIZE, SPIN_SIZE, DOWN_SIZE, COMMAND_SIZE = 3.0, 30.0, 0.15, 0.3


class Hover(NamedTuple):
    """u (n,): commands; omega (3,) [rad/s], body; down (3,): unit vector, body; effectiveness (n,). A motion that stays."""

    u: np.ndarray
    omega: np.ndarray
    down: np.ndarray
    effectiveness: np.ndarray

    @property
    def rate(self) -> float:
        """|omega| [rad/s]."""
        return float(np.linalg.norm(self.omega))

    @property
    def tilt(self) -> float:
        """Between the body's z axis and down [rad]."""
        return float(np.arccos(np.clip(self.down[2], -1.0, 1.0)))


def moments(airframe: Airframe, e, u, omega, numpy: Any = np):
    """(J d omega/dt (3,) [N m], thrust [N]) at commands u (n,) that the rotors have reached, at rest but for turning."""
    a = airframe
    w = numpy.sqrt(numpy.maximum(u, 1e-12))
    push, left = a.thrust_max * e * u, w * e
    T = push + a.k_z * left * (omega[0] * a.y - omega[1] * a.x)
    a_x, a_y = omega[1] * a.z - omega[2] * a.y, -omega[0] * a.z + omega[2] * a.x
    H_x, H_y = -a.k_d * left * a_x, -a.k_d * left * a_y
    yaw = a.drag_ratio * (a.spin * push).sum() + (a.x * H_y - a.y * H_x).sum()
    tau = numpy.stack([-(a.y * T).sum() - a.z * H_y.sum(), (a.x * T).sum() + a.z * H_x.sum(), yaw])
    momentum = a.J @ omega - numpy.stack([0.0, 0.0, 1.0]) * (a.rotor_momentum * (a.spin * w).sum())
    return tau - numpy.cross(omega, momentum), T.sum()


def _some(airframe: Airframe, rotors) -> Airframe:
    """The airframe reduced to these rotors."""
    return airframe._replace(**{name: getattr(airframe, name)[rotors] for name in ("x", "y", "spin", "thrust_max")})


def _balance(z, airframe, e, weight, arm):
    """(4,) what is out of balance, as shares of the weight. z: commands, then body rates over RATE_UNIT."""
    omega = z[-3:] * RATE_UNIT
    turning, thrust = moments(airframe, e, z[:-3], omega, jnp)
    # At rest down is the body's z axis.
    down = jnp.sqrt(omega[2] ** 2 + REST**2) / jnp.sqrt(omega @ omega + REST**2)
    return jnp.append(turning / (weight * arm), thrust * down / weight - 1.0)


def _cost(z):
    """Power, with room to the limits, and no more rates than it takes."""
    u = jnp.clip(z[:-3], 1e-4, 1.0 - 1e-4)
    return jnp.sum(u**1.5) - BARRIER * jnp.sum(jnp.log(u * (1.0 - u))) + 1e-3 * (z[-3:] @ z[-3:])


@functools.cache
def _programs():
    """Compiled: (balance, its derivative, cost and its derivative)."""
    return jax.jit(_balance), jax.jit(jax.jacfwd(_balance)), jax.jit(jax.value_and_grad(_cost))


def relaxed_hover(airframe: Airframe, effectiveness) -> Hover | None:
    """The relaxed hover with the least power for that effectiveness (n,), or None when there is none with commands within COMMANDS at
    no more than RATE_MOST. Rotors without any effectiveness stand still."""
    from scipy.optimize import minimize

    e = checks.between("effectiveness", np.asarray(effectiveness, float), 0.0, 1.0)
    alive = np.flatnonzero(e > DEAD)
    k, weight = len(alive), airframe.mass * G0
    full = float((airframe.thrust_max * e).sum())
    if not k or full * COMMANDS[1] < weight:
        return None
    arm = max(float(np.hypot(airframe.x, airframe.y).max()), 1e-6)
    arguments = (_some(airframe, alive), e[alive], weight, arm)
    balance, derivative, cost = _programs()
    constraint = {"type": "eq", "fun": lambda z: np.asarray(balance(z, *arguments)),
                  "jac": lambda z: np.asarray(derivative(z, *arguments))}  # fmt: skip
    limits = [COMMANDS] * k + [(-RATE_MOST / RATE_UNIT, RATE_MOST / RATE_UNIT)] * 3
    level = np.clip(weight / full, 0.05, 0.9)
    lost_moment = np.array([-(airframe.y * (1 - e)).sum(), (airframe.x * (1 - e)).sum()])
    lost_moment = lost_moment / max(float(np.linalg.norm(lost_moment)), 1e-9)
    # The yaw moment of the rotors that are left turns it.
    way = float(np.sign(np.sum(airframe.spin[alive])) or 1.0)
    best, best_z, same = np.inf, None, 0
    for rate in STARTS:
        for side in (0.3, -0.3) if rate else (0.0,):
            if same:  # found twice
                break
            start = np.r_[np.full(k, level), np.r_[side * lost_moment, way] * rate / RATE_UNIT]
            result = minimize(
                lambda z: tuple(np.asarray(part) for part in cost(z)), start, jac=True, method="SLSQP", bounds=limits,
                constraints=constraint, options={"maxiter": ITERATIONS, "ftol": 1e-12},
            )  # fmt: skip
            omega = result.x[-3:] * RATE_UNIT
            balanced = np.abs(constraint["fun"](result.x)).max() < BALANCED and np.linalg.norm(omega) <= RATE_MOST
            same += balanced and abs(result.fun - best) < 1e-6
            if balanced and result.fun < best - 1e-9:
                u, length = np.zeros(len(e)), float(np.linalg.norm(omega))
                u[alive] = result.x[:-3]
                turns = length > 10.0 * REST
                down = omega / length * (1.0 if omega[2] >= 0 else -1.0) if turns else np.array([0.0, 0.0, 1.0])
                best, best_z = result.fun, Hover(u, omega, down, e)
    return best_z


class Gains(NamedTuple):
    """K (n, 5 + n): commands per error of omega (3), of down (2, along `across`) and of the rotors' thrust shares (n). across (2, 3):
    unit vectors across down. slowest: how fast the slowest error fades [1/s]."""

    K: np.ndarray
    across: np.ndarray
    slowest: float


def design(airframe: Airframe, hover: Hover) -> Gains | None:
    """The regulator around a relaxed hover, or None when none holds it with the rotors that are left.

    Linearised by central differences: J d omega/dt = ..., d(down)/dt = -omega x down, df/dt = (u - f) / lag with the thrust shares f.
    """
    from scipy.linalg import LinAlgError, solve_continuous_are

    alive = np.flatnonzero(hover.effectiveness > DEAD)
    k, n = len(alive), len(hover.u)
    across = np.linalg.svd(hover.down[None])[2][1:]
    J_inverse = np.linalg.inv(airframe.J)

    def slope(s):
        omega, f = hover.omega + s[:3], hover.u.copy()
        f[alive] += s[5:]
        down = hover.down + across.T @ s[3:5]
        turning = J_inverse @ moments(airframe, hover.effectiveness, f, omega)[0]
        return np.concatenate([turning, across @ -np.cross(omega, down), -s[5:] / airframe.lag])

    step = 1e-5
    A = np.column_stack([(slope(step * v) - slope(-step * v)) / (2 * step) for v in np.eye(5 + k)])
    B = np.vstack([np.zeros((5, k)), np.eye(k) / airframe.lag])
    # The spin along down is free; rates across it and the direction of down are not.
    along = np.outer(hover.down, hover.down)
    Q_rate = (np.eye(3) - along) / RATE_SIZE**2 + along / SPIN_SIZE**2
    Q = np.zeros((5 + k, 5 + k))
    Q[:3, :3], Q[3:5, 3:5] = Q_rate, np.eye(2) / DOWN_SIZE**2
    R = np.eye(k) / COMMAND_SIZE**2
    try:
        P = solve_continuous_are(A, B, Q, R)
    except (LinAlgError, ValueError):
        return None
    K_alive = np.linalg.solve(R, B.T @ P)
    slowest = -float(np.linalg.eigvals(A - B @ K_alive).real.max())
    if not np.isfinite(K_alive).all() or slowest < SLOWEST:
        return None
    K = np.zeros((n, 5 + n))
    K[np.ix_(alive, np.append(np.arange(5), 5 + alive))] = K_alive
    return Gains(K, across, slowest)


class Turning(NamedTuple):
    """The regulator's state: f (n,), thrust shares that the rotors should have reached."""

    f: Array


def feedback(hover: Hover, gains: Gains, f, omega, down, lift):
    """u (n,) of the regulator: hover's commands times `lift`, corrected. f (n,): thrust shares that the rotors have reached. All
    of it may be traced."""
    base = hover.u * lift
    errors = jnp.concatenate([omega - hover.omega, gains.across @ (down - hover.down), f - base])
    return jnp.clip(base - gains.K @ errors, 0.0, 1.0)


class SpinningHover:
    """Holds a relaxed hover: `init() -> state`, `step(state, omega, down, lift) -> (state, u)`, both pure, and C like estimators."""

    name = "spinning_hover"

    def __init__(self, airframe: Airframe, effectiveness: Any, dt: float):
        """effectiveness (n,): what is left of each rotor; dt [s]: a step's length. Raises ConfigError where such a vehicle cannot hover
        even while turning."""
        hover = relaxed_hover(airframe, effectiveness)
        gains = design(airframe, hover) if hover else None
        if hover is None or gains is None:
            raise ConfigError("This vehicle cannot hover with these losses, not even while turning: land it or save it otherwise.")
        self.dt = float(checks.positive("dt", dt))
        self.hover, self.gains, self.n = hover, gains, len(hover.u)
        self.keep = math.exp(-self.dt / airframe.lag)

    def init(self) -> Turning:
        """Rotors at their hover commands."""
        return Turning(jnp.asarray(self.hover.u))

    def step(self, state: Turning, omega, down, lift=1.0) -> tuple[Turning, Array]:
        """Commands (n,), shares of full thrust. omega (3,): body rates [rad/s]. down (3,): the direction, in body axes, that
        the body is to turn about: gravity's to stay in place, tilted from it to accelerate. lift: demanded thrust, 1 carries the weight."""
        u = feedback(self.hover, self.gains, state.f, omega, down, lift)
        return Turning(u + (state.f - u) * self.keep), u
