"""The C compiler and processor of this computer, and the folder of built libraries.

Uses Python's standard library alone: the build of the package needs it before anything is installed.
"""

from __future__ import annotations

import functools
import os
import platform
import warnings
from collections.abc import Callable
from pathlib import Path

from rotorwatch.base import incoming
from rotorwatch.base.backend import cache_folder, code_folder
from rotorwatch.errors import BackendWarning, ConfigError


class Unavailable(ConfigError):
    """No native code on this computer; the sentence says why."""


waiting: Callable[[str], None] | None = None
"""Reported what is about to be built, which takes seconds and is done once: a program with somebody who waits sets it."""


def building(what: str) -> None:
    """Warn a waiting user that native code is being built."""
    if waiting is not None:
        waiting(what)


def compiler() -> str:
    """The C compiler: $CC, else cc, gcc or clang. Raises Unavailable."""
    import shlex
    import shutil

    candidates = [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]
    for name in candidates:
        path = shutil.which(shlex.split(name)[0])
        if path:
            return path
    raise Unavailable(f"There is no C compiler ({', '.join(candidates)}): install gcc or clang, or set CC.")


@functools.cache
def processor() -> str:
    """The kind of processor that the compiler builds for, as in `platform.machine()`: another one than this computer's for a cross compiler
    (CC=aarch64-linux-gnu-gcc). Raises Unavailable without a compiler."""
    import subprocess

    run = subprocess.run([compiler(), "-dumpmachine"], capture_output=True, text=True, check=False)
    target = run.stdout.strip().partition("-")[0]
    same = not target or run.returncode or {target, platform.machine().lower()} == {"x86_64", "amd64"}
    return platform.machine() if same else target


@functools.cache
def machine() -> str:
    """The compiler and the processor, so that a cache shared by computers holds a build for each."""
    cc = Path(compiler())
    about = cc.resolve().stat()
    try:
        info = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        cpu = "".join(line for line in info if line.startswith(("model name", "flags", "Features", "CPU part")))
    except OSError:
        cpu = platform.processor()
    return f"{cc} {about.st_size} {about.st_mtime_ns} {platform.machine()} {cpu}"


def folder() -> Path:
    """Folder of built libraries; one for this process only where the cache is not writable, or other users can write to it."""
    try:
        return code_folder("native")
    except PermissionError as why:
        reason = str(why) if why.errno is None else f"{why.filename} cannot be written"
    except OSError:
        reason = f"{cache_folder()} cannot be written"
    return _temporary(reason)


@functools.cache
def _temporary(why: str) -> Path:
    warnings.warn(f"{why}; native code is built anew in every process.", BackendWarning, stacklevel=4)
    place = incoming.spool() / "native"
    place.mkdir(exist_ok=True)
    return place
