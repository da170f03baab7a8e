"""How fast are logs read, each kind beside the best public reader of it?

    python benchmarks/logs.py [--flights ../shared/flights] [--others FOLDER] [--rounds 5]

The same file for both, in turn, in one process; processor time, the fastest round of each, and the median of the rounds' ratios. pymavlink
decodes of a DataFlash log the messages that rotorwatch reads, the others all that is in the file; mcap gives the bytes of a message,
rosbags its fields. FOLDER: the site-packages in which orangebox is installed (benchmarks/blackbox.py says how).
"""

from __future__ import annotations

import argparse
import gzip
import lzma
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
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
    from rotorwatch_lab.simulation import scenario, simulate

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


def dataflash(path: Path) -> None:
    time_pymavlink(path)


def ulog(path: Path) -> None:
    import pyulog

    pyulog.ULog(str(path))


def tlog(path: Path) -> None:
    from pymavlink import mavutil

    log = mavutil.mavlink_connection(str(path))
    while log.recv_match() is not None:
        pass
    log.close()


def orangebox(path: Path) -> None:
    from orangebox import Parser  # pyright: ignore[reportMissingImports]

    for _ in Parser.load(str(path)).frames():
        pass


def mcap(path: Path) -> None:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        for _ in make_reader(file).iter_messages():
            pass


def rosbags(path: Path) -> None:
    from rosbags.highlevel import AnyReader

    with AnyReader([path.parent]) as bag:
        for link, _, data in bag.messages():
            bag.deserialize(data, link.msgtype)


def samples(flights: Path, folder: Path) -> list[tuple[str, Path, dict[str, Callable[[Path], None]]]]:
    """(kind, log, its other readers by name)."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from tests import ros2_bags

    binary, telemetry, box = folder / "small.bin", folder / "flight.tlog", folder / "flight.bbl"
    binary.write_bytes(enlarged(sample(flights), SMALL))
    px4 = px4_log(flights, folder)
    telemetry.write_bytes(largest(flights, "*.tlog*"))
    box.write_bytes(largest(flights / "blackbox", "*.[bBT]*"))
    (folder / "simulated").mkdir()
    flown = px4_log(folder / "simulated", folder / "simulated")  # those of the folder are older than the messages of bags
    (bag,) = ros2_bags.write(folder / "bag", ros2_bags.of_ulog(flown)).glob("*.mcap")
    return [
        ("DataFlash", binary, {"pymavlink": dataflash}),
        ("ULog", px4, {"pyulog": ulog}),
        (".tlog", telemetry, {"pymavlink": tlog}),
        ("Blackbox", box, {"orangebox": orangebox}),
        ("ROS 2 bag, MCAP", bag, {"mcap": mcap, "rosbags": rosbags}),
    ]


def largest(folder: Path, pattern: str) -> bytes:
    """The largest of these logs, unpacked."""
    return max((unpacked(path) for path in folder.rglob(pattern)), key=len)


def spent(read: Callable[[Path], object], path: Path) -> float:
    """Processor seconds."""
    start = time.process_time()
    read(path)
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=Path, default=Path(__file__).resolve().parents[1] / "../shared/flights")
    parser.add_argument("--others", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    if options.others:
        sys.path.append(str(options.others))
    print("| log | MB | rotorwatch MB/s | other reader | MB/s | times faster |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        for kind, path, others in samples(options.flights, Path(scratch)):
            size = path.stat().st_size / 1e6
            for name, read in others.items():
                try:
                    read(path)
                except ImportError:
                    continue
                rounds = [(spent(logs.read, path), spent(read, path)) for _ in range(options.rounds)]
                ours, theirs = (min(seconds) for seconds in zip(*rounds, strict=True))
                times = statistics.median(other / own for own, other in rounds)
                print(f"| {kind} | {size:.1f} | {size / ours:.0f} | {name} | {size / theirs:.2g} | {times:.2g} |", flush=True)


if __name__ == "__main__":
    main()
