"""C functions for products, Cholesky factors and triangular systems, written for one shape each.

Each returns (stem of the name, text with @ for the name). out is row-major; arguments have steps of their own, so that transposes
and slices need no copy.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rotorwatch.compiling.c99.graph import strides

ROWS = 4  # rows of a product computed side by side: more do not fit the registers
PACKED = 512  # elements of the right factor that are copied when they do not lie in a row
WIDE = 64  # columns that are summed in registers and stack, not in the result


class Product(NamedTuple):
    """out[b, i, j] = sum_k A[b, i, k] B[b, k, j]. Each group of axes: (size, step in out, step in A, step in B), merged where they
    lie one after the other."""

    batch: tuple[tuple[int, int, int, int], ...]
    rows: tuple[tuple[int, int, int, int], ...]
    inner: tuple[tuple[int, int, int, int], ...]
    columns: tuple[tuple[int, int, int, int], ...]

    @classmethod
    def of(cls, shape_a, steps_a, shape_b, steps_b, out, n_batch: int, n_inner: int) -> Product:
        """A (batch, rows, inner), B (batch, inner, columns); out: steps of the result."""
        free_a, free_b = len(shape_a) - n_batch - n_inner, len(shape_b) - n_batch - n_inner
        batch = [(shape_a[k], out[k], steps_a[k], steps_b[k]) for k in range(n_batch)]
        rows = [(shape_a[k], out[k], steps_a[k], 0) for k in range(n_batch, n_batch + free_a)]
        inner = [(shape_b[n_batch + k], 0, steps_a[n_batch + free_a + k], steps_b[n_batch + k]) for k in range(n_inner)]
        columns = [
            (shape_b[n_batch + n_inner + k], out[n_batch + free_a + k], 0, steps_b[n_batch + n_inner + k])
            for k in range(free_b)
        ]
        return cls(*(_merged(group) for group in (batch, rows, inner, columns)))

    def swapped(self) -> Product:
        """The same with rows and columns exchanged: out' = B' A'."""

        def turn(group):
            return tuple((n, o, b, a) for n, o, a, b in group)

        return Product(turn(self.batch), turn(self.columns), turn(self.inner), turn(self.rows))


def _merged(group):
    """Axes of length 1 dropped; neighbours that lie one after the other in out, A and B made one."""
    out: list[tuple[int, int, int, int]] = []
    for n, *steps in group:
        if n == 1:
            continue
        if out and all(p == s * n for p, s in zip(out[-1][1:], steps)):
            n *= out.pop()[0]
        out.append((n, *steps))
    return tuple(out)


class _Text:
    """Lines of one function."""

    def __init__(self, head: str):
        self.lines, self.depth = [head, "{"], 1

    def line(self, text: str):
        self.lines.append("    " * self.depth + text)

    def loop(self, name: str, n: int, first: int = 0, step: int = 1):
        turn = f"++{name}" if step == 1 else f"{name} += {step}"
        self.line(f"for (int {name} = {first}; {name} < {n}; {turn}) {{")
        self.depth += 1

    def end(self, times: int = 1):
        for _ in range(times):
            self.depth -= 1
            self.line("}")

    def done(self) -> str:
        return "\n".join([*self.lines, "}"])


def _at(offset: int, *terms: tuple[int, str]) -> str:
    parts = [name if step == 1 else f"{step} * {name}" for step, name in terms if step]
    if offset or not parts:
        parts.insert(0, str(offset))
    return " + ".join(parts).replace("+ -", "- ")


