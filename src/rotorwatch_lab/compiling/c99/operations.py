"""Element-wise operations: how NumPy folds them over constants and how C writes them.

`real` is double or float. Floating functions go through macros (r_sqrt is sqrt or sqrtf), so that a float build calls float
functions only; integers wrap around and convert as XLA has it, where C leaves that open.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

TYPES = {"f": "real", "i": "int32_t", "l": "int64_t", "b": "bool"}


class Operation(NamedTuple):
    """fold: on NumPy arrays. c: C expression by the kind of the first argument (f real, i int32, l int64, b bool), with
    {0}, {1} ... for arguments."""

    fold: Callable
    c: dict[str, str]


def kind(dtype) -> str:
    """f, i, l or b for a NumPy type. Raises KeyError for types that are not exported."""
    dtype = np.dtype(dtype)
    return {"f": "f", "b": "b"}.get(dtype.kind) or {"int64": "l", "int32": "i", "int16": "i", "int8": "i"}[dtype.name]


NUMPY = {"f": np.float64, "i": np.int32, "l": np.int64, "b": np.bool_}


def _function(name: str, arguments: int = 1) -> dict[str, str]:
    holes = ", ".join(f"{{{k}}}" for k in range(arguments))
    return {"f": f"r_{name}({holes})"}


def _all(text: str, kinds: str = "filb") -> dict[str, str]:
    return dict.fromkeys(kinds, text)


def _wrapping(sign: str) -> dict[str, str]:
    return {
        "f": f"({{0}} {sign} {{1}})",
        "i": f"(int32_t)((uint32_t){{0}} {sign} (uint32_t){{1}})",
        "l": f"(int64_t)((uint64_t){{0}} {sign} (uint64_t){{1}})",
    }


def _logic(word: str, bits: str) -> dict[str, str]:
    return {"b": f"({{0}} {word} {{1}})", "i": f"({{0}} {bits} {{1}})", "l": f"({{0}} {bits} {{1}})"}


def _divide(a, b):
    """XLA: integers towards zero, x / 0 = -1; reals as IEEE 754 has it."""
    if a.dtype.kind == "f":
        return a / b
    quotient = np.trunc(a / np.where(b == 0, 1, b)).astype(a.dtype)
    return np.where(b == 0, -1, quotient).astype(a.dtype)


def _remainder(a, b):
    if a.dtype.kind == "f":
        return np.fmod(a, b)
    return np.where(b == 0, a, np.fmod(a, np.where(b == 0, 1, b))).astype(a.dtype)


def _erf(x):
    from scipy.special import erf

    return erf(x)


def _erfc(x):
    from scipy.special import erfc

    return erfc(x)


_UNARY = ("exp", "log", "log1p", "expm1", "sqrt", "cbrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "floor", "ceil", "exp2")  # fmt: skip
_INVERSE = ("asin", "acos", "atan", "asinh", "acosh", "atanh")

ELEMENTWISE: dict[str, Operation] = {
    "copy": Operation(lambda a: a, _all("{0}")),
    "add": Operation(np.add, _wrapping("+") | {"b": "({0} || {1})"}),
    "sub": Operation(np.subtract, _wrapping("-")),
    "mul": Operation(np.multiply, _wrapping("*") | {"b": "({0} && {1})"}),
    "div": Operation(_divide, {"f": "({0} / {1})", "i": "i_div({0}, {1})", "l": "(int64_t)l_div({0}, {1})"}),
    "rem": Operation(_remainder, {"f": "r_fmod({0}, {1})", "i": "i_rem({0}, {1})", "l": "(int64_t)l_rem({0}, {1})"}),
    "neg": Operation(np.negative, {"f": "(-{0})", "i": "(int32_t)(0u - (uint32_t){0})", "l": "(int64_t)((uint64_t)0 - (uint64_t){0})"}),
    "abs": Operation(np.abs, {"f": "r_fabs({0})", "i": "i_abs({0})", "l": "l_abs({0})"}),
    "sign": Operation(np.sign, {"f": "r_sign({0})", "i": "(int32_t)(({0} > 0) - ({0} < 0))", "l": "(int64_t)(({0} > 0) - ({0} < 0))"}),
    "max": Operation(
        np.maximum, {"f": "r_max({0}, {1})", "b": "({0} || {1})", "i": "({0} > {1} ? {0} : {1})", "l": "({0} > {1} ? {0} : {1})"}
    ),
    "min": Operation(
        np.minimum, {"f": "r_min({0}, {1})", "b": "({0} && {1})", "i": "({0} < {1} ? {0} : {1})", "l": "({0} < {1} ? {0} : {1})"}
    ),
    "and": Operation(lambda a, b: a & b, _logic("&&", "&")),
    "or": Operation(lambda a, b: a | b, _logic("||", "|")),
    "xor": Operation(lambda a, b: a ^ b, _logic("!=", "^")),
    "not": Operation(lambda a: ~a, {"b": "(!{0})", "i": "(~{0})", "l": "(~{0})"}),
    "eq": Operation(np.equal, _all("({0} == {1})") | {"f": "r_eq({0}, {1})"}),
    "ne": Operation(np.not_equal, _all("({0} != {1})") | {"f": "!r_eq({0}, {1})"}),
    "lt": Operation(np.less, _all("({0} < {1})")),
    "le": Operation(np.less_equal, _all("({0} <= {1})")),
    "gt": Operation(np.greater, _all("({0} > {1})")),
    "ge": Operation(np.greater_equal, _all("({0} >= {1})")),
    "select": Operation(lambda which, no, yes: np.where(which, yes, no), _all("({0} ? {2} : {1})")),
    "to_f": Operation(lambda a: a.astype(np.float64), _all("(real){0}") | {"f": "{0}"}),
    "to_i": Operation(lambda a: _saturated(a, np.int32), _all("(int32_t){0}") | {"f": "i_of({0})", "i": "{0}"}),
    "to_l": Operation(lambda a: _saturated(a, np.int64), _all("(int64_t){0}") | {"f": "l_of({0})", "l": "{0}"}),
    "to_b": Operation(lambda a: a != 0, _all("({0} != 0)") | {"f": "!r_eq({0}, 0)", "b": "{0}"}),
    "is_finite": Operation(np.isfinite, {"f": "r_finite({0})"}),
    "rsqrt": Operation(lambda a: 1.0 / np.sqrt(a), {"f": "(R(1.0) / r_sqrt({0}))"}),
    "logistic": Operation(lambda a: 1.0 / (1.0 + np.exp(-a)), {"f": "(R(1.0) / (R(1.0) + r_exp(-{0})))"}),
    "square": Operation(np.square, {"f": "r_square({0})", "i": "(int32_t)((uint32_t){0} * (uint32_t){0})"}),
    "round": Operation(lambda a: np.trunc(a + np.copysign(0.5, a)), _function("round")),
    "rint": Operation(np.rint, _function("rint")),
    "erf": Operation(_erf, _function("erf")),
    "erfc": Operation(_erfc, _function("erfc")),
    "pow": Operation(lambda a, b: np.power(a, b.astype(float)), {"f": "r_pow({0}, {1})"}),
    "atan2": Operation(np.arctan2, _function("atan2", 2)),
    "hypot": Operation(np.hypot, _function("hypot", 2)),
    **{name: Operation(getattr(np, name), _function(name)) for name in _UNARY},
    **{name: Operation(getattr(np, "arc" + name[1:]), _function(name)) for name in _INVERSE},
}
# Worth a variable of their own rather than a second evaluation.
CHEAP = {"copy", "neg", "to_f", "to_i", "to_l", "to_b", "not"}
COMPARISONS = {"eq", "ne", "lt", "le", "gt", "ge", "is_finite", "to_b"}


def _saturated(a, to):
    if a.dtype.kind != "f":
        return a.astype(to)
    low, high = np.iinfo(to).min, np.iinfo(to).max
    inside = np.clip(np.nan_to_num(a, nan=0.0), float(low), float(high))
    return np.where(inside >= float(high), high, inside.astype(np.float64).clip(low, high * (1 - 2**-53)).astype(to))


FUNCTIONS = (*_UNARY, *_INVERSE, "fabs", "fmod", "round", "rint", "erf", "erfc", "pow", "atan2", "hypot")

# What the source needs of these, by name; project.py keeps the functions that are used.
HELPERS = {
    re.search(r"(\w+)\(", text)[1]: text.rstrip("\n")  # pyright: ignore[reportOptionalSubscript]
    for text in Path(__file__).with_name("helpers.h").read_text("utf-8").split("\n\n")[1:]
}
