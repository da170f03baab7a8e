"""What control may rely on: losses come at once, recoveries late, a rotor that is left out stays out, and the mixer answers the demands."""

import shutil

import numpy as np
import pytest
from tests import board

from rotorwatch import airframes
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.events.events import Event
from rotorwatch.engine.events.reliance import LEAST, LEVEL, MOVED, REFRESH_S, RISES_S, TURNS, UNABLE, Reliance
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import ROTORS


def craft(name, mixer=False):
    """A frame in the definitions' form."""
    vehicle, v = airframes.named(name), Vehicle()
    v.rotors = len(vehicle.rotors)
    for a, row in enumerate(vehicle.effectiveness()):
        v.effectiveness[a][: v.rotors] = row.tolist()
    if vehicle.mixer is not None and mixer:
        v.mixer[: v.rotors], v.mixer_known = vehicle.mixer.tolist(), True
    return v


def loss(rotor, share, sd=0.05, **more):
    """A loss of a rotor, from 0."""
    e = Event()
    e.rotors, e.loss[0], e.lower[0], e.upper[0], e.probability = 1 << rotor, share, max(share - 2 * sd, 0.0), min(share + 2 * sd, 1.0), 0.99
    for name, value in more.items():
        setattr(e, name, value)
    return e


def looked(r, v, now, *events, start=1.0):
    return r.look(v, list(events), len(events), start, now)


def test_a_loss_comes_at_once_and_a_recovery_when_it_has_lasted():
    r, v = Reliance(), craft("ardupilot-hexa-x")
    assert not looked(r, v, 5.0)
    assert looked(r, v, 10.0, loss(2, 0.3)) and r.effectiveness[2] == pytest.approx(0.7)
    assert (r.lower[2], r.upper[2]) == (pytest.approx(0.6), pytest.approx(0.8))
    assert not looked(r, v, 10.0 + REFRESH_S, loss(2, 0.3 + 0.9 * MOVED)), "no further than the last one by MOVED"
    assert not looked(r, v, 10.0 + 0.5 * REFRESH_S, loss(2, 0.45)) and looked(r, v, 10.0 + REFRESH_S, loss(2, 0.45))
    seen, now = [], 20.0
    while now < 20.0 + 2 * RISES_S:  # over, and again, and over
        seen.append(looked(r, v, now, *([loss(2, 0.45)] if int(now) % 4 == 0 else [])))
        now += 0.1
    assert not any(seen), "it does not flap"
    looked(r, v, 39.95, loss(2, 0.45))
    assert not looked(r, v, 40.0) and not looked(r, v, 39.9 + RISES_S) and looked(r, v, 40.0 + RISES_S)
    assert list(r.effectiveness[:6]) == [1.0] * 6 and r.left_out == 0


def test_a_rotor_that_is_left_out_stays_out_until_the_next_flight():
    r, v = Reliance(), craft("ardupilot-hexa-x")
    unsure = loss(4, 0.9)
    unsure.alternative_count, unsure.alternatives[0] = 1, 1 << 1
    assert not looked(r, v, 10.0, unsure), "other rotors may be it"
    assert looked(r, v, 10.5, loss(4, 0.55, 0.04)) and r.left_out == 0, "it may give more than half"
    assert looked(r, v, 11.0, loss(4, 0.8)) and r.left_out == 1 << 4 and r.effectiveness[4] == 0.0
    assert (r.decided, r.stands) == (11.0, True) and r.odds == pytest.approx(99.0)
    revision = r.revision
    assert not looked(r, v, 11.05, loss(4, 0.5)) and r.stands, "it may give half again, and is left out all the same"
    for now in np.arange(11.1, 60.0, 0.1):
        looked(r, v, now)
    assert r.left_out == 1 << 4 and r.revision == revision and not r.stands
    assert not looked(r, v, 61.0, start=LASTS) and r.left_out == 1 << 4, "on the ground all stays"
    looked(r, v, 70.0, start=69.0)
    assert r.left_out == 0 and r.decided == LASTS and r.effectiveness[4] == 1.0 and r.revision > revision


def test_a_stuck_rotor_answers_no_command():
    r, v = Reliance(), craft("ardupilot-octa-x")
    assert looked(r, v, 10.0, loss(3, 0.1, size=2.1)) and r.left_out == 1 << 3


