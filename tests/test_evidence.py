"""The evidence of a bank: sums over onsets and hypotheses against plain NumPy, and the best jump against dense Gaussian algebra."""

import numpy as np
import pytest
from scipy.special import logsumexp
from tests.loss_prior import beside_steps, one_of

from rotorwatch import airframes
from rotorwatch.engine.default import bank, evidence, hypotheses
from rotorwatch.engine.default.hypotheses import (
    AIR_SHARE,
    CLEAR,
    FAR,
    FAR_SHARE,
    LOSS_WIDTH,
    NOTHING,
    TOTAL_LOSS,
    WEIGHT,
)

N, N_X, DT = 4, 20, 0.05
HYP = hypotheses.make(N)
B = airframes.named("ardupilot-quad-x").effectiveness()
REACH = np.abs(B).max(axis=0)
DRAG = np.zeros(N)
AIR, OUTSIDE, FULL = 0.3, 0.02, 2.5
CALM = np.tile(np.array([[0.01**2], [0.02**2], [0.02**2], [0.01**2]]), (1, 4))
FAULTS = [h for h, fault in enumerate(HYP.fault) if fault]


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


JUMPS = bank.Jumps(np.eye(N_X + N)[:, -(N + 4) :], DT)


def told(strength=60.0, jump=(0, 0.1), seed=0, sd=0.03):
    """A bank of onsets, every third slot unused, that has seen rotor jump[0] lose jump[1]: information grows with age."""
    rng = np.random.default_rng(seed)
    W, q = JUMPS.stride.size, N + 4
    age = np.where(np.arange(W) % 3 == 2, -1, np.arange(W))
    directions = np.concatenate([B, np.eye(4)], axis=1)
    size = strength * (np.maximum(age, 0) + 1.0) / W
    A = 0.4 * rng.standard_normal((W, q, q))  # no two directions are told apart without the others
    C = size[:, None, None] * (directions.T @ directions + A.transpose(0, 2, 1) @ A)
    z = np.einsum("wij,j->wi", C, jump[1] * np.eye(q)[jump[0]]) + sd * np.sqrt(size)[:, None] * rng.standard_normal(
        (W, q)
    )
    return bank.Bank(rng.uniform(0, 1, (W, N_X + N, q)), C, z, age.astype(np.int32), np.int32(9), np.zeros((W, N)))


def gather(bank_, theta=(0.0,) * N, active=(), variances=CALM):
    known = np.isin(np.arange(1, N + 1), active)
    return evidence.gather(
        HYP, JUMPS, bank_, np.asarray(theta, float), known, variances, REACH, DRAG, AIR**2, OUTSIDE, B, FULL
    )


def moved(width):
    """Width of disturbances, where air moves as well."""
    return np.hypot(np.hypot(width, OUTSIDE), [0.0, 0.0, 0.0, AIR])


def expected(found, bank_, theta=(0.0,) * N, active=()):
    """Log evidence of each hypothesis, from the Bayes factors alone."""
    known, live = np.isin(np.arange(N), np.array(active) - 1), np.asarray(bank_.age) >= 0
    out = np.empty(len(HYP.names))
    for h, (kind, who) in enumerate(zip(HYP.kinds, HYP.rotors)):
        mine = all(known[i] for i in who)
        prior = np.log(WEIGHT.get(kind, 1.0))
        if kind != "disturbance":
            prior += CLEAR if mine else -CLEAR if known.any() else 0.0
        if kind == "stuck" and known.any() and not mine:
            prior = -np.inf
        out[h] = logsumexp(np.asarray(found.log_bf)[live, h] + np.log(JUMPS.stride[live]) + prior)
    return out


