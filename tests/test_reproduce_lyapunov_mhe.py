"""How the moving-horizon study compares: over seeds, with intervals, flight by flight."""

import inspect

import numpy as np
import pytest
from scipy import stats

from rotorwatch import airframes
from rotorwatch_lab.experiments.studies import reproduce_lyapunov_mhe as study

SHAPE = (len(study.PATHS), len(study.FAULTS), 10)


def errors(rng, gain):
    """(paths, faults, seeds) of every estimator; the moving horizon's are `gain` better, seed by seed, give or take a little."""
    base = 0.05 + 0.02 * rng.random(SHAPE)
    found = {name: base.copy() for name in study.ESTIMATORS}
    for name in study.MOVING:
        found[name] = base - gain + 1e-3 * rng.standard_normal(SHAPE)
    return found


@pytest.mark.parametrize("gain, counted", [(0.01, "better"), (-0.01, "worse")])
def test_differences_that_hold_for_every_seed_count_in_every_case(gain, counted):
    found = study.compared(errors(np.random.default_rng(0), gain))
    assert found["cases"] == 12 and found[counted] == 12 and found["better"] + found["worse"] == 12


def test_differences_within_their_interval_do_not_count():
    """About one in twenty counts by chance."""
    rng = np.random.default_rng(1)
    counted = sum(sum(study.compared(errors(rng, 0.0))[k] for k in ("better", "worse")) for _ in range(50))
    assert 10 <= counted <= 55  # of 600; 30 expected


def test_the_interval_is_students():
    values = np.random.default_rng(2).random(10)
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert study.spread(values) == pytest.approx((high - low) / 2)
    assert study.spread(values[:1]) is None
    assert study.together(np.array([3.0, 4.0])) == pytest.approx(np.sqrt(12.5))


def test_eq_6_literally_takes_the_plant_at_the_estimate():
    """By hand: the prediction of the rates from the observer's own, with eq. (6)'s cross product; as built from the measured ones."""
    system = study.RateDynamics.of(airframes.paper("niermeyer-hexa"))
    omega_hat, omega, theta = np.array([1.0, -2.0, 0.7]), np.array([1.2, -1.7, 0.6]), np.full(6, 0.1)
    u, dt, J = np.linspace(0.3, 0.5, 6), 0.005, np.asarray(system.J)
    y, valid = np.array([1.2, -1.7, 0.6, -9.0]), np.ones(4, bool)

    def turned(at):
        return np.linalg.solve(J, np.asarray(system.B_tau) @ (u * (1 - theta)) - np.cross(at, J @ at))

    for kind, at in ((study.AtEstimate, omega_hat), (study.Lyapunov, omega)):
        estimator = kind(system, dt, bounds=study.LOOSE)
        carry = estimator.init()._replace(x=omega_hat, measured=omega, theta=theta)
        _, out = estimator.step(carry, u, y, valid)
        np.testing.assert_allclose(out.innovation[:3], y[:3] - (omega_hat + dt * turned(at)), atol=2e-4)
    assert np.abs(turned(omega) - turned(omega_hat)).max() * dt > 1e-3  # the two are distinguished


def numbers(better, worse):
    rmse = {f: {e: dict.fromkeys(study.PATHS, 0.05) for e in study.ESTIMATORS} for f in study.FAULTS}
    return {
        "rmse": rmse, "rmse_disturbed": rmse, "rmse_capped": {f: dict.fromkeys(study.PATHS, 0.04) for f in study.FAULTS},
        "moving_horizon": {"calm": {"better": better, "worse": worse, "cases": 12}, "disturbed": {"better": 0, "worse": 0, "cases": 0}},
        "microseconds_per_step": dict.fromkeys(study.ESTIMATORS, 1.0), "qobs_rank_flight": 9, "qobs_rank_hover": 6, "qobs_gap": 9.0,
        "sensitivity_ratio": [200.0] * 3, "sensitivity_ratio_thrust": 200.0, "mhe_vs_nlp": 1e-8, "qobs_gap_unscaled": 1.0,
        "qobs_longest_T0": 0.06, "sensitivity_best": [60.0] * 3, "sensitivity_below": [2] * 3, "sensitivity_faintest": 1.0,
        "effort": {name: {"lines": 50 + 10 * k, "parameters": 5} for k, name in enumerate(study.WRITTEN)},
    }  # fmt: skip


@pytest.mark.parametrize("better, worse, verdict", [(9, 0, "holds"), (9, 2, "partly"), (6, 0, "partly"), (2, 3, "not reproduced")])
def test_the_verdict_on_the_moving_horizon_follows_from_the_cases(better, worse, verdict):
    claim = next(c for c in study.claims(numbers(better, worse)) if c.claim.startswith("The moving horizon makes"))
    assert claim.verdict == verdict and f"clearly better in {better}, worse in {worse} of 12" in claim.measured


LONGER = {name: {"lines": 70 - 10 * k, "parameters": 9 - k} for k, name in enumerate(study.WRITTEN)}


@pytest.mark.parametrize(
    "start, change, verdict",
    [
        ("Two of its", {}, "partly"),
        ("Two of its", {"qobs_gap_unscaled": 6.0}, "holds"),
        ("Two of its", {"qobs_gap": 4.0}, "not reproduced"),
        ("Sensitivity off", {}, "partly"),
        ("Sensitivity off", {"sensitivity_faintest": 12.0}, "holds"),
        ("Sensitivity off", {"sensitivity_best": [9.0] * 3}, "not reproduced"),
        ("It is easy", {}, "holds"),
        ("It is easy", {"effort": LONGER}, "not reproduced"),
        ("It is easy", {"effort": LONGER, "microseconds_per_step": {**dict.fromkeys(study.ESTIMATORS, 1.0), "mhe": 9.0}}, "partly"),
    ],
)
def test_verdicts_follow_from_the_numbers(start, change, verdict):
    assert next(c for c in study.claims(numbers(9, 0) | change) if c.claim.startswith(start)).verdict == verdict


def test_lines_are_counted_without_what_explains_them():
    found = {name: study.effort(*row) for name, row in study.WRITTEN.items()}
    longest = {name: sum(len(inspect.getsource(m).splitlines()) for m in modules) for name, (_, modules) in study.WRITTEN.items()}
    assert all(0.3 * longest[name] < row["lines"] < longest[name] for name, row in found.items())
    assert all(row["parameters"] >= 5 for row in found.values())


@pytest.mark.thorough
def test_unscaled_derivatives_hide_the_two_small_values():
    system = study.RateDynamics.of(study.airframes.paper("niermeyer-hexa"))
    scaled, plain = study.observable(system), study.observable(system, scaled=False)
    assert plain["gap"] == plain["gap_unscaled"] == scaled["gap_unscaled"] < 1.1 < 5 < scaled["gap"]
    assert scaled["longest"] == pytest.approx(0.06) and scaled["below"][:2] == [2, 2] and scaled["faintest"] < 1.1


@pytest.mark.thorough
def test_orders_above_four_add_nothing_to_scaled_derivatives():
    system = study.RateDynamics.of(study.airframes.paper("niermeyer-hexa"))
    four, eight = (study.observable(system, orders=k) for k in (4, None))
    assert (four["rank_flight"], four["rank_hover"]) == (eight["rank_flight"], eight["rank_hover"]) == (9, 7)
    np.testing.assert_allclose(four["along"], eight["along"], rtol=1e-6)
