"""Consistency tests of a log, before any evaluation: does the log show what flew?

Each test takes a `Case` and gives one sentence when the log cannot be what flew, else None. Any such sentence makes the answer
`inconclusive`: conclusions from outputs that did not reach the motors are unfounded. The tests look for contradictions that no healthy or
faulty flight shows; docs/limits.md has the rate of false alarms of each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median, quantile
from rotorwatch.base.physics import G0
from rotorwatch.engine.motion import inertial, mixing, order, turning
from rotorwatch.engine.motion.allocation import within
from rotorwatch.engine.motion.tick_table import Ticks
from rotorwatch.flight import Flight, Signal, output_functions
from rotorwatch.flight.vehicle import Vehicle

Spans = tuple[tuple[float, float], ...]

# A controller responds before its vehicle has turned by this much: outputs that rest longer did not fly it.
STILL_S, STILL_RAD = 1.0, 1.0
# ... nor do outputs rest for this long, over so many samples, within an output's resolution, unless the air is dead calm.
STILL_LONG_S, STILL_LONG_RAD, STILL_SAMPLES = 5.0, 0.2, 25
# rad/s and m/s^2, means of half a second: beyond the range of autopilots' gyros (2000 deg/s) and the strength of airframes
WILD_RATE, WILD_FORCE, WILD_S = 60.0, 20.0 * G0, 0.5
SCALE = 2.5  # factor by which the magnitude of the specific force may differ from one g where the attitude is unknown
NEARER = 2.0**0.5  # beyond this factor a scale is closer to a half or a double than to the right one
FASTEST_FALL = 15.0  # m/s: largest difference of a multirotor's vertical speed between two times
# Outputs may exceed their range by this share of it, in this share of a flight; share of a flight in which they are below all of it
BEYOND, SELDOM, MOSTLY = 0.1, 0.01, 0.95
ALIKE = 0.5  # correlation of two measurements of one motion
# Hover thrusts of one rotor, per rotor and rad/s^2: the smallest vehicles need no less (radius of gyration 2 cm, arms of 3 cm), large
# ones no more.
LEAST_GAIN, MOST_GAIN = 0.001, 0.02
# Torque required by the motion: so many times the one commanded, and so many hover thrusts. Vibration looks like less.
HARDER, HARD = 3.0, 0.05
# rad/s^2 and rad/s of roll or pitch: motion beyond the gyro's noise or dead calm
PLAIN, PLAIN_RATE = 0.3, 0.03
HELD = 0.05  # share of the motion that commands would give a large vehicle, below which it does not follow them: it stands, or is held
LONG_S = 30.0  # of flight, before commands are compared with motion
SLOWEST_S = 0.1  # longest ticks in which commands and the motion they cause can be compared
SHIFTS = 40  # number of comparisons of commands with motion at wrong times
SIGNIFICANT = 2.5  # standard deviations of those comparisons
# Change from one attitude or position to the next, how many times that over two samples, and in which share of the samples
APART_RAD, APART_M, AWAY, ALTERNATES = 0.1, 1.0, 4.0, 0.05
BLOCK = 1 << 14  # samples processed at a time
APART_S, LAG_S, LEAST_PARTS = (5.0, 0.1, 3)  # range and step of the lags between gyro and attitude; smallest number of parts of a flight
THE_SAME = 0.8  # correlation of two measurements at a lag above which the lag is real
GYRO_UNITS = {"degrees/s": np.degrees(1.0), "mrad/s": 1e3, "turns/s": 0.5 / np.pi}
GEOMETRY = ("FRAME_CLASS", "FRAME_TYPE", "CA_ROTOR_COUNT", "CA_AIRFRAME", "SYS_AUTOSTART", "MAV_TYPE")


@dataclass(frozen=True, eq=False, repr=False)
class Case:
    """A log under test: the flight, its vehicle, when it was airborne, and its ticks. alike: of `_alike`, by pair of axes."""

    flight: Flight
    vehicle: Vehicle
    air: Spans
    table: Ticks
    alike: dict = field(default_factory=dict)

    @cached_property
    def mixing(self) -> mixing.Mixing | None:
        """Outputs and the rate controller's demand."""
        return mixing.mixing(self.flight, self.vehicle, self.air)

    @cached_property
    def another_order(self) -> str | None:
        """Outputs that follow the mixer's demand on other rotors."""
        return mixing.outputs_in_another_order(self.mixing)

    @cached_property
    def turning(self) -> Signal | None:
        """Angular rates."""
        return self.flight.angular_rate()

    @cached_property
    def turns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`inertial.turns` of attitude and gyro at the same time."""
        return inertial.turns(self.flight["attitude"], self.flight["gyro"], self.air)

    @cached_property
    def flying(self) -> np.ndarray:
        """(T,) ticks in the air, upset or not."""
        return self.table.mode > 0


def contradictions(
    flight: Flight, vehicle: Vehicle, air: Spans, table: Ticks, progress: Callable[[float], object] | None = None
) -> tuple[str, ...]:
    """Sentences of all tests that fail, on why the log cannot be what flew; empty when nothing contradicts it. progress: called with the
    finished share, 0..1."""
    case, found = Case(flight, vehicle, air, table), []
    for done, test in enumerate(TESTS, 1):
        found += [why] if (why := test(case)) else []
        if progress:
            progress(done / len(TESTS))
    return tuple(found)


def two_publishers(case: Case) -> str | None:
    """Outputs of two publishers that both move: which of them reached the motors is unknown."""
    if case.flight.facts.get("publishers", 1) > 1:
        return "the motor outputs in this log come from two publishers at once, and the log does not show which of them drove the motors."
    return None


def two_flights(case: Case) -> str | None:
    """Attitudes or positions that often jump away and back from one sample to the next: records of two flights in one log."""
    for name, least in (("attitude", APART_RAD), ("position", APART_M)):
        if not case.flight.has(name):
            continue
        values, often = case.flight[name].wholes().values, 0
        for start in range(0, len(values) - 2, BLOCK):
            part = values[start : start + BLOCK + 2]
            part = _axes(part) if name == "attitude" else part  # q and -q are one attitude: compare its axes
            away, back = (np.linalg.norm(part[k:] - part[:-k], axis=1) for k in (1, 2))
            away = np.minimum(away[1:], away[:-1])
            often += int(np.count_nonzero((away > least) & (away > AWAY * back)))
        if len(values) >= 100 and often > ALTERNATES * len(values):
            return f"two series of {name} alternate in this log: it mixes records of two flights or of two vehicles."
    return None


def _axes(q: np.ndarray) -> np.ndarray:
    """(n, 6) first and third body axes in the world, of quaternions (n, 4) body to world."""
    w, x, y, z = q.T
    forward = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
    down = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
    return np.stack([*forward, *down], axis=1)


def clock_jumped(case: Case) -> str | None:
    """A clock that was set in the air: commands and motion around the jump cannot be ordered."""
    when = [t for t in case.flight.facts.get("clock_jumps", ()) if within(np.array([t]), case.air).any()]
    if when:
        return f"the log's clock jumps at {when[0]:.1f} s, in the air: commands and motion cannot be put in order."
    return None


def another_airframe(case: Case) -> str | None:
    """Parameters of the airframe that change between the first take-off and the last landing: two logs, or two vehicles, in one file."""
    start, end = case.air[0][0], case.air[-1][1]
    for time, name, value in case.flight.parameter_changes:
        output = output_functions.function(name, value)
        if (name in GEOMETRY or (output is not None and output.motor)) and start <= time <= end:
            return (
                f"the airframe changes after take-off ({name} becomes {value:g} at {time:.1f} s): the log is not of one vehicle; diagnose "
                "its flights one by one."
            )
    return None


def frame_without_outputs(case: Case) -> str | None:
    """A frame with fewer rotors than outputs that move like motors: it is not the one that flew."""
    left = case.flight.facts.get("outputs_left_out")
    if not left:
        return None
    return (
        f"the frame {case.vehicle.name} has {len(case.vehicle.rotors)} rotors, but output{'s' if len(left) > 1 else ''} "
        f"{', '.join(map(str, left))} move{'' if len(left) > 1 else 's'} as a motor's: it is not the frame that flew. Give the right one "
        "with --vehicle FILE."
    )


def outputs_in_another_order(case: Case) -> str | None:
    """Outputs that follow the mixer's demand on other rotors."""
    return case.another_order


