"""Arguments, options, progress and output that all commands share, for those of other packages (entry points `rotorwatch.commands`)."""

from __future__ import annotations

from rotorwatch.commands.tools import (
    FIGURE,
    JSON,
    LOG,
    OUT,
    answer,
    common,
    counting,
    drawable,
    findable,
    flag,
    label,
    live,
    numbers,
    option,
    print_json,
    progress,
    resumable,
    say,
    shares,
    show,
    spread,
    vehicle_of,
    written,
)

__all__ = [
    "FIGURE", "JSON", "LOG", "OUT", "answer", "common", "counting", "drawable", "findable", "flag", "label", "live", "numbers", "option",
    "print_json", "progress", "resumable", "say", "shares", "show", "spread", "vehicle_of", "written",
]  # fmt: skip
