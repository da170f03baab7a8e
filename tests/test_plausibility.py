"""May this jump be a loss? Each gate by itself, at its limit, and how what is missing is followed."""

from functools import partial

import numpy as np
import pytest
from tests.plain import array, copied, made, plant

from rotorwatch import airframes
from rotorwatch.diagnose import diagnose
from rotorwatch.engine.estimator.bank import Slots
from rotorwatch.engine.estimator.evidence import Best
from rotorwatch.engine.estimator.hypotheses import NONE, RECOVERY
from rotorwatch.engine.estimator.kalman import Branch
from rotorwatch.engine.estimator.model_error import AT_LIMIT, BELOW_LIMIT, Seen
from rotorwatch.engine.estimator.noise import FAST, Noise
from rotorwatch.engine.estimator.plant import ANSWER_S, USUAL_S, Inputs
from rotorwatch.engine.estimator.plausibility import (
    CUT_SHARE,
    DEMAND_SHARE,
    DEMAND_SLACK,
    LIMIT_S,
    MISSING_SLACK,
    Coupling,
    Missing,
    Plausible,
)
from rotorwatch.engine.events.carried import LANDS
from rotorwatch.flight.kinds import LOSS
from rotorwatch_lab.simulation import scenario, simulate

N, DT = 4, 0.1
NOTHING = np.zeros(N)
P = plant(airframes.named("ardupilot-quad-x").effectiveness(), DT)


def missing(fast=1.0, slow=0.0, limit=NOTHING, climb=0.0, usual=0.0):
    return made(Missing, fast=fast, slow=slow, usual=usual, climb=climb, limit=np.asarray(limit, float))


def jump(*rotors, gives=0.0):
    """Rotor (1-based) and size of one or two; gives: the thrust that it gives, whatever it is commanded."""
    (one, size), (other, second) = (*rotors, (0, 0.0))[:2]
    return made(Best, rotor=one - 1, other=other - 1, size=size, other_size=second, gives=gives)


def possible(what, rise=1.0, now=None, measured=True, active=(), rough=(0.0, 0.0, 0.0, 0.0), smooth=1.0, since=60.0):
    seen = made(Seen, thrust=smooth * np.ones(N), part=rise * np.ones(N))
    v, may, coupling = np.zeros((4, 4)), Plausible(), made(Coupling, raises=np.eye(N))
    v[FAST] = rough
    leader = made(Branch, active=np.isin(np.arange(1, N + 1), active))
    tick = made(Inputs, valid=np.array([True, True, True, measured]))
    what.since = since / DT
    may.assess(P, what, Slots(), tick, seen, now or missing(), leader, made(Noise, v=v), coupling)
    return may.asked and may.missing


def test_a_loss_that_is_asked_for_and_missing_is_possible():
    assert possible(jump((2, 0.3))) and possible(jump((2, 0.3), (4, 0.2)))


def test_the_smallest_loss():
    assert not possible(jump((2, NONE - 1e-6))) and possible(jump((2, NONE + 1e-6)))


@pytest.mark.parametrize("size, smooth", [(0.3, 1.0), (0.3, 0.6), (0.9, 1.0)])
def test_more_has_to_be_asked_of_a_rotor_that_gives_less(size, smooth):
    """A quarter of what is missing, less the slack; of every rotor that is named."""
    least = DEMAND_SHARE * size * smooth - DEMAND_SLACK
    assert possible(jump((2, size)), rise=least + 1e-6, smooth=smooth)
    assert not possible(jump((2, size)), rise=least - 1e-6, smooth=smooth)
    rises = np.array([1.0, 1.0, 1.0, least - 1e-6])
    assert not possible(jump((1, size), (4, size)), rise=rises, smooth=smooth)
    assert possible(jump((1, -0.3)), rise=9.0, active=(1,))  # one that works again need not be asked for less at once


