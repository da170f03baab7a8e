"""Tables in our own columns (CSV, Parquet) and arrays or data frames in memory."""

import csv
import io
import re
import subprocess
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import logs
from rotorwatch.errors import LogError
from rotorwatch.logs import container, log_memory, parquet_pages
from rotorwatch.logs import table as logs_table
from rotorwatch.logs.log_memory import from_arrays

DOCS = Path(__file__).parents[1] / "docs" / "readers.md"


def columns(n=100, rotors=4, **extra):
    time = np.arange(n) / 100
    out = {"time_s": time, **{f"motor_{k}": 0.1 * k + 0 * time for k in range(1, rotors + 1)}}
    out |= {f"gyro_{a}_rad_s": 0.01 * np.arange(n) for a in "xyz"}
    return out | extra


def write(path, table):
    rows = zip(*table.values())
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(table)
        out.writerows([["" if isinstance(v, float) and np.isnan(v) else v for v in map(float, row)] for row in rows])
    return path


def test_csv_and_memory_give_the_same_flight(tmp_path):
    table = columns(accel_z_m_s2=np.full(100, -9.8), accel_x_m_s2=np.zeros(100), accel_y_m_s2=np.zeros(100))
    from_file, from_memory = logs.read(write(tmp_path / "flight.csv", table)), from_arrays(table)
    assert from_file.format == "CSV" and from_memory.format == "arrays"
    assert set(from_file.signals) == set(from_memory.signals) == {"motors", "gyro", "accel"}
    for name, signal in from_memory.signals.items():
        assert np.allclose(signal.values, from_file[name].values) and np.allclose(signal.time, from_file[name].time)
    assert from_memory["motors"].unit == "1" and from_memory.rotor_count == 4


