"""PX4 logs: ULog through pyulog, ulog2csv tables, and the topics of old and new releases."""

import time
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import logs
from rotorwatch.errors import LogError
from rotorwatch.flight import Flight
from rotorwatch.logs import px4_outputs, px4_reports, px4_topics, series, ulog

FLIGHTS = Path(__file__).parents[2] / "shared" / "flights"
pytestmark = pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the folder of test flights, ../shared/flights, is missing")
REFERENCE = FLIGHTS / "corrupt" / "intact_reference.ulg"


@pytest.fixture(scope="module")
def events() -> Flight:
    return logs.read(FLIGHTS / "px4-pyulog" / "sample_px4_events.ulg.xz")


def test_new_px4_gives_motors_in_shares_and_esc_telemetry(events):
    motors = events["motors"]
    assert motors.unit == "1" and motors.source == "actuator_motors" and motors.columns == ("r1", "r2", "r3", "r4")
    assert 9.5 < motors.rate_hz < 10.5 and 0.5 < motors.values.max() < 0.6
    assert events["gyro"].source == "sensor_combined" and events["gyro"].rate_hz == pytest.approx(250, rel=0.02)
    assert events["rates"].source == "vehicle_angular_velocity"
    esc = events["esc"]
    assert esc.columns[:5] == ("speed1", "speed2", "speed3", "speed4", "current1") and esc.unit == "rad/s,A,V,degC"
    assert esc.values[:, :4].max() == pytest.approx(3324 * np.pi / 30)
    assert not events["battery"].valid[:, 1].any()  # logged as -1: no current sensor
    assert events["control"].values[:, 3].max() == pytest.approx(0.552, abs=0.001)


def test_state_changes_become_messages(events):
    armed = [(round(m.time, 1), m.value) for m in events.messages if m.kind == "armed"]
    landed = [(round(m.time, 1), m.value) for m in events.messages if m.kind == "landed"]
    assert armed == [(0.0, 0.0), (14.9, 1.0), (30.1, 0.0)]
    assert landed == [(0.0, 1.0), (16.7, 0.0), (28.1, 1.0)]
    assert [m.text for m in events.messages if m.kind == "mode"][1] == "Takeoff"
    assert any("Disarmed by landing" in m.text for m in events.messages if m.kind == "text")


def test_old_px4_gives_pulses_with_limits_and_dropouts():
    flight = logs.read(FLIGHTS / "px4-pyulog" / "sample.ulg.xz")
    assert flight["motors"].unit == "us" and flight.rotor_count == 4
    assert flight.facts["pwm_min"] == 1075 and flight.facts["pwm_max"] == 1950
    assert flight["rates"].source == "vehicle_attitude"
    assert [m.value for m in flight.messages if m.kind == "dropout"] == [0.026, 0.031, 0.062]


def test_the_fault_topic_and_ground_truth_are_never_decoded(monkeypatch):
    import pyulog

    asked = []
    real = pyulog.ULog

    def spy(file, **options):
        asked.append(options)
        return real(file, **options)

    monkeypatch.setattr(pyulog, "ULog", spy)
    flight = logs.read(FLIGHTS / "px4-rflymad" / "TestCase_4_1000000003.ulg.xz")
    names = [n for o in asked for n in o.get("message_name_filter_list", [])]
    assert set(names) == {*px4_topics.TOPICS, *px4_topics.RAW, px4_reports.EVENTS} and all(
        o.get("parse_header_only") or names for o in asked
    )
    assert "rfly_ctrl_lxl" not in names and not [n for n in names if "groundtruth" in n]
    assert flight.vehicle_type == "quadrotor" and flight.parameter_changes[0][1] == "COM_RCL_EXCEPT"


