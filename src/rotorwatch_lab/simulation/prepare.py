"""From a scenario to numbers: vehicle, autopilot gains, air, sensors and faults, ready for simulation."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.airframes import ardupilot, px4
from rotorwatch.base.physics import G0
from rotorwatch.errors import ConfigError, VehicleError
from rotorwatch.flight.vehicle import Rotor, ThrustCurve, Vehicle
from rotorwatch_lab.simulation import attached, control, dynamics, faults, incremental, outside, trajectories, wind
from rotorwatch_lab.simulation.multirotor import Battery, Plan
from rotorwatch_lab.simulation.scenario import FIELDS, Scenario, brief
from rotorwatch_lab.simulation.sensors import Sensors

AIR = 1.225  # kg/m^3
TIP_SPEED = 170.0  # m/s
WATT_PER_NEWTON = 12.0  # electrical, at full thrust
SAG = 0.07
SAME = {"octaquad-x": "octa-coaxial", "octa-coaxial": "octaquad-x"}  # one frame, two names
PWM = (1000.0, 2000.0)
MOVING = ("square", "figure-eight", "aggressive", "turning-square")
SPIN = (0.15, 0.95)  # ArduPilot's MOT_SPIN_MIN, MOT_SPIN_MAX


def vehicle(scenario: Scenario) -> Vehicle:
    """The airframe in the autopilot's parameters: rotors in metres, mixer, assumed thrust curve. Raises ConfigError."""
    frame, a = scenario.airframe["frame"], scenario.airframe
    if scenario.helicopter:
        raise ConfigError(f"airframe.frame: {frame} is a helicopter; here only multirotors fly.")
    believed = a["expo"] if a["believed_expo"] is None else a["believed_expo"]
    known = _paper(frame)
    if known is not None:
        geometry, arm = _rotors(known), 1.0
    else:
        geometry = _stretched(_geometry(scenario.autopilot, frame), a["length_to_width"])
        arm = a["arm_m"] / max(np.hypot(r.x, r.y) for r in geometry)
    shares = (a["lower_rotor"] if r.lower else 1.0 for r in geometry)
    rotors = tuple(Rotor(r.x * arm, r.y * arm, r.spin, share, r.lower) for r, share in zip(geometry, shares))
    for k, fault in enumerate(scenario.faults):
        if fault["rotor"] > len(rotors):
            raise ConfigError(f"faults[{k + 1}].rotor is {fault['rotor']}, but the frame {frame} has {len(rotors)} rotors.")
    if scenario.autopilot == "px4":
        # Demands are logged: the thrust curve is applied to them on the way to the ESC.
        curve, name, mixer = ThrustCurve(0.0, 1.0, 0.0), f"px4-{frame}", px4.mix(reported(scenario, rotors))
    else:
        low, high = (PWM[0] + s * (PWM[1] - PWM[0]) for s in SPIN)
        curve, name = ThrustCurve(low, high, believed), f"ardupilot-{frame}"
        mixer = px4.mix(rotors) if known is not None else _built(frame).mixer
    return Vehicle(name, rotors, curve, mixer, lag_s=a["lag_s"], source="scenario", extra={"mixer_expo": curve.expo})


def _stretched(rotors: tuple[Rotor, ...], ratio: float) -> tuple[Rotor, ...]:
    """Rotors of a frame that is longer (x) than wide (y) by this ratio; the same area."""
    if ratio == 1.0:
        return rotors
    return tuple(replace(r, x=r.x * np.sqrt(ratio), y=r.y / np.sqrt(ratio)) for r in rotors)


def reported(scenario: Scenario, rotors: tuple[Rotor, ...]) -> tuple[Rotor, ...]:
    """The geometry that PX4 has in its parameters: the true one, unless the scenario has it believe in another ratio of its sides."""
    a = scenario.airframe
    if a["believed_length_to_width"] is None:
        return rotors
    return _stretched(rotors, a["believed_length_to_width"] / a["length_to_width"])


