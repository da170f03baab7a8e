"""From a traced function to C: random programs, refusals, the project's files, native code and its cache."""

import json
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import rotorwatch as rw
from exporting import STRICT, address, jax, library, room, struct
from rotorwatch import airframes
from rotorwatch.base.compiling import toolchain
from rotorwatch.commands.cli import cli
from rotorwatch.errors import ConfigError
from rotorwatch.export.export_diagnoser import export_diagnoser
from rotorwatch_lab.compiling import native
from rotorwatch_lab.compiling.c99.lower import Refused
from rotorwatch_lab.compiling.c99.project import Field, emit_program
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.export_c import export_c
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

jnp, lax = jax.numpy, jax.lax
pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
PROGRAMS, OPERATIONS = 10, 40  # every value of every program is compared: 400 expressions
N, M = 5, 3


# Random programs: a pool of values grows by operations on what is there.


def floats(pool, rng, rank=None):
    fitting = [v for v in pool if v.dtype == float and (rank is None or v.ndim == rank)]
    return fitting[rng.integers(len(fitting))]


def tame(x):
    """Values stay where differences mean something."""
    return jnp.tanh(x)


def definite(a):
    return a @ a.T + 2.0 * jnp.eye(a.shape[0])


def matrix(pool, rng):
    """An (N, N) matrix."""
    return jnp.tanh(jnp.outer(vector(pool, rng), vector(pool, rng))) + jnp.eye(N)


def vector(pool, rng):
    """(N,) of anything."""
    x = floats(pool, rng).reshape(-1)
    return x[:N] if x.size >= N else jnp.resize(x, N)


def count(pool, rng):
    """A run-time integer."""
    return (jnp.abs(floats(pool, rng)).sum() * 3.7).astype(jnp.int32)


def scanned(p, r):
    def turn(carry, row):
        new = (carry[1], tame(carry[0] * 0.9 + row))
        return new, new[0] - row

    last, each = lax.scan(turn, (vector(p, r), vector(p, r)), matrix(p, r), reverse=bool(r.integers(2)))
    return last[0] + each.sum(0) + last[1]


