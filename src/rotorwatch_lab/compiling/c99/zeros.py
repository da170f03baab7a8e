"""Which elements of a value are zero whatever the inputs are, and products that leave those out.

Derivatives come with most of their elements zero: a plant's Jacobian is a sum of constants with few entries, scaled and stacked.
As with selections, what is known to be zero contributes nothing, even where the other factor is infinite or NaN.
"""

from __future__ import annotations

import numpy as np

from rotorwatch_lab.compiling.c99.graph import Graph, Node, axes_of, taken, value
from rotorwatch_lab.compiling.c99.indices import regular

MOST = 8192  # elements of a value that is looked at
SPARSE = 0.4  # share of elements that may be other than zero for a product to be written out term by term
TABLE, FEW = 64, 8  # a constant of that many elements is no table if only one in so many is other than zero
WIDE = 8  # columns of the other factor from which on that is worth its code
ZERO_AT_ZERO = {"copy", "neg", "abs", "sign", "sqrt", "sin", "tan", "asin", "atan", "sinh", "tanh", "asinh", "atanh", "expm1", "log1p",
                "floor", "ceil", "square", "to_f", "div"}  # fmt: skip


def pattern(graph: Graph, x: Node) -> np.ndarray:
    """Where x may be other than zero, a bool array of its shape."""
    known, todo = graph.patterns, [x]
    while todo:
        node = todo[-1]
        missing = [a for a in _seen_through(node) if a.index not in known]
        if missing:
            todo += missing
            continue
        todo.pop()
        known[node.index] = _pattern(node, [known[a.index] for a in _seen_through(node)])
    return known[x.index]


def _seen_through(x: Node) -> tuple[Node, ...]:
    """The arguments that determine the pattern of x."""
    if max([x.size, *(a.size for a in x.args)]) > MOST:
        return ()
    matrices = x.op == "dot" and x.data in ((0, 1), (1, 1)) and all(len(a.shape) <= 2 + x.data[0] for a in x.args)
    if matrices or x.op in ("view", "alias", "concat", "mul", "add", "sub"):
        return x.args
    if x.op == "select":
        return x.args
    if x.op == "scatter" and x.data[1] in ("add", "set") and (x.data[0] >= 0).all():
        return x.args
    return x.args[:1] if x.op in ZERO_AT_ZERO else ()


def _pattern(x: Node, args: list[np.ndarray]) -> np.ndarray:
    if x.op == "const":
        return x.data != 0
    if not args:
        return np.ones(x.shape, bool)
    if x.op == "view":
        return taken(args[0], x.shape, x.data)
    if x.op == "concat":
        return np.concatenate(args, axis=x.data)
    if x.op == "dot":
        a, b = (one.astype(int) for one in args)
        counts = np.einsum("bij,bj->bi", a, b) if x.data[0] and b.ndim == 2 else a @ b
        return np.asarray(counts, bool)
    if x.op == "mul":
        return args[0] & args[1]
    if x.op == "select":
        which = value(x.args[0])
        return args[1] | args[2] if which is None else np.where(which, args[2], args[1])
    if x.op == "scatter":
        nonzero = args[0].reshape(-1).copy()
        at, new = x.data[0].reshape(-1), args[1].reshape(-1)
        nonzero[at] = new if x.data[1] == "set" else nonzero[at] | new
        return nonzero.reshape(x.shape)
    return np.any(args, axis=0).reshape(x.shape)


def added(graph: Graph, x: Node, constant: Node) -> Node | None:
    """x + a constant that is zero but on a line (an identity, a diagonal of process noise): only that line is added; else None."""
    known = value(constant)
    if known is None or x.kind != "f" or x.shape != constant.shape or x.size < TABLE or x.op == "view" or graph.symmetric(x):
        return None
    at = np.flatnonzero(known)
    if regular(at) is None or at.size * FEW > x.size or value(x) is not None:
        return None
    line = graph.const(known.reshape(-1)[at])
    return graph.make("scatter", (x, line), x.shape, "f", (at, "add"), key=(at.tobytes(), "add"))


