"""A traced function (jaxpr) as a `Graph`: calls inlined, indices made constant tables, loops and branches as regions.

What C cannot do without a run-time library, or not in a time known beforehand, is refused: `Refused` names the operation, the
line of the method it comes from, and what to write instead.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling.c99 import indices, selections, zeros
from rotorwatch_lab.compiling.c99.graph import Graph, Node, Region, uniform, value, values
from rotorwatch_lab.compiling.c99.operations import COMPARISONS, ELEMENTWISE, NUMPY, kind

CALLS = {
    "jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr", "remat", "remat2",
    "checkpoint", "custom_lin",
}  # fmt: skip
SAME = {"copy", "copy_p", "device_put", "stop_gradient", "reduce_precision", "optimization_barrier", "pvary"}
RENAMED = {"add_any": "add"}
_FACTORS = "factor with cholesky and cho_solve, or do it once in __init__"
ADVICE = {
    "while": "use fori_loop or scan with a fixed number of turns",
    "sort": "use max, argmax or comparisons of all pairs",
    "top_k": "use max and argmax",
    "scatter": "use where with a mask, or dynamic_update_slice, when the index is known at run time only",
    **dict.fromkeys(("lu", "qr", "householder_product", "geqrf", "eigh", "eig", "svd", "schur", "hessenberg"), _FACTORS),
    **dict.fromkeys(("pure_callback", "io_callback", "debug_callback"), "leave Python out of a step"),
    **dict.fromkeys(("fft", "conv_general_dilated"), "write it as a product with a constant matrix"),
    **dict.fromkeys(("random_bits", "threefry2x32", "random_wrap"), "draw random numbers outside a step"),
}


class Refused(ConfigError):
    """A function that cannot become C: which operation, where in the source, what to write instead."""


class Loop(NamedTuple):
    """A scan. carry, slices: parameters of its region; new, each: what a turn leaves, of the carry and to be stacked."""

    region: Region
    length: int
    reverse: bool
    carry: tuple[Node, ...]
    slices: tuple[Node, ...]
    new: tuple[Node, ...]
    each: tuple[Node, ...]


class Branches(NamedTuple):
    """A choice by run-time index: of each branch its region and its outputs."""

    regions: tuple[Region, ...]
    outputs: tuple[tuple[Node, ...], ...]


def lower(graph: Graph, jaxpr, consts, args) -> list[Node]:
    """The outputs of `jaxpr` applied to nodes. Raises Refused."""
    known: dict[Any, Node] = {}

    def read(atom) -> Node:
        return graph.const(np.asarray(atom.val)) if hasattr(atom, "val") else known[atom]

    known.update(zip(jaxpr.constvars, (graph.const(np.asarray(c)) for c in consts)))
    known.update(zip(jaxpr.invars, args))
    for equation in jaxpr.eqns:
        graph.source = _where(equation) or graph.source
        name = equation.primitive.name
        try:
            out = _equation(graph, name, [read(a) for a in equation.invars], equation.params, equation.outvars)
        except KeyError as unknown:
            what = f"the type {unknown.args[0]}" if name not in ADVICE else name
            raise _refusal(graph, what, "use float64, int32 or bool") from None
        known.update(zip(equation.outvars, out if isinstance(out, list) else [out]))
    return [read(a) for a in jaxpr.outvars]


def _where(equation) -> str:
    try:
        from importlib import import_module

        return import_module("jax._src.source_info_util").summarize(equation.source_info)
    except (ImportError, AttributeError):  # a private module: without it a refusal does not name the line
        return ""


def _refusal(graph: Graph, what: str, advice: str) -> Refused:
    place = f" ({graph.source})" if graph.source else ""
    return Refused(f"{what} cannot be exported to C{place}; {advice}.")


def _inner(params):
    """The jaxpr a call holds, with its constants."""
    inner = next(params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in params)
    return (inner.jaxpr, inner.consts) if hasattr(inner, "consts") and hasattr(inner, "jaxpr") else (inner, ())


def _equation(graph: Graph, name: str, x: list[Node], params, outvars):
    if name in CALLS:
        return lower(graph, *_inner(params), x)
    if name in SAME:
        return list(x)
    special = SPECIAL.get(name)
    if special is not None:
        return special(graph, x, params, outvars)
    name = RENAMED.get(name, name)
    if name in ELEMENTWISE and (x[0].kind in ELEMENTWISE[name].c):
        return graph.elementwise(name, *x, kind="b" if name in COMPARISONS else x[0].kind)
    raise _refusal(graph, name, ADVICE.get(name, "it has no counterpart there: write it with arithmetic, where, @ or cholesky"))


# Element by element.


def _as(graph: Graph, x: Node, dtype) -> Node:
    to = kind(dtype)
    return graph.elementwise(f"to_{to}", x, kind=to)


def _add(graph, x, params, outvars):
    for one, other in (x, x[::-1]):
        total = zeros.added(graph, one, other)
        if total is not None:
            return total
    return graph.elementwise("add", *x, kind=x[0].kind)


def _integer_pow(graph, x, params, outvars):
    """By squaring, as XLA does."""
    y, base, out = abs(int(params["y"])), x[0], None
    one = graph.broadcast(graph.const(np.ones((), NUMPY[base.kind])), base.shape, ())
    while y:
        if y & 1:
            out = base if out is None else graph.elementwise("mul", out, base, kind=base.kind)
        y >>= 1
        base = graph.elementwise("square", base, kind=base.kind) if y else base
    out = one if out is None else out
    return graph.elementwise("div", one, out, kind=out.kind) if params["y"] < 0 else out


def _one_minus_square(graph, x, params, outvars):
    """1 - x^2: what JAX from 0.12 on makes of the derivative of tanh."""
    one = graph.broadcast(graph.const(np.ones((), NUMPY[x[0].kind])), x[0].shape, ())
    return graph.elementwise("sub", one, graph.elementwise("square", x[0], kind=x[0].kind), kind=x[0].kind)


def _select(graph, x, params, outvars):
    which, cases = x[0], x[1:]
    if which.kind == "b":
        return graph.elementwise("select", which, *cases, kind=cases[0].kind)
    out = cases[-1]
    for k in reversed(range(len(cases) - 1)):
        here = graph.elementwise("le", which, graph.const(np.asarray(k, NUMPY[which.kind])), kind="b")
        out = graph.elementwise("select", here, out, cases[k], kind=out.kind)
    return out


# Where elements are.


def _between(graph: Graph, x: Node, axis: int, start: int, stop: int) -> Node:
    """x from start to stop along one axis."""
    ends = [(start, stop) if k == axis else (0, n) for k, n in enumerate(x.shape)]
    return graph.sliced(x, *zip(*ends))


def _split(graph, x, params, outvars):
    ends = np.cumsum([int(size) for size in params["sizes"]]).tolist()
    return [_between(graph, x[0], params["axis"], at, end) for at, end in zip([0, *ends], ends)]


def _unstack(graph, x, params, outvars):
    pieces = (_between(graph, x[0], params["axis"], at, at + 1) for at in range(len(outvars)))
    return [graph.reshaped(piece, var.aval.shape) for piece, var in zip(pieces, outvars)]


def _stack(graph, x, params, outvars):
    axis = params["axis"]
    shape = (*x[0].shape[:axis], 1, *x[0].shape[axis:])
    where = [k + (k >= axis) for k in range(len(x[0].shape))]
    return graph.concat([graph.broadcast(p, shape, where) for p in x], axis)


def _pad(graph, x, params, outvars):
    body, filling, config = x[0], x[1], params["padding_config"]
    if any(inside for _, _, inside in config):
        base = graph.broadcast(filling, outvars[0].aval.shape, ())
        grid = np.indices(body.shape)
        at = [low + g * (inside + 1) for (low, _, inside), g in zip(config, grid)]
        shape = base.shape
        inside_ = np.all([(0 <= a) & (a < n) for a, n in zip(at, shape)], axis=0)
        table = np.where(inside_, np.ravel_multi_index([np.clip(a, 0, n - 1) for a, n in zip(at, shape)], shape), -1)
        return _scattered(graph, base, body, table, "set")
    start = [max(0, -low) for low, _, _ in config]
    stop = [n - max(0, -high) for n, (_, high, _) in zip(body.shape, config)]
    body = graph.sliced(body, start, stop)
    for axis, (low, high, _) in enumerate(config):
        blocks = [graph.broadcast(filling, (*body.shape[:axis], max(0, n), *body.shape[axis + 1 :]), ()) for n in (low, high)]
        body = graph.concat([blocks[0], body, blocks[1]], axis)
    return body


def _tile(graph, x, params, outvars):
    out = x[0]
    for axis, times in enumerate(params["reps"]):
        out = graph.concat([out] * int(times), axis)
    return out


def _iota(graph, x, params, outvars):
    shape, axis = params["shape"], params["dimension"]
    line = np.arange(shape[axis]).reshape([-1 if k == axis else 1 for k in range(len(shape))])
    return graph.const(np.broadcast_to(line, shape).astype(NUMPY[kind(params["dtype"])]))


def _gather(graph, x, params, outvars):
    operand, index = x
    shape, known = outvars[0].aval.shape, value(index)
    if known is not None:
        table = indices.gathered(operand.shape, known, params, shape)
        fixed = value(operand)
        if fixed is not None:
            taken = fixed.reshape(-1)[np.maximum(table, 0)]
            return graph.const(np.where(table < 0, indices.filling(operand.kind, params), taken).astype(NUMPY[operand.kind]))
        axes = indices.affine(table, operand.shape)
        if axes is not None:
            return graph.view(operand, shape, axes)
        fill = None if table.min(initial=0) >= 0 else indices.filling(operand.kind, params)
        return graph.make("take", (graph.stored(operand),), shape, operand.kind, (table, fill), key=(table.tobytes(), str(fill)))
    axes, parts, dims, most = indices.run_time_gather(graph, operand.shape, index, params, shape)
    fill = indices.filling(operand.kind, params) if "FILL" in str(params["mode"]) else None
    return graph.make("pick", (operand, *parts), shape, operand.kind, (axes, dims, most, fill), key=(axes, dims, most, str(fill)))


def _dynamic_slice(graph, x, params, outvars):
    operand, sizes = x[0], tuple(int(n) for n in params["slice_sizes"])
    most = tuple(n - s for n, s in zip(operand.shape, sizes))
    starts, axes, free = [], [], []
    for d, index in enumerate(x[1:]):
        fixed = uniform(index)
        steps = tuple(int(j == d) for j in range(len(sizes)))
        axes.append((0 if fixed is None else min(max(int(fixed), 0), most[d]), steps))
        if fixed is None and most[d] > 0:
            free.append(d)
            starts.append(graph.broadcast(index, sizes, ()))
    axes = tuple(indices.Axis(*a) for a in axes)
    if not free:
        return graph.view(operand, sizes, axes)
    return graph.make("pick", (operand, *starts), sizes, operand.kind, (axes, tuple(free), tuple(most[d] for d in free), None))


def _dynamic_update_slice(graph, x, params, outvars):
    operand, update = x[0], x[1]
    most = tuple(n - s for n, s in zip(operand.shape, update.shape))
    return graph.make("update", (operand, update, *x[2:]), operand.shape, operand.kind, most)


def _scatter(how: str):
    def scatter(graph, x, params, outvars):
        operand, index, updates = x
        known = value(index)
        if known is None:
            raise _refusal(graph, "an index of .at[] known at run time only", ADVICE["scatter"])
        return _scattered(graph, operand, updates, indices.scattered(operand.shape, known, params, updates.shape), how)

    return scatter


def _scattered(graph, operand, updates, table, how):
    known = values(operand, updates)
    if known is not None:
        out, inside = known[0].reshape(-1).copy(), table >= 0
        if how == "set":
            out[table[inside]] = known[1][inside]
        else:
            accumulate = {"add": np.add, "mul": np.multiply, "min": np.minimum, "max": np.maximum}[how]
            accumulate.at(out, table[inside], known[1][inside])
        return graph.const(out.reshape(operand.shape))
    if indices.regular(table) is None:  # read by a table: one after the other
        updates = graph.stored(updates)
    return graph.make("scatter", (operand, updates), operand.shape, operand.kind, (table, how), key=(table.tobytes(), how))


# Many to one.


def _reduction(name: str):
    def reduce(graph, x, params, outvars):
        axes = tuple(int(a) for a in params["axes"])
        remaining = [k for k in range(len(x[0].shape)) if k not in axes]
        turned = graph.transposed(x[0], [*remaining, *axes])
        known = value(turned)
        last = tuple(range(len(remaining), len(turned.shape)))
        out = outvars[0].aval
        if known is not None:
            fold = {"sum": np.sum, "prod": np.prod, "max": np.max, "min": np.min, "and": np.all, "or": np.any}.get(name)
            if fold is not None:
                return graph.const(np.asarray(fold(known, axis=last)).astype(NUMPY[turned.kind]))
        if all(n == 1 for n in turned.shape[len(remaining) :]) and not name.startswith("arg"):
            return graph.reshaped(turned, out.shape)
        return graph.make("reduce", (turned,), out.shape, kind(out.dtype), (name, len(axes)))

    return reduce


def _cumulative(name: str):
    def accumulate(graph, x, params, outvars):
        return graph.make("cumulative", (x[0],), x[0].shape, x[0].kind, (name, int(params["axis"]), bool(params["reverse"])))

    return accumulate


# Linear algebra.


def _dot_general(graph, x, params, outvars):
    """Arguments are turned to (batch, free, contracted) and (batch, contracted, free)."""
    ((over_a, over_b), (batch_a, batch_b)) = params["dimension_numbers"]
    a, b = (_as(graph, one, outvars[0].aval.dtype) for one in x)
    free_a = [k for k in range(len(a.shape)) if k not in (*over_a, *batch_a)]
    free_b = [k for k in range(len(b.shape)) if k not in (*over_b, *batch_b)]
    a, b = graph.transposed(a, [*batch_a, *free_a, *over_a]), graph.transposed(b, [*batch_b, *over_b, *free_b])
    shape, n_batch, n_over = outvars[0].aval.shape, len(batch_a), len(over_a)
    va, vb = value(a), value(b)
    if va is not None and vb is not None:
        inner = int(np.prod(a.shape[len(a.shape) - n_over :]))
        batch = int(np.prod(a.shape[:n_batch]))
        return graph.const(np.matmul(va.reshape(batch, -1, inner), vb.reshape(batch, inner, -1)).reshape(shape))
    if a.kind == "b":
        raise KeyError("bool in a product")
    if not n_over:  # an outer product
        left = graph.broadcast(a, shape, range(len(a.shape)))
        right = graph.broadcast(b, shape, [*range(n_batch), *range(len(a.shape), len(shape))])
        return graph.elementwise("mul", left, right, kind=a.kind)
    if n_over == 1:
        simple = zeros.product(graph, a, b, n_batch) if n_batch else selections.product(graph, a, b)
        if simple is not None:
            return simple
    return graph.make("dot", (a, b), shape, a.kind, (n_batch, n_over))


def _triangular_solve(graph, x, params, outvars):
    if params["conjugate_a"] and x[0].kind != "f":
        raise KeyError("complex")
    how = (params["left_side"], params["lower"], params["transpose_a"], params["unit_diagonal"])
    return zeros.solved(graph, x[0], x[1], tuple(bool(h) for h in how))


# Control.


def _platform_index(graph, x, params, outvars):
    platforms = params["platforms"]
    usable = [k for k, p in enumerate(platforms) if p is not None and "cpu" in p]
    default = [k for k, p in enumerate(platforms) if p is None]
    return graph.const(np.asarray((usable + default)[0], np.int32))


def _cond(graph, x, params, outvars):
    branches, index = params["branches"], x[0]
    fixed = uniform(index)
    if fixed is not None:
        chosen = branches[min(max(int(fixed), 0), len(branches) - 1)]
        return lower(graph, chosen.jaxpr, chosen.consts, x[1:])
    regions, outputs, parent = [], [], _deepest(x)
    for branch in branches:
        region = Region(parent)
        inputs = [_inside(graph, a, region) for a in x[1:]]
        regions.append(region)
        outputs.append(tuple(lower(graph, branch.jaxpr, branch.consts, inputs)))
    args = (index, *_free([n for out in outputs for n in out], regions), *(a for a in x[1:] if value(a) is None))
    node = graph.make("cond", args, (), "n", Branches(tuple(regions), tuple(outputs)), key=False)
    return [graph.make("result", (node,), v.aval.shape, kind(v.aval.dtype), k) for k, v in enumerate(outvars)]


def _scan(graph, x, params, outvars):
    if "num_consts" in params:
        n_consts, n_carry = params["num_consts"], params["num_carry"]
    else:  # JAX from 0.12 on: trees of constants, carry and rows
        n_consts, n_carry, _ = (len(part) for part in params["ft_in"].unpack())
    body = params["jaxpr"]
    consts, inits, xs = x[:n_consts], x[n_consts : n_consts + n_carry], x[n_consts + n_carry :]
    region = Region(_deepest(x))
    carry = tuple(graph.param(a.shape, a.kind, ("carry", k), region) for k, a in enumerate(inits))
    xs = [a if uniform(a) is not None else graph.stored(a) for a in xs]
    each = [graph.param(a.shape[1:], a.kind, ("slice", a), region) if uniform(a) is None else _first(graph, a) for a in xs]
    slices = tuple(p for p in each if p.op == "param" and p.region is region)
    out = lower(graph, body.jaxpr, body.consts, [*consts, *carry, *each])
    out[:n_carry] = [_held_state(graph, new, old, region) for new, old in zip(out, carry)]
    loop = Loop(region, int(params["length"]), bool(params["reverse"]), carry, slices, tuple(out[:n_carry]), tuple(out[n_carry:]))
    args = (*inits, *xs, *_free(out, [region]))
    node = graph.make("scan", args, (), "n", loop, key=False)
    return [graph.make("result", (node,), v.aval.shape, kind(v.aval.dtype), k) for k, v in enumerate(outvars)]


def _inside(graph, a: Node, region: Region) -> Node:
    """The parameter that stands for an outside value within a branch."""
    if value(a) is not None:
        return a
    if a.op == "view":
        root = graph.param(a.args[0].shape, a.kind, ("alias", a.args[0]), region)
        return graph.view(root, a.shape, a.data)
    return graph.param(a.shape, a.kind, ("alias", a), region)


def _first(graph, a: Node) -> Node:
    """The slice for a single iteration of a value that is the same in every iteration."""
    return graph.broadcast(graph.const(np.asarray(uniform(a), NUMPY[a.kind])), a.shape[1:], ())


def _held_state(graph, new: Node, old: Node, region: Region) -> Node:
    """The new carry as a separate value, so that no iteration reads a half-written carry."""
    root = new.args[0] if new.op in ("view", "alias") else new
    if new is old or new.op == "const" or root.op != "param":
        return new
    return graph.make("copy", (new,), new.shape, new.kind, key=False, region=region)


def _deepest(nodes) -> Region:
    return max((n.region for n in nodes), key=lambda r: r.depth)


def _free(outputs, regions) -> tuple[Node, ...]:
    """Outside values that the regions use."""
    outside, seen, todo = [], set(), list(outputs)
    while todo:
        node = todo.pop()
        if node.index in seen:
            continue
        seen.add(node.index)
        if any(node.region.within(r) for r in regions):
            todo += node.args
            if node.op == "param" and node.data[0] in ("alias", "slice"):
                todo.append(node.data[1])
        else:
            outside.append(node)
    return tuple(outside)


SPECIAL = {
    # Element by element.
    "add": _add, "add_any": _add, "integer_pow": _integer_pow, "one_minus_square": _one_minus_square, "select_n": _select,
    "convert_element_type": lambda graph, x, params, outvars: _as(graph, x[0], params["new_dtype"]),
    "pow": lambda graph, x, params, outvars: graph.elementwise("pow", x[0], _as(graph, x[1], float), kind="f"),
    "round": lambda graph, x, params, outvars: graph.elementwise(
        "rint" if int(params["rounding_method"]) == 1 else "round", x[0], kind="f"),
    "clamp": lambda graph, x, params, outvars: graph.elementwise(
        "min", graph.elementwise("max", x[1], x[0], kind=x[1].kind), x[2], kind=x[1].kind),
    # Where elements are.
    "broadcast_in_dim": lambda graph, x, params, outvars: graph.broadcast(x[0], params["shape"], params["broadcast_dimensions"]),
    "slice": lambda graph, x, params, outvars: graph.sliced(
        x[0], params["start_indices"], params["limit_indices"], params["strides"]),
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"),
                    lambda graph, x, params, outvars: graph.reshaped(x[0], outvars[0].aval.shape)),
    "transpose": lambda graph, x, params, outvars: graph.transposed(x[0], params["permutation"]),
    "rev": lambda graph, x, params, outvars: graph.reversed(x[0], params["dimensions"]),
    "concatenate": lambda graph, x, params, outvars: graph.concat(x, params["dimension"]),
    "split": _split, "stack": _stack, "unstack": _unstack, "pad": _pad, "tile": _tile, "iota": _iota, "gather": _gather,
    "dynamic_slice": _dynamic_slice, "dynamic_update_slice": _dynamic_update_slice, "scatter": _scatter("set"),
    **{f"scatter-{how}": _scatter(how) for how in ("add", "mul", "min", "max")}, "scatter_add": _scatter("add"),
    # Many to one, linear algebra, control.
    **{f"reduce_{how}": _reduction(how) for how in ("sum", "prod", "max", "min", "and", "or")},
    "argmax": _reduction("argmax"), "argmin": _reduction("argmin"),
    "cumsum": _cumulative("sum"), "cumprod": _cumulative("prod"), "cummax": _cumulative("max"), "cummin": _cumulative("min"),
    "dot_general": _dot_general, "triangular_solve": _triangular_solve,
    "cholesky": lambda graph, x, params, outvars: zeros.cholesky(graph, x[0]),
    "platform_index": _platform_index, "cond": _cond, "scan": _scan,
}  # fmt: skip
