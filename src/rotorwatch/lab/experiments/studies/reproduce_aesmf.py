"""Set-membership filters against adaptive Kalman filters on a helicopter whose tail is jammed and whose roll loses 60 %.

Every filter gets the same flights (`ruav_flight`), the same bounds and the same restart (`ruav_filters`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.lab.experiments.studies import (
    reproduction,
    ruav_filters,
    ruav_flight,
    ruav_flight_test,
    ruav_identification,
    ruav_linearisation,
)
from rotorwatch.lab.experiments.studies.reproduction import Claim, Reproduction, graded, panels, silent
from rotorwatch.lab.experiments.studies.ruav_filters import TOO_WIDE, filters
from rotorwatch.lab.experiments.studies.ruav_flight import DT, FAULT_S
from rotorwatch.lab.experiments.studies.small_systems import adversarial_escapes, mutation_escapes

PAPER = "aesmf"
TITLE, LITERAL = reproduction.about(PAPER)
SEEDS = 4
NEEDS = ("cvxpy",)
SETTLE_S = 2.0  # statistics start this long after the fault
LABELS = {
    "esmf": "ESMF",
    "aesmf": "GD-ESMF",
    "aesmf_floor": "GD-ESMF, floor",
    "aekf": "AEKF",
    "aukf": "AUKF",
    "ekf": "EKF, fixed Q",
}


def reproduce(seeds: int = SEEDS, literal: tuple[str, ...] = (), progress=silent) -> Reproduction:
    """All filters over `seeds` flights, the guarantee on small systems, the flight test, and how the model is identified and flown.

    progress: called with the finished share.
    """
    checks.between("seeds", seeds, 1, 1000)
    system = ruav_flight.plant()
    flights = ruav_flight.fly(system, seeds)
    made, results, series = filters(ruav_flight.plant(stops=False), literal), {}, {}
    for k, (name, estimator) in enumerate(made.items()):
        progress(k / (len(made) + 4))
        results[name], series[name] = _judged(estimator, flights)
    escapes = adversarial_escapes(seeds=40)  # the same number below, and the programs are the same
    progress((len(made) + 1) / (len(made) + 4))
    mutants = mutation_escapes(seeds=40)
    keys = tuple(key for key in results["esmf"] if key != "restarts")
    figures: dict[str, Any] = {key: {name: results[name][key] for name in made} for key in keys}
    figures["restarts_per_flight"] = {name: results[name]["restarts"] for name in made}
    figures |= {"adversarial_escapes": escapes, "mutation_escapes": mutants}
    series["truth"] = flights.theta[0]
    claims = _claims(figures)
    figures["flight_test"], flown = ruav_flight_test.flight_test()
    figures["identification"] = ruav_identification.numbers(ruav_identification.identify())
    figures["feedback_linearisation"] = ruav_linearisation.numbers(ruav_linearisation.flight())
    claims += ruav_flight_test.claims(figures["flight_test"]) + ruav_identification.claims(figures["identification"])
    claims += ruav_linearisation.claims(figures["feedback_linearisation"])
    return Reproduction(PAPER, TITLE, claims, figures, literal, seeds, series | flown)


def _judged(estimator, flights) -> tuple[dict, dict]:
    """Statistics of one filter over all flights, and one flight's bounds for the picture."""
    jax = load_jax()
    start = ruav_filters.start(estimator)

    def step(state, row):
        state, z, P = ruav_filters.step(estimator, state, *row)
        q = jax.numpy.ones(()) if ruav_filters.is_kalman(estimator) else state[0].q
        return state, (z, P, state[1], q)

    def over(u, y):
        return jax.lax.scan(step, start, (u, y))[1]

    z, P, count, q = (
        np.asarray(part)
        for part in jax.jit(lambda *table: jax.lax.map(lambda one: over(*one), table))(flights.u, flights.y)
    )
    fault, late, last = (round(s / DT) for s in (FAULT_S, FAULT_S + SETTLE_S, ruav_flight.SECONDS - 5.0))
    truth = np.concatenate([flights.x, flights.theta], axis=-1)
    half = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    inside = (np.abs(z - truth) <= half)[:, late:, 6:].mean(axis=(1, 2))
    scaled = P / half[..., :, None] / half[..., None, :]
    d = ((z - truth) / half)[..., None]
    form = np.einsum("stij,stij->st", d, np.linalg.solve(scaled, d))
    return {
        "containment": float(inside.mean()),
        "containment_worst_seed": float(inside.min()),
        "ellipsoid": float((form <= 1)[:, late:].mean()),
        "ellipsoid_healthy": float((form <= 1)[:, fault // 2 : fault].mean()),
        "off_centre": float(np.abs(d)[:, late:, 6:].mean()),
        "least_q": float(np.min(q)),
        "half_width": float(half[:, late:, 6:].mean()),
        "half_width_last_5s": float(half[:, last:, 6:].mean()),
        "half_width_healthy": float(half[:, fault // 2 : fault, 6:].mean()),
        "restarts": float(count[:, -1].mean()),
    }, {"theta": z[0, :, 6:], "half": half[0, :, 6:]}


def _claims(f) -> tuple[Claim, ...]:
    inside, wide, healthy, least, off = (
        f[key] for key in ("containment", "half_width", "half_width_healthy", "least_q", "off_centre")
    )
    covered = min(f["containment_worst_seed"][name] for name in ("esmf", "aesmf", "aesmf_floor")) == 1.0
    sharper, after = healthy["aesmf"] < healthy["esmf"], wide["aesmf"] < wide["esmf"]
    safe, bound = f["adversarial_escapes"] == 0, 1 / TOO_WIDE**2
    verdicts = {
        "cover": graded(covered, True),
        "tightest": graded(sharper and after, sharper or after),
        "kalman": graded(max(inside["aekf"], inside["aukf"]) < 0.95),
        "stable": graded(safe and least["aesmf"] >= bound, safe),
        "centre": graded(off["esmf"] > 1.5 * off["aesmf"]),
    }
    return reproduction.claims(PAPER, verdicts, f=f, bound=bound)


def figures(result: Reproduction) -> dict:
    """The paper's figure of bounds, for the coefficients of roll and tail."""
    figure, axes = panels(2, 2, (9, 6), sharex=True)
    truth = result.series["truth"][::5]
    time = DT * np.arange(0, len(result.series["truth"]), 5)
    titles = {1: "tail: loss", 3: "roll: loss", 5: "tail: displacement", 7: "roll: displacement"}
    for axis, (i, title) in zip(axes.flat, titles.items(), strict=True):
        for name, colour in (("esmf", "C0"), ("aesmf", "C2"), ("aekf", "C3"), ("ekf", "C1")):
            one = result.series[name]
            ruav_flight_test.edges(axis, time, one["theta"][::5, i], one["half"][::5, i], colour, LABELS[name])
        axis.plot(time, truth[:, i], "k--", lw=1.2, label="truth")
        axis.set(title=title, ylim=(-1.2, 2.2) if i < 4 else (-1.0, 1.0))
    axes[0, 0].legend(fontsize="small")
    for axis in axes[1]:
        axis.set_xlabel("s")
    return {"aesmf-bounds": figure, **ruav_flight_test.figures(result.series["flight_test"])}
