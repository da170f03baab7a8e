"""What the template's plug-ins do. rotorwatch's own laws for estimators can be run on yours too: see the README."""

import numpy as np
import pytest
from plugin_template import acme_airframe, acme_log, full_output
from plugin_template.height import Height
from plugin_template.observer import Observer

import rotorwatch as rw

LOG = acme_log.HEAD + b"M,1000000,50,50,50,50\nM,1100000,60,50,50,50\nI,1050000,180,0,0,0,0,-1\nI,1060000,0,0,90,0,0,-1\n"


def test_a_log_is_read_in_si_units():
    flight = acme_log.read(LOG, "a.acme")
    assert flight["motors"].values[1, 0] == pytest.approx(0.6)
    assert flight["gyro"].values[0, 0] == pytest.approx(np.pi)
    assert flight["accel"].values[0, 2] == pytest.approx(-9.80665)
    assert flight["gyro"].time[0] == pytest.approx(0.05) and flight.duration == pytest.approx(0.1)


def test_damage_is_a_warning_and_nothing_is_guessed():
    flight = acme_log.read(LOG + b"M,12000", "a.acme")
    assert len(flight["motors"]) == 2 and "1 of 5 lines" in flight.warnings[0]
    with pytest.raises(rw.LogError, match="no records"):
        acme_log.read(acme_log.HEAD + b"nonsense\n", "a.acme")


def test_the_airframe_is_of_acme_logs_only():
    flight = acme_log.read(LOG, "a.acme")
    vehicle = acme_airframe.identify(flight)
    assert vehicle is not None and np.linalg.matrix_rank(vehicle.effectiveness()) == 4
    assert sum(rotor.spin for rotor in vehicle.rotors) == 0


def test_the_observer_finds_a_loss_of_lift():
    plant, dt, T = Height(), 0.02, 400
    rw.checks.plant(plant)
    hover = plant.m * 9.80665 / (4 * plant.thrust)
    theta = np.zeros((T, 4))
    theta[T // 2 :] = 0.2
    made = rw.simulate_system(plant, np.full((T, 4), hover), theta, dt, seed=1)
    found = np.asarray(rw.run(Observer(plant, dt), made.u, made.y)[1].theta)
    assert found[T // 2 - 1].max() < 0.05 and found[-1].min() > 0.1


def test_an_output_at_its_top_is_said_once():
    rows = b"".join(b"M,%d,50,%d,50,50\n" % (k * 100_000, 100 if k > 20 else 50) for k in range(60))
    flight = acme_log.read(acme_log.HEAD + rows, "a.acme")
    (finding,) = full_output.detect(flight, acme_airframe.build(), ((0.0, 6.0),))
    assert finding["rotor"] == 2 and finding["time_s"] == pytest.approx(3.1, abs=0.11)
