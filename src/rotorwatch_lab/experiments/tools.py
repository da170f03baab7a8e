"""Shared by experiments and campaigns: distribution of parts, shares and rates with 95 % intervals, and tables.

Rates have exact Poisson intervals (Garwood 1936), shares Wilson's (1927), medians and errors those of a seeded bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np

from rotorwatch.base import many
from rotorwatch.base.backend import jax as load_jax

Z = 1.959963984540054
RESAMPLES = 400


def gathered(
    part: Callable[[Any], Iterable[Any]],
    parts: Sequence[Any],
    jobs: int | None,
    progress: Callable[[float, str], Any] | None = None,
    text: str = "",
    scheduler: str | None = None,
    keep: str | PathLike | None = None,
) -> list[Any]:
    """The rows that `part` makes of all parts, in their order. jobs, scheduler, keep: as for `many.ordered`. progress(share, text)."""

    def finished(count: int) -> None:
        if progress:
            progress(count / len(parts), text)

    return [row for rows in many.ordered(part, parts, jobs, scheduler, finished, keep) for row in rows]


def batches(flights: int, cells: int, width: int) -> list[range]:
    """Numbers of the flights of each batch: flight k is of cell k % cells, a batch holds at most `width` flights of one cell."""
    of_cells = (range(cell, flights, cells) for cell in range(cells))
    return [numbers[k : k + width] for numbers in of_cells for k in range(0, len(numbers), width)]


def stepped(estimator: Any, u: Any, y: Any, select: Callable[[Any], Any], valid: Any = None) -> Any:
    """Outputs of each step, reduced by `select`, over rows u (T, n_u), y (T, n_y), valid (T, n_y) (None: all valid). For compiled programs;
    can be mapped over flights or tunings."""
    jax = load_jax()
    valid = jax.numpy.ones(y.shape, bool) if valid is None else valid

    def step(carry, row):
        carry, out = estimator.step(carry, *row)
        return carry, select(out)

    return jax.lax.scan(step, estimator.init(), (u, y, valid))[1]


def losses(out: Any) -> Any:
    """theta (n_theta,) of an estimate. For `stepped`."""
    return out.theta


def rate(count: int, hours: float) -> dict[str, float] | None:
    """Events per hour with its exact Poisson interval."""
    if hours <= 0.0:
        return None
    from scipy.stats import chi2

    low = 0.5 * chi2.ppf(0.025, 2 * count) if count else 0.0
    high = 0.5 * chi2.ppf(0.975, 2 * count + 2)
    return {"value": count / hours, "low": float(low) / hours, "high": float(high) / hours, "n": count}


def share(flags: Sequence[Any] | np.ndarray) -> dict[str, float] | None:
    """Share of true flags, with Wilson's interval."""
    n = len(flags)
    if n == 0:
        return None
    p = float(np.mean(np.asarray(flags).astype(float)))
    middle = (p + Z * Z / (2 * n)) / (1 + Z * Z / n)
    half = Z / (1 + Z * Z / n) * np.sqrt(p * (1 - p) / n + Z * Z / (4 * n * n))
    low, high = max(0.0, float(middle - half)), min(1.0, float(middle + half))
    return {"value": p, "low": min(low, p), "high": max(high, p), "n": n}  # rounding may leave none, or all, outside


def boot(values: Any, statistic: Callable) -> dict[str, float] | None:
    """A statistic of a sample with its bootstrap interval, the same for the same sample."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return None
    rng = np.random.default_rng(values.size)
    again = [statistic(values[rng.integers(values.size, size=values.size)]) for _ in range(RESAMPLES)]
    low, high = np.quantile(again, (0.025, 0.975))
    return {"value": float(statistic(values)), "low": float(low), "high": float(high), "n": int(values.size)}


def interval(value: Mapping[str, float] | None, digits: int | None = None) -> str:
    """A measure with its interval, as text: in percent, or with so many digits."""
    if value is None:
        return "-"
    middle, low, high = (value[k] * (100.0 if digits is None else 1.0) for k in ("value", "low", "high"))
    unit, digits = (" %", 0) if digits is None else ("", digits)
    return f"{middle:.{digits}f}{unit} ({low:.{digits}f} to {high:.{digits}f})"


def table(heads: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """A Markdown table."""
    first, *rest = ("| " + " | ".join(map(str, line)) + " |" for line in (heads, *rows))
    return "\n".join([first, "|" + "---|" * len(heads), *rest])


def latex(heads: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """A LaTeX tabular of texts; code marks of Markdown become typewriter."""

    def cell(value: Any) -> str:
        text = str(value)
        code, text = text.startswith("`"), text.strip("`")
        for sign in "\\&%#_$":
            text = text.replace(sign, "\\textbackslash{}" if sign == "\\" else f"\\{sign}")
        return f"\\texttt{{{text}}}" if code else text

    lines = [" & ".join(map(cell, line)) + " \\\\" for line in (heads, *rows)]
    return "\n".join(
        [f"\\begin{{tabular}}{{l{'r' * (len(heads) - 1)}}}", "\\hline", lines[0], "\\hline", *lines[1:], "\\hline", "\\end{tabular}"]
    )


def side_by_side(title: str, columns: Mapping[str, Any], lines: Mapping[str, Callable[[Any], str]]) -> str:
    """A Markdown table of measures, a column for each of `columns`."""
    return table([title, *columns], ([name, *map(line, columns.values())] for name, line in lines.items())) + "\n"
