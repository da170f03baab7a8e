"""Set-membership filters against adaptive Kalman filters on a helicopter whose tail is jammed and whose roll loses 60 %.

Every filter gets the same flights (`ruav_flight`) and the same bounds (`ruav_filters`). Sets are run in four forms: as in the paper's
sources, with the restart that the paper does not have, and in this project's own form with it and without; Kalman filters with a restart
and without, and the one with a fixed Q with a Q as large as the noise, too. Each claim about filters is assessed for each of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.compiling.run import stepper
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.experiments.studies import (
    reproduction,
    ruav_filters,
    ruav_flight,
    ruav_flight_test,
    ruav_identification,
    ruav_linearisation,
)
from rotorwatch_lab.experiments.studies.reproduction import Claim, Reproduction, Verdict, graded, panels, silent
from rotorwatch_lab.experiments.studies.ruav_filters import FORM_LABELS, FORMS, KALMAN, LABELS, SETS, TOO_WIDE, filters
from rotorwatch_lab.experiments.studies.ruav_flight import DT, FAULT_S
from rotorwatch_lab.experiments.studies.small_systems import adversarial_escapes, mutation_escapes

PAPER = "aesmf"
TITLE, LITERAL = reproduction.about(PAPER)
SEEDS = 4
NEEDS = ("cvxpy",)
SETTLE_S = 2.0  # statistics start this long after the fault
RESTARTS = {"no_restart": "no restart", "restart": "restart"}
TIMED = ("aekf/no_restart", "aukf/no_restart", "esmf/printed", "aesmf/printed", "esmf/own", "aesmf/own")
ROUNDS, LONG_S = 5, 5.0  # of timing; what takes longer is timed once
KNOWN = float(np.mean(ruav_filters.REACH))  # mean half-width of what is known beforehand: a wider bound tells nothing
NARROWER = 0.99  # by one percent at least
ALIKE = 0.05  # bounds of two filters that differ by less are almost the same


class Run(NamedTuple):
    """A filter, and whether it restarts, for Kalman filters (for sets the form decides)."""

    estimator: Any
    restart: bool = True


def runs(literal: tuple[str, ...] = ()) -> dict[str, Run]:
    """Name of LABELS -> its run in the form that the literal readings choose; filter/form and filter/restart -> all that there are."""
    system, chosen = ruav_flight.plant(stops=False), ruav_filters.form_of(literal)
    again = "no_restart" if "no_restart" in literal else "restart"
    main = filters(system, literal)
    all_runs = {name: Run(estimator, again == "restart") for name, estimator in main.items()}
    for form in FORMS:
        estimators = main if form == chosen else filters(system, literal, form)
        all_runs |= {f"{name}/{form}": Run(estimators[name], again == "restart") for name in SETS}
    all_runs["ekf/true_q"] = Run(ruav_filters.kalman(EKF, 1.0), again == "restart")
    return all_runs | {f"{name}/{how}": Run(main[name], how == "restart") for name in (*KALMAN, "ekf") for how in RESTARTS}


def reproduce(seeds: int = SEEDS, literal: tuple[str, ...] = (), progress=silent) -> Reproduction:
    """All filters over `seeds` flights, the guarantee on small systems, the flight test, and how the model is identified and flown.

    progress: called with the finished share and what comes next.
    """
    checks.between("seeds", seeds, 1, 1000)
    flights = ruav_flight.fly(ruav_flight.plant(), seeds)
    all_runs = runs(literal)
    statistics, programs = {}, {}
    for k, (name, one) in enumerate(all_runs.items()):
        if one not in statistics:
            progress(0.5 * k / len(all_runs), f"simulation of figure 5, {name}")
            programs[one] = _program(one)
            statistics[one] = _assessed(programs[one], flights)
    results = {name: statistics[one][0] for name, one in all_runs.items()}
    series = {name: statistics[one][1] for name, one in all_runs.items()} | {"truth": flights.theta[0]}
    cost = _microseconds({name: programs[all_runs[name]] for name in TIMED}, flights, progress)
    progress(0.52, "worst noise on small systems")
    escapes = adversarial_escapes(seeds=40)  # the same number below, and the programs are the same
    progress(0.58, "wrong filters on small systems")
    figures: dict[str, Any] = {
        key: {name: results[name][key] for name in LABELS} for key in results["esmf"] if key not in ("restarts", "outgrown_s")
    }
    figures |= {
        "restarts_per_flight": {name: results[name]["restarts"] for name in LABELS},
        "forms": {form: {name: results[f"{name}/{form}"] for name in SETS} for form in FORMS},
        "kalman": {how: {name: results[f"{name}/{how}"] for name in (*KALMAN, "ekf")} for how in RESTARTS},
        "ekf_true_q": results["ekf/true_q"],
        "microseconds_per_step": cost,
        "adversarial_escapes": escapes,
        "mutation_escapes": mutation_escapes(seeds=40),
    }
    claims, forms = _claims(figures)
    figures["flight_test"], flown = ruav_flight_test.flight_test(literal, lambda share, text: progress(0.6 + 0.35 * share, text))
    progress(0.95, "identification")
    identified = ruav_identification.identify()
    figures["identification"] = ruav_identification.numbers(identified)
    progress(0.97, "feedback linearisation")
    figures["feedback_linearisation"] = ruav_linearisation.numbers(ruav_linearisation.flight())
    flight_claims, flight_forms = ruav_flight_test.claims(figures["flight_test"], ruav_filters.form_of(literal))
    claims += flight_claims + ruav_identification.claims(figures["identification"])
    claims += ruav_linearisation.claims(figures["feedback_linearisation"])
    series |= flown | {"identified": identified}
    return Reproduction(PAPER, TITLE, claims, figures, literal, seeds, series, _named(forms | flight_forms))


class _Filter(NamedTuple):
    """A run in steps: its output is (z, P, restarts, q)."""

    run: Run

    def init(self):
        return ruav_filters.start(self.run.estimator)

    def step(self, state, u, y, valid):
        filter_, restart = self.run
        state, z, P = ruav_filters.step(filter_, state, u, y, restart)
        q = load_jax().numpy.ones(()) if ruav_filters.is_kalman(filter_) else state[0].q
        return state, (z, P, state[1], q)


def _program(run: Run) -> Callable:
    """Compiled (u (N, T, 6), y (N, T, 6)) -> [(z, P, restarts, q) of all steps] of each flight."""
    one = _Filter(run)
    start, over = one.init(), stepper(lambda _: one)
    return lambda u, y: [over((), start, *row)[1] for row in zip(u, y, strict=True)]


def _assessed(program: Callable, flights) -> tuple[dict, dict]:
    """Statistics of one filter over all flights, and one flight's bounds for the picture. restarts: also how often a set that does not
    start again was empty; outgrown_s: when, without any fault, the bounds are first wider than what is KNOWN."""
    z, P, count, q = (np.stack(part) for part in zip(*program(flights.u, flights.y), strict=True))
    fault, late, last = (round(s / DT) for s in (FAULT_S, FAULT_S + SETTLE_S, ruav_flight.SECONDS - 5.0))
    truth = np.concatenate([flights.x, flights.theta], axis=-1)
    half = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    inside = (np.abs(z - truth) <= half)[:, late:, 6:].mean(axis=(1, 2))
    scaled = P / half[..., :, None] / half[..., None, :]
    d = ((z - truth) / half)[..., None]
    form = np.einsum("stij,stij->st", d, np.linalg.solve(scaled, d))
    outgrown = np.flatnonzero((half[:, :fault, 6:].mean(axis=-1) > KNOWN).any(axis=0))
    return {
        "containment": float(inside.mean()),
        "containment_worst_seed": float(inside.min()),
        "ellipsoid": float((form <= 1)[:, late:].mean()),
        "ellipsoid_healthy": float((form <= 1)[:, fault // 2 : fault].mean()),
        "error": float(np.sqrt(((z - truth)[:, late:, 6:] ** 2).mean())),
        "off_centre": float(np.abs(d)[:, late:, 6:].mean()),
        "least_q": float(np.min(q)),
        "half_width": float(half[:, late:, 6:].mean()),
        "half_width_last_5s": float(half[:, last:, 6:].mean()),
        "half_width_healthy": float(half[:, fault // 2 : fault, 6:].mean()),
        "outgrown_s": DT * int(outgrown[0]) if len(outgrown) else np.inf,
        "restarts": float(count[:, -1].mean()),
    }, {"theta": z[0, :, 6:], "half": half[0, :, 6:]}


def _microseconds(programs: dict[str, Callable], flights, progress) -> dict[str, float]:
    """Computing time of one step, best of ROUNDS, the filters in turn. Not time on the clock: a computer has other things to do as well."""
    best = dict.fromkeys(programs, np.inf)
    for k in range(ROUNDS):
        for name, program in programs.items():
            if k and best[name] > LONG_S:
                continue
            progress(0.5 + 0.02 * k / ROUNDS, f"cost, {name}")
            began = time.process_time()
            load_jax().block_until_ready(program(flights.u, flights.y))
            best[name] = min(best[name], time.process_time() - began)
    return {name: 1e6 * seconds / flights.u[..., 0].size for name, seconds in best.items()}


def _claims(f) -> tuple[tuple[Claim, ...], dict[str, dict[str, Verdict]]]:
    """The claims on the simulation, and the verdicts on them by form of the sets, or by Kalman filter."""
    forms, bound = f["forms"], 1 / TOO_WIDE**2
    safe, cost = f["adversarial_escapes"] == 0, f["microseconds_per_step"]

    def sets(verdict: Callable[[dict, dict, str], Verdict]) -> dict[str, Verdict]:
        return {FORM_LABELS[form]: verdict(both["esmf"], both["aesmf"], form) for form, both in forms.items()}

    def reported(text: Callable[[dict, dict], str]) -> str:
        return ruav_filters.by_form({form: text(both["esmf"], both["aesmf"]) for form, both in forms.items()})

    kalman = {f"{name.upper()}, {label}": f["kalman"][how][name]["containment"] for name in KALMAN for how, label in RESTARTS.items()}
    timed = {label: how for label, how in ((FORM_LABELS["printed"], "printed"), (FORM_LABELS["own"], "own"))}
    cheapest = max(cost[f"{name}/no_restart"] for name in KALMAN)
    by_form = {
        "cover": sets(lambda e, g, _: graded(_covers(e) and _covers(g) and _tells(e) and _tells(g), _covers(e) and _covers(g))),
        "tightest": sets(lambda e, g, _: _tightest(e, g)),
        "kalman": {label: graded(inside < 0.95) for label, inside in kalman.items()},
        "stable": sets(
            lambda e, g, _: graded(
                safe and g["half_width_healthy"] < KNOWN and g["least_q"] >= bound, safe and g["half_width_healthy"] < KNOWN
            )
        ),
        "accuracy": sets(lambda e, g, _: graded(_tells(e) and _tells(g) and g["error"] < NARROWER * e["error"])),
        "centre": sets(lambda e, g, _: graded(e["off_centre"] > 1.5 * g["off_centre"])),
        "cheapest": {label: graded(cheapest < min(cost[f"{name}/{form}"] for name in SETS)) for label, form in timed.items()},
        "best_cost": {label: "refuted" if cost[f"aesmf/{form}"] > cheapest else graded(True) for label, form in timed.items()},
    }
    widths = {label: [f["kalman"][how][name]["half_width"] for name in KALMAN] for how, label in RESTARTS.items()}
    apart = {label: aukf / aekf - 1.0 for label, (aekf, aukf) in widths.items()}
    by_form["alike"] = {label: graded(abs(share) < ALIKE) for label, share in apart.items()}
    verdicts = {name: reproduction.across(one) for name, one in by_form.items()}
    aukf = cost["aukf/no_restart"] / cost["aekf/no_restart"]
    verdicts["costly_aukf"] = graded(aukf > 2.0, aukf > 1.0)
    words = {
        "cover": reported(lambda e, g: f"{e['containment']:.3f} and {g['containment']:.3f}, half-widths {_size(e)} and {_size(g)}"),
        "tightest": reported(lambda e, g: f"healthy {_size(e, '_healthy')} -> {_size(g, '_healthy')}, after it {_size(e)} -> {_size(g)}"),
        "kalman": "; ".join(f"{label} {inside:.2f}" for label, inside in kalman.items()),
        "stable": reported(
            lambda e, g: f"{g['least_q']:.3f}, {g['ellipsoid_healthy']:.2f} and {g['ellipsoid']:.2f}, empty {g['restarts']:.2g} times"
        ),
        "accuracy": reported(lambda e, g: f"{e['error']:.3f} and {g['error']:.3f}" if _tells(e) and _tells(g) else "wider than the prior"),
        "alike": "; ".join(f"{label} {round(100 * share, 1) + 0.0:+.1f} %" for label, share in apart.items()),
        "centre": reported(lambda e, g: f"{e['off_centre']:.2f} and {g['off_centre']:.2f}"),
        "ratios": {name: value / cost["aekf/no_restart"] for name, value in cost.items()},
    }
    return reproduction.claims(PAPER, verdicts, f=f, bound=bound, reported=words, known=KNOWN), by_form


def _covers(one: dict) -> bool:
    return one["containment_worst_seed"] == 1.0


def _tells(one: dict) -> bool:
    return one["half_width"] < KNOWN


def _tightest(esmf: dict, gd: dict) -> Verdict:
    """True if GD-ESMF covers the truth and its bounds are narrower than ESMF's, before the fault and after it."""
    sharper = gd["half_width_healthy"] < NARROWER * esmf["half_width_healthy"]
    after = gd["half_width"] < NARROWER * esmf["half_width"]
    return graded(_covers(gd) and sharper and after, _covers(gd) and (sharper or after))


