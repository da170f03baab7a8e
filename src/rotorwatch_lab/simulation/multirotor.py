"""A multirotor in the closed loop: rotors and their faults, battery, mixer, and the autopilot's model of them."""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.simulation import attached, control, dynamics, faults, incremental, motor, outside, rotation, trajectories, wind
from rotorwatch_lab.simulation.loop import Moment, State
from rotorwatch_lab.simulation.rigid import Air, Body
from rotorwatch_lab.simulation.sensors import Sensors

Array = Any
TURN = 2.0 * np.pi
BELIEF_HZ = 0.5  # the autopilot's filter of the battery's voltage
CRASH_COS = 0.5  # lying on the ground further tilted than this, the autopilot gives up


class Battery(namedtuple("Battery", "full empty charge resistance current")):
    """full, empty: voltages at rest [V]; charge [A s]; resistance [ohm]; current [A] at full thrust of all rotors."""


class Plan(NamedTuple):
    """Numbers of one flight for a compiled program. seed: integer; schedule: of `reconfigured`, else nothing."""

    craft: dynamics.Craft
    pilot: control.Autopilot
    way: trajectories.Trajectory
    wind: wind.Wind
    faults: faults.Faults
    battery: Battery
    sensors: Sensors
    seed: Array
    outside: outside.Outside
    schedule: Any = ()


class Drives(NamedTuple):
    """State of the n rotors' drives. w (n,): speeds as shares of full, phase (n,): turns; drawn: charge used [A s]; sag: battery voltage as
    a share of full, believed: the autopilot's estimate of it; held (n,): last sound commands; f (n,): thrust shares that the rotors should
    have reached; memory: of `incremental`."""

    w: Array
    phase: Array
    drawn: Array
    sag: Array
    believed: Array
    held: Array
    f: Array
    memory: incremental.Memory


class Supply(namedtuple("Supply", "lift compensated lift_max stir")):
    """The autopilot's assumptions during a tick. lift: 0 while the motors idle; compensated: divisor of commands; lift_max: share of full
    thrust that it believes it has left; stir (n,): `outside.stirred`, unknown to it."""


class Record(
    namedtuple(
        "Record",
        "time p v q omega rates accel demand command control rates_setpoint q_setpoint w phase shake theta volts amps "
        "drawn believed lift_max wind flies",
    )
):
    """Record of one tick; n rotors. Logs hold some of it, with noise; the truth file the rest.

    time [s]; p [m], v [m/s] (3,) NED, q (4,) body to world, omega (3,) [rad/s]; rates (3,): filtered gyro [rad/s]; accel (3,): filtered
    specific force [m/s^2]; demand (n,): thrust setpoint of each rotor, command (n,): drive share that gives it; control (4,): roll, pitch,
    yaw, throttle; rates_setpoint (3,), q_setpoint (4,); w (n,): speeds as shares of full, phase (n,) in turns, shake (n,) [m/s^2], theta
    (n,): losses of thrust, by whatever; volts, amps of the battery; drawn (n,) [A] by each ESC; believed, lift_max; wind (3,) NED [m/s];
    flies: 0 after a crash.
    """


