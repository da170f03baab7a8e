"""Rot, Hasan and Manoonpong 2020: an adaptive exogenous Kalman filter on a hovering hexarotor of which two motors weaken.

Noise-free flights with the paper's tuning, as in the paper; then what happens with noise, with other tunings, and with wrong
starts, for which the observer stage is there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes, optional
from rotorwatch.backend import jax as load_jax
from rotorwatch.estimators.adaptive_ekf import AdaptiveEKF
from rotorwatch.estimators.axkf import AXKF, Carry
from rotorwatch.estimators.ekf import EKF
from rotorwatch.experiments.studies import rot_flights as flights
from rotorwatch.experiments.studies.reproduction import Claim, Reproduction, Verdict, check_literal
from rotorwatch.experiments.studies.rot_flights import DT, LOSSES, MOTORS, ONSETS
from rotorwatch.maths import adaptive_kalman, linearise, observer_gain
from rotorwatch.systems.port_hamiltonian_attitude import PortHamiltonianAttitude

PAPER = "axkf"
NEEDS = ("cvxpy",)
TITLE = "Rot, Hasan and Manoonpong 2020, Robust actuator fault diagnosis for hexacopter UAVs (IFAC-PapersOnLine 53-2)"
LITERAL = {
    "innovation": "Table 1's innovation leaves A x out: the measurement itself drives the losses, which run away",
    "two_predictions": "the innovation uses f at the observer, the update f at the filter's own estimate",
    "initial_s": "S(0) = I as in Table 1, instead of 0.001 I as in the text: losses are found sooner",
}
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
KEEP = 10  # every how many-th step is drawn


class History(NamedTuple):
    """theta (lanes, T, p), x (lanes, T, 6) of the filter, z of the observer; S (lanes, T, p): variances; PC (lanes, T, 6, 3); told
    (lanes, T, p, p): what a step tells of the losses, Omega' Sigma^-1 Omega."""

    theta: Any
    x: Any
    z: Any
    S: Any
    PC: Any
    told: Any


class AsPrinted(AXKF):
    """The filter with Table 1's equations where they differ. literal: which of them."""

    name = "axkf_as_printed"

    def __init__(self, system, dt, literal=(), **tuning):
        super().__init__(system, dt, **tuning)
        self.literal = literal

    def step(self, carry: Carry, u, y, valid, dt=None):
        """One step; only for plants with y = C x."""
        import jax.numpy as jnp

        if not {"innovation", "two_predictions"} & set(self.literal):
            return super().step(carry, u, y, valid, dt)
        system, (state, z, correction) = self.system, carry
        f, F, Phi = linearise.transition(system, z, u, state.theta, self.dt)
        _, C, D = linearise.measurement(system, z, u, state.theta)
        increment = f - z if "innovation" in self.literal else state.x + f - z
        x = system.f(state.x, u, state.theta, self.dt)
        state, estimate = adaptive_kalman.step(
            state, x, F, Phi, y - C @ increment, C, D, system.Q(self.dt), system.R(u), valid, self.tuned
        )
        z = f + correction
        return Carry(state, z, jnp.asarray(self.gain) @ (y - C @ z)), estimate


def reproduce(seeds: int = SEEDS, literal: tuple[str, ...] = (), progress=None) -> Reproduction:
    """Run the experiments; seeds: of every noisy one. literal: names out of LITERAL."""
    import sys

    literal = check_literal(sys.modules[__name__], tuple(literal))
    tell = progress or (lambda _: None)
    airframe = airframes.paper("rot-hexa")
    plant = PortHamiltonianAttitude.of(airframe)
    u, theta = flights.thrusts(), flights.losses()
    truth = flights.fly(plant.J, plant.B, u, theta)
    excited = flights.thrusts(excited=True)
    truth_excited = flights.fly(plant.J, plant.B, excited, theta)
    tell(0.1)
    figures: dict[str, Any] = {"p_final": truth[-1, 3:]}
    six = _six(airframe, literal, (u, truth), (excited, truth_excited), figures)
    tell(0.4)
    two = _two(airframe, literal, u, truth, seeds, figures)
    tell(0.6)
    _virtual(airframe, plant, u, truth, figures)
    _theorem(plant, figures)
    tell(0.8)
    figures["tumbles_after_s"] = _tumble(plant, u, theta)
    errors = _wrong_starts(airframe, seeds)
    for key, kind in (("divergence", "overconfident"), ("divergence_honest_P0", "honest")):
        figures[key] = {name: _lost(both[kind]) for name, both in errors.items()}
    tell(1.0)
    series = {"time": flights.clock() + DT, "u": u, "losses": theta, "truth": truth}
    series |= {"two": History(*(a[0] for a in two)), "no_fault_term": History(*(a[1] for a in two)), "six": six}
    series |= {"wrong_starts": {name: both["overconfident"][0] for name, both in errors.items()}}
    return Reproduction(PAPER, TITLE, _claims(figures), figures, literal, seeds, series)