OPS = [
    lambda p, r: tame(floats(p, r) * 1.5 - 0.25),
    lambda p, r: jnp.sqrt(jnp.abs(floats(p, r)) + 0.1) + jnp.exp(-jnp.abs(floats(p, r)).max()),
    lambda p, r: jnp.cos(floats(p, r)) / (1.0 + floats(p, r).mean() ** 2),
    lambda p, r: vector(p, r) - vector(p, r)[::-1],
    lambda p, r: jnp.where(vector(p, r) > vector(p, r), vector(p, r), 0.5),
    lambda p, r: jnp.maximum(vector(p, r), vector(p, r).min()),
    lambda p, r: matrix(p, r) @ matrix(p, r).T * 0.1,
    lambda p, r: matrix(p, r) @ vector(p, r) * 0.2,
    lambda p, r: tame(jnp.einsum("ij,jk,k->ik", matrix(p, r), matrix(p, r), vector(p, r))),
    lambda p, r: jnp.linalg.cholesky(definite(matrix(p, r))) * 0.3,
    lambda p, r: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(definite(matrix(p, r))), True), matrix(p, r)),
    lambda p, r: jax.scipy.linalg.solve_triangular(definite(matrix(p, r)), vector(p, r), lower=True, trans=int(r.integers(2))),
    lambda p, r: jax.vmap(lambda a: jnp.linalg.cholesky(definite(a)))(jnp.stack([matrix(p, r), matrix(p, r)])).sum(0) * 0.2,
    lambda p, r: matrix(p, r)[1:4, ::2],
    lambda p, r: jnp.concatenate([vector(p, r)[:2], vector(p, r)[2:]]),
    lambda p, r: jnp.stack([vector(p, r), vector(p, r)], axis=int(r.integers(2))),
    lambda p, r: jnp.concatenate(jnp.unstack(matrix(p, r), axis=int(r.integers(2)))[::-1])[:3] * 0.5,
    lambda p, r: matrix(p, r).T.reshape(-1)[:12].reshape(4, 3),
    lambda p, r: jnp.pad(vector(p, r), (1, 2))[: N + 2],
    lambda p, r: jnp.roll(vector(p, r), int(r.integers(N))),
    lambda p, r: vector(p, r)[np.array([3, 0, 4, 0])],
    lambda p, r: matrix(p, r).at[1:3, 2:].set(0.25).at[np.array([0, 4]), np.array([1, 3])].add(vector(p, r)[:2]),
    lambda p, r: vector(p, r).at[np.array([4, 0, 2])].set(vector(p, r)[:3]),
    lambda p, r: matrix(p, r).sum(axis=int(r.integers(2))) + matrix(p, r).max(axis=int(r.integers(2))),
    lambda p, r: jnp.cumsum(matrix(p, r), axis=int(r.integers(2))) * 0.2,
    lambda p, r: jnp.argmax(vector(p, r)).astype(float) * 0.1 + jnp.argmin(matrix(p, r), axis=1),
    lambda p, r: lax.dynamic_slice(matrix(p, r), (count(p, r), count(p, r)), (2, 3)),
    lambda p, r: lax.dynamic_index_in_dim(matrix(p, r), count(p, r) % 9 - 2, keepdims=False),
    lambda p, r: lax.dynamic_update_slice(vector(p, r), vector(p, r)[:2], (count(p, r),)),
    lambda p, r: vector(p, r)[jnp.clip(count(p, r), 0, N - 1)] + matrix(p, r)[count(p, r) % N],
    lambda p, r: (count(p, r) // 3 - count(p, r) % 4 + jnp.sign(-count(p, r))).astype(float) * 0.01,
    lambda p, r: lax.fori_loop(0, 4, lambda k, x: tame(x * 0.7 + 0.1 * k), vector(p, r)),
    scanned,
    lambda p, r: lax.cond(vector(p, r).sum() > 0, lambda a, b: a @ b, lambda a, b: b[::-1] * 2, matrix(p, r), vector(p, r)),
    lambda p, r: lax.switch(count(p, r) % 3, [jnp.sin, jnp.negative, lambda x: x.sum() + x], vector(p, r)),
    lambda p, r: jax.jacfwd(lambda x: tame(jnp.cross(x[:3], x[2:5])) * x[0])(vector(p, r)),
    lambda p, r: jnp.tril(matrix(p, r)) - jnp.triu(matrix(p, r), 1) + jnp.diag(vector(p, r)),
    lambda p, r: tame(jnp.diag(vector(p, r)) @ jnp.tile(matrix(p, r), (1, 2))),
    lambda p, r: tame(jax.jacfwd(lambda x: jnp.cross(x[:3], x[2:5]))(vector(p, r)) @ matrix(p, r).repeat(2, axis=1)),
    lambda p, r: tame(jnp.concatenate([matrix(p, r) @ matrix(p, r), matrix(p, r) @ matrix(p, r).T], axis=int(r.integers(2)))),
    lambda p, r: tame(jnp.tile(matrix(p, r), (2, 2)) @ jnp.ones((10, 9)) + np.eye(10, 9)),
    lambda p, r: jnp.clip(vector(p, r), -0.2, floats(p, r).max()) ** 3 + jnp.isfinite(vector(p, r)),
    lambda p, r: jnp.any(vector(p, r) > 0.3, axis=0) * vector(p, r) + jnp.all(matrix(p, r) < 9, axis=1),
    lambda p, r: jnp.round(vector(p, r) * 10) * 0.1 + jnp.floor(vector(p, r)) + jnp.arctan2(vector(p, r), 2.0),
    lambda p, r: tame(jax.device_put(vector(p, r)) * 0.8),  # jnp.asarray of JAX 0.6 makes these of constants
]  # fmt: skip


def random_program(seed):
    """A step of random operations; all values are its outputs."""

    def step(_, carry, a, b, flags):
        rng = np.random.default_rng(seed)
        pool = [carry[0], carry[1], a, b, jnp.where(flags, 1.0, -0.5) * a]
        for _ in range(OPERATIONS):
            new = OPS[rng.integers(len(OPS))](pool, rng)
            pool.append(jnp.asarray(new, float))
        return (tame(vector(pool, rng)), tame(matrix(pool, rng))), tuple(pool[5:])

    return step


INPUTS = (Field("a", "f", (N,)), Field("b", "f", (M, N)), Field("flags", "b", (N,)))


