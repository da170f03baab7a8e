"""How long does a large log take, and how much memory?

    python benchmarks/big.py LOG.bin[.xz] FOLDER [--megabytes 1500 ...]

A DataFlash log of each size is made in FOLDER: the flight part of LOG is repeated, with its time stamps moved on; 0 is LOG as it is.
`rotorwatch info` and `rotorwatch diagnose` then each take it in a process of their own. Memory is the largest resident size, as a multiple
of the log; what is mapped of the file counts. The last column is without what a process takes that has only loaded the program. Logs are
deleted at the end.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from logs import unpacked
from read_dataflash import pieces


def measured(command: list[str]) -> tuple[float, float, float]:
    """(seconds by the clock, of the processor, peak resident megabytes) of a command that must succeed."""
    began, peak = time.perf_counter(), 0
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        status = Path(f"/proc/{process.pid}/status")
        while True:
            # Unlike getrusage, this does not remember the parent process.
            found = re.search(r"VmHWM:\s*(\d+)", status.read_text())
            peak = max(peak, int(found[1]) if found else 0)
            done, code, used = os.wait4(process.pid, os.WNOHANG)
            if done:
                process.returncode = os.waitstatus_to_exitcode(code)
                break
            time.sleep(0.02)
        out.seek(0)
        if process.returncode not in (0, 1, 3):
            raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}: {out.read().decode()}")
    return time.perf_counter() - began, used.ru_utime + used.ru_stime, peak * 1024 / 1e6


LOADED = """
from rotorwatch import diagnose, logs
from rotorwatch.commands import cli
from rotorwatch.engine.definition import ENGINE
from rotorwatch.report import info, terminal
logs.formats(), ENGINE.library
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--megabytes", type=float, nargs="+", default=[1500.0])
    arguments = parser.parse_args()
    *_, bare = measured([sys.executable, "-c", LOADED])
    print(f"Loaded alone: {bare:.0f} MB\n\n| MB | command | s | processor s | peak MB | of the log | without loading |")
    print("|---|---|---|---|---|---|---|")
    for megabytes in arguments.megabytes:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as scratch:
            path = Path(scratch) / "big.bin"
            with path.open("wb") as file:
                file.writelines(pieces(unpacked(arguments.log), int(megabytes * 1e6)))
            size = path.stat().st_size / 1e6
            for command in ("info", "diagnose"):
                wall, spent, peak = measured([sys.executable, "-m", "rotorwatch", command, str(path)])
                figures = f"{wall:.1f} | {spent:.1f} | {peak:.0f} | {peak / size:.2f} | {(peak - bare) / size:.2f}"
                print(f"| {size:.1f} | `{command}` | {figures} |", flush=True)


if __name__ == "__main__":
    main()
