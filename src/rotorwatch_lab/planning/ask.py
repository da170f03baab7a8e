"""Designs an excitation that tells which of several sets of rotors is weak: amplitude, length, motion and separation.

    asked = rw.ask("ardupilot-hexa-x", [(1, 2), (3, 4), (5, 6), ()], loss=0.3)
    print(asked.summary)
    asked.design.signal                # rotorwatch_lab.control.excitation.at(signal, t): what to add to the commands
    rw.ask("flight.ulg")               # candidates, hover and noise from a log whose answer is ambiguous

See docs/control.md.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import airframes, logs
from rotorwatch.base import checks, files, optional
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, vehicle_file
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import READY_S, TAU, airborne, events, excitation_response, observe, program, usual_gains
from rotorwatch_lab.control import excitation
from rotorwatch_lab.control.excitation import Design, Limits, Noise
from rotorwatch_lab.planning.question import Question, pose, suspects

# Of the thrust of simulated multirotors of 1 to 8 kg in winds of 2 to 4 m/s, in hover thrusts of one rotor.
USUAL_NOISE = (0.025**2, 0.0, 0.02**2, 0.2**2)
GYRATION = 0.4  # radius of gyration about roll and pitch, in arms
HOVER = 0.45  # share of full thrust: twice the weight and a little more


@dataclass(frozen=True)
class Asking:
    """An excitation of a vehicle and its purpose. name; rotors: how many; candidates: sets of weak rotors (1-based; (): none), losses (k,
    n) of each; B (4, n); hover (n,): commands; dt [s]; design: the excitation; assumptions: sentences on unknown quantities."""

    name: str
    rotors: int
    candidates: tuple[tuple[int, ...], ...]
    losses: np.ndarray
    B: np.ndarray
    hover: np.ndarray
    dt: float
    design: Design
    assumptions: tuple[str, ...]

    @property
    def amplitude(self) -> np.ndarray:
        """(n,) largest change of each rotor's command, share of full thrust."""
        return np.abs(self.design.signal.first) + np.abs(self.design.signal.second)

    @property
    def separation(self) -> np.ndarray:
        """(k,) standard deviations between each candidate and the nearest other one."""
        d = np.sqrt(self.design.information)
        return np.array([d[(self.design.pairs == k).any(axis=1)].min() for k in range(len(self.candidates))])

    @property
    def summary(self) -> str:
        """Summary in one sentence."""
        signal, enough = self.design.signal, self.design.information.min() >= self.design.needed
        what = "tells these candidates apart" if enough else "does not yet tell these candidates apart for sure"
        return (
            f"An excitation of {float(signal.length):.2f} s, periods of {float(signal.period):.2f} and "
            f"{float(signal.period) / excitation.FASTER:.2f} s, commands changed by up to {self.amplitude.max():.1%} of full thrust, "
            f"{what} and turns the vehicle by up to {np.degrees(self.design.tilt.max()):.2f} degrees; a healthy one does not move."
        )

    def commands(self, rate_hz: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
        """(time (T,) [s], excitation added to the commands (T, n)) over its whole length."""
        signal = self.design.signal
        time = np.arange(0.0, float(signal.length) + 0.5 / rate_hz, 1.0 / rate_hz)
        return time, np.stack([np.asarray(excitation.value_at(signal, t)) for t in time])

    def to_dict(self) -> dict:
        """Plain lists, numbers and strings."""
        d = self.design
        return {
            "name": self.name, "rotors": self.rotors, "candidates": [list(c) for c in self.candidates],
            "losses": self.losses.tolist(), "hover": self.hover.tolist(), "tick_s": self.dt,
            "length_s": float(d.signal.length), "period_s": float(d.signal.period), "first": np.asarray(d.signal.first).tolist(),
            "second": np.asarray(d.signal.second).tolist(), "amplitude": self.amplitude.tolist(),
            "turn_deg": np.degrees(d.tilt).tolist(), "height_m": d.heave.tolist(), "separation_sd": self.separation.tolist(),
            "pairs": [
                {"one": list(self.candidates[i]), "other": list(self.candidates[j]), "information": float(v)}
                for (i, j), v in zip(d.pairs, d.information, strict=True)
            ],
            "needed": d.needed, "limited_by": d.bound, "assumptions": list(self.assumptions), "summary": self.summary,
        }  # fmt: skip

    def to_json(self) -> str:
        """JSON text of `to_dict`."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False)

    def figure(self, path: str | os.PathLike | None = None):
        """Change of each command, thrust response of each candidate, and growth of the information; written to `path` (SVG, PNG, PDF) when
        given. Raises ConfigError without matplotlib."""
        Figure = optional.library("matplotlib.figure", "A figure").Figure
        picture = Figure(figsize=(11, 3.4), layout="constrained")
        left, middle, right = picture.subplots(1, 3)
        time, added = self.commands()
        for k in range(self.rotors):
            left.plot(time, 100.0 * added[:, k], lw=1, label=str(k + 1))
        left.set(title="Added to the commands", xlabel="time [s]", ylabel="% of full thrust")
        left.legend(frameon=False, fontsize="small", ncols=2, title="rotor")
        for rotors, theta in zip(self.candidates, self.losses, strict=True):
            answer = -added @ (self.B[3] * theta) / self.hover.mean()
            middle.plot(time, answer, lw=1, label=label(rotors))
        middle.set(title="Answer of each candidate", xlabel="time [s]", ylabel="thrust [hover thrusts of a rotor]")
        middle.legend(frameon=False, fontsize="small")
        course = self.design.course
        right.plot(self.dt * np.arange(1, len(course) + 1), course, color="tab:blue")
        right.axhline(self.design.needed, color="0.6", ls=":", lw=1)
        right.set(title="Information between the closest two", xlabel="time [s]", ylabel="(standard deviations)²")
        if path is not None:
            with files.replacing(path) as unfinished:
                picture.savefig(unfinished, metadata={"Date": None} if Path(path).suffix != ".png" else None)
        return picture


def label(rotors: Sequence[int]) -> str:
    """Rotor set as text: (1, 4) -> '1+4', () -> 'none'."""
    return "+".join(map(str, rotors)) or "none"


def ask(
    subject: Vehicle | Flight | str | os.PathLike,
    candidates: Sequence[Sequence[int]] | None = None,
    *,
    vehicle: Vehicle | None = None,
    loss: float | Sequence[float] = 0.3,
    hover: float | None = None,
    arm_m: float | None = None,
    tick_s: float = 0.05,
    within_s: float = excitation.LONGEST_S,
    tilt_deg: float = 1.0,
    amplitude: float = Limits().amplitude,
) -> Asking:
    """The excitation that tells apart soonest which of several sets of rotors is weak.

    subject: a `Vehicle`, a vehicle file, the name of an airframe, or a `Flight` or log file whose answer is ambiguous: then candidates,
    hover, gains and noise are the log's. vehicle: its airframe, if the log does not say. candidates: sets of rotors, 1-based; (): none
    is weak. loss: of each rotor of them, or of those of each candidate; hover: share of full thrust; arm_m: centre to the outermost rotor,
    which says how far the vehicle turns; tick_s: how often outputs are logged, 0.05 at most. within_s: no longer than that; tilt_deg:
    largest turn; amplitude: largest change of a command, share of full thrust. Raises LogError, VehicleError, ConfigError.
    """
    for key, value in (("within_s", within_s), ("tilt_deg", tilt_deg), ("amplitude", amplitude), ("tick_s", tick_s)):
        checks.positive(key, value)
    limits = Limits(tilt=float(np.radians(tilt_deg)), amplitude=float(amplitude))
    if isinstance(subject, Flight) or _is_log(subject):
        name, B, question = _of_log(subject, vehicle)
        hypotheses = question.candidates if candidates is None else _candidates(candidates, loss, B.shape[1])
        notes = ("Hover, gains and noise are those of the log.",)
    else:
        craft = _vehicle(subject)
        name, B = craft.name, craft.effectiveness()
        n = B.shape[1]
        if candidates is None:
            raise ConfigError("Name the candidates, such as --candidates 1+4,2+5,none; only a log says them by itself.")
        hypotheses = _candidates(candidates, loss, n)
        if hover is not None and not 0.0 < hover < 1.0:
            raise ConfigError(f"hover must be a share of full thrust, above 0 and below 1, not {hover:g}.")
        gain = usual_gains(n)[:3]
        if arm_m is not None:
            gain[:2] = n * GYRATION**2 * checks.positive("arm_m", arm_m) / G0
        notes = (
            *(("Hover is taken to need 45 % of full thrust.",) if hover is None else ()),
            *(("The vehicle is taken to turn as usual multirotors do; give its arm.",) if arm_m is None else ()),
            "The noise is that of simulated multirotors in a light wind; a log of the vehicle says it better.",
        )
        usual = np.full(n, HOVER if hover is None else hover)
        question = Question(hypotheses, usual, Noise(np.array(USUAL_NOISE), np.array(TAU)), gain, tick_s)
    about = question.hover, question.noise, question.gain, question.dt
    design = excitation.design(B, list(hypotheses.values()), *about, limits, longest_s=within_s)
    rotor_sets = tuple(tuple(k + 1 for k in c) for c in hypotheses)
    return Asking(name, B.shape[1], rotor_sets, np.stack(list(hypotheses.values())), B, question.hover, question.dt, design, notes)


def _is_log(subject: Any) -> bool:
    if isinstance(subject, Vehicle) or not isinstance(subject, (str, os.PathLike)):
        return False
    return Path(subject).exists() and Path(subject).suffix != ".toml"


def _vehicle(subject: Any) -> Vehicle:
    if isinstance(subject, Vehicle):
        return subject
    name = os.fspath(subject)
    return vehicle_file.read(name) if Path(name).suffix == ".toml" else airframes.named(name)


def _candidates(sets: Sequence[Sequence[int]], loss: float | Sequence[float], n: int) -> dict:
    """{rotors (0-based): losses (n,)}. Raises ConfigError."""
    each = [float(loss)] * len(sets) if isinstance(loss, (int, float)) else [float(x) for x in loss]
    if len(each) != len(sets):
        raise ConfigError(f"loss: give one number, or one for each of the {len(sets)} candidates, not {len(each)}.")
    if not all(0.0 < x <= 1.0 for x in each):
        raise ConfigError("loss: give numbers above 0 and up to 1.")
    losses = {}
    for rotors, size in zip(sets, each, strict=True):
        indices = tuple(sorted(int(k) - 1 for k in rotors))
        if len(set(indices)) != len(indices) or not all(0 <= k < n for k in indices):
            raise ConfigError(f"The candidate {label(rotors)} is no set of rotors from 1 to {n}.")
        losses[indices] = np.where(np.isin(np.arange(n), indices), size, 0.0)
    return losses


def _of_log(subject: Any, vehicle: Vehicle | None) -> tuple[str, np.ndarray, Question]:
    """(name, B, question) of a log whose answer is ambiguous. Raises ConfigError if it is not."""
    flight = subject if isinstance(subject, Flight) else logs.read(subject)
    craft = vehicle or airframes.identify(flight)
    air = airborne(flight) if flight.has("motors") else ()
    table = observe(flight, craft, air, READY_S)
    if table is None:
        raise ConfigError("The log shows no flight with motor outputs, so there is nothing to ask of it.")
    B = craft.effectiveness()
    carry, out = program.estimate(table, B)
    unsure = [e for e in events.read(out, table, B) if e.alternatives]
    sets = excitation_response.candidates(unsure[-1], B) if unsure else suspects(carry, out, table, B)
    if not sets:
        raise ConfigError("The diagnosis of this log names no alternatives, and its trim has not changed: there is nothing to ask.")
    return craft.name, B, pose(sets, carry, table, B)
