"""What the C on board makes of sensed ticks for the estimator: what motion/ticks.py assembles of a whole flight."""

import numpy as np
import pytest

from onboard_c import doubles, library
from rotorwatch import airframes
from rotorwatch.default import program
from rotorwatch.motion import ticks

DRIVER = """
#include "rw_ticks.h"

void made(int count, const double *rows, const double *effectiveness, const double *plan, double *out);

/* rows [count][23 + RW_ROTORS]: start of the flight that settles with it or 0, of the one that it lies in or 0, what was sensed. */
void made(int count, const double *rows, const double *effectiveness, const double *plan, double *out)
{
    static rw_ticks s;
    const rw_plan p = {.dt = plan[0], .ready = plan[1], .hover = (rw_real)plan[2], .accel = plan[3] > 0.5, .gyro = true};
    rw_vehicle v = {.u_max = 1};
    const int width = 23 + RW_ROTORS;
    int settled = 0;
    for (int k = 0; k < 4 * RW_ROTORS; k++) v.effectiveness[k / RW_ROTORS][k % RW_ROTORS] = (rw_real)effectiveness[k];
    rw_ticks_init(&s);
    for (int k = 0; k < count; k++) {
        rw_sensed x[2];
        rw_made it;
        /* A second ahead: what settles. */
        for (int turn = 0; turn < 2; turn++) {
            const int which = turn ? k : settled;
            const double *r = rows + (long)which * width;
            rw_sensed *const one = &x[turn];
            if (which >= count) continue;
            one->time = r[2];
            one->when = r[3];
            one->some = r[4] > 0.5;
            one->rate_ok = r[5] > 0.5;
            one->load_ok = r[6] > 0.5;
            one->load = (rw_real)r[7];
            one->shake = (rw_real)r[8];
            one->level = (rw_real)r[9];
            for (int i = 0; i < 3; i++) {
                one->rate[i] = (rw_real)r[10 + i];
                one->rate_dot[i] = (rw_real)r[13 + i];
            }
            for (int i = 0; i < 2; i++) {
                one->push[i] = (rw_real)r[16 + i];
                one->side[i] = (rw_real)r[18 + i];
            }
            for (int i = 0; i < RW_ROTORS; i++) one->share[i] = (rw_real)r[20 + i];
            if (!turn) {
                if (r[0] > 0) rw_ticks_settle(&s, one, r[0]);
                settled++;
                if (settled < count && (settled <= k + 30)) turn--;
            }
        }
        {
            const double *const r = rows + (long)k * width;
            rw_ticks_make(&s, &v, &p, &x[1], r[1] > 0 ? r[1] : RW_LASTS, &it);
        }
        for (int i = 0; i < RW_INPUTS; i++) *out++ = (double)it.u[i];
        for (int i = 0; i < 4; i++) *out++ = (double)it.y[i];
        for (int i = 0; i < 4; i++) *out++ = it.valid[i];
        *out++ = it.tick.restart;
        *out++ = it.tick.upset;
        *out++ = it.touch.hit;
    }
}
"""
FRAMES = {"quad": ("ardupilot-quad-x", 0.05), "hexa": ("ardupilot-hexa-x", 0.1), "tri": ("ardupilot-tri", 0.05)}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    codes = {}

    def of(frame, single=False):
        if (frame, single) not in codes:
            name, dt = FRAMES[frame]
            B = airframes.named(name).effectiveness()
            folder = tmp_path_factory.mktemp("ticks")
            sources = ["rw_ticks.c", "rw_contact.c"]
            codes[frame, single] = library(folder, sources, DRIVER, B, single, dt=dt), B, dt
        return codes[frame, single]

    return of


def sensed(n, dt, seed):
    """Two flights and a hop of less than a second, with knocks, tumbling and what is missing."""
    rng, T = np.random.default_rng(seed), 900
    hi = 2.0 + dt * np.arange(T)
    some = rng.random(T) > 0.03
    when = np.where(some, hi - dt * rng.random(T), hi - dt / 2)
    share = np.where(some[:, None], np.clip(0.4 + 0.1 * rng.standard_normal((T, n)), 0.0, 1.0), 0.0)
    rate, rate_dot = rng.standard_normal((T, 3)), rng.standard_normal((T, 3))
    push, side = 0.3 * rng.standard_normal((T, 2)), 0.2 * rng.standard_normal((T, 2))
    load, level = 1.0 + 0.1 * rng.standard_normal(T), np.ones(T)
    for k in rng.integers(0, T, 6):
        rate_dot[k] += 50.0 * rng.standard_normal(3)
        push[k] += 15.0 * rng.standard_normal(2)
    for k in rng.integers(0, T, 4):
        rate[k : k + rng.integers(1, 9), rng.integers(3)] += 7.0
    if rng.random() < 0.5:
        level[-40:] = 0.2
    seen = ticks.Sensed(
        hi + ticks.LAG_S + dt / 2, when, share, some, rate, rate_dot, rng.random(T) > 0.01, load, rng.random(T) > 0.01,
        level, push, side, 0.2 + 0.1 * rng.random(T),
    )  # fmt: skip
    a = rng.uniform(0.0, 1.0)
    total = dt * T
    air = ((3.0 + a, 0.4 * total), (0.45 * total + a, 0.45 * total + a + 0.8), (0.55 * total + a, total - a))
    return seen, air


def fed(seen, air):
    """Rows that the driver reads."""
    settles, lies = np.zeros(len(seen)), np.zeros(len(seen))
    for start, end in air:
        inside = (seen.time >= start + ticks.SETTLE_S) & (seen.when <= end)
        if inside.any():
            lies[inside] = start
            settles[(seen.when >= start) & (seen.when < start + ticks.SETTLE_S)] = start
    columns = (
        settles,
        lies,
        seen.time,
        seen.when,
        seen.some,
        seen.rate_ok,
        seen.load_ok,
        seen.load,
        seen.shake,
        seen.level,
    )
    spare = np.zeros((len(seen), 3))
    rows = np.column_stack([*columns, seen.rate, seen.rate_dot, seen.push, seen.side, seen.share, spare])
    return np.ascontiguousarray(rows, float)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("hover", [None, 0.37])
def test_inputs_of_the_estimator_are_those_of_python(built, frame, hover):
    ready, knocks, falls = 3.0, 0, 0
    for seed in range(12):
        _, B, dt = built(frame)
        n = B.shape[1]
        seen, air = sensed(n, dt, seed)
        plan = ticks.Plan(dt, ready, ticks.LAG_S, 2.0, "gyro", True, {}, {}, ())
        table, _ = ticks.assemble(seen, plan, B, air, hover)
        u, y, valid = program.inputs(table, B)
        wanted = np.column_stack([u, y, valid, table.restart, table.upset, table.contact])
        for single in (False, True):
            out = np.zeros(wanted.shape)
            rows, numbers = fed(seen, air), np.array([dt, ready, hover or 0.0, 1.0])
            effectiveness = np.ascontiguousarray(B, float)
            built(frame, single)[0].made(
                len(rows), doubles(rows), doubles(effectiveness), doubles(numbers), doubles(out)
            )
            tolerance = 1e-5 if single else 1e-12
            np.testing.assert_allclose(out, wanted, rtol=tolerance, atol=tolerance, err_msg=str(seed))
        knocks, falls = knocks + table.contact.sum(), falls + table.upset[-1]
        assert table.restart.sum() == 2
    assert knocks > 10 and falls > 2
