"""Performance limits of any diagnoser: a bound on the error of a loss, and one on the delay of its detection.

Both follow from one number: how much the data up to a time tell about a jump of one actuator's loss at a known time,

    I(t) = sum_k phi_k' S_k^-1 phi_k

with S_k the innovation variances of the Kalman filter that knows of no jump, and phi_k what a unit jump does to its innovations
(Willsky and Jones, IEEE TAC 21(1), 1976). 1 / I is the variance with which the filter that has this loss in its state ends,
all else unknown as before: the posterior Cramer-Rao bound (Tichavsky, Muravchik and Nehorai, IEEE TSP 46(5), 1998), whose
recursion it is for additive Gaussian noise. And theta^2 I / 2 is the information (Kullback-Leibler) in favour of the jump
over none, on which the delay of Page's CUSUM depends, the optimal rule for a known change (Moustakides, Ann. Statist. 14, 1986):

    mean time to a false alarm   (e^h - h - 1) / r        mean delay: until the information is  h - 1 + e^-h

for a threshold h and r information per time (Shiryaev 1996; the limit of many small samples).
"""

from __future__ import annotations

import functools
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import PER_AXIS, PLANT_STATES, program
from rotorwatch_lab.experiments import known_losses
from rotorwatch_lab.experiments.known_losses import KNOWN_LOSSES

Array = Any


class Rows(namedtuple("Rows", "A G C H Q R")):
    """Matrices of one step: x' = A x + G theta + w, var w = Q; y = C x + H theta + v, var v = R.

    A (n, n), or (n,) where it is diagonal; G (n,); C (m, n); H (m,); Q (n, n); R (m,).
    """


def information(model: Callable[[Any], Rows], rows: Any, P0: Array, valid: Array, onset: Array) -> Array:
    """(T,) information I on a jump of theta at step `onset` that the measurements up to each step hold.

    model: what `Rows` a row of `rows` (a pytree of (T, ...) arrays) stands for. P0 (n, n): covariance before the first step. valid
    (T, m) bool. Pure: to be compiled and mapped over flights.
    """
    jax = load_jax()
    jnp = jax.numpy

    def step(carry, row):
        P, M, total, k = carry
        row, ok = row
        A, G, C, H, Q, R = model(row)
        begun = jnp.where(k >= onset, 1.0, 0.0)
        P = (A[:, None] * P * A[None, :] if A.ndim == 1 else A @ P @ A.T) + Q
        M = (A * M if A.ndim == 1 else A @ M) + begun * G
        for a in range(C.shape[0]):
            Pc = P @ C[a]
            S = C[a] @ Pc + R[a]
            w = jnp.where(ok[a], 1.0 / S, 0.0)
            phi = C[a] @ M + begun * H[a]
            total = total + w * phi * phi
            M = M - Pc * (w * phi)
            P = P - w * (Pc[:, None] * Pc[None, :])
        return (0.5 * (P + P.T), M, total, k + 1), total

    P0 = jnp.asarray(P0)
    carry = (P0, jnp.zeros(P0.shape[0]), jnp.zeros(()), jnp.int32(0))
    return jax.lax.scan(step, carry, (rows, valid))[1]


def loss_sd(information, prior_sd: float = np.inf):
    """Posterior Cramer-Rao bound: the least standard deviation of the loss. prior_sd: what was known before."""
    with np.errstate(divide="ignore"):
        return 1.0 / np.sqrt(np.asarray(information, float) + prior_sd**-2.0)


def cusum(rate, false_alarm_period) -> tuple[Array, Array]:
    """(threshold h, information needed) of the CUSUM with that mean time between false alarms; arrays or numbers.

    rate: information per time, rate * false_alarm_period is all that counts. A rule with the same time between false alarms
    detects on average no sooner than when theta^2 I / 2 reaches the information needed. Raises ConfigError unless both are above 0.
    """
    wanted = np.asarray(rate, float) * false_alarm_period
    if not np.all(np.isfinite(wanted) & (wanted > 0.0)):
        raise ConfigError("rate and false_alarm_period must be above zero.")
    low, high = np.zeros_like(wanted), np.maximum(1.7, np.log(2.0 * wanted))  # e^h - h - 1 > e^h / 2 from 1.7 on
    h = high
    for _ in range(60):
        h = 0.5 * (low + high)
        short = np.expm1(h) - h < wanted
        low, high = np.where(short, h, low), np.where(short, high, h)
    return h, h + np.expm1(-h)


def delay(time: Array, information: Array, theta: float, onset: float, false_alarm_period: float) -> float:
    """Least mean delay [s] of a detection of the loss theta: when there is enough information; inf when there never is.

    time (T,): when each step is known. information (T,): of `information`. onset, false_alarm_period [s]. The information comes
    unevenly; the threshold is that of its mean rate up to the detection.
    """
    kl = 0.5 * theta * theta * np.asarray(information, float)
    since = np.asarray(time, float) - onset
    usable = (since > 0.0) & (kl > 0.0)
    if not usable.any():
        return float("inf")
    enough = kl[usable] >= cusum(kl[usable] / since[usable], false_alarm_period)[1]
    return float(since[usable][np.argmax(enough)]) if enough.any() else float("inf")


