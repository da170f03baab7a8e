"""Native code that comes with the package: made when the package is, found here by what it was made of, run without JAX.

A folder holds libraries, C to be compiled when it is first needed, and `index.json`: what each of them is (functions, shapes, layout,
SHA-256), and the definition that all were traced from, as the files of this package and a hash of them. Where a file has changed since,
nothing of the folder is used: code that is older than the definition, or not what was made, never runs.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import lzma
import platform
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

HOME = Path(__file__).parents[1]
FOLDER = Path(__file__).parent / "built"
INDEX = "index.json"
DEFINITIONS = (
    "definitions.json"  # what `compiling.running` runs: room -> digest of its files, target, library and its SHA-256
)
FORMAT = 3

# Levels of processors, best first: the compiler's -march and the flags of /proc/cpuinfo that code of that level needs
# (x86-64 psABI, micro-architecture levels). A processor of another kind has its compiler's own baseline.
LEVELS: dict[str, tuple[str, ...]] = {
    "x86-64-v3": ("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"),
    "x86-64": (),
}
BASELINE = ""
# Names that programs do not hold: the package's version, and what is raised.
NOTHING = ("__init__.py", "errors.py")


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
    except OSError:  # another system: what every such processor runs
        flags = set()
    return tuple(name for name, needs in LEVELS.items() if flags.issuperset(needs))


def files_of(roots: Iterable[str], alone: Iterable[str]) -> list[str]:
    """Files of the package, from its folder on, that the modules `roots` import, directly or not, inside functions too; of the modules
    `alone`, and of modules of which only constants (NAMES IN CAPITALS) are imported, the file itself and nothing further."""
    found, waiting = {_file(name) for name in alone}, [_file(name) for name in roots]
    followed: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path in followed:
            continue
        followed.add(path)
        for module, constants in _imports(path):
            if module.relative_to(HOME).as_posix() in NOTHING:
                continue
            found.add(module)
            if not constants:
                waiting.append(module)
    return sorted(path.relative_to(HOME).as_posix() for path in found | followed)


def _file(name: str) -> Path:
    """The file of a module of this package."""
    place = HOME.joinpath(*name.split(".")[1:])
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


def _imports(path: Path) -> list[tuple[Path, bool]]:
    """(file, only its constants?) of each module of this package that a file imports."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("rotorwatch"):
            continue
        package = _file(node.module or "")
        inner = [a.name for a in node.names if _file(f"{node.module}.{a.name}").exists()]
        found += [(_file(f"{node.module}.{name}"), False) for name in inner]
        own = [a.name for a in node.names if a.name not in inner]
        if own and package.exists():
            found.append((package, all(name.isupper() for name in own)))
    return found


def templates() -> list[str]:
    """Files of C that translated programs begin with."""
    return sorted(path.relative_to(HOME).as_posix() for path in (HOME / "compiling" / "c99").glob("*.h*"))


def files_in(room: str) -> list[str]:
    """Files of the package that the definitions of a room are translated from."""
    own = [path.relative_to(HOME).as_posix() for path in (HOME / room).glob("*.py")]
    return sorted([*own, *(f"compiling/{name}.py" for name in ("structs", "body", "translate"))])


def digest(files: Iterable[str]) -> str:
    """Hash of files of the package as they are now; of a file that is gone, that it is."""
    made = hashlib.sha256(str(FORMAT).encode())
    for name in files:
        path = HOME / name
        made.update(name.encode() + b"\0" + (path.read_bytes() if path.exists() else b"\1") + b"\0")
    return made.hexdigest()


def key(names: Any, shapes: Any, like: Any, sizes: Any) -> str:
    """What a program is known by: functions that build it, shapes and structure of its parameters, sizes of u and y."""
    return hashlib.sha256(json.dumps([names, shapes, like, sizes]).encode()).hexdigest()[:32]


@functools.cache
def _index(folder: Path) -> tuple[dict, str]:
    """(programs by key, why there are none)."""
    try:
        index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        files, recorded_digest, made_for = index["definition"]["files"], index["definition"]["digest"], index["target"]
    except OSError:
        return {}, "this installation came without native code"
    except (ValueError, KeyError, TypeError):
        return {}, f"{folder / INDEX} is damaged: install rotorwatch again"
    if made_for != target():
        return {}, f"the native code that came with it is for {made_for}"
    if digest(files) != recorded_digest:
        return {}, "the native code that came with it is of another version of the method"
    return index["programs"], ""


def find(program: str, folder: Path = FOLDER) -> tuple[Path, list] | None:
    """(library, layout) of a program by its `key`, best for this processor; None where there is none (`why_not`)."""
    known = _index(folder)[0].get(program)
    if not known:
        return None
    for level in levels():
        name, sha256 = known["libraries"].get(level) or ("", "")
        if name and _as_built(folder / name, sha256):
            return folder / name, known["layout"]
    return None


class Source(NamedTuple):
    """C that came with the package, to be compiled for this computer. words: whose it is, in a sentence."""

    words: str
    header: str
    source: str
    layout: list


def source(program: str, folder: Path = FOLDER) -> Source | None:
    """The C of a program by its `key`; None where there is none."""
    known = _index(folder)[0].get(program)
    name, sha256 = (known or {}).get("source") or ("", "")
    if not known or not name or digest_of(folder / name) != sha256:
        return None
    header, text = json.loads(lzma.decompress((folder / name).read_bytes()))
    return Source(known["words"], header, text, known["layout"])


def write_source(path: Path, header: str, text: str) -> None:
    """Keep C as `source` reads it, the same bytes at every time."""
    path.write_bytes(lzma.compress(json.dumps([header, text]).encode()))


@functools.cache
def _as_built(library: Path, sha256: str) -> bool:
    """Asked once of each: what is loaded stays loaded."""
    return digest_of(library) == sha256


def digest_of(path: Path) -> str:
    """SHA-256 of a file; empty where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def whole(folder: Path) -> bool:
    """Whether every file that a folder's index names is there, as it was made."""
    programs, _ = _index(folder)
    named = [library for program in programs.values() for library in program["libraries"].values()]
    named += [program["source"] for program in programs.values() if program.get("source")]
    return bool(named) and all(digest_of(folder / name) == sha256 for name, sha256 in named)


def why_not(folder: Path = FOLDER) -> str:
    """Why `find` found nothing, as the middle of a sentence."""
    return _index(folder)[1] or "no native code for such a vehicle, or for this processor, came with rotorwatch"
