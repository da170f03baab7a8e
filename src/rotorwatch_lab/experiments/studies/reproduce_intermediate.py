"""Intermediate observer on the F450: four hovering flights, the matrix inequality, and more than four rotors.

A plant at 400 Hz under a PID controller (studies/hover_flights.py) is watched by the observer at 100 Hz with L = (10, 20). The
paper's flights are shortened for the ten seeds: faults come at 5, 15 and 25 s, and a hover of a minute before them adds nothing. One
flight of each scenario is as long as printed (intermediate_as_printed.py). Wrong models and wind: wrong_models.py. Sources: see
estimators/intermediate.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.intermediate import Intermediate
from rotorwatch_lab.experiments.studies import error_bound, hover_flights, reproduction, wrong_models
from rotorwatch_lab.experiments.studies import intermediate_as_printed as printed
from rotorwatch_lab.experiments.studies.reproduction import Claim, Reproduction, Table, graded, panels, silent
from rotorwatch_lab.maths import intermediate_design as design
from rotorwatch_lab.systems.linear_hover import LinearHover

PAPER = "intermediate"
NEEDS = ("cvxpy",)
TITLE, LITERAL = reproduction.about(PAPER)
SEEDS = 10
DT = 1.0 / hover_flights.OBSERVER_HZ
SAMPLES, ONSETS, LAST = 3500, (500, 1500, 2500), 200
# Losses (gamma_1..4) from each onset on; the paper's gain on yaw.
SCENARIOS = {
    "scenario_1": (((0, 0, 0.2, 0),), 1.0),
    "scenario_2": (((0, 0, 0.2, 0),), 10.0),
    "scenario_3": (((0, 0, 0.22, 0), (0, 0, 0.22, 0.16), (0, 0.13, 0.22, 0.16)), 10.0),
    "scenario_4": (((0.3, 0.3, 0.3, 0.3),), 10.0),
}
ALPHAS = (1.0, 5.0)
CLIMB_ALPHA = 5.0  # while it climbs and sinks
BAND = 0.02
EPSILON, PRINTED_EPSILON = 50.0, 0.02
RINGS = {"hexa": 6, "octa": 8}
GAINS = (10.0, 20.0)  # lp, lv: the observer's own
STIFFNESS = (1.0, 0.8, 0.7, 0.6)  # of the attitude controller, the first being the study's own
DRAWN = 0.6  # the one of the figures of position and PWM: nearest to the paper's numbers
# Largest deviations that the paper reads off its figures 3, 7, 11 and 15: (x, y) [m] after each onset, and the drop of scenario 4.
DEVIATION = {"scenario_2": ((0.60, 0.30),), "scenario_3": ((0.60, 0.25), (0.50, 0.10), (None, 0.60))}
SMALL = 0.1  # m: "a small deviation" in height, beside 0.25 to 0.6 m sideways
DROP, ALIKE = 0.4, 0.3  # m; share within which a number read off a figure counts as met
PICTURE = 20  # every how many-th sample of a long flight is drawn
BACK = 0.05  # m: what is nearer than that to its place has come back
CHANNEL_OFF = 1e-3  # error of a channel's fault that counts as none, against the largest fault of the flight
INACCURATE = 0.05  # a loss that is off by so much
SETS, RING_SAMPLES, RING_ONSET = 8, 700, 200  # sets of faulty rotors a number of faults, 100 Hz samples


def reproduce(seeds: int = SEEDS, literal: tuple[str, ...] = (), progress=silent) -> Reproduction:
    """The study; see studies/reproduction.py."""
    rng = np.random.default_rng(2020)
    file = airframes.paper("f450")
    flights = _scenario_flights(file, seeds, rng)
    progress(0.2)
    moving = _climbing(file)
    runs, plain, filtered = _watch_all(file, flights, moving)
    if "pi" in literal:
        runs = {alpha: _without_inertia(file, flights.u, run) for alpha, run in runs.items()}
    progress(0.3)
    figures = {name: _scenario(name, flights, runs) for name in SCENARIOS}
    figures |= _inequality(PRINTED_EPSILON if "epsilon" in literal else EPSILON)
    figures |= _balance(flights, runs)
    figures["channels"] = _channels(file, flights, runs)
    progress(0.4)
    figures["manoeuvre"], series = _manoeuvre(file, moving, filtered)
    progress(0.5)
    figures["bound"], series["bound"] = _bound(file, *plain)
    figures["position"], series["position"] = _positions(file), _placed(file)
    progress(0.6)
    figures |= _as_printed(file, flights, moving)
    figures["printed_times"], series["long"] = _long(file, np.random.default_rng(130))
    progress(0.7)
    figures["uncertain"] = wrong_models.grid(file, _watcher(file), GAINS, EPSILON)
    progress(0.8)
    beyond = {}
    for k, (name, rotors) in enumerate(RINGS.items()):
        beyond[name] = _ring(file, rotors, rng)
        progress(0.8 + 0.1 * (k + 1))
    figures["beyond_four"] = {name: ring["sparse"] for name, ring in beyond.items()}
    figures["beyond_four_rules"] = beyond
    series["time"] = DT * np.arange(SAMPLES)
    return Reproduction(PAPER, TITLE, _claims(figures), figures, literal, seeds, series)


def _scenario_flights(file: dict, seeds: int, rng) -> SimpleNamespace:
    """All flights at once: of each scenario one without noise, then one a seed; then scenario 1 again with the yaw gain."""
    gamma, nu, rows, show = [], [], {}, {}
    noise = rng.standard_normal((seeds, hover_flights.PER_SAMPLE * SAMPLES, 8)) * hover_flights.SD
    noise = np.concatenate([np.zeros_like(noise[:1]), noise])
    for name, (losses, gain) in SCENARIOS.items():
        rows[name] = len(gamma) + np.arange(seeds + 1)
        show[name] = rows[name][-1]
        gamma += [_steps(losses)] * (seeds + 1)
        nu += [gain] * (seeds + 1)
    gamma = np.array(gamma)
    u, y = hover_flights.fly(hover_flights.craft(file), gamma, np.zeros((len(gamma), SAMPLES, 4)), np.tile(noise, (len(SCENARIOS), 1, 1)))
    return SimpleNamespace(gamma=gamma, nu=np.array(nu), rows=rows, show=show, u=u, y=y)


def _steps(losses) -> np.ndarray:
    """(SAMPLES, 4) losses that change at each onset."""
    table = np.zeros((SAMPLES, 4))
    for onset, loss in zip(ONSETS, losses, strict=False):
        table[onset:] = loss
    return table


def _watch(system, u, y, alpha, nu, **options) -> SimpleNamespace:
    """theta (N, T, n), fault (N, T, 8) and ambiguity (N, T) and states x (N, T, 8) of the observer over N
    flights: one program."""
    jax = load_jax()
    valid = np.ones(y.shape[1:], bool)

    def one(alpha, nu, u, y):
        estimator = Intermediate(system, DT, alpha=alpha, yaw_gain=nu, **options)

        def step(carry, row):
            carry, estimate = estimator.step(carry, *row)
            return carry, (estimate.theta, carry.fault[:8], carry.ambiguity, estimate.x)

        return jax.lax.scan(step, estimator.init(), (u, y, valid))[1]

    outputs = jax.jit(jax.vmap(one))(*(np.broadcast_to(v, len(u)).astype(float) for v in (alpha, nu)), u, y)
    return SimpleNamespace(**dict(zip(("theta", "fault", "ambiguity", "x"), map(np.asarray, outputs), strict=True)))


def _watch_all(file: dict, flights, moving) -> tuple[dict, tuple, np.ndarray]:
    """All that one program can do: every scenario's flights by alpha; (u, y, gamma, run) of each scenario's first flight and the climbing
    one without gain on yaw, alpha = 1; and losses (T, 4) of the climbing one with alpha = 5."""
    clean, N = [flights.rows[name][0] for name in SCENARIOS], len(flights.u)
    plain = [np.concatenate([getattr(flights, k)[clean], part]) for k, part in zip(("u", "y", "gamma"), moving, strict=True)]
    u, y = (np.concatenate([*[getattr(flights, k)] * len(ALPHAS), plain[i], moving[i]]) for i, k in enumerate(("u", "y")))
    rest = np.ones(len(plain[0]))
    alpha = np.concatenate([np.repeat(ALPHAS, N), rest, [CLIMB_ALPHA]])
    run = _watch(LinearHover.of(file), u, y, alpha, np.concatenate([np.tile(flights.nu, len(ALPHAS)), rest, [1.0]]))

    def part(start, stop):
        return SimpleNamespace(**{k: v[start:stop] for k, v in vars(run).items()})

    runs = {a: part(i * N, (i + 1) * N) for i, a in enumerate(ALPHAS)}
    return runs, (*plain, part(len(ALPHAS) * N, -1)), run.theta[-1]


def _without_inertia(file: dict, u, run) -> SimpleNamespace:
    """The same faults read through the printed Pi = M instead of D M: gamma = -diag(u)^-1 M^-1 fault."""
    vehicle = hover_flights.craft(file)
    wrong = np.linalg.solve(vehicle.M, vehicle.D[:, None] * vehicle.M)
    return SimpleNamespace(**{**vars(run), "theta": ((u * run.theta) @ wrong.T) / u})


def _scenario(name: str, flights, runs) -> dict:
    """Final losses without noise and as a mean over seeds, and how long they take to settle after the worst onset."""
    clean, noisy = flights.rows[name][0], flights.rows[name][1:]
    true = flights.gamma[clean]
    end = {alpha: run.theta[:, -LAST:].mean(axis=1) for alpha, run in runs.items()}
    onsets = [k for k in ONSETS if np.any(true[k] != true[k - 1])]
    return {
        "true": true[-1],
        "final": end[1.0][noisy].mean(axis=0) if len(noisy) else end[1.0][clean],
        "final_without_noise": end[1.0][clean],
        "sd": runs[1.0].theta[noisy, -LAST:].std(axis=(0, 1)) if len(noisy) else np.zeros(4),
        "settle_s": {f"alpha_{alpha:g}": max(_settling_s(run.theta[clean], true, k) for k in onsets) for alpha, run in runs.items()},
    }


def _settling_s(theta, true, onset: int) -> float:
    """Seconds from an onset until all losses stay within BAND of the truth, up to the next onset; NaN when never."""
    stop = next((k for k in (*ONSETS, len(true)) if k > onset), len(true))
    off = np.flatnonzero((np.abs(theta - true)[onset:stop] > BAND).any(axis=1))
    if not off.size:
        return 0.0
    return float("nan") if off[-1] == stop - onset - 1 else float(off[-1] + 1) * DT


def _inequality(epsilon: float) -> dict:
    """Feasibility of the matrix inequality for the printed epsilon (its inverse where read the other way)."""
    A, C, E = design.double_integrators()

    def solve(epsilon):
        try:
            return design.synthesize(A, C, E, E, 1.0, epsilon)
        except ConfigError as error:
            if "CVXPY" in str(error):
                raise
            return None

    synthesis = solve(epsilon)
    values = np.linalg.eigvalsh(design.sigma(A, C, E, E, np.diag([10.0] * 4 + [20.0] * 4), 1.0, epsilon, 1.0))
    return {
        "lmi_paper_feasible": solve(PRINTED_EPSILON) is not None,
        "lmi_epsilon": epsilon,
        "lmi_feasible": synthesis is not None,
        "lmi_max_eig": synthesis.largest if synthesis else None,
        "lmi_max_eig_10_20": float(values.max()),
        "lmi_gain": [float(synthesis.L[0, 0]), float(synthesis.L[4, 4])] if synthesis else None,
    }


def _balance(flights, runs) -> dict:
    """Effect of the yaw gain between scenarios 1 and 2, which are the same flight: means, and noise on the yaw fault."""
    one, two = (flights.rows[f"scenario_{k}"] for k in (1, 2))
    theta, yaw = runs[1.0].theta[:, -LAST:], runs[1.0].fault[:, -LAST:, 6]
    change = np.abs(theta[one].mean(axis=(0, 1)) - theta[two].mean(axis=(0, 1))).max()
    return {
        "balance_changes_mean": bool(change > 1e-3),
        "balance_mean_change": float(change),
        "balance_yaw_noise": {"gain_1": float(yaw[one[1:]].std()), "gain_10": float(yaw[two[1:]].std() / 10.0)},
    }


def _true_fault(file: dict, flights, k) -> np.ndarray:
    """(T, 4) true wrench deficit of flight k, in the units of the observer's fault: yaw times the gain."""
    fault = error_bound.truth(hover_flights.craft(file), flights.u[k], flights.y[k], flights.gamma[k])[0]
    return fault * np.array([1.0, 1.0, flights.nu[k], 1.0])


