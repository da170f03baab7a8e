"""Products with a constant that picks and scales rows (an identity, a diagonal, the measured states): no product at all.

What is known to be zero in such a constant contributes nothing, even where the other factor is infinite or NaN.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch_lab.compiling.c99 import zeros
from rotorwatch_lab.compiling.c99.graph import Axis, Graph, Node, identity, value
from rotorwatch_lab.compiling.c99.indices import regular


class Selection(NamedTuple):
    """Row i of the constant is factors[i] at the column start + step i, and zero elsewhere."""

    start: int
    step: int
    factors: np.ndarray


def selection(matrix: np.ndarray | None) -> Selection | None:
    """The selection that a (rows, columns) constant is, if it is one."""
    if matrix is None or matrix.ndim != 2 or not matrix.size or matrix.dtype.kind != "f":
        return None
    if not (np.count_nonzero(matrix, axis=1) == 1).all():
        return None
    columns = np.argmax(matrix != 0, axis=1)
    straight = regular(columns)
    if straight is None:
        return None
    return Selection(straight[0], straight[1][0], matrix[np.arange(len(matrix)), columns])


def product(graph: Graph, a: Node, b: Node) -> Node | None:
    """a @ b without a product for a (rows, inner), b (inner, ...), or b (inner, columns), a (..., inner), where a factor selects; and
    block by block where one is stacked of blocks that do; without its zeros where `a` is known to have many. None where nothing is so."""
    for left, first, second in ((True, a, b), (False, b, a)):
        axis = 0 if left else len(first.shape) - 1
        if len(first.shape) > 2 or (not left and len(first.shape) == 2 and len(second.shape) == 0):
            continue
        one = first.shape if len(first.shape) == 2 else None
        matrix = value(first)
        if matrix is not None:
            matrix = matrix[None] if one is None else matrix if left else matrix.T
        picked = selection(matrix)
        if picked is not None:
            return _picked(graph, picked, second, left, vector=one is None)
        if one is None:
            continue
        blocks = _blocks(graph, first, axis)
        if any(selection(value(p) if left else _turned(value(p))) is not None for p in blocks):
            parts = [_multiplied(graph, p, second) if left else _multiplied(graph, second, p) for p in blocks]
            return graph.concat(parts, 0 if left else len(parts[0].shape) - 1)
    return zeros.product(graph, a, b)


def _turned(matrix):
    return None if matrix is None else matrix.T


def _multiplied(graph: Graph, a: Node, b: Node) -> Node:
    result = product(graph, a, b)
    if result is not None:
        return result
    return graph.make("dot", (a, b), (*a.shape[:-1], *b.shape[1:]), a.kind, (0, 1))


def _blocks(graph: Graph, x: Node, axis: int) -> tuple[Node, ...]:
    """The parts of which x is stacked along an axis: a concatenation or its transpose."""
    if x.op == "concat" and x.data == axis:
        return x.args
    if x.op == "view" and x.args[0].op == "concat" and x.args[0].data == 1 - axis and len(x.args[0].shape) == 2:
        if x == graph.transposed(x.args[0], (1, 0)):
            return tuple(graph.transposed(p, (1, 0)) for p in x.args[0].args)
    return ()


def _picked(graph: Graph, s: Selection, x: Node, left: bool, vector: bool) -> Node:
    """Rows of x (left), or its last axis' columns, picked and scaled."""
    rank, along = len(x.shape), 0 if left else len(x.shape) - 1
    shape = tuple(len(s.factors) if k == along else n for k, n in enumerate(x.shape))
    axes = list(identity(shape))
    axes[along] = Axis(s.start, tuple(s.step * int(j == along) for j in range(rank)))
    picked = graph.view(x, shape, tuple(axes))
    if (s.factors != 1).any():
        factors = graph.broadcast(graph.const(s.factors), shape, (along,))
        picked = graph.elementwise("mul", factors, picked, kind=x.kind)
    if vector:
        picked = graph.reshaped(picked, tuple(n for k, n in enumerate(shape) if k != along))
        return picked if not picked.shape or zeros.in_rows(picked) else graph.stored(picked)
    return picked
