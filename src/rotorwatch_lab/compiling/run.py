"""Run an estimator over a table of inputs: compiled once per size, in chunks of one length for every log."""

from __future__ import annotations

import functools
import inspect
import os
import warnings
from collections.abc import Callable

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.compiling import toolchain
from rotorwatch.errors import BackendWarning, ConfigError
from rotorwatch_lab.compiling import native

CHUNK = 1024
BACKENDS = ("jax", "native", "auto")


def chosen(backend: str | None, usual: str) -> str:
    """The backend asked for, else $ROTORWATCH_BACKEND, else the usual one. Raises ConfigError for one that does not exist."""
    backend = backend or os.environ.get("ROTORWATCH_BACKEND") or usual
    if backend not in BACKENDS:
        raise ConfigError(f"backend must be 'jax', 'native' or 'auto', not {backend!r}.")
    return backend


def engine() -> str:
    """The default backend for many flights: "native" C code on a processor with a C compiler, one flight after the other; else, or with
    $ROTORWATCH_BACKEND=jax, "jax", side by side. Results of the two differ in their last digits."""
    if load_jax().default_backend() != "cpu" or chosen(None, "auto") == "jax":
        return "jax"
    try:
        toolchain.compiler()
    except native.Unavailable:
        return "jax"
    return "native"


@functools.lru_cache(maxsize=32)
def _program(build: Callable, select: Callable):
    jax = load_jax()

    @jax.jit
    def chunk(parameters, carry, u, y, valid, size):
        estimator = build(parameters)

        def step(carry, numbered):
            k, row = numbered
            new, out = estimator.step(carry, *row)
            carry = jax.tree.map(lambda a, b: jax.numpy.where(k < size, a, b), new, carry)  # padding leaves no trace
            return carry, select(out)

        return jax.lax.scan(step, carry, (jax.numpy.arange(len(u)), (u, y, valid)))

    return chunk


def everything(out):
    """The default selection: all of what a step returns."""
    return out


def run(estimator, u, y, valid=None, select: Callable = everything, progress=None, carry=None, backend: str | None = None, dt=None):
    """Step one estimator over T rows.

    estimator: an object with `init` and `step`. u (T, n_u): inputs. y (T, n_y): measurements. valid (T, n_y): bool; None: all of y that
    is finite.
    A row's u is held over its step, and its y is measured at the end of that step: the first y belongs one step after x0. dt: s, one
    number or (T,), the length of each row's step, for estimators whose `step` takes it; None: what the estimator was made for.

    select: what to keep of each output, as a function; None: all of it. Returns (last carry, stacked outputs), as NumPy arrays.
    Compiled once for the estimator object: run the same object again for further flights. progress: called with the finished share,
    0..1. carry: where an earlier run ended, to go on from there. backend: "jax", or "native": C, built once by the system's compiler
    and kept (docs/export.md), without a compiler JAX, after a BackendWarning; "auto": the same without one; None: what
    $ROTORWATCH_BACKEND says, else "jax". Raises ConfigError for tables of the wrong shape or type, and for a plant or a method whose
    parts do not fit together.
    """
    u, y = _floats("u", u), _floats("y", y)
    valid = np.isfinite(y) if valid is None else np.asarray(valid, bool)
    system = getattr(estimator, "system", None)
    rows = len(u) if u.ndim else 0
    for name, table, width in (("u", u, getattr(system, "n_u", None)), ("y", y, getattr(system, "n_y", None))):
        if table.ndim != 2 or len(table) != rows or (width is not None and table.shape[1] != width):
            expected = f"({rows}, {width if width is not None else 'n'})"
            raise ConfigError(f"{name} must have the shape {expected}, a row per time step, not {table.shape}.")
    if valid.shape != y.shape:
        raise ConfigError(f"valid must have the shape of y, {y.shape}, not {valid.shape}.")
    timed = dt is not None
    if timed:
        if "dt" not in inspect.signature(estimator.step).parameters:
            name = getattr(estimator, "name", type(estimator).__name__)
            raise ConfigError(f"{name} takes no dt: it runs in steps of the length that it was made for.")
        seconds = checks.positive("dt", _floats("dt", dt))
        if seconds.shape not in ((), (rows,)):
            raise ConfigError(f"dt must be one number or have the shape ({rows},), not {seconds.shape}.")
        u = np.column_stack([u, np.broadcast_to(seconds, rows)])
    try:
        return run_built(_Same(estimator, timed), (), u, y, valid, select, progress, carry, backend)
    except (TypeError, ValueError, AttributeError, IndexError) as why:  # JAX's errors are TypeErrors
        if system is not None and not isinstance(why, ConfigError):
            checks.plant(system)
        if isinstance(why, load_jax().errors.JAXTypeError):
            name = getattr(estimator, "name", type(estimator).__name__)
            raise ConfigError(checks.untraceable(f"step of {name}", why)) from why
        raise


