"""The campaign's statistics against other implementations and numbers from the literature."""

import numpy as np
import pytest
from scipy import stats

from rotorwatch_lab.campaign import score, summary
from rotorwatch_lab.experiments import tools


@pytest.mark.parametrize("count, n", [(0, 10), (1, 10), (5, 10), (10, 10), (1, 1), (3, 400), (397, 400), (17, 29)])
def test_shares_have_wilsons_interval(count, n):
    """Against SciPy's, without continuity correction."""
    found = summary.share(np.arange(n) < count)
    low, high = stats.binomtest(count, n).proportion_ci(0.95, "wilson")
    assert (found["value"], found["n"]) == (count / n, n)
    assert (found["low"], found["high"]) == (pytest.approx(low, abs=1e-12), pytest.approx(high, abs=1e-12))


@pytest.mark.parametrize("count, n, low, high", [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605)])
def test_wilsons_interval_as_published(count, n, low, high):
    """Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3."""
    found = summary.share(np.arange(n) < count)
    assert (round(found["low"], 4), round(found["high"], 4)) == (low, high)


def test_wilsons_limits_are_where_the_score_test_just_rejects():
    """The definition: p0 with |p - p0| = z sqrt(p0 (1 - p0) / n)."""
    found = summary.share(np.arange(40) < 7)
    for p0 in (found["low"], found["high"]):
        assert abs(7 / 40 - p0) == pytest.approx(stats.norm.ppf(0.975) * np.sqrt(p0 * (1 - p0) / 40), rel=1e-12)


@pytest.mark.parametrize("count", [0, 1, 3, 40])
def test_rates_have_garwoods_interval(count):
    """The limits are the means under which so few, or so many, have a probability of 2.5 %."""
    found, hours = summary.rate(count, 8.0), 8.0
    assert found["value"] == count / hours and found["n"] == count
    assert stats.poisson.cdf(count, found["high"] * hours) == pytest.approx(0.025)
    if count:
        assert stats.poisson.sf(count - 1, found["low"] * hours) == pytest.approx(0.025)
    else:
        assert found["low"] == 0.0
    assert summary.rate(count, 1e-6) is not None and summary.rate(count, 0.0) is None


def test_bootstrap_intervals_are_the_middle_95_percent_of_the_resampled():
    """A mean of many values: normal, with the standard error of the sample."""
    values = np.random.default_rng(4).normal(3.0, 2.0, 400)
    found = summary.boot(np.append(values, [np.nan, np.inf]), np.mean)
    error = values.std() / np.sqrt(values.size)
    assert found["value"] == pytest.approx(values.mean()) and found["n"] == 400
    assert found["low"] == pytest.approx(values.mean() - 1.96 * error, abs=0.25 * error)
    assert found["high"] == pytest.approx(values.mean() + 1.96 * error, abs=0.25 * error)
    assert summary.boot(values, np.mean) == summary.boot(values, np.mean)
    assert summary.boot(np.full(3, np.nan), np.mean) is None


def test_a_ratio_of_errors_resamples_flights_not_numbers():
    """Errors of twice the bound, flight by flight: the ratio is 2, whichever flights are drawn."""
    sd = np.random.default_rng(1).uniform(0.01, 0.2, 30)
    found = summary._ratio(2.0 * sd, sd)
    assert (found["value"], found["low"], found["high"]) == pytest.approx((2.0, 2.0, 2.0))
    assert summary._rms(np.array([3.0, 4.0])) == pytest.approx(np.sqrt(12.5))


def test_edges_and_thresholds_go_up_and_cover_what_there_is():
    """A curve needs points in order; a loss of 1 and a calm of 0 m/s have to be somewhere; 0 is the threshold in use."""
    for points in (summary.LOSS_EDGES, summary.WIND_EDGES, summary.INDUCED_EDGES, summary.DELAYS_S, summary.THRESHOLDS):
        assert (np.diff(points) > 0).all()
    assert summary.LOSS_EDGES[0] <= 0.03 and summary.LOSS_EDGES[-1] > 1.0 and summary.WIND_EDGES[0] == 0.0
    assert np.array(summary.THRESHOLDS) == pytest.approx(np.arange(-24, 25) / 2.0)
    assert max(summary.DELAYS_S) == max(score.WINDOWS_S) == score.EVALUATE_S
    assert summary.LIKELY == pytest.approx(stats.norm.ppf(0.75)) and tools.Z == pytest.approx(stats.norm.ppf(0.975))


