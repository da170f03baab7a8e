"""Published estimators over all flights of a batch side by side, each with every decision of the plan behind it.

What `published.assess` does flight by flight - the hop's plant, the method, the threshold of published/decide.py - is done here in
one compiled loop: the estimator is stepped once, and as many thresholds as the plan names look at it. On a processor with a C compiler that
is native code, which is built once for a method and a number of rotors; on an accelerator a scan over flights side by side. Methods whose
design needs values (linear matrix inequalities, eigenvalues) cannot be built inside a program; they run flight by flight.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import Ticks, list_hypotheses, program
from rotorwatch_lab.compiling.run import engine, run, run_built
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.published import published
from rotorwatch_lab.published.log_plant import LogPlant
from rotorwatch_lab.published.published import Decisions

TICK_BLOCK = 100
"""Tables are padded to a multiple of this, so that a flight's few ticks more or less need no other program."""
CACHE_BYTES = 2_500_000
"""Of the estimators' states that a processor keeps at hand: larger batches are slower, not faster."""


def side_by_side(carry: Any, size: int) -> int:
    """How many of `size` flights (a power of two) the estimator with this state steps at once."""
    tree = load_jax().tree
    each = sum(np.asarray(leaf).nbytes for leaf in tree.leaves(carry))
    if load_jax().default_backend() == "cpu":
        while size > 1 and size % 2 == 0 and size * each > CACHE_BYTES:
            size //= 2
    return size


def stacked(tables: Sequence[tuple[np.ndarray, ...]], size: int) -> tuple[np.ndarray, ...]:
    """Tables of flights (each some arrays of as many rows), flights first: filled up with rows of zeros and with the last flight."""
    longest = max(len(table[0]) for table in tables)
    length = -(-longest // TICK_BLOCK) * TICK_BLOCK

    def fill(a: np.ndarray) -> np.ndarray:
        return np.concatenate([a, np.zeros((length - len(a), *a.shape[1:]), a.dtype)])

    rows = [tuple(map(fill, table)) for table in tables]
    rows += [rows[-1]] * (size - len(rows))
    return tuple(np.stack(parts) for parts in zip(*rows, strict=True))


@functools.lru_cache(maxsize=32)
def _program(name: str, dt: float, decisions: Decisions):
    """Compiled: parameters of the plants and tables (flights first), B -> stacked `published.Seen`, one per decision."""
    jax = load_jax()

    def single(plant, B, u, y, valid):
        estimator = published.watched(name, dt, (), decisions, {"plant": plant, "B": B})
        return tools.stepped(estimator, u, y, published.seen, valid)

    return jax.jit(jax.vmap(single, in_axes=(0, None, 0, 0, 0)))


def run_hops(name: str, hops: Sequence[LogPlant], B: np.ndarray, size: int, decisions: Decisions) -> list[tuple]:
    """For each hop the `published.Seen` of each decision. Raises ConfigError for a method that the plant does not suit.

    size: width that the batch is filled up to, so that a hop's result does not depend on which it runs with.
    """
    jax, dt = load_jax(), hops[0].dt
    build, parameters = published.builder(name, dt, (), decisions), [{"plant": hop.parameters, "B": B} for hop in hops]
    example = build(parameters[0])  # with values: says what is wrong
    try:
        if engine() == "native":
            ran = [run_built(build, p, h.u, h.y, h.valid, published.seen, backend="auto") for h, p in zip(hops, parameters)]
            return [out for _, out in ran]
        return _side_by_side(_program(name, dt, decisions), side_by_side(example.init(), size), hops, B, size)
    except (jax.errors.JAXTypeError, ConfigError):  # design work that needs values: compiled for each flight alone
        return [run(build(p), h.u, h.y, h.valid, published.seen)[1] for h, p in zip(hops, parameters, strict=True)]


def _side_by_side(program, step: int, hops: Sequence[LogPlant], B: np.ndarray, size: int) -> list[tuple]:
    """Outputs of a `_program` for each hop, `step` hops at once."""
    tree, results = load_jax().tree, []
    rows = stacked([(hop.u, hop.y, hop.valid) for hop in hops], size)
    plants = [hop.parameters for hop in hops]
    plants += [plants[-1]] * (size - len(plants))
    plants = tree.map(lambda *leaves: np.stack([np.asarray(leaf, float) for leaf in leaves]), *plants)
    for start in range(0, len(hops), step):
        part = slice(start, start + step)
        out = program(tree.map(lambda a, part=part: a[part], plants), B, *(a[part] for a in rows))
        out = tree.map(np.asarray, out)
        lengths = [len(hop.u) for hop in hops[part]]
        results += [tree.map(lambda a, k=k, n=n: a[k, :n], out) for k, n in enumerate(lengths)]
    return results


def assess(
    name: str, tables: Sequence[Ticks], hops: Sequence[Sequence[LogPlant]], B: np.ndarray, size: int, decisions: Decisions
) -> list[list[program.TickOutput]]:
    """Output of `published.assess` for each decision and each flight. hops: of each flight, by `log_plant.hops`."""
    hyp = list_hypotheses(B.shape[1])
    outputs = [[program.blank(len(table.time), hyp) for table in tables] for _ in decisions]
    for turn in range(max(map(len, hops), default=0)):
        here = [k for k, found in enumerate(hops) if len(found) > turn]
        for k, found in zip(here, run_hops(name, [hops[k][turn] for k in here], B, size, decisions), strict=True):
            for which, seen in enumerate(found):
                published.record(outputs[which][k], seen, hops[k][turn], hyp, B)
    return outputs
