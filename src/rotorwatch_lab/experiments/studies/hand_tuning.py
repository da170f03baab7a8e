"""Each paper's hand tuning against the result of `tune`, on flights not used for fitting.

For each paper's airframe, plant and covariances: the tuning is fitted to two healthy flights with the noise of the paper's sensors; a
third one, healthy, gives the likelihood under either tuning, and a fourth one, in which the first actuator loses 0.3 half-way, the error
of the losses. The filter is the augmented extended Kalman filter for all papers: covariances are compared, not methods. Truth: the same
physics in finer steps (Runge-Kutta), under a feedback that does not know the loss.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import rotorwatch_lab.tune as tune
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.choices import meant
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.studies.runge_kutta import rk4
from rotorwatch_lab.published import published
from rotorwatch_lab.tune import Table

LOSS, METHOD, SUBSTEPS = 0.3, "ekf", 4


class Paper(NamedTuple):
    """plant, with the paper's covariances; dt [s]; rows of a flight; keywords: the paper's walk and first variance of the losses;
    hover (n_u,); feedback (n_u, n_x); process_sd (n_x,) per square root of s and sensor_sd (n_y,): the noise there is."""

    plant: Any
    dt: float
    rows: int
    keywords: dict
    hover: np.ndarray
    feedback: np.ndarray
    process_sd: np.ndarray
    sensor_sd: np.ndarray


def axkf() -> Paper:
    """Rot 2020: Q = 0.01, R = 0.04; sensors of 0.2 degrees."""
    from rotorwatch_lab.systems.port_hamiltonian_attitude import PortHamiltonianAttitude

    frame = airframes.paper("rot-hexa")
    plant = PortHamiltonianAttitude.of(frame, suspects=(0, 2), generalised_force="physical")
    J = np.array(frame["inertia"], float)
    feedback = np.linalg.pinv(np.asarray(plant.B)) @ np.hstack([np.diag(36.0 * J), np.diag([10.0] * 3)])
    process_sd = np.concatenate([np.zeros(3), 0.02 * J * 10.0])
    # Filters know the mean of a row; the vehicle hovers, excited.
    keywords = {"theta_walk": 1e-3, "theta_var": 1e-3}
    return Paper(plant, 0.005, 1000, keywords, np.full(6, 2.0), feedback, process_sd, np.full(3, np.radians(0.2)))


def atsukf() -> Paper:
    """Zhang 2023: Q_theta = 0.01 a step, R = 1e-7; sensors with R."""
    from rotorwatch_lab.systems.rigid_body import RigidBody

    frame = airframes.paper("uaf-02e")
    plant = RigidBody.of(frame, P0=1e-4 * np.eye(12))
    hover = np.full(4, plant.m * plant.gravity / np.sum(plant.B_T))
    J = np.diag(plant.J)
    torque = np.hstack([np.zeros((3, 3)), np.diag(60.0 * J), np.zeros((3, 3)), np.diag(12.0 * J)])
    torque[0, [1, 7]], torque[1, [0, 6]] = 60.0 * J[0] * np.array([0.15, 0.25]), -60.0 * J[1] * np.array([0.15, 0.25])
    thrust = np.zeros((1, 12))
    thrust[0, [2, 8]] = -plant.m * np.array([4.0, 4.0])
    feedback = np.linalg.inv(np.vstack([plant.B_tau, plant.B_T])) @ np.vstack([torque, thrust])
    process_sd = np.concatenate([np.zeros(6), np.full(3, 0.05), np.full(3, 0.05)])
    keywords = {"theta_walk": 1.0, "theta_var": 1e-6}
    return Paper(plant, 0.01, 1200, keywords, hover, feedback, process_sd, np.full(6, np.sqrt(1e-7)))


def lyapunov_mhe() -> Paper:
    """Niermeyer 2017: gyro 0.01 rad/s, accelerometer 0.3 m/s^2; no covariance is printed: the plant's own count as hand-tuned."""
    from rotorwatch_lab.systems.rate_dynamics import RateDynamics

    plant = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    B = np.vstack([plant.B_tau, plant.B_T])
    mix = np.linalg.pinv(B)
    hover = mix @ np.array([0.0, 0.0, 0.0, plant.m * G0])
    feedback = mix[:, :3] @ np.diag(8.0 * np.diag(plant.J))
    process_sd = 0.02 / np.diag(plant.J)
    return Paper(plant, 0.02, 1000, {}, hover, feedback, process_sd, np.array([0.01, 0.01, 0.01, 0.3]))


def aesmf() -> Paper:
    """The 40 kg helicopter: a third of the noise bounds, as the set-membership filters' Kalman rivals have it."""
    from rotorwatch_lab.systems.helicopter import Helicopter

    jax = load_jax()
    plant = Helicopter(airframes.paper("ruav-40kg"))
    hover = np.concatenate([plant.trim, np.zeros(2)])
    healthy = np.zeros(plant.n_theta)
    by_u = np.asarray(jax.jacfwd(lambda u: plant.derivative(np.zeros(6), u, healthy))(hover))[:, :4]
    drift = np.asarray(plant.derivative(np.zeros(6), hover, healthy))
    rows = [2, 3, 4, 5]  # climb and rates follow; forward and sideways motion is left to drag
    inverse = np.linalg.inv(by_u[rows])
    feedback = np.zeros((6, 6))
    feedback[:4, rows] = inverse @ np.diag([1.0, 4.0, 4.0, 4.0])
    hover[:4] -= inverse @ drift[rows]
    process_sd = np.repeat([4e-3, 8e-3], 3) / np.sqrt(0.02) * 0.5
    return Paper(plant, 0.02, 1000, {}, hover, feedback, process_sd, 2.0 * np.sqrt(np.asarray(plant.R(hover))))


