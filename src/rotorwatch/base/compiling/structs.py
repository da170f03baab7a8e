"""Types of a small part of Python that is also C: what definitions that run sample by sample are written in (docs/one-definition.md).

A definition is a class derived from `Struct`, with fields of fixed size and methods of plain loops, conditions and arithmetic. Python runs
it as it stands; `translate` makes C99 of it, for this computer and for a flight controller. Both do the same operations in the same
order, so that double precision gives the same bits.

    class Mean(Struct):
        '''Running mean of a signal.'''

        total: Time = 0.0
        count: int = 0

        def add(self, value: Real) -> None:
            self.total += value
            self.count += 1

Real: a number in the library's precision, float on small boards. Time: seconds or sums, always double. int: 32 bits. Mask: a set, and
Small: 16 bits, which are read as int. Each: a number of each of LANES things that stand side by side, and all are calculated at once:
machine code of a computer has several, in one vector of its processor; a flight controller and Python have one. No `if` may depend on it,
only a conditional expression. Sums, products and `<<` must stay within these; `//` and `%` are of numbers that are not negative: Python
and C differ beyond; where sums may not stay within, `sum32`, `difference32` and `shift32` go on from the other end. str: a text in ASCII,
read by `len(text)` and `ord(text[k])`. Bytes: what is only read, each a number from 0 to 255.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar

Real = float
Time = float
Each = float  # of each of LANES lanes
Reals = list[float]
Eaches = list[float]
Times = list[float]
Mask = int  # a set: bit k is element k; 16 bits
Small = int  # 16 bits
Ints = list[int]
Flags = list[bool]
Bytes = Sequence[int]
Vectors = list[list[float]]  # rows of three

LANES = 1
"""How many stand side by side in Python; in machine code of a computer, as many as a vector holds (`running.LANES`)."""
LASTS = 1e30
"""Later than all times: the end of what lasts."""
NAN = math.nan

REAL, TIME, EACH, INT, FLAG, MASK, SMALL, LETTER = (
    "real",
    "time",
    "each",
    "int",
    "flag",
    "mask",
    "small",
    "letter",
)  # kinds of elements, for `array`
# annotation -> kind
SCALARS = {"Real": REAL, "Time": TIME, "float": TIME, "Each": EACH, "int": INT, "bool": FLAG, "Mask": MASK, "Small": SMALL, "str": "text"}

# The same, of arrays.
LISTS = {"Reals": REAL, "Eaches": EACH, "Times": TIME, "Ints": INT, "Flags": FLAG, "Bytes": "byte"}

S = TypeVar("S", bound="Struct")


class Packed(int):
    """A count, with LANES of them in one element of an array."""


def packed(count: int) -> int:
    """The size of an array whose elements hold LANES each, for `count` in all."""
    return Packed(count)


class Array:
    """A field of fixed size, as it is declared."""

    def __init__(self, kind: Any, shape: tuple[int, ...], fill: Any):
        self.kind, self.shape, self.fill = kind, shape, fill

    def make(self) -> list:
        return self._made(list(self.shape))

    def _made(self, shape: list[int]) -> list:
        if len(shape) > 1:
            return [self._made(shape[1:]) for _ in range(shape[0])]
        if isinstance(self.kind, str):
            return [self.fill] * shape[0]
        return [self.kind() for _ in range(shape[0])]


def array(kind: Any, *shape: int, fill: Any = None) -> Any:
    """A field, or a local variable, of fixed size. kind: REAL, TIME, EACH, INT, FLAG, MASK, SMALL, LETTER (of a text), or a Struct."""
    nothing: Any = 0 if kind in (INT, MASK, SMALL, LETTER) else False if kind == FLAG else 0.0
    return Array(kind, shape, nothing if fill is None else fill)


def local(kind: Any, *shape: int) -> Any:
    """A local variable of fixed size, all zero."""
    return array(kind, *shape).make()


class Struct:
    """Base of all definitions: an instance has a copy of every field's initial value."""

    _plain: ClassVar[dict[str, Any]] = {}
    _deep: ClassVar[dict[str, Any]] = {}

    def __init_subclass__(cls):
        fields = {k: v for k, v in vars(cls).items() if not k.startswith("__") and not callable(v)} | {
            k: v for k, v in vars(cls).items() if isinstance(v, type) and issubclass(v, Struct)
        }
        cls._deep = {k: v for k, v in fields.items() if isinstance(v, (Array, type))}
        cls._plain = {k: v for k, v in fields.items() if k not in cls._deep}

    @classmethod
    def declared(cls) -> list[tuple[str, Any]]:
        """(name, first value, Array or Struct) of each field, in order."""
        return [(name, value) for name, value in vars(cls).items() if name in cls._deep or name in cls._plain]

    def __init__(self):
        state = self.__dict__
        state.update(self._plain)
        for name, field in self._deep.items():
            state[name] = field() if isinstance(field, type) else field.make()


def embedded(kind: type[S]) -> S:
    """A field that is another Struct."""
    return kind  # type: ignore[return-value]  # an instance has an instance


def reset(what: Struct) -> None:
    """Reset all fields to their initial values."""
    what.__init__()


def copy(to: S, source: S) -> None:
    """Copy all fields of `source` to `to`."""
    for name, value in source.__dict__.items():
        to.__dict__[name] = _copied(value)


def _copied(value: Any) -> Any:
    if isinstance(value, list):
        return [_copied(v) for v in value]
    if isinstance(value, Struct):
        other = type(value)()
        copy(other, value)
        return other
    return value


sqrt, exp, log, isnan, floor = math.sqrt, math.exp, math.log, math.isnan, math.floor


def real(value: float) -> Real:
    """A number in the library's precision, from one in double precision."""
    return value


def each(value: Real) -> Each:
    """The same number in every lane."""
    return value


def one(value: Each, lane: int) -> Real:
    """The value of one lane."""
    return value


def replaced(value: Each, lane: int, other: Real) -> Each:
    """The value with another number in one lane."""
    return other


def sum32(a: int, b: int) -> int:
    """a + b of 32 bits, as processors add."""
    return _wrapped(a + b)


def difference32(a: int, b: int) -> int:
    """a - b of 32 bits, as processors subtract."""
    return _wrapped(a - b)


def shift32(a: int, places: int) -> int:
    """a << places of 32 bits: what leaves them is lost. places: 0 to 31."""
    return _wrapped(a << places)


def _wrapped(value: int) -> int:
    return ((value + 0x80000000) & 0xFFFFFFFF) - 0x80000000


@functools.cache
def snake(name: str) -> str:
    """rw_half_second of HalfSecond: the name of a Struct in C."""
    return "rw_" + re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