def start(_):
    return jnp.arange(N) * 0.1, jnp.ones((N, N)) * 0.3


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("seed", range(PROGRAMS))
def test_random_programs_say_the_same_in_c(seed, tmp_path):
    step = random_program(seed)
    program = emit_program("chance", step, start, INPUTS)
    # Half of them watched by the sanitizers' traps, half optimised, one of these as far as it goes: all without a warning.
    optimised = "-O3" if seed == 0 else "-O1"
    flags = ("-O0", "-fsanitize=undefined", "-fsanitize-undefined-trap-on-error") if seed % 2 else (optimised,)
    lib = library(program, tmp_path, *flags)
    rng, compiled, carry = np.random.default_rng(seed), jax.jit(step), start(())
    state, out, keep = np.zeros((), struct(program.state)), np.zeros((), struct(program.out)), room(program)
    lib.chance_init(address(state), address(keep))
    for _ in range(4):
        given = [rng.standard_normal(N), rng.standard_normal((M, N)), rng.random(N) > 0.5]
        carry, said = compiled((), carry, *given)
        lib.chance_step(address(state), *map(address, given), address(out), address(keep))
        for f, leaf in zip(program.out, said, strict=True):
            np.testing.assert_allclose(out[f.name], leaf, rtol=1e-9, atol=1e-11, err_msg=f.name)
        for f, leaf in zip(program.state, carry, strict=True):
            np.testing.assert_allclose(state[f.name], leaf, rtol=1e-9, atol=1e-11, err_msg=f.name)


CHANGES = [
    lambda m, o, x, r: 0.9 * m + x[:, None] * 0.1,
    lambda m, o, x, r: m - (m @ x)[:, None] * x[None, :] * 0.05,
    lambda m, o, x, r: jnp.where(x[0] > 0.0, m, 0.5 * m + 0.1),
    lambda m, o, x, r: m + 0.1 * m.mean(),
    lambda m, o, x, r: 0.5 * m + 0.1 * m[:, ::-1],
    lambda m, o, x, r: 0.6 * m + 0.3 * m.T,
    lambda m, o, x, r: 0.5 * m + 0.4 * o[r.integers(len(o))],  # what it has been before
    lambda m, o, x, r: 0.5 * m + 0.4 * o[0] * x[None, :],
]


@pytest.mark.parametrize("seed", range(4))
def test_a_matrix_that_is_changed_many_times(seed, tmp_path):
    """Where nobody reads what it was before, a large one is changed where it is; else it is not."""
    size = 32

    def step(_, carry, x):
        rng, m, known = np.random.default_rng(seed), carry[0], [carry[0]]
        for _ in range(12):
            # Of the first program nobody reads what was before.
            m = CHANGES[rng.integers(4 if seed == 0 else len(CHANGES))](m, known, x, rng)
            known.append(m)
        return (m,), m.sum()

    program = emit_program("changed", step, lambda _: (jnp.ones((size, size)) * 0.3,), (Field("x", "f", (size,)),))
    if seed == 0:
        assert program.workspace_bytes < 8 * size * size
    lib, rng, carry = library(program, tmp_path, "-O2"), np.random.default_rng(seed), (jnp.ones((size, size)) * 0.3,)
    state, out, keep = np.zeros((), struct(program.state)), np.zeros((), struct(program.out)), room(program)
    lib.changed_init(address(state), address(keep))
    for _ in range(3):
        x = rng.standard_normal(size)
        carry, _ = step((), carry, x)
        lib.changed_step(address(state), address(x), address(out), address(keep))
        np.testing.assert_allclose(state[program.state[0].name], carry[0], rtol=1e-9, atol=1e-11)


