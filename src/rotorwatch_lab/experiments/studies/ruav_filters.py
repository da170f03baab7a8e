"""The filters of the helicopter's study: every one gets the same bounds. Sets are built in four forms, FORMS, and Kalman filters run with
a restart after a measurement they cannot explain and without. The paper's formulas are lost in print: its form is that of the sources it
names, Scholte and Campbell 2003 and Zhou, Han and Liu 2008.

Kalman filters take a third of each bound for a standard deviation and claim three of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.estimators.aekf import AEKF
from rotorwatch_lab.estimators.aesmf import AESMF
from rotorwatch_lab.estimators.aukf import AUKF
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.estimators.esmf import ESMF
from rotorwatch_lab.experiments.studies import ruav_flight
from rotorwatch_lab.experiments.studies.ruav_flight import DT, MEASUREMENT, PROCESS

TOO_WIDE = 3.0  # Q of the filters in true semi-axes
CENTRE, REACH = np.repeat([0.5, 0.0], 4), np.repeat([1.0, 0.5], 4)
START_REACH = np.repeat([0.05, 0.02], 4)
RANGE = (np.repeat([0.0, -0.25], 4), np.repeat([1.0, 0.25], 4))
N_X = 6
LABELS = {"esmf": "ESMF", "aesmf": "GD-ESMF", "aesmf_floor": "GD-ESMF, floor", "aekf": "AEKF", "aukf": "AUKF", "ekf": "EKF, fixed Q"}
SETS, KALMAN = ("esmf", "aesmf"), ("aekf", "aukf")
PRINTED: dict[str, Any] = {"form": "batch", "remainder": "interval"}
FORMS: dict[str, dict[str, Any]] = {
    "printed": PRINTED | {"restart": False},
    "printed_restart": PRINTED,
    "own_no_restart": {"restart": False},
    "own": {},
}
FORM_LABELS = {
    "printed": "as in its sources",
    "printed_restart": "as in its sources, with a restart",
    "own_no_restart": "own form, without a restart",
    "own": "own form",
}


def by_form(texts: Mapping[str, str]) -> str:
    """Results of the forms of the sets in one text; those of the sources' form with and without a restart once where they are equal."""
    labels = dict(FORM_LABELS)
    if texts.get("printed") is not None and texts.get("printed") == texts.get("printed_restart"):
        labels["printed_restart"] = "as in its sources, restart or not"
        texts = {form: text for form, text in texts.items() if form != "printed"}
    return "; ".join(f"{labels[form]} {text}" for form, text in texts.items())


def form_of(literal=()) -> str:
    """The form that these literal readings choose."""
    return {(True, True): "printed", (True, False): "printed_restart", (False, True): "own_no_restart", (False, False): "own"}[
        "printed" in literal, "no_restart" in literal
    ]


def filters(system, literal=(), form: str | None = None) -> dict[str, Any]:
    """Name -> estimator, with the bounds of the experiment. form: of the sets, a name in FORMS; None: as `literal` chooses."""
    bounds: dict[str, Any] = FORMS[form or form_of(literal)] | {
        "process": TOO_WIDE * PROCESS[:6],
        "measurement": MEASUREMENT,
        "theta_drift": TOO_WIDE * PROCESS[6:] / DT,
        "theta_centre": CENTRE,
        "theta_reach": REACH,
        "theta_range": RANGE,
        "remainder_box": "paper" if "box" in literal else "trace",
    }
    rule: dict[str, Any] = {"additive": "additive" in literal}
    return {
        "esmf": ESMF(system, DT, **bounds),
        "aesmf": AESMF(system, DT, **bounds, **rule),
        "aesmf_floor": AESMF(system, DT, **bounds, **rule, floor=1 / TOO_WIDE**2),
        "aekf": kalman(AEKF),
        "aukf": kalman(AUKF),
        "ekf": kalman(EKF),
    }


def kalman(kind: type, wide: float = TOO_WIDE):
    """A Kalman filter of that kind, three deviations of whose process noise are `wide` true semi-axes."""
    plant = ruav_flight.plant()
    plant.process_sd = wide * PROCESS[[0, 3]] / 3
    return kind(plant, DT, theta_walk=(wide * PROCESS[6:] / 3) ** 2 / DT, theta_var=(START_REACH / 3) ** 2)


def is_kalman(estimator) -> bool:
    """True if the estimator has a covariance, False if it has the shape of a set."""
    return isinstance(estimator, EKF | AEKF | AUKF)


def start(estimator):
    """(carry, restarts) of a healthy hover: the coefficients known to START_REACH."""
    from jax import numpy as jnp

    carry = estimator.init()
    if not is_kalman(estimator):
        P = np.diag(np.concatenate([np.repeat([0.03, 0.006], 3), START_REACH]) ** 2)
        carry = carry._replace(z=np.zeros(14), shape=P)
    return carry, jnp.zeros((), jnp.int32)


def step(estimator, state, u, y, restart: Any = True):
    """Advance one filter: ((carry, restarts), z (14,), P (14, 14) whose ellipsoid or three deviations are the bounds).

    restart: whether a Kalman filter starts its coefficients again, as uncertain as the prior, after an innovation outside all that
    three deviations allow. Sets do so by themselves, once they are empty.
    """
    jax = load_jax()
    jnp, lax = jax.numpy, jax.lax
    carry, count = state
    valid = jnp.ones(N_X, bool)
    new, out = estimator.step(carry, u, y, valid)
    if not is_kalman(estimator):
        return (new, new.restarts), new.z, estimator.unfactored(new.shape)

    def again():
        z, P = carry[:2]
        P = jnp.zeros_like(P).at[:N_X, :N_X].set(4 * P[:N_X, :N_X]).at[N_X:, N_X:].set(np.diag((REACH / 3) ** 2))
        return estimator.step(carry._replace(**dict(zip(carry._fields, (z, P), strict=False))), u, y, valid)

    R = estimator.system.R(u)
    g = jnp.maximum(jnp.diagonal(out.innovation_cov) - R, 0.0)
    lost = (jnp.abs(out.innovation) > 3 * (jnp.sqrt(g) + jnp.sqrt(R))).any() & restart
    new, out = lax.cond(lost, again, lambda: (new, out))
    return (new, count + lost), new[0], 9.0 * new[1]
