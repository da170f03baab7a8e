"""Build machine code for distribution: `python -m rotorwatch.engine.bindings.shipping FOLDER`.

The build of the package calls it (hatch_build.py). Compiled from definitions (docs/one-definition.md): the front end, the estimator, the
decoder of Blackbox logs, the ULog parser and the search for damaged values, one library each.
"""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from rotorwatch.base.compiling import shipped, toolchain
from rotorwatch.engine.definition import ENGINE
from rotorwatch.errors import RotorwatchError
from rotorwatch.logs.blackbox.decoder import BLACKBOX
from rotorwatch.logs.plausible import LONE
from rotorwatch.logs.ulog_data import ULOG

DEFINITIONS = (ENGINE, BLACKBOX, LONE, ULOG)


def levels(portable: bool) -> tuple[str, ...]:
    """Processor levels to build for: all of this kind of computer, or the best that this one runs."""
    if toolchain.processor() != platform.machine():  # for another computer: all levels of its kind
        return tuple(shipped.LEVELS) if toolchain.processor() == "x86_64" else (shipped.BASELINE,)
    runs = shipped.levels()
    return tuple(shipped.LEVELS) if portable and runs[0] != shipped.BASELINE else runs[:1]


def ship(folder: Path, portable: bool = False) -> None:
    """Build the libraries in a folder, as `compiling.running` reads them. portable: for every processor of this kind; else for this
    computer. Raises toolchain.Unavailable without a compiler."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for definition in DEFINITIONS:
        definition.ship(folder, levels(portable))


def main(arguments: Sequence[str]) -> int:
    """FOLDER [--portable]: build. Returns 3, with one sentence, where this computer cannot."""
    try:
        ship(Path(arguments[0]), "--portable" in arguments[1:])
    except RotorwatchError as why:
        print(why)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