def _channels(file: dict, flights, runs) -> dict:
    """For every scenario and channel: the fault at the end as injected and as estimated, without the gain; mean and scatter with noise."""
    out = {}
    for name in SCENARIOS:
        clean, noisy = flights.rows[name][0], flights.rows[name][1:]
        divide = np.array([1.0, 1.0, flights.nu[clean], 1.0])
        true = (_true_fault(file, flights, clean) / divide)[-LAST:].mean(axis=0)
        faults = runs[1.0].fault[..., 4:] / divide
        seen = faults[noisy] if len(noisy) else faults[[clean]]
        out[name] = {
            "true": true,
            "found": seen[:, -LAST:].mean(axis=(0, 1)),
            "sd": seen[:, -LAST:].std(axis=(0, 1)),
            "found_without_noise": faults[clean, -LAST:].mean(axis=0),
        }
    return out


def _bound(file: dict, u, y, gamma, run) -> tuple[dict, dict]:
    """Theorem 1 on the four flights and on the climbing one, without noise and gain on yaw, by the observer with alpha = 1."""
    vehicle = hover_flights.craft(file)
    fault, xi = error_bound.truth(vehicle, u, y, gamma)
    rows = {}
    for k, name in enumerate((*SCENARIOS, "climbing")):
        jumps = [a for a in ONSETS if np.any(gamma[k, a] != gamma[k, a - 1])]
        starts = tuple(a + 1 for a in jumps)
        rows[name] = (y[k] - run.x[k], fault[k] - run.fault[k, :, 4:], fault[k], xi[k], starts)
    bounds = error_bound.compare(rows, 1.0, GAINS, EPSILON)
    return bounds, {name: row.pop("series") for name, row in bounds["flights"].items()}


