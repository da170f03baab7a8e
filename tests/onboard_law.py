"""Logs through the C library of the whole diagnoser: its events, to be held against those of `diagnose`."""

import ctypes
import subprocess
from dataclasses import dataclass

import numpy as np
from tests.embedded_c_parts import STRICT

from rotorwatch import airframes
from rotorwatch.engine.motion import allocation, tick_table
from rotorwatch.engine.motion.air_spans import output_range
from rotorwatch.export import export_diagnoser
from rotorwatch.flight.vehicle import Vehicle

OUTPUTS, ACCEL, GYRO, VELOCITY, STATE, CONTROL, ATTITUDE, BATTERY = range(8)
# Of the same time, in the order of engine/intake/front.py.
FIRST = {BATTERY: 0, OUTPUTS: 1, CONTROL: 2, GYRO: 3, ACCEL: 4, VELOCITY: 5, STATE: 6, ATTITUDE: 7}
WIDTH = 24
COMMON = """#include "rw_diagnoser.h"
#define WIDTH 24
static rw_diagnoser d;
static rw_notification notifications[2 * RW_EVENTS];
static void to_real(rw_real *to, const double *from, int n) { for (int k = 0; k < n; k++) to[k] = (rw_real)from[k]; }
static void feed_row(const double *row)
{
    const double t = row[1];
    rw_real x[RW_ROTORS > 4 ? RW_ROTORS : 4];
    const bool ok = row[2] > 0.5;
    to_real(x, row + 3, row[0] < 0.5 ? RW_ROTORS : 4);
    switch ((int)row[0]) {
    case 0: rw_diagnoser_outputs(&d, t, x, (rw_rotors)row[2]); break;
    case 1: rw_diagnoser_accel(&d, t, x, ok); break;
    case 2: rw_diagnoser_gyro(&d, t, x, ok); break;
    case 3: rw_diagnoser_velocity_ned(&d, t, x); break;
    case 4: rw_diagnoser_state(&d, t, (int)row[3], (int)row[4]); break;
    case 5: rw_diagnoser_control(&d, t, x, ok); break;
    case 6: rw_diagnoser_attitude(&d, t, x); break;
    default: rw_diagnoser_battery(&d, t, x[0]); break;
    }
}
"""
DRIVER = (
    COMMON
    + """
static int burst; /* most ticks that one call took from those that waited */
int sizes(int what);
int sizes(int what)
{
    return what == 0 ? (int)sizeof d : what == 1 ? (int)sizeof d.engine.estimator : what == 2 ? (int)sizeof d.engine.room : burst;
}
int drive(int rows, const double *table, double until, double *found, int most);
int drive(int rows, const double *table, double until, double *found, int most)
{
    rw_diagnoser_init(&d, &rw_vehicle_default, &rw_plan_default);
    for (int i = 0; i < rows; i++) {
        const int waited = d.engine.front.count;
        feed_row(table + (long)i * WIDTH);
        if (waited - d.engine.front.count > burst) burst = waited - d.engine.front.count;
        if (i % 50 == 0) rw_diagnoser_poll(&d, notifications);
    }
    rw_diagnoser_finish(&d, until);
    rw_diagnoser_poll(&d, notifications);
    const rw_event *events;
    const int count = rw_diagnoser_events(&d, &events);
    for (int k = 0; k < count && k < most; k++) {
        double *row = found + k * WIDTH;
        row[0] = events[k].kind; row[1] = events[k].onset; row[2] = events[k].detected; row[3] = events[k].end;
        row[4] = events[k].rotors; row[5] = (double)events[k].loss[0]; row[6] = (double)events[k].lower[0];
        row[7] = (double)events[k].upper[0]; row[8] = (double)events[k].size; row[9] = events[k].alternative_count;
        for (int a = 0; a < events[k].alternative_count && a < 12; a++) row[10 + a] = events[k].alternatives[a];
    }
    found[most * WIDTH] = (double)rw_diagnoser_verdict(&d);
    return count;
}
"""
)