def test_a_tenth_is_a_tenth():
    assert {0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0} <= set(summary.DELAYS_S)
    assert {0.25, 0.5} <= set(summary.LOSS_EDGES)


def test_winds_are_reported_by_their_edges():
    d = {name: np.array(["x"] * 5, object) for name in ("frame", "autopilot", "profile", "trajectory", "fault")}
    labels = summary._labels(
        {
            **d,
            "wind_m_s": np.array([0.0, 2.9, 3.1, 60.0, np.nan]),
            "induced_m_s": np.array([1.0, 2.1, 3.6, 16.0, np.nan]),
            "fault": np.array(["", "", "loss", "", ""]),
        }
    )
    assert labels["wind"].tolist() == ["0 to 3 m/s", "0 to 3 m/s", "3 to 6 m/s", "over 6 m/s", "unknown"]
    assert labels["induced velocity"].tolist() == ["0 to 2 m/s", "2 to 3.5 m/s", "3.5 to 5 m/s", "over 5 m/s", "unknown"]
    assert labels["fault"].tolist() == ["none", "none", "loss", "none", "none"] and labels["profile"][0] == "x x"


def test_cells_as_people_read_them():
    value = {"value": 0.8, "low": 0.704, "high": 0.906}
    assert summary.cell("detected", value) == "80 % (70 to 91)"
    assert summary.cell("loss_rmse", value) == "0.800 (0.704 to 0.906)"
    assert summary.cell("delay_s", value) == "0.80 (0.70 to 0.91)"
    assert summary.cell("named", None) == "-"


def faulty(count, **more):
    """Flights with one clear fault that was found, in columns as `summarise` has them."""
    row = {"fault": "loss", "clear": True, "detected": True, "right": True, "named": True, "delay_s": 0.4, "loss": 0.2,
           "estimate": 0.21, "lower": 0.15, "upper": 0.25, "bound_sd": 0.01, "bound_delay_s": 0.2, "peak": -5.0, "false_alarms": 0.0,
           "sure_false_alarms": 0.0, "wrong": 0.0, "healthy_s": 36.0, "method": "default", "frame": "quad-x", "autopilot": "px4",
           "profile": "fast", "trajectory": "hover", "wind_m_s": 1.0, "induced_m_s": 6.0, "broken": "3", "answer": "fault", "accused": "3",
           **{f"peak_{s:g}s": 3.0 for s in score.WINDOWS_S}, **more}  # fmt: skip
    return {k: np.array([v] * count, object if isinstance(v, str | bool) or v is None else float) for k, v in row.items()}


def both(*groups):
    return {key: np.concatenate([g[key] for g in groups]) for key in groups[0]}


def test_an_error_is_an_estimate_of_an_announced_rotor_less_the_truth():
    """What was never announced has no estimate, and no error; where no bound is known there is no ratio."""
    d = both(faulty(3, estimate=0.25), faulty(4, estimate=0.0), faulty(2, bound_sd=np.nan), faulty(1, clear=False))
    error, sd = summary._errors(d)
    assert error == pytest.approx([0.05] * 3) and sd == pytest.approx([0.01] * 3)
    measured = summary.measures(d)
    assert measured["loss_rmse"]["value"] == pytest.approx(0.05) and measured["bound_rmse"]["value"] == pytest.approx(0.01)
    assert measured["rmse_ratio"]["value"] == pytest.approx(5.0)
    assert measured["typical_ratio"]["value"] == pytest.approx(5.0 / stats.norm.ppf(0.75))
    assert measured["coverage"]["value"] == 1.0 and measured["coverage"]["n"] == 3
    assert measured["clear_faults"] == 9 and measured["faults"] == 10 and measured["healthy_h"] == pytest.approx(0.1)