@pytest.mark.parametrize("degrees", [False, True])
def test_the_gps_of_old_and_new_releases_in_metres(degrees):
    stamp = np.arange(4) * 200_000
    north, east, up = (np.array([46.0, 47.0, 47.0001, 47.0]), np.array([7.0, 8.0, 8.0, 8.0001]), np.array([0, 400.0, 410.0, 400.0]))
    names = ("latitude_deg", "longitude_deg", "altitude_msl_m") if degrees else ("lat", "lon", "alt")
    units = (1.0, 1.0, 1.0) if degrees else (1e7, 1e7, 1e3)
    place = {n: v if degrees else np.rint(v * u).astype(np.int32) for n, v, u in zip(names, (north, east, up), units)}
    table = {"timestamp": stamp, **place, "vel_m_s": np.full(4, 2.5), "fix_type": np.array([1, 3, 3, 4])}
    found, _ = px4_topics.signals(px4_topics.Topics({("vehicle_gps_position", 0): table}, 0), {})
    assert found["gps"].valid[:, 0].tolist() == [False, True, True, True]
    assert found["gps"].values[2] == pytest.approx([11.118, 0.0, -10.0, 2.5], abs=0.01)
    assert found["gps"].values[3] == pytest.approx([0.0, 7.604, 0.0, 2.5], abs=0.01)


def test_every_topic_that_is_read_is_loaded(monkeypatch):
    """A topic that is missing in TOPICS would never come from a ULog, whatever the log holds."""
    read, real = set(), px4_topics.Topics.table

    def spy(self, name, *fields, **options):
        read.add(name)
        return real(self, name, *fields, **options)

    monkeypatch.setattr(px4_topics.Topics, "table", spy)
    flight = logs.read(FLIGHTS / "px4-rflymad" / "TestCase_4_1000000003.ulg.xz")
    assert read <= set(px4_topics.TOPICS), read - set(px4_topics.TOPICS)
    assert flight["rates_wanted"].source == "vehicle_rates_setpoint"


def test_gaps_of_not_a_number_are_masked_rows():
    flight = logs.read(FLIGHTS / "corrupt" / "nan_motor_outputs.ulg")
    motors = flight["motors"]
    assert motors.values.shape == (61, 4) and not motors.valid.all(axis=1)[25:30].all()
    assert 0.6 < motors.valid.mean() < 0.7 and np.isfinite(motors.values).all()


def test_a_cut_log_is_read_and_said():
    whole, cut = (logs.read(FLIGHTS / "corrupt" / f) for f in ("intact_reference.ulg", "truncated_mid_message.ulg"))
    n = len(cut["gyro"])
    assert n < len(whole["gyro"]) and np.array_equal(cut["gyro"].values, whole["gyro"].values[:n])
    assert whole.warnings == () and "middle of a record" in cut.warnings[0]


def test_the_name_does_not_matter():
    flight = logs.read(FLIGHTS / "corrupt" / "ulog_with_wrong_extension.bin")
    assert flight.format == ulog.FORMAT and flight.name == "ulog_with_wrong_extension.bin"


def outcome(data) -> str:
    """'read', or the sentence of the LogError; anything else fails the test."""
    begin = time.perf_counter()
    try:
        module = logs.recognise(bytes(data[: logs.HEAD]), "x.ulg")
        if module is None:
            return "unknown"
        flight = logs._checked(lambda: module.read(data, "x.ulg"), module, Path("x.ulg"), ())
        assert all(np.isfinite(s.values).all() and (np.diff(s.time) >= 0).all() for s in flight.signals.values())
        assert flight.duration < 1e6
        return "read"
    except LogError as error:
        assert "\n" not in str(error)
        return str(error)
    finally:
        assert time.perf_counter() - begin < 5


def test_truncation_anywhere_is_read_or_refused(amount):
    data = REFERENCE.read_bytes()
    outcomes = [outcome(data[:end]) for end in range(1, len(data), amount(839, 337))]
    assert outcomes[-1] == "read" and outcomes.count("read") > 10


def test_random_damage_is_read_or_refused(capfd, amount):
    data = REFERENCE.read_bytes()
    rng = np.random.default_rng(7)
    outcomes = []
    for _ in range(amount(60, 150)):
        hurt = np.frombuffer(data, np.uint8).copy()
        # Half of the damage in the definitions, where it does most.
        where = rng.integers(0, rng.choice([3000, 30_000, hurt.size]), rng.integers(1, 30))
        hurt[where] = rng.integers(0, 256, where.size)
        outcomes.append(outcome(hurt.tobytes()))
    assert outcomes.count("read") > len(outcomes) / 3
    assert capfd.readouterr().out == ""


def definitions(*lines: bytes) -> bytes:
    head = b"ULog\x01\x12\x35\x01" + (1000).to_bytes(8, "little")
    return head + b"".join(len(x).to_bytes(2, "little") + b"F" + x for x in lines)


