"""The airframe of a flight: one module per autopilot, each making a `Vehicle` from a log.

A module here offers ``identify(flight) -> Vehicle | None`` (None: another autopilot, or too little in the log) and may offer ``NAMES``,
name -> function without arguments that builds the `Vehicle` with default settings, and ``complete(vehicle, flight) -> Vehicle``, a vehicle
from a file with what only the log says. Adding an autopilot is adding a file, or an entry point
`rotorwatch.airframes` of another package: a module or an object with the same parts (docs/plug-ins.md), which is tried when no module here
recognises the flight.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from rotorwatch.base import discovery
from rotorwatch.base.choices import meant
from rotorwatch.errors import VehicleError
from rotorwatch.flight import Flight, vehicle_kind
from rotorwatch.flight.vehicle import Vehicle

KINDS = {2: "quad", 15: "tri", 13: "hexa", 14: "octa", 29: "dodecahexa", 35: "deca"}  # MAVLink MAV_TYPE
WORDS = {"tricopter": "tri", "octo": "octa", "dodeca": "dodecahexa", **{w: w for w in ("quad", "hexa", "octa", "deca")}}


def modules() -> Iterator[ModuleType]:
    """The airframe modules found in this folder, by name, each imported when it is reached."""
    return discovery.modules(__name__)


def offered() -> tuple[tuple[Any, Any], ...]:
    """(entry point, airframes) that other installed packages offer, by name; broken ones are left out, with a PluginWarning."""
    return tuple(discovery.others(__name__, ("identify",)))


def identify(flight: Flight) -> Vehicle:
    """The airframe of a flight.

    Raises VehicleError when the log is of another kind of vehicle, when nothing in it names an airframe, or when the frame
    contradicts the number of outputs."""
    if other := vehicle_kind.refusal(flight):
        raise VehicleError(other)
    vehicles = (module.identify(flight) for module in modules())
    vehicle = next((found for found in vehicles if found is not None), None) or _theirs(flight)
    if vehicle is not None:
        check(vehicle, flight)
        return vehicle
    raise VehicleError(
        f"{flight.name or 'The log'} does not say which airframe flew ({_missing(flight)}); "
        "describe it in a vehicle file and give that with --vehicle FILE."
    )


def of(flight: Flight, vehicle: Vehicle | None = None) -> Vehicle:
    """The airframe of a flight: `vehicle` where one is given, with what it does not say and the log does. Raises VehicleError as `identify`
    does."""
    if vehicle is None:
        return identify(flight)
    check(vehicle, flight)
    for module in modules():
        vehicle = module.complete(vehicle, flight) if hasattr(module, "complete") else vehicle
    return vehicle


def check(vehicle: Vehicle, flight: Flight) -> None:
    """Raise VehicleError when the log commands another number of rotors than the vehicle has."""
    if flight.rotor_count and flight.rotor_count != len(vehicle.rotors):
        raise VehicleError(
            f"{flight.name or 'The log'} commands {flight.rotor_count} rotors but the frame {vehicle.name} "
            f"({vehicle.source}) has {len(vehicle.rotors)}; give the right airframe with --vehicle FILE."
        )


def names() -> tuple[str, ...]:
    """Names of all airframes that `named` can build."""
    return tuple(sorted({name for module in _all() for name in getattr(module, "NAMES", {})}))


def named(name: str) -> Vehicle:
    """The airframe of that name with its autopilot's default settings. Raises VehicleError for an unknown name."""
    for module in _all():
        build = getattr(module, "NAMES", {}).get(name)
        if build is not None:
            return build()
    close = [n for n in names() if name.lower() in n] or [n for n in names() if n.endswith("-quad-x")]
    raise VehicleError(f"There is no airframe called {name!r}{meant(name, names())}; close ones are {', '.join(close[:8])}.")


def _all() -> Iterator[Any]:
    """Built-in airframes, then those of other packages, which are loaded only when reached."""
    yield from modules()
    yield from (found for _, found in offered())


def _theirs(flight: Flight) -> Vehicle | None:
    """The vehicle of a flight by the airframes of other packages; one that raises is skipped, with a warning."""
    for entry, found in offered():
        try:
            vehicle = found.identify(flight)
            if vehicle is not None and not isinstance(vehicle, Vehicle):
                raise TypeError(f"{type(vehicle).__name__} is not a Vehicle")
        except VehicleError:  # the vehicle was recognised, and refused with a reason
            raise
        except Exception as why:  # a module of another package may raise anything
            discovery.failed(entry, "identify", why)
        else:
            if vehicle is not None:
                return vehicle
    return None


def paper(name: str) -> dict:
    """The parameters (SI) of an airframe that a paper describes, from `airframes/papers/NAME.toml`. Raises VehicleError."""
    try:
        text = (_papers() / f"{name}.toml").read_text("utf-8")
    except OSError as error:
        like, known = meant(name, papers()), ", ".join(papers())
        raise VehicleError(f"There is no paper's airframe called {name!r}{like}; known are {known}.") from error
    from rotorwatch.base.optional import tomllib

    return tomllib.loads(text)


def papers() -> tuple[str, ...]:
    """Names of the airframes that `paper` knows."""
    folder = _papers()
    if not folder.is_dir():
        return ()
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")))


def _papers() -> Any:
    from importlib import resources

    return resources.files(__name__) / "papers"


def kind(flight: Flight) -> str | None:
    """quad, hexa, octa ... by the vehicle type the log names (MAVLink's MAV_TYPE or its word for it); None without one. For autopilots that
    need a frame when nothing else is logged, as in telemetry."""
    number = flight.facts.get("mav_type", finite(flight).get("MAV_TYPE"))
    if number in KINDS:
        return KINDS[int(number)]
    text = str(flight.vehicle_type).lower()
    # Longest word first: "dodeca" holds "deca".
    return next((WORDS[word] for word in sorted(WORDS, key=len, reverse=True) if word in text), None)


def finite(flight: Flight) -> dict[str, float]:
    """The parameters that are usable numbers: damaged logs hold others."""
    return {name: float(v) for name, v in flight.parameters.items() if math.isfinite(v) and abs(v) < 1e9}


def _missing(flight: Flight) -> str:
    if not flight.rotor_count:
        return "it has no motor outputs either"
    if flight.autopilot.lower().startswith("ardupilot"):
        return "no FRAME_CLASS or FRAME parameter"
    if flight.autopilot.lower().startswith("px4"):
        return "no CA_ROTOR parameters and no known SYS_AUTOSTART or MAV_TYPE"
    return "no frame parameters, no vehicle type"