def outputs_of_another_mixer(case: Case) -> str | None:
    """Outputs that follow the rate controller by another mixer than the frame's, in whatever order."""
    return None if case.another_order else mixing.outputs_of_another_mixer(case.mixing)


def outputs_of_another_range(case: Case) -> str | None:
    """Outputs whose thrust, by the curve of the parameters, is not the rate controller's demand."""
    return mixing.outputs_of_another_range(case.mixing)


def outputs_that_never_move(case: Case) -> str | None:
    """Outputs that stand still through a flight in which the others move."""
    return mixing.outputs_that_never_move(case.flight, case.air)


def wild_motion(case: Case) -> str | None:
    """Rates or accelerations that no vehicle survives, for half a second: wrong units, or invalid sensor values."""
    for name, limit, what, unit in (("gyro", WILD_RATE, "turns at", "rad/s"), ("accel", WILD_FORCE, "accelerates at", "m/s^2")):
        if not case.flight.has(name):
            continue
        width, most, at = max(1, round(WILD_S * case.flight[name].rate_hz)), 0.0, 0.0
        before, sizes = np.zeros(0), np.zeros(0)
        for time, size in _lengths(case.flight[name], case.air):
            time, size = np.concatenate([before, time]), np.concatenate([sizes, size])
            smooth = _mean_of_next(size, width)
            if smooth.size and smooth.max() > most:
                most, at = float(smooth.max()), float(time[int(np.argmax(smooth))])
            before, sizes = time[len(smooth) :], size[len(smooth) :]
        if most > limit:
            return f"the vehicle {what} {most:.0f} {unit} at {at:.1f} s, which no vehicle survives: its {name} or its unit is wrong."
    return None