def _paper(frame: str) -> dict | None:
    return airframes.paper(frame) if frame in airframes.papers() else None


def _rotors(known: Mapping[str, Any]) -> tuple[Rotor, ...]:
    rows = (known["rotors"][k] for k in ("x", "y", "spin"))
    return tuple(Rotor(float(x), float(y), int(s)) for x, y, s in zip(*rows, strict=True))


def _built(frame: str) -> Vehicle:
    name = f"ardupilot-{frame}"
    try:
        return airframes.named(name)
    except VehicleError as error:
        if frame in SAME:
            return airframes.named(f"ardupilot-{SAME[frame]}")
        known = sorted({*ardupilot.FRAMES, *px4.FRAMES, *airframes.papers()})
        close = difflib.get_close_matches(frame, known, 6, 0.5) or ["quad-x"]
        raise ConfigError(f"airframe.frame: there is no frame {brief(frame)}; close ones are {', '.join(close)}.") from error


def _geometry(autopilot: str, frame: str) -> tuple[Rotor, ...]:
    if autopilot == "px4":
        name = frame if frame in px4.FRAMES else SAME.get(frame, "")
        if name in px4.FRAMES:
            return px4.place(name)
    rotors = _built(frame).rotors  # PX4 takes any geometry, by its CA_ROTOR parameters
    # The servo of a tricopter is not simulated; its yaw is free.
    if frame != "tri" and any(r.spin == 0 for r in rotors):
        raise ConfigError(f"airframe.frame: the rotors of {frame} are tilted, which is not simulated.")
    return rotors


def frame_numbers(frame: str) -> tuple[int, int]:
    """(FRAME_CLASS, FRAME_TYPE) of an ArduPilot frame. Raises ConfigError for others."""
    frame = frame if frame in ardupilot.FRAMES else SAME.get(frame, frame)
    for number, kind in ardupilot.CLASSES.items():
        for code, word in ardupilot.TYPES.items():
            if f"{kind}-{word}" == frame:
                return number, code
    if frame == "tri":
        return 7, 0
    if frame.startswith("y6"):
        return 5, {"y6-b": 10, "y6-f": 11}.get(frame, 1)
    raise ConfigError(f"airframe.frame: ArduPilot has no frame {frame}, so no DataFlash log of it can be written.")


class Bare(NamedTuple):
    """A vehicle without its payload; n rotors, SI. x, y, spin, thrust_max (n,); J (3, 3); arm: to the outermost rotor; radius of a rotor;
    drag_ratio: torque per thrust [m]; hover: share of full thrust that carries it."""

    x: np.ndarray
    y: np.ndarray
    spin: np.ndarray
    thrust_max: np.ndarray
    mass: float
    J: np.ndarray
    arm: float
    radius: float
    drag_ratio: float
    hover: float


BEYOND = {
    "airframe": ("lag_down", "drag_at_m", "shift_m", "legs", "slung_kg"),
    "trajectory": ("slow_m", "drift_m_s", "cut_s", "hops", "levels_s"),
    "": ("desaturation",),
    "wind": ("falls",),
    "outside": ("push_ramp_s", "push_down_m_s2", "twist_rad_s2", "tether_m"),
}
"""Fields whose default is that there is nothing: where all of them have it, the simulated program has no part for them."""


def beyond(scenario: Scenario) -> bool:
    """True if a scenario asks for legs, lines, hops or anything else in BEYOND."""
    own = {"": vars(scenario), **{part: getattr(scenario, part) for part in BEYOND if part}}
    return any(own[part][name] != FIELDS[part][name].default for part, names in BEYOND.items() for name in names)


