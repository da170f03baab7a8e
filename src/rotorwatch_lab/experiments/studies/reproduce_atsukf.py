"""Zhang et al. 2023: two-stage unscented filters, plain and adaptive, on a hovering quadrotor whose motors weaken.

Q1 is the paper's "matched" random walk of the losses (1e-2 a step), Q2 the "mismatched" one (1e-7 a step).
"""

from __future__ import annotations

import time
from copy import copy
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.compiling.run import engine, run
from rotorwatch_lab.estimators.atsukf import ATSUKF
from rotorwatch_lab.estimators.tsukf import TSUKF
from rotorwatch_lab.estimators.ukf import UKF
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.studies import hover_flights, reproduction
from rotorwatch_lab.experiments.studies import two_stage_as_printed as printed
from rotorwatch_lab.experiments.studies.reproduction import Claim, Reproduction, graded, panels, silent
from rotorwatch_lab.experiments.studies.uaf_flight import DT, ONSET, STEP, fly, losses
from rotorwatch_lab.systems.rigid_body import RigidBody

PAPER = "atsukf"
TITLE, LITERAL = reproduction.about(PAPER)
SEEDS = 10
WALKS = {"q1": 1e-2, "q2": 1e-7}  # growth of the losses' variance in a step
P0_THETA = 1e-6
X0 = (1.0, 1.0, 1.0, *(0.0,) * 9)  # where the filters start: 1 m off sideways, 2 m in height
SETTLED = 5.0  # s: errors count from here
NOISE, LOUD = 1e-7, 1e-3  # measurement variances
LOUD_SEEDS = 3  # the loud noise shows with few
MATCHED = 0.05  # RMSE that differ by less are equal
FOUND = 0.05  # a loss that is off by less is found
GATE = 0.2  # lag-1 correlation of innovations above which the gated filter adapts
OPEN = -1.0  # a gate that lets everything pass
ROUNDS = 4  # of the clock
KEEP = 20  # every how many-th step is kept for drawing


def plant(literal: tuple[str, ...] = (), kind: type[RigidBody] = RigidBody) -> tuple[dict, RigidBody]:
    """The airframe and the plant model of the filters, of that class."""
    airframe = airframes.paper("uaf-02e")
    if "arm" in literal:
        rotors = airframe["rotors"]
        airframe["rotors"] = rotors | {axis: [0.1 * v for v in rotors[axis]] for axis in ("x", "y")}
    return airframe, kind.of(airframe, x0=np.array(X0))


def measure(pose: np.ndarray, variance: float, seed: int) -> np.ndarray:
    """(T, 6): pose with white noise."""
    return pose + np.sqrt(variance) * np.random.default_rng(seed).standard_normal(pose.shape)


def estimates(system: RigidBody, adaptive: bool, lanes: list[tuple], seen=(True,) * 6) -> np.ndarray:
    """Losses (lanes, T, n) that one filter finds in many tables at once. lanes: (u (T, n), y (T, 6), walk per step, gate, R of each
    measurement); seen (6,): which columns of y it is given."""
    jax = load_jax()

    def one(u, y, walk, gate, variance):
        growth, plant = {"theta_walk": walk / DT, "theta_var": P0_THETA}, copy(system)
        plant.measured_sd = jax.numpy.sqrt(variance)
        method = ATSUKF(plant, DT, **growth, whiteness=gate) if adaptive else TSUKF(plant, DT, **growth)
        return tools.stepped(method, u, y, tools.losses, jax.numpy.broadcast_to(np.array(seen), y.shape))

    return np.asarray(jax.jit(jax.vmap(one))(*(np.stack(column) for column in zip(*lanes, strict=True))))