def diagonal(graph: Graph, x: Node) -> Node | None:
    """The diagonal (..., n) of a matrix, or of each of a batch, that is known to be zero beside it; else None."""
    rank = len(x.shape)
    if rank < 2 or x.shape[-1] != x.shape[-2] or x.size > MOST or pattern(graph, x)[..., ~np.eye(x.shape[-1], dtype=bool)].any():
        return None
    return graph.view(x, x.shape[:-1], axes_of(rank, rank - 1, lambda i, j: j == min(i, rank - 2)))


def cholesky(graph: Graph, x: Node) -> Node:
    """The lower factor of x: of a diagonal matrix the roots of its elements, NaN of what is not above zero."""
    line = diagonal(graph, x)
    if line is None:
        return graph.make("cholesky", (x,), x.shape, "f")
    above = graph.elementwise("gt", line, graph.const(np.float64(0.0)), kind="b")
    root = graph.elementwise("sqrt", line, kind="f")
    root = graph.elementwise("select", above, graph.const(np.float64(np.nan)), root, kind="f")
    rank = len(x.shape)
    here = graph.broadcast(graph.const(np.eye(x.shape[-1], dtype=bool)), x.shape, (rank - 2, rank - 1))
    none = graph.broadcast(graph.const(np.float64(0.0)), x.shape, ())
    return graph.elementwise("select", here, none, graph.broadcast(root, x.shape, range(rank - 1)), kind="f")


def solved(graph: Graph, a: Node, b: Node, how: tuple[bool, ...]) -> Node:
    """X of op(A) X = B or X op(A) = B; how: left, lower, transposed, unit diagonal."""
    line = diagonal(graph, a)
    if line is None:
        return graph.make("trisolve", (a, b), b.shape, "f", how)
    left, _, _, unit = how
    if unit:
        return b
    rank = len(b.shape)
    inverse = graph.elementwise("div", graph.const(np.float64(1.0)), line, kind="f")
    where = (*range(rank - 2), rank - 2 if left else rank - 1)
    return graph.elementwise("mul", b, graph.broadcast(inverse, b.shape, where), kind="f")


def product(graph: Graph, a: Node, b: Node, batch: int = 0) -> Node | None:
    """a @ b of matrices, or of `batch` axes of them, without the elements of a that are known to be zero: of a diagonal a the rows of b
    scaled; row by row where few are other than zero and b's rows are long; else None."""
    if len(a.shape) != 2 + batch or a.kind != "f" or batch > 1:
        return None
    line = diagonal(graph, a) if a.size >= TABLE else None
    if line is not None:
        return graph.elementwise("mul", graph.broadcast(line, b.shape, range(batch + 1)), b, kind="f")
    if len(b.shape) != 2 + batch or b.shape[-1] < WIDE or not in_rows(b):
        return None
    here = pattern(graph, a).reshape(-1, *a.shape[batch:]).max(axis=0)
    if here.sum() > SPARSE * here.size:
        return None
    many = a.shape[:batch]
    shape, origin = (*many, 1, b.shape[-1]), (0,) * batch
    rows = []
    for i, row in enumerate(here):
        sum_: Node | None = None
        for k in np.flatnonzero(row).tolist():
            one = graph.sliced(a, (*origin, i, k), (*many, i + 1, k + 1))
            factor = graph.broadcast(one, shape, range(len(shape)))
            term = graph.elementwise("mul", factor, graph.sliced(b, (*origin, k, 0), (*many, k + 1, shape[-1])), kind="f")
            sum_ = term if sum_ is None else graph.elementwise("add", sum_, term, kind="f")
        rows.append(graph.broadcast(graph.const(np.float64(0.0)), shape, ()) if sum_ is None else sum_)
    return graph.concat(rows, batch)


def in_rows(x: Node) -> bool:
    """True if neighbours along the last axis are contiguous in storage."""
    if x.op != "view":
        return True
    return bool(x.data) and x.data[-1].steps[-1] == 1 and all(axis.steps[-1] == 0 for axis in x.data[:-1])
