"""Progress of a part as progress of the whole."""

from __future__ import annotations

from collections.abc import Callable

READ = 0.25
"""Share of a diagnosis when the log is read."""


def portion(tell: Callable | None, first: float, last: float, text: str = "") -> Callable[[float], None]:
    """A callback for a part of the work that reports its own share, 0..1, as `first` to `last` of the whole. tell: receives the share of
    the whole, and the text where there is one; None: no report. text: the current step."""
    if tell is None:
        return lambda share: None
    words = (text,) if text else ()
    return lambda share: tell(first + (last - first) * min(max(float(share), 0.0), 1.0), *words)
