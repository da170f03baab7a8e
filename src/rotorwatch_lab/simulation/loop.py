"""The closed-loop simulation of any aircraft: air, sensors, autopilot and body, tick by tick.

A tick is the period of the autopilot's outer loops and of the record; it has `steps` Runge-Kutta steps, each with the inner loops. An
`Aircraft` - its actuators, their faults, its autopilot - is defined in a file of its own. One definition of a tick serves a single flight
and many side by side: a batch maps it with the flights as the last axis, so that every line is an operation on long vectors; `fly_each`
steps it as native code, flight by flight, where there is a C compiler.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from typing import Any, NamedTuple, Protocol

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling import run as compiled
from rotorwatch_lab.simulation import wind
from rotorwatch_lab.simulation.control import Loops, Target
from rotorwatch_lab.simulation.rigid import Air, Body
from rotorwatch_lab.simulation.trajectories import Reference

Array = Any


class State(NamedTuple):
    """State carried from tick to tick. accel (3,): filtered specific force [m/s^2]; integral (3,): of the velocity loop; flies: 0 after a
    crash; own: the aircraft's actuators and other state of its own."""

    body: Body
    accel: Array
    gusts: wind.Gusts
    integral: Array
    loops: Loops
    flies: Array
    own: Any


class Moment(NamedTuple):
    """Values held during one tick. target: of the autopilot's outer loops; more: the aircraft's own."""

    target: Target
    air: Air
    more: Any = ()


class Aircraft(Protocol):
    """Interface of a simulated aircraft: hashable, because a program is compiled for each. Plans are pytrees of numbers with wind, faults,
    sensors and seed.

    noise_kind: what standard normal numbers are drawn as. Thousands of multirotors at once draw single precision, half the memory.
    """

    noise_kind: Any

    @property
    def made(self) -> tuple | None:
        """Key of the aircraft (numbers, strings and lists), under which native code is cached; None where it cannot be native code."""
        ...

    def start(self, plan) -> tuple[Body, Array, Any]:
        """(body, specific force (3,) [m/s^2], own state) at time 0."""
        ...

    def reference(self, plan, ticks: int, dt: float) -> Reference:
        """Setpoints at each tick of dt seconds: arrays of `ticks` rows."""
        ...

    def begin(self, plan, state: State, reference: Reference, blowing, turning, dt: float) -> tuple[Moment, Array]:
        """Begin a tick of dt seconds: the moment, and the velocity loop's integral. blowing (3,) NED [m/s], turning (3,) [rad/s]."""
        ...

    def step(self, plan, now: Moment, t, body: Body, gyro, loops: Loops, own, dt: float, /) -> tuple:
        """Runge-Kutta step of dt seconds from time t at measured rates gyro (3,): (body, loops, own, force (3,), values for `end`)."""
        ...

    def end(self, plan, now: Moment, before: State, after: State, seen: dict[str, Array], last, dt: float) -> tuple:
        """End a tick of dt seconds: (state, record). seen: what every record holds; last: values returned by the tick's last step."""
        ...


def start(aircraft: Aircraft, plan) -> State:
    """Before the first tick: no gusts yet, loops at rest."""
    jnp = load_jax().numpy
    body, accel, own = aircraft.start(plan)
    kind = body.p.dtype
    none, one = jnp.zeros(3, kind), jnp.ones((), kind)
    return State(body, accel, wind.still(kind), none, Loops(none, none, one), one, own)


