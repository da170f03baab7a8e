"""An estimator's outputs at the ticks of a log."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from rotorwatch.engine.bindings.program import TickOutput, threshold
from rotorwatch.engine.diagnoser import Written
from rotorwatch.engine.motion.tick_table import Ticks
from rotorwatch.flight.method_series import MethodSeries


@dataclass(frozen=True, eq=False, repr=False)
class Estimated:
    """An estimator's outputs `out` at the ticks `table`. default: of the default estimator; written: the engine's records, if it ran
    there. series: of a published method, its own estimate. assumptions: of the method. own_limit: `limit`, None: the default
    estimator's."""

    table: Ticks
    out: TickOutput
    default: bool = True
    written: Written | None = None
    series: MethodSeries | None = None
    assumptions: tuple[str, ...] = ()
    own_limit: float | None = None

    @functools.cached_property
    def limit(self) -> float:
        """Log-likelihood ratio from which a loss is announced."""
        return threshold(self.out.theta.shape[1], self.table.dt) if self.own_limit is None else self.own_limit