def test_less_has_to_be_asked_of_a_rotor_that_gives_more():
    """A quarter of what it gives more, less the slack; it has to be taken off the command, and to stay so."""
    cut = np.array([1.0, 0.2, 1.0, 1.0])
    stuck = jump((2, 1.0), gives=1.8)
    most = -DEMAND_SHARE * (1.8 - 0.2) + DEMAND_SLACK
    assert possible(stuck, rise=most - 1e-6, smooth=cut)
    assert not possible(stuck, rise=most + 1e-6, smooth=cut)
    assert not possible(stuck, rise=-2.0, smooth=cut, since=0.5 * ANSWER_S - 1e-6)
    follows = np.full(N, 1.0)
    for share, may in ((CUT_SHARE - 1e-3, True), (CUT_SHARE + 1e-3, False)):
        follows[1] = 3.0 * share / (4.0 - share)  # so much of the mean of all four
        assert possible(stuck, rise=-2.0, smooth=follows) == may


def test_a_rough_flight_leaves_a_lone_rotor_more_slack_and_two_none():
    """Torque's standard deviation over the rotors; two at once have to show as they would in calm air."""
    rough = (0.3**2, 0.4**2, 1.2**2, 0.0)
    swing = 1.3 / N
    least = DEMAND_SHARE * 0.3 - swing
    assert swing > DEMAND_SLACK
    assert possible(jump((2, 0.3)), rise=least + 1e-6, rough=rough)
    assert not possible(jump((2, 0.3)), rise=least - 1e-6, rough=rough)
    calm = DEMAND_SHARE * 0.3 - DEMAND_SLACK
    assert not possible(jump((2, 0.3), (4, 0.3)), rise=calm - 1e-6, rough=rough)
    assert possible(jump((2, 0.3), (4, 0.3)), rise=calm + 1e-6, rough=rough)


@pytest.mark.parametrize("rough, slack", [(0.0, MISSING_SLACK), (0.4**2, 0.4)])
def test_thrust_that_rotors_no_longer_give_is_missing(rough, slack):
    """A quarter of it, less the slack or the roughness of thrust; against what was missing before; where thrust is measured."""
    least = DEMAND_SHARE * 0.9 * 2.0 - slack
    for before in (0.0, 0.3):
        for more, answer in ((1e-6, True), (-1e-6, False)):
            now = missing(fast=before + least + more, slow=9.0, usual=before)
            one = jump((2, 0.9))
            assert possible(one, now=now, rough=(0, 0, 0, rough), smooth=2.0, rise=9.0) is answer
            assert possible(one, now=now, measured=False, rise=9.0, smooth=2.0)
    assert possible(jump((2, -0.3)), now=missing(fast=-9.0), active=(2,))  # what gives more again lacks nothing


@pytest.mark.parametrize("still", [True, False])
@pytest.mark.parametrize("carries", [0.97, 0.8])
def test_no_rotor_is_lost_while_the_ground_carries_a_part(carries, still):
    """Commanded less than carries the vehicle, which neither climbs nor sinks. A rotor stuck at much thrust makes it climb first. The end
    of a loss needs less thrust, too."""
    now, gear = made(Missing), made(Inputs, load=float(N), valid=np.ones(4, bool), still=still, full=9.0)
    for thrust in (1.0,) * 30 + (carries,) * 10:
        now.follow(P, gear, N * (thrust - 1.0))
    assert now.stands == (still and carries < LANDS)
    stuck, cut = jump((2, 1.0), gives=1.8), np.array([1.0, 0.2, 1.0, 1.0])
    assert possible(stuck, rise=-2.0, smooth=cut, now=now) != now.stands
    back = jump((2, -0.3))
    back.kind = RECOVERY
    assert possible(back, now=now, active=(2,))


