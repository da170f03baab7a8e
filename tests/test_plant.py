"""The default method's plant: its equation term by term, what any multirotor is like, and which rotors are lower ones."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.plain import array, measured
from tests.plain import plant as plant_of

from rotorwatch import airframes
from rotorwatch.engine.bindings import plant_rows, program
from rotorwatch.engine.bindings.plant_rows import AXIS_STATES
from rotorwatch.engine.estimator import plant as definition
from rotorwatch.engine.estimator.plant import AIR, B3, DAMPING, GAIN, PER_AXIS, SHARE, SHARE_SD, SIDEWAYS, TAU, THETA
from rotorwatch_lab.experiments import limits

QUAD, Y6 = (airframes.named(f"ardupilot-{name}").effectiveness() for name in ("quad-x", "y6"))
RNG = np.random.default_rng(5)


def table(n, count=3, side=True):
    """Ticks of random motion."""
    return SimpleNamespace(
        thrust=RNG.uniform(0.5, 1.5, (count, n)), rate_dot=RNG.normal(0, 3, (count, 3)), rate=RNG.normal(0, 1, (count, 3)),
        load=RNG.uniform(0.8, 1.2, count), hover=RNG.uniform(0.3, 0.5, count), side=RNG.normal(0, 1, (count, 2)) if side else None,
        curve=(0.6, 0.2), axial=RNG.normal(0, 2, count) if side else None,
    )  # fmt: skip


def yaw_of_drag(B, thrust, forward, right, arm=0.2):
    """(n,) yaw, over hover thrust times drag ratio, of the drag of rotors that takes all of a side force: r x H, rotor by rotor.

    arm [m]: one unit of B; the drag ratio is such that arms over drag ratios times the gap between rotors are definition.DRAG."""
    places = [(b[1] / b[3], -b[0] / b[3]) for b in np.transpose(B)]  # forward, right
    gap = min(d for a in places for b in places if (d := np.hypot(a[0] - b[0], a[1] - b[1])) > 0.1)
    drag_ratio, mass = arm * gap / definition.DRAG, 1.3
    moments = []
    for (x, y), share in zip(places, np.sqrt(thrust) / len(thrust)):
        H_x, H_y = mass * forward * share, mass * right * share
        moments.append((arm * x * H_y - arm * y * H_x) / (mass * 9.80665 / len(thrust) * drag_ratio))
    return np.array(moments)


@pytest.mark.parametrize("side", [True, False])
def test_the_commanded_wrench_is_what_the_motion_needs_and_what_is_lost(side):
    """y_a = G_a m_a + c_a r_a + l f_a + n k v + b1_a + b2_a + b3_a + sum_i B_ai T_i theta_i, written out."""
    ticks, known = table(4, side=side), program.steps(0.05, QUAD).plant
    u, x, theta = plant_rows.packed(ticks, 4), np.zeros(THETA), RNG.uniform(0, 0.5, 4)
    x[:AXIS_STATES], x[AIR] = RNG.normal(0, 1, AXIS_STATES), 0.07
    assert u.shape == (3, 17)
    h, drag = limits.balance(u, known)
    state = x[:AXIS_STATES].reshape(4, PER_AXIS)
    for k in range(3):
        motion = [*ticks.rate_dot[k], 4 * ticks.load[k]]
        forward, right = ticks.side[k] if side else (0.0, 0.0)
        push = [-right, forward, 0.0, 0.0]
        turning = [*ticks.rate[k], 0.0]
        for a in range(4):
            damped = state[a, DAMPING] * turning[a] + x[SIDEWAYS] * push[a]
            wanted = state[a, GAIN] * motion[a] + damped + state[a, :3].sum() + (QUAD[a] * ticks.thrust[k]) @ theta
            if a == 3 and side:
                wanted += 0.07 * 4 * ticks.axial[k]
            if a == 2:  # what is left of the rotors' drag turns it without a command
                wanted -= yaw_of_drag(QUAD, ticks.thrust[k], forward, right) @ (1.0 - theta)
            said = h[k, a] @ np.append(x, theta) - (drag[k].sum() if a == 2 else 0.0)
            assert said == pytest.approx(wanted)
        assert u[k, -4:-1] == pytest.approx([1.0 / ticks.hover[k], *ticks.curve])


def test_lower_rotors_give_more_and_all_give_less():
    """The share is one more state; the hover command, all rotors at 1, carries the same weight whatever it is."""
    lower, share, s = plant_rows.lower_rotors(Y6), 0.1, np.zeros(THETA + 6)
    p, u = plant_of(Y6), plant_rows.packed(table(6), 6)[0]
    s[SHARE] = share
    more = lower - (Y6[3] * lower).mean()
    still = np.concatenate([u[:13], [0.0, 0.0], u[15:]])  # no air from the side
    h, _ = measured(p, still, s)
    assert share * h[:, SHARE] == pytest.approx(-share * Y6 @ (more * u[:6]))
    assert Y6[3] @ more == pytest.approx(0.0, abs=1e-9)
    assert h[:, THETA:] == pytest.approx(Y6 * u[:6] * (1.0 + share * more))
    assert measured(p, still)[0][:, THETA:] == pytest.approx(Y6 * u[:6])
    across = measured(p, u)[0][:, THETA:] - Y6 * u[:6]  # rotors of one arm have no gap
    assert across[2] == pytest.approx(yaw_of_drag(Y6, u[:6], *u[13:15])) and not across[[0, 1, 3]].any()
    prior = array(p.variance)
    assert (p.mean[SHARE], prior[SHARE, SHARE]) == (0.0, SHARE_SD**2)
    assert not prior[SHARE, :SHARE].any() and not prior[:SHARE, SHARE].any()
    assert plant_of(QUAD).variance[SHARE][SHARE] == 0.0  # no other frame has it
    mean, P = plant_rows.any_multirotor(6)
    taught = {"x0": mean, "P0": P, "noise": np.ones((4, 4)), "noise_weight": 2.0, "share": [0.05, 0.001]}
    known = program.steps(0.05, Y6, taught).plant
    assert (known["mean"][0, SHARE], known["variance"][0, SHARE, SHARE]) == (0.05, 0.001)


@pytest.mark.parametrize("B", [QUAD, Y6])
def test_disturbances_fade_and_the_rest_stays(B):
    """b1 and b2 with their time constants."""
    left = array(plant_of(B, 0.2).decay, THETA + B.shape[1])
    assert left[:AXIS_STATES].reshape(4, PER_AXIS) == pytest.approx(
        np.tile([np.exp(-0.2 / TAU[0]), np.exp(-0.2 / TAU[1]), 1, 1, 1], (4, 1))
    )
    assert (left[AXIS_STATES:] == 1.0).all()


def test_what_any_multirotor_is_like():
    """Damping is a rate times the gain, both uncertain and independent: moments of the product, against draws."""
    n, draws = 6, 400_000
    mean, P = plant_rows.any_multirotor(n)
    rng = np.random.default_rng(0)
    for axis in range(3):
        gain = rng.normal(n * definition.GAIN_MEAN[axis], n * definition.GAIN_SD[axis], draws)
        both = np.stack([gain, gain * rng.normal(definition.DAMPING_RATE, definition.DAMPING_RATE_SD, draws)])
        rows = axis * PER_AXIS + np.array([GAIN, DAMPING])
        assert mean[rows] == pytest.approx(both.mean(axis=1), rel=0.02)
        assert P[np.ix_(rows, rows)] == pytest.approx(np.cov(both), rel=0.03)
        assert P[axis * PER_AXIS + B3, axis * PER_AXIS + B3] == definition.BIAS_SD[axis] ** 2
    thrust = 3 * PER_AXIS + GAIN
    assert (mean[thrust], P[thrust, thrust]) == (1.0, definition.GAIN_SD[3] ** 2)
    assert (mean[SIDEWAYS], P[SIDEWAYS, SIDEWAYS]) == pytest.approx((n * definition.SIDE, (n * definition.SIDE_SD) ** 2))
    assert np.linalg.eigvalsh(P).min() >= -1e-12 and (P == P.T).all()
    assert plant_rows.usual_gains(n) == pytest.approx([*(n * np.array(definition.GAIN_MEAN[:3])), 1.0])
    assert np.count_nonzero(P - np.diag(np.diag(P))) == 6  # each angular gain with its damping, nothing else


def test_lower_rotors_are_the_weaker_ones_at_one_place():
    arms = {"y6": ((1, 5), (2, 3), (4, 6)), "octaquad-x": ((1, 6), (2, 5), (3, 8), (4, 7))}
    for name, pairs in arms.items():
        B = airframes.named(f"ardupilot-{name}").effectiveness()
        lower = plant_rows.lower_rotors(B)
        for pair in pairs:
            weaker = min(pair, key=lambda r: B[3, r - 1])
            assert [lower[r - 1] for r in pair] == [float(r == weaker) for r in pair]
    for name in ("quad-x", "hexa-x", "octa-x"):
        assert plant_rows.lower_rotors(airframes.named(f"ardupilot-{name}").effectiveness()) is None
    even = Y6 / Y6[3]
    assert plant_rows.lower_rotors(even) is None  # rotors of equal strength have no lower one
