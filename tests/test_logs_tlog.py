"""MAVLink telemetry logs: our frame decoder against pymavlink's, vehicles, clocks and damage."""

import lzma
import struct
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import logs
from rotorwatch.errors import LogError
from rotorwatch.live.framing import Outgoing, Sender
from rotorwatch.logs import mavlink_frames, mavlink_messages, tlog

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights"
LOG = FLIGHTS / "ardupilot-sitl" / "quadx_m3_mul0.85_tlog.tlog.xz"
needs_flights = pytest.mark.skipif(not LOG.exists(), reason="the folder of test flights, ../shared/flights, is missing")


class Writer:
    """Makes telemetry logs with pymavlink's own encoder."""

    def __init__(self, version=2):
        from pymavlink.dialects.v20 import ardupilotmega

        self.mav = ardupilotmega
        self.version, self.data, self.stamp, self.encoders = version, b"", 1_700_000_000_000_000, {}

    def add(self, name, *values, system=1, component=1, raw=None):
        if (system, component) not in self.encoders:
            self.encoders[system, component] = self.mav.MAVLink(None, system, component)
        message = getattr(self.mav, f"MAVLink_{name}_message")(*values)
        frame = message.pack(self.encoders[system, component], force_mavlink1=self.version == 1)
        self.stamp += 10_000
        self.data += struct.pack(">Q", self.stamp) + frame
        return self

    def flight(self, samples=200, kind=2, autopilot=3):
        self.add("heartbeat", kind, autopilot, 0x81, 4, 4, 3)
        for k in range(samples):
            ms = 5000 + 20 * k
            self.add("attitude", ms, 0.1, 0.2, 0.3, 0.01 * k, 0.02, -0.03)
            self.add("raw_imu", ms * 1000, 10, -20, -1000, 100, 200, -300, 0, 0, 0)
            self.add("servo_output_raw", ms * 1000, 0, 1500, 1501, 1502, 1503, 1504, 1505, 1506, 1507)
        return self


def read(writer):
    return tlog.read(writer.data, "x.tlog")


@needs_flights
def test_every_wanted_field_equals_pymavlinks():
    from pymavlink.dialects.v20 import ardupilotmega

    data = lzma.decompress(LOG.read_bytes())[:600_000]
    layouts = mavlink_messages.by_name()
    frames = mavlink_frames.Frames(data, mavlink_messages.by_id())
    parser = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    theirs: dict[str, list] = {}
    at = 0
    while at + 8 < len(data):
        at += 8
        size = data[at + 1] + (8 if data[at] == 0xFE else 12)
        message = parser.parse_char(data[at : at + size])
        at += size
        if message is not None:
            theirs.setdefault(message.get_type(), []).append(message)
    checked = 0
    for name, messages in theirs.items():
        if name in ("BAD_DATA", "STATUSTEXT", "PARAM_VALUE") or name.startswith("UNKNOWN"):
            continue
        table, _ = frames.decode(1, 1, layouts[name])
        assert table.size == len(messages), name
        for field in messages[0].fieldnames:
            want = np.array([getattr(m, field) for m in messages])
            if want.dtype.kind in "iuf":
                assert np.array_equal(table[field].astype(want.dtype), want, equal_nan=want.dtype.kind == "f"), (name, field)
                checked += want.size
    assert checked > 50_000


@needs_flights
def test_the_telemetry_of_a_flight_agrees_with_its_onboard_log():
    telemetry, onboard = logs.read(LOG), logs.read(LOG.with_name("quadx_m3_mul0.85_tlog.bin.xz"))
    shift = (onboard.start_us - telemetry.start_us) * 1e-6
    at = np.linspace(15, 70, 200)
    for name, column, tolerance in (("motors", 0, 10.0), ("accel", 2, 0.3), ("position", 2, 0.1)):
        a, b = telemetry[name], onboard[name]
        mine = np.interp(at + shift, a.time, a.values[:, column])
        other = np.interp(at, b.time, b.values[:, column])
        assert np.median(np.abs(mine - other)) < tolerance, name
    assert telemetry["motors"].unit == "us" and telemetry["motors"].rate_hz == pytest.approx(50, rel=0.05)
    assert [(round(m.time), m.value) for m in telemetry.messages if m.kind == "armed"] == [(0, 0.0), (44, 1.0)]


@needs_flights
def test_reading_prints_nothing(capfd):
    logs.read(LOG)
    captured = capfd.readouterr()
    assert captured.out == "" and captured.err == ""


