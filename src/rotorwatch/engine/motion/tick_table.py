"""From a log's uneven samples to the diagnoser's ticks: the definitions of the front end over a whole flight, as one table.

A tick at time t uses nothing measured after t. Units: thrusts in hover thrusts of one rotor (the mean command that carries the weight is
1), found from the first second in the air and then kept for that flight. All frames body FRD.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.compiling.running import Rows
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.definition import ENGINE, Part, craft, pieces
from rotorwatch.engine.events import calls
from rotorwatch.engine.intake import sense as cutting
from rotorwatch.engine.intake import ticks as definition
from rotorwatch.engine.intake.planning import (
    LAG_S,
    LATE_PERIODS,
    READY_KNOWN_S,
    READY_S,
    READY_TICKS,
    SHORTEST_S,
    TICKS_S,
    half_averaged,
    ready_after,
    ready_within,
    samples_in,
    tick_length,
)
from rotorwatch.engine.intake.sense import LATE_S, SIDE_S
from rotorwatch.engine.intake.ticks import AGAIN, ASSESS, GROUND, HOVER_LEARN_S, LEARN
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.knocks import Contact, contacts, look_back
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle

__all__ = ["AGAIN", "ASSESS", "GROUND", "HOVER_LEARN_S", "LATE_S", "LEARN", "READY_KNOWN_S", "READY_S", "READY_TICKS", "SIDE_S", "TICKS_S"]

EARLIEST_TICKS = 2  # duration of an announcement: engine/estimator/announcement.py
ROOM = 512  # ticks, or rows, in one call


@dataclass(frozen=True, eq=False, repr=False)
class Ticks:
    """T ticks of an n-rotor flight.

    time (T,) s, when the whole tick was known. command_time (T,) s, mean time of its commands. thrust (T, n); wrench (T, 4) = B thrust;
    rate, rate_dot (T, 3) rad/s, rad/s^2; load (T,) specific force up / g0; valid (T, 4) bool; mode (T,) GROUND, LEARN or ASSESS; restart
    (T,) bool, first tick of a hop; dt s; hover (T,) mean share of full thrust per rotor per unit of thrust; side (T, 2): specific force
    forward and right [m/s^2], mean of the last SIDE_S, or None where not measured. contact (T,) bool: an external force or torque acted
    on the vehicle, and for `ready_s` after it its trim is learned again (None: no contact); contacts: their description. seen (T,) bool:
    a tick with commands, else thrust is 0. curve: expo of the thrust curve used, and its standard deviation. axial (T,): speed along the
    thrust axis [m/s], positive when climbing along it, NaN where velocity or attitude are unknown (None: nowhere known).
    """

    time: np.ndarray
    command_time: np.ndarray
    thrust: np.ndarray
    wrench: np.ndarray
    rate: np.ndarray
    rate_dot: np.ndarray
    load: np.ndarray
    valid: np.ndarray
    mode: np.ndarray
    restart: np.ndarray
    hover: np.ndarray
    dt: float
    upset: np.ndarray
    notes: tuple[str, ...] = ()
    side: np.ndarray | None = None
    contact: np.ndarray | None = None
    contacts: tuple[Contact, ...] = ()
    seen: np.ndarray | None = None
    curve: tuple[float, float] = (0.0, 0.0)
    axial: np.ndarray | None = None

    def part(self, keep: np.ndarray | slice) -> Ticks:
        """The ticks `keep` (T,) bool, or from one to another."""
        return replace(self, **{k: v[keep] for k, v in vars(self).items() if isinstance(v, np.ndarray)})


def joined(parts: Sequence[Ticks]) -> Ticks:
    """Consecutive ticks in one table; a single one as it is. A column missing from one part is missing from the whole, except contacts."""
    if len(parts) == 1:
        return parts[0]
    columns = {}
    for name, last in vars(parts[-1]).items():
        values = [getattr(p, name) for p in parts]
        if name == "contact" and any(v is not None for v in values):
            values = [np.zeros(len(p.time), bool) if p.contact is None else p.contact for p in parts]
        array = all(isinstance(v, np.ndarray) for v in values)
        columns[name] = np.concatenate(values) if array else None if isinstance(last, np.ndarray) else last
    return Ticks(**columns)


def length_of(flight: Flight) -> float:
    """Length of a tick of a log with motor outputs [s]."""
    return tick_length(flight["control" if allocation.faster_control(flight) else "motors"].rate_hz)


def slow(rate_hz: float, dt: float, ready_s: float) -> str:
    """A sentence on the limits of slow ticks; empty where they are not slow."""
    if dt <= SHORTEST_S / 2.0:
        return ""
    return (
        f"motor outputs at {rate_hz:.1f} Hz are assessed every {dt:g} s, after {ready_s:.0f} s of learning: a loss is announced when it "
        f"shows in {EARLIEST_TICKS} of these, {EARLIEST_TICKS * dt:g} s; one that ends sooner is missed, and a small one may be missed"
    )


def ready_of(ready_s: float, air: Sequence[tuple[float, float]]) -> float:
    """`planning.ready_within` of a whole log that was in the air at these times ((start, end), ...) s."""
    return ready_within(ready_s, max((end - start for start, end in air), default=np.inf))


def _period(signal: Signal) -> float:
    """Usual time between two known samples, s; NaN with fewer than two."""
    time = signal.time[signal.whole]
    steps = np.diff(time)
    return float(median(steps[steps > 0])) if (steps > 0).any() else np.nan


class Plan(NamedTuple):
    """Division of a flight into ticks, fixed by its sampling rates.

    dt: length of a tick; ready_s: blind time after lift-off; lag_s; first: end of the first tick [all s]. gyro: signal with angular
    rates, or None. accel: the log has one. half: signal -> half of its averaging time; period: signal -> usual time between samples [s].
    notes: sentences on missing data.
    """

    dt: float
    ready_s: float
    lag_s: float
    first: float
    gyro: str | None
    accel: bool
    half: dict[str, float]
    period: dict[str, float]
    notes: tuple[str, ...]


def plan(flight: Flight, thrust: Signal, ready_s: float, lag_s: float = LAG_S, dt: float | None = None) -> Plan:
    """The plan of a flight with these commands; see `make`."""
    dt = tick_length(thrust.rate_hz) if dt is None else dt
    ready_s, half = ready_after(ready_s, dt), dt / 2.0
    notes = []
    if limit := slow(thrust.rate_hz, dt, ready_s):
        notes.append(limit)
    # Slow commands are single samples: put them in the middle of their ticks so that jitter never empties one.
    turns = np.exp(2j * np.pi * thrust.time[:64] / dt)  # the first seconds decide, so that a longer log changes nothing
    phase = float(np.angle(turns.mean()) / (2.0 * np.pi) % 1.0 * dt) if thrust.rate_hz < 1.5 / dt else 0.0
    gyro = "gyro" if flight.has("gyro") else "rates" if flight.has("rates") else None
    if gyro is None:
        notes.append("no angular rate in the log: torque is assessed from commands alone, as in steady hover")
    if not flight.has("accel"):
        notes.append("no accelerometer in the log: only torque is assessed, not thrust")
    motion = [name for name in (gyro, "accel" if flight.has("accel") else None) if name]
    return Plan(
        dt, ready_s, lag_s, float(np.floor((thrust.time[0] - phase) / dt) * dt + phase + half), gyro, flight.has("accel"),
        {name: half_averaged(dt, thrust.rate_hz, flight[name].rate_hz) for name in motion},
        {name: _period(flight[name]) for name in motion}, tuple(notes),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Sensed:
    """Commands and measurements of T ticks, in the air or not: a tick needs no other, and nothing logged after it.

    time, when (T,) s as in `Ticks`; share (T, n): mean share of full thrust; some (T,) bool: commands in it; rate, rate_dot, load, side
    as in `Ticks`; rate_ok, load_ok (T,) bool; level (T,): cosine of the tilt. rows: the same in the definitions' form.
    """

    time: np.ndarray
    when: np.ndarray
    share: np.ndarray
    some: np.ndarray
    rate: np.ndarray
    rate_dot: np.ndarray
    rate_ok: np.ndarray
    load: np.ndarray
    load_ok: np.ndarray
    level: np.ndarray
    rows: Rows

    def __len__(self):
        return len(self.time)


def laid_out(plan: Plan, hover: float | None = None, rebuilt: bool = False) -> Rows:
    """The plan in the definitions' form; see `table`."""
    made = ENGINE.new(cutting.Plan)
    made.set(**table(plan, hover, rebuilt))
    return made


