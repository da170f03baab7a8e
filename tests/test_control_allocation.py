"""Control allocation: exact against SciPy and against every active set, priorities, doubt, commands that no number asks for, and its C."""

import ctypes
import itertools
import subprocess
from pathlib import Path

import numpy as np
import pytest

import exporting
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.compiling import toolchain
from rotorwatch.errors import ConfigError
from rotorwatch_lab.control import allocation, box
from rotorwatch_lab.control.allocation import Allocator, Belief, believed
from rotorwatch_lab.export_c import allocator_program, export_allocator
from script_files import loaded

study = loaded(Path(__file__).resolve().parents[1] / "benchmarks" / "allocation.py")

jax = load_jax()
QUAD, HEXA = "ardupilot-quad-x", "ardupilot-hexa-x"


@pytest.fixture(scope="module")
def compiled():
    """(frame, by) -> allocator and its compiled solver, made once."""
    known = {}

    def get(frame, by="estimate"):
        if (frame, by) not in known:
            allocator = Allocator(allocation.rows(airframes.named(frame)), by=by)
            known[frame, by] = allocator, study.solver(allocator)
        return known[frame, by]

    return get


ORACLE = [(QUAD, "estimate", 250), (HEXA, "bounds", 400), ("ardupilot-dodecahexa-x", "estimate", 250), (QUAD, "posterior", 100)]


@pytest.fixture(scope="module")
def one(compiled):
    """A quadrotor's step on an estimate, compiled for one demand."""
    return jax.jit(compiled(QUAD)[0].step)


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("frame, by, count", ORACLE)
def test_commands_are_those_of_an_independent_solver(compiled, frame, by, count):
    row = study.compare(frame, count, by, seed=1, run=compiled(frame, by)[1])
    assert row.worst < 1e-9
    assert row.bounded > 0.3  # many rotors were at their limits
    assert by == "posterior" or row.turns <= box.TURNS - 4


def test_every_active_set_was_tried(compiled):
    """The best of all 3^4 sets of bounds, each solved exactly, is what is found."""
    allocator, run = compiled(QUAD)
    given = study.problems(QUAD, 100, 2)
    found = np.asarray(run(given.demand, given.belief)[0].u)
    sides = np.array(list(itertools.product((-1, 0, 1), repeat=4)))
    problem = jax.jit(jax.vmap(lambda d, e: allocator.problem(allocator.scale * d, e, e, e)))
    parts = problem(given.demand, given.belief.mean)
    for u, A, b, c, d in zip(found, *map(np.asarray, parts), strict=True):
        H, g = A.T @ A + np.diag(d), A.T @ b + d * c
        fixed, free = (sides > 0).astype(float), sides == 0
        masked = np.where(free[:, :, None] & free[:, None, :], H, np.eye(4))
        t = np.where(free, np.linalg.solve(masked, np.where(free, g - fixed @ H, 0.0)[..., None])[..., 0], fixed)
        cost = 0.5 * np.einsum("si,ij,sj->s", t, H, t) - t @ g
        best = t[np.where(((t > -1e-9) & (t < 1 + 1e-9)).all(axis=1), cost, np.inf).argmin()]
        np.testing.assert_allclose(u, best, atol=1e-7)  # normal equations: half the digits of the problem


def test_too_few_turns_are_reported(compiled):
    allocator, _ = compiled(HEXA, "bounds")
    given = study.problems(HEXA, 300, 1)
    problem = jax.vmap(lambda d, e: allocator.problem(allocator.scale * d, *e[:3]))(given.demand, given.belief)
    solve = jax.jit(jax.vmap(lambda turns, p: box.solve(*p, turns), (None, 0)))
    (one, reported), (all_, taken) = solve(1, problem), solve(box.TURNS, problem)
    assert np.abs(one - all_).max() > 0.1 and (reported == 2).any() and (taken <= box.TURNS).all()
    np.testing.assert_allclose(one[reported == 1], all_[reported == 1], atol=1e-12)


@pytest.mark.parametrize("method", allocation.METHODS)
def test_what_fits_is_given(method):
    """Small demands are met, by rotors as equal as can be; the two methods say the same."""
    allocator = Allocator(allocation.rows(airframes.named(HEXA)), method=method)
    e = np.array([1.0, 0.7, 1.0, 1.0, 0.9, 1.0])
    demand = np.array([2.4, 0.1, -0.15, 0.2])
    out = jax.jit(allocator.step)(allocator.init(), demand, believed(e))[1]
    np.testing.assert_allclose(out.wrench, demand, atol=1e-5)
    np.testing.assert_allclose(out.u, np.linalg.pinv(allocator.B * e) @ demand, atol=1e-4)
    assert out.granted.tolist() == [1.0] * 4 and out.status == allocation.OK