def _as_printed(file: dict, flights, moving) -> dict:
    """The rank test, the procedure of table 1 on the flight of scenario 3 without noise, and the parts of xi."""
    vehicle, clean = hover_flights.craft(file), flights.rows["scenario_3"][0]
    gamma = flights.gamma[clean]

    def settle(theta):
        return max(_settling_s(theta, gamma, k) for k in ONSETS)

    readings = {"as printed": PRINTED_EPSILON, "its inverse": EPSILON}
    ours = [(alpha, *GAINS) for alpha in ALPHAS]
    named = {name: tuple(getattr(flights, k)[flights.rows[name][0]] for k in ("u", "y", "gamma")) for name in SCENARIOS}
    return {
        "eq_1": {"as printed": printed.off_rotation(False), "mended": printed.off_rotation(True)},
        "eq_6": printed.misfits(),
        "assumption_4": printed.assumptions(),
        "matching": printed.matching(1.0, EPSILON),
        "table_1": printed.procedure(vehicle, flights.u[clean], flights.y[clean], readings, settle, ours),
        "xi": printed.parts_of_xi(vehicle, named | {"climbing": tuple(a[0] for a in moving)}),
    }


def _long(file: dict, rng) -> tuple[dict, dict]:
    """For every scenario with its faults at the printed times: final losses, and series."""
    vehicle = hover_flights.craft(file)
    u, y, gamma = printed.long_flights(vehicle, SCENARIOS, rng)
    nu = np.array([gain for _, gain in SCENARIOS.values()])
    run = _watch(LinearHover.of(file), u, y, 1.0, nu)
    true = error_bound.truth(vehicle, u, y, gamma)[0]
    rows, series = {}, {"time": DT * np.arange(gamma.shape[1])}
    for k, name in enumerate(SCENARIOS):
        rows[name] = {"onsets_s": printed.PRINTED_S[name], "final": run.theta[k, -LAST:].mean(axis=0), "true": gamma[k, -1]}
        divide = np.array([1.0, 1.0, nu[k], 1.0])
        series[name] = {"theta": run.theta[k], "gamma": gamma[k], "fault": run.fault[k, :, 4:] / divide, "true_fault": true[k]}
    return {"length_s": printed.LENGTH_S, "flights": rows}, series


