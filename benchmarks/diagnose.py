"""How long does a verdict take, from the start of the command on, how much memory, and where does the time go?

    python benchmarks/diagnose.py [--flights ../shared/flights/ardupilot-sitl] [--minutes 10] [--repeats 2] [--frames]

Long logs are made from short ones: the flight part is repeated with its time stamps moved on. Every log is diagnosed by
a process of its own, `rotorwatch diagnose LOG --json`, `repeats` times after one that fills the compilation cache; the
fastest counts. CPU is what that process used, which other work on the machine hardly changes. Memory is its largest
resident size, memory-mapped log included; most of it is JAX and the compiled estimator, whatever the log, so the last
column is what a log takes beyond the shortest one, as a multiple of its size.
"""

from __future__ import annotations

import argparse
import gzip
import json
import lzma
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from read_dataflash import enlarged

FLIGHTS = Path(__file__).resolve().parents[1] / "../shared/flights/ardupilot-sitl"
# (log, whether to make it long, what it is)
LOGS = (
    ("quadx_healthy_hover.bin.xz", False, "quad, default rate, as flown"),
    ("quadx_healthy_hover.bin.xz", True, "quad, default rate, long"),
    ("fullrate_excerpt_quadx_m1_mul0.90_hover.bin.xz", True, "quad, 400 Hz, long"),
    ("hexax_m3_mul0.80_square_wind.bin.xz", False, "hexa, 50 Hz, as flown"),
    ("octa_m7_mul0.70_square_wind.bin.xz", False, "octa, 50 Hz, as flown"),
    ("octa_m7_mul0.70_square_wind.bin.xz", True, "octa, 50 Hz, long"),
)


def unpacked(path: Path) -> bytes:
    opener = {".xz": lzma.open, ".gz": gzip.open}.get(path.suffix, open)
    with opener(path, "rb") as file:
        return file.read()


def lengthened(data: bytes, seconds: float) -> bytes:
    """`data` with its flight part repeated until it covers `seconds`."""
    from rotorwatch.logs.dataflash_binary import BinaryLog

    once = enlarged(data, len(data) + 1)
    part = len(once) - len(data)
    table = BinaryLog(once).table("RATE", ["TimeUS"])
    if table is None:
        raise SystemExit("The log has no RATE records; choose another.")
    stamps = table["TimeUS"]
    span = (stamps[-1] - stamps[0]) / 2e6
    return enlarged(data, len(data) + part * (int(seconds / span) - 1) + 1)


def diagnose(path: Path) -> tuple[float, float, float, dict]:
    """(wall seconds, CPU seconds, peak resident megabytes, the answer) of one `rotorwatch diagnose --json`."""
    command = [sys.executable, "-m", "rotorwatch.commands.cli", "diagnose", str(path), "--json", "--quiet"]
    peak, before, start = 0, _cpu_seconds(), time.perf_counter()
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(command, stdout=out)
        status = Path(f"/proc/{process.pid}/status")
        while process.poll() is None:
            # Unlike getrusage, this does not remember the parent process.
            found = re.search(r"VmHWM:\s*(\d+)", status.read_text()) if status.exists() else None
            peak = max(peak, int(found[1]) if found else 0)
            time.sleep(0.01)
        wall = time.perf_counter() - start
        if process.returncode not in (0, 1, 3):
            raise SystemExit(f"{path.name}: exit code {process.returncode}")
        out.seek(0)
        return wall, _cpu_seconds() - before, peak * 1024 / 1e6, json.loads(out.read())


def import_seconds(module: str) -> float:
    """Seconds that a fresh interpreter takes to import `module`, less those of an idle one."""

    def clock(code):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        return time.perf_counter() - start

    return min(clock(f"import {module}") for _ in range(3)) - min(clock("pass") for _ in range(3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=Path, default=FLIGHTS)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--frames", action="store_true", help="hexa and octa too")
    arguments = parser.parse_args()
    print("| log | minutes | MB | wall s | CPU s | of it estimating s | peak MB | beyond the first |")
    print("|---|---|---|---|---|---|---|---|")
    base = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for name, long, what in LOGS[: None if arguments.frames else 3]:
            data = unpacked(arguments.flights / name)
            path = Path(folder) / "flight.bin"
            path.write_bytes(lengthened(data, 60 * arguments.minutes) if long else data)
            del data
            diagnose(path)
            runs = [diagnose(path) for _ in range(arguments.repeats)]
            wall, cpu, peak = min(r[0] for r in runs), min(r[1] for r in runs), min(r[2] for r in runs)
            base = base or peak
            size, minutes = path.stat().st_size / 1e6, runs[0][3]["flight"]["duration_s"] / 60
            estimating = min(run[3]["timing"]["estimate_s"] for run in runs)
            beyond = f"{(peak - base) / size:.1f} x" if long else ""
            print(
                f"| {what} | {minutes:.1f} | {size:.1f} | {wall:.1f} | {cpu:.1f} | {estimating:.1f} | {peak:.0f} | {beyond} |", flush=True
            )
    print("\nImports: " + ", ".join(f"{m} {import_seconds(m):.2f} s" for m in ("numpy", "rotorwatch.commands.cli", "jax")) + ".")


def _cpu_seconds() -> float:
    """What finished child processes have used so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