def table(plan: Plan, hover: float | None = None, rebuilt: bool = False) -> dict[str, float | int | bool]:
    """The fields of front.sense.Plan. hover: share of full thrust at hover, where known from healthy flights; rebuilt: thrusts come from
    the rate controller's output, which is sampled faster than the outputs."""
    gyro, accel = plan.gyro or "", "accel"
    of = {name: (plan.half.get(name, plan.dt / 2.0), plan.period.get(name, np.nan)) for name in (gyro, accel)}
    slowest = np.nan_to_num([0.0, *plan.period.values()]).max()
    return {
        "dt": plan.dt, "lag": plan.lag_s, "phase": (plan.first - plan.dt / 2.0) % plan.dt, "ready": plan.ready_s, "hover": hover or 0.0,
        "gyro_half": of[gyro][0], "accel_half": of[accel][0], "gyro_least": samples_in(*of[gyro]), "accel_least": samples_in(*of[accel]),
        "side_least": samples_in(0.5 * SIDE_S, of[accel][1]), "late": float(max(LATE_S, LATE_PERIODS * slowest)),
        "before": look_back(plan.dt), "gyro": plan.gyro is not None, "accel": plan.accel, "rebuilt": rebuilt,
    }  # fmt: skip


def sense(flight: Flight, thrust: Signal, plan: Plan, progress: Callable[[float], object] | None = None) -> Sensed:
    """The ticks of a flight with these thrusts; none where the thrusts of all rotors are never known together. progress: called with the
    finished share, 0..1."""
    n = thrust.values.shape[1]
    parts = [Part("thrust", thrust.time, thrust.values, thrust.whole)]
    parts += [Part.of(flight, plan.gyro)._replace(name="gyro")] if plan.gyro else []
    parts += [Part.of(flight, "accel")] if plan.accel else []
    parts += [Part.of(flight, name) for name in ("velocity", "attitude") if name in flight.signals]
    vehicle, how = craft(n), laid_out(plan)
    state, rows, done = ENGINE.new(cutting.Sense), ENGINE.array(cutting.Sensed, ROOM), ENGINE.new(calls.Done)
    made, done_s = [], max(flight.duration, 1e-9)
    for samples in pieces(parts):
        if progress and len(samples):
            progress(float(samples.time[0]) / done_s)
        taken = 0
        while taken < len(samples):
            arguments = (taken, len(samples), samples.kind, samples.time, samples.at, samples.values)
            ENGINE.call(calls.cut, state, vehicle, how, *arguments, rows, ROOM, done)
            taken = int(done["samples"][0])
            made.append(rows.cut(int(done["rows"][0])))
    while count := ENGINE.call(calls.rest, state, vehicle, how, rows, ROOM):
        made.append(rows.cut(count))
    last = max((k for k, rows in enumerate(made) if rows["some"].any()), default=0)
    commanded = np.flatnonzero(made[last]["some"])  # the rows after the last command are not flight
    made[last:] = [made[last].cut(int(commanded[-1]) + 1 if commanded.size else 0)]
    whole_rows = Rows.joined(made)
    made.clear()
    columns = {name: whole_rows[name] for name in Sensed.__dataclass_fields__ if name not in ("share", "rows")}
    return Sensed(share=whole_rows["share"][:, :n], rows=whole_rows, **columns)