@pytest.mark.parametrize(
    "lines",
    [
        [b"a:uint64_t timestamp;a inner;"],
        [b"a:uint64_t timestamp;b[9] x;", b"b:a[9] y;"],
        [b"a:uint64_t timestamp;b[60000] x;", b"b:c[60000] y;", b"c:float[60000] z;"],
    ],
)
def test_definitions_that_would_eat_all_memory_are_refused(lines):
    subscribe = b"\0\1\0a"
    data = definitions(*lines) + len(subscribe).to_bytes(2, "little") + b"A" + subscribe
    with pytest.raises(LogError, match="definitions"):
        ulog.read(data, "x.ulg")


def test_a_parser_in_circles_meets_the_end_of_the_file():
    file = ulog._File(bytes(1000))
    reads = 0
    while file.read(3):
        file.seek(0)
        reads += 1
    assert reads <= ulog._CIRCLES + 10
    with pytest.raises(ValueError):
        file.seek(-5)


@pytest.mark.parametrize("stamp", [0, 2**63 - 1, 10**17])
def test_a_damaged_start_time_falls_back_on_the_data(stamp):
    data = bytearray(REFERENCE.read_bytes())
    data[8:16] = stamp.to_bytes(8, "little")
    flight = ulog.read(bytes(data), "x.ulg")
    assert "start time" in flight.warnings[0] and 17 < flight.duration < 19 and flight.has("motors", "gyro")


# Topics of releases that no test flight has


def topics(**tables) -> px4_topics.Topics:
    """Topics from name=(n rows at 10 Hz, fields)."""
    out = {}
    for name, fields in tables.items():
        base, _, instance = name.partition("__")
        n = len(next(iter(fields.values())))
        stamp = np.arange(n, dtype=np.uint64) * 100_000 + 1_700_000_000_000_000
        out[base, int(instance or 0)] = {"timestamp": stamp, **{k: np.asarray(v) for k, v in fields.items()}}
    return px4_topics.Topics(out, 1_700_000_000_000_000)


def outputs(*levels, n=50):
    """output[0..15], each swinging by 100 us round its level; level 0: unused."""
    wave = 100 * np.sin(np.arange(n) / 5)
    columns = [level + wave if level else np.zeros(n) for level in (*levels, *[0] * (16 - len(levels)))]
    return {f"output[{k}]": c for k, c in enumerate(columns)}


def test_outputs_are_put_in_rotor_order_by_their_functions():
    found, _ = px4_topics.signals(
        topics(actuator_outputs=outputs(1500, 1400, 1300, 1200)),
        {"PWM_MAIN_FUNC1": 104, "PWM_MAIN_FUNC2": 103, "PWM_MAIN_FUNC3": 102, "PWM_MAIN_FUNC4": 101, "CA_ROTOR_COUNT": 4},
    )
    assert np.allclose(found["motors"].values.mean(axis=0), [1200, 1300, 1400, 1500], atol=20)
    assert found["motors"].source == "actuator_outputs" and found["motors"].unit == "us"


def test_the_instance_that_moves_has_the_motors():
    still = {k: v * 0 + 1500 for k, v in outputs(1500, 1500, 1500, 1500).items()}
    found, _ = px4_topics.signals(topics(actuator_outputs=still, actuator_outputs__1=outputs(1400, 1400, 1400, 1400)), {"MAV_TYPE": 2})
    assert found["motors"].source == "actuator_outputs[1]" and np.ptp(found["motors"].values) > 100


@pytest.mark.parametrize("low, high", [(0.0, 1.0), (-1.0, 1.0)])
def test_scaled_simulator_outputs_become_shares(low, high):
    share = 0.5 + 0.3 * np.sin(np.arange(50) / 5)
    fields = {f"output[{k}]": low + (high - low) * share for k in range(4)} | {"output[4]": np.zeros(50)}
    if low < 0:
        fields = {k: np.where(np.arange(50) < 5, low, v) if k != "output[4]" else v for k, v in fields.items()}
    found, _ = px4_topics.signals(topics(actuator_outputs=fields), {"MAV_TYPE": 2})
    assert found["motors"].unit == "1" and found["motors"].values.shape == (50, 4)
    assert np.allclose(found["motors"].values[10:, 0], share[10:])