def _floats(name: str, values) -> np.ndarray:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise ConfigError(f"{name} must be a table of numbers with rows of one length.") from None


class _Same:
    """A build function that always returns the one estimator; equal for the same object, so that it is compiled once. timed: u has a last
    column that says how long the row's step is."""

    def __init__(self, estimator, timed: bool = False):
        self.estimator, self.timed = estimator, timed

    def __call__(self, _):
        return _Timed(self.estimator) if self.timed else self.estimator

    def __hash__(self):
        return hash((id(self.estimator), self.timed))

    def __eq__(self, other):
        return isinstance(other, _Same) and other.estimator is self.estimator and other.timed == self.timed


class _Timed:
    """An estimator whose u has a last column: the length of the row's step [s]."""

    def __init__(self, estimator):
        self.estimator = estimator

    def init(self):
        return self.estimator.init()

    def step(self, carry, u, y, valid):
        return self.estimator.step(carry, u[:-1], y, valid, u[-1])


def run_built(
    build: Callable, parameters, u, y, valid, select: Callable = everything, progress=None, carry=None, backend: str | None = None
):
    """The same for an estimator that is built inside the compiled program: build(parameters).

    build: a function of `parameters` (a pytree of arrays) that returns an estimator; it and `select` (what to keep of each
    step) are compiled once per array shape, so give the same function objects again: one program serves every airframe
    with as many rotors.
    """
    u, y, valid = np.asarray(u, float), np.asarray(y, float), np.asarray(valid, bool)
    backend = chosen(backend, "jax")
    if backend != "jax":
        try:
            library = native.prepared(build, select, parameters, (u.shape[1], y.shape[1]))
            start = build(parameters).init() if carry is None else carry
            return native.run(library, parameters, start, u, y, valid, progress)
        except native.Unmakeable:
            raise
        except ConfigError as why:  # without a compiler, or a method that cannot be C
            if backend == "native" and not isinstance(why, native.Unavailable):
                raise
            if backend == "native":
                warnings.warn(f"{why} JAX runs instead.", BackendWarning, stacklevel=3)
    jax = load_jax()
    parameters = jax.tree.map(np.asarray, parameters)
    if carry is None:
        carry = build(parameters).init()
    program = _program(build, select)
    count, parts = len(u), []
    for start in range(0, max(count, 1), CHUNK):
        rows = [a[start : start + CHUNK] for a in (u, y, valid)]
        size = len(rows[0])
        if size < CHUNK:  # a padded tail keeps one program for all lengths
            rows = [np.concatenate([a, np.zeros((CHUNK - size, *a.shape[1:]), a.dtype)]) for a in rows]
        carry, out = program(parameters, carry, *rows, size)
        parts.append(jax.tree.map(lambda a, size=size: np.asarray(a)[:size], out))
        if progress:
            progress(min(1.0, (start + size) / max(count, 1)))
    return carry, jax.tree.map(lambda *a: np.concatenate(a), *parts)


def stepper(build: Callable) -> Callable:
    """Compiled (parameters, carry, u (T, n_u), y (T, n_y)) -> (carry, outputs) of the steps of build(parameters): by `engine`. Unlike
    `run_built` with JAX it makes a program for each T: for tables that are short, or of one length."""
    if engine() == "native":
        return lambda parameters, carry, u, y: run_built(build, parameters, u, y, np.ones(y.shape, bool), carry=carry, backend="native")
    jax = load_jax()

    def over(parameters, carry, u, y):
        one, valid = build(parameters), jax.numpy.ones(y.shape[1], bool)
        return jax.lax.scan(lambda state, row: one.step(state, *row, valid), carry, (u, y))

    return jax.jit(over)
