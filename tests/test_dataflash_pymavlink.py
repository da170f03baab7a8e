"""Every field of every wanted record equals what pymavlink reads; the text form equals the binary one."""

import lzma
from pathlib import Path

import numpy as np
import pytest

from rotorwatch.logs import dataflash
from rotorwatch.logs.dataflash_binary import BinaryLog
from rotorwatch.logs.dataflash_text import TextLog

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights"
WANTED = set("RCOU RATE IMU IMU2 ANG ATT XKF1 NKF1 EKF1 CTUN BAT CURR MOTB ESC PARM MSG VER ERR EV MODE ARM GPS PM FMTU".split())
LOGS = {
    "SITL": "ardupilot-sitl/quadx_healthy_hover.bin.xz",
    "3.3": "ardupilot-real-dronekit/log171.bin.xz",
    "real": "ardupilot-real-rrc/20_mm_cut_hover_2.bin.xz",
}


def _read(path: str) -> bytes:
    if not (FLIGHTS / path).exists():
        pytest.skip(f"test flights are not at {FLIGHTS}")
    return lzma.decompress((FLIGHTS / path).read_bytes())


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("path", LOGS.values(), ids=LOGS)
def test_equals_pymavlink_field_by_field(path, tmp_path):
    from pymavlink import DFReader

    data = _read(path)
    file = tmp_path / "log.bin"
    file.write_bytes(data)
    theirs: dict[str, dict[str, list]] = {}
    reader = DFReader.DFReader_binary(str(file), zero_time_base=False)
    counts = {f.name: reader.counts[t] for t, f in reader.formats.items() if reader.counts[t]}
    while (record := reader.recv_match(type=WANTED)) is not None:
        columns = theirs.setdefault(record.get_type(), {c: [] for c in record.get_fieldnames()})
        for column, values in columns.items():
            values.append(getattr(record, column))
    reader.close()

    log = BinaryLog(data)
    assert log.counts == counts
    assert set(theirs) == WANTED & set(log.counts)
    compared = 0
    for name, columns in theirs.items():
        table = log.table(name)
        assert table is not None and set(table.columns) == set(columns)
        for column, expected in columns.items():
            ours = table[column]
            if ours.dtype.kind == "S":
                assert [v.split(b"\0")[0].decode("latin-1") for v in ours.tolist()] == expected, (name, column)
            else:
                # Integers as integers: 64-bit stamps must not pass through float.
                expected = np.array(expected, dtype=None if ours.dtype.kind == "f" else ours.dtype)
                np.testing.assert_array_equal(ours, expected, err_msg=f"{name}.{column}")
            compared += len(expected)
    assert compared > 50_000


def as_text(log: BinaryLog) -> bytes:
    """The log as a ground station would write it: one record a line, scaled, in file order."""
    lines = {}
    for name in log.counts:
        table = log.table(name)
        assert table is not None
        columns = [
            [v.decode("latin-1") for v in c.tolist()] if c.dtype.kind == "S" else [repr(v) for v in c.tolist()]
            for c in table.columns.values()
        ]
        for k, record in enumerate(table.record.tolist()):
            lines[record] = ", ".join([name, *(c[k] for c in columns)])
    return "\n".join(lines[k] for k in sorted(lines)).encode("latin-1")


@pytest.mark.parametrize("path", [LOGS["SITL"], LOGS["3.3"]], ids=["SITL", "3.3"])
def test_text_form_equals_binary(path):
    data = _read(path)
    log = BinaryLog(data)
    text = b" 1\n 2\n" + as_text(log)
    assert dataflash.sniff(text[:4096], "")
    assert TextLog(text).counts == log.counts
    binary, textual = dataflash.read(data, "a.bin"), dataflash.read(text, "a.log")
    assert textual.signals.keys() == binary.signals.keys()
    for name, signal in binary.signals.items():
        np.testing.assert_array_equal(textual[name].time, signal.time)
        np.testing.assert_array_equal(textual[name].values, signal.values, err_msg=name)
        np.testing.assert_array_equal(textual[name].valid, signal.valid)
    assert textual.parameters == binary.parameters
    assert textual.parameter_changes == binary.parameter_changes
    assert textual.messages == binary.messages
    assert (textual.firmware, textual.start_us, textual.duration) == (binary.firmware, binary.start_us, binary.duration)
    assert textual.facts == binary.facts
