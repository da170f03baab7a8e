"""Running an estimator over a table: chunks are an implementation detail that nobody may notice."""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch_lab.compiling.run import CHUNK, run_built, stepper


class Counter:
    """Adds up inputs, and says at each step how far it is, so that a lost or repeated step shows."""

    def __init__(self, gain):
        self.gain = gain

    def init(self):
        return {"total": np.zeros(2), "steps": np.int32(0)}

    def step(self, carry, u, y, valid):
        import jax.numpy as jnp

        total = 0.9 * carry["total"] + self.gain * u + jnp.where(valid, y, 0.0)
        steps = carry["steps"] + 1
        return {"total": total, "steps": steps}, (total, steps)


def build(parameters):
    return Counter(parameters["gain"])


def only_total(out):
    return out[0]


def table(count):
    rng = np.random.default_rng(count)
    u, y = rng.standard_normal((2, count, 2))
    return SimpleNamespace(u=u, y=y, valid=rng.random((count, 2)) < 0.8)


def by_hand(t, gain, total=None):
    total = np.zeros(2) if total is None else total
    rows = []
    for u, y, valid in zip(t.u, t.y, t.valid, strict=True):
        total = 0.9 * total + gain * u + np.where(valid, y, 0.0)
        rows.append(total)
    return np.array(rows)


@pytest.mark.parametrize("count", [1, 7, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK, 2 * CHUNK + 500])
def test_any_length_is_run_as_one(count):
    t = table(count)
    _, (total, steps) = run_built(build, {"gain": 0.5}, t.u, t.y, t.valid)
    assert isinstance(total, np.ndarray) and total.dtype == np.float64
    np.testing.assert_allclose(total, by_hand(t, 0.5), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(steps, np.arange(1, count + 1))


def test_selections_and_parameters():
    t = table(40)
    for gain in (0.5, 2.0):  # the same program, another vehicle
        _, total = run_built(build, {"gain": gain}, t.u, t.y, t.valid, only_total)
        np.testing.assert_allclose(total, by_hand(t, gain), rtol=1e-12, atol=1e-12)


def test_a_table_in_two_parts_is_the_same_when_the_carry_is_handed_on():
    t = table(2 * CHUNK + 7)
    last, (whole, _) = run_built(build, {"gain": 1.0}, t.u, t.y, t.valid)
    for cut in (CHUNK, 5, CHUNK + 700):  # in the middle of a chunk, too: padding leaves no trace
        carry, (first, _) = run_built(build, {"gain": 1.0}, t.u[:cut], t.y[:cut], t.valid[:cut])
        end, (second, _) = run_built(build, {"gain": 1.0}, t.u[cut:], t.y[cut:], t.valid[cut:], carry=carry)
        np.testing.assert_array_equal(np.concatenate([first, second]), whole)
        assert end["steps"] == last["steps"] == len(t.u)


@pytest.mark.parametrize("backend", ["jax", "auto"])
def test_steps_of_a_short_table_are_the_same_by_any_engine(monkeypatch, backend):
    monkeypatch.setenv("ROTORWATCH_BACKEND", backend)
    t, over = table(9), stepper(build)
    for gain in (0.5, 2.0):
        carry = Counter(gain).init()
        for rows in (slice(0, 5), slice(5, 9)):
            carry, (total, steps) = over({"gain": gain}, carry, t.u[rows], t.y[rows])
        expected = by_hand(SimpleNamespace(u=t.u, y=t.y, valid=np.ones((9, 2), bool)), gain)
        np.testing.assert_allclose(total, expected[5:], rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(steps, np.arange(6, 10))


def test_progress_grows_to_one():
    reported = []
    t = table(2 * CHUNK + 10)
    run_built(build, {"gain": 1.0}, t.u, t.y, t.valid, progress=reported.append)
    assert reported == sorted(reported) and len(reported) == 3 and reported[-1] == 1.0