@pytest.mark.parametrize("name", ["ardupilot-quad-x", "ardupilot-hexa-x", "ardupilot-octa-x", "px4-octa-coaxial"])
@pytest.mark.parametrize("lost", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("mixer", [False, True])
def test_the_mixer_answers_the_demands(name, lost, mixer):
    r, v = Reliance(), craft(name, mixer)
    B = np.array(v.effectiveness)[:, : v.rotors]
    if lost:
        assert looked(r, v, 10.0, loss(0, lost, 0.01))
    out = [0.0] * (4 * ROTORS)
    can = r.factors(v, out)
    F = np.array(out[: 4 * v.rotors]).reshape(v.rotors, 4)
    e = np.array(r.effectiveness)[: v.rotors]
    assert can == (TURNS if lost < 1.0 or "octa" in name else LEVEL if "hexa" in name else UNABLE)
    if can == UNABLE:
        return
    kept = [0, 1, 2, 3] if can == TURNS else [0, 1, 3]
    wanted = B @ np.array(v.mixer)[: v.rotors] if mixer else np.eye(4)
    np.testing.assert_allclose((B @ (e[:, None] * F))[np.ix_(kept, kept)], wanted[np.ix_(kept, kept)], atol=1e-9)
    assert (F[e > 0.0, 3] >= LEAST * F[:, 3].mean()).all() and (can == TURNS or not F[:, 2].any())


def hovers(vehicle, lost, onset, until):
    """Samples of a hover in which a rotor stops, and the others carry the vehicle."""
    rng, n, B = np.random.default_rng(5), len(vehicle.rotors), vehicle.effectiveness()
    left = np.delete(np.arange(n), lost)
    gone = np.insert(np.linalg.lstsq(B[:, left], [0.0, 0.0, 0.0, float(n)], rcond=None)[0], lost, 1.6)  # its controller asks more of it
    time = np.arange(0.0, until, 0.01)
    rows = np.zeros((6, len(time), board.onboard_law.WIDTH))
    for k, kind in enumerate((board.onboard_law.OUTPUTS, board.onboard_law.GYRO, board.onboard_law.ACCEL, board.onboard_law.ATTITUDE)):
        rows[k, :, 0], rows[k, :, 1], rows[k, :, 2] = kind, time + 1e-4 * k, 1.0
    flies = time > 2.0
    thrust = np.where((time >= onset)[:, None], gone, 1.0) * (0.45 + 0.004 * rng.standard_normal((len(time), n)))
    a = vehicle.curve.expo
    drive = (np.sqrt((1 - a) ** 2 + 4 * a * thrust) - (1 - a)) / (2 * a)
    u = vehicle.curve.u_min + (vehicle.curve.u_max - vehicle.curve.u_min) * np.where(flies[:, None], drive, 0.01)
    rows[0, :, 2], rows[0, :, 3 : 3 + n] = 2**n - 1, u
    rows[1, :, 3:6] = 0.01 * rng.standard_normal((len(time), 3))
    rows[2, :, 3:6] = [0.0, 0.0, -9.81] + 0.2 * rng.standard_normal((len(time), 3))
    rows[3, :, 3] = 1.0
    table = rows[:4].reshape(-1, rows.shape[2])
    armed = np.zeros((1, rows.shape[2]))
    armed[0, :5] = board.onboard_law.STATE, 0.0, 1.0, 0.0, 1.0
    return np.concatenate([armed, table[np.argsort(table[:, 1], kind="stable")]])


@pytest.mark.skipif(not (shutil.which("gcc") and shutil.which("g++")), reason="needs gcc and g++")
@pytest.mark.parametrize("autopilot", ["ardupilot", pytest.param("px4", marks=pytest.mark.thorough)])
def test_an_autopilot_flies_on_with_what_is_left(autopilot, tmp_path):
    """Nothing changes before, nothing where it is not asked for; once a rotor is lost it is left out, and for good."""
    craft = airframes.named(f"{autopilot}-octa-x")
    table = hovers(craft, 2, 30.0, 45.0)
    program = board.build(autopilot, board.library(board.Shown(table, craft, 50.0, 100.0), tmp_path / "library"), tmp_path)
    assert all(f[:8].any(axis=1).all() for _, f in board.fly(program, table, tmp_path, "1", "5", "0").factors)
    flown = board.fly(program, table, tmp_path, "1", "5", "1")
    assert any("rotor 3 lost" in text for *_, text in flown.texts), flown.texts
    late = [(time, f[:8]) for time, f in flown.factors if time > 30.0]
    assert late and late[-1][0] < 31.0 and all(f[:8].any(axis=1).all() for time, f in flown.factors if time < 30.0)
    for _, f in late:
        assert not f[2].any() and np.delete(f, 2, axis=0).any(axis=1).all()
    if autopilot == "ardupilot":
        np.testing.assert_allclose(craft.effectiveness() @ late[-1][1], craft.effectiveness() @ craft.mixer, atol=1e-4)