class Multirotor:
    """The `loop.Aircraft` of every frame with rotors; plans: `Plan`."""

    noise_kind = np.float32
    made: tuple | None = ()

    def start(self, plan: Plan) -> tuple[Any, Array, Drives]:
        """Standing on the ground, motors off, battery full."""
        jnp = load_jax().numpy
        n, kind = plan.craft.x.shape[0], jnp.result_type(plan.craft.x)
        zero, one = jnp.zeros((), kind), jnp.ones((), kind)
        none, rotors = jnp.zeros(3, kind), jnp.zeros(n, kind)
        body = Body(jnp.stack([zero, zero, zero + 0.01]), none, rotation.heading(plan.way.yaw).astype(kind), none)
        extra = plan.craft.extra
        if extra:
            body = attached.standing(extra, plan.craft.mount, body)
        accel = jnp.stack([zero, zero, zero - G0])
        return body, accel, Drives(rotors, rotors, zero, one, one, rotors, rotors, incremental.rest(n, kind))

    def reference(self, plan: Plan, ticks: int, dt: float) -> trajectories.Reference:
        """Take-off, the manoeuvre and the landing."""
        jax, n, kind = load_jax(), plan.craft.x.shape[0], plan.craft.x.dtype
        stir = jax.lax.cond(
            plan.outside.wash > 0.0,  # else nothing comes of it
            lambda seed: outside.stirred(seed, n, ticks, dt).astype(kind),
            lambda seed: jax.numpy.zeros((ticks, n), kind),
            plan.seed,
        )
        return trajectories.table(plan.way, ticks, dt)._replace(stir=stir)

    def begin(self, plan: Plan, state: State, reference, blowing, turning, dt: float) -> tuple[Moment, Array]:
        """Outer loops, and the autopilot's estimate of its battery."""
        jnp = load_jax().numpy
        pilot = plan.pilot
        # Near the ground the air is slow: a logarithmic profile in short.
        near = jnp.clip(-state.body.p[2] / 2.0, 0.1, 1.0)
        if plan.outside.changes:
            near = 1.0 - plan.outside.changes.falls * (1.0 - near)
        air = Air(blowing * near, turning * near, jnp.ones_like(near))
        lift = reference.lift * state.flies
        target, integral = control.outer(pilot, reference._replace(lift=lift), state.body, state.integral, dt)
        if not isinstance(reference.level, tuple):  # on the ground it lies level, and pushes less and less
            grounded = reference.level > 0.0
            q = jnp.where(grounded, rotation.heading(reference.yaw), target.q)
            target = target._replace(q=q, throttle=target.throttle * (1.0 - 0.75 * reference.level))
            integral = jnp.where(grounded, 0.0, integral)
        compensated = pilot.compensates * state.own.believed + (1.0 - pilot.compensates)
        supply = Supply(lift, compensated, dynamics.thrust_share(pilot.expo, compensated), reference.stir)
        return Moment(target, air, supply), integral

    def step(self, plan: Plan, now: Moment, t, body: Body, gyro, loops: control.Loops, drives: Drives, dt: float) -> tuple:
        """Inner loops, mixer, faults, rotors and body."""
        jnp = load_jax().numpy
        pilot, s = plan.pilot, faults.strength(plan.faults, t)
        target, (lift, compensated, lift_max, stir) = self.aimed(plan, now, t, body), now.more
        factors = outside.washed(plan.outside, stir, now.air.wind, body.v)
        craft = outside.now(plan.craft, plan.outside, plan.faults, s, t, factors)
        turning, wanted, loops = control.inner(pilot, target, body.q, gyro, loops, lift, dt)
        known, e = pilot.inversion, self.effectiveness(plan, t)
        miss, cut = wanted - loops.gyro, pilot.gyro_cut
        change, memory = incremental.control(known, drives.memory, miss, gyro, drives.f, e, lift, cut, dt)
        turning = jnp.where(known.used > 0.5, change, turning)
        demand, free = self.mixed(plan, now, t, body, gyro, turning, drives)
        reached = demand + (drives.f - demand) * jnp.exp(-dt / craft.lag)
        drives = drives._replace(f=reached, memory=memory._replace(demand=demand))
        command = jnp.minimum(control.drive(pilot.expo, lift_max * demand) / compensated, 1.0) * jnp.where(lift > 0, 1.0, 0.0)
        driven, undriven, held = faults.act(plan.faults, s, command, drives.held)
        theta = faults.loss(plan.faults, s)  # of the propellers
        driven = outside.rounded(plan.outside, driven)
        commanded = jnp.sqrt(dynamics.thrust_share(craft.expo, driven * drives.sag))
        friction = faults.summed(plan.faults, plan.faults.friction * s)
        remaining = 1.0 - faults.weak(plan.faults, s)
        # Without friction the speed is the commanded one, to the last bit.
        share = jnp.where(friction > 0.0, motor.slowed(commanded, theta, friction), commanded) * jnp.sqrt(remaining)
        share = jnp.minimum(share, jnp.sqrt(faults.ceiling(plan.faults, s)))
        slower = faults.summed(plan.faults, plan.faults.slower * s)
        own_lag = outside.lag(plan.outside, craft.lag, drives.w, share) if plan.outside.changes else craft.lag
        lag = own_lag * (1.0 + (faults.SPIN_DOWN - 1.0) * undriven + slower)
        body, w, force = self.moved(plan._replace(craft=craft), body, drives.w, share, lag, now.air, theta, dt)
        phase = drives.phase + 0.5 * (drives.w + w) * plan.sensors.full_turns * dt
        phase = phase - jnp.floor(phase)
        controls = jnp.concatenate([turning, target.throttle[None]])
        lost = 1.0 - (1.0 - theta) * jnp.where(commanded > 0.0, (share / jnp.maximum(commanded, 1e-9)) ** 2, remaining)
        lost = jnp.where(share < commanded, lost, theta)
        last = (demand, command, controls, wanted, lost, s, theta, friction, 1.0 - undriven)
        return body, loops._replace(free=free), drives._replace(w=w, phase=phase, held=held), force, last

    def aimed(self, plan: Plan, now: Moment, t, body: Body) -> control.Target:
        """Target of the inner loops."""
        return now.target

    def effectiveness(self, plan: Plan, t):
        """Effectiveness (n,) of each rotor as assumed by the autopilot."""
        return 1.0 + 0.0 * plan.craft.x

    def mixed(self, plan: Plan, now: Moment, t, body: Body, gyro, turning, drives: Any) -> tuple:
        """Thrust demands (n,) of control `turning` (3,), and whether all of it was granted (1 or 0)."""
        pilot, throttle = plan.pilot, now.target.throttle
        usual = control.mix(pilot.mixer, turning, throttle)
        if isinstance(pilot.sequential, tuple):
            return usual
        other = control.mix_sequential(pilot.mixer, turning, throttle)
        where = load_jax().numpy.where
        return tuple(where(pilot.sequential > 0.5, a, b) for a, b in zip(other, usual, strict=True))

    def moved(self, plan: Plan, body: Body, w, share, lag, air: Air, theta, dt: float) -> tuple:
        """Body, rotor speeds (n,) and mean specific force (3,) after a step of dt: `dynamics.step`. Overridden by other models of the
        motion."""
        return dynamics.step(plan.craft, body, w, share, lag, air, theta, dt)

    def end(self, plan: Plan, now: Moment, before: State, after: State, seen, last, dt: float) -> tuple[State, Record]:
        """End of a tick: the battery, and whether the vehicle lies on the ground."""
        jnp = load_jax().numpy
        battery, drives, body = plan.battery, after.own, after.body
        demand, command, controls, wanted, theta, s, propeller, friction, driven = last
        work = jnp.sum(drives.w * drives.w * drives.w) / drives.w.shape[0]
        at_rest = battery.full - (battery.full - battery.empty) * jnp.minimum(drives.drawn / battery.charge, 1.2)
        amps = battery.current * work * battery.full / jnp.maximum(at_rest, 1.0)
        volts = jnp.maximum(at_rest - amps * battery.resistance, 0.3 * battery.full)
        sag = volts / battery.full
        believed = sag + (drives.believed - sag) * math.exp(-TURN * BELIEF_HZ * dt)
        R22 = 1.0 - 2.0 * (body.q[1] ** 2 + body.q[2] ** 2)
        crashed = (body.p[2] > 0.0) & (R22 < CRASH_COS)
        if plan.craft.extra:
            crashed = attached.struck(plan.craft.extra, plan.craft.mount, body)
        flies = jnp.where(crashed, 0.0, before.flies)
        drawn = motor.current(battery.current / drives.w.shape[0], drives.w, propeller, friction, sag, driven)
        drives = drives._replace(drawn=drives.drawn + amps * dt, sag=sag, believed=believed)
        record = Record(
            **seen, p=body.p, v=body.v, q=body.q, omega=body.omega, demand=demand, command=command,
            control=controls, rates_setpoint=wanted, q_setpoint=now.target.q,
            w=drives.w, phase=drives.phase, shake=(plan.sensors.shake + faults.imbalance(plan.faults, s)) * drives.w * drives.w,
            theta=theta, volts=volts, amps=amps, drawn=drawn, believed=believed, lift_max=now.more.lift_max, flies=flies,
        )  # fmt: skip
        return after._replace(flies=flies, own=drives), record


MULTIROTOR = Multirotor()
