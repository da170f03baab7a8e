"""Niermeyer, Pak and Lohmann 2017: observability of a hexarotor's losses, and three kinds of estimators on closed-loop flights."""

from __future__ import annotations

import ast
import inspect
import time
from types import ModuleType
from typing import Any

import numpy as np

import rotorwatch_lab.published.observability as observability
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.core import Estimate
from rotorwatch_lab.estimators import lyapunov, mh_lyapunov, mhe
from rotorwatch_lab.estimators.lyapunov import Lyapunov
from rotorwatch_lab.estimators.mh_lyapunov import MHLyapunov
from rotorwatch_lab.estimators.mhe import MHE
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.studies import niermeyer_flights as flights
from rotorwatch_lab.experiments.studies import reproduction
from rotorwatch_lab.experiments.studies.reproduction import Claim, Reproduction, graded, panels, silent
from rotorwatch_lab.maths import lyapunov_law
from rotorwatch_lab.maths.lyapunov_law import State
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

PAPER = "lyapunov-mhe"
TITLE, LITERAL = reproduction.about(PAPER)
SEEDS = 10
WEATHER = {"calm": 0.0, "disturbed": 0.01}  # white disturbance torque, N m per square root of Hz
DURATION_S = 12.0
SETTLE_S = 3.0  # after the onset; the error is taken from then on
FAULTS = {"rotor 1, 40 %": (0.4, 0, 0, 0, 0, 0), "rotors 1,3": (0.3, 0, 0.3, 0, 0, 0), "full loss rotor 1": (1.0, 0, 0, 0, 0, 0)}
PATHS = {"eight": 1.0, "hover": 0.0}
LOOSE = (-0.2, 1.0)  # effectiveness up to 1.2, as for an airframe that has not been calibrated
TIGHT = (-0.005, 1.0)  # so that bounds are at work in the window that another solver gets
ESTIMATORS = {
    "lyapunov": (Lyapunov, {}),
    "gradient": (MHLyapunov, {"pull": "gradient", "flush": False}),
    "proximal": (MHLyapunov, {"flush": False}),
    "proximal_flush": (MHLyapunov, {}),
    "mhe": (MHE, {}),
}
MOVING = ("gradient", "proximal_flush")
PARTICULAR = 5.0  # ratio of singular values that makes the smaller one particularly small
SPANS = 0.01 * np.arange(1, 31)  # s: T0 that are tried
LARGER = 10.0  # ratio of sensitivities that is an order of magnitude
WRITTEN: dict[str, tuple[type, tuple[ModuleType, ...]]] = {  # what each estimator is written in, apart from linear algebra
    "lyapunov": (Lyapunov, (lyapunov, lyapunov_law)),
    "mh_lyapunov": (MHLyapunov, (mh_lyapunov, lyapunov_law)),
    "mhe": (MHE, (mhe,)),
}
NLP_NODES = 10  # a shorter window, for the other solver's sake
NLP_STEPS = 260  # of a flight, after which the window is handed to another solver


class AtEstimate(Lyapunov):
    """Eq. (6) as printed: the plant, its gyroscopic term included, is taken at the observer's state, not at the measured one."""

    def step(self, carry: State, u, y, valid, dt=None) -> tuple[State, Estimate]:
        """Predict and update as in `Lyapunov`."""
        return super().step(carry._replace(measured=carry.x), u, y, valid, dt)


