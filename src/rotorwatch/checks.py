"""Checks of what a user configures: each raises ConfigError with one sentence that names the argument and says what it must be.

Inside a compiled program arrays have no values yet; there only shapes can be checked, and only they are.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError


def shape(name: str, value: Any, *expected: int) -> Any:
    """value, unchanged, when it is an array of that shape."""
    found = np.shape(value)
    if found != expected:
        raise ConfigError(f"{name} must have the shape {expected}, not {found}.")
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
    """Nothing when the plant offers all these parts; else says that the method is not defined for it, and why."""
    missing = [part for part in parts if not hasattr(system, part)]
    if missing:
        kind = plant_name(system)
        reason = f" ({why})" if why else ""
        raise ConfigError(f"{method} is not defined for the plant {kind}: it needs {', '.join(missing)}{reason}.")


def plant_name(system: Any) -> str:
    """The plant's own name, else that of its class."""
    return str(getattr(system, "name", None) or type(system).__name__)


def library(name: str, what: str) -> Any:
    """The library of that name, imported. Raises ConfigError that says how to install it, where it is not: what needs it."""
    try:
        importlib.import_module(name.partition(".")[0])  # a part of it may be loaded already
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise ConfigError(f"{what} needs {package}, which is not installed: pip install {package}.") from None


def concrete(value: Any) -> bool:
    """Whether the value is known now: not a tracer inside a compiled program."""
    import sys

    jax = sys.modules.get("jax")
    if jax is None:
        return True
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))