def weightless(case: Case) -> str | None:
    """Specific force that, over a flight, is not one g upwards: wrong unit, or another sensor.

    Its vertical component is one g on average, except for changes of the vehicle's speed; its magnitude is larger where the vehicle
    shakes or turns.
    """
    if not case.flight.has("accel"):
        return None
    parts = [(time[[0, -1]], size) for time, size in _lengths(case.flight["accel"], case.air)]
    size = np.concatenate([size for _, size in parts]) if parts else np.zeros(0)
    if size.size < 50:
        return None
    typical, lasts = float(median(size)) / G0, float(parts[-1][0][1] - parts[0][0][0])
    del size
    wrong = not 1.0 / SCALE < typical < SCALE and lasts >= LONG_S
    if not wrong and case.flight.has("attitude"):
        up = _upwards(case.flight["accel"], case.flight["attitude"], case.air)
        speed = FASTEST_FALL / (G0 * lasts)
        wrong = max(typical, up + speed) < 1.0 / NEARER or min(typical, up - speed) > NEARER
    if not wrong:
        return None
    return f"the accelerometer shows {typical:.3g} g over the flight instead of 1 g: its unit is not m/s^2, or it is of another vehicle."


def attitude_against_gyro(case: Case) -> str | None:
    """Gyro and attitude that do not show the same rotations: same magnitude, sign and time."""
    if not case.flight.has("gyro", "attitude"):
        return None
    _, turned, (rate,) = case.turns
    if len(rate) < 50:
        return None
    # Over most of the flight: knocks and a crash saturate sensors.
    bound = 5.0 * median(np.abs(rate)) + 1.0, 5.0 * median(np.abs(turned)) + 1.0
    calm = (np.abs(rate) < bound[0]).all(axis=1) & (np.abs(turned) < bound[1]).all(axis=1)
    rate, turned = rate[calm], turned[calm]
    if len(rate) < 50:
        return None
    moving = np.sqrt(np.mean(rate**2)) > inertial.MOVING / SCALE and np.sqrt(np.mean(turned**2)) > inertial.MOVING
    size = np.sqrt(np.sum(rate**2, axis=0) * np.sum(turned**2, axis=0))
    alike = float((np.sum(rate * turned, axis=0) / np.maximum(size, 1e-12)).max())
    if moving and alike < ALIKE:
        return "gyro and attitude show different rotations: they are not of one vehicle, one clock or one coordinate frame."
    low, high = min((inertial.scale(rate[:, k], turned[:, k]) for k in range(3)), key=lambda one: one[1] / one[0])
    if low <= NEARER and high >= 1.0 / NEARER:
        return None
    units = [name for name, factor in GYRO_UNITS.items() if low < factor * NEARER and high > factor / NEARER]
    why = f"it seems to be in {units[0]} instead of rad/s." if units else "one of them is in a wrong unit, or is of another vehicle."
    return f"the gyro turns {(low * high) ** 0.5:.3g} times as fast as the attitude: {why}"