def reproduce(seeds: int = SEEDS, literal: tuple[str, ...] = (), progress=silent) -> Reproduction:
    """The experiments with that many noise seeds. literal: names from LITERAL. progress: called with share and text."""
    table = airframes.paper("niermeyer-hexa")
    system = RateDynamics.of(table)
    progress(0.02, "observability")
    observed = observable(system, scaled="unscaled" not in literal)
    progress(0.2, "flights")
    options: dict[str, Any] = {"hold": 0.0} if "no-hold" in literal else {}
    errors: dict[str, dict[str, np.ndarray]] = {weather: {} for weather in WEATHER}
    cost, traces, flown = {}, {}, {}
    for w, (weather, torque_sd) in enumerate(WEATHER.items()):
        flown[weather] = fly(table, seeds, torque_sd)
        for k, (name, (kind, tuning)) in enumerate(ESTIMATORS.items()):
            progress(0.25 + 0.3 * w + 0.06 * k, f"{name}, {weather}")
            estimator = kind(system, flights.DT, bounds=LOOSE, **tuning, **options)
            errors[weather][name], taken, trace = assess(estimator, flown[weather])
            if w == 0:
                cost[name], traces[name] = taken, trace
    progress(0.85, "proximal_flush, capped")
    as_read: dict[str, float] = {}
    if "gyro-at-estimate" in literal:
        estimator = AtEstimate(system, flights.DT, bounds=LOOSE, **options)
        read, _, trace = assess(estimator, flown["calm"])
        gap = float(np.abs(trace - traces["lyapunov"]).max())
        as_read = {"difference": gap, "rmse": float(read.mean()), "rmse_as_built": float(errors["calm"]["lyapunov"].mean())}
        as_read["bodies_term"] = gyroscopic(system, flown["calm"].omega)
    capped = assess(MHLyapunov(system, flights.DT, **options), flown["calm"])[0]
    progress(0.9, "another solver")
    gap = mhe_vs_nlp(system, flown["calm"])
    numbers: dict[str, Any] = {
        "rmse": {f: {e: by_path(v, k) for e, v in errors["calm"].items()} for k, f in enumerate(FAULTS)},
        "rmse_disturbed": {f: {e: by_path(v, k) for e, v in errors["disturbed"].items()} for k, f in enumerate(FAULTS)},
        "rmse_capped": {f: by_path(capped, k) for k, f in enumerate(FAULTS)},
        "interval": {
            weather: {f: {e: by_path(v, k, spread) for e, v in found.items()} for k, f in enumerate(FAULTS)}
            for weather, found in errors.items()
        },
        "moving_horizon": {weather: compared(found) for weather, found in errors.items()},
        "qobs_rank_flight": observed["rank_flight"],
        "qobs_rank_hover": observed["rank_hover"],
        "qobs_gap": observed["gap"],
        "qobs_gap_unscaled": observed["gap_unscaled"],
        "qobs_longest_T0": observed["longest"],
        "sensitivity_ratio": observed["ratio"][:3],
        "sensitivity_ratio_thrust": observed["ratio"][3],
        "sensitivity_best": observed["best"],
        "sensitivity_below": observed["below"],
        "sensitivity_faintest": observed["faintest"],
        "effort": {name: effort(*row) for name, row in WRITTEN.items()},
        "mhe_vs_nlp": gap,
        "microseconds_per_step": cost,
    }
    progress(1.0, "done")
    if as_read:
        numbers["literal"] = {"gyro-at-estimate": as_read}
    series = {"flights": flown["calm"], "traces": traces, **{k: observed[k] for k in ("t", "along", "kernel", "other")}}
    return Reproduction(PAPER, TITLE, claims(numbers), numbers, literal, seeds, series)


def gyroscopic(system: RateDynamics, omega: np.ndarray) -> float:
    """The largest acceleration by the vehicle's own gyroscopic torque in flights with rates omega (..., 3) [rad/s^2]."""
    J = np.asarray(system.J)
    return float(np.abs(np.cross(omega, omega @ J.T) @ np.linalg.inv(J).T).max())