def plan(scenario: Scenario, more: bool = False) -> Plan:
    """The scenario's numbers. more: with parts for everything in BEYOND, even where it asks for none of it: plans of one batch must be
    alike. Raises ConfigError for frames that do not exist or vehicles that cannot fly."""
    known = vehicle(scenario)
    bare = _bare(scenario, known)
    full_speed = _full_speed(scenario, bare)
    more = beyond(scenario) or more
    return Plan(
        craft=_craft(scenario, bare, full_speed, more),
        pilot=_pilot(scenario, known, bare, full_speed, more),
        way=_up_and_down(scenario, more),
        wind=air(scenario, bare.arm),
        faults=broken(scenario, len(bare.x)),
        battery=_battery(scenario, bare.thrust_max.sum(), bare.hover),
        sensors=sensors(scenario, full_speed),
        seed=np.array(scenario.seed, np.int64),
        outside=_outside(scenario, bare, full_speed, more),
    )


def craft(scenario: Scenario, known: Vehicle | None = None) -> dynamics.Craft:
    """The physical vehicle of a scenario. known: another geometry than that of the scenario's frame, brought to its arm_m, with the rotors'
    own shares of thrust. Raises ConfigError."""
    if known is None:
        bare = _bare(scenario, vehicle(scenario))
    else:
        arm = scenario.airframe["arm_m"] / max(np.hypot(r.x, r.y) for r in known.rotors)
        rotors = tuple(replace(r, x=r.x * arm, y=r.y * arm) for r in known.rotors)
        bare = _bare(scenario, replace(known, rotors=rotors))
    return _craft(scenario, bare, _full_speed(scenario, bare), beyond(scenario))


def induced_velocity(scenario: Scenario) -> float:
    """Induced velocity of the rotors in hover [m/s], each carrying the same weight: sqrt(T / (2 rho A)), momentum theory (Leishman,
    Principles of Helicopter Aerodynamics, 2006, section 2.2). Raises ConfigError."""
    return float(_induced(_bare(scenario, vehicle(scenario))))


def _induced(bare: Bare) -> np.floating:
    return np.sqrt(bare.mass * G0 / len(bare.x) / (2.0 * AIR * np.pi * bare.radius**2))


def _full_speed(scenario: Scenario, bare: Bare) -> float:
    """Full rotor speed [rad/s]."""
    return scenario.airframe["rotor_speed_rad_s"] or TIP_SPEED / bare.radius


def _bare(scenario: Scenario, craft: Vehicle) -> Bare:
    """Bare vehicle from the paper's airframe data, else from the scenario or typical values."""
    a, known = scenario.airframe, _paper(scenario.airframe["frame"])
    x, y, spin, share = (np.array([getattr(r, k) for r in craft.rotors], float) for k in ("x", "y", "spin", "share"))
    arm = float(np.hypot(x, y).max())
    mass = float(known["mass"]) if known else a["mass_kg"]
    if known:
        thrust_max = np.full(len(x), float(known["thrust_max"]))
    else:
        thrust_max = share * a["thrust_to_weight"] * mass * G0 / share.sum()
    radius = a["rotor_radius_m"] or 0.75 * _gap(x, y) / 2.0
    drag_ratio = a["drag_ratio_m"] or (float(known["drag_ratio"]) if known else 0.12 * radius)
    hover = mass * G0 / thrust_max.sum()
    return Bare(x, y, spin, thrust_max, mass, _inertia(a, known, mass, arm), arm, radius, drag_ratio, hover)


def _pilot(scenario: Scenario, known: Vehicle, bare: Bare, full_speed: float, more: bool) -> control.Autopilot:
    """An autopilot tuned for the vehicle without payload, with the thrust curve that it assumes. full_speed [rad/s] of the rotors."""
    a, mixer = scenario.airframe, known.mixer
    assert mixer is not None
    B_tau = np.stack([-bare.y, bare.x, bare.drag_ratio * bare.spin])
    believed, hover = a["expo"] if a["believed_expo"] is None else a["believed_expo"], bare.hover
    if believed != a["expo"]:  # what carries it was learned, as autopilots do
        hover = float(dynamics.thrust_share(believed, control.drive(a["expo"], hover)))
    pilot = control.tune(
        *(mixer, B_tau, np.diag(bare.J), bare.thrust_max, hover, a["lag_s"]),
        gyro_hz=scenario.sensors["gyro_filter_hz"],
        expo=believed,
        compensates=float(a_compensates(scenario)),
    )
    # Momentum goes with speed, thrust and its drag with speed squared: what a change of thrust at hover is worth in both.
    momentum = _rotor_inertia(scenario, bare) * full_speed / (2.0 * np.sqrt(bare.hover))
    lead = momentum / (bare.drag_ratio * bare.thrust_max.mean())
    about = (mixer, B_tau, np.diag(bare.J), bare.thrust_max, 3.0 * pilot.attitude, lead, a["lag_s"])
    sequential = np.array(float(scenario.autopilot == "px4" and scenario.desaturation == "sequential")) if more else ()
    return pilot._replace(inversion=incremental.tune(scenario.control == "indi", *about), sequential=sequential)