@pytest.mark.parametrize("version", [1, 2])
def test_units_and_times_of_both_protocol_versions(version):
    flight = read(Writer(version).flight())
    assert flight.start_us == 5_000_000 and flight.autopilot == "ArduPilot" and flight.vehicle_type == "quadrotor"
    assert flight["motors"].values[0].tolist() == [1500, 1501, 1502, 1503]
    assert np.allclose(flight["accel"].values[0], np.array([10, -20, -1000]) * 9.80665e-3)
    assert np.allclose(flight["gyro"].values[:, 0], 0.01 * np.arange(200), atol=1e-6)
    assert np.allclose(flight["gyro"].time, np.arange(200) / 50, atol=1e-9)
    assert np.allclose((flight["attitude"].values ** 2).sum(axis=1), 1)


@pytest.mark.parametrize("kind, rotors", [(2, 4), (13, 6), (14, 8)])
def test_the_number_of_rotors_follows_the_heartbeat(kind, rotors):
    assert read(Writer().flight(kind=kind)).rotor_count == rotors


def test_ground_stations_and_other_components_are_not_the_vehicle():
    log = Writer()
    log.add("heartbeat", 6, 8, 0, 0, 0, 3, system=255, component=190)  # ground station
    log.add("heartbeat", 26, 8, 0, 0, 0, 3, system=7, component=154)  # gimbal
    log.flight()
    log.add("attitude", 1, 9, 9, 9, 9, 9, 9, system=255, component=190)
    flight = read(log)
    assert flight.start_us == 5_000_000 and np.abs(flight["gyro"].values).max() < 3


def test_no_vehicle_no_flight():
    log = Writer()
    for k in range(10):
        log.add("heartbeat", 6, 8, 0, 0, 0, 3).add("attitude", 100 + k, 0, 0, 0, 0, 0, 0)
    with pytest.raises(LogError, match="heartbeat"):
        read(log)


def test_simulation_parameters_stay_out_and_changes_are_kept():
    log = Writer().flight(samples=20)
    for name, value in ((b"SIM_ENGINE_MUL", 0.5), (b"MOT_THST_EXPO", 0.65), (b"MOT_THST_EXPO", 0.65)):
        log.add("param_value", name, value, 9, 100, 1)
    log.add("param_value", b"MOT_THST_EXPO", 0.5, 9, 100, 1).flight(samples=1)
    flight = read(log)
    assert list(flight.parameters) == ["MOT_THST_EXPO"] and flight.parameters["MOT_THST_EXPO"] == pytest.approx(0.65)
    assert [(n, v) for _, n, v in flight.parameter_changes] == [("MOT_THST_EXPO", 0.5)]


def test_outputs_are_put_in_rotor_order_by_their_functions():
    log = Writer()
    for output, rotor in ((1, 4), (2, 3), (3, 2), (4, 1)):
        log.add("param_value", b"SERVO%d_FUNCTION" % output, 32 + rotor, 9, 100, 1)
    flight = read(log.flight())
    assert flight["motors"].values[0].tolist() == [1503, 1502, 1501, 1500]


def test_px4_sends_whole_numbers_as_their_bytes():
    log = Writer().flight(autopilot=12)
    log.add("param_value", b"CA_ROTOR_COUNT", struct.unpack("<f", struct.pack("<i", 4))[0], 6, 100, 1)
    assert read(log).parameters == {"CA_ROTOR_COUNT": 4.0}


