"""The definitions together, ready to run."""

from __future__ import annotations

from rotorwatch.base.compiling.running import Definition
from rotorwatch.base.compiling.shipped import files_in
from rotorwatch.engine.estimator import (
    announcement,
    bank,
    estimator,
    evidence,
    hypotheses,
    kalman,
    known,
    model_error,
    noise,
    opposite,
    plant,
    plausibility,
    posterior,
    sizes,
    whole,
)

PARTS = (
    plant,
    noise,
    model_error,
    kalman,
    bank,
    hypotheses,
    evidence,
    plausibility,
    announcement,
    opposite,
    posterior,
    estimator,
)
NEIGHBOURS = tuple(f"engine/front/{name}.py" for name in ("contact", "losses", "sizes", "ticks", "vehicle"))
ENGINE = Definition("engine", (*PARTS, whole, known), sizes, [*files_in("engine/estimator"), *NEIGHBOURS], vectors=True)
