"""What may be learned from a tick, how much its evidence counts, and how wrong the model may be: against plain NumPy."""

from pathlib import Path

import numpy as np
import pytest
from tests.plain import array, copied, filled, made, plant, room

from rotorwatch import airframes
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.plant_rows import AXIS_STATES, any_multirotor
from rotorwatch.engine.estimator import model_error, noise
from rotorwatch.engine.estimator.model_error import Memory, Seen
from rotorwatch.engine.estimator.noise import Noise
from rotorwatch.engine.estimator.plant import (
    ANSWER_S,
    BURST_S,
    DAMPING,
    DAMPING_RATE,
    GAIN,
    GAIN_MEAN,
    PER_AXIS,
    TAU,
    THETA,
    USUAL_S,
    Inputs,
)
from rotorwatch_lab.campaign import batch, plan

N, DT = 4, 0.05
B = airframes.named("ardupilot-quad-x").effectiveness()
P, SLOW, OCTA = plant(B, DT), plant(B, 0.5), plant(airframes.named("ardupilot-octa-x").effectiveness(), DT)
X = np.append(any_multirotor(N)[0], np.zeros(THETA + N - AXIS_STATES))
CALM = np.full((4, 4), 1e-8)
YES, NO = np.ones(4, bool), np.zeros(4, bool)
EVEN = np.array([1.0, 1.1, 0.9, 1.0])
MEANS = np.array(GAIN_MEAN)[:3]


def inputs(thrust=EVEN, motion=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), load=1.0, full=2.5, axial=0.0):
    """One tick's."""
    return made(Inputs, thrust=np.asarray(thrust), turn=np.asarray(motion), rate=np.asarray(rates), load=load * N, full=full, axial=axial)


def begun():
    """A memory that knows nothing."""
    memory = Memory()
    memory.begin(P)
    return memory


LEVEL, RATE_LEVEL = np.sqrt(begun().turn_level), np.sqrt(begun().rate_level)


def settled(thrust=EVEN):
    """A memory for which these thrusts are the usual ones."""
    thrust = np.asarray(thrust, float)
    part = thrust - thrust.mean()
    return filled(begun(), thrust=part, trim=part, collective=float(thrust.mean()))


def look(memory, now, valid=YES, flying=True, restart=False, variances=CALM, share=1.0, lost=0.0):
    """share: of the torque that the motion needs, how much the rotors make; lost: torque that they lack of what is commanded."""
    gain = N * MEANS
    needs = gain * now.turn + DAMPING_RATE * gain * now.rate
    lost = np.array([lost, -lost, lost, 0.0])
    biases = X[:AXIS_STATES].reshape(4, PER_AXIS)[:3, :3].sum(axis=1)
    now = filled(copied(now), wrench=lost + np.array([*(share * needs + biases), 0.0]), valid=valid, restart=restart)
    memory, seen = copied(memory), Seen()
    memory.weigh_inputs(P, now, X.tolist(), lost.tolist(), made(Noise, v=variances), flying, seen)
    return memory, seen


def taught(seen):
    """(shares of gain, of damping) of roll, pitch and yaw."""
    table = array(seen.gain_share, AXIS_STATES).reshape(4, PER_AXIS)
    return table[:3, GAIN], table[:3, DAMPING]


def test_only_motion_that_stands_out_teaches():
    """The garrote: nothing up to GARROTE times the calm level, and 1 - (GARROTE level / motion)^2 of it beyond."""
    for times in (0.5, 2.4, 2.6, 10.0):
        _, seen = look(settled(), inputs(motion=times * LEVEL, rates=times * RATE_LEVEL))
        expected = max(0.0, 1.0 - (model_error.GARROTE / times) ** 2)
        for shares in taught(seen):
            assert shares == pytest.approx([expected] * 3, abs=1e-4)
    others = array(seen.gain_share, AXIS_STATES).reshape(4, PER_AXIS)
    assert (others[3] == 1.0).all() and (others[:3, :GAIN] == 1.0).all()
    assert (array(seen.gain_share, THETA + N)[AXIS_STATES:] == 1.0).all()