def _watcher(file: dict):
    """The observer with alpha = 1, as wrong_models.py wants it."""

    def watch(u, y):
        run = _watch(LinearHover.of(file), u, y, 1.0, 1.0)
        return run.theta, run.fault, run.x

    return watch


def _placed(file: dict) -> dict:
    """Position [m], from the printed height, and counts over flights as long as printed, with one controller: figures 3, 4 and so on."""
    gamma = printed.long_losses(SCENARIOS)
    place, u = hover_flights.hold(hover_flights.craft(file), gamma, np.full(len(gamma), DRAWN))
    heights = np.array([[0.0, 0.0, printed.HEIGHT_M[name]] for name in SCENARIOS])
    return {name: {"place": place[k] + heights[k], "u": u[k]} for k, name in enumerate(SCENARIOS)}


def _positions(file: dict) -> dict:
    """How far the vehicle is pushed off its place, and counts, for each scenario that differs and each stiffness of the controller."""
    names = [name for name in SCENARIOS if name != "scenario_1"]  # the same flight as scenario 2
    gamma = np.repeat([_steps(SCENARIOS[name][0]) for name in names], len(STIFFNESS), axis=0)
    place, u = hover_flights.hold(hover_flights.craft(file), gamma, np.tile(STIFFNESS, len(names)))
    place, u = (a.reshape(len(names), len(STIFFNESS), *a.shape[1:]) for a in (place, u))
    out: dict = {"stiffness": STIFFNESS}
    for k, name in enumerate(names):
        stops = (*ONSETS[1:], SAMPLES)
        spans = [
            (a, b) for a, b in zip(ONSETS, stops, strict=True) if np.any(gamma[k * len(STIFFNESS), a] != gamma[k * len(STIFFNESS), a - 1])
        ]
        off = [[np.abs(place[k, i, a:b] - place[k, i, a - 1]).max(axis=0) for a, b in spans] for i in range(len(STIFFNESS))]
        out[name] = {
            "off_m": np.array(off),
            "back_m": np.abs(place[k, :, -1]).max(axis=1),
            "counts_before": u[k, 0, ONSETS[0] - 1],
            "counts_after": np.array([u[k, 0, b - LAST : b].mean(axis=0) for _, b in spans]),
        }
    return out