def observable(system: RateDynamics, scaled: bool = True, orders: int | None = None) -> dict:
    """Ranks and singular values of Q_obs along the figure-eight and in hover, and sensitivities inside and outside ker B.

    orders: of derivatives; None: n - 1, as the paper has it."""
    omega, u = observability.figure_eight(system)
    stride, n = 10, system.n_x + system.n_theta
    orders = n - 1 if orders is None else orders
    hover = np.concatenate([observability.hover_thrusts(system)[None], np.zeros((orders, system.n_u))])
    xs = np.concatenate([np.zeros((1, 3)), omega[::stride]])
    us = np.concatenate([hover[None], observability.derivatives(u, orders)[::stride]])
    plain = observability.lie_matrices(system, xs, us, np.zeros(system.n_theta), orders, scaled=False)

    def relative(T0: float):
        scale = np.cumprod(np.concatenate([[1.0], T0 / np.arange(1, orders + 1)]))
        values = np.linalg.svd(plain * np.repeat(scale, system.n_y)[:, None], compute_uv=False)
        return values / values[:, :1]

    def gap(along) -> float:
        return float((along[1:, n - 3] / along[1:, n - 2]).min())

    unscaled = np.linalg.svd(plain, compute_uv=False)
    unscaled /= unscaled[:, :1]
    along = relative(observability.T0) if scaled else unscaled
    rank = (along > observability.RANK).sum(axis=1)
    S = observability.sensitivity(system, omega, u, observability.DT)
    B = np.concatenate([system.B_tau, system.B_T[None]])
    basis = np.linalg.svd(B)[2]
    size = np.abs(S @ basis.T)  # (T, n_y, n): the last n - 4 directions span ker B
    rms = np.sqrt((size**2).mean(axis=0))
    inside, most = np.sqrt((rms[:, 4:] ** 2).mean(axis=1)), rms[:, 4:].max(axis=1)
    every = np.sqrt((rms**2).sum(axis=0))  # of each direction, over all outputs
    return {
        "rank_hover": int(rank[0]),
        "rank_flight": int(rank[1:].min()),
        "gap": gap(along),
        "gap_unscaled": gap(unscaled),
        "longest": max((float(T0) for T0 in SPANS if gap(relative(T0)) >= PARTICULAR), default=0.0),
        "best": (rms[:3, :4].max(axis=1) / most[:3]).tolist(),
        "below": (rms[:3, :4] <= most[:3, None]).sum(axis=1).tolist(),
        "faintest": float(every[:4].min() / every[4:].max()),
        "ratio": (np.sqrt((rms[:, :4] ** 2).mean(axis=1)) / np.maximum(inside, 1e-12)).tolist(),
        "t": observability.DT * np.arange(len(omega)),
        "along": along[1:],
        "kernel": size[:, :, 4:],
        "other": size[:, :, :4],
    }


def effort(kind: type, modules: tuple[ModuleType, ...]) -> dict[str, int]:
    """Lines of code of these modules, without comments and documentation, and parameters of the estimator besides plant and step."""
    lines = 0
    for module in modules:
        tree = ast.parse(inspect.getsource(module))
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
                node.body = node.body[1:] or [ast.Pass()]
        lines += len([line for line in ast.unparse(tree).splitlines() if line.strip()])
    known = [name for name in inspect.signature(kind).parameters if name not in ("system", "dt")]
    return {"lines": lines, "parameters": len(known)}


def together(errors: np.ndarray) -> float:
    """Root of the mean square over seeds."""
    return float(np.sqrt((errors**2).mean()))


def spread(errors: np.ndarray) -> float | None:
    """Half of the 95 % interval of the mean over seeds (Student's t); None for a single seed."""
    from scipy.stats import t

    n = len(errors)
    return float(t.ppf(0.975, n - 1) * errors.std(ddof=1) / np.sqrt(n)) if n > 1 else None


def by_path(errors: np.ndarray, fault: int, of=together) -> dict:
    """Path -> what `of` makes of the errors (paths, faults, seeds) of one fault."""
    return {path: of(errors[i, fault]) for i, path in enumerate(PATHS)}


def compared(errors: dict[str, np.ndarray]) -> dict[str, int]:
    """Both moving-horizon laws against the Lyapunov estimator, flight by flight with the same noise: in how many of faults and paths
    they are better and worse by more than the 95 % interval of the mean difference (with one seed: at all), and of how many."""
    better = worse = cases = 0
    for name in MOVING:
        for difference in (errors[name] - errors["lyapunov"]).reshape(-1, errors[name].shape[-1]):
            half = spread(difference) or 0.0
            better += bool(difference.mean() < -half)
            worse += bool(difference.mean() > half)
            cases += 1
    return {"better": better, "worse": worse, "cases": cases}


def fly(table: dict, seeds: int, torque_sd: float = 0.0) -> flights.Flight:
    """All flights: leading axes are paths, faults and seeds. torque_sd: of the disturbance, N m per square root of Hz."""
    jax = load_jax()
    loss = np.array(list(FAULTS.values()), float)
    noise, disturbance = flights.noise(range(seeds), round(DURATION_S / flights.DT), torque_sd)
    one = jax.vmap(flights.fly, (None, None, None, 0, 0))
    every = jax.vmap(jax.vmap(one, (None, 0, None, None, None)), (None, None, 0, None, None))
    flown = jax.jit(every)(flights.arrays(table), loss, np.array(list(PATHS.values())), noise, disturbance)
    return jax.tree.map(np.asarray, flown)


