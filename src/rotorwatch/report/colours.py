"""Colours of rotors, the same in table, top view and plots. Faulty rotors share one that no other has."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rotorwatch.flight.diagnosis import Diagnosis, Event

# Okabe and Ito's palette and neighbours, which colour-blind readers can distinguish: vermilion for faulty rotors, orange for
# suspected ones, the rest for all others. Dashes distinguish rotors of the same colour.
FAULT, SUSPECT = "#d55e00", "#e69f00"
OTHERS = ("#0072b2", "#009e73", "#56b4e9", "#9467bd", "#8c8c8c", "#44727f", "#6aa84f", "#b08fb5")
# For anything but rotors.
PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#8c8c8c", "#9467bd")
DASHES = ("solid", "dashed", "dotted", "dotdash", "dashdot")
MOMENT = "#c2185b"  # the moment marked on the page; no event and no rotor has this colour
INK = "#7a828a"  # legible on white and on black until the page's script has set the theme


def faulty(diagnosis: Diagnosis) -> list[int]:
    """Rotors of the main event where it has no alternatives, and degraded or failed ones."""
    event = None if diagnosis.main is None else diagnosis.events[diagnosis.main]
    named = set(event.rotors) if event is not None and not event.alternatives else set()
    return sorted(named | {r.rotor for r in diagnosis.rotors if r.status in ("degraded", "failed")})


def suspects(diagnosis: Diagnosis) -> list[int]:
    """Suspect rotors that are not among `faulty`."""
    named = faulty(diagnosis)
    return [r.rotor for r in diagnosis.rotors if r.status == "suspect" and r.rotor not in named]


def looks(diagnosis: Diagnosis, count: int = 0) -> dict[int, tuple[str, str]]:
    """(colour, dash) of each rotor, 1-based; count: of rotors at least, where the diagnosis does not list them all."""
    numbers = {*(r.rotor for r in diagnosis.rotors), *range(1, count + 1)}
    return chosen(numbers, faulty(diagnosis), suspects(diagnosis))


def chosen(numbers: Iterable[int], bad: Sequence[int], open_: Sequence[int] = ()) -> dict[int, tuple[str, str]]:
    """(colour, dash) of each rotor, 1-based. bad: faulty rotors; open_: suspect ones."""
    out = {}
    for k in sorted(numbers):
        for group, tint in ((bad, FAULT), (open_, SUSPECT)):
            if k in group:
                out[k] = tint, DASHES[group.index(k) % len(DASHES)]
        if k not in out:
            out[k] = OTHERS[(k - 1) % len(OTHERS)], DASHES[(k - 1) // len(OTHERS) % len(DASHES)]
    return out


def of_event(event: Event) -> str:
    """Colour of an event: faulty, suspect, or neutral."""
    return INK if not event.rotors or not event.means.wrong else SUSPECT if event.alternatives else FAULT
