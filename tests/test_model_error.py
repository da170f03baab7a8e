"""What may be learned from a tick, how much its evidence counts, and how wrong the model may be: against plain NumPy."""

from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.engine.default import events, model_error, noise, plant
from rotorwatch.engine.default.plant import (
    AXIS_STATES,
    DAMPING,
    DAMPING_RATE,
    GAIN,
    GAIN_MEAN,
    PER_AXIS,
    any_multirotor,
)
from rotorwatch.lab.campaign import batch, plan

N, DT = 4, 0.05
B = airframes.named("ardupilot-quad-x").effectiveness()
X = any_multirotor(N)[0]
CALM = np.full((4, 4), 1e-8)
YES, NO = np.ones(4, bool), np.zeros(4, bool)
EVEN = np.array([1.0, 1.1, 0.9, 1.0])


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


def inputs(thrust=EVEN, motion=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), load=1.0, full=2.5, axial=0.0):
    """u (n + 10,) as `WrenchBalance.pack` lays it out."""
    return np.concatenate([thrust, motion, [load * N], rates, [0.0, 0.0], [full, 0.65, 0.0, axial]])


def settled(thrust=EVEN):
    """A memory for which these thrusts are the usual ones."""
    thrust = np.asarray(thrust, float)
    part = thrust - thrust.mean()
    return model_error.init(N)._replace(thrust=part, trim=part, collective=np.float64(thrust.mean()))


def look(memory, u, valid=YES, flying=True, restart=False, variances=CALM, dt=DT, share=1.0, lost=0.0):
    """share: of the torque that the motion needs, how much the rotors make; lost: torque that they lack of what is commanded."""
    x = X.reshape(-1)[:AXIS_STATES].reshape(4, PER_AXIS)
    gain = N * GAIN_MEAN[:3]
    needs = gain * u[N : N + 3] + DAMPING_RATE * gain * u[N + 4 : N + 7]
    lost = np.array([lost, -lost, lost, 0.0])
    y = lost + np.array([*(share * needs + x[:3, :3].sum(axis=1)), 0.0])
    return model_error.look(memory, u, y, lost, valid, flying, restart, X, variances, N, dt)


def taught(seen):
    """(shares of gain, of damping) of roll, pitch and yaw."""
    table = np.asarray(seen.gain_share)[:AXIS_STATES].reshape(4, PER_AXIS)
    return table[:3, GAIN], table[:3, DAMPING]


def test_only_motion_that_stands_out_teaches():
    """The garrote: nothing up to GARROTE times the calm level, and 1 - (GARROTE level / motion)^2 of it beyond."""
    level = np.sqrt(model_error.init(N).level)
    for times in (0.5, 2.4, 2.6, 10.0):
        _, seen = look(settled(), inputs(motion=times * level[:3], rates=times * level[3:]))
        expected = max(0.0, 1.0 - (model_error.GARROTE / times) ** 2)
        for shares in taught(seen):
            assert shares == pytest.approx([expected] * 3, abs=1e-4)
    others = np.asarray(seen.gain_share)[:AXIS_STATES].reshape(4, PER_AXIS)
    assert (others[3] == 1.0).all() and (others[:3, :GAIN] == 1.0).all()
    assert np.asarray(seen.gain_share).size == X.size + N and (np.asarray(seen.gain_share)[AXIS_STATES:] == 1.0).all()


def test_motion_that_gusts_have_made_teaches_less():
    """What the motion needs, gain times acceleration, against twice what this flight's gusts give."""
    gusts = CALM.copy()
    gusts[1], gusts[2], gusts[3] = 0.02**2, 0.03**2, 0.01**2
    motion = np.array([12.0, 12.0, 12.0])
    _, seen = look(settled(), inputs(motion=motion, rates=motion), variances=gusts)
    variance = 0.02**2 + 0.03**2 + plant.TAU[1] * 0.01**2
    needs = N * GAIN_MEAN[:3] * motion
    for shares, force, level in zip(taught(seen), (needs, DAMPING_RATE * needs), (0.3, 0.05)):
        garrote = 1.0 - model_error.GUST_SHARE**2 * variance / force**2
        calm = 1.0 - (model_error.GARROTE * level / motion) ** 2
        assert shares == pytest.approx(np.minimum(np.maximum(garrote, 0.0), calm))


