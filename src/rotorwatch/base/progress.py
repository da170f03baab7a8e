"""Who is told how far a work has come hears of its parts, too."""

from __future__ import annotations

from collections.abc import Callable

READ = 0.25
"""Share of a diagnosis when the log is read."""


def portion(tell: Callable | None, first: float, last: float, text: str = "") -> Callable[[float], None]:
    """What a part of a work is given to tell its own share, 0..1: it takes the whole from `first` to `last`. text: what is done meanwhile.
    tell: is told the share of the whole, and the text where there is one; None: nobody is."""
    if tell is None:
        return lambda share: None
    words = (text,) if text else ()
    return lambda share: tell(first + (last - first) * min(max(float(share), 0.0), 1.0), *words)
