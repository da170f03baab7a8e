"""Rot, Hasan and Manoonpong 2020: an adaptive exogenous Kalman filter on a hovering hexarotor, two of whose motors weaken.

Noise-free flights with the paper's tuning, as in the paper; then what happens with noise, with other tunings, and with wrong
starts, for which the observer stage is there.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import optional
from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.estimators.adaptive_ekf import AdaptiveEKF
from rotorwatch_lab.estimators.axkf import AXKF, Carry
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.studies import reproduction
from rotorwatch_lab.experiments.studies import rot_flights as flights
from rotorwatch_lab.experiments.studies.reproduction import Claim, Reproduction, graded, panels, silent
from rotorwatch_lab.experiments.studies.rot_flights import DT, LOSSES, MOTORS, ONSETS
from rotorwatch_lab.maths import linearise, observer_gain
from rotorwatch_lab.systems.port_hamiltonian_attitude import PortHamiltonianAttitude

PAPER = "axkf"
NEEDS = ("cvxpy",)
TITLE, LITERAL = reproduction.about(PAPER)
SEEDS = 40
LOUD_SEEDS = 5  # of what shows with few
LAMBDA, S0 = 0.995, 0.001
S_BOUND = 1e8  # with which no digits are lost and the losses come out the same
QUIET, PRINTED_SD = 4e-5, 0.2  # rad; the second is the root of the printed R
# What counts for the verdicts: momenta that follow, and losses that are steady (both as shares of them); an error of a torque in N m.
FOLLOWS, STEADY, TORQUE_ERROR = 0.1, 0.25, 1e-5
EXCITED_S, UNEXCITED = 1.0, 1e-9  # s; share of the largest eigenvalue below which the least one is rounding
BAND = 0.1  # settled: within this share of the loss
LIPSCHITZ_BOX, RATE = (0.4, 0.2, 0.0, 0.2), 30.0  # rad, rad/s: where constants are taken; rate that counts as 1
WRONG_ANGLE, WRONG_RATE, WRONG_SECONDS = 1.0, 30.0, 4.0  # rad, rad/s, s
WRONG_SEEDS = 20
WRONG_SD, WRONG_Q, LOST = 1e-2, 1e-8, 0.5 * np.pi  # rad, 1/s, rad
P0 = {"overconfident": np.array([1e-6] * 3 + [1e-8] * 3), "honest": np.ones(6)}
KEPT_S, KEPT = 20.0, 0.5  # s: how long the observer runs from a wrong start; share of the start's error above which it has not converged
KEEP = 10  # every how many-th step is drawn


class History(namedtuple("History", "theta x z S PC evidence")):
    """theta (lanes, T, p), x (lanes, T, 6) of the filter, z of the observer; S (lanes, T, p): variances; PC (lanes, T, 6, 3); evidence
    (lanes, T, p, p): the information of a step on the losses, Omega' Sigma^-1 Omega."""


class AsPrinted(AXKF):
    """The filter with Table 1's equations where they differ. literal: which of them."""

    name = "axkf_as_printed"

    def __init__(self, system, dt, literal=(), **tuning):
        super().__init__(system, dt, **tuning)
        self.literal = literal

    def step(self, carry: Carry, u, y, valid, dt=None):
        """Predict and update as printed; only for plants with y = C x."""
        import jax.numpy as jnp

        if not {"innovation", "two_predictions"} & set(self.literal):
            return super().step(carry, u, y, valid, dt)
        system, (state, z, correction) = self.system, carry
        f = linearise.transition(system, z, u, state.theta, self.dt)
        h = linearise.measurement(system, z, u, state.theta)
        C, increment = h.by_x, f.value - z if "innovation" in self.literal else state.x + f.value - z
        x = system.f(state.x, u, state.theta, self.dt)
        state, estimate = self.recursion(state, x, f, y - C @ increment, h, u, valid, dt)
        z = f.value + correction
        return Carry(state, z, jnp.asarray(self.gain) @ (y - C @ z)), estimate


