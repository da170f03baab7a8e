"""The look at the trim of a flight (engine/drift/): held to the same weighing in arrays, and what it promises to a board."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rotorwatch.engine.definition import ENGINE, craft
from rotorwatch.engine.drift import many, weighing
from rotorwatch.engine.drift.drift_sizes import AMOUNTS_TURNED, BLOCKS
from rotorwatch.engine.drift.fit import DOUBT, GAIN, WHITE
from rotorwatch.engine.drift.stretch import SMOOTH
from rotorwatch.engine.drift.trim import LOOK_S, Trim
from rotorwatch.engine.drift.weighing import DRIFT, RARE, TURNED
from rotorwatch.engine.events.losses import CLEAR
from test_slow import HEXA, QUAD, flight

AMOUNTS = np.concatenate([-np.array(weighing.AMOUNTS)[::-1], weighing.AMOUNTS])
SIZES = np.array(weighing.SIZES)


def passed(B, ticks, out, state=None, part=slice(None), every=1e30):
    """The definition, with these ticks."""
    if state is None:
        state = ENGINE.new(Trim)
        state.set(every=every)
    known = craft(B.shape[1], effectiveness=B, expo_sd=ticks.curve[1])
    lacking = (out.biases + (ticks.thrust * out.theta) @ B.T)[part, :3]
    usable = ticks.valid[part, :2].all(axis=1)
    rows = ticks.time[part], ticks.mode[part].astype(np.int32), usable, lacking, ticks.thrust[part]
    ENGINE.call(many.pass_on, state, known, ticks.dt, len(rows[0]), *map(np.ascontiguousarray, rows))
    return state, known


def looked_at(B, **how):
    out, ticks = flight(B, **how)
    state, known = passed(B, ticks, out)
    ENGINE.call(many.settle, state, known)
    return state


def total(logs, axis=None) -> Any:
    return np.logaddexp.reduce(logs, axis) if axis is not None else float(np.logaddexp.reduce(logs, None))


def in_arrays(B, state):
    """The same blocks and courses weighed with matrices: log-odds of each course, rotor and size; of turned mounts; of all else."""
    stretch, work = state.part("stretch"), state.part("weighing")
    N, n, C = int(stretch["count"][0]), B.shape[1], int(work["courses"][0])
    at, z = stretch["at"][0, :N].astype(int), stretch["z"][0, :, :N].T
    share, white = stretch["share"][0, :n, :N].T, stretch["white"][0, :N]
    start, rise = (work[name][0, :C].astype(float) for name in ("start", "rise"))
    r = np.clip((at - start[:, None]) / np.maximum(rise, 1e-9)[:, None], 0.0, 1.0)
    r = np.where(rise[:, None] > 0, r, at >= start[:, None])
    X = np.concatenate([r[:, None], r[:, None] * share.T], axis=1).reshape(-1, N)
    torque, moves = share @ B[:3].T, np.zeros((N, 3))
    for j in range(N):
        near = np.abs(at - at[j]) <= SMOOTH
        for a in range(3):
            moves[j, a] = torque[j, a] - np.polyval(np.polyfit(at[near] - at[j], torque[near, a], 1), 0.0)
    walk, fits = np.minimum(at[:, None], at) - at[0] + 1.0, []
    for k, q in enumerate(WHITE):
        whiten = np.linalg.inv(np.linalg.cholesky(walk + q * np.diag(white)))
        U, size, _ = np.linalg.svd(whiten @ moves, full_matrices=False)
        some = size > max(1e-5, 1e-5 * size.max())
        U, size = U[:, some], size[some]
        for axis, y in enumerate(z.T):
            left = whiten @ y
            left -= U @ (U.T @ left)
            known = 1.0 / np.sqrt(1.0 + GAIN**2 * size**2 * N / (left @ left))
            W = whiten - (U * (1.0 - known)) @ (U.T @ whiten)
            level = W.sum(axis=1)
            W -= np.outer(level, level @ W) / (level @ level)
            fit = np.log(np.diag(whiten)).sum() + np.log(known).sum() - 0.5 * np.log(level @ level) + k * np.log(DOUBT)
            x, y = X @ W.T, W @ y
            fits.append((axis, fit, y @ y, (x @ y).reshape(C, n + 1), (x**2).sum(axis=1).reshape(C, n + 1)))

    def log_fit(axis, which, amount):
        rests = [(f, yy - 2.0 * amount * xy[:, which, None] + amount**2 * xx[:, which, None]) for a, f, yy, xy, xx in fits if a == axis]
        return np.logaddexp.reduce([f - 0.5 * (N - 1) * np.log(rest) for f, rest in rests])

    losses, small, large = np.zeros((C, n, SIZES.size)), np.zeros((3, C)), np.zeros((3, C, AMOUNTS.size))
    turns = np.abs(AMOUNTS) >= TURNED
    for axis in range(3):
        none = log_fit(axis, 0, np.zeros(1))[0, 0]
        density = np.gradient(AMOUNTS) / (np.pi * DRIFT[axis] * (1.0 + (AMOUNTS / DRIFT[axis]) ** 2))
        drift = log_fit(axis, 0, AMOUNTS) + np.log(density) - none
        small[axis], large[axis] = total(drift[:, ~turns], 1), np.where(turns, drift, -np.inf)
        losses += log_fit(axis, slice(1, None), SIZES * B[axis, :, None]) - none
    whole = np.logaddexp(small, total(large, 2))
    still, calm = small[:2].sum(axis=0), whole[:2].sum(axis=0)
    alone = np.logaddexp(0.0, total(whole[:2], 1) - np.log(C)).sum() - 3.0 * np.log(2.0)
    turned = np.logaddexp(alone, still[:, None]) + large[2] - np.log(3.0 * C)
    together = np.logaddexp(calm + small[2], calm + np.log(-np.expm1(np.minimum(still - calm, -1e-6))) + whole[2])
    apart = alone + np.logaddexp(0.0, total(small[2]) - np.log(C))
    other = total(np.array([0.0, total(together) - np.log(C), apart])) - np.log(3.0)
    return losses + np.log(RARE / losses.size), turned, other


@pytest.mark.parametrize(
    "B, how",
    [
        (QUAD, {"loss": 0.4}), (QUAD, {"rise": 0.0, "drift": (0.0, 0.0, 0.8)}), (QUAD, {"turns": 0.3, "loss": 0.12}),
        (HEXA, {"rotor": 2, "loss": 0.3, "rise": 0.0}), (HEXA, {"drift": (0.3, 0.2, -0.5), "turns": 0.2}),
    ],
)  # fmt: skip
def test_each_explanation_has_the_odds_that_matrices_give_it(B, how):
    state = looked_at(B, **how)
    losses, turned, other = in_arrays(B, state)
    growth, mount, work = state.part("growth"), state.part("mount"), state.part("weighing")
    np.testing.assert_allclose(work["lost"][0, : len(losses), : B.shape[1]], total(losses, 2) + np.log(losses.size / RARE), atol=1e-5)
    rotor = total(losses.transpose(1, 0, 2).reshape(B.shape[1], -1), 1)
    rest = [total(np.delete(rotor, rotor.argmax())), total(turned), other]
    assert np.log(growth["odds"][0]) == pytest.approx(min(rotor.max() - total(np.array(rest)), 27.0), abs=1e-4)
    assert np.log(mount["odds"][0]) == pytest.approx(min(total(turned) - total(np.array([*rotor, other])), 27.0), abs=1e-4)
    weight = np.exp(turned - turned.max())
    yaw, course = weight.sum(axis=0), weight.sum(axis=1)
    assert mount["yaw"][0] == pytest.approx(yaw @ AMOUNTS / yaw.sum(), abs=1e-6)
    stretch, C = state.part("stretch"), len(losses)
    place = course @ work["start"][0, :C] / course.sum()
    assert mount["onset"][0] == pytest.approx(stretch["start"][0] + stretch["length"][0] * (place + 0.5), abs=1e-3)
    if int(growth["count"][0]):
        best, grows = rotor.argmax(), work["rise"][0, :C] * stretch["length"][0] >= weighing.GROWS_S
        assert growth["rotors"][0, 0] == best
        own = total(losses[grows if growth["grew"][0] else ~grows, best], 0)
        weight = np.exp(own - own.max())
        assert growth["loss"][0, 0] == pytest.approx(weight @ SIZES / weight.sum(), abs=1e-6)


def test_amounts_of_a_mount_are_those_beyond_what_air_turns():
    assert 2 * sum(amount >= TURNED for amount in weighing.AMOUNTS) == AMOUNTS_TURNED


@pytest.mark.parametrize("seconds", [40.0, 119.0, 1000.0])
def test_blocks_are_means_of_their_ticks_and_never_too_many(seconds):
    """However long the flight: joined in pairs, as if their ticks had been one block's from the beginning; gaps stay empty."""
    rng, dt = np.random.default_rng(1), 0.25
    time = np.arange(0.0, seconds, dt)
    usable = (time < 0.4 * seconds) | (time > 0.5 * seconds)
    thrust, lacking = 1.0 + 0.1 * rng.random((time.size, 4)), rng.standard_normal((time.size, 3))
    state, known = ENGINE.new(Trim), craft(4, effectiveness=QUAD)
    rows = time, np.full(time.size, 2, np.int32), usable, lacking, thrust
    ENGINE.call(many.pass_on, state, known, dt, time.size, *rows)
    blocks = state.part("blocks")
    start, length = float(blocks["start"][0]), float(blocks["length"][0])
    assert start == 6.0 and (length == 2.0 or time[-1] - start >= 0.5 * BLOCKS * length)
    every, use = blocks["all"][0], usable & (time >= start)
    at, z = ((time - start) / length).astype(int), lacking / thrust.mean(axis=1, keepdims=True)
    for i in range(BLOCKS):
        mine = use & (at == i)
        assert every[i]["count"] == mine.sum()
        if mine.any():
            np.testing.assert_allclose(every[i]["z"], z[mine].mean(axis=0), atol=1e-12)
            np.testing.assert_allclose(every[i]["scatter"], z[mine].var(axis=0), atol=1e-12)
            np.testing.assert_allclose(every[i]["thrust"][:4], thrust[mine].mean(axis=0), atol=1e-12)