def _climbing(file: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, y, gamma) of one flight without noise that loses 20 % of motor 3, then climbs and sinks."""
    time = DT * np.arange(SAMPLES)
    reference = np.zeros((1, SAMPLES, 4))
    reference[0, 1000:, 3] = 1.0 * np.sin(2 * np.pi * 0.4 * (time[1000:] - time[1000]))
    gamma = np.tile(_steps(((0, 0, 0.2, 0),)), (1, 1, 1))
    noise = np.zeros((1, hover_flights.PER_SAMPLE * SAMPLES, 8))
    u, y = hover_flights.fly(hover_flights.craft(file), gamma, reference, noise)
    return u, y, gamma


def _manoeuvre(file: dict, moving, filtered) -> tuple[dict, dict]:
    """Largest error while climbing and sinking, dividing by filtered and by present commands, and the losses."""
    u, y, gamma = moving
    present = _watch(LinearHover.of(file), u, y, CLIMB_ALPHA, 1.0, matched=False).theta[0]
    series = {"manoeuvre": {"filtered": filtered, "present": present}}
    error = {name: float(np.abs(theta - gamma[0])[1000:].max()) for name, theta in series["manoeuvre"].items()}
    return {**error, "ratio": error["present"] / error["filtered"]}, series


def _ring(file: dict, rotors: int, rng) -> dict:
    """Median over random sets of faults of the largest error of any rotor, for 1, 2 and 3 faulty rotors and each rule.

    Sparse and least squares in hover; temporal while yaw, roll, pitch and height move, with the time until it stays within BAND.
    """
    vehicle = hover_flights.craft(hover_flights.ring(file, rotors))
    gamma = np.zeros((3, SETS, RING_SAMPLES, rotors))
    for faults in (1, 2, 3):
        known = list(combinations(range(rotors), faults))
        for k, chosen in enumerate(rng.permutation(len(known))[np.arange(SETS) % len(known)]):
            gamma[faults - 1, k, RING_ONSET:, known[chosen]] = rng.uniform(0.1, 0.4, (faults, 1))
    gamma = gamma.reshape(3 * SETS, RING_SAMPLES, rotors)
    time = DT * np.arange(RING_SAMPLES)
    moving = np.stack([0.1 * np.sin(9 * time), 0.1 * np.cos(7 * time), 0.3 * np.sin(3 * time), 0.3 * np.sin(5 * time)], axis=1)
    reference = np.stack([0.0 * moving, moving])[:, None].repeat(len(gamma), axis=1).reshape(-1, RING_SAMPLES, 4)
    noise = rng.standard_normal((2 * len(gamma), hover_flights.PER_SAMPLE * RING_SAMPLES, 8)) * hover_flights.SD
    u, y = hover_flights.fly(vehicle, np.concatenate([gamma, gamma]), reference, noise)
    hover, moved = slice(0, len(gamma)), slice(len(gamma), None)
    system, result = LinearHover.of(vehicle.file), {}
    for rule, part in (("least_squares", hover), ("sparse", hover), ("temporal", moved)):
        run = _watch(system, u[part], y[part], 5.0, 1.0, allocation=rule)
        end = np.abs(run.theta[:, -LAST // 2 :].mean(axis=1) - gamma[:, -1]).max(axis=1)
        result[rule] = np.median(end.reshape(3, SETS), axis=1)
        if rule == "sparse":
            result["ambiguous_share"] = (np.median(run.ambiguity[:, -LAST // 2 :], axis=1) > 1).reshape(3, SETS).mean(axis=1)
        if rule == "temporal":
            late = (np.abs(run.theta - gamma)[:, RING_ONSET:] > BAND).any(axis=2)
            settle = DT * (late.shape[1] - np.argmax(late[:, ::-1], axis=1)) * late.any(axis=1)
            result["temporal_settle_s"] = np.median(settle.reshape(3, SETS), axis=1)
    return result


def _claims(f: dict) -> tuple[Claim, ...]:
    """The paper's claims, and ours beyond it."""
    worst, exact = (
        {n: float(np.abs(np.subtract(f[n][key], f[n]["true"])).max()) for n in SCENARIOS} for key in ("final", "final_without_noise")
    )
    right = {n: worst[n] < 1e-3 and exact[n] < 1e-3 for n in SCENARIOS}
    rules = f["beyond_four_rules"]
    verdicts = {
        "balanced": graded(right["scenario_2"]),
        "unbalanced": graded(not all(right.values()) or f["balance_changes_mean"]),
        "one_by_one": graded(right["scenario_3"]),
        "all_four": graded(right["scenario_4"]),
        "inequality": graded(f["lmi_paper_feasible"], True),
        "more_motors": graded(all(max(r["least_squares"]) > INACCURATE for r in rules.values())),
    }
    feasible = {True: "feasible", False: "infeasible"}
    rings = "; ".join(
        f"{name}: pseudo-inverse {_list(r['least_squares'])}, fewest rotors {_list(r['sparse'])}, memory {_list(r['temporal'])}"
        for name, r in rules.items()
    )
    main = reproduction.claims(
        PAPER, verdicts, f=f, worst=worst, rings=rings,
        settle=[f["scenario_2"]["settle_s"][f"alpha_{a:g}"] for a in ALPHAS],
        three=_list(f["scenario_3"]["final"], ", "), four=_list(f["scenario_4"]["final"], ", "),
        printed=feasible[f["lmi_paper_feasible"]], used=feasible[f["lmi_feasible"]],
    )  # fmt: skip
    position = f["position"]
    return (
        *main,
        *printed.claims(f),
        *wrong_models.claims(f["uncertain"]),
        _bound_claim(f["bound"]),
        _channel_claim(f["channels"]),
        *_off_claims(position),
        _pwm_claim(position),
    )