def tick(aircraft: Aircraft, plan, state: State, t, reference: Reference, noise, dt: float, steps: int) -> tuple[State, Any]:
    """Advance by one tick of `steps` steps of dt seconds from time t: the next state and the record.

    reference: setpoints now. noise: wind.NOISES + 3 steps standard normal numbers.
    """
    jax = load_jax()
    jnp = jax.numpy
    kind, sensors, long = state.body.p.dtype, plan.sensors, dt * steps
    gusts = wind.step(plan.wind, state.gusts, noise[: wind.NOISES], long)
    blowing = wind.velocity(plan.wind, gusts)
    now, integral = aircraft.begin(plan, state, reference, blowing, gusts.turning, long)
    accel_fade = jnp.exp(-sensors.accel_cut * dt)

    def advance(carry, row):
        body, accel, loops, own = carry
        t, n_gyro = row[0], row[1:]
        gyro = body.omega + sensors.gyro_sd * n_gyro
        body, loops, own, force, last = aircraft.step(plan, now, t, body, gyro, loops, own, dt)
        return (body, force + (accel - force) * accel_fade, loops, own), last

    kicks = noise[wind.NOISES :].reshape(steps, 3).astype(kind)
    rows = jnp.concatenate([(t + dt * jnp.arange(steps, dtype=kind))[:, None], kicks], axis=1)
    carry = (state.body, state.accel, state.loops, state.own)
    # What a step remembers goes through the carry: stacked it would be written down for every step and read for the last.
    blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(advance, carry, rows[0])[1])
    (carry, last), _ = jax.lax.scan(lambda both, row: (advance(both[0], row), None), (carry, blank), rows)
    body, accel, loops, own = carry
    after = State(body, accel, gusts, integral, loops, state.flies, own)
    seen = {"time": t + long, "rates": loops.gyro, "accel": accel, "wind": blowing}
    return aircraft.end(plan, now, state, after, seen, last, long)


def everything(record: Any) -> Any:
    """The default selection: all of a record."""
    return record


@functools.lru_cache(maxsize=32)
def program(aircraft: Aircraft, ticks: int, dt: float, steps: int, batch: bool, select: Callable):
    """Compiled program: plan (or stacked plans) -> stacked selections of `ticks` records; time first, flights last."""
    jax = load_jax()
    jnp = jax.numpy
    width = wind.NOISES + 3 * steps

    def noises(seed):
        return jax.random.normal(jax.random.key(seed), (ticks, width), aircraft.noise_kind)

    def begin(plan):
        return start(aircraft, plan)

    def setpoints(plan):
        return aircraft.reference(plan, ticks, dt * steps)

    def advance(plan, state, t, reference, noise):
        state, record = tick(aircraft, plan, state, t, reference, noise.astype(t.dtype), dt, steps)
        return state, select(record)

    @jax.jit
    def run(plan):
        if not batch:
            move, state, reference, noise = advance, begin(plan), setpoints(plan), noises(plan.seed)
        else:
            many = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
            move = jax.vmap(advance, in_axes=(-1, -1, None, -1, -1), out_axes=-1)
            state, reference, noise = many(begin)(plan), many(setpoints)(plan), many(noises)(plan.seed)
        times = jnp.arange(ticks) * jnp.asarray(dt * steps, state.body.p.dtype)
        return jax.lax.scan(lambda s, row: move(plan, s, *row), state, (times, reference, noise))[1]

    return run


def fly(
    aircraft: Aircraft, plan: Any, duration: float, rate_hz: float = 400.0, record_hz: float = 100.0, select: Callable = everything
) -> Any:
    """Fly for `duration` seconds: the stacked records (T, ...) as NumPy arrays, reduced by `select` where given. Raises ConfigError for
    wrong rates."""
    run = program(aircraft, *grid(duration, rate_hz, record_hz), False, select)
    return load_jax().tree.map(np.asarray, run(plan))


def fly_many(
    aircraft: Aircraft, plans: Any, duration: float, rate_hz: float = 400.0, record_hz: float = 100.0, select: Callable = everything
) -> Any:
    """Many flights at once: plans stacked along a new last axis (see `stack`); so are the results, (T, ..., B), arrays of the device."""
    return program(aircraft, *grid(duration, rate_hz, record_hz), True, select)(plans)


class Ticks:
    """The ticks of one flight in the form of an estimator, so that what makes native code of those makes it of a flight: u is the time, the
    noise and the setpoints of a tick; y nothing."""

    def __init__(self, aircraft: Aircraft, plan: Any, dt: float, steps: int):
        self.aircraft, self.plan, self.dt, self.steps = aircraft, plan, dt, steps

    def init(self) -> State:
        return start(self.aircraft, self.plan)

    def step(self, carry, u, y, valid):
        jax = load_jax()
        width = wind.NOISES + 3 * self.steps
        t, noise, left, setpoints = u[0], u[1 : 1 + width], u[1 + width :], []
        like = jax.eval_shape(lambda p: self.aircraft.reference(p, 1, self.dt * self.steps), self.plan)
        leaves, tree = jax.tree.flatten(like)
        for leaf in leaves:
            size = int(np.prod(leaf.shape[1:]))
            setpoints.append(left[:size].reshape(leaf.shape[1:]))
            left = left[size:]
        return tick(self.aircraft, self.plan, carry, t, jax.tree.unflatten(tree, setpoints), noise, self.dt, self.steps)