def test_pieces_make_no_difference_and_looks_before_the_end_neither():
    out, ticks = flight(QUAD, loss=0.4)
    whole = looked_at(QUAD, loss=0.4).part("growth")
    state, known = None, None
    for first in range(0, ticks.time.size, 97):
        state, known = passed(QUAD, ticks, out, state, slice(first, first + 97), LOOK_S)
    assert state is not None and int(state["looks"][0]) == 2
    ENGINE.call(many.settle, state, known)
    for name in ("loss", "lower", "upper", "start", "end", "odds", "lost"):
        np.testing.assert_array_equal(state.part("growth")[name], whole[name])


def test_a_look_is_worked_off_before_the_next_and_what_comes_meanwhile_is_not_in_it():
    out, ticks = flight(QUAD, loss=0.4)
    state, done = None, []
    for first in range(ticks.time.size):
        state, _ = passed(QUAD, ticks, out, state, slice(first, first + 1), LOOK_S)
        done.append((bool(state["busy"][0]), int(state["looks"][0])))
    began = [k for k in range(1, len(done)) if done[k][0] and not done[k - 1][0]]
    ended = [k for k in range(1, len(done)) if done[k][1] > done[k - 1][1]]
    assert [ticks.time[k] for k in began] == pytest.approx([37.0, 67.0], abs=0.2)
    assert all(5.0 < ticks.time[b] - ticks.time[a] < LOOK_S for a, b in zip(began, ended, strict=True))
    assert state is not None and state.part("growth")["looked"][0] <= ticks.time[began[-1]]


