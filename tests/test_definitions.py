"""A part of Python that is also C: what it says is the same in both, bit for bit, and what is not C is refused by name."""

from __future__ import annotations

import ctypes
import importlib
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from embedded_c_parts import STRICT, compilers
from rotorwatch.base.compiling import shipped, structs, toolchain
from rotorwatch.base.compiling.running import TRANSLATOR, TYPES, Definition, Rows
from rotorwatch.base.compiling.translate import Translation
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.intake import sizes
from rotorwatch.errors import ConfigError

IMPORTS = (
    "from __future__ import annotations\n"
    "from rotorwatch.base.compiling.structs import *\n"
    "from rotorwatch.base.compiling.structs import FLAG, INT, LASTS, LETTER, MASK, NAN, REAL, TIME\n"
)
SOURCE = '''
from made_sizes import COUNT

LOW, MIDDLE, HIGH = 0, 1, 2
_TABLE = (0.5, -1.5, 2.0)
_FACTOR = 0.1


class Inner(Struct):
    """Something in something else."""

    value: Real = 1.5
    time: Time = -LASTS  # never yet
    count: int = 3
    on: bool = True


class Outer(Struct):
    inner = embedded(Inner)
    several = array(Inner, 3)
    rows = array(REAL, 2, COUNT, fill=0.25)
    many = array(INT, COUNT)
    sets = array(MASK, 3)
    least: Small = -4

    def add(self, x: Real, k: int) -> None:
        """One more."""
        one = self.several[k]
        row = self.rows[k % 2]
        one.value += x
        one.count -= k
        row[k] = max(row[k], x * self.inner.value)
        self.inner.on = not self.inner.on
        self.inner.time = max(self.inner.time, x)
        self.many[k] += int(self._most(k))
        self.sets[k] |= 1 << 13 + k
        self.sets[0] = self.sets[k] ^ self.sets[2]
        self.least += max(k - 1, self.least) + abs(self.least)
        both = self.sets[1] & ~self.sets[0]
        self.many[0] += (-self.least if self.least < self.sets[1] else both) - both // 3

    def shuffle(self) -> None:
        copy(self.inner, self.several[1])
        copy(self.several[0], self.several[2])
        reset(self.several[1])
        fresh = Inner()
        fresh.value = self.inner.value
        copy(self.several[2], fresh)

    def _most(self, k: int) -> Real:
        return min(self.several[k].value, real(COUNT))


def numbers(x: Real, y: Real, out: Reals) -> None:
    out[0] = x + y * 2.0 - x / (abs(y) + 1.0)
    out[1] = -(x - (y - x)) * (x / (1.0 + y * y) / 3.0)
    out[2] = min(x, y) - max(x, _FACTOR)
    out[3] = sqrt(abs(x)) * exp(min(max(y, -5.0), 5.0))
    out[4] = floor(x / 7.0) + abs(-x)
    out[5] = _TABLE[LOW] * x + _TABLE[MIDDLE] * y if x > y else _TABLE[HIGH] if x < 0.0 else -y
    a = b = x - 1.0
    a -= b * y
    out[6] = a
    a /= 3.0
    out[7] = NAN if a < -1e5 else a


def whole_numbers(a: int, b: int, out: Ints) -> None:
    out[0] = a // b + a % b * 2
    out[1] = (a - b) * (a - (b - 1)) - 3
    out[2] = min(a, b) + max(a, b) - abs(b - a)
    out[3] = int(float(a) / float(b)) + int(-2.5)
    out[4] = a if a > b and b != 2 else b
    out[5] = COUNT - a // (b + 1)


def bits(a: int, b: int, k: int, out: Ints) -> None:
    out[0] = a & b | 3 ^ a
    out[1] = a & ~b
    out[2] = (a << k) | b >> k + 1
    out[3] = -1 - a ^ b
    out[4] = a if a & 1 << k else b
    c = a
    c |= 1 << k
    c &= ~b
    c ^= 5
    c <<= 2
    out[5] = c >> 1


def modulo(a: int, b: int, k: int, out: Ints) -> None:
    out[0] = sum32(a, b)
    out[1] = difference32(a, b)
    out[2] = shift32(a, k) | 1
    out[3] = sum32(difference32(a, b), shift32(b, k & 3))
    out[4] = shift32(1, 31)
    out[5] = difference32(0, sum32(a, 1)) >> 1


def from_bytes(data: Bytes, n: int, out: Ints) -> int:
    total = 0
    for i in range(n):
        total = sum32(shift32(total, 7), data[i])
        out[i % 6] = data[i] << 8 | data[n - 1 - i] >> 3 if data[i] > 99 else -data[i]
    return total


def truths(x: Real, y: Real, k: int, out: Flags) -> None:
    out[0] = x < y <= 2.0
    out[1] = x < y and not k > 3 or y == x
    out[2] = isnan(x) or isnan(y)
    out[3] = not (x > 0.0 or y >= 0.0) and k % 2 == 0
    out[4] = k >= 2 if x > y else k != 1
    out[5] = (x > 0.0) == (y > 0.0)


class Text(Struct):
    at = array(LETTER, 12)
    length: Small = 0

    def add(self, more: str) -> None:
        for i in range(len(more)):
            if self.length < 12:
                self.at[self.length] = ord(more[i])
                self.length += 1


def texts(t: Text, k: int, more: str) -> int:
    t.add("a\\"b\\\\" if k > 2 else "")
    t.add(more)
    return len(more)


def conversions(x: Real, k: int, out: Reals) -> None:
    out[0] = float(k) / 3.0
    out[1] = real(k) * x
    out[2] = float(int(x))
    out[3] = k / 4
    out[4] = x + float(k // 2)
    exact: Time = x
    out[5] = real(exact * exact)
    out[6] = 1 / 4 + float(3) / 2
    out[7] = x * float(int(-2.7)) + 7 // 2


def loops(n: int, x: Reals, out: Reals) -> int:
    kept = local(REAL, COUNT)
    grid = local(REAL, 2, COUNT)
    total: Real = 0.0
    found = 0
    for i in range(n):
        if x[i] < 0.0:
            continue
        elif x[i] > 50.0:
            found += 10
            break
        else:
            kept[found % COUNT] = x[i]
            found += 1
        for j in range(1, i):
            total += x[j] * 0.5
    for i in range(n - 1, -1, -1):
        total = total * _FACTOR + x[i]
        grid[i % 2][i] = total
    k = 0
    while k < n and total > 1.0:
        total -= abs(x[k]) + kept[k]
        k += 1
    out[0] = total
    out[1] = grid[1][2] - grid[0][1]
    out[2] = _last(x, n) if n > 0 else 0.0
    return found


def _last(x: Reals, n: int) -> Real:
    return x[n - 1]


class Side(Struct):
    x: Each = -1.5
    y = array(EACH, 2)
    scale: Real = 2.0

    def take(self, lane: int, x: Real, y: Real) -> None:
        self.x = replaced(self.x, lane, x)
        self.y[1] = replaced(self.y[1], lane, y)

    def made(self, least: Each) -> Each:
        x = self.x
        y = self.y[1]
        rows = local(EACH, 2, 2)
        for k in range(2):
            rows[k][1] = self.scale * x - y / 3.0
            rows[1][k] += 2.0
        less = y if x > y or x < -2.0 else -x
        less += max(abs(x), least) - min(y, 0.25 * x)
        total = each(0.5)
        total *= sqrt(abs(less)) + exp(min(max(y, -3.0), 3.0)) - log(abs(x) + 1.0)
        inside = total if x > -1.0 or y >= 2.0 and x != y else each(self.scale)
        return inside + rows[1][1] * rows[0][1] - rows[1][0]


class Sides(Struct):
    sides = array(Side, packed(8))

    def run(self, x: Reals, y: Reals, out: Reals) -> None:
        for k in range(8):
            self.sides[k // LANES].take(k % LANES, x[k], y[k])
        for k in range(8 // LANES):
            made = self.sides[k].made(each(0.1)) + self.sides[k].y[0]
            for lane in range(LANES):
                out[k * LANES + lane] = one(made, lane)


def side_by_side(x: Reals, y: Reals, out: Reals) -> None:
    whole = Sides()
    whole.run(x, y, out)


def at_first(out: Reals) -> None:
    whole = Sides()
    for k in range(8):
        out[k] = one(whole.sides[k // LANES].x, k % LANES)
'''
COUNT = 5


