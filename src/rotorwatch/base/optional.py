"""Optional libraries: imported where installed, else a ConfigError with the command to install them."""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from rotorwatch.errors import ConfigError

if TYPE_CHECKING:
    import tomllib as tomllib


def __getattr__(name: str) -> Any:
    """tomllib, on demand; on Python 3.10 its backport."""
    if name == "tomllib":
        return importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def library(name: str, what: str) -> Any:
    """The library of that name, imported. Raises ConfigError with the command to install it. what: the feature that needs it."""
    try:
        importlib.import_module(name.partition(".")[0])  # a part of it may be loaded already
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise ConfigError(f"{what} needs {package}, which is not installed: pip install {package}.") from None