def test_motion_that_gusts_have_made_teaches_less():
    """What the motion needs, gain times acceleration, against twice what this flight's gusts give."""
    gusts = CALM.copy()
    gusts[1], gusts[2], gusts[3] = 0.02**2, 0.03**2, 0.01**2
    motion = np.array([12.0, 12.0, 12.0])
    _, seen = look(settled(), inputs(motion=motion, rates=motion), variances=gusts)
    variance = 0.02**2 + 0.03**2 + TAU[1] * 0.01**2
    needs = N * MEANS * motion
    for shares, force, level in zip(taught(seen), (needs, DAMPING_RATE * needs), (0.3, 0.05)):
        garrote = 1.0 - model_error.GUST_SHARE**2 * variance / force**2
        calm = 1.0 - (model_error.GARROTE * level / motion) ** 2
        assert shares == pytest.approx(np.minimum(np.maximum(garrote, 0.0), calm))


@pytest.mark.parametrize("lost", [0.0, 0.4])
@pytest.mark.parametrize("share, part", [(-0.5, 0.0), (0.0, 0.0), (0.3, 0.3), (1.0, 1.0), (1.7, 1.0)])
def test_motion_teaches_as_far_as_the_rotors_have_made_it(share, part, lost):
    """A motor that stops turns a vehicle that was commanded nothing; what biases and known losses take was commanded for nothing."""
    for times in (5.0, 10.0):
        _, seen = look(settled(), inputs(motion=times * LEVEL, rates=times * RATE_LEVEL), share=share, lost=lost)
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


def levels(memory):
    return np.array([*memory.turn_level, *memory.rate_level])


def test_the_calm_level_follows_motion_and_forgets_it():
    """A tenth of its way in a second; a burst counts as six times the level at most; neither on the ground nor unmeasured."""
    memory, part = settled(), DT / model_error.LEVEL_MEMORY_S
    after, _ = look(memory, inputs(motion=0.2 * LEVEL, rates=0.2 * RATE_LEVEL))
    assert levels(after) == pytest.approx(levels(memory) * (1.0 + part * (0.04 - 1.0)))
    loud, _ = look(memory, inputs(motion=(50.0,) * 3, rates=(9.0,) * 3))
    assert levels(loud) == pytest.approx(levels(memory) * (1.0 + 5.0 * part))
    for blocked in (dict(flying=False), dict(valid=NO)):
        assert levels(look(memory, inputs(motion=(50.0,) * 3), **blocked)[0]) == pytest.approx(levels(memory))


def test_a_rotors_jitter_is_smoothed_and_its_steps_are_not():
    """A rotor's own part of thrust: below GARROTE times its calm level what it was, beyond it what stands out; the mean passes."""
    level = np.sqrt(begun().thrust_level[0])
    for times in (1.0, 4.0):
        step = times * level * np.array([1.0, -1.0, 1.0, -1.0])
        memory, seen = look(settled(), inputs(EVEN + step + 0.07))
        passes = max(0.0, 1.0 - (model_error.GARROTE / times) ** 2)
        assert array(seen.thrust, N) == pytest.approx(EVEN + 0.07 + passes * step)
        assert array(seen.part, N) - array(seen.trim, N) == pytest.approx(passes * step, abs=1e-12)
        assert array(memory.thrust, N) == pytest.approx(EVEN - 1.0 + step * DT / ANSWER_S)
        assert array(memory.trim, N) == pytest.approx(EVEN - 1.0 + step * DT / USUAL_S)
        wanted = level**2 * (1.0 + DT / model_error.LEVEL_MEMORY_S * (min(times**2, 6.0) - 1.0))
        assert memory.thrust_level[:N] == pytest.approx([wanted] * N)
    assert min(look(settled([5.0, -0.9, 0.0, 0.1]), inputs(EVEN))[1].thrust[:N]) >= 0.0