@pytest.mark.parametrize("lost", [0.0, 0.4])
@pytest.mark.parametrize("share, part", [(-0.5, 0.0), (0.0, 0.0), (0.3, 0.3), (1.0, 1.0), (1.7, 1.0)])
def test_motion_teaches_as_far_as_the_rotors_have_made_it(share, part, lost):
    """A motor that stops turns a vehicle that was commanded nothing; what biases and known losses take was commanded for nothing."""
    level = np.sqrt(model_error.init(N).level)
    for times in (5.0, 10.0):
        _, seen = look(settled(), inputs(motion=times * level[:3], rates=times * level[3:]), share=share, lost=lost)
        calm = 1.0 - (model_error.GARROTE / times) ** 2
        for shares in taught(seen):
            assert shares == pytest.approx([part * calm] * 3, abs=1e-3)


@pytest.mark.parametrize("axis", range(3))
def test_each_axis_has_its_own_gusts(axis):
    """Gusts in one axis take nothing from what the motion in the others teaches."""
    gusts = CALM.copy()
    gusts[2, axis] = 0.3**2
    motion = np.array([12.0, 12.0, 12.0])
    windy, calm = (taught(look(settled(), inputs(motion=motion, rates=motion), variances=v)[1]) for v in (gusts, CALM))
    for with_gusts, without in zip(windy, calm):
        less = np.asarray(with_gusts) < np.asarray(without) - 1e-9
        assert less.tolist() == [a == axis for a in range(3)]


def test_the_calm_level_follows_motion_and_forgets_it():
    """A tenth of its way in a second; a burst counts as six times the level at most; neither on the ground nor unmeasured."""
    memory = settled()
    motion = 0.2 * np.sqrt(memory.level)
    after, _ = look(memory, inputs(motion=motion[:3], rates=motion[3:]))
    part = DT / model_error.LEVEL_MEMORY_S
    assert np.asarray(after.level) == pytest.approx(memory.level + part * (0.04 - 1.0) * memory.level)
    loud, _ = look(memory, inputs(motion=(50.0,) * 3, rates=(9.0,) * 3))
    assert np.asarray(loud.level) == pytest.approx(memory.level * (1.0 + 5.0 * part))
    for blocked in (dict(flying=False), dict(valid=NO)):
        assert np.asarray(look(memory, inputs(motion=(50.0,) * 3), **blocked)[0].level) == pytest.approx(memory.level)


def test_a_rotors_jitter_is_smoothed_and_its_steps_are_not():
    """A rotor's own part of thrust: below GARROTE times its calm level what it was, beyond it what stands out; the mean passes."""
    level = np.sqrt(model_error.init(N).thrust_level[0])
    for times in (1.0, 4.0):
        step = times * level * np.array([1.0, -1.0, 1.0, -1.0])
        memory, seen = look(settled(), inputs(EVEN + step + 0.07))
        passes = max(0.0, 1.0 - (model_error.GARROTE / times) ** 2)
        assert np.asarray(seen.u)[:N] == pytest.approx(EVEN + 0.07 + passes * step)
        assert np.asarray(seen.part - seen.trim) == pytest.approx(passes * step, abs=1e-12)
        assert np.asarray(memory.thrust) == pytest.approx(EVEN - 1.0 + step * DT / plant.ANSWER_S)
        assert np.asarray(memory.trim) == pytest.approx(EVEN - 1.0 + step * DT / plant.USUAL_S)
        wanted = level**2 * (1.0 + DT / model_error.LEVEL_MEMORY_S * (min(times**2, 6.0) - 1.0))
        assert np.asarray(memory.thrust_level) == pytest.approx(wanted)
    assert np.asarray(seen.u)[N:] == pytest.approx(inputs()[N:])
    assert np.asarray(look(settled([5.0, -0.9, 0.0, 0.1]), inputs(EVEN))[1].u)[:N].min() >= 0.0


def test_a_new_hop_takes_its_first_tick_for_the_usual():
    memory = settled()._replace(burst=np.full(4, 3.0), innovation_mean=np.full(4, 2.0), lasting=np.full(4, 5.0))
    after, seen = look(memory, inputs(2.0 * EVEN), restart=True)
    assert np.asarray(seen.u)[:N] == pytest.approx(2.0 * EVEN)
    assert np.asarray(after.thrust) == pytest.approx(2.0 * (EVEN - 1.0)) == np.asarray(after.trim)
    assert after.collective == pytest.approx(2.0) and seen.far == 0.0
    assert np.asarray(after.thrust_level) == pytest.approx(memory.thrust_level)
    assert (np.asarray(after.burst) == 1.0).all() and not np.asarray(after.innovation_mean).any()
    assert np.asarray(after.lasting) == pytest.approx(memory.lasting)