class Bound(namedtuple("Bound", "information variances")):
    """Bound of one flight on its ticks: information (T,) on the loss, and the noise variances (4, 4) it holds for
    (engine/estimator/noise.py)."""


@functools.lru_cache(maxsize=4)
def _program():
    jax = load_jax()
    jnp = jax.numpy

    def one(decay, P0, C, H, Q, R, flying, valid, onset):
        def model(row) -> Rows:
            C, H, fly = row
            return Rows(decay, jnp.zeros(decay.size), C, H, jnp.diag(jnp.where(fly, Q, 0.0)), R)

        return information(model, (C, H, flying), P0, valid, onset)

    return jax.jit(jax.vmap(one, in_axes=(None, None, *[0] * 7)))


def on_ticks(B, u, y, valid, flying, theta, rotor, onset, dt: float, batch: bool = False) -> Bound:
    """The bound for a diagnoser that has these ticks: plant and noise model are the default estimator's (engine/estimator/plant.py), its
    noise that of the whole flight with the true losses taken out, the rotor and the onset known.

    B (4, n), u (T, n + 13), y (T, 4), valid (T, 4), flying (T,) bool; theta (T, n) true losses; rotor (0-based), onset (first tick with
    the loss): integers. batch: all but B have a first axis of flights. Arrays of NumPy.
    """
    rows = [np.asarray(a) for a in (u, y, valid, flying, theta, rotor, onset)]
    u, y, valid, flying, theta, rotor, onset = rows if batch else (a[None] for a in rows)
    known, states = program.steps(dt, B), PLANT_STATES
    decay, P0 = known.plant["decay"][0, :states], known.plant["variance"][0]
    C, H, Q, R, variances = [], [], [], [], []
    for k in range(len(u)):
        h, _ = balance(u[k], known.plant)
        lost = np.einsum("tai,ti->ta", h[:, :, states:], theta[k])
        learned = noise_of(u[k], np.where(valid[k], y[k], 0.0) - lost, valid[k], flying[k], known.plant)
        C.append(h[:, :, :states])
        H.append(h[:, :, states + rotor[k]])
        Q.append(_walks(learned, known.plant["left"][0], dt))
        R.append(learned[0])
        variances.append(learned)
    bounds = _program()(decay, P0, *map(np.stack, (C, H, Q, R)), flying, valid, onset)
    bound = Bound(np.asarray(bounds), np.stack(variances))
    return bound if batch else Bound(bound.information[0], bound.variances[0])


def balance(u: np.ndarray, vehicle: Any) -> tuple[np.ndarray, np.ndarray]:
    """h (T, 4, n_x + n) and drag (T, n): the wrench of a tick is h [x; theta], in yaw less the sum of drag, for a state without another
    share. u (T, n + 13 or more): as `program.inputs` begins; vehicle: the plant of the default estimator's `Steps`."""
    n = int(vehicle["rotors"][0])
    out = KNOWN_LOSSES.array(known_losses.Rows, len(u))
    KNOWN_LOSSES.call(known_losses.measure, _plant(vehicle), len(u), _ticks(u, n), out)
    return out["h"][:, :, : PLANT_STATES + n], out["drag"][:, :n]


def noise_of(u: np.ndarray, y: np.ndarray, valid: np.ndarray, flying: np.ndarray, vehicle: Any) -> np.ndarray:
    """Variances (4, 4) of the noise in ticks without losses: y (T, 4) is the wrench less their effect; flying (T,); else as `balance`."""
    model = KNOWN_LOSSES.new(known_losses.Noise)
    ticks = _ticks(u, int(vehicle["rotors"][0]), wrench=y, valid=valid.astype(bool))
    KNOWN_LOSSES.call(known_losses.learn, _plant(vehicle), len(u), ticks, np.ascontiguousarray(flying, bool), model)
    return model["v"][0] / model["safety"][0]


def _plant(vehicle: Any) -> Any:
    """The default estimator's plant, for this definition."""
    made, given = KNOWN_LOSSES.new(known_losses.Plant), ("rotors", "dt", "effect", "lower", "mean", "variance", "noise", "noise_weight")
    made.set(**{name: vehicle[name][0] for name in given})
    return made


def _ticks(u: np.ndarray, n: int, **measured: np.ndarray) -> Any:
    """Inputs of the ticks. measured: their wrench and its validity."""
    made = KNOWN_LOSSES.array(known_losses.Inputs, len(u))
    made.fill(
        thrust=u[:, :n], turn=u[:, n : n + 3], load=u[:, n + 3], rate=u[:, n + 4 : n + 7], forward=u[:, n + 7], right=u[:, n + 8],
        full=u[:, n + 9], expo=u[:, n + 10], expo_sd=u[:, n + 11], axial=np.nan_to_num(u[:, n + 12]), **measured,
    )  # fmt: skip
    return made


def _walks(variances: np.ndarray, left: np.ndarray, dt: float) -> np.ndarray:
    """(n_x,) process noise variances of a tick: coloured disturbances stay as large as they are, the drift walks."""
    Q = np.zeros(PLANT_STATES)
    grows = variances[1:] * np.append(1.0 - left**2, dt)[:, None]
    for a in range(4):
        Q[a * PER_AXIS : a * PER_AXIS + 3] = grows[:, a]
    return Q
