"""ESC evidence on a loss, in the form of the answer: the part of the motor, the part of the propeller, and the cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rotorwatch.answer.wording import CAUSES, rotors
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import LOSS
from rotorwatch.witnesses.esc import ratios

FAULT_AFTER_S = 3.0  # a fault that begins so long after a rotor has stopped is that it stopped


def _named_as_it_stands(claim: Event, known: Event) -> bool:
    return known.means.lasting_fault and claim.rotors[0] in known.suspects and known.onset_s < claim.onset_s + FAULT_AFTER_S


STANDS = Source("esc: stopped", 7, _named_as_it_stands)


def entry(
    rotor: int,
    cause: str,
    causes: Mapping[str, float],
    parts: Mapping[str, Sequence[float]],
    thrust_of_speed: float,
    current_ratio: float | None = None,
    supply_drop_V: float | None = None,
) -> dict:
    """An entry on one rotor in an event's `esc` (docs/json.md). parts: (loss, low, high) of "speed" and "propeller"."""
    fields: dict = {"rotor": rotor, "cause": cause, "causes": dict(causes)}
    for part in ("speed", "propeller"):
        loss, low, high = parts[part]
        fields |= {f"{part}_loss": loss, f"{part}_loss_interval": (low, high)}
    optional = {"thrust_of_speed": thrust_of_speed, "current_ratio": current_ratio, "supply_drop_V": supply_drop_V}
    return fields | optional


def loss(
    rotor: int,
    onset_s: float,
    detected_s: float,
    size: Sequence[float],
    shares: Sequence[float],
    parts: Mapping[str, Sequence[float]],
    sentence: str,
    thrust_of_speed: float,
    current_ratio: float | None = None,
    source: Source = STANDS,
) -> Event:
    """A loss of effectiveness that an ESC alone shows. size: most likely, least and largest loss; shares: probability of each cause, in the
    order of `ratios.PRIOR`; parts: as for `entry`; sentence: the evidence, to follow "says that"."""
    causes = dict(zip(ratios.PRIOR, shares, strict=True))
    cause = max(causes, key=lambda name: causes[name])
    reason = f"the ESC of {rotors([rotor])} shows that {sentence}so the cause is the {CAUSES[cause]}"
    about = entry(rotor, cause, causes, parts, thrust_of_speed, current_ratio)
    extra = {"cause": cause, "causes": causes, "esc": [about]}
    return Event(
        LOSS, (rotor,), onset_s, detected_s, None, (size[0],), ((size[1], size[2]),), causes[cause], (), reason, extra, source,
    )  # fmt: skip
