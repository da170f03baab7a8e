"""Outputs that deviate from the mixer, as the engine has recorded them (engine/intake/deviations.py), in words.

Loss of effectiveness never shows here: only commands are compared.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from rotorwatch.base.compiling.running import Rows
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.events import calls
from rotorwatch.engine.intake import deviations
from rotorwatch.engine.intake.airborne import CONFIRM_S
from rotorwatch.engine.intake.sizes import OVERRIDES
from rotorwatch.engine.motion.allocation import Spans

KINDS = {deviations.STUCK: "stuck", deviations.OFF: "off", deviations.OVERRIDDEN: "overridden"}


class Override(NamedTuple):
    """An output that no longer follows the mixer.

    rotor: 1-based. kind: stuck, off or overridden. Times in s, end None while in progress. reason: one sentence. demanded: share of full
    thrust that the mixer demanded when it was noticed; None if not logged. shared: another output left the mixer and returned at the same
    samples, so that the log is wrong, not a rotor.
    """

    rotor: int
    kind: str
    onset: float
    detected: float
    end: float | None
    reason: str
    demanded: float | None = None
    shared: bool = False


def in_flight(found: Iterable[Override], spans: Spans) -> list[Override]:
    """Overrides noticed in flight, each ended with its flight at the latest."""
    inside = []
    for one in found:
        for start, end in spans:
            if start <= one.onset < end and one.detected <= end + CONFIRM_S:
                inside.append(one if (one.end or np.inf) <= end else one._replace(end=end))
    return inside


def found(state: Rows, craft: Rows) -> tuple[Override, ...]:
    """All overrides so far; the end of one in progress is None."""
    rows = ENGINE.array(deviations.Override, OVERRIDES)
    return in_words(rows.cut(ENGINE.call(calls.overrides, state, craft, rows)))


def in_words(rows: Rows) -> tuple[Override, ...]:
    """Overrides in readable form."""
    names = ("rotor", "kind", "onset", "detected", "end", "output", "demanded", "got", "shared")
    return tuple(_in_words(*values) for values in zip(*(rows[name].tolist() for name in names)))


def _in_words(
    rotor: int, number: int, onset: float, detected: float, end: float, output: float, demanded: float, got: float,
    shared: bool,
) -> Override:  # fmt: skip
    kind, named = KINDS[number], f"output {rotor + 1}"
    if demanded >= 0.0:
        reason = f"{named} was at {output:.4g} while the mixer asked for {demanded:.0%} of full thrust and got {got:.0%}"
    else:
        reason = f"{named} {'did not move' if kind == 'stuck' else 'was off'} at {output:.4g} while the others kept working"
    known_demand = demanded if demanded >= 0.0 else None
    return Override(rotor + 1, kind, onset, detected, None if end >= LASTS else end, reason, known_demand, shared)