def test_a_new_hop_takes_its_first_tick_for_the_usual():
    memory = filled(settled(), burst=np.full(4, 3.0), innovation_mean=np.full(4, 2.0), lasting=np.full(4, 5.0))
    after, seen = look(memory, inputs(2.0 * EVEN), restart=True)
    assert array(seen.thrust, N) == pytest.approx(2.0 * EVEN)
    assert array(after.thrust, N) == pytest.approx(2.0 * (EVEN - 1.0)) == array(after.trim, N)
    assert after.collective == pytest.approx(2.0) and seen.far == 0.0
    assert after.thrust_level == memory.thrust_level
    assert after.burst == [1.0] * 4 and not any(after.innovation_mean) and after.lasting == memory.lasting


@pytest.mark.parametrize("thrust, load, far", [(1.2, 1.2, 0.0), (1.5, 1.0, 0.2), (0.4, 1.0, 0.3), (1.0, 0.5, 0.2), (1.5, 1.6, 0.5)])
def test_far_from_hover_is_counted_beyond_three_tenths(thrust, load, far):
    """Of the usual thrust, and of gravity; the usual follows in five seconds."""
    memory, seen = look(settled(np.ones(N)), inputs(np.full(N, thrust), load=load))
    assert seen.far == pytest.approx(far)
    assert memory.collective == pytest.approx(1.0 + (thrust - 1.0) * DT / USUAL_S)


def test_the_usual_thrust_is_what_the_rotors_give_not_what_they_are_commanded():
    """A rotor that lost a half is commanded twice as much and gives as before; a state out of range counts as 0 or 1."""
    state, thrust = X.copy(), np.ones(N)
    state[THETA], thrust[0] = 0.5, 2.0
    assert model_error.given(P, inputs(thrust), state.tolist()) == pytest.approx(1.0)
    for theta, first in ((-0.3, 2.0), (1.3, 0.0)):
        state[THETA] = theta
        assert model_error.given(P, inputs(thrust), state.tolist()) == pytest.approx((first + N - 1) / N)


def remembered(innovations, variance=1.0, ok=YES, start=None):
    memory = copied(start or begun())
    for e in innovations:
        memory.remember(P, [e] * 4, [variance] * 4, ok.tolist())
    return memory


def test_bursts_are_remembered_for_three_seconds():
    """Mean square of innovations in standard deviations, clipped, first order; and forgotten again."""
    loud = remembered([3.0] * 20, variance=4.0)
    part = 1.0 - (1.0 - DT / BURST_S) ** 20
    assert np.asarray(loud.burst) == pytest.approx(1.0 + part * (1.5**2 - 1.0))
    assert np.asarray(remembered([100.0]).burst) == pytest.approx(1.0 + DT / BURST_S * (noise.CLIP - 1.0))
    quiet = remembered([0.0] * 20, start=loud)
    assert np.asarray(quiet.burst) == pytest.approx(np.asarray(loud.burst) * (1.0 - part))
    blind = remembered([9.0] * 20, ok=NO)
    for name in ("burst", "innovation_mean", "lasting"):
        assert getattr(blind, name) == getattr(begun(), name)


def test_innovations_that_lean_to_one_side_are_remembered_for_half_a_minute():
    """Their mean over a second, squared, over the variance that white ones would give it."""
    series, lean, lasting = [1.0, 0.5, 1.5, 0.0, 2.0] * 6, 0.0, 1.0
    memory = remembered(series)
    for e in series:
        lean += DT / TAU[1] * (e - lean)
        lasting += DT / model_error.LASTING_MEMORY_S * (min(lean**2 * (2.0 * TAU[1] / DT - 1.0), noise.CLIP) - lasting)
    assert np.asarray(memory.innovation_mean) == pytest.approx(lean) and np.asarray(memory.lasting) == pytest.approx(lasting)
    assert 1.0 < lasting < noise.CLIP
    white = np.random.default_rng(0).standard_normal(4000)
    mean, squares = 0.0, []
    for e in white:
        mean += DT / TAU[1] * (e - mean)
        squares.append(mean**2)
    assert np.mean(squares[200:]) * (2.0 * TAU[1] / DT - 1.0) == pytest.approx(1.0, abs=0.25)


