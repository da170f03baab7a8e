"""Change of the thrust command that all rotors share."""

from __future__ import annotations

from rotorwatch.answer.wording import percent
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import plain

name, title, order = "all_rotors", "All rotors together", 300
views, post_order = ("page", "terminal", "post"), 70
SMALL_SHIFT = 0.02
VARIED = 0.2  # share of the thrust beyond which the comparison says nothing


def data(diagnosis: Diagnosis) -> str | None:
    return sentence(diagnosis) or None


def words(data: str) -> list[str]:
    return [data]


def sentence(diagnosis: Diagnosis) -> str:
    """The shared change in thrust command; empty where it was not assessed."""
    facts = diagnosis.common_mode
    shift = facts.get("thrust_shift")
    if shift is None:
        return plain(facts) if facts else ""
    count = max(1, len(diagnosis.rotors))
    share, low, high = (float(x) / count for x in (shift, *facts.get("interval", (shift, shift))))
    within = max(abs(low), abs(high))
    if low <= 0.0 <= high or within < SMALL_SHIFT:
        if within > VARIED:
            return "The total thrust varied too much in this flight to compare its end with its beginning."
        same = "The total commanded thrust was the same at the end as at the beginning"
        return f"{same}, within {percent(max(within, SMALL_SHIFT))}."
    more, why = "less", "a lighter vehicle, denser air or a fresher battery"
    if share > 0:
        more, why = "more", "a weaker battery, more weight, thinner air, or a loss common to all rotors"
    return (
        f"For the same motion {percent(abs(share))} {more} total thrust was commanded at the end than at the beginning "
        f"(95 % interval {percent(min(abs(low), abs(high)))} to {percent(within)}): {why}. This is not a fault of a single rotor."
    )