def reproduce(seeds: int = SEEDS, literal: tuple[str, ...] = (), progress=silent) -> Reproduction:
    """The paper's experiments with so many noise seeds. literal: names from LITERAL. progress: called with the finished share."""
    airframe, system = plant(literal)
    truth = {s: losses(s) for s in (1, 2)}
    flights = {s: fly(airframe, truth[s]) for s in (1, 2)}
    variance = LOUD if "noise" in literal else NOISE
    progress(0.1)

    def lanes(scenario, walk, gate=OPEN, variance=variance, count=seeds, R=NOISE):
        u, pose = flights[scenario]
        return [(u, measure(pose, variance, seed), WALKS[walk], gate, R) for seed in range(count)]

    # Every case is so many lanes of one compiled program per filter.
    few = min(seeds, LOUD_SEEDS)
    cases = {(f"scenario_{s}", q): lanes(s, q) for s in (1, 2) for q in WALKS}
    loud = {("loud", q): lanes(1, q, variance=LOUD, count=few) for q in WALKS}
    # R as large as the printed noise.
    reported = {(f"reported_{s}", q): lanes(s, q, variance=LOUD, count=few, R=LOUD) for s, q in ((2, "q1"), (1, "q2"))}
    gated = {("gated", "q2"): lanes(1, "q2", GATE), ("loud_gated", "q2"): lanes(1, "q2", GATE, LOUD, few)}
    theta_of = _split(False, system, cases | loud | reported)
    progress(0.45)
    theta_of |= _split(True, system, cases | loud | reported | gated)
    progress(0.8)

    rmse, delay = {}, {}
    for s in (1, 2):
        of = {f"{f}_{q}": theta_of[f, f"scenario_{s}", q] for q in WALKS for f in ("tsukf", "atsukf")}
        rmse[f"scenario_{s}"] = {name: error(theta, truth[s]) for name, theta in of.items()}
        delay[f"scenario_{s}"] = {name: half_delay(theta) for name, theta in of.items()}
    noise = {f"{f}_{q}": error(theta_of[f, "loud", q], truth[1]) for q in WALKS for f in ("tsukf", "atsukf")}
    reported_rmse = {
        f"{f}_{q}": error(theta_of[f, f"reported_{s}", q], truth[s]) for s, q in ((2, "q1"), (1, "q2")) for f in ("tsukf", "atsukf")
    }
    noise["atsukf_q2_gated"] = error(theta_of["atsukf", "loud_gated", "q2"], truth[1])
    figures = {
        "rmse": rmse,
        "half_delay_s": delay,
        "tsukf_vs_augmented_linear": against_kalman(),
        **against_augmented(system, *flights[1]),
        "matched_four_apart": apart(theta_of["tsukf", "scenario_2", "q1"], theta_of["atsukf", "scenario_2", "q1"]),
        "settled_loss_tsukf_q2": float(theta_of["tsukf", "scenario_1", "q2"][:, 6500:8000, 0].mean()),
        "rmse_gated_q2": error(theta_of["atsukf", "gated", "q2"], truth[1]),
        "rmse_loud": noise,
        "rmse_reported": reported_rmse,
        "hexarotor": hexarotor(airframe),
        "attitude_alone": attitude_alone(system, airframe, flights, truth),
    }
    readings = [name for name in literal if name in printed.READINGS]
    if readings:
        figures["literal"] = {name: as_printed(system, *flights[1], truth[1], name) for name in readings}
    progress(1.0)
    series = {"t": np.arange(0, len(truth[1]), KEEP) * DT}
    series |= {f"truth_{s}": truth[s][::KEEP] for s in (1, 2)}
    series |= {"/".join(key): theta[0, ::KEEP] for key, theta in theta_of.items()}
    return Reproduction(PAPER, TITLE, claims(figures), figures, literal, seeds, series)


def _split(adaptive, system, cases):
    """Estimates (seeds, T, 4) by (filter, case, walk)."""
    name = "atsukf" if adaptive else "tsukf"
    theta = estimates(system, adaptive, [lane for case in cases.values() for lane in case])
    ends = np.cumsum([len(case) for case in cases.values()])[:-1]
    return {(name, *key): part for key, part in zip(cases, np.split(theta, ends), strict=True)}