def product(p: Product, kind: str) -> tuple[str, str]:
    """out = A B, rows four at a time, columns innermost where they lie side by side."""
    flipped = False
    if _contiguous(p.columns, 3) < _contiguous(p.rows, 2):
        p, flipped = p.swapped(), True
    a, b = ("b", "a") if flipped else ("a", "b")
    text = _Text(f"static void @({kind} *restrict out, const {kind} *a, const {kind} *b)")
    outer = (
        [("b", axis) for axis in p.batch]
        + [("r", axis) for axis in p.rows[:-1]]
        + [("c", axis) for axis in p.columns[:-1]]
    )
    rows = p.rows[-1] if p.rows else (1, 0, 0, 0)
    columns = p.columns[-1] if p.columns else (1, 0, 0, 0)
    names = [f"{letter}{k}" for k, (letter, _) in enumerate(outer)]
    here_out = [(axis[1], name) for name, (_, axis) in zip(names, outer)]
    here_a = [(axis[2], name) for name, (_, axis) in zip(names, outer)]
    here_b = [(axis[3], name) for name, (_, axis) in zip(names, outer)]
    for name, (_, axis) in zip(names, outer):
        text.loop(name, axis[0])
    inner_b = [(axis[3], f"k{k}") for k, axis in enumerate(p.inner)]
    n_inner = math.prod(axis[0] for axis in p.inner)
    pack = columns[0] > 1 and columns[3] != 1 and rows[0] >= ROWS and n_inner * columns[0] <= PACKED
    if pack:
        text.line(f"{kind} packed[{n_inner * columns[0]}];")
        for k, axis in enumerate(p.inner):
            text.loop(f"k{k}", axis[0])
        packed_steps = strides(tuple(axis[0] for axis in p.inner))
        text.loop("j", columns[0])
        to = _at(0, *((columns[0] * s, f"k{k}") for k, s in enumerate(packed_steps)), (1, "j"))
        text.line(f"packed[{to}] = {b}[{_at(0, *here_b, *inner_b, (columns[3], 'j'))}];")
        text.end(len(p.inner) + 1)
        b = "packed"
        here_b = []
        inner_b = [(columns[0] * s, f"k{k}") for k, s in enumerate(packed_steps)]
        columns = (columns[0], columns[1], 0, 1)
    # Three at a time where that leaves nothing over: half the code.
    together = 3 if rows[0] % ROWS and rows[0] % 3 == 0 else ROWS
    full = rows[0] // together * together
    if full:
        _block(text, p, kind, a, b, here_out, here_a, here_b, inner_b, rows, columns, ("i", full, together))
    for left in range(full, rows[0]) if rows[0] - full < 2 else ():
        _block(text, p, kind, a, b, here_out, here_a, here_b, inner_b, rows, columns, (str(left), 0, 1))
    if rows[0] - full >= 2:
        _block(text, p, kind, a, b, here_out, here_a, here_b, inner_b, rows, columns, (str(full), 0, rows[0] - full))
    text.end(len(outer))
    return "product", text.done()


def _contiguous(group, which: int) -> int:
    """How many elements lie side by side."""
    return group[-1][0] if group and group[-1][which] == 1 else 1


def _block(text: _Text, p, kind, a, b, here_out, here_a, here_b, inner_b, rows, columns, which):
    """`count` rows at once: from `first`, or in a loop over `first` up to `stop`."""
    first, stop, count = which
    J = columns[0]
    if stop:
        text.loop(first, stop, 0, count)
        row = [(rows[1], first)], [(rows[2], first)], 0, 0
    else:
        row = [], [], rows[1] * int(first), rows[2] * int(first)
        text.line("{")
        text.depth += 1
    sums = [f"s{r}" for r in range(count)]
    wide = J > 1
    if J > WIDE:
        return _wide_block(text, p, kind, a, b, here_out, here_a, here_b, inner_b, rows, columns, row, count)
    for s in sums:
        text.line(f"{kind} {s}[{J}] = {{0}};" if wide else f"{kind} {s} = 0;")
    inner_a = [(axis[2], f"k{k}") for k, axis in enumerate(p.inner)]
    for k, axis in enumerate(p.inner):
        text.loop(f"k{k}", axis[0])
    for r, _ in enumerate(sums):
        text.line(f"const {kind} x{r} = {a}[{_at(row[3] + r * rows[2], *here_a, *row[1], *inner_a)}];")
    if wide:
        text.loop("j", J)
    text.line(f"const {kind} y = {b}[{_at(0, *here_b, *inner_b, *([(columns[3], 'j')] if wide else []))}];")
    for r, s in enumerate(sums):
        text.line(f"{s}{'[j]' if wide else ''} += x{r} * y;")
    text.end(len(p.inner) + wide)
    if wide:
        text.loop("j", J)
    for r, s in enumerate(sums):
        to = _at(row[2] + r * rows[1], *here_out, *row[0], *([(columns[1], "j")] if wide else []))
        text.line(f"out[{to}] = {s}{'[j]' if wide else ''};")
    text.end(wide + 1)
    return None