def assess(estimator, flown: flights.Flight):
    """(rmse (paths, faults, seeds), microseconds a step, losses of the first seed (paths, faults, T, n)): the error is over rotors, from
    SETTLE_S after the onset. One flight after the other: the moving-horizon estimator solves only where a node is complete."""
    jax = load_jax()
    size = flown.t.shape
    table = [a.reshape(-1, *a.shape[3:]) for a in (flown.u, flown.y)]
    program = jax.jit(lambda *table: jax.lax.map(lambda flight: tools.stepped(estimator, flight[0], flight[1], tools.losses), table))
    program = program.lower(*table).compile()
    began = time.process_time()  # not the clock on the wall: other programs may be running
    theta = np.asarray(program(*table))
    cost = 1e6 * (time.process_time() - began) / theta[..., 0].size
    theta = theta.reshape(*size, -1)
    late = flown.t[0, 0, 0] >= flights.ONSET_S + SETTLE_S
    error = (1.0 - theta - flown.effectiveness)[..., late, :]
    return np.sqrt((error**2).mean(axis=(3, 4))), cost, theta[:, :, 0]


def mhe_vs_nlp(system: RateDynamics, flown: flights.Flight) -> float:
    """Largest difference between the moving-horizon estimator's nodes, iterated until they settle, and SciPy's bounded nonlinear
    least squares (an interior trust-region method) over the same window of a flight with a fault, from another start."""
    from scipy.optimize import least_squares

    jax = load_jax()
    jnp = jax.numpy
    start = round((flights.ONSET_S - 0.1) / flights.DT)
    rows = slice(start, start + NLP_STEPS)
    u, y = flown.u[0, 0, 0, rows], flown.y[0, 0, 0, rows]
    quick = MHE(system, flights.DT, nodes=NLP_NODES, bounds=TIGHT)
    valid = jnp.ones(4, bool)
    carry, _ = jax.jit(lambda u, y: jax.lax.scan(lambda c, r: quick.step(c, r[0], r[1], valid), quick.init(), (u, y)))(u, y)
    thorough = MHE(system, flights.DT, nodes=NLP_NODES, bounds=TIGHT, iterations=6, active_set=4)
    solve = jax.jit(thorough.solve)
    nodes, force = carry.nodes, carry.force
    for _ in range(4):
        nodes, force = solve(carry.window, carry.filled, nodes, force, carry.prior, carry.prior_P)

    root = np.linalg.inv(np.linalg.cholesky(np.asarray(carry.prior_P)))
    window, n = jax.tree.map(np.asarray, carry.window), thorough.n

    def residuals(flat):
        """Residuals of unit variance, derived independently from the definition of the problem."""
        s = flat.reshape(-1, n)

        def interval(before, after, samples):
            x, theta, parts = before[:3], before[3:], []
            for j in range(thorough.m):
                u, y, dt = samples.u[j], samples.y[j], samples.dt[j]
                x = system.f(x, u, theta, dt)
                at, loss = (x, theta) if j < thorough.m - 1 else (after[:3], after[3:])
                parts.append((y - system.h(at, u, loss)) / jnp.sqrt(system.R(u)))
            scale = jnp.linalg.cholesky(thorough.Q(samples.u[-1], samples.dt.sum()))
            miss = after - jnp.concatenate([x, theta])
            return jnp.concatenate([*parts, jax.scipy.linalg.solve_triangular(scale, miss, lower=True)])

        return jnp.concatenate([root @ (s[0] - carry.prior), jax.vmap(interval)(s[:-1], s[1:], window).reshape(-1)])

    value: Any
    jacobian: Any
    value, jacobian = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
    low, high = (np.tile(np.asarray(b), thorough.intervals + 1) for b in (thorough.low, thorough.high))
    other = np.tile(np.asarray(carry.prior), thorough.intervals + 1).reshape(-1, n)
    other[:, 3:] = np.clip(other[:, 3:], TIGHT[0] / 2, 0.9)
    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-13, "max_nfev": 200}
    optimum = least_squares(value, other.ravel(), jacobian, (low, high), x_scale="jac", **tight)
    return float(np.abs(optimum.x - np.asarray(nodes).ravel()).max())