def reproduce(seeds: int = SEEDS, literal: tuple[str, ...] = (), progress=silent) -> Reproduction:
    """Run the experiments; seeds: of every noisy one. literal: names out of LITERAL."""
    airframe = airframes.paper("rot-hexa")
    plant = PortHamiltonianAttitude.of(airframe)
    u, theta = flights.thrusts(), flights.losses()
    truth = flights.fly(plant.J, plant.B, u, theta)
    excited = flights.thrusts(excited=True)
    truth_excited = flights.fly(plant.J, plant.B, excited, theta)
    progress(0.1)
    figures: dict[str, Any] = {"p_final": truth[-1, 3:]}
    six = _six(airframe, literal, (u, truth), (excited, truth_excited), figures)
    progress(0.4)
    two = _two(airframe, literal, u, truth, seeds, figures)
    progress(0.6)
    _virtual(airframe, plant, u, truth, figures)
    _theorem(plant, figures)
    figures["kept_of_start"] = _kept(plant)
    figures["turning_torques"] = _turning(truth)
    progress(0.8)
    figures["tumbles_after_s"] = _tumble(plant, u, theta)
    errors = _wrong_starts(airframe, seeds)
    for key, kind in (("divergence", "overconfident"), ("divergence_honest_P0", "honest")):
        figures[key] = {name: _lost(both[kind]) for name, both in errors.items()}
    progress(1.0)
    series = {"time": flights.clock() + DT, "u": u, "losses": theta, "truth": truth}
    series |= {"two": History(*(a[0] for a in two)), "no_fault_term": History(*(a[1] for a in two)), "six": six}
    series |= {"wrong_starts": {name: both["overconfident"][0] for name, both in errors.items()}}
    return Reproduction(PAPER, TITLE, _claims(figures), figures, literal, seeds, series)


def histories(system, literal, lanes) -> History:
    """The filter over many tables at once. lanes: (u (T, n), y (T, 3), forgetting, variance of the losses, s_max) each."""
    jax = load_jax()
    valid = np.ones(3, bool)

    def one(u, y, forgetting, theta_var, s_max):
        memory_s = -DT / jax.numpy.log(forgetting)
        method = AsPrinted(system, DT, literal, gain=observer_gain.printed(), memory_s=memory_s, theta_var=theta_var, s_max=s_max)

        def step(carry, row):
            evidence = information(system, carry, row[0])
            carry, out = method.step(carry, row[0], row[1], valid)
            row_out = History(out.theta, out.x, carry.z, jax.numpy.diagonal(carry.state.S), carry.state.P[:, :3], evidence)
            return carry, row_out

        return jax.lax.scan(step, method.init(), (u, y))[1]

    columns = [np.stack([np.asarray(v, float) for v in column]) for column in zip(*lanes, strict=True)]
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(*columns))


def information(system, carry, u):
    """(p, p) Omega' Sigma^-1 Omega of the step from `carry` with input u, as the filter takes it."""
    import jax.numpy as jnp

    state = carry.state
    _, F, Phi = linearise.transition(system, carry.z, u, state.theta, DT)
    _, C, D = linearise.measurement(system, carry.z, u, state.theta)
    Sigma = C @ (F @ state.P @ F.T + system.Q(DT)) @ C.T + jnp.diag(system.R(u))
    Omega = C @ (F @ state.Upsilon + Phi) + D
    return Omega.T @ jnp.linalg.solve(Sigma, Omega)


def excitation(evidence) -> tuple[float, float]:
    """alpha of eq. (16): the least eigenvalue of the sum of evidence (T, p, p) over any N = EXCITED_S / DT steps in a row, once Omega has
    built up for as long; and the largest eigenvalue of that very sum."""
    total = np.cumsum(evidence, axis=0)
    steps = round(EXCITED_S / DT)
    eigenvalues = np.linalg.eigvalsh(total[2 * steps :: KEEP] - total[steps:-steps:KEEP])
    weakest = int(eigenvalues[:, 0].argmin())
    return float(eigenvalues[weakest, 0]), float(eigenvalues[weakest, -1])


def settling(theta, truth, onset: float) -> float:
    """s from the onset until theta (T,) stays within BAND of the loss for good; inf when it does not."""
    off = np.flatnonzero(np.abs(theta - truth[-1]) > BAND * truth[-1])
    last_outside = off.max(initial=-1)
    return float((last_outside + 2) * DT - onset) if last_outside + 1 < len(theta) else np.inf