@pytest.mark.parametrize("turns", [1, 2, 5])
def test_the_32_bit_clock_of_the_outputs_may_wrap(turns):
    log = Writer().add("heartbeat", 2, 3, 0x81, 4, 4, 3)
    for k in range(100):
        us = turns * 2**32 - 1_000_100 + 20_000 * k
        log.add("attitude", us // 1000, 0, 0, 0, 0, 0, 0)
        log.add("servo_output_raw", us % 2**32, 0, *[1500] * 8)
    flight = read(log)
    time = flight["motors"].time
    assert flight.start_us == pytest.approx(turns * 2**32 - 1_000_100, abs=1000)
    assert time.size == 100 and time[-1] - time[0] == pytest.approx(1.98) and (np.diff(time) > 0).all()


def test_damaged_frames_are_skipped_and_said():
    log = Writer().flight()
    data = bytearray(log.data)
    rng = np.random.default_rng(3)
    for at in rng.integers(200, len(data), 40):
        data[at] ^= 0x55
    flight = tlog.read(bytes(data), "x.tlog")
    assert 100 < len(flight["gyro"]) < 200 and "damaged" in flight.warnings[0]
    assert set(flight["motors"].values[:, 0]) == {1500.0}


def test_no_value_that_damage_can_make_is_warned_of():
    """Floats that are signalling NaNs and infinities, in all messages that are read."""
    rng, log, sender = np.random.default_rng(0), Writer().flight(100), Sender(1, 1)
    special = [b"\x01\x00\xa0\x7f", b"\x00\x00\x80\x7f", b"\x00\x00\x80\xff", b"\x00\x00\xc0\x7f"]
    for layout in [one for name, one in tlog.layouts().items() if name != "HEARTBEAT"] * 4:
        kind = mavlink_frames.payload_type(layout)
        body = np.frombuffer(b"".join(special[k] for k in rng.integers(0, 4, 80))[: kind.itemsize], kind).copy()
        for name, unit in (("time_boot_ms", 1), ("time_usec", 1000)):
            if name in (kind.names or ()):
                body[name] = unit * int(rng.integers(5000, 7000))
        log.data += struct.pack(">Q", log.stamp) + sender.frame(Outgoing(layout.name, body.tobytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read(log)["motors"]) >= 100


def test_truncation_anywhere_is_read_or_refused(amount):
    data = Writer().flight(samples=30).data
    outcomes = set()
    for end in range(0, len(data), amount(37, 13)):
        try:
            tlog.read(data[:end], "x.tlog")
            outcomes.add("read")
        except LogError:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def test_recognised_by_its_frames():
    data = Writer().flight(samples=5).data
    assert tlog.sniff(data[:4096], "") and not tlog.sniff(bytes(4096), "")
    assert tlog.sniff(b"", "flight.TLOG")


def test_a_plane_is_read_and_named_but_a_multirotor_beside_it_goes_first():
    from rotorwatch import airframes
    from rotorwatch.errors import VehicleError

    plane = read(Writer().flight(kind=1))
    assert plane.facts["mav_type"] == 1
    with pytest.raises(VehicleError, match="fixed-wing"):
        airframes.identify(plane)
    both = Writer().add("heartbeat", 1, 3, 0x81, 4, 4, 3, system=9).flight(kind=2)
    assert read(both).facts["mav_type"] == 2


def global_position(log, ms, **more):
    """GLOBAL_POSITION_INT: relative_alt in mm, velocities in cm/s."""
    f = {"lat": 0, "lon": 0, "alt": 500_000, "relative_alt": 0, "vx": 0, "vy": 0, "vz": 0, "hdg": 0} | more
    log.add("global_position_int", ms, *f.values())


def test_units_of_what_is_sent_in_whole_numbers():
    """Raw rates in mrad/s, accelerations in thousandths of g, cm/s, mm above ground, mV, 0.01 A, percent."""
    log = Writer()
    log.add("heartbeat", 2, 3, 0x81, 4, 4, 3)
    for k in range(20):
        ms = 5000 + 20 * k
        log.add("raw_imu", ms * 1000, 500, -250, 1000, 1500, -250, 125, 0, 0, 0)
        log.add("servo_output_raw", ms * 1000, 0, 1500, 1501, 1502, 1503, 0, 0, 0, 0)
        global_position(log, ms, relative_alt=12_500, vx=150, vy=-250, vz=75)
        log.add("sys_status", 0, 0, 0, 500, 15_800, 1_234, 80, 0, 0, 0, 0, 0, 0)
        log.add("vfr_hud", 0.0, 0.0, 90, 65, 0.0, 0.0)
    flight = read(log)
    assert flight["gyro"].values[3] == pytest.approx([1.5, -0.25, 0.125])
    assert flight["accel"].values[3] == pytest.approx(np.array([0.5, -0.25, 1.0]) * 9.80665)
    assert flight["velocity"].values[3] == pytest.approx([1.5, -2.5, 0.75])
    assert flight["position"].values[3, 2] == pytest.approx(-12.5) and not flight["position"].valid[:, :2].any()
    assert flight["battery"].values[3] == pytest.approx([15.8, 12.34])
    assert flight["throttle"].values[3] == pytest.approx([0.65])
    assert flight["gyro"].time[3] == pytest.approx(0.06)


def test_a_battery_that_is_not_measured_is_not_known():
    """0 and 65535 mV, and -1 for the current."""
    log = Writer().flight(samples=3)
    for volts, amps in ((0, 100), (65_535, 100), (12_000, -1), (12_000, 0)):
        log.add("sys_status", 0, 0, 0, 500, volts, amps, 80, 0, 0, 0, 0, 0, 0)
    battery = read(log)["battery"]
    assert battery.valid.tolist() == [[False, True], [False, True], [True, False], [True, True]]


def test_a_battery_of_which_only_the_cells_are_sent():
    """BATTERY_STATUS of MAVLink: mV and 0.01 A, 65535 for a cell that is not there, -1 for an unknown current. A voltage that no cell's
    field can hold is 65534 in the first and the rest of it in the second."""
    log = Writer().flight(samples=3)
    for cells, amps in (([4_000, 3_900, 3_800], 1_250), ([65_534, 34_466], 0), ([], -1)):
        volts = cells + [65_535] * (10 - len(cells))
        log.add("battery_status", 0, 0, 0, 0, volts, amps, 0, 0, 80)
    battery = read(log)["battery"]
    assert battery.valid.tolist() == [[True, True], [True, True], [False, False]]
    assert battery.values[:2] == pytest.approx(np.array([[11.7, 12.5], [100.0, 0.0]]))


def test_an_output_that_drives_nothing_gives_no_command():
    """It is sent as 0, and is a gap in its own column only."""
    log = Writer()
    log.add("heartbeat", 2, 3, 0x81, 4, 4, 3)
    for k in range(20):
        log.add("attitude", 5000 + 20 * k, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
        outputs = [1500.0, 1501.0, 1502.0 if k else 0.0, 1503.0]
        log.add("actuator_output_status", (5000 + 20 * k) * 1000, 4, outputs + [0.0] * 28)
    motors = read(log)["motors"]
    assert motors.source == "ACTUATOR_OUTPUT_STATUS"
    assert motors.valid[:2].tolist() == [[True, True, False, True], [True] * 4]


def test_the_start_in_utc_is_what_the_autopilot_says_else_when_the_ground_station_heard_it():
    log = Writer().flight(samples=40)
    heard = read(log).facts["utc_start"]
    assert heard.startswith("2023-11-14T22:13:2")  # the stamps of the file begin at 1.7e9 s
    for k in range(8):
        log.add("system_time", 1_600_000_000_000_000 + 1_000_000 * k, 5000 + 1000 * k)
    assert read(log).facts["utc_start"] == "2020-09-13T12:26:40.000Z"


def test_arming_modes_and_landing_become_messages():
    log = Writer()
    for armed, mode in ((0, 5), (0x80, 5), (0x80, 9), (0, 9)):
        log.flight(samples=3)
        log.add("heartbeat", 2, 3, 1 | armed, mode, 4, 3)
        log.add("extended_sys_state", 0, 2 if armed else 1)
        log.add("statustext", 3 if armed else 6, b"words")
    said = [(m.kind, m.text, m.value) for m in read(log).messages]
    states = [m[1:] for m in said if m[0] == "armed"]
    assert states == [("armed", 1.0), ("disarmed", 0.0), ("armed", 1.0), ("disarmed", 0.0)]
    assert [m[1] for m in said if m[0] == "mode"] == [*("GUIDED", "LOITER") * 2, *("GUIDED", "LAND") * 2]
    assert [m[1] for m in said if m[0] == "landed"] == ["landed", "in the air", "landed"]
    assert [m[0] for m in said if m[1] == "words"] == ["text", "error", "error", "text"]


def test_modes_of_other_autopilots_are_named_or_numbered():
    for autopilot, number, name in ((12, 4 << 16 | 5 << 24, "Return"), (12, 3 << 16, "Position"), (12, 77 << 16, "mode 5046272"),
                                    (3, 99, "mode 99"), (4, 5, "mode 5")):  # fmt: skip
        log = Writer().flight(samples=4, autopilot=autopilot)
        log.add("heartbeat", 2, autopilot, 0x81, number, 4, 3)
        assert [m.text for m in read(log).messages if m.kind == "mode"][-1] == name


def test_the_gps_is_read_in_metres_from_its_first_fix():
    """One ten-thousandth of a degree at 60 degrees north: 11.14 m to the north, 5.58 m to the east (WGS 84)."""
    log = Writer().flight(samples=40)
    for k, (fix, north, east) in enumerate([(0, 0, 0), (3, 600_000_000, 100_000_000), (3, 600_001_000, 100_001_000)]):
        log.add("gps_raw_int", (6000 + 200 * k) * 1000, fix, north, east, 70_000 + 500 * k, 100, 100, 320, 0, 9)
    gps = read(log)["gps"]
    assert gps.source == "GPS_RAW_INT" and gps.valid[:, 0].tolist() == [False, True, True]
    assert gps.values[1] == pytest.approx([0.0, 0.0, 0.0, 3.2]) and gps.values[2, 3] == pytest.approx(3.2)
    assert gps.values[2, :3] == pytest.approx([11.141, 5.580, -0.5], abs=0.002)
    log = Writer().flight(samples=40)
    for k, east in enumerate((1_799_999_000, 1_800_000_000, -1_799_999_000)):
        log.add("global_position_int", 6000 + 200 * k, -600_000_000, east, 0, 0, 300, 400, 0, 0)
    far = read(log)["gps"]
    assert far.values[:, 3] == pytest.approx(5.0) and far.values[2, 1] == pytest.approx(11.16, abs=0.01), "across the date line"


@needs_flights
def test_gps_and_estimate_of_a_flight_agree():
    flight = logs.read(LOG)
    gps, position = flight["gps"], flight["position"]
    late = gps.time > 50.0
    down = np.interp(gps.time[late], position.time, position.values[:, 2])
    apart = gps.values[late, 2] - down
    assert np.std(apart) < 0.5 and np.abs(gps.values[late, :2]).max() < 2.0
    assert [m.text for m in flight.messages if m.kind == "mode"] == ["STABILIZE", "GUIDED"]


def test_a_head_that_ends_where_the_second_frame_would_begin_is_believed():
    data = Writer().flight(samples=5).data
    first = 8 + 12 + data[9]
    for more in (7, 8, 9):
        assert tlog.sniff(data[: first + more], "")
    wrong = bytearray(data[: first + 40])
    wrong[first + 8] = 0
    assert not tlog.sniff(bytes(wrong), "")


def px4(**parameters):
    """A telemetry log of PX4 that calls itself a quadrotor; outputs 1 to 8 move, each about its own middle."""
    log = Writer()
    log.add("heartbeat", 2, 12, 0x81, 0, 4, 3)
    for name, value in parameters.items():
        log.add("param_value", name.encode(), struct.unpack("<f", struct.pack("<i", value))[0], 6, len(parameters), 0)
    for k in range(300):
        ms = 5000 + 20 * k
        log.add("attitude", ms, 0, 0, 0.1, 0, 0, 0)
        log.add("servo_output_raw", ms * 1000, 0, *(1200 + 50 * n + k % 150 for n in range(8)))
    return read(log)


def functions(driver, *motors):
    return {f"{driver}_FUNC{n}": 100 + k for n, k in enumerate(motors, 1)}


@pytest.mark.parametrize("driver", ["PWM_MAIN", "PWM_AUX", "HIL_ACT"])
def test_outputs_of_px4_are_put_in_rotor_order_by_their_functions(driver):
    flight = px4(CA_ROTOR_COUNT=4, **functions(driver, 3, 2, 1, 4))
    assert flight["motors"].values[0].tolist() == [1300.0, 1250.0, 1200.0, 1350.0]
    assert flight.facts["outputs"] == (3, 2, 1, 4) and flight["motors"].unit == "us"


def test_the_rotors_of_px4_are_counted_by_its_parameters():
    assert px4(CA_ROTOR_COUNT=6).rotor_count == 6
    assert px4(**functions("PWM_MAIN", 1, 2, 3, 4, 5, 6)).rotor_count == 6
    unknown = px4()  # no parameter at all: those count that move
    assert unknown.rotor_count == 8 and any("rotor k was taken to be output k" in w for w in unknown.warnings)


def test_limits_of_pulses_are_those_of_the_outputs_that_drive_motors():
    limits = {f"PWM_MAIN_MIN{n}": v for n, v in ((1, 900), (5, 1100), (6, 1100), (7, 1100), (8, 1100))}
    flight = px4(CA_ROTOR_COUNT=4, **limits, **{f"PWM_MAIN_FUNC{4 + k}": 100 + k for k in range(1, 5)})
    assert flight["motors"].values[0].tolist() == [1400.0, 1450.0, 1500.0, 1550.0]
    assert flight.facts["pwm_min"] == 1100.0


def test_counts_of_a_can_bus_are_shares():
    flight = px4(CA_ROTOR_COUNT=4, UAVCAN_EC_MIN1=1000, UAVCAN_EC_MAX1=2000, **functions("UAVCAN_EC", 1, 2, 3, 4))
    assert flight["motors"].unit == "1"
    assert flight["motors"].values[0].tolist() == pytest.approx([0.2, 1250 / 8191, 1300 / 8191, 1350 / 8191])


def test_the_next_frame_is_found_in_time_that_grows_with_the_log():
    """A frame seems to begin at every second byte, and none is followed by another."""
    flight = Writer().flight(samples=20).data
    before = time.process_time()
    frames = mavlink_frames.Frames(flight + b"\xfe\x01" * 700_000 + flight, range(256))
    assert time.process_time() - before < 1.0
    assert frames.count == 2 * 61 and 1_399_990 < frames.skipped <= 1_400_000