def histories(system, literal, lanes) -> History:
    """The filter over many tables at once. lanes: (u (T, n), y (T, 3), forgetting, variance of the losses, s_max) each."""
    jax = load_jax()
    valid = np.ones(3, bool)

    def one(u, y, forgetting, theta_var, s_max):
        method = AsPrinted(
            system,
            DT,
            literal,
            gain=observer_gain.printed(),
            forgetting=forgetting,
            theta_var=theta_var,
            s_max=s_max,
        )

        def step(carry, row):
            told = information(system, carry, row[0])
            carry, out = method.step(carry, row[0], row[1], valid)
            kept = History(out.theta, out.x, carry.z, jax.numpy.diagonal(carry.state.S), carry.state.P[:, :3], told)
            return carry, kept

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


def excitation(told) -> tuple[float, float]:
    """alpha of eq. (16): the least eigenvalue of the sum of told (T, p, p) over any N = EXCITED_S / DT steps in a row, once Omega has
    built up for as long; and the largest eigenvalue of that very sum."""
    total = np.cumsum(told, axis=0)
    steps = round(EXCITED_S / DT)
    eigenvalues = np.linalg.eigvalsh(total[2 * steps :: KEEP] - total[steps:-steps:KEEP])
    weakest = int(eigenvalues[:, 0].argmin())
    return float(eigenvalues[weakest, 0]), float(eigenvalues[weakest, -1])


def settling(theta, truth, onset: float) -> float:
    """s from the onset until theta (T,) stays within BAND of the loss for good; inf when it does not."""
    outside = np.flatnonzero(np.abs(theta - truth[-1]) > BAND * truth[-1])
    last = outside.max(initial=-1)
    return float((last + 2) * DT - onset) if last + 1 < len(theta) else np.inf


def _six(airframe, literal, flight, excited, figures) -> History:
    """Losses of all six motors: as in the paper, with S bounded, and with tones on every motor."""
    start = 1.0 if "initial_s" in literal else S0
    lanes = [
        (flight[0], flight[1][:, :3], LAMBDA, start, np.inf),
        (flight[0], flight[1][:, :3], LAMBDA, start, S_BOUND),
        (excited[0], excited[1][:, :3], LAMBDA, start, S_BOUND),
    ]
    found = histories(PortHamiltonianAttitude.of(airframe), literal, lanes)
    P = found.PC[0, round(ONSETS[0] / DT) - 1]  # level flight, long after the start: P C' = K R
    R = airframe["measurement_var"]
    K = P / R
    figures["sigma11"] = np.linalg.inv(np.eye(3) - K[:3])[0, 0] * R
    figures["k11"], figures["k41"] = K[0, 0], K[3, 0]
    figures["six_theta_final"], figures["six_theta_bounded_final"], figures["six_theta_excited_final"] = found.theta[
        :, -1
    ]
    figures["s11_final"], figures["s11_bounded_final"] = found.S[:2, -1, 0]
    figures["excitation_six"], figures["excitation_tones"] = (excitation(found.told[lane]) for lane in (1, 2))
    return found