def test_per_output_limits_win_over_common_ones():
    tables = topics(actuator_outputs=outputs(1500, 1500, 1500, 1500))
    old = px4_topics.signals(tables, {"MAV_TYPE": 2, "PWM_MIN": 1075, "PWM_MAX": 1950})[1]
    new = px4_topics.signals(tables, {"MAV_TYPE": 2, "PWM_MAIN_MIN1": 1100, "PWM_MAIN_MAX1": 1900, "PWM_MIN": 1075})[1]
    assert (old["pwm_min"], old["pwm_max"]) == (1075, 1950) and (new["pwm_min"], new["pwm_max"]) == (1100, 1900)


def counts(*levels, n=400, full=8191.0, off=20):
    """output[0..15] as counts of a bus: `off` samples without command, then a share of `full` that swings by a tenth."""
    wave = 0.1 * np.sin(np.arange(n) / 5 + np.arange(len(levels))[:, None])
    columns = [np.where(np.arange(n) < off, 0.0, full * (level + w)) for level, w in zip(levels, wave)]
    return {f"output[{k}]": c for k, c in enumerate([*columns, *[np.zeros(n)] * (16 - len(levels))])}


def test_uavcan_counts_are_shares_of_8191_and_their_instance_has_the_motors():
    """Three drivers publish: unused outputs, UAVCAN with two idle channels, and pulses of servos that hardly move."""
    can = counts(0.6, 0.55, 0.5, 0.45)
    can |= {"output[4]": np.full(400, 4095.5), "output[5]": np.full(400, 4095.5)}
    servos = {f"output[{k}]": np.full(400, 1500.0) for k in range(6)}
    unused = {f"output[{k}]": np.zeros(400) for k in range(16)}
    tables = topics(actuator_outputs=unused, actuator_outputs__1=can, actuator_outputs__2=servos)
    found, facts = px4_topics.signals(tables, {"MAV_TYPE": 2, "UAVCAN_ENABLE": 3})
    motors = found["motors"]
    assert motors.source == "actuator_outputs[1]" and motors.unit == "1" and motors.values.shape == (400, 4)
    assert np.allclose(motors.values[20:].mean(axis=0), [0.6, 0.55, 0.5, 0.45], atol=0.01)
    assert facts["motors_scaled"] == "UAVCAN" and any("8191" in note for note in tables.notes)


def test_uavcan_outputs_have_their_order_and_ends_from_the_parameters():
    """Two CAN outputs of four are exchanged, and 110 to 8082 is the range; pulses on the main outputs are a gimbal's."""
    ends = {f"UAVCAN_EC_MIN{k}": 110 for k in range(1, 5)} | {f"UAVCAN_EC_MAX{k}": 8082 for k in range(1, 5)}
    functions = {f"UAVCAN_EC_FUNC{k}": v for k, v in zip(range(1, 5), (102, 101, 103, 104))}
    can = {k: np.where(v > 0, 110 + v / 8191 * (8082 - 110), 0.0) for k, v in counts(0.6, 0.5, 0.4, 0.3).items()}
    tables = topics(actuator_outputs=outputs(1500, 1500, 1500, 1500, n=400), actuator_outputs__1=can)
    motors = px4_topics.signals(tables, {"CA_ROTOR_COUNT": 4, **ends, **functions})[0]["motors"]
    assert motors.source == "actuator_outputs[1]"
    assert np.allclose(motors.values[20:].mean(axis=0), [0.5, 0.6, 0.4, 0.3], atol=0.01)


def test_counts_that_look_like_pulses_are_reported_by_the_parameters():
    """A light vehicle flies UAVCAN at 1300 to 2300 counts; without the parameters such values are pulses."""
    tables = topics(actuator_outputs=counts(0.22, 0.22, 0.22, 0.22, off=0, full=8191.0))
    light = {k: np.where(v > 0, 1800 + (v - v.mean()) * 0.5, 0.0) for k, v in tables.tables["actuator_outputs", 0].items()}
    light["timestamp"] = tables.tables["actuator_outputs", 0]["timestamp"]
    tables.tables["actuator_outputs", 0] = light
    functions = {f"UAVCAN_EC_FUNC{k}": 100 + k for k in range(1, 5)}
    assert px4_topics.signals(tables, {"MAV_TYPE": 2})[0]["motors"].unit == "us"
    motors = px4_topics.signals(tables, {"MAV_TYPE": 2, **functions})[0]["motors"]
    assert motors.unit == "1" and motors.values.mean() == pytest.approx(1800 / 8191, rel=0.02)


