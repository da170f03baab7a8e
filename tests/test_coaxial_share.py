"""Lower rotors of coaxial arms: how much they give is a state of the default method's plant."""

from dataclasses import replace

import numpy as np
import pytest
from tests.plain import array, measured
from tests.plain import plant as plant_of

from rotorwatch import airframes
from rotorwatch.engine.bindings import event_rows, program
from rotorwatch.engine.bindings.plant_rows import lower_rotors
from rotorwatch.engine.estimator.plant import SHARE, SHARE_SD, THETA


@pytest.mark.parametrize("frame, lower", [("y6", (0, 2, 3)), ("octaquad-x", (4, 5, 6, 7)), ("hexa-x", ()), ("quad-x", ())])
def test_which_rotors_are_below(frame, lower):
    vehicle = airframes.named(f"ardupilot-{frame}")
    found = lower_rotors(vehicle.effectiveness())
    assert (() if found is None else tuple(np.flatnonzero(found))) == lower
    assert tuple(k for k, r in enumerate(vehicle.rotors) if r.lower) == lower
    known = plant_of(vehicle.effectiveness())
    assert (known.variance[SHARE][SHARE] > 0.0) == bool(lower) == any(known.lower)
    assert "lower" in program.parameters(vehicle.effectiveness(), 0.05) or not lower


@pytest.mark.parametrize("frame", ["y6", "octaquad-x", "dodecahexa-plus"])
def test_the_state_is_the_derivative_of_the_geometry(frame):
    """Where the lower rotors give a little more, y of the frame as described differs by what the last column says, and what a loss
    takes by what H says: finite differences of the vehicle's own matrix."""
    vehicle = airframes.named(f"ardupilot-{frame}")
    B, n = vehicle.effectiveness(), len(vehicle.rotors)
    p = plant_of(B)
    rng = np.random.default_rng(1)
    u = np.concatenate([1.0 + 0.3 * rng.standard_normal(n), np.zeros(9), [2.5, 0.65, 0.0, 0.3]])
    s = 1e-6
    more = replace(vehicle, rotors=tuple(replace(r, share=r.share * (1.0 + s * r.lower)) for r in vehicle.rotors)).effectiveness()
    wanted = (more - B) / s @ u[:n]
    np.testing.assert_allclose(-measured(p, u)[0][:, SHARE], wanted, rtol=1e-4, atol=1e-6)
    x = np.zeros(THETA + n)
    x[SHARE] = s
    change = (measured(p, u, x)[0] - measured(p, u)[0])[:, THETA:] / s
    np.testing.assert_allclose(change, (more - B) / s * u[:n], rtol=1e-4, atol=1e-6)


def test_the_share_is_learned_where_motion_shows_it():
    """A Kalman filter on the plant, yawing with upper and lower rotors that turn differently: from 0.85 to the truth, 0.97."""
    vehicle = airframes.named("ardupilot-y6-b")  # all upper rotors one way, all lower ones the other
    B, n, truth = vehicle.effectiveness(), 6, 0.97 / 0.85 - 1.0
    p = plant_of(B)
    more = array(p.more, n)
    rng = np.random.default_rng(3)
    x, P = np.array(p.mean), array(p.variance)
    assert P[SHARE, SHARE] == pytest.approx(SHARE_SD**2)
    for k in range(600):
        load = 1.0 + 0.2 * np.sin(0.05 * k)
        u = np.concatenate([np.full(n, load), np.zeros(3), [n * load], np.zeros(5), [2.5, 0.65, 0.0, 0.3]])
        y = np.array([0.0, 0.0, -truth * (B @ (more * u[:n]))[2], n * load]) + 0.02 * rng.standard_normal(4)
        C = measured(p, u)[0][:, :THETA]
        S = C @ P @ C.T + 0.02**2 * np.eye(4)
        K = np.linalg.solve(S, C @ P).T
        x, P = x + K @ (y - C @ x), P - K @ S @ K.T
    assert x[SHARE] == pytest.approx(truth, abs=4 * np.sqrt(P[SHARE, SHARE])) and np.sqrt(P[SHARE, SHARE]) < 0.5 * SHARE_SD


def test_sizes_on_coaxial_frames_carry_what_is_unknown_of_the_share():
    y6, hexa = (airframes.named(f"ardupilot-{f}").effectiveness() for f in ("y6", "hexa-x"))
    plain, coaxial = (float(event_rows.sd_of(np.array(0.5), np.array(0.01), B)) for B in (hexa, y6))
    assert coaxial > 1.1 * plain and plain == pytest.approx(float(event_rows.sd_of(np.array(0.5), np.array(0.01), hexa)))
