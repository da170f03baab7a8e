"""Interval arithmetic on compiled functions: a range that certainly holds every value a function takes over a box.

A function is traced once by JAX and its operations are evaluated on intervals instead of numbers (Moore 1966, "Interval
Analysis": the result of every operation holds all results for operands from their intervals, hence so does the whole).
Operands that do not depend on the box stay plain numbers. The range may be wider than the true one, when a variable occurs
several times, but never narrower, up to rounding: bounds are not rounded outwards, and are good to about 1e-14 relative.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from rotorwatch.base.backend import jax, jnp
from rotorwatch.errors import ConfigError


class Interval(namedtuple("Interval", "lo hi")):
    """All arrays between lo and hi, element by element."""


def evaluate(function, *arguments):
    """Interval (or plain array, where nothing depends on the box) that holds function(*arguments).

    arguments: arrays or Intervals of float64 arrays. function: made of operations that are known here; returns one array.
    Raises ConfigError that names the operation otherwise.
    """
    closed = jax.make_jaxpr(function)(*[a.lo if isinstance(a, Interval) else a for a in arguments])

    def rule(equation, operands):
        if equation.primitive.name == "mul" and equation.invars[0] is equation.invars[1]:
            return [_power(operands[0], 2)]
        return apply(equation, operands)

    return walk(closed.jaxpr, closed.consts, arguments, rule, Interval)[0]


def second_order_remainder(function, centre, lo, hi):
    """Interval of function(z) - function(centre) - J (z - centre) over all z in the box [lo, hi], J the Jacobian at the centre.

    Lagrange: it is 1/2 d' Hess d with d = z - centre, the Hessian at some point on the way to z. Each of its elements is bounded
    over the box by interval arithmetic, and 1/2 sum_ij Hess_ij d_i d_j is summed term by term, with d_i^2 for a square. So d is
    let loose once for each pair, not at each of the plant's operations. function: (n,) -> (m,), smooth over the box: a kink has no
    second derivative and is not seen (`taylor` bounds it); all (n,).
    """
    n = centre.shape[0]
    i, j = np.triu_indices(n)

    def second_derivatives(z):
        """(n (n + 1) / 2, m): of every pair of directions."""
        unit = np.eye(n)
        return jax.vmap(lambda a, b: jax.jvp(lambda point: jax.jvp(function, (point,), (a,))[1], (z,), (b,))[1])(unit[i], unit[j])

    lo, hi = jnp.minimum(lo, centre), jnp.maximum(hi, centre)  # the way there belongs to the box
    H = _ends(evaluate(second_derivatives, Interval(lo, hi)))
    low, high = lo - centre, hi - centre
    products = _multiply(None, Interval(low[i], high[i]), Interval(low[j], high[j]))
    pairs = Interval(  # half of a square, and the whole of two equal products
        jnp.where(i == j, 0.0, products.lo), jnp.where(i == j, 0.5 * jnp.maximum(low[i] ** 2, high[i] ** 2), products.hi)
    )
    terms = _multiply(None, H, Interval(pairs.lo[:, None], pairs.hi[:, None]))
    return Interval(terms.lo.sum(0), terms.hi.sum(0))


def walk(jaxpr, consts, arguments, rule, kinds) -> list:
    """The results of a traced function: `rule(equation, operands)` where an operand is one of `kinds`, else the operation itself."""
    values: dict = {}

    def read(atom):
        return atom.val if hasattr(atom, "val") else values[atom]  # a literal, or a variable

    def write(variables, results):
        values.update(zip(variables, results, strict=True))

    write(jaxpr.constvars, consts)
    write(jaxpr.invars, arguments)
    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        name = equation.primitive.name
        if name in CALLS:
            inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
            inner = (inner.jaxpr, inner.consts) if hasattr(inner, "consts") else (inner, ())
            results = walk(*inner, operands, rule, kinds)
        elif not any(isinstance(operand, kinds) for operand in operands):
            out = equation.primitive.bind(*operands, **equation.params)
            results = out if equation.primitive.multiple_results else [out]
        else:
            results = rule(equation, operands)
        write(equation.outvars, results)
    return [read(atom) for atom in jaxpr.outvars]


def apply(equation, operands) -> list:
    """Results of one traced operation on operands of which some are Intervals. Raises ConfigError where no rule is known."""
    name = equation.primitive.name
    if name == "split":
        parts = (equation.primitive.bind(end, **equation.params) for end in operands[0])
        return [Interval(lo, hi) for lo, hi in zip(*parts, strict=True)]
    if name not in RULES:
        raise ConfigError(f"The plant's operation {name!r} has no interval rule; choose another remainder.")
    return [RULES[name](equation, *operands)]


CALLS = frozenset({"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "checkpoint"})


def _ends(value):
    return value if isinstance(value, Interval) else Interval(value, value)


def _bind(equation, *operands):
    out = equation.primitive.bind(*operands, **equation.params)
    return out[0] if equation.primitive.multiple_results else out


def _rising(equation, *operands):
    """Operations that grow with every operand; moving and copying elements is one."""
    ends = [_ends(operand) for operand in operands]
    return Interval(_bind(equation, *[e.lo for e in ends]), _bind(equation, *[e.hi for e in ends]))


def _falling(equation, operand):
    return Interval(_bind(equation, operand.hi), _bind(equation, operand.lo))


def _subtract(equation, a, b):
    a, b = _ends(a), _ends(b)
    return Interval(a.lo - b.hi, a.hi - b.lo)


def _hull(*candidates):
    lo, hi = candidates[0], candidates[0]
    for candidate in candidates[1:]:
        lo, hi = jnp.minimum(lo, candidate), jnp.maximum(hi, candidate)
    return Interval(lo, hi)


def _multiply(equation, a, b):
    if not isinstance(a, Interval):
        a, b = b, a
    if not isinstance(b, Interval):
        return _hull(a.lo * b, a.hi * b)
    return _hull(a.lo * b.lo, a.lo * b.hi, a.hi * b.lo, a.hi * b.hi)


def _divide(equation, a, b):
    if not isinstance(b, Interval):
        return _multiply(equation, a, 1.0 / b)
    without_zero = (b.lo > 0) | (b.hi < 0)
    inverse = Interval(jnp.where(without_zero, 1.0 / b.hi, -jnp.inf), jnp.where(without_zero, 1.0 / b.lo, jnp.inf))
    return _multiply(equation, a, inverse)


def _power(a, exponent: int):
    if exponent < 0:
        return _divide(None, Interval(1.0, 1.0), _power(a, -exponent))
    lo, hi = a.lo**exponent, a.hi**exponent
    if exponent % 2:
        return Interval(lo, hi)
    least = jnp.where((a.lo <= 0) & (a.hi >= 0), 0.0, jnp.minimum(lo, hi))
    return Interval(least, jnp.maximum(lo, hi))


def _real_power(equation, a, b):
    """a**b of a positive base: exp(b log a)."""
    a = _ends(a)
    exponent = _multiply(None, _ends(b), Interval(jnp.log(jnp.maximum(a.lo, 0.0)), jnp.log(jnp.maximum(a.hi, 0.0))))
    return Interval(jnp.exp(exponent.lo), jnp.exp(exponent.hi))


def _square_root(equation, a):
    """Outside its domain it is 0: a box may reach further than the function."""
    return Interval(jnp.sqrt(jnp.maximum(a.lo, 0.0)), jnp.sqrt(jnp.maximum(a.hi, 0.0)))


def _absolute(equation, a):
    return Interval(jnp.maximum(jnp.maximum(a.lo, -a.hi), 0.0), jnp.maximum(-a.lo, a.hi))


def _wave(a, crest: float):
    """A cosine that is 1 at `crest`."""

    def touches(place):
        return jnp.ceil((a.lo - place) / (2 * math.pi)) * 2 * math.pi + place <= a.hi

    ends = _hull(jnp.cos(a.lo - crest), jnp.cos(a.hi - crest))
    return Interval(jnp.where(touches(crest + math.pi), -1.0, ends.lo), jnp.where(touches(crest), 1.0, ends.hi))


def _tangent(equation, a):
    pole = jnp.ceil((a.lo - math.pi / 2) / math.pi) * math.pi + math.pi / 2 <= a.hi
    return Interval(jnp.where(pole, -jnp.inf, jnp.tan(a.lo)), jnp.where(pole, jnp.inf, jnp.tan(a.hi)))


def _dot(equation, a, b):
    """Exact range when one factor is plain; else by midpoint and radius (Rump 1999), at most 1.5 times as wide."""
    if not isinstance(a, Interval) or not isinstance(b, Interval):
        box, fixed = (a, b) if isinstance(a, Interval) else (b, a)
        mid, rad = 0.5 * (box.lo + box.hi), 0.5 * (box.hi - box.lo)
        pairs = (((mid, fixed), (rad, jnp.abs(fixed))), ((fixed, mid), (jnp.abs(fixed), rad)))[box is b]
        centre, radius = (_bind(equation, *pair) for pair in pairs)
        return Interval(centre - radius, centre + radius)
    (ma, ra), (mb, rb) = ((0.5 * (e.lo + e.hi), 0.5 * (e.hi - e.lo)) for e in (a, b))
    centre = _bind(equation, ma, mb)
    radius = _bind(equation, jnp.abs(ma), rb) + _bind(equation, ra, jnp.abs(mb) + rb)
    return Interval(centre - radius, centre + radius)


def _triangular(equation, a, b):
    """Solution of a plain triangular system with an interval right-hand side: its inverse times the interval."""
    if isinstance(a, Interval):
        raise ConfigError("A matrix that depends on the state is inverted; choose a remainder that is not an interval.")
    centre, radius = _bind(equation, a, 0.5 * (b.lo + b.hi)), absolute_solve(equation, a, 0.5 * (b.hi - b.lo))
    return Interval(centre - radius, centre + radius)


def absolute_solve(equation, a, b):
    """|a^-1| b (or b |a^-1|) of a traced triangular solution: how far errors of at most b reach."""
    eye = jnp.broadcast_to(jnp.eye(a.shape[-1]), a.shape)
    inverse = jnp.abs(_bind(equation, a, eye))
    return inverse @ b if equation.params["left_side"] else b @ inverse


def _compare(equation, a, b):
    """Interval of truth values: lo where it certainly holds, hi where it may."""
    a, b = _ends(a), _ends(b)
    name = equation.primitive.name
    if name in ("lt", "le"):
        return Interval(_bind(equation, a.hi, b.lo), _bind(equation, a.lo, b.hi))
    if name in ("gt", "ge"):
        return Interval(_bind(equation, a.lo, b.hi), _bind(equation, a.hi, b.lo))
    same, overlap = (a.lo == a.hi) & (b.lo == b.hi) & (a.lo == b.lo), (a.lo <= b.hi) & (b.lo <= a.hi)
    return Interval(same, overlap) if name == "eq" else Interval(~overlap, ~same)


def _choose(equation, which, *cases):
    ends = [_ends(case) for case in cases]
    if not isinstance(which, Interval):
        return Interval(_bind(equation, which, *[e.lo for e in ends]), _bind(equation, which, *[e.hi for e in ends]))
    no, yes = ends
    either = _hull(no.lo, yes.lo).lo, _hull(no.hi, yes.hi).hi
    return Interval(
        jnp.where(which.lo, yes.lo, jnp.where(which.hi, either[0], no.lo)),
        jnp.where(which.lo, yes.hi, jnp.where(which.hi, either[1], no.hi)),
    )


_STRUCTURAL = (
    "broadcast_in_dim reshape transpose squeeze slice concatenate stack tile pad rev expand_dims copy "
    "gather dynamic_slice reduce_sum reduce_max reduce_min cumsum and or convert_element_type stop_gradient reduce_precision real"
).split()
_INCREASING = "add add_any max min clamp exp exp2 expm1 log log1p tanh sinh atan asin asinh cbrt erf logistic floor ceil sign".split()
RULES = {
    **dict.fromkeys(_STRUCTURAL + _INCREASING, _rising),
    **dict.fromkeys(("lt", "le", "gt", "ge", "eq", "ne"), _compare),
    "neg": _falling,
    "not": _falling,
    "acos": _falling,
    "erfc": _falling,
    "sub": _subtract,
    "mul": _multiply,
    "div": _divide,
    "integer_pow": lambda equation, a: _power(a, equation.params["y"]),
    "square": lambda equation, a: _power(a, 2),
    "pow": _real_power,
    "sqrt": _square_root,
    "rsqrt": lambda equation, a: _divide(None, Interval(1.0, 1.0), _square_root(None, a)),
    "abs": _absolute,
    "sin": lambda equation, a: _wave(a, math.pi / 2),
    "cos": lambda equation, a: _wave(a, 0.0),
    "tan": _tangent,
    "dot_general": _dot,
    "triangular_solve": _triangular,
    "select_n": _choose,
}
