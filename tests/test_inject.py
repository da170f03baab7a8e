"""Losses put into healthy flights: the physics they obey, and the campaign's bookkeeping."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, logs
from rotorwatch.commands import cli
from rotorwatch.engine.driver import fly
from rotorwatch.engine.motion import air_spans, allocation
from rotorwatch.engine.motion.tick_table import READY_S
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch_lab.experiments import counting, inject

ONSET = 10.0
FLIGHTS = Path(__file__).resolve().parents[1] / ".." / "shared" / "flights"


def made(frame="ardupilot-quad-x", fast=False, hover=0.4, battery=0.95, seed=0):
    """A flight whose motor commands are exactly what the mixer makes of the rate controller's output."""
    vehicle = airframes.named(frame)
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 20.0, 0.02 if fast else 0.1)
    control = np.column_stack([0.04 * rng.standard_normal((time.size, 3)), hover + 0.02 * rng.standard_normal(time.size)])
    drive = allocation.drive(vehicle.curve.expo, control @ vehicle.mixer.T) / battery
    command = vehicle.curve.u_min + (vehicle.curve.u_max - vehicle.curve.u_min) * drive
    slow = slice(None, None, 5 if fast else 1)
    names = tuple(f"r{k + 1}" for k in range(len(vehicle.rotors)))
    signals = {
        "motors": Signal(time[slow], command[slow], names, "us"),
        "control": Signal(time, control, ("roll", "pitch", "yaw", "thrust"), "1"),
        "gyro": Signal(time, 0.1 * rng.standard_normal((time.size, 3)), ("x", "y", "z"), "rad/s"),
        "lift": Signal(time, np.full(time.size, battery), ("voltage_ratio",), "1"),
    }
    return Flight("made", "ArduPilot", signals, 20.0, name="made"), vehicle


def test_a_quads_faulty_rotor_is_commanded_more_as_the_specification_says():
    flight, vehicle = made()
    faulty = inject.inject(flight, vehicle, 3, 0.3, ONSET)
    time = flight["motors"].time
    before, after = (allocation.motor_thrusts(f, vehicle).values for f in (flight, faulty))
    raised = 1.0 + 0.3 / 0.7 * np.maximum(0.0, 1.0 - np.exp(-(time - ONSET) / 0.7))
    np.testing.assert_allclose(after[:, 2], before[:, 2] * raised, rtol=1e-9)
    np.testing.assert_allclose(after[:, [0, 1, 3]], before[:, [0, 1, 3]], rtol=1e-9)
    assert faulty["gyro"] is flight["gyro"] and faulty.facts["injected"]["at_limit"] == [0.0] * 4


@pytest.mark.parametrize("frame", ["ardupilot-quad-x", "ardupilot-hexa-x", "ardupilot-octa-plus"])
@pytest.mark.parametrize(("rotors", "loss"), [(1, 0.2), ((1, 3), (0.3, 0.15))])
def test_the_delivered_wrench_stays(frame, rotors, loss):
    """Long after the onset, what healthy and faulty rotors deliver together is what they delivered before."""
    flight, vehicle = made(frame)
    faulty = inject.inject(flight, vehicle, rotors, loss, ONSET, response_s=0.01)
    healthy_share = np.ones(len(vehicle.rotors))
    healthy_share[np.atleast_1d(rotors) - 1] -= loss
    before, after = (allocation.motor_thrusts(f, vehicle).values[-20:] for f in (flight, faulty))
    B = vehicle.effectiveness()
    np.testing.assert_allclose((after * healthy_share) @ B.T, before @ B.T, atol=1e-9)


@pytest.mark.parametrize("frame", ["ardupilot-quad-x", "ardupilot-hexa-x"])
@pytest.mark.parametrize("fast", [False, True])
def test_commands_still_follow_the_mixer(frame, fast):
    flight, vehicle = made(frame, fast)
    faulty = inject.inject(flight, vehicle, 2, 0.3, ONSET)
    check = allocation.compare(faulty, vehicle)
    late = check.time > 2.0
    # A command between two control samples is compared with a straight line; the loss grows along a curve.
    assert np.abs(check.deviation[late]).max() < (1e-3 if fast else 1e-9)
    assert np.abs(faulty["control"].values - flight["control"].values).max() > 0.02
    flown = fly(faulty, vehicle, ((1.0, 19.0),), READY_S)
    assert flown is not None and flown[0].overrides == ()
    if fast:
        both = [allocation.mixed_thrusts(f, vehicle) for f in (flight, faulty)]
        assert both[1].valid[200:].mean() > 0.95
        assert (both[1].values[-50:, 1] / both[0].values[-50:, 1]).min() > (1.42 if frame.endswith("quad-x") else 1.05)


def test_before_the_onset_nothing_changes():
    flight, vehicle = made()
    faulty = inject.inject(flight, vehicle, (1, 4), 0.5, ONSET)
    for name in flight.signals:
        early = flight[name].time <= ONSET
        np.testing.assert_array_equal(faulty[name].values[early], flight[name].values[early])
        np.testing.assert_array_equal(faulty[name].valid, flight[name].valid)


def test_a_command_at_its_limit_is_cut_off_and_reported():
    flight, vehicle = made(hover=0.7)
    faulty = inject.inject(flight, vehicle, 1, 0.6, ONSET)
    assert faulty["motors"].values.max() == pytest.approx(vehicle.curve.u_max)
    assert faulty.facts["injected"]["at_limit"][0] > 0.5
    assert "rotor 1 to its limit" in faulty.warnings[-1]


