"""How fast are logs read? .bin against pymavlink and .ulg against pyulog, the same file for both."""

from __future__ import annotations

import gzip
import lzma
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from read_dataflash import enlarged, time_pymavlink, time_rotorwatch

from rotorwatch import logs
from rotorwatch.commands.cli import SAMPLES

QUAD = "quadx_healthy_hover.bin.xz"
SMALL, LARGE = 4_000_000, 60_000_000  # bytes: for pymavlink, and for us alone
PX4_SECONDS = 120.0


def unpacked(path: Path) -> bytes:
    """A log's bytes."""
    opener = {".xz": lzma.open, ".gz": gzip.open}.get(path.suffix, open)
    with opener(path, "rb") as file:
        return file.read()


def sample(flights: Path) -> bytes:
    """A default-rate DataFlash log: of the folder of test flights, else the one in the package."""
    path = flights / "ardupilot-sitl" / QUAD
    return unpacked(path if path.exists() else SAMPLES / QUAD)


def px4_log(flights: Path, folder: Path) -> Path:
    """The largest .ulg among the test flights, else a simulated one."""
    found = sorted(flights.glob("px4-*/*.ulg*"), key=lambda path: path.stat().st_size)
    goal = folder / "flight.ulg"
    if found:
        goal.write_bytes(unpacked(found[-1]))
        return goal
    from rotorwatch.lab.simulation import scenario, simulate

    plan = scenario.read(Path(__file__).resolve().parents[1] / "docs" / "scenarios" / "quad-chipped-propeller.toml")
    simulate(replace(plan, duration_s=PX4_SECONDS)).write(goal)
    return goal


def reading(flights: Path) -> dict:
    """Megabytes a second; pymavlink decodes the messages that rotorwatch reads, pyulog all that is in the file."""
    import pyulog

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        data, small, large = sample(flights), folder / "small.bin", folder / "large.bin"
        small.write_bytes(enlarged(data, SMALL))
        large.write_bytes(enlarged(data, LARGE))
        size = small.stat().st_size / 1e6
        ours, theirs = time_rotorwatch(small)[0], time_pymavlink(small)
        seconds, memory = time_rotorwatch(large)
        ulog = px4_log(flights, folder)
        both: dict[str, list[float]] = {"rotorwatch": [], "pyulog": []}
        for _ in range(3):
            for name, read in (("rotorwatch", logs.read), ("pyulog", lambda path: pyulog.ULog(str(path)))):
                start = time.perf_counter()
                read(ulog)
                both[name].append(time.perf_counter() - start)
        megabytes = ulog.stat().st_size / 1e6
        rates = {name: megabytes / statistics.median(times) for name, times in both.items()}
        return {
            "bin_mb": size, "bin_rotorwatch_mb_per_s": size / ours, "bin_pymavlink_mb_per_s": size / theirs,
            "bin_times_faster": theirs / ours, "large_bin_rotorwatch_mb_per_s": large.stat().st_size / 1e6 / seconds,
            "large_bin_peak_memory_per_byte": memory, "ulg_mb": megabytes,
            "ulg_rotorwatch_mb_per_s": rates["rotorwatch"], "ulg_pyulog_mb_per_s": rates["pyulog"],
            "ulg_times_faster": rates["rotorwatch"] / rates["pyulog"],
        }  # fmt: skip
