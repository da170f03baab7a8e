"""Outputs logged at 1 to 8 Hz are assessed, at ticks they can fill."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rotorwatch import diagnose
from rotorwatch.engine.estimator import announcement
from rotorwatch.engine.motion import tick_table
from rotorwatch.live.replay import Replay
from rotorwatch.live.watched import Watched
from rotorwatch_lab.simulation import scenario, simulate


@cache
def flown(loss):
    faults = [{"kind": "loss", "rotor": 3, "onset_s": 70.0, "strength": loss}] if loss else []
    made = simulate(
        scenario.from_table(
            {
                "duration_s": 110.0,
                "seed": 4,
                "airframe": {"frame": "hexa-x"},
                "trajectory": {"kind": "square", "land": False},
                "wind": {"speed_m_s": 2.0},
                "faults": faults,
            }
        )
    )
    return made.flight


def thinned(flight, hz):
    """One sample of the outputs every 1/hz s, twice as many of what moves; no controller outputs."""

    def thin(signal, rate):
        if signal.rate_hz <= rate:
            return signal
        keep = np.unique(np.searchsorted(signal.time, np.arange(signal.time[0], signal.time[-1], 1.0 / rate)))
        return replace(signal, time=signal.time[keep], values=signal.values[keep], valid=signal.valid[keep])

    signals = {k: thin(s, hz if k == "motors" else max(2.0 * hz, 4.0)) for k, s in flight.signals.items() if k != "control"}
    return replace(flight, signals=signals)


@pytest.mark.parametrize("rate", [0.3, 1.0, 1.79, 1.8, 4.4, 4.5, 7.9, 8.0, 18.9, 19.0, 400.0])
def test_every_rate_has_ticks_that_the_estimator_has(rate):
    length = tick_table.tick_length(rate)
    assert length in tick_table.TICKS_S and (length == 1.0 or rate * length > 0.75)


@pytest.mark.parametrize("hz, within", [(5.0, 2.0), (2.0, 4.0), (1.1, 8.0)])
def test_a_loss_is_found_and_named(hz, within):
    answer = diagnose(thinned(flown(0.4), hz))
    (event,) = [e for e in answer.events if e.rotors]
    assert event.rotors == (3,) and not event.alternatives
    assert 70.0 < event.detected_s < 70.0 + within and abs(event.loss[0] - 0.4) < 0.1
    assert event.interval[0][0] < 0.4 < event.interval[0][1]
    assert any("Hz are assessed every" in a for a in answer.assumptions)


@pytest.mark.parametrize("hz", [5.0, 2.0, 1.1])
def test_a_healthy_flight_stays_healthy(hz):
    answer = diagnose(thinned(flown(0.0), hz))
    assert answer.verdict == "healthy" and not answer.events


@pytest.mark.parametrize("hz, length", [(1.1, 1.0)])
def test_a_slow_link_is_assessed_while_it_flies_and_says_what_cannot_be_seen(hz, length):
    flight, reported = thinned(flown(0.4), hz), []
    replay = Replay(flight, Watched("one", reported.append))
    while replay.poll():
        pass
    (limit,) = [alert["text"] for alert in reported if alert["type"] == "notice"]
    assert f"assessed every {length:g} s" in limit and f"shows in 2 of these, {2 * length:g} s" in limit
    assert limit in diagnose(flight).assumptions
    (event,) = [alert["event"] for alert in reported if alert["type"] == "event" and alert["state"] == "final"]
    assert event["rotors"] == [3] and 70.0 < event["detected_s"] < 78.0


def test_a_fast_link_has_no_such_limit():
    assert [tick_table.slow(hz, tick_table.tick_length(hz), 8.0) for hz in (50.0, 20.0, 10.0)] == [""] * 3
    assert tick_table.EARLIEST_TICKS == announcement.TICKS
