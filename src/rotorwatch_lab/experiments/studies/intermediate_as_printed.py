"""The intermediate observer as its paper prints it: eqs. (11)-(14) and (38), its rank test, the procedure of table 1, the printed times.

    dxhat/dt = A xhat + B u + E fhat + G + L (y - C xhat),   dtauhat/dt = -S (A xhat + B u + E tauhat + E S xhat + G)
    fhat = tauhat + S xhat,   Lambda = -Gamma^-1 (D M)^-1 fhat       (D is missing in (38))

Integrated exactly between samples (matrix exponential), with any L; estimators/intermediate.py has gains lp, lv alone.
Source: Nguyen, Huynh, Do, Mung and Hong, Sensors 20 (2020) 4917.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments.studies import error_bound, hover_flights, reproduction
from rotorwatch_lab.experiments.studies.error_bound import DT
from rotorwatch_lab.experiments.studies.hover_flights import Craft
from rotorwatch_lab.experiments.studies.reproduction import Claim, Table, graded
from rotorwatch_lab.maths import intermediate_design as design

MUS = (1.0, 0.1, 0.01)  # "small", table 1
PRINTED_S = {"scenario_1": (68.5,), "scenario_2": (73.5,), "scenario_3": (73.0, 91.0, 110.0), "scenario_4": (50.0,)}
HEIGHT_M = {"scenario_1": 4.0, "scenario_2": 2.4, "scenario_3": 2.4, "scenario_4": 3.8}
# Rows and columns of what eq. (6) adds up, as its definitions have them: x is (phi, theta, psi) and rates, N is I_4.
SIZES = {"x": (6, 1), "A": (8, 8), "B": (8, 4), "u": (4, 1), "N": (4, 4), "xi": (4, 1), "G": (8, 1)}
LENGTH_S = 130.0  # the last time that is printed, of scenario 3 (as 1300 s)


def observe(vehicle: Craft, L, alpha: float, u, y) -> tuple[np.ndarray, np.ndarray]:
    """fault (T, 4) [rad/s^2, m/s^2 down] and losses (T, 4) of one flight: u (T, 4) mean counts over each sample, y (T, 8) at its end."""
    from scipy.linalg import expm

    A, C, E = design.double_integrators()
    S = alpha * E.T
    down = np.array([1.0, 1.0, 1.0, -1.0])
    DM = vehicle.D[:, None] * vehicle.M * down[:, None]
    turns = np.block([[A + E @ S - L @ C, E], [-S @ A - S @ E @ S, -S @ E]])
    enters = np.block([[E, L], [-S @ E, np.zeros((4, 8))]])  # of the commanded accelerations, and of y
    step = expm(DT * np.block([[turns, enters], [np.zeros((12, 24))]]))
    keep, push = step[:12, :12], step[:12, 12:]
    driven = np.hstack([u @ DM.T + [0.0, 0.0, 0.0, vehicle.gravity], (y + np.concatenate([y[:1], y[:-1]])) / 2.0])
    z, fault = np.concatenate([y[0], -S @ y[0]]), np.empty((len(u), 4))
    for k, row in enumerate(driven):
        z = keep @ z + push @ row
        fault[k] = z[8:] + S @ z[:8]
    return fault, -np.linalg.solve(DM, fault.T).T / u


def rotation(phi: float, theta: float, psi: float, mended: bool = False) -> np.ndarray:
    """(3, 3) R of eq. (1); mended: with sin phi, cos phi where it has cos phi in the last column and psi in the last row."""
    (s_phi, s_theta, s_psi), (c_phi, c_theta, c_psi) = np.sin([phi, theta, psi]), np.cos([phi, theta, psi])
    corner, last = (s_psi * s_phi, (s_phi, c_phi)) if mended else (s_psi * c_phi, (s_psi, c_psi))
    return np.array(
        [
            [c_psi * c_theta, c_psi * s_theta * s_phi - s_psi * c_phi, c_psi * s_theta * c_phi + corner],
            [s_psi * c_theta, s_psi * s_theta * s_phi + c_psi * c_phi, s_psi * s_theta * c_phi - s_phi * c_psi],
            [-s_theta, c_theta * last[0], c_theta * last[1]],
        ]
    )


def off_rotation(mended: bool) -> float:
    """Largest entry of R R' - I at roll 0.1, pitch 0.1, yaw 1 rad: none for a rotation."""
    R = rotation(0.1, 0.1, 1.0, mended)
    return float(np.abs(R @ R.T - np.eye(3)).max())


