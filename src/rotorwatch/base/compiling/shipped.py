"""Machine code shipped with the package, identified by the digest of its source definitions.

Where a file of a definition has changed since, its library is not used: code older than its definition, or altered, never runs
(`compiling.running`).
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Iterable
from pathlib import Path

HOME = Path(__file__).parents[2]
FOLDER = Path(__file__).parent / "built"
DEFINITIONS = "definitions.json"  # for `compiling.running`: folder -> digest of its files, target, library, its SHA-256
FORMAT = 3

# Levels of processors, best first: the compiler's -march and the flags of /proc/cpuinfo that code of that level needs
# (x86-64 psABI, micro-architecture levels). A processor of another kind has its compiler's own baseline.
LEVELS: dict[str, tuple[str, ...]] = {"x86-64-v3": ("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"), "x86-64": ()}
BASELINE = ""


def target(processor: str = "") -> str:
    """The kind of computer that code is for: operating system and processor, by default this one's."""
    return f"{sys.platform} {(processor or platform.machine()).lower()}"


def levels() -> tuple[str, ...]:
    """Levels of code that this processor runs, best first."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return (BASELINE,)
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as file:
            flags = next((set(line.split()) for line in file if line.startswith("flags")), set())
    except OSError:  # another system: the baseline
        flags = set()
    return tuple(name for name, needs in LEVELS.items() if flags.issuperset(needs))


def files_in(room: str) -> list[str]:
    """Source files of a folder's definitions."""
    folder = HOME / room
    sources = [f"{room}/{name}" for name in os.listdir(folder) if name.endswith(".py")] if folder.is_dir() else []
    return sorted([*sources, *(f"base/compiling/{name}.py" for name in ("structs", "body", "translate"))])


def digest(files: Iterable[str]) -> str:
    """Hash of files of the package as they are now; a missing file counts as such."""
    hash_ = hashlib.sha256(str(FORMAT).encode())
    for name in files:
        try:
            with open(f"{HOME}/{name}", "rb") as file:
                text = file.read()
        except FileNotFoundError:
            text = b"\1"
        hash_.update(name.encode() + b"\0" + text + b"\0")
    return hash_.hexdigest()


def digest_of(path: Path) -> str:
    """SHA-256 of a file; empty where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
