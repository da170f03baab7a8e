"""Execution of `structs` definitions: as machine code where it was shipped or can be built, else by Python.

    definition = Definition("front", modules, sizes)
    one = definition.new(Airborne)
    definition.call(whole.fly, one, vehicle, n, kinds, times, ...)
    one["ended"]                      # a field; rows["time"] of an array of structs

Arguments: structs and arrays of them made here; contiguous NumPy arrays of the type that the function declares; numbers. A function may
write into arrays of integers, and into structs. Both ways give the same bits.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from rotorwatch.base.compiling import shipped, structs, toolchain
from rotorwatch.base.compiling.structs import Struct
from rotorwatch.errors import FirstUse

TYPES = {
    "real": np.float64,
    "time": np.float64,
    "each": np.float64,
    "int": np.int32,
    "flag": np.bool_,
    "mask": np.uint16,
    "small": np.int16,
    "letter": np.int8,
    "byte": np.uint8,
}
WHOLE = "int", "mask", "small"  # kinds of numbers that are int32 as arguments
# Lanes calculated at once in machine code (`structs.Each`), by level of the processor: the width of its vectors.
LANES, OTHER_LANES = {"x86-64-v3": 4}, 2
# No fused multiply and add: the same operations as Python's.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")
# ... for several lanes at once, at the processor's full width. -O3 would take half as long again, for the same speed.
VECTORS = ("-ftree-vectorize", "-fvect-cost-model", "-fno-trapping-math", "-fno-semantic-interposition")

TRANSLATOR = tuple(f"base/compiling/{name}.py" for name in ("structs", "body", "translate"))
"""Files that every definition is made by."""


class Rows:
    """An array of structs, or a single one, with fields by name as NumPy arrays."""

    def __init__(self, kind: type[Struct], native: np.ndarray | None, plain: list | None, many: bool = False):
        self.kind, self.native, self.plain, self.many = kind, native, plain, many

    def __getitem__(self, name: str) -> Any:
        """A field of all of them, (n, ...)."""
        if self.native is not None:
            return self.native[name]
        assert self.plain is not None
        return np.array([getattr(one, name) for one in self.plain])

    def part(self, name: str) -> Rows:
        """A field that is a struct, or an array of structs (of the first one)."""
        field: Any = self.kind._deep[name]
        several = isinstance(field, structs.Array)
        kind = field.kind if several else field
        if self.native is not None:
            return Rows(kind, self.native[name][0] if several else self.native[name], None)
        inner = [getattr(one, name) for one in self.plain or ()]
        return Rows(kind, None, inner[0] if several else inner)

    def row(self, number: int) -> Rows:
        """The struct at an index, from 0."""
        if self.native is not None:
            return Rows(self.kind, self.native[number : number + 1], None)
        return Rows(self.kind, None, (self.plain or [])[number : number + 1])

    def cut(self, count: int) -> Rows:
        """A copy of the first `count` structs."""
        if self.native is not None:
            return Rows(self.kind, self.native[:count].copy(), None, many=True)
        copies = [type(one)() for one in (self.plain or ())[:count]]
        for to, one in zip(copies, self.plain or ()):
            structs.copy(to, one)
        return Rows(self.kind, None, copies, many=True)

    def copy(self) -> Rows:
        """A copy of a single struct."""
        copied = self.cut(1)
        return Rows(self.kind, copied.native, copied.plain)

    def assign(self, other: Rows) -> None:
        """Overwrite the first one with a copy of the first of `other`, in place."""
        if self.native is not None and other.native is not None:
            self.native[0] = other.native[0]
        else:
            assert self.plain is not None and other.plain is not None
            structs.copy(self.plain[0], other.plain[0])

    @staticmethod
    def joined(parts: Sequence[Rows]) -> Rows:
        """Concatenation of arrays."""
        first = parts[0]
        if first.native is not None:
            return Rows(first.kind, np.concatenate([one.native for one in parts if one.native is not None]), None, many=True)
        return Rows(first.kind, None, [x for one in parts for x in one.plain or ()], many=True)

    def fill(self, **columns: Any) -> None:
        """Write fields, one row of values per struct; arrays fill the first part of a field."""
        for name, values in columns.items():
            if self.native is not None:
                self.native[name][tuple(slice(0, s) for s in np.shape(values))] = values
            else:
                for one, value in zip(self.plain or (), values):
                    _fill(one, name, value)

    def put(self, **fields: Rows) -> None:
        """Copy struct fields from the first struct of the given rows into the first one here."""
        for name, rows in fields.items():
            if self.native is not None and rows.native is not None:
                self.native[name][0] = rows.native[0]
            else:
                assert self.plain is not None and rows.plain is not None
                structs.copy(getattr(self.plain[0], name), rows.plain[0])

    def set(self, **fields: Any) -> None:
        """Write fields of the first struct; arrays fill the first part of a field."""
        for name, value in fields.items():
            if self.native is not None:
                place = self.native[name][0]
                if np.ndim(value):
                    place[tuple(slice(0, s) for s in np.shape(value))] = value
                else:
                    self.native[name][0] = value
            else:
                assert self.plain is not None
                _fill(self.plain[0], name, value)


def _fill(one: Any, name: str, value: Any) -> None:
    if not np.ndim(value):
        setattr(one, name, value.item() if isinstance(value, np.generic) else value)
        return
    place, rows = getattr(one, name), np.asarray(value).tolist()
    for i, row in enumerate(rows):
        if isinstance(row, list):
            place[i][: len(row)] = row
        else:
            place[i] = row


class Definition:
    """Modules of definitions. name: of the library; sizes: the modules with the sizes of arrays; files: of the package, from which these
    are made, by default all in the folder of that name; vectors: built for each level of processors (shipped.LEVELS), not once for all."""

    def __init__(
        self,
        name: str,
        modules: Sequence[ModuleType],
        sizes: ModuleType | Sequence[ModuleType],
        files: Sequence[str] | None = None,
        vectors: bool = False,
    ):
        self.name, self.modules, self.vectors = name, tuple(modules), vectors
        self.sizes = (sizes,) if isinstance(sizes, ModuleType) else tuple(sizes)
        self.files = shipped.files_in(name) if files is None else sorted([*files, *TRANSLATOR])
        self._types: dict[type[Struct], np.dtype] = {}
        self._other: dict[str, float] = {}

    @functools.cached_property
    def library(self) -> ctypes.CDLL | None:
        """Machine code; None without any and without a compiler, or where $ROTORWATCH_DEFINITIONS is python."""
        if os.environ.get("ROTORWATCH_DEFINITIONS") == "python":
            return None
        path = None if self._other else self._shipped()
        try:
            return ctypes.CDLL(str(path or self.build(toolchain.folder(), self._levels()[0])))
        except (toolchain.Unavailable, OSError) as why:
            warnings.warn(f"{why} Python runs instead, slowly.", FirstUse, stacklevel=2)
            return None

    @property
    def lanes(self) -> int:
        """Number of lanes calculated side by side."""
        return 1 if self.library is None else ctypes.c_int32.in_dll(self.library, "rw_lanes").value

    @contextmanager
    def changed(self, values: Mapping[str, float]) -> Iterator[None]:
        """Context in which constants of the modules have other values: "losses.HIDDEN" -> value. Machine code with them is built once."""
        places = []  # of a name: its own module, and those that import it
        for key, value in values.items():
            home, _, name = key.partition(".")
            (own,) = (vars(m) for m in self.modules if m.__name__.endswith(f".{home}"))
            places += [(m, name, own[name], value) for m in self.modules if vars(m).get(name) is own[name]]
        others, usual = self._other, self.library
        self._other = {**others, **values}
        if usual is not None:
            del self.__dict__["library"]  # rebuilt with these values
        try:
            for module, name, _, value in places:
                setattr(module, name, value)
            yield
        finally:
            self._other = others
            self.__dict__["library"] = usual
            for module, name, value, _ in places:
                setattr(module, name, value)

    @property
    def digest(self) -> str:
        """Hash of its source files."""
        return shipped.digest(self.files)

    def _shipped(self) -> Path | None:
        """The shipped library, if it was made from these files and is intact."""
        try:
            known = json.loads((shipped.FOLDER / shipped.DEFINITIONS).read_text(encoding="utf-8"))[self.name]
            libraries = known["libraries"] if known["digest"] == self.digest and known["target"] == shipped.target() else {}
            file, sha256 = next(libraries[level] for level in self._levels() if level in libraries)
        except (OSError, ValueError, KeyError, TypeError, StopIteration):
            return None
        path = shipped.FOLDER / file
        return path if shipped.digest_of(path) == sha256 else None

    def _levels(self) -> tuple[str, ...]:
        """Levels of processors whose code this computer runs, best first."""
        return shipped.levels() if self.vectors else (shipped.BASELINE,)

    def ship(self, folder: Path, levels: Sequence[str] = (shipped.BASELINE,)) -> None:
        """Put the library into the folder of shipped code, beside those of other definitions. levels: of processors, where each has its
        own."""
        import shutil

        libraries = {}
        for level in levels if self.vectors else (shipped.BASELINE,):
            name = f"{self.name}{level and '-' + level}.so"
            shutil.copyfile(self.build(toolchain.folder(), level), folder / name)
            libraries[level] = name, shipped.digest_of(folder / name)
        known = {"digest": self.digest, "target": shipped.target(toolchain.processor()), "libraries": libraries}
        index = folder / shipped.DEFINITIONS
        others = json.loads(index.read_text(encoding="utf-8")) if index.exists() else {}
        index.write_text(json.dumps({**others, self.name: known}, indent=1) + "\n", encoding="utf-8")

    def translated(self, level: str = shipped.BASELINE) -> tuple[str, str, str]:
        """(rw_config.h, header, source) for a computer."""
        from rotorwatch.base.compiling.translate import Translation

        whole = Translation(self.modules, *self.sizes)
        sizes = {**whole.sizes, "LANES": LANES.get(level, OTHER_LANES)}
        config = "".join(f"#define RW_{name} {value}\n" for name, value in sizes.items())
        source = whole.source(f"rw_{self.name}.h") + "\nextern const int32_t rw_lanes;\nconst int32_t rw_lanes = RW_LANES;\n"
        return config, whole.header("For this computer.", name=self.name), source

    def build(self, folder: Path, level: str = shipped.BASELINE) -> Path:
        """The library in a folder, built unless present. level: of processors that it is for. Raises toolchain.Unavailable."""
        compiler = toolchain.compiler()
        flags = (*FLAGS, *(VECTORS if self.vectors else ()), *([f"-march={level}"] if level else ()))
        key = hashlib.sha256("\0".join([self.digest, repr(self._other), *flags, toolchain.machine()]).encode()).hexdigest()
        goal = folder / f"{self.name}-{key[:32]}.so"
        seal = goal.with_suffix(".sha256")
        if goal.exists() and seal.exists() and seal.read_text() == shipped.digest_of(goal):
            return goal
        import subprocess
        import tempfile

        toolchain.building(self.name)
        with tempfile.TemporaryDirectory() as scratch:
            place = Path(scratch)
            for name, text in zip(("rw_config.h", f"rw_{self.name}.h", f"rw_{self.name}.c"), self.translated(level)):
                (place / name).write_text(text, encoding="utf-8")
            library = place / "made.so"
            command = [compiler, *flags, "-o", str(library), str(place / f"rw_{self.name}.c"), "-lm"]
            run = subprocess.run(command, capture_output=True, text=True, check=False)
            if run.returncode:
                message = (run.stderr.strip().splitlines() or ["nothing said"])[0]
                raise toolchain.Unavailable(f"{compiler} cannot build native code: {message}.")
            for to, data in ((goal, library.read_bytes()), (seal, shipped.digest_of(library).encode())):
                part = to.with_suffix(f".{os.getpid()}")
                part.write_bytes(data)
                os.replace(part, to)
        return goal

    # Structs

    def type_of(self, kind: type[Struct]) -> np.dtype:
        """A Struct as C lays it out."""
        if kind not in self._types:
            fields = []
            for name, value in kind.declared():
                if isinstance(value, structs.Array):
                    shape = tuple(n // self.lanes if isinstance(n, structs.Packed) else n for n in value.shape)
                    fields.append((name, self._stored(value.kind), shape))
                else:
                    kept = value if isinstance(value, type) else structs.SCALARS[kind.__annotations__[name]]
                    fields.append((name, self._stored(kept)))
            self._types[kind] = np.dtype(fields, align=True)
        return self._types[kind]

    def _stored(self, kind: str | type[Struct]) -> Any:
        """An element of a kind as C lays it out."""
        if isinstance(kind, type):
            return self.type_of(kind)
        return np.dtype((TYPES[kind], (self.lanes,))) if kind == structs.EACH else TYPES[kind]

    def new(self, kind: type[Struct]) -> Rows:
        """A struct with its initial values."""
        if self.library is None:
            return Rows(kind, None, [kind()])
        rows = np.zeros(1, self.type_of(kind))
        getattr(self.library, f"{structs.snake(kind.__name__)}_init")(ctypes.c_void_p(rows.ctypes.data))
        return Rows(kind, rows, None)

    def array(self, kind: type[Struct], count: int) -> Rows:
        """Uninitialised structs."""
        if self.library is None:
            return Rows(kind, None, [kind() for _ in range(count)], many=True)
        return Rows(kind, np.zeros(count, self.type_of(kind)), None, many=True)

    def call(self, function: Callable, *arguments: Any) -> Any:
        """Call a free function of the modules. Raises TypeError for arguments of other types, which C would misread."""
        taken = _taken(function)
        if len(taken) != len(arguments):
            raise TypeError(f"{function.__name__} takes {len(taken)} arguments, not {len(arguments)}.")
        for (name, kind), x in zip(taken, arguments):
            if not _fits(kind, x):
                raise TypeError(f"{function.__name__}: {name} must be {_called(kind)}, not {_called(x)}.")
        if self.library is None:
            plain = [_plain(x) for x in arguments]
            result = function(*plain)
            for x, argument in zip(arguments, plain):
                if isinstance(argument, list) and isinstance(x, np.ndarray) and x.flags.writeable:
                    x.reshape(-1)[:] = argument  # a function may write them
            return result
        name = f"rw_{function.__module__.rpartition('.')[2]}_{function.__name__}"
        called = getattr(self.library, name)
        result = str(function.__annotations__.get("return"))
        called.restype = {"int": ctypes.c_int32, "bool": ctypes.c_bool, "None": None}.get(result, ctypes.c_double)
        return called(*(_native(kind, x) for (_, kind), x in zip(taken, arguments)))


@functools.cache
def _taken(function: Callable) -> tuple[tuple[str, Any], ...]:
    """(name, kind) of a function's arguments: a Struct, NumPy's type of an array's elements, or the kind of a number or a text."""

    def kind(text: str) -> Any:
        if text in structs.SCALARS:
            return structs.SCALARS[text]
        if text == "Vectors" or text in structs.LISTS:
            return np.dtype(TYPES[structs.LISTS.get(text, structs.REAL)])
        return function.__globals__[text.removeprefix("list[").removesuffix("]")]

    return tuple((name, kind(text)) for name, text in function.__annotations__.items() if name != "return")