def _inside(B, wrench):
    """Whether a quadrotor's commands for that wrench lie in [0, 1]; there is one set of them."""
    u = np.linalg.solve(B, wrench)
    return u.min() >= 0.0 and u.max() <= 1.0


@pytest.mark.parametrize("method", allocation.METHODS)
def test_yaw_gives_way_before_thrust_and_tilt(method):
    allocator = Allocator(allocation.rows(airframes.named(QUAD)), method=method)
    demand = np.array([2.0, 0.3, 0.2, 3.0])
    out = allocator.step(allocator.init(), demand, believed(np.ones(4)))[1]
    np.testing.assert_allclose(out.wrench[:3], demand[:3], atol=0.02)
    fits = [yaw for yaw in np.linspace(0.0, 3.0, 3001) if _inside(allocator.B, [*demand[:3], yaw])]
    assert max(fits) - 0.02 < out.wrench[3] < max(fits) + 0.05
    assert out.granted[3] == 0.0 and (np.asarray(out.u).max() > 1.0 - 1e-9 or np.asarray(out.u).min() < 1e-9)


def corners(belief):
    return np.array(list(itertools.product(*zip(np.asarray(belief.lower), np.asarray(belief.upper), strict=True))))


def test_bounds_are_answered_at_the_worst_distribution_within_them(compiled):
    """Two-point distributions at the ends have the largest variance; no other commands do better there, the estimate's do worse."""
    allocator, _ = compiled(HEXA, "bounds")
    belief = believed([1, 0.5, 1, 0.9, 1, 1], [1, 0.1, 1, 0.8, 1, 1], [1, 0.8, 1, 1, 1, 1])
    ends, wide = np.unique(corners(belief), axis=0), np.asarray(belief.upper > belief.lower)
    high = np.asarray((belief.mean - belief.lower) / np.where(wide, belief.upper - belief.lower, 1.0))
    chance = np.where(wide, np.where(ends == np.asarray(belief.upper), high, 1.0 - high), 1.0).prod(axis=1)
    demand = np.array([2.5, 0.4, 0.3, 0.1])

    def cost(u):
        miss = (ends * u) @ allocator.C.T - allocator.scale * demand
        return chance @ (miss**2).sum(axis=1)

    assert chance.sum() == pytest.approx(1.0)
    sure = np.asarray(allocator.step(allocator.init(), demand, belief)[1].u)
    naive = np.asarray(Allocator(allocator.B).step(allocator.init(), demand, belief)[1].u)
    assert cost(sure) < 0.8 * cost(naive)
    rng = np.random.default_rng(0)
    for _ in range(300):
        assert cost(sure) <= cost(np.clip(sure + 0.02 * rng.standard_normal(6), 0, 1)) + 1e-5


def test_worst_error_is_that_of_the_worst_corner(compiled):
    allocator, _ = compiled(HEXA, "bounds")
    belief = believed([1, 0.5, 1, 0.9, 1, 1], [0.9, 0.1, 1, 0.8, 1, 1], [1, 0.8, 1, 1, 1, 1])
    demand = np.array([2.5, 0.4, 0.3, 0.1])
    out = allocator.step(allocator.init(), demand, belief)[1]
    errors = np.abs(demand - (corners(belief) * np.asarray(out.u)) @ allocator.B.T)
    np.testing.assert_allclose(out.worst, errors.max(axis=0), atol=1e-12)


def test_between_two_suspects_both_are_leant_on_less(compiled):
    allocator, _ = compiled(QUAD, "posterior")
    dead_1, dead_3 = np.array([[0.4, 1, 1, 1], [1, 1, 0.4, 1]])
    demand = np.array([1.6, 0.0, 0.0, 0.0])

    one_step = jax.jit(lambda belief: allocator.step(allocator.init(), demand, belief)[1].u)

    def step(weights):
        return np.asarray(one_step(believed((dead_1 + dead_3) / 2, None, None, [dead_1, dead_3], np.array(weights))))

    one, both = step([5.0, 0.0]), step([1.0, 1.0])
    sure = Allocator(allocator.B).step(allocator.init(), demand, believed(dead_1))[1].u
    np.testing.assert_allclose(one, sure, atol=1e-9)
    assert both[0] == pytest.approx(both[2]) and one[0] > one[2]
    np.testing.assert_allclose(step([0.0, 0.0]), step([1.0, 1.0]), atol=0.2)  # no weights: the mean


