"""Blackbox logs of Betaflight and its relatives: frames against another encoder and another decoder, and what is made of them."""

from __future__ import annotations

import csv
import itertools
import lzma
import re
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import blackbox_writer as writer
import fuzzing
from blackbox_writer import Field, Log
from conftest import trials
from embedded_c_parts import STRICT, compilers
from rotorwatch import airframes, gathering, logs
from rotorwatch.base.compiling.running import Definition
from rotorwatch.diagnose_many import diagnose_many
from rotorwatch.errors import LogError, VehicleError
from rotorwatch.logs import container
from rotorwatch.logs.blackbox import decoder, encodings, frame_sizes, frames, header
from rotorwatch.report.info import info

SHARED = Path(__file__).parents[1] / "../shared/flights/blackbox"
SAMPLES = Path(__file__).resolve().parents[1] / "src" / "rotorwatch" / "samples"
PLAIN = Definition("blackbox", (encodings, frames), frame_sizes, decoder.FILES)
PLAIN.__dict__["library"] = None


@pytest.fixture(params=["native", "python"])
def way(request, monkeypatch):
    """Both ways in which the definition runs."""
    if request.param == "python":
        monkeypatch.setattr(decoder, "BLACKBOX", PLAIN)
    elif decoder.BLACKBOX.library is None:
        pytest.skip("no C compiler is here")
    return request.param


def decoded(log: Log, end: bool = True):
    data = log.bytes(end)
    return decoder.decode(data, 0, len(data))


def numbers(table, names):
    return np.stack([table.columns[name].astype(np.int64) for name in names], axis=1)


# Real logs, which are not part of the project


