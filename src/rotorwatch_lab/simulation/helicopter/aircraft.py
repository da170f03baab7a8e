"""A helicopter in the closed loop: four actuators with their faults, and the autopilot that allocates to them.

It begins in trimmed hover at the working height and ends in the air; a helicopter that meets the ground stays there.
"""

from __future__ import annotations

import functools
from collections import namedtuple
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.simulation import faults, prepare, rotation, trajectories
from rotorwatch_lab.simulation.control import Loops
from rotorwatch_lab.simulation.faults import Faults
from rotorwatch_lab.simulation.helicopter import control, dynamics
from rotorwatch_lab.simulation.helicopter.control import Pilot
from rotorwatch_lab.simulation.loop import Moment, State
from rotorwatch_lab.simulation.rigid import Air, Body
from rotorwatch_lab.simulation.scenario import Scenario
from rotorwatch_lab.simulation.sensors import Sensors
from rotorwatch_lab.simulation.trajectories import Reference, Trajectory
from rotorwatch_lab.simulation.wind import Wind

Array = Any
ACTUATORS = 4


class Plan(NamedTuple):
    """Numbers of one flight. mass [kg], payload included; lag [s]; altitude [m]; faults: rotors stand for the four actuators."""

    mass: Array
    lag: Array
    pilot: Pilot
    way: Trajectory
    altitude: Array
    wind: Wind
    faults: Faults
    sensors: Sensors
    seed: Array


class Actuators(namedtuple("Actuators", "U held")):
    """U (4,): where they are; held (4,): where they were when they jammed; both in [0, 1]."""


class Record(namedtuple("Record", "time p v q omega rates accel command actuators theta wind flies")):
    """After each tick: time [s]; p [m], v [m/s] (3,) NED, q (4,) body to world, omega (3,) [rad/s]; rates (3,): filtered gyro [rad/s];
    accel (3,): filtered specific force [m/s^2]; command, actuators (4,) in [0, 1]; theta (8,): losses, then displacements, of the
    plant; wind (3,) NED [m/s]; flies: 0 on the ground."""


@functools.lru_cache
def _pilot(frame: str, lag: float, gyro_hz: float) -> Pilot:
    """Many flights have the same: its trim takes a second."""
    return control.tune(dynamics.plant(airframes.paper(frame)), lag, gyro_hz)


def plan(scenario: Scenario) -> Plan:
    """The scenario's numbers. Raises ConfigError for a helicopter that cannot fly."""
    a, way = scenario.airframe, scenario.trajectory
    data = airframes.paper(a["frame"])
    lag, loaded = a["lag_s"], float(data["mass"]) + a["payload_kg"]
    if a["payload_kg"]:
        dynamics.trim(dynamics.plant(data, loaded))  # says so when it is too heavy
    # With no height to climb, the manoeuvre's own time begins this long after the take-off.
    begin = way["take_off_s"] - 1.0 - trajectories.HOVER_FIRST
    return Plan(
        mass=np.array(loaded),
        lag=np.array(lag),
        pilot=_pilot(a["frame"], lag, scenario.sensors["gyro_filter_hz"]),
        way=prepare.way(scenario, altitude=0.0, take_off=begin, landing=faults.NEVER),
        altitude=np.array(way["altitude_m"]),
        wind=prepare.air(scenario, float(data["main"]["radius"])),
        faults=prepare.broken(scenario, ACTUATORS),
        sensors=prepare.sensors(scenario, float(data["main"]["speed"])),
        seed=np.array(scenario.seed, np.int64),
    )


def theta_of(broken: Faults, s, held):
    """theta (8,) of the plant: losses, then displacements, of actuators that jam where they were (`held`, (4,)). s (F,): strengths."""
    jnp = load_jax().numpy
    remaining, shift = faults.remaining(broken, s), faults.summed(broken, broken.bias * s)
    for k in range(faults.MOST):
        jammed = broken.rotor[k] * broken.frozen[k] * jnp.where(s[k] > 0.0, 1.0, 0.0) > 0.0
        remaining = jnp.where(jammed, 0.0, remaining)
        shift = jnp.where(jammed, jnp.where(broken.level[k] < 0.0, held, broken.level[k]), shift)
    return jnp.concatenate([1.0 - remaining, shift])


@dataclass(frozen=True)
class HelicopterAircraft:
    """The `loop.Aircraft` of a helicopter that a paper describes, by its frame's name; plans: `Plan`."""

    frame: str
    noise_kind = np.float64
    made: tuple | None = None

    def start(self, plan: Plan) -> tuple[Body, Array, Actuators]:
        """In trimmed hover of the nominal vehicle at the working height."""
        jnp = load_jax().numpy
        none, zero, U = jnp.zeros(3), jnp.zeros(()), jnp.asarray(plan.pilot.U)
        q = rotation.multiply(rotation.heading(plan.way.yaw), plan.pilot.q)
        body = Body(jnp.stack([zero, zero, -plan.altitude]), none, q, none)
        return body, -G0 * jnp.stack(rotation.axes(q)[2]), Actuators(U, U)

    def reference(self, plan: Plan, ticks: int, dt: float) -> Reference:
        """The manoeuvre at the working height, from the beginning in the air."""
        jnp = load_jax().numpy
        reference = trajectories.table(plan.way, ticks, dt)
        height = jnp.stack([jnp.zeros(()), jnp.zeros(()), -plan.altitude])
        return reference._replace(p=reference.p + height, lift=jnp.ones_like(reference.lift))

    def begin(self, plan: Plan, state: State, reference, blowing, turning, dt: float) -> tuple[Moment, Array]:
        """Outer loops."""
        target, integral = control.outer(plan.pilot, reference, state.body, state.integral, dt)
        return Moment(target, Air(blowing, turning, 0.0 * reference.yaw)), integral

    def step(self, plan: Plan, now: Moment, t, body: Body, gyro, loops: Loops, actuators: Actuators, dt: float) -> tuple:
        """Inner loops and allocation, faults, actuators and body."""
        jnp = load_jax().numpy
        system = dynamics.plant(airframes.paper(self.frame), plan.mass)
        command, loops = control.inner(plan.pilot, now.target, body.q, gyro, loops, dt)
        theta = theta_of(plan.faults, faults.strength(plan.faults, t), actuators.held)
        driven = system.outputs(command, theta)
        body, U, force = dynamics.step(system, body, actuators.U, driven, plan.lag, now.air, dt)
        held = jnp.where(theta[:ACTUATORS] >= 1.0, actuators.held, U)
        return body, loops, Actuators(U, held), force, (command, theta)

    def end(self, plan: Plan, now: Moment, before: State, after: State, seen, last, dt: float) -> tuple[State, Record]:
        """End of a tick: detects ground contact; from then on the helicopter stays there."""
        jax = load_jax()
        jnp = jax.numpy
        flies = jnp.where(after.body.p[2] >= 0.0, 0.0, before.flies)
        lying = before.body._replace(v=0.0 * after.body.v, omega=0.0 * after.body.omega)
        body = jax.tree.map(lambda now, then: jnp.where(flies > 0.0, now, then), after.body, lying)
        command, theta = last
        record = Record(**seen, **body._asdict(), command=command, actuators=after.own.U, theta=theta, flies=flies)
        return after._replace(body=body, flies=flies), record