def error(theta: np.ndarray, truth: np.ndarray) -> float:
    """RMSE (over seeds and time, once settled) of the loss, mean over the motors that do lose something."""
    faulty = truth.any(axis=0)
    off = (theta - truth)[:, round(SETTLED / DT) :, faulty]
    return float(np.sqrt((off**2).mean(axis=(0, 1))).mean())


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Largest difference of two filters' losses over seeds, motors and time, once settled."""
    return float(np.abs(one - other)[:, round(SETTLED / DT) :].max())


def attitude_alone(system: RigidBody, airframe: dict, flights: dict, truth: dict) -> dict:
    """The adaptive filter (Q1) that is given the attitude and no position: its losses in the middle of the step, of both scenarios; and
    what torques of hovering rotors cannot show: losses in the kernel of B_tau diag(u)."""
    rows = slice(*(round(t / DT) for t in (60.0, 75.0)))
    lanes = [(flights[s][0], measure(flights[s][1], NOISE, 0), WALKS["q1"], OPEN, NOISE) for s in (1, 2)]
    means = estimates(system, True, lanes, (False,) * 3 + (True,) * 3)[:, rows].mean(axis=1)
    x, y, spin = (np.array(airframe["rotors"][k], float) for k in ("x", "y", "spin"))
    torques = np.stack([-y, x, airframe["drag_ratio"] * spin]) * flights[1][0][round(20.0 / DT)]
    hidden = np.linalg.svd(torques)[2][3]
    return {
        **{f"scenario_{s}": {"true": truth[s][rows][0], "found": means[s - 1]} for s in (1, 2)},
        "hidden": hidden * np.sign(hidden[0]),
        "off": float(max(np.abs(means[s - 1] - truth[s][rows][0]).max() for s in (1, 2))),
    }


def hexarotor(airframe: dict) -> dict:
    """The adaptive filter (Q1) on six of the same motors on the same arm, of which the first loses as much: its losses in the middle of
    the step."""
    x, y = (airframe["rotors"][axis][0] for axis in "xy")
    larger = hover_flights.ring({**airframe, "arm": float(np.hypot(x, y))}, 6)
    true, rows = losses(1, 6), slice(*(round(t / DT) for t in (60.0, 75.0)))
    u, pose = fly(larger, true)
    lane = (u, measure(pose, NOISE, 0), WALKS["q1"], OPEN, NOISE)
    found = estimates(RigidBody.of(larger, x0=np.array(X0)), True, [lane])[0, rows].mean(axis=0)
    return {"true": true[rows][0], "found": found, "off": float(np.abs(found - true[rows][0]).max())}


def half_delay(theta: np.ndarray) -> float:
    """s from the step until motor 1's estimate is at half of it; mean over seeds."""
    after = theta[:, round(ONSET / DT) :, 0] > 0.5 * STEP
    return float(np.where(after.any(axis=1), after.argmax(axis=1) * DT, np.nan).mean())


class Linear:
    """A small linear Gaussian plant whose losses are felt in the measurement as well: for exact comparison."""

    name, n_x, n_u, n_theta, n_y = "linear", 4, 2, 2, 3

    def __init__(self, seed: int = 0):
        rng = np.random.default_rng(seed)
        self.A = 0.97 * np.linalg.qr(rng.standard_normal((4, 4)))[0]
        self.B, self.C, self.D = rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), rng.standard_normal((3, 2))
        self.x0, root = rng.standard_normal(4), rng.standard_normal((4, 4))
        self.P0, self.process, self.variance = root @ root.T, 0.01 * root.T @ root, np.array([0.1, 0.02, 0.3])

    def f(self, x, u, theta, dt):
        return self.A @ x + self.B @ (u * (1.0 - theta))

    def h(self, x, u, theta):
        return self.C @ x + self.D @ (u * (1.0 - theta))

    def Q(self, dt):
        return self.process

    def R(self, u):
        return self.variance


