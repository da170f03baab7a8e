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
from rotorwatch.flight.kinds import AT_LIMIT, CAPPED, EXHAUSTED, GIVEN_UP, HEAVY, STANDS_APART, UNEVEN, Kind, Weight, Words, register
from rotorwatch.witnesses.witness import Events, Stage, View, Witness, adding


def _setup(number: int, name: str, noun: str, meaning: str, brief: str, advice: str) -> Kind:
    """A kind of finding from outputs on the vehicle's build, load and setup: of no rotor, with its number in its reason."""
    return Kind(number, name, noun, meaning, Weight.NOTICE, brief=brief, headline=Words("{Why}."), advice=Words(advice))


register(
    _setup(
        11,
        AT_LIMIT,
        "outputs at their limit",
        "outputs were at their limit for long",
        "outputs at their limit",
        "Increase the thrust margin: less weight, a fresh battery, less wind, gentler climbs. Where only some motors are at their limit, "
        "look for an off-centre load and twisted mounts.",
    ),
    _setup(
        12,
        HEAVY,
        "low thrust margin",
        "hover takes nearly all of the thrust: too heavy, or a weak battery",
        "low thrust margin",
        "Reduce weight, charge the battery, or fit stronger motors before the next flight: full thrust should be twice the weight.",
    ),
    _setup(
        13,
        UNEVEN,
        "yaw imbalance",
        "rotors of one spin direction work harder since take-off: twisted mounts",
        "yaw imbalance",
        "Align every motor upright and check the arms for twist; then compare propellers and ESC end points of both spin directions.",
    ),
    _setup(
        14,
        STANDS_APART,
        "output offset",
        "an output is offset from what the mixer needs since take-off: ESC end points",
        "output offset",
        "Calibrate the end points of all ESCs alike. If the offset stays, swap this motor's propeller, and then the motor, with another "
        "one's and see whether it moves with them.",
    ),
    _setup(
        15,
        EXHAUSTED,
        "not enough thrust without a rotor",
        "the vehicle sank without a rotor because the others could not carry it",
        "others at their limit",
        "Reduce the weight if this vehicle must stay up without a rotor: `rotorwatch survive` gives the limit.",
    ),
    _setup(
        21,
        GIVEN_UP,
        "output given up",
        "the mixer gave up an output to balance the loss of another rotor",
        "output given up",
        "Nothing is wrong with the output that the mixer gave up: repair the lost rotor.",
    ),
    _setup(
        22,
        CAPPED,
        "outputs capped",
        "outputs stood at one value below their limit for long: a cap",
        "outputs capped",
        "Find the setting that caps the outputs: a maximum of the ESC's or the motor's output, a throttle limit, a limit of current or "
        "battery; the vehicle has no more thrust than that.",
    ),
)


def _flights(view: View) -> tuple[Event, ...]:
    """Damage from take-off, by the healthy flights of this vehicle."""
    stored = (view.vehicle.identified or {}).get("whole_flight")
    if not stored or not view.consistent or not view.hovers:
        return ()
    from rotorwatch.witnesses.healthy import whole_flight

    features = whole_flight.features(view.flight, view.vehicle, view.air)
    baseline = [whole_flight.Features.from_dict(f) for f in stored]
    view.facts["whole_flight"] = found = whole_flight.assess(features, baseline, view.vehicle, view.said(None)).to_dict()
    return from_takeoff.claims(found, from_takeoff.FLIGHTS, view.air)


def _vehicles(view: View) -> tuple[Event, ...]:
    """Damage from take-off, by healthy vehicles of any build."""
    if view.known or not view.consistent or not view.hovers or view.table is None:
        return ()
    from rotorwatch.witnesses.healthy import population

    upset = view.table.time[view.table.upset & (view.table.mode > GROUND)]
    undisturbed_s = min([np.inf, *(e.onset_s for e in view.events), *upset[:1]])  # earlier it was there from take-off
    found = population.assess(view.flight, view.vehicle, view.air, undisturbed_s, view.said(None))
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