def module(folder, name, text):
    """A module of definitions, in a file as the translator needs it."""
    (folder / f"{name}.py").write_text(text)
    sys.modules.pop(name, None)
    importlib.invalidate_caches()
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(module, its definitions as machine code, the same as Python)."""
    folder = tmp_path_factory.mktemp("definitions")
    of_arrays = module(folder, "made_sizes", f"COUNT = {COUNT}\n")
    small = module(folder, "made_small", IMPORTS + SOURCE)
    compiled, plain = Definition("made", (small,), of_arrays), Definition("made", (small,), of_arrays)
    try:
        compiled.__dict__["library"] = ctypes.CDLL(str(compiled.build(folder)))
    except toolchain.Unavailable as why:
        pytest.skip(str(why))
    plain.__dict__["library"] = None
    return small, compiled, plain


def both(made, name, kind, count, *inputs):
    """What a function writes into its last argument, and returns, by Python; the same as by C."""
    small, compiled, _ = made
    ours = [False if kind == "flag" else 0] * count
    theirs = np.zeros(count, TYPES[kind])
    result = getattr(small, name)(*(x.tolist() if isinstance(x, np.ndarray) else x for x in inputs), ours)
    assert result == compiled.call(getattr(small, name), *inputs, theirs)
    same(np.array(ours, TYPES[kind]), theirs)


def same(ours, theirs):
    """Arrays of the same bits; a zero has no sign, NaN is NaN."""
    assert ours.dtype == theirs.dtype and ours.shape == theirs.shape
    if ours.dtype.names:
        for name in ours.dtype.names:
            same(ours[name], theirs[name])
    elif ours.dtype == float:
        np.testing.assert_array_equal(ours + 0.0, theirs + 0.0)
    else:
        np.testing.assert_array_equal(ours, theirs)


def records(rows: Rows, definition: Definition):
    """Structs of either way as a record array."""
    if rows.native is not None:
        return rows.native
    assert rows.plain is not None
    return np.array([_record(one) for one in rows.plain], definition.type_of(rows.kind))


def _record(one):
    """A struct as NumPy takes it: a tuple of its fields."""
    return tuple(_value(getattr(one, name)) for name, _ in type(one).declared())


def _value(value):
    if isinstance(value, structs.Struct):
        return _record(value)
    return [_value(x) for x in value] if isinstance(value, list) else value


REAL = st.floats(-1e6, 1e6)
ANY = st.one_of(REAL, st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1.0, 2.0]))


@settings(max_examples=trials(100), deadline=None)
@given(REAL, REAL)
def test_numbers(made, x, y):
    both(made, "numbers", "real", 8, x, y)


@settings(max_examples=trials(100), deadline=None)
@given(st.integers(0, 10000), st.integers(1, 10000))
def test_whole_numbers(made, a, b):
    """Quotients and remainders are those of numbers that are not negative: Python and C round others differently."""
    both(made, "whole_numbers", "int", 6, a, b)


@settings(max_examples=trials(100), deadline=None)
@given(st.integers(0, 2**24), st.integers(0, 2**24), st.integers(0, 6))
def test_bits(made, a, b, k):
    both(made, "bits", "int", 6, a, b, k)


WHOLE = st.integers(-(2**31), 2**31 - 1) | st.sampled_from([0, 1, -1, 2**31 - 1, -(2**31)])


@settings(max_examples=trials(200), deadline=None)
@given(WHOLE, WHOLE, st.integers(0, 31))
def test_numbers_of_32_bits_go_on_from_the_other_end(made, a, b, k):
    both(made, "modulo", "int", 6, a, b, k)


@settings(max_examples=trials(100), deadline=None)
@given(st.binary(max_size=20))
def test_bytes(made, data):
    both(made, "from_bytes", "int", 6, np.frombuffer(data, np.uint8), len(data))


@settings(max_examples=trials(100), deadline=None)
@given(st.lists(REAL, min_size=16, max_size=16))
def test_what_stands_side_by_side(made, numbers):
    """Each for itself, as if it stood alone: eight in vectors of the processor, and one after the other in Python."""
    both(made, "side_by_side", "real", 8, np.array(numbers[:8]), np.array(numbers[8:]))
    both(made, "at_first", "real", 8)


def test_python_writes_into_the_arrays_that_are_given(made):
    small, _, plain = made
    out = np.zeros(6, np.int32)
    plain.call(small.bits, 12, 10, 1, out)
    assert out[0] == 12 & 10 | 3 ^ 12
    reals, flags = np.full((2, 4), np.nan), np.zeros(6, bool)
    plain.call(small.numbers, 3.0, 2.0, reals)
    assert reals[0, 2] == 2.0 - 3.0 and reals[1, 0] == 3.0
    plain.call(small.truths, 1.0, 2.0, 1, flags)
    assert flags[:2].all() and not flags[2]


@pytest.mark.parametrize("way", [1, 2])
def test_arguments_of_other_types_are_refused(made, way):
    """By name: C would read, and write, whatever lies at that address."""
    small, definition = made[0], made[way]
    out, data = np.zeros(6, np.int32), np.zeros(8, np.uint8)
    for a, wrong, why in (
        (1.0, out, "a must be int, not float"),
        (1, out.astype(np.int64), "out must be an array of int32 without gaps, not an array of int64"),
        (1, np.zeros(12, np.int32)[::2], "not an array of int32 with gaps"),
        (1, out.tolist(), "not list"),
        (1, definition.new(small.Outer), "not Outer"),
    ):
        with pytest.raises(TypeError, match=f"bits: .*{re.escape(why)}"):
            definition.call(small.bits, a, 10, 1, wrong)
    with pytest.raises(TypeError, match="data must be an array of uint8"):
        definition.call(small.from_bytes, data.view(np.int8), 8, out)
    with pytest.raises(TypeError, match="must be Text, not Outer"):
        definition.call(small.texts, definition.new(small.Outer), 1, "a")
    with pytest.raises(TypeError, match="bits takes 4 arguments, not 3"):
        definition.call(small.bits, 1, 2, 3)


def test_whole_numbers_are_numbers(made):
    """Where C takes 2.0, 2 is not what lies in another register."""
    small, compiled, _ = made
    out = np.zeros(8)
    compiled.call(small.conversions, 2, 3, out)
    both(made, "conversions", "real", 8, 2.0, 3)
    again = np.zeros(8)
    compiled.call(small.conversions, 2.0, 3, again)
    same(out, again)


def test_several_definitions_are_shipped_side_by_side(made, tmp_path):
    _, compiled, _ = made
    other = Definition("other", compiled.modules, compiled.sizes, files=["logs/table.py"])
    for definition in (compiled, other):
        definition.ship(tmp_path)
    index = json.loads((tmp_path / shipped.DEFINITIONS).read_text())
    assert set(index) == {"made", "other"} and index["made"]["digest"] != index["other"]["digest"]
    assert index["other"]["digest"] == shipped.digest(sorted(["logs/table.py", *TRANSLATOR]))
    for name, reported in index.items():
        assert reported["libraries"] == {"": [f"{name}.so", shipped.digest_of(tmp_path / f"{name}.so")]}


@settings(max_examples=trials(100), deadline=None)
@given(ANY, ANY, st.integers(0, 5))
def test_conditions(made, x, y, k):
    both(made, "truths", "flag", 6, x, y, k)


@settings(max_examples=trials(50), deadline=None)
@given(REAL, st.integers(0, 10000))
def test_conversions(made, x, k):
    both(made, "conversions", "real", 8, x, k)


@settings(max_examples=trials(100), deadline=None)
@given(st.lists(st.floats(-20.0, 60.0), min_size=0, max_size=COUNT))
def test_loops_and_local_arrays(made, x):
    both(made, "loops", "real", 3, len(x), np.array([*x, *[0.0] * (COUNT - len(x))]))


@settings(max_examples=trials(50), deadline=None)
@given(st.lists(st.tuples(REAL, st.integers(0, 2)), max_size=8))
def test_structs(made, steps):
    """First values, fields of fields, other names for parts, copies and resets."""
    small, compiled, plain = made
    one, other = plain.new(small.Outer), compiled.new(small.Outer)
    same(records(one, plain), records(other, compiled))
    for k, (x, where) in enumerate(steps):
        one.plain[0].add(x, where)
        at = ctypes.c_void_p(other.native.ctypes.data)
        compiled.library.rw_outer_add(at, ctypes.c_double(x), ctypes.c_int32(where))
        if k % 3 == 2:
            one.plain[0].shuffle()
            compiled.library.rw_outer_shuffle(at)
        same(records(one, plain), records(other, compiled))


@settings(max_examples=trials(30), deadline=None)
@given(st.integers(0, 5), st.text(st.characters(min_codepoint=1, max_codepoint=126), max_size=9))
def test_texts(made, k, more):
    small, compiled, plain = made
    one, other = plain.new(small.Text), compiled.new(small.Text)
    assert plain.call(small.texts, one, k, more) == compiled.call(small.texts, other, k, more) == len(more)
    same(records(one, plain), records(other, compiled))


def test_copies_share_nothing(made):
    small, _, _ = made
    one, other = small.Outer(), small.Outer()
    one.rows[1][2], one.several[1].value = 7.0, 8.0
    structs.copy(other, one)
    one.rows[1][2], one.several[1].value = 9.0, 9.0
    assert (other.rows[1][2], other.several[1].value) == (7.0, 8.0)
    structs.reset(one)
    assert (one.rows[1][2], one.several[1].value) == (0.25, 1.5) and small.Outer().rows[1][2] == 0.25


NOT_C = {
    "y = [1.0, 2.0]": "List is not C",
    "y = x ** 2.0": "product instead of a power",
    "y = +x": "this sign is not C",
    "y = x << 2": "bits are of whole numbers",
    "x |= 2": "this operation is not C",
    "y = sum32(x, 1)": "sum32 is of whole numbers",
    "y = ~x": "this sign is not C",
    "y = x is None": "this comparison is not C",
    "y = 'text'": "a text is passed on",
    "y = None": "is no number",
    "y, z = x, x": "not C",
    "y = other": "other is not known",
    "y = a.nothing": "nothing is no field of a",
    "y = x[0]": "x is no array",
    "y = wrong(x)": "wrong is no definition",
    "y = f(a, x)": "takes 3 arguments",
    "f(a, x, k=1)": "arguments have no names",
    "a.part = Part()": "copy\\(\\) copies a struct",
    "for y in (1.0, 2.0): pass": "a loop is over range",
    "for i in range(0, 4, 2): pass": "counts by 1 or -1",
    "for k in range(4): pass": "k is a variable already",
    "for i in range(3): pass\n    else: x = 1.0": "a loop has no else",
    "while x > 1.0: x -= 1.0\n    else: x = 1.0": "a loop has no else",
    "try: pass\n    finally: pass": "Try is not C",
    "with x: pass": "With is not C",
    "y = lambda: x": "Lambda is not C",
    "y: bytes = x": "this type is not known",
    "y = each(x)\n    if y > 0.0: x = 1.0": "may choose a number, no more",
    "y = each(x)\n    while y > 0.0: x = 1.0": "may choose a number, no more",
    "y = each(x)\n    z = y > 0.0": "may choose a number, no more",
    "y = each(x)\n    z = k > 1 and y > 0.0": "may choose a number, no more",
    "y = each(x)\n    z = x if 0.0 < y < 1.0 else y": "one by one",
    "y = each(x)\n    x = y": "side by side, and one is wanted",
}


@pytest.mark.parametrize("line", NOT_C)
def test_what_is_not_c_is_refused_with_file_and_line(tmp_path, line):
    text = f"{IMPORTS}class Part(Struct):\n    x: Real = 0.0\nclass All(Struct):\n    part = embedded(Part)\n"
    text += f"def f(a: All, x: Real, k: int) -> None:\n    {line}\n"
    at = text[: text.index(line)].count("\n") + 1
    with pytest.raises(ConfigError, match=NOT_C[line]) as error:
        Translation([module(tmp_path, "made_wrong", text)], sizes)
    number = int(re.search(r"made_wrong, line (\d+):", str(error.value))[1])
    assert at <= number <= at + line.count("\n")


def test_a_constant_is_not_taken_for_a_size_of_its_name(tmp_path):
    """Of all definitions: C has the sizes as macros."""
    text = f"{IMPORTS}ROTORS = 5.0\ndef f(x: Real) -> Real:\n    return ROTORS * x\n"
    with pytest.raises(ConfigError, match="ROTORS is the name of a size, and another number here"):
        Translation([module(tmp_path, "made_taken", text)], sizes)


@pytest.mark.parametrize("what", ["class A(Struct):\n    x = 1.0\n", "def f(x: bytes) -> None:\n    pass\n"])
def test_types_that_are_not_known_are_refused(tmp_path, what):
    with pytest.raises(ConfigError, match="made_wrong, line "):
        Translation([module(tmp_path, "made_wrong", IMPORTS + what)], sizes)


@pytest.fixture(scope="module")
def translated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("engine")
    texts = ENGINE.translated()
    for name, text in zip(("rw_config.h", "rw_engine.h", "rw_engine.c"), texts):
        (folder / name).write_text(text)
    return folder, texts


@pytest.mark.parametrize("precision", [(), ("-DROTORWATCH_FLOAT",)])
def test_no_compiler_warns_of_the_definitions(translated, precision):
    folder, _ = translated
    for compiler in compilers():
        constants = ["-fsingle-precision-constant"] if compiler == "gcc" and precision else []
        command = [compiler, *STRICT, *precision, *constants, "-fsyntax-only", str(folder / "rw_engine.c")]
        subprocess.run(command, check=True)


def test_vehicle_and_plan_are_constant_and_tables_are(translated):
    _, (_, header, source) = translated
    for kind in ("rw_vehicle", "rw_plan"):
        named = re.findall(rf"(\w+) {kind} \*(\w+)[,)]", re.sub(rf"{kind}_init\(.*", "", header + source))
        assert len(named) > 20 and {word for word, _ in named} == {"const"}
    assert set(re.findall(r"static (\w+) rw_real rw_\w+\[\d+\] = \{", source)) == {"const"}
    assert "rw_samples_area(const rw_samples *self" in header and "rw_samples_add(rw_samples *self" in header