def _six(airframe, literal, flight, excited, figures) -> History:
    """Losses of all six motors: as in the paper, with S bounded, and with tones on every motor."""
    start = 1.0 if "initial_s" in literal else S0
    lanes = [
        (flight[0], flight[1][:, :3], LAMBDA, start, np.inf),
        (flight[0], flight[1][:, :3], LAMBDA, start, S_BOUND),
        (excited[0], excited[1][:, :3], LAMBDA, start, S_BOUND),
    ]
    history = histories(PortHamiltonianAttitude.of(airframe), literal, lanes)
    P = history.PC[0, round(ONSETS[0] / DT) - 1]  # level flight, long after the start: P C' = K R
    R = airframe["measurement_var"]
    K = P / R
    figures["sigma11"] = np.linalg.inv(np.eye(3) - K[:3])[0, 0] * R
    figures["k11"], figures["k41"] = K[0, 0], K[3, 0]
    figures["six_theta_final"], figures["six_theta_bounded_final"], figures["six_theta_excited_final"] = history.theta[:, -1]
    figures["s11_final"], figures["s11_bounded_final"] = history.S[:2, -1, 0]
    figures["excitation_six"], figures["excitation_tones"] = (excitation(history.evidence[lane]) for lane in (1, 2))
    return history


def _two(airframe, literal, u, truth, seeds, figures) -> History:
    """Losses of motors 1 and 3 only: as in the paper, without the fault term, other forgetting, and noise."""
    start = 1.0 if "initial_s" in literal else S0
    y, rng = truth[:, :3], np.random.default_rng(2020)
    noise = rng.standard_normal((seeds, *y.shape))
    lanes = [(u, y, LAMBDA, start, np.inf), (u, y, LAMBDA, 0.0, np.inf)]
    lanes += [(u, y, forgetting, start, np.inf) for forgetting in (0.99, 0.998)]
    lanes += [(u, y + QUIET * one, LAMBDA, start, np.inf) for one in noise]
    lanes += [(u, y + PRINTED_SD * one, LAMBDA, start, np.inf) for one in noise[:LOUD_SEEDS]]
    history = histories(PortHamiltonianAttitude.of(airframe, suspects=MOTORS), literal, lanes)
    loss = flights.losses()[:, list(MOTORS)]
    settled = [[settling(lane[:, k], loss[:, k], ONSETS[k]) for k in range(2)] for lane in history.theta[[0, 2, 3]]]
    figures["motors_1_3_final"], figures["motors_1_3_settle_s"] = history.theta[0, -1], settled[0]
    figures["settle_s_lambda_099"], figures["settle_s_lambda_0998"] = settled[1:]
    for name, lane in (("", 0), ("_without_fault_term", 1)):
        figures[f"p_error{name}"] = np.abs(history.x[lane, -1, 3:] - truth[-1, 3:])
        figures[f"observer_p_error{name}"] = np.abs(history.z[lane, -1, 3:] - truth[-1, 3:])
        late = slice(-round(1.0 / DT), None)  # angles of the last second, largest error of each
        figures[f"angle_error{name}"] = np.abs(history.x[lane, late, :3] - truth[late, :3]).max(axis=0)
        figures[f"observer_angle_error{name}"] = np.abs(history.z[lane, late, :3] - truth[late, :3]).max(axis=0)
    figures["angle_final"], figures["excitation_two"] = truth[-1, :3], excitation(history.evidence[0])
    late_theta = history.theta[4:, -round(1.0 / DT) :]  # over seeds and the last second
    quiet, loud = late_theta[:seeds], late_theta[seeds:]
    figures["noise_4e5_mean"], figures["noise_4e5_std"] = quiet.mean(axis=(0, 1)), quiet.std(axis=(0, 1))
    figures["noise_printed_R_std"] = loud.std(axis=(0, 1))
    return history


def _virtual(airframe, plant, u, truth, figures) -> None:
    """Body torques as the input: losses of balanced (zero) torques, and torques that are missing."""
    torque = u @ np.asarray(plant.B).T
    lane = (torque, truth[:, :3], LAMBDA, S0, np.inf)
    missing = -torque[-1] + (u[-1] * flights.losses()[-1]) @ np.asarray(plant.B).T
    noise = {k: airframe[k] for k in ("process_var", "measurement_var")}
    for faults in ("multiplicative", "additive"):
        system = PortHamiltonianAttitude(plant.J, faults=faults, **noise)
        final = histories(system, (), [lane]).theta[0, -1]
        figures[f"virtual_{faults}_final"] = final
        if faults == "additive":
            figures["virtual_additive_error"] = float(np.abs(final - missing).max())


