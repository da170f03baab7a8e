"""A shift that two opposite rotors explain as well as a disturbance: each condition by itself."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.default import bank, hypotheses, opposite
from rotorwatch.engine.default.hypotheses import CLEAR, LOSS_WIDTH, NONE, SMALL_WIDTH
from rotorwatch.engine.default.plant import ANSWER_S, USUAL_S

DT, LIMIT, PAIR, SLOT = 0.05, 14.0, (0, 1), 5
HEXA, QUAD = (airframes.named(f"ardupilot-{f}").effectiveness() for f in ("hexa-x", "quad-x"))


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


def of_one_loss(n, pair, fit, loss):
    """C, z of which a loss of both rotors is the most probable size, and has so many nats."""
    C, z, c = 1e-3 * np.eye(n + 4), np.zeros(n + 4), 1.0
    for _ in range(200):  # nats = z nu / 2 - log(own w^2) / 2, less what the narrow half of the prior adds
        own = c + 1.0 / LOSS_WIDTH**2
        parts = []
        for width in (SMALL_WIDTH, LOSS_WIDTH):
            each = c + 1.0 / width**2
            nu = min(max(own * loss / each, 0.0), 1.0)
            parts.append(own * loss * nu - 0.5 * each * nu**2 - 0.5 * np.log(each * width**2))
        c *= np.exp(0.1 * (fit - (np.logaddexp(*parts) - np.log(2.0))) / max(fit, 1.0))
    C[pair, pair], z[list(pair)] = 0.5 * c, 0.5 * own * loss
    return C, z


def suspect(
    B=HEXA,
    fit=20.0,
    sudden=20.0,
    gradual=10.0,
    loss=0.2,
    heave=0.0,
    rose=0.0,
    pair=PAIR,
    slot=SLOT,
    calm=True,
    lasted=ANSWER_S - DT,
    live=True,
):
    """Evidence in which a pair at a sudden onset, and disturbances at sudden and gradual ones, have so many nats.

    heave, rose: at the onset."""
    n = B.shape[1]
    hyp, jumps = hypotheses.make(n), bank.Jumps(np.eye(20 + n)[:, : n + 4], DT)
    W = jumps.stride.size
    log_bf = np.full((W, len(hyp.names)), 1.0)
    C, z = np.tile(1e-3 * np.eye(n + 4), (W, 1, 1)), np.zeros((W, n + 4))
    C[slot], z[slot] = of_one_loss(n, pair, fit, loss)
    h = hyp.rotors.index(pair)
    log_bf[0, ~hyp.fault], log_bf[np.flatnonzero(jumps.slow)[3], -1] = sudden, gradual
    found = SimpleNamespace(log_bf=log_bf, live=np.arange(W) != slot if not live else np.ones(W, bool))
    told = SimpleNamespace(age=np.arange(W, dtype=np.int32), C=C, z=z)
    left = np.exp(-slot * DT / USUAL_S)
    missing = SimpleNamespace(heave=heave * left, rose=rose * left)
    out, since = opposite.suspect(hyp, jumps, told, found, B, np.bool_(calm), missing, LIMIT, lasted, DT)
    return out, float(since), h


def test_it_is_said_once_after_half_a_second_with_its_onset_and_losses():
    out, since, h = suspect()
    assert int(out.pair) == h and since == pytest.approx(ANSWER_S)
    assert float(out.onset) == SLOT + 1.0 and np.asarray(out.loss) == pytest.approx([0.2, 0.2])
    for lasted in (ANSWER_S - 2 * DT - 1e-9, ANSWER_S + 1e-9):
        out, since, _ = suspect(lasted=lasted)
        assert int(out.pair) == -1 and since == pytest.approx(lasted + DT)


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
    assert int(out.pair) == h and since > 0.0
    out, since, _ = suspect(**beyond)
    assert int(out.pair) == -1 and since == 0.0


def test_a_quads_pairs_are_told_apart_by_their_yaw():
    assert suspect(QUAD, pair=(0, 1))[1] == 0.0


def test_pairs_without_torque_are_those_that_stand_opposite():
    hyp = hypotheses.make(6)
    free = np.asarray(opposite.torque_free(hyp, HEXA))
    places = HEXA[:2] / HEXA[3]
    for k, (i, j) in enumerate(hyp.pairs):
        assert free[k] == (np.abs(places[:, i] + places[:, j]).max() < 0.05)
    assert free.sum() == 3
