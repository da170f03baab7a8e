"""Data of a build from its healthy flights, as its description carries them: the hover of each, and the default estimator's parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rotorwatch.engine.bindings.learning import learn
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.aerobatic import assess as aerobatic
from rotorwatch.witnesses.healthy import whole_flight

if TYPE_CHECKING:
    from rotorwatch.witnesses.healthy.baselines import Candidate


def learned(kept: Sequence[Candidate], dynamics: Callable | None = None) -> Vehicle:
    """The vehicle of flights that `baselines.healthy` has accepted; as `calibrate` returns it."""
    reference = kept[0].vehicle
    identified = _identified(kept)
    dynamics_ = (dynamics or learn)([each.table for each in kept if each.table is not None], reference.effectiveness())
    if dynamics_:
        identified["dynamics"] = dict(dynamics_)
    names = ", ".join(each.name for each in kept)
    source = f"{reference.source}; calibrated on {names}" if reference.source else f"calibrated on {names}"
    assumptions = (*reference.assumptions, *_assumptions(kept))
    return replace(reference, identified=identified, source=source, assumptions=tuple(dict.fromkeys(assumptions)))


def _identified(kept: Sequence[Candidate]) -> dict:
    """Everything but the dynamics; plain floats and lists."""
    tables = [each.features for each in kept]
    identified: dict = {
        "flights": len(kept),
        "airborne_s": float(sum(end - start for each in kept for start, end in each.air)),
        "steady_s": float(sum(t.seconds for t in tables)),
    }
    usable = [t for t in tables if t.usable]
    if usable:
        share = np.average([t.share for t in usable], axis=0, weights=[t.seconds for t in usable])
        identified["hover"] = float(share.mean())
        identified["thrust_offset"] = [float(v) for v in share / share.mean() - 1.0]
    from rotorwatch.witnesses.balance import imbalances  # what few logs need

    heard = [(each.name, imbalances.listen(each.flight, len(each.vehicle.rotors), each.air)) for each in kept]
    if rows := [imbalances.stored(name, found) for name, found in heard if found is not None]:
        identified["imbalance"] = rows
    identified["whole_flight"] = [t.to_dict() for t in tables]
    return identified


def _assumptions(kept: Sequence[Candidate]) -> list[str]:
    """Sentences on the assumptions of a calibration."""
    count, tables = len(kept), [each.features for each in kept]
    which = f"The {count} calibration flights were" if count > 1 else "The calibration flight was"
    sentences = [
        f"{which} healthy and of the same build, payload and battery type.",
        "The hover command is the mean of these flights, at their battery voltages.",
    ]
    sentences += [f"{each.name} does not hover: only its airframe is used." for each in kept if aerobatic.applies(each.flight, each.table)]
    short = (t.name or "A calibration flight" for t in tables if not t.usable)
    sentences += [f"{name} has too little steady hover for a comparison." for name in short]
    if sum(t.usable for t in tables) < whole_flight.MANY_FLIGHTS:
        sentences.append(
            "With few calibration flights the spread between healthy flights is mostly assumed: "
            f"{100 * whole_flight.CENTRE_SD:.1f} % of an arm length for the centre of mass, "
            f"{100 * whole_flight.THRUST_SD:.0f} % for the thrust that all rotors need together."
        )
    return sentences