def known_hover(vehicle: Vehicle) -> float | None:
    """Share of full thrust at hover, where known from healthy flights."""
    return (vehicle.identified or {}).get("hover")


def cut_ticks(
    flight: Flight,
    thrust: Signal,
    B: np.ndarray,
    airborne: tuple[tuple[float, float], ...],
    ready_s: float,
    lag_s: float = LAG_S,
    hover: float | None = None,
    dt: float | None = None,
    progress: Callable[[float], object] | None = None,
) -> Ticks:
    """Ticks of one flight. thrust: share of full thrust per rotor over time; B (4, n); ready_s: blind time after lift-off.

    hover: share of full thrust at hover, when known from a vehicle file or baseline. progress: as in `sense`.
    """
    how = plan(flight, thrust, ready_s, lag_s, dt)
    return assemble(sense(flight, thrust, how, progress), how, B, airborne, hover)


def assemble(seen: Sensed, plan: Plan, B: np.ndarray, airborne: tuple[tuple[float, float], ...], hover: float | None = None) -> Ticks:
    """Ticks from their measurements and the intervals in the air."""
    n, count, time = B.shape[1], len(seen), seen.time
    lifted, start = np.full(count, LASTS), np.full(count, LASTS)
    for begin, end in airborne:
        inside = (time >= begin + HOVER_LEARN_S) & (seen.when <= end)
        if inside.any():
            lifted[time >= begin] = begin
            start[inside] = begin
    made = ENGINE.array(definition.Made, count)
    state, vehicle = ENGINE.new(definition.Ticks), craft(n, effectiveness=B)
    ENGINE.call(calls.assemble, state, vehicle, laid_out(plan, hover), count, seen.rows, lifted, start, made)
    return columns(made, plan, n).part(np.arange(count))  # without the fields that only the definitions need


def columns(made: Rows, plan: Plan, n: int, before: tuple[Contact, ...] = ()) -> Ticks:
    """Completed ticks as a table of n rotors; before: contacts of the ticks before."""
    touch = made.part("touch")
    return Ticks(
        made["time"], made["when"], made["thrust"][:, :n], made["wrench"], made["rate"], made["rate_dot"], made["load"], made["valid"],
        made["mode"], made["restart"], made["hover"], plan.dt, made["upset"], plan.notes, made["side"] if plan.accel else None,
        touch["hit"], contacts(touch, before), made["some"], axial=made["axial"],
    )  # fmt: skip


def landed(table: Ticks, spans: allocation.Spans) -> np.ndarray:
    """(T,) bool: ticks between the end of a flight and the start of the next one."""
    after = np.zeros(len(table.time), bool)
    for k, (start, end) in enumerate(spans):
        following = spans[k + 1][0] if k + 1 < len(spans) else np.inf
        after |= (table.command_time > end) & (table.time >= start) & (table.time < following)
    return after


def grounded(table: Ticks, spans: allocation.Spans) -> Ticks:
    """The ticks, with those after the end of their flight set to on the ground: after an impact."""
    after = landed(table, spans)
    if not (after & (table.mode != GROUND)).any():
        return table
    mode, valid, upset = np.where(after, GROUND, table.mode), table.valid & ~after[:, None], table.upset & ~after
    contact = None if table.contact is None else table.contact & ~after
    return replace(table, mode=mode.astype(np.int32), valid=valid, upset=upset, contact=contact)