def kalman(plant: Linear, Q_theta, P_theta, u, y, valid):
    """Augmented Kalman filter, dense and in NumPy: z, P and S after each row."""
    n, m = plant.n_x, plant.n_theta
    z, P = np.zeros(n + m), np.zeros((n + m, n + m))
    z[:n], P[:n, :n], P[n:, n:] = plant.x0, plant.P0, P_theta
    F, Q, history = np.eye(n + m), np.zeros_like(P), []
    F[:n, :n], Q[:n, :n], Q[n:, n:] = plant.A, plant.process, Q_theta
    for now, measured, good in zip(u, y, valid, strict=True):
        F[:n, n:] = -plant.B * now
        H = np.hstack([plant.C, -plant.D * now])
        z, P = F @ z + np.r_[plant.B @ now, np.zeros(m)], F @ P @ F.T + Q
        S = H @ P @ H.T + np.diag(plant.variance)
        K = np.linalg.solve(S[np.ix_(good, good)], H[good] @ P).T
        z = z + K @ (measured - H @ z - plant.D @ now)[good]
        rest = np.eye(n + m) - K @ H[good]
        P = rest @ P @ rest.T + (K * plant.variance[good]) @ K.T
        history.append((z, P, S))
    return tuple(np.stack(column) for column in zip(*history, strict=True))


def linear_table(plant: Linear, rows: int = 500, seed: int = 1):
    """u, y, valid of a run with losses (0.3, -0.1) and gaps."""
    rng = np.random.default_rng(seed)
    u, x, theta, y = 1.0 + 0.5 * rng.standard_normal((rows, 2)), plant.x0, np.array([0.3, -0.1]), []
    for now in u:
        x = plant.f(x, now, theta, 0.1) + np.linalg.cholesky(plant.process) @ rng.standard_normal(4)
        y.append(plant.h(x, now, theta) + np.sqrt(plant.variance) * rng.standard_normal(3))
    valid = rng.random((rows, 3)) < 0.8
    valid[100:110] = False
    return u, np.array(y), valid


def against_kalman() -> float:
    """Largest difference of the two-stage filter from the augmented Kalman filter on a linear plant: x, theta, P's and S."""
    plant = Linear()
    u, y, valid = linear_table(plant)
    _, out = run(TSUKF(plant, 0.1, theta_walk=0.01, theta_var=0.3), u, y, valid)
    z, P, S = kalman(plant, 0.001 * np.eye(2), 0.3 * np.eye(2), u, y, valid)
    pairs = ((out.x, z[:, :4]), (out.theta, z[:, 4:]), (out.x_cov, P[:, :4, :4]), (out.theta_cov, P[:, 4:, 4:]))
    return max(float(np.abs(a - b).max()) for a, b in (*pairs, (out.innovation_cov, S)))


def against_augmented(system: RigidBody, u, pose) -> dict:
    """Largest difference of the two-stage filter's losses from the augmented UKF's in one flight (Q1), and the time of a step of either and
    of the adaptive one: as exported C where a compiler is available (JAX copies the adaptive filter's window in every step), in turns,
    processor time, the shortest of each."""
    y = measure(pose, NOISE, 0)
    tuned = {m.name: m(system, DT, theta_walk=WALKS["q1"] / DT, theta_var=P0_THETA) for m in (TSUKF, ATSUKF, UKF)}
    losses_of: dict[str, np.ndarray] = {}
    seconds: dict[str, list[float]] = {name: [] for name in tuned}
    for estimator in tuned.values():
        run(estimator, u[:1], y[:1], select=tools.losses, backend="auto")  # compiled apart from the clock
    for _ in range(ROUNDS):
        for name, estimator in tuned.items():
            start = time.process_time()
            losses_of[name] = run(estimator, u, y, select=tools.losses, backend="auto")[1]
            seconds[name].append(time.process_time() - start)
    least = {name: 1e6 * min(taken) / len(u) for name, taken in seconds.items()}
    apart = float(np.abs(losses_of["tsukf"] - losses_of["ukf"]).max())
    return {"tsukf_vs_augmented_quad": apart, "microseconds_per_step": least, "timed_as": engine()}