def _rotor_inertia(scenario: Scenario, bare: Bare) -> float:
    """Inertia of one rotor about its axis [kg m^2]."""
    inertia = scenario.airframe["rotor_inertia_kg_m2"]
    return 0.015 * bare.mass / len(bare.x) * (2.0 * bare.radius) ** 2 / 12.0 if inertia is None else inertia


def _outside(scenario: Scenario, bare: Bare, full_speed: float, more: bool) -> outside.Outside:
    """External influences of the scenario. full_speed [rad/s] of the rotors. Raises ConfigError."""
    a, w, drops = scenario.airframe, scenario.outside, scenario.airframe["payload_drops_s"]
    to, empty = np.radians(w["push_to_deg"]), replace(scenario, airframe={**a, "payload_kg": 0.0})
    return outside.Outside(
        push=bare.mass * np.array([w["push_m_s2"] * np.cos(to), w["push_m_s2"] * np.sin(to), w["push_down_m_s2"]]),
        height=np.array(w["push_above_m"]),
        onset=np.array(w["push_onset_s"]),
        end=np.array(faults.NEVER if w["push_end_s"] is None else w["push_end_s"]),
        wash=np.array(a["wash"]),
        induced=np.array(_induced(bare)),
        steps=np.array(a["output_steps"]),
        lighter=_craft(scenario if drops is None else empty, bare, full_speed, more),
        drops=np.array(faults.NEVER if drops is None else drops),
        changes=_changes(scenario, bare) if more else (),
    )


def _changes(scenario: Scenario, bare: Bare) -> outside.Changes:
    """What changes in the scenario besides."""
    a, w = scenario.airframe, scenario.outside
    return outside.Changes(
        push_ramp=np.array(w["push_ramp_s"]),
        twist=bare.J @ np.array(w["twist_rad_s2"], float),
        shift=np.array(a["shift_m"], float),
        shift_onset=np.array(a["shift_onset_s"]),
        shift_ramp=np.array(a["shift_ramp_s"]),
        lag_down=np.array(a["lag_down"]),
        falls=np.array(float(scenario.wind["falls"])),
    )


