"""Intermediate observer: states and actuator faults by a proportional-integral observer, losses by allocation of the faults.

    x- = f(x, u, 0) + G fault,   e = y - h(x-, u, 0) - direct fault,   x = x- + K_x e,   fault <- fault + K_f e
    fault = Phi theta, with Phi = df/dtheta (and dh/dtheta) passed through the very filter that the fault went through

The paper writes it with an intermediate variable tau = fault - S x, S = alpha E', which is the same: maths/intermediate_design.py.
A state that losses drive has the gains k1, k2 of a sampled double pole; h that feels losses directly (an accelerometer) is
passed through the same filter. Dividing by filtered Phi instead of the present one keeps a loss still while commands move.

Source: Nguyen, Huynh, Do, Mung and Hong, Robust fault estimation using the intermediate observer: application to the
quadcopter, Sensors 20 (2020) 4917, eqs. (11)-(14), (30)-(38). What it prints and what is built: docs/methods/intermediate.md.
"""

from __future__ import annotations

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import intermediate_design as design
from rotorwatch_lab.maths import linearise, plant
from rotorwatch_lab.maths.faulty_allocation import CHANNELS, LeastSquares, Sparse, Temporal
from rotorwatch_lab.maths.small import symmetric

GAINS = {"exact": design.exact_gains, "euler": design.euler_gains}
ALLOCATIONS = ("auto", "least_squares", "sparse", "temporal")
SEEN = 1e-9  # share of the largest derivative below which a loss does nothing to a channel


class Filter(namedtuple("Filter", "value lag")):
    """Regressors value (n_x + n_y, n_theta) as the faults are filtered, and lag: the filter's other state."""


class Carry(NamedTuple):
    """x (n_x,); P (2 n_x, 2 n_x): covariance that noise gives (x, state fault); fault (n_x + n_y,): what losses do to states [per
    s] and to measurements; lag (n_y,), regressor: see Filter; direct (3, n_y), late (3,): variances of (lag, fault) from noise
    and from losses that change; known (n_x + n_y,): measured once; started; allocation: the rule's; ambiguity (int32): how many sets of
    rotors explain the faults as well."""

    x: Array
    P: Array
    fault: Array
    lag: Array
    regressor: Filter
    direct: Array
    late: Array
    known: Array
    started: Array
    allocation: tuple
    ambiguity: Array