@dataclass(frozen=True)
class Flown:
    """A flight as the library gets it: rows of samples in time order (kind, time, valid, values); ticks of dt s."""

    table: np.ndarray
    until: float
    texts: dict
    dt: float


def table(flight, craft) -> np.ndarray:
    """(m, WIDTH) all samples that the library takes, in time order."""
    n, rows = len(craft.rotors), []

    def add(kind, time, valid, values):
        block = np.zeros((len(time), WIDTH))
        block[:, 0], block[:, 1], block[:, 2] = kind, time, valid
        block[:, 3 : 3 + values.shape[1]] = np.nan_to_num(values)
        rows.append(block)

    motors = flight["motors"]
    add(OUTPUTS, motors.time, np.asarray(motors.valid) @ (1 << np.arange(n)), motors.values)
    gyro = "gyro" if flight.has("gyro") else "rates"
    for kind, name in ((ACCEL, "accel"), (GYRO, gyro), (CONTROL, "control")):
        if flight.has(name):
            signal = flight[name]
            add(kind, signal.time, np.asarray(signal.valid).all(axis=1), signal.values[:, :4])
    if flight.has("velocity"):
        v = flight["velocity"]
        block = np.zeros((len(v), WIDTH))
        block[:, 0], block[:, 1], block[:, 3:6] = VELOCITY, v.time, np.where(v.valid, v.values, np.nan)
        rows.append(block)
    if flight.has("attitude"):
        q = flight["attitude"]
        add(ATTITUDE, q.time, 1.0, q.values)
    full, lift = craft.extra.get("full_voltage"), flight.signals.get("lift")
    if full and flight.has("battery"):
        b = flight["battery"]
        ok = b.valid[:, 0] & (b.values[:, 0] > 0.5 * full)
        add(BATTERY, b.time[ok], 1.0, b.values[ok, :1] / full)
    elif lift is not None and "voltage_ratio" in lift.columns:
        k = lift.columns.index("voltage_ratio")
        ok = lift.valid[:, k] & (lift.values[:, k] > 0.3)
        add(BATTERY, lift.time[ok], 1.0, lift.values[ok, k : k + 1])
    for m in flight.messages:
        if m.kind in ("landed", "armed"):
            value = float(m.value > 0.5)
            pair = (value, -1.0) if m.kind == "landed" else (-1.0, value)
            add(STATE, np.array([m.time]), 1.0, np.array([pair]))
    every = np.concatenate(rows)
    return every[np.lexsort(([FIRST[int(k)] for k in every[:, 0]], every[:, 1]))]


def flown(flight) -> Flown:
    """The flight, and the library for its vehicle and its rates."""
    craft = airframes.identify(flight)
    dynamics = (craft.identified or {}).get("dynamics")
    ready_s = tick_table.READY_KNOWN_S if dynamics and flight.has("gyro") else tick_table.READY_S
    mixed = allocation.mixed_thrusts(flight, craft)
    thrust = allocation.better(allocation.motor_thrusts(flight, craft), mixed)
    plan = tick_table.plan(flight, thrust, ready_s)
    rates = [fastest(flight, name) for name in ("motors", "gyro" if flight.has("gyro") else "rates", "accel")]
    headroom = flight.parameters.get("MOT_YAW_HEADROOM", allocation.YAW_HEADROOM)
    tables = (
        export_diagnoser.vehicle_table(craft, output_range(flight), headroom),
        tick_table.table(plan, tick_table.known_hover(craft), mixed is not None),
    )
    last = flight["motors"].time[np.asarray(flight["motors"].valid).any(axis=1)][-1]
    texts = export_diagnoser.files(craft, plan, (rates[0], rates[1], rates[2]), tables)
    return Flown(table(flight, craft), max(flight.duration, float(last)), texts, plan.dt)