@pytest.mark.parametrize(
    "thrust, load, far", [(1.2, 1.2, 0.0), (1.5, 1.0, 0.2), (0.4, 1.0, 0.3), (1.0, 0.5, 0.2), (1.5, 1.6, 0.5)]
)
def test_far_from_hover_is_counted_beyond_three_tenths(thrust, load, far):
    """Of the usual thrust, and of gravity; the usual follows in five seconds."""
    memory, seen = look(settled(np.ones(N)), inputs(np.full(N, thrust), load=load))
    assert seen.far == pytest.approx(far)
    assert memory.collective == pytest.approx(1.0 + (thrust - 1.0) * DT / plant.USUAL_S)


def remembered(innovations, variance=1.0, ok=YES, start=None):
    memory = start or model_error.init(N)
    for e in innovations:
        memory = model_error.remember(memory, np.full(4, e), np.full(4, variance), ok, DT)
    return memory


def test_bursts_are_remembered_for_three_seconds():
    """Mean square of innovations in standard deviations, clipped, first order; and forgotten again."""
    loud = remembered([3.0] * 20, variance=4.0)
    part = 1.0 - (1.0 - DT / plant.BURST_S) ** 20
    assert np.asarray(loud.burst) == pytest.approx(1.0 + part * (1.5**2 - 1.0))
    assert np.asarray(remembered([100.0]).burst) == pytest.approx(1.0 + DT / plant.BURST_S * (noise.CLIP - 1.0))
    quiet = remembered([0.0] * 20, start=loud)
    assert np.asarray(quiet.burst) == pytest.approx(np.asarray(loud.burst) * (1.0 - part))
    blind = remembered([9.0] * 20, ok=NO)
    for name in ("burst", "innovation_mean", "lasting"):
        assert np.asarray(getattr(blind, name)) == pytest.approx(getattr(model_error.init(N), name))


def test_innovations_that_lean_to_one_side_are_remembered_for_half_a_minute():
    """Their mean over a second, squared, over the variance that white ones would give it."""
    memory, lean, lasting = model_error.init(N), 0.0, 1.0
    for e in [1.0, 0.5, 1.5, 0.0, 2.0] * 6:
        memory = model_error.remember(memory, np.full(4, e), np.ones(4), YES, DT)
        lean += DT / plant.TAU[1] * (e - lean)
        lasting += (
            DT / model_error.LASTING_MEMORY_S * (min(lean**2 * (2.0 * plant.TAU[1] / DT - 1.0), noise.CLIP) - lasting)
        )
    assert np.asarray(memory.innovation_mean) == pytest.approx(lean) and np.asarray(memory.lasting) == pytest.approx(
        lasting
    )
    assert 1.0 < lasting < noise.CLIP
    white = np.random.default_rng(0).standard_normal(4000)
    mean, squares = 0.0, []
    for e in white:
        mean += DT / plant.TAU[1] * (e - mean)
        squares.append(mean**2)
    assert np.mean(squares[200:]) * (2.0 * plant.TAU[1] / DT - 1.0) == pytest.approx(1.0, abs=0.25)


def test_evidence_counts_less_while_innovations_are_larger_than_the_model_expects():
    memory = model_error.init(N)._replace(burst=np.array([0.5, 1.0, 4.0, 2.0]), lasting=np.array([0.1, 2.0, 2.0, 5.0]))
    assert np.asarray(model_error.calm(memory)) == pytest.approx([1.0, 0.5, 0.25, 0.2])


def error(u, y=(0.0,) * 4, before=(0.0,) * 4, far=0.0, white=0.01**2, dt=DT):
    memory = model_error.init(N)._replace(y=np.asarray(before, float))
    seen = model_error.Look(u, np.ones(1), np.float64(far), np.zeros(N), np.zeros(N))
    return np.asarray(model_error.variance(memory, seen, X, np.asarray(y, float), np.full(4, white), B, N, dt))


