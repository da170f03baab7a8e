"""The graph of a traced function: each value once, constants folded, slices, transposes and broadcasts as affine views.

A value of shape (s_0, s_1, ...) is a `Node`. A view's element (i_0, i_1, ...) is its root's element whose index along each of
the root's axes is  c + sum_j m_j i_j:  `Axis(c, (m_0, m_1, ...))`. Views of views are composed, so a view's root is no view.
Loops and branches are regions of their own: a node belongs to the innermost region whose parameters it depends on, which
takes what does not change out of loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rotorwatch_lab.compiling.c99.operations import ELEMENTWISE, NUMPY, kind

MOST_FOLDED = 200_000  # elements
MANY = 8  # rows from which on a table is kept column by column


class Axis(NamedTuple):
    """Index along one axis of the root: start + sum of steps[j] i_j over the view's axes."""

    start: int
    steps: tuple[int, ...]


class Region:
    """Where a node is computed: the whole function (depth 0), or the inside of a loop or branch."""

    def __init__(self, parent: Region | None = None):
        self.parent = parent
        self.depth: int = 0 if parent is None else parent.depth + 1

    def within(self, other: Region) -> bool:
        """True if this region is `other` or nested inside it."""
        here: Region | None = self
        while here is not None and here is not other:
            here = here.parent
        return here is other


class Node:
    """A value of the graph. kind: f, i, l or b (operations.TYPES); data: parameters of the operation besides its arguments."""

    __slots__ = ("args", "data", "index", "kind", "op", "region", "shape", "source")

    def __init__(self, op, args, shape, kind, data, region, source, index):
        self.op: str = op
        self.args: tuple[Node, ...] = args
        self.shape: tuple[int, ...] = shape
        self.kind: str = kind
        self.data: Any = data
        self.region: Region = region
        self.source: str = source
        self.index: int = index

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def __repr__(self):
        return f"%{self.index}:{self.kind}{list(self.shape)} = {self.op}({', '.join(f'%{a.index}' for a in self.args)})"


def axes_of(count: int, width: int, step: Callable[[int, int], Any], start: Callable[[int], int] = lambda i: 0):
    """The axes of a view: index i of `count` starts at start(i) and goes step(i, j) for axis j of `width`."""
    return tuple(Axis(int(start(i)), tuple(int(step(i, j)) for j in range(width))) for i in range(count))


def identity(shape: tuple[int, ...]) -> tuple[Axis, ...]:
    """Axes of the view that leaves every element in place."""
    return axes_of(len(shape), len(shape), lambda i, j: i == j)


def composed(outer: tuple[Axis, ...], inner: tuple[Axis, ...], width: int) -> tuple[Axis, ...]:
    """The view `outer` of the view `inner`; width: axes of the outer one."""

    def one(axis: Axis) -> Axis:
        start = axis.start + sum(m * o.start for m, o in zip(axis.steps, outer))
        return Axis(start, tuple(sum(m * o.steps[j] for m, o in zip(axis.steps, outer)) for j in range(width)))

    return tuple(one(axis) for axis in inner)