def test_what_is_diagonal_or_sparse_in_a_batch_needs_no_dense_algebra(tmp_path):
    """Inverses of diagonal noise, each of a batch, and products with Jacobians that are mostly zero: element by element."""
    size = 10
    few = np.eye(size) + np.diag(np.ones(size - 1), 1)

    def step(_, carry, v, a):
        Q = jax.vmap(jnp.diag)(v)
        Q = Q.at[:, 2:5, 2:5].set(jnp.eye(3) * v[:, :1, None])
        factor = (jnp.linalg.cholesky(Q), True)
        inverse = jax.vmap(lambda L: jax.scipy.linalg.cho_solve((L, True), jnp.eye(size)))(factor[0])
        right = jax.scipy.linalg.solve_triangular(factor[0][0], a.T, lower=True, trans=1).T
        sparse = few * v[:, None, :]
        scaled = inverse @ (v[:, :, None] * a[:size])
        return carry, (factor[0], inverse, right, scaled, sparse @ scaled, jnp.einsum("kij,kj->ki", inverse, v))

    inputs = (Field("v", "f", (M, size)), Field("a", "f", (size + 1, size)))
    program = emit_program("sparse", step, lambda _: (jnp.zeros(2),), inputs)
    assert not any(f"{kernel}_" in program.source for kernel in ("cholesky", "triangular", "product"))
    lib, rng = library(program, tmp_path, "-O2"), np.random.default_rng(0)
    state, out, keep = np.zeros((), struct(program.state)), np.zeros((), struct(program.out)), room(program)
    v, a = rng.uniform(0.1, 2.0, (M, size)), rng.standard_normal((size + 1, size))
    _, said = step((), (jnp.zeros(2),), v, a)
    lib.sparse_step(address(state), address(v), address(a), address(out), address(keep))
    for f, leaf in zip(program.out, said, strict=True):
        np.testing.assert_allclose(out[f.name], leaf, rtol=1e-9, atol=1e-11, err_msg=f.name)
    v[1, 7] = -1.0  # a variance that is none: no factor
    lib.sparse_step(address(state), address(v), address(a), address(out), address(keep))
    factor = out[program.out[0].name]
    assert np.isnan(factor[1]).sum() == 1 and np.isnan(factor[1, 7, 7]) and np.isfinite(factor[::2]).all()


# What cannot be exported.

REFUSED = {
    "while": (lambda x: lax.while_loop(lambda v: v.sum() < 9, lambda v: v + 1, x), "fori_loop"),
    "sort": (lambda x: jnp.sort(x), "argmax"),
    "lu": (lambda x: jnp.linalg.inv(jnp.outer(x, x)).sum(), "cho_solve"),
    "qr|geqrf|householder": (lambda x: jnp.linalg.qr(jnp.outer(x, x))[0], "cho_solve"),
    "eigh": (lambda x: jnp.linalg.eigh(jnp.outer(x, x))[0], "cho_solve"),
    "svd": (lambda x: jnp.linalg.svd(jnp.outer(x, x))[1], "cho_solve"),
    "known at run time": (lambda x: x.at[x.argmax()].set(1.0), "dynamic_update_slice"),
    "callback": (lambda x: jax.pure_callback(np.sin, x, x), "Python"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_c_is_refused_with_its_line(what):
    function, advice = REFUSED[what]
    with pytest.raises(Refused, match=what) as why:
        emit_program("refused", lambda _, c, a: (c, function(a)), start, (Field("a", "f", (N,)),))
    said = str(why.value)
    assert advice in said and "test_export_c.py:" in said and len(said.splitlines()) == 1


# The project's files.


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    return export_c("ekf", tmp_path_factory.mktemp("ekf"), variable_dt=True)


def test_the_header_says_names_units_version_and_definition(project):
    text = (project.folder / "ekf.h").read_text()
    for part in ("thrust_1", "thrust_6", "p, q, r [rad/s], f_z [m/s^2]", "loss_6", "0 ok, 1 not ready", rw.__version__, project.digest):
        assert part in text
    assert "rw_real dt" in text and "malloc" not in (project.folder / "ekf.c").read_text()


@pytest.mark.parametrize("cc", ["gcc", "clang", "g++"])
def test_the_example_builds_without_a_warning_and_runs(project, cc, tmp_path):
    if shutil.which(cc) is None:
        pytest.skip(f"{cc} is not installed")
    flags = ("-Wall", "-Wextra", "-Werror") if cc == "g++" else STRICT
    main = tmp_path / ("main.cpp" if cc == "g++" else "main.c")
    main.write_text((project.folder / "example.c").read_text())
    c_compiler = "gcc" if cc == "g++" else cc
    include = f"-I{project.folder}"
    subprocess.run([c_compiler, *STRICT, "-O2", "-c", "-o", str(tmp_path / "m.o"), str(project.folder / "ekf.c")], check=True)
    subprocess.run([cc, *flags, include, "-o", str(tmp_path / "m"), str(main), str(tmp_path / "m.o"), "-lm"], check=True)
    said = subprocess.run([str(tmp_path / "m")], capture_output=True, text=True, check=True).stdout
    numbers = [float(word) for word in said.split()[3:]]
    assert said.startswith("status 0") and len(numbers) == 6 and max(map(abs, numbers)) < 0.01


def test_the_same_estimator_has_the_same_definition(project, tmp_path):
    assert export_c("ekf", tmp_path / "a", variable_dt=True).digest == project.digest
    assert export_c("ekf", tmp_path / "b").digest != project.digest


def test_the_command_line(tmp_path):
    done = CliRunner().invoke(cli, ["export-c", "--estimator", "default", "-o", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"default.c", "default.h", "example.c", "CMakeLists.txt"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"estimator": "nonsense"}, "no estimator called 'nonsense'"),
        ({"estimator": "ekf", "vehicle": "no-such-frame"}, "no airframe called"),
        ({"estimator": "default", "vehicle": "f450"}, "is a paper's"),
        ({"estimator": "default", "variable_dt": True}, "leave --variable-dt out"),
        ({"estimator": "default", "dt": 0.03}, "no ticks of 0.03 s"),
        ({"estimator": "default-filter"}, "give ekf with --vehicle"),
        ({"estimator": "ekf", "vehicle": "ruav-40kg"}, "does not say"),
        ({"estimator": "ekf", "name": "2nd"}, "begin it with a letter"),
    ],
)
def test_bad_calls_are_reported_in_one_sentence(arguments, said, tmp_path):
    with pytest.raises(rw.RotorwatchError, match=said) as why:
        rw.export_c(arguments.pop("estimator"), tmp_path, **arguments)
    assert len(str(why.value).splitlines()) == 1


