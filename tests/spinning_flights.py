"""Simulated flights of a quadrotor that loses rotors, spins and flies on, as logs: the lab's rigid body and its regulator of a turning
hover (`control.spinning`, after Mueller and D'Andrea). The commands to a lost rotor are those of a controller that does not know of it."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import ThrustCurve, Vehicle
from rotorwatch_lab.control.airframe import Airframe
from rotorwatch_lab.control.spinning import SpinningHover
from rotorwatch_lab.simulation import dynamics, prepare, rotation, scenario
from rotorwatch_lab.simulation.rigid import Air, Body

jax = load_jax()
jnp = jax.numpy
DT = 1.0 / 400.0
IDLE_S, HOVER_S, KNOWS_S = 2.0, 14.0, 0.1  # on the ground; hover before the first loss; until the regulator has adapted
LEVER = np.array([0.01, -0.015, -0.03])  # m: of the accelerometer
DEMANDED = 0.9  # share of full thrust, of a rotor that does not answer
SHAKES, DRIFTS = 0.6, 0.02  # m/s^2, rad/s: noise of the sensors


Losses = tuple[tuple[float, tuple[int, ...]], ...]


def fly(losses: Losses, seconds: float, seed: int, hz: float = 20.0) -> tuple[Flight, Vehicle]:
    """A flight, and its vehicle. losses: ((time after HOVER_S [s], rotors from 0 that stop then, or none where all work again), ...); hz:
    of the logged commands."""
    rows, rng, vehicle = _flown(losses, seconds, seed)
    return _logged(rows, copy.deepcopy(rng), hz), vehicle


@functools.cache
def _flown(losses: Losses, seconds: float, seed: int) -> tuple[dict[str, np.ndarray], np.random.Generator, Vehicle]:
    """Every step of a flight, the generator of its log's noise, and its vehicle."""
    table = scenario.from_table({"airframe": {"frame": "quad-x", "ground_effect": False}})
    craft, vehicle = prepare.plan(table).craft, prepare.vehicle(table)
    vehicle = replace(vehicle, curve=ThrustCurve(0.0, 1.0, 0.0), mixer=None, extra={})
    airframe, rng, n = Airframe.of(craft), np.random.default_rng(seed), len(craft.x)
    works = np.ones(n)
    body = Body(np.array([0.0, 0.0, -30.0]), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
    times = [0.0, *(HOVER_S + at for at, _ in losses), HOVER_S + seconds]
    control, parts = SpinningHover(airframe, works, DT), []
    w, state = np.sqrt(control.hover.u), control.init()
    for begin, end, stop in zip(times, times[1:], [(), *(who for _, who in losses)]):
        works = np.where(np.isin(np.arange(n), stop), 0.0, works) if stop else np.ones(n)
        for until, knows in ((min(begin + KNOWS_S, end), False), (end, True)) if begin else ((end, True),):
            if knows and begin > KNOWS_S:
                control = SpinningHover(airframe, works, DT)
                state = control.init()._replace(f=jnp.asarray(w**2 * works))
            steps = round((until - begin) / DT)
            kicks = 0.02 * rng.standard_normal((steps, n))
            (body, w, state), rows = _run(craft, control, (body, w, state), kicks, 1.0 - works)
            u = np.where(works > 0.0, rows["u"], DEMANDED if knows else rows["u"])
            parts.append({**rows, "u": u})
            begin = until
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, rng, vehicle


def _run(craft, control, start, kicks, theta):
    air = Air(np.zeros(3), np.zeros(3), 0.0)

    def step(carry, kick):
        body, w, state = carry
        R = rotation.axes(body.q)
        down = jnp.stack(R[2])
        lift = jnp.clip(1.0 + 0.2 * body.v[2] + 0.05 * (body.p[2] + 30.0), 0.85, 1.2)
        state, u = control.step(state, body.omega, down, lift)
        u = jnp.clip(u * (1.0 + kick), 0.0, 1.0)
        new, w, force = dynamics.step(craft, body, w, jnp.sqrt(u), craft.lag, air, theta, DT)
        turn = (new.omega - body.omega) / DT
        force = force + jnp.cross(turn, LEVER) + jnp.cross(body.omega, jnp.cross(body.omega, LEVER))
        return (new, w, state), {"u": u, "rate": body.omega, "force": force, "q": body.q, "v": body.v, "p": body.p}

    start = jax.tree.map(jnp.asarray, start)
    end, rows = jax.jit(lambda s, k: jax.lax.scan(step, s, k))(start, jnp.asarray(kicks))
    return jax.tree.map(np.asarray, end), {name: np.asarray(column) for name, column in rows.items()}


def _logged(rows: dict[str, np.ndarray], rng: np.random.Generator, hz: float) -> Flight:
    """The log: idle on the ground, a climb that is not simulated, and the flight."""
    count = len(rows["u"])
    time = IDLE_S + DT * np.arange(count)
    idle = np.arange(0.0, IDLE_S, 1.0 / hz)
    every, n = round(1.0 / hz / DT), rows["u"].shape[1]
    motion = np.arange(0, count, 2)
    u = np.concatenate([np.zeros((len(idle), n)), rows["u"][::every]])
    ground = np.arange(0.0, IDLE_S, 2 * DT)
    force = np.concatenate([np.tile([0.0, 0.0, -9.81], (len(ground), 1)), rows["force"][motion]])
    rate = np.concatenate([np.zeros((len(ground), 3)), rows["rate"][motion]])
    when = np.concatenate([ground, time[motion]])
    force = force + SHAKES * rng.standard_normal(force.shape)
    rate = rate + DRIFTS * rng.standard_normal(rate.shape)
    slow = np.arange(0, count, round(0.1 / DT))
    return Flight(
        "table", "",
        {
            "motors": Signal(np.concatenate([idle, time[::every]]), u, tuple(f"r{k + 1}" for k in range(n)), "1", "", "motors"),
            "gyro": Signal(when, rate, ("x", "y", "z"), "rad/s", "FRD", "gyro"),
            "accel": Signal(when, force, ("x", "y", "z"), "m/s^2", "FRD", "accel"),
            "attitude": Signal(time[slow], rows["q"][slow], ("w", "x", "y", "z"), "1", "", "attitude"),
            "velocity": Signal(time[slow], rows["v"][slow], ("n", "e", "d"), "m/s", "NED", "velocity"),
            "position": Signal(time[slow], rows["p"][slow], ("n", "e", "d"), "m", "NED", "position"),
        },
        float(time[-1]), name="simulated",
    )  # fmt: skip
