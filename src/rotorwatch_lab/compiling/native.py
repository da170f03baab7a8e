"""Estimators as machine code of this computer: exported C, built once by the system's compiler, called through ctypes.

The library is kept in the cache under a hash of its source, of the compiler with its flags and of the processor, so a changed
definition never meets an old build. What `run_built` runs is known by the package's own sources and the shapes it is given: from the second
time on nothing is traced, and JAX is not even imported.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import json
import os
import platform
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.compiling import shipped, toolchain
from rotorwatch.base.compiling.toolchain import Unavailable

# Vector code of this processor; errno and floating-point signals are not used, but NaN and signed zeros are.
FLAGS = ("-std=c99", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared")
# With glibc this macro only declares that sin, cos, exp and their like come as vectors too, and gcc then calls those in loops.
VECTORS = ("-D__FAST_MATH__", "-lmvec")
QUICK = ("-O1", "-ftree-loop-vectorize")  # for large programs
# Source characters above which only the worthwhile parts are optimised: the default diagnoser builds in 10 s, not 50, and runs as fast.
BIG = 80_000
_SEALED: set[Path] = set()
ROWS = 512  # run in one go, between two words on progress
LABORATORY = Path(__file__).parents[1]
TYPES = {"f": np.float64, "i": np.int32, "l": np.int64, "b": np.bool_}


class Unmakeable(Unavailable):
    """No library came with the package and JAX is not installed to build one; the message says what to do."""


class Layout(NamedTuple):
    """The calling interface of a library, without the program it was built from: structs as lists of (name, kind, shape), and the structure
    of carry and outputs (`described`)."""

    name: str
    parameters: list
    state: list
    out: list
    workspace: int
    carry_like: Any
    out_like: Any


@contextmanager
def _alone(goal: Path) -> Iterator[None]:
    """Hold an exclusive lock on that file of the cache, across processes; the lock is released when the process ends."""
    with open(goal.with_suffix(".lock"), "w") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        except (ImportError, OSError):  # no such locks here: it is made twice, which only takes longer
            pass
        yield


def build(header: str, source: str, name: str) -> Path:
    """The shared library of a program for this processor, built unless it is there already. Raises Unavailable with what the compiler
    says."""
    cc = toolchain.compiler()
    flags = (*(QUICK if len(source) > BIG else ("-O3",)), *FLAGS, "-march=native")
    vectors = VECTORS if toolchain.processor() == "x86_64" and platform.libc_ver()[0] == "glibc" else ()
    key = hashlib.sha256("\0".join([header, source, *flags, *vectors, toolchain.machine()]).encode()).hexdigest()[:32]
    goal = toolchain.folder() / f"{name}-{key}.so"
    seal = goal.with_suffix(".sha256")
    if _sealed(goal):
        return goal
    with _alone(goal), tempfile.TemporaryDirectory() as scratch:
        if _sealed(goal):  # by another process meanwhile
            return goal
        toolchain.building(name)
        for suffix, text in ((".h", header), (".c", source)):
            (Path(scratch) / f"{name}{suffix}").write_text(text, encoding="utf-8")
        compiled = Path(scratch) / "made.so"
        for extra in (vectors, ()):
            command = [cc, *flags, *extra[:1], "-o", str(compiled), str(Path(scratch) / f"{name}.c"), *extra[1:], "-lm"]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if not result.returncode or not extra:
                break
        if result.returncode:
            message = (result.stderr.strip().splitlines() or ["nothing said"])[0]
            raise Unavailable(f"{cc} cannot build native code: {message}.")
        # Atomic, even if another process builds the same; between the two writes it is not sealed, and would be built again.
        part = goal.with_suffix(f".{os.getpid()}")
        for place, data in ((goal, compiled.read_bytes()), (seal, shipped.digest_of(compiled).encode())):
            part.write_bytes(data)
            os.replace(part, place)
    return goal


def _sealed(library: Path) -> bool:
    """True if the cache holds the complete library as it was built; checked once per library, since a loaded one stays loaded."""
    if library not in _SEALED:
        recorded_digest = shipped.digest_of(library)
        try:
            if not recorded_digest or library.with_suffix(".sha256").read_text() != recorded_digest:
                return False
        except (OSError, ValueError):
            return False
        _SEALED.add(library)
    return True


def _dtype(fields) -> np.dtype:
    """The C struct as a NumPy type."""
    return np.dtype([(name, TYPES[kind], tuple(shape)) for name, kind, shape in fields if 0 not in shape], align=True)


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


class Library:
    """A built program, run on NumPy structs."""

    def __init__(self, path: Path, layout: Layout):
        self.layout = layout
        try:
            library = ctypes.CDLL(str(path))
        except OSError as why:
            raise Unavailable(f"{path} cannot be loaded ({why}); delete it and try again.") from None
        self.call, self.step = (getattr(library, f"{layout.name}_{verb}") for verb in ("run", "step"))
        self.call.restype = self.step.restype = None
        self.state_type, self.out_type = _dtype(layout.state), _dtype(layout.out)
        self.parameter_type = _dtype(layout.parameters)

    def room(self) -> np.ndarray:
        """A workspace, at the beginning of a cache line."""
        room = np.zeros(self.layout.workspace // 8 + 16)
        return room[-room.ctypes.data % 64 // 8 :]

    def pack(self, fields, kind: np.dtype, leaves) -> np.ndarray:
        """A struct of leaves."""
        struct = np.zeros((), kind)
        for (name, _, shape), leaf in zip(fields, leaves):
            if 0 not in shape:
                struct[name] = leaf
        return struct

    def leaves(self, state: np.ndarray) -> list[np.ndarray]:
        """The carry's arrays."""
        return [np.zeros(shape, TYPES[kind]) if 0 in shape else np.array(state[name]) for name, kind, shape in self.layout.state]

    def run(self, state: np.ndarray, parameters, u, y, valid, progress=None, room=None) -> list[np.ndarray]:
        """Step over rows; changes `state` (and `room`); returns the outputs' leaves, stacked: views of one table, which is never copied."""
        rows = len(u)
        out, room = np.empty(rows, self.out_type), self.room() if room is None else room
        between = [_address(parameters)] if self.layout.parameters else []
        for first in range(0, rows, ROWS):
            part = slice(first, first + ROWS)
            arguments = [_address(a[part]) for a in (u, y, valid)]
            count = min(ROWS, rows - first)
            self.call(ctypes.c_int32(count), _address(state), *between, *arguments, _address(out[part]), _address(room))
            if progress:
                progress(min(1.0, (first + ROWS) / rows))
        return self.columns(out)

    def columns(self, out: np.ndarray) -> list[np.ndarray]:
        """The leaves of outputs: views of the table of rows."""
        return [out[name] if 0 not in shape else np.zeros((len(out), *shape), TYPES[kind]) for name, kind, shape in self.layout.out]