# Native code.


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of its own, and a fresh mind."""
    monkeypatch.setenv("ROTORWATCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("ROTORWATCH_BACKEND", raising=False)
    toolchain.machine.cache_clear()
    toolchain._temporary.cache_clear()
    yield tmp_path / "cache" / "native"
    toolchain.machine.cache_clear()


def small(walk=1e-3):
    return EKF(RateDynamics.of(airframes.paper("niermeyer-hexa")), 0.01, theta_walk=walk)


def table(rows=700, seed=0):
    rng = np.random.default_rng(seed)
    u = 0.36 + 0.02 * rng.standard_normal((rows, 6))
    y = np.column_stack([0.05 * rng.standard_normal((rows, 3)), -9.8 + 0.3 * rng.standard_normal(rows)])
    return u, np.where(rng.random((rows, 4)) < 0.1, np.nan, y)


def close(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_native_runs_are_the_same(cache):
    method, (u, y), shares = small(), table(1024), []
    one, other = run(method, u, y), run(method, u, y, backend="native", progress=shares.append)
    assert type(other[0]) is type(one[0]) and type(other[1]) is type(one[1])
    close(one, other)
    assert shares[-1] == 1.0 and shares == sorted(shares)
    first = run(method, u[:300], y[:300], backend="native")
    close(run(method, u[300:], y[300:], carry=first[0], backend="native")[0], one[0])
    assert run(method, u[:0], y[:0], backend="native")[1].x.shape == (0, 3)


def test_a_changed_definition_never_meets_an_old_build(cache):
    u, y = table(100)
    old = run(small(1e-3), u, y, backend="native")[1].theta_cov
    new = run(small(1e-1), u, y, backend="native")[1].theta_cov
    assert new[-1, 0, 0] > 2 * old[-1, 0, 0]
    assert len(list(cache.glob("*.so"))) == 2
    run(small(1e-1), u, y, backend="native")
    assert len(list(cache.glob("*.so"))) == 2


def test_live_steps_are_the_run(cache):
    method, (u, y) = small(), table(60)
    live, whole = native.Live(method), run(method, u, y)[1]
    for k in range(60):
        said = live.step(u[k], y[k], np.isfinite(y[k]))
        np.testing.assert_allclose(said.theta, whole.theta[k], rtol=1e-9, atol=1e-12)
    assert said.status == whole.status[-1]


def test_without_a_compiler_jax_runs_and_says_so(cache, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    method, (u, y) = small(), table(50)
    with pytest.warns(RuntimeWarning, match=r"no C compiler \(no-such-compiler\).*JAX runs instead"):
        out = run(method, u, y, backend="native")
    close(out[1], run(method, u, y)[1])


def test_a_cache_that_cannot_be_written_costs_a_build(cache, monkeypatch):
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode, **more: mode != os.W_OK and access(path, mode, **more))
    method, (u, y) = small(), table(50)
    with pytest.warns(RuntimeWarning, match="cannot be written; native code is built anew"):
        out = run(method, u, y, backend="native")
    assert not list(cache.glob("*.so"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        close(out[1], run(method, u, y, backend="jax")[1])


@pytest.mark.skipif(os.name != "posix", reason="owners and modes of POSIX")
@pytest.mark.parametrize("mode", [0o777, 0o770])
def test_a_cache_that_others_may_write_is_not_used(cache, mode):
    cache.mkdir(parents=True)
    cache.chmod(mode)
    with pytest.warns(RuntimeWarning, match="can be written by other users.*chmod go-w"):
        assert toolchain.folder() != cache
    cache.chmod(0o700)
    assert toolchain.folder() == cache


@pytest.mark.skipif(os.name != "posix" or os.getuid() != 0, reason="only root can give a folder to another user")
def test_a_cache_of_another_user_is_not_used(cache):
    cache.mkdir(parents=True, mode=0o700)
    os.chown(cache, 12345, 12345)
    with pytest.warns(RuntimeWarning, match="belongs to another user"):
        assert toolchain.folder() != cache


def test_a_library_that_was_changed_in_the_cache_is_built_again(cache):
    method, (u, y) = small(), table(50)
    first = run(method, u, y, backend="native")
    (library,) = cache.glob("*.so")
    good = library.read_bytes()
    library.unlink()  # what is loaded stays loaded
    library.write_bytes(b"of somebody else")
    native._nameless.cache_clear()
    native._SEALED.clear()
    again = run(small(), u, y, backend="native")
    close(again[1], first[1])
    assert library.read_bytes() == good


def test_an_unknown_backend_is_reported():
    u, y = table(3)
    with pytest.raises(ConfigError, match="'jax', 'native' or 'auto', not 'fortran'"):
        run(small(), u, y, backend="fortran")


WARM = """
import json, sys
import numpy as np
from typing import NamedTuple
from rotorwatch_lab.compiling import native
from rotorwatch_lab.compiling.run import run_built
class Carry(NamedTuple):
    total: object