def misfits(sizes: Mapping[str, tuple[int, int]] = SIZES) -> list[str]:
    """What cannot be multiplied or added in A x + B u + N xi + G of these sizes."""
    products = (("A", "x"), ("B", "u"), ("N", "xi"))
    wrong = [f"{M} has {sizes[M][1]} columns for the {sizes[v][0]} of {v}" for M, v in products if sizes[M][1] != sizes[v][0]]
    rows = {f"{M} {v}": sizes[M][0] for M, v in products} | {"G": sizes["G"][0]}
    return wrong + [f"{name} has {n} rows, dx/dt {sizes['A'][0]}" for name, n in rows.items() if n != sizes["A"][0]]


def assumptions() -> dict:
    """Assumption 4 for the measurements of the paper, and for fewer of them."""
    A, C, E = design.double_integrators()
    cases = {"all eight": C, "angles and height": C[:4], "rates alone": C[4:], "angles alone": C[:3]}
    tests = {name: design.rank_test(A, some, E) for name, some in cases.items()}
    return {name: {"holds": r.holds, "at": "everywhere" if r.everywhere else [float(z.real) for z in r.zeros]} for name, r in tests.items()}


def matching(alpha: float, epsilon: float) -> dict:
    """The condition that the paper relaxes, rank C E = rank E: with all states, and with angles and height alone, where the observer with
    L = (10, 25) still converges, at `slowest` [1/s], and no L satisfies the inequality: `least` is on Sigma's diagonal whatever L is."""
    A, C, E = design.double_integrators()
    pose, S, L = C[:4], alpha * E.T, np.vstack([10.0 * np.eye(4), 25.0 * np.eye(4)])
    errors = np.block([[A - L @ pose + E @ S, E], [-S @ (A + E @ S), -S @ E]])
    free = [np.diag(design.sigma(A, pose, E, E, gain * L, alpha, epsilon, 1.0))[4] for gain in (0.0, 1.0, 1e3)]
    return {
        "rank_E": int(np.linalg.matrix_rank(E)),
        "rank_CE": {"all eight": int(np.linalg.matrix_rank(C @ E)), "angles and height": int(np.linalg.matrix_rank(pose @ E))},
        "slowest": float(np.real(np.linalg.eigvals(errors)).max()),
        "least": float(min(free)),
    }  # fmt: skip


def procedure(vehicle: Craft, u, y, epsilons: dict[str, float], settle: Callable, ours: list[tuple]) -> dict:
    """Table 1: for every small mu alpha and L, and how the observer does with them; then this project's (alpha, lp, lv) in `own`.

    settle(losses (T, 4)) -> seconds. u, y: one flight. epsilons: name -> epsilon."""
    A, C, E = design.double_integrators()
    rows = []
    for name, epsilon in epsilons.items():
        for mu in MUS:
            row: dict = {"epsilon": epsilon, "reading": name, "mu": mu}
            try:
                alpha, synthesis = design.table_1(A, C, E, E, mu, epsilon)
            except ConfigError as error:
                if "CVXPY" in str(error):
                    raise
                rows.append({**row, "feasible": False})
                continue
            gain = [float(synthesis.L[i, j]) for i, j in ((0, 0), (0, 4), (4, 0), (4, 4))]
            seconds = settle(observe(vehicle, synthesis.L, alpha, u, y)[1])
            rows.append({**row, "feasible": True, "alpha": alpha, "L": gain, "largest": synthesis.largest, "settle_s": seconds})
    for alpha, lp, lv in ours:
        L = np.diag([lp] * 4 + [lv] * 4)
        mu = 1.0 / alpha**2
        largest = float(np.linalg.eigvalsh(design.sigma(A, C, E, E, L, alpha, max(epsilons.values()), mu)).max())
        rows.append({
            "epsilon": max(epsilons.values()), "reading": "this project's", "mu": mu, "feasible": largest < 0, "alpha": alpha,
            "L": [lp, 0.0, 0.0, lv], "largest": largest, "settle_s": settle(observe(vehicle, L, alpha, u, y)[1]),
        })  # fmt: skip
    return {"rows": rows}


