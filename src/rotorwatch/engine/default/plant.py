"""Commanded wrench = what the motion needed + slow disturbances + what faulty rotors did not deliver.

The default diagnoser's plant. Nothing of the vehicle but its geometry is needed: for each axis a of roll, pitch, yaw and thrust

    y_a = G_a m_a + c_a r_a + l f_a + n k v + b1_a + b2_a + b3_a + sum_i B_ai T_i theta_i + noise

y = B T: commanded wrench; T (n,): commanded thrusts (hover thrust of one rotor = 1); m: angular acceleration [rad/s^2], and for
thrust the load factor times n; r: angular rate [rad/s] (damping, none for thrust); f: side force per mass [m/s^2], -right for roll
and forward for pitch, with one l; b1, b2: coloured disturbances with time
constants TAU (gusts, and what the controller makes of them); b3: slow drift (wind,
centre of mass, battery), a random walk. theta_i: loss of rotor i. Per axis the state is (b1, b2, b3, G, c). It is linear
in the state for given u, and in theta. Air that pushes the vehicle to one side pushes at its rotors, at each in proportion to its
speed (Martin and Salaun, ICRA 2010): unequal rotors yaw in wind, and the part of one that is gone is missing, `drag`. Air along the
thrust axis takes thrust where the vehicle climbs along that axis, by the rotors' inflow and the body's drag, and adds some where it
sinks: n k v, with v the speed along the axis over ground. Wind is not known; what it adds while the tilt stays as it is is in b3. A weak
rotor loses as much of this as a whole one. On coaxial frames the lower rotors of all arms give a share s more than B says, which is one
more state: y_a - ... - s (dB/ds T)_a, with B kept such that hover takes the same command.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.engine.estimator import plant as definition
from rotorwatch.engine.estimator.plant import (  # noqa: F401 - the method's constants stand in its definition
    AIR,
    ANSWER_S,
    BUILT_SD,
    BURST_S,
    CURVE,
    DAMPING_RATE,
    DAMPING_RATE_SD,
    DRAG,
    INFLOW,
    INFLOW_SD,
    PER_AXIS,
    SHARE_SD,
    SIDE,
    SIDE_SD,
    SIDEWAYS,
    TAU,
    USUAL_S,
)

B1, B2, B3, GAIN, DAMPING = range(PER_AXIS)
AXES = ("roll", "pitch", "yaw", "thrust")

# What any multirotor is like, in these units. Angular gains of roll, pitch and yaw, per rotor: squared radius of gyration over
# g times the arm (over g times the propellers' drag ratio for yaw), 3 to 60 cm arms. Motion dies out, at DAMPING_RATE in
# 1/s, from air through the rotors and past the body: damping is that rate times the gain, whatever the gain turns out to be.
# Thrust against load factor is one to one by the choice of unit.
GAIN_MEAN = np.array(definition.GAIN_MEAN)
GAIN_SD = np.array(definition.GAIN_SD)
BIAS_SD = np.array(definition.BIAS_SD)
AXIS_STATES = 4 * PER_AXIS


class WrenchBalance:
    """n rotors with effectiveness matrix B (4, n). x (22,), u (n + 13,): see `pack`; theta (n,) loss; y (4,) wrench."""

    name = "wrench_balance"
    n_y = 4

    def __init__(self, B, prior=None, lower=None, share=None, curve=None, air=None):
        """prior: (mean (20,), covariance (20, 20)) from healthy flights (calibrate), else what any multirotor is like. lower (n,): 1 for
        the lower rotors of coaxial arms, None on other frames: with it, how much more or less than in B they all give is the last state,
        with mean and variance `share` (2,). curve, air (2,): mean and variance of how much the thrust curve is bent, and of what air along
        the thrust axis takes, where that is known."""
        self.B = B  # numpy, or traced: one compiled program serves every airframe with n rotors
        self.lower = lower
        self.n_theta = B.shape[1]
        self.n_u = self.n_theta + 13
        self.n_x = AXIS_STATES + 2 + (lower is not None)
        self._prior, self._share, self._curve, self._air = prior, share, curve, air

    @cached_property
    def prior(self):
        """(mean (n_x,), covariance (n_x, n_x)) of the state before anything is known; made when it is asked for, as `pack` needs none."""
        mean, P = any_multirotor(self.n_theta) if self._prior is None else self._prior
        mean, P = _widened(mean, P, any_curve() if self._curve is None else self._curve)
        mean, P = _widened(mean, P, any_air() if self._air is None else self._air)
        if self.lower is None:
            return mean, P
        return _widened(mean, P, np.array([0.0, SHARE_SD**2]) if self._share is None else self._share)

    @property
    def x0(self):
        """Mean of `prior`."""
        return self.prior[0]

    @property
    def P0(self):
        """Covariance of `prior`."""
        return self.prior[1]

    @property
    def x_names(self) -> tuple[str, ...]:
        """Name of every state."""
        names = tuple(
            "side force" if axis == "thrust" and what == "damping" else f"{axis}.{what}"
            for axis in AXES
            for what in ("b1", "b2", "b3", "gain", "damping")
        )
        return (*names, "thrust curve", "air from above", "lower rotors' share")[: self.n_x]

    def pack(self, ticks):
        """(T, n + 13) inputs of a table of ticks: `packed`."""
        return packed(ticks, self.n_theta)

    def C(self, u, usual=1.0):
        """(4, n_x) dy/dx. usual: mean thrust lately, about which the curve is bent."""
        from jax import numpy as jnp

        n = self.n_theta
        one = jnp.ones(4)
        rates = jnp.concatenate([u[n + 4 : n + 7], jnp.zeros(1)])
        rows = jnp.stack([one, one, one, u[n : n + 4], rates], axis=1)
        C = (jnp.eye(4)[:, :, None] * rows[:, None, :]).reshape(4, AXIS_STATES)
        push = jnp.stack([-u[n + 8], u[n + 7], *jnp.zeros(2)])
        C = C + push[:, None] * (np.arange(AXIS_STATES) == SIDEWAYS)
        C = jnp.concatenate([C, -(self.B @ self.bend(u, usual))[:, None], self.inflow(u)[:, None]], axis=1)
        if self.lower is None:
            return C
        return jnp.concatenate([C, -(self.B @ (self._more() * u[:n]))[:, None]], axis=1)

    def H(self, u, x=None, usual=1.0):
        """(4, n) dy/dtheta; where x (n_x,) is given, with the thrust curve and the lower rotors' share in it."""
        from jax import numpy as jnp

        thrust = (
            u[: self.n_theta] if x is None else jnp.maximum(u[: self.n_theta] + x[CURVE] * self.bend(u, usual), 0.0)
        )
        effect = self.B * thrust[None, :] + self.drag(u)
        return effect if x is None or self.lower is None else effect * (1.0 + x[-1] * self._more())[None, :]

    def bend(self, u, usual=1.0):
        """(n,) thrust that each rotor gives more where the curve's expo is a standard deviation larger, at the same commands, while that of
        the command that gives `usual` stays as it is: battery and air change that, too."""
        from jax import numpy as jnp

        n = self.n_theta
        full, expo, sd = jnp.maximum(u[n + 9], 1e-3), u[n + 10], u[n + 11]
        share = jnp.concatenate([jnp.clip(u[:n] / full, 0.0, 1.0), (usual / full)[None]])
        straight = 1.0 - expo
        command = 2.0 * share / (jnp.sqrt(straight**2 + 4.0 * expo * share) + straight + 1e-9)
        more = command**2 - command
        return sd * full * (more[:n] - u[:n] / usual * more[n])

    def inflow(self, u):
        """(4,) wrench that 1 of `AIR` takes of all rotors at this speed along the thrust axis; 0 where that is not known."""
        from jax import numpy as jnp

        axial = u[self.n_theta + 12]
        return jnp.zeros(4).at[AXES.index("thrust")].set(self.n_theta * jnp.where(jnp.isnan(axial), 0.0, axial))

    def drag(self, u):
        """(4, n) yaw that each rotor's drag in the plane of the rotors makes; of all of them together, what a healthy vehicle need not be
        commanded."""
        from jax import numpy as jnp

        n = self.n_theta
        place = self.B[:2] / self.B[3]
        apart = jnp.sqrt(((place[:, :, None] - place[:, None, :]) ** 2).sum(axis=0))
        gap = jnp.where(one_arm(self.B), jnp.inf, apart).min()
        across = place[0] * u[n + 7] + place[1] * u[n + 8]
        yaw = DRAG / (gap * G0) * jnp.sqrt(jnp.maximum(u[:n], 0.0)) * across
        return jnp.zeros((4, n)).at[AXES.index("yaw")].set(yaw)

    def _more(self):
        """(n,) by how much each rotor's thrust grows with the share. The unit of thrust stays the hover command: what the lower rotors
        give more, all give less."""
        return self.lower - (self.B[3] * self.lower).mean()

    def f(self, x, u, theta, dt):
        """State after dt: disturbances decay, the rest stays."""
        return self.decay(dt) * x

    def h(self, x, u, theta):
        """Commanded wrench (4,)."""
        return self.C(u) @ x + self.H(u) @ theta - self.drag(u).sum(axis=1)

    def decay(self, dt):
        """(n_x,) diagonal of the state transition: constant for a dt that is known, traced for one that is not."""
        numpy, left = arrays(dt), fading(dt)
        row = numpy.concatenate([left, np.ones(PER_AXIS - 2)])
        return numpy.concatenate([numpy.tile(row, 4), np.ones(self.n_x - AXIS_STATES)])


