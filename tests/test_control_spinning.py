"""Hover while turning: it is one, the regulator holds it in the simulator with its lag, gyroscopic moments and air, and C says the same."""

import ctypes

import numpy as np
import pytest

import exporting
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling.c99.project import Field, emit_program
from rotorwatch_lab.control import spinning
from rotorwatch_lab.control.airframe import Airframe
from rotorwatch_lab.control.spinning import SpinningHover, relaxed_hover
from rotorwatch_lab.simulation import dynamics, prepare, rotation, scenario
from rotorwatch_lab.simulation.rigid import Air, Body

jax = load_jax()
jnp = jax.numpy
DT, SECONDS = 1.0 / 400.0, 12.0


def craft(frame):
    return prepare.plan(scenario.from_table({"airframe": {"frame": frame, "ground_effect": False}})).craft


def dead(craft, *rotors):
    return np.where(np.isin(np.arange(len(craft.x)), rotors), 0.0, 1.0)


@pytest.fixture(scope="module")
def quad():
    return craft("quad-x")


def q_to(down):
    """A quaternion whose body axes see "down" in that direction."""
    down = np.asarray(down)
    axis = np.cross(down, [0.0, 0.0, 1.0])
    q = np.append(1.0 + down[2], axis)
    return q / np.linalg.norm(q)


def fly(craft, control, tilt, spin):
    """(angle between the held axis and down (T,), climb rate (T,), rates (T, 3)), begun `tilt` [rad] off and at `spin` of its rate."""
    hover = control.hover
    theta, air = 1.0 - hover.effectiveness, Air(np.zeros(3), np.zeros(3), 0.0)

    def step(carry, _):
        body, w, state = carry
        R = rotation.axes(body.q)
        down = jnp.stack(R[2])
        # Thrust that carries the weight and slows the fall.
        lift = jnp.clip(1.0 + 0.15 * body.v[2], 0.8, 1.15)
        state, u = control.step(state, body.omega, down, lift)
        body, w, _ = dynamics.step(craft, body, w, jnp.sqrt(u), craft.lag, air, theta, DT)
        return (body, w, state), (jnp.arccos(jnp.clip(down @ hover.down, -1, 1)), -body.v[2], body.omega)

    wrong = hover.down + np.tan(tilt) * np.linalg.svd(hover.down[None])[2][1]
    q = q_to(wrong / np.linalg.norm(wrong))
    body = Body(np.array([0.0, 0.0, -50.0]), np.zeros(3), q, spin * hover.omega)
    start = (body, np.sqrt(hover.u), control.init())
    return (np.asarray(x) for x in jax.jit(lambda s: jax.lax.scan(step, s, None, round(SECONDS / DT)))(start)[1])


def test_the_motion_stays(quad):
    hover = relaxed_hover(Airframe.of(quad), dead(quad, 0))
    turning, thrust = spinning.moments(Airframe.of(quad), hover.effectiveness, hover.u, hover.omega)
    np.testing.assert_allclose(turning, 0.0, atol=1e-6)
    assert thrust * np.cos(hover.tilt) == pytest.approx(quad.mass * spinning.G0, rel=1e-6)
    np.testing.assert_allclose(np.cross(hover.omega, hover.down), 0.0, atol=1e-9)
    assert hover.u[0] == 0.0 and hover.rate > 5.0 and 0.02 <= hover.u[1:].min() and hover.u.max() <= 0.95


def test_moments_are_those_of_the_simulator(quad):
    airframe, rng = Airframe.of(quad), np.random.default_rng(0)
    for _ in range(5):
        u, omega, e = rng.random(4), 5.0 * rng.standard_normal(3), rng.random(4)
        body = Body(np.array([0.0, 0.0, -50.0]), np.zeros(3), np.array([1.0, 0, 0, 0]), omega)
        w = np.sqrt(u)
        rotors = dynamics.sums(quad, w, 0.0 * w, 1.0 - e)
        change, force = dynamics.derivative(quad, body, rotors, Air(np.zeros(3), np.zeros(3), 0.0))
        turning, thrust = spinning.moments(airframe, e, u, omega)
        np.testing.assert_allclose(quad.J @ change.omega, turning, atol=1e-9)
        assert -force[2] * quad.mass == pytest.approx(thrust, rel=1e-9)


@pytest.mark.parametrize("frame, rotors", [("quad-x", (0,)), ("quad-x", (0, 1)), ("hexa-x", (0,))])
def test_the_simulator_stays_in_the_air(frame, rotors):
    """One rotor of a quadrotor gone, two opposite ones, one of a hexarotor: tilted and turning too slowly at first."""
    vehicle = craft(frame)
    control = SpinningHover(Airframe.of(vehicle), dead(vehicle, *rotors), DT)
    angle, climb, rates = fly(vehicle, control, np.radians(10.0), 0.8)
    assert angle.max() < np.radians(30.0)
    last = round(2.0 / DT)
    assert angle[-last:].max() < np.radians(2.0)
    assert np.abs(climb[-last:]).max() < 0.7
    np.testing.assert_allclose(rates[-1], control.hover.omega, atol=0.15 * control.hover.rate + 0.2)


def test_without_the_regulator_it_falls_over(quad):
    control = SpinningHover(Airframe.of(quad), dead(quad, 0), DT)
    control.gains = control.gains._replace(K=0.0 * control.gains.K)
    assert next(fly(quad, control, np.radians(10.0), 1.0)).max() > np.radians(45.0)


def test_two_neighbours_gone_cannot_be_held(quad):
    assert relaxed_hover(Airframe.of(quad), dead(quad, 0, 2)) is None
    with pytest.raises(ConfigError, match="cannot hover with these losses"):
        SpinningHover(Airframe.of(quad), dead(quad, 0, 2), DT)


def test_c_says_what_python_says(quad, tmp_path):
    control = SpinningHover(Airframe.of(quad), dead(quad, 0), DT)
    inputs = (Field("omega", "f", (3,)), Field("down", "f", (3,)), Field("lift", "f", ()))
    program = emit_program("spin", lambda _, carry, *given: control.step(carry, *given), lambda _: control.init(), inputs)
    library, rng = exporting.library(program, tmp_path), np.random.default_rng(0)
    state, out = np.zeros((), exporting.struct(program.state)), np.zeros((), exporting.struct(program.out))
    room = exporting.room(program)
    library.spin_init(exporting.address(state), exporting.address(room))
    known, step = control.init(), jax.jit(control.step)
    for _ in range(50):
        omega, down = (control.hover.omega + 0.5 * rng.standard_normal(3), control.hover.down + 0.05 * rng.standard_normal(3))
        lift = np.array(rng.uniform(0.8, 1.2))
        library.spin_step(
            *(exporting.address(a) for a in (state, omega, down)), ctypes.c_double(lift),
            exporting.address(out), exporting.address(room),
        )  # fmt: skip
        known, u = step(known, omega, down, lift)
        np.testing.assert_allclose(out["value"], u, rtol=0, atol=1e-12)