def strides(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Strides of a row-major array, in elements."""
    return tuple(math.prod(shape[k + 1 :]) for k in range(len(shape)))


def flat(axes: tuple[Axis, ...], root_shape: tuple[int, ...], width: int) -> tuple[int, tuple[int, ...]]:
    """(offset, steps) of a view in the row-major storage of its root."""
    s = strides(root_shape)
    steps = tuple(sum(k * axis.steps[j] for k, axis in zip(s, axes)) for j in range(width))
    return sum(k * axis.start for k, axis in zip(s, axes)), steps


class Graph:
    """Builds nodes; equal nodes are shared."""

    def __init__(self):
        self.nodes: list[Node] = []
        self.top = Region()
        self.source = ""
        self._known: dict[Any, Node] = {}
        self._symmetric: dict[int, bool] = {}
        self.patterns: dict[int, np.ndarray] = {}  # of zeros.py

    def make(self, op, args, shape, kind, data=None, key=None, region=None) -> Node:
        """A node, or the equal one that exists already unless key is False. key: replaces data in the comparison."""
        shape = tuple(int(n) for n in shape)
        if region is None:
            region = max((a.region for a in args), key=lambda r: r.depth, default=self.top)
        known = None
        if key is not False:
            known = (op, tuple(a.index for a in args), shape, kind, data if key is None else key)
            if known in self._known:
                return self._known[known]
        node = Node(op, tuple(args), shape, kind, data, region, self.source, len(self.nodes))
        self.nodes.append(node)
        if known is not None:
            self._known[known] = node
        return node

    def const(self, value) -> Node:
        """A constant; one that is the same everywhere is a broadcast scalar."""
        value = np.asarray(value)
        value = np.ascontiguousarray(value, NUMPY[kind(value.dtype)]).reshape(value.shape)
        if value.size > 1 and value.tobytes() == np.broadcast_to(value.flat[0], value.shape).tobytes():
            return self.broadcast(self.const(value.flat[0].reshape(())), value.shape, ())
        return self.make("const", (), value.shape, kind(value.dtype), value, key=value.tobytes())

    def param(self, shape, kind, data, region: Region | None = None) -> Node:
        """An input of the function or of a region."""
        return self.make("param", (), shape, kind, data, key=False, region=region or self.top)

    def elementwise(self, name: str, *args: Node, kind: str) -> Node:
        """An operation of `ELEMENTWISE` on arguments of one shape; scalars and axes of length 1 are broadcast."""
        rank = max(len(a.shape) for a in args)
        shape = tuple(max(sizes) for sizes in zip(*(a.shape for a in args if len(a.shape) == rank)))
        args = tuple(a if a.shape == shape else self.broadcast(a, shape, range(len(a.shape))) for a in args)
        simple = self._simplified(name, args, kind)
        if simple is not None:
            return simple
        known = values(*args)
        if known is not None and math.prod(shape) <= MOST_FOLDED:
            with np.errstate(all="ignore"):
                return self.const(np.asarray(ELEMENTWISE[name].fold(*known), NUMPY[kind]))
        order = _common_order(args)
        if order is None and _tall(shape) and all(_order(a) is None for a in args):
            order = (1, 0)
        if order is not None:  # computed as it lies in storage, and read turned
            turned = self.elementwise(name, *(self.transposed(a, order) for a in args), kind=kind)
            return self.transposed(turned, _inverse(order))
        return self.make(name, args, shape, kind)

    def _simplified(self, name, args, kind) -> Node | None:
        """Removes operations without effect, as derivatives and masks produce them."""
        if name == "copy" or name == f"to_{args[0].kind}":
            return args[0]
        if name in ("mul", "add") and kind in "fil":
            for one, other in (args, args[::-1]):
                if uniform(one) == (1 if name == "mul" else 0):
                    return other
        if name in ("sub", "div") and kind in "fil" and uniform(args[1]) == (0 if name == "sub" else 1):
            return args[0]
        if name in ("mul", "div") and args[0].op == "add" and args[0].args[0] is args[0].args[-1]:
            if uniform(args[1]) == {"mul": 0.5, "div": 2}[name]:
                return args[0].args[0]  # (x + x) / 2
        if name == "mul" and args[1].op == "add" and args[1].args[0] is args[1].args[1] and uniform(args[0]) == 0.5:
            return args[1].args[0]
        if name == "div" and kind == "f":
            return self._divided(*args)
        if name == "select":
            which, no, yes = args
            if no is yes:
                return no
            if uniform(which) is not None:
                return yes if uniform(which) else no
            mask = value(which) if yes.op == "cholesky" else None
            lower = mask is not None and mask.ndim == 2 and np.array_equal(mask, np.tril(np.ones_like(mask)))
            if lower and yes.op == "cholesky" and uniform(no) == 0:
                return yes  # the factor's upper part is zero already
        return None

    def _divided(self, x: Node, by: Node) -> Node | None:
        """x / by as XLA computes it, with a single division where the divisor is constant or the same for all elements."""
        one, known = self.const(np.float64(1.0)), value(by)
        if values(x) is not None:
            return None
        if known is not None:
            with np.errstate(all="ignore"):
                return self.elementwise("mul", x, self.const(1.0 / known), kind="f")
        if by.op == "view" and by.size > 1 and not any(any(axis.steps) for axis in by.data):
            same = self.view(by.args[0], (), tuple(Axis(axis.start, ()) for axis in by.data))
            inverse = self.elementwise("div", one, same, kind="f")
            return self.elementwise("mul", x, self.broadcast(inverse, by.shape, ()), kind="f")
        return None

    # Views.

    def view(self, x: Node, shape: tuple[int, ...], axes: tuple[Axis, ...]) -> Node:
        """Elements of x where `axes` says."""
        shape = tuple(int(n) for n in shape)
        axes = tuple(Axis(a.start, tuple(m if n > 1 else 0 for m, n in zip(a.steps, shape))) for a in axes)
        if x.op == "view":
            x, axes = x.args[0], composed(axes, x.data, len(shape))
        if x.op == "concat":
            piece = self._piece(x, shape, axes)
            if piece is not None:
                return piece
        if shape == x.shape and all(
            axis.start == 0 and all(m == int(i == j) or shape[j] == 1 for j, m in enumerate(axis.steps)) for i, axis in enumerate(axes)
        ):
            return x
        if x.op == "const" and math.prod(shape) <= x.size > 1:
            return self.const(taken(x.data, shape, axes))
        return self.make("view", (x,), shape, x.kind, axes)

    def _piece(self, x: Node, shape, axes) -> Node | None:
        """A view of a concatenation that stays within one of its pieces."""
        along, at = axes[x.data], 0
        low = along.start + sum(min(0, m * (n - 1)) for m, n in zip(along.steps, shape))
        high = along.start + sum(max(0, m * (n - 1)) for m, n in zip(along.steps, shape))
        for piece in x.args:
            size = piece.shape[x.data]
            if at <= low and high < at + size:
                moved = tuple(Axis(a.start - at, a.steps) if k == x.data else a for k, a in enumerate(axes))
                return self.view(piece, shape, moved)
            at += size
        return None

    def broadcast(self, x: Node, shape, where) -> Node:
        """x's axis i becomes axis where[i] of the result."""
        return self.view(x, shape, axes_of(len(x.shape), len(shape), lambda i, j: j == where[i] and x.shape[i] > 1))

    def sliced(self, x: Node, start, stop, step=None) -> Node:
        step = step or (1,) * len(start)
        shape = tuple(-(-(b - a) // s) for a, b, s in zip(start, stop, step))
        return self.view(x, shape, axes_of(len(start), len(shape), lambda i, j: step[i] * (i == j), lambda i: start[i]))

    def transposed(self, x: Node, order) -> Node:
        """Axis j of the result is axis order[j] of x."""
        if tuple(order) == (1, 0) and self.symmetric(x):
            return x
        return self._turned(x, order)

    def _turned(self, x: Node, order=(1, 0)) -> Node:
        shape = tuple(x.shape[k] for k in order)
        return self.view(x, shape, axes_of(len(order), len(order), lambda i, j: order[j] == i))

    def symmetric(self, x: Node) -> bool:
        """True if x provably equals its own transpose to the last bit: A + A', and element-wise functions of such values."""
        if len(x.shape) != 2 or x.shape[0] != x.shape[1]:
            return False
        known = value(x)
        if known is not None:
            return np.array_equal(known, known.T)
        if x.op not in ELEMENTWISE:
            return False
        if x.index not in self._symmetric:
            one, other = x.args[0], x.args[-1]
            if x.op in ("add", "mul") and other.op == "view" and other == self._turned(one):
                symmetric = True
            elif x.op == "select" and (mask := value(one)) is not None and not (mask & ~np.eye(len(mask), dtype=bool)).any():
                symmetric = self.symmetric(x.args[1])  # only the diagonal comes from elsewhere
            else:
                symmetric = all(self.symmetric(a) for a in x.args)
            self._symmetric[x.index] = symmetric
        return self._symmetric[x.index]

    def reversed(self, x: Node, dimensions) -> Node:
        ends = [n - 1 if i in dimensions else 0 for i, n in enumerate(x.shape)]
        steps = [-1 if i in dimensions else 1 for i in range(len(x.shape))]
        axes = axes_of(len(ends), len(ends), lambda i, j: steps[i] * (i == j), lambda i: ends[i])
        return self.view(x, x.shape, axes)

    def reshaped(self, x: Node, shape) -> Node:
        """A view where only axes of length 1 come or go; else the same storage read in another shape."""
        shape = tuple(int(n) for n in shape)
        if shape == x.shape:
            return x
        if uniform(x) is not None:
            return self.broadcast(self.const(np.asarray(uniform(x), NUMPY[x.kind])), shape, ())
        if x.op == "const":
            return self.const(x.data.reshape(shape))
        long = [j for j, n in enumerate(shape) if n > 1]
        old = [i for i, n in enumerate(x.shape) if n > 1]
        if [shape[j] for j in long] == [x.shape[i] for i in old]:
            place = dict(zip(old, long))
            return self.view(x, shape, axes_of(len(x.shape), len(shape), lambda i, j: place.get(i) == j))
        root = self.stored(x)
        root = root.args[0] if root.op == "alias" else root
        return root if root.shape == shape else self.make("alias", (root,), shape, x.kind)

    def stored(self, x: Node) -> Node:
        """x with row-major storage of its own: a copy of a view."""
        return self.make("copy", (x,), x.shape, x.kind) if x.op == "view" else x

    def concat(self, parts, dimension: int) -> Node:
        parts = _joined(self, [p for p in parts if p.size], dimension)
        if len(parts) == 1:
            return parts[0]
        shape = list(parts[0].shape)
        shape[dimension] = sum(p.shape[dimension] for p in parts)
        known = values(*parts)
        if known is not None and math.prod(shape) <= MOST_FOLDED:
            return self.const(np.concatenate(known, axis=dimension))
        order = _common_order(parts)
        if order is None and dimension == 1 and len(shape) == 2 and shape[0] >= MANY and all(p.shape[1] == 1 for p in parts):
            order = (1, 0)  # columns of a batch, each kept together
        if order is not None:
            turned = self.concat([self.transposed(p, order) for p in parts], order.index(dimension))
            return self.transposed(turned, _inverse(order))
        return self.make("concat", tuple(parts), shape, parts[0].kind, dimension)


def _tall(shape) -> bool:
    """True if a table is best stored column by column: one value for each member of a batch, whose values are read together."""
    return len(shape) == 2 and shape[0] >= MANY > shape[1]


def _order(x: Node) -> tuple[int, ...] | None:
    """Axes of x from slowest to fastest in storage; None where the order does not matter: a constant, or equal along an axis."""
    long = [j for j, n in enumerate(x.shape) if n > 1]
    if len(long) < 2 or value(x) is not None:
        return None
    used = [j for axis in x.data for j, m in enumerate(axis.steps) if m] if x.op == "view" else long
    if sorted(used) != long:
        return None if set(used) != set(long) else tuple(range(len(x.shape)))
    fast = iter(used)
    return tuple(next(fast) if n > 1 else j for j, n in enumerate(x.shape))


def _common_order(nodes) -> tuple[int, ...] | None:
    """The storage order shared by all nodes, if it is not row-major."""
    orders = {order for order in map(_order, nodes) if order is not None}
    order = orders.pop() if len(orders) == 1 else ()
    return None if order == tuple(range(len(order))) else order


def _inverse(order: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(order.index(k) for k in range(len(order)))


def _joined(graph: Graph, parts: list[Node], dimension: int) -> list[Node]:
    """Merge neighbouring slices of one value."""
    out: list[Node] = []
    for part in parts:
        previous = out[-1] if out else None
        if previous is not None and previous.op == part.op == "view" and previous.args == part.args:
            n = previous.shape[dimension]
            follows = all(a.steps == b.steps and b.start - a.start == n * a.steps[dimension] for a, b in zip(previous.data, part.data))
            if follows and any(a.steps[dimension] for a in previous.data):
                size = n + part.shape[dimension]
                shape = tuple(size if k == dimension else m for k, m in enumerate(previous.shape))
                out[-1] = graph.view(previous.args[0], shape, previous.data)
                continue
        out.append(part)
    return out


def value(x: Node) -> np.ndarray | None:
    """The value of a constant node, else None."""
    if x.op == "const":
        return x.data
    if x.op == "view" and x.args[0].op == "const" and x.size <= MOST_FOLDED:
        return taken(x.args[0].data, x.shape, x.data)
    return None


def values(*nodes: Node) -> list[np.ndarray] | None:
    """The values of constant nodes, or None if one of them is not constant."""
    known = [v for v in map(value, nodes) if v is not None]
    return known if len(known) == len(nodes) else None


def uniform(x: Node):
    """The number that all elements of a constant equal, or None."""
    if x.op == "view":
        x = x.args[0]
    return x.data.reshape(-1)[0].item() if x.op == "const" and x.size == 1 else None


def taken(a: np.ndarray, shape, axes) -> np.ndarray:
    """The elements that a view selects, by NumPy."""
    offset, steps = flat(axes, a.shape, len(shape))
    index = np.full(shape, offset)
    for j, (n, m) in enumerate(zip(shape, steps)):
        index += (np.arange(n) * m).reshape([-1 if k == j else 1 for k in range(len(shape))])
    return a.reshape(-1)[index].reshape(shape)
