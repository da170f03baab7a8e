"""Run an estimator over a table of inputs: compiled once per size, in chunks of one length for every log."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from rotorwatch.backend import jax as load_jax

CHUNK = 1024


@functools.lru_cache(maxsize=32)
def _program(build: Callable, select: Callable):
    jax = load_jax()

    @jax.jit
    def chunk(parameters, carry, u, y, valid):
        estimator = build(parameters)

        def step(carry, row):
            carry, out = estimator.step(carry, *row)
            return carry, select(out)

        return jax.lax.scan(step, carry, (u, y, valid))

    return chunk


def everything(out):
    """The default selection: all of what a step returns."""
    return out


def run(build: Callable, parameters, u, y, valid, select: Callable = everything, progress=None, carry=None):
    """Step build(parameters) over T rows: u (T, n_u), y (T, n_y), valid (T, n_y) bool.

    build: a function of `parameters` (a pytree of arrays) that returns an estimator; it and `select` (what to keep of each
    step) are compiled once per array shape, so give the same function objects again. Returns the last carry and the
    stacked selections, as NumPy arrays. progress: called with the finished share, 0..1.
    """
    jax = load_jax()
    u, y, valid = np.asarray(u, float), np.asarray(y, float), np.asarray(valid, bool)
    parameters = jax.tree.map(np.asarray, parameters)
    if carry is None:
        carry = build(parameters).init()
    program = _program(build, select)
    count, parts, new_carry = len(u), [], carry
    for start in range(0, max(count, 1), CHUNK):
        rows = [a[start : start + CHUNK] for a in (u, y, valid)]
        size = len(rows[0])
        if size < CHUNK:  # a padded tail keeps one program for all lengths; its carry is not the flight's any more
            rows = [np.concatenate([a, np.zeros((CHUNK - size, *a.shape[1:]), a.dtype)]) for a in rows]
        new_carry, out = program(parameters, carry, *rows)
        if size == CHUNK:
            carry = new_carry
        parts.append(jax.tree.map(lambda a, size=size: np.asarray(a)[:size], out))
        if progress:
            progress(min(1.0, (start + size) / max(count, 1)))
    return new_carry, jax.tree.map(lambda *a: np.concatenate(a), *parts)