def test_what_a_look_has_shown_holds_until_the_next_one_shows_enough():
    """The flight ends, and the vehicle takes off again, for too short a time; then for long enough."""
    out, ticks = flight(QUAD, rise=0.0, drift=(0.0, 0.0, 0.8))
    state, known = passed(QUAD, ticks, out)
    ground = SimpleNamespace(**{**vars(ticks), "mode": np.zeros_like(ticks.mode), "time": ticks.time + 100.0})
    passed(QUAD, ground, out, state)
    first = float(state.part("mount")["odds"][0])
    assert first > CLEAR and int(state["looks"][0]) == 1
    ticks.time += 200.0
    passed(QUAD, ticks, out, state, slice(0, 300))
    ENGINE.call(many.settle, state, known)
    assert float(state.part("mount")["odds"][0]) == first and int(state["looks"][0]) == 1
    calm, _ = flight(QUAD)
    ground.time += 200.0
    ticks.time += 200.0
    passed(QUAD, ground, out, state)
    passed(QUAD, ticks, calm, state)
    ENGINE.call(many.settle, state, known)
    assert float(state.part("mount")["odds"][0]) < CLEAR and int(state["looks"][0]) == 2


def test_python_and_machine_code_give_the_same_bits():
    if ENGINE.library is None:
        pytest.skip("no C compiler")
    library, compiled = ENGINE.library, looked_at(HEXA, loss=0.3, turns=0.2)
    ENGINE.__dict__["library"] = None
    try:
        plain = looked_at(HEXA, loss=0.3, turns=0.2)
    finally:
        ENGINE.__dict__["library"] = library
    for part, names in (
        ("growth", ("count", "loss", "lower", "upper", "start", "end", "odds", "lost")), ("mount", ("onset", "odds", "yaw", "half")),
    ):  # fmt: skip
        for name in names:
            np.testing.assert_array_equal(compiled.part(part)[name], plain.part(part)[name], err_msg=name)