def packed(ticks, n: int) -> np.ndarray:
    """(T, n + 13) inputs of a table of ticks of n rotors: thrusts, angular accelerations, n times load factor, angular rates, side forces
    forward and right [m/s^2], full thrust of a rotor, expo of the thrust curve and its standard deviation, speed along the thrust axis
    [m/s; NaN: not known]. Thrusts in hover thrusts."""
    load = ticks.load[:, None] * n
    side = np.zeros((len(load), 2)) if ticks.side is None else ticks.side
    full = 1.0 / ticks.hover[:, None]
    curve = np.broadcast_to(np.asarray(ticks.curve, float), (len(load), 2))
    axial = np.full((len(load), 1), np.nan) if ticks.axial is None else ticks.axial[:, None]
    return np.concatenate([ticks.thrust, ticks.rate_dot, load, ticks.rate, side, full, curve, axial], axis=1)


def arrays(dt):
    """The module that computes with dt: NumPy for a number that is known, jax.numpy for one that is traced."""
    if isinstance(dt, int | float | np.ndarray | np.generic):
        return np
    from jax import numpy as jnp

    return jnp


def fading(dt):
    """(2,) share of b1 and b2 that is left after dt seconds: constant for a dt that is known, traced for one that is not."""
    return arrays(dt).exp(-dt / np.array(TAU))