def _extra(scenario: Scenario, bare: Bare, mass: float, J: np.ndarray, shift: np.ndarray, hub: float) -> attached.Extra:
    """Legs, lines and what else is attached. mass [kg], J (3, 3) with payload; shift (3,): of its centre of mass; hub [m] above it."""
    a, w, n = scenario.airframe, scenario.outside, len(bare.x)
    legs = a["legs"] or attached.LEGS  # without, four feet stand for level ones
    leg = 0.5 * bare.arm if a["leg_m"] is None else a["leg_m"]
    out = 0.6 * bare.arm if a["leg_at_m"] is None else a["leg_at_m"]
    turn = np.radians(a["leg_turn_deg"]) + 2.0 * np.pi * (np.arange(attached.LEGS) + 0.5) / legs
    feet = np.stack([out * np.cos(turn), out * np.sin(turn), np.full(attached.LEGS, leg)], axis=1)
    hubs = np.stack([bare.x, bare.y, np.full(n, -hub)], axis=1)
    stands = np.concatenate([np.arange(attached.LEGS) < legs, np.ones(n)]).astype(float)
    stiff = mass * attached.CONTACT**2 / legs * np.ones(attached.LEGS + n)
    damp = 2.0 * attached.CONTACT_DAMPING * stiff / attached.CONTACT
    load, hook = a["slung_kg"], np.array([0.0, 0.0, a["hook_m"]]) - shift
    slow = 1.0 / mass + hook @ hook / np.diag(J).min()  # of the vehicle at its hook, per newton
    line_stiff = attached.LINE**2 / (slow + 1.0 / load) if load else 0.0
    line_damp = 2.0 * attached.LINE_DAMPING * line_stiff / attached.LINE
    tether = faults.NEVER if w["tether_m"] is None else w["tether_m"]
    tether_stiff = w["tether_stiffness"] * mass
    return attached.Extra(
        points=np.concatenate([feet, hubs]) - shift,
        stands=stands,
        stiff=stiff,
        damp=damp,
        grip=stiff,
        grip_damp=damp,
        friction=np.array(a["friction"]),
        floor=np.array(leg - shift[2]),
        drag_at=np.array(a["drag_at_m"], float) - shift,
        twist=np.zeros(3),
        hook=hook,
        load=np.array(load),
        line=np.array(a["sling_m"]),
        line_stiff=np.array(line_stiff),
        line_damp=np.array(line_damp),
        load_drag=np.array(0.01 * load * a["body_drag"]),
        tether=np.array(tether),
        anchor=np.array([*w["tether_at_m"], leg]),
        tether_stiff=np.array(tether_stiff),
        tether_damp=np.array(0.4 * np.sqrt(tether_stiff * mass)),
    )


