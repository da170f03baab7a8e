"""A shift that two opposite rotors explain as well as a disturbance: each condition by itself."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.plain import filled, lower, made, plant

from rotorwatch import airframes
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Bank
from rotorwatch.engine.estimator.evidence import Evidence
from rotorwatch.engine.estimator.hypotheses import CLEAR, LOSS_WIDTH, NONE, PAIR, SMALL_WIDTH, kind_of
from rotorwatch.engine.estimator.opposite import PARTS, Opposite, contested
from rotorwatch.engine.estimator.plant import ANSWER_S, USUAL_S
from rotorwatch.engine.estimator.plausibility import torque_free

DT, LIMIT, BOTH, SLOT = 0.05, 14.0, (0, 1), 5
HEXA, QUAD = (airframes.named(f"ardupilot-{f}").effectiveness() for f in ("hexa-x", "quad-x"))


def of_one_loss(n, pair, fit, loss):
    """C, z of which a loss of both rotors is the most probable size, and has so many nats."""
    C, z, c = 1e-3 * np.eye(FIRST_LOSS + n), np.zeros(FIRST_LOSS + n), 1.0
    for _ in range(200):  # nats = z nu / 2 - log(own w^2) / 2, less what the narrow half of the prior adds
        own = c + 1.0 / LOSS_WIDTH**2
        parts = []
        for width in (SMALL_WIDTH, LOSS_WIDTH):
            each = c + 1.0 / width**2
            nu = min(max(own * loss / each, 0.0), 1.0)
            parts.append(own * loss * nu - 0.5 * each * nu**2 - 0.5 * np.log(each * width**2))
        c *= np.exp(0.1 * (fit - (np.logaddexp(*parts) - np.log(2.0))) / max(fit, 1.0))
    who = [FIRST_LOSS + i for i in pair]
    C[who, who], z[who] = 0.5 * c, 0.5 * own * loss
    return C, z


def suspect(
    B=HEXA,
    fit=20.0,
    sudden=20.0,
    gradual=10.0,
    loss=0.2,
    heave=0.0,
    rose=0.0,
    pair=BOTH,
    slot=SLOT,
    calm=True,
    lasted=ANSWER_S - DT,
    live=True,
):
    """Evidence in which a pair at a sudden onset, and disturbances at sudden and gradual ones, have so many nats.

    heave, rose: at the onset."""
    n, p, bank = B.shape[1], plant(B, DT), Bank()
    bank.begin(p)
    for age, each in enumerate(bank.packs):
        each.age = float(age)
    bank.packs[slot].age = float(slot % len(bank.packs)) if live else -1.0
    C, z = of_one_loss(n, pair, fit, loss)
    filled(bank.packs[slot], C=lower(C), z=z)
    left = np.exp(-slot * DT / USUAL_S)
    missing, alarm = SimpleNamespace(heave=heave * left, rose=rose * left), SimpleNamespace(limit=LIMIT)
    out, found = made(Opposite, lasted=lasted), made(Evidence, yaw_error=1e-12, damping_error=1e-12)
    most = 1.0 + max(sudden, gradual)
    found.top[list_hypotheses(n).kinds.index("disturbance")] = most
    found.loud[0][0], found.loud[1][0] = float(np.exp(sudden - most)), float(np.exp(gradual - most))
    for part in range(PARTS):
        out.suspect(p, bank, found, missing, alarm, calm, part)
    return out, out.lasted, list_hypotheses(n).rotors.index(pair)


def test_it_is_said_once_after_half_a_second_with_its_onset_and_losses():
    out, since, h = suspect()
    assert out.pair == h and since == pytest.approx(ANSWER_S)
    assert out.onset == SLOT + 1.0 and out.loss == pytest.approx(0.2)
    for lasted in (ANSWER_S - 2 * DT - 1e-9, ANSWER_S + 1e-9):
        out, since, _ = suspect(lasted=lasted)
        assert out.pair == -1 and since == pytest.approx(lasted + DT)


@pytest.mark.parametrize(
    "within, beyond",
    [
        (dict(fit=LIMIT + 0.1, sudden=15.0, gradual=9.0), dict(fit=LIMIT - 0.1, sudden=15.0, gradual=9.0)),
        (dict(sudden=20.0 + 2.0 * CLEAR - 0.1), dict(sudden=20.0 + 2.0 * CLEAR + 0.1)),
        (dict(gradual=19.9), dict(gradual=20.1)),
        (dict(loss=NONE + 1e-6), dict(loss=NONE - 1e-6)),
        (dict(heave=0.2 + 0.4 / 6 - 1e-3), dict(heave=0.2 + 0.4 / 6 + 1e-3)),
        (dict(rose=0.2 - 1e-3), dict(rose=0.2 + 1e-3)),
        ({}, dict(calm=False)),
        ({}, dict(live=False)),
        ({}, dict(pair=(0, 2))),
        ({}, dict(slot=-3)),
    ],
    ids=["limit", "disturbance", "gradual", "size", "heave", "rose", "calm", "unused", "torque", "slow"],
)
def test_it_is_suspected_while_all_this_holds(within, beyond):
    out, since, h = suspect(**within)
    assert out.pair == h and since > 0.0
    out, since, _ = suspect(**beyond)
    assert out.pair == -1 and since == 0.0


def test_a_quads_pairs_are_reported_apart_by_their_yaw():
    assert suspect(QUAD, pair=(0, 1))[1] == 0.0


def test_pairs_without_torque_are_those_that_stand_opposite():
    """They contest each other where there are several; a quad's never do."""
    hexa, hyp = plant(HEXA), list_hypotheses(6)
    places = HEXA[:2] / HEXA[3]
    free = [torque_free(hexa, int(i), int(j)) for i, j in hyp.pairs]
    assert free == [bool(np.abs(places[:, i] + places[:, j]).max() < 0.05) for i, j in hyp.pairs] and sum(free) == 3
    alike = [contested(hexa, h) for h in range(len(hyp.names))]
    assert alike == [kind_of(6, h) == PAIR and free[h - 6] for h in range(len(hyp.names))]
    assert not any(contested(plant(QUAD), h) for h in range(len(list_hypotheses(4).names)))
