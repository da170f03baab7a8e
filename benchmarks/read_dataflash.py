"""How fast are DataFlash logs read? Rotorwatch and pymavlink on the same file.

    python benchmarks/read_dataflash.py LOG.bin[.xz] [--megabytes 120] [--pymavlink-megabytes 4]

The input is made from LOG: its flight part is repeated, with the time stamps moved on, until the file is large enough.
pymavlink reads the same message types, every field of them, from a shorter file of the same making, which rotorwatch
reads too: the ratio is that of the two times on this file.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import io
import lzma
import mmap
import multiprocessing
import re
import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rotorwatch.logs import dataflash
from rotorwatch.logs.dataflash_binary import BinaryLog

MESSAGES = "RCOU RATE IMU ANG ATT XKF1 NKF1 CTUN BAT MOTB ESC MSG VER ERR EV MODE ARM PARM".split()


def enlarged(data: bytes, size: int) -> bytes:
    """`data` with its part from the first RATE record on repeated until `size` bytes, time running on."""
    return b"".join(pieces(data, size))


def pieces(data: bytes, size: int) -> Iterator[bytes]:
    """The same, piece by piece."""
    log = BinaryLog(data)
    rate = log.table("RATE", [])
    if rate is None:
        raise SystemExit("The log has no RATE records to start from.")
    stamps = log.stamps()
    first = int(rate.record[0])
    start = int(log._at[first])
    part = data[start:]
    stamped = np.flatnonzero(np.isfinite(stamps) & (np.arange(stamps.size) >= first))
    at = log._at[stamped] - start + 3
    span = np.uint64(np.ptp(stamps[stamped]) + 2500)
    yield data
    total, copy = len(data), 0
    while total < size:
        copy += 1
        moved = bytearray(part)
        view = np.ndarray((len(part) - 7,), "V8", buffer=moved, strides=(1,))
        view[at] = (stamps[stamped].astype("<u8") + span * np.uint64(copy)).view("V8")
        yield bytes(moved)
        total += len(part)


def time_rotorwatch(path: Path, repeats: int = 3) -> tuple[float, float]:
    """(best seconds, peak memory as a share of the file) of reading `path` through a memory map, in a fresh process."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_time_rotorwatch, (path, repeats))


def _time_rotorwatch(path: Path, repeats: int) -> tuple[float, float]:
    seconds = []
    before = _peak_bytes()
    for _ in range(repeats):
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            start = time.perf_counter()
            flight = dataflash.read(data, path.name)
            seconds.append(time.perf_counter() - start)
        del flight
    return min(seconds), (_peak_bytes() - before) / path.stat().st_size


def _peak_bytes() -> int:
    """Largest resident memory of this process so far, mapped files included."""
    status = Path("/proc/self/status")
    if status.exists():  # unlike getrusage, this does not remember the parent process
        return 1024 * int(re.findall(r"VmHWM:\s*(\d+)", status.read_text())[0])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def time_pymavlink(path: Path) -> float:
    """Seconds to open `path` with pymavlink and read every field of the records of MESSAGES."""
    from pymavlink import DFReader

    start = time.perf_counter()
    with contextlib.redirect_stderr(io.StringIO()):  # it names every byte it skips
        log = DFReader.DFReader_binary(str(path), zero_time_base=False)
        while (record := log.recv_match(type=MESSAGES)) is not None:
            record.to_dict()
        log.close()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--megabytes", type=float, default=120.0)
    parser.add_argument("--pymavlink-megabytes", type=float, default=4.0)
    arguments = parser.parse_args()
    opener = {".xz": lzma.open, ".gz": gzip.open}.get(arguments.log.suffix, open)
    with opener(arguments.log, "rb") as file:
        data = file.read()
    with tempfile.TemporaryDirectory() as folder:
        large, small = Path(folder) / "large.bin", Path(folder) / "small.bin"
        small.write_bytes(enlarged(data, int(arguments.pymavlink_megabytes * 1e6)))
        large.write_bytes(enlarged(data, int(arguments.megabytes * 1e6)))
        del data
        seconds, memory = time_rotorwatch(large)
        rate = large.stat().st_size / 1e6 / seconds
        print(f"rotorwatch  {large.stat().st_size / 1e6:7.1f} MB in {seconds:6.2f} s: {rate:7.1f} MB/s")
        print(f"            peak memory grew by {memory:.2f} times the file, memory map included")
        size = small.stat().st_size / 1e6
        ours, theirs = time_rotorwatch(small)[0], time_pymavlink(small)
        print(f"rotorwatch  {size:7.1f} MB in {ours:6.2f} s: {size / ours:7.1f} MB/s")
        print(f"pymavlink   {size:7.1f} MB in {theirs:6.2f} s: {size / theirs:7.1f} MB/s")
        print(f"            {theirs / ours:.0f} times as long as rotorwatch")


if __name__ == "__main__":
    main()