def looped(table: np.ndarray, hz: float) -> np.ndarray:
    """The samples that a loop of hz passes on: of each signal the newest since the last turn, of motion the mean of them and of their
    times; and every word of the autopilot."""
    rows = [table[table[:, 0] == STATE]]
    for kind in sorted(set(table[:, 0]) - {STATE}):
        one = table[table[:, 0] == kind]
        if kind in (GYRO, ACCEL):
            one = one[one[:, 2] > 0.5]
        turn = np.ceil(one[:, 1] * hz).astype(int)
        last = np.flatnonzero(np.diff(turn, append=turn[-1] + 1))
        kept = one[last]
        if kind in (GYRO, ACCEL):
            first = np.append(0, last[:-1] + 1)
            kept[:, 1:] = np.add.reduceat(one[:, 1:], first, axis=0) / (last + 1 - first)[:, None]
        rows.append(kept)
    every = np.concatenate(rows)
    return every[np.lexsort(([FIRST[int(k)] for k in every[:, 0]], every[:, 1]))]


def on_board(flight, hz: float, craft: Vehicle | None = None) -> Flown:
    """The flight as a loop of hz feeds it, and the library as `export-c` writes it for these rates. craft: where the log does not say."""
    craft = airframes.identify(flight) if craft is None else craft
    known, raw = craft.identified or {}, table(flight, craft)

    def rate(name):
        time = flight[name].time if flight.has(name) else ()
        return min(hz, (len(time) - 1) / (time[-1] - time[0])) if len(time) > 1 else 0.0

    moves = max(min(hz, rate("gyro") or rate("rates")), 8.0)
    outputs, control = rate("motors"), rate("control")
    plan = export_diagnoser.usual_plan(outputs, control, moves, moves, bool(known.get("dynamics")))
    headroom = flight.parameters.get("MOT_YAW_HEADROOM", allocation.YAW_HEADROOM)
    vehicle = export_diagnoser.vehicle_table(craft, output_range(flight), headroom)
    tables = vehicle, tick_table.table(plan, tick_table.known_hover(craft), control >= 1.5 * outputs)
    # Room for more than comes on the average: samples of a log come in bursts.
    texts = export_diagnoser.files(craft, plan, (hz, 2.0 * hz, 2.0 * hz), tables)
    return Flown(looped(raw, hz), float(raw[-1, 1]), texts, plan.dt)


def fastest(flight, name) -> float:
    """The most samples in any half second, a second."""
    if not flight.has(name):
        return 50.0
    time = flight[name].time
    return 2.0 * max(10, int((np.searchsorted(time, time + 0.5) - np.arange(len(time))).max())) + 2.0


def compiled(folder, what: Flown, driver, single=False, compiler="cc"):
    """The library of a flight with a driver, for ctypes. One that is in the folder already is taken."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (what.texts | {"driver.c": driver}).items():
        (folder / name).write_text(text)
    sources = [str(folder / name) for name in what.texts if name.endswith(".c")]
    # More contacts than a library keeps on board: a log of the ground has many.
    flags = [*STRICT, "-O1", "-fPIC", "-shared", "-DRW_CONTACTS=32", "-DRW_EVENTS=40", *(["-DROTORWATCH_FLOAT"] if single else [])]
    target = folder / "law.so"
    command = [compiler, *flags, f"-I{folder}", *sources, str(folder / "driver.c"), "-lm", "-o", str(target)]
    if not target.exists():
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[:3000]
    return ctypes.CDLL(str(target))


def events_in_c(folder, what: Flown, single=False, compiler="cc"):
    """(events, verdict, numbers). A library that is in the folder already is taken.

    Events as rows: kind, onset, detected, end, rotors, loss, lower, upper, size, alternatives. Numbers: bytes of the whole, of the
    estimator's state and of its workspace; the most ticks that a call in flight worked off."""
    library = compiled(folder, what, DRIVER, single, compiler)
    most, samples = 64, np.ascontiguousarray(what.table)
    found = np.zeros((most + 1) * WIDTH)
    pointer = ctypes.POINTER(ctypes.c_double)
    count = library.drive(len(samples), samples.ctypes.data_as(pointer), ctypes.c_double(what.until), found.ctypes.data_as(pointer), most)
    return found.reshape(-1, WIDTH)[:count], int(found[most * WIDTH]), [library.sizes(k) for k in range(4)]
