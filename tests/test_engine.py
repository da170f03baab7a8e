"""The estimator's definition: machine code and Python give the same bits, and both what the method written as one traced step gives."""

import itertools

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.engine.default import program
from rotorwatch.engine.default.estimator import JumpBank
from rotorwatch.engine.default.plant import WrenchBalance
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.estimator import estimator
from rotorwatch.engine.motion.ticks import AGAIN, GROUND, JUDGE, LEARN

SETTLES, FAILS, WELL, PUSHED, LANDED, AGAIN_UP = 60, 130, 260, 330, 380, 390


def flight(B: np.ndarray, ticks: int, dt: float, seed: int = 0):
    """u, y, valid of a flight in which a rotor loses 40 %, is well again, something pushes the vehicle, and it lands and takes off again;
    the controller makes up for the loss. Motion is not measured now and then, nor is the speed."""
    rng, n = np.random.default_rng(seed), B.shape[1]
    when = np.arange(ticks)
    loss = 0.4 * np.eye(n)[1] * ((when >= FAILS) & (when < WELL))[:, None]
    thrust = 1.0 + 0.03 * rng.normal(size=(ticks, n))
    late = np.minimum(np.maximum(when - FAILS, 0) * dt / 0.2, 1.0) * (when < WELL + 4)
    lost = (0.4 * B[:, 1])[:, None] * late
    thrust = np.maximum(thrust + (np.linalg.pinv(B) @ lost).T, 0.05)
    turn = np.where((when % 90 < 30)[:, None], 0.5, 0.05) * rng.normal(size=(ticks, 3))
    mode = np.where(when < 5, GROUND, np.where(when < SETTLES, LEARN, JUDGE))
    mode = np.where((when >= PUSHED) & (when < PUSHED + 20), LEARN, mode)
    mode = np.where((when >= LANDED) & (when < AGAIN_UP), GROUND, mode)
    mode = np.where((when >= AGAIN_UP) & (when < AGAIN_UP + 40), LEARN, mode)
    restart = np.where(np.isin(when, (5, AGAIN_UP)), 1.0, np.where(when == PUSHED, AGAIN, 0.0))
    load = n * (1.0 + 0.02 * rng.normal(size=ticks) - (thrust * loss).mean(axis=1))
    axial = np.where(when % 50 < 20, np.nan, rng.normal(size=ticks))
    u = np.column_stack([
        thrust, turn, load, 0.1 * rng.normal(size=(ticks, 3)), 0.4 * rng.normal(size=(ticks, 2)), np.full(ticks, 2.2), np.full(ticks, 0.65),
        np.full(ticks, 0.35), axial, mode, restart,
    ])  # fmt: skip
    gains = np.array([0.005 * n, 0.005 * n, 0.13 * n])
    y = thrust @ B.T - np.column_stack([np.zeros((ticks, 3)), thrust.sum(axis=1) - load])
    y = (
        y
        + (thrust * loss) @ B.T
        + np.column_stack([turn * gains, np.zeros(ticks)])
        + 0.02 * rng.normal(size=(ticks, 4))
    )
    y[when >= PUSHED] += [0.2, 0.0, 0.0, 0.1]
    return u, y, rng.random((ticks, 4)) > 0.02


def test_python_and_machine_code_give_the_same_bits():
    if ENGINE.library is None:
        pytest.skip("no C compiler")
    B = airframes.named("ardupilot-quad-x").effectiveness()
    table = flight(B, 160, 0.05)
    told = program.steps(0.05, B).run(*table)
    library = ENGINE.library
    ENGINE.__dict__["library"] = None
    try:
        plain = program.steps(0.05, B).run(*table)
    finally:
        ENGINE.__dict__["library"] = library
    assert told.announced.any()
    for name, one, other in zip(told._fields, told, plain, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(
    "frame, dt",
    [
        ("ardupilot-hexa-x", 0.05),
        ("ardupilot-quad-x", 0.1),
        ("ardupilot-y6", 0.05),
        ("ardupilot-tri", 0.2),
        ("ardupilot-octaquad-x", 0.05),
    ],
)
def test_the_definition_is_the_method(frame, dt):
    """Against the step that is traced: every output, and what has been learned, at every tick."""
    jax = load_jax()
    B = airframes.named(frame).effectiveness()
    p, table = program.parameters(B, dt), flight(B, 520, dt)
    system = WrenchBalance(p["B"], (p["x0"], p["P0"]), p.get("lower"), p.get("share"), p["curve"], p["air"])
    bank = JumpBank(system, dt, (p["noise"], p["noise_weight"]))

    def tick(carry, row):
        carry, out = bank.step(carry, *row)
        d = out.decision
        kept = {
            name: getattr(out, name) for name in estimator.Result._deep | estimator.Result._plain if hasattr(out, name)
        }
        return carry, kept | {
            "log_odds": d.log_odds,
            "statistic": d.statistic,
            "onset": d.onset,
            "innovation": out.estimate.innovation,
        }

    last, said = jax.tree.map(np.asarray, jax.jit(lambda first: jax.lax.scan(tick, first, table))(bank.init()))
    steps = program.steps(dt, B)
    told = steps.run(*table)._asdict() | {"plausible": steps.plausible}
    assert said["announced"].any() and said["active"][:, 0, 1].any()
    left = said["share"] > 0.0
    for name, one in said.items():
        other = told[name]
        if name == "plausible":  # where there is nothing to be plausible it says nothing
            one, other = (np.where(said["statistic"] > -15.0, side, False) for side in (one, other))
        if name in ("active", "each", "onsets"):  # what is no explanation any more says nothing
            shown = left if one.ndim == 2 else left[:, :, None]
            one, other = np.where(shown, one, 0), np.where(shown, other, 0)
        np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-8, err_msg=name)
    states = [*range(system.n_x), *range(23, 23 + B.shape[1])]
    np.testing.assert_allclose(steps.learned.s[states], last.s, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(steps.learned.P[np.ix_(states, states)], last.P, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(steps.learned.variances, last.noise.variances, rtol=1e-8)


def test_ticks_may_come_piece_by_piece():
    B = airframes.named("ardupilot-hexa-x").effectiveness()
    table = flight(B, 300, 0.05)
    whole, steps = program.steps(0.05, B).run(*table), program.steps(0.05, B)
    cuts = [0, 1, 7, 150, 151, 300]
    parts = [steps.run(*(column[a:b] for column in table)) for a, b in itertools.pairwise(cuts)]
    for name in whole._fields:
        np.testing.assert_array_equal(
            np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name), err_msg=name
        )


def test_a_raised_threshold_announces_no_more():
    B = airframes.named("ardupilot-hexa-x").effectiveness()
    table, counts = flight(B, 250, 0.05), []
    for nats in (0.0, 30.0, 1e6):
        steps = program.steps(0.05, B)
        steps.raise_threshold(nats)
        counts.append(int(steps.run(*table).announced.sum()))
    assert counts[0] >= counts[1] >= counts[2] == 0 < counts[0]
