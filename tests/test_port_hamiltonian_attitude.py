"""Attitude in Hamiltonian form: it is the rigid body, and says what is wrong with a configuration."""

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments.studies.rot_flights import body_rates, euler_rates
from rotorwatch_lab.systems.port_hamiltonian_attitude import PortHamiltonianAttitude

jax = load_jax()
jnp = jax.numpy


def newton_euler(plant, x, u, theta):
    """dq/dt and dp/dt of a rigid body with J and the body torque B diag(u) (1 - theta), through body rates."""
    q, p = x[:3], x[3:]
    omega = np.linalg.solve(plant.J, np.asarray(euler_rates(q)).T @ p)
    omega_dot = np.linalg.solve(plant.J, plant.B @ (u * (1 - theta)) - np.cross(omega, plant.J @ omega))
    q_dot = np.asarray(euler_rates(q)) @ omega
    W, W_dot = jax.jvp(body_rates, (jnp.asarray(q),), (jnp.asarray(q_dot),))
    return np.concatenate([q_dot, np.asarray(W_dot).T @ plant.J @ omega + np.asarray(W).T @ plant.J @ omega_dot])


def test_hamiltonian_form_is_the_rigid_body_when_forces_are_physical():
    airframe, rng = airframes.paper("rot-hexa"), np.random.default_rng(2)
    physical = PortHamiltonianAttitude.of(airframe, generalised_force="physical")
    printed = PortHamiltonianAttitude.of(airframe)
    apart = []
    for _ in range(20):
        x = np.concatenate([rng.uniform(-1.2, 1.2, 3), 0.05 * rng.standard_normal(3)])
        u, theta = rng.uniform(0, 1, 6), rng.uniform(0, 1, 6)
        wanted = newton_euler(physical, x, u, theta)
        apart.append([np.abs(np.asarray(s.derivative(x, u, theta)) - wanted).max() for s in (physical, printed)])
    assert np.max(apart, axis=0)[0] < 1e-11
    assert np.max(apart, axis=0)[1] > 1e-2  # the paper's force is another one
    wrong = PortHamiltonianAttitude(physical.J * np.diag([1.0, 1.0, 1.001]), physical.B, generalised_force="physical")
    assert np.abs(np.asarray(wrong.derivative(x, u, theta)) - wanted).max() > 1e-6


def test_free_motion_keeps_its_energy():
    """H is a first integral of dq/dt = dH/dp, dp/dt = -dH/dq: the derivative along the flow vanishes."""
    plant = PortHamiltonianAttitude.of(airframes.paper("rot-hexa"))

    def energy(x):
        momentum = euler_rates(x[:3]).T @ x[3:]
        return 0.5 * momentum @ (plant._J_inverse @ momentum)

    x = jnp.array([0.4, -0.7, 1.0, 0.02, -0.03, 0.05])
    flow = plant.derivative(x, jnp.zeros(6), jnp.zeros(6))
    assert abs(jax.grad(energy)(x) @ flow) < 1e-14
    np.testing.assert_allclose(flow[:3], jax.grad(energy)(x)[3:], atol=1e-12)
    np.testing.assert_allclose(flow[3:], -jax.grad(energy)(x)[:3], atol=1e-12)


def test_missing_torques_and_suspects():
    J = PortHamiltonianAttitude.of(airframes.paper("rot-hexa")).J
    plant = PortHamiltonianAttitude(J, faults="additive", suspects=(2,))
    assert plant.theta_names == ("missing_3",) and plant.n_theta == 1
    x_dot = plant.derivative(jnp.zeros(6), jnp.array([0.1, 0.2, 0.3]), jnp.array([0.05]))
    np.testing.assert_allclose(x_dot[3:], [0.1, 0.2, 0.25], atol=1e-15)
    traced = jax.jit(lambda J: PortHamiltonianAttitude(J).derivative(jnp.full(6, 0.1), jnp.ones(3), jnp.zeros(3)))
    usual = PortHamiltonianAttitude(J).derivative(jnp.full(6, 0.1), jnp.ones(3), jnp.zeros(3))
    np.testing.assert_allclose(traced(J), usual, atol=1e-12)


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: PortHamiltonianAttitude(-np.eye(3)), "J is not positive definite"),
        (lambda: PortHamiltonianAttitude(np.eye(3), np.eye(2)), r"B must have the shape \(3, n\)"),
        (lambda: PortHamiltonianAttitude(np.eye(3), suspects=(0, 3)), "suspects must be different inputs from 0 to 2"),
        (lambda: PortHamiltonianAttitude(np.eye(3), generalised_force="right"), "must be one of printed, physical"),
        (lambda: PortHamiltonianAttitude(np.eye(3), faults="none"), "must be one of multiplicative, additive"),
        (lambda: PortHamiltonianAttitude(np.eye(3), process_var=[1.0]), "process_var must be one number or 6"),
    ],
)
def test_bad_configuration_gets_one_sentence(build, sentence):
    with pytest.raises(ConfigError, match=sentence):
        build()
