"""Closed-loop flights of a hexarotor that loses effectiveness: hover, and a figure-eight near 4 m/s with the nose on a fixed point.

The truth is a rigid body with ideal rotors, integrated by RK4 at half the control step; it shares no code with any plant.
NED, FRD, SI; quaternion Hamilton, body to world. The controller sees the true position and attitude and the noisy gyro. It
allocates by a bounded weighted least squares in which yaw yields first (reduced attitude: a hexarotor with alternating spins
survives the loss of a rotor only so), and knows the true effectiveness BELIEVED_AFTER_S after the fault.
Source: Niermeyer, Pak and Lohmann 2017, sections 2.1 and 2.2, for airframe, path and sensors; the controller is ours.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.experiments.studies.runge_kutta import rk4
from rotorwatch_lab.simulation.rotation import axes, rate, to_body, to_world

DT = 0.005
ONSET_S = 6.0
BELIEVED_AFTER_S = 0.6
PERIOD_S = 7.0  # of the figure-eight
EIGHT = (4.0, 2.0, 0.8)  # half lengths forward, right, down [m]
LOOKED_AT = (0.0, 9.0, 0.0)  # where the nose points [m]
BANDWIDTH = (1.2, 1.4, 7.0, 20.0)  # position, velocity, attitude, rate [1/s]
YAW_BANDWIDTH = (2.0, 5.0)  # heading, yaw rate [1/s]
WEIGHT = (1.0, 1.0, 0.5, 0.3)  # allocation: roll, pitch, yaw [per N m], thrust [per N]; yaw yields first
REDUCED_WEIGHT = (1.0, 1.0, 0.1, 0.3)  # once a rotor is dead
DEAD = 0.1  # effectiveness
FRUGAL = 1e-5  # allocation: prefers small commands
SWEEPS = 15  # of coordinate descent, in the allocation


class Flight(namedtuple("Flight", "t u y omega position effectiveness")):
    """t (T,), u (T, n) commands, y (T, 4) noisy (omega, f_z), omega (T, 3), position (T, 3), effectiveness (T, n). Row k: u is held over
    the step that ends at t; the others are values at its end."""


def reference(t, eight):
    """Position, velocity, acceleration (3,) and the point looked at, at time t; eight 0 is hover, 1 the figure-eight."""
    jnp = load_jax().numpy
    w = 2 * np.pi / PERIOD_S
    turns, phase = np.array([1.0, 2.0, 1.0]) * w, np.array([0.0, 0.0, 0.7])
    a = eight * np.array(EIGHT)
    angle = turns * t + phase
    return a * jnp.sin(angle), a * turns * jnp.cos(angle), -a * turns**2 * jnp.sin(angle)


def effectiveness(t, loss):
    """1 before ONSET_S, 1 - loss after."""
    jnp = load_jax().numpy
    return 1.0 - jnp.where(t >= ONSET_S, 1.0, 0.0) * loss


def allocate(B, v, weight):
    """u in [0, 1] (n,) that minimises |weight (B u - v)|^2 + FRUGAL |u|^2: the weighted pseudo-inverse while that is within
    the limits, else coordinate descent from there."""
    jax = load_jax()
    jnp = jax.numpy
    A = weight[:, None] * B
    H, b = A.T @ A + FRUGAL * jnp.eye(B.shape[1]), A.T @ (weight * v)
    start = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(H), True), b)

    def sweep(_, u):
        for i in range(B.shape[1]):
            u = u.at[i].set(jnp.clip(u[i] + (b[i] - H[i] @ u) / H[i, i], 0.0, 1.0))
        return u

    return jax.lax.fori_loop(0, SWEEPS, sweep, jnp.clip(start, 0.0, 1.0))


def fly(airframe, loss, eight, seed_noise, disturbance):
    """Simulate a flight. airframe: the tables of an airframe file as arrays; loss (n,); eight 0 or 1; seed_noise (T, 4) standard normal;
    disturbance (T, 3) torque [N m] held over each step. Returns a `Flight`. Pure: vmap over loss, noise and so on."""
    jax = load_jax()
    jnp = jax.numpy
    x, y, spin = airframe["x"], airframe["y"], airframe["spin"]
    m, J, T, kappa = airframe["mass"], airframe["inertia"], airframe["thrust_max"], airframe["drag_ratio"]
    B = T * jnp.stack([-y, x, kappa * spin, jnp.ones_like(x)])
    sd = jnp.concatenate([jnp.broadcast_to(airframe["gyro_sd"], (3,)), jnp.reshape(airframe["accel_sd"], (1,))])
    down = np.array([0.0, 0.0, 1.0])

    def motion(state, u, lam, torque):
        _, v, q, omega = state
        wrench = B @ (lam * u)
        a = down * G0 - to_world(axes(q), down * wrench[3] / m)
        spin_up = (wrench[:3] + torque - jnp.cross(omega, J * omega)) / J
        return v, a, rate(q, omega), spin_up

    def moved(state, u, lam, torque, dt):
        p, v, q, omega = rk4(lambda s: motion(s, u, lam, torque), state, dt)
        return p, v, q / jnp.sqrt(q @ q), omega

    def control(state, gyro, integral, t, known):
        p, v, q, _ = state
        R = axes(q)
        p_ref, v_ref, a_ref = reference(t, eight)
        kp, kv, ka, kr = BANDWIDTH
        error = p_ref - p
        want = a_ref + kv * (v_ref - v + kp * error) + 0.4 * integral
        force = want - down * G0
        size = jnp.sqrt(force @ force)
        tilt = jnp.cross(down, to_body(R, -force / size))  # sine of the angle, about the axis to turn
        nose = to_world(R, np.array([1.0, 0.0, 0.0]))
        to = jnp.asarray(LOOKED_AT) - p
        heading = jnp.arctan2(nose[0] * to[1] - nose[1] * to[0], nose[0] * to[0] + nose[1] * to[1])
        turning = jnp.array([ka * tilt[0], ka * tilt[1], YAW_BANDWIDTH[0] * heading])
        gain = jnp.array([kr, kr, YAW_BANDWIDTH[1]])
        torque = J * gain * (turning - gyro) + jnp.cross(gyro, J * gyro)
        thrust = -m * force @ to_world(R, down)
        reduced = jnp.min(known) < DEAD  # keep the tilt and let the heading go
        weight = jnp.where(reduced, np.array(REDUCED_WEIGHT), np.array(WEIGHT))
        return allocate(B * known, jnp.concatenate([torque, thrust[None]]), weight), integral + DT * error

    def step(carry, row):
        state, integral, u = carry
        t, noise, torque = row
        lam = effectiveness(t - DT / 2, loss)
        for _ in range(2):
            state = moved(state, u, lam, torque, DT / 2)
        y_k = jnp.concatenate([state[3], -(B[3] @ (lam * u))[None] / m]) + sd * noise
        believed = effectiveness(t - BELIEVED_AFTER_S, loss)
        u_next, integral = control(state, y_k[:3], integral, t, believed)
        return (state, integral, u_next), Flight(t, u, y_k, state[3], state[0], lam)

    p, v, _ = reference(0.0, eight)
    hover = jnp.full(x.shape, m * G0 / (T * x.size))
    # The nose on the point looked at: a turn about the vertical.
    half = 0.5 * jnp.arctan2(LOOKED_AT[1] - p[1], LOOKED_AT[0] - p[0])
    q = jnp.stack([jnp.cos(half), 0.0, 0.0, jnp.sin(half)])
    time = DT * np.arange(1, len(seed_noise) + 1)
    start = ((p, v, q, jnp.zeros(3)), jnp.zeros(3), hover)
    return jax.lax.scan(step, start, (time, seed_noise, disturbance))[1]


def arrays(airframe: dict) -> dict:
    """The tables of an airframe file as one flat dictionary of arrays, for `fly`."""
    rotors = {k: np.array(airframe["rotors"][k], float) for k in ("x", "y", "spin")}
    rest = ("mass", "inertia", "thrust_max", "drag_ratio", "gyro_sd", "accel_sd")
    return rotors | {k: np.array(airframe[k], float) for k in rest}


def noise(seeds, count: int, torque_sd=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Sensor noise (seeds, count, 4) in standard deviations, and white disturbance torques (seeds, count, 3) [N m], torque_sd
    in N m per square root of Hz."""
    rng = [np.random.default_rng(seed) for seed in seeds]
    y = np.stack([r.standard_normal((count, 4)) for r in rng])
    return y, torque_sd / np.sqrt(DT) * np.stack([r.standard_normal((count, 3)) for r in rng])
