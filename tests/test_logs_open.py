"""Opening logs: containers, recognition, clear errors, and what no reader may ever show."""

import bz2
import csv
import gzip
import hashlib
import lzma
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import logs
from rotorwatch.errors import LogError
from rotorwatch.logs import container, px4_topics

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights"
needs_flights = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the folder of test flights, ../shared/flights, is missing")

TABLE = b"time_s,motor_1,motor_2,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n" + b"".join(
    b"%.2f,0.5,0.5,0.1,0.2,0.3\n" % (k / 100) for k in range(500)
)


def truth_rows():
    if not FLIGHTS.is_dir():
        return []
    with (FLIGHTS / "truth.csv").open() as file:
        return [r for r in csv.DictReader(file) if r["log_start_us"]]


@pytest.mark.thorough(keep=20)
@needs_flights
@pytest.mark.parametrize("row", truth_rows(), ids=lambda r: Path(r["path"]).name)
def test_every_flight_reads_with_its_start_time_and_without_simulator_truth(row):
    flight = logs.read(FLIGHTS.parent.parent / row["path"])
    assert flight.start_us == int(row["log_start_us"])
    assert flight.rotor_count == int(row["n_rotors"])
    assert flight.has("motors", "accel")
    for name, signal in flight.signals.items():
        assert np.isfinite(signal.values).all(), name
        assert (np.diff(signal.time) >= 0).all(), name
        assert signal.time[0] >= 0, name
        assert "groundtruth" not in signal.source and "rfly" not in signal.source
    assert flight.duration <= (int(row["log_end_us"]) - flight.start_us) * 1e-6 + 0.05
    names = [*flight.parameters, *(n for _, n, _ in flight.parameter_changes)]
    assert not [n for n in names if n.startswith("SIM_")]
    assert not [m for m in flight.messages if "SIM_" in m.text]
    accel = flight["accel"].values[:, 2]
    assert -10.5 < np.median(accel) < -9.0


def test_no_truth_topic_is_on_the_list_of_topics_read():
    assert not [t for t in px4_topics.TOPICS if "groundtruth" in t or t.startswith(("rfly", "sim"))]


@pytest.mark.parametrize("pack", [lzma.compress, gzip.compress, bz2.compress, bytes])
def test_compressed_files_are_recognised_by_content(tmp_path, pack):
    path = tmp_path / "flight.dat"
    path.write_bytes(pack(TABLE))
    flight = logs.read(path)
    assert flight.format == "CSV" and len(flight["gyro"]) == 500 and flight.warnings == ()


@pytest.mark.parametrize("pack", [lzma.compress, gzip.compress])
def test_streams_in_a_row_are_read_as_one(tmp_path, pack):
    cut = TABLE.index(b"\n", 3000) + 1
    path = tmp_path / "flight.csv.z"
    path.write_bytes(pack(TABLE[:cut]) + pack(TABLE[cut:]))
    assert len(logs.read(path)["gyro"]) == 500


@pytest.mark.parametrize("pack", [lzma.compress, gzip.compress, bz2.compress])
def test_a_truncated_container_gives_what_is_there_or_a_sentence(tmp_path, pack):
    noise = np.random.default_rng(1).normal(size=(4000, 4))
    text = b"time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n"
    text += b"".join(b"%.2f,%.6f,%.6f,%.6f\n" % (k / 100, *row[1:]) for k, row in enumerate(noise))
    packed = pack(text)
    path = tmp_path / "flight.csv.packed"
    outcomes = set()
    for share in (0.02, 0.3, 0.6, 0.95):
        path.write_bytes(packed[: int(share * len(packed))])
        try:
            flight = logs.read(path)
        except LogError as error:
            assert str(error).count("\n") == 0
            outcomes.add("rejected")
        else:
            assert "ends early" in flight.warnings[0] and 0 < len(flight["gyro"]) < 4000
            outcomes.add("read")
    assert "read" in outcomes or pack is bz2.compress  # bzip2 gives only whole blocks of 900 kB


