"""Storage plan of a graph: which values are stored, when each is written and last read, and which values share storage.

Element-wise values that are read once per element are written inside their reader's loop and need none. The rest gets
row-major storage; two values share it when one is last read before the other is written (interval packing, largest first).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rotorwatch_lab.compiling.c99.graph import Node, Region
from rotorwatch_lab.compiling.c99.indices import regular
from rotorwatch_lab.compiling.c99.lower import Branches, Loop
from rotorwatch_lab.compiling.c99.operations import CHEAP, ELEMENTWISE

WORKSPACE = {"f": "w", "i": "wi", "l": "wl", "b": "wb"}  # its members by the kind of value
ALIGNMENT = 4  # elements: vector loads of neighbours
LARGE = 1024  # elements, from which on room counts for more than the few per cent of time that writing over what is read costs


class Place(NamedTuple):
    """Where a value is: `base[offset]` onwards; plain: the variable `base` itself."""

    base: str
    offset: int = 0
    plain: bool = False


def live(outputs: list[Node]) -> list[Node]:
    """All nodes that the outputs depend on, in the order in which they were made."""
    seen: dict[int, Node] = {}
    todo = list(outputs)
    while todo:
        node = todo.pop()
        if node.index in seen:
            continue
        seen[node.index] = node
        todo += node.args
        if isinstance(node.data, Loop):
            todo += [*node.data.carry, *node.data.slices, *node.data.new, *node.data.each]
        elif isinstance(node.data, Branches):
            todo += [n for out in node.data.outputs for n in out]
        elif node.op == "param" and node.data[0] in ("alias", "slice"):
            todo.append(node.data[1])
    return [seen[k] for k in sorted(seen)]


class Plan:
    """Storage plan of a graph, for emit.py. outputs: nodes to be written at the end; targets[k]: the destination of output k and, if that
    is also an input, its parameter's node (else None)."""

    def __init__(self, outputs: list[Node], targets: list[tuple[Place, Node | None]]):
        self.nodes = live(outputs)
        self.outputs, self.targets = outputs, targets
        self.times: dict[int, float] = {}
        self.must: set[int] = set()
        self.stored: set[int] = set()
        self.place: dict[int, Place] = {}
        self.into: set[int] = set()  # pieces of concatenations
        self.owner: dict[int, Node] = {}  # loops and branches by the parameters' and results' regions
        self._choose()
        self._order()
        self._pack()

    # What is stored.

    def _choose(self):
        for node in self.nodes:
            regions = ()
            if isinstance(node.data, Loop):
                regions = (node.data.region,)
            elif isinstance(node.data, Branches):
                regions = node.data.regions
            for region in regions:
                self.owner[id(region)] = node
        for out, (_, also_input) in zip(self.outputs, self.targets):
            self._read(out, 1.0, must=also_input is not None and out is not also_input and out.op != "const")
        for node in reversed(self.nodes):
            self._readers(node)

    def _read(self, x: Node, times: float = 1.0, must: bool = False, by: Node | None = None):
        if by is not None and x.region is not by.region:
            must = True  # evaluated inside a loop otherwise, over and over
        self.times[x.index] = self.times.get(x.index, 0.0) + times
        if must:
            self.must.add(x.index)

    def _readers(self, node: Node):
        """Record how this node reads its arguments."""
        op, times = node.op, self.times.get(node.index, 0.0)
        must = node.index in self.must
        if op == "view":
            spread = math.prod(n for j, n in enumerate(node.shape) if not any(axis.steps[j] for axis in node.data))
            self._read(node.args[0], times * spread, must, node)
        elif op == "alias":
            self._read(node.args[0], must=True)
        elif op in ELEMENTWISE:
            inlined = not must and (times <= 1 or (op in CHEAP and node.size > 1 and node.args[0].op == "param"))
            if not inlined:
                self.stored.add(node.index)
            for x in node.args:
                self._read(x, times if inlined else 1.0, by=node)
        elif op == "scan":
            loop: Loop = node.data
            for x in node.args[: len(loop.carry)]:
                self._read(x)
            for x in node.args[len(loop.carry) :]:
                self._read(x, must=True)
            for old, new in zip(loop.carry, loop.new):
                self._read(new, must=new is not old and new.op != "const")
            for x in loop.each:
                self._read(x, must=x.region is not loop.region)
        elif op == "cond":
            self._read(node.args[0])
            for x in node.args[1:]:
                self._read(x, must=True)
            for out in node.data.outputs:
                for x in out:
                    self._read(x)
        elif op not in ("const", "param"):
            if not (op in ("dot", "concat") and node.index in self.into and times == 1 and not must):
                self.stored.add(node.index)  # else written by its only reader, a concatenation
            if op == "concat":
                self.into.update(x.index for x in node.args)
            for k, x in enumerate(node.args):
                self._read(x, must=self._needs_storage(node, k), by=node)

    @staticmethod
    def _needs_storage(node: Node, k: int) -> bool:
        """True if argument k is read in another order than element by element."""
        op = node.op
        if op == "scatter":
            return k == 1 and regular(node.data[0]) is None
        return op in ("dot", "take") or (op in ("pick", "trisolve") and k == 0)

    def local(self, node: Node) -> bool:
        """True if the value is a scalar C variable: one element whose address is never taken."""
        return node.shape == () and node.index not in self.must and node.op in (*ELEMENTWISE, "reduce", "dot", "pick")

    # When.

    def leaves(self, x: Node) -> list[Node]:
        """The stored values, parameters and constants that evaluating x reads."""
        out, todo = [], [x]
        while todo:
            node = todo.pop()
            if node.op in ("view", "alias") or (node.op in (*ELEMENTWISE, "dot", "concat") and node.index not in self.stored):
                todo += node.args
            elif node.op == "param" and node.data[0] == "alias":
                todo.append(node.data[1])
            else:
                out.append(node)
        return out

    def inside(self, region: Region) -> list[Node]:
        """The region's statements in order."""
        return self.statements.get(id(region), [])

    def _order(self):
        """Positions in the order in which the C code runs; loops have a first and a last."""
        self.statements: dict[int, list[Node]] = {}
        for node in self.nodes:
            if (node.index in self.stored and node.op != "result") or node.op in ("scan", "cond"):
                self.statements.setdefault(id(node.region), []).append(node)
        self.start: dict[int, int] = {}
        self.end: dict[int, int] = {}
        self.written: dict[int, int] = {}
        self.clock = 0
        top = self.nodes[0].region
        while top.parent is not None:
            top = top.parent
        self.top = top
        self._walk(top)
        self.last: dict[int, int] = {}
        for node in self.nodes:
            if node.index in self.start:
                for x in node.args:
                    self._used(x, node.region, self.end[node.index])
                if isinstance(node.data, Loop):
                    for x in (*node.data.new, *node.data.each):
                        self._used(x, node.data.region, self.end[node.index])
                    for x in node.data.carry:  # written at the end of each turn, read in the next
                        self._used(x, node.data.region, self.end[node.index])
                elif isinstance(node.data, Branches):
                    for region, out in zip(node.data.regions, node.data.outputs):
                        for x in out:
                            self._used(x, region, self.end[node.index])
        for x in self.outputs:
            self._used(x, top, self.clock + 1)

    def _walk(self, region: Region):
        for node in self.inside(region):
            self.clock += 1
            self.start[node.index] = self.clock
            if isinstance(node.data, Loop):
                self._walk(node.data.region)
            elif isinstance(node.data, Branches):
                for inner in node.data.regions:
                    self._walk(inner)
            self.clock += 1
            self.end[node.index] = self.clock

    def _used(self, x: Node, region: Region, position: int):
        """x is read at `position` inside `region`; what comes from outside is needed until the loop ends."""
        for leaf in self.leaves(x):
            here, when = region, position
            while here is not leaf.region and here.parent is not None:
                owner = self.owner[id(here)]
                when, here = max(when, self.end[owner.index]), owner.region
            self.last[leaf.index] = max(self.last.get(leaf.index, 0), when)

    # Where.

    def _pack(self):
        self.results: dict[int, list[Node]] = {}
        for node in self.nodes:
            if node.op == "result":
                self.results.setdefault(node.args[0].index, []).append(node)
        wanted: dict[str, list[tuple[int, int, int, Node]]] = {}
        for node in reversed(self.nodes):  # what goes into an output takes along what it is made of
            if node.op in ("view", "alias", "const", "scan", "cond", "param"):
                continue
            if node.index not in self.stored or self.local(node):
                continue
            begin = self.start[node.args[0].index if node.op == "result" else node.index]
            if node.index in self.place or self._placed_in_output(node, begin):
                continue
            wanted.setdefault(node.kind, []).append((node.size, begin, self.last.get(node.index, begin + 1), node))
        for node in self.nodes:  # a loop's carry is its result; one that nobody reads needs storage all the same
            if isinstance(node.data, Loop):
                results = {r.data for r in self.results.get(node.index, [])}
                for k, p in enumerate(node.data.carry):
                    if k not in results:
                        wanted.setdefault(p.kind, []).append((p.size, self.start[node.index], self.end[node.index], p))
        self.sizes = {kind: self._packed(kind, blocks) for kind, blocks in wanted.items()}
        for node in self.nodes:
            if isinstance(node.data, Loop):
                for r in self.results.get(node.index, []):
                    if r.data < len(node.data.carry):
                        self.place[node.data.carry[r.data].index] = self.place[r.index]
        for node in self.nodes:
            if node.op == "alias":
                self.place[node.index] = self.of(node.args[0])

    def _placed_in_output(self, node: Node, begin: int) -> bool:
        """Compute the value directly in its output, if nobody reads the previous content from then on."""
        if node.region is not self.top:
            return False
        for out, (place, also_input) in zip(self.outputs, self.targets):
            root = out.args[0] if out.op == "alias" else out
            if root is node and not place.plain and self._free(node, begin, also_input):
                self.place[node.index] = place
                self._in_place(node, place, also_input)
                return True
        return False

    def _in_place(self, node: Node, place: Place, also_input: Node | None) -> None:
        """Compute in the place of `node` the values it is made of element by element that nobody reads later, recursively.

        An element is read before the same one is written. A step that changes a large matrix a little, several times, needs no second one.
        """
        while node.op in ELEMENTWISE and node.size >= LARGE:
            last_reads = [x for x in self._same_elements(node) if self.last.get(x.index, 0) == self.end[node.index]]
            usable = [x for x in last_reads if self._may_go(x, node, also_input)]
            if not usable:
                return
            node = usable[0]
            self.place[node.index] = place

    def _may_go(self, x: Node, reader: Node, also_input: Node | None) -> bool:
        """True if x can share the place of its reader: nobody reads the previous content before x is written."""
        if x.index not in self.stored or x.op == "result" or x.op not in ELEMENTWISE or x.region is not self.top or self.local(x):
            return False
        if x.kind != reader.kind or x.index in self.place or x.index in self.into or any(x is out for out in self.outputs):
            return False
        return self._free(x, self.start[x.index], also_input)

    def _free(self, node: Node, begin: int, also_input: Node | None) -> bool:
        """True if, once `node` is written over an input, only `node` itself still reads it, element by element."""
        if also_input is None:
            return True
        last_read = self.last.get(also_input.index, 0)
        if last_read < begin:
            return True
        if node.size < LARGE:
            return False
        reads_itself = node.op in ELEMENTWISE and last_read == self.end.get(node.index)
        return reads_itself and any(x is also_input for x in self._same_elements(node))

    def _same_elements(self, node: Node) -> list[Node]:
        """Stored values, and parameters, of which element i is all that element i of an element-wise node reads."""
        alike: dict[int, Node] = {}
        other: set[int] = set()
        todo = list(node.args)
        while todo:
            x = todo.pop()
            if x.shape == node.shape and x.op in ELEMENTWISE and x.index not in self.stored:
                todo += x.args
            elif x.shape == node.shape and (x.index in self.stored or x.op == "param"):
                alike[x.index] = x
            else:
                other.update(leaf.index for leaf in self.leaves(x))
        return [x for k, x in alike.items() if k not in other]

    def _packed(self, kind: str, blocks) -> int:
        """First fit, largest first. Returns the number of elements."""
        placed: list[tuple[int, int, int, int]] = []
        most = 0
        for size, begin, end, node in sorted(blocks, key=lambda b: (-b[0], b[1])):
            room = -(-max(size, 1) // ALIGNMENT) * ALIGNMENT if size > 1 else 1
            at = 0
            for a, b, _, _ in sorted(d for d in placed if not (d[3] < begin or end < d[2])):
                if at + room <= a:
                    break
                at = max(at, b)
            placed.append((at, at + room, begin, end))
            most = max(most, at + room)
            self.place[node.index] = Place(WORKSPACE[kind], at)
        return most

    def of(self, x: Node) -> Place:
        """Where a stored value, parameter or alias is."""
        if x.op == "alias":
            return self.of(x.args[0])
        if x.op == "param" and x.data[0] == "alias":
            return self.of(x.data[1])
        if x.op == "param" and x.data[0] == "input":
            return x.data[1]
        if x.op == "param" and x.data[0] == "slice":
            return Place(f"x{x.index}")
        if x.op == "const":
            return Place(f"c{x.index}")
        return self.place[x.index]