def _two(airframe, literal, u, truth, seeds, figures) -> History:
    """Losses of motors 1 and 3 only: as in the paper, without the fault term, other forgetting, and noise."""
    start = 1.0 if "initial_s" in literal else S0
    y, rng = truth[:, :3], np.random.default_rng(2020)
    noise = rng.standard_normal((seeds, *y.shape))
    lanes = [(u, y, LAMBDA, start, np.inf), (u, y, LAMBDA, 0.0, np.inf)]
    lanes += [(u, y, forgetting, start, np.inf) for forgetting in (0.99, 0.998)]
    lanes += [(u, y + QUIET * one, LAMBDA, start, np.inf) for one in noise]
    lanes += [(u, y + PRINTED_SD * one, LAMBDA, start, np.inf) for one in noise[:LOUD_SEEDS]]
    found = histories(PortHamiltonianAttitude.of(airframe, suspects=MOTORS), literal, lanes)
    loss = flights.losses()[:, list(MOTORS)]
    settled = [[settling(lane[:, k], loss[:, k], ONSETS[k]) for k in range(2)] for lane in found.theta[[0, 2, 3]]]
    figures["motors_1_3_final"], figures["motors_1_3_settle_s"] = found.theta[0, -1], settled[0]
    figures["settle_s_lambda_099"], figures["settle_s_lambda_0998"] = settled[1:]
    for name, lane in (("", 0), ("_without_fault_term", 1)):
        figures[f"p_error{name}"] = np.abs(found.x[lane, -1, 3:] - truth[-1, 3:])
        figures[f"observer_p_error{name}"] = np.abs(found.z[lane, -1, 3:] - truth[-1, 3:])
        late = slice(-round(1.0 / DT), None)  # angles of the last second, largest error of each
        figures[f"angle_error{name}"] = np.abs(found.x[lane, late, :3] - truth[late, :3]).max(axis=0)
        figures[f"observer_angle_error{name}"] = np.abs(found.z[lane, late, :3] - truth[late, :3]).max(axis=0)
    figures["angle_final"], figures["excitation_two"] = truth[-1, :3], excitation(found.told[0])
    last = found.theta[4:, -round(1.0 / DT) :]  # over seeds and the last second
    quiet, loud = last[:seeds], last[seeds:]
    figures["noise_4e5_mean"], figures["noise_4e5_std"] = quiet.mean(axis=(0, 1)), quiet.std(axis=(0, 1))
    figures["noise_printed_R_std"] = loud.std(axis=(0, 1))
    return found


def _virtual(airframe, plant, u, truth, figures) -> None:
    """Body torques as the input: losses of balanced (zero) torques, and torques that are missing."""
    torque = u @ np.asarray(plant.B).T
    lane = (torque, truth[:, :3], LAMBDA, S0, np.inf)
    missing = -torque[-1] + (u[-1] * flights.losses()[-1]) @ np.asarray(plant.B).T
    noise = {k: airframe[k] for k in ("process_var", "measurement_var")}
    for faults in ("multiplicative", "additive"):
        system = PortHamiltonianAttitude(plant.J, faults=faults, **noise)
        found = histories(system, (), [lane]).theta[0, -1]
        figures[f"virtual_{faults}_final"] = found
        if faults == "additive":
            figures["virtual_additive_error"] = float(np.abs(found - missing).max())


def _theorem(plant, figures) -> None:
    """Theorem 1 with the printed constants, with A = I and with the kinematics in A; and what the printed gain leaves."""
    C, eye = np.eye(3, 6), np.eye(6)
    constants = observer_gain.Lipschitz(rho=1.0, beta=-4.0, eta=1.0)
    figures["lmi_paper_max_eig"] = observer_gain.theorem_1(eye, C, 9 * eye, 3 * np.eye(6, 3), constants, 10.0, 10.0)
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
    valid, errors = np.ones(3, bool), {}
    for name, build in methods.items():

        def error(y, start, variance, build=build):
            noise = {"process_var": q, "measurement_var": WRONG_SD**2}
            begin = {"x0": start, "P0": jax.numpy.diag(variance)}
            system = PortHamiltonianAttitude.of(airframe, suspects=MOTORS, **noise, **begin)
            method = build(system)

            def step(carry, row):
                carry, out = method.step(carry, row[0], row[1], valid)
                return carry, jax.numpy.abs(out.x[:3] - row[2]).max()

            return jax.lax.scan(step, method.init(), (u, y, truth[:, :3]))[1]

        run = jax.jit(jax.vmap(error, in_axes=(0, 0, None)))
        errors[name] = {kind: np.asarray(run(y, starts, variance)) for kind, variance in P0.items()}
    return errors


