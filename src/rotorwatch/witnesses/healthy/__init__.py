"""Comparison with healthy flights.

baselines.py      checks healthy flights before they are used, also against the flight that they are compared with
whole_flight.py   damage present at take-off, by comparison with healthy flights of the build
population.py     damage present at take-off, by comparison with healthy vehicles of any build
outputs.py        outputs near their limits, and rotors with unequal load, by comparison with healthy vehicles
learned.py        trim, noise and gains of a vehicle for the default method
"""

import numpy as np

from rotorwatch.answer import from_takeoff, ledger
from rotorwatch.engine.motion.tick_table import GROUND
from rotorwatch.flight.diagnosis import Event
from rotorwatch.witnesses.witness import Events, Stage, View, Witness, adding


def _flights(view: View) -> tuple[Event, ...]:
    """Damage from take-off, by the healthy flights of this vehicle."""
    stored = (view.vehicle.identified or {}).get("whole_flight")
    if not stored or not view.consistent or not view.hovers:
        return ()
    from rotorwatch.witnesses.healthy import whole_flight

    features = whole_flight.features(view.flight, view.vehicle, view.air)
    baseline = [whole_flight.Features.from_dict(f) for f in stored]
    view.facts["whole_flight"] = found = whole_flight.judge(features, baseline, view.vehicle).to_dict()
    return from_takeoff.claims(found, from_takeoff.FLIGHTS, view.air)


def _vehicles(view: View) -> tuple[Event, ...]:
    """Damage from take-off, by healthy vehicles of any build."""
    if view.known or not view.consistent or not view.hovers or view.table is None:
        return ()
    from rotorwatch.witnesses.healthy import population

    upset = view.table.time[view.table.upset & (view.table.mode > GROUND)]
    undisturbed_s = min([np.inf, *(e.onset_s for e in view.events), *upset[:1]])  # earlier it was there from take-off
    found = population.judge(view.flight, view.vehicle, view.air, undisturbed_s)
    return from_takeoff.claims(found, from_takeoff.VEHICLES, view.air)


def _outputs(view: View, events: Events) -> Events:
    """Notices on how the vehicle is built, loaded and set up."""
    from rotorwatch.witnesses.healthy import outputs

    if view.table is None or not view.hovers:
        return events
    until = ledger.undisturbed(events, view.open)
    return ledger.joined(events, outputs.claims(view.flight, view.vehicle, view.table, view.air, until, events))


WITNESSES = (
    Witness("healthy flights", Stage.OPEN, 10, adding(_flights)),
    Witness("healthy vehicles", Stage.OPEN, 20, adding(_vehicles)),
    Witness("outputs", Stage.SETUP, 10, _outputs, needs=("motors",)),
)
