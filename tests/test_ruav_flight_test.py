"""The helicopter paper's flight test in a short slice, its attitude loop, the identified model and feedback linearisation."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments.studies import ruav_control, ruav_filters, ruav_flight, ruav_identification, ruav_linearisation
from rotorwatch_lab.experiments.studies import ruav_flight_test as study
from rotorwatch_lab.experiments.studies.reproduction import plain
from rotorwatch_lab.maths import h_infinity

pytest.importorskip("cvxpy")
SYSTEM = ruav_flight.plant()
SLICE = study.Setting(begin=study.FAULT_STEP - 300, end=study.FAULT_STEP + 250)


@pytest.fixture(scope="module")
def designs():
    return ruav_control.Designs(SYSTEM)


@pytest.fixture(scope="module")
def flown(designs):
    return study.fly("aekf", SLICE, designs)


@pytest.mark.thorough
def test_a_controller_is_sure_for_its_whole_interval(designs):
    plant, low, high = designs.plant, np.array([0.0, 0.5, 0.3]), np.array([0.4, 1.0, 0.6])
    made = ruav_control.design(plant, low, high)
    rng = np.random.default_rng(0)
    closed = plant.A + (plant.B * rng.uniform(low, high, (50, 1, 3))) @ made.K
    assert h_infinity.quadratic_decay(closed, made.X) >= made.decay * (1 - 1e-6) > 0
    assert np.abs(np.linalg.eigvals(np.eye(8) + ruav_flight.DT * closed)).max() < 1.0
    z = plant.C + plant.D @ made.K
    for one in closed[:10]:
        norms = h_infinity.sweep(one, plant.E, z), h_infinity.bisection(one, plant.E, z)
        assert norms[0] == pytest.approx(norms[1], rel=1e-4) and max(norms) <= made.level * (1 + 1e-6)
    found = study._norms(designs, designs.key(low, high), designs.of(designs.key(low, high)))
    assert all(found[way] == pytest.approx(found["norm"], rel=1e-4) for way in ("sweep", "bisection", "bounded_real"))


def test_bounds_that_exclude_every_controller(designs):
    with pytest.raises(ConfigError, match="bounds that exclude every controller"):
        ruav_control.design(designs.plant, np.zeros(3), np.ones(3))
    assert designs.of(designs.key(np.zeros(3), np.ones(3))) is None


def test_intervals_are_rounded_outwards_and_kept_until_they_are_left(designs):
    key = designs.key([0.31, 0.5, 0.999], [0.62, 0.5, 1.0])
    assert key == (3, 5, 9, 7, 5, 10)
    assert not designs.is_due((3, 5, 9, 7, 5, 10), key, 0.2) and not designs.is_due((4, 5, 9, 7, 5, 10), key, 0.2)
    assert designs.is_due((2, 5, 9, 7, 5, 10), key, 0.2) and designs.is_due((5, 5, 9, 7, 5, 10), key, 0.2)
    assert designs.is_due((3, 5, 9, 8, 5, 10), key, 0.2) and designs.is_due((3, 5, 9, 5, 5, 10), key, 0.2)


def test_the_trim_command_makes_up_for_what_is_known():
    gain, off = np.array([1.0, 0.5, 1.0, 0.4]), np.array([0.0, 0.0, 0.1, 0.15])
    command = ruav_control.trim_command(SYSTEM.trim, gain, np.zeros(4), off)
    assert np.abs(gain * command + off - SYSTEM.trim).max() < 0.003
    unsure = ruav_control.trim_command(SYSTEM.trim, gain, np.ones(4), off)
    assert np.abs(unsure - SYSTEM.trim).max() < 0.5 * np.abs(command - SYSTEM.trim).max()


@pytest.mark.thorough
def test_hover_is_quiet_and_the_fault_is_the_one_that_was_set(flown):
    found, at = study.assessed(flown), study.FAULT_STEP - SLICE.begin
    assert max(found["rates_before"]) < study.QUIET and found["inside_before"] > 0.9
    np.testing.assert_allclose(flown.theta[at] - flown.theta[at - 1], ruav_flight.FAULT)
    assert (np.diff(flown.theta, axis=0)[np.arange(len(flown.theta) - 1) != at - 1] == 0).all()
    assert found["inside_after"] < 0.6  # without a restart an adaptive Kalman filter never learns of so large a jump


def test_sensors_are_as_accurate_as_printed_and_leave_the_weather_alone():
    blur = ruav_flight.sensed(3, 4000)
    limit = np.repeat([np.pi / 1800, 0.1], 3)
    assert (np.abs(blur) <= limit).all() and (np.abs(blur).max(axis=0) > 0.99 * limit).all()
    assert not np.array_equal(blur[:100], ruav_flight.sensed(4, 100))
    (moves, exact), (same, printed) = (study._rows(replace(SLICE, sensors=share)) for share in (0.0, 1.0))
    np.testing.assert_array_equal(moves, same)
    np.testing.assert_array_equal(exact[:, :6], printed[:, :6])
    assert (exact[:, 6:] == 0).all() and (printed[:, 6:] == ruav_flight.sensed(0, len(printed))).all()


@pytest.mark.thorough
def test_controllers_fly_on_what_is_measured(designs, flown):
    """The first command of a flight, from the measured attitude and place, by hand."""
    moves, measured = (rows[0] for rows in study._rows(SLICE))
    blur, dither = measured[6:], moves[6:10]
    roll, pitch, turn, climb, _ = ruav_control.position_loop(blur[3:], blur[2], np.zeros(3), 0.0, np.zeros(3))
    K = designs.of(designs.key(1.0 - ruav_filters.START_REACH[1:4], np.ones(3))).K
    off = [ruav_flight.ATTITUDE[0] + blur[0] - roll, ruav_flight.ATTITUDE[1] + blur[1] - pitch]
    cyclic = K @ np.concatenate([[0, 0, -turn], off, np.zeros(3)])
    lift = ruav_flight.hover(SYSTEM)[1][2, 0]
    np.testing.assert_allclose(flown.command[0], SYSTEM.trim + np.concatenate([[climb / lift], cyclic]) + dither, rtol=1e-9)


def test_the_sure_floor_holds_pushes_and_a_tilted_gravity():
    """A velocity gains what pushes and, by an attitude that is off, a part of gravity: never more than the floor's bound allows."""
    rng = np.random.default_rng(0)
    push = ruav_flight.in_ball(rng, 20_000, 6)
    push /= np.linalg.norm(push, axis=1, keepdims=True)
    tilt = rng.choice([-1, 1], (20_000, 2)) * ruav_flight.ACCURACY[0]
    push[:, :2] += 9.80665 * ruav_flight.DT * tilt[:, ::-1] / ruav_flight.PROCESS[0]
    widest = np.linalg.norm(push, axis=1).max() / ruav_filters.TOO_WIDE
    assert 0.9 * study.SURE_FLOOR < widest**2 <= study.SURE_FLOOR