def _bound_claim(bound: dict) -> Claim:
    """Theorem 1: whether the bound holds at every sample of every flight, and its ratio to the errors."""
    flights, climbing = bound["flights"], bound["flights"]["climbing"]
    held = [name for name, row in flights.items() if row["held"]]
    within = climbing["error"] <= climbing["bound"]
    verdicts = {"theorem": graded(len(held) == len(flights) and within, within)}
    best = climbing["bound_best_epsilon"] / climbing["error"]
    values = {"f": {"bound": bound}, "held": len(held), "of": len(flights), "climbing": climbing, "best": best}
    return reproduction.claims(PAPER, verdicts, **values)[0]


def _channel_claim(channels: dict) -> Claim:
    """Figures 5, 9, 13, 17: every channel's fault, of every flight, in noise and without, relative to the largest of its flight."""
    off = {
        name: max(np.abs(np.subtract(row[key], row["true"])).max() for key in ("found", "found_without_noise")) / np.abs(row["true"]).max()
        for name, row in channels.items()
    }
    met = [name for name, error in off.items() if error < CHANNEL_OFF]
    rows = "; ".join(f"{n[-1]}: {', '.join(f'{v:.2f}' for v in channels[n]['found'])}" for n in channels if n != "scenario_1")
    verdicts = {"channels": graded(len(met) == len(off), met)}
    return reproduction.claims(PAPER, verdicts, channels=rows, channel_percent=100 * max(off.values()))[0]