def _board(a: Mapping[str, Any]) -> np.ndarray:
    """(3, 3) that takes vectors from the axes of the autopilot's board to the frame's: its roll, pitch and yaw in the frame."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (np.cos(angle), np.sin(angle)) for angle in (np.radians(a[f"board_{axis}_deg"]) for axis in ("roll", "pitch", "yaw"))
    )
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return yaw @ pitch @ roll


def _craft(scenario: Scenario, bare: Bare, full_speed: float, more: bool) -> dynamics.Craft:
    """The vehicle with its payload, about their common centre of mass. full_speed [rad/s] of the rotors. Raises ConfigError."""
    a, n, full = scenario.airframe, len(bare.x), bare.thrust_max.sum()
    total, J, shift = _loaded(bare.mass, bare.J, a["payload_kg"], np.array(a["payload_at_m"], float))
    mount, of_frame = _board(a), J
    J = mount.T @ J @ mount
    built = 1.0 + a["rotor_spread"] * np.random.default_rng([scenario.seed, 4]).uniform(-1.0, 1.0, n)
    if total * G0 > 0.9 * full:
        raise ConfigError(f"airframe.payload_kg: {total:.3g} kg are too much for {full:.3g} N of full thrust.")
    if (total + a["slung_kg"]) * G0 > 0.9 * full:
        raise ConfigError(f"airframe.slung_kg: {total + a['slung_kg']:.3g} kg are too much for {full:.3g} N of full thrust.")
    hub = 0.1 * bare.arm if a["hub_height_m"] is None else a["hub_height_m"]
    each = bare.mass * G0 / n
    # N s/m at full speed: hover thrust over induced velocity, at hover speed
    slope = each / _induced(bare) / np.sqrt(bare.hover)
    return dynamics.Craft(
        mass=np.array(total),
        J=J,
        J_inverse=np.linalg.inv(J),
        x=bare.x - shift[0],
        y=bare.y - shift[1],
        z=np.array(-hub - shift[2]),
        spin=bare.spin,
        thrust_max=bare.thrust_max * built,
        drag_ratio=np.array(bare.drag_ratio),
        expo=np.array(a["expo"]),
        lag=np.array(a["lag_s"]),
        rotor_momentum=np.array(_rotor_inertia(scenario, bare) * full_speed),
        k_d=np.array(0.1 * slope * a["rotor_drag"]),
        k_z=np.array(0.4 * slope * a["inflow"]),
        drag=a["body_drag"] * 0.01 * bare.mass * np.array([1.0, 1.0, 2.0]),
        radius=np.array(bare.radius),
        ground_effect=np.array(float(a["ground_effect"])),
        lean=np.zeros(n),
        mount=mount,
        push=np.zeros(3),
        push_z=np.array(0.0),
        extra=_extra(scenario, bare, total, of_frame, shift, hub) if more else (),
    )


def a_compensates(scenario: Scenario) -> bool:
    """True if the autopilot divides battery sag out of its commands: an ArduPilot may, PX4 does not."""
    return scenario.autopilot == "ardupilot" and bool(scenario.battery["compensated"])


def _inertia(a: Mapping[str, Any], known: dict | None, mass: float, arm: float) -> np.ndarray:
    if a["inertia_kg_m2"] is not None:
        diagonal = np.array(a["inertia_kg_m2"])
    elif known:
        diagonal = np.array(known["inertia"], float)
    else:
        diagonal = mass * (arm * np.array([0.4, 0.4, 0.55])) ** 2
        if a["length_to_width"] != 1.0:  # about x it is as wide as its width
            ratio = a["length_to_width"]
            diagonal[:2] *= np.array([2.0, 2.0 * ratio**2]) / (1.0 + ratio**2)
    if 2.0 * diagonal.max() > diagonal.sum() * (1.0 + 1e-9):
        raise ConfigError("airframe.inertia_kg_m2: no body has one moment of inertia larger than the sum of the others.")
    return np.diag(diagonal)


def _gap(x, y) -> float:
    """Distance between neighbouring hubs that are not on the same arm."""
    d = np.hypot(x[:, None] - x, y[:, None] - y)
    return float(d[d > 0.05 * d.max()].min())


def _loaded(mass, J, payload, at):
    """Mass, inertia about the common centre of mass and its position, of a vehicle with a point mass at `at`."""
    total = mass + payload
    shift = payload / total * at

    def offset(m, r):
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    return total, J + offset(mass, -shift) + offset(payload, at - shift), shift


def _up_and_down(scenario: Scenario, more: bool) -> trajectories.Trajectory:
    """Take-off, manoeuvre, and landing if the scenario has one."""
    w, landing = scenario.trajectory, faults.NEVER
    slow_speed = w["slow_m_s"] or trajectories.DESCENT
    if w["land"]:
        landing = scenario.duration_s - w["altitude_m"] / trajectories.DESCENT - 5.0 - w["rest_s"]
        if more:
            down = trajectories.down_time(w["altitude_m"], w["slow_m"], slow_speed)
            landing = scenario.duration_s - down - w["cut_s"] - 3.0 - w["rest_s"]
    made = way(scenario, w["altitude_m"], w["take_off_s"], landing)
    if not more:
        return made
    to, hops = np.radians(w["drift_to_deg"]), w["hops"]
    levels = faults.NEVER if w["levels_s"] is None else w["levels_s"]
    drift = w["drift_m_s"] * np.array([np.cos(to), np.sin(to)])
    numbers = (w["slow_m"], slow_speed, drift, w["cut_s"], hops, w["hop_m"], w["hop_s"], w["hop_rest_s"], levels)
    return made._replace(approach=trajectories.Approach(*(np.array(v, float) for v in numbers)))


def way(scenario: Scenario, altitude: float, take_off: float, landing: float) -> trajectories.Trajectory:
    """The scenario's manoeuvre at `altitude` [m] above where it begins, between those times [s]."""
    w = scenario.trajectory
    return trajectories.Trajectory(
        kind=np.array(trajectories.KINDS.index(w["kind"]), np.int32),
        altitude=np.array(altitude),
        size=np.array(w["size_m"]),
        speed=np.array(w["speed_m_s"]),
        yaw=np.radians(w["yaw_deg"]),
        yaw_speed=np.radians(w["yaw_speed_deg_s"]),
        take_off=np.array(take_off),
        landing=np.array(landing),
        turn=np.array(w["turn_s"]),
        spool=np.array(w["spool_s"]),
        rest=np.array(w["rest_s"]),
    )


