"""The definitions together, ready to run over ticks."""

from __future__ import annotations

import numpy as np

from rotorwatch.compiling.running import Definition, Rows
from rotorwatch.compiling.shipped import files_in
from rotorwatch.engine import (
    announcement,
    bank,
    estimator,
    evidence,
    hypotheses,
    kalman,
    model_error,
    noise,
    opposite,
    plant,
    plausibility,
    posterior,
    sizes,
    whole,
)
from rotorwatch.engine.plant import AIR, CURVE, SHARE, SHARE_SD

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
NEIGHBOURS = tuple(f"front/{name}.py" for name in ("contact", "losses", "sizes", "ticks"))
ENGINE = Definition("engine", (*PARTS, whole), sizes, [*files_in("engine"), *NEIGHBOURS])
PIECE = 256  # ticks in one call


def plant_of(parameters: dict) -> Rows:
    """A Plant of `default.program.parameters`."""
    B = np.asarray(parameters["B"], float)
    n = B.shape[1]
    mean, variance = np.zeros(sizes.X), np.zeros((sizes.X, sizes.X))
    mean[:CURVE], variance[:CURVE, :CURVE] = parameters["x0"], parameters["P0"]
    known = {CURVE: parameters["curve"], AIR: parameters["air"]}
    lower = parameters.get("lower")
    if lower is not None:
        known[SHARE] = parameters.get("share", (0.0, SHARE_SD**2))
    for state, (m, v) in known.items():
        mean[state], variance[state, state] = m, v
    made = ENGINE.new(plant.Plant)
    made.set(
        rotors=n, dt=float(parameters["dt"]), effect=B, mean=mean, variance=variance,
        noise=np.asarray(parameters["noise"], float), noise_weight=float(parameters["noise_weight"]),
        lower=np.zeros(n) if lower is None else np.asarray(lower, float),
    )  # fmt: skip
    return made


class Steps:
    """The estimator of one vehicle, stepped as ticks come."""

    def __init__(self, parameters: dict):
        self.plant, self.now = plant_of(parameters), ENGINE.new(estimator.Estimator)
        self.rotors = np.shape(parameters["B"])[1]
        ENGINE.call(whole.begin, self.plant, self.now)

    def run(self, u: np.ndarray, y: np.ndarray, valid: np.ndarray) -> dict[str, np.ndarray]:
        """Outputs of the rows, by the names of `estimator.Result`."""
        room = ENGINE.array(estimator.Result, PIECE)
        tables = [np.ascontiguousarray(u, float), np.ascontiguousarray(y, float), np.ascontiguousarray(valid, bool)]
        parts = []
        for first in range(0, len(u), PIECE):
            rows = [table[first : first + PIECE] for table in tables]
            ENGINE.call(whole.run, self.plant, self.now, len(rows[0]), *rows, room)
            parts.append(self._cut(room, len(rows[0])))
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _cut(self, room: Rows, count: int) -> dict[str, np.ndarray]:
        n, found = self.rotors, {}
        h = 3 * n + n * (n - 1) // 2 + hypotheses.DISTURBANCE_COUNT
        for name, _ in estimator.Result.declared():
            values = room[name][:count]
            full = {sizes.ROTORS: n, sizes.HYPOTHESES: h}.get(values.shape[-1] if values.ndim > 1 else 0)
            found[name] = values[..., :full].copy()
        return found