class Intermediate:
    """Intermediate observer on any plant whose losses drive measured states or measurements."""

    name = "intermediate"
    not_kalman = "its gains are placed poles, not the noise's ratio, and losses are read from the faults after filtering"

    def __init__(
        self,
        system,
        dt,
        *,
        alpha=1.0,
        position_rate=10.0,
        velocity_rate=20.0,
        yaw_gain=1.0,
        allocation="auto",
        matched=True,
        discretisation="exact",
        drift_sd=0.02,
        loss_sd=0.3,
        sparsity=9.0,
        memory_s=10.0,
    ):
        """dt: s. alpha [1/s]: speed of the faults, settled in 2.2 s at 1 and 0.4 s at 5; velocity_rate, position_rate [1/s]: lv and lp,
        correction of states that losses drive and of other measured ones. yaw_gain: the paper's nu, "magnitude order balance".

        allocation: "least_squares", "sparse" (fewest rotors), "temporal" (memory of memory_s seconds) or "auto": sparse from
        five losses on. matched: divide by filtered commands, not by the present ones. discretisation: "exact" poles or "euler".
        drift_sd: how far a loss walks in a second; loss_sd: how large losses are; both for covariances. sparsity: chi-squared
        that one more faulty rotor must earn. Raises ConfigError for wrong values and where faults cannot be measured.
        """
        self.system, self.dt = plant.checked("The intermediate observer", system, dt), dt
        self.alpha = checks.positive("alpha", alpha)
        self.lp, self.lv = (checks.positive("position_rate", position_rate), checks.positive("velocity_rate", velocity_rate))
        self.drift, self.loss_sd = checks.positive("drift_sd", drift_sd), checks.positive("loss_sd", loss_sd)
        checks.one_of("discretisation", discretisation, GAINS)
        checks.one_of("allocation", allocation, ALLOCATIONS)
        self.gains, self.matched = GAINS[discretisation], matched
        if discretisation == "euler" and checks.concrete((dt, alpha, velocity_rate)):
            _stable(float(velocity_rate), float(alpha), float(dt))
        self.scale = self._yaw(checks.positive("yaw_gain", yaw_gain))
        with jax.ensure_compile_time_eval():  # values stay values inside compiled programs, where the plant has them
            self._look()
        self.allocate = _rule(system, allocation, float(sparsity), float(loss_sd), float(memory_s))

    def init(self) -> Carry:
        """The plant's start, no fault, nothing measured yet."""
        n_x, n_y, n = self.system.n_x, self.system.n_y, self.system.n_theta
        P = jnp.zeros((2 * n_x, 2 * n_x)).at[:n_x, :n_x].set(jnp.asarray(self.system.P0, float))
        none = jnp.zeros((n_x + n_y, n))
        return Carry(
            x=jnp.asarray(self.system.x0, float),
            P=P,
            fault=jnp.zeros(n_x + n_y),
            lag=jnp.zeros(n_y),
            regressor=Filter(none, none),
            direct=jnp.zeros((3, n_y)),
            late=jnp.array([0.0, 0.0, 1.0]) * self.loss_sd**2,
            known=jnp.zeros(n_x + n_y, bool),
            started=jnp.array(False),
            allocation=self.allocate.init(),
            ambiguity=jnp.int32(1),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then correct with y (n_y,) where valid."""
        system, n_x, none = self.system, self.system.n_x, jnp.zeros(self.system.n_theta)
        dt = self.dt if dt is None else dt
        kp, k1, k2 = self.gains(self.lp, self.lv, self.alpha, dt)
        R = system.R(u)

        # Predict: half of the fault's push before the plant's own step and half after is exact on double integrators.
        push, nu = 0.5 * dt * carry.fault[:n_x], self.scale[:n_x]
        move, F, Phi = linearise.transition(system, carry.x + push, u, none, dt)
        x = move + push + (nu - 1.0) * (move - carry.x - push)
        G = 0.5 * dt * (F + np.eye(n_x)) * self.driven
        y_, H, D = linearise.measurement(system, x, u, none)
        C, D = jnp.where(self.feels[:, None], 0.0, H), jnp.where(self.feels[:, None], D, 0.0)
        e = jnp.where(valid, y - y_ - carry.fault[n_x:], 0.0)
        seen, K_x, K_f, known = self._gains(carry.known, valid, kp, k1, k2)

        # Correct states and what losses do to them, then what they do to measurements, by the same filter.
        x, state_fault = x + K_x @ e, carry.fault[:n_x] + K_f @ e
        l1, l2, ldt = (jnp.where(self.feels & valid, g, 0.0) for g in (k1, k2, dt))
        ahead = carry.lag + ldt * e
        fault = jnp.concatenate([state_fault, carry.fault[n_x:] + l2 * ahead])

        # The error of (x, state fault) goes A, then J, for whatever gains (Joseph's form).
        K, constant = jnp.concatenate([K_x, K_f]), np.eye(2 * n_x)[n_x:]
        A = jnp.concatenate([jnp.concatenate([F, G], axis=1), constant])
        J = np.eye(2 * n_x) - jnp.concatenate([K @ C, np.zeros((2 * n_x, n_x))], axis=1)
        P_ = A @ carry.P @ A.T
        P_ = P_.at[:n_x, :n_x].add(system.Q(dt))
        P = symmetric(J @ P_ @ J.T + (K * R) @ K.T)

        # What happens to a fault happens to regressors, so that fault = regressor theta stays true while commands move.
        now = jnp.concatenate([Phi / dt * self.driven[:, None], D])
        value = jnp.where(carry.started, carry.regressor.value, now)
        missing = now - value
        lagging = J @ (A @ jnp.concatenate([carry.regressor.lag[:n_x], missing[:n_x]]))
        lagging_y = carry.regressor.lag[n_x:] + ldt[:, None] * missing[n_x:]
        value = jnp.concatenate([now[:n_x] - lagging[n_x:], value[n_x:] + l2[:, None] * lagging_y])
        regressor = Filter(value, jnp.concatenate([lagging[:n_x], (1.0 - l1)[:, None] * lagging_y]))
        Psi = value if self.matched else now

        direct = _block(carry.direct, l1, l2, ldt, R * ldt**2, 0.0)
        all_seen = jnp.where(seen, 1.0, 0.0)
        late = _block(carry.late, all_seen * k1, all_seen * k2, dt, 0.0, self.drift**2 * dt)

        noise = jnp.concatenate([jnp.diagonal(P)[n_x:], direct[2]]) / self.scale**2
        W = jnp.where(known & self.channel, 1.0 / (noise + self.least), 0.0)
        state, answer = self.allocate(carry.allocation, Psi, fault / self.scale, W, all_seen * dt)

        wide = P[n_x:, n_x:] / nu / nu[:, None]
        M_x, M_y = answer.M[:, :n_x], answer.M[:, n_x:]
        theta_cov = M_x @ wide @ M_x.T + (M_y * direct[2]) @ M_y.T + answer.spread + late[2] * np.eye(system.n_theta)
        slow = value[:n_x] * jnp.sqrt(late[0])
        loss_effect = C @ slow + value[n_x:] * jnp.sqrt(late[2])
        S = C @ P_[:n_x, :n_x] @ C.T + jnp.diag(R + direct[2]) + loss_effect @ loss_effect.T
        estimate = Estimate(
            x=x,
            x_cov=symmetric(P[:n_x, :n_x] + slow @ slow.T),
            theta=answer.theta,
            theta_cov=symmetric(theta_cov),
            innovation=e,
            innovation_cov=symmetric(S),
            status=jnp.where(self.mute & valid.any(), jnp.int32(1), linearise.status(valid)),
        )
        lag = (1.0 - l1) * ahead
        started = jnp.array(True)
        return Carry(x, P, fault, lag, regressor, direct, late, known, started, state, answer.count), estimate

    def _gains(self, known, valid, kp, k1, k2):
        """K_x, K_f (n_x, n_y) with what is measured now; whether every fault is; what has been measured by now."""
        n_x, use = self.system.n_x, valid & ~self.feels
        direct = jnp.where(self.feels, valid, True).all()
        if self.steady is not None:
            K_x, K_f = (jnp.where(use, K, 0.0) for K in self.steady)
            states = known[:n_x] | use.any()
            seen = jnp.where(self.feels, True, valid).all() & direct
        else:
            measured = self.measured & (use | ~self.needs).all(axis=1)
            first = measured & ~known[:n_x]  # a state's first measurement sets it
            rate = jnp.where(measured, jnp.where(first, 1.0, jnp.where(self.driven > 0, k1, kp)), 0.0)
            K_x = rate[:, None] * self.from_y
            K_f = (jnp.where(measured & ~first, k2, 0.0) * self.driven)[:, None] * self.from_y
            states = known[:n_x] | measured
            seen = jnp.where(self.driven > 0, measured, True).all() & direct
        return seen, K_x, K_f, jnp.concatenate([states, known[n_x:] | (self.feels & valid)])

    def _look(self) -> None:
        """Find the channels that losses act on, how states follow from measurements, and the gains where they do not."""
        system = self.system
        x0, u, theta = jnp.asarray(system.x0, float), jnp.ones(system.n_u), jnp.zeros(system.n_theta)

        Phi = _known(jax.jacfwd(lambda theta: linearise.rate(system, x0, u, theta))(theta))
        D = _known(jax.jacfwd(lambda theta: system.h(x0, u, theta))(theta))
        H = _known(jax.jacfwd(lambda x: system.h(x, u, theta))(x0))
        self.driven = 1.0 * _acts(Phi)  # (n_x,) 1 where losses drive a state
        self.feels = _acts(D)  # (n_y,) where a measurement feels losses at once
        self.channel = jnp.concatenate([self.driven > 0, self.feels])
        if checks.concrete(self.channel) and not self.channel.any():
            raise ConfigError(f"The intermediate observer finds no loss that does anything in the plant {checks.plant_name(system)}.")
        C = jnp.where(self.feels[:, None], 0.0, H)
        eye = np.eye(system.n_x)
        information = C.T @ C
        factor = jnp.linalg.cholesky(information + 1e-12 * (1.0 + jnp.max(jnp.diagonal(information))) * eye)
        self.from_y = jax.scipy.linalg.cho_solve((factor, True), C.T)  # (n_x, n_y) states from measurements
        self.from_y = _known(jnp.where(jnp.abs(self.from_y) > SEEN, self.from_y, 0.0))
        self.measured = _known(jnp.abs(jnp.diagonal(self.from_y @ C) - 1.0) < 1e-6)
        self.needs = _known(self.from_y != 0.0)
        self.steady = None
        blind = (self.driven > 0) & ~self.measured
        if checks.concrete(blind) and blind.any():
            self.steady = self._riccati(x0, u, theta)
        self.mute = blind.any() & (self.steady is None)  # only a plant without values yet: its faults are never seen
        # What one measurement's noise does to a fault: keeps weights finite while the covariance starts from nothing.
        k2, R = self.gains(self.lp, self.lv, self.alpha, self.dt)[2], jnp.asarray(system.R(u))
        K_f = k2 * self.from_y if self.steady is None else self.steady[1]
        self.least = jnp.concatenate([(K_f * K_f) @ R, (k2 * self.dt) ** 2 * R]) + 1e-30

    def _riccati(self, x0, u, theta):
        """Steady gains about the inputs that hold x0."""
        system = self.system
        at_x0, by_u = (np.asarray(part) for part in linearise.once(lambda u: linearise.rate(system, x0, u, theta), u))
        u = u - np.linalg.pinv(by_u) @ at_x0
        F = np.asarray(linearise.transition(system, x0, u, theta, self.dt).by_x)
        turning = np.where(np.abs(u) > SEEN, u, 1.0)  # an input that rests shows nothing of its losses
        Phi = np.asarray(linearise.transition(system, x0, turning, theta, self.dt).by_theta)
        H = np.asarray(linearise.measurement(system, x0, u, theta).by_x)
        driven = np.asarray(self.driven)
        Phi = Phi / self.dt * driven[:, None]
        G = 0.5 * self.dt * (F + np.eye(system.n_x)) * driven
        basis, size, _ = np.linalg.svd(Phi * self.loss_sd * self.alpha * np.sqrt(self.dt), full_matrices=False)
        E = (basis * size)[:, size > SEEN * size[0]]  # losses that walk by loss_sd alpha in a second
        H = np.where(np.asarray(self.feels)[:, None], 0.0, H)
        return design.riccati_gains(F, G, E, H, np.asarray(system.Q(self.dt)), np.asarray(system.R(u)))

    def _yaw(self, yaw_gain):
        """(n_x + n_y,) the paper's nu on the yaw rate's channel, 1 elsewhere."""
        here = np.array([name == "r" for name in getattr(self.system, "x_names", ())] or [False] * self.system.n_x)
        if checks.concrete(yaw_gain) and yaw_gain != 1.0 and not here.any():
            raise ConfigError(f"yaw_gain is for plants with a yaw rate called r; the plant {checks.plant_name(self.system)} has none.")
        return jnp.concatenate([jnp.where(here, yaw_gain, 1.0), jnp.ones(self.system.n_y)])


def _stable(lv: float, alpha: float, dt: float) -> None:
    """Euler's pole leaves the unit circle through -1 where lv dt (1 + alpha dt / 2) = 2."""
    if lv * dt * (1.0 + 0.5 * alpha * dt) >= 2.0:
        raise ConfigError(
            f"Euler's method is unstable for steps of {dt:g} s with velocity_rate = {lv:g}: keep velocity_rate * dt below 2, "
            "or choose exact."
        )


def _rule(system, allocation: str, sparsity: float, loss_sd: float, memory_s: float):
    """The allocation rule of that name; auto: least squares as long as four channels can determine the losses."""
    n = system.n_theta
    losses = sum(name.startswith("loss") for name in getattr(system, "theta_names", ())) or n
    if allocation == "auto":
        allocation = "least_squares" if n <= CHANNELS else "sparse"
    if allocation == "least_squares":
        return LeastSquares(n, loss_sd)
    if allocation == "sparse":
        return Sparse(n, losses, price=sparsity)
    return Temporal(n, losses, loss_sd, memory_s=memory_s)


def _block(V, k1, k2, dt, q, drift):
    """Next variances V = (lag, both, fault) of  lag <- (1 - k1)(lag + fault dt + q-noise),  fault <- fault - k2 (lag + fault dt)."""
    ee, ef, ff = V[0] + 2.0 * dt * V[1] + dt * dt * V[2] + q, V[1] + dt * V[2], V[2] + drift
    keep = 1.0 - k1
    return jnp.stack([keep * keep * ee, keep * (ef - k2 * ee), ff - 2.0 * k2 * ef + k2 * k2 * ee])


def _acts(derivative):
    """True for rows in which any loss has an effect."""
    size = abs(derivative).max(axis=1)
    return size > SEEN * size.max()


def _known(array):
    """A NumPy array where concrete, else the tracer."""
    return np.asarray(array) if checks.concrete(array) else array
