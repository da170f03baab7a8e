"""Ticks as the C on board senses them from samples, fed one by one: those of motion/ticks.py."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rotorwatch
from onboard_c import doubles, library
from rotorwatch import airframes, logs
from rotorwatch.motion import allocation, ticks

DRIVER = """
#include "rw_sense.h"

int sensed(int count, const double *samples, const double *plan, double *out, int most);

static rw_sense s;

static int told(const rw_plan *p, double now, double **out, int most)
{
    rw_sensed x;
    int count = 0;
    while (count < most && rw_sense_next(&s, p, now, &x)) {
        double *const row = *out;
        row[0] = x.time;
        row[1] = x.when;
        row[2] = x.some;
        row[3] = x.rate_ok;
        row[4] = x.load_ok;
        row[5] = (double)x.load;
        row[6] = (double)x.shake;
        row[7] = (double)x.level;
        for (int i = 0; i < 3; i++) {
            row[8 + i] = (double)x.rate[i];
            row[11 + i] = (double)x.rate_dot[i];
        }
        for (int i = 0; i < 2; i++) {
            row[14 + i] = (double)x.push[i];
            row[16 + i] = (double)x.side[i];
        }
        for (int i = 0; i < RW_ROTORS; i++) row[18 + i] = (double)x.share[i];
        *out += 18 + RW_ROTORS;
        count++;
    }
    return count;
}

/* samples [count][3 + RW_ROTORS]: time, kind (0 thrust, 1 gyro, 2 accelerometer, 3 level), all of it known, values. */
int sensed(int count, const double *samples, const double *plan, double *out, int most)
{
    const rw_plan p = {
        .dt = plan[0], .lag = plan[1], .phase = plan[2], .gyro_half = plan[3], .accel_half = plan[4],
        .gyro_least = (int16_t)plan[5], .accel_least = (int16_t)plan[6], .side_least = (int16_t)plan[7],
        .gyro = plan[8] > 0.5, .accel = plan[9] > 0.5,
    };
    int found = 0;
    rw_sense_init(&s);
    for (int k = 0; k < count; k++, samples += 3 + RW_ROTORS) {
        rw_real x[RW_ROTORS];
        for (int i = 0; i < RW_ROTORS; i++) x[i] = (rw_real)samples[3 + i];
        if (samples[1] < 0.5) rw_sense_thrust(&s, &p, samples[0], x, samples[2] > 0.5);
        else if (samples[1] < 1.5) rw_sense_gyro(&s, samples[0], x);
        else if (samples[1] < 2.5) rw_sense_accel(&s, samples[0], x);
        else rw_sense_level(&s, samples[0], x[0]);
        found += told(&p, samples[0], &out, most - found);
    }
    return found + told(&p, 1e9, &out, most - found);
}
"""
SAMPLES = Path(rotorwatch.__file__).parent / "samples"
COLUMNS = ("some", "rate_ok", "load_ok", "load", "shake", "level", "rate", "rate_dot", "push", "side", "share")


@functools.cache
def flown(name):
    flight = logs.read(SAMPLES / name)
    return flight, airframes.identify(flight)


def least(half, period):
    return max(1, int(half / period * 0.8)) if period > 0.0 else 1


def fed(flight, thrust, plan):
    """Samples in the order of their times, and the numbers of a rw_plan."""
    n, parts = thrust.values.shape[1], []
    for kind, signal in enumerate((thrust, flight[plan.gyro], flight["accel"], flight["attitude"])):
        ok = signal.valid.all(axis=1)
        values = np.zeros((len(signal), n))
        if kind == 3:
            _, x, y, _ = signal.values.T
            values[:, 0] = 1.0 - 2.0 * (x * x + y * y)
        else:
            values[:, : signal.values.shape[1]] = signal.values
        rows = np.column_stack([signal.time, np.full(len(signal), kind), ok, values])
        parts.append(rows if kind == 0 else rows[ok])
    rows = np.concatenate(parts)
    rows = np.ascontiguousarray(rows[np.argsort(rows[:, 0], kind="stable")])
    phase = (plan.first - plan.dt / 2.0) % plan.dt
    phase = 0.0 if min(phase, plan.dt - phase) < 1e-9 else phase
    gyro, accel = plan.half[plan.gyro], plan.half["accel"]
    numbers = [plan.dt, plan.lag_s, phase, gyro, accel, least(gyro, plan.period[plan.gyro]), least(accel, plan.period["accel"]),
               least(0.25, plan.period["accel"]), 1, 1]  # fmt: skip
    return rows, np.array(numbers)


def compared(folder, flight, vehicle, single=False):
    """Ticks of Python and of C, each (T, 18 + n)."""
    thrust = allocation.rotor_thrusts(flight, vehicle)
    plan = ticks.plan(flight, thrust, ticks.READY_S)
    seen = ticks.sense(flight, thrust, plan.ends(plan.numbers(thrust.time)), plan)
    wanted = np.column_stack([seen.time, seen.when, *(np.asarray(getattr(seen, name), float) for name in COLUMNS)])
    rates = {"GYRO_HZ": int(1.3 / plan.period[plan.gyro]) + 1, "ACCEL_HZ": int(1.3 / plan.period["accel"]) + 1}
    sources = ["rw_sense.c", "rw_contact.c"]
    code = library(folder, sources, DRIVER, vehicle.effectiveness(), single, dt=plan.dt, **rates)
    rows, numbers = fed(flight, thrust, plan)
    got = np.zeros((len(wanted) + 10, wanted.shape[1]))
    count = code.sensed(len(rows), doubles(rows), doubles(numbers), doubles(got), len(got))
    return wanted, got[:count], seen


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", ["quadx_healthy_hover.bin.xz", "hexax_m3_mul0.80_square_wind.bin.xz"])
def test_ticks_of_a_flight_are_those_of_python(name, single, tmp_path):
    wanted, got, _ = compared(tmp_path, *flown(name), single)
    assert got.shape == wanted.shape and len(wanted) > 500
    np.testing.assert_array_equal(got[:, 2:5], wanted[:, 2:5])
    if single:
        np.testing.assert_allclose(got, wanted, atol=2e-4, rtol=1e-4)
    else:
        np.testing.assert_allclose(got, wanted, atol=1e-9, rtol=1e-9)


def test_commands_that_stop_for_long_leave_ticks_out(tmp_path):
    flight, vehicle = flown("quadx_healthy_hover.bin.xz")
    signals = {}
    for name, signal in flight.signals.items():
        middle = signal.time[0] + 20.0
        gap = (signal.time > middle) & (signal.time < middle + 13.0) & np.isin(name, ("motors", "control"))
        signals[name] = signal.with_arrays(signal.time[~gap], signal.values[~gap], signal.valid[~gap])
    wanted, got, _ = compared(tmp_path, replace(flight, signals=signals), vehicle)
    assert np.diff(wanted[:, 0]).max() > 4.0
    np.testing.assert_allclose(got[:, :3], wanted[:, :3], atol=1e-9)
    commanded = wanted[:, 2] > 0.5
    np.testing.assert_allclose(got[commanded], wanted[commanded], atol=1e-9, rtol=1e-9)