def test_commands_stay_where_a_demand_is_no_number(one):
    state, out = one(allocation.Held(np.zeros(4)), np.array([2.0, 0.1, 0.0, 0.0]), believed(np.ones(4)))
    for demand, e in (([np.nan, 0, 0, 0], np.ones(4)), ([2.0, 0, 0, 0], [1, np.inf, 1, 1])):
        kept, held = one(state, np.array(demand), believed(e))
        assert held.status == allocation.HELD and held.granted.tolist() == [0.0] * 4
        np.testing.assert_array_equal(held.u, out.u)
        np.testing.assert_array_equal(kept.u, out.u)


def test_a_batch_is_the_same_as_one_by_one(compiled, one):
    given = study.problems(QUAD, 20, 3)
    u = compiled(QUAD)[1](given.demand, given.belief)[0].u
    for k in range(20):
        alone = one(allocation.Held(np.zeros(4)), given.demand[k], Belief(*(leaf[k] for leaf in given.belief)))[1].u
        np.testing.assert_allclose(u[k], alone, atol=1e-10)


EXPORTED = [(HEXA, "bounds", "bounded"), (QUAD, "posterior", "bounded"), (QUAD, "estimate", "pseudo-inverse")]


@pytest.mark.parametrize("frame, by, method", EXPORTED)
def test_c_says_what_python_says(compiled, frame, by, method, tmp_path):
    """1e-12 of each output's range over 1,000 demands; strict C99 without a warning, nothing allocated."""
    if method == "bounded":
        allocator, run = compiled(frame, by)
    else:
        allocator = Allocator(allocation.rows(airframes.named(frame)), method=method)
        run = study.solver(allocator)
    program = allocator_program(allocator, "allocator", study.SETS)
    library = exporting.library(program, tmp_path, "-O1")
    given = study.problems(frame, 1000, 4)
    known = {"demand": given.demand, **given.belief._asdict()}
    columns = [np.ascontiguousarray(known[f.name]) for f in program.inputs]
    state, out = np.zeros((), exporting.struct(program.state)), np.zeros(1000, exporting.struct(program.out))
    room = exporting.room(program)  # kept: the library writes there
    pointers = [exporting.address(a) for a in (state, *columns, out, room)]
    library.allocator_run(ctypes.c_int32(1000), *pointers)
    expected = run(given.demand, given.belief)[0]
    assert exporting.worst(program.out, out, jax.tree.leaves(expected), skip=("granted",))[0] < 1e-12
    assert not any(word in program.source for word in ("alloc(", "free(", "static rw_real"))


def test_an_exported_project_runs(tmp_path):
    made = export_allocator(tmp_path, vehicle=QUAD)
    here = str(tmp_path / "example")
    sources = [str(tmp_path / "allocator.c"), str(tmp_path / "example.c")]
    subprocess.run([toolchain.compiler(), "-std=c99", *sources, "-lm", "-o", here], check=True)
    said = subprocess.run([here], capture_output=True, text=True, check=True).stdout
    assert said.startswith("status 0, commands 0.000000") and made.workspace_bytes < 4000


@pytest.mark.parametrize(
    "kw, words",
    [
        ({"by": "hope"}, "by must be one of"),
        ({"by": "bounds", "method": "pseudo-inverse"}, "driven by an estimate only"),
        ({"weights": (1, 1, 1)}, "weights must have the shape"),
        ({"weights": (1, 1, 1, 0)}, "weights must be above zero"),
        ({"eps": 0.0}, "eps must be above zero"),
    ],
)
def test_wrong_settings_are_one_sentence(kw, words):
    with pytest.raises(ConfigError, match=words):
        Allocator(np.ones((4, 4)), **kw)


def test_wrong_matrices_and_names_are_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match="must have the shape"):
        Allocator(np.ones((3, 4)))
    with pytest.raises(ConfigError, match="NaN"):
        Allocator(np.full((4, 4), np.nan))
    with pytest.raises(ConfigError, match="begin it with a letter"):
        export_allocator(tmp_path, name="1st")