@pytest.mark.thorough
def test_a_flight_is_the_same_twice():
    short = study.Setting(begin=study.FAULT_STEP - 40, end=study.FAULT_STEP)
    one, other = (study.fly("aekf", short, ruav_control.Designs(SYSTEM)) for _ in range(2))
    for a, b in zip(one[:7], other[:7], strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.synthesis.K, other.synthesis.K)


@pytest.mark.thorough
def test_an_aekf_that_starts_again_finds_the_coefficients(flown, designs):
    restarted = study.fly("aekf", replace(SLICE, end=study.FAULT_STEP + 30, restart=True), designs)
    at, roll = study.FAULT_STEP - SLICE.begin + 29, 3
    assert restarted.restarts >= 1 and flown.restarts == 0
    assert abs(restarted.middle[at, roll] - 0.4) < 0.1 < abs(flown.middle[at, roll] - 0.4)


def numbers(before=0.05, esmf=(0.1, 0.1, 0.1), roll_only=(0.1, 0.1, 0.1), aekf=(1.0, 1.0, 1.0), restarted=True, apart=1e-6):
    """The numbers of a flight test as they might be."""

    def one(after):
        return {"rates_before": np.full(3, before), "rates_after": np.array(after), "stable_after": max(after) < 0.3, "inside_after": 0.5,
                "half_width_after": 0.1, "excluded": 0}  # fmt: skip

    norms = {"norm": 1.0, "sweep": 1.0 + apart, "bisection": 1.0, "bounded_real": 1.0, "decay_per_s": 0.1}
    calm = (0.1,) * 3
    return {
        "rates_before": np.full(3, before),
        "rates_after_esmf": np.array(esmf),
        "rates_after_aekf": np.array(aekf),
        "stable_after_esmf": max(esmf) < 0.3,
        "stable_after_aekf": max(aekf) < 0.3,
        "flights": {"aesmf": one(esmf), "aekf": one(aekf)},
        "varied": {
            "aesmf": {"roll_only": one(roll_only)},
            "aekf": {"restart": one(calm if restarted else aekf)},
            "aukf": {"no_restart": one(aekf), "restart": one(calm if restarted else aekf)},
            "ekf": {"fixed_q": one(calm)},
        },
        "forms": {form: one((0.1, 0.1, 0.5) if "printed" in form else esmf) for form in ruav_filters.FORMS},
        "controllers": {"healthy": norms, "aesmf": norms, "aekf": norms, "made": 3, "excluded": 1},
    }