def test_evidence_counts_less_while_innovations_are_larger_than_the_model_expects():
    memory = made(Memory, burst=np.array([0.5, 1.0, 4.0, 2.0]), lasting=np.array([0.1, 2.0, 2.0, 5.0]))
    assert [memory.calm(a) for a in range(4)] == pytest.approx([1.0, 0.5, 0.25, 0.2])
    assert memory.unsure() == pytest.approx((1.0 + 2.0 + 4.0 + 5.0) / 4.0)


def error(now, y=(0.0,) * 4, before=(0.0,) * 4, far=0.0, white=0.01**2, p=P):
    memory = filled(begun(), wrench=np.asarray(before, float))
    seen, out = made(Seen, thrust=array(now.thrust, N), far=far), room(4)
    now = filled(copied(now), wrench=np.asarray(y, float), valid=YES)
    memory.variance(p, now, seen, X.tolist(), 1.0, made(Noise, v=np.full((4, 4), white)), out)
    assert memory.wrench == pytest.approx(y)
    return np.array(out)


def test_the_model_may_be_wrong_by_a_share_of_each_of_its_terms():
    """One after the other: gains, damping, far from hover, rotors at their limits, steps of the commands."""
    gains = X[:AXIS_STATES].reshape(4, PER_AXIS)[:, GAIN]
    damping = X[:AXIS_STATES].reshape(4, PER_AXIS)[:, DAMPING]
    assert error(inputs()) == pytest.approx(np.zeros(4))
    turned = error(inputs(motion=(3.0, -2.0, 1.0), load=1.5))
    wanted = np.array(model_error.GAIN_ERROR) * gains * [3.0, -2.0, 1.0, 0.5 * N]
    assert turned == pytest.approx(model_error.ERROR_TICKS * wanted**2)
    spun = error(inputs(rates=(1.0, -2.0, 0.5)))
    wanted = model_error.DAMPING_ERROR * damping * [1.0, -2.0, 0.5, 0.0]
    assert spun == pytest.approx(model_error.ERROR_TICKS * wanted**2) and spun[2] > 0.0 == spun[3]
    assert error(inputs(), far=0.3) == pytest.approx(np.full(4, model_error.ERROR_TICKS * (model_error.FAR_ERROR * N * 0.3) ** 2))
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
    found = error(inputs(), y=(0.3, -0.3, 0.03, 0.0), before=(0.1, 0.1, 0.0, 0.0), p=P if dt == DT else SLOW)
    wanted = share * np.array([0.2 - 0.04, 0.4 - 0.04, 0.0, 0.0])
    assert found == pytest.approx(model_error.ERROR_TICKS * wanted**2)
    assert model_error.LAG_ERROR_S == 0.015


def test_a_tick_without_commands_changes_nothing_that_is_usual():
    """In a gap of the log thrusts are 0: taken for usual, the hover after it would count as far from hover for many seconds."""
    memory = settled()
    for _ in range(60):
        memory, _ = look(memory, inputs(thrust=np.zeros(N)), valid=NO)
    for name in ("thrust", "trim", "collective", "turn_level", "rate_level", "thrust_level"):
        assert getattr(memory, name) == getattr(settled(), name), name
    _, seen = look(memory, inputs())
    assert seen.far == 0.0


def test_more_damping_than_known_is_possible():
    """Five a second times the gain, of roll and pitch on average; a gain that is not known yet counts as three tenths of the usual."""
    x, n = np.zeros(THETA + 8), 8
    x[[GAIN, PER_AXIS + GAIN]] = 0.08, 0.12
    assert model_error.unknown_damping(OCTA, x.tolist()) == pytest.approx((5.0 * 0.1) ** 2)
    assert model_error.unknown_damping(OCTA, (0.0 * x).tolist()) == pytest.approx((5.0 * 0.3 * n * GAIN_MEAN[0]) ** 2)


def test_a_light_coaxial_octa_that_flies_off_is_not_accused():
    """0.9 kg on arms of 0.55 m: rotation dies out at 9 a second, and the first eight looked like a rotor at the end of one arm."""
    flights = plan.read(Path(__file__).parents[1] / "plans" / "default.toml")
    (flown,) = batch.fly(flights, [3599], 1)
    (done,) = batch.by_default([flown])
    assert event_rows.read(done.out, done.table, flown.vehicle.effectiveness()) == ()