def _size(one: dict, when: str = "") -> str:
    return f"{one[f'half_width{when}']:.2g}"


def _named(forms: dict) -> dict:
    """The verdicts by the words of their claims."""
    return {reproduction.claimed_as(PAPER, name): verdicts for name, verdicts in forms.items()}


def figures(result: Reproduction) -> dict:
    """The paper's figures 3, 5 and 7 to 9; figure 5 also with the sets of its sources."""
    chosen = {"esmf": "C0", "aesmf": "C2", "aukf": "C4", "aekf": "C3", "ekf": "C1"}
    printed = {"esmf/printed": "C0", "aesmf/printed": "C2", "aukf/no_restart": "C4", "aekf/no_restart": "C3"}
    return {
        "aesmf-bounds": _bounds(result.series, chosen),
        "aesmf-bounds-printed": _bounds(result.series, printed, wide=True),
        "aesmf-model": ruav_identification.figure(result.series["identified"]),
        **ruav_flight_test.figures(result.series["flight_test"]),
    }


def _bounds(series, colours: dict[str, str], wide: bool = False) -> Any:
    """Bounds of the coefficients of roll and tail by these runs, in their colours. wide: beyond 1 the scale is logarithmic."""

    def coefficient(theta, i):
        return 1.0 - theta if i < 4 else theta

    figure, axes = panels(2, 2, (9, 6), sharex=True)
    truth = series["truth"][::5]
    seconds = DT * np.arange(0, len(series["truth"]), 5)
    titles = {1: "tail: gamma", 3: "roll: gamma", 5: "tail: delta", 7: "roll: delta"}
    for axis, (i, title) in zip(axes.flat, titles.items(), strict=True):
        for name, colour in colours.items():
            one, (filter_, _, form) = series[name], name.partition("/")
            label = ", ".join([LABELS[filter_], *([(FORM_LABELS | RESTARTS)[form]] if form else [])])
            ruav_flight_test.edges(axis, seconds, coefficient(one["theta"][::5, i], i), one["half"][::5, i], colour, label)
        axis.plot(seconds, coefficient(truth[:, i], i), "k--", lw=1.2, label="truth")
        axis.set(title=title, ylim=(-1.2, 2.2) if i < 4 else (-1.0, 1.0))
        if wide:
            axis.set_yscale("symlog", linthresh=1.0)
            axis.set_ylim(-300, 300)
    axes[0, 0].legend(fontsize="small")
    for axis in axes[1]:
        axis.set_xlabel("s")
    return figure
