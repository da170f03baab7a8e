"""The trim of a flight on board: in single precision what a computer says of it, with the texts for the pilot."""

import ctypes
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from onboard_c import doubles, library
from rotorwatch.answer import drift
from rotorwatch.engine.engine import Engine
from rotorwatch.engine.events.events import AMBIGUOUS, HEALTHY, NOT_ASSESSED
from test_slow import DT, QUAD, flight

DRIVER = """
#include "rw_names.h"
#include "rw_trim.h"
#include <string.h>
int reported(int count, const double *effectiveness, double expo_sd, double dt, const double *rows, double *out, char *text, int *looks);

/* rows [count][4 + RW_ROTORS]: time, lacking [3], thrust; out: of each event kind, rotors, onset, detected, loss, lower, upper, size. */
int reported(int count, const double *effectiveness, double expo_sd, double dt, const double *rows, double *out, char *text, int *looks)
{
    static rw_trim t;
    static rw_event list[RW_EVENTS];
    static const char *const names[] = RW_NAMES;
    rw_vehicle v = {.rotors = RW_ROTORS, .expo_sd = (rw_real)expo_sd};
    int events;
    for (int k = 0; k < 4 * RW_ROTORS; k++) v.effectiveness[k / RW_ROTORS][k % RW_ROTORS] = (rw_real)effectiveness[k];
    rw_trim_init(&t);
    for (int k = 0; k < count; k++, rows += 4 + RW_ROTORS) {
        rw_real lacking[3], thrust[RW_ROTORS];
        for (int a = 0; a < 3; a++) lacking[a] = (rw_real)rows[1 + a];
        for (int i = 0; i < RW_ROTORS; i++) thrust[i] = (rw_real)rows[4 + i];
        rw_trim_tick(&t, &v, dt, rows[0], RW_ASSESS, true, lacking, thrust);
        rw_trim_work(&t, &v, 2);
    }
    *looks = t.looks;
    rw_trim_finish(&t, &v);
    events = rw_growth_join(&t.growth, list, 0, RW_EVENTS);
    events = rw_mount_put(&t.mount, list, events, RW_EVENTS);
    for (int k = 0; k < events; k++, out += 8) {
        const rw_event *e = &list[k];
        rw_words words;
        const double row[] = {e->kind, e->rotors, e->onset, e->detected, (double)e->loss[0], (double)e->lower[0], (double)e->upper[0],
                              (double)e->size};
        memcpy(out, row, sizeof row);
        rw_words_init(&words);
        rw_words_event(&words, e, false, names[e->kind]);
        memcpy(text, words.at, sizeof words.at);
    }
    return events;
}
"""


@pytest.fixture(scope="module")
def code(tmp_path_factory):
    """The C of a quad, in single precision."""
    return library(tmp_path_factory.mktemp("trim"), ["rw_front.c", "rw_trim.c"], DRIVER, QUAD, single=True, dt=DT)


@pytest.mark.parametrize(
    "how, says",
    [
        ({"loss": 0.4}, "rotorwatch: rotor 1 lost 37 % (25-48)"),
        ({"rise": 0.0, "drift": (0.0, 0.0, 0.8)}, "rotorwatch: motor mount twisted"),
        ({"turns": 0.3, "sag": 0.3}, ""),
        ({"drift": (0.3, 0.2, -0.5)}, ""),
    ],
    ids=str,
)
def test_the_same_is_reported_on_board(code, how, says):
    B = QUAD
    out, ticks = flight(B, **how)
    state = drift.look(out, ticks, B)
    grown, mounts = drift.growth(state), drift.mounts(state)
    rows = np.ascontiguousarray(np.column_stack([ticks.time, (out.biases + (ticks.thrust * out.theta) @ B.T)[:, :3], ticks.thrust]))
    found, text, looks = np.zeros((4, 8)), ctypes.create_string_buffer(80), ctypes.c_int()
    arguments = doubles(np.ascontiguousarray(B)), ctypes.c_double(ticks.curve[1]), ctypes.c_double(DT), doubles(rows)
    count = code.reported(len(rows), *arguments, doubles(found), text, ctypes.byref(looks))
    assert looks.value == 2, "it looks while the vehicle flies"
    expected = []
    if grown is not None and grown.certain:
        expected.append([0, 1 << (grown.rotors[0] - 1), grown.start_s, grown.looked_s, grown.loss[0], *grown.interval[0], 0.0])
    expected += [[9, 0, m.onset_s, m.detected_s, 0.0, 0.0, 0.0, m.extra["yaw"]] for m in mounts]
    assert count == len(expected) == bool(says) and text.value.decode() == says
    for row, wanted in zip(found, expected):
        np.testing.assert_allclose(row[[0, 1, 3, 4, 5, 6]], np.array(wanted)[[0, 1, 3, 4, 5, 6]], rtol=0, atol=1e-3)
        np.testing.assert_allclose(row[[2, 7]], np.array(wanted)[[2, 7]], rtol=0, atol=0.05)


@pytest.mark.parametrize(
    "count, grew, spun, says",
    [(0, False, False, HEALTHY), (1, True, False, AMBIGUOUS), (1, False, False, HEALTHY), (0, False, True, NOT_ASSESSED)],
)
def test_a_loss_that_seems_to_grow_and_a_spin_are_not_healthy(count, grew, spun, says):
    """Before anything is certain, on board: no events."""
    engine: Any = SimpleNamespace(
        events=[], count=0, assessed=True, front=SimpleNamespace(air=SimpleNamespace(unseen=0)), spin=SimpleNamespace(spun=spun),
        trim=SimpleNamespace(growth=SimpleNamespace(count=count, grew=grew)),
    )  # fmt: skip
    assert Engine.verdict(engine) == says