def gyro_axes(case: Case) -> str | None:
    """A gyro with exchanged or reversed axes: one of the 48 permutations makes its rotations those of the attitude, or of the rates used
    by the controller, far better than the unchanged axes."""
    if not case.flight.has("gyro"):
        return None
    if case.flight.has("attitude"):
        _, turned, (rate,) = case.turns
        if why := inertial.other_axes(rate, turned, "the attitude"):
            return why
    used = case.flight.signals.get("rates")
    if used is None or used.source == case.flight["gyro"].source or used.source.endswith(turning.MADE):
        return None
    return inertial.other_axes(*inertial.together(case.flight["gyro"], used, case.air), "the rates that the controller used")


def two_clocks(case: Case) -> str | None:
    """Gyro and attitude that show the same rotations at different times: in most parts of the flight, in calm air as well."""
    if not case.flight.has("gyro", "attitude"):
        return None
    when, (alike,) = inertial.alike_at(case.turns)
    differ = alike.max(axis=1) < ALIKE
    if differ.sum() < LEAST_PARTS or differ.mean() < 0.5:
        return None
    lags = np.arange(-APART_S, APART_S + 0.5 * LAG_S, LAG_S)
    alike = inertial.alike_at(inertial.turns(case.flight["attitude"], case.flight["gyro"], case.air, lags))[1].max(axis=2)
    found = differ & (alike.max(axis=0) > THE_SAME)
    when, apart = when[found], lags[alike.argmax(axis=0)][found]
    if found.sum() < LEAST_PARTS or found.mean() < 0.5:
        return None
    if median(np.abs(apart - np.polyval(np.polyfit(when, apart, 1), when))) > 2.0 * LAG_S:
        return None
    least, most = (f"{value:.1f}" for value in sorted(np.abs(apart[[0, -1]])))
    far = most if least == most else f"{least} to {most}"
    return f"gyro and attitude show the same rotations {far} s apart: they are not on one clock."


def outputs_beyond_range(case: Case) -> str | None:
    """Outputs far above the stated full thrust, or mostly below the stated zero: that range is not the one that flew, so no thrust is
    known."""
    motors, curve = case.flight["motors"], case.vehicle.curve
    inside = within(motors.time, case.air) & motors.whole
    if inside.sum() < 50:
        return None
    highest = motors.values[inside].max(axis=1)
    if (usual := quantile(highest, MOSTLY)) <= curve.u_min:
        return (
            f"the motor outputs stay at {usual:.4g} and below in the air, but {curve.u_min:.4g} is given as zero thrust: the range of the "
            "outputs is wrong in the parameters or in the vehicle file."
        )
    reached = quantile(highest, 1.0 - SELDOM)
    if reached < curve.u_max + BEYOND * (curve.u_max - curve.u_min):
        return None
    return (
        f"the motor outputs reach {reached:.4g}, but {curve.u_max:.4g} is given as full thrust: the range of the outputs is wrong in the "
        "parameters or in the vehicle file."
    )


