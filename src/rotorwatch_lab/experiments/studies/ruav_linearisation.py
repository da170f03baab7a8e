"""Feedback linearisation with the filter's coefficients, as in the paper's hardware-in-the-loop tests (figures 4 and 5).

The wanted accelerations nu of climb, roll, pitch and yaw are inverted through the model, one step of Newton's method from trim:

    U_out = U_trim + M^-1 (nu - (dw, dp, dq, dr)/dt at (x, U_trim)),   M = d(dw, dp, dq, dr)/dt / dU_out in hover
    U_in = trim command + (U_out - U_trim) g / (g^2 + h^2),   g, h: middle of gamma's bounds and their half-width, SURE at least

The coefficients are those a filter gives in the same step (`ruav_control.trim_command` is the rest of it), or a healthy helicopter's.
Source: Qi et al. 2015, "a feedback linearization control scheme"; its equations and gains are not printed and chosen here.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.experiments.studies import reproduction, ruav_control, ruav_filters, ruav_flight
from rotorwatch_lab.experiments.studies.reproduction import Claim, graded
from rotorwatch_lab.experiments.studies.ruav_flight import DT

STEPS, FAULT_STEP, SETTLE_S, DITHER = 1000, 400, 4.0, 0.1  # as long as figure 5's flight; a tenth of its dither
RATE, ATTITUDE_GAIN, CLIMB, STABLE = np.array([6.0, 6.0, 2.0]), np.array([9.0, 9.0]), 1.0, 0.3
LOST = 100.0  # m/s: what flies no more
MOVED = np.array([2, 3, 4, 5])  # w, p, q, r


def flight(estimator=None, seed: int = 0):
    """(x (T, 6) with a filter's coefficients, x (T, 6) with a healthy helicopter's): the coupled faults of figure 5, one program."""
    jax = load_jax()
    jnp = jax.numpy
    system = ruav_flight.plant()
    estimator = ruav_filters.filters(ruav_flight.plant(stops=False))["ekf"] if estimator is None else estimator
    inverse = np.linalg.inv(ruav_flight.hover(system)[1][MOVED, :4])
    push, error, wave = ruav_flight.weather(seed, STEPS)
    rows = push, error, DITHER * ruav_flight.DITHER * wave, np.arange(STEPS) == FAULT_STEP
    trim = jnp.asarray(system.trim)

    def one(informed):
        def step(state, row):
            truth, y, integral, filtered, gain, half, displaced = state
            push, error, dither, now = row
            attitude, heading = truth.attitude[:2], truth.attitude[2]
            roll, pitch, turn, climb, integral = ruav_control.position_loop(truth.place, heading, y[:3], y[5], integral)
            tilting = ATTITUDE_GAIN * (jnp.stack([roll, pitch]) - attitude) - RATE[:2] * y[3:5]
            nu = jnp.concatenate([CLIMB * climb[None], tilting, RATE[2] * (turn - y[5])[None]])
            at_trim = system.derivative(y, jnp.concatenate([trim, attitude]), jnp.zeros(8))[MOVED]
            known = jnp.where(informed, gain, 1.0), jnp.where(informed, half, 0.0), jnp.where(informed, displaced, 0.0)
            wanted = inverse @ (nu - at_trim) + trim
            U = ruav_control.trim_command(trim, *known, wanted)
            u, truth = truth.moved(system, jnp.clip(U + dither, 0.0, 1.0), push, now, ruav_flight.FAULT)
            y = truth.x + error
            filtered, z, P = ruav_filters.step(estimator, filtered, u, y)
            half = jnp.sqrt(jnp.maximum(jnp.diagonal(P), 0.0))[6:10]
            return (truth, y, integral, filtered, 1.0 - z[6:10], half, z[10:]), truth.x

        zero, start = jnp.zeros, ruav_filters.start(estimator)
        first = (ruav_flight.Truth.hover(), zero(6), zero(3), start, jnp.ones(4), zero(4), zero(4))
        return jax.lax.scan(step, first, rows)[1]

    program = jax.jit(one)
    return np.asarray(program(True)), np.asarray(program(False))


def numbers(flights) -> dict:
    """Largest rates [rad/s] before the fault and from SETTLE_S after it, with the filter's coefficients and without."""
    largest = {}
    for name, x in zip(("with_coefficients", "without"), flights, strict=True):
        rates = np.abs(x[:, 3:])
        after = rates[FAULT_STEP + round(SETTLE_S / DT) :].max(axis=0)
        largest[name] = {
            "rates_before": rates[100:FAULT_STEP].max(axis=0),
            "rates_after": after,
            "velocity_after": np.abs(x[FAULT_STEP + round(SETTLE_S / DT) :, :3]).max(),
            "stable": bool(after.max() < STABLE),
        }
    return largest


def claims(numbers: dict) -> tuple[Claim, ...]:
    """The paper's claim about it."""

    def text(one):
        if one["velocity_after"] > LOST:
            return "lost"
        return ", ".join(f"{v:.3f}" for v in one["rates_after"]) + f" rad/s, {one['velocity_after']:.1f} m/s"

    stable = numbers["with_coefficients"]["stable"]
    verdict = graded(stable and not numbers["without"]["stable"], stable)
    return reproduction.claims("aesmf", {"linearised": verdict}, **{name: text(one) for name, one in numbers.items()})
