"""Data messages of a ULog as tables: what pyulog says of the same bytes, whatever they are."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.errors import LogError
from rotorwatch.logs import ulog, ulog_data
from rotorwatch_lab.simulation import scenario, simulate

PLAN = {"autopilot": "px4", "duration_s": 25.0, "airframe": {"frame": "quad-x"}, "trajectory": {"kind": "hover", "altitude_m": 2.0}}


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """A simulated log, with what has no time of its own put between its messages."""
    path = tmp_path_factory.mktemp("ulog") / "flight.ulg"
    simulate(scenario.from_table(PLAN)).write(path)
    data = path.read_bytes()
    found = ulog_data.messages(data, ("actuator_motors", "vehicle_angular_velocity"))
    assert found is not None
    late = [int(p) - 3 for p in found.places[found.kinds == ord("D")][[400, 900, 1500]]]
    key = b"float MC_ROLL_P"
    parameter = message("P", bytes([len(key)]) + key + struct.pack("<f", 7.5))
    extra = (message("O", struct.pack("<H", 120)), parameter, message("L", b"4" + struct.pack("<Q", 2_000_000) + b"hello"))
    parts, at = [], 0
    for place, more in zip(late, extra, strict=True):
        parts += [data[at:place], more]
        at = place
    return b"".join([*parts, data[at:]])


def both(data: bytes, monkeypatch) -> list:
    """What is read with tables, and by pyulog alone; the sentence where nothing can be."""
    found = []
    for way in (ulog_data.messages, lambda *_: None):
        with monkeypatch.context() as patch:
            patch.setattr(ulog_data, "messages", way)
            try:
                found.append(ulog.read(data, "flight.ulg"))
            except LogError as why:
                found.append(str(why))
    return found


def same(one, other) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    names = ("duration", "parameters", "parameter_changes", "messages", "warnings", "start_us", "facts", "firmware")
    signals = one.signals.keys() == other.signals.keys() and all(
        np.array_equal(getattr(one[k], what), getattr(other[k], what), equal_nan=what == "values")
        for k in one.signals for what in ("time", "values", "valid")
    )  # fmt: skip
    return signals and all(getattr(one, name) == getattr(other, name) for name in names)


def test_a_sound_log_is_what_pyulog_says_it_is(whole, monkeypatch):
    assert ulog_data.messages(whole, ("actuator_motors",)) is not None
    fast, slow = both(whole, monkeypatch)
    assert same(fast, slow)
    assert any(m.kind == "dropout" and m.time > 0.1 for m in fast.messages)
    assert any(m.text == "hello" for m in fast.messages)


@settings(max_examples=trials(60), deadline=None)
@given(st.data())
def test_a_damaged_log_is_what_pyulog_says_it_is(whole, data):
    """Cut anywhere, or with bytes that are other ones."""
    made = bytearray(whole)
    if data.draw(st.booleans(), "cut"):
        del made[data.draw(st.integers(17, len(made)), "at") :]
    for _ in range(data.draw(st.integers(0, 3), "flips")):
        made[data.draw(st.integers(0, len(made) - 1), "place")] = data.draw(st.integers(0, 255), "byte")
    with pytest.MonkeyPatch.context() as patch:
        fast, slow = both(bytes(made), patch)
    assert same(fast, slow)


@pytest.mark.parametrize("kind", ["again", "unknown", "short", "behind"])
def test_what_is_not_sound_is_pyulogs(whole, kind, monkeypatch):
    found = ulog_data.messages(whole, ("actuator_motors",))
    assert found is not None
    added = int(found.places[found.kinds == ord("A")][0])
    data = int(found.places[found.kinds == ord("D")][50])
    size = struct.unpack("<H", whole[data - 3 : data - 1])[0]
    made = {
        "again": whole + whole[added - 3 : added + struct.unpack("<H", whole[added - 3 : added - 1])[0]],
        "unknown": whole[: data - 3] + message("Z", b"new") + whole[data - 3 :],
        "short": whole[: data - 3] + message("D", whole[data : data + size - 1]) + whole[data + size :],
        "behind": whole[:16] + message("B", bytes(8) + b"\1" + bytes(7) + struct.pack("<QQQ", data - 3, 0, 0)) + whole[16:],
    }[kind]
    assert same(*both(made, monkeypatch))


def test_it_is_used(whole, monkeypatch):
    """The log that pyulog gets is small."""
    sizes = []
    monkeypatch.setattr(ulog, "_File", lambda data, *more, real=ulog._File: sizes.append(len(data)) or real(data, *more))
    flight = ulog.read(whole, "flight.ulg")
    assert flight.parameter_changes and all(t > 0.1 for t, _, _ in flight.parameter_changes)
    assert min(sizes) < 0.5 * len(whole)
