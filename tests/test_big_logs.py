"""What a long log costs, by its laws: memory grows with the log by little more than the log."""

import lzma
import tracemalloc
from pathlib import Path

import pytest

import rotorwatch as rw
from script_files import loaded

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
LOG = FLIGHTS / "ardupilot-sitl" / "fullrate_excerpt_quadx_m1_mul0.90_hover.bin.xz"
BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "read_dataflash.py"


def peak(path: Path) -> int:
    """Bytes that were held at once while a log was diagnosed."""
    tracemalloc.start()
    try:
        rw.diagnose(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_grows_by_little_more_than_the_log(tmp_path):
    """Of a log at 400 Hz, whose samples are its bulk; what is mapped of the file comes and goes."""
    if not LOG.exists():
        pytest.skip("the flight logs for tests are not here")
    made = loaded(BENCHMARK)
    data, path = lzma.decompress(LOG.read_bytes()), tmp_path / "long.bin"
    sizes, peaks = [], []
    for size in (5_000_000, 20_000_000):
        path.write_bytes(made.enlarged(data, size))
        sizes.append(path.stat().st_size)
        peaks.append(peak(path))
    assert peaks[1] - peaks[0] < 1.4 * (sizes[1] - sizes[0])
