"""First-order Taylor models over an ellipsoid: a function's value, slope, and a bound of everything else.

Over all z = a + d with d in E(0, P) every intermediate result of a function is written

    value = c + g'd + rest,   |rest| <= e,    and, where something more is known,   lo <= value <= hi

A linear operation keeps the form. A product of two linear parts lies within 1/2 (g1'P g2 +- |g1| |g2|), |g| = sqrt(g'Pg): the
exact range of a quadratic form over an ellipsoid. A smooth operation of one operand adds its distance from its tangent over the
operand's range: exactly when it bends one way there, else by half its second derivative, bounded by interval arithmetic.
Correlations within P count, so the bounds are much tighter than those of interval arithmetic over the box around the
ellipsoid, and they hold as certainly.
Source: Makino and Berz, "Taylor models and other validated functional inclusion methods", 2003, of order one, with
ellipsoids for boxes.
"""

from __future__ import annotations

from collections import namedtuple

from rotorwatch.base.backend import jax, jnp
from rotorwatch_lab.maths import interval
from rotorwatch_lab.maths.interval import Interval


class Model(namedtuple("Model", "c g e lo hi")):
    """c, e, lo, hi: (*shape,); g: (k, *shape), the slope in k directions; (2 k, *shape) with what `_Rules` measures it by."""


def expand(function, a, slope, metric=None, lo=None, hi=None) -> tuple:
    """(c (m,), g (m, k), e (m,)) with |function(a + slope' xi) - c - g xi| <= e for all admitted xi (k,). function (n,) -> (m,).

    slope (k, n): L' of P = L L', for xi in the unit ball (metric None); or the unit matrix, for xi = d in E(0, metric). Both
    say the same. lo, hi (n,): what is known about the argument besides. Raises ConfigError for operations without a rule.
    """
    closed = jax.make_jaxpr(function)(a)
    k = slope.shape[0]
    rules = _Rules(k, metric is not None)
    both = slope if metric is None else jnp.concatenate([slope, metric @ slope])
    reach = rules.size(both)
    ends = [a - reach if lo is None else jnp.maximum(a - reach, lo), a + reach if hi is None else jnp.minimum(a + reach, hi)]
    start = Model(a, both, jnp.zeros(a.shape), *ends)
    model = interval.walk(closed.jaxpr, closed.consts, [start], rules.apply, (Model, Interval))[0]
    if not isinstance(model, Model):
        model = jnp.asarray(model)
        return model, jnp.zeros((model.shape[0], k)), jnp.zeros(model.shape)
    return model.c, model.g[:k].T, model.e


