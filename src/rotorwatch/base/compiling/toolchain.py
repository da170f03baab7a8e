"""What makes native code on this computer: the C compiler, its flags, the processor, and the folder where results are kept.

Python's own library is enough for this file: the build of the package asks it before anything is installed.
"""

from __future__ import annotations

import functools
import os
import platform
import shlex
import shutil
import subprocess
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rotorwatch.base import incoming
from rotorwatch.base.backend import cache_folder, code_folder
from rotorwatch.errors import BackendWarning, ConfigError

# Vector code of this processor; errno and signals of floating point are nobody's business here, NaN and signed zeros are.
FLAGS = ("-std=c99", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared")
# With glibc this macro only declares that sin, cos, exp and their like come as vectors too, and gcc then calls those in loops.
VECTORS = ("-D__FAST_MATH__", "-lmvec")
QUICK = ("-O1", "-ftree-loop-vectorize")  # for large programs


class Unavailable(ConfigError):
    """No native code on this computer; the sentence says why."""


class Unmakeable(Unavailable):
    """None came with the package, and JAX is not there to make any; the sentence says what to do."""


waiting: Callable[[str], None] | None = None
"""Told what is about to be built, which takes seconds and is done once: a program with somebody who waits sets it."""


def building(what: str) -> None:
    """Tell who waits."""
    if waiting is not None:
        waiting(what)


def compiler() -> str:
    """The C compiler: $CC, else cc, gcc or clang. Raises Unavailable."""
    candidates = [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]
    for name in candidates:
        found = shutil.which(shlex.split(name)[0])
        if found:
            return found
    raise Unavailable(f"There is no C compiler ({', '.join(candidates)}): install gcc or clang, or set CC.")


@functools.cache
def processor() -> str:
    """The kind of processor that the compiler builds for, as in `platform.machine()`: another one than this computer's when it is a cross
    compiler (CC=aarch64-linux-gnu-gcc). Raises Unavailable without a compiler."""
    done = subprocess.run([compiler(), "-dumpmachine"], capture_output=True, text=True, check=False)
    target = done.stdout.strip().partition("-")[0]
    same = not target or done.returncode or {target, platform.machine().lower()} == {"x86_64", "amd64"}
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
    """Where libraries are kept; a folder for this process only where the cache cannot be written, or could have been by others."""
    try:
        return code_folder("native")
    except PermissionError as why:
        reason = str(why) if why.errno is None else f"{why.filename} cannot be written"
    except OSError:
        reason = f"{cache_folder()} cannot be written"
    return _temporary(reason)


@contextmanager
def alone(goal: Path) -> Iterator[None]:
    """No other process makes that file of the cache meanwhile; the lock goes with the process."""
    with open(goal.with_suffix(".lock"), "w") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        except (ImportError, OSError):  # no such locks here: it is made twice, which only takes longer
            pass
        yield


@functools.cache
def _temporary(why: str) -> Path:
    warnings.warn(f"{why}; native code is built anew in every process.", BackendWarning, stacklevel=4)
    place = incoming.spool() / "native"
    place.mkdir(exist_ok=True)
    return place