def as_printed(system: RigidBody, u, pose, truth, reading: str) -> dict:
    """Effect of one printed slip in one flight: largest difference of losses from the filter as built, and RMSE."""
    jax = load_jax()
    y, out = measure(pose, NOISE, 0), {}
    walks = np.array(list(WALKS.values()))
    other = plant(kind=printed.EulerRates)[1] if reading == "euler_rates" else system

    def one(walk, reading):
        method = printed.AsPrinted(other if reading else system, DT, walk * np.eye(4), P0_THETA * np.eye(4), reading)
        return jax.lax.scan(lambda carry, row: method.step(carry, *row), method.init(), (u, y))[1]

    built, literal = (np.asarray(jax.jit(jax.vmap(lambda walk, r=r: one(walk, r)))(walks)) for r in ((), (reading,)))
    for k, walk in enumerate(WALKS):
        out[f"difference_{walk}"] = float(np.abs(built[k] - literal[k]).max())
        out[f"rmse_{walk}"] = error(literal[k][None], truth)
    return out


def claims(f: dict) -> tuple[Claim, ...]:
    """The paper's claims beside the numbers."""
    (one, two), loud, cost = f["rmse"].values(), f["rmse_loud"], f["microseconds_per_step"]
    change = [s["atsukf_q2"] / s["tsukf_q2"] - 1.0 for s in (one, two)]
    as_accurate = max(change) < 0 and max(s["atsukf_q2"] / s["tsukf_q1"] for s in (one, two)) < 1.1
    reported = f["rmse_reported"]
    plain = {"R": two["atsukf_q1"] / two["tsukf_q1"] - 1.0, "reported": reported["atsukf_q1"] / reported["tsukf_q1"] - 1.0}
    finds = max(max(s["tsukf_q1"], s["atsukf_q1"]) for s in (one, two)) < FOUND
    cured = loud["atsukf_q2_gated"] < 1.1 * loud["tsukf_q2"] and f["rmse_gated_q2"] < 1.1 * one["atsukf_q2"]
    verdicts = {
        "matched": graded(abs(one["atsukf_q1"] / one["tsukf_q1"] - 1.0) < MATCHED),
        "matched_four": graded(min(plain.values()) > 0.01, max(plain.values()) > 0.01),
        "plain_mismatched": graded(abs(f["settled_loss_tsukf_q2"] - STEP) >= 0.05 * STEP),
        "adaptive_mismatched": graded(as_accurate, max(change) < -0.1),
        "split": graded(f["tsukf_vs_augmented_linear"] < 1e-9 and f["tsukf_vs_augmented_quad"] < 1e-3),
        "cost": graded(cost["tsukf"] < 0.8 * cost["ukf"], cost["tsukf"] < 0.97 * cost["ukf"]),
        "dearer": graded(cost["atsukf"] > 1.02 * cost["tsukf"]),
        "robust": graded(loud["atsukf_q2"] <= loud["tsukf_q2"], reported["atsukf_q2"] < 0.9 * reported["tsukf_q2"]),
        "gated": graded(cured, True),
        "attitude_alone": "holds" if f["attitude_alone"]["off"] < FOUND else graded(False, finds),
        "many": graded(finds),
        "others": graded(f["hexarotor"]["off"] < FOUND),
    }
    alone = {key: " ".join(f"{v:.3f}" for v in f["attitude_alone"][key]["found"]) for key in ("scenario_1", "scenario_2")}
    alone["hidden"] = " ".join(f"{v:.2f}" for v in f["attitude_alone"]["hidden"])
    percent, delay = [100 * c for c in change], f["half_delay_s"]["scenario_1"]
    out = reproduction.claims(
        PAPER,
        verdicts,
        f=f,
        one=one,
        two=two,
        loud=loud,
        delay=delay,
        percent=percent,
        step=STEP,
        gate=GATE,
        reported=reported,
        more={key: 100 * value for key, value in plain.items()},
        better=100 * (1.0 - reported["atsukf_q2"] / reported["tsukf_q2"]),
        hexa=" ".join(f"{v:.3f}" for v in f["hexarotor"]["found"]),
        alone=alone,
        timed={"native": "C", "jax": "JAX"}[f["timed_as"]],
        cheaper=100 * (1.0 - cost["tsukf"] / cost["ukf"]),
        dearer=100 * (cost["atsukf"] / cost["tsukf"] - 1.0),
    )
    return out + tuple(_slip(name, row) for name, row in f.get("literal", {}).items())