def test_the_model_may_be_wrong_by_a_share_of_each_of_its_terms():
    """One after the other: gains, damping, far from hover, rotors at their limits, steps of the commands."""
    gains = X.reshape(4, PER_AXIS)[:, GAIN]
    damping = X.reshape(4, PER_AXIS)[:, DAMPING]
    assert error(inputs()) == pytest.approx(np.zeros(4))
    turned = error(inputs(motion=(3.0, -2.0, 1.0), load=1.5))
    wanted = np.array(model_error.GAIN_ERROR) * gains * [3.0, -2.0, 1.0, 0.5 * N]
    assert turned == pytest.approx(model_error.ERROR_TICKS * wanted**2)
    spun = error(inputs(rates=(1.0, -2.0, 0.5)))
    wanted = model_error.DAMPING_ERROR * damping * [1.0, -2.0, 0.5, 0.0]
    assert spun == pytest.approx(model_error.ERROR_TICKS * wanted**2) and spun[2] > 0.0 == spun[3]
    assert error(inputs(), far=0.3) == pytest.approx(
        np.full(4, model_error.ERROR_TICKS * (model_error.FAR_ERROR * N * 0.3) ** 2)
    )
    climbs = error(inputs(axial=3.0))
    assert climbs == pytest.approx([0.0, 0.0, 0.0, model_error.ERROR_TICKS * (model_error.AIR_ERROR * 3.0 * N) ** 2])
    full = error(inputs([1.0, 2.4, 1.0, 2.2]))
    lost = np.array([0.0, 2.4 - model_error.BELOW_LIMIT * 2.5, 0.0, 0.0])
    assert full == pytest.approx(model_error.ERROR_TICKS * (B * lost) ** 2 @ np.ones(N))


@pytest.mark.parametrize("sink, share", [(0.9, 0.0), (1.5, 0.5), (2.0, 1.0), (5.0, 1.0)])
def test_rotors_that_sink_into_their_wake_are_unsteady_each_by_itself(sink, share):
    """In proportion to their thrust, on all axes that each works on."""
    thrust = np.array([0.8, 1.0, 1.2, 1.4])
    slip = (np.arange(4) == 3) * (model_error.AIR_ERROR * sink * N) ** 2
    wanted = np.array([((B[a] * share * model_error.WASH * thrust) ** 2).sum() for a in range(4)]) + slip
    assert error(inputs(thrust, axial=-sink)) == pytest.approx(model_error.ERROR_TICKS * wanted)


@pytest.mark.parametrize("dt, share", [(0.05, 0.015 / 0.05), (0.5, 0.015 / 0.5)])
def test_a_step_of_the_commands_is_felt_a_little_sooner_or_later(dt, share):
    """By the lag's error; of what is beyond four standard deviations of noise."""
    found = error(inputs(), y=(0.3, -0.3, 0.03, 0.0), before=(0.1, 0.1, 0.0, 0.0), dt=dt)
    wanted = share * np.array([0.2 - 0.04, 0.4 - 0.04, 0.0, 0.0])
    assert found == pytest.approx(model_error.ERROR_TICKS * wanted**2)
    assert model_error.LAG_ERROR_S == 0.015


def test_a_tick_without_commands_changes_nothing_that_is_usual():
    """In a gap of the log thrusts are 0: taken for usual, the hover after it would count as far from hover for many seconds."""
    memory = settled()
    for _ in range(60):
        memory, _ = look(memory, inputs(thrust=np.zeros(N)), valid=NO)
    for name in ("thrust", "trim", "collective", "level", "thrust_level"):
        np.testing.assert_array_equal(getattr(memory, name), getattr(settled(), name))
    _, seen = look(memory, inputs())
    assert float(seen.far) == 0.0


def test_more_damping_than_known_is_possible_and_less_is_not():
    """Five a second times the gain, of roll and pitch on average; a gain that is not known yet counts as three tenths of the usual."""
    x, n = np.zeros(AXIS_STATES), 8
    x[[GAIN, PER_AXIS + GAIN]] = 0.08, 0.12
    more, less, none = np.asarray(model_error.unknown_damping(x, np.array([3.0, -3.0, 0.0]), n))
    assert more == pytest.approx((5.0 * 0.1) ** 2)
    assert less < 1e-9 and none < 1e-9
    (unknown,) = np.asarray(model_error.unknown_damping(0.0 * x, np.ones(1), n))
    assert unknown == pytest.approx((5.0 * 0.3 * n * GAIN_MEAN[0]) ** 2)


def test_a_light_coaxial_octa_that_flies_off_is_not_accused():
    """0.9 kg on arms of 0.55 m: rotation dies out at 9 a second, and the first eight looked like a rotor at the end of one arm."""
    flights = plan.read(Path(__file__).parents[1] / "plans" / "default.toml")
    (flown,) = batch.fly(flights, [3599], 1)
    B = flown.vehicle.effectiveness()
    ((judged, _),) = batch.by_default([flown], B)
    assert events.read(judged.kept, flown.ticks, B) == ()