def _theorem(plant, figures) -> None:
    """Theorem 1 with the printed constants, with A = I and with the kinematics in A; and what the printed gain leaves."""
    C, eye = np.eye(3, 6), np.eye(6)
    constants = observer_gain.Lipschitz(rho=1.0, beta=-4.0, eta=1.0)
    whole = observer_gain.theorem_1_eigenvalues(eye, C, 9 * eye, 3 * np.eye(6, 3), constants, 10.0, 10.0)
    three = np.eye(3)
    figures["lmi_paper_max_eig"], figures["lmi_paper_positive"] = whole.max(), int((whole > 0).sum())
    figures["lmi_paper_angles_eig"] = observer_gain.theorem_1(three, three, 9 * three, 3 * three, constants, 10.0, 10.0)
    # x+ = 2 x without measurement or f: rho = 100 is a true bound, and a negative epsilon_1 makes it a merit.
    one = np.eye(1)
    growing = observer_gain.Lipschitz(rho=100.0, beta=0.0, eta=0.0)
    figures["lmi_negative_epsilon"] = observer_gain.theorem_1(2.0 * one, 0.0 * one, one, 0.0 * one, growing, -1.0, 1e3)
    figures["lmi_paper_constants_vacuous"] = observer_gain.is_vacuous(constants)
    J = np.diag(plant.J)
    T = np.concatenate([np.ones(3), RATE * J])
    *angles, rate = LIPSCHITZ_BOX
    F = observer_gain.jacobians(plant, DT, np.concatenate([angles, rate * J])) * T / T[:, None]
    kinematics = eye.copy()
    kinematics[:3, 3:] = DT * RATE * np.eye(3)
    for name, A in (("identity", eye), ("kinematics", kinematics)):
        best, *_ = observer_gain.theorem_1_best(A, C, observer_gain.lipschitz(F - A))
        figures[f"lmi_best_eig_A_{name}"] = best
    left = np.linalg.eigvals(eye - observer_gain.printed() @ C)
    figures["printed_gain_spectral_radius"] = float(np.abs(left).max())


def _kept(plant) -> np.ndarray:
    """(3,) share of a wrong start of each momentum (1 rad/s) that the observer with the printed gain keeps after KEPT_S of hover, with
    exact measurements and no fault."""
    jax = load_jax()
    gain, still, u = observer_gain.printed(), np.zeros(plant.n_theta), np.full(plant.n_u, flights.THRUST)

    def step(z, _):
        return plant.f(z, u, still, DT) - gain @ z[:3], None

    start = np.concatenate([np.zeros((3, 3)), np.diag(np.diag(plant.J))], axis=1)
    after = jax.jit(jax.vmap(lambda z: jax.lax.scan(step, z, None, length=round(KEPT_S / DT))[0]))(start)
    return np.diag(np.asarray(after)[:, 3:]) / np.diag(plant.J)


def _turning(truth) -> dict[str, np.ndarray]:
    """(3,) mean slope of the true momenta [N m] with motor 1 weak and, from 0.1 to 1 s after its onset, with motor 3 weak too."""

    def slope(begin: float, end: float):
        first, last = (round(t / DT) for t in (begin, end))
        return (truth[last, 3:] - truth[first, 3:]) / (end - begin)

    return {"one": slope(ONSETS[0] + 0.1, ONSETS[1] - 0.1), "both": slope(ONSETS[1] + 0.1, ONSETS[1] + 1.0)}


def _tumble(plant, u, theta) -> float:
    """s after take-off until roll or pitch pass 90 degrees with the printed Q as real noise."""
    first = round(flights.ON / DT)
    shock = np.sqrt(0.01) * np.random.default_rng(3).standard_normal((400, 6))
    path = flights.fly(plant.J, plant.B, u[first : first + 400], theta[:400], shock=shock)
    over = np.flatnonzero(~(np.abs(path[:, :2]).max(axis=1) < 0.5 * np.pi))
    return float((over[0] + 1) * DT) if over.size else np.inf


