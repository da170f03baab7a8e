"""The helicopter's closed loop: body, air, sensors, actuators with their faults and autopilot, tick by tick.

It begins in trimmed hover at the working height and ends in the air; a helicopter that meets the ground stays there.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.backend import jax as load_jax
from rotorwatch.simulation import faults, prepare, rotation, trajectories, wind
from rotorwatch.simulation.control import Loops
from rotorwatch.simulation.dynamics import G0, Air, Body
from rotorwatch.simulation.faults import Faults
from rotorwatch.simulation.helicopter import control, dynamics
from rotorwatch.simulation.helicopter.control import Pilot
from rotorwatch.simulation.loop import Sensors, grid
from rotorwatch.simulation.scenario import Scenario
from rotorwatch.simulation.trajectories import Reference, Trajectory
from rotorwatch.simulation.wind import Gusts, Wind

Array = Any
ACTUATORS = 4


class Plan(NamedTuple):
    """One flight as numbers. mass [kg], payload included; lag [s]; altitude [m]; faults: rotors stand for the four actuators."""

    mass: Array
    lag: Array
    pilot: Pilot
    way: Trajectory
    altitude: Array
    wind: Wind
    faults: Faults
    sensors: Sensors
    seed: Array


class State(NamedTuple):
    """U (4,): where the actuators are; held (4,): where they were when they jammed; flies: 0 on the ground."""

    body: Body
    U: Array
    held: Array
    accel: Array
    gusts: Gusts
    integral: Array
    loops: Loops
    flies: Array


class Record(NamedTuple):
    """After each tick: time; p, v, q, omega; rates: filtered gyro; accel: filtered specific force; command, actuators (4,);
    theta (8,): losses, then displacements, of the plant; wind (3,); flies."""

    time: Array
    p: Array
    v: Array
    q: Array
    omega: Array
    rates: Array
    accel: Array
    command: Array
    actuators: Array
    theta: Array
    wind: Array
    flies: Array


def plan(scenario: Scenario) -> Plan:
    """The scenario's numbers. Raises ConfigError for a helicopter that cannot fly."""
    a, way = scenario.airframe, scenario.trajectory
    data = airframes.paper(a["frame"])
    system, lag = dynamics.plant(data), a["lag_s"]
    loaded = float(data["mass"]) + a["payload_kg"]
    dynamics.trim(dynamics.plant(data, loaded))  # says so when it is too heavy
    manoeuvre = trajectories.Trajectory(
        *(np.array(trajectories.KINDS.index(way["kind"]), np.int32), np.array(0.0), np.array(way["size_m"])),
        *(np.array(way["speed_m_s"]), np.radians(way["yaw_deg"]), np.radians(way["yaw_speed_deg_s"])),
        # With no height to climb, the manoeuvre's own time begins this long after the take-off.
        *(np.array(way["take_off_s"] - 1.0 - trajectories.SETTLE), np.array(faults.NEVER)),
    )
    return Plan(
        *(np.array(loaded), np.array(lag), control.tune(system, lag, scenario.sensors["gyro_filter_hz"]), manoeuvre),
        *(np.array(way["altitude_m"]), prepare.air(scenario, float(data["main"]["radius"]))),
        *(prepare.broken(scenario, ACTUATORS), prepare.sensors(scenario, float(data["main"]["speed"]))),
        np.array(scenario.seed, np.int64),
    )


def theta_of(broken: Faults, s, held):
    """theta (8,) of the plant: losses, then displacements, of actuators that jam where they were (`held`, (4,)). s (F,): strengths."""
    jnp = load_jax().numpy
    left, shift = jnp.ones(ACTUATORS), jnp.zeros(ACTUATORS)
    for k in range(faults.MOST):
        left = left * (1.0 - broken.rotor[k] * (broken.loss * s)[k])
        shift = shift + broken.rotor[k] * (broken.bias * s)[k]
    for k in range(faults.MOST):
        jammed = broken.rotor[k] * broken.frozen[k] * jnp.where(s[k] > 0.0, 1.0, 0.0) > 0.0
        left = jnp.where(jammed, 0.0, left)
        shift = jnp.where(jammed, jnp.where(broken.level[k] < 0.0, held, broken.level[k]), shift)
    return jnp.concatenate([1.0 - left, shift])


