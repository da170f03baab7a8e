"""How fast are Blackbox logs decoded: rotorwatch as machine code and as Python alone, and other decoders.

    python benchmarks/blackbox.py [LOG ...] [--others FOLDER] [--repeats 5]

LOG: Blackbox logs, by default those of the folder of test flights next to the repository. FOLDER: the site-packages in which other
decoders are installed:

    python -m venv /tmp/others
    /tmp/others/bin/pip install --no-deps betaflight-chirp-core==0.4.1
    /tmp/others/bin/pip download --no-deps orangebox==0.5.0 -d /tmp/others && python -m zipfile -e /tmp/others/orangebox*.whl \\
        /tmp/others/lib/python3.11/site-packages

(pip refuses to install orangebox.) Every decoder takes all frames of all sessions from memory or from an unpacked file; what is counted is
main frames a second, the best of some runs, all decoders in turn.
"""

from __future__ import annotations

import argparse
import bz2
import gzip
import itertools
import lzma
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rotorwatch import logs
from rotorwatch.base.compiling.running import Definition
from rotorwatch.errors import LogError
from rotorwatch.logs.blackbox import decoder, encodings, frame_sizes, frames, header

LOGS = Path(__file__).resolve().parents[1].parent / "shared" / "flights" / "blackbox"
OPEN = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}


def spans(data: bytes) -> list[tuple[int, int]]:
    starts = [*header.starts(data), len(data)]
    return list(itertools.pairwise(starts))


def ours(definition: Definition) -> Callable[[bytes, Path], int]:
    """Frames to arrays."""

    def count(data: bytes, path: Path) -> int:
        decoder.BLACKBOX, total = definition, 0
        for start, end in spans(data):
            try:
                total += len(decoder.decode(data, start, end).main)
            except LogError:
                continue
        return total

    return count


def whole(data: bytes, path: Path) -> int:
    """File to Flight: units, axes, checks."""
    decoder.BLACKBOX = NATIVE
    return sum(len(logs.read(name)["motors"]) for name in logs.sessions(path))


def orangebox(data: bytes, path: Path) -> int:
    from orangebox import Parser  # pyright: ignore[reportMissingImports]

    total = 0
    for number in range(1, len(spans(data)) + 1):
        total += sum(1 for _ in Parser.load(str(path), number).frames())
    return total


def chirp_core(data: bytes, path: Path) -> int:
    from betaflight_chirp_core import decoder as theirs  # pyright: ignore[reportMissingImports]

    total = 0
    for start, end in theirs.split_sessions(data):
        parser = theirs.FlightLogParser(data, start, end)
        parser.parse_header()
        parser.parse_data()
        total += len(parser.main_frames)
    return total


NATIVE = decoder.BLACKBOX
PLAIN = Definition("blackbox", (encodings, frames), frame_sizes, decoder.FILES)
PLAIN.__dict__["library"] = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--others", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    ways = {
        "rotorwatch, machine code": (ours(NATIVE), options.repeats),
        "rotorwatch, Python alone": (ours(PLAIN), 1),
        "rotorwatch, file to Flight": (whole, options.repeats),
    }
    if options.others:
        sys.path.append(str(options.others))
        ways |= {"betaflight-chirp-core 0.4.1": (chirp_core, 1), "orangebox 0.5.0": (orangebox, 1)}
    if NATIVE.library is None:
        del ways["rotorwatch, machine code"]
    paths = options.logs or sorted(LOGS.glob("*.[bBT]*.xz"))
    with tempfile.TemporaryDirectory() as folder:
        unpacked = []
        for path in paths:
            place = Path(folder) / path.name.removesuffix(path.suffix if path.suffix in OPEN else "")
            with OPEN.get(path.suffix, open)(path, "rb") as file:
                place.write_bytes(file.read())
            unpacked.append((place.read_bytes(), place))
        print(f"{len(paths)} logs, {sum(len(data) for data, _ in unpacked) / 1e6:.1f} MB unpacked\n")
        print("| decoder | main frames | s | frames a second |\n|---|---|---|---|")
        for name, (way, repeats) in ways.items():
            best, total = float("inf"), 0
            for _ in range(repeats):
                begun = time.perf_counter()
                total = sum(way(data, path) for data, path in unpacked)
                best = min(best, time.perf_counter() - begun)
            print(f"| {name} | {total:,} | {best:.3g} | {total / best:,.0f} |", flush=True)


if __name__ == "__main__":
    main()