def _lost(errors) -> float:
    """Share of seeds whose angles are wrong, or no numbers, in the last quarter; errors (seeds, T) in rad."""
    return float(np.mean(~(errors[:, -errors.shape[1] // 4 :] < LOST).all(axis=1)))


def _wrong_starts(airframe, seeds) -> dict[str, dict[str, np.ndarray]]:
    """{filter: {P0: largest error of angles (seeds, T) [rad]}} from starts about 1 rad and 30 rad/s off."""
    jax = load_jax()
    plant = PortHamiltonianAttitude.of(airframe)
    rows, rng = round(WRONG_SECONDS / DT), np.random.default_rng(7)
    u = flights.thrusts(excited=True)[round(flights.ON / DT) :][:rows]
    theta = np.zeros_like(u)
    theta[rows // 2 :, MOTORS[0]] = 2 * LOSSES[0]
    truth = flights.fly(plant.J, plant.B, u, theta)
    J, seeds = np.diag(plant.J), min(seeds, WRONG_SEEDS)
    size = np.concatenate([np.full(3, WRONG_ANGLE), WRONG_RATE * J])
    starts = size * rng.choice([-1.0, 1.0], (seeds, 6)) * rng.uniform(0.8, 1.0, (seeds, 6))
    y = truth[:, :3] + WRONG_SD * rng.standard_normal((seeds, rows, 3))
    box = np.concatenate([[1.0, 0.8, 0.0], 2.0 * J])
    gain = injecting_gain(plant, box)
    methods = {
        "adaptive_ekf": lambda system: AdaptiveEKF(system, DT, theta_var=S0),
        "axkf": lambda system: AXKF(system, DT, gain=gain, theta_var=S0),
        "ekf": lambda system: EKF(system, DT, theta_var=S0),
    }
    q = WRONG_Q * np.concatenate([np.ones(3), J**2])
    errors = {}
    for name, build in methods.items():

        def angles(y, start, variance, build=build):
            noise = {"process_var": q, "measurement_var": WRONG_SD**2}
            begin = {"x0": start, "P0": jax.numpy.diag(variance)}
            system = PortHamiltonianAttitude.of(airframe, suspects=MOTORS, **noise, **begin)
            return tools.stepped(build(system), u, y, lambda out: out.x[:3])

        run = jax.jit(jax.vmap(angles, in_axes=(0, 0, None)))
        # NumPy's maximum of NaN is NaN; XLA's may be a number.
        errors[name] = {kind: np.abs(np.asarray(run(y, starts, variance)) - truth[:, :3]).max(axis=-1) for kind, variance in P0.items()}
    return errors


def injecting_gain(plant, box) -> np.ndarray:
    """(6, 3) gain that corrects momenta too: 5 % contraction per step over a box of half-widths box (6,)."""
    scale = np.concatenate([np.ones(3), 20.0 * np.diag(plant.J)])
    F = observer_gain.jacobians(plant, DT, box)
    return observer_gain.common_lyapunov(F, np.eye(3, 6), 0.95, scale=scale).gain


def _claims(f: dict[str, Any]) -> tuple[Claim, ...]:
    """The paper's claims beside what came out."""
    p, six, tones = (f[key] for key in ("p_final", "six_theta_final", "six_theta_excited_final"))
    works = (np.abs(np.subtract(f["motors_1_3_final"], LOSSES)) < BAND * np.array(LOSSES)).all()
    lost, honest = f["divergence"], f["divergence_honest_P0"]
    # Errors of the momenta at the end, as shares of them: of the observer stage and of the filter, with the fault term and without.
    slow, quick, blind, follows = (
        float(np.max(f[f"{who}p_error{term}"] / np.abs(p))) for term in ("", "_without_fault_term") for who in ("observer_", "")
    )
    one, both = f["turning_torques"].values()
    angle = np.abs(f["angle_final"]).max()
    off = [np.max(f[f"{who}angle_error{term}"]) for who in ("", "observer_") for term in ("", "_without_fault_term")]
    excited = {which: f[f"excitation_{which}"][0] > UNEXCITED * f[f"excitation_{which}"][1] for which in ("two", "six")}
    quiet, loud = ((np.asarray(f[k]) < STEADY * np.array(LOSSES)).all() for k in ("noise_4e5_std", "noise_printed_R_std"))
    share = np.abs(f["virtual_multiplicative_final"]).max()
    seen, recovered = share > 0.5 * min(LOSSES), f["virtual_additive_error"] < TORQUE_ERROR
    verdicts = {
        "motion": graded(p[0] > 0 > p[1] and p[2] > 0),
        "six": graded(abs(six[0] - LOSSES[0]) < 0.01 and abs(six[2] - LOSSES[1]) < 0.01),
        "two": graded(works),
        "tones": graded(np.abs(tones - flights.losses()[-1]).max() < 0.01),
        "motor_3": graded(0 < both[0] < one[0] and both[2] > one[2] > 0),
        "theorem": "refuted" if f["lmi_paper_max_eig"] > 0 else "holds",
        "epsilons": "refuted" if f["lmi_negative_epsilon"] < 0 else "holds",
        "converges": "refuted" if np.max(np.abs(f["kept_of_start"])) > KEPT else "holds",
        "slow_momenta": graded(quick < slow < FOLLOWS, quick < FOLLOWS < slow),
        "no_fault_term": graded(min(blind, follows) > FOLLOWS, max(blind, follows) > FOLLOWS),
        "noise": graded(loud, quiet),
        "forgetting": graded(works),
        "angles": graded(max(off) < FOLLOWS * angle, min(off) < FOLLOWS * angle),
        "excitation": graded(excited["six"], excited["two"]),
        "bounded": graded(f["s11_final"] < S_BOUND),
        "torques": graded(seen and recovered, seen or recovered),
        "divergence": graded(lost["axkf"] == 0 < lost["adaptive_ekf"] and honest["adaptive_ekf"] > 0, True),
    }
    settle = [_seconds(f[key]) for key in ("motors_1_3_settle_s", "settle_s_lambda_099", "settle_s_lambda_0998")]
    return reproduction.claims(
        PAPER, verdicts, f=f, settle=settle, angle=angle, off=off, span=EXCITED_S, share=share,
        six=", ".join(f"{v:.4f}" for v in six), tones=", ".join(f"{v:.4f}" for v in tones),
        quiet=_pair(f["noise_4e5_mean"], f["noise_4e5_std"]), loud=np.min(f["noise_printed_R_std"]),
        lost=_shares(lost), honest=_shares(honest),
    )  # fmt: skip


def _pair(mean, sd) -> str:
    return " and ".join(f"{m:.3f}+-{s:.3f}" for m, s in zip(mean, sd, strict=True))


def _seconds(values) -> str:
    return " and ".join(f"{v:.2f} s" if np.isfinite(v) else "never" for v in values)


def _shares(shares: dict[str, float]) -> str:
    return ", ".join(f"{name} {share:.0%}" for name, share in shares.items())


def figures(result: Reproduction) -> dict:
    """The paper's figures 3, 4 and 6 to 9, and all six losses."""
    optional.library("matplotlib", "A figure").use("agg")
    series = result.series
    rows, t = slice(None, None, KEEP), series["time"][::KEEP]
    two, without, six = series["two"], series["no_fault_term"], series["six"]
    wanted, drawn = series["losses"][rows], {}
    drawn["fig3_thrust"], (axis,) = _axes(1, "thrust [N]")
    axis.plot(t, series["u"][rows, 0], "k")
    drawn["fig4_faults"], axes = _axes(2, "loss")
    for k, axis in enumerate(axes):
        axis.plot(t, two.theta[rows, k], "C3--", label="estimate")
        axis.plot(t, wanted[:, MOTORS[k]], "k", lw=1, label="truth")
        axis.set_title(f"motor {MOTORS[k] + 1}")
    axes[0].legend()
    drawn["six_losses"], axes = _axes(2, "loss")
    for axis, lane, title in zip(axes, (1, 2), ("equal thrusts", "a tone on every motor"), strict=True):
        for k in range(6):
            axis.plot(t, six.theta[lane, rows, k], f"C{k}", label=f"motor {k + 1}")
        axis.plot(t, wanted[:, list(MOTORS)], "k:", lw=1)
        axis.set(ylim=(-0.1, 0.2), title=title)
    axes[1].legend(ncols=2, fontsize="x-small")
    for stem, history, first in (
        ("fig6_angles", two, 0), ("fig7_momenta", two, 3),
        ("fig8_angles_without_fault_term", without, 0), ("fig9_momenta_without_fault_term", without, 3),
    ):  # fmt: skip
        drawn[stem], axes = _axes(3, "[kg m2/s]" if first else "[rad]")
        for k, axis in enumerate(axes):
            axis.plot(t, series["truth"][rows, first + k], "k", lw=1, label="truth")
            axis.plot(t, history.z[rows, first + k], "C0", label="observer")
            axis.plot(t, history.x[rows, first + k], "C3--", label="filter")
            axis.set_title(("roll", "pitch", "yaw")[k])
        axes[0].legend()
    drawn["wrong_starts"], (axis,) = _axes(1, "largest error of angles [rad]")
    for name, error in series["wrong_starts"].items():
        invalid = np.logical_or.accumulate(~(error < 5.0))  # no angles any more
        axis.semilogy(DT * np.arange(len(error))[rows], np.where(invalid, np.nan, error)[rows], label=name)
    axis.axhline(LOST, color="k", ls=":", lw=1)
    axis.legend()
    return drawn


def _axes(count: int, label: str):
    """A figure with `count` panels side by side, time below."""
    figure, (axes,) = panels(1, count, (1.5 + 2.8 * count, 2.8), grid=False)
    axes[0].set_ylabel(label)
    for axis in axes:
        axis.set_xlabel("time [s]")
    return figure, axes
