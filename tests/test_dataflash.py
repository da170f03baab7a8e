"""The DataFlash reader on logs made here: formats of all firmware ages, mapping to rotors, units, clock."""

import struct
import time
from pathlib import Path

import numpy as np
import pytest

from rotorwatch.errors import LogError
from rotorwatch.logs import dataflash, dataflash_clock
from rotorwatch.logs.dataflash_binary import CODES, BinaryLog
from rotorwatch.logs.dataflash_clock import LOOK_BACK, make_clock

STRUCT = dict(a="64s", b="b", B="B", h="h", H="H", i="i", I="I", q="q", Q="Q", g="e", f="f", d="d", M="B") | dict(
    n="4s", N="16s", Z="64s", c="h", C="H", e="i", E="I", L="i"
)
IMU = ("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
RATE = ("RATE", "Qffffffffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut,ADes,A,AOut")
RCOU = ("RCOU", "Q" + "H" * 14, "TimeUS," + ",".join(f"C{k}" for k in range(1, 15)))
PARM = ("PARM", "QNf", "TimeUS,Name,Value")


class Writer:
    """Writes a binary DataFlash log record by record."""

    def __init__(self):
        self.types: dict[str, tuple[int, str]] = {}
        self.data = b""
        self.define("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 128)

    def define(self, name, codes, columns, type_=None):
        type_ = len(self.types) + 1 if type_ is None else type_
        length = 3 + struct.calcsize("<" + "".join(STRUCT[c] for c in codes))
        self.types[name] = (type_, codes)
        self.add("FMT", type_, length, name.encode(), codes.encode(), columns.encode())

    def add(self, name, *values):
        type_, codes = self.types[name]
        self.data += struct.pack("<BBB" + "".join(STRUCT[c] for c in codes), 0xA3, 0x95, type_, *values)

    def parameters(self, time=1_000_000, **values):
        if "PARM" not in self.types:
            self.define(*PARM)
        for name, value in values.items():
            self.add("PARM", time, name.encode(), value)


def pwm(**outputs):
    """14 RCOU fields: o3=1500 sets output 3, the others are off."""
    return [outputs.get(f"o{k}", 0) for k in range(1, 15)]


def test_places_by_gps_and_barometer():
    log = Writer()
    log.define(*IMU)
    log.define("GPS", "QBBLLeff", "TimeUS,I,Status,Lat,Lng,Alt,Spd,GCrs")
    log.define("BARO", "QBf", "TimeUS,I,Alt")
    for k in range(6):
        log.add("IMU", 1_000_000 + 100_000 * k, 0, 0, 0, 0, 0, 0, -9.8)
        for instance in (0, 1):
            status, off = (1, 0) if k == 0 else (3, 1000 * k)
            log.add(
                "GPS",
                1_000_000 + 100_000 * k,
                instance,
                status,
                470_000_000 + off,
                80_000_000 - off + 5 * instance,
                40_000 + 100 * k,
                1.5,
                0,
            )
        log.add("BARO", 1_000_000 + 100_000 * k, 0, 0.5 * k)
    flight = dataflash.read(log.data, "made.bin")
    gps = flight["gps"]
    assert len(gps) == 6 and gps.valid[:, 0].tolist() == [False] + [True] * 5
    assert gps.values[1] == pytest.approx([0.0, 0.0, 0.0, 1.5]) and gps.unit == "m,m,m,m/s"
    assert gps.values[5] == pytest.approx([4 * 11.118, -4 * 7.604, -4.0, 1.5], abs=0.02)
    assert flight["baro"].values[:, 0] == pytest.approx(0.5 * np.arange(6))
    alone = Writer()
    alone.define("BARO", "QBf", "TimeUS,I,Alt")
    for k in range(6):
        alone.add("BARO", 1_000_000 + 100_000 * k, 0, 0.5 * k)
    with pytest.raises(LogError, match="holds no flight"):
        dataflash.read(alone.data, "made.bin")


def flight_with(outputs, n=5, **parameters):
    log = Writer()
    log.parameters(**parameters)
    log.define(*RCOU)
    for k in range(n):
        log.add("RCOU", 1_000_000 + 100_000 * k, *pwm(**outputs(k)))
    return dataflash.read(log.data, "made.bin")


def test_every_field_code():
    log = Writer()
    values = dict(b=-5, B=250, h=-300, H=65000, i=-70000, I=4_000_000_000, q=-(2**60), Q=2**63 + 1, g=0.5, f=1.25, d=np.pi)
    values |= dict(M=16, n=b"abcd", N=b"name", Z=b"text, with comma", c=-1234, C=54321, e=-123456, E=3_000_000_000)
    values |= dict(L=-353632621, a=struct.pack("<32h", *range(-16, 16)))
    assert set(values) == set(CODES) == set(STRUCT)
    for part in ("bBhHiIqQgfdM", "nNZcCeEL", "a"):
        log.define("X" + part[0], part, ",".join("f" + c for c in part))
        log.add("X" + part[0], *(values[c] for c in part))
    read = BinaryLog(log.data)
    row = {c: v[0] for name in ("Xb", "Xn", "Xa") for c, v in read.table(name).columns.items()}
    for code in "bBhHiIqQgfdMnNZ":
        assert row["f" + code] == values[code], code
    for code in "cCeE":
        assert row["f" + code] == values[code] / 100, code
    assert row["fL"] == -35.3632621
    assert row["fa"].tolist() == list(range(-16, 16))


def test_rotors_follow_servo_functions():
    functions = dict(SERVO2_FUNCTION=33, SERVO4_FUNCTION=34, SERVO1_FUNCTION=35, SERVO14_FUNCTION=36, SERVO3_FUNCTION=0)
    flight = flight_with(lambda k: dict(o1=1300 + k, o2=1100 + k, o4=1200 + k, o14=1400 + k), FRAME_CLASS=1, **functions)
    assert flight.facts["rotor_outputs"] == [2, 4, 1, 14]
    assert flight["motors"].values[2].tolist() == [1102, 1202, 1302, 1402]
    assert flight["motors"].columns == ("r1", "r2", "r3", "r4")
    assert flight.warnings == ()


def test_motors_nine_to_twelve():
    functions = {f"SERVO{k}_FUNCTION": 32 + k if k < 9 else 73 + k for k in range(1, 13)}
    flight = flight_with(lambda k: {f"o{j}": 1000 + j for j in range(1, 13)}, FRAME_CLASS=12, **functions)
    assert flight.facts["rotor_outputs"] == list(range(1, 13))
    assert flight["motors"].values[0].tolist() == [1000 + j for j in range(1, 13)]


@pytest.mark.parametrize(
    ("parameters", "rotors", "said"),
    [
        (dict(FRAME_CLASS=2), 6, ""),  # old firmware: outputs are the motors
        (dict(FRAME_CLASS=1, SERVO1_FUNCTION=33, SERVO2_FUNCTION=34, SERVO3_FUNCTION=35), 4, "motors 4"),
        (dict(FRAME_CLASS=1, **{f"SERVO{k}_FUNCTION": 32 + k for k in range(1, 6)}), 4, "motors 5"),
        (dict(FRAME_CLASS=0), 6, "moving outputs 1, 2, 3, 4, 5, 6"),
        ({f"SERVO{k}_FUNCTION": 32 + k for k in range(1, 4)}, 3, ""),
    ],
)
def test_rotor_count_without_a_full_description(parameters, rotors, said):
    flight = flight_with(lambda k: {f"o{j}": 1500 + k for j in range(1, 7)}, FRAME_TYPE=1, **parameters)
    assert flight.rotor_count == rotors
    assert said in " ".join(flight.warnings)


def with_throttle(outputs, n=60, **parameters):
    """`flight_with`, and a throttle that rises from 0.2 to 0.6."""
    log = Writer()
    log.parameters(**parameters)
    log.define(*RCOU)
    log.define("CTUN", "Qff", "TimeUS,ThI,ThO")
    for k in range(n):
        log.add("RCOU", 1_000_000 + 100_000 * k, *pwm(**outputs(k)))
        log.add("CTUN", 1_000_000 + 100_000 * k, 0.0, 0.2 + 0.4 * k / n)
    return dataflash.read(log.data, "made.bin")


def test_outputs_with_another_function_are_no_motors():
    """Radio passed through (1) and a gripper (28): the firmware drives no rotor through them, whatever they do."""
    functions = dict.fromkeys((f"SERVO{k}_FUNCTION" for k in (1, 2, 4)), 1) | {"SERVO3_FUNCTION": 28}
    flight = with_throttle(lambda k: dict(o1=1300 + k, o2=1300 + k, o3=1300 + k, o4=1300 + k), FRAME_CLASS=1, **functions)
    assert flight.rotor_count == 0 and "motors" not in flight.signals
    assert any("the motor outputs are not in this log" in w for w in flight.warnings)


@pytest.mark.parametrize("slope, rotors", [(4, 4), (0, 0), (-4, 0)])
def test_outputs_without_any_function_are_motors_when_they_follow_the_throttle(slope, rotors):
    functions = dict.fromkeys((f"SERVO{k}_FUNCTION" for k in range(1, 17)), 0)
    flight = with_throttle(lambda k: {f"o{j}": 1500 + slope * k for j in range(1, 5)}, FRAME_CLASS=1, **functions)
    assert flight.rotor_count == rotors
    assert any("rotor k was taken to be output k" in w for w in flight.warnings)


def test_tricopter_leaves_its_tail_servo_out():
    functions = {f"SERVO{k}_FUNCTION": 32 + k for k in (1, 2, 4, 7)}
    flight = flight_with(lambda k: dict(o1=1500, o2=1500, o4=1500, o7=1500), FRAME_CLASS=7, **functions)
    assert flight["motors"].columns == ("r1", "r2", "r4")
    assert flight.warnings == ()


def test_outputs_that_are_off_or_wild_are_invalid():
    flight = flight_with(lambda k: dict(o1=1500, o2=0, o3=65535 if k == 2 else 1400, o4=499), FRAME_CLASS=1)
    assert flight["motors"].valid.all(axis=0).tolist() == [True, False, False, False]
    assert flight["motors"].valid[:, 2].sum() == 4
    assert "motors (RCOU): 6 impossible values dropped." in flight.warnings


def test_simulation_parameters_and_their_mention_are_never_read():
    log = Writer()
    log.parameters(SIM_ENGINE_FAIL=4, SIM_ENGINE_MUL=0.8, MOT_THST_EXPO=0.65, FRAME_CLASS=1)
    log.define("MSG", "QZ", "TimeUS,Message")
    log.add("MSG", 1_000_000, b"ArduCopter V4.5.1 (abc123)")
    log.add("MSG", 2_000_000, b"SIM_ENGINE_MUL set")
    log.parameters(time=3_000_000, SIM_ENGINE_MUL=0.5, MOT_THST_EXPO=0.7)
    log.define(*RCOU)
    for k in range(3):
        log.add("RCOU", 3_000_000 + k, *pwm(o1=1500, o2=1500, o3=1500, o4=1500))
    flight = dataflash.read(log.data, "made.bin")
    assert set(flight.parameters) == {"MOT_THST_EXPO", "FRAME_CLASS"}
    assert flight.parameter_changes == ((2.0, "MOT_THST_EXPO", pytest.approx(0.7)),)
    assert "SIM" not in repr(flight.messages)
    assert (flight.firmware, flight.vehicle_type) == ("ArduCopter V4.5.1 (abc123)", "ArduCopter")


def test_first_sensor_instance_else_the_fullest():
    for instances, chosen in (((0, 1), 0), ((1, 2, 2), 2)):
        log = Writer()
        log.define(*IMU)
        for k in range(20):
            for i in instances:
                log.add("IMU", 1000 * k, i, i, i, i, 0, 0, -9.8)
        flight = dataflash.read(log.data, "made.bin")
        assert (flight["gyro"].values == chosen).all()
        assert ("IMU has no instance 0; instance 2 was used." in flight.warnings) == (chosen == 2)


def old_log(seconds=4.0):
    """A log in the manner of APM:Copter 3.3: milliseconds, raw outputs, hundredths."""
    log = Writer()
    log.define("PARM", "Nf", "Name,Value")
    log.define("MSG", "Z", "Message")
    log.define("EV", "B", "Id")
    log.define("IMU", "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.define("RCOU", "Ihhhh", "TimeMS,Ch1,Ch2,Ch3,Ch4")
    log.define("RATE", "Iffffffffffff", RATE[2].replace("US", "MS"))
    log.define("CURR", "IhhhHfh", "TimeMS,Throttle,Volt,Curr,Vcc,CurrTot,Volt2")
    log.define("ATT", "IccccCC", "TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
    log.define("CTUN", "Ihhh", "TimeMS,ThrIn,AngBst,ThrOut")
    log.define("GPS", "BI", "Status,TimeMS")
    log.add("PARM", b"FRAME", 1.0)
    log.add("MSG", b"APM:Copter V3.3 (d6053245)")
    log.add("MSG", b"Frame: QUAD")
    for k in range(int(seconds * 50)):
        ms, turn = 5000 + 20 * k, np.sin(0.1 * k)
        log.add("IMU", ms, turn, -turn, 0.5 * turn, 0, 0, -9.8)
        log.add("RCOU", ms, 1500, 1510, 1520, 1530)
        log.add("GPS", 3, 10)  # a time of week, smaller than any boot time
        if k == 100:
            log.add("EV", 10)
        centi = 100 * np.degrees(turn)
        log.add("RATE", ms, 0, centi, 450, 0, -centi, -900, 0, centi / 2, 4000, 0, 0, 387)
        log.add("CURR", ms, 0, 1654, 55, 5357, 422.0, 0)
        log.add("ATT", ms, 0, -4300, 0, 1000, 0, 35999)
        log.add("CTUN", ms, 550, 0, 387)
    return log.data


def test_firmware_3_3_units_and_names():
    flight = dataflash.read(old_log(), "old.bin")
    assert flight.start_us == 5_000_000
    assert flight.duration == pytest.approx(3.98)
    assert (flight.facts["frame_class"], flight.facts["frame_type"], flight.rotor_count) == (1, 1, 4)
    assert flight["motors"].values[0].tolist() == [1500, 1510, 1520, 1530]
    np.testing.assert_allclose(flight["rates"].values, flight["gyro"].values, atol=1e-6)
    np.testing.assert_allclose(flight["control"].values[0], [0.1, -0.2, 4000 / 4500, 0.387], atol=1e-6)
    np.testing.assert_allclose(flight["battery"].values[0], [16.54, 0.55])
    assert flight["throttle"].values[0, 0] == pytest.approx(0.387)
    assert any("centidegrees" in w for w in flight.warnings) and any("raw" in w for w in flight.warnings)
    assert [(m.kind, m.value, m.time) for m in flight.messages if m.kind == "armed"] == [("armed", 1.0, pytest.approx(2.0))]
    assert (flight.firmware, flight.vehicle_type) == ("APM:Copter V3.3 (d6053245)", "ArduCopter")


def test_attitude_quaternion_turns_body_to_world_and_is_continuous():
    log = Writer()
    log.define("ATT", "Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
    for k in range(9):
        log.add("ATT", 100_000 * k, 0, 0, 0, 0, 0, (340 + 5 * k) % 360)
    log.add("ATT", 900_000, 0, 30, 0, -20, 0, 100)
    q = dataflash.read(log.data, "made.bin")["attitude"].values
    assert (np.sum(q[1:] * q[:-1], axis=1) > 0).all()
    w, x, y, z = q[-1]
    down_of_x = 2 * (x * z - w * y)  # world-down part of the body's x axis
    np.testing.assert_allclose([down_of_x, x * x + y * y + z * z + w * w], [-np.sin(np.radians(-20)), 1], atol=1e-9)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    assert np.degrees(roll) == pytest.approx(30)


def test_modern_rate_is_degrees():
    log = Writer()
    log.define(*IMU)
    log.define(*RATE)
    for k in range(100):
        turn = np.sin(0.1 * k)
        log.add("IMU", 10_000 * k, 0, turn, 0, 0, 0, 0, -9.8)
        log.add("RATE", 10_000 * k, 0, np.degrees(turn), 0.1, 0, 0, 0.2, 0, 0, -0.3, 0, 0, 0.4)
    flight = dataflash.read(log.data, "made.bin")
    np.testing.assert_allclose(flight["rates"].values, flight["gyro"].values, atol=1e-6)
    np.testing.assert_allclose(flight["control"].values[3], [0.1, 0.2, -0.3, 0.4], atol=1e-6)
    assert flight.warnings == ()


def test_esc_telemetry_in_rotor_order():
    log = Writer()
    functions = {f"SERVO{output}_FUNCTION": 32 + rotor for rotor, output in ((1, 4), (2, 3), (3, 2), (4, 1))}
    log.parameters(time=0, FRAME_CLASS=1, **functions)
    log.define("ESC", "QBeffcfcf", "TimeUS,Instance,RPM,Volt,Curr,Temp,CTot,MotTemp,Err")
    log.define(*RCOU)
    for k in range(20):
        log.add("RCOU", 100_000 * k, *pwm(o1=1500, o2=1500, o3=1500, o4=1500))
        for instance in range(4):
            if not (instance == 2 and k > 5):  # output 3, rotor 2, falls silent
                log.add("ESC", 100_000 * k + instance, instance, 100 * (5000 + instance), 12, 2.5 + instance, *[0] * 4)
    esc = dataflash.read(log.data, "made.bin")["esc"]
    assert esc.columns[:5] == ("speed1", "speed2", "speed3", "speed4", "current1")
    assert esc.values[3, :4] == pytest.approx(np.array([5003, 5002, 5001, 5000]) * np.pi / 30)
    assert esc.values[3, 4:8].tolist() == [5.5, 4.5, 3.5, 2.5]
    assert not esc.valid[-1, 1] and esc.valid[-1, [0, 2, 3]].all()


def test_what_stops_motors_and_which_core_of_the_estimator_is_used():
    """LogEvent and LogErrorSubsystem of AP_Logger.h: core 0 is one to change to, not the end of an error."""
    log = Writer()
    log.define("ERR", "QBB", "TimeUS,Subsys,ECode")
    log.define("EV", "QB", "TimeUS,Id")
    log.define(*RCOU)
    for k in range(3):
        log.add("RCOU", 1000 * k, *pwm(o1=1500, o2=1500 + k))
    for k, number in enumerate((54, 56, 51, 19)):
        log.add("EV", 1_000_000 + k, number)
    log.add("ERR", 2_000_000, 24, 0)
    log.add("ERR", 3_000_000, 6, 0)
    texts = [m.text for m in dataflash.read(log.data, "made.bin").messages]
    assert texts == [
        "emergency stop of the motors", "motors interlocked", "parachute released", "lost GPS", "estimator core: error 0",
        "battery failsafe: resolved",
    ]  # fmt: skip


def test_what_disarmed_is_reported():
    log = Writer()
    log.define("ARM", "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method")
    log.define(*RCOU)
    for k in range(3):
        log.add("RCOU", 1000 * k, *pwm(o1=1500, o2=1500 + k))
    for k, (state, method) in enumerate(((1, 2), (0, 16), (0, 13), (0, 99))):
        log.add("ARM", 1_000_000 * (k + 1), state, 0, 0, method)
    events = [(m.time, m.text) for m in dataflash.read(log.data, "made.bin").messages if m.kind == "event"]
    assert events == [(2.0, "disarmed: radio failsafe"), (3.0, "disarmed: landing")]


def test_what_is_compared_with_limits_is_of_the_first_imu_and_core_and_warns_of_nothing():
    log = Writer()
    log.define("VIBE", "QBfffI", "TimeUS,IMU,VibeX,VibeY,VibeZ,Clip")
    log.define("XKF4", "QBcccc", "TimeUS,C,SV,SP,SH,SM")
    log.define(*RCOU)
    for k in range(20):
        log.add("RCOU", 100_000 * k, *pwm(o1=1500, o2=1500 + k))
        for core in (0, 1):
            log.add("VIBE", 100_000 * k, core, 3.0 + core, 9.0 + core, np.inf if k == 5 else 4.0, 7 * k * (1 - core))
            log.add("XKF4", 100_000 * k, core, 10 + core, 20, 30, 240)
    flight = dataflash.read(log.data, "made.bin")
    assert flight["vibration"].values[0, 0] == 9.0 and not flight["vibration"].valid[5, 0]
    assert flight["clipping"].values[-1, 0] == 7 * 19
    assert flight["innovations"].values[0] == pytest.approx([0.1, 0.2, 0.3, 2.4])
    assert not any("VIBE" in text or "XKF4" in text for text in flight.warnings)


def test_messages_and_states():
    log = Writer()
    log.define("MODE", "QMBB", "TimeUS,Mode,ModeNum,Rsn")
    log.define("ERR", "QBB", "TimeUS,Subsys,ECode")
    log.define("EV", "QB", "TimeUS,Id")
    log.define("ARM", "QBI", "TimeUS,ArmState,ArmChecks")
    log.define(*RCOU)
    for k in range(3):
        log.add("RCOU", 1000 * k, *pwm(o1=1500, o2=1500 + k))
    log.add("MODE", 1_000_000, 5, 5, 1)
    log.add("ARM", 2_000_000, 1, 0)
    log.add("EV", 2_000_100, 10)
    log.add("EV", 3_000_000, 28)
    log.add("ERR", 4_000_000, 25, 1)
    log.add("EV", 5_000_000, 18)
    log.add("EV", 6_000_000, 11)
    got = [(m.time, m.kind, m.text, m.value) for m in dataflash.read(log.data, "made.bin").messages]
    assert got == [
        (1.0, "mode", "LOITER", 5.0),
        (2.0, "armed", "armed", 1.0),
        (3.0, "landed", "in the air", 0.0),
        (4.0, "error", "thrust loss check: error 1", 25.0),
        (5.0, "landed", "landed", 1.0),
        (6.0, "armed", "disarmed", 0.0),
    ]


def test_a_message_redefined_half_way():
    log = Writer()
    log.define("BAT", "Qff", "TimeUS,Volt,Curr", 7)
    for k in range(5):
        log.add("BAT", 1000 * k, 12.0, 1.0)
    log.define("BAT", "QBfff", "TimeUS,Instance,Volt,VoltR,Curr", 7)
    for k in range(5, 10):
        log.add("BAT", 1000 * k, 0, 13.0, 13.5, 2.0)
    battery = dataflash.read(log.data, "made.bin")["battery"]
    assert battery.values.tolist() == [[12, 1]] * 5 + [[13, 2]] * 5


def test_messages_redefined_in_turns_cost_no_more_than_others():
    """Two meanings of one type, thousands of times: each record is read by the one that holds, and time grows with the log."""
    log, count = Writer(), 3000
    for k in range(2):
        log.define("BAT", "Qff" if k else "QBff", "TimeUS,Volt,Curr" if k else "TimeUS,Instance,Volt,Curr", 7)
        log.add("BAT", k, *(() if k else (0,)), 10.0 + k, 1.0)
    start, turn = log.data[:89], log.data[89:]
    before = time.process_time()
    read = BinaryLog(start + turn * count)
    battery = read.table("BAT")
    assert time.process_time() - before < 1.0
    assert battery["Volt"].tolist() == [10.0, 11.0] * count and read.counts["BAT"] == 2 * count
    assert not np.isnan(read.stamps()[read.table("FMT").record[-1] + 1])


def test_a_log_that_defines_endless_kinds_is_refused():
    log = Writer()
    for k in range(4100):
        log.define("BAT", "Qf", f"TimeUS,V{k}", 7)
    with pytest.raises(LogError, match="defines more than 4096 kinds of messages"):
        BinaryLog(log.data)


def test_header_bytes_inside_payloads_are_no_records():
    log = Writer()
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define(*IMU)
    fake = log.data[:89] + b""
    imu = struct.pack("<BBBQB", 0xA3, 0x95, log.types["IMU"][0], 77, 0)
    for k in range(50):
        log.add("IMU", 1000 * k, 0, k, 0, 0, 0, 0, -9.8)
        log.add("MSG", 1000 * k, (imu + fake)[:64])
    read = BinaryLog(log.data)
    assert read.counts["IMU"] == read.counts["MSG"] == 50 and read.warnings == []
    assert read.table("IMU")["GyrX"].tolist() == list(range(50))


@pytest.mark.parametrize("piece", [1, 3, 1 << 20])
def test_times_that_are_read_where_they_are_asked_for(monkeypatch, piece):
    """They are those of all records at once: of records without a stamp, in older units, and of a type that is defined anew."""
    monkeypatch.setattr(dataflash_clock, "PIECE", piece)
    log = Writer()
    log.define(*IMU)
    log.define("OLD", "If", "TimeMS,X")
    log.define("BARE", "Bf", "I,X")
    for k in range(12):
        log.add("IMU", 5_000_000 + 10_000 * k - 1000 * (k % 3), 0, *[0] * 6)
        log.add("OLD", 5000 + 10 * k, 1.0)
        if k % 4 == 0:
            log.add("BARE", 1, 2.0)
            log.define("OLD", "If" if k % 8 else "Qf", "TimeMS,X" if k % 8 else "TimeUS,X", log.types["OLD"][0])
            log.add("OLD", *((5000 + 10 * k, 1.0) if k % 8 else (5_000_000 + 10_000 * k, 1.0)))
            log.define("OLD", "If", "TimeMS,X", log.types["OLD"][0])
    read = BinaryLog(log.data)
    clock, source = dataflash_clock.clock_of(read)
    whole, every = make_clock(read.stamps()), np.arange(read.record_count)
    assert isinstance(clock, dataflash_clock.SteadyClock) and source == ""
    assert (clock.start_us, clock.end, clock.jumps) == (whole.start_us, whole.end, whole.jumps)
    for some in (every, every[::3], every[:1], every[-1:]):
        np.testing.assert_array_equal(clock.of(some), whole.of(some))
    back = Writer()
    back.define(*IMU)
    for k in [*range(50), *range(20, 70)]:
        back.add("IMU", 5_000_000 + 100_000 * k, 0, *[0] * 6)
    assert dataflash_clock.clock_of(BinaryLog(back.data))[0].jumps == (pytest.approx(4.9),)


def test_clock_keeps_small_steps_and_long_gaps():
    later = [900.0, 900.01, 900.02, 900.03, 900.04, 900.05]
    stamps = np.array([5.0, 5.01, 5.005, np.nan, 5.02, 5.03, 5.04, *later]) * 1e6
    clock = make_clock(stamps)
    np.testing.assert_allclose(clock.time[:7], [0, 0.01, 0.005, 0.005, 0.02, 0.03, 0.04], atol=1e-12)
    np.testing.assert_allclose(clock.time[7:], np.array(later) - 5)
    assert clock.good.all() and clock.warnings == () and clock.start_us == 5e6


def test_clock_drops_garbage_and_takes_out_resets():
    stamps = 1e6 * (100 + 0.01 * np.arange(2000))
    stamps[[300, 301, 700]] = [2e18, 17.0, 3e6]
    stamps[1500:] -= 3e6
    clock = make_clock(stamps)
    assert np.flatnonzero(~clock.good).tolist() == [300, 301, 700]
    assert (np.diff(clock.time[clock.good]) >= 0).all()
    assert clock.jumps == (pytest.approx(14.99),)
    assert clock.end == pytest.approx(19.98)
    assert len(clock.warnings) == 2 and "jumps back by 3.0 s at 15.0 s" in clock.warnings[1]


def test_a_stamp_slightly_ahead_costs_one_sample():
    log = Writer()
    log.define(*IMU)
    for k in range(200):
        log.add("IMU", 10_000 * k + {50: 300_000, 120: 700_000, 121: -4_000}.get(k, 0), 0, k / 4, 0, 0, 0, 0, -9.8)
    gyro = dataflash.read(log.data, "made.bin")["gyro"]
    assert (np.diff(gyro.time) > 0).all()
    assert sorted(set(range(200)) - set(4 * gyro.values[:, 0])) == [50, 120]


def test_text_log_with_mode_names_and_commas():
    text = b"""Ready to drive.
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 132, 67, MSG, QZ, TimeUS,Message
FMT, 136, 12, RCOU, QHHHH, TimeUS,C1,C2,C3,C4
FMT, 170, 13, MODE, QMB, TimeUS,Mode,ModeNum
FMT, 171, 13, HURT
MSG, 1000000, ArduCopter V3.5.7 (b11c6af3), quad
MSG, 1000000, Frame: QUAD
MODE, 1000000, AltHold, AltHold
RCOU, 1000000, 1500, 1501, 1502, 1503
RCOU, 1100000, 1500, 15
NONE, 1, 2
RCOU, 1200000, 1500, 1501, oops, 0
"""
    flight = dataflash.read(text, "made.log")
    assert flight["motors"].valid.tolist() == [[True] * 4, [True] + [False] * 3, [True, True, False, False]]
    assert [m.text for m in flight.messages] == ["ArduCopter V3.5.7 (b11c6af3), quad", "Frame: QUAD", "ALT_HOLD"]
    assert "2 lines damaged or of unknown type skipped." in flight.warnings


def test_a_log_without_flight_or_of_another_kind_is_refused():
    log = Writer()
    log.parameters(FRAME_CLASS=1)
    assert dataflash.sniff(log.data, "")
    for data, said in ((log.data, "no data"), (b"", "empty"), (b"ULog" + bytes(99), "not a DataFlash log")):
        with pytest.raises(LogError, match=said):
            dataflash.read(data, "x.bin")
    assert not dataflash.sniff(b"ULog\x01\x12\x35" + bytes(99), "x.bin")


def test_progress_runs_to_the_end():
    seen = []
    dataflash.read(old_log(), "x.bin", seen.append)
    assert seen == sorted(seen) and seen[0] == 0.1 and seen[-1] == 1.0  # first the headers are found


@pytest.mark.parametrize("wrap", [memoryview, bytearray])
def test_reads_any_buffer_and_lets_go_of_it(wrap):
    buffer = wrap(bytearray(old_log()))
    flight = dataflash.read(buffer, "x.bin")
    if wrap is bytearray:
        buffer.extend(b"x")  # raises BufferError while anything still looks at it
    assert len(flight["gyro"]) == 200


WILD = Path(__file__).parents[2] / "shared" / "flights" / "wild"


@pytest.mark.skipif(not (WILD / "on-its-side-1.bin.xz").is_file(), reason="this flight is missing")
def test_a_vehicle_whose_outputs_are_passed_through_is_not_assessed():
    from rotorwatch import diagnose

    diagnosis = diagnose(WILD / "on-its-side-1.bin.xz")
    assert diagnosis.verdict == "inconclusive" and not diagnosis.events
    assert any("SERVO1_FUNCTION" in w for w in diagnosis.warnings)


@pytest.mark.parametrize("lead", [0, 1, 3])
def test_a_good_stretch_is_found_again_behind_more_garbage_than_is_looked_at_one_by_one(lead):
    """Seconds of sound stamps, then more single wild ones than LOOK_BACK, then sound ones again: both parts are kept."""
    sound = 1e6 * (100 + 0.01 * np.arange(600))
    wild = 1e12 * (9 + np.arange(LOOK_BACK + 9) % 7 + 0.1 * np.arange(LOOK_BACK + 9))
    stamps = np.concatenate([wild[:lead], sound[:300], wild[lead:], sound[300:]])
    clock = make_clock(stamps)
    good = np.concatenate([np.full(lead, False), np.full(300, True), np.full(wild.size - lead, False), np.full(300, True)])
    np.testing.assert_array_equal(clock.good, good)
    assert clock.end == pytest.approx(5.99) and clock.start_us == 100e6 and clock.jumps == ()


@pytest.mark.parametrize("count", [9, 10])
def test_rates_in_centidegrees_are_reported_by_the_gyro_from_ten_samples_on(count):
    log = Writer()
    log.define(*IMU)
    log.define(*RATE)
    for k in range(max(count, 12)):
        us, turn = 1_000_000 + 20_000 * k, 0.005 + 0.001 * k
        log.add("IMU", us, 0, turn, 0.0, 0.0, 0.0, 0.0, -9.8)
        if k < count:
            log.add("RATE", us, 0.0, np.degrees(turn) * 100.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.4, 0.4)
    rates = dataflash.read(log.data, "made.bin")["rates"]
    assert rates.values[3, 0] == pytest.approx(0.008 * (1.0 if count == 10 else 100.0), rel=1e-5)


@pytest.mark.parametrize("raw", [True, False])
def test_small_controller_outputs_are_raw_or_not_as_the_motors_move(raw):
    """A calm flight of old firmware asks for 60 of 4500: by size alone that would be sixty times full output."""
    log = Writer()
    log.parameters(FRAME_CLASS=1, **{f"SERVO{n}_FUNCTION": 32 + n for n in range(1, 5)})
    log.define(*RCOU)
    log.define(*RATE)
    for k in range(40):
        us, roll = 1_000_000 + 20_000 * k, 60.0 / 4500.0 * (-1) ** k
        # A quad's mixer makes of it half as much of the motors' 1000 us, one side up and the other down.
        log.add("RCOU", us, *pwm(**{f"o{n}": 1500 + round(500 * roll) * (1 if n in (2, 3) else -1) for n in range(1, 5)}))
        out = roll * (4500.0 if raw else 1.0)
        log.add("RATE", us + 10, 0.0, 0.0, out, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.4, 0.4)
    control = dataflash.read(log.data, "made.bin")["control"]
    assert control.values[10, 0] == pytest.approx(60.0 / 4500.0, rel=1e-5)


def test_a_log_without_any_time_has_a_clock_that_stands_at_nothing():
    clock = make_clock(np.full(4, np.nan))
    assert (clock.end, clock.start_us, clock.warnings) == (0.0, 0.0, ()) and clock.good.all() and not clock.time.any()