def test_a_damaged_container_is_said(tmp_path):
    packed = bytearray(gzip.compress(TABLE))
    packed[len(packed) // 2] ^= 0xFF
    path = tmp_path / "flight.csv.gz"
    path.write_bytes(packed)
    try:
        assert "damaged" in logs.read(path).warnings[0]
    except LogError as error:
        assert "decompressed" in str(error) or "number" in str(error)


def test_a_decompression_bomb_is_refused(tmp_path):
    path = tmp_path / "bomb.xz"
    path.write_bytes(lzma.compress(bytes(5 << 20)))
    with pytest.raises(LogError, match="decompresses to more than 1 MB"):
        container.open_log(path, limit=1 << 20)
    assert len(container.open_log(path, limit=5 << 20)[0]) == 5 << 20  # just as much is none


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("empty.bin", b"", "empty"),
        ("picture.ulg", b"\x89PNG\r\n\x1a\n" + bytes(100), "not a flight log of a known kind"),
        ("zeros.bin", bytes(10_000), "not a flight log of a known kind"),
        ("old.zst", b"\x28\xb5\x2f\xfd" + bytes(50), "unzstd"),
        ("logs.zip", b"PK\x03\x04" + bytes(50), "unzip"),
        ("bad.csv", b"hello, world\n1,2\n", "time_s"),
        ("bad.tlog", bytes(5000), "tlog"),
    ],
)
def test_what_is_no_log_is_refused_in_one_sentence(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(LogError) as caught:
        logs.read(path)
    assert words in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


def test_missing_files_and_foreign_folders_are_refused(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        logs.read(tmp_path / "nowhere.ulg")
    with pytest.raises(LogError, match="without ulog2csv tables"):
        logs.read(tmp_path)


def test_unknown_content_names_the_known_formats(tmp_path):
    path = tmp_path / "thing"
    path.write_bytes(b"\x01\x02\x03" * 100)
    with pytest.raises(LogError) as caught:
        logs.read(path)
    assert all(m.FORMAT in str(caught.value) for m in logs.formats()) and len(logs.formats()) >= 5


def test_a_reader_that_breaks_becomes_a_sentence(tmp_path, monkeypatch):
    from rotorwatch.logs import table

    def broken(data, name, progress):
        raise ZeroDivisionError

    monkeypatch.setattr(table, "read", broken)
    path = tmp_path / "flight.csv"
    path.write_bytes(TABLE)
    with pytest.raises(LogError, match="too damaged to be read"):
        logs.read(path)


@pytest.mark.parametrize(
    "name, library, head",
    [("a.ulg", "pyulog", b"ULog\x01\x12\x35"), ("a.parquet", "pyarrow", b"PAR1"), ("a.mcap", "mcap", b"\x89MCAP0\r\n")],
)
def test_a_library_that_is_not_installed_is_no_damage(tmp_path, monkeypatch, name, library, head):
    for loaded in [module for module in sys.modules if module.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / name).write_bytes(head + bytes(200))
    with pytest.raises(LogError, match=f"needs {library}, which is not installed: pip install {library}") as caught:
        logs.read(tmp_path / name)
    assert "damaged" not in str(caught.value) and str(caught.value).startswith(str(tmp_path))


def test_reading_a_table_loads_no_heavy_library(tmp_path):
    path = tmp_path / "flight.csv"
    path.write_bytes(TABLE)
    code = (
        "import sys; from rotorwatch import logs; logs.read(sys.argv[1]);"
        "print([m for m in ('pymavlink', 'pyulog', 'pandas', 'pyarrow', 'jax') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_progress_rises_to_the_end(tmp_path):
    path = tmp_path / "flight.csv.xz"
    path.write_bytes(lzma.compress(TABLE))
    seen = []
    logs.read(path, progress=seen.append)
    assert seen == sorted(seen) and all(0 <= s <= 1 for s in seen)


def test_the_fingerprint_of_a_folder_is_that_of_its_files(tmp_path):
    """Stores and JSON lines hold these hashes: they must stay as they are."""
    for name, data in (("b.csv", b"22"), ("a.csv", b"1")):
        (tmp_path / name).write_bytes(data)
    (tmp_path / "plots").mkdir()
    assert logs.fingerprint(tmp_path) == (3, hashlib.sha256(b"a.csv\n1\n1" + b"b.csv\n2\n22").hexdigest())
    assert logs.fingerprint(tmp_path / "b.csv") == (2, hashlib.sha256(b"22").hexdigest())
    assert logs.fingerprint(f"{tmp_path / 'b.csv'}#3") == (2, hashlib.sha256(b"#322").hexdigest())


@pytest.mark.parametrize(
    ("name", "file", "number"),
    [("LOG.BFL#2", "LOG.BFL", 2), ("LOG.BFL#123456", "LOG.BFL", 123456), ("LOG.BFL#1234567", "LOG.BFL#1234567", None)],
)
def test_a_flight_in_a_file_has_a_number_of_six_figures_at_most(tmp_path, name, file, number):
    """Longer ones, as hashes and dates in names are, belong to the name."""
    assert logs.of_part(tmp_path / name) == (tmp_path / file, number)


def test_a_format_of_another_package_is_asked_only_for_what_it_has_and_believed_only_when_it_says_yes(monkeypatch):
    folders = SimpleNamespace(FORMAT="folders", sniff_folder=lambda path: True)
    files = SimpleNamespace(FORMAT="files", sniff=lambda head, name: head.startswith(b"mine"))
    monkeypatch.setattr(logs, "offered", lambda: {f.FORMAT: (None, f) for f in (folders, files)})
    assert logs.recognise(b"theirs", "x.dat") is None
    assert logs.recognise(b"mine", "x.dat") is files
