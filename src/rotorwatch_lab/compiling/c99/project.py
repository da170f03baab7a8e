"""A function with named state, inputs and outputs as a C99 project: header, source, example, CMakeLists.

    NAME_init(state)   NAME_step(state, u, y, valid, out, work)   NAME_run(rows, ...): a step per row

No allocation, no globals that change: everything lives in what the caller hands over, so that any number of them can run at once.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import __version__
from rotorwatch.base.backend import jax
from rotorwatch_lab.compiling.c99.emit import Emitter, literal
from rotorwatch_lab.compiling.c99.graph import Graph, Node
from rotorwatch_lab.compiling.c99.kernels import LANES
from rotorwatch_lab.compiling.c99.lower import lower
from rotorwatch_lab.compiling.c99.operations import FUNCTIONS, HELPERS, NUMPY, TYPES, kind
from rotorwatch_lab.compiling.c99.plan import WORKSPACE, Place, Plan

WIDTH = 120
RESERVED = ("int", "double", "float", "short", "long", "register", "default")
HEADER = Template(Path(__file__).with_name("header.h.in").read_text("utf-8"))


class Field(NamedTuple):
    """An array of a struct, or an argument. note: unit and meaning, for the header."""

    name: str
    kind: str
    shape: tuple[int, ...]
    note: str = ""

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def c_type(self) -> str:
        return {"real": "rw_real"}.get(TYPES[self.kind], TYPES[self.kind])

    @property
    def declared(self) -> str:
        """`rw_real P[81]`, or without brackets for a scalar."""
        return f"{self.c_type} {self.name}" + (f"[{self.size}]" if self.shape else "")


@dataclass(frozen=True)
class Program:
    """C of one function, and what its structs hold. sources: file name -> text."""

    name: str
    parameters: tuple[Field, ...]
    state: tuple[Field, ...]
    inputs: tuple[Field, ...]
    out: tuple[Field, ...]
    header: str
    source: str
    digest: str
    workspace_bytes: int
    extra: dict[str, str] = field(default_factory=dict)


def fields(tree: Any, notes: dict[str, str] | None = None) -> tuple[Field, ...]:
    """The leaves of a pytree of arrays, named after where they are in it; reserved words and twins get a tail."""
    leaves: list[Field] = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = "_".join(_key(part) for part in path) or "value"
        name = name if name[0].isalpha() else f"_{name}"
        while name in {f.name for f in leaves} or name in RESERVED:
            name += "_"
        shape, dtype = np.shape(leaf), np.asarray(leaf).dtype if not hasattr(leaf, "dtype") else leaf.dtype
        leaves.append(Field(name, kind(dtype), shape, (notes or {}).get(name, "")))
    return tuple(leaves)


def _key(part) -> str:
    text = str(getattr(part, "name", getattr(part, "key", getattr(part, "idx", part))))
    return "".join(c if c.isalnum() else "_" for c in text)


def emit_program(
    name: str,
    step: Callable,
    init: Callable | None,
    inputs: tuple[Field, ...],
    parameters: Any = (),
    notes: dict[str, str] | None = None,
    about: str = "",
    carry: Any = None,
) -> Program:
    """The program of `step(parameters, carry, *inputs) -> (carry, out)` and `init(parameters) -> carry`; without init no NAME_init, and
    `carry` is an example of one.

    parameters: a pytree of arrays (values do not matter), empty when everything is constant. notes: what the header says of a field.
    about: the header's first words. Raises Refused for what has no counterpart in C.
    """
    notes = notes or {}
    carry = jax.eval_shape(init, parameters) if init else jax.tree.map(np.asarray, carry)
    example = [jax.ShapeDtypeStruct(f.shape, NUMPY[f.kind]) for f in inputs]
    out = jax.eval_shape(step, parameters, carry, *example)[1]
    p_fields, s_fields, o_fields = fields(parameters, notes), fields(carry, notes), fields(out, notes)
    structs = {"parameters": p_fields, "state": s_fields, "out": o_fields}
    step_c = _function(jax.make_jaxpr(step)(parameters, carry, *example), structs, inputs, o_fields)
    init_c = _function(jax.make_jaxpr(init)(parameters), structs, (), None) if init else None
    parts = [c for c in (step_c, init_c) if c is not None]
    sizes = {k: max(c.sizes.get(k, 0) for c in parts) for k in WORKSPACE}
    digest = hashlib.sha256("\n".join(line for c in parts for line in (*c.lines, *c.tables)).encode()).hexdigest()[:16]
    header = _header(name, about, digest, structs, inputs, sizes, init is not None)
    source = _source(name, digest, structs, inputs, step_c, init_c)
    bytes_ = sum(n * {"f": 8, "i": 4, "l": 8, "b": 1}[k] for k, n in sizes.items())
    return Program(name, p_fields, s_fields, inputs, o_fields, header, source, digest, bytes_)


class _C(NamedTuple):
    """Statements of one function, the tables and kernels it needs, and its workspace."""

    lines: list[str]
    tables: list[str]
    kernels: list[str]
    sizes: dict[str, int]
    bases: set[str]


def _function(traced, structs, inputs: tuple[Field, ...], out: tuple[Field, ...] | None) -> _C:
    """traced: of (parameters, state, *inputs) -> (state, out), or, without out, of (parameters) -> state."""
    graph = Graph()
    args: list[Node] = []
    arguments_of = [("parameters->", structs["parameters"])] + ([("state->", structs["state"])] if out is not None else [])
    states: list[Node | None] = []
    for prefix, group in [*arguments_of, ("", inputs)]:
        for f in group:
            node = _input(graph, f, prefix)
            args.append(node)
            if prefix == "state->":
                states.append(node)
    results = lower(graph, traced.jaxpr, traced.consts, args)
    targets: list[tuple[Place, Node | None]] = []
    outputs: list[Node] = []
    groups = [("state->", structs["state"])] + ([("out->", out)] if out is not None else [])
    flat = iter(results)
    for prefix, group in groups:
        for k, f in enumerate(group):
            node = next(flat)
            if not f.size:
                continue
            also_input = states[k] if prefix == "state->" and states else None
            if also_input is not None and node is not also_input:
                node = _own(graph, node)
            outputs.append(node)
            targets.append((Place(prefix + f.name, 0, not f.shape), also_input))
    # The state last: what is only computed on the way out may still read it.
    order = sorted(range(len(outputs)), key=lambda k: targets[k][1] is not None)
    plan = Plan([outputs[k] for k in order], [targets[k] for k in order])
    emitter = Emitter(plan)
    lines = emitter.function_body()
    tables = [_table(node) for _, node in sorted(emitter.tables.items())]
    lists = [text for _, text in emitter.lists.values()]
    kernels = [text.replace("@", name) for text, name in emitter.kernels.items()]
    return _C(lines, tables + lists, kernels, plan.sizes, emitter.bases)


def _input(graph: Graph, f: Field, prefix: str) -> Node:
    if not f.size:
        return graph.const(np.zeros(f.shape, NUMPY[f.kind]))
    return graph.param(f.shape, f.kind, ("input", Place(prefix + f.name, 0, not f.shape)))


def _own(graph: Graph, node: Node) -> Node:
    """A value that is not itself an input under another name."""
    root = node.args[0] if node.op in ("view", "alias") else node
    return graph.make("copy", (node,), node.shape, node.kind, key=False) if root.op == "param" else node


def _table(node: Node) -> str:
    values = node.data.reshape(-1).tolist()
    numbers = [literal(v, node.kind) for v in values]
    if node.kind == "f":  # shorter to read where single precision holds the same number
        numbers = [n[2:-1] if n.startswith("R(") and _short(v) else n for n, v in zip(numbers, values, strict=True)]
    head = f"static const {TYPES[node.kind]} c{node.index}[{node.size}] = {{"
    return "\n".join([head, *_wrapped(numbers), "};"]) if len(head) + 22 * len(numbers) > WIDTH else head + ", ".join(numbers) + "};"


def _short(value: float) -> bool:
    """True if an initialiser can hold the number literally, in single precision too, without a warning."""
    with np.errstate(over="ignore"):
        return float(np.float32(value)) == value


def _wrapped(words: list[str], indent: str = "    ") -> list[str]:
    lines, line = [], indent
    for word in words:
        if len(line) + len(word) + 2 > WIDTH:
            lines.append(line.rstrip())
            line = indent
        line += f"{word}, "
    return [*lines, line.rstrip(", ")]


def arguments(name: str, structs, inputs: tuple[Field, ...], many: bool = False) -> str:
    """The arguments of NAME_step, or of NAME_run, where inputs and outputs are rows."""
    parts = [f"{name}_state *restrict state"]
    if structs["parameters"]:
        parts.append(f"const {name}_parameters *parameters")
    if many:
        parts.insert(0, "int32_t rows")
    for f in inputs:
        if many:
            parts.append(f"const {f.c_type} *{f.name}")
        else:
            parts.append(f"const {f.declared}" if f.shape else f"{f.c_type} {f.name}")
    return ", ".join([*parts, f"{name}_out *restrict out", f"{name}_workspace *restrict work"])


def _header(name, about, digest, structs, inputs, sizes, starts: bool) -> str:
    meaning = {
        "parameters": "What it is built from.",
        "state": "What it remembers from one step to the next.",
        "out": "What one step says.",
    }
    lines: list[str] = []
    for kind_, group in structs.items():
        if group or kind_ != "parameters":
            members = [_member(f) for f in group if f.size] or ["    char nothing;"]
            lines += [f"/* {meaning[kind_]} Matrices row by row. */", "typedef struct {", *members]
            lines += [f"}} {name}_{kind_};", ""]
    workspace = [f"    {Field(WORKSPACE[k], k, (n,)).declared};" for k, n in sizes.items() if n]
    first = f"/* The state before the first step. */\n{_init_head(name, structs)};\n\n"
    steps = (_signature(f"void {name}_{k}", arguments(name, structs, inputs, k == "run"), ";") for k in ("step", "run"))
    step, run = ("\n".join(lines) for lines in steps)
    prose = (f"     {f.name}[{f.size}]  {f.note}" if f.shape else f"     {f.name}  {f.note}" for f in inputs)
    return HEADER.substitute(
        about=about or name, version=__version__, digest=digest, NAME=name.upper(), name=name, inputs="\n".join(prose),
        structs="\n".join(lines), workspace="\n".join(workspace or ["    char nothing;"]), init=first if starts else "", step=step, run=run,
    )  # fmt: skip


def _init_head(name: str, structs) -> str:
    """NAME_init and its arguments."""
    parameters = f", const {name}_parameters *parameters" if structs["parameters"] else ""
    return f"void {name}_init({name}_state *restrict state{parameters}, {name}_workspace *restrict work)"


def _member(f: Field) -> str:
    shape = f"({', '.join(str(n) for n in f.shape)})" if len(f.shape) > 1 else ""
    note = "; ".join(part for part in (shape, f.note) if part)
    return f"    {f.declared};" + (f" /* {note} */" if note else "")


def _signature(head: str, arguments_: str, tail: str) -> list[str]:
    """The signature on one line, or with its arguments wrapped below."""
    line = f"{head}({arguments_}){tail}"
    if len(line) <= WIDTH:
        return [line]
    lines = _wrapped(arguments_.split(", "))
    return [f"{head}(", *lines[:-1], f"{lines[-1]}){tail}"]


def _source(name, digest, structs, inputs, step: _C, init: _C | None) -> str:
    parts = [c for c in (step, init) if c is not None]
    body = "\n".join(line for c in parts for line in (*c.kernels, *c.lines))
    helpers = _used(body)
    text = body + "".join(helpers)
    macros = [f for f in FUNCTIONS if f"r_{f}(" in text]
    lines = [f"/* rotorwatch {__version__}, definition {digest}: see {name}.h. */", f'#include "{name}.h"', ""]
    lines += ["#include <math.h>", "#include <stddef.h>", "", "#define real rw_real", "#define R(x) ((real)(x))"]
    if macros:
        floats, doubles = ([f"#define r_{f} {f}{tail}" for f in macros] for tail in ("f", ""))
        lines += ["#ifdef ROTORWATCH_FLOAT", *floats, "#else", *doubles, "#endif"]
    for macro, single in (("R_TINY", "R(0.0)"), ("R_HUGE", "(real)INFINITY")):
        if f"{macro}(" in "\n".join([text, *(line for c in parts for line in c.tables)]):
            lines += ["#ifdef ROTORWATCH_FLOAT", f"#define {macro}(x) {single}", "#else", f"#define {macro}(x) R(x)", "#endif"]
    if LANES in text:
        # gcc would write a short loop out, and then take the loop around it for the vector's lanes.
        pragma = '_Pragma("GCC unroll 1")'
        lines += ["#if defined(__GNUC__) && !defined(__clang__)", f"#define {LANES} {pragma}", "#else", f"#define {LANES}", "#endif"]
    lines += ["", *helpers, ""] if helpers else [""]
    if init is not None:
        init = _renamed(init, "i_")
        lines += [*init.tables, *init.kernels, "", _init_head(name, structs), "{"]
        lines += [*_opening(init, structs, ()), *init.lines, "}", ""]
    lines += [*step.tables, *step.kernels, ""]
    lines += [*_signature(f"void {name}_step", arguments(name, structs, inputs), ""), "{"]
    lines += [*_opening(step, structs, inputs), *step.lines, "}", ""]
    lines += [*_signature(f"void {name}_run", arguments(name, structs, inputs, True), ""), "{"]
    row = ["state", *(["parameters"] if structs["parameters"] else [])]
    row += [f"{f.name} + {f.size} * (size_t)k" if f.shape else f"{f.name}[k]" for f in inputs]
    lines += ["    for (int32_t k = 0; k < rows; ++k)", f"        {name}_step({', '.join([*row, 'out + k', 'work'])});", "}", ""]
    return "\n".join(lines)


def _used(body: str) -> list[str]:
    """The helper functions that the text calls."""
    return [text for name, text in HELPERS.items() if f"{name}(" in body]


def _renamed(c: _C, prefix: str) -> _C:
    """Tables and kernels of the two functions kept apart."""
    names = [re.search(r"(\w+)\[\d+\] = \{", t) for t in c.tables] + [re.search(r"static void (\w+)\(", k) for k in c.kernels]
    known = {m.group(1) for m in names if m}

    def change(text: str) -> str:
        return re.sub(r"\b[A-Za-z_]\w*", lambda m: prefix + m.group(0) if m.group(0) in known else m.group(0), text)

    return c._replace(lines=[change(t) for t in c.lines], tables=[change(t) for t in c.tables], kernels=[change(t) for t in c.kernels])


def _opening(c: _C, structs, inputs) -> list[str]:
    """Shorter names of the workspace's members; what is not used is marked as unused."""
    text = "\n".join(c.lines)
    lines = []
    for k, member in WORKSPACE.items():
        if member in c.bases and c.sizes.get(k):
            lines.append(f"    {TYPES[k]} *const {member} = work->{member};")
    if not lines:
        lines.append("    (void)work;")
    if structs["parameters"] and "parameters->" not in text:
        lines.append("    (void)parameters;")
    if inputs and "state->" not in text:
        lines.append("    (void)state;")
    for f in inputs:
        if not re.search(rf"\b{f.name}\b", text):
            lines.append(f"    (void){f.name};")
    return lines
