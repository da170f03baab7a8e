"""The evidence of a bank: sums over onsets and hypotheses against plain NumPy, and the best jump against dense Gaussian algebra."""

import numpy as np
import pytest
from scipy.special import logsumexp
from tests.loss_prior import beside_steps, one_of
from tests.plain import array, copied, filled, logs, lower, made, plant, room

from rotorwatch import airframes
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.program import square
from rotorwatch.engine.estimator import hypotheses
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Bank
from rotorwatch.engine.estimator.estimator_sizes import SLOTS
from rotorwatch.engine.estimator.evidence import Best, Evidence, Shift
from rotorwatch.engine.estimator.hypotheses import (
    AIR_SHARE,
    ALL_TORQUES,
    CLEAR,
    DISTURBANCE_WEIGHT,
    FAR,
    FAR_SHARE,
    LOSS_WIDTH,
    NONE,
    NOTHING,
    PAIR_WEIGHT,
    RECOVERY_SHARE,
)
from rotorwatch.engine.estimator.kalman import Branch
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import ANSWER_S, THETA, entry
from rotorwatch.engine.events.decisions import TOTAL_LOSS

N, DT = 4, 0.05
HYP = list_hypotheses(N)
FAULT = np.array(HYP.fault)
B = airframes.named("ardupilot-quad-x").effectiveness()
P = plant(B, DT)
AIR, OUTSIDE, FULL = 0.3, 0.02, 2.5
CALM = np.tile(np.array([[0.01**2], [0.02**2], [0.02**2], [0.01**2]]), (1, 4))
PLACE = [*range(FIRST_LOSS, FIRST_LOSS + N), *range(4)]  # rotors, then axes, among the directions of the bank


def reported(strength=60.0, jump=(0, 0.1), seed=0, sd=0.03):
    """A bank of onsets, every third slot unused, that has seen rotor jump[0] lose jump[1]: information grows with age."""
    rng, bank, q = np.random.default_rng(seed), Bank(), FIRST_LOSS + N
    bank.begin(P)
    directions = np.concatenate([B, np.eye(4)], axis=1)
    for w, slot in enumerate(bank.packs):
        size = strength * (w + 1.0) / SLOTS
        A = 0.4 * rng.standard_normal((N + 4, N + 4))  # no two directions are distinguished without the others
        own = size * (directions.T @ directions + A.T @ A)
        score = own @ (jump[1] * np.eye(N + 4)[jump[0]]) + sd * np.sqrt(size) * rng.standard_normal(N + 4)
        C, z = np.zeros((q, q)), np.zeros(q)
        C[np.ix_(PLACE, PLACE)], z[PLACE] = own, score
        filled(slot, age=-1.0 if w % 3 == 2 else float(w), C=lower(C), z=z, M=rng.uniform(0, 1, (THETA + N, q)))
    return bank


def gather(bank, theta=(0.0,) * N, active=(), variances=CALM):
    found = made(Evidence, yaw_error=1e-12, damping_error=1e-12)
    leader = made(Branch, s=np.append(np.zeros(THETA), theta), active=np.isin(np.arange(1, N + 1), active))
    found.ask(P, leader, made(Noise, v=variances), [1.0] * N, [0.0] * N, AIR, OUTSIDE, FULL)
    found.slots = []  # of each, its log Bayes factors
    for k, slot in enumerate(bank.packs):
        found.look(P, bank, k, k + 1)
        row = logs(array(found.nats, len(HYP.names)), array(found.weight, len(HYP.names)))
        found.slots.append((row if slot.age >= 0 else np.full(len(HYP.names), NOTHING)) + np.log(slot.stride))
    found.gather(P)
    return found


def in_use(bank):
    return np.array([slot.age >= 0 for slot in bank.packs])


def factors(found):
    """(slots, hypotheses) log Bayes factors with the slots' strides."""
    return np.array(found.slots)


def odds(found):
    return array(found.odds, len(HYP.names))


def moved(width):
    """Width of disturbances, where air moves as well."""
    return np.hypot(np.hypot(width, OUTSIDE), [0.0, 0.0, 0.0, AIR])


def expected(found, bank, active=()):
    """Log evidence of each hypothesis, from the Bayes factors alone."""
    known, out = np.isin(np.arange(N), np.array(active) - 1), np.empty(len(HYP.names))
    for h, (kind, who) in enumerate(zip(HYP.kinds, HYP.rotors)):
        mine = all(known[i] for i in who)
        prior = np.log(HYP.weight[h])
        if kind != "disturbance":
            prior += CLEAR if mine else -CLEAR if known.any() else 0.0
        if kind == "stuck" and known.any() and not mine:
            prior = -np.inf
        out[h] = logsumexp(factors(found)[in_use(bank), h] + prior)
    return out