def _off_claims(position: dict) -> tuple[Claim, ...]:
    """Figures 3, 7, 11, 15: distance of the vehicle from its place. The controller's gains are not printed."""
    verdicts, texts = {}, {}
    for name, wanted in DEVIATION.items():
        off = np.array(position[name]["off_m"])[:, :, :2]
        met = all(_met(off[0], wanted, axis) for axis in (0, 1))
        share = off.max(axis=(1, 2)) / np.max([w for pair in wanted for w in pair if w is not None])
        near = int(np.abs(np.log(share)).argmin())
        returned = max(position[name]["back_m"]) < BACK
        key = f"pushed_{name[-1]}"
        verdicts[key] = graded(returned and met, returned and abs(share[near] - 1.0) < ALIKE)
        texts[key] = (
            f"{_pairs(off[0])} cm; {_pairs(off[near])} cm with a controller {position['stiffness'][near]:g} times as fast; "
            f"back within {100 * position[name]['back_m'][0]:.2g} cm"
        )
    height = np.concatenate([np.array(position[name]["off_m"])[:, :, 2] for name in DEVIATION], axis=1)
    verdicts["small_z"] = graded(height.max() < SMALL, height[0].max() < SMALL)
    off = np.array(position["scenario_4"]["off_m"])[0, 0]
    aside, met = float(off[:2].max()), abs(off[2] / DROP - 1.0) < ALIKE
    verdicts["drop"] = graded(met and aside < 0.01, met or aside < 0.01)
    heights = {f"height_{k}": ", ".join(f"{100 * v:.1f}" for v in height[row]) for k, row in (("own", 0), ("drawn", -1))}
    return reproduction.claims(PAPER, verdicts, **texts, **heights, drawn=DRAWN, aside=aside, drop=off[2])


def _met(off, wanted, axis: int) -> bool:
    """True if deviations off (spans, 2) are near all those of an axis that the paper names."""
    pairs = [(o[axis], w[axis]) for o, w in zip(off, wanted, strict=True) if w[axis] is not None]
    return all(abs(o / w - 1.0) < ALIKE for o, w in pairs)


def _pwm_claim(position: dict) -> Claim:
    """Figures 4, 8, 12, 16: counts are alike before, and rise on the motors that are weak and no other."""
    right, rows = [], []
    for name in ("scenario_2", "scenario_3", "scenario_4"):
        row, before = position[name], np.array(position[name]["counts_before"])
        after, losses = np.array(row["counts_after"])[-1], np.array(SCENARIOS[name][0][-1])
        rise = after / before.mean() - 1.0
        weak = losses > 0
        even = np.ptp(before) < 0.01 * before.mean()
        right.append(bool(even and (rise[weak] > 0.02).all() and (np.abs(rise[~weak]) < 0.02).all()))
        rows.append(f"{name[-1]}: {before.mean():.0f} to {', '.join(f'{v:.0f}' for v in after)}")
    verdicts = {"pwm": graded(all(right), any(right))}
    return reproduction.claims(PAPER, verdicts, pwm="; ".join(rows))[0]


def _pairs(off) -> str:
    return "; ".join(", ".join(f"{100 * v:.0f}" for v in row) for row in off)


def _list(values, between: str = " ") -> str:
    return between.join(f"{v:.3f}" for v in values)


