"""An assessed log as a store entry."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from rotorwatch import __version__, airframes
from rotorwatch.base.progress import READ, portion
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.fleet.store import Entry
from rotorwatch.flight import Flight, identity
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.healthy import whole_flight


def entry(path: str | os.PathLike, aircraft: str = "", vehicle: Vehicle | None = None, progress: Callable | None = None) -> Entry:
    """Read and assess a log. aircraft: a name to use in place of what the log says. Raises LogError, VehicleError or ConfigError."""
    from rotorwatch import logs

    hash = logs.fingerprint(path)[1]
    flight = logs.read(path, progress and portion(progress, 0.0, READ, "reading"))
    return of_flight(flight, hash, os.path.abspath(path), logs.of_part(path)[0].stat().st_size, aircraft, vehicle, progress)


def of_flight(
    flight: Flight, hash: str, path: str, size: int, aircraft: str = "", vehicle: Vehicle | None = None, progress: Callable | None = None,
    found: Diagnosis | None = None,
) -> Entry:  # fmt: skip
    """The entry of a flight that was read. found: its diagnosis, where already made."""
    craft = airframes.of(flight, vehicle)
    if found is None:
        from rotorwatch.diagnose import diagnose

        found = diagnose(flight, vehicle=craft, progress=progress)
    diagnosed = found.to_dict()
    del diagnosed["timing"]  # the only thing that differs from run to run
    who = identity.Identity(f"name {aircraft}", aircraft, "name") if aircraft else identity.identify(flight)
    air = found.trace.airborne if found.trace is not None else airborne(flight)
    return Entry(
        hash=hash,
        path=path,
        name=flight.name,
        size=size,
        identity=who.text,
        called=who.called,
        utc=flight.facts.get("utc_start"),
        clock_us=int(flight.start_us),
        count=identity.count(flight),
        duration_s=float(flight.duration),
        airborne_s=float(sum(b - a for a, b in air)),
        autopilot=flight.autopilot,
        firmware=flight.firmware,
        frame=craft.name,
        rotors=len(craft.rotors),
        build=identity.build(craft),
        verdict=str(diagnosed["verdict"]),
        headline=str(diagnosed["headline"]),
        version=__version__,
        diagnosis=diagnosed,
        trim=trim(flight, craft, air, found.doubts) | imbalance(found) | ({"lost": True} if found.story else {}),
    )


def trim(flight: Flight, craft: Vehicle, air, doubts: Sequence[str]) -> dict:
    """The flight's hover, for histories: whole_flight.Features, the effectiveness B (4 x n) and `doubt`, the first reason to doubt its log;
    empty when there is too little steady hover."""
    hovering = whole_flight.features(flight, craft, air)
    if not hovering.usable:
        return {}
    table = hovering.to_dict() | {"name": "", "effectiveness": craft.effectiveness().tolist()}
    return _short(table) | {"doubt": doubts[0] if doubts else ""}


def imbalance(found: Diagnosis) -> dict:
    """`imbalance`, for histories: of each rotor its figure with its interval, None where it was not heard by itself, and their unit; empty
    where none was."""
    heard = [r.imbalance if r.imbalance and len(r.imbalance["together"]) == 1 else None for r in found.rotors]
    if not any(heard):
        return {}
    unit = next(one["unit"] for one in heard if one)
    return {"imbalance": {"unit": unit, "rotors": [one and _short([one["value"], *one["interval"]]) for one in heard]}}


def _short(value):
    """Numbers with seven digits: sufficient, and mostly the same on every processor."""
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_short(v) for v in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value
