"""Linear matrix inequalities, solved by CVXPY with CLARABEL (extra `research`)."""

from __future__ import annotations

import warnings
from typing import Any

from rotorwatch.base import optional


def library() -> Any:
    """CVXPY. Raises ConfigError where it is not installed."""
    return optional.library("cvxpy", "Solving a matrix inequality")


def solved(problem: Any) -> bool:
    """Solve the problem; True if the solver found an answer. The caller verifies it by eigenvalues. Raises ConfigError without CVXPY."""
    cp = library()
    try:
        with warnings.catch_warnings():  # "may be inaccurate": what comes back is checked by its eigenvalues
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:
        return False
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