def _fits(kind: Any, x: Any) -> bool:
    if isinstance(kind, np.dtype):
        return isinstance(x, np.ndarray) and x.dtype == kind and x.flags.c_contiguous
    if isinstance(kind, str):
        numbers = int | np.integer if kind in WHOLE else int | float | np.integer | np.floating
        return isinstance(x, str if kind == "text" else bool | np.bool_ if kind == "flag" else numbers)
    return isinstance(x, Rows) and x.kind is kind and (x.native is None or x.native.flags.c_contiguous)


def _called(x: Any) -> str:
    """A kind, or an argument, in words."""
    if isinstance(x, np.dtype):
        return f"an array of {x} without gaps"
    if isinstance(x, np.ndarray):
        return f"an array of {x.dtype}{'' if x.flags.c_contiguous else ' with gaps'}"
    if isinstance(x, Rows):
        return f"{x.kind.__name__}{'' if x.native is None or x.native.flags.c_contiguous else ' with gaps'}"
    return x if isinstance(x, str) else (x if isinstance(x, type) else type(x)).__name__


def _native(kind: Any, x: Any) -> Any:
    """A valid argument in the form that C takes."""
    if isinstance(x, Rows):
        assert x.native is not None
        return ctypes.c_void_p(x.native.ctypes.data)
    if isinstance(x, np.ndarray):
        return ctypes.c_void_p(x.ctypes.data)
    if isinstance(x, str):
        return ctypes.c_char_p(x.encode("ascii", "replace"))
    if kind == "flag":
        return ctypes.c_bool(bool(x))
    return ctypes.c_int32(int(x)) if kind in WHOLE else ctypes.c_double(float(x))


def _plain(x: Any) -> Any:
    if isinstance(x, Rows):
        assert x.plain is not None
        return x.plain if x.many else x.plain[0]
    if not isinstance(x, np.ndarray):
        return x
    # Row by row, as in C. Integers without a copy: byte arrays are long.
    return x.reshape(-1).data if x.dtype in (np.int32, np.uint8) else x.ravel().tolist()