@pytest.mark.parametrize("active, theta", [((), (0.0,) * 4), ((2,), (0.0, 0.3, 0.0, 0.0))])
def test_evidence_is_summed_over_all_onsets_with_prior_weights(active, theta):
    """Rotors known to be weak are likelier to change again, others less likely to fail; two at once are rare; a recovery is of a
    rotor that is known to be weak."""
    bank_ = told()
    found = gather(bank_, theta, active)
    wanted = expected(found, bank_, theta, active)
    known = [HYP.rotors[h][0] + 1 in active if HYP.rotors[h] else False for h in range(len(HYP.kinds))]
    free = {
        "recovery": known,
        "stuck": known if active else [True] * len(known),
    }  # beside a weak rotor no other gives one thrust
    may = np.array([free.get(kind, [True] * len(known))[h] for h, kind in enumerate(HYP.kinds)])
    can = may & (wanted > NOTHING + 10.0)  # less is as good as never
    assert np.asarray(found.log_odds)[can] == pytest.approx(wanted[can], rel=1e-9)
    assert (np.asarray(found.log_odds)[~may] < NOTHING).all()
    faults = np.asarray(HYP.fault) & may
    assert found.fault == pytest.approx(logsumexp(wanted[faults])) and found.other == pytest.approx(
        logsumexp(wanted[~HYP.fault])
    )
    assert np.asarray(found.probability)[faults] == pytest.approx(
        np.exp(wanted[faults] - logsumexp(wanted[faults])), abs=1e-12
    )
    assert np.asarray(found.probability)[~HYP.fault].max() == 0.0 and np.asarray(
        found.probability
    ).sum() == pytest.approx(1.0)
    assert active or HYP.names[int(np.argmax(found.probability))] == "rotor 1"


def test_two_rotors_at_once_need_ten_thousand_times_the_odds():
    found = gather(told())
    live = np.flatnonzero(np.asarray(found.live))[-1]
    for h, (kind, weight) in enumerate(zip(HYP.kinds, HYP.weight)):
        own = np.asarray(found.per_slot - found.log_bf)[live, h] - np.log(JUMPS.stride[live])
        assert kind == "recovery" or own == pytest.approx(np.log(weight))
    assert WEIGHT["pair"] == 1e-4 and WEIGHT["disturbance"] > 1.0  # of one rotor: 1


def test_disturbances_larger_than_this_flights_are_a_fifth_of_them():
    """Four times as wide as the noise model has them, within limits; in thrust also as the air that moves."""
    bank_ = told()
    found = gather(bank_)
    sd = np.sqrt(CALM[1] + CALM[2] + 5.0 * CALM[3])
    assert (
        np.asarray(found.width) == pytest.approx(moved(np.clip(3.0 * sd, 0.03, 1.0)))
        and np.asarray(found.width).min() > 0.03
    )
    wide = np.asarray(hypotheses.disturbances(HYP, bank_.C, bank_.z, FAR * found.width))
    live = np.asarray(bank_.age) >= 0
    wanted = logsumexp((wide + np.log(JUMPS.stride)[:, None])[live]) + np.log(FAR_SHARE * WEIGHT["disturbance"])
    assert found.far == pytest.approx(wanted, rel=1e-9)
    assert np.asarray(gather(bank_, variances=1e-12 * CALM).width) == pytest.approx(moved(np.full(4, 0.03)))
    assert np.asarray(gather(bank_, variances=1e6 * CALM).width) == pytest.approx(moved(np.ones(4)))


def test_slots_that_are_not_in_use_say_nothing():
    bank_ = told()
    empty = np.asarray(bank_.age) < 0
    loud = bank_._replace(z=np.where(empty[:, None], 1e3, bank_.z))
    found = gather(loud)
    assert (np.asarray(found.log_bf)[empty] == NOTHING).all() and not np.asarray(found.live)[empty].any()
    for h in (0, 5, len(HYP.names) - 1):
        assert evidence.jump(HYP, loud, found, h, B).slot[empty].max() == 0.0


@pytest.mark.parametrize(("loss", "another"), [(TOTAL_LOSS - 0.01, -1.0), (TOTAL_LOSS + 0.01, -3.0)])
def test_beside_a_weak_rotor_another_loss_is_less_likely_and_far_less_beside_one_that_is_gone(loss, another):
    """Itself it is likely to change again: ten times; another one is ten times less likely, or a thousand times and not two at once."""
    found = gather(told(), (0.0, loss, 0.0, 0.0), (2,))
    live = np.flatnonzero(np.asarray(found.live))[-1]
    prior = np.asarray(found.per_slot - found.log_bf)[live] - np.log(JUMPS.stride[live]) - np.log(HYP.weight)
    for h in (h for h in FAULTS if HYP.kinds[h] != "recovery"):
        new = set(HYP.rotors[h]) - {1}
        if (another == -3.0 and len(new) > 1) or (new and HYP.kinds[h] == "stuck"):
            assert found.log_odds[h] < NOTHING, HYP.names[h]
        else:
            assert prior[h] == pytest.approx(CLEAR * (another if new else 1.0)), HYP.names[h]