@pytest.mark.parametrize("active, theta", [((), (0.0,) * 4), ((2,), (0.0, 0.3, 0.0, 0.0))])
def test_evidence_is_summed_over_all_onsets_with_prior_weights(active, theta):
    """Rotors known to be weak are likelier to change again, others less likely to fail; two at once are rare; a recovery is of a
    rotor that is known to be weak."""
    bank = reported()
    found = gather(bank, theta, active)
    wanted = expected(found, bank, active)
    known = [HYP.rotors[h][0] + 1 in active if HYP.rotors[h] else False for h in range(len(HYP.kinds))]
    # beside a weak rotor no other gives one thrust
    free = {"recovery": known, "stuck": known if active else [True] * len(known)}
    may = np.array([free.get(kind, [True] * len(known))[h] for h, kind in enumerate(HYP.kinds)])
    can = may & (wanted > NOTHING + 10.0)  # less is as good as never
    assert odds(found)[can] == pytest.approx(wanted[can], rel=1e-9) and (odds(found)[~may] < NOTHING).all()
    faults, probability = FAULT & may, array(found.probability, len(HYP.names))
    assert found.fault == pytest.approx(logsumexp(wanted[faults]))
    assert found.other == pytest.approx(logsumexp(wanted[~FAULT]))
    assert probability[faults] == pytest.approx(np.exp(wanted[faults] - logsumexp(wanted[faults])), abs=1e-12)
    assert probability[~FAULT].max() == 0.0 and probability.sum() == pytest.approx(1.0)
    assert found.first == int(np.argmax(probability)) and (active or HYP.names[found.first] == "rotor 1")


def test_two_rotors_at_once_need_ten_thousand_times_the_odds():
    bank = reported()
    found = gather(bank)
    summed = logsumexp(factors(found)[in_use(bank)], axis=0)
    for h, kind in enumerate(HYP.kinds):
        if kind != "recovery" and summed[h] > NOTHING + 10.0:
            assert odds(found)[h] - summed[h] == pytest.approx(np.log(HYP.weight[h]), abs=1e-9)
    assert PAIR_WEIGHT == 1e-4 and DISTURBANCE_WEIGHT > 1.0  # of one rotor: 1


def test_the_loudest_disturbance_is_that_of_one_onset_sudden_or_gradual():
    bank = reported(strength=600.0)
    found = gather(bank)
    single = factors(found)[:, ~FAULT] - np.log([[slot.stride] for slot in bank.packs])
    gradual = np.array([slot.gradual for slot in bank.packs])
    for kind in (False, True):
        wanted = single[in_use(bank) & (gradual == kind)].max()
        assert found.disturbed(P, kind) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(("active", "first"), [((), ALL_TORQUES), ((2,), 0)])
def test_something_else_is_a_fifth_of_disturbances_and_larger_than_this_flights(active, first):
    """Four times as wide as the noise model has them, within limits; in thrust also as the air that moves. Of all torques together, and
    beside a weak rotor of any axes."""
    bank = reported()
    found = gather(bank, active=active)
    sd = np.sqrt(CALM[1] + CALM[2] + 5.0 * CALM[3])
    assert found.asked.width == pytest.approx(moved(np.clip(3.0 * sd, 0.03, 1.0))) and min(found.asked.width) > 0.03
    wide, nats, weight = [], room(len(HYP.blocks)), room(len(HYP.blocks))
    for slot in (slot for slot in bank.packs if slot.age >= 0):
        found.window.reduce(P, slot, 1e-12, 1e-12)
        hypotheses.steps(found.window, found.asked.width, FAR, first, nats, weight)
        wide.append(logs(nats, weight)[first:] + np.log(slot.stride))
    wanted = logsumexp(wide) + np.log(FAR_SHARE * DISTURBANCE_WEIGHT)
    assert found.far == pytest.approx(wanted, rel=1e-9)
    assert gather(bank, variances=1e-12 * CALM).asked.width == pytest.approx(moved(np.full(4, 0.03)))
    assert gather(bank, variances=1e6 * CALM).asked.width == pytest.approx(moved(np.ones(4)))


def test_slots_that_are_not_in_use_say_nothing():
    loud = copied(reported())
    for slot in loud.packs:
        if slot.age < 0:
            slot.z = [1e3] * len(slot.z)
    found, best = gather(loud), Best()
    np.testing.assert_array_equal(odds(found), odds(gather(reported())))
    for h in (0, 5, len(HYP.names) - 1):
        found.pick(P, loud, h, best)
        assert in_use(loud)[best.slot]


@pytest.mark.parametrize(("loss", "another"), [(TOTAL_LOSS - 0.01, -1.0), (TOTAL_LOSS + 0.01, -3.0)])
def test_beside_a_weak_rotor_another_loss_is_less_likely_and_far_less_beside_one_that_is_gone(loss, another):
    """Itself it is likely to change again: ten times; another one is ten times less likely, or a thousand times and not two at once."""
    bank = reported()
    found = gather(bank, (0.0, loss, 0.0, 0.0), (2,))
    summed = logsumexp(factors(found), axis=0)
    prior, can = odds(found) - summed - np.log(HYP.weight), summed > NOTHING + 10.0  # less is as good as never
    for h in (h for h, fault in enumerate(FAULT) if fault and can[h] and HYP.kinds[h] != "recovery"):
        new = set(HYP.rotors[h]) - {1}
        if (another == -3.0 and len(new) > 1) or (new and HYP.kinds[h] == "stuck"):
            assert odds(found)[h] < NOTHING, HYP.names[h]
        else:
            assert prior[h] == pytest.approx(CLEAR * (another if new else 1.0)), HYP.names[h]


