"""Intervals calibrated on flights: the promise holds whatever the method's covariance says."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rotorwatch as rw
from rotorwatch.errors import ConfigError
from rotorwatch.flight.method_series import INTERVAL, SET, MethodSeries
from rotorwatch_lab.published import conformal

ROOT = Path(__file__).parents[1]


def series(theta, off, says=INTERVAL):
    """A method that says theta (T, n) with half-widths off."""
    theta = np.asarray(theta, float)
    T, n = theta.shape
    sd = np.broadcast_to(off, theta.shape) / (1.0 if says == SET else 1.96)
    none = np.zeros((T, 0))
    return MethodSeries(
        "ekf", "rate dynamics", says, np.arange(T) * 0.1, np.ones(T, int), theta, np.einsum("ti,ij->tij", sd**2, np.eye(n)), none, none,
        none, none, np.zeros(T, int), tuple(f"loss_{k + 1}" for k in range(n)), (), (), (), (), 0.1,
    )  # fmt: skip


@pytest.mark.parametrize("says", [INTERVAL, SET])
def test_a_score_is_what_the_interval_must_be_widened_by(says):
    one = series([[0.1, 0.3], [0.1, 0.0]], [0.1, 0.05], says)
    found = conformal.scores(one, np.array([[0.15, 0.1], [0.1, 0.0]]))
    assert found == pytest.approx([4.0, 0.0])
    wide = replace(one, factor=4.0 + 1e-9)
    assert (wide.lower[0] <= [0.15, 0.1]).all() and (wide.upper[0] >= [0.15, 0.1]).all() and "4 times" in wide.whose
    assert conformal.scores(series([[0.1]], 0.0), np.zeros((1, 1)))[0] == np.inf


def test_the_quantile_is_that_of_a_finite_sample():
    """ceil((n + 1) 0.95): the largest of 19 to 38, the second largest of 39; fewer promise nothing."""
    flights = [np.full(5, float(k)) for k in range(1, 40)]
    assert [conformal.factor(flights[:n]) for n in (18, 19, 38, 39)] == [np.inf, 19.0, 38.0, 38.0]


@pytest.mark.parametrize("n", [20, 60])
def test_a_step_of_another_flight_is_held_as_promised(n):
    """Flights of a method that is overconfident by an unknown factor, different in each, with scores alike within a flight."""
    rng = np.random.default_rng(n)

    def flights(count):
        return [abs(rng.normal(0.0, 3.0 * rng.lognormal(0.0, 0.5), 80)) for _ in range(count)]

    held = [np.mean([np.mean(one <= conformal.factor(flights(n))) for one in flights(40)]) for _ in range(30)]
    assert 0.94 < np.mean(held) < 0.985


def test_what_was_not_calibrated_is_refused(monkeypatch, tmp_path):
    table = tmp_path / "conformal.csv"
    table.write_text("method,rotors,step_s,flights,factor\nekf,2,0.1,40,2.5\n")
    monkeypatch.setattr(conformal, "FACTORS", table)
    conformal.factors.cache_clear()
    one = series(np.zeros((3, 2)), 0.1)
    assert conformal.calibrated(one).factor == 2.5
    with pytest.raises(ConfigError, match=r"only for 2 rotors in steps of 0\.1 s"):
        conformal.calibrated(series(np.zeros((3, 4)), 0.1))
    with pytest.raises(ConfigError, match=r"ukf is not calibrated for 2 rotors in steps of 0\.1 s; calibrated are ekf"):
        conformal.calibrated(replace(one, method="ukf"))
    sample = ROOT / "src/rotorwatch/samples/quadx_healthy_hover.bin.xz"
    table.write_text("method,rotors,step_s,flights,factor\ndefault,4,0.1,40,2.5\n")
    conformal.factors.cache_clear()
    (plain,), (wide,) = (rw.estimate(sample, "default", calibrated=c).series for c in (False, True))
    assert wide.theta_off == pytest.approx(2.5 * plain.theta_off) and (plain.theta_off > 0.0).all() and not plain.theta.any()
    with pytest.raises(ConfigError, match="leave the others out"):
        rw.estimate(sample, "default", calibrated=True, plant="paper")
    conformal.factors.cache_clear()


def test_the_shipped_factors_are_positive_and_of_enough_flights():
    with open(conformal.FACTORS, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert all(int(r["flights"]) >= 19 and 0.0 < float(r["factor"]) < np.inf for r in rows)