def test_what_ends_a_loss_is_all_that_the_filter_still_holds_of_it():
    """-theta over the part of a jump that the filter holds by now, or will; of gradual onsets part is still to come."""
    bank_, theta = told(), np.array([0.0, 0.3, 0.0, 0.2])
    gone = np.asarray(gather(bank_, theta, (2,)).recovery)
    for w in (0, 4, 33, 46):
        age = max(int(bank_.age[w]), 0)
        held = bank_.M[w, N_X + 1, 1] + (JUMPS.decay ** (age + 1.0) if JUMPS.slow[w] else 0.0)
        assert gone[w] == pytest.approx([0.0, -0.3 / max(held, 0.3), 0.0, 0.0])
    assert JUMPS.slow[33] and not JUMPS.slow[4]


@pytest.mark.parametrize("name", ["rotor 2", "rotors 1+3", "rotor 2 is well again"])
def test_a_jump_has_the_covariance_of_a_gaussian_in_all_its_directions_together(name):
    """Rotors' losses and the axes' slop at once, dense: the marginal of the losses, cross terms and all."""
    h, bank_ = HYP.names.index(name), told(seed=3)
    found = gather(bank_, (0.0, 0.3, 0.0, 0.0), (2,))
    jump = evidence.jump(HYP, bank_, found, h, B)
    w = int(np.argmax(jump.slot))
    live = np.flatnonzero(np.asarray(found.live))
    assert w == live[np.argmax(np.asarray(found.per_slot)[live, h])] and np.asarray(jump.slot).sum() == 1.0
    who = list(HYP.rotors[h])
    assert np.flatnonzero(np.asarray(jump.rotors)).tolist() == who and jump.since == bank_.age[w] + 1.0
    width = LOSS_WIDTH
    if "again" in name:
        width = float(hypotheses.recovery_sd(np.asarray(found.recovery)[w, who[0]]))
    index = [*who, *range(N, N + 4)]
    prior = np.array([width**2] * len(who) + (np.asarray(found.slop)[w] + 1e-12).tolist())
    dense = np.linalg.inv(bank_.C[w][np.ix_(index, index)] + np.diag(1.0 / prior))[: len(who), : len(who)]
    cov = np.asarray(jump.cov)
    if name == "rotor 2":  # parts of the prior instead of one Gaussian, with and without air that moves
        C, z, steady = bank_.C[w][np.ix_(index, index)], bank_.z[w][index], prior[1:]
        in_air = steady + np.array([0.0, 0.0, 0.0, AIR**2])
        parts = ((AIR_SHARE, in_air), (1.0 - AIR_SHARE, steady))
        dense = np.array([[one_of([(share, *beside_steps(C, z, p, 1.0 - 0.3)) for share, p in parts])[2]]])
    assert cov[np.ix_(who, who)] == pytest.approx(dense, rel=1e-6)
    if len(who) == 2:
        assert abs(dense[0, 1]) > 0.05 * dense[0, 0]  # there is something to be told
    assert not cov[N:].any() and not cov[:, N:].any()  # what geometry is wrong by becomes no disturbance
    size = np.asarray(jump.size)
    assert size[who] == pytest.approx(np.asarray(found.nu)[w, h, : len(who)]) and not np.delete(size, who).any()
    assert np.asarray(jump.each).sum(axis=0) == pytest.approx(size[:N])


def test_a_disturbance_is_a_step_of_its_axes_alone():
    h, bank_ = HYP.names.index("pitch and common mode"), told(seed=4)
    found, axes = gather(bank_), np.array([1, 3])
    assert np.flatnonzero(HYP.steps[h]).tolist() == axes.tolist()
    jump = evidence.jump(HYP, bank_, found, h, B)
    w, index = int(np.argmax(jump.slot)), N + axes
    prior = (FAR * np.asarray(found.width)[axes]) ** 2
    dense = np.linalg.inv(bank_.C[w][np.ix_(index, index)] + np.diag(1.0 / prior))
    assert np.asarray(jump.cov)[np.ix_(index, index)] == pytest.approx(dense, rel=1e-6)
    assert np.asarray(jump.size)[index] == pytest.approx(dense @ bank_.z[w][index], rel=1e-6)
    assert not np.delete(np.asarray(jump.size), index).any() and not np.asarray(jump.rotors).any()


def test_a_loss_can_be_measured_as_well_as_the_best_slot_knows_it():
    bank_ = told()
    found = gather(bank_)
    live = np.asarray(bank_.age) >= 0
    own = np.array([bank_.C[live, i, i].max() for i in range(N)])
    assert np.asarray(evidence.detectable(bank_, found)) == pytest.approx(1.0 / np.sqrt(own + LOSS_WIDTH**-2))