def outputs_at_rest(case: Case) -> str | None:
    """Outputs that stand still while the vehicle turns: something else drove the motors."""
    motors, curve = case.flight["motors"], case.vehicle.curve
    inside = within(motors.time, case.air) & motors.whole
    time, values = motors.time[inside], motors.values[inside]
    if time.size < 5:
        return None
    moved = (np.abs(np.diff(values, axis=0)) > 1e-6 * (curve.u_max - curve.u_min)).any(axis=1)
    starts = np.concatenate([[0], np.flatnonzero(moved) + 1])
    ends = np.concatenate([starts[1:], [time.size]]) - 1
    span = 0.02 * (curve.u_max - curve.u_min)
    long_enough = (ends - starts >= 4) & (time[ends] - time[starts] >= STILL_S)
    for a, b in zip(starts[long_enough], ends[long_enough]):
        seconds = float(time[b] - time[a])
        # Motors that are off, or all at their limits, may rest.
        if ((values[a] > curve.u_min + span) & (values[a] < curve.u_max - span)).mean() <= 0.5:
            continue
        angle = _angle(case.turning, float(time[a]), float(time[b]))
        long = seconds > STILL_LONG_S and b - a >= STILL_SAMPLES and angle > STILL_LONG_RAD
        if angle > STILL_RAD or long:
            return (
                f"the motor outputs in the log do not change from {time[a]:.1f} to {time[b]:.1f} s while the vehicle turns by "
                f"{np.degrees(angle):.0f} deg: they did not drive the motors, so nothing can be concluded from them."
            )
    return None


def motion_without_command(case: Case) -> str | None:
    """Angular acceleration that requires more torque than was commanded, through most of a flight and uncorrelated with the commands."""
    sizes = [_coherence(case, axis) for axis in (0, 1)]
    if any(s is None for s in sizes):
        return None
    if all(s.needed > max(HARDER * s.commanded, HARD) and s.alike < ALIKE for s in sizes if s):
        return "the vehicle rotates harder than its motor outputs can make it: they did not drive the motors."
    return None


def command_without_effect(case: Case) -> str | None:
    """Commands that explain no motion on any axis: they fit the motion no better than at wrong times. With hardly any motion the test is
    void, unless the commands demand a lot of it."""
    if not case.flight.has("gyro"):
        return None
    found = [c for axis in range(3) if (c := _coherence(case, axis)) is not None]
    if len(found) < 3 or max(c.sigmas for c in found) > SIGNIFICANT:
        return None
    least = PLAIN * LEAST_GAIN * case.table.thrust.shape[1]
    rates = np.abs(case.table.rate[case.flying][:, :2])
    still = quantile(rates, 0.8) < PLAIN_RATE
    if all(c.needed > HELD * LEAST_GAIN / MOST_GAIN * c.commanded and (still or c.needed < least) for c in found[:2]):
        return None
    return "the motor outputs do not explain the motion of the vehicle: they are of another vehicle, another time or another airframe."


def outputs_of_other_rotors(case: Case) -> str | None:
    """Outputs that the vehicle's motion follows in another order than the frame's."""
    rotors = None if mixing.confirmed(case.mixing) else order.followed(case.table, case.vehicle.effectiveness())
    if rotors is None:
        return None
    moved = [f"output {k + 1} as motor {rotor + 1}" for k, rotor in enumerate(rotors) if rotor != k]
    return f"the motor outputs drive other rotors than assumed: the vehicle moves by {', '.join(moved)}."


class Coherence(NamedTuple):
    """Commanded torque and angular acceleration of one axis. alike: correlation, -1..1, at the best lag; sigmas: excess over that at
    wrong times, in standard deviations; needed, commanded: usual magnitude of the torque that the motion requires at least, and of the
    commanded one (hover thrusts)."""

    alike: float
    sigmas: float
    needed: float
    commanded: float


def _coherence(case: Case, axis: int, commanded: int | None = None, sign: float = 1.0) -> Coherence | None:
    """Coherence of an axis' motion with the torque commanded on it, or on the axis `commanded`, times a sign. None where the flight is
    too short or logged too slowly. Trim, over a second, is removed."""
    table = case.table
    if (case.flying & table.valid[:, axis]).sum() * table.dt < LONG_S or table.dt > SLOWEST_S:
        return None
    commanded = axis if commanded is None else commanded
    if (axis, commanded) not in case.alike:
        case.alike[axis, commanded] = _alike(case, axis, commanded)
    alike_at, usual = case.alike[axis, commanded]
    needed = LEAST_GAIN * table.thrust.shape[1] * usual[1]
    if alike_at is None:
        return Coherence(0.0, 0.0, needed, usual[0]) if usual[1] > 1.0 else None
    count, lags = len(alike_at), np.arange(max(2, round(0.3 / table.dt)))
    step = count // (SHIFTS + 2)
    if step * table.dt < 0.5:
        return None
    shifts = step * np.arange(SHIFTS + 1)[:, None]
    alike, *others = (sign * alike_at[(shifts + lags) % count]).max(axis=1)
    elsewhere = np.array(others)
    return Coherence(float(alike), float((alike - elsewhere.mean()) / max(elsewhere.std(), 1e-3)), needed, usual[0])


