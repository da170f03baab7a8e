"""Checks of user settings: each raises ConfigError with one sentence that names the argument and the requirement.

Inside a compiled program arrays have no values yet; there only shapes are checked.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterable
from typing import Any

import numpy as np

from rotorwatch.base.backend import jax
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError


def shape(name: str, value: Any, *expected: int) -> Any:
    """value, unchanged, when it is an array of that shape."""
    shape_ = np.shape(value)
    if shape_ != expected:
        raise ConfigError(f"{name} must have the shape {expected}, not {shape_}.")
    return value


def finite(name: str, value: Any) -> Any:
    """value, unchanged, when all of it is finite."""
    if concrete(value) and not np.isfinite(np.asarray(value, float)).all():
        raise ConfigError(f"{name} holds NaN or infinity; give finite numbers.")
    return value


def positive(name: str, value: Any) -> Any:
    """value, unchanged, when all of it is finite and above zero."""
    finite(name, value)
    if concrete(value) and not (np.asarray(value, float) > 0).all():
        raise ConfigError(f"{name} must be above zero, not {np.min(np.asarray(value, float)):g}.")
    return value


def between(name: str, value: Any, low: float, high: float) -> Any:
    """value, unchanged, when all of it lies in [low, high]."""
    finite(name, value)
    if concrete(value) and not ((np.asarray(value, float) >= low) & (np.asarray(value, float) <= high)).all():
        raise ConfigError(f"{name} must lie between {low:g} and {high:g}, not {value}.")
    return value


def one_of(name: str, value: Any, known: Iterable[Any]) -> Any:
    """value, unchanged, when it is one of the known ones."""
    if value not in (known := tuple(known)):
        raise ConfigError(f"{name} must be one of {', '.join(filter(None, known))}, not {value!r}{meant(value, known)}.")
    return value


def whole(name: str, value: Any, least: int, most: float = 2.0**53) -> int:
    """value as an int, when it is a whole number from least to most."""
    if int(value) != value or not least <= value <= most:
        raise ConfigError(f"{name} must be a whole number, {least} or more, not {value}.")
    return int(value)


def covariance(name: str, P: Any, n: int, definite: bool = False) -> Any:
    """P, unchanged, when it is a symmetric positive semidefinite (definite: and invertible) n x n matrix."""
    finite(name, shape(name, P, n, n))
    if concrete(P):
        A = np.asarray(P, float)
        scale = max(np.abs(A).max(), 1e-300) if A.size else 1.0
        if np.abs(A - A.T).max(initial=0.0) > 1e-9 * scale:
            raise ConfigError(f"{name} is not symmetric; a covariance must be.")
        least = np.linalg.eigvalsh(A).min(initial=np.inf)
        if least < -1e-9 * scale or (definite and least <= 0):
            word = "definite" if definite else "semidefinite"
            raise ConfigError(f"{name} is not positive {word} (smallest eigenvalue {least:.3g}); a covariance must be.")
    return P


def has(system: Any, method: str, *parts: str, why: str = "") -> None:
    """Raise ConfigError, with the reason, where the plant lacks one of the parts that the method requires."""
    missing = [part for part in parts if not hasattr(system, part)]
    if missing:
        kind = plant_name(system)
        reason = f" ({why})" if why else ""
        raise ConfigError(f"{method} is not defined for the plant {kind}: it needs {', '.join(missing)}{reason}.")
    if "x0" in parts and hasattr(system, "n_x"):
        shape(f"x0 of the plant {getattr(system, 'name', type(system).__name__)}", system.x0, system.n_x)


def plant_name(system: Any) -> str:
    """The plant's own name, else that of its class."""
    return str(getattr(system, "name", None) or type(system).__name__)


def plant(system: Any, dt: float = 0.01) -> Any:
    """system, unchanged, when it is a plant (`core.System`) whose parts fit together: sizes, x0, P0, and shapes of f, h, Q and R.

    The functions are traced, not run. Raises ConfigError with one sentence that names the part and the shape it must have, also where NumPy
    or Python's float() is called on a value that has none yet."""
    kind = getattr(system, "name", type(system).__name__)
    has(system, "rotorwatch", "name", "n_x", "n_u", "n_theta", "n_y", "x0", "P0", "f", "h", "Q", "R")
    for size in ("n_x", "n_u", "n_theta", "n_y"):
        value = getattr(system, size)
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < (size in ("n_x", "n_y")):
            raise ConfigError(f"{size} of the plant {kind} must be a whole number, not {value!r}.")
    n_x, n_u, n_theta, n_y = system.n_x, system.n_u, system.n_theta, system.n_y
    shape(f"x0 of the plant {kind}", system.x0, n_x)
    shape(f"P0 of the plant {kind}", system.P0, n_x, n_x)
    x, u, theta, h = ((n_x,), (n_u,), (n_theta,), ())
    for part, arguments, expected in (
        ("f", (x, u, theta, h), (n_x,)),
        ("h", (x, u, theta), (n_y,)),
        ("Q", (h,), (n_x, n_x)),
        ("R", (u,), (n_y,)),
    ):
        got = _traced(f"{part} of the plant {kind}", getattr(system, part), arguments)
        if got != expected:
            raise ConfigError(f"{part} of the plant {kind} must return an array of the shape {expected}, not {got}.")
    return positive("dt", dt) and system


def controller(u: Any, system: Any) -> None:
    """Raise ConfigError unless u(t, y) can be traced and returns (n_u,)."""
    got = _traced("u(t, y)", u, ((), (system.n_y,)))
    if got != (system.n_u,):
        raise ConfigError(f"u(t, y) must return an array of the shape {(system.n_u,)}, not {got}.")


def _traced(name: str, function: Any, arguments: tuple[tuple[int, ...], ...]) -> tuple[int, ...]:
    """The shape of what a function returns for arrays of these shapes. Raises ConfigError where it cannot be traced."""
    empty = [jax.ShapeDtypeStruct(size, np.float64) for size in arguments]
    try:
        out = jax.eval_shape(function, *empty)
        return tuple(out.shape)
    except jax.errors.JAXTypeError as why:
        raise ConfigError(untraceable(name, why)) from why
    except ConfigError:
        raise
    except Exception as why:  # a user's function may raise anything
        reason = " ".join(f"{type(why).__name__}: {why}".split())[:200]
        raise ConfigError(f"{name} fails for arguments of the shapes {arguments}: {reason.rstrip('.')}.") from why


def untraceable(name: str, why: BaseException) -> str:
    """A sentence for JAX's error about a value that has none yet: NumPy, float(), bool() or `if` on it. Names the line."""
    return (
        f"{name} asks for the number behind a value that is known only at run time{_where(why)}: use jax.numpy instead of numpy or "
        "math there, and jnp.where instead of `if`."
    )


def _where(why: BaseException) -> str:
    """The innermost line outside the libraries, as " (file, line)"."""
    frames = traceback.extract_tb(why.__traceback__)
    user = [f for f in frames if "site-packages" not in f.filename and "/rotorwatch/" not in f.filename]
    inside = user or [f for f in frames if "/rotorwatch/" in f.filename and not f.filename.endswith("checks.py")]
    return f" ({inside[-1].filename.rpartition('/')[2]}, line {inside[-1].lineno})" if inside else ""


def concrete(value: Any) -> bool:
    """True if the value is known now: not a tracer inside a compiled program."""
    return "jax" not in sys.modules or not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))