def _ticks(kind: str, made: tuple, dt: float, steps: int, plan) -> Ticks:
    module, _, name = kind.partition(":")
    return Ticks(getattr(import_module(module), name)(*made), plan, dt, steps)


@functools.lru_cache(maxsize=32)
def _inputs(aircraft: Aircraft, ticks: int, dt: float, steps: int):
    """Compiled: plan -> the state before the first tick, and the rows u (ticks, n) of `Ticks`."""
    jax = load_jax()
    jnp = jax.numpy

    @jax.jit
    def inputs(plan):
        noise = jax.random.normal(jax.random.key(plan.seed), (ticks, wind.NOISES + 3 * steps), aircraft.noise_kind)
        setpoints = jax.tree.leaves(aircraft.reference(plan, ticks, dt * steps))
        columns = [jnp.arange(ticks) * (dt * steps), noise, *setpoints]
        return start(aircraft, plan), jnp.concatenate([a.reshape(ticks, -1).astype(float) for a in columns], axis=1)

    return inputs


def fly_each(
    aircraft: Aircraft,
    plans: Sequence[Any],
    duration: float,
    rate_hz: float = 400.0,
    record_hz: float = 100.0,
    select: Callable = everything,
    size: int | None = None,
) -> Iterator[Any]:
    """The record (T, ...) of each of many flights, as NumPy arrays, when it is asked for. As native code one by one where there is a C
    compiler, on a processor several times as fast as side by side, and only one is held in memory; else by `fly_many`, filled up to
    `size` flights, so one program serves all numbers of flights up to that. The two differ in their last digits. Raises ConfigError."""
    jax = load_jax()
    if aircraft.made is None or compiled.engine() != "native":
        # Plans of one structure fly together.
        shapes = [jax.tree.structure(plan) for plan in plans]
        made: dict[int, Any] = {}
        for shape in dict.fromkeys(shapes):
            alike = [k for k, other in enumerate(shapes) if other == shape]
            filled = stack([plans[k] for k in alike] + [plans[alike[-1]]] * ((size or len(alike)) - len(alike)))
            many = jax.tree.map(np.asarray, fly_many(aircraft, filled, duration, rate_hz, record_hz, select))
            made |= {k: jax.tree.map(lambda a, i=i, many=many: a[..., i], many) for i, k in enumerate(alike)}
        yield from (made[k] for k in range(len(plans)))
        return
    ticks, dt, steps = grid(duration, rate_hz, record_hz)
    kind = f"{type(aircraft).__module__}:{type(aircraft).__qualname__}"
    build, inputs, none = (
        functools.partial(_ticks, kind, aircraft.made, dt, steps),
        _inputs(aircraft, ticks, dt, steps),
        np.zeros((ticks, 1)),
    )
    for plan in plans:
        state, u = jax.tree.map(np.asarray, inputs(plan))
        plan = jax.tree.map(np.asarray, plan)
        yield compiled.run_built(build, plan, u, none, none, select, carry=state, backend="native")[1]


def grid(duration: float, rate_hz: float, record_hz: float) -> tuple[int, float, int]:
    """(ticks, dt [s] of a step, steps per tick). Raises ConfigError where the record's rate does not divide the steps'."""
    steps = round(rate_hz / record_hz)
    if steps < 1 or abs(steps * record_hz - rate_hz) > 1e-9 * rate_hz:
        raise ConfigError(f"record_hz {record_hz:g} must divide rate_hz {rate_hz:g}.")
    if not 0.0 < duration <= 7200.0:
        raise ConfigError(f"duration_s must lie between 0 and 7200, not {duration:g}.")
    return round(duration * record_hz), 1.0 / rate_hz, steps


def stack(plans: list[Any]) -> Any:
    """Plans of vehicles with equally many rotors, stacked along a new last axis. Raises ConfigError for others."""
    if len({p.faults.rotor.shape for p in plans}) != 1:
        raise ConfigError("flights of one batch must have the same number of rotors (and there must be one).")
    return load_jax().tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves], axis=-1), *plans)