PAPERS: dict[str, Callable[[], Paper]] = {"axkf": axkf, "atsukf": atsukf, "lyapunov-mhe": lyapunov_mhe, "aesmf": aesmf}


def fly(paper: Paper, seed: int, loss: float = 0.0) -> tuple[Table, np.ndarray]:
    """A flight and its true losses (T, n_theta): every actuator excited, actuator 1 losing `loss` half-way."""
    jax = load_jax()
    jnp = jax.numpy
    plant, dt, T = paper.plant, paper.dt, paper.rows
    rng = np.random.default_rng(seed)
    theta = np.zeros((T, plant.n_theta))
    theta[T // 2 :, 0] = loss
    when = dt * np.arange(T)[:, None]
    pace = 2 * np.pi * (0.4 + 0.23 * np.arange(plant.n_u))
    moving = np.abs(paper.hover) > 1e-9
    wiggle = 0.04 * np.where(moving, paper.hover, 0.0) * np.sin(when * pace + np.arange(plant.n_u))
    push = rng.standard_normal((T, plant.n_x)) * paper.process_sd / np.sqrt(dt)
    noise = rng.standard_normal((T, plant.n_y)) * paper.sensor_sd

    def step(x, row):
        theta, wiggle, push, noise = row
        u = paper.hover + wiggle - paper.feedback @ (x - jnp.asarray(plant.x0))

        def rate(x):
            return plant.derivative(x, u, theta) + push

        for _ in range(SUBSTEPS):
            x = rk4(rate, x, dt / SUBSTEPS)
        return x, (u, plant.h(x, u, theta) + noise)

    start = jnp.asarray(plant.x0, float)
    u, y = jax.jit(lambda rows: jax.lax.scan(step, start, rows)[1])((theta, wiggle, push, noise))
    return Table(plant, np.asarray(u), np.asarray(y), np.ones((T, plant.n_y), bool), dt), theta


def study(names: Sequence[str] = (), rounds: int = tune.ROUNDS, progress: Callable | None = None) -> list[dict]:
    """A row for each paper: log-likelihood of a row of the unseen healthy flight, and RMSE of the losses (helicopter: of the
    actuators' outputs) of the unseen faulty one, by hand and tuned; and the tuning.

    names: of PAPERS, all when empty. Raises ConfigError for others.
    """
    for name in names:
        if name not in PAPERS:
            raise ConfigError(f"There is no paper called {name!r}{meant(name, PAPERS)}; known are {', '.join(PAPERS)}.")
    rows = []
    for k, name in enumerate(names or PAPERS):
        paper = PAPERS[name]()
        fit = tune.fit(METHOD, [fly(paper, 0)[0], fly(paper, 1)[0]], paper.keywords, rounds)
        healthy, (faulty, truth) = fly(paper, 2)[0], fly(paper, 3, LOSS)
        hand = published.Tuning(keywords=paper.keywords)
        row: dict[str, Any] = {"paper": name, "plant": paper.plant.name}
        for how, tuning in (("hand", hand), ("tuned", fit.tuning)):
            row[f"{how}_log_likelihood"] = tune.log_likelihood(METHOD, healthy, tuning)
            row[f"{how}_rmse"] = _rmse(faulty, truth, tuning)
        rows.append(row | {"q": fit.tuning.q.tolist(), "r": fit.tuning.r.tolist(), "keywords": dict(fit.tuning.keywords)})
        if progress:
            progress((k + 1) / len(names or PAPERS), name)
    return rows


def _rmse(table: Table, truth: np.ndarray, tuning: published.Tuning) -> float:
    """RMSE of all losses, once the filter has settled. A plant with biases cannot tell losses from biases while the command is constant:
    there the actuators' outputs are compared."""
    estimator = published.method(METHOD, table.system, table.dt, tuning)
    _, theta = run(estimator, table.u, table.y, table.valid, select=tools.losses)
    error = theta - truth
    outputs = getattr(table.system, "outputs", None)
    if outputs is not None:
        both = load_jax().vmap(outputs)
        error = np.asarray(both(table.u, theta) - both(table.u, truth))
    return float(np.sqrt(np.mean(error[tune.SETTLE :] ** 2)))


def markdown(rows: Sequence[dict]) -> str:
    """The rows as a Markdown table."""
    heads = ("paper", "plant", "log-likelihood by hand", "tuned", "loss RMSE by hand", "tuned")
    kinds = {"log_likelihood": 2, "rmse": 4}
    cells = ([f"{r[f'{how}_{what}']:.{k}f}" for what, k in kinds.items() for how in ("hand", "tuned")] for r in rows)
    return tools.table(heads, ([r["paper"], f"`{r['plant']}`", *c] for r, c in zip(rows, cells))) + "\n"