def _alike(case: Case, axis: int, commanded: int) -> tuple[np.ndarray | None, tuple[float, float]]:
    """(correlation of an axis' motion with a commanded torque at every circular shift (T,), usual magnitudes of command and motion); None
    where one of these is zero."""
    table, ok = case.table, case.flying & case.table.valid[:, axis]
    width = max(3, round(1.0 / table.dt))
    columns = table.wrench[:, commanded], table.rate_dot[:, axis]
    command, motion = (np.where(ok, _without_trim(np.where(ok, x, 0.0), width), 0.0) for x in columns)
    # Clip to the usual size: one knock must not dominate a flight.
    usual = quantile(np.abs(command[ok]), 0.8), quantile(np.abs(motion[ok]), 0.8)
    if min(usual) <= 0.0:
        return None, usual
    command, motion = (np.clip(x, -3 * size, 3 * size) for x, size in zip((command, motion), usual))
    sizes = max(np.sqrt(np.sum(command * command) * np.sum(motion * motion)), 1e-12)
    # At every shift at once; not products of one shift after the other, which BLAS would spread over busy processors.
    return np.fft.irfft(np.fft.rfft(motion) * np.conj(np.fft.rfft(command)), len(command)) / sizes, usual


def _without_trim(x: np.ndarray, width: int) -> np.ndarray:
    return x - np.convolve(x, np.ones(width) / width, "same")


def _lengths(signal: Signal, air: Spans) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(time, magnitude) of a vector signal's valid samples in the air, in blocks."""
    for start in range(0, len(signal), BLOCK):
        some = signal.part(slice(start, start + BLOCK))
        ok = within(some.time, air) & some.whole
        if ok.any():
            yield some.time[ok], np.sqrt(np.einsum("ij,ij->i", some.values, some.values))[ok]


def _mean_of_next(x: np.ndarray, width: int) -> np.ndarray:
    """Mean of each value and those after it, `width` in all; only for values followed by enough others."""
    total = np.cumsum(np.concatenate([[0.0], x]))
    return (total[width:] - total[:-width]) / width


def _upwards(accel: Signal, attitude: Signal, air: Spans) -> float:
    """Mean specific force against gravity in the air, in g; 0 where no attitude is valid."""
    ok, attitude = within(accel.time, air) & accel.whole, attitude.wholes()
    if not len(attitude):
        return 0.0
    total = 0.0
    for start in range(0, len(accel), BLOCK):
        part = slice(start, start + BLOCK)
        when, force = accel.time[part][ok[part]], accel.values[part][ok[part]]
        if when.size:
            first, last = np.searchsorted(attitude.time, when[[0, -1]])
            near = attitude.part(slice(max(int(first) - 1, 0), int(last) + 1))
            w, x, y, z = near.values.T
            for axis, down in enumerate((2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))):
                total += float((np.interp(when, near.time, down) * force[:, axis]).sum())
    return -total / float(ok.sum()) / G0


def _angle(gyro: Signal | None, start: float, end: float) -> float:
    """Angle in rad that the vehicle turned through, back and forth counted alike; NaN without a gyro."""
    if gyro is None or len(part := gyro.between(start, end)) < 2:
        return np.nan
    rate = np.linalg.norm(part.values, axis=1)
    # The trapezoidal rule, whose name changed with NumPy 2.
    return float(np.diff(part.time) @ (rate[1:] + rate[:-1]) / 2)


TESTS = (
    two_publishers,
    two_flights,
    clock_jumped,
    another_airframe,
    frame_without_outputs,
    outputs_beyond_range,
    wild_motion,
    weightless,
    two_clocks,
    gyro_axes,
    attitude_against_gyro,
    outputs_at_rest,
    outputs_in_another_order,
    outputs_of_another_mixer,
    outputs_of_another_range,
    outputs_that_never_move,
    motion_without_command,
    outputs_of_other_rotors,
    command_without_effect,
)