def expected():
    if not SHARED.is_dir():
        return []
    with (SHARED / "frames.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.skipif(not SHARED.is_dir(), reason="the flight logs for tests are not here (../shared/flights)")
def test_real_logs_are_decoded_as_another_decoder_does():
    for row in expected():
        data = lzma.decompress((SHARED / f"{row['path']}.xz").read_bytes())
        starts = [*header.starts(data), len(data)]
        one = decoder.decode(data, *starts[int(row["session"]) :][:2])
        found = {"frames": len(one.main), "first_us": one.time[0], "last_us": one.time[-1], "corrupt": one.corrupt}
        for k in range(4):
            found[f"motor{k}_mean"] = one.main.columns[f"motor[{k}]"].mean()
        for k in range(3):
            found[f"gyro{k}_std_raw"] = one.main.columns[f"gyroADC[{k}]"].std()
        found["acc2_mean_raw"] = one.main.columns["accSmooth[2]"].mean()
        assert {name: round(float(v), 3) for name, v in found.items()} == {name: float(row[name]) for name in found}


@pytest.mark.skipif(not SHARED.is_dir(), reason="the flight logs for tests are not here (../shared/flights)")
@pytest.mark.parametrize("name", ["LOG00031.BFL", "gimbal-ghost-btfl_002.bbl"])
def test_python_alone_decodes_the_same(name, monkeypatch):
    data = lzma.decompress((SHARED / f"{name}.xz").read_bytes())
    starts = [*header.starts(data), len(data)]
    for span in itertools.pairwise(starts[:3]):
        native = decoder.decode(data, *span)
        monkeypatch.setattr(decoder, "BLACKBOX", PLAIN)
        plain = decoder.decode(data, *span)
        monkeypatch.undo()
        for kind in ("main", "slow", "gps"):
            for column, values in getattr(native, kind).columns.items():
                np.testing.assert_array_equal(values, getattr(plain, kind).columns[column])
        np.testing.assert_array_equal(native.events, plain.events)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the flight logs for tests are not here (../shared/flights)")
@pytest.mark.parametrize(
    "name", ["LOG00017.BFL", "LOG00001.BFL", "LOG00027.BFL", "Chameleon_3_1_7.BFL", "Hiro_highP_highD.BFL", "gimbal-ghost-btfl_002.bbl"]
)
def test_real_vehicles_turn_as_their_frame_says(name):
    """Angular acceleration goes with the torque that the frame makes of the outputs, in all axes, whichever way its motors turn."""
    signal = pytest.importorskip("scipy.signal")
    flight = logs.read(SHARED / f"{name}.xz")
    craft = airframes.identify(flight)
    assert craft.name == ("betaflight-quad-x-reversed" if "gimbal" in name else "betaflight-quad-x")
    gyro, motors = flight["gyro"], flight["motors"]
    share = 1.0 / (1.0 + 0.03 * gyro.rate_hz)  # motors take 30 ms
    thrust = signal.lfilter([share], [1.0, share - 1.0], craft.curve(motors.values), axis=0)
    step = max(1, round(0.05 * gyro.rate_hz))

    def means(x):
        return x[: len(x) // step * step].reshape(-1, step, *x.shape[1:]).mean(axis=1)

    rate, torque, least = (means(gyro.values), means(thrust @ craft.effectiveness()[:3].T), means(motors.values).min(axis=1))
    driven = least[1:] > craft.curve.u_min + 0.03
    for axis in range(3):
        between = 0.5 * (torque[1:, axis] + torque[:-1, axis])
        assert np.corrcoef(between[driven], np.diff(rate[:, axis])[driven])[0, 1] > 0.05, axis


def test_no_compiler_warns_of_the_frames(tmp_path):
    for name, text in zip(("rw_config.h", "rw_blackbox.h", "rw_blackbox.c"), decoder.BLACKBOX.translated()):
        (tmp_path / name).write_text(text)
    for compiler in compilers():
        subprocess.run([compiler, *STRICT, "-fsyntax-only", str(tmp_path / "rw_blackbox.c")], check=True)


# Frames that were written here

EDGES = [0, 1, -1, 2, -2, 7, -8, 8, -9, 15, -16, 31, -32, 63, -64, 127, -128, 128, -129, 255, -256, 32767, -32768]
WIDE = [*EDGES, 32768, -32769, 8388607, -8388608, 8388608, -8388609, 2**31 - 1, -(2**31)]


def fields(encode, count, predict=writer.ZERO):
    return [Field(f"x[{k}]", 1, predict, encode, predict, encode) for k in range(count)]


TIME = Field("time", 0, writer.ZERO, writer.UNSIGNED, writer.LINE, writer.SIGNED)


@pytest.mark.parametrize(
    "encode, values, count",
    [
        (writer.SIGNED, WIDE, 1), (writer.UNSIGNED, WIDE, 1), (writer.NEG14, [v for v in EDGES if abs(v) < 8192] + [8191, -8191], 1),
        (writer.TAG8_8, WIDE, 1), (writer.TAG8_8, WIDE, 5), (writer.TAG8_8, WIDE, 11), (writer.TAG2_3, WIDE, 3), (writer.TAG2_3, WIDE, 6),
        (writer.TAG8_4, EDGES, 4), (writer.TAG2_3V, WIDE, 3), (writer.DELTA_U, WIDE, 3), (writer.DELTA_S, WIDE, 3),
        (writer.GAMMA_S, WIDE, 3),
    ],
)  # fmt: skip
def test_every_encoding_at_its_edges(way, encode, values, count):
    rng = np.random.default_rng(encode)
    log = Log([TIME, *fields(encode, count), Field("after", 1)])
    made = [[k, *rng.choice(values, count).tolist(), int(rng.choice(WIDE))] for k in range(120)]
    made += [[120 + k, *[v] * count, 0] for k, v in enumerate(values)]
    writer.fly(log, made)
    one = decoded(log)
    assert (one.corrupt, one.orphans, one.garbage) == (0, 0, 0) and one.ended
    np.testing.assert_array_equal(numbers(one.main, [f.name for f in log.main]), made)


def test_four_numbers_of_the_first_data_version(way):
    rng = np.random.default_rng(1)
    log = Log([TIME, *fields(writer.TAG8_4, 4)], version=1)
    made = [[k, *rng.choice(EDGES, 4).tolist()] for k in range(200)]
    writer.fly(log, made)
    np.testing.assert_array_equal(numbers(decoded(log).main, [f.name for f in log.main]), made)


PREDICTS = [writer.ZERO, writer.PREVIOUS, writer.LINE, writer.AVERAGE, writer.MINTHROTTLE, writer.MOTOR0, writer.P1500]
PREDICTS += [writer.VBATREF, writer.MINMOTOR]
ENCODES = {
    writer.SIGNED: 30,
    writer.UNSIGNED: 30,
    writer.NEG14: 11,
    writer.TAG8_8: 30,
    writer.TAG2_3: 30,
    writer.TAG8_4: 13,
    writer.NONE: 0,
}
ENCODES |= {writer.TAG2_3V: 30, writer.DELTA_U: 30, writer.DELTA_S: 30, writer.GAMMA_S: 30}
SIZES = {writer.TAG2_3: 3, writer.TAG2_3V: 3, writer.TAG8_4: 4}


@st.composite
def sessions(draw):
    """(log, rows): fields in any order, encoded and predicted in any way; numbers that fit."""
    layout, bits = [Field("motor[0]", 1, writer.ZERO, writer.SIGNED, writer.PREVIOUS, writer.SIGNED)], [11]
    for _ in range(draw(st.integers(1, 6))):
        encode = draw(st.sampled_from(sorted(ENCODES)))
        for _ in range(SIZES.get(encode, draw(st.integers(1, 3)))):
            how = [draw(st.sampled_from(PREDICTS)) if encode != writer.NONE else writer.ZERO for _ in range(2)]
            layout.append(Field(f"f{len(layout)}", 1, how[0], encode, how[1], encode))
            bits.append(ENCODES[encode])
    time = Field("time", 0, writer.ZERO, writer.UNSIGNED, writer.LINE, writer.SIGNED)
    layout += [time, Field("loopIteration", 0, writer.ZERO, writer.UNSIGNED, writer.INC, writer.NONE)]
    slow = [Field("flightModeFlags", 0, writer.ZERO, writer.UNSIGNED), Field("failsafePhase", 0, writer.ZERO, writer.SIGNED)]
    log = Log(layout, slow, settings={"minthrottle": 1070, "vbatref": 1600, "motorOutput": "138,2047"})
    start, made = draw(st.sampled_from([0, 2**31 - 5000, 2**32 - 5000])), []
    for k in range(draw(st.integers(1, 70))):
        row = [draw(st.integers(-(2**b) // 2, 2**b // 2)) if b else 0 for b in bits]
        made.append([*row, (start + 500 * k + draw(st.integers(0, 99))) % 2**32, k])
    return log, made


@settings(max_examples=trials(60), deadline=None)
@given(sessions(), st.booleans())
def test_what_is_written_is_read(pair, native):
    log, made = pair
    writer.fly(log, made)
    definition = decoder.BLACKBOX
    try:
        decoder.BLACKBOX = definition if native else PLAIN
        one = decoded(log)
    finally:
        decoder.BLACKBOX = definition
    np.testing.assert_array_equal(numbers(one.main, [f.name for f in log.main]), made)
    assert (one.corrupt, one.orphans, one.garbage, one.ended) == (0, 0, 0, True)
    np.testing.assert_array_equal(one.time - one.time[0], [(row[-2] - made[0][-2]) % 2**32 for row in made])


def simple(count=100, start=1000, step=500, gyro=None, more=()):
    """A log with a number that moves."""
    log = Log([TIME, Field("gyroADC[0]", 1, writer.ZERO, writer.SIGNED, writer.AVERAGE, writer.SIGNED), *more], **{"slow": SLOW})
    gyro = gyro if gyro is not None else np.arange(count) * 3 - 50
    return writer.fly(log, [[(start + step * k) % 2**32, int(gyro[k]), *[0] * len(more)] for k in range(count)])


SLOW = [Field("flightModeFlags", 0, writer.ZERO, writer.UNSIGNED), *(Field(n, 0, writer.ZERO, writer.TAG2_3) for n in "abc")]


def test_slow_gps_home_and_event_frames(way):
    log = Log([TIME, Field("motor[0]")], SLOW)
    log.home = [Field("GPS_home[0]"), Field("GPS_home[1]")]
    log.gps = [
        Field("time", 0, writer.MAINTIME, writer.UNSIGNED),
        Field("GPS_coord[0]", 1, writer.HOME),
        Field("GPS_coord[1]", 1, writer.HOME),
    ]
    log.add("S", [3, 0, 1, 1])
    log.add("I", [2**32 - 700, 5])
    log.add("H", [470000000, -80000000])
    log.add("G", [2**32 - 400, 470000123, -80000321])
    log.event(0, 2**32 - 650)
    log.event(30, 5, 1)
    log.add("P", [2**32 - 200, 6])
    log.event(13, 7, -120)
    log.add("P", [300, 7])
    log.add("G", [400, 469999999, -79999999])
    log.add("S", [2**32 - 1, 2, -1 % 4 - 4, 100])
    log.event(15, 4)
    one = decoded(log)
    assert (one.corrupt, one.garbage) == (0, 0)
    assert one.time.tolist() == [2**32 - 700, 2**32 - 200, 2**32 + 300]
    assert numbers(one.slow, ["flightModeFlags", "a", "b"]).tolist()[0] == [3, 0, 1] and one.slow.before.tolist() == [0, 3]
    assert one.slow.columns["flightModeFlags"][1] == 2**32 - 1
    assert numbers(one.gps, ["GPS_coord[0]", "GPS_coord[1]"]).tolist() == [[470000123, -80000321], [469999999, -79999999]]
    assert one.clock(one.gps.columns["time"], one.gps.before).tolist() == [2**32 - 400, 2**32 + 400]
    assert one.events[:, 1].tolist() == [0, 30, 13, 15, 255]
    assert one.events[1, 3:].tolist() == [5, 1] and one.events[2, 3:].tolist() == [7, -120]


def test_more_frames_than_the_buffers_hold(way, monkeypatch):
    monkeypatch.setattr(decoder, "CELLS", 200)
    monkeypatch.setattr(decoder, "FEW", 3)
    log = simple(0)
    made = [[1000 + 500 * k, k * k] for k in range(400)]
    for k, row in enumerate(made):
        log.add("P" if k % 32 else "I", row)
        if k % 7 == 0:
            log.add("S", [k, 0, 0, 0])
            log.event(30, k, 0)
    one = decoded(log)
    np.testing.assert_array_equal(numbers(one.main, ["time", "gyroADC[0]"]), made)
    assert one.slow.columns["flightModeFlags"].tolist() == list(range(0, 400, 7)) == one.events[:-1, 3].tolist()


def test_loops_are_counted_as_the_header_says(way):
    for interval, counted in (((32, 1, 4), [0, 4, 8, 12]), ((8, 1, 4), [0, 4, 8, 12]), ((6, 2, 3), [0, 2, 3, 5, 6, 8])):
        log = Log([Field("loopIteration", 0, writer.ZERO, writer.UNSIGNED, writer.INC, writer.NONE), TIME], interval=interval)
        for k, loop in enumerate(counted):
            log.add("I" if loop % interval[0] == 0 else "P", [loop, 1000 * k])
        assert decoded(log).main.columns["loopIteration"].tolist() == counted, interval


# Damage


def test_a_damaged_frame_costs_the_frames_up_to_the_next_that_stands_alone(way):
    log = simple(100)
    data = log.bytes()
    at = data.index(log.data) + len(log.data) // 2
    cut = data.index(b"P", at)
    one = decoder.decode(data[:cut] + b"\xff\xff" + data[cut:], 0, len(data) + 2)
    assert 64 <= len(one.main) < 100 and one.corrupt + one.garbage >= 1 and one.orphans >= 1
    known = set(map(tuple, numbers(decoded(log).main, ["time", "gyroADC[0]"]).tolist()))
    assert set(map(tuple, numbers(one.main, ["time", "gyroADC[0]"]).tolist())) <= known


def test_a_frame_at_an_impossible_time_is_not_believed_unless_the_next_agrees(way):
    log = simple(64)
    log.add("I", [2**31, 7])  # damage
    writer.fly(log, [[33000 + 500 * k, k] for k in range(40)])
    one = decoded(log)
    assert len(one.main) == 104 and 2**31 not in one.time
    log = simple(64)  # a logger that lost a minute
    writer.fly(log, [[60_000_000 + 500 * k, k] for k in range(70)])
    one = decoded(log)
    assert one.time[-1] == 60_000_000 + 500 * 69 and len(one.main) == 64 + 38


def test_a_pause_that_the_firmware_tells_is_believed_at_once(way):
    log = simple(32)
    log.event(14, 999, 90_000_000)
    writer.fly(log, [[90_000_000 + 500 * k, k] for k in range(40)])
    assert len(decoded(log).main) == 72


def test_truncated_anywhere_it_is_read_or_refused_in_a_sentence(tmp_path, amount):
    log = writer.betaflight()
    writer.fly(log, writer.rows(log, 60, time=np.arange(60) * 1000 + 5000, motor_0=np.arange(60) + 300, accSmooth_2=2048))
    data = log.bytes()
    path, counts = tmp_path / "cut.bbl", []
    for end in range(0, len(data), amount(17, 7)):
        path.write_bytes(data[:end])
        try:
            counts.append(len(logs.read(path)["motors"]))
        except LogError as why:
            assert "cut.bbl" in str(why) and len(str(why)) < 200
    assert counts == sorted(counts) and counts[-1] in (59, 60) and counts[0] < 5


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda h: h.replace("Field I name", "Field I nane"), "list of fields of I frames is damaged"),
        (lambda h: re.sub("(?m)^H Field.*\n", "", h), "does not list the fields"),
        (lambda h: h.replace("time", "tine"), "does not list the fields"),
        (lambda h: re.sub("(?m)^(H Field I encoding:.*),0$", r"\1", h), "list of fields of I frames is damaged"),
        (lambda h: re.sub("(?m)^(H Field I encoding:.*),0$", r"\1,77", h), "have an unknown encoding"),
        (lambda h: re.sub("(?m)^(H Field I predictor:.*),5$", r"\1,200", h), "have an unknown encoding"),
        (lambda h: re.sub("(?m)^(H Field I encoding:.*),0$", r"\1,8", h), "do not fit their encoding"),
        (lambda h: re.sub("(?m)^(H Field I predictor:)0", r"\g<1>5", h), "invalid predictor"),
        (lambda h: h.replace("accSmooth[1]", "accSmooth[0]"), "is damaged"),
        (lambda h: h.replace("loopIteration", "a," * 300 + "loopIteration"), "is damaged"),
    ],
)
def test_headers_that_make_no_sense_are_refused(tmp_path, change, said):
    log = writer.betaflight()
    writer.fly(log, writer.rows(log, 40, time=np.arange(40) * 1000))
    text = log.header().decode()
    assert change(text) != text
    (tmp_path / "x.bbl").write_bytes(change(text).encode() + log.data)
    with pytest.raises(LogError, match=said):
        logs.read(tmp_path / "x.bbl")


def test_a_header_that_is_partly_damaged_leaves_what_it_can(file):
    log = small(writer.betaflight(), 100)
    log.add("S", [0, 0, 0, 1, 1])
    text = log.header().decode()
    without = re.sub("(?m)^(H Field P encoding:.*),0$", r"\1,8", text).replace("H Field S encoding:1", "H Field S encoding:x")
    flight = logs.read(file("x.bbl", without.encode() + log.data))
    assert len(flight["motors"]) == 4 and "fields of P and S frames is damaged" in " ".join(flight.warnings)  # I frames alone
    flight = logs.read(file("y.bbl", text.replace("H Product:B", "H Pr?duct:B").encode() + log.data + writer.END))
    assert len(flight["motors"]) == 100 and flight.warnings == ()
    assert [k.rpartition("#")[2] for k in logs.sessions(file("z.bbl", three().replace(b"H Product", b"H product", 1)))] == ["2", "3", "1"]


def test_files_without_a_session_or_frames(tmp_path):
    (tmp_path / "a.bfl").write_bytes(b"\xff" * 5000)
    (tmp_path / "b.bfl").write_bytes(writer.betaflight().bytes())
    with pytest.raises(LogError, match=r"a\.bfl: no session"):
        logs.read(tmp_path / "a.bfl")
    with pytest.raises(LogError, match=r"b\.bfl: the session holds no frames"):
        logs.read(tmp_path / "b.bfl")


def test_damaged_copies_are_read_or_refused_politely(file, amount):
    trials = amount(120, 300)
    outcomes, failures = fuzzing.anywhere(file("LOG.BFL", three()), trials, seed=5)
    assert failures == [] and sum(outcomes.values()) == trials
    assert outcomes["read with warnings"] > outcomes["rejected"] > 0


def test_of_logs_without_end_a_part_is_read(file, monkeypatch):
    monkeypatch.setattr(decoder, "MOST_CELLS", 2000)
    monkeypatch.setattr(decoder, "CELLS", 1000)
    flight = logs.read(file("x.bbl", small(writer.betaflight(), 400).bytes()))
    assert 60 < len(flight["motors"]) < 400 and "which is more than is read" in " ".join(flight.warnings)


def test_frames_of_one_byte_do_not_fill_memory(way, monkeypatch):
    """A slow frame of two hundred fields that take no byte each."""
    monkeypatch.setattr(decoder, "FEW", 100)
    monkeypatch.setattr(container, "SLACK", 1 << 20)
    log = Log([TIME, Field("motor[0]")], [Field(f"s{k}", encode=writer.NONE) for k in range(200)])
    log.add("I", [1000, 5])
    log.data += b"S" * 10_000  # 8 MB
    one = decoded(log)
    assert one.cut and 1000 < len(one.slow) < 2000 and len(one.main) == 1


# Flights

ORDER = (3, 0, 1, 2)  # ArduPilot's motors 1 .. 4 of a quad X in Betaflight's order: rear right, front right, rear left, front left
MIX = np.array([[-1, 1, -1], [-1, -1, 1], [1, 1, 1], [1, -1, -1]])  # Betaflight's: right, nose down, left


@cache
def origin():
    return logs.read(SAMPLES / "quadx_healthy_hover.bin.xz")


@cache
def hover(seconds: float = 25.0) -> bytes:
    """The healthy sample as Betaflight logs it, 500 times a second: DShot, axes forward, left, up."""
    flight = origin()
    time = np.arange(0.0, seconds, 0.002)

    def at(name, smooth=True):
        s = flight[name]
        return np.stack([np.interp(time, s.time, c) for c in s.values.T], axis=1)

    motors = (at("motors") - 1000.0) / 1000.0
    outputs = np.round(48 + 1999 * motors[:, ORDER]).clip(158, 2047)
    share = (outputs - 158) / (2047 - 158)
    sums = np.round(1000 * share @ MIX / 4 * [1, 1, -1])
    gyro = np.round(np.degrees(at("gyro")) * [1, -1, -1] * 10)
    acc = np.round(at("accel") / 9.80665 * [1, -1, -1] * 2048)
    volts = np.round(at("battery")[:, 0] * 100)
    log = writer.betaflight(blackbox_high_resolution=1)
    columns = {f"axisP_{k}": sums[:, k] for k in range(3)}
    columns |= {f"gyroADC_{k}": gyro[:, k] for k in range(3)} | {f"accSmooth_{k}": acc[:, k] for k in range(3)}
    columns |= {f"motor_{k}": outputs[:, k] for k in range(4)} | {f"setpoint_{k}": gyro[:, k] for k in range(3)}
    stick = np.round(1000 * share.mean(axis=1))
    writer.fly(log, writer.rows(
        log, len(time), loopIteration=np.arange(len(time)), time=np.round(time * 1e6) + 7_000_000, vbatLatest=volts, amperageLatest=1234,
        setpoint_3=stick, rcCommand_3=(1000 + stick) * 10, **columns,
    ))  # fmt: skip
    log.event(15, 4)
    return log.bytes()


@pytest.fixture
def file(tmp_path):
    def write(name, data):
        path = tmp_path / name
        path.write_bytes(data)
        return path

    return write


def test_a_flight_comes_back_in_our_units_and_axes(file):
    flight, known = logs.read(file("hover.bbl", hover())), origin()
    assert (flight.format, flight.autopilot, flight.firmware) == ("Blackbox", "Betaflight", "Betaflight 4.5.1 (77d01ba3b) STM32F7X2")
    assert flight.warnings == () or all("do not fit" in w or "does not fit" in w for w in flight.warnings)
    assert flight.start_us == 7_000_000 and flight.duration == pytest.approx(25.0, abs=0.01)
    for name, least in (("gyro", np.radians(0.051)), ("rates", np.radians(0.051)), ("rates_wanted", np.radians(0.051)), ("accel", 0.003)):
        source = known["gyro" if name != "accel" else name]
        there = np.stack([np.interp(flight[name].time, source.time, c) for c in source.values.T], axis=1)
        assert np.abs(flight[name].values - there)[flight[name].valid.all(axis=1)].max() <= least, name
    motors = flight["motors"]
    assert motors.unit == "1" and (flight.facts["motor_low"], flight.facts["motor_high"]) == (0.0555, 1.0)
    pulses = np.stack([np.interp(motors.time, known["motors"].time, c) for c in known["motors"].values.T], axis=1)[:, ORDER]
    np.testing.assert_allclose(motors.values, np.maximum((1 + 1.999 * (pulses - 1000)) / 2000, 0.0555), atol=0.0003)
    assert flight["battery"].values[:, 1] == pytest.approx(12.34) and flight["battery"].values[0, 0] == pytest.approx(
        known["battery"].values[0, 0], abs=0.3
    )
    assert flight["throttle"].values.mean() == pytest.approx(flight["control"].values[:, 3].mean())
    assert flight.facts["utc_start"] == "2026-03-04T05:06:07.890Z" and flight.facts["craft"] == "five inch"
    assert flight.parameters["vbatcellvoltage[2]"] == 430 and flight.parameters["motor_poles"] == 14
    assert [(m.kind, m.value) for m in flight.messages if m.kind == "armed"] == [("armed", 1.0), ("armed", 0.0)]


@pytest.mark.parametrize("turned", [False, True])
def test_the_frame_is_what_the_outputs_are_mixed_for(file, turned):
    craft = airframes.identify(logs.read(file("x.bbl", mixed("quad-x", turned))))
    assert craft.name == f"betaflight-quad-x{'-reversed' if turned else ''}" and "identified from the mixing" in craft.assumptions[0]
    assert [r.spin for r in craft.rotors] == ([1, -1, -1, 1] if turned else [-1, 1, 1, -1])
    assert [(r.x > 0, r.y > 0) for r in craft.rotors] == [(False, True), (True, True), (False, False), (True, False)]
    assert (craft.curve.u_min, craft.curve.u_max, craft.curve.known) == (0.0555, 1.0, False)


def test_a_calm_flight_does_not_show_its_mixer(file):
    craft = airframes.identify(logs.read(file("hover.bbl", hover())))
    assert craft.name == "betaflight-quad-x" and "does not name its frame" in craft.assumptions[0]


def test_a_motor_that_is_off_all_the_time_ends_nothing(file):
    log = writer.betaflight()
    made = [[*row[:-1], 0] for row in writer.rows(log, 3000, time=np.arange(3000) * 1000, **{f"motor_{k}": 1200 for k in range(3)})]
    flight = logs.read(file("x.bbl", writer.fly(log, made).bytes()))
    assert not info(flight)["ready"]


def test_info_says_what_there_is(file):
    found = info(logs.read(file("hover.bbl", hover())))
    assert found["frame"] == "betaflight-quad-x" and found["rotors"] == 4 and found["ready"]
    assert {s["name"] for s in found["signals"]} == {
        "motors", "control", "gyro", "rates", "rates_wanted", "accel", "throttle", "battery",
    }  # fmt: skip
    assert ["attitude", "esc"] == [gap["signal"] for gap in found["missing"]]


def mixed(frame, turned=False, **settings):
    """A log whose outputs are mixed for a frame."""
    rng = np.random.default_rng(3)
    factors = airframes_factors(frame) * [1, 1, -1 if turned else 1]
    asked = rng.normal(0, 60, (600, 3)).round()
    outputs = 700 + (2047 - 158) * (asked / 1000) @ factors.T
    log = writer.betaflight(len(factors), **settings)
    columns = {f"axisP_{k}": asked[:, k] * (1 if k == 0 else -1) for k in range(3)}
    names = {f"motor[{k}]": outputs[:, k].round() for k in range(len(factors))}
    made = list(writer.rows(log, 600, time=np.arange(600) * 500, **columns))
    at = {f.name: k for k, f in enumerate(log.main)}
    for name, values in names.items():
        for row, value in zip(made, values):
            row[at[name]] = int(value)
    return writer.fly(log, made).bytes()


def airframes_factors(frame):
    from rotorwatch.airframes import betaflight

    return betaflight._factors(betaflight.FRAMES[frame])


@pytest.mark.parametrize("frame", ["quad-x", "quad-plus", "hexa-x", "hexa-plus", "y6", "octa-x8", "octa-x", "octa-plus"])
@pytest.mark.parametrize("turned", [False, True])
def test_frames_are_reported_apart(file, frame, turned):
    craft = airframes.identify(logs.read(file("x.bbl", mixed(frame, turned))))
    assert craft.name == f"betaflight-{frame}{'-reversed' if turned else ''}"
    named = airframes.named(craft.name)
    assert [(r.spin, r.lower) for r in named.rotors] == [(r.spin, r.lower) for r in craft.rotors]
    assert not np.any(np.abs(named.effectiveness()[:3].sum(axis=1)) > 1e-6) or frame in ("y6", "octa-x8")


def test_motors_that_turn_both_ways_are_refused_and_odd_numbers_too(file):
    with pytest.raises(VehicleError, match="turn both ways"):
        airframes.identify(logs.read(file("x.bbl", mixed("quad-x", features=1 << 12))))
    log = writer.betaflight(5)
    writer.fly(log, writer.rows(log, 40, time=np.arange(40) * 500, motor_0=500))
    with pytest.raises(VehicleError, match="commands 5 motors"):
        airframes.identify(logs.read(file("y.bbl", log.bytes())))
    log = writer.betaflight(3)
    writer.fly(log, writer.rows(log, 40, time=np.arange(40) * 500, motor_0=500))
    craft = airframes.identify(logs.read(file("z.bbl", log.bytes())))
    assert craft.name == "betaflight-tri" and "not assessed" in craft.assumptions[0]


def small(log, count=60, **columns):
    return writer.fly(log, writer.rows(log, count, time=np.arange(count) * 1000 + 5000, motor_0=600, **columns))


def test_revolutions_of_the_motors(file):
    log = writer.betaflight(more=[Field(f"eRPM[{k}]", 0, writer.ZERO, writer.UNSIGNED) for k in range(4)], motor_poles=12)
    writer.fly(log, ([*row[:-8], 900, 1000, 1100, 0, *row[-4:]] for row in writer.rows(log, 60, time=np.arange(60) * 1000, motor_0=600)))
    esc = logs.read(file("x.bbl", log.bytes()))["esc"]
    assert esc.columns[:4] == ("speed1", "speed2", "speed3", "speed4")
    np.testing.assert_allclose(esc.values[5, :3], np.array([90_000, 100_000, 110_000]) / 6 * 2 * np.pi / 60)


def test_speeds_and_the_unfiltered_accelerometer_of_indiflight(file):
    more = [Field(f"{name}[{k}]") for name, n in (("accUnfiltered", 3), ("omega", 8), ("omegaUnfiltered", 8)) for k in range(n)]
    log = writer.betaflight(more=more, **{"Firmware revision": "Indiflight 5.0.0 (abc) STM32H743"})
    speeds = {f"omegaUnfiltered_{k}": 1900 + k for k in range(4)} | {f"omega_{k}": 1800 for k in range(4)}
    flight = logs.read(file("x.bfl", small(log, accUnfiltered_0=1024, accUnfiltered_2=2048, accSmooth_2=2048, **speeds).bytes()))
    np.testing.assert_allclose(flight["raw_accel"].values[5], [0.5 * 9.80665, 0.0, -9.80665])
    np.testing.assert_allclose(flight["accel"].values[5], [0.0, 0.0, -9.80665])
    np.testing.assert_allclose(flight["esc"].values[5, :4], [1900.0, 1901.0, 1902.0, 1903.0])
    assert flight["esc"].columns[:5] == ("speed1", "speed2", "speed3", "speed4", "current1")
    assert flight["esc"].source == "omegaUnfiltered[0] .."


def test_attitude_velocity_and_position_of_inav(file):
    more = [Field(f"{name}[{k}]") for name in ("attitude", "navPos", "navVel", "axisRate") for k in range(3)]
    log = writer.betaflight(more=more, **{"Firmware type": "INAV", "Firmware revision": "INAV 7.1.2 (abc) MATEKF405", "minthrottle": 1050})
    log.main = [f for f in log.main if not f.name.startswith("setpoint")]
    log.numbers |= {"motorOutput": "1050,1950", "maxthrottle": 1950}
    values = {"attitude_0": 100, "attitude_1": 200, "attitude_2": 900, "navPos_0": 100, "navPos_1": 200, "navPos_2": 300}
    values |= {"navVel_0": 10, "navVel_1": 20, "navVel_2": 30, "axisRate_0": 90, "axisRate_1": 90, "axisRate_2": 90}
    flight = logs.read(file("x.txt", small(log, vbatLatest=1600, **values).bytes()))
    assert flight.autopilot == "INAV" and flight["motors"].unit == "us" and flight.facts["motor_high"] == 1950
    np.testing.assert_allclose(flight["velocity"].values[3], [0.1, 0.2, -0.3])
    np.testing.assert_allclose(flight["position"].values[3], [1.0, 2.0, -3.0])
    np.testing.assert_allclose(flight["rates_wanted"].values[3], np.radians([90.0, -90.0, -90.0]))
    w, x, y, z = flight["attitude"].values[3]
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    assert np.degrees([roll, np.arcsin(2 * (w * y - z * x))]) == pytest.approx([10.0, -20.0])
    assert "control" not in flight.signals and airframes.identify(flight).curve.u_min == 1050


@pytest.mark.parametrize(
    ("firmware", "number", "why"),
    [
        ("Betaflight 4.5.1", 5, "crash protection"), ("Betaflight 4.5.1", 6, "runaway take-off"), ("Betaflight 4.5.1", 9, "landing"),
        ("INAV 7.1.2", 5, "kill switch"), ("INAV 7.1.2", 6, "failsafe"), ("INAV 7.1.2", 8, "landing"), ("INAV 7.1.2", 40, "reason 40"),
    ],
)  # fmt: skip
def test_why_the_motors_were_stopped_by_the_numbers_of_the_firmware(file, firmware, number, why):
    log = small(writer.betaflight(**{"Firmware type": firmware.split()[0], "Firmware revision": f"{firmware} (abc) BOARD"}))
    log.event(15, number)
    flight = logs.read(file("x.bbl", log.bytes()))
    assert [m.text for m in flight.messages if m.text.startswith("disarmed:")] == [f"disarmed: {why}"]


def test_the_quaternion_of_betaflight(file):
    """Turned 40 degrees to the left and 20 nose down: in our axes to -40 and -20."""
    half = np.radians([0.0, 20.0, 40.0]) / 2
    q = origin_quaternion(*half)
    log = writer.betaflight(more=[Field(f"imuQuaternion[{k}]") for k in range(3)])
    values = {f"imuQuaternion_{k}": round(32767 * q[k + 1]) for k in range(3)}
    w, x, y, z = logs.read(file("x.bbl", small(log, **values).bytes()))["attitude"].values[4]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    assert np.degrees([np.arcsin(2 * (w * y - z * x)), yaw]) == pytest.approx([-20.0, -40.0], abs=0.02)


def origin_quaternion(a, b, c):
    """About z by 2c, then y by 2b, then x by 2a."""
    z, y = np.array([np.cos(c), 0, 0, np.sin(c)]), np.array([np.cos(b), 0, np.sin(b), 0])
    w = z[0] * y[0]
    return np.array([w, -z[3] * y[2], z[0] * y[2], z[3] * y[0]])


def test_velocity_from_gps_frames(file):
    log = writer.betaflight()
    log.home = [Field("GPS_home[0]"), Field("GPS_home[1]")]
    log.gps = [Field("time", 0, writer.MAINTIME, writer.UNSIGNED), *(Field(f"GPS_velned[{k}]") for k in range(3))]
    small(log, 30)
    log.add("G", [34_100, 100, -200, 300])
    small(log, 0)
    log.add("G", [34_300, 100, -200, 301])
    flight = logs.read(file("x.bbl", log.bytes()))
    np.testing.assert_allclose(flight["velocity"].values[0], [1.0, -2.0, 3.0])
    np.testing.assert_allclose(flight["velocity"].time, [0.0291, 0.0293])


def test_places_by_gps_frames_and_height_by_barometer(file):
    """Betaflight from 4.0 logs altitudes in 0.1 m, INAV in m; of others the unit is not certain."""
    for revision, unit in (("Betaflight 4.5.1 (abc) X", 0.1), ("INAV 7.1.2 (abc) X", 1.0), ("Betaflight 3.4.0 (abc) X", np.nan)):
        log = writer.betaflight(more=[Field("BaroAlt")], **{"Firmware revision": revision, "Firmware type": revision[:4]})
        log.home = [Field("GPS_home[0]"), Field("GPS_home[1]")]
        log.gps = [
            Field("time", 0, writer.MAINTIME, writer.UNSIGNED), Field("GPS_numSat", 0),
            *(Field(f"GPS_coord[{k}]", 1, writer.HOME) for k in range(2)), Field("GPS_altitude"), Field("GPS_speed"),
        ]  # fmt: skip
        log.add("H", [470_000_000, 80_000_000])
        small(log, 60, BaroAlt=1234)
        log.add("G", [64_100, 2, 470_000_000, 80_000_000, 4000, 0])
        for k in range(3):
            log.add("G", [64_200 + 100 * k, 9, 470_000_000 + 1000 * k, 80_000_000 - 1000 * k, 4000 + 50 * k, 250])
        flight = logs.read(file("x.bbl", log.bytes()))
        gps = flight["gps"]
        assert gps.source == "GPS_coord" and gps.valid[:, 0].tolist() == [False, True, True, True]
        assert gps.values[3, [0, 1, 3]] == pytest.approx([2 * 11.118, -2 * 7.604, 2.5], abs=0.01)
        assert gps.valid[3, 2] == np.isfinite(unit) and (not gps.valid[3, 2] or gps.values[3, 2] == pytest.approx(-100 * unit))
        assert flight["baro"].values[0, 0] == pytest.approx(12.34) and len(flight["baro"]) <= 60
        assert flight.duration == pytest.approx(0.059), "what is only shown does not prolong the flight"


def test_flight_modes_have_names(file):
    log = writer.betaflight()
    for flags in (1, 3, 1 | 1 << 20, 5, 5 | 1 << 9):
        log.add("S", [flags, 0, 0, 0, 0])
        small(log, 4)
    log.event(30, 5, 1)
    flight = logs.read(file("x.bbl", log.bytes()))
    assert [m.text for m in flight.messages if m.kind == "mode"] == ["Acro", "Angle", "Acro", "Horizon"]
    assert next(m.text for m in flight.messages if m.kind == "event") == "modes 0x5, before 0x1"
    log = writer.betaflight(**{"Firmware type": "INAV", "Firmware revision": "INAV 7.1.2 (abc) MATEKF405"})
    log.slow = [Field("activeFlightModeFlags", 0, writer.ZERO, writer.UNSIGNED), *log.slow[1:]]
    for flags in (0, 1, 1 | 1 << 3, 1 | 1 << 3 | 1 << 5, 1 | 1 << 3 | 1 << 4, 1 << 9 | 1 << 4):
        log.add("S", [flags, 0, 0, 0, 0])
        small(log, 4)
    names = [m.text for m in logs.read(file("y.bbl", log.bytes())).messages if m.kind == "mode"]
    assert names == ["Acro", "Angle", "Altitude hold", "Position hold", "Return home", "Failsafe"]
    log = writer.betaflight(**{"Firmware type": "Cleanflight", "Firmware revision": "bdaf8ec"})
    log.add("S", [1, 0, 0, 0, 0])
    small(log, 4)
    log.event(30, 5, 1)
    assert [m.text for m in logs.read(file("z.bbl", log.bytes())).messages if m.kind == "mode"] == ["modes 0x5, before 0x1"]


@pytest.mark.skipif(not SHARED.is_dir(), reason="the flight logs for tests are not here (../shared/flights)")
def test_the_gps_of_a_real_flight():
    flight = logs.read(SHARED / "gimbal-ghost-btfl_002.bbl.xz")
    gps = flight["gps"]
    assert len(gps) == 234 and gps.valid.all() and gps.values[:, 3].max() == pytest.approx(25.6)
    assert np.ptp(gps.values[:, :3], axis=0) == pytest.approx([113.9, 183.9, 97.8], abs=0.2)
    height = logs.read(SHARED / "LOG00006.BFL.xz")["baro"]
    assert height.rate_hz < 60 and np.ptp(height.values) < 60


@pytest.mark.parametrize(
    "settings_, raw, volts",
    [({}, 1580, 15.8), ({"vbatcellvoltage": "33,35,43", "vbatref": 164}, 158, 15.8),
     ({"vbatcellvoltage": "33,35,43", "vbatref": 1840, "vbatscale": 110}, 1840, 16.31)],
)  # fmt: skip
def test_voltages_of_all_ages(file, settings_, raw, volts):
    battery = logs.read(file("x.bbl", small(writer.betaflight(**settings_), vbatLatest=raw, amperageLatest=500).bytes()))["battery"]
    assert battery.values[5, 0] == pytest.approx(volts, abs=0.01)
    assert battery.valid[5, 1] == (settings_.get("vbatref", 0) < 700)


def test_pulses_stay_pulses_and_motors_at_rest_are_no_command(file):
    log = writer.betaflight(motorOutput="1070,2000")
    flight = logs.read(file("x.bbl", small(log).bytes()))
    assert flight["motors"].unit == "us" and flight.facts["motor_low"] == 1070
    log = writer.betaflight()
    made = list(writer.rows(log, 60, time=np.arange(60) * 1000, motor_0=600, motor_1=0, motor_2=700, motor_3=800))
    assert not logs.read(file("y.bbl", writer.fly(log, made).bytes()))["motors"].valid[:, 1].any()


def test_the_end_is_missing_and_frames_are_damaged(file):
    data = small(writer.betaflight(), 100).bytes(end=False)
    assert "The log has no end marker" in logs.read(file("x.bbl", data)).warnings[-1]
    middle = data.rindex(b"P", 0, len(data) - 300)
    flight = logs.read(file("y.bbl", data[:middle] + b"\x00\x01" + data[middle:]))
    assert re.search(r"\d+ damaged frames?, \d+ more that need them, and \d+ bytes between", flight.warnings[0])


# Several sessions


def three() -> bytes:
    first, second, third = (small(writer.betaflight(**{"Craft name": f"nr {n}"}), count) for n, count in ((1, 40), (2, 90), (3, 60)))
    return first.bytes() + b"\xff" * 100 + second.bytes(end=False) + third.bytes()


def test_the_longest_session_is_read_and_the_others_are_named(file):
    path = file("LOG.BFL", three())
    flight = logs.read(path)
    assert flight.name == "LOG.BFL" and flight.facts["craft"] == "nr 2" and flight.facts["session"] == 2
    assert "session 2 of 3, the longest; also in this file: #3, #1." in " ".join(flight.warnings)
    assert logs.sessions(path) == [f"{path}#2", f"{path}#3", f"{path}#1"]
    for number in (1, 2, 3):
        one = logs.read(f"{path}#{number}")
        assert (one.name, one.facts["craft"]) == (f"LOG.BFL#{number}", f"nr {number}")
        assert "also in this file" not in " ".join(one.warnings)
    with pytest.raises(LogError, match="holds 3 sessions, not one of number 4"):
        logs.read(f"{path}#4")
    with pytest.raises(LogError, match="no such file"):
        logs.read(f"{path}#x")


def test_a_damaged_session_is_passed_over(file):
    data = three().replace(b"H Field I encoding:1,1,0", b"H Field I encoding:1,1,2", 2)
    flight = logs.read(file("LOG.BFL", data))
    assert flight.facts["craft"] == "nr 3"


def test_files_with_one_flight_have_no_parts(file):
    path = file("one.bbl", small(writer.betaflight()).bytes())
    assert logs.sessions(path) == [str(path)] and logs.of_part(f"{path}#1") == (path, 1)
    named = file("really#1", small(writer.betaflight()).bytes())
    assert logs.of_part(named) == (named, None) and logs.read(named).name == "really#1"
    table = file("t.csv", b"time_s,motor_1\n0,0.5\n1,0.5\n2,0.6\n")
    assert logs.sessions(table) == [str(table)]
    with pytest.raises(LogError, match="holds one flight; leave #2 out"):
        logs.read(f"{table}#2")


def test_every_session_is_assessed_the_longest_first(file, tmp_path):
    path = file("LOG.BFL", three())
    wanted = [tmp_path / f"LOG.BFL#{k}" for k in (2, 3, 1)]
    assert gathering.is_several(path) and list(gathering.Gathered([path])) == wanted
    assert list(gathering.Gathered([tmp_path])) == wanted == list(gathering.Gathered([tmp_path / "*.BFL"]))
    assert list(gathering.Gathered([f"{path}#3"])) == [Path(f"{path}#3")]
    answers = sorted(diagnose_many([path], jobs=1, hashed=True), key=lambda a: a.index)
    assert [a.path for a in answers] == [str(w) for w in wanted]
    assert [a.error for a in answers] == [None] * 3
    assert len({a.sha256 for a in answers}) == 3 and logs.fingerprint(path)[1] not in {a.sha256 for a in answers}


def test_a_fleet_keeps_the_sessions_of_a_file_apart(file):
    pytest.importorskip("sqlalchemy")
    path = file("LOG.BFL", three())
    assert len({logs.fingerprint(p)[1] for p in (path, *(f"{path}#{k}" for k in (1, 2, 3)))}) == 4


# Tables of blackbox_decode

CSV = """loopIteration, time (us), vbatLatest (V), amperageLatest (A), gyroADC[0]{turn}, gyroADC[1]{turn}, gyroADC[2]{turn}, \
accSmooth[0]{force}, accSmooth[1]{force}, accSmooth[2]{force}, motor[0], motor[1], motor[2], motor[3], energyCumulative (mAh), \
flightModeFlags (flags)
"""


def lines(turn, force):
    rest = f"15.800, 12.30, {10 * turn:g}, {20 * turn:g}, {30 * turn:g}, 0, 0, {force:g}, 600, 610, 620, 630"
    return "".join(f"{k}, {1_000_000 + 1000 * k}, {rest}, {k}, ANGLE_MODE|MAG\n" for k in range(50)).encode()


@pytest.mark.parametrize("unit, turn", [("", 1.0), (" (deg/s)", 1.0), (" (rad/s)", np.pi / 180)])
@pytest.mark.parametrize("force, one", [("", 2048.0), (" (g)", 1.0), (" (m/s/s)", 9.80665), (" (m/s2)", 9.80665)])
def test_tables_of_blackbox_decode(file, unit, turn, force, one):
    flight = logs.read(file("x.csv", CSV.format(turn=unit, force=force).encode() + lines(turn, one)))
    assert (flight.format, flight.autopilot, flight.rotor_count) == ("Blackbox CSV", "Betaflight", 4)
    np.testing.assert_allclose(flight["gyro"].values[7], np.radians([10.0, -20.0, -30.0]), rtol=1e-4)
    np.testing.assert_allclose(flight["battery"].values[7], [15.8, 12.3])
    assert ("accel" in flight.signals) == bool(force) and flight["motors"].unit == "1"
    if force:
        np.testing.assert_allclose(flight["accel"].values[7], [0.0, 0.0, -9.80665], rtol=1e-4)
    assert "without the log's header" in " ".join(flight.warnings) and flight["gyro"].time[1] == pytest.approx(0.001)
    assert airframes.identify(flight).name == "betaflight-quad-x"


def test_damaged_tables_of_blackbox_decode(file):
    head = CSV.format(turn="", force="").encode()
    assert len(logs.read(file("x.csv", head + lines(1, 1)[:-40] + b"\n1,2\n"))["gyro"]) in (48, 49)
    with pytest.raises(LogError, match="no numeric line"):
        logs.read(file("y.csv", head))
    with pytest.raises(LogError, match="no time in us"):
        logs.read(file("z.csv", head.replace(b"(us)", b"(lightyears)") + lines(1, 1)))