def air(scenario: Scenario, arm: float) -> wind.Wind:
    """The scenario's wind, for a vehicle of that half span [m]."""
    w, flown = scenario.wind, scenario.trajectory
    airspeed = flown["speed_m_s"] if flown["kind"] in MOVING else 0.0
    speed = w["speed_m_s"]
    return wind.dryden(speed, w["from_deg"], w["turbulence"], flown["altitude_m"], np.hypot(speed, airspeed), 2.0 * arm)


def _battery(scenario: Scenario, thrust: float, hover: float) -> Battery:
    b = scenario.battery
    full, empty = 4.2 * b["cells"], b["empty_V"] * b["cells"]
    amps = thrust * WATT_PER_NEWTON / full
    hovering = amps * hover**1.5
    charge = 3600.0 * b["capacity_Ah"] if b["capacity_Ah"] else hovering * b["hover_min"] * 60.0
    resistance = SAG * full / amps if b["resistance_ohm"] is None else b["resistance_ohm"]
    return Battery(*(np.array(float(v)) for v in (full, empty, charge, resistance, amps)))


def sensors(scenario: Scenario, full_speed: float) -> Sensors:
    """The scenario's sensors, biases drawn, on a vehicle whose rotors turn with full_speed [rad/s] at most."""
    s = scenario.sensors
    rng = np.random.default_rng([scenario.seed, 1])
    gyro_bias, accel_bias = s["gyro_bias"] * rng.standard_normal(3), s["accel_bias"] * rng.standard_normal(3)
    # One-sided densities: a step of dt passes 1 / (2 dt), a first-order filter pi / 2 of its corner.
    gyro_sd = s["gyro_noise"] * np.sqrt(scenario.rate_hz / 2.0)
    accel_sd = s["accel_noise"] * np.sqrt(0.5 * np.pi * s["accel_filter_hz"])
    return Sensors(
        gyro_sd=np.array(gyro_sd),
        accel_sd=np.array(accel_sd),
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        accel_cut=np.array(2.0 * np.pi * s["accel_filter_hz"]),
        shake=np.array(s["vibration"]),
        full_turns=np.array(full_speed / (2.0 * np.pi)),
        rattle=np.array(0.01),
        attitude_sd=np.array(0.002),
        velocity_sd=np.array(0.03),
        position_sd=np.array(0.02),
    )


def broken(scenario: Scenario, rotors: int) -> faults.Faults:
    """The scenario's faults as numbers."""
    table = {k: np.array(v, float) for k, v in faults.none(rotors)._asdict().items()}
    for k, f in enumerate(scenario.faults):
        kind, held = f["kind"], faults.HELD if f["kind"] == "stuck" else 1.0
        frozen = {"frozen": 1.0, "level": held if f["level"] is None else f["level"]}
        row = {
            "loss": {"loss": f["strength"]}, "chipped": {"loss": f["strength"], "shake": f["vibration"]},
            "complete loss": {"loss": 1.0}, "bias": {"bias": f["strength"]}, "stuck": frozen, "saturated": frozen,
            "strong": {"loss": None if f["strength"] is None else -f["strength"]}, "capped": {"ceiling": f["level"]},
            "slow": {"slower": f["times"] - 1.0}, "tilt": {"lean": np.sin(np.radians(f["angle_deg"] or 0.0))},
            "float": {"undriven": 1.0}, "weak motor": {"weak": f["strength"]}, "bearing": {"friction": f["strength"]},
        }[kind]  # fmt: skip
        row |= {"onset": f["onset_s"], "ramp": f["ramp_s"], "end": f["end_s"], "period": f["period_s"]}
        row["duty"] = 1.0 if f["period_s"] is None else f["duty"]
        for name, value in row.items():
            if value is not None:
                table[name][k] = value
        table["rotor"][k, f["rotor"] - 1] = 1.0
    return faults.Faults(**table)
