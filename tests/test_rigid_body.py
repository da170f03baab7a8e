"""The rigid body: signs and frames, kinematics against rotation matrices, and against the study's own flight."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from conftest import trials
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments.studies.uaf_flight import DT, fly
from rotorwatch_lab.systems.rigid_body import RigidBody

jax = load_jax()
AIRFRAME = airframes.paper("uaf-02e")
PLANT = RigidBody.of(AIRFRAME)
HOVER = np.full(4, AIRFRAME["mass"] * AIRFRAME["gravity"] / (4 * AIRFRAME["thrust_max"]))
HEALTHY = np.zeros(4)
P, ANGLES, V, OMEGA = (slice(k, k + 3) for k in (0, 3, 6, 9))
rate = jax.jit(PLANT.derivative)
small = st.floats(-1.2, 1.2)


def skew(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def body_to_world(angles):
    return Rotation.from_euler("ZYX", angles[::-1]).as_matrix()


def test_it_hovers_at_the_papers_command():
    assert HOVER[0] == pytest.approx(0.307, abs=5e-4)
    np.testing.assert_allclose(rate(np.zeros(12), HOVER, HEALTHY), 0.0, atol=1e-12)


def test_a_weak_rotor_drops_its_corner_and_turns_against_its_spin():
    """Rotor 1 is front right and pushes the yaw to the right: without it roll right, nose down, yaw left, sink."""
    d = np.asarray(rate(np.zeros(12), HOVER, np.array([0.4, 0, 0, 0])))
    p, q, r = d[OMEGA]
    assert p > 1 and q < -1 and r < -0.1 and d[V][2] > 0.5
    thrust = 0.4 * HOVER[0] * 11.18
    arm = 0.225 * np.sin(np.pi / 4)
    np.testing.assert_allclose(d[OMEGA], thrust * np.array([arm, -arm, -0.0161]) / AIRFRAME["inertia"], rtol=1e-12)
    np.testing.assert_allclose(d[V], [0, 0, thrust / 1.4], atol=1e-12)


@settings(deadline=None, max_examples=trials(60))
@given(st.tuples(*[small] * 3), st.tuples(*[small] * 3), st.tuples(*[st.floats(0, 1)] * 4), st.tuples(*[st.floats(0, 1)] * 4))
def test_it_turns_and_pushes_as_rotation_matrices_do(angles, omega, u, theta):
    """dR/dt = R skew(omega); m dv/dt = m g - R F e_3; J d(omega)/dt = torque - omega x J omega."""
    angles, omega, thrust = np.array(angles), np.array(omega), np.array(u) * (1 - np.array(theta))
    x = np.concatenate([[1.0, 2.0, 3.0], angles, [4.0, 5.0, 6.0], omega])
    d = np.asarray(rate(x, np.array(u), np.array(theta)))
    R, h = body_to_world(angles), 1e-6
    moved = (body_to_world(angles + h * d[ANGLES]) - body_to_world(angles - h * d[ANGLES])) / (2 * h)
    np.testing.assert_allclose(moved, R @ skew(omega), atol=1e-7)
    force = -R[:, 2] * 11.18 * thrust.sum() + np.array([0, 0, 1.4 * 9.8])
    np.testing.assert_allclose(d[V], force / 1.4, atol=1e-9)
    J = np.diag(AIRFRAME["inertia"])
    torque = PLANT.B_tau @ thrust - np.cross(omega, J @ omega)
    np.testing.assert_allclose(J @ d[OMEGA], torque, atol=1e-10)
    np.testing.assert_allclose(d[P], [4.0, 5.0, 6.0])


def test_small_steps_fly_as_the_studys_own_truth():
    """Quaternions and Runge-Kutta there, Euler angles and Euler's steps here: the same flight with a weak motor."""
    loss = np.tile([0.4, 0, 0, 0], (150, 1))
    u, pose = fly(AIRFRAME, loss)
    parts = 200

    def step(x, row):
        x = jax.lax.fori_loop(0, parts, lambda _, x: PLANT.f(x, *row, DT / parts), x)
        return x, x[:6]

    start = np.zeros(12)
    start[2] = -1.0
    found = jax.jit(lambda u, loss: jax.lax.scan(step, start, (u, loss))[1])(u, loss)
    assert np.abs(pose - pose[0]).max() > 0.05
    np.testing.assert_allclose(found, pose, atol=3e-4)


def test_losses_act_linearly_and_the_step_is_eulers():
    x, theta = np.linspace(-0.3, 0.3, 12), np.array([0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(PLANT.f(x, HOVER, theta, DT), x + DT * PLANT.derivative(x, HOVER, theta))
    F = jax.jacfwd(lambda theta: PLANT.f(x, HOVER, theta, DT))(theta)
    np.testing.assert_allclose(PLANT.f(x, HOVER, theta, DT) - F @ theta, PLANT.f(x, HOVER, HEALTHY, DT), atol=1e-12)


def test_the_airframe_brings_the_papers_noise():
    np.testing.assert_allclose(PLANT.R(HOVER), np.full(6, 1e-7))
    np.testing.assert_allclose(PLANT.Q(0.01), np.diag([1e-5] * 6 + [1e-8] * 6))
    assert PLANT.y_names == ("north", "east", "down", "roll", "pitch", "yaw") and PLANT.y_units == ("m",) * 3 + ("rad",) * 3


def test_what_is_measured_can_be_chosen():
    plant = RigidBody.of(AIRFRAME, measured=("yaw", "p"), measured_sd=(0.1, 0.2))
    x = np.arange(12.0)
    np.testing.assert_array_equal(plant.h(x, HOVER, HEALTHY), [5.0, 9.0])
    np.testing.assert_allclose(plant.R(HOVER), [0.01, 0.04])
    assert plant.n_y == 2 and plant.y_units == ("rad", "rad/s")


def test_six_rotors_and_traced_numbers():
    hexa = airframes.paper("niermeyer-hexa")
    plant = RigidBody.of(hexa)
    assert plant.n_u == plant.n_theta == 6 and len(plant.theta_names) == 6

    def sink(m, J):
        return RigidBody(J, plant.B_tau, plant.B_T, m).derivative(np.zeros(12), np.zeros(6), np.zeros(6))[8]

    assert float(jax.jit(sink)(2.0, plant.J)) == pytest.approx(9.80665)


@pytest.mark.parametrize(
    "options, says",
    [
        ({"measured": ("yaw", "height")}, r"measured must name some of north, .* not height\."),
        ({"measured": ()}, "not none of them"),
        ({"measured_sd": 0.0}, "measured_sd must be above zero"),
        ({"measured_sd": (0.1, 0.2)}, r"measured_sd must have the shape \(6,\)"),
        ({"walk": (1.0,) * 3}, r"walk must have the shape \(12,\)"),
        ({"walk": (-1.0,) * 12}, "walk must lie between 0"),
        ({"x0": np.zeros(6)}, r"x0 must have the shape \(12,\)"),
        ({"P0": -np.eye(12)}, "P0 is not positive semidefinite"),
    ],
)
def test_bad_numbers_get_one_sentence(options, says):
    with pytest.raises(ConfigError, match=says):
        RigidBody.of(AIRFRAME, **options)


def test_a_bad_geometry_gets_one_sentence():
    with pytest.raises(ConfigError, match=r"B_tau must have the shape \(3, 4\)"):
        RigidBody(np.eye(3), np.ones((3, 3)), np.ones(4), 1.0)
    with pytest.raises(ConfigError, match="J is not positive definite"):
        RigidBody(np.diag([1.0, 1.0, 0.0]), np.ones((3, 4)), np.ones(4), 1.0)
