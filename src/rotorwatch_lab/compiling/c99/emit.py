"""A planned graph as C99 statements: one loop nest per stored value, what is read once written inside its reader's loop."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rotorwatch_lab.compiling.c99 import kernels
from rotorwatch_lab.compiling.c99.graph import Axis, Node, Region, composed, flat, identity, strides, uniform
from rotorwatch_lab.compiling.c99.indices import regular
from rotorwatch_lab.compiling.c99.lower import Branches, Loop
from rotorwatch_lab.compiling.c99.operations import ELEMENTWISE, TYPES
from rotorwatch_lab.compiling.c99.plan import Place, Plan

NAMES = "ijklmnpq"
START = {
    "sum": {"f": "R(0.0)", "i": "0", "l": "0", "b": "false"},
    "prod": {"f": "R(1.0)", "i": "1", "l": "1", "b": "true"},
    "max": {"f": "-(real)INFINITY", "i": "INT32_MIN", "l": "INT64_MIN", "b": "false"},
    "min": {"f": "(real)INFINITY", "i": "INT32_MAX", "l": "INT64_MAX", "b": "true"},
    "and": {"b": "true"},
    "or": {"b": "false"},
}
# Limits of single precision, beyond which constants cannot be written out for it.
LEAST, MOST = 2.0**-149, float(np.finfo(np.float32).max)
COMBINE = {"sum": "add", "prod": "mul", "max": "max", "min": "min", "and": "and", "or": "or"}


class Leaf:
    """A read of stored elements: base[offset + steps . loop variables (+ run-time terms)]."""

    def __init__(self, place: Place, offset: int, steps: tuple[int, ...], extra: tuple[tuple[Any, int, int], ...] = ()):
        self.place, self.offset, self.steps, self.extra = place, offset, list(steps), extra


class Emitter:
    """Statements of one function. tables: constants it reads; kernels: functions it calls, by name."""

    def __init__(self, plan: Plan):
        self.plan = plan
        self.lines: list[str] = []
        self.tables: dict[int, Node] = {}
        self.lists: dict[str, tuple[str, str]] = {}  # index tables: text -> (name, declaration)
        self.kernels: dict[str, str] = {}
        self.depth = 1
        self.bases: set[str] = set()

    def function_body(self) -> list[str]:
        """Statements of the whole function, the outputs last."""
        self._region(self.plan.top)
        for out, (place, also_input) in zip(self.plan.outputs, self.plan.targets):
            root = out.args[0] if out.op == "alias" else out
            if out is also_input or (root.op != "view" and self.plan.place.get(root.index) == place):
                continue
            self._store(out, place)
        return self.lines

    def line(self, text: str):
        self.lines.append("    " * self.depth + text)

    # Expressions: ("text", C), Leaf, or (template, [parts]).

    def tree(self, x: Node, axes: tuple[Axis, ...], width: int):
        """x at the indices `axes` of `width` loop variables."""
        if x.op == "view":
            return self.tree(x.args[0], composed(axes, x.data, width), width)
        number = uniform(x)
        if number is not None:
            return literal(number, x.kind)
        if x.op in ELEMENTWISE and x.index not in self.plan.stored:
            parts = [self.tree(a, axes, width) for a in x.args]
            return ELEMENTWISE[x.op].c[x.args[0].kind], parts
        if self.plan.local(x):
            return f"t{x.index}"
        return self._leaf(x, axes, width)

    def _leaf(self, x: Node, axes, width) -> Leaf:
        offset, steps = flat(axes, x.shape, width)
        return Leaf(self.where(x), offset, steps)

    def where(self, x: Node) -> Place:
        """The place of a stored value; records the variables to be declared."""
        while x.op == "alias" or (x.op == "param" and x.data[0] == "alias"):
            x = x.args[0] if x.op == "alias" else x.data[1]
        if x.op == "const":
            self.tables[x.index] = x
        place = self.plan.of(x)
        self.bases.add(place.base)
        return place

    def text(self, tree, names: list[str]) -> str:
        """C of an expression tree, loops named."""
        if isinstance(tree, str):
            return tree
        if isinstance(tree, Leaf):
            if tree.place.plain:
                return tree.place.base
            index = _sum(tree.place.offset + tree.offset, tree.steps, names)
            for part, most, step in tree.extra:
                clamp = f"i_clamp({self.text(part, names)}, {most})"
                index = f"{index} + {step} * {clamp}" if step != 1 else f"{index} + {clamp}"
            return f"{tree.place.base}[{index}]"
        return tree[0].format(*(self.text(part, names) for part in tree[1]))

    def _nest(self, shape: list[int], groups: list[list[int]], trees: list, body):
        """Loops over `shape` around body(names): neighbouring loops of one group become one where all steps allow it.

        trees: all that is read or written inside; their steps are changed to those of the merged loops."""
        leaves = list({id(leaf): leaf for tree in trees for leaf in _leaves(tree)}.values())
        shape = list(shape)
        keep = []
        for group in groups:
            merged: list[int] = []
            for j in group:
                if shape[j] == 1:
                    continue
                i = merged[-1] if merged else None
                if i is not None and all(leaf.steps[i] == leaf.steps[j] * shape[j] for leaf in leaves):
                    shape[j] *= shape[i]
                    merged.pop()
                merged.append(j)
            keep += merged
        for leaf in leaves:
            leaf.steps = [leaf.steps[j] for j in keep]
        names = list(NAMES[: len(keep)])
        for name, j in zip(names, keep):
            self.line(f"for (int {name} = 0; {name} < {shape[j]}; ++{name})")
            self.depth += 1
        body(names)
        self.depth -= len(keep)

    def _write(self, shape, groups: list[list[int]], target: Leaf, tree, assign: str = "="):
        """Emit loops that write the tree's elements to the target's."""
        self._nest(
            list(shape), groups, [tree, target], lambda names: self.line(f"{self.text(target, names)} {assign} {self.text(tree, names)};")
        )

    def _store(self, x: Node, place: Place, axes_of_target: tuple[int, tuple[int, ...]] | None = None, assign="="):
        """Write all of x to a place, row-major or with (offset, steps)."""
        width = len(x.shape)
        offset, steps = axes_of_target or (0, strides(x.shape))
        tree = self.tree(x, identity(x.shape), width)
        target = Leaf(place, offset, steps)
        self.bases.add(place.base)
        if x.size:
            self._write(x.shape, [list(range(width))], target, tree, assign)

    # Statements.

    def _region(self, region: Region):
        for node in self.plan.inside(region):
            self._statement(node)

    def _statement(self, node: Node):
        if node.op in ELEMENTWISE:
            parts = [self.tree(a, identity(node.shape), len(node.shape)) for a in node.args]
            tree = (ELEMENTWISE[node.op].c[node.args[0].kind], parts)
            self._assign(node, tree)
            return
        getattr(self, f"_{node.op}")(node)

    def _concat(self, node: Node):
        self._join(node, self.where(node), 0, strides(node.shape))

    def _join(self, node: Node, place: Place, at: int, steps: tuple[int, ...]):
        """Write the pieces one after the other from `at`; products and concatenations with no other reader directly in place."""
        for piece in node.args:
            if piece.op == "dot" and piece.index not in self.plan.stored:
                self._multiply(piece, self._pointer(place, at), steps)
            elif piece.op == "concat" and piece.index not in self.plan.stored:
                self._join(piece, place, at, steps)
            else:
                self._store(piece, place, (at, steps))
            at += piece.shape[node.data] * steps[node.data]

    def _pick(self, node: Node):
        axes, dims, most, fill = node.data
        operand, width = node.args[0], len(node.shape)
        place, offset, across = self._strided(operand)
        leaf = Leaf(place, offset + sum(s * a.start for s, a in zip(across, axes)), _steps(axes, across, width))
        parts = [self.tree(a, identity(node.shape), width) for a in node.args[1:]]
        leaf.extra = tuple((p, m, across[d]) for p, d, m in zip(parts, dims, most))
        tree: Any = leaf
        if fill is not None:
            inside = " && ".join(f"{{{k}}} >= 0 && {{{k}}} <= {m}" for k, m in enumerate(most))
            tree = (f"({inside} ? {{{len(parts)}}} : {literal(fill, node.kind)})", [*parts, leaf])
        self._assign(node, tree)

    def _assign(self, node: Node, tree):
        """Store one value, given as a tree over its own indices."""
        if self.plan.local(node):
            self.line(f"const {TYPES[node.kind]} t{node.index} = {self.text(tree, [])};")
            return
        self._write(node.shape, [list(range(len(node.shape)))], Leaf(self.where(node), 0, strides(node.shape)), tree)

    def _take(self, node: Node):
        table, fill = node.data
        source, target = self.where(node.args[0]), self.where(node)
        name = self._list(table)
        self.line(f"for (int i = 0; i < {node.size}; ++i)")
        read = f"{source.base}[{_plus(source.offset, f'{name}[i]')}]"
        if fill is not None:
            read = f"{name}[i] < 0 ? {literal(fill, node.kind)} : {read}"
        self.line(f"    {target.base}[{_plus(target.offset, 'i')}] = {read};")

    def _update(self, node: Node):
        operand, update, *starts = node.args
        place, steps = self.where(node), strides(node.shape)
        self._store(operand, place)
        width = len(update.shape)
        tree = self.tree(update, identity(update.shape), width)
        # The start is the same for all elements: nothing of it depends on a loop.
        extra = tuple((self.tree(s, (), width), most, step) for s, most, step in zip(starts, node.data, steps) if most > 0)
        self._write(update.shape, [list(range(width))], Leaf(place, 0, steps, extra), tree)

    def _scatter(self, node: Node):
        table, how = node.data
        operand, updates = node.args
        place = self.where(node)
        self._store(operand, place)
        straight = regular(table)
        if straight is not None and how == "set":
            self._store(updates, place, straight)
            return
        if straight is not None and how == "add":
            self._store(updates, place, straight, "+=")
            return
        source, name = self.where(self._root(updates)), self._list(table)
        read = f"{source.base}[{_plus(source.offset, 'i')}]"
        old = f"{place.base}[{_plus(place.offset, f'{name}[i]')}]"
        new = read if how == "set" else ELEMENTWISE[how].c[node.kind].format(old, read)
        self.line(f"for (int i = 0; i < {updates.size}; ++i)")
        self.line(f"    if ({name}[i] >= 0) {old} = {new};")

    @staticmethod
    def _root(x: Node) -> Node:
        return x.args[0] if x.op == "alias" else x

    def _reduce(self, node: Node):
        name, over = node.data
        x = node.args[0]
        out_rank = len(x.shape) - over
        width = len(x.shape)
        tree = self.tree(x, identity(x.shape), width)
        if name.startswith("arg"):
            return self._extreme(node, tree, out_rank)
        first, combine = START[name][node.kind], ELEMENTWISE[COMBINE[name]].c[node.kind]
        if self.plan.local(node) or math.prod(node.shape) == 1:
            variable = f"t{node.index}"
            self.line(f"{TYPES[node.kind]} {variable} = {first};")

            def add(names):
                self.line(f"{variable} = {combine.format(variable, self.text(tree, names))};")

            self._nest(list(x.shape), [list(range(width))], [tree], add)
            if not self.plan.local(node):
                self._put(self.where(node), variable)
            return
        target = Leaf(self.where(node), 0, (*strides(node.shape), *([0] * over)))
        self._write(node.shape, [list(range(out_rank))], Leaf(self.where(node), 0, strides(node.shape)), first)
        # What stays varies fastest: neighbouring sums grow side by side.
        self._write(x.shape, [list(range(out_rank, width)), list(range(out_rank))], target, (combine, [target, tree]))

    def _put(self, place: Place, text: str):
        self.line(f"{place.base if place.plain else f'{place.base}[{place.offset}]'} = {text};")

    def _extreme(self, node: Node, tree, out_rank: int):
        """argmax, argmin along one axis: the first of equal ones; NaN counts as the extreme."""
        x, sign = node.args[0], ">" if node.data[0] == "argmax" else "<"
        width, n = len(x.shape), x.shape[-1]
        target = Leaf(self.where(node), 0, (*strides(node.shape), 0)) if not self.plan.local(node) else None
        kind, index = TYPES[x.kind], TYPES[node.kind]
        number = f"{node.index}"
        if target is None:
            self.line(f"{index} t{number} = 0;")
        self.line("{")
        self.depth += 1
        names = list(NAMES[:width])
        for name, size in zip(names[:out_rank], x.shape):
            self.line(f"for (int {name} = 0; {name} < {size}; ++{name}) {{")
            self.depth += 1
        first = self.text(tree, [*names[:out_rank], "0"])
        self.line(f"{kind} best = {first};")
        self.line(f"{index} at = 0;")
        last = names[out_rank]
        self.line(f"for (int {last} = 1; {last} < {n}; ++{last}) {{")
        self.line(f"    const {kind} here = {self.text(tree, names)};")
        worse = f"here {sign} best"
        if x.kind == "f":
            worse = f"{worse} || (isnan(here) && !isnan(best))"
        self.line(f"    if ({worse}) {{ best = here; at = {last}; }}")
        self.line("}")
        goal = f"t{number}" if target is None else self.text(target, [*names[:out_rank], "0"])
        self.line(f"{goal} = at;")
        for _ in range(out_rank):
            self.depth -= 1
            self.line("}")
        self.depth -= 1
        self.line("}")

    def _cumulative(self, node: Node):
        name, axis, backwards = node.data
        place, shape = self.where(node), node.shape
        self._store(node.args[0], place)
        n, step = shape[axis], strides(shape)[axis]
        if n < 2:
            return
        rest = [1 if k == axis else s for k, s in enumerate(shape)]
        rest[axis] = n - 1
        here = Leaf(place, 0 if backwards else step, strides(shape))
        before = Leaf(place, step if backwards else 0, strides(shape))
        if backwards:
            for leaf in (here, before):
                leaf.offset += step * (n - 2)
                leaf.steps[axis] = -step

        others = [k for k in range(len(rest)) if k != axis]
        self._write(rest, [[axis], others], here, (ELEMENTWISE[COMBINE[name]].c[node.kind], [here, before]))

    # Kernels: functions of pointers.

    def _strided(self, x: Node) -> tuple[Place, int, tuple[int, ...]]:
        """(place, offset, steps) of a stored value or a view of one."""
        axes, root = (x.data, x.args[0]) if x.op == "view" else (identity(x.shape), x)
        offset, steps = flat(axes, root.shape, len(x.shape))
        return self.where(root), offset, steps

    def _pointer(self, place: Place, offset: int = 0) -> str:
        if place.plain:
            return f"&{place.base}"
        total = place.offset + offset
        return f"{place.base} + {total}" if total else place.base

    def _call(self, kernel: tuple[str, str], *pointers: str):
        name, text = kernel
        name = self.kernels.setdefault(text, f"{name}_{len(self.kernels)}")
        self.line(f"{name}({', '.join(pointers)});")

    def _dot(self, node: Node):
        if self.plan.local(node):
            self.line(f"{TYPES[node.kind]} t{node.index};")
            goal = f"&t{node.index}"
        else:
            goal = self._pointer(self.where(node))
        self._multiply(node, goal, strides(node.shape))

    def _multiply(self, node: Node, goal: str, steps: tuple[int, ...]):
        """The product written where `goal` points, with steps of its own."""
        (pa, oa, sa), (pb, ob, sb) = (self._strided(x) for x in node.args)
        product = kernels.Product.of(node.args[0].shape, sa, node.args[1].shape, sb, steps, *node.data)
        self._call(kernels.product(product, TYPES[node.kind]), goal, self._pointer(pa, oa), self._pointer(pb, ob))

    def _cholesky(self, node: Node):
        place = self.where(node)
        self._store(node.args[0], place)
        self._call(kernels.cholesky(node.shape), self._pointer(place))

    def _trisolve(self, node: Node):
        place = self.where(node)
        self._store(node.args[1], place)
        at, offset, steps = self._strided(node.args[0])
        kernel = kernels.triangular(node.args[0].shape, steps, node.shape, *node.data)
        self._call(kernel, self._pointer(place), self._pointer(at, offset))

    # Loops and branches.

    def _scan(self, node: Node):
        loop: Loop = node.data
        results = {r.data: r for r in self.plan.results.get(node.index, [])}
        for p, init in zip(loop.carry, node.args):
            self._store(init, self.where(p))
        if not loop.length:
            return
        turn = f"n{node.index}"
        self.line(f"for (int {turn} = 0; {turn} < {loop.length}; ++{turn}) {{")
        self.depth += 1
        at = f"({loop.length - 1} - {turn})" if loop.reverse else turn
        for p in loop.slices:
            if p.index in self.plan.times:
                source = self.where(p.data[1])
                self.line(f"const {TYPES[p.kind]} *const x{p.index} = {self._pointer(source)} + {p.size} * {at};")
        self._region(loop.region)
        for k, x in enumerate(loop.each):
            result = results.get(len(loop.carry) + k)
            if result is not None:
                place = self.where(result)
                self.line(f"{TYPES[x.kind]} *const y{result.index} = {self._pointer(place)} + {x.size} * {at};")
                self._store(x, Place(f"y{result.index}"))
        for p, new in zip(loop.carry, loop.new):
            if new is not p:
                self._store(new, self.where(p))
        self.depth -= 1
        self.line("}")

    def _cond(self, node: Node):
        choice: Branches = node.data
        results = {r.data: r for r in self.plan.results.get(node.index, [])}
        index = self.text(self.tree(node.args[0], (), 0), [])
        for k, (region, outputs) in enumerate(zip(choice.regions, choice.outputs)):
            last = k == len(choice.regions) - 1
            opening = "if (" + f"{index} <= {k}" + ") {" if not last else "{"
            self.line(opening if k == 0 else f"}} else {opening}")
            self.depth += 1
            self._region(region)
            for number, x in enumerate(outputs):
                if number in results:
                    self._store(x, self.where(results[number]))
            self.depth -= 1
        self.line("}")

    def _list(self, table: np.ndarray) -> str:
        """The name of a constant table of positions."""
        text = ", ".join(str(int(k)) for k in table.reshape(-1))
        small = table.size == 0 or (table.max() < 2**15)
        if text not in self.lists:
            name = f"p{len(self.lists)}"
            self.lists[text] = (name, f"static const int{16 if small else 32}_t {name}[{max(table.size, 1)}] = {{{text}}};")
        return self.lists[text][0]


def _leaves(tree) -> list[Leaf]:
    if isinstance(tree, Leaf):
        return [tree, *(leaf for part, _, _ in tree.extra for leaf in _leaves(part))]
    if isinstance(tree, tuple):
        return [leaf for part in tree[1] for leaf in _leaves(part)]
    return []


def _steps(axes, across, width) -> tuple[int, ...]:
    return tuple(sum(s * a.steps[j] for s, a in zip(across, axes)) for j in range(width))


def _sum(offset: int, steps, names) -> str:
    """offset + steps . names, as short as it can be."""
    terms = [name if m == 1 else f"{m} * {name}" for m, name in zip(steps, names) if m and name != "0"]
    if offset or not terms:
        terms.insert(0, str(offset))
    return " + ".join(terms).replace("+ -", "- ")


def _plus(offset: int, text: str) -> str:
    return f"{offset} + {text}" if offset else text


def literal(number, kind: str) -> str:
    """A constant as C."""
    if kind == "b":
        return "true" if number else "false"
    if kind in "il":
        if number == -(2**31) and kind == "i":
            return "INT32_MIN"
        if number == -(2**63):
            return "INT64_MIN"
        return str(int(number)) if kind == "i" else f"INT64_C({int(number)})" if number >= 0 else f"(-INT64_C({-int(number)}))"
    number = float(number)
    if math.isnan(number):
        return "(real)NAN"
    if math.isinf(number):
        return "(real)INFINITY" if number > 0 else "(-(real)INFINITY)"
    if 0.0 < abs(number) < LEAST or abs(number) > MOST:
        return f"{'-' * (number < 0)}{'R_TINY' if abs(number) < 1 else 'R_HUGE'}({abs(number)!r})"
    return f"R({number!r})"