class Live:
    """Steps one estimator as measurements arrive, without allocation. Not thread-safe."""

    def __init__(self, estimator):
        """estimator: any that can be exported. Raises Unavailable, or c99.lower.Refused."""
        self._library = traced(estimator, ())
        layout, system = self._library.layout, estimator.system
        self._state = self._library.pack(layout.state, self._library.state_type, flattened(estimator.init()))
        self._room = self._library.room()
        u_size = getattr(estimator, "n_u", system.n_u)
        self.u, self.y, self.valid = np.zeros(u_size), np.zeros(system.n_y), np.zeros(system.n_y, bool)
        self._out = np.zeros((), self._library.out_type)
        order = (self._state, self.u, self.y, self.valid, self._out, self._room)
        self._pointers = [_address(a) for a in order]
        views = [self._out[name] for name, _, _ in layout.out]
        self._estimate = rebuilt(layout.out_like, views)

    def step(self, u, y, valid) -> Any:
        """The output of the estimator's `step`, without the carry; its arrays are overwritten by the next step."""
        self.u[:], self.y[:], self.valid[:] = u, y, valid
        self._library.step(*self._pointers)
        return self._estimate


def described(tree: Any) -> Any:
    """A tree of (named) tuples, lists and dicts around leaves as JSON; raises TypeError for other nodes."""
    if isinstance(tree, dict):
        return {"dict": {k: described(tree[k]) for k in sorted(tree)}}
    if isinstance(tree, tuple | list):
        kind = type(tree)
        items = [described(item) for item in tree]
        return {"kind": f"{kind.__module__}:{kind.__qualname__}", "items": items}
    if tree is None:
        return {"none": True}
    return 0


def rebuilt(like: Any, leaves: Iterable) -> Any:
    """The tree that `described` describes, with new leaves in the same order."""
    flat = iter(leaves)

    def one(node) -> Any:
        if node == 0:
            return next(flat)
        if "none" in node:
            return None
        if "dict" in node:
            return {k: one(v) for k, v in node["dict"].items()}
        module, _, name = node["kind"].partition(":")
        kind: Any = functools.reduce(getattr, name.split("."), import_module(module))
        items = [one(item) for item in node["items"]]
        return kind(*items) if hasattr(kind, "_fields") else kind(items)

    return one(like)


def flattened(tree: Any) -> list:
    """Leaves of such a tree, in JAX's order."""
    if isinstance(tree, dict):
        return [leaf for k in sorted(tree) for leaf in flattened(tree[k])]
    if isinstance(tree, tuple | list):
        return [leaf for item in tree for leaf in flattened(item)]
    return [] if tree is None else [tree]


def _made(make_estimator: Callable, select: Callable, parameters, sizes: tuple[int, int], name: str):
    """(program, layout) of an estimator built from parameters: traced and exported."""
    from rotorwatch.base.backend import jax as load_jax
    from rotorwatch_lab.compiling.c99.project import Field, emit_program

    jax = load_jax()

    def step(p, carry, u, y, valid):
        carry, out = make_estimator(p).step(carry, u, y, valid)
        return carry, select(out)

    carry = make_estimator(parameters).init()
    n_u, n_y = sizes
    inputs = (Field("u", "f", (n_u,)), Field("y", "f", (n_y,)), Field("valid", "b", (n_y,)))
    program = emit_program(name, step, None, inputs, parameters, carry=carry)
    out = jax.eval_shape(step, parameters, carry, *(jax.ShapeDtypeStruct(f.shape, TYPES[f.kind]) for f in inputs))[1]
    p, s, o = ([(f.name, f.kind, list(f.shape)) for f in g] for g in (program.parameters, program.state, program.out))
    return program, Layout(name, p, s, o, program.workspace_bytes, described(carry), described(out))


