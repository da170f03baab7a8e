"""The closed loop: vehicle, air, sensors, battery and autopilot, tick by tick; one flight, or many side by side.

A tick is the autopilot's outer loop and the finest thing that is recorded; within it `steps` Runge-Kutta steps, each with
its inner loop. One definition of a tick serves both forms: a batch maps it with the flights as the last axis, so that
every line is one operation on long vectors.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch.simulation import control, dynamics, faults, trajectories, wind

Array = Any
TURN = 2.0 * np.pi
BELIEF_HZ = 0.5  # the autopilot's filter of the battery's voltage
CRASH_COS = 0.5  # lying on the ground further tilted than this, the autopilot gives up


class Battery(NamedTuple):
    """full, empty: voltages at rest [V]; charge [A s]; resistance [ohm]; current [A] at full thrust of all rotors."""

    full: Array
    empty: Array
    charge: Array
    resistance: Array
    current: Array


class Sensors(NamedTuple):
    """gyro_sd [rad/s] of one sample in a step, accel_sd [m/s^2] after the filter; biases (3,); accel_cut [rad/s];
    shake [m/s^2 at full speed] of each healthy rotor, full_turns: its revolutions per second at full speed; rattle: rad/s of gyro
    per m/s^2 of it; attitude_sd [rad], velocity_sd [m/s], position_sd [m] of what is logged."""

    gyro_sd: Array
    accel_sd: Array
    gyro_bias: Array
    accel_bias: Array
    accel_cut: Array
    shake: Array
    full_turns: Array
    rattle: Array
    attitude_sd: Array
    velocity_sd: Array
    position_sd: Array


class Plan(NamedTuple):
    """One flight as numbers: everything that a compiled program needs. seed: integer."""

    craft: dynamics.Craft
    pilot: control.Autopilot
    way: trajectories.Trajectory
    wind: wind.Wind
    faults: faults.Faults
    battery: Battery
    sensors: Sensors
    seed: Array


class State(NamedTuple):
    """Everything that goes on from tick to tick; n rotors. phase: turns of each rotor; drawn: charge used [A s]; sag: battery
    voltage as a share of full, believed: what the autopilot knows of it; held: last sound commands; flies: 0 after a crash."""

    body: dynamics.Body
    w: Array
    phase: Array
    accel: Array
    gusts: wind.Gusts
    integral: Array
    loops: control.Loops
    drawn: Array
    sag: Array
    believed: Array
    held: Array
    flies: Array


class Record(NamedTuple):
    """What there is to know after each tick; n rotors. Logs hold some of it, with noise; the truth file the rest.

    time; p, v, q, omega; rates: filtered gyro; accel: filtered specific force; demand (n,): thrust asked of each rotor, command
    (n,): drive share that gives it; control (4,); rates_asked (3,), q_asked (4,); w, phase, shake, theta (n,); volts, amps;
    believed, lift_max; wind (3,); flies.
    """

    time: Array
    p: Array
    v: Array
    q: Array
    omega: Array
    rates: Array
    accel: Array
    demand: Array
    command: Array
    control: Array
    rates_asked: Array
    q_asked: Array
    w: Array
    phase: Array
    shake: Array
    theta: Array
    volts: Array
    amps: Array
    believed: Array
    lift_max: Array
    wind: Array
    flies: Array


def start(plan: Plan) -> State:
    """Standing on the ground, motors off, battery full."""
    jnp = load_jax().numpy
    n, kind = plan.craft.x.shape[0], jnp.result_type(plan.craft.x)
    zero, one = jnp.zeros((), kind), jnp.ones((), kind)
    half = 0.5 * plan.way.yaw
    q = jnp.stack([jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)]).astype(kind)
    none, rotors = jnp.zeros(3, kind), jnp.zeros(n, kind)
    gusts = wind.Gusts(zero, jnp.zeros(2, kind), jnp.zeros(2, kind), none)
    body = dynamics.Body(jnp.stack([zero, zero, zero + 0.01]), none, q, none)
    loops = control.Loops(none, none, one)
    accel = jnp.stack([zero, zero, zero - dynamics.G0])
    return State(body, rotors, rotors, accel, gusts, none, loops, zero, one, one, rotors, one)


def tick(plan: Plan, state: State, t, ask, noise, dt: float, steps: int) -> tuple[State, Record]:
    """One tick of `steps` steps of dt seconds from time t.

    ask: the `trajectories.Reference` of now. noise: wind.NOISES + 3 steps standard normal numbers.
    """
    jax = load_jax()
    jnp = jax.numpy
    craft, pilot, sensors, battery = plan.craft, plan.pilot, plan.sensors, plan.battery
    long = dt * steps
    gusts = wind.step(plan.wind, state.gusts, noise[: wind.NOISES], long)
    blowing = wind.velocity(plan.wind, gusts)
    # Near the ground the air is slow: a logarithmic profile in short.
    near = jnp.clip(-state.body.p[2] / 2.0, 0.1, 1.0)
    air = dynamics.Air(blowing * near, gusts.turning * near, jnp.ones_like(t))
    lift = ask.lift * state.flies
    target, integral = control.outer(pilot, ask._replace(lift=lift), state.body, state.integral, long)
    compensated = pilot.compensates * state.believed + (1.0 - pilot.compensates)
    lift_max = dynamics.thrust_share(pilot.expo, compensated)
    accel_fade = jnp.exp(-sensors.accel_cut * dt)

    def one_step(carry, row):
        body, w, phase, accel, loops, held, _ = carry
        t, n_gyro = row[0], row[1:]
        gyro = body.omega + sensors.gyro_sd * n_gyro
        turning, wish, loops = control.inner(pilot, target, body.q, gyro, loops, lift, dt)
        demand, free = control.mix(pilot.mixer, turning, target.throttle)
        command = jnp.minimum(control.drive(pilot.expo, lift_max * demand) / compensated, 1.0) * jnp.where(
            lift > 0, 1.0, 0.0
        )
        s = faults.strength(plan.faults, t)
        driven, undriven, held = faults.act(plan.faults, s, command, held)
        theta = faults.loss(plan.faults, s)
        share = jnp.sqrt(dynamics.thrust_share(craft.expo, driven * state.sag))
        lag = craft.lag * (1.0 + (faults.SPIN_DOWN - 1.0) * undriven)
        before = w
        body, w, force = dynamics.step(craft, body, w, share, lag, air, theta, dt)
        phase = phase + 0.5 * (before + w) * sensors.full_turns * dt
        phase = phase - jnp.floor(phase)
        accel = force + (accel - force) * accel_fade
        loops = loops._replace(free=free)
        out = (demand, command, jnp.concatenate([turning, target.throttle[None]]), wish, theta, s)
        return (body, w, phase, accel, loops, held, out), None

    n = craft.x.shape[0]
    zero = 0.0 * state.w
    blank = (zero, zero, jnp.zeros(4, zero.dtype), 0.0 * state.accel, zero, jnp.zeros(faults.MOST, zero.dtype))
    kicks = noise[wind.NOISES :].reshape(steps, 3).astype(zero.dtype)
    rows = jnp.concatenate([(t + dt * jnp.arange(steps, dtype=zero.dtype))[:, None], kicks], axis=1)
    carry = (state.body, state.w, state.phase, state.accel, state.loops, state.held, blank)
    (body, w, phase, accel, loops, held, out), _ = jax.lax.scan(one_step, carry, rows)
    demand, command, asked, wish, theta, s = out

    work = jnp.sum(w * w * w) / n
    at_rest = battery.full - (battery.full - battery.empty) * jnp.minimum(state.drawn / battery.charge, 1.2)
    amps = battery.current * work * battery.full / jnp.maximum(at_rest, 1.0)
    volts = jnp.maximum(at_rest - amps * battery.resistance, 0.3 * battery.full)
    sag = volts / battery.full
    believed = sag + (state.believed - sag) * math.exp(-TURN * BELIEF_HZ * long)
    R22 = 1.0 - 2.0 * (body.q[1] ** 2 + body.q[2] ** 2)
    lying = (body.p[2] > 0.0) & (R22 < CRASH_COS)
    flies = jnp.where(lying, 0.0, state.flies)
    new = State(body, w, phase, accel, gusts, integral, loops, state.drawn + amps * long, sag, believed, held, flies)
    shake = (sensors.shake + faults.imbalance(plan.faults, s)) * w * w
    record = Record(
        *(t + long, body.p, body.v, body.q, body.omega, loops.gyro, accel, demand, command, asked, wish, target.q),
        *(w, phase, shake, theta, volts, amps, believed, lift_max, blowing, flies),
    )
    return new, record


def everything(record: Record) -> Any:
    """The default selection: all of a record."""
    return record


@functools.lru_cache(maxsize=32)
def program(ticks: int, dt: float, steps: int, batch: bool, select: Callable):
    """Compiled program: plan (or stacked plans) -> stacked selections of `ticks` records; time first, flights last."""
    jax = load_jax()
    jnp = jax.numpy
    width = wind.NOISES + 3 * steps

    def noises(seed):
        return jax.random.normal(jax.random.key(seed), (ticks, width), jnp.float32)

    def asked(way):
        return trajectories.table(way, ticks, dt * steps)

    def advance(plan, state, t, ask, noise):
        state, record = tick(plan, state, t, ask, noise.astype(t.dtype), dt, steps)
        return state, select(record)

    @jax.jit
    def run(plan: Plan):
        times = jnp.arange(ticks) * jnp.asarray(dt * steps, plan.craft.x.dtype)
        if not batch:
            move, state, ask, noise = advance, start(plan), asked(plan.way), noises(plan.seed)
        else:
            many = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
            move = jax.vmap(advance, in_axes=(-1, -1, None, -1, -1), out_axes=-1)
            state, ask, noise = many(start)(plan), many(asked)(plan.way), many(noises)(plan.seed)
        return jax.lax.scan(lambda s, row: move(plan, s, *row), state, (times, ask, noise))[1]

    return run


def fly(plan: Plan, duration: float, rate_hz: float = 400.0, record_hz: float = 100.0, select: Callable = everything):
    """One flight. Returns the stacked records (T, ...), or what `select` keeps of each. Raises ConfigError for wrong rates."""
    run = program(*grid(duration, rate_hz, record_hz), False, select)
    return load_jax().tree.map(np.asarray, run(plan))


def fly_many(plans: Plan, duration, rate_hz=400.0, record_hz=100.0, select: Callable = everything):
    """Many flights at once: plans stacked along a new last axis (see `stack`); so are the results, (T, ..., B)."""
    return program(*grid(duration, rate_hz, record_hz), True, select)(plans)


def grid(duration: float, rate_hz: float, record_hz: float) -> tuple[int, float, int]:
    """(ticks, dt, steps per tick)."""
    steps = round(rate_hz / record_hz)
    if steps < 1 or abs(steps * record_hz - rate_hz) > 1e-9 * rate_hz:
        raise ConfigError(f"record_hz {record_hz:g} must divide rate_hz {rate_hz:g}.")
    if not 0.0 < duration <= 7200.0:
        raise ConfigError(f"duration_s must lie between 0 and 7200, not {duration:g}.")
    return round(duration * record_hz), 1.0 / rate_hz, steps


def stack(plans: list[Plan]) -> Plan:
    """Plans of vehicles with equally many rotors, stacked along a new last axis. Raises ConfigError for others."""
    if len({p.craft.x.shape for p in plans}) != 1:
        raise ConfigError("flights of one batch must have the same number of rotors (and there must be one).")
    return load_jax().tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves], axis=-1), *plans)