def any_multirotor(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(mean (20,), covariance (20, 20)) of the state before anything is known of a vehicle with n rotors."""
    mean, P = np.zeros((4, PER_AXIS)), np.zeros((4, PER_AXIS, 4, PER_AXIS))
    for axis in range(4):
        gain, sd = (n * GAIN_MEAN[axis], n * GAIN_SD[axis]) if axis < 3 else (1.0, GAIN_SD[axis])
        rate, rate_sd = (DAMPING_RATE, DAMPING_RATE_SD) if axis < 3 else (0.0, 0.0)
        mean[axis, GAIN], mean[axis, DAMPING] = gain, rate * gain
        P[axis, B3, axis, B3] = BIAS_SD[axis] ** 2
        P[axis, GAIN, axis, GAIN] = sd**2
        P[axis, GAIN, axis, DAMPING] = P[axis, DAMPING, axis, GAIN] = rate * sd**2
        P[axis, DAMPING, axis, DAMPING] = (rate * sd) ** 2 + rate_sd**2 * (gain**2 + sd**2)
    mean, P = mean.reshape(-1), P.reshape(4 * PER_AXIS, 4 * PER_AXIS)
    mean[SIDEWAYS], P[SIDEWAYS, SIDEWAYS] = n * SIDE, (n * SIDE_SD) ** 2
    return mean, P


def _widened(mean, P, one):
    """The prior with one more state, of mean one[0] and variance one[1]. Also of traced arrays."""
    k = len(P)
    if all(isinstance(a, np.ndarray) for a in (mean, P, one)):
        wide = np.zeros((k + 1, k + 1))
        wide[:-1, :-1], wide[-1, -1] = P, one[1]
        return np.append(mean, one[0]), wide
    from jax import numpy as jnp

    last = jnp.zeros(k + 1).at[-1].set(one[1])
    wide = jnp.concatenate([jnp.concatenate([P, jnp.zeros((k, 1))], axis=1), last[None]])
    return jnp.concatenate([mean, jnp.asarray(one[:1])]), wide


def lower_rotors(B: np.ndarray) -> np.ndarray | None:
    """(n,) 1 for each rotor that stands where a stronger one does: the lower ones of coaxial arms. None where there are none."""
    lower = (one_arm(B) & (B[3][None, :] > 1.02 * B[3][:, None])).any(axis=1)
    return lower.astype(float) if lower.any() else None


def one_arm(B):
    """(n, n) bool: which rotors of effectiveness B (4, n), also a traced one, stand in the same place; each does with itself."""
    place = B[:2] / B[3]
    return abs(place[:, :, None] - place[:, None, :]).max(axis=0) < 0.05


def any_curve() -> np.ndarray:
    """(2,) mean and variance of how much a thrust curve is bent, before anything has been seen of it."""
    return np.array([0.0, 1.0])


def any_air() -> np.ndarray:
    """(2,) mean and variance of what air along the thrust axis takes, before anything has been seen of it."""
    return np.array([INFLOW, INFLOW_SD**2])


def usual_gains(n: int) -> np.ndarray:
    """(4,) gains of an n-rotor vehicle that nothing is known of."""
    return any_multirotor(n)[0].reshape(4, PER_AXIS)[:, GAIN]