def test_verdicts_follow_from_the_numbers():
    def verdicts(**changed):
        return [claim.verdict for claim in study.claims(numbers(**changed))[0]]

    assert verdicts() == ["holds", "partly", "partly", "holds"]
    assert verdicts(restarted=False)[2] == "holds"
    assert verdicts(aekf=(0.1, 0.1, 0.1))[2] == "not reproduced"
    assert verdicts(esmf=(0.1, 0.1, 0.6))[1] == "not reproduced"
    forms = study.claims(numbers(roll_only=(0.1, 0.1, 0.6)))[1]
    assert list(forms["sets_fly"].values()) == ["not reproduced", "not reproduced", "holds", "partly"]
    assert set(forms["quiet"].values()) == {"holds"} and len(forms["quiet"]) == 8
    assert list(forms["kalman_crashes"].values()) == ["holds", "not reproduced"] * 2
    assert verdicts(before=0.2)[0] == "not reproduced" and verdicts(apart=1e-3)[3] == "not reproduced"
    json.dumps(plain(numbers()), allow_nan=False)


@pytest.fixture(scope="module")
def identified():
    return ruav_identification.identify()


def test_the_model_is_identified_within_its_intervals(identified):
    found = ruav_identification.numbers(identified)
    assert found["intervals_hold"] >= 0.85 and found["median_error"] < 0.02 and found["coherent"] > 0.6
    assert found["parameters"]["L_lateral"]["value"] == pytest.approx(47.4, rel=0.02)
    assert ruav_identification.claims(found)[0].verdict == "holds"


def test_responses_agree_with_the_simulators_where_they_are_coherent(identified):
    off = np.abs(identified.H - identified.truth_H) / np.abs(identified.truth_H)
    rates = identified.used[:, 3]
    assert np.median(off[rates][:, 3, 3]) < 0.02 and np.median(off[identified.used[:, 4]][:, 4, 2]) < 0.02
    assert (identified.coherence <= 1.0).all()


def test_the_models_accuracy_is_that_of_a_simulation_by_scipy(identified):
    """One window of a new record, flown by another program; and a model that is wrong by 10 % is less accurate."""
    from scipy.signal import dlsim

    measured, model = ruav_identification.predicted(identified)
    states, inputs, _ = ruav_identification._free()
    A, B = ruav_identification._matrices(identified.value, states, inputs)
    whole = np.concatenate([B, ruav_identification._gravity(), np.eye(6)], axis=1)
    u, y, _ = ruav_identification._records(SYSTEM, 1)
    slope = (y[3, 1:] - y[3, :-1]) / ruav_flight.DT
    rest = (slope - y[3, :-1] @ A.T - u[3, :-1] @ whole[:, :6].T).mean(axis=0)
    rows = slice(100, 150)
    command = np.concatenate([u[3, rows], np.broadcast_to(rest, (50, 6))], axis=1)
    discrete = np.eye(6) + ruav_flight.DT * A, ruav_flight.DT * whole, np.eye(6), np.zeros((6, 12)), ruav_flight.DT
    _, x, _ = dlsim(discrete, command, x0=y[3, 100])
    np.testing.assert_array_equal(measured[3, 2], y[3, rows])
    np.testing.assert_allclose(model[3, 2], x, rtol=1e-9, atol=1e-12)
    good = ruav_identification.fit(measured, model)
    wrong = ruav_identification.fit(*ruav_identification.predicted(identified._replace(value=1.1 * identified.value)))
    assert (good > 0.9).all() and (good[3:] > 0.99).all() and (wrong[3:] < good[3:]).all()


def test_feedback_linearisation_needs_the_coefficients():
    found = ruav_linearisation.numbers(ruav_linearisation.flight())
    assert found["with_coefficients"]["stable"] and not found["without"]["stable"]
    assert ruav_linearisation.claims(found)[0].verdict == "holds"
    assert max(found["with_coefficients"]["rates_before"]) < 0.1
