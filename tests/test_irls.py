"""Iteratively reweighted least squares: against a second implementation, and that outliers do not count."""

import numpy as np
import pytest

from measured import PLANT, Regression, run
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators import irls
from rotorwatch_lab.estimators.irls import IRLS
from test_laws import DT, LOSS, ONSET, flown, linear_table, rates_hexa, rates_quad

ROWS, VAR, TURNS = 7, 0.3, 3


def second(table, weights):
    """The window as a list, the weights one by one. Yields x, theta, P, s."""
    regression, theta, P, s, window = Regression(), np.zeros(2), VAR * np.eye(2), 1.0, []
    c = {"huber": 1.345, "tukey": 4.685}[weights]
    for u, y, valid, dt in zip(*table, strict=True):
        z, Omega = regression.rows(u, y, valid, theta, dt)
        before = theta
        if valid.any():
            window = [*window, (z, Omega)][-ROWS:]
            rows = [(value, r) for z, Omega in window for value, r in zip(z, Omega, strict=True)]
            for _ in range(TURNS):
                residuals = [value - r @ theta for value, r in rows]
                s = max(1.0, np.sqrt(np.mean([min(e * e, (1.5 * s) ** 2) for e in residuals]) / irls.BETA))
                information, moment = np.eye(2) / VAR, np.zeros(2)
                for (value, r), e in zip(rows, residuals, strict=True):
                    size = abs(e) / s
                    w = min(1.0, c / size) if weights == "huber" else (1 - (size / c) ** 2) ** 2 * (size < c)
                    information = information + w / s**2 * np.outer(r, r)
                    moment = moment + w / s**2 * value * r
                theta, P = np.linalg.solve(information, moment), np.linalg.inv(information)
        regression.measured(valid, theta - before, PLANT.R(u))
        yield regression.x.copy(), theta, P, s


@pytest.mark.parametrize("weights", ["huber", "tukey"])
def test_it_is_what_a_second_implementation_says(weights):
    """Gaps, steps of different length, feedthrough, and a window that has gone round five times."""
    u, y, valid, dt = linear_table(40)
    y = np.where((np.arange(40) % 11 == 5)[:, None], y + 3.0, y)
    method = IRLS(PLANT, DT, window_s=ROWS * DT, theta_var=VAR, weights=weights, iterations=TURNS)
    got, s = run(method, u, y, valid, dt, keep=lambda carry, out: (out, carry.s))
    wanted = [np.array(column) for column in zip(*second((u, y, valid, dt), weights), strict=True)]
    for a, b in zip((got.x, got.theta, got.theta_cov, s), wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)
    assert s.max() > 1.1  # the scale was needed


def test_the_constant_of_the_scale_is_the_mean_of_normal_noise():
    z = np.linspace(-12, 12, 400_001)
    density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    mean = (np.minimum(z * z, irls.K**2) * density).sum() * (z[1] - z[0])
    assert abs(mean - irls.BETA) < 1e-8


@pytest.mark.parametrize("weights", ["huber", "tukey"])
def test_it_finds_a_loss(weights):
    u, y, valid, _ = flown(rates_quad, 0, LOSS)
    out = run(IRLS(rates_quad(), DT, weights=weights), u, y, valid)
    np.testing.assert_allclose(out.theta[-1], [0.0, LOSS, 0.0, 0.0], atol=0.1)
    u, y, valid, _ = flown(rates_hexa, 0, LOSS)
    out = run(IRLS(rates_hexa(), DT, weights=weights), u, y, valid)
    assert out.theta[-1].argmax() == 1 and abs(out.theta[-1, 1] - LOSS) < 0.1


@pytest.mark.parametrize("weights", ["huber", "tukey"])
def test_outliers_do_not_count(weights):
    """Every eleventh accelerometer sample is 5 g wrong: weighted least squares moves by far, the robust one hardly."""
    u, y, valid, _ = flown(rates_quad, 0, 0.0)
    hit = np.arange(len(y)) % 11 == 3
    wild = np.where(hit[:, None] & (np.arange(4) == 3), y + 50.0, y)
    late = slice(60, ONSET)

    def moved(**options):
        clean, dirty = (run(IRLS(rates_quad(), DT, **options), u, t, valid).theta[late] for t in (y, wild))
        return np.abs(dirty - clean).max()

    robust, plain = moved(weights=weights), moved(constant=1e9)  # Huber's weights are 1 then
    assert robust < 0.15 * plain and robust < 0.1, (robust, plain)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"window_s": 0.0}, "window_s"),
        ({"weights": "cauchy"}, "huber, tukey"),
        ({"iterations": 0}, "iterations"),
        ({"constant": -1.0}, "constant"),
    ],
)
def test_wrong_values_are_named(wrong, says):
    with pytest.raises(ConfigError, match=says):
        IRLS(rates_quad(), DT, **wrong)