def _slip(name: str, row: dict) -> Claim:
    """The claim about a reading as printed."""
    measured, why = "diverges", "The sensitivities are off by a factor of the spread."
    if np.isfinite(row["difference_q1"] + row["difference_q2"]):
        measured = f"losses differ by up to {row['difference_q1']:.2g} (Q1) and {row['difference_q2']:.2g} (Q2)"
        why = f"RMSE of motor 1 {row['rmse_q1']:.3f} (Q1), {row['rmse_q2']:.3f} (Q2)."
    return Claim(f"Literal reading: {name}", LITERAL[name], measured, "not reproduced", why)


def figures(result: Reproduction) -> dict[str, Any]:
    """Figures 3 to 8 of the paper: losses found in both scenarios, and what noise beyond R does. Needs matplotlib."""
    t, series = result.series["t"], result.series
    colours = {"tsukf": "#c44e52", "atsukf": "#2a6f97"}
    drawn = {}
    drawings = {
        "scenario-1": (1, [("q1", 0), ("q2", 0)]),
        "scenario-2-matched": (2, [("q1", m) for m in range(4)]),
        "scenario-2": (2, [("q2", m) for m in range(4)]),
    }
    for stem, (scenario, drawn_motors) in drawings.items():
        rows = len(drawn_motors) // 2
        figure, axes = panels(rows, 2, (9, 3.2 if rows == 1 else 5.5), sharex=True, sharey=True)
        for axis, (q, m) in zip(axes.flat, drawn_motors, strict=True):
            axis.plot(t, series[f"truth_{scenario}"][:, m], color="black", lw=1.0, label="true")
            for name, colour in colours.items():
                axis.plot(t, series[f"{name}/scenario_{scenario}/{q}"][:, m], color=colour, lw=1.0, label=name.upper())
            axis.set_title(f"motor {m + 1}, {'matched' if q == 'q1' else 'mismatched'} walk", fontsize=10)
        figure.supxlabel("time [s]", fontsize=9)
        figure.supylabel("loss of effectiveness", fontsize=9)
        axes.flat[0].legend(fontsize=8, frameon=False, loc="upper left")
        drawn[f"atsukf-{stem}"] = figure
    drawn["atsukf-noise"], ((axis,),) = panels(1, 1, (9, 3.2))
    axis.plot(t, series["truth_1"][:, 0], color="black", lw=1.0, label="true")
    for key, label, colour in (
        ("atsukf/loud/q2", "ATSUKF", colours["atsukf"]),
        ("atsukf/loud_gated/q2", "ATSUKF with whiteness gate", "#55a868"),
        ("tsukf/loud/q2", "TSUKF", colours["tsukf"]),
    ):
        axis.plot(t, series[key][:, 0], color=colour, lw=0.8, label=label)
    axis.set(xlabel="time [s]", ylabel="loss of motor 1", ylim=(-1.0, 1.4), title="noise variance 1e-3, R = 1e-7, Q2")
    axis.legend(fontsize=8, frameon=False, loc="lower left", ncols=4)
    return drawn
