"""Set-up of JAX: float64, and compiled programs cached on disk between runs."""

from __future__ import annotations

import functools
import importlib
import os
import sys
from pathlib import Path
from typing import Any

from rotorwatch.errors import ConfigError


def cache_folder() -> Path:
    """Folder of compiled programs: $ROTORWATCH_CACHE, else $XDG_CACHE_HOME/rotorwatch, else ~/.cache/rotorwatch."""
    if "ROTORWATCH_CACHE" in os.environ:
        return Path(os.environ["ROTORWATCH_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rotorwatch"


def code_folder(name: str) -> Path:
    """A cache folder for code that is loaded and run, created where missing. Raises PermissionError where it is not writable or other users
    can write to it; OSError."""
    place = cache_folder() / name
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = place.stat()
    if not os.access(place, os.W_OK):
        raise PermissionError(f"{place} cannot be written")
    if hasattr(os, "getuid") and about.st_uid not in (os.getuid(), 0):
        raise PermissionError(f"{place} belongs to another user, who could put code there: set ROTORWATCH_CACHE")
    if os.name == "posix" and about.st_mode & 0o022:
        raise PermissionError(f"{place} can be written by other users, who could put code there: chmod go-w {place}")
    return place


@functools.cache
def set_up() -> None:
    """Import JAX, in float64 and with a persistent compilation cache. Raises ConfigError where it is not installed."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    loaded = "jax" in sys.modules
    try:
        import jax
    except ModuleNotFoundError:
        raise ConfigError("This needs JAX, which is not installed: pip install jax.") from None

    if not jax.config.read("jax_enable_x64"):
        jax.config.update("jax_enable_x64", True)
        if loaded:  # functions traced before are float32, and would be mixed with float64
            jax.clear_caches()
    try:
        folder = code_folder("jax")
    except OSError:  # a read-only or foreign home only costs a recompilation
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


class _Module:
    """A JAX module whose import, and JAX's set-up, are deferred to the first use, because they take 0.5 s.

    A call sets JAX up at once and returns the module: plants and estimators do so when constructed, so that nothing of theirs is traced in
    float32."""

    def __init__(self, name: str):
        self._name = name

    def __call__(self) -> Any:
        set_up()
        return importlib.import_module(self._name)

    def __getattr__(self, part: str) -> Any:
        if part.startswith("__"):  # probed by inspection tools
            raise AttributeError(part)
        value = getattr(self(), part)
        setattr(self, part, value)
        return value


jax: Any = _Module("jax")
jnp: Any = _Module("jax.numpy")
lax: Any = _Module("jax.lax")
