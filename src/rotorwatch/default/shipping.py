"""The default estimator built for whoever installs rotorwatch: `python -m rotorwatch.default.shipping FOLDER`.

The build of the package calls it (hatch_build.py). One program for each number of rotors, coaxial or not, whatever the length of ticks.
Tracing one takes a second and compiling it ten: for this computer alone only the FIRST are compiled, and the C of the others goes along,
to be compiled when such a vehicle is first met (compiling/native.py). What was made of the same definition by the same compiler is taken
from the cache. What asks the cache (`kept`) needs nothing but Python.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from rotorwatch.base import backend
from rotorwatch.compiling import shipped, toolchain
from rotorwatch.errors import RotorwatchError


class Frame(NamedTuple):
    """Vehicles with one program."""

    rotors: int
    coaxial: bool = False

    @property
    def name(self) -> str:
        """Of its files."""
        return f"rotors-{self.rotors}{'-coaxial' if self.coaxial else ''}"

    @property
    def words(self) -> str:
        """In a sentence."""
        return f"vehicles with {self.rotors} rotors{' on coaxial arms' if self.coaxial else ''}"


# What takes longest to build comes first.
FRAMES = (
    Frame(12, True), Frame(12), Frame(10), Frame(8, True), Frame(8), Frame(7), Frame(6, True), Frame(6), Frame(5), Frame(4, True),
    Frame(4), Frame(3),
)  # fmt: skip
# Most vehicles, and those of the demo: compiled when the package is built, wherever that is.
FIRST = (Frame(6), Frame(4))
# Rooms with definitions that are shipped, too.
DEFINED = ("front", "logs/blackbox")
# What the programs are traced from: modules with all that they import, and such of which only the file counts.
ROOTS = ("rotorwatch.default.estimator", "rotorwatch.compiling.c99.project")
ALONE = (
    "rotorwatch.default.program",
    "rotorwatch.compiling.native",
    "rotorwatch.compiling.shipped",
    "rotorwatch.compiling.toolchain",
)


def definition() -> dict:
    """{"files", "digest"}: what the programs are made of, and its hash."""
    files = [*shipped.files_of(ROOTS, ALONE), *shipped.templates()]
    return {"files": files, "digest": shipped.digest(files)}


def example(frame: Frame) -> tuple[dict, tuple[int, int]]:
    """(parameters, sizes of u and y) of such a vehicle: only their shapes matter."""
    import numpy as np

    from rotorwatch.default.plant import any_multirotor

    n = frame.rotors
    mean, P = any_multirotor(n)
    coaxial = {"lower": np.zeros(n), "share": np.zeros(2)} if frame.coaxial else {}
    arrays = {
        "B": np.ones((4, n)),
        "dt": np.array(1.0),
        "curve": np.zeros(2),
        "air": np.zeros(2),
        **coaxial,
        "x0": mean,
        "P0": P,
    }
    return {**arrays, "noise": np.ones((4, 4)), "noise_weight": np.array(1.0)}, (n + 15, 4)


def levels(portable: bool) -> tuple[str, ...]:
    """Levels of processors to build for: all that this kind of computer has, or the best that this one runs."""
    if toolchain.processor() != platform.machine():  # for another computer: all levels that its kind has
        return tuple(shipped.LEVELS) if toolchain.processor() == "x86_64" else (shipped.BASELINE,)
    runs = shipped.levels()
    return tuple(shipped.LEVELS) if portable and runs[0] != shipped.BASELINE else runs[:1]


def made(frame: Frame, marches: Sequence[str], folder: Path) -> tuple[str, dict]:
    """(key, entry of the index) of one program, written into the folder: its libraries, or where there are no marches its C. Raises
    toolchain.Unavailable."""
    from rotorwatch.compiling import native
    from rotorwatch.default import program

    parameters, sizes = example(frame)
    c, layout = native.exported(program.estimator, program.tick_output, parameters, sizes)
    libraries, source = {}, None
    for march in marches:
        name = f"{frame.name}{march and '-' + march}.so"
        shutil.copyfile(native.build(c.header, c.source, "estimator", march), folder / name)
        libraries[march] = name, shipped.digest_of(folder / name)
    if not marches:
        name = f"{frame.name}.c.xz"
        shipped.write_source(folder / name, c.header, c.source)
        source = name, shipped.digest_of(folder / name)
    known = native.known_by(program.estimator, program.tick_output, parameters, sizes)
    assert known is not None
    return known, {"words": frame.words, "libraries": libraries, "source": source, "layout": layout}


def ship(folder: Path, frames: Sequence[Frame] = FRAMES, portable: bool = False) -> None:
    """Make the programs of `frames` in a folder, as `shipped.find` and `shipped.source` read it. portable: compiled for every processor of
    this kind; else for this computer alone, the FIRST only. Raises toolchain.Unavailable without a compiler."""
    compiler, marches, about = toolchain.compiler(), levels(portable), definition()
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    compiled = [frame for frame in frames if portable or frame in FIRST]
    order = [*compiled, *(frame for frame in frames if frame not in compiled)]  # what takes longest comes first
    wanted = [marches if frame in compiled else () for frame in order]
    workers = min(len(frames), len(compiled) + 1, os.cpu_count() or 1)
    if workers == 1:
        programs = dict(map(made, order, wanted, [folder] * len(order)))
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            programs = dict(pool.map(made, order, wanted, [folder] * len(order)))
    jax = backend.jax()
    index = {
        "definition": about,
        "target": shipped.target(toolchain.processor()),
        "made_with": f"JAX {jax.__version__}, {Path(compiler).resolve().name}",
        "programs": programs,
    }
    from rotorwatch.front.definition import FRONT
    from rotorwatch.logs.blackbox.decoder import BLACKBOX

    FRONT.ship(folder)
    BLACKBOX.ship(folder)
    (folder / shipped.INDEX).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")


def kept(portable: bool) -> Path:
    """Where the cache keeps what `ship` makes of this definition with this compiler on this computer. Raises toolchain.Unavailable."""
    return toolchain.cached_path(
        "shipped",
        json.dumps(
            [definition()["digest"], *(shipped.digest(shipped.files_in(r)) for r in DEFINED), portable, FIRST, FRAMES]
        ),
    )


def main(arguments: Sequence[str]) -> int:
    """FOLDER [--portable]: build, or take from the cache. 3, with one sentence, where this computer cannot."""
    folder, portable = Path(arguments[0]), "--portable" in arguments[1:]
    try:
        cache = kept(portable)
        if not shipped.whole(cache):
            part = cache.with_suffix(f".{os.getpid()}")
            ship(part, portable=portable)
            shutil.rmtree(cache, ignore_errors=True)
            os.replace(part, cache)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(cache, folder)
    except (RotorwatchError, ModuleNotFoundError) as why:
        print(why)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