def start(plan: Plan) -> State:
    """In trimmed hover of the nominal vehicle at the working height."""
    jnp = load_jax().numpy
    half = 0.5 * plan.way.yaw
    heading = jnp.stack([jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)])
    none, zero, U = jnp.zeros(3), jnp.zeros(()), jnp.asarray(plan.pilot.U)
    body = Body(jnp.stack([zero, zero, -plan.altitude]), none, rotation.multiply(heading, plan.pilot.q), none)
    gusts = Gusts(zero, jnp.zeros(2), jnp.zeros(2), none)
    accel = -G0 * jnp.stack(rotation.axes(body.q)[2])
    return State(body, U, U, accel, gusts, none, Loops(none, none, jnp.ones(())), jnp.ones(()))


def tick(system, plan: Plan, state: State, t, ask: Reference, noise, dt: float, steps: int) -> tuple[State, Record]:
    """One tick of `steps` steps of dt seconds from time t. noise: wind.NOISES + 3 steps standard normal numbers."""
    jax = load_jax()
    jnp = jax.numpy
    gusts = wind.step(plan.wind, state.gusts, noise[: wind.NOISES], dt * steps)
    blowing = wind.velocity(plan.wind, gusts)
    air = Air(blowing, gusts.turning, jnp.zeros(()))
    target, integral = control.outer(plan.pilot, ask, state.body, state.integral, dt * steps)
    accel_fade = jnp.exp(-plan.sensors.accel_cut * dt)

    def one_step(carry, row):
        body, U, held, accel, loops = carry
        t, n_gyro = row[0], row[1:]
        gyro = body.omega + plan.sensors.gyro_sd * n_gyro
        command, loops = control.inner(plan.pilot, target, body.q, gyro, loops, dt)
        theta = theta_of(plan.faults, faults.strength(plan.faults, t), held)
        driven = system.outputs(command, theta)
        body, U, force = dynamics.step(system, body, U, driven, plan.lag, air, dt)
        held = jnp.where(theta[:ACTUATORS] >= 1.0, held, U)
        return (body, U, held, force + (accel - force) * accel_fade, loops), (command, theta)

    rows = jnp.concatenate([(t + dt * jnp.arange(steps))[:, None], noise[wind.NOISES :].reshape(steps, 3)], axis=1)
    carry = (state.body, state.U, state.held, state.accel, state.loops)
    (body, U, held, accel, loops), (command, theta) = jax.lax.scan(one_step, carry, rows)
    flies = jnp.where(body.p[2] >= 0.0, 0.0, state.flies)
    lying = state.body._replace(v=0.0 * body.v, omega=0.0 * body.omega)
    body = jax.tree.map(lambda now, then: jnp.where(flies > 0.0, now, then), body, lying)
    new = State(body, U, held, accel, gusts, integral, loops, flies)
    return new, Record(
        *(
            t + dt * steps,
            body.p,
            body.v,
            body.q,
            body.omega,
            loops.gyro,
            accel,
            command[-1],
            U,
            theta[-1],
            blowing,
            flies,
        )
    )


@functools.lru_cache(maxsize=16)
def program(frame: str, ticks: int, dt: float, steps: int):
    """Compiled program: plan -> stacked records. One for every scenario of this helicopter and length."""
    jax = load_jax()
    jnp = jax.numpy
    data = airframes.paper(frame)

    @jax.jit
    def run(plan: Plan) -> Record:
        system = dynamics.plant(data, plan.mass)
        noise = jax.random.normal(jax.random.key(plan.seed), (ticks, wind.NOISES + 3 * steps))
        ask = trajectories.table(plan.way, ticks, dt * steps)
        height = jnp.stack([jnp.zeros(()), jnp.zeros(()), -plan.altitude])
        ask = ask._replace(p=ask.p + height, lift=jnp.ones_like(ask.lift))
        times = jnp.arange(ticks) * (dt * steps)

        def move(state, row):
            t, asked, kicks = row
            return tick(system, plan, state, t, asked, kicks, dt, steps)

        return jax.lax.scan(move, start(plan), (times, ask, noise))[1]

    return run


def fly(plan: Plan, frame: str, duration: float, rate_hz: float, record_hz: float) -> Record:
    """One flight: the stacked records, as NumPy arrays. Raises ConfigError for wrong rates."""
    run = program(frame, *grid(duration, rate_hz, record_hz))
    return load_jax().tree.map(np.asarray, run(plan))
