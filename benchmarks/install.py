"""What an installation takes: `python benchmarks/install.py SOURCE...` (folders or wheels).

For each source an empty environment is made, the source is installed with pip, and a sample is diagnosed twice: in a cache folder that
is empty when it begins, with no compiler in reach, and again. Printed: seconds of the installation, megabytes on the disk in all (without
pip and setuptools, which the empty environment has) and of the largest packages, and seconds of the two verdicts.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

LARGEST = 12


def megabytes(folder: Path) -> float:
    """Size of a folder's files, or of a file."""
    files = folder.rglob("*") if folder.is_dir() else [folder]
    return sum(f.stat().st_blocks * 512 for f in files if f.is_file() and not f.is_symlink()) / 1e6


def timed(command: list[str], **more) -> float:
    """Seconds that a command takes; a verdict's exit code is none of its business."""
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False, **more)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(command)} failed: {done.stderr[-500:]}")
    return time.perf_counter() - began


def installed(source: str) -> None:
    """Measure and print one source."""
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch) / "env"
        venv.create(place, with_pip=True)
        packages = next(place.glob("lib/python*/site-packages"))
        before = {p.name for p in packages.iterdir()}
        env = {**os.environ, "ROTORWATCH_CACHE": str(Path(scratch) / "cache")}
        seconds = timed([str(place / "bin" / "pip"), "install", "-q", source], env=env)
        sizes = {p.name: megabytes(p) for p in packages.iterdir() if p.name not in before}
        env = {**env, "ROTORWATCH_CACHE": str(Path(scratch) / "empty"), "CC": "none"}
        sample = next(packages.glob("rotorwatch/samples/hexa*.xz"))
        verdicts = [timed([str(place / "bin" / "rotorwatch"), "diagnose", str(sample)], env=env) for _ in range(2)]
        print(
            f"{source}: installed in {seconds:.0f} s, {sum(sizes.values()):.0f} MB; verdicts in {verdicts[0]:.1f} and {verdicts[1]:.1f} s"
        )
        for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:LARGEST]:
            print(f"  {size:6.1f} MB  {name}")


if __name__ == "__main__":
    for source in sys.argv[1:]:
        installed(source)