def traced(estimator, parameters, select: Callable | None = None, sizes: tuple[int, int] | None = None) -> Library:
    """The library of an estimator object: traced every time, built once."""
    sizes = sizes or (getattr(estimator, "n_u", estimator.system.n_u), estimator.system.n_y)
    program, layout = _made(lambda _: estimator, select or (lambda out: out), parameters, sizes, "estimator")
    return Library(build(program.header, program.source, "estimator"), layout)


@functools.cache
def _package() -> str:
    """A hash of both packages' sources and of what traces them. Raises ConfigError without JAX."""
    digest = hashlib.sha256(_jax_version().encode())
    for home in (shipped.HOME, LABORATORY):
        templates = (home / "compiling" / "c99").glob("*.h*")
        for path in sorted([*home.rglob("*.py"), *templates]):
            digest.update(f"{home.name}/{path.relative_to(home)}".encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _jax_version() -> str:
    try:
        return metadata.version("jax")
    except metadata.PackageNotFoundError:
        raise Unmakeable("This needs JAX, which is not installed: pip install jax.") from None


def _named(function: Callable) -> str | None:
    """A function's full name when it is one of the two packages' own, found again by that name; of a partial one with its arguments."""
    if isinstance(function, functools.partial):
        inner = _named(function.func)
        try:
            return inner and inner + json.dumps(function.args)
        except TypeError:
            return None
    module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "<")
    return f"{module}:{name}" if module.startswith(("rotorwatch.", f"{LABORATORY.name}.")) and "<" not in name else None


class _Example:
    """Parameters that represent all others with the same names, shapes and types."""

    def __init__(self, values: Any):
        self.values, self._shapes = values, json.dumps([described(values), _shapes(values)])

    def __hash__(self):
        return hash(self._shapes)

    def __eq__(self, other):
        return isinstance(other, _Example) and other._shapes == self._shapes


def _shapes(parameters) -> list[tuple[tuple[int, ...], str]]:
    return [(np.shape(leaf), str(np.asarray(leaf).dtype)) for leaf in flattened(parameters)]


@functools.lru_cache(maxsize=32)
def _nameless(build_estimator: Callable, select: Callable, example: _Example, sizes: tuple[int, int]):
    """The library of functions known in this process only, or the reason why they cannot become C: traced once for all parameter values."""
    from rotorwatch_lab.compiling.c99.lower import Refused

    try:
        program, layout = _made(build_estimator, select, example.values, sizes, "estimator")
    except Refused as why:
        return why.with_traceback(None)
    return Library(build(program.header, program.source, "estimator"), layout)


@functools.lru_cache(maxsize=8)
def _loaded(path: str, layout: str) -> Library:
    return Library(Path(path), Layout(*json.loads(layout)))


def prepared(build_estimator: Callable, select: Callable, parameters, sizes: tuple[int, int]) -> Library:
    """The library of build_estimator(parameters): without tracing when the same functions of the same package, or in this process the same
    functions of any, were met before. Raises Unavailable where it has to be made and cannot be."""
    names = (_named(build_estimator), _named(select))
    if None in names:
        found = _nameless(build_estimator, select, _Example(parameters), sizes)
        if isinstance(found, Library):
            return found
        raise found
    about = json.dumps(
        [_package(), names, _shapes(parameters), described(parameters), sizes, toolchain.machine(), QUICK, BIG, FLAGS, VECTORS]
    )
    note = toolchain.folder() / f"known-{hashlib.sha256(about.encode()).hexdigest()[:32]}.json"
    try:
        known = json.loads(note.read_text())
        if Path(known["library"]).parent == note.parent and _sealed(Path(known["library"])):
            return _loaded(known["library"], json.dumps(known["layout"]))
    except (OSError, ValueError, KeyError):
        pass  # not met before, or damaged: made again
    program, layout = _made(build_estimator, select, parameters, sizes, "estimator")
    library = build(program.header, program.source, "estimator")
    part = note.with_suffix(f".{os.getpid()}")
    part.write_text(json.dumps({"library": str(library), "layout": layout}))
    os.replace(part, note)
    return Library(library, layout)


def run(library: Library, parameters, carry, u, y, valid, progress=None):
    """(last carry, stacked outputs) of an estimator over rows, as `run.run_built` returns them."""
    layout = library.layout
    packed = library.pack(layout.parameters, library.parameter_type, flattened(parameters))
    state = library.pack(layout.state, library.state_type, flattened(carry))
    u, y, valid = (np.ascontiguousarray(a) for a in (u, y, valid))
    out = library.run(state, packed, u, y, valid, progress)
    return rebuilt(layout.carry_like, library.leaves(state)), rebuilt(layout.out_like, out)
