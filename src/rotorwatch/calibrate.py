"""What healthy means for one build: learned from its healthy flights, kept in the vehicle's description."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike

import numpy as np

from rotorwatch import airframes, logs, ticks, whole_flight
from rotorwatch.airborne import airborne
from rotorwatch.allocation import rotor_thrusts
from rotorwatch.default_estimator import learn
from rotorwatch.errors import ConfigError, VehicleError
from rotorwatch.flight import Flight
from rotorwatch.vehicle import Vehicle

READY_S = 3.0  # after lift-off, before the dynamics of a flight are learned from


def calibrate(
    flights: Sequence[Flight | str | PathLike],
    progress: Callable | None = None,
    dynamics: Callable | None = None,
    vehicle: Vehicle | None = None,
) -> Vehicle:
    """The flights' airframe with what was learned from them in ``identified``:

    flights, airborne_s, steady_s   how much was learned from
    hover                           mean share of full thrust of a rotor in steady hover
    thrust_offset (n)               how much more (+) than that mean each rotor needs, relative: trim of this build
    whole_flight                    a table for each flight: whole_flight.Features.from_dict reads them
    dynamics                        motion gains and noise (default_estimator.learn), when the flights show enough

    flights: at least one healthy flight of one build, or their log files. progress: called with the finished share.
    dynamics: called as dynamics(list of ticks.Ticks, B) -> mapping of floats and lists, in place of learn. vehicle: the airframe, for logs
    that do not name theirs. Raises ConfigError without a flight, VehicleError when the flights are not of one airframe
    or never flew, LogError for an unreadable file.
    """
    flown: list[tuple[Flight, tuple]] = []
    tables: list[whole_flight.Features] = []
    reference: Vehicle | None = None
    for k, given in enumerate(flights):
        flight = given if isinstance(given, Flight) else logs.read(given)
        own = vehicle or airframes.identify(flight)
        airframes.check(own, flight)
        reference = reference or own
        if flown:
            _agree(own, reference, flight, flown[0][0])
        air = airborne(flight) if flight.has("motors") else ()
        if not air:
            raise VehicleError(
                f"{_name(flight)} shows no flight: nothing healthy can be learned from it; leave it out."
            )
        # Each flight's own curve: limits and compensation may have been set anew in between.
        tables.append(whole_flight.features(flight, own, air))
        flown.append((flight, air))
        if progress:
            progress((k + 1) / len(flights) * 0.5)
    if reference is None:
        raise ConfigError("Calibration needs at least one healthy flight.")
    identified = _identified(flown, tables)
    B = reference.effectiveness()
    rows = [ticks.make(f, rotor_thrusts(f, reference), B, air, READY_S) for f, air in flown if f.has("motors")]
    learned = (dynamics or learn)(rows, B) if rows else None
    if learned:
        identified["dynamics"] = dict(learned)
    if progress:
        progress(1.0)
    names = ", ".join(_name(flight) for flight, _ in flown)
    source = f"{reference.source}; calibrated on {names}" if reference.source else f"calibrated on {names}"
    assumptions = (*reference.assumptions, *_assumptions(flown, tables, identified))
    return replace(reference, identified=identified, source=source, assumptions=tuple(dict.fromkeys(assumptions)))


def _identified(flown, tables) -> dict:
    """Everything but the dynamics; plain floats and lists."""
    found: dict = {
        "flights": len(flown),
        "airborne_s": float(sum(end - start for _, air in flown for start, end in air)),
        "steady_s": float(sum(t.seconds for t in tables)),
    }
    usable = [t for t in tables if t.usable]
    if usable:
        share = np.average([t.share for t in usable], axis=0, weights=[t.seconds for t in usable])
        found["hover"] = float(share.mean())
        found["thrust_offset"] = [float(v) for v in share / share.mean() - 1.0]
    found["whole_flight"] = [t.to_dict() for t in tables]
    return found


def _agree(own: Vehicle, reference: Vehicle, flight: Flight, first: Flight) -> None:
    """Raise VehicleError unless both flights are of the same geometry."""
    same = len(own.rotors) == len(reference.rotors) and np.allclose(
        own.effectiveness(), reference.effectiveness(), atol=0.01
    )
    if not same or own.name != reference.name:
        raise VehicleError(
            f"{_name(flight)} is a {own.name} with {len(own.rotors)} rotors, {_name(first)} a {reference.name} with "
            f"{len(reference.rotors)}: calibrate on flights of one build only."
        )


def _assumptions(flown, tables, identified) -> list[str]:
    """Sentences on what calibration takes for granted."""
    count = len(flown)
    said = [
        f"The {count} calibration flights were healthy and of the same build, payload and battery type."
        if count > 1
        else "The calibration flight was healthy and of the same build, payload and battery type.",
        "The hover command is the mean of these flights, at their battery voltages.",
    ]
    said += [
        f"{t.name or 'A calibration flight'} has too little steady hover to be compared with."
        for t in tables
        if not t.usable
    ]
    if sum(t.usable for t in tables) < 5:
        said.append(
            "With few calibration flights the spread between healthy flights is mostly assumed: "
            f"{100 * whole_flight.ROTOR_SD:.0f} % for the thrust of each rotor, "
            f"{100 * whole_flight.CENTRE_SD:.0f} % of an arm length for the centre of mass."
        )
    return said


def _name(flight: Flight) -> str:
    return flight.name or "a flight without a name"
