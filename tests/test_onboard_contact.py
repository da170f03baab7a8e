"""Knocks as the C on board finds them, tick by tick: those of motion/contact.py."""

import numpy as np
import pytest

from onboard_c import doubles, library
from rotorwatch import airframes
from rotorwatch.motion import contact

DRIVER = """
#include "rw_contact.h"

void struck(int count, const double *rows, double *out);
void shaken(int count, const double *rows, double *out);

void struck(int count, const double *rows, double *out)
{
    rw_contact s;
    rw_contact_init(&s);
    for (int k = 0; k < count; k++, out += 4) {
        rw_shove x;
        rw_touch found;
        x.time = *rows++;
        for (int i = 0; i < RW_ROTORS; i++) x.thrust[i] = (rw_real)*rows++;
        for (int i = 0; i < 3; i++) x.torque[i] = (rw_real)*rows++;
        for (int i = 0; i < 3; i++) x.rate_dot[i] = (rw_real)*rows++;
        for (int i = 0; i < 2; i++) x.side[i] = (rw_real)*rows++;
        x.load = (rw_real)*rows++;
        x.shake = (rw_real)*rows++;
        x.fresh = *rows++ > 0.5;
        x.accelerometer = *rows++ > 0.5;
        found = rw_contact_tick(&s, &x);
        out[0] = found.hit;
        out[1] = found.hit ? found.time : 0;
        out[2] = found.hit ? (double)found.size : 0;
        out[3] = found.hit ? found.push : 0;
    }
}

/* rows: force [3], sum before [3], count before. */
void shaken(int count, const double *rows, double *out)
{
    rw_vibration s;
    rw_vibration_init(&s);
    for (int k = 0; k < count; k++, rows += 7) {
        rw_real force[3], sum[3];
        for (int i = 0; i < 3; i++) {
            force[i] = (rw_real)rows[i];
            sum[i] = (rw_real)rows[3 + i];
        }
        rw_vibration_sample(&s, force, sum, (int)rows[6]);
        *out++ = (double)rw_vibration_rms(&s);
    }
}
"""
WHAT = ("turned it", "pushed it sideways", "pushed it upwards")
N, T = 6, 600


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    B = airframes.named("ardupilot-hexa-x").effectiveness()
    codes = {}

    def of(dt, single=False):
        if (dt, single) not in codes:
            folder = tmp_path_factory.mktemp("contact")
            codes[dt, single] = library(folder, ["rw_contact.c"], DRIVER, B, single, dt=dt)
        return codes[dt, single]

    return of


def bumpy(seed, dt):
    """A flight with knocks of all kinds, near the limits as well, and ticks in which something is missing."""
    rng = np.random.default_rng(seed)
    time = 7.0 + dt * np.arange(T)
    thrust = 1.0 + 0.1 * rng.standard_normal((T, N))
    torque, rate_dot = 0.1 * rng.standard_normal((T, 3)), rng.standard_normal((T, 3))
    side, load = 0.3 * rng.standard_normal((T, 2)), 1.0 + 0.05 * rng.standard_normal(T)
    for k in rng.integers(0, T, 30):
        rate_dot[k] += rng.choice([0.0, 6.0, 30.0]) * rng.standard_normal(3)
        rate_dot[k] *= rng.choice([1.0, 20.0])
        side[k] += rng.choice([0.0, 5.0, 20.0]) * rng.standard_normal(2)
        load[k] += rng.choice([0.0, 1.0, 3.0])
    fresh = rng.random(T) > 0.01
    return time, side, load, np.abs(rng.normal(0.3, 0.3, T)), thrust, torque, rate_dot, fresh


def in_c(code, time, side, load, shake, thrust, torque, rate_dot, fresh, accelerometer=True):
    known = np.full(T, accelerometer)
    rows = np.ascontiguousarray(
        np.column_stack([time, thrust, torque, rate_dot, side, load, shake, fresh, known]), float
    )
    out = np.zeros((T, 4))
    code.struck(T, doubles(rows), doubles(out))
    return out


def check(out, hit, contacts, tolerance):
    np.testing.assert_array_equal(out[:, 0] > 0.5, hit)
    last = {}
    for _, time, size, push in out[out[:, 0] > 0.5]:
        last[time] = size, WHAT[int(push)]
    assert list(last) == [c.time for c in contacts]
    assert [what for _, what in last.values()] == [c.what for c in contacts]
    np.testing.assert_allclose([size for size, _ in last.values()], [c.size for c in contacts], rtol=tolerance)


@pytest.mark.parametrize("dt", [0.05, 0.1])
def test_knocks_are_those_of_python(built, dt):
    seen = 0
    for seed in range(30):
        table = bumpy(seed, dt)
        hit, contacts, _ = contact.struck(*table, dt)
        check(in_c(built(dt), *table), hit, contacts, 1e-9)
        check(in_c(built(dt, single=True), *table), hit, contacts, 1e-5)
        seen += len(contacts)
        time, _, _, _, *rest = table
        hit, contacts, _ = contact.struck(time, None, None, None, *rest, dt)
        check(in_c(built(dt), *table, accelerometer=False), hit, contacts, 1e-9)
    assert seen > 100


@pytest.mark.parametrize("single", [False, True])
def test_vibration_is_that_of_python(built, single):
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.uniform(0.001, 0.02, 2000))
    force = rng.standard_normal((2000, 3)) * np.where(rng.random((2000, 1)) > 0.99, 30.0, 1.0) + [0.0, 0.0, -9.8]
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(force, axis=0)])
    now, first = np.arange(2000), np.searchsorted(time, time - contact.BEFORE_S)
    rows = np.ascontiguousarray(np.column_stack([force, total[now] - total[first], now - first]))
    out = np.zeros(2000)
    built(0.05, single).shaken(2000, doubles(rows), doubles(out))
    np.testing.assert_allclose(out, contact.vibration(time, force, time), rtol=1e-5 if single else 1e-9)