def test_dshot_counts_are_shares_of_1999_and_65535_is_no_command():
    fields = counts(0.5, 0.5, 0.4, 0.4, full=1999.0)
    fields = {k: np.where((np.arange(400) < 20) & (v.max() > 0), 65535.0, v) for k, v in fields.items()}
    tables = topics(actuator_outputs=fields)
    motors = px4_topics.signals(tables, {"MAV_TYPE": 2, "DSHOT_CONFIG": 600})[0]["motors"]
    assert motors.unit == "1" and not motors.values[:20].any()
    assert np.allclose(motors.values[20:].mean(axis=0), [0.5, 0.5, 0.4, 0.4], atol=0.01)


def test_one_damaged_value_does_not_change_the_unit():
    for unit, fields in (("us", outputs(1500, 1400, 1300, 1200, n=400)), ("1", counts(0.6, 0.5, 0.5, 0.5))):
        fields["output[1]"][77] = 3e8
        motors = px4_topics.signals(topics(actuator_outputs=fields), {"MAV_TYPE": 2})[0]["motors"]
        assert motors.unit == unit and (~motors.valid).sum() == 1


def test_a_uavcan_flight_is_assessed():
    path = FLIGHTS / "wild" / "uavcan-1.ulg.xz"
    if not path.is_file():
        pytest.skip("this flight is missing")
    flight = logs.read(path)
    assert flight["motors"].source == "actuator_outputs[1]" and flight.rotor_count == 4
    hover = flight["motors"].between(15, 25).values
    assert 0.3 < hover.mean() < 0.7 and hover.std(axis=0).min() > 0.003


def test_a_failed_motor_is_a_gap_in_its_column_only():
    values = np.full((50, 12), np.nan)
    values[:, :6] = 0.5
    values[20:, 2] = np.nan
    fields = {f"control[{k}]": values[:, k] for k in range(12)}
    motors = px4_topics.signals(topics(actuator_motors=fields), {"CA_ROTOR_COUNT": 6})[0]["motors"]
    assert motors.values.shape == (50, 6) and motors.valid[:, 2].sum() == 20 and motors.valid[:, 0].all()


@pytest.mark.parametrize(
    "fields, kind", [({"system_type": 1}, 1), ({"is_vtol": 1, "vehicle_type": 1}, 22), ({"vehicle_type": 3}, 10), ({}, None)]
)
def test_the_vehicle_status_says_what_kind_of_vehicle_it_is(fields, kind):
    status = {k: np.full(9, v) for k, v in {"arming_state": 2, "is_vtol": 0, "vehicle_type": 1, **fields}.items()}
    assert px4_topics.signals(topics(vehicle_status=status), {})[1].get("mav_type") == kind


def test_esc_telemetry_follows_the_actuator_functions():
    fields = {}
    for i, function in enumerate((103, 101, 102)):
        fields |= {f"esc[{i}].esc_rpm": np.full(9, 1000 * function), f"esc[{i}].esc_current": np.full(9, float(i))}
        fields |= {f"esc[{i}].actuator_function": np.full(9, function)}
    esc = px4_topics.signals(topics(esc_status=fields), {"CA_ROTOR_COUNT": 3})[0]["esc"]
    assert esc.columns == tuple(f"{q}{k}" for q in ("speed", "current", "voltage", "temperature") for k in (1, 2, 3))
    assert esc.values[0, :6] == pytest.approx([*(np.array([101, 102, 103]) * 100 * np.pi / 3), 1, 2, 0])
    assert esc.valid[0].tolist() == [True] * 6 + [False] * 6  # no voltage, no temperature


def test_times_count_from_the_start_in_exact_microseconds():
    table = topics(vehicle_angular_velocity={f"xyz[{k}]": np.zeros(30) for k in range(3)})
    rates = px4_topics.signals(table, {})[0]["rates"]
    assert np.allclose(rates.time, np.arange(30) / 10, atol=1e-9, rtol=0)


# ulog2csv


def test_a_folder_of_tables_is_one_flight():
    flight = logs.read(FLIGHTS / "px4-ulogassessment")
    assert flight["motors"].columns == ("r1", "r2", "r3", "r4") and 1500 < np.median(flight["motors"].values) < 1700
    assert {"gyro", "accel", "attitude", "battery"} <= set(flight.signals)
    assert flight["gyro"].rate_hz == pytest.approx(50, rel=0.02)