@pytest.mark.parametrize("climb, air", [(-3.0, 0.1 * N * 3.0), (0.0, 0.0), (3.0, 0.0)])
def test_air_from_below_gives_thrust_that_a_rotor_lacks(climb, air):
    """A vehicle that has begun to sink by 3 m/s: a tenth of all thrust for each m/s. Two rotors must show as in calm air."""
    least, now = DEMAND_SHARE * 0.9 * 2.0 - MISSING_SLACK, partial(missing, climb=climb)
    for more, answer in ((1e-6, True), (-1e-6, False)):
        assert possible(jump((2, 0.9)), now=now(fast=least - air + more), smooth=2.0, rise=9.0) is answer
        two = DEMAND_SHARE * 1.8 * 2.0 - MISSING_SLACK + more
        assert possible(jump((2, 0.9), (4, 0.9)), now=now(fast=two), smooth=2.0, rise=9.0) is answer


def test_the_speed_of_climb_is_what_the_load_factor_has_made_lately():
    """Half a second at 1.2 g is 1 m/s; after six seconds 37 % of it is left, after a new start nothing; what is not measured adds none."""
    push = [(0.0, 1.2, 0.5, True, False)] * 5
    begun = float(followed(push).climb)
    assert begun == pytest.approx(0.2 * 9.80665 * 0.5, rel=0.05)
    assert float(followed([(0.0, 0.8, 0.5, True, False)] * 5).climb) == pytest.approx(-begun)
    quiet = [(0.0, 1.0, 0.5, True, False)] * round(USUAL_S / DT)
    assert float(followed(push + quiet).climb) == pytest.approx(begun * np.exp(-1.0))
    assert float(followed([*push, (0.0, 1.2, 0.5, True, True)]).climb) == 0.0
    assert float(followed([(0.0, 1.2, 0.5, False, False)] * 5).climb) == 0.0


@pytest.mark.parametrize("since", [0.05, 0.2, 1.0])
def test_a_young_loss_need_not_be_missing_yet(since):
    """The average over half a second shows a step by 1 - exp(-t / 0.5 s)."""
    least = DEMAND_SHARE * 0.9 * 2.0 * -np.expm1(-since / ANSWER_S) - MISSING_SLACK
    for more, answer in ((1e-6, True), (-1e-6, False)):
        assert possible(jump((2, 0.9)), now=missing(fast=least + more), smooth=2.0, rise=9.0, since=since) is answer


def test_a_jump_beyond_all_lacks_no_more_than_all():
    least = DEMAND_SHARE * 1.0 * 2.0 - MISSING_SLACK
    assert possible(jump((2, 1.5)), now=missing(fast=least + 1e-6), smooth=2.0, rise=9.0)


def test_what_a_limit_explains_is_no_loss():
    """Of the rotor at its limit only; a rotor that is known to be weak is asked no more."""
    limit = np.array([0.0, 0.2, 0.0, 0.0])
    assert not possible(jump((2, 0.19)), now=missing(limit=limit)) and possible(jump((2, 0.21)), now=missing(limit=limit))
    assert possible(jump((3, 0.19)), now=missing(limit=limit))
    assert possible(jump((2, 0.19)), now=missing(limit=limit), active=(2,))
    assert possible(jump((2, -0.19)), now=missing(limit=limit), active=(2,))


def followed(rows, start=None):
    """(missing, load, share, valid, restart) tick by tick."""
    state = copied(start or Missing())
    for what, load, share, valid, restart in rows:
        now = made(Inputs, thrust=np.full(N, share), full=1.0, load=load * N, restart=restart, valid=np.full(4, valid))
        state.follow(P, now, what)
    return state


def test_what_is_missing_is_averaged_over_half_a_second_and_six():
    """First order: after its time constant 63 % of a step; what is not measured takes nothing from the slow one."""
    begun = [(0.0, 1.0, 0.5, True, True)]
    for name, tau in (("fast", ANSWER_S), ("slow", USUAL_S)):
        ticks = round(tau / DT)
        part = float(getattr(followed(begun + [(2.0, 1.0, 0.5, True, False)] * ticks), name))
        assert part == pytest.approx(2.0 * (1.0 - (1.0 - DT / tau) ** ticks)) and 1.2 < part < 1.4
    blind = followed([(5.0, 1.0, 0.5, False, False)] * 30, missing(fast=1.0, slow=0.4))
    assert float(blind.slow) == pytest.approx(0.4) and float(blind.fast) == pytest.approx(0.4, abs=0.03)
    anew = followed([(3.0, 1.4, 0.95, True, True)], missing(fast=1.0, slow=0.4, limit=np.ones(N)))
    assert float(anew.fast) == float(anew.slow) == 3.0 and float(anew.heave) == pytest.approx(0.4)
    assert array(anew.limit, N) == pytest.approx(1.0 - BELOW_LIMIT / 0.95)