class _Rules:
    """Evaluates traced operations on models. k: directions. measured: whether a slope (2 k, *shape) is g and P g, one above the
    other, so that what is done to g is done to P g as well and no operation need multiply by P."""

    def __init__(self, k: int, measured: bool):
        self.k, self.measured = k, measured

    def apply(self, equation, operands: list) -> list:
        """Results of one traced operation."""
        name = equation.primitive.name
        models = [operand for operand in operands if isinstance(operand, Model)]
        if any(isinstance(operand, Interval) for operand in operands):
            return self.flat(equation, operands)
        if name in LINEAR or (name in BILINEAR and len(models) == 1 and (name != "div" or operands[0] is models[0])):
            return self.linear(equation, operands)
        if name == "mul":
            return [self.multiply(*operands)]
        if name == "div":
            over = Model(*operands[1])
            inverse = self.smooth(lambda y: 1.0 / y, over)
            x = operands[0]
            return [self.multiply(x, inverse) if isinstance(x, Model) else self.times(inverse, x)]
        if name in SMOOTH:
            return [self.smooth(lambda x: equation.primitive.bind(x, **equation.params), operands[0])]
        if name == "clamp" and isinstance(operands[1], Model) and len(models) == 1:
            return [self.clip(operands[1], operands[0], operands[2])]
        if name in ("max", "min") and len(models) == 1:
            x, bound = operands if isinstance(operands[0], Model) else operands[::-1]
            bound = bound if jnp.ndim(bound) else jnp.broadcast_to(bound, x.c.shape)
            return [self.clip(x, bound, jnp.inf) if name == "max" else self.clip(x, -jnp.inf, bound)]
        return self.flat(equation, operands)

    def size(self, g):
        """sqrt(g' P g)."""
        return jnp.sqrt(jnp.maximum(self.inner(g, g), 0.0))

    def inner(self, g, other):
        """g' P other."""
        return (g[: self.k] * other[self.k :]).sum(0) if self.measured else (g * other).sum(0)

    def range(self, x) -> Interval:
        """All values a model can take."""
        if not isinstance(x, Model):
            return x if isinstance(x, Interval) else Interval(x, x)
        reach = self.size(x.g) + x.e
        return Interval(jnp.maximum(x.c - reach, x.lo), jnp.minimum(x.c + reach, x.hi))

    def linear(self, equation, operands) -> list:
        """An operation that is linear in its one model, or in all of them together: done to centres and slopes alike."""
        name, several = equation.primitive.name, equation.primitive.multiple_results

        def bind(*values):
            if name == "dot_general":
                return (_dot(equation, *values),)
            out = equation.primitive.bind(*values, **equation.params)
            return tuple(out) if several else (out,)

        def pick(part, other):
            return [part(o) if isinstance(o, Model) else other(o) for o in operands]

        same, nothing = (lambda o: o), (lambda o: jnp.zeros_like(o))
        affine = name in ("add", "add_any", "sub", "concatenate", "stack", "pad")
        centre = bind(*pick(lambda m: m.c, same))
        axes = [0 if isinstance(o, Model) else None for o in operands]
        slope = jax.vmap(bind, in_axes=axes)(*pick(lambda m: m.g, nothing if affine else same))
        size = nothing if affine else (lambda o: jnp.abs(o) if jnp.issubdtype(jnp.result_type(o), jnp.floating) else o)
        if name in ("sub", "neg"):
            errors = pick(lambda m: m.e, nothing)
            error = (errors[0] if name == "neg" else errors[0] + errors[1],)
        elif name == "triangular_solve":
            error = (interval.absolute_solve(equation, operands[0], operands[1].e),)
        else:
            error = bind(*pick(lambda m: m.e, size))
        if name in MOVING:  # what is known of the operands stays known
            ends = (bind(*pick(lambda m: m.lo, same)), bind(*pick(lambda m: m.hi, same)))
        else:
            free = tuple(jnp.full(c.shape, jnp.inf) for c in centre)
            ends = (tuple(-f for f in free), free)
        return [Model(*parts) for parts in zip(centre, slope, error, *ends, strict=True)]

    def times(self, x: Model, factor) -> Model:
        c = x.c * factor
        free = jnp.full(c.shape, jnp.inf)
        return Model(c, x.g * factor, x.e * jnp.abs(factor), -free, free)

    def multiply(self, x: Model, y: Model) -> Model:
        size_x, size_y = self.size(x.g), self.size(y.g)
        c = x.c * y.c + 0.5 * self.inner(x.g, y.g)
        e = 0.5 * size_x * size_y + (jnp.abs(x.c) + size_x) * y.e + (jnp.abs(y.c) + size_y) * x.e + x.e * y.e
        free = jnp.full(c.shape, jnp.inf)
        return Model(c, x.c * y.g + y.c * x.g, e, -free, free)

    def smooth(self, function, x: Model) -> Model:
        """A smooth operation on one operand, by Lagrange's remainder over the operand's range."""
        reach = self.range(x)
        centre = jnp.clip(x.c, reach.lo, reach.hi)

        def slope(t):
            return jax.jvp(function, (t,), (jnp.ones_like(t),))[1]

        value, first = jax.jvp(function, (centre,), (jnp.ones_like(centre),))
        bend = interval.evaluate(lambda t: jax.jvp(slope, (t,), (jnp.ones_like(t),))[1], reach)
        bend = bend if isinstance(bend, Interval) else Interval(bend, bend)
        square = jnp.maximum(reach.hi - centre, centre - reach.lo) ** 2
        # Where it bends one way only, the tangent is furthest from it at the ends: exact, and finite at a root of 0.
        tangent_error = [function(t) - value - first * (t - centre) for t in (reach.lo, reach.hi)]
        one_way = (bend.lo >= 0) | (bend.hi <= 0)
        low = jnp.where(one_way, jnp.minimum(*tangent_error), 0.5 * jnp.minimum(bend.lo, 0.0) * square)
        high = jnp.where(one_way, jnp.maximum(*tangent_error), 0.5 * jnp.maximum(bend.hi, 0.0) * square)
        low, high = jnp.minimum(low, 0.0), jnp.maximum(high, 0.0)
        c = value + first * (x.c - centre) + 0.5 * (low + high)
        e = jnp.abs(first) * x.e + 0.5 * (high - low)
        # At the edge of its domain (a root of what may be 0) there is no slope: only the range is known.
        whole = interval.evaluate(function, reach)
        fine = jnp.isfinite(c) & jnp.isfinite(e)
        return Model(
            jnp.where(fine, c, 0.5 * (whole.lo + whole.hi)),
            jnp.where(fine, first * x.g, 0.0),
            jnp.where(fine, e, 0.5 * (whole.hi - whole.lo)),
            whole.lo,
            whole.hi,
        )

    def clip(self, x: Model, low, high) -> Model:
        """Clipping by its chord over the operand's range; the largest distances between both are at the corners."""
        reach = self.range(x)
        ends = Interval(jnp.clip(reach.lo, low, high), jnp.clip(reach.hi, low, high))
        width = reach.hi - reach.lo
        slope = jnp.where(width > 0, (ends.hi - ends.lo) / jnp.where(width > 0, width, 1.0), 1.0)

        def chord_error(corner):
            corner = jnp.clip(corner, reach.lo, reach.hi)
            return jnp.clip(corner, low, high) - ends.lo - slope * (corner - reach.lo)

        gaps = (
            jnp.minimum(jnp.minimum(chord_error(low), chord_error(high)), 0.0),
            jnp.maximum(jnp.maximum(chord_error(low), chord_error(high)), 0.0),
        )
        c = ends.lo + slope * (x.c - reach.lo) + 0.5 * (gaps[0] + gaps[1])
        return Model(c, slope * x.g, slope * x.e + 0.5 * (gaps[1] - gaps[0]), ends.lo, ends.hi)

    def flat(self, equation, operands) -> list:
        """Any other operation: its range by interval arithmetic, without a slope."""
        inputs = [self.range(o) if isinstance(o, Model) else o for o in operands]
        found = interval.apply(equation, inputs)
        results = []
        for out in found:
            if out.lo.dtype == bool:  # certainly true, possibly true: a comparison
                results.append(out)
                continue
            c, e = 0.5 * (out.lo + out.hi), 0.5 * (out.hi - out.lo)
            results.append(Model(c, jnp.zeros((2 * self.k if self.measured else self.k, *c.shape)), e, out.lo, out.hi))
        return results


def _dot(equation, a, b):
    """A product as a sum of products: `small`."""
    (left, right), batch = equation.params["dimension_numbers"]
    if any(batch):
        return equation.primitive.bind(a, b, **equation.params)
    a, b = (jnp.moveaxis(x, axes, range(-len(axes), 0)) for x, axes in ((a, left), (b, right)))
    n_free = a.ndim - len(left)
    a = a.reshape(*a.shape[:n_free], *[1] * (b.ndim - len(right)), *a.shape[n_free:])
    return (a * b).sum(tuple(range(-len(left), 0)))


MOVING = frozenset(
    "broadcast_in_dim reshape transpose squeeze slice split concatenate stack rev expand_dims copy gather dynamic_slice".split()
)
LINEAR = MOVING | frozenset("neg add add_any sub pad reduce_sum cumsum convert_element_type real".split())
BILINEAR = frozenset(("mul", "div", "dot_general", "triangular_solve"))
SMOOTH = frozenset("sin cos tan exp log sqrt rsqrt integer_pow square tanh log1p expm1 exp2 atan sinh asinh logistic".split())