@pytest.mark.parametrize("loss, covered", [(0.149, 0), (0.151, 1), (0.249, 1), (0.251, 0)])
def test_an_interval_covers_what_lies_within_it(loss, covered):
    assert summary.measures(faulty(2, loss=loss))["coverage"]["value"] == covered


def test_a_delay_and_its_bound_are_of_the_same_flights():
    d = both(faulty(5), faulty(3, bound_delay_s=np.nan, delay_s=9.0), faulty(2, detected=False, delay_s=np.nan))
    found = summary.measures(d)
    assert found["delay_s"]["n"] == 8 and found["bound_delay_s"]["n"] == found["delay_ratio"]["n"] == 5
    assert found["delay_ratio"]["value"] == pytest.approx(2.0) and found["detected"]["value"] == pytest.approx(0.8)


def test_losses_are_sorted_by_size():
    d = both(faulty(2, loss=0.04), faulty(3, loss=0.06), faulty(1, loss=1.0, estimate=0.9), faulty(4, loss=0.02))
    points = {p["low"]: p for p in summary._loss_error(d)}
    assert {low: p["faults"] for low, p in points.items()} == {0.03: 2, 0.06: 3, 0.12: 0, 0.25: 0, 0.5: 1}
    assert [p["high"] for p in points.values()] == [0.06, 0.12, 0.25, 0.5, 1.0]
    assert points[0.5]["bias"]["value"] == pytest.approx(-0.1) and points[0.12]["bias"] is None
    assert [(p["low"], p["high"]) for p in summary._curves(d)["loss_error"]] == [(0.03, 0.06), (0.06, 0.12), (0.5, 1.0)]


@pytest.mark.parametrize(("slow", "high"), [(82, 1.0), (88, 2.0), (119, 2.0)])
def test_the_delay_at_a_rate_of_false_alarms_has_the_middle_95_percent_of_the_resampled(slow, high):
    """Of 201 faults found after 1 s or 2 s, the median of as many drawn from them is 2 s when more than half of these are slow: by the
    binomial distribution in 0.4 %, 3.8 % and 99.6 % of the draws."""
    n, waited = 201, np.arange(201) < slow
    d = faulty(n) | {"flight": np.arange(n)}
    d |= {f"peak_{s:g}s": np.where(s >= np.where(waited, 2.0, 1.0), 3.0, -9.0) for s in score.RISE_S}
    chance = stats.binom.sf(n // 2, n, slow / n)
    found = summary.at_rate(d, 0.1, within_s=5.0)
    assert found["delay_s"]["high"] == high == (2.0 if chance > 0.025 else 1.0)
    assert found["delay_s"]["value"] == (2.0 if slow > n / 2 else 1.0)
    assert found["threshold"] == -5.0 and found["detected"]["value"] == 1.0 and found["found"] == list(range(n))


def test_size_errors_are_kept_to_a_hundredth_of_a_percent():
    d = both(faulty(1, estimate=0.21234), faulty(1, estimate=0.0)) | {"flight": np.array([3, 4])}
    assert summary.size_errors(d) == {"3": 0.0123}


def test_flights_in_which_both_are_equally_close_say_nothing_of_who_is_closer():
    """Four in which the first is closer, none in which the other is, and three ties: p = 2 / 2^4 of the sign test."""
    first = {str(k): 0.01 for k in range(7)}
    other = {str(k): 0.02 if k < 4 else -0.01 for k in range(7)}
    assert summary.closer(first, other)["p"] == summary.closer(other, first)["p"] == 2.0 / 2**4


def test_missing_numbers_are_nan_and_missing_words_none():
    made = summary.column([1, None, 3], "int64"), summary.column(["a", None], "string")
    assert np.isnan(made[0][1]) and made[0].dtype == float and made[1].tolist() == ["a", None]


def test_a_share_lies_in_its_interval_to_the_last_bit():
    """Of none or all of them rounding once left it outside, and a results file was refused at the end of a run."""
    for n in range(1, 200):
        for count in (0, n):
            found = summary.share(np.arange(n) < count)
            assert 0.0 <= found["low"] <= found["value"] <= found["high"] <= 1.0, n
