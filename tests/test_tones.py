"""Rotor speeds from commands and tones, where a log has none."""

from dataclasses import replace

import numpy as np
import pytest

from rotorwatch.flight import Signal
from rotorwatch.witnesses.balance import hearing, imbalances, tones, unbalanced
from rotorwatch_lab.experiments import imbalance

SPAN = ((0.0, 60.0),)
SEED = 4


@pytest.fixture(scope="module")
def drawn():
    """The same flight with speeds and without; rotor 3 becomes out of balance."""
    return [imbalance.simulated(SEED, 4, 60.0, 1000.0, times=2.5, speeds=speeds) for speeds in (True, False)]


def followed(flight):
    sensor, commands = flight["raw_accel"], flight["motors"]
    return tones.follow(sensor.time, sensor.values, commands.time, commands.values)


def test_speeds_are_found_from_commands_and_tones(drawn):
    with_, without = (d.flight for d in drawn)
    found = followed(without)
    esc = with_["esc"]
    true = np.stack([np.interp(without["raw_accel"].time, esc.time, esc.values[:, k]) for k in range(4)], axis=1)
    assert found.sure.all()
    assert np.abs(np.median(np.log(found.speed / true), axis=0)).max() < 0.004
    assert np.std(np.log(found.speed / true)) < 0.015


def test_a_rotor_that_becomes_out_of_balance_is_named_without_speeds(drawn):
    _, without = drawn
    assert "esc" not in without.flight.signals and hearing.deaf(without.flight, 4) is None
    found = imbalances.listen(without.flight, 4, SPAN)
    assert not found.measured
    (one,) = unbalanced.findings(found)
    assert one.rotors == (without.rotor,) and one.onset == pytest.approx(without.onset, abs=2.5)
    measured = imbalances.listen(drawn[0].flight, 4, SPAN)
    assert [f.value for f in found.figures] == pytest.approx([f.value for f in measured.figures], rel=0.4)


def test_commands_that_move_alike_do_not_tell_whose_a_tone_is(drawn):
    flight = drawn[1].flight
    motors = flight["motors"]
    alike = replace(motors, values=np.repeat(motors.values[:, :1], 4, axis=1))
    found = imbalances.listen(replace(flight, signals={**flight.signals, "motors": alike}), 4, SPAN)
    assert found is None or not unbalanced.findings(found)


def test_commands_of_another_flight_and_noise_tell_nothing(drawn):
    flight, other = drawn[1].flight, imbalance.simulated(SEED + 2, 4, 60.0, 1000.0, speeds=False).flight
    sensor = flight["raw_accel"]
    noise = replace(sensor, values=np.random.default_rng(1).standard_normal(sensor.values.shape))
    for signals in ({"motors": other["motors"]}, {"raw_accel": noise}):
        found = followed(replace(flight, signals={**flight.signals, **signals}))
        assert found is None or not found.sure.any()


@pytest.mark.parametrize("change", ["short", "slow commands", "slow sensor", "no commands"])
def test_what_is_too_short_or_too_slow_is_not_followed(drawn, change):
    signals = dict(drawn[1].flight.signals)
    if change == "short":
        signals = {name: s.part(slice(None, round(5.0 * s.rate_hz))) for name, s in signals.items()}
    elif change == "no commands":
        signals.pop("motors")
    else:
        name = "motors" if change == "slow commands" else "raw_accel"
        s: Signal = signals[name]
        signals[name] = s.part(slice(None, None, round(s.rate_hz / (10.0 if name == "motors" else 300.0))))
    flight = replace(drawn[1].flight, signals=signals)
    assert imbalances.listen(flight, 4, SPAN) is None
    if "sensor" in change or change == "no commands":
        assert "no speed of every rotor" in hearing.deaf(flight, 4).why
