"""Losses as they are written down tick by tick: on board, in both precisions and with a board's room, those of a computer."""

from types import SimpleNamespace

import numpy as np
import pytest

from onboard_c import doubles, library
from rotorwatch import airframes
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.plant_rows import lower_rotors
from rotorwatch.engine.estimator.posterior import PLACES
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, LEARN

# A row of numbers per event: onset, detected, end, probability, rotors, loss, lower and upper (4 each), alternatives (30).
ROW, MOST = 5 + 12 + 31, 40
DRIVER = """
#include "rw_front.h"

unsigned long bytes(void);
int reported(int count, const double *effectiveness, int coaxial, const double *rows, double *out);

unsigned long bytes(void) { return sizeof(rw_losses); }

/* rows [count][width]: see columns() of the test; out [40][48]. */
int reported(int count, const double *effectiveness, int coaxial, const double *rows, double *out)
{
    static rw_losses s;
    static rw_event list[RW_RECORDS];
    static rw_records room;
    rw_vehicle v = {.coaxial = coaxial != 0, .rotors = RW_ROTORS};
    int events;
    for (int k = 0; k < 4 * RW_ROTORS; k++) v.effectiveness[k / RW_ROTORS][k % RW_ROTORS] = (rw_real)effectiveness[k];
    rw_losses_init(&s);
    for (int k = 0; k < count; k++) {
        const double *row = rows;
        rw_found found;
        rows += 4;
        found.announced = *rows++ > 0.5;
        for (int i = 0; i < RW_ROTORS; i++) found.theta[i] = (rw_real)*rows++;
        for (int i = 0; i < RW_ROTORS; i++) found.theta_sd[i] = (rw_real)*rows++;
        for (int i = 0; i < RW_ROTORS; i++) found.gives[i] = (rw_real)*rows++;
        for (int i = 0; i < RW_PLACES; i++) found.share[i] = (rw_real)*rows++;
        for (int i = 0; i < RW_PLACES; i++) found.onsets[i] = (rw_real)*rows++;
        for (int i = 0; i < RW_PLACES * RW_ROTORS; i++) found.active[i / RW_ROTORS][i % RW_ROTORS] = *rows++ > 0.5;
        for (int i = 0; i < RW_HYPOTHESES; i++) found.probability[i] = (rw_real)*rows++;
        rw_losses_write(&s, &v, row[0], row[1], (int32_t)row[2], row[3] > 0.5, &found);
    }
    events = rw_losses_losses(&s, &v, false, &room, list);
    for (int i = 0; i < events && i < 40; i++, out += 48) {
        const rw_event *const e = &list[i];
        out[0] = e->onset;
        out[1] = e->detected;
        out[2] = e->end;
        out[3] = (double)e->probability;
        out[4] = e->rotors;
        for (int j = 0; j < 4 && j < RW_TOGETHER; j++) {
            out[5 + j] = (double)e->loss[j];
            out[9 + j] = (double)e->lower[j];
            out[13 + j] = (double)e->upper[j];
        }
        out[17] = e->alternative_count;
        for (int j = 0; j < e->alternative_count && j < 30; j++) out[18 + j] = e->alternatives[j];
    }
    return events;
}
"""
FRAMES = {name: airframes.named(f"ardupilot-{name}").effectiveness() for name in ("quad-x", "hexa-x", "octaquad-x")}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The C of a frame, double or single."""
    known = {}

    def of(frame, single=False, compiler="gcc"):
        what = frame, single, compiler
        if what not in known:
            folder = tmp_path_factory.mktemp("events")
            known[what] = library(folder, ["rw_front.c"], DRIVER, FRAMES[frame], single, compiler)
        return known[what]

    return of


def columns(out, ticks):
    """(T, width) rows that the driver reads."""
    T = len(ticks.time)
    flat = [ticks.time, ticks.command_time, ticks.mode, ticks.restart, out.announced,
            out.theta, out.theta_sd, out.gives, out.share, out.onsets, out.active, out.probability]  # fmt: skip
    return np.ascontiguousarray(np.column_stack([np.asarray(c, float).reshape(T, -1) for c in flat]))


def in_c(code, out, ticks, B, count):
    """Events of the first `count` ticks, as rows of numbers."""
    rows, answer = columns(out, ticks)[:count], np.zeros((MOST, ROW))
    effectiveness = np.ascontiguousarray(B, float)
    found = code.reported(count, doubles(effectiveness), int(lower_rotors(B) is not None), doubles(rows), doubles(answer))
    return answer[:found]


def mask(rotors):
    return sum(1 << (r - 1) for r in rotors)


def in_python(out, ticks, B, count):
    """The same of engine/bindings/event_rows.py, with a computer's room."""

    def cut(columns):
        return SimpleNamespace(**{k: v[:count] if np.ndim(v) else v for k, v in vars(columns).items()})

    rows = []
    for e in event_rows.read(cut(out), cut(ticks), B):
        row = np.zeros(ROW)
        row[:5] = e.onset_s, e.detected_s, LASTS if e.end_s is None else e.end_s, e.probability, mask(e.rotors)
        order = np.argsort(e.rotors)
        for first, values in ((5, e.loss), (9, [i[0] for i in e.interval]), (13, [i[1] for i in e.interval])):
            row[first : first + len(values)] = np.asarray(values)[order]
        row[17] = len(e.alternatives)
        row[18 : 18 + len(e.alternatives)] = [mask(a) for a in e.alternatives]
        rows.append(row)
    return np.array(rows).reshape(-1, ROW)


