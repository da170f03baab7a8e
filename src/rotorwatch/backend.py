"""JAX, set up once: float64, and compiled programs kept on disk between runs."""

from __future__ import annotations

import functools
import os
import sys
from pathlib import Path

from rotorwatch.errors import ConfigError


def cache_folder() -> Path:
    """Where compiled programs are kept: $ROTORWATCH_CACHE, else $XDG_CACHE_HOME/rotorwatch, else ~/.cache/rotorwatch."""
    if "ROTORWATCH_CACHE" in os.environ:
        return Path(os.environ["ROTORWATCH_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rotorwatch"


@functools.cache
def jax():
    """The jax module in float64 with a persistent compilation cache; imported on first use, because it takes 0.5 s.

    Every plant and every estimator asks for it when it is made, so that nothing of theirs is traced in float32.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    loaded = "jax" in sys.modules
    try:
        import jax
    except ModuleNotFoundError:
        raise ConfigError("This needs JAX, which is not installed: pip install jax.") from None

    if not jax.config.read("jax_enable_x64"):
        jax.config.update("jax_enable_x64", True)
        if loaded:  # what was traced before is float32, and would be mixed into what comes now
            jax.clear_caches()
    try:
        folder = cache_folder() / "jax"
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
            jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    except OSError:  # a read-only home only costs a recompilation
        pass
    return jax