def claims(n: dict) -> tuple[Claim, ...]:
    """The paper's claims beside the numbers."""
    cost = n["microseconds_per_step"]
    mean, disturbed = (
        {e: np.mean([list(n[key][f][e].values()) for f in FAULTS]) for e in ESTIMATORS} for key in ("rmse", "rmse_disturbed")
    )
    moving, moving_disturbed = (min(main["proximal"], main["proximal_flush"]) for main in (mean, disturbed))
    count = {key: sum(v[key] for v in n["moving_horizon"].values()) for key in ("better", "worse", "cases")}
    better, worse, cases = count.values()
    capped = np.mean([list(v.values()) for v in n["rmse_capped"].values()])
    ours, standard = n["effort"]["mh_lyapunov"], n["effort"]["mhe"]
    shorter, fewer = ours["lines"] < standard["lines"], ours["parameters"] <= standard["parameters"]
    verdicts = {
        "rank": graded(n["qobs_rank_flight"] == 9),
        "small_values": graded(min(n["qobs_gap"], n["qobs_gap_unscaled"]) >= PARTICULAR, n["qobs_gap"] >= PARTICULAR),
        "sensitivity": graded(n["sensitivity_faintest"] > LARGER, min(n["sensitivity_best"]) > LARGER),
        "horizon": graded(worse == 0 and 2 * better > cases, better > worse),
        "comparable": graded(moving < 1.2 * mean["mhe"], True),
        "easy": graded(shorter and fewer, cost["mhe"] > 3 * cost["proximal_flush"]),
        "above_one": graded(mean["proximal_flush"] <= capped, True),
    }
    main = reproduction.claims(
        PAPER, verdicts, n=n, mean=mean, disturbed=disturbed, moving=moving, moving_disturbed=moving_disturbed,
        **count, cost=cost, solves=4 * cost["mhe"], capped=capped,
    )  # fmt: skip
    return main + tuple(_read(name, row) for name, row in n.get("literal", {}).items())


def _read(name: str, row: dict) -> Claim:
    """The claim about eq. (6), read literally."""
    return Claim(
        f"Literal reading: {name}",
        LITERAL[name],
        f"losses differ by up to {row['difference']:.2g}; mean RMSE {row['rmse']:.4f}, as built {row['rmse_as_built']:.4f}",
        "holds" if row["rmse"] <= 1.02 * row["rmse_as_built"] else "not reproduced",
        f"The term is at most {row['bodies_term']:.2g} rad/s^2 here. At the estimate it makes the error nonlinear, and the proof is lost.",
    )


def figures(result: Reproduction) -> dict:
    """The paper's figures 1 and 2, and the estimates on the figure-eight. Raises ConfigError without matplotlib."""
    s = result.series
    one, ((axis,),) = panels(1, 1, (7, 3.2), grid=False)
    axis.semilogy(np.linspace(0, s["t"][-1], len(s["along"])), s["along"], lw=1)
    axis.set(title="Singular values of Q_obs", xlabel="time [s]", ylabel="relative to the largest")

    two, axes = panels(4, 1, (7, 6), grid=False, sharex=True)
    for k, axis in enumerate(axes.flat):
        axis.semilogy(s["t"][::5], np.maximum(s["other"][::5, k], 1e-8), color="tab:blue", lw=1)
        axis.semilogy(s["t"][::5], np.maximum(s["kernel"][::5, k], 1e-8), color="tab:red", lw=1)
        axis.set_ylabel(("p", "q", "r", "f_z")[k])
    two.suptitle("Sensitivity (absolute value) to losses; red: kernel of B, blue: off it, not all of it larger")

    three, grid = panels(len(FAULTS), len(ESTIMATORS), (9, 6), grid=False, sharex=True, sharey=True)
    flown, step = s["flights"], 240
    for f, fault in enumerate(FAULTS):
        for e, name in enumerate(ESTIMATORS):
            axis, t = grid[f, e], flown.t[0, f, 0, ::step]
            axis.plot(t, flown.effectiveness[0, f, 0, ::step], color="0.7", lw=2)
            axis.plot(t, 1.0 - s["traces"][name][0, f, ::step], lw=0.8)
            axis.set_ylim(-0.1, 1.3)
            axis.set_title(name if f == 0 else "", fontsize=9)
        grid[f, 0].set_ylabel(fault, fontsize=9)
    three.suptitle("Effectiveness on the figure-eight; grey: truth")
    return {"observability": one, "sensitivity": two, "estimates": three}