def ends(bank, w, loss=0.3):
    """The jump that ends the loss of rotor 2 at an onset: all that the filter holds of it by now, or will; of gradual onsets part is still
    to come."""
    slot = bank.packs[w]
    held = slot.M[THETA + 1][FIRST_LOSS + 1] + slot.gradual * np.exp(-DT / ANSWER_S * (slot.age + 1))
    return -loss / max(held, 0.3)


def test_what_ends_a_loss_is_all_that_the_filter_still_holds_of_it():
    """A recovery that is as likely as can be has that size."""
    bank, best = reported(strength=1e-9), Best()
    for w in (0, 4, 33, 46):
        alone = copied(bank)
        for k, slot in enumerate(alone.packs):
            slot.age = slot.age if k == w else -1.0
        found = gather(alone, (0.0, 0.3, 0.0, 0.2), (2,))
        found.pick(P, alone, HYP.names.index("rotor 2 is well again"), best)
        assert best.slot == w and best.size == pytest.approx(ends(bank, w), rel=1e-4)
    assert bank.packs[33].gradual and not bank.packs[4].gradual


def jumped(found, bank, name):
    """(best, size, covariance) of a hypothesis, rotors and then axes."""
    best, shift = Best(), Shift()
    found.pick(P, bank, HYP.names.index(name), best)
    found.shift(P, bank, best, shift)
    return best, np.array(shift.size)[PLACE], np.array(shift.cov)[np.ix_(PLACE, PLACE)]


@pytest.mark.parametrize("name", ["rotor 2", "rotors 1+4", "rotor 2 is well again"])
def test_a_jump_has_the_covariance_of_a_gaussian_in_all_its_directions_together(name):
    """Rotors' losses and the axes' slop at once, dense: the marginal of the losses, cross terms and all."""
    h, bank = HYP.names.index(name), reported(seed=3)
    found = gather(bank, (0.0, 0.3, 0.0, 0.0), (2,))
    best, size, cov = jumped(found, bank, name)
    w, live = best.slot, np.flatnonzero(in_use(bank))
    assert w == live[np.argmax(factors(found)[live, h])] and best.since == bank.packs[w].age + 1.0
    who = list(HYP.rotors[h])
    index = [*who, *range(N, N + 4)]
    C = square(np.array(bank.packs[w].C), FIRST_LOSS + N)[np.ix_(PLACE, PLACE)][np.ix_(index, index)]
    z = array(bank.packs[w].z)[PLACE][index]
    width = float(np.hypot(NONE, RECOVERY_SHARE * ends(bank, w))) if "again" in name else LOSS_WIDTH
    prior = np.array([width**2] * len(who) + (np.array(found.freed.slop) + 1e-12).tolist())
    dense = np.linalg.inv(C + np.diag(1.0 / prior))[: len(who), : len(who)]
    if name == "rotor 2":  # parts of the prior instead of one Gaussian, with and without air that moves
        steady = prior[1:]
        parts = ((AIR_SHARE, steady + np.array([0.0, 0.0, 0.0, AIR**2])), (1.0 - AIR_SHARE, steady))
        dense = np.array([[one_of([(share, *beside_steps(C, z, p, 1.0 - 0.3)) for share, p in parts])[2]]])
    assert cov[np.ix_(who, who)] == pytest.approx(dense, rel=1e-6)
    if len(who) == 2:
        assert abs(dense[0, 1]) > 0.02 * dense[0, 0]  # there is something to distinguish
    assert not cov[N:].any() and not cov[:, N:].any()  # what geometry is wrong by becomes no disturbance
    assert size[who] == pytest.approx([best.size_of(i) for i in who]) and not np.delete(size, who).any()


def test_a_disturbance_is_a_step_of_its_axes_alone():
    bank, axes = reported(seed=4), np.array([1, 3])
    found = gather(bank)
    best, size, cov = jumped(found, bank, "pitch and common mode")
    index = N + axes
    prior = (FAR * np.array(found.asked.width)[axes]) ** 2
    own = square(np.array(bank.packs[best.slot].C), FIRST_LOSS + N)[np.ix_(axes, axes)]
    dense = np.linalg.inv(own + np.diag(1.0 / prior))
    assert cov[np.ix_(index, index)] == pytest.approx(dense, rel=1e-6)
    assert size[index] == pytest.approx(dense @ array(bank.packs[best.slot].z)[axes], rel=1e-6)
    assert not np.delete(size, index).any() and best.rotor == best.other == -1


def test_a_loss_can_be_measured_as_well_as_the_best_slot_knows_it():
    bank = reported()
    found = gather(bank)
    for i in range(N):
        own = max(slot.C[entry(FIRST_LOSS + i, FIRST_LOSS + i)] for slot in bank.packs if slot.age >= 0)
        assert found.detectable(i) == pytest.approx(1.0 / np.sqrt(own + LOSS_WIDTH**-2))
