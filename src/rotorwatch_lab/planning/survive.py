"""Survivability of a vehicle: for every loss of one and of two rotors, can it still hover, with what control authority and in what wind?

    survival = rw.survive("ardupilot-hexa-x", mass_kg=2.0, thrust_to_weight=2.2, arm_m=0.3)
    print(survival.summary)

Full control: thrust, roll, pitch and yaw can be moved both ways from hover. Yaw given up: all but yaw; it turns slowly or drifts.
Only spinning: no hover at rest, but a periodic motion that a regulator can hold (`control.spinning`). See docs/control.md.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import checks, files, optional
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError, VehicleError
from rotorwatch.flight import vehicle_file
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import attainable
from rotorwatch_lab.control import spinning
from rotorwatch_lab.control.airframe import Airframe
from rotorwatch_lab.simulation import prepare, scenario

FULL, NO_YAW, SPINNING, NO = VERDICTS = ("full control", "yaw given up", "only spinning", "cannot hover")
LEAST = 0.01  # of each channel's authority that full control has to both sides of hover
MOST_TILT_DEG = 40.0  # degrees: what the simulator's autopilot leans at most
STRONGEST = 60.0  # m/s
HEADINGS = 16
NEEDED = ("mass_kg", "thrust_to_weight", "arm_m")
OPTIONS = {"mass_kg": "--mass", "thrust_to_weight": "--thrust-to-weight", "arm_m": "--arm"}
MAY = (
    "inertia_kg_m2", "drag_ratio_m", "rotor_radius_m", "rotor_inertia_kg_m2", "hub_height_m", "body_drag", "rotor_drag", "inflow", "lag_s",
)  # fmt: skip
COLOURS = {FULL: "tab:green", NO_YAW: "gold", SPINNING: "tab:orange", NO: "tab:red"}


@dataclass(frozen=True)
class Case:
    """A set of losses. rotors: those weak or dead (1-based), loss: share of their thrust. lift: the largest thrust over weight. roll,
    pitch, yaw [N m]: the largest moment at hover to both sides, the others zero; None where there is none. depth: distance of hover from
    the nearest limit, as a share of the channels' authority. wind [m/s] that it can hold from any side, None where it spins or falls. rate
    [rad/s], tilt [rad]: of the steady turning motion (`control.spinning`), where yaw is given up or it only spins."""

    rotors: tuple[int, ...]
    loss: float
    verdict: str
    lift: float
    roll: float | None
    pitch: float | None
    yaw: float | None
    depth: float
    wind: float | None
    rate: float | None
    tilt: float | None


@dataclass(frozen=True)
class Survival:
    """name of the vehicle; rotors: how many; healthy and all other cases; assumptions: sentences on what was not known. airframe: the
    numbers behind it."""

    name: str
    rotors: int
    healthy: Case
    cases: tuple[Case, ...]
    losses: tuple[float, ...]
    assumptions: tuple[str, ...]
    airframe: Airframe

    def count(self, rotors: int, loss: float) -> dict[str, int]:
        """Number of cases with each verdict, of that many rotors and that loss."""
        verdicts = [c.verdict for c in self.cases if len(c.rotors) == rotors and c.loss == loss]
        return {verdict: verdicts.count(verdict) for verdict in VERDICTS}

    @property
    def summary(self) -> str:
        """Summary: a sentence for each size of loss."""
        sentences = []
        for loss in self.losses:
            what = "Total loss" if loss == 1.0 else f"A loss of {loss:.0%}"
            parts = []
            for rotors, word in ((1, "one rotor"), (2, "two rotors")):
                counts = {verdict: count for verdict, count in self.count(rotors, loss).items() if count}
                total = sum(counts.values())
                if total:
                    ends = ", ".join(f"{verdict} in {count} of {total}" for verdict, count in counts.items())
                    parts.append(f"of {word}: {ends}")
            sentences.append(f"{what} {'; '.join(parts)}.")
        return " ".join(sentences)

    def to_dict(self) -> dict:
        """Plain lists, numbers and strings."""
        return {
            "name": self.name,
            "rotors": self.rotors,
            "mass_kg": float(self.airframe.mass),
            "thrust_to_weight": self.healthy.lift,
            "losses": list(self.losses),
            "healthy": _plain(self.healthy),
            "cases": [_plain(case) for case in self.cases],
            "assumptions": list(self.assumptions),
            "summary": self.summary,
        }

    def to_json(self) -> str:
        """JSON text of `to_dict`."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False)

    def figure(self, path: str | os.PathLike | None = None):
        """Verdicts of every one and two rotors lost (the largest loss asked for), and the roll and pitch moments left at hover after each
        single one; written to `path` (SVG, PNG, PDF) when given. Raises ConfigError without matplotlib."""
        Figure = optional.library("matplotlib.figure", "A figure").Figure
        colour = optional.library("matplotlib.colors", "A figure").to_rgb
        picture = Figure(figsize=(9.5, 4.4), layout="constrained")
        left, right = picture.subplots(1, 2)
        n, loss = self.rotors, max(self.losses)
        image = np.ones((n, n, 3))
        for case in self.cases:
            if case.loss == loss:
                i, j = case.rotors[0] - 1, case.rotors[-1] - 1
                image[i, j] = image[j, i] = colour(COLOURS[case.verdict])
        left.imshow(image)
        left.set_xticks(range(n), [str(k + 1) for k in range(n)])
        left.set_yticks(range(n), [str(k + 1) for k in range(n)])
        left.set(title=f"Loss of {loss:.0%}: one rotor (diagonal), two rotors", xlabel="rotor", ylabel="rotor")
        for verdict in VERDICTS:
            left.plot([], [], "s", color=COLOURS[verdict], label=verdict)
        left.legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, -0.14), ncols=2)
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        for rotor in range(n + 1):
            e = np.where(np.arange(n) == rotor - 1, 1.0 - loss, 1.0)
            Z = attainable.planes(self.airframe.B[:3] * e)
            hover = np.array([self.airframe.mass * G0, 0.0, 0.0])
            reach = np.array([Z.reach(hover, [0.0, np.cos(a), np.sin(a)]) for a in angle])
            if np.isfinite(reach).all():
                style = {"lw": 1, "label": f"rotor {rotor}"} if rotor else {"color": "k", "lw": 2, "label": "healthy"}
                right.plot(reach * np.sin(angle), reach * np.cos(angle), **style)
        right.set(title="Moments left at hover, yaw not counted", xlabel="pitch [N m]", ylabel="roll [N m]", aspect="equal")
        right.legend(frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
        if path is not None:
            with files.replacing(path) as unfinished:
                picture.savefig(unfinished, metadata={"Date": None} if Path(path).suffix != ".png" else None)
        return picture


def survive(
    vehicle: Vehicle | str | os.PathLike,
    *,
    loss: tuple[float, ...] = (1.0,),
    mass_kg: float | None = None,
    thrust_to_weight: float | None = None,
    arm_m: float | None = None,
    progress: Any = None,
) -> Survival:
    """Losses that a vehicle survives.

    vehicle: a `Vehicle`, a vehicle file, or the name of an airframe or of a paper's airframe. loss: sizes of losses, above 0 to 1;
    two weak rotors lose the same. mass_kg, thrust_to_weight (full thrust over weight), arm_m (centre to the outermost rotor): instead
    of what the vehicle says, in its file under [extra], with the names of docs/simulation.md. progress: called with the finished share.
    Raises VehicleError, ConfigError.
    """
    sizes = tuple(dict.fromkeys(float(x) for x in loss))
    if not sizes or not all(0.0 < x <= 1.0 for x in sizes):
        raise ConfigError("loss: give numbers above 0 and up to 1, such as 0.3, 0.6, 1.")
    options = {"mass_kg": mass_kg, "thrust_to_weight": thrust_to_weight, "arm_m": arm_m}
    name, airframe, servo, assumptions = _numbers(vehicle, {k: v for k, v in options.items() if v is not None})
    n = len(airframe.x)
    healthy = _case(airframe, (), 1.0, servo)
    if healthy.verdict != FULL:
        raise VehicleError(
            f"{name} cannot hover under full control even with sound rotors: its full thrust without moments is {healthy.lift:.2f} of its "
            "weight; check mass, thrust and geometry."
        )
    sets = [s for k in (1, 2) for s in combinations(range(1, n + 1), k)]
    cases, total = [], len(sizes) * len(sets)
    for size in sizes:
        for rotors in sets:
            cases.append(_case(airframe, rotors, size, servo))
            if progress:
                progress(len(cases) / total, f"rotors {', '.join(map(str, rotors))}")
    return Survival(name, n, healthy, tuple(cases), sizes, assumptions, airframe)


def _plain(case: Case) -> dict:
    return {**case.__dict__, "rotors": list(case.rotors)}


def _case(airframe: Airframe, rotors: tuple[int, ...], loss: float, servo: bool) -> Case:
    """Row of one set of losses. servo: yaw does not come from the rotors."""
    e = np.ones(len(airframe.x))
    e[[k - 1 for k in rotors]] = 1.0 - loss
    B, weight = airframe.B * e, airframe.mass * G0
    size = np.abs(airframe.B).sum(axis=1) / 2.0
    upright, tilting = (attainable.margins(B, weight, size, free_yaw=free) for free in (False, True))
    verdict, margins, hover = NO, tilting, None
    if servo:
        verdict = FULL if tilting.depth > LEAST else NO
    elif upright.depth > LEAST:
        verdict, margins = FULL, upright
    elif tilting.depth > LEAST:
        verdict = NO_YAW
    if verdict in (NO, NO_YAW) and not servo:
        hover = spinning.relaxed_hover(airframe, e)
        if verdict == NO and hover is not None:
            verdict = SPINNING if spinning.design(airframe, hover) is not None else NO
        hover = None if verdict == NO else hover
    held = verdict in (FULL, NO_YAW)
    roll, pitch, yaw = (float(x) if held and np.isfinite(x) else None for x in (margins.roll, margins.pitch, margins.yaw))
    wind = _wind(airframe, e, verdict == NO_YAW or servo) if held else None
    turning = (hover.rate, hover.tilt) if hover else (None, None)
    lift, depth = float(margins.lift), float(margins.depth)
    return Case(rotors, loss if rotors else 0.0, verdict, lift, roll, pitch, yaw, depth, wind, *turning)


def _wind(airframe: Airframe, e, free_yaw: bool) -> float:
    """The strongest steady wind [m/s] from any side in which the forces balance, LEAST of every channel to spare, leaning at most
    MOST_TILT_DEG."""
    rows = 3 if free_yaw else 4
    B, size = airframe.B * e, np.abs(airframe.B).sum(axis=1) / 2.0
    size = np.where(size > 0.0, size, 1.0)
    Z = attainable.planes((B / size[:, None])[:rows])
    w0 = np.sqrt(_trim(B[:rows], airframe.mass * G0)) * e  # what a rotor has lost meets no air
    coarse = np.arange(0.0, STRONGEST + 0.5, 0.5)
    first = _holds(airframe, Z, size[:rows], w0, coarse)
    if first.all():
        return STRONGEST
    start = max(int(first.argmin()) - 1, 0) * 0.5
    fine = start + np.arange(0.0, 0.51, 0.02)
    return float(round(fine[max(int(_holds(airframe, Z, size[:rows], w0, fine).argmin()) - 1, 0)], 2))


def _trim(B, weight: float) -> np.ndarray:
    """Hover commands (n,), as equal as possible."""
    from scipy.optimize import lsq_linear

    wrench = np.zeros(len(B))
    wrench[0] = weight
    scale = np.abs(B).sum(axis=1).max()
    rows = np.vstack([B / scale, 1e-5 * np.eye(B.shape[1])])
    return lsq_linear(rows, np.append(wrench / scale, np.zeros(B.shape[1])), (0.0, 1.0), method="bvls").x


def _holds(a: Airframe, Z: attainable.Planes, size, w0, speeds) -> np.ndarray:
    """(V,) bool for winds of those speeds from all sides; w0 (n,): rotor speeds in hover, of full speed, times what each has
    left. The forces are those of `simulation.dynamics`; the rotors turn as in hover, all faster or slower by the thrust that the wind
    asks for."""
    weight = a.mass * G0
    V, angle = np.meshgrid(speeds, np.linspace(0.0, 2.0 * np.pi, HEADINGS, endpoint=False), indexing="ij")
    turns = np.ones_like(V)  # rotor speeds over those of hover
    side, down = (float(np.asarray(a.drag)[k]) for k in (0, 2))
    thrust, tilt = np.full_like(V, weight), np.zeros_like(V)
    for _ in range(20):
        flow = turns * w0.sum()
        tilt = np.arctan((side * V**2 + a.k_d * flow * V) / weight)
        thrust = weight * np.cos(tilt) + (down * V**2 + a.k_z * flow * V) * np.sin(tilt)
        turns = np.sqrt(thrust / weight)
    # Of the air past the body: in the rotors' plane, and down through it.
    across, along = -V * np.cos(tilt), -V * np.sin(tilt)
    a_x, a_y = across * np.cos(angle), across * np.sin(angle)
    flow, x, y = (turns * s for s in (w0.sum(), w0 @ a.x, w0 @ a.y))
    H_x, H_y = -a.k_d * a_x * flow, -a.k_d * a_y * flow
    roll = -a.k_z * along * y - a.z * H_y
    pitch = a.k_z * along * x + a.z * H_x
    yaw = -a.k_d * (a_y * x - a_x * y)
    needed = np.stack([thrust, -roll, -pitch, -yaw], axis=-1)[..., : len(size)] / size
    inside = (needed @ Z.normals.T <= Z.limits - LEAST).all(axis=-1)
    return (inside & (tilt <= math.radians(MOST_TILT_DEG))).all(axis=1)


def _numbers(vehicle: Any, options: dict[str, float]) -> tuple[str, Airframe, bool, tuple[str, ...]]:
    """(name, numbers, whether yaw is a servo's, assumptions). Raises VehicleError, ConfigError."""
    known = vehicle if isinstance(vehicle, Vehicle) else None
    name = vehicle.name if isinstance(vehicle, Vehicle) else str(os.fspath(vehicle))
    if known is None and (Path(name).suffix == ".toml" or Path(name).exists()) and name not in airframes.papers():
        known = vehicle_file.read(name)
    for key, value in options.items():
        if key == "thrust_to_weight" and not value > 1.0:
            raise ConfigError(f"A thrust of {value:g} times the weight carries no vehicle: give --thrust-to-weight above 1.")
        checks.positive(key, value)
    assumptions = []
    if known is not None:
        extra = {k: v for k, v in known.extra.items() if k in NEEDED or k in MAY}
        fields = {"lag_s": known.lag_s, **extra, **options}
        missing = [key for key in NEEDED if key not in fields]
        if missing:
            raise VehicleError(
                f"{name} does not say {', '.join(missing)}: give {', '.join(OPTIONS[key] for key in missing)}, or write "
                f"{'it' if len(missing) == 1 else 'them'} into the vehicle file under [extra]."
            )
        plan = scenario.from_table({"airframe": {"frame": "quad-x", **fields}})
    elif name in airframes.papers():
        if options:
            raise ConfigError(f"{name} is a paper's airframe, whose mass, thrust and size are known: leave the options out.")
        plan = scenario.from_table({"airframe": {"frame": name}})
    else:
        known = airframes.named(name)
        usual = {key: scenario.FIELDS["airframe"][key].default for key in NEEDED}
        fields = {**usual, **options}
        guessed = [f"{OPTIONS[key]} {fields[key]:g}" for key in NEEDED if key not in options]
        if guessed:
            assumptions.append(f"{name} is a shape; taken as usual: {', '.join(guessed)}.")
        plan = scenario.from_table({"airframe": {"frame": "quad-x", **fields}})
    craft = prepare.craft(plan, known)
    servo = known is not None and not any(r.spin for r in known.rotors)
    if known is not None and not servo and not all(r.spin for r in known.rotors):
        raise VehicleError(f"Some rotors of {name} are tilted, which is not reckoned with; only upright rotors can be assessed.")
    if servo:
        assumptions.append("Yaw is a servo's and taken as sound; it is not assessed.")
    airframe = Airframe.of(craft)
    assumptions.append(
        f"Wind: steady, from any side; drag as in the simulator ({airframe.drag[0]:.3g} V^2 N on the body, {airframe.k_d:.3g} N s/m of a "
        f"rotor at full speed), leaning at most {MOST_TILT_DEG:.0f} degrees, {LEAST:.0%} of each channel to spare."
    )
    return name, airframe, servo, tuple(assumptions)
