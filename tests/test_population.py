"""Damage from take-off without a baseline: the balance of one flight against healthy vehicles of any build."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, logs
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.stats.tails import f_tail
from rotorwatch.witnesses.healthy import population
from rotorwatch.witnesses.healthy.whole_flight import Features, features

FLIGHTS = Path(__file__).resolve().parents[1] / ".." / "shared" / "flights"
QUAD, HEXA, OCTA = (airframes.named(f"ardupilot-{name}-x").effectiveness() for name in ("quad", "hexa", "octa"))
HEALTHY = (  # real flights, vehicle by vehicle
    ("ardupilot-real-dronekit/log171.bin.xz",),
    ("ardupilot-real-rrc/good_prop_hover_2.bin.xz", "ardupilot-real-rrc/good_prop_straight_line_2.bin.xz"),
    ("ardupilot-real-twoflights/sample.bin.xz",),
    ("wild/saturated-1.bin.xz", "crash/flips-1.bin.xz"),
    ("wild/healthy-real-1.bin.xz",),
    ("wild/healthy-real-2.bin.xz",),
    ("wild/healthy-real-3.ulg.xz",),
    ("wild/healthy-real-4.ulg.xz",),
    ("crazypad/normal_flight__E8_log01.usd.xz", "crazypad/normal_flight__E8_log03.usd.xz"),
    tuple(f"crazypad/normal_flight__E9_log0{k}.usd.xz" for k in (0, 2, 4)),
    ("wild/uavcan-1.ulg.xz",),
    ("wild/slow-tlog-1.tlog.xz", "wild/slow-tlog-2.tlog.xz"),
)


def hover(w, n=4, limited=0.0):
    """Features of a flight whose rotors share the load with balance w (3,)."""
    none, square = (0.0,) * 2, ((0.0,) * 3,) * 3
    return Features("", (0.4,) * n, tuple(map(float, w)), none, none, none, square, (0.0,) * 3, square, (limited,) * n, 30.0, 8.0)


def weak(B, rotor, loss, trim=(0.0, 0.0, 0.0)):
    """Verdict on a vehicle with one weak rotor (0-based), from the equations of hover: thrust and torques of what the rotors give."""
    n = B.shape[1]
    left = np.ones(n)
    left[rotor] -= loss
    wrench = np.linalg.solve((B * left) @ np.linalg.pinv(B), np.r_[np.zeros(3), B[3].sum()])  # what the mixer is asked for
    f = np.linalg.pinv(B) @ wrench
    return population.weigh(hover(B[:3] @ f / f.sum() + trim, n), B)


@pytest.mark.parametrize(("B", "bound"), [(QUAD, 0.2), (HEXA, 0.38), (OCTA, 0.48)])
def test_a_vehicle_without_trim_is_healthy_and_has_a_bound(B, bound):
    found = population.weigh(hover(np.zeros(3), B.shape[1]), B)
    assert found["verdict"] == "healthy"
    assert max(high for _, high in found["interval"]) == pytest.approx(bound, abs=0.01)


@pytest.mark.parametrize("B", [QUAD, HEXA, OCTA])
@pytest.mark.parametrize("loss", [0.1, 0.3, 0.5, 0.7, 0.8])
def test_the_interval_holds_the_loss_whatever_is_said(B, loss):
    for rotor in range(B.shape[1]):
        found = weak(B, rotor, loss)
        low, high = found["interval"][rotor]
        assert low <= loss <= high
        assert found["rotors"] in ([], [rotor + 1])


@pytest.mark.parametrize(("loss", "verdict"), [(0.3, "healthy"), (0.45, "ambiguous"), (0.7, "fault")])
def test_what_is_said_grows_with_the_loss(loss, verdict):
    assert weak(QUAD, 2, loss)["verdict"] == verdict


@pytest.mark.parametrize(("loss", "leans"), [(0.1, False), (0.2, False), (0.28, True), (0.33, True)])
def test_a_loss_of_a_third_leans_to_its_rotor(loss, leans):
    for rotor in range(4):
        found = weak(QUAD, rotor, loss)
        assert found["verdict"] == "healthy" and ("leaning" in found) is leans
        if leans:
            assert found["leaning"]["rotors"] == [rotor + 1] and found["interval"][rotor][1] > loss
            assert found["leaning"]["causes"][0]["rotors"] == [rotor + 1]


def test_one_in_twenty_healthy_quadrotors_leans_and_no_hexa():
    rng = np.random.default_rng(3)
    scale = np.array([population.CENTRE, population.CENTRE, population.TILT / 2.0])
    drawn = rng.standard_normal((400, 3)) * scale / np.sqrt(rng.chisquare(population.FREEDOM, 400) / population.FREEDOM)[:, None]
    leaning = [("leaning" in population.weigh(hover(w), QUAD)) for w in drawn]
    assert 0.005 < np.mean(leaning) < 0.08
    assert not any("leaning" in population.weigh(hover(w, 6), HEXA) for w in drawn[:40])


def test_yaw_decides_between_a_rotor_and_the_centre_of_mass():
    w = np.array([-0.3, 0.3, 0.0])  # the roll and pitch of a rotor that lost two thirds
    rotor = population.weigh(hover(np.add(w, (0.0, 0.0, 0.3))), QUAD)
    centre = population.weigh(hover(np.subtract(w, (0.0, 0.0, 0.1))), QUAD)
    assert rotor["verdict"] == "fault"
    assert centre["verdict"] != "fault"
    share = {c["kind"]: c["probability"] for c in rotor["causes"]}
    assert share["centre_of_mass"] < 0.01


@pytest.mark.parametrize("side", [0.1, 0.2, 0.3])
def test_a_camera_out_in_front_accuses_no_rotor(side):
    found = population.weigh(hover([0.0, side, 0.0]), QUAD)
    assert found["verdict"] == "healthy" and "leaning" not in found


def test_a_rotor_at_its_limit_or_a_short_flight_is_not_assessed(monkeypatch):
    craft = airframes.named("ardupilot-quad-x")
    for found, assessed in ((hover(np.zeros(3)), True), (hover(np.zeros(3), limited=0.5), False)):
        monkeypatch.setattr(population, "features", lambda *_, found=found: found)
        assert (population.assess(None, craft, [(0.0, 30.0)]) is not None) is assessed  # pyright: ignore[reportArgumentType]


@cache
def balance(name):
    """w of a log."""
    path = FLIGHTS / name
    if not path.exists():
        pytest.skip("the flight logs for tests are not here (../shared/flights)")
    flight = logs.read(path)
    return features(flight, airframes.identify(flight), airborne(flight))


def fitted(rows):
    """(scale of roll and pitch, of yaw) of the t distribution about 0 that makes rows (m, 3) likeliest."""
    centre, yaw = np.meshgrid(np.arange(0.02, 0.08, 0.0025), np.arange(0.05, 0.2, 0.005), indexing="ij")
    far = ((rows[:, :2] ** 2).sum(axis=1)[:, None, None] / centre**2) + rows[:, 2, None, None] ** 2 / yaw**2
    nu = population.FREEDOM
    likelihood = -(nu + 3) / 2 * np.log1p(far / nu).sum(axis=0) - len(rows) * (2 * np.log(centre) + np.log(yaw))
    best = np.unravel_index(np.argmax(likelihood), likelihood.shape)
    return centre[best], yaw[best]


def test_the_population_is_that_of_real_flights_and_hangs_on_none_of_its_vehicles():
    rows = np.array([np.mean([balance(name).wrench for name in names], axis=0) for names in HEALTHY])
    centre, yaw = fitted(rows)
    assert centre == pytest.approx(population.CENTRE, abs=0.005)
    assert yaw == pytest.approx(population.TILT / 2.0, abs=0.01)
    for k, w in enumerate(rows):
        centre, yaw = fitted(np.delete(rows, k, axis=0))
        assert centre == pytest.approx(population.CENTRE, abs=0.0075)
        assert yaw == pytest.approx(population.TILT / 2.0, abs=0.02)
        far = np.sum(w**2 / np.array([centre, centre, yaw]) ** 2)
        assert f_tail(far / 3, 3, population.FREEDOM) > 0.01


@pytest.mark.parametrize("name", [name for names in HEALTHY for name in names])
def test_no_healthy_real_flight_is_unlike_healthy_vehicles(name):
    found = population.weigh(balance(name), QUAD)
    assert found["verdict"] == "healthy" and "leaning" not in found