def figures(result: Reproduction) -> dict:
    """The paper's figures of losses and channel faults, as matplotlib figures."""
    series, units = result.series, ("p, rad/s²", "q, rad/s²", "r, rad/s²", "down, m/s²")
    long = series["long"]
    time = long["time"][::40]
    losses, grid = panels(2, 2, (8, 5), sharex=True)
    for k, (axes, name) in enumerate(zip(grid.flat, SCENARIOS)):
        for i in range(4):
            axes.plot(time, long[name]["theta"][::40, i], lw=1, label=f"motor {i + 1}")
            axes.plot(time, long[name]["gamma"][::40, i], "k:", lw=0.7)
        axes.set(title=f"scenario {k + 1}", xlabel="time, s" if k > 1 else "", ylabel="loss" if k % 2 == 0 else "")
    losses.axes[0].legend(fontsize="small", loc="upper left")
    channels, grid = panels(4, 4, (9, 7), sharex=True, sharey="row")
    for j, name in enumerate(SCENARIOS):
        for i, axes in enumerate(grid[:, j]):
            axes.plot(time, long[name]["fault"][::40, i], lw=1)
            axes.plot(time, long[name]["true_fault"][::40, i], "k:", lw=0.7)
            axes.set(title=f"scenario {j + 1}" if i == 0 else "", ylabel=units[i] if j == 0 else "")
            axes.set(xlabel="time, s" if i == 3 else "")
    return {
        "intermediate-losses": losses, "intermediate-channels": channels,
        "intermediate-position": _position_figure(series), "intermediate-pwm": _pwm_figure(series),
        "intermediate-bound": _bound_figure(series),
        "intermediate-wrong-models": wrong_models.figure(result.figures["uncertain"]),
    }  # fmt: skip


def tables(figures: Mapping[str, Any]) -> list[Table]:
    """Wrong models, the procedure of table 1, and what xi is made of."""
    return [wrong_models.table(figures["uncertain"]), *printed.tables(figures)]


def _position_figure(series):
    """Figures 3, 7, 11, 15: where the vehicle is, from the printed height."""
    figure, grid = panels(3, len(SCENARIOS), (9, 5.5), sharex=True, sharey="row")
    time = series["long"]["time"][::PICTURE]
    for j, (name, flown) in enumerate(series["position"].items()):
        for i, axis in enumerate("xyz"):
            grid[i, j].plot(time, flown["place"][::PICTURE, i], lw=1)
            grid[i, j].set_ylabel(f"{axis}, m" if j == 0 else "")
        grid[0, j].set_title(f"scenario {name[-1]}")
        grid[2, j].set(xlabel="time, s")
    return figure


def _pwm_figure(series):
    """Figures 4, 8, 12, 16: counts of the motors."""
    figure, grid = panels(2, 2, (8, 5), sharex=True, sharey=True)
    time = series["long"]["time"][::PICTURE]
    for k, (axes, (name, flown)) in enumerate(zip(grid.flat, series["position"].items())):
        for m in range(4):
            axes.plot(time, flown["u"][::PICTURE, m], lw=1, label=f"motor {m + 1}")
        axes.set(
            title=f"scenario {name[-1]}", xlabel="time, s" if k > 1 else "", ylabel="PWM, counts" if k % 2 == 0 else "", ylim=(400, 800)
        )
    figure.axes[0].legend(fontsize="small", loc="upper left")
    return figure


def _bound_figure(series):
    """Size of the errors, and the bound of theorem 1, of three flights."""
    figure, (row,) = panels(1, 3, (9, 3), sharey=True)
    titles = {"scenario_3": "scenario 3", "scenario_4": "scenario 4", "climbing": "climbing at 0.4 Hz"}
    for axes, (name, title) in zip(row, titles.items(), strict=True):
        size, limit = series["bound"][name]
        axes.semilogy(series["time"][::5], np.maximum(size[::5], 1e-6), lw=1, label="error")
        axes.semilogy(series["time"][::5], np.maximum(limit[::5], 1e-6), "k--", lw=1, label="bound")
        axes.set(title=title, xlabel="time, s", ylim=(1e-3, 1e3))
    row[0].set_ylabel("|e|")
    row[0].legend(fontsize="small")
    return figure
