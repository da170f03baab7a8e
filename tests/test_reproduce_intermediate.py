"""The intermediate observer's paper: what its experiments come out at here."""

import json

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.experiments.studies import hover_flights
from rotorwatch.experiments.studies import reproduce_intermediate as study
from rotorwatch.systems.linear_hover import LinearHover

FILE = airframes.paper("f450")


@pytest.fixture(scope="module")
def result():
    """The whole study with two seeds and few sets of rotors."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "SETS", 6)
        patch.setattr(study, "RINGS", {"hexa": 6})
        shares = []
        found = study.reproduce(seeds=2, progress=shares.append)
        assert shares == sorted(shares) and shares[-1] <= 1.0
        return found


@pytest.mark.parametrize("k", range(1, 5))
def test_losses_come_out_as_injected(result, k):
    found = result.figures[f"scenario_{k}"]
    np.testing.assert_allclose(found["final_without_noise"], found["true"], atol=1e-3)
    np.testing.assert_allclose(found["final"], found["true"], atol=2e-3)


def test_settling_times(result):
    for k in (1, 2):
        settle = result.figures[f"scenario_{k}"]["settle_s"]
        assert settle["alpha_1"] == pytest.approx(2.2, abs=0.3) and settle["alpha_5"] == pytest.approx(0.4, abs=0.08)


def test_balance_changes_noise_and_no_mean(result):
    assert result.figures["balance_changes_mean"] is False
    noise = result.figures["balance_yaw_noise"]
    assert noise["gain_10"] < 0.8 * noise["gain_1"]
    assert next(c for c in result.claims if c.claim.startswith("Without balance")).verdict == "not reproduced"


def test_inequality(result):
    found = result.figures
    assert found["lmi_paper_feasible"] is False and found["lmi_feasible"] is True
    assert found["lmi_max_eig"] < 0 and found["lmi_max_eig_10_20"] < 0


def test_filtered_commands_are_worth_more_than_a_factor_of_thirty(result):
    assert result.figures["manoeuvre"]["ratio"] > 30


def test_more_than_four_rotors(result):
    rules = result.figures["beyond_four_rules"]["hexa"]
    assert (rules["least_squares"] > 0.05).all()
    assert (rules["sparse"][:2] <= 0.004).all()
    assert (rules["temporal"] <= 0.006).all() and (rules["temporal_settle_s"] < 2.0).all()
    assert result.figures["beyond_four"]["hexa"] is rules["sparse"]


def test_it_can_be_written_down_and_drawn(result):
    assert set(json.loads(result.to_json())["figures"]) >= {
        "scenario_1",
        "scenario_4",
        "beyond_four",
        "lmi_paper_feasible",
    }
    drawn = study.figures(result)
    assert set(drawn) == {"intermediate-losses", "intermediate-channels"}
    assert all(len(axes.lines) > 0 for figure in drawn.values() for axes in figure.axes)


def test_printed_pi_gives_losses_that_cannot_be():
    """-19 to 38 for a loss of 20 %, by (37) and (38) without the masses and inertias: S^-1 D S, S the table of signs."""
    run = study.SimpleNamespace(theta=np.array([[[0.0, 0.0, 0.2, 0.0]]]))
    theta = study._without_inertia(FILE, np.full((1, 1, 4), 500.0), run).theta[0, 0]
    np.testing.assert_allclose(theta, [-9.06, -9.06, 37.7, -19.45], atol=0.05)


def test_the_simulated_flight_is_the_plant_for_small_motions():
    """Frames and signs: what was flown, height up, against the NED plant stepped with the same commands and losses."""
    rng = np.random.default_rng(0)
    T = 150
    gamma = np.zeros((1, T, 4))
    gamma[0, 40:, 1] = 0.02
    reference = 0.01 * rng.standard_normal((1, 1, 4)) * np.ones((1, T, 1))
    u, y = hover_flights.fly(hover_flights.craft(FILE), gamma, reference, np.zeros((1, 4 * T, 8)))
    plant, x = LinearHover.of(FILE), np.zeros(8)
    for k in range(T):
        x = np.asarray(plant.f(x, u[0, k], gamma[0, k], study.DT))
        np.testing.assert_allclose(x[4:], y[0, k, 4:], atol=2e-3)
    assert np.abs(y[0, :, 4:]).max() > 0.02


def test_without_matplotlib_it_says_what_to_install(result, monkeypatch):
    import sys

    from rotorwatch.errors import ConfigError

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigError, match="needs matplotlib, which is not installed: pip install matplotlib"):
        study.figures(result)