class Sum:
    class system: n_u, n_y = 1, 1
    def __init__(self, p): self.p = p
    def init(self): return Carry(np.zeros(1))
    def step(self, carry, u, y, valid): return Carry(carry.total + u * self.p["gain"]), {"total": carry.total * 1.0}
def build(p): return Sum(p)
def keep(out): return out
native._named = lambda function: function.__name__
u = np.ones((5, 1))
carry, out = run_built(build, {"gain": np.array(float(sys.argv[1]))}, u, u, u > 0, keep, backend="native")
print(json.dumps([float(carry.total[0]), out["total"][:, 0].tolist(), "jax" in sys.modules]))
"""


def test_what_is_known_is_run_without_jax(tmp_path):
    """The second process neither traces nor imports JAX; parameters are not part of the build."""
    environment = {**os.environ, "ROTORWATCH_CACHE": str(tmp_path)}

    def process(gain):
        command = [sys.executable, "-c", WARM, str(gain)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
        assert done.returncode == 0, done.stderr[-2000:]
        return json.loads(done.stdout)

    assert process(2.0) == [10.0, [0.0, 2.0, 4.0, 6.0, 8.0], True]
    assert process(3.0) == [15.0, [0.0, 3.0, 6.0, 9.0, 12.0], False]
    for note in Path(tmp_path, "native").glob("known-*.json"):
        note.write_text("{damaged")
    assert process(1.0)[0] == 5.0


@pytest.mark.thorough
def test_the_example_of_the_diagnoser_names_its_rotor(tmp_path):
    made = export_diagnoser(tmp_path, prefix="my")
    sources = [path.name for path in made if path.suffix == ".c" and path.name != "example.c"]
    text = (tmp_path / "CMakeLists.txt").read_text()
    assert f"add_library(my_diagnoser STATIC {' '.join(sources)})" in text and "example.c" in text
    subprocess.run(["gcc", *STRICT, "-O1", *sources, "example.c", "-o", "example", "-lm"], cwd=tmp_path, check=True)
    said = subprocess.run([str(tmp_path / "example")], capture_output=True, text=True, check=True).stdout
    assert "rotor 1 lost" in said and said.endswith("verdict: fault found\n")
