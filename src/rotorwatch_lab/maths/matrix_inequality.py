"""Linear matrix inequalities are solved by a library (CVXPY with CLARABEL, in the extra `research`); this calls it."""

from __future__ import annotations

import warnings
from typing import Any

from rotorwatch.base import optional


def library() -> Any:
    """CVXPY. Raises ConfigError where it is not installed."""
    return optional.library("cvxpy", "Solving a matrix inequality")


def solved(problem: Any) -> bool:
    """Whether the solver found an answer; how accurate it is the caller judges by eigenvalues. Raises ConfigError without CVXPY."""
    cp = library()
    try:
        with warnings.catch_warnings():  # "may be inaccurate": what comes back is checked by its eigenvalues
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:
        return False
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