def injecting_gain(plant, box) -> np.ndarray:
    """(6, 3) gain that corrects momenta too: 5 % contraction per step over a box of half-widths box (6,)."""
    scale = np.concatenate([np.ones(3), 20.0 * np.diag(plant.J)])
    F = observer_gain.jacobians(plant, DT, box)
    return observer_gain.common_lyapunov(F, np.eye(3, 6), 0.95, scale=scale).gain


def _claims(f: dict[str, Any]) -> tuple[Claim, ...]:
    """The paper's claims beside what came out."""
    p, found, settle = f["p_final"], f["motors_1_3_final"], f["motors_1_3_settle_s"]
    near = np.abs(np.subtract(found, LOSSES)) < BAND * np.array(LOSSES)
    six, tones = f["six_theta_final"], f["six_theta_excited_final"]
    alone = abs(six[0] - LOSSES[0]) < 0.01 and abs(six[2] - LOSSES[1]) < 0.01
    told = np.abs(tones - flights.losses()[-1]).max() < 0.01
    works = bool(near.all())
    lost, honest = f["divergence"], f["divergence_honest_P0"]
    # Errors of the momenta at the end, as shares of them: of the observer stage and of the filter, with the fault term and without.
    slow, quick = (float(np.max(f[key] / np.abs(p))) for key in ("observer_p_error", "p_error"))
    blind, follows = (
        float(np.max(f[f"{key}_without_fault_term"] / np.abs(p))) for key in ("observer_p_error", "p_error")
    )
    turned = [float(np.max(f[f"{who}angle_error{term}"]) / np.abs(f["angle_final"]).max())
              for who in ("", "observer_") for term in ("", "_without_fault_term")]  # fmt: skip
    excited = {
        which: f[f"excitation_{which}"][0] > UNEXCITED * f[f"excitation_{which}"][1]
        for which in ("two", "six", "tones")
    }
    quiet = bool((np.asarray(f["noise_4e5_std"]) < STEADY * np.array(LOSSES)).all())
    loud = bool((np.asarray(f["noise_printed_R_std"]) < STEADY * np.array(LOSSES)).all())
    seen = float(np.abs(f["virtual_multiplicative_final"]).max()) > 0.5 * min(LOSSES)
    found_torque = f["virtual_additive_error"] < TORQUE_ERROR

    def verdict(yes: bool, otherwise: Verdict = "not reproduced") -> Verdict:
        return "holds" if yes else otherwise

    return (
        Claim(
            "A weaker motor 1 rolls and yaws the hexarotor to positive angles; a weaker motor 3 then pitches it below zero",
            "figures 6 and 7",
            f"momenta after 8 s {p[0]:.3e}, {p[1]:.3e}, {p[2]:.3e} kg m2/s",
            verdict(bool(p[0] > 0 > p[1] and p[2] > 0)),
            "The flight is simulated by Newton's and Euler's equations; the signs follow from the printed input matrix.",
        ),
        Claim(
            "The losses of all six motors are estimated accurately",
            "0.124 on motor 1, 0.135 on motor 3, 0 elsewhere",
            ", ".join(f"{v:.4f}" for v in six),
            verdict(bool(alone)),
            "Opposite columns of B are negatives of each other: with equal thrusts only differences of opposite motors show, and each "
            "loss is split half and half. The excitation that the paper assumes, its eq. (16), is absent.",
        ),
        Claim(
            "The same when only motors 1 and 3 may fail",
            "0.124 and 0.135, about 1 s after onset (figure 4)",
            f"{found[0]:.4f} and {found[1]:.4f}, within 10 % after {settle[0]:.2f} and {settle[1]:.2f} s",
            verdict(works),
            "Two differences are excited by two unknowns. The second is faster because S has wound up by then.",
        ),
        Claim(
            "Beyond the paper: tones of different frequency on every motor make six losses identifiable",
            "-",
            ", ".join(f"{v:.4f}" for v in tones),
            verdict(bool(told)),
            "Thrusts that are not proportional to each other excite all six columns.",
        ),
        Claim(
            "Theorem 1 is satisfied by the printed gain and constants, so that the observer converges globally",
            "inequality (7) negative",
            f"largest eigenvalue {f['lmi_paper_max_eig']:+.3f}; best gain with A = I {f['lmi_best_eig_A_identity']:+.1e}, "
            f"with dt J^-1 in A {f['lmi_best_eig_A_kinematics']:+.1e}",
            verdict(f["lmi_paper_max_eig"] < 0),
            "beta = -4 with eta = 1 holds for no function; with A = I the momenta's error keeps eigenvalue 1 under any gain. With the "
            "kinematics in A, scaled momenta and constants of a small box a gain exists.",
        ),
        Claim(
            "The observer's momenta converge more slowly than its angles",
            "figure 7",
            f"observer off by {f['observer_p_error'][0]:.1e} of {p[0]:.1e} after 8 s, filter by {f['p_error'][0]:.1e}",
            verdict(quick < slow < FOLLOWS, "partly" if quick < FOLLOWS < slow else "not reproduced"),
            "The printed gain corrects no momenta: the observer's drift by whatever the losses were wrong before, and stay off.",
        ),
        Claim(
            "Without the fault term the momenta can no longer be estimated",
            "figures 8 and 9",
            f"observer off by {f['observer_p_error_without_fault_term'][0]:.1e} (all of it), filter by "
            f"{f['p_error_without_fault_term'][0]:.1e}",
            verdict(min(blind, follows) > FOLLOWS, "partly" if max(blind, follows) > FOLLOWS else "not reproduced"),
            "True of the observer. The filter's own gain corrects momenta by 0.38 of an angle's error, so it follows to 1.5 %.",
        ),
        Claim(
            "The algorithm is robust to process and measurement noise",
            "Q = 0.01 I, R = 0.04 I",
            f"noise of 4e-5 rad: {_pair(f['noise_4e5_mean'], f['noise_4e5_std'])}; of the printed R: +-"
            f"{f['noise_printed_R_std'].min():.0f}; the printed Q tumbles the vehicle in {f['tumbles_after_s']:.2f} s",
            verdict(loud, "partly" if quiet else "not reproduced"),
            "Q and R are tuning, not noise: thrusts of 0.01 N are drowned by more than a hundredth of a degree.",
        ),
        Claim(
            "A forgetting factor of 0.995 lets the losses converge",
            "lambda = 0.995",
            f"0.995: {_seconds(settle)}; 0.99: {_seconds(f['settle_s_lambda_099'])}; 0.998: "
            f"{_seconds(f['settle_s_lambda_0998'])}",
            verdict(works),
            "It hangs on the tuning: with S(0) = 0.001 and so little excitation losses move only once forgetting has wound S up.",
        ),
        Claim(
            "Angles are estimated, with the fault term and without it",
            "figures 6 and 8",
            f"off by at most {np.max(f['angle_error']):.1e} rad of {np.abs(f['angle_final']).max():.1e} in the last second, without it by "
            f"{np.max(f['angle_error_without_fault_term']):.1e}; the observer by {np.max(f['observer_angle_error']):.1e} and "
            f"{np.max(f['observer_angle_error_without_fault_term']):.1e}",
            verdict(max(turned) < FOLLOWS, "partly" if min(turned) < FOLLOWS else "not reproduced"),
            "Angles are measured. What a missing fault term costs shows in the momenta.",
        ),
        Claim(
            "The inputs are persistently exciting",
            "eq. (16), assumed with some alpha > 0",
            f"alpha over {EXCITED_S:g} s: two motors {f['excitation_two'][0]:.1e}, six {f['excitation_six'][0]:.0e} of "
            f"{f['excitation_six'][1]:.0e}, six with tones {f['excitation_tones'][0]:.1e}",
            verdict(excited["six"], "partly" if excited["two"] else "not reproduced"),
            "The least eigenvalue of the sum of Omega' Sigma^-1 Omega over a second, at the worst time. Zero for six motors with equal "
            "thrusts.",
        ),
        Claim(
            "The recursion stays bounded",
            "assumed, with excitation",
            f"variance of a loss after 8 s {f['s11_final']:.1e}; bounded by s_max {f['s11_bounded_final']:.1e}",
            verdict(f["s11_final"] < S_BOUND),
            "Directions that are not excited are forgotten without bound: S loses its last digit near 14 s. s_max bounds it and "
            "changes the losses by less than 1e-5.",
        ),
        Claim(
            "With body torques as the input the method works too",
            "mentioned",
            f"shares of torques: {np.abs(f['virtual_multiplicative_final']).max():.0e}; missing torques: right to "
            f"{f['virtual_additive_error']:.0e} N m",
            verdict(seen and found_torque, "partly" if seen or found_torque else "not reproduced"),
            "Balanced thrusts command no torque, so a share of it cannot be seen; a missing torque can.",
        ),
        Claim(
            "The observer stage prevents the divergence of a plain linearised filter",
            "not shown",
            f"lost from wrong starts with overconfident P0: {_shares(lost)}; with honest P0: {_shares(honest)}",
            verdict(lost["axkf"] == 0 < lost["adaptive_ekf"] and honest["adaptive_ekf"] > 0, "partly"),
            "With a gain that corrects momenta (common Lyapunov function), and only where P0 is overconfident; with an honest P0 there is "
            "no advantage.",
        ),
    )


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
    wanted = series["losses"][rows]
    names = ("roll", "pitch", "yaw")
    thrust, (axis,) = _axes(1, "thrust [N]")
    axis.plot(t, series["u"][rows, 0], "k")
    faults, axes = _axes(2, "loss")
    for k, axis in enumerate(axes):
        axis.plot(t, two.theta[rows, k], "C3--", label="estimate")
        axis.plot(t, wanted[:, MOTORS[k]], "k", lw=1, label="truth")
        axis.set_title(f"motor {MOTORS[k] + 1}")
    axes[0].legend()
    all_six, axes = _axes(2, "loss")
    for axis, lane, title in zip(axes, (1, 2), ("equal thrusts", "a tone on every motor"), strict=True):
        for k in range(6):
            axis.plot(t, six.theta[lane, rows, k], f"C{k}", label=f"motor {k + 1}")
        axis.plot(t, wanted[:, list(MOTORS)], "k:", lw=1)
        axis.set(ylim=(-0.1, 0.2), title=title)
    axes[1].legend(ncols=2, fontsize="x-small")
    drawn = {"fig3_thrust": thrust, "fig4_faults": faults, "six_losses": all_six}
    parts = (("fig6_angles", two, 0), ("fig7_momenta", two, 3))
    parts += (("fig8_angles_without_fault_term", without, 0), ("fig9_momenta_without_fault_term", without, 3))
    for stem, history, first in parts:
        figure, axes = _axes(3, "[kg m2/s]" if first else "[rad]")
        for k, axis in enumerate(axes):
            axis.plot(t, series["truth"][rows, first + k], "k", lw=1, label="truth")
            axis.plot(t, history.z[rows, first + k], "C0", label="observer")
            axis.plot(t, history.x[rows, first + k], "C3--", label="filter")
            axis.set_title(names[k])
        axes[0].legend()
        drawn[stem] = figure
    drawn["wrong_starts"], (axis,) = _axes(1, "largest error of angles [rad]")
    for name, error in series["wrong_starts"].items():
        gone = np.logical_or.accumulate(~(error < 5.0))  # no angles any more
        axis.semilogy(DT * np.arange(len(error))[rows], np.where(gone, np.nan, error)[rows], label=name)
    axis.axhline(LOST, color="k", ls=":", lw=1)
    axis.legend()
    return drawn


def _axes(count: int, label: str):
    """A figure with `count` panels side by side, time below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.5 + 2.8 * count, 2.8), layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)[0]
    axes[0].set_ylabel(label)
    for axis in axes:
        axis.set_xlabel("time [s]")
    return figure, axes
