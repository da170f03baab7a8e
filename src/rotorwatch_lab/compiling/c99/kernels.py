"""C functions for products, Cholesky factors and triangular systems, written for one shape each.

Each returns (stem of the name, text with @ for the name). out is row-major; arguments have steps of their own, so that transposes
and slices need no copy.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rotorwatch_lab.compiling.c99.graph import strides

ROWS = 4  # rows of a product computed side by side: more do not fit the registers
PACKED = 512  # elements of the right factor that are copied when they do not lie in a row
WIDE = 64  # columns that are summed in registers and stack, not in the result
LANES = "R_LANES"  # before a loop whose turns are a vector's lanes


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
        columns = [(shape_b[n_batch + n_inner + k], out[n_batch + free_a + k], 0, steps_b[n_batch + n_inner + k]) for k in range(free_b)]
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
    if _contiguous(p.columns, 3) < _contiguous(p.rows, 2):
        return "product", _ProductText(p.swapped(), kind, "b", "a").done()
    return "product", _ProductText(p, kind, "a", "b").done()


def _contiguous(group, which: int) -> int:
    """How many elements lie side by side."""
    return group[-1][0] if group and group[-1][which] == 1 else 1


class _ProductText(_Text):
    """The lines of a product. a, b: names of its factors; rows, columns: the innermost axes of each; to, of_a, of_b: what the outer loops
    add to an index of out, A and B; inner_a, inner_b: the same of the loops that are summed over."""

    def __init__(self, p: Product, kind: str, a: str, b: str):
        super().__init__(f"static void @({kind} *restrict out, const {kind} *a, const {kind} *b)")
        self.kind, self.a, self.b, self.inner = kind, a, b, [axis[0] for axis in p.inner]
        self.rows, self.columns = (group[-1] if group else (1, 0, 0, 0) for group in (p.rows, p.columns))
        axes = [(letter, axis) for letter, group in zip("brc", (p.batch, p.rows[:-1], p.columns[:-1])) for axis in group]
        outer = [(f"{letter}{k}", axis) for k, (letter, axis) in enumerate(axes)]
        self.to, self.of_a, self.of_b = ([(axis[k], name) for name, axis in outer] for k in (1, 2, 3))
        self.inner_a, self.inner_b = ([(axis[k], f"k{j}") for j, axis in enumerate(p.inner)] for k in (2, 3))
        for name, axis in outer:
            self.loop(name, axis[0])
        count = self.rows[0]
        if self.columns[0] > 1 and self.columns[3] != 1 and count >= ROWS:
            self._pack()
        # Three at a time where that leaves nothing over: half the code.
        together = 3 if count % ROWS and count % 3 == 0 else ROWS
        full = count // together * together
        if full:
            self._block("i", full, together)
        if count > full:
            self._block(str(full), 0, count - full)
        self.end(len(outer))

    def _sum(self):
        """Loops over what is summed."""
        for k, n in enumerate(self.inner):
            self.loop(f"k{k}", n)

    def _pack(self):
        """A copy of the right factor whose columns lie in a row, where it is small."""
        J, n_inner = self.columns[0], math.prod(self.inner)
        if n_inner * J > PACKED:
            return
        packed = [(J * s, f"k{k}") for k, s in enumerate(strides(tuple(self.inner)))]
        self.line(f"{self.kind} packed[{n_inner * J}];")
        self._sum()
        self.loop("j", J)
        read = _at(0, *self.of_b, *self.inner_b, (self.columns[3], "j"))
        self.line(f"packed[{_at(0, *packed, (1, 'j'))}] = {self.b}[{read}];")
        self.end(len(self.inner) + 1)
        self.b, self.of_b, self.inner_b, self.columns = "packed", [], packed, (J, self.columns[1], 0, 1)

    def _block(self, first: str, stop: int, count: int):
        """`count` rows at once: from `first`, or in a loop over `first` up to `stop`. They are summed in registers and stack, or in the
        result where there are too many columns for that."""
        _, row_out, row_a, _ = self.rows
        J, column_out, _, column_b = self.columns
        fixed = 0 if stop else int(first)
        looped = [first] if stop else []
        if stop:
            self.loop(first, stop, 0, count)
        else:
            self.line("{")
            self.depth += 1
        wide, long = J > 1, J > WIDE
        column = ["j"] if wide else []
        goals = [
            _at((fixed + r) * row_out, *self.to, *((row_out, i) for i in looped), *((column_out, j) for j in column)) for r in range(count)
        ]
        goals = [f"out[{goal}]" for goal in goals]
        sums = goals if long else [f"s{r}{'[j]' if wide else ''}" for r in range(count)]
        if long:
            self.loop("j", J)
        for r, goal in enumerate(goals):
            zero = f"{self.kind} s{r}[{J}] = {{0}};" if wide else f"{self.kind} s{r} = 0;"
            self.line(f"{goal} = 0;" if long else zero)
        self.end(long)
        self._sum()
        for r in range(count):
            read = _at((fixed + r) * row_a, *self.of_a, *((row_a, i) for i in looped), *self.inner_a)
            self.line(f"const {self.kind} x{r} = {self.a}[{read}];")
        if wide:
            self.line(LANES)
            self.loop("j", J)
        right = f"{self.b}[{_at(0, *self.of_b, *self.inner_b, *((column_b, j) for j in column))}]"
        if not long:
            self.line(f"const {self.kind} y = {right};")
        for r, total in enumerate(sums):
            self.line(f"{total} += x{r} * {right if long else 'y'};")
        self.end(len(self.inner) + wide)
        if not long:
            if wide:
                self.loop("j", J)
            for goal, total in zip(goals, sums):
                self.line(f"{goal} = {total};")
            self.end(wide)
        self.end()


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
    # A row of the unknown is summed in registers: in x, each turn would wait for what the one before it has stored.
    row_of = "s" if m == 1 else "s[j]"
    many = m > 1

    def each(line: str):
        if many:
            text.line(LANES)
            text.loop("j", m)
        text.line(line)
        text.end(many)

    here, other = (f"x[{_at(0, (xi, name), *[(xj, 'j')] * many)}]" for name in "ik")
    text.line(f"real {'s' if m == 1 else f's[{m}]'};")
    each(f"{row_of} = {here};")
    text.line("for (int k = 0; k < i; ++k) {" if lower else f"for (int k = i + 1; k < {n}; ++k) {{")
    text.depth += 1
    text.line(f"const real y = a[{_at(0, (row, 'i'), (column, 'k'))}];")
    each(f"{row_of} -= y * {other};")
    text.end()
    each(f"{here} = {row_of}{'' if unit else ' * w'};")
    text.end(1 + len(batch))
    return "triangular", text.done()


def _batch(text: _Text, shape):
    """A loop over matrices that lie one after the other, in which the pointer a moves along."""
    if len(shape) > 2:
        size = shape[-1] * shape[-2]
        text.loop("m", math.prod(shape[:-2]))
        text.lines[0] = text.lines[0].replace("*restrict a", "*restrict a0")
        text.line(f"real *const a = a0 + {size} * m;")