def long_losses(scenarios: dict) -> np.ndarray:
    """(scenarios, T, 4) losses with the faults at the printed times."""
    gamma = np.zeros((len(scenarios), round(LENGTH_S / DT), 4))
    for k, (name, (losses, _)) in enumerate(scenarios.items()):
        for at, loss in zip(PRINTED_S[name], losses, strict=True):
            gamma[k, round(at / DT) :] = loss
    return gamma


def long_flights(vehicle: Craft, scenarios: dict, rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, y, gamma) of every scenario with its faults at the printed times, in noise."""
    gamma = long_losses(scenarios)
    T = gamma.shape[1]
    noise = rng.standard_normal((len(gamma), hover_flights.PER_SAMPLE * T, 8)) * hover_flights.SD
    u, y = hover_flights.fly(vehicle, gamma, np.zeros_like(gamma), noise)
    return u, y, gamma


def parts_of_xi(vehicle: Craft, flights: dict) -> dict:
    """Largest size of each part of xi (eq. 6) [rad/s^2, m/s^2], by flight name -> (u, y, gamma)."""
    still = Craft(vehicle.M, vehicle.D, 0.0 * vehicle.spun, vehicle.gravity, vehicle.counts_max, vehicle.file)
    out = {}
    for name, flight in flights.items():
        whole, body = (error_bound.truth(craft, *(a[None] for a in flight))[1][0] for craft in (vehicle, still))
        out[name] = {
            "body": float(np.abs(body[:, :3]).max()),
            "rotors": float(np.abs(whole - body).max()),
            "tilt": float(np.abs(body[:, 3]).max()),
        }
    return out


def claims(f: dict) -> tuple[Claim, ...]:
    """Assumption 4, the procedure of table 1, and the flights with faults at the printed times."""
    rank, flights = f["assumption_4"], f["printed_times"]["flights"]
    fails = {
        name: "at every lambda" if row["at"] == "everywhere" else f"at lambda = {row['at'][0]:g}"
        for name, row in rank.items()
        if not row["holds"]
    }
    rows = f["table_1"]["rows"]
    named = {name: [r for r in rows if r["reading"] == name] for name in ("as printed", "its inverse", "this project's")}
    off = max(float(np.abs(np.subtract(r["final"], r["true"])).max()) for r in flights.values())
    feasible = {name: all(r["feasible"] for r in part) for name, part in named.items()}
    verdicts = {
        "rank": graded(rank["all eight"]["holds"]),
        "matching": graded(f["matching"]["least"] < 0 > f["matching"]["slowest"], f["matching"]["slowest"] < 0),
        "procedure": graded(feasible["as printed"], feasible["its inverse"]),
        "printed_times": graded(off < 2e-3),
        "rotation": "refuted" if f["eq_1"]["as printed"] > 1e-3 else "holds",
        "sizes": "refuted" if f["eq_6"] else "holds",
    }
    return reproduction.claims(
        "intermediate", verdicts, f=f, fails="; ".join(f"{name} {text}" for name, text in fails.items()), off=off,
        misfits="; ".join(f["eq_6"]) or "none", passes=", ".join(name for name, row in rank.items() if row["holds"]),
    )  # fmt: skip


def _seconds(value: float | None) -> str:
    """Seconds as text; a run that never settles is NaN, and None in a kept result."""
    return "never" if value is None or np.isnan(value) else f"{value:.2f}"


def tables(f: Mapping[str, Any]) -> list[Table]:
    """The procedure of table 1, and what xi is made of."""
    solved = []
    for r in f["table_1"]["rows"]:
        cells = (
            [f"{r['alpha']:.3g}", " ".join(f"{v:.3g}" for v in r["L"]), _seconds(r["settle_s"])] if r["feasible"] else ["-", "none", "-"]
        )
        solved.append([r["reading"], f"{r['epsilon']:g}", f"{r['mu']:g}", *cells])
    head = ("epsilon", "its value", "mu", "alpha", "L: angle, rate from angle, rate", "within 0.02 after, s")
    parts = [[name.replace("_", " "), *(f"{row[k]:.1e}" for k in ("body", "rotors", "tilt"))] for name, row in f["xi"].items()]
    of = ("flight", "gyroscopic, vehicle, rad/s²", "gyroscopic, rotors (J_r), rad/s²", "tilt, m/s²")
    return [
        Table("Gains by table 1's procedure, and this project's, on scenario 3", head, solved),
        Table("Largest parts of the disturbance xi (eq. 6)", of, parts),
    ]