def test_parquet_and_data_frames(tmp_path):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(columns())
    assert from_arrays(frame).has("motors", "gyro")
    path = tmp_path / "flight.parquet"
    pytest.importorskip("pyarrow")
    frame.to_parquet(path)
    flight = logs.read(path)
    assert flight.format == "Parquet" and np.array_equal(flight["gyro"].values, from_arrays(frame)["gyro"].values)
    frame.rename(columns={"motor_1": "engine"}).to_parquet(path)
    with pytest.raises(LogError, match="engine"):
        logs.read(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(LogError, match="damaged"):
        logs.read(path)


def test_empty_cells_take_no_more_memory_than_others():
    tracemalloc.start()
    try:
        notes: list[str] = []
        for more, dropped in ((b"", 0), (b"1\n", 1)):  # all lines whole, or one not, which is read another way
            table = log_memory.numbers(b"time_s,a,b,c\n" + b"0,,,\n" * 50_000 + more, notes)
            assert np.isnan(table["b"]).all() and table["c"].size == 50_000 and len(notes) == dropped
        assert tracemalloc.get_traced_memory()[1] < 50 * 4 * 50_000
    finally:
        tracemalloc.stop()


def parquet(pages, **options):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    out = io.BytesIO()
    parquet.write_table(pyarrow.table(pages), out, **options)
    return out.getvalue()


@pytest.mark.parametrize("compression", ["none", "snappy", "zstd", "gzip"])
@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_pages_of_parquet_are_counted_whoever_wrote_them(compression, version):
    from pyarrow.parquet import ParquetFile

    rng = np.random.default_rng(1)
    table = columns(5000, armed=rng.integers(0, 2, 5000), rpm_1=np.where(rng.random(5000) < 0.5, np.nan, 1.0))
    data = parquet(table, compression=compression, data_page_version=version, data_page_size=4096, row_group_size=2000)
    pages, cells = parquet_pages.unfolded(data, ParquetFile(io.BytesIO(data)).metadata, 1 << 30), 8 * 5000 * len(table)
    assert cells <= pages < 1.5 * cells
    assert np.array_equal(logs_table.read(data, "x.parquet")["gyro"].values, from_arrays(table)["gyro"].values)


def test_what_parquet_unfolds_to_is_limited(monkeypatch):
    """By the number of values, by the kind of a column, and by what pages say of themselves."""
    from pyarrow.parquet import ParquetFile

    monkeypatch.setattr(container, "SLACK", 1 << 20)
    table = columns(3)
    bombs = [
        dict.fromkeys(table, np.zeros(100_000)),
        table | {"motor_4": [np.zeros(200_000)] * 3},
        table | {"motor_4": ["0" * 2_000_000] * 3},
    ]
    for bomb in bombs:
        with pytest.raises(LogError, match="decompresses to more than 1 MB"):
            logs_table.read(parquet(bomb, compression="zstd"), "x.parquet")
    with pytest.raises(LogError, match="non-numeric"):
        logs_table.read(parquet(table | {"motor_4": ["0"] * 3}), "x.parquet")
    data = parquet({"time_s": np.zeros(500_000)}, compression="zstd", use_dictionary=False)
    real = ParquetFile(io.BytesIO(data)).metadata.row_group(0).column(0)
    reported = {name: getattr(real, name) for name in ("data_page_offset", "has_dictionary_page", "total_compressed_size")}
    column = SimpleNamespace(num_values=3, **reported)
    lying = SimpleNamespace(num_row_groups=1, num_columns=1, row_group=lambda _: SimpleNamespace(column=lambda _: column))
    assert parquet_pages.unfolded(data, lying, 1 << 30) > 4_000_000
    rng = np.random.default_rng(2)
    for _ in range(300):
        damaged = bytearray(data)
        damaged[4 + int(rng.integers(40))] = int(rng.integers(256))
        try:
            parquet_pages.unfolded(damaged, lying, 1 << 20)
        except parquet_pages.Damaged:
            pass


def test_parquet_without_pyarrow_says_what_to_install(tmp_path):
    path = tmp_path / "flight.parquet"
    path.write_bytes(b"PAR1" + bytes(100))
    code = (
        "import sys; sys.modules['pyarrow'] = None\nfrom rotorwatch import logs\n"
        "try: logs.read(sys.argv[1])\nexcept logs.LogError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert "pip install pyarrow" in done.stdout


def test_every_documented_column_is_known_and_every_known_one_documented():
    text = DOCS.read_text()
    section = text[text.index("## Columns") : text.index("## ", text.index("## Columns") + 5)]
    documented = set()
    for name in re.findall(r"`([A-Za-z0-9_]+)`", section):
        documented.add(name)
        assert log_memory.known_column(name), name
    missing = [n for n in log_memory._KNOWN if n not in documented]
    assert not missing


def test_degrees_and_g_are_converted():
    n = 50
    flight = from_arrays(
        {
            "time_s": np.arange(n) / 50,
            **{f"gyro_{a}_deg_s": np.full(n, 180.0) for a in "xyz"},
            **{f"accel_{a}_g": np.full(n, -1.0) for a in "xyz"},
            **{f"{a}_deg": np.full(n, 90.0 if a == "yaw" else 0.0) for a in ("roll", "pitch", "yaw")},
        }
    )
    assert np.allclose(flight["gyro"].values, np.pi) and np.allclose(flight["accel"].values, -9.80665)
    assert np.allclose(flight["attitude"].values, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def test_pulses_are_recognised_by_name_or_size():
    big = columns()
    for k in range(1, 5):
        big[f"motor_{k}"] = np.full(100, 1500.0)
    flight = from_arrays(big)
    assert flight["motors"].unit == "us" and "because of their size" in flight.warnings[0]
    named = {k.replace("motor_", "motor_") + ("_us" if k.startswith("motor") else ""): v for k, v in big.items()}
    flight = from_arrays(named)
    assert flight["motors"].unit == "us" and flight.warnings == ()


def test_gaps_are_masked_and_slow_signals_keep_their_rate():
    table = columns(n=1000, voltage_V=np.where(np.arange(1000) % 100 == 0, 12.0, np.nan))
    table["motor_2"][100:150] = np.nan
    flight = from_arrays(table)
    assert flight["motors"].valid[:, 1].sum() == 950 and flight["motors"].valid[:, 0].all()
    assert flight["battery"].rate_hz == pytest.approx(1.0) and len(flight["battery"]) == 10
    assert all(np.isfinite(s.values).all() for s in flight.signals.values())


def test_time_running_backwards_is_repaired_and_said():
    table = columns()
    table["time_s"][60:] -= 0.2
    flight = from_arrays(table)
    assert (np.diff(flight["gyro"].time) >= 0).all() and "backwards" in " ".join(flight.warnings)


def test_armed_and_landed_columns_become_messages():
    landed = np.r_[np.ones(30), np.zeros(50), np.ones(20)]
    flight = from_arrays(columns(landed=landed))
    assert [(round(m.time, 2), m.kind, m.value) for m in flight.messages] == [
        (0.0, "landed", 1.0),
        (0.3, "landed", 0.0),
        (0.8, "landed", 1.0),
    ]


def test_simulation_parameters_are_dropped():
    flight = from_arrays(columns(), parameters={"SIM_ENGINE_FAIL": 1, "MOT_THST_EXPO": 0.6})
    assert flight.parameters == {"MOT_THST_EXPO": 0.6}


@pytest.mark.parametrize(
    "change, words",
    [
        ({"gyro_x_rpm": np.zeros(100)}, "unknown column gyro_x_rpm"),
        ({"accel_x_m_s2": np.zeros(100)}, "accel_y_m_s2, accel_z_m_s2 is missing next to accel_x_m_s2"),
        ({"motor_6": np.zeros(100)}, "without gaps"),
        ({"motor_1_us": np.zeros(100)}, "same rotor"),
        ({"motor_5_us": np.zeros(100)}, "all end in _us"),
        ({"throttle": np.zeros(7)}, "one length"),
        ({"throttle": ["a"] * 100}, "other than numbers"),
        ({"time_s": np.full(100, np.nan)}, "no numbers"),
    ],
)
def test_wrong_columns_are_named_in_one_sentence(change, words):
    with pytest.raises(LogError) as caught:
        from_arrays(columns() | change)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_table_without_time_is_refused():
    with pytest.raises(LogError, match="time_s"):
        from_arrays({"motor_1": [1, 2]})


def test_damaged_lines_cost_only_themselves(tmp_path):
    path = write(tmp_path / "flight.csv", columns())
    lines = path.read_text().splitlines()
    lines[10] = lines[10].rsplit(",", 1)[0]
    cells = lines[20].split(",")
    lines[20] = ",".join([cells[0], "0.1x", *cells[2:]])
    path.write_text("\n".join(lines) + "\n0.99,0.1")  # and the last line is cut
    flight = logs.read(path)
    assert len(flight["gyro"]) == 99 and flight["motors"].valid[:, 0].sum() == 98
    assert "2 lines" in flight.warnings[0] and "1 cell" in flight.warnings[1]


@settings(max_examples=trials(60), deadline=None)
@given(st.lists(st.lists(st.one_of(st.none(), st.floats(-1e6, 1e6, width=32)), min_size=3, max_size=3), min_size=1, max_size=20))
def test_empty_cells_anywhere_are_not_a_number(rows):
    text = "a,b,c\n" + "".join(",".join("" if v is None else repr(v) for v in row) + "\n" for row in rows)
    notes = []
    table = log_memory.numbers(text.encode(), notes)
    want = np.array([[np.nan if v is None else v for v in row] for row in rows], float)
    got = np.column_stack([table[c] for c in "abc"])
    assert np.array_equal(got, want, equal_nan=True) and notes == []


def test_damage_anywhere_is_read_or_refused(tmp_path):
    out = io.StringIO()
    np.savetxt(out, np.column_stack(list(columns(60).values())), delimiter=",", fmt="%.4f")
    data = (",".join(columns()) + "\n" + out.getvalue()).encode()
    rng = np.random.default_rng(2)
    path, outcomes = tmp_path / "flight.csv", []
    for trial in range(150):
        hurt = np.frombuffer(data, np.uint8).copy()
        hurt[rng.integers(0, hurt.size, 4)] = rng.integers(0, 256, 4)
        path.write_bytes(hurt[: rng.integers(1, hurt.size)].tobytes() if trial % 2 else hurt.tobytes())
        try:
            flight = logs.read(path)
            outcomes.append(all(np.isfinite(s.values).all() for s in flight.signals.values()))
        except LogError as error:
            assert "\n" not in str(error)
            outcomes.append(None)
    assert True in outcomes and False not in outcomes


def test_one_column_is_a_battery_without_current_and_a_throttle_without_anything():
    flight = from_arrays(columns(voltage_V=np.full(100, 12.0), throttle=np.full(100, 0.4)))
    assert flight["throttle"].values.shape == (100, 1) and flight["throttle"].valid.all()
    assert flight["battery"].values[0, 0] == 12.0 and flight["battery"].valid[:, 0].all()
    assert not flight["battery"].valid[:, 1].any()


def test_times_count_from_the_first_row():
    later = columns()
    later["time_s"] = later["time_s"] + 1234.5
    flight = from_arrays(later)
    assert flight["gyro"].time[:3] == pytest.approx([0.0, 0.01, 0.02]) and flight.start_us == 1_234_500_000
    assert flight.duration == pytest.approx(0.99, abs=0.011)