def _wide_block(text: _Text, p, kind, a, b, here_out, here_a, here_b, inner_b, rows, columns, row, count):
    """The same, summed in the result: too many columns for the stack."""
    inner_a = [(axis[2], f"k{k}") for k, axis in enumerate(p.inner)]
    goals = [f"out[{_at(row[2] + r * rows[1], *here_out, *row[0], (columns[1], 'j'))}]" for r in range(count)]
    text.loop("j", columns[0])
    for goal in goals:
        text.line(f"{goal} = 0;")
    text.end()
    for k, axis in enumerate(p.inner):
        text.loop(f"k{k}", axis[0])
    for r in range(count):
        text.line(f"const {kind} x{r} = {a}[{_at(row[3] + r * rows[2], *here_a, *row[1], *inner_a)}];")
    text.loop("j", columns[0])
    for r, goal in enumerate(goals):
        text.line(f"{goal} += x{r} * {b}[{_at(0, *here_b, *inner_b, (columns[3], 'j'))}];")
    text.end(len(p.inner) + 2)


def cholesky(shape) -> tuple[str, str]:
    """A's lower triangle becomes L with A = L L'; zero above the diagonal; all NaN below it when A is not positive definite."""
    n, text = shape[-1], _Text("static void @(real *restrict a)")
    _batch(text, shape)
    for line in f"""bool definite = true;
for (int j = 0; j < {n}; ++j) {{
    real column[{n}];
    if (!(a[{n + 1} * j] > 0)) definite = false;
    const real d = r_sqrt(a[{n + 1} * j]), w = R(1.0) / d;
    a[{n + 1} * j] = d;
    for (int i = j + 1; i < {n}; ++i) {{
        column[i] = a[{n} * i + j] *= w;
        a[{n} * j + i] = 0;
    }}
    for (int i = j + 1; i < {n}; ++i) {{
        const real x = column[i];
        for (int k = j + 1; k <= i; ++k)
            a[{n} * i + k] -= x * column[k];
    }}
}}
if (!definite)
    for (int i = 0; i < {n}; ++i)
        for (int j = 0; j <= i; ++j)
            a[{n} * i + j] = (real)NAN;""".splitlines():
        text.line(line)
    text.end(len(shape) > 2)
    return "cholesky", text.done()


def triangular(shape_a, steps_a, shape, left: bool, lower: bool, transposed: bool, unit: bool) -> tuple[str, str]:
    """x holds B and becomes X with op(A) X = B (left) or X op(A) = B."""
    batch, steps = shape[:-2], strides(shape)
    text = _Text(f"static void @(real *restrict {'x0' if batch else 'x'}, const real *{'a0' if batch else 'a'})")
    for k, n in enumerate(batch):
        text.loop(f"m{k}", n)
    names = [f"m{k}" for k in range(len(batch))]
    if names:
        text.line(f"real *const x = x0 + {_at(0, *zip(steps, names))};")
        text.line(f"const real *const a = a0 + {_at(0, *zip(steps_a, names))};")
    n = shape_a[-1]
    row, column = steps_a[-2:]
    if transposed:
        row, column, lower = column, row, not lower
    if not left:  # X op(A) = B is op(A)' X' = B'
        row, column, lower = column, row, not lower
    m = shape[-1] if left else shape[-2]
    # Elements of the unknown: i along the system, j from one right-hand side to the next.
    xi, xj = (steps[-2], steps[-1]) if left else (steps[-1], steps[-2])
    text.line(f"for (int n = 0; n < {n}; ++n) {{")
    text.depth += 1
    text.line("const int i = n;" if lower else f"const int i = {n - 1} - n;")
    if not unit:
        text.line(f"const real w = R(1.0) / a[{_at(0, (row + column, 'i'))}];")
    here = f"x[{_at(0, (xi, 'i'), (xj, 'j'))}]"
    text.line("for (int k = 0; k < i; ++k) {" if lower else f"for (int k = i + 1; k < {n}; ++k) {{")
    text.depth += 1
    text.line(f"const real y = a[{_at(0, (row, 'i'), (column, 'k'))}];")
    text.loop("j", m)
    text.line(f"{here} -= y * x[{_at(0, (xi, 'k'), (xj, 'j'))}];")
    text.end(2)
    if not unit:
        text.loop("j", m)
        text.line(f"{here} *= w;")
        text.end()
    text.end(1 + len(batch))
    return "triangular", text.done()


def _batch(text: _Text, shape):
    """A loop over matrices that lie one after the other, in which the pointer a moves along."""
    if len(shape) > 2:
        size = shape[-1] * shape[-2]
        text.loop("m", math.prod(shape[:-2]))
        text.lines[0] = text.lines[0].replace("*restrict a", "*restrict a0")
        text.line(f"real *const a = a0 + {size} * m;")