def flight(B, seed, count=420, dt=0.05):
    """What an estimator might say in a flight of one to three hops: announcements, explanations that overtake, recoveries."""
    rng, n = np.random.default_rng(seed), B.shape[1]
    hyp = list_hypotheses(n)
    time = 3.0 + dt * np.arange(count)
    ticks = SimpleNamespace(
        time=time, command_time=time - 0.06 - 0.02 * rng.random(count), mode=np.full(count, GROUND), restart=np.zeros(count, bool), dt=dt
    )
    out = SimpleNamespace(
        theta=np.clip(np.cumsum(0.02 * rng.standard_normal((count, n)), axis=0) + 0.3, 0, 1),
        theta_sd=0.005 + 0.02 * rng.random((count, n)),
        gives=np.where(rng.random((count, n)) < 0.9, 0.0, rng.uniform(1.3, 2.5, (count, n))),
        announced=np.zeros(count, bool),
        active=np.zeros((count, PLACES, n), bool),
        share=np.tile(np.eye(PLACES)[0], (count, 1)),
        onsets=np.zeros((count, PLACES)),
        probability=rng.dirichlet(np.full(len(hyp.names), 0.05), count),
    )
    starts = sorted({10, *(rng.integers(60, count - 40, rng.integers(0, 3)).tolist())})
    active, share = np.zeros((PLACES, n), bool), np.eye(PLACES)[0].copy()
    began = np.zeros(PLACES, int)
    for k in range(count):
        if k in starts:
            ticks.restart[k], hop = True, k
            active, share, began = np.zeros((PLACES, n), bool), np.eye(PLACES)[0].copy(), np.full(PLACES, k)
        if k >= starts[0]:
            ticks.mode[k] = ASSESS if k - hop > 12 and rng.random() > 0.04 else LEARN
            gap = [s - k for s in starts if s > k]
            if gap and gap[0] < 8:
                ticks.mode[k] = GROUND
        assessed = ticks.mode[k] == ASSESS
        if assessed and rng.random() < 0.1 and active.any():  # another explanation leads
            b = rng.integers(1, PLACES)
            for column in (active, share, began):
                column[[0, b]] = column[[b, 0]]
        if assessed and rng.random() < 0.02:
            parent, sets = active[0].copy(), []
            for _ in range(PLACES):
                new = parent.copy()
                for r in rng.choice(n, rng.integers(1, 3), replace=False):
                    new[r] = ~new[r]
                sets.append(new if rng.random() < 0.85 else parent.copy())
            old = began[0]
            active = np.array(sets)
            began = np.where(rng.random(PLACES) < 0.8, k - rng.integers(1, 65, PLACES), old)
            share = rng.dirichlet(np.full(PLACES, 0.3))
            share[0] += rng.choice([0.0, 5.0])
            share /= share.sum()
            out.announced[k] = True
        out.active[k], out.share[k], out.onsets[k] = active, share, k - began
    return out, ticks


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("frame", FRAMES)
def test_every_event_at_every_moment_is_the_same_with_a_boards_room(built, frame):
    """Flights of anything an estimator may say: the same events after any number of ticks, in double precision."""
    B, seen = FRAMES[frame], 0
    for seed in range(20):
        out, ticks = flight(B, seed)
        for count in (*np.random.default_rng(seed).integers(20, 420, 5).tolist(), 420):
            wanted = in_python(out, ticks, B, count)
            if len(wanted) > 2 * B.shape[1] + 4:
                continue  # more than there is room for
            got = in_c(built(frame), out, ticks, B, count)
            assert got.shape == wanted.shape, (seed, count)
            np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9, err_msg=f"{seed}, {count} ticks")
            seen += len(wanted)
    assert seen > 100


@pytest.mark.thorough
def test_single_precision_tells_the_same_events(built):
    """Times are double in both: the same; shares and losses to six digits."""
    B = FRAMES["quad-x"]
    for seed in range(20):
        out, ticks = flight(B, seed)
        got, wanted = (in_c(built("quad-x", single), out, ticks, B, 420) for single in (True, False))
        assert got.shape == wanted.shape
        exact = [1, 4, *range(17, ROW)]  # detected, rotors, alternatives
        np.testing.assert_array_equal(got[:, exact], wanted[:, exact])
        np.testing.assert_allclose(got, wanted, rtol=2e-6, atol=2e-6)


@pytest.mark.thorough
def test_another_compiler_agrees(built):
    B = FRAMES["quad-x"]
    out, ticks = flight(B, 1)
    np.testing.assert_array_equal(in_c(built("quad-x", compiler="clang"), out, ticks, B, 420), in_c(built("quad-x"), out, ticks, B, 420))


def test_of_more_losses_than_there_is_room_for_the_last_are_kept(built):
    """Forty losses that end and come again, of which twelve are kept: the last ones, as they are."""
    B, count = FRAMES["quad-x"], 900
    out, ticks = flight(B, 3, count)
    out.announced[:], out.active[:] = False, False
    ticks.mode[:], ticks.restart[:] = ASSESS, np.arange(count) == 0
    for k in range(20, count, 10):
        out.announced[k] = True
        out.onsets[k:] = 3 + np.arange(count - k)[:, None]
        out.active[k:, 0, 1], out.share[k:] = k % 20 == 0, np.eye(PLACES)[0]
    wanted, got = in_python(out, ticks, B, count), in_c(built("quad-x"), out, ticks, B, count)
    assert len(wanted) == 44 and len(got) == 12
    np.testing.assert_allclose(got, wanted[-12:], rtol=1e-9)


def test_it_is_small(built):
    """Of a quadrotor in single precision: what the whole diagnoser may take on board is 32 kB."""
    assert built("quad-x", single=True).bytes() < 6000
