"""The work on board in pieces: the same to the bit, however the calls are spread; a text as seldom as is promised."""

import ctypes

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from onboard_law import COMMON, compiled, flown
from rotorwatch import logs
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.engine.drift.trim import LOOK_S

DRIVER = (
    COMMON
    + """
#include "rw_text.h"
#include <string.h>
static rw_texts texts;
static int looked;
int looks(void);
/* How often the trim has been looked at in flight. */
int looks(void) { return looked; }
int pieces(int rows, const double *table, double until, const int *gaps, int many, double *reported, int most);
/* Feed the rows, with gaps[k % many] pieces of work after each, less where there are none left; gaps NULL: as they are fed. What is
reported,
   a row each: time, severity, rotors and loss of the first event. Returns how many texts. */
int pieces(int rows, const double *table, double until, const int *gaps, int many, double *reported, int most)
{
    char text[RW_TEXT];
    int said = 0, turn = 0;
    rw_diagnoser_init(&d, &rw_vehicle_default, &rw_plan_default);
    rw_texts_init(&texts);
    if (gaps) rw_diagnoser_defer(&d);
    for (int i = 0; i < rows; i++) {
        const double *row = table + (long)i * WIDTH;
        feed_row(row);
        for (int left = gaps ? gaps[turn++ % many] : 0; left > 0 && rw_diagnoser_work(&d); left--) { }
        while (gaps && (d.next + 1) % (RW_SAMPLES + 1) == d.first) rw_diagnoser_work(&d);
        if (i % 50 == 0) {
            while (gaps && rw_diagnoser_work(&d)) { }
            rw_diagnoser_poll(&d, notifications);
            const int severity = rw_diagnoser_text(&d, &texts, row[1], RW_INFO, text);
            if (severity > 0 && said < most) {
                reported[4 * said] = row[1]; reported[4 * said + 1] = severity;
                reported[4 * said + 2] = texts.reported[0].event.rotors; reported[4 * said + 3] = (double)texts.reported[0].event.loss[0];
                said++;
            }
        }
    }
    looked = d.engine.trim.looks;
    rw_diagnoser_finish(&d, until);
    rw_diagnoser_poll(&d, notifications);
    return rw_diagnoser_lost(&d) ? -1 : said;
}
/* All that is remembered of the flight. */
unsigned hash(void);
unsigned hash(void)
{
    unsigned sum = 2166136261u;
    const unsigned char *const parts[] = {(unsigned char *)&d.engine.estimator, (unsigned char *)&d.engine.losses,
                                          (unsigned char *)&d.engine.trim, (unsigned char *)&d.engine.front};
    const size_t sizes[] = {sizeof d.engine.estimator, sizeof d.engine.losses, sizeof d.engine.trim, sizeof d.engine.front};
    for (int p = 0; p < 4; p++) for (size_t k = 0; k < sizes[p]; k++) sum = (sum ^ parts[p][k]) * 16777619u;
    return sum;
}
"""
)
MOST, ASSESSED_S = 40, 80.0  # texts; of the sample's flight, at least


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A function: gaps or None -> (hash of all that is remembered, what is reported, how often the trim was looked at in flight)."""
    what = flown(logs.read(SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"))
    library = compiled(tmp_path_factory.mktemp("pieces"), what, DRIVER, single=True)
    table = np.ascontiguousarray(what.table)
    pointer = ctypes.POINTER(ctypes.c_double)

    def run(gaps):
        reported = np.zeros((MOST, 4))
        spread = (ctypes.c_int * len(gaps))(*gaps) if gaps else None
        arguments = len(table), table.ctypes.data_as(pointer), ctypes.c_double(what.until), spread, len(gaps or ())
        count = library.pieces(*arguments, reported.ctypes.data_as(pointer), MOST)
        assert count >= 0, "no sample was lost"
        return library.hash(), reported[:count], library.looks()

    return run


@pytest.fixture(scope="module")
def at_once(run):
    return run(None)


@settings(max_examples=trials(5), deadline=None)
@given(st.lists(st.sampled_from([0, 1, 3, 20, 400]), min_size=1, max_size=12))
def test_the_results_are_the_same_to_the_bit_however_the_work_is_spread(run, at_once, gaps):
    same, reported, looks = run(gaps)
    assert same == at_once[0] and looks == at_once[2]
    np.testing.assert_array_equal(reported, at_once[1])


def test_the_trim_is_looked_at_while_the_vehicle_flies(at_once):
    """Not only at its end: a pilot hears of a slow loss while it grows."""
    assert at_once[2] >= ASSESSED_S // LOOK_S >= 2


def test_a_pilot_is_reported_once_and_seldom(at_once):
    reported = at_once[1]
    assert len(reported) and reported[0, 2] == 1 << 2, "the rotor that lost thrust"
    assert (np.diff(reported[:, 0]) >= 5.0).all()