def test_without_a_mixer_the_controllers_output_is_left_out():
    flight, vehicle = made()
    faulty = inject.inject(flight, replace(vehicle, mixer=None), 1, 0.2, ONSET)
    assert "control" not in faulty.signals and "mixer" in faulty.warnings[-1]
    with_mixer = inject.inject(flight, vehicle, 1, 0.2, ONSET)
    np.testing.assert_allclose(faulty["motors"].values, with_mixer["motors"].values, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"rotors": 0}, "rotor numbers"),
        ({"rotors": 5}, "rotor numbers"),
        ({"rotors": (2, 2)}, "different"),
        ({"rotors": 1.5}, "rotor numbers"),
        ({"rotors": ()}, "rotor numbers"),
        ({"loss": 0.0}, "above 0"),
        ({"loss": 1.0}, "dead"),
        ({"loss": float("nan")}, "above 0"),
        ({"loss": (0.1, 0.2)}, "one for all"),
        ({"onset": -1.0}, "outside"),
        ({"onset": 1e9}, "outside"),
        ({"onset": float("nan")}, "outside"),
        ({"response_s": 0.0}, "positive"),
    ],
)
def test_impossible_requests_are_refused(change, word):
    flight, vehicle = made()
    with pytest.raises(ConfigError, match=word):
        inject.inject(flight, vehicle, **({"rotors": 1, "loss": 0.2, "onset": ONSET} | change))


def test_a_flight_of_other_rotors_is_refused():
    flight, _ = made()
    with pytest.raises(ConfigError, match="4 rotors, the vehicle 6"):
        inject.inject(flight, airframes.named("ardupilot-hexa-x"), 1, 0.2, ONSET)


def event(rotors, detected, loss=0.25, alternatives=()):
    interval = tuple((loss - 0.1, loss + 0.1) for _ in rotors)
    share = (loss,) * len(rotors)
    return Event(
        "loss_of_effectiveness", rotors, detected, detected, None, share, interval, 1.0, alternatives,
        extra={"loss_2s": list(share)},
    )  # fmt: skip


def test_outcomes_are_counted_as_the_table_says():
    def outcome(*found):
        return inject._outcome(counting.alarms(found), 2, 0.3, ONSET)

    hit = outcome(event((2,), 11.5))
    assert hit["right"] and hit["covered"] and hit["delay_s"] == 1.5 and hit["false_alarms"] == 0
    assert outcome() == {"onset_s": ONSET, "detected": False, "false_alarms": 0}
    assert outcome(event((3,), 5.0))["false_alarms"] == 1 and not outcome(event((2,), 5.0))["detected"]
    unsure = outcome(event((1,), 12.0, alternatives=((2,), (1, 2))))
    assert unsure["ambiguous_with_truth"] and not unsure["right"]
    wrong = outcome(event((1,), 12.0), event((2,), 13.0), event((4,), 14.0))
    assert not wrong["right"] and not wrong["ambiguous_with_truth"] and wrong["false_alarms"] == 2

    at = {"at_limit": 0.0}
    row = inject._row(0.3, [o | at for o in (hit, outcome(), unsure, wrong)])
    assert (row["injections"], row["detected"], row["false_alarms"]) == (4, 0.75, 2)
    assert row["right"] == pytest.approx(1 / 3) and row["ambiguous_with_truth"] == pytest.approx(1 / 3)
    assert row["loss_rms"] == pytest.approx(0.05) and row["loss_bias"] == pytest.approx(-0.05)
    assert row["coverage"] == 1.0 and row["median_delay_s"] == 2.0


def test_campaign_on_the_sample_flight():
    """Simulated noise is small: a large loss is found at once, in the right rotor, with the right size."""
    flight = logs.read(next(cli.SAMPLES.glob("quadx_healthy*")))
    flight = flight.until(45.0)
    reported = []
    result = inject.campaign([flight], losses=(0.3,), repeats=1, seed=3, progress=lambda share, text: reported.append(share))
    (row,) = result["table"]
    assert row["injections"] == 4 and row["detected"] == row["right"] == 1.0 and row["false_alarms"] == 0
    assert row["loss_rms"] < 0.03 and row["median_delay_s"] < 2.0
    assert result["healthy"]["flights"] == 1 and result["healthy"]["false_alarms"] == 0
    assert result["healthy"]["hours"] == pytest.approx(33.0 / 3600, abs=3.0 / 3600)
    assert reported == sorted(reported) and reported[-1] == 1.0
    ((start, end),) = air_spans.airborne(flight)
    assert all(start + 11.0 <= t["onset_s"] <= end - 12.0 for t in result["trials"])


@pytest.mark.parametrize(
    ("call", "word"), [(([],), "at least one"), ((["x"], (1.0,)), "dead"), ((["x"], ()), "above 0"), ((["x"], (0.2,), 0), "repeats")]
)
def test_campaign_refuses_impossible_requests(call, word):
    with pytest.raises(ConfigError, match=word):
        inject.campaign(*call)


def test_campaign_says_when_flights_are_too_short():
    flight = logs.read(next(cli.SAMPLES.glob("quadx_healthy*"))).until(15.0)
    with pytest.raises(ConfigError, match="long enough"):
        inject.campaign([flight])


def test_a_real_flight_keeps_following_its_mixer():
    path = FLIGHTS / "ardupilot-real-rrc" / "good_prop_hover_2.bin.xz"
    if not path.exists():
        pytest.skip("the real test flights are not here")
    flight = logs.read(path)
    vehicle, air = airframes.identify(flight), air_spans.airborne(flight)
    faulty = inject.inject(flight, vehicle, 1, 0.2, 40.0)
    for one in (flight, faulty):
        flown = fly(one, vehicle, air, READY_S)
        assert flown is not None and flown[0].overrides == ()
