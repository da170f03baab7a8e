"""Checks of healthy flights before anything is learned from them, alone and against the flight under test.

A flight is rejected, with a sentence that names it and the reason, when

* it shows no flight, or is the very flight under test, or a copy of one already accepted;
* the default diagnosis, without a baseline, finds something in it;
* it is of another frame, or logged in other units or at another rate;
* it cannot be of the same aircraft: its thrust curve has another slope at the hover command (SLOPE), or it hovers at another share of
full
  thrust (HOVER), or a command turns it faster or slower by a factor (GAIN) that the uncertainty of both cannot explain;
* it hovers unlike the others (`whole_flight.rarity`): of three or more, the worst is left out while it is rarer than FALSE_ALARM shared
by
  all of them. Of two that differ nothing shows which is wrong: that is an error.

The reference for "the same" is the flight under test; without one, the flight that agrees with most others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike

import numpy as np

from rotorwatch import airframes
from rotorwatch.answer.conclusion import LOPSIDED
from rotorwatch.base.arrays import median
from rotorwatch.engine.motion import trust
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.allocation import within
from rotorwatch.engine.motion.tick_table import Ticks
from rotorwatch.errors import ConfigError, RotorwatchError, VehicleError
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.healthy import whole_flight

READY_S = 3.0  # after lift-off, before the dynamics of a flight are learned from

SLOPE = 1.25
"""Ratio of the slopes d ln f / du of two thrust curves at the hover command: with it, a rotor trimmed by a tenth seems to be off by
0.025 more, as much as the yaw of healthy flights does (whole_flight.TILT_SD)."""
HOVER = 1.5
"""Ratio of the shares of full thrust in hover: half the weight again, which no battery and no air makes."""
GAIN = 2.0
"""Ratio of the angular accelerations by one command: what is learned of it changes by up to 1.7 when a hexa loses a rotor (simulated)."""
APART_SD = 3.0  # standard deviations by which gains must exceed that factor
AXES = ("roll", "pitch", "yaw")
Diagnose = Callable[[Flight, Vehicle], Diagnosis]


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """A flight given as healthy, with derived data computed on demand. given: its airframe; None: as its log says."""

    flight: Flight
    given: Vehicle | None = None

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.flight.name or "a flight without a name"

    @cached_property
    def vehicle(self) -> Vehicle:
        """Its airframe, without learned parameters. Raises VehicleError."""
        return replace(airframes.of(self.flight, self.given), identified=None)

    @cached_property
    def air(self) -> tuple[tuple[float, float], ...]:
        """Intervals in the air, ((start, end), ...) s."""
        return airborne(self.flight) if self.flight.has("motors") else ()

    @cached_property
    def table(self) -> Ticks | None:
        """Its ticks; None when it shows no flight."""
        from rotorwatch.engine.driver import observe

        return observe(self.flight, self.vehicle, self.air, READY_S)

    @cached_property
    def features(self) -> whole_flight.Features:
        """Its hover, by its own thrust curve: limits and compensation may differ between flights."""
        return whole_flight.features(self.flight, self.vehicle, self.air)

    @cached_property
    def gains(self) -> tuple[np.ndarray, np.ndarray]:
        """Commanded torque per angular acceleration (roll, pitch, yaw) as the default estimator learns it: (3,) and its sd (3,)."""
        from rotorwatch.engine.bindings.program import estimate
        from rotorwatch.engine.estimator.plant import GAIN, PER_AXIS

        assert self.table is not None
        carry, _ = estimate(self.table, self.vehicle.effectiveness())
        rows = np.arange(3) * PER_AXIS + GAIN
        return np.asarray(carry.s)[rows], np.sqrt(np.diag(np.asarray(carry.P))[rows])

    @cached_property
    def unusable(self) -> str:
        """Reason why nothing can be compared with it; empty when it shows a flight of a known airframe."""
        try:
            if not self.flight.has("motors"):
                return "it has no motor outputs"
            return "it has no flight" if self.table is None else ""
        except RotorwatchError as why:
            return str(why).rstrip(".")

    def flaw(self, diagnose: Diagnose) -> str:
        """Finding of the default diagnosis in it alone, or doubt about its log; empty without any, and when it is too short. Cached."""
        if "found" not in self.__dict__:
            self.__dict__["found"] = self._finding(diagnose)
        return self.__dict__["found"]

    def _finding(self, diagnose: Diagnose) -> str:
        try:
            assert self.table is not None
            diagnosis = diagnose(self.flight, self.vehicle)
            doubts = trust.contradictions(self.flight, self.vehicle, self.air, self.table)
        except RotorwatchError as why:
            return str(why).rstrip(".")
        # A difference from other builds is no flaw: the user states that the flight is healthy.
        lopsided = {r.note for r in diagnosis.rotors if r.status == "suspect"} == {LOPSIDED} and not diagnosis.events
        if diagnosis.verdict == "healthy" or lopsided or (diagnosis.verdict == "inconclusive" and not doubts):
            return ""
        return f"on its own it is diagnosed as {diagnosis.verdict}, not healthy: {diagnosis.reason.rstrip('.')}"


Given = Flight | Candidate | str | PathLike


def several(flights: Given | Iterable[Given]) -> tuple[Given, ...]:
    """A single flight or file, or many, as a tuple."""
    return (flights,) if isinstance(flights, (Flight, Candidate, str, PathLike)) else tuple(flights)


def healthy(
    flights: Given | Iterable[Given],
    diagnose: Diagnose,
    vehicle: Vehicle | None = None,
    of: Candidate | None = None,
    progress: Callable | None = None,
) -> tuple[tuple[Candidate, ...], tuple[str, ...]]:
    """The flights that can be learned from, and a sentence for each rejected one.

    diagnose: the default diagnosis, which must find nothing in them. vehicle: the airframe of all of them; None: as each log says. of: the
    flight under test. progress: called with the finished share, 0..1. Raises ConfigError without a flight, LogError for a file that cannot
    be read, and VehicleError when no flight is left or two that are left contradict one another."""
    given = several(flights)
    tell = progress or (lambda share: None)
    candidates = [f if isinstance(f, Candidate) else Candidate(_read(f), vehicle) for f in given]
    if not candidates:
        raise ConfigError("Give at least one healthy flight.")
    rejected: list[tuple[str, str]] = []
    accepted: list[Candidate] = []
    for k, candidate in enumerate(candidates):
        why = candidate.unusable or _again(candidate, accepted, of) or candidate.flaw(diagnose)
        if why:
            rejected.append((candidate.name, why))
        else:
            accepted.append(candidate)
        tell((k + 1) / len(candidates))
    accepted = _same_build(accepted, of, rejected)
    accepted = _alike_in_hover(accepted, rejected)
    if not accepted:
        reasons = "; ".join(f"{name}: {why}" for name, why in rejected)
        raise VehicleError(f"No healthy flight is left to learn from ({reasons}); give healthy flights of one aircraft.")
    return tuple(accepted), tuple(f"{name} was set aside: {why}" for name, why in rejected)


def settle(
    flight: Flight, vehicle: Vehicle | None, baseline: Given | Iterable[Given], diagnose: Diagnose, progress: Callable | None = None
) -> tuple[Vehicle, str, tuple[str, ...]]:
    """The vehicle for the diagnosis of a flight, the name of what was taken as healthy ("none" without), and warnings.

    vehicle: requested, or None: as the log says. baseline: healthy flights, whose `identified` the vehicle then carries; diagnose: as for
    `healthy`. Raises as `healthy` does, and VehicleError when the vehicle has another number of rotors than the log."""
    craft = airframes.of(flight, vehicle)
    warnings = _other_frame(flight, vehicle)
    given = several(baseline)
    if given:
        from rotorwatch.witnesses.healthy.learned import learned

        tested = Candidate(flight, vehicle)
        accepted, rejected = healthy(given, diagnose, vehicle, None if tested.unusable else tested, progress)
        known = learned(accepted)
        craft = replace(craft, identified=known.identified, assumptions=(*craft.assumptions, *known.assumptions))
        source = f"{len(accepted)} healthy flight{'s' if len(accepted) > 1 else ''} of the same build"
        return craft, source, (*warnings, *(f"baseline: {sentence}" for sentence in rejected))
    return craft, f"vehicle file {craft.name}" if vehicle and craft.identified else "none", warnings


def vehicle_of(vehicle: Vehicle | str | PathLike | None) -> Vehicle | None:
    """The vehicle, read where it is given as a file. Raises VehicleError, ConfigError."""
    from rotorwatch.flight import vehicle_file

    return vehicle_file.read(vehicle) if isinstance(vehicle, str | PathLike) else vehicle


def _read(given) -> Flight:
    from rotorwatch.logs import plausible, read

    return plausible.checked(given) if isinstance(given, Flight) else read(given)


def _other_frame(flight: Flight, vehicle: Vehicle | None) -> tuple[str, ...]:
    """A warning when the requested vehicle is not the one that the log names."""
    if vehicle is None:
        return ()
    try:
        logged = airframes.identify(flight)
    except RotorwatchError:
        return ()
    if _same_geometry(logged, vehicle):
        return ()
    return (f"the log says {logged.name}; its rotor positions are taken from the vehicle {vehicle.name}, as requested",)


def _again(candidate: Candidate, accepted: list[Candidate], of: Candidate | None) -> str:
    """Reason why a flight is a copy: of the flight under test, or of one already accepted; empty otherwise."""

    def same(other):
        a, b = candidate.flight["motors"], other.flight["motors"]
        return np.array_equal(a.time, b.time) and np.array_equal(a.values, b.values)

    if of is not None and same(of):
        return "it is the flight to be diagnosed and cannot serve as its own baseline"
    return next((f"it is the same flight as {other.name}" for other in accepted if same(other)), "")


def _same_build(flights: list[Candidate], of: Candidate | None, rejected: list[tuple[str, str]]) -> list[Candidate]:
    """The flights of the build of `of`; without it, of the flight that agrees with most of the others."""
    if len(flights) < (1 if of else 2):
        return flights
    if of is not None:
        reference, why = of, [unlike(candidate, of) for candidate in flights]
    else:
        table = [[unlike(candidate, other) if candidate is not other else "" for candidate in flights] for other in flights]
        agree = [sum(not why for why in row) for row in table]
        best = int(np.argmax(agree))
        if agree.count(agree[best]) > agree[best]:  # as many flights of another build
            odd = next(k for k, why in enumerate(table[best]) if why)
            raise VehicleError(
                f"{flights[odd].name} and {flights[best].name} are not of one build: {table[best][odd]}; give flights of one build only."
            )
        reference, why = flights[best], table[best]
    rejected += [(candidate.name, f"{w} (compared with {reference.name})") for candidate, w in zip(flights, why) if w]
    return [candidate for candidate, w in zip(flights, why) if not w]


def _alike_in_hover(flights: list[Candidate], rejected: list[tuple[str, str]]) -> list[Candidate]:
    """The flights that hover alike: leave-one-out, the worst first."""
    while True:
        usable = [candidate for candidate in flights if candidate.features.usable]
        m = len(usable)
        if m < 2:
            return flights
        others = [[u.features for u in usable if u is not candidate] for candidate in usable]
        rare = [whole_flight.rarity(candidate.features, rest) for candidate, rest in zip(usable, others)]
        worst = int(np.argmin(rare))
        if m == 2:
            if min(rare) >= whole_flight.FALSE_FAULT:
                return flights
            raise VehicleError(
                f"{usable[0].name} and {usable[1].name} hover too differently for two healthy flights of one aircraft, and two cannot show "
                "which one is not healthy; add a third, or leave one out."
            )
        if rare[worst] >= whole_flight.FALSE_ALARM / m:
            return flights
        odd = usable[worst]
        rejected.append((odd.name, f"its rotors share the load differently than in the {m - 1} other flights"))
        flights = [candidate for candidate in flights if candidate is not odd]


# Can two flights be of one aircraft?


def unlike(one: Candidate, other: Candidate) -> str:
    """Reason why `one` cannot have been flown by the same aircraft with the same logging as `other`; empty when it can."""
    a, b = one.vehicle, other.vehicle
    if len(a.rotors) != len(b.rotors):
        return f"its frame is {a.name} with {len(a.rotors)} rotors, not {b.name} with {len(b.rotors)}"
    if not _same_geometry(a, b):
        return f"its frame is {a.name}, not {b.name}: the rotors differ in position, direction or load share"
    units = one.flight["motors"].unit, other.flight["motors"].unit
    if units[0] != units[1]:
        words = {"us": "pulses in us"}
        return f"its outputs are logged as {words.get(units[0], 'shares')}, not as {words.get(units[1], 'shares')}"
    assert one.table is not None and other.table is not None
    if one.table.dt != other.table.dt:
        return f"it is logged at another rate: assessed every {one.table.dt:.2f} s, not every {other.table.dt:.2f} s"
    command = _hover_command(other)
    slopes = _slope(a.curve, command), _slope(b.curve, command)
    if _ratio(*slopes) > SLOPE:
        return (
            f"its thrust curve ({_curve(a)}) rises differently from the other ({_curve(b)}), by a factor {_ratio(*slopes):.1f} in hover: "
            "different settings or drive"
        )
    hover = float(np.mean(one.features.share)), float(np.mean(other.features.share))
    if one.features.usable and other.features.usable and _ratio(*hover) > HOVER:
        return f"it hovers at {100 * hover[0]:.0f} % of full thrust, not at {100 * hover[1]:.0f} %: different weight or drive"
    return _other_gains(one, other)


def _other_gains(one: Candidate, other: Candidate) -> str:
    try:
        (mine, sd), (theirs, their_sd) = one.gains, other.gains
    except RotorwatchError:  # commands too slow to learn from: reported where the flight is diagnosed
        return ""
    mine, theirs = np.maximum(mine, 1e-6), np.maximum(theirs, 1e-6)
    apart = np.abs(np.log(mine / theirs)) - np.log(GAIN) - APART_SD * np.hypot(sd / mine, their_sd / theirs)
    axis = int(np.argmax(apart))
    if apart[axis] <= 0:
        return ""
    ratio = theirs[axis] / mine[axis]
    faster = f"{max(ratio, 1 / ratio):.1f} times as {'fast' if ratio > 1 else 'slowly'}"
    return f"a command turns it {faster} in {AXES[axis]}: different weight, size or drive"


def _same_geometry(a: Vehicle, b: Vehicle) -> bool:
    return len(a.rotors) == len(b.rotors) and np.allclose(a.effectiveness(), b.effectiveness(), atol=0.01)


def _hover_command(candidate: Candidate) -> float:
    """Median of the outputs in the air, in their unit."""
    motors = candidate.flight["motors"]
    values = motors.values[within(motors.time, candidate.air) & motors.whole]
    return float(median(values)) if values.size else float("nan")


def _slope(curve, u: float) -> float:
    """d ln f / du of a thrust curve."""
    h = 1e-3 * (curve.u_max - curve.u_min)
    low, high = (float(curve(np.array(v))) for v in (u - h, u + h))
    return (high - low) / (2 * h) / max(0.5 * (high + low), 1e-9)


def _curve(vehicle: Vehicle) -> str:
    c = vehicle.curve
    return f"{c.u_min:g} to {c.u_max:g}, expo {c.expo:.2g}"


def _ratio(a: float, b: float) -> float:
    """Ratio of the larger to the smaller; 1 where one of them is unknown."""
    return max(a, b) / min(a, b) if a > 0 and b > 0 else 1.0
