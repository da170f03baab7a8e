"""Why a flight was not assessed: the true reason, with its numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch.answer import unassessed
from rotorwatch.engine.motion import tick_table


def table(seconds, mode=tick_table.ASSESS, upset=False, valid=True, contacts=(), dt=0.1):
    """Ticks of a flight, all alike."""
    count = round(seconds / dt)
    return SimpleNamespace(
        mode=np.full(count, mode), upset=np.full(count, upset), valid=np.full((count, 4), valid), contacts=contacts, dt=dt
    )


KNOCKS = tuple(SimpleNamespace(time=t) for t in (11.0, 22.5))


@pytest.mark.parametrize(
    ("made", "air", "assessed_s", "says"),
    [
        (table(8.0), ((2.0, 10.0),), 0.0, "11 s of flight are needed, 8 s were flown"),
        (table(10.5), ((2.0, 12.5),), 2.0, "11 s of flight are needed, 10.5 s were flown"),
        (table(16.0), ((2.0, 10.0), (20.0, 28.0)), 0.4, "11 s of flight without landing are needed, 8 s were flown"),
        (table(30.0, tick_table.LEARN, contacts=KNOCKS), ((2.0, 32.0),), 2.0, "made contact at 11.00 s and 22.50 s"),
        (table(30.0, upset=True), ((2.0, 32.0),), 2.0, "more than 65 degrees"),
        (table(30.0, valid=False), ((2.0, 32.0),), 0.0, "motion or command data are missing"),
        (table(30.0), ((2.0, 32.0),), 22.0, "22 s of assessed flight are too few"),
        (table(300.0, dt=0.5), ((2.0, 302.0),), 285.0, "motor outputs every 0.5 s are too sparse"),
    ],
)  # fmt: skip
def test_the_reason_is_the_true_one_and_the_advice_fits_it(made, air, assessed_s, says):
    found = unassessed.find(air, made, assessed_s, 11.0, True, 3.0, True)
    assert says in found.why and found.advice.endswith(".")
    assert ("10 Hz" in found.advice) == ("every" in found.why) and "outputs that reach" not in found.advice


@pytest.mark.parametrize(
    ("lengths", "ready_s"), [((60.0,), 8.0), ((16.0,), 8.0), ((12.0,), 6.0), ((8.0, 4.0), 4.0), ((5.0,), 3.0), ((), 8.0)]
)
def test_of_a_short_flight_half_is_learned_from_but_enough(lengths, ready_s):
    assert tick_table.ready_of(tick_table.READY_S, tuple((10.0 * k, 10.0 * k + s) for k, s in enumerate(lengths))) == ready_s
    assert tick_table.ready_of(tick_table.READY_KNOWN_S, ((0.0, 60.0),)) == tick_table.READY_KNOWN_S