def test_one_table_alone_reads_too():
    path = next((FLIGHTS / "px4-ulogassessment").glob("*angular_velocity*"))
    flight = logs.read(path)
    assert set(flight.signals) == {"gyro", "rates"}


def test_tables_of_two_logs_are_refused(tmp_path):
    for log in ("one", "two"):
        (tmp_path / f"{log}_battery_status_0.csv").write_text("timestamp,voltage_v,current_a\n1,12,1\n")
    with pytest.raises(LogError, match="2 logs"):
        logs.read(tmp_path)


# Damaged time


def test_one_wild_stamp_costs_one_sample():
    t = np.arange(100) / 10.0
    t[40], t[60] = 1e9, 0.0
    assert series.steady(t).tolist() == [k for k in range(100) if k not in (40, 60)]


def test_time_set_back_never_gives_a_negative_step():
    t = np.r_[np.arange(60) / 10.0, np.arange(30, 70) / 10.0]
    kept = t[series.steady(t)]
    assert (np.diff(kept) >= 0).all() and kept.size >= 70


def test_a_jump_of_years_keeps_the_longer_side():
    t = np.r_[np.arange(90) / 10.0, 1e9 + np.arange(10) / 10.0]
    assert series.steady(t).tolist() == list(range(90))


def test_a_message_of_as_many_fields_as_are_allowed_is_read_and_one_more_is_damage():
    """Fields of nested messages count as often as they are in it."""

    def check(inner, outer):
        fields = [("float", 0, f"f{k}") for k in range(inner)]
        ulog._check_definitions({"in": fields, "out": [("in", outer, "x"), ("uint64_t", 0, "timestamp")]})

    most = ulog._MOST_FIELDS
    check(3, (most - 1) // 3)
    with pytest.raises(LogError, match="definitions"):
        check(3, (most - 1) // 3 + 1)


def test_progress_of_reading_is_reported():
    seen = []
    file = ulog._File(bytes(300_000), seen.append)
    while file.read(1000):
        pass
    assert seen == sorted(seen) and 0.5 < seen[0] < 1.0 and seen[-1] == 1.0


@pytest.mark.parametrize("volts, amps, valid", [(0.0, 3.0, [False, True]), (15.8, -1.0, [True, False]), (15.8, 0.0, [True, True])])
def test_a_battery_that_is_not_measured_is_not_known(volts, amps, valid):
    fields = {"voltage_v": np.full(20, volts), "current_a": np.full(20, amps)}
    battery = px4_topics.signals(topics(battery_status=fields), {})[0]["battery"]
    assert battery.valid[0].tolist() == valid


def test_the_publisher_of_the_first_sample_is_known_from_where_both_have_been_seen():
    """It is the one at rest. Then the other sends three times on end, and from there on they take turns."""
    resting = np.array([0, *range(4, 100, 2)])
    values = np.full((100, 4), 1500.0)
    values[resting] = 1000.0
    flying, rest = px4_outputs.tracks(values, 10.0)
    assert rest.tolist() == resting.tolist() and flying.tolist() == sorted({*range(100)} - {*resting.tolist()})


def reported(**tables):
    """What PX4 reports, of topics {name: {field: values}} with a sample each second."""
    made = {}
    for name, fields in tables.items():
        n = len(next(iter(fields.values())))
        made[name, 0] = {"timestamp": np.arange(n) * 1_000_000, **{k: np.asarray(v) for k, v in fields.items()}}
    return px4_topics.messages(px4_topics.Topics(made, 0))


def test_flags_count_where_they_rise_in_flight():
    flags = {"manual_control_signal_lost": [1, 1, 0, 1], "local_position_invalid": [1, 1, 1, 1], "fd_motor_failure": [0, 0, 1, 1]}
    said = [(m.time, m.text) for m in reported(failsafe_flags=flags)]
    assert sorted(said) == [(2.0, "failure detector: motor"), (3.0, "manual control lost")]


def test_the_failure_detector_speaks_once_though_two_topics_hold_it():
    own, status = {"fd_roll": [0, 0, 1]}, {"failure_detector_status": [0, 1, 1]}
    assert [(m.time, m.text) for m in reported(vehicle_status=status)] == [(1.0, "failure detector: attitude (roll)")]
    both = reported(vehicle_status=status, failure_detector_status=own)
    assert [(m.time, m.text) for m in both] == [(2.0, "failure detector: attitude (roll)")]


def test_batteries_failsafes_and_who_disarmed():
    battery = {"warning": [0, 1, 2, 0], "voltage_v": [16.0] * 4, "current_a": [9.0] * 4}
    assert [m.text for m in reported(battery_status=battery)] == ["battery warning: low", "battery warning: critical"]
    status = {"failsafe": [0, 1, 1, 0], "arming_state": [2, 2, 1, 1], "latest_disarming_reason": [0, 0, 9, 9]}
    said = [(m.time, m.text) for m in reported(vehicle_status=status) if m.kind == "event"]
    assert said == [(1.0, "failsafe begins"), (2.0, "disarmed: kill switch")]
    landed = {**status, "latest_disarming_reason": [0, 0, 7, 7]}
    assert not [m for m in reported(vehicle_status=landed) if m.text.startswith("disarmed:")]


def test_events_are_reported_in_the_words_that_the_log_carries():
    flight = logs.read(FLIGHTS / "wild" / "healthy-real-4.ulg.xz")
    assert any(m.text == "Failsafe warning:" and abs(m.time - 68.15) < 0.1 for m in flight.messages)
    without = logs.read(FLIGHTS / "open" / "px4_q28_esc_m3_dead.ulg.xz")
    assert any(m.text == "failure detector: motor" for m in without.messages)


def test_instances_that_are_counted_from_one():
    """A logger that numbers instances from 1: the lowest is taken for the first."""
    stamp = np.arange(0, 10_000_000, 10_000)
    fields = {"timestamp": stamp, **{f"gyro_rad[{k}]": np.sin(stamp * 1e-6 + k) for k in range(3)}}
    topics = px4_topics.Topics({("sensor_combined", 1): fields, ("sensor_combined", 2): {}}, 0)
    found, _ = px4_topics.signals(topics, {})
    assert found["gyro"].values.shape == (len(stamp), 3)


@pytest.mark.parametrize("log", ["px4-rflymad/TestCase_4_1000000003.ulg.xz", "wild/rflymad-hil-1.ulg.xz"])
def test_outputs_of_an_old_quad_follow_from_what_its_controller_asked_for(log, monkeypatch):
    """A straight line and one with THR_MDL_FAC .3: what is computed is what the same log holds."""
    logged = logs.read(FLIGHTS / log)
    held = px4_topics.Topics.table
    monkeypatch.setattr(
        px4_topics.Topics,
        "table",
        lambda self, name, *fields, **how: None if name == "actuator_outputs" else held(self, name, *fields, **how),
    )
    computed = logs.read(FLIGHTS / log)
    motors = computed["motors"]
    assert motors.source == "actuator_controls_0" and motors.unit == "1" and computed.rotor_count == 4
    assert any("computed by the quad's mixer" in note for note in computed.warnings)
    at = np.searchsorted(motors.time, logged["motors"].time, side="right") - 1
    free = (at >= 0) & (np.abs(motors.values[at] - 0.5) < 0.45).all(axis=1)  # away from the limits
    both = 1000.0 + 1000.0 * motors.values[at][free], logged["motors"].values[free]
    assert free.sum() > 200 and np.nanquantile(np.abs(both[0] - both[1]), 0.95) < 1.0


def test_outputs_are_computed_of_known_quads_alone():
    control = np.array([[0.1, 0.0, 0.0, 0.5], [0.0, 0.1, 0.0, 0.5], [0.0, 0.0, 0.1, 0.5], [0.0, 0.0, 0.0, 1.2]])
    x, plus = (px4_outputs.mixed(control, {"SYS_AUTOSTART": start}) for start in (4001, 5001))
    assert x[0] == pytest.approx([0.429, 0.571, 0.571, 0.429], abs=1e-3)  # to the right: more thrust on the left
    assert plus[1] == pytest.approx([0.5, 0.5, 0.6, 0.4]) and x[2] == pytest.approx([0.6, 0.6, 0.4, 0.4])
    assert x[3].tolist() == [1.0] * 4
    for start in (0, 6001, 8001, 10016):
        assert px4_outputs.mixed(control, {"SYS_AUTOSTART": start}) is None
    assert "motors" not in px4_topics.signals(topics(), {"SYS_AUTOSTART": 4001})[0]
