"""Surrogate flights: they keep what noise is made of, and the study counts alarms correctly."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes, logs
from rotorwatch.commands import cli
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN, READY_S
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Event
from rotorwatch_lab.experiments.studies import false_alarms as study


@pytest.fixture(scope="module")
def flight():
    return logs.read(next(cli.SAMPLES.glob("quadx_healthy*")))


@pytest.fixture(scope="module")
def origin(flight):
    return study.source(flight, airframes.identify(flight))


def coloured(rng, count=600):
    """Three channels: slow noise, what follows it two ticks later with noise of its own, and heavy-tailed noise."""
    slow = np.convolve(rng.standard_normal(count + 20), np.exp(-np.arange(20) / 6.0), "valid")[:count]
    return np.column_stack([slow, np.roll(slow, 2) + 0.3 * rng.standard_normal(count), rng.standard_t(3, count)])


def test_phases_keep_values_and_spectra():
    values = coloured(np.random.default_rng(1))
    made = study.phases(values, np.random.default_rng(2))
    np.testing.assert_array_equal(np.sort(made, axis=0), np.sort(values, axis=0))

    def bands(v):
        power = np.abs(np.fft.rfft(v, axis=0)[1:]) ** 2
        return np.array([b.sum(axis=0) for b in np.array_split(power, 10)])

    np.testing.assert_allclose(bands(made), bands(values), rtol=0.15)
    assert abs(np.corrcoef(made[:, 0], values[:, 0])[0, 1]) < 0.5  # it is another realisation


def test_phases_keep_what_channels_have_in_common():
    values = coloured(np.random.default_rng(3))
    made = study.phases(values, np.random.default_rng(4))

    def lagged(v):
        return [np.corrcoef(v[: -k or None, 0], v[k:, 1])[0, 1] for k in range(5)]

    np.testing.assert_allclose(lagged(made), lagged(values), atol=0.12)
    assert np.argmax(lagged(made)) == 2


def test_surrogates_look_like_the_flight(origin):
    rng = np.random.default_rng(0)
    table = origin.table
    assessed = np.flatnonzero((table.mode == ASSESS) & table.valid.all(axis=1))[:-30]  # without the touch-down
    made = [study.surrogate(origin, rng) for _ in range(4)]
    for name in ("wrench", "rate", "rate_dot"):
        real = getattr(table, name)[assessed].std(axis=0)
        ours = np.mean([getattr(t, name)[t.mode == ASSESS].std(axis=0) for t in made], axis=0)
        np.testing.assert_allclose(ours[:3], real[:3], rtol=0.35, atol=1e-4)
        assert np.all(ours < 2.0 * real) and np.all(ours > 0.5 * real)  # thrust: mostly one slow sag
    # Side forces keep what they have to do with the torque that they make.
    together = [np.corrcoef(t.side[t.mode == ASSESS, 0], t.wrench[t.mode == ASSESS, 1])[0, 1] for t in made]
    assert np.mean(together) == pytest.approx(np.corrcoef(table.side[assessed, 0], table.wrench[assessed, 1])[0, 1], abs=0.35)
    assert np.mean([t.load.mean() for t in made]) == pytest.approx(table.load[assessed].mean(), abs=0.01)


def test_surrogates_are_flights(origin):
    table = study.surrogate(origin, np.random.default_rng(5))
    B = origin.vehicle.effectiveness()
    np.testing.assert_allclose(table.wrench, table.thrust @ B.T, atol=1e-12)
    assert table.thrust.min() >= 0.0 and table.thrust.mean() == pytest.approx(1.0, abs=0.2)
    assert table.restart.sum() == 1 and table.restart[0]
    assert table.mode[0] == LEARN and table.time[table.mode == ASSESS][0] == pytest.approx(READY_S - 1.0)
    assert table.dt == origin.table.dt and len(table.time) % study.CHUNK == 0
    other = study.surrogate(origin, np.random.default_rng(6))
    assert abs(np.corrcoef(table.wrench[:, 0], other.wrench[:, 0])[0, 1]) < 0.5


def test_mirrored_twice_is_as_flown(origin):
    table, vehicle = origin.table, origin.vehicle
    signs = (-1.0, 1.0, -1.0)
    once = study.mirrored(table, vehicle, signs)
    flying = table.thrust.min(axis=1) > 0
    np.testing.assert_allclose(once.wrench[flying], table.wrench[flying] * [*signs, 1.0], atol=1e-9)
    np.testing.assert_array_equal(once.rate, table.rate * signs)
    twice = study.mirrored(once, vehicle, signs)
    np.testing.assert_allclose(twice.thrust[flying], table.thrust[flying], atol=1e-9)
    # Roll and yaw turned over: left rotors become right ones and change their sense; the quad stays the same.
    np.testing.assert_allclose(np.sort(once.thrust[flying], axis=1), np.sort(table.thrust[flying], axis=1), atol=1e-9)


def test_rates_are_exact_poisson_intervals():
    none = study._rate(0, 30.0)
    assert none["rate"] == 0.0 and none["low"] == 0.0 and none["high"] == pytest.approx(3.689 / 30.0, abs=1e-4)
    ten = study._rate(10, 5.0)
    assert ten["rate"] == 2.0 and ten["low"] == pytest.approx(4.795 / 5, abs=1e-3)
    assert ten["high"] == pytest.approx(18.390 / 5, abs=1e-3)


def with_loss(table, vehicle, since_s):
    """A surrogate whose rotor 1 loses 30 %: an alarm on purpose."""
    thrust = table.thrust.copy()
    thrust[table.time > since_s, 0] *= 1.0 / 0.7
    return replace(table, thrust=thrust, wrench=thrust @ vehicle.effectiveness().T)


def test_first_alarms_come_no_later_with_lower_thresholds(origin):
    table = with_loss(study.surrogate(origin, np.random.default_rng(7)), origin.vehicle, 40.0)
    found, out = study.losses(table, origin.vehicle)
    assert [e.rotors for e in found] == [(1,)] and 40.0 < found[0].detected_s < 43.0
    first = study._first_alarms(table, origin.vehicle, out)
    times = [first[shift] for shift in study.SHIFTS]
    assert times == sorted(times)
    assessed_before = found[0].detected_s - table.time[table.mode == ASSESS][0]
    assert first[0.0] == pytest.approx(assessed_before, abs=2 * table.dt)


def test_study_counts_hours_and_alarms(flight, monkeypatch):
    calls = []

    def every_second(table, vehicle):
        """Stands for the diagnoser."""
        calls.append(table)
        alarm = Event("loss_of_effectiveness", (2,), 50.0, 51.0, None, (0.2,), ((0.1, 0.3),), 1.0)
        quiet = SimpleNamespace(announced=np.zeros(len(table.time), bool), statistic=np.full(len(table.time), -7.0))
        return (alarm,) * (len(calls) % 2 == 0), quiet

    monkeypatch.setattr(study, "losses", every_second)
    monkeypatch.setattr(study, "_first_alarms", lambda *_: {s: 30.0 for s in study.SHIFTS})
    result = study.false_alarms([flight], hours=0.1, seed=1)
    (row,) = result["table"]
    assert row["flights"] == 4 and row["hours"] == pytest.approx(4 * 95.4 / 3600, abs=1e-3)
    assert row["alarms"] == result["total"]["alarms"] == 2 and row["rate"] == pytest.approx(2 / row["hours"])
    assert result["flown"]["flights"] == 2 and result["flown"]["alarms"] == 1
    assert [a["rotors"] for a in result["alarms"]] == [[2], [2], [2]]
    assert result["thresholds"][0]["first_alarms"] == 4
    assert result["thresholds"][0]["hours"] == pytest.approx(4 * 30.0 / 3600)
    assert result["evidence"]["flown"] == [-7.0, -7.0, -7.0]
    text = study.describe(result)
    assert max(map(len, text.splitlines())) <= 80 and "+2 nats" in text


def test_simulated_noise_raises_no_alarm_and_the_same_seed_gives_the_same_flights(flight, capsys, monkeypatch):
    log = str(next(cli.SAMPLES.glob("quadx_healthy*")))
    with pytest.raises(SystemExit) as leave:
        cli.main(["false-alarms", log, "--hours", "0.05", "--seed", "4", "--json", "--quiet"])
    result = json.loads(capsys.readouterr().out)
    assert leave.value.code == 0 and result["total"]["alarms"] == 0 and result["total"]["hours"] >= 0.05
    assert result["flown"]["alarms"] == 0
    again = study.false_alarms([flight], hours=0.05, seed=4)
    assert again["evidence"]["surrogates"] == pytest.approx(result["evidence"]["surrogates"])


@pytest.mark.parametrize(("paths", "hours", "word"), [([], 1.0, "at least one"), (["x"], 0.0, "above 0")])
def test_impossible_requests_are_refused(paths, hours, word):
    with pytest.raises(ConfigError, match=word):
        study.false_alarms(paths, hours)


def test_a_flight_too_short_is_refused(flight):
    short = flight.until(25.0)
    with pytest.raises(ConfigError, match="leave it out"):
        study.source(short, airframes.identify(short))
