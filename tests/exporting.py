"""What the tests of exported C share: estimators with random measurements, compiled projects, single steps side by side."""

import ctypes
import functools
import subprocess

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.export_c import USUAL, prepare, program_of

jax = load_jax()
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
FLOAT = {"f": np.float32, "i": np.int32, "l": np.int64, "b": np.bool_}


@functools.cache
def estimator(name):
    """An estimator as it is exported by default; NAME-on-rates: on the plant that most have: its program is small."""
    method, _, rates = name.partition("-on-")
    return prepare(method, USUAL[1] if rates else None)


def measurements(method, rows, seed=0):
    """(u, y, valid) around what a healthy vehicle measures; what is not valid is NaN."""
    rng = np.random.default_rng(seed)
    system, n_u = method.system, method.system.n_u
    u = 0.5 + 0.05 * rng.standard_normal((rows, n_u))
    h = jax.jit(jax.vmap(lambda u: system.h(jax.numpy.asarray(system.x0, float), u, np.zeros(system.n_theta))))
    sd = np.sqrt(np.asarray(system.R(u[0]))) if hasattr(system, "R") else 0.05
    y = np.asarray(h(u)) + sd * rng.standard_normal((rows, system.n_y))
    valid = rng.random((rows, system.n_y)) > 0.05
    valid[rng.random(rows) < 0.02] = False
    return u, np.where(valid, y, np.nan), valid


def library(program, folder, *flags, cc="gcc"):
    """The project's source as a shared library, without a warning."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{program.name}.h").write_text(program.header)
    (folder / f"{program.name}.c").write_text(program.source)
    goal = folder / f"{program.name}.so"
    command = [cc, *STRICT, *flags, "-fPIC", "-shared", "-o", str(goal), str(folder / f"{program.name}.c"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr[:2000]
    return ctypes.CDLL(str(goal))


def struct(fields, real=np.float64):
    kinds = {**FLOAT, "f": real}
    return np.dtype([(f.name, kinds[f.kind], f.shape) for f in fields if f.size], align=True)


def address(array):
    return ctypes.c_void_p(array.ctypes.data)


def room(program):
    return np.zeros(program.workspace_bytes // 8 + 8)


@functools.cache
def exported(name):
    return program_of(estimator(name), name.replace("-", "_"))


@functools.cache
def flown(name):
    """Python's run over a table: (carries before each step, carries after, outputs)."""
    method = estimator(name)

    def step(carry, row):
        after, out = method.step(carry, *row)
        return after, (carry, after, out)

    return jax.jit(lambda table: jax.lax.scan(step, method.init(), table)[1])


def one_by_one(program, lib, table, before):
    """(carries after, outputs) of the C step, each from Python's carry before it: nothing adds up."""
    u, y, valid = (np.ascontiguousarray(a) for a in table)
    states, out = np.zeros(len(u), struct(program.state)), np.zeros(len(u), struct(program.out))
    for f, leaf in zip(program.state, jax.tree.leaves(before), strict=True):
        if f.size:
            states[f.name] = leaf
    step = getattr(lib, f"{program.name}_step")
    arrays = (states, u, y, valid, out)
    starts, sizes = [a.ctypes.data for a in arrays], [a.strides[0] for a in arrays]
    keep = room(program)
    work = address(keep)
    for k in range(len(u)):
        step(*(ctypes.c_void_p(start + k * size) for start, size in zip(starts, sizes)), work)
    return states, out


def worst(fields, structs, leaves, skip=()):
    """The largest difference of any leaf, relative to the largest value the leaf takes; name of that leaf. NaN must agree."""
    found = (0.0, "")
    for f, leaf in zip(fields, leaves, strict=True):
        if not f.size or f.name in skip:
            continue
        a, b = np.asarray(leaf, float), np.asarray(structs[f.name], float)
        if not np.array_equal(np.isnan(a), np.isnan(b)):
            return np.inf, f.name
        fine = np.isfinite(a) & np.isfinite(b)
        if not np.array_equal(a[~fine], b[~fine], equal_nan=True):
            return np.inf, f.name
        scale = max(np.abs(a[fine]).max(initial=0.0), 1e-300)
        found = max(found, (np.abs(a - b)[fine].max(initial=0.0) / scale, f.name))
    return found


def difference(name, program, lib, rows, seed=0):
    """The law's measure: single steps of C and of Python, over a flight."""
    table = measurements(estimator(name), rows, seed)
    before, after, out = flown(name)(table)
    states, said = one_by_one(program, lib, table, before)
    return max(worst(program.state, states, jax.tree.leaves(after)), worst(program.out, said, jax.tree.leaves(out)))