@pytest.mark.parametrize("load", [0.5, 1.5])
def test_a_push_up_or_down_is_remembered_for_eight_seconds(load):
    push = [(0.0, load, 0.5, True, False)]
    assert float(followed(push).heave) == pytest.approx(0.5)
    assert float(followed(push).rose) == pytest.approx(max(load - 1.0, 0.0)), "no loss lifts a vehicle"
    quiet = [(0.0, 1.0, 0.5, True, False)] * round(USUAL_S / DT)
    assert float(followed(push + quiet).heave) == pytest.approx(0.5 * np.exp(-1.0))
    assert float(followed([(0.0, load, 0.5, False, False)]).heave) == 0.0


def test_a_rotor_near_its_limit_may_lack_what_it_is_commanded_beyond_what_is_believed():
    """None up to BELIEVED, all beyond it from AT_LIMIT on, in between in proportion; remembered for two seconds."""
    for share, near in ((BELOW_LIMIT, 0.0), (0.5 * (BELOW_LIMIT + AT_LIMIT), 0.5), (AT_LIMIT, 1.0), (1.0, 1.0), (0.2, 0.0)):
        found = array(followed([(0.0, 1.0, share, True, False)]).limit, N)
        assert found == pytest.approx(near * max(0.0, 1.0 - BELOW_LIMIT / share))
    quiet = [(0.0, 1.0, 0.3, True, False)] * round(LIMIT_S / DT)
    after = array(followed([(0.0, 1.0, 1.0, True, False), *quiet]).limit, N)
    assert after == pytest.approx((1.0 - BELOW_LIMIT) * np.exp(-1.0))


def test_what_is_asked_of_two_rotors_follows_from_geometry():
    """A rotor alone: its own loss; of a neighbour what the least change of thrusts gives; of opposite ones each its own."""
    hexa = airframes.named("ardupilot-hexa-x").effectiveness()
    known, answer = Coupling(), np.linalg.pinv(hexa) @ hexa - 1 / 6
    known.begin(plant(hexa))
    coupling = array(known.raises, 6, 6)
    assert np.diagonal(coupling) == pytest.approx(np.ones(6))
    assert coupling @ [0.3, 0.3, 0, 0, 0, 0] == pytest.approx([0.3, 0.3, *(coupling[2:, :2].sum(axis=1) * 0.3)])
    assert (coupling @ [0.3, 0, 0.3, 0, 0, 0])[0] == pytest.approx((answer @ [0.3, 0, 0.3, 0, 0, 0])[0] / answer[0, 0])


@pytest.mark.parametrize("onset", [26.0, 28.0])
def test_a_loss_while_a_manoeuvre_lowers_the_rotors_command_is_announced(onset):
    """An octa that turns on the spot in calm air: yaw swings the commands by more than a loss of 45 % raises them."""
    flight = simulate(scenario.from_table({
        "duration_s": 40.0, "autopilot": "ardupilot", "airframe": {"frame": "octa-x", "mass_kg": 2.0, "arm_m": 0.3},
        "trajectory": {"kind": "yaw", "speed_m_s": 4.0, "land": False}, "logging": {"profile": "fast"}, "seed": 3,
        "faults": [{"kind": "loss", "rotor": 1, "onset_s": onset, "strength": 0.45}],
    })).flight  # fmt: skip
    (event,) = (e for e in diagnose(flight).events if e.kind == LOSS)
    assert event.rotors == (1,) and not event.alternatives
    assert event.onset_s == pytest.approx(onset, abs=0.5) and event.detected_s < onset + 4.0
