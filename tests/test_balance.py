"""Rotors out of balance, heard in an unfiltered sensor at the angle of each rotor."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rotorwatch
from rotorwatch.errors import ConfigError
from rotorwatch.fleet import flight_result
from rotorwatch.flight import Flight, Signal, kinds, vehicle_file
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.kinds import Weight, kind_of
from rotorwatch.logs import dataflash_raw, raw_sensors
from rotorwatch.logs.dataflash_binary import Table
from rotorwatch.report import figures as report_figures
from rotorwatch.report.info import info
from rotorwatch.witnesses.balance import hearing, imbalances, orders, unbalanced
from rotorwatch_lab.experiments import imbalance
from rotorwatch_lab.simulation import scenario, simulate, vibration
from rotorwatch_lab.simulation.write_dataflash import write_dataflash
from rotorwatch_lab.simulation.write_ulog import write_ulog

SAMPLES = Path(__file__).resolve().parents[1] / "src" / "rotorwatch" / "samples"
SPINS = np.array([1, -1, -1, 1])
USUAL = np.array([1900.0, 1980.0, 1820.0, 2060.0])  # rad/s: 290 to 330 turns a second
NAMES = ("x", "y", "z")


def wandering(time, usual=USUAL, size=30.0, seed=3):
    """Speeds (n, R) rad/s that wander about their usual ones within a second or so."""
    rng = np.random.default_rng(seed)
    knots = np.arange(time[0], time[-1] + 1.0, 0.7)
    off = rng.normal(0.0, size, (knots.size, len(usual)))
    return np.stack([u + np.interp(time, knots, off[:, k]) for k, u in enumerate(usual)], axis=1)


def flown(
    unbalance, duration=24.0, rate_hz=504.0, usual=USUAL, noise=1.0, frame=None, speed=None, esc_hz=0.0, kind="raw_accel", source="",
    seed=1, autopilot="Betaflight", parameters=None, left=lambda hz: 1.0,
):  # fmt: skip
    """A flight of unbalanced rotors (R,) or (n, R) g mm/kg, without anything else. left: gain of a filter at a frequency."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 1.0 / rate_hz)
    speed = wandering(time, usual) if speed is None else speed(time)
    frame = frame or vibration.rigid(SPINS[: speed.shape[1]])
    shake = vibration.acceleration if kind.endswith("accel") else vibration.rate
    values = shake(vibration.angles(time, speed), speed, np.asarray(unbalance) * left(speed / (2.0 * np.pi)), frame)
    values = values + noise * rng.standard_normal(values.shape) + np.sin(4.0 * time)[:, None]
    esc = vibration.reported(time, speed, esc_hz or rate_hz)
    sensor = Signal(time, values, NAMES, "m/s^2" if kind.endswith("accel") else "rad/s", "FRD", source or kind)
    form = "Blackbox" if autopilot == "Betaflight" else autopilot
    return Flight(form, autopilot, {kind: sensor, "esc": esc}, duration, parameters=parameters or {})


def heard(flight, rotors=4):
    found = imbalances.listen(flight, rotors, ((0.0, flight.duration),))
    assert found is not None
    return found


def values(found):
    return np.array([f.value if f else np.nan for f in found.figures])


@pytest.mark.parametrize("rate_hz", [504.0, 1000.0, 2000.0])
def test_the_unbalance_of_each_rotor_is_measured_below_and_above_half_the_sampling_rate(rate_hz):
    true = np.array([1.0, 0.5, 1.6, 0.2])
    found = heard(flown(true, rate_hz=rate_hz))
    assert values(found) == pytest.approx(true, abs=0.06)
    for f, u in zip(found.figures, true, strict=True):
        assert f.low - 0.02 <= u <= f.high + 0.02
        assert f.together == (found.figures.index(f) + 1,)
    assert found.channel.unit == "g mm/kg"


def test_intervals_hold_the_truth_in_nineteen_of_twenty(amount):
    true = np.array([0.8, 0.4, 1.2, 0.2])
    inside = []
    for seed in range(amount(15, 40)):
        for f, u in zip(heard(flown(true, duration=12.0, noise=2.0, seed=seed)).figures, true, strict=True):
            inside.append(f.low <= u <= f.high)
    assert np.mean(inside) > 0.9


def test_without_an_unbalance_nothing_is_heard():
    found = heard(flown(np.zeros(4)))
    assert values(found).max() < 0.1
    assert not unbalanced.findings(found)


def test_blades_that_pass_are_reported_from_an_unbalance():
    time = np.arange(0.0, 20.0, 1e-3)
    speed = wandering(time)
    for blades in (2, 3):
        size = np.array([0.0, 0.0, 0.7, 0.0])
        frame = vibration.Frame(vibration.rigid(SPINS).gain * size[:, None])
        a = vibration.acceleration(vibration.angles(time, speed), speed, np.zeros(4), frame, (blades, 1.0))
        a += 0.5 * np.random.default_rng(1).standard_normal(a.shape)
        f = Flight(
            "Blackbox",
            "Betaflight",
            {"raw_accel": Signal(time, a, NAMES, "m/s^2", "FRD"), "esc": vibration.reported(time, speed, 1000.0)},
            20.0,
        )
        found = heard(f)
        assert found.orders == (1, blades)
        assert found.figures[2].blades == pytest.approx(0.7, abs=0.05)
        assert values(found).max() < 0.1


def test_rotors_at_one_speed_are_named_together_and_apart_where_they_part():
    alike = np.array([1900.0, 1980.0, 1900.5, 2060.0])
    same = heard(flown([1.0, 0.5, 1.4, 0.2], speed=lambda t: wandering(t, alike)[:, [0, 1, 0, 3]] + [0.0, 0.0, 0.5, 0.0]))
    assert [f.together for f in same.figures] == [(1, 3), (2,), (1, 3), (4,)]
    assert values(same)[1] == pytest.approx(0.5, abs=0.06)

    def parting(t):
        w = wandering(t, alike)
        w[:, 2] = w[:, 0] + np.where(t > 12.0, 120.0, 0.5)
        return w

    parted = heard(flown([1.0, 0.5, 1.4, 0.2], speed=parting))
    assert values(parted) == pytest.approx([1.0, 0.5, 1.4, 0.2], abs=0.08)
    assert parted.figures[2].windows < parted.figures[1].windows


def test_many_rotors_at_nearly_one_speed_have_a_fit():
    time = np.arange(0.0, 6.0, 0.001)
    rng = np.random.default_rng(0)
    for apart in 10.0 ** np.arange(-8.0, -2.0):
        speed = 400.0 * (1.0 + apart * rng.standard_normal(8)) * (1.0 + 0.02 * np.sin(time))[:, None]
        windows = orders.fit(time, rng.standard_normal((len(time), 3)), speed, 2.0)
        assert windows is not None and np.isfinite(windows.power).all() and (windows.inflation[:, 0] > 100.0).all()


def test_rotors_at_one_speed_of_which_one_is_missing_for_a_while():
    """The fit of the group has the windows of the fit of each."""
    flight = with_speeds(
        flown([40.0, 60.0, 25.0, 55.0], speed=lambda t: wandering(t)[:, [0, 0, 2, 3]]), lambda t, w: np.where(
            ((t > 5.0) & (t < 7.0))[:, None] & (np.arange(4) == 1), np.nan, w)
    )  # fmt: skip
    found = heard(flight)
    assert found.figures[0] is not None and found.figures[0].together == (1, 2)
    assert len(found.used) == len(found.windows.time)


def test_a_change_of_rotors_at_one_speed_names_them_all():
    def changing(t):
        u = np.tile([0.8, 0.5, 1.2, 0.4], (t.size, 1))
        u[t > 14.0, 2] *= 3.0
        return u

    def alike(t):
        return wandering(t)[:, [0, 1, 0, 3]] + [0.0, 0.0, 0.5, 0.0]

    time = np.arange(0.0, 30.0, 1.0 / 504.0)
    (found,) = unbalanced.findings(heard(flown(changing(time), duration=30.0, speed=alike)))
    assert found.rotors == (1, 3) and found.onset == pytest.approx(14.0, abs=1.5)


@pytest.mark.parametrize("rotor", [0, 2])
def test_a_rotor_that_becomes_out_of_balance_is_named_with_its_onset(rotor):
    def changing(t):
        u = np.tile([0.8, 0.5, 1.2, 0.4], (t.size, 1))
        u[t > 14.0, rotor] *= 2.0
        return u

    duration, rate = 30.0, 504.0
    time = np.arange(0.0, duration, 1.0 / rate)
    (found,) = unbalanced.findings(heard(flown(changing(time), duration=duration, noise=2.0)))
    assert found.rotors == (rotor + 1,)
    assert found.onset == pytest.approx(14.0, abs=1.0)
    assert found.onset < found.certain < 20.0
    assert found.times == pytest.approx(2.0, rel=0.15)


def test_what_all_rotors_share_is_no_rotor():
    duration, rate = 30.0, 504.0
    time = np.arange(0.0, duration, 1.0 / rate)
    u = np.array([0.8, 0.5, 1.2, 0.4]) * np.where(time > 14.0, 2.0, 1.0)[:, None]
    assert not unbalanced.findings(heard(flown(u, duration=duration)))


def test_a_resonance_that_follows_the_speed_is_no_change():
    frame = vibration.Frame(vibration.rigid(SPINS).gain, 400.0, 0.1)
    found = heard(
        flown([0.8, 0.5, 1.2, 0.4], duration=30.0, frame=frame, speed=lambda t: wandering(t) + np.where(t > 15.0, 150.0, 0.0)[:, None])
    )
    assert not unbalanced.findings(found)


def test_a_rotor_far_above_the_others_is_out_of_balance():
    (found,) = unbalanced.findings(heard(flown([0.4, 0.5, 4.0, 0.3])))
    assert (found.rotors, found.against, found.onset) == ((3,), "others", None)
    assert found.times > 5.0
    assert not unbalanced.findings(heard(flown([0.04, 0.05, 0.4, 0.03], noise=0.3)))  # it shakes nothing
    assert not unbalanced.findings(heard(flown([0.9, 0.5, 1.5, 0.5])))


def earlier(*rows, unit="g mm/kg"):
    return [{"name": f"{k}", "unit": unit, "value": list(row), "windows": [30] * len(row)} for k, row in enumerate(rows)]


def test_earlier_flights_of_the_vehicle_are_a_sharper_measure():
    past = earlier(*([1.0, 0.5, 1.2, 0.6] * np.exp(np.random.default_rng(5).normal(0.0, 0.1, (8, 4)))))
    (found,) = unbalanced.findings(heard(flown([1.0, 0.5, 2.4, 0.6])), past)
    assert (found.rotors, found.against) == ((3,), "flights")
    assert found.times == pytest.approx(2.0, rel=0.15)
    assert not unbalanced.findings(heard(flown([1.0, 0.5, 1.4, 0.6])), past)
    assert not unbalanced.findings(heard(flown([1.0, 0.5, 2.4, 0.6])), earlier([1.0, 0.5, 1.2, 0.6], unit="urad"))  # another sensor
    assert not unbalanced.findings(heard(flown([1.0, 1.0, 1.2, 0.6])), past)  # the best balanced one is now like the others


def test_what_a_filter_took_off_is_put_back():
    true = np.array([1.0, 0.6, 1.4, 0.4])
    slow = USUAL / 4.0
    filtered = flown(
        true, usual=slow, noise=0.01, rate_hz=400.0, kind="accel", source="IMU", autopilot="ArduPilot",
        parameters={"INS_ACCEL_FILTER": 20.0},
        left=lambda hz: 1.0 / np.sqrt(1.0 + (hz / 20.0) ** 4),
    )  # fmt: skip
    assert values(heard(filtered)) == pytest.approx(true, rel=0.1)
    mean = flown(
        true,
        usual=slow,
        noise=0.01,
        rate_hz=250.0,
        kind="accel",
        source="sensor_combined",
        autopilot="PX4",
        left=lambda hz: np.sinc(hz / 250.0),
    )
    assert values(heard(mean)) == pytest.approx(true, rel=0.1)


def test_a_gyro_hears_where_no_accelerometer_does():
    found = heard(flown([1.0, 0.5, 1.6, 0.2], noise=1e-4, rate_hz=1000.0, kind="gyro", source="gyroUnfilt"))
    assert found.channel.unit == "urad"
    assert values(found) == pytest.approx(vibration.TO_RATE * np.array([1.0, 0.5, 1.6, 0.2]), rel=0.15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: {"raw_accel": s["raw_accel"]}, "no speed of every rotor"),
        (lambda s: {"esc": s["esc"]}, "no accelerometer or gyro"),
        (lambda s: {**s, "esc": s["esc"].part(slice(None, None, 400))}, "too slowly"),
        (lambda s: {**s, "raw_accel": s["raw_accel"].part(slice(None, None, 5))}, "no accelerometer or gyro"),
    ],
)  # fmt: skip
def test_a_log_that_cannot_hear_says_why_and_which_setting_would(change, words):
    flight = flown(np.ones(4))
    assert hearing.deaf(flight, 4) is None
    silent = replace(flight, signals=change(flight.signals))
    why = hearing.deaf(silent, 4)
    assert words in why.why and why.setting.endswith(".")
    assert imbalances.listen(silent, 4, ((0.0, 24.0),)) is None


def with_speeds(flight, change):
    esc = flight["esc"]
    v = esc.values.copy()
    v[:, :4] = change(esc.time, v[:, :4])
    return replace(flight, signals={**flight.signals, "esc": replace(esc, values=v)})


def test_a_wrong_number_of_poles_is_said():
    flight = replace(flown([1.0, 0.5, 1.6, 0.2]), parameters={"motor_poles": 14.0})
    assert not heard(flight).doubts
    wrong = heard(with_speeds(flight, lambda t, w: w * 12.0 / 14.0))  # the motors have 12
    assert not any(wrong.figures) and not unbalanced.findings(wrong)
    assert "12 poles, not 14" in wrong.doubts[0]


def test_speeds_of_other_rotors_are_not_believed():
    flight = flown([1.0, 0.5, 3.6, 0.2])
    esc = flight["esc"]
    motors = Signal(esc.time, (esc.values[:, :4] / 4000.0) ** 2, ("r1", "r2", "r3", "r4"), "1", "", "motor[0] ..")
    flight = replace(flight, signals={**flight.signals, "motors": motors})
    assert any(heard(flight).figures)
    mixed = heard(with_speeds(flight, lambda t, w: w[:, [1, 2, 3, 0]]))
    assert not any(mixed.figures) and "other rotors' commands" in mixed.doubts[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda t, w: np.where((t > 10.0)[:, None] & (np.arange(4) == 2), 0.0, w),  # it stands
        lambda t, w: np.where((t > 10.0)[:, None] & (np.arange(4) == 2), 1820.0, w),  # frozen
        lambda t, w: w * (1.0 + 0.02 * (np.arange(4) == 1)),  # off by 2 %
        lambda t, w: np.where((np.sin(3.0 * t) > 0.95)[:, None], np.nan, w),  # missing
    ],
)
def test_speeds_that_are_wrong_make_no_finding(change):
    flight = flown([1.0, 0.5, 1.6, 0.4], duration=30.0)
    found = imbalances.listen(with_speeds(flight, change), 4, ((0.0, 30.0),))
    assert found is None or not unbalanced.findings(found)


def test_motors_that_reverse_in_flight_make_no_finding():
    """3D modes: the rotors stop, and turn the other way; telemetry has no sign."""

    def reversing(t):
        return np.abs(wandering(t) * np.clip(8.0 * np.sin(0.4 * t), -1.0, 1.0)[:, None])

    found = heard(flown([1.0, 0.5, 1.6, 0.4], duration=40.0, speed=reversing))
    assert values(found) == pytest.approx([1.0, 0.5, 1.6, 0.4], abs=0.1)
    assert not unbalanced.findings(found)


def test_gaps_and_jitter_make_no_finding():
    flight = flown([1.0, 0.5, 1.6, 0.4], duration=30.0)
    sensor, rng = flight["raw_accel"], np.random.default_rng(2)
    for size in (1e-4, 3e-4, 1e-3, 3e-3):
        shaken = replace(sensor, time=np.sort(sensor.time + rng.normal(0.0, size, len(sensor))))
        found = imbalances.listen(replace(flight, signals={**flight.signals, "raw_accel": shaken}), 4, ((0.0, 30.0),))
        assert found is None or not unbalanced.findings(found)
    kept = rng.random(len(sensor)) > 0.02
    gone = sensor.with_arrays(sensor.time[kept], sensor.values[kept], sensor.valid[kept])
    found = heard(replace(flight, signals={**flight.signals, "raw_accel": gone}))
    assert values(found) == pytest.approx([1.0, 0.5, 1.6, 0.4], abs=0.1)
    assert not unbalanced.findings(found)


def test_windows_are_whole_and_spread_over_the_flight():
    time = np.arange(0.0, 400.0, 0.002)
    speed = np.full((time.size, 4), 1000.0)
    speed[5000:5100] = np.nan
    rows = orders.windows(time, speed, 0.15, 21)
    assert rows.shape[1] == 75
    assert not np.isnan(speed[rows]).any()
    assert np.diff(rows, axis=1).max() == 1
    assert not len(orders.windows(time[::20], speed[::20], 0.15, 21))
    fit = orders.fit(time, np.random.default_rng(0).standard_normal((time.size, 3)), speed, 2.0)
    assert 0.5 * orders.MOST < len(fit.time) <= orders.MOST
    assert fit.time[-1] > 395.0


def test_both_kinds_are_notices_that_do_not_rest_on_the_outputs():
    for name in (kinds.OUT_OF_BALANCE, kinds.UNBALANCED):
        kind = kind_of(name)
        assert kind.weight is Weight.NOTICE and not kind.by_outputs and not kind.weakens


@pytest.fixture(scope="module")
def hover():
    """A real flight without such sensors."""
    return rotorwatch.read(SAMPLES / "quadx_healthy_hover.bin.xz")


def shaken(flight, unbalance, seed=0):
    """The flight with speeds after its commands, and an accelerometer of unbalanced rotors: unbalance(time (n,)) -> (n, 4) g mm/kg."""
    rng, motors = np.random.default_rng(seed), flight["motors"]
    time = np.arange(motors.time[0], motors.time[-1], 0.002)
    share = np.clip((motors.values - 1100.0) / 850.0, 0.0, 1.0)
    commanded = np.stack([np.interp(time, motors.time, 900.0 * np.sqrt(s)) for s in share.T], axis=1)
    speed = commanded * np.array([1.0, 1.13, 0.85, 1.25]) + wandering(time, np.zeros(4), 8.0, seed + 1) * (commanded > 0.0)
    speed = np.maximum(speed, 0.0)
    a = vibration.acceleration(vibration.angles(time, speed), speed, unbalance(time), vibration.rigid(SPINS))
    a += 0.3 * rng.standard_normal(a.shape)
    signals = {"raw_accel": Signal(time, a, NAMES, "m/s^2", "FRD", "ACC"), "esc": vibration.reported(time, speed, 500.0)}
    return replace(flight, signals={**flight.signals, **signals}, name=f"flight {seed}")


def steady(*u):
    return lambda time: np.tile(np.array(u, float), (time.size, 1))


def test_a_diagnosis_measures_it_and_says_it_everywhere(hover, tmp_path):
    plain = rotorwatch.diagnose(hover)
    assert all(r.imbalance is None for r in plain.rotors)
    quiet = rotorwatch.diagnose(shaken(hover, steady(4.0, 3.0, 5.0, 2.0)))
    assert [r.imbalance["value"] for r in quiet.rotors] == pytest.approx([4.0, 3.0, 5.0, 2.0], rel=0.1)
    assert (quiet.verdict, [e.kind for e in quiet.events]) == (plain.verdict, [e.kind for e in plain.events])
    middle = 0.5 * (hover["motors"].time[0] + hover["motors"].time[-1])

    def changing(time):
        u = steady(4.0, 3.0, 5.0, 2.0)(time)
        u[time > middle, 1] = 12.0
        return u

    loud = rotorwatch.diagnose(shaken(hover, changing))
    (event,) = (e for e in loud.events if e.kind == kinds.UNBALANCED)
    assert event.rotors == (2,) and event.onset_s == pytest.approx(middle, abs=2.0)
    assert loud.verdict == plain.verdict
    assert "out of balance" in loud.headline and any("propeller of rotor 2" in a for a in loud.advice)
    assert loud.to_dict()["rotors"][1]["imbalance"]["unit"] == "g mm/kg"
    assert Diagnosis.from_dict(loud.to_dict()).rotors[1].imbalance["value"] == pytest.approx(loud.rotors[1].imbalance["value"])
    replace(loud, trace=None).to_html(tmp_path / "report.html")  # without plots it is made faster
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "out of balance" in page and "<h2>Balance of each rotor</h2>" in page
    drawn = report_figures.plots(loud)
    assert {"balance", "spectrogram"} <= set(drawn)
    assert drawn["spectrogram"].x_range is drawn["loss"].x_range
    assert drawn["spectrogram"].y_range.end == pytest.approx(250.0, rel=1e-3)
    assert "Balance of each rotor" in loud.to_markdown()
    stored = flight_result.imbalance(loud)["imbalance"]
    assert stored["unit"] == "g mm/kg" and stored["rotors"][1][0] == pytest.approx(loud.rotors[1].imbalance["value"], rel=1e-6)
    assert flight_result.imbalance(plain) == {}
    assert "balance" not in report_figures.plots(plain)


def test_a_vehicle_file_keeps_the_figures_of_healthy_flights(hover, tmp_path):
    flights = [shaken(hover, steady(4.0, 3.0, 5.0, 2.0), seed=k) for k in range(2)]
    vehicle = rotorwatch.calibrate(flights[:1])
    assert vehicle.identified["imbalance"][0]["value"] == pytest.approx([4.0, 3.0, 5.0, 2.0], rel=0.1)
    vehicle_file.write(vehicle, tmp_path / "quad.toml")
    again = vehicle_file.read(tmp_path / "quad.toml")
    found = rotorwatch.diagnose(shaken(hover, steady(4.0, 3.0, 14.0, 2.0), seed=7), again)
    assert [(e.kind, e.rotors) for e in found.events if "balance" in e.kind] == [(kinds.OUT_OF_BALANCE, (3,))]
    assert not [e for e in rotorwatch.diagnose(flights[1], again).events if "balance" in e.kind]


def test_a_log_says_whether_it_hears(hover):
    assert info(hover)["hears"]["ready"] is False
    assert "ESC" in info(hover)["hears"]["setting"]
    assert info(shaken(hover, steady(1.0, 1.0, 1.0, 1.0)))["hears"] == {"ready": True, "why": "", "setting": "", "sensor": "ACC"}


def raw_of(flight, tmp_path, write, name):
    write(flight, tmp_path / name)
    return rotorwatch.read(tmp_path / name)


def hovering(autopilot):
    """A simulated flight of a real log's shape, with speeds and raw sensors."""
    flight = shaken(rotorwatch.read(SAMPLES / "quadx_healthy_hover.bin.xz"), steady(4.0, 3.0, 5.0, 2.0))
    signals = {name: flight[name] for name in ("motors", "gyro", "accel", "attitude", "raw_accel", "esc")}
    gyro = flight["raw_accel"]
    signals["raw_gyro"] = replace(gyro, values=0.01 * gyro.values, unit="rad/s")
    if autopilot == "PX4":
        motors = flight["motors"]
        signals["motors"] = replace(motors, values=np.clip((motors.values - 1000.0) / 1000.0, 0.0, 1.0), unit="1")
    parameters = {"CA_ROTOR_COUNT": 4.0, "MAV_TYPE": 2.0} if autopilot == "PX4" else flight.parameters
    return replace(flight, signals=signals, autopilot=autopilot, parameters=parameters, warnings=())


def test_ardupilots_raw_sensors_are_read_at_the_times_of_their_samples(tmp_path):
    flight = hovering("ArduPilot")
    read = raw_of(flight, tmp_path, write_dataflash, "x.bin")
    for name in ("raw_accel", "raw_gyro"):
        assert read[name].rate_hz == pytest.approx(500.0)
        offset = read[name].time[0] - flight[name].time[0]
        np.testing.assert_allclose(read[name].time - offset, flight[name].time, atol=2e-6)
        np.testing.assert_allclose(read[name].values, flight[name].values, rtol=1e-5, atol=1e-5)
    assert read["raw_accel"].source == "ACC"
    silent = replace(flight, signals={k: v for k, v in flight.signals.items() if k != "esc"})
    assert "raw_accel" not in raw_of(silent, tmp_path, write_dataflash, "silent.bin").signals  # nobody needs it


def test_px4s_blocks_of_samples_are_read_at_their_times(tmp_path):
    flight = hovering("PX4")
    read = raw_of(flight, tmp_path, write_ulog, "x.ulg")
    for name, step in (("raw_accel", 9.80665 / 2048.0), ("raw_gyro", np.radians(2000.0) / 32768.0)):
        found, true = read[name], flight[name]
        n = len(found)
        assert n == len(true) // 8 * 8 and found.source == f"sensor_{name[4:]}_fifo"
        np.testing.assert_allclose(found.time, true.time[:n], atol=3e-6)
        np.testing.assert_allclose(found.values, true.values[:n], atol=0.51 * step)
    assert values(heard(read)) == pytest.approx([4.0, 3.0, 5.0, 2.0], rel=0.1)
    silent = replace(flight, signals={k: v for k, v in flight.signals.items() if k != "esc"})
    assert "raw_accel" not in raw_of(silent, tmp_path, write_ulog, "silent.ulg").signals


class Batches:
    """A log of ISBH and ISBD records, as `dataflash_raw` reads them."""

    def __init__(self, rate, batches):
        """batches: (number, type, start [s], scale, samples (n, 3))."""
        self.counts = {"ISBH": 1, "ISBD": 1}
        self.head = np.array([[n, what, 0, scale, (start + 0.3) * 1e6, start * 1e6, rate] for n, what, start, scale, _ in batches], float)
        self.times = np.array([start + 0.3 for _, _, start, _, _ in batches])
        parts = [(n, k, s[32 * k : 32 * k + 32]) for n, _, _, scale, s in batches for k in range(len(s) // 32)]
        scales = {n: scale for n, _, _, scale, _ in batches}
        xyz = np.stack([np.round(part * scales[n]) for n, _, part in parts]).astype("<i2")
        self.data = {"N": np.array([n for n, _, _ in parts]), "seqno": np.array([k for _, k, _ in parts])}
        self.data |= {axis: xyz[..., k] for k, axis in enumerate("xyz")}

    def table(self, name, columns, where=None):
        if name == "ISBH":
            return self.times, self.head, {}
        return Table(name, np.arange(len(self.data["N"])), self.data, {})


def test_ardupilots_batches_of_samples_are_put_together():
    rng = np.random.default_rng(4)
    accel = [rng.normal(0.0, 5.0, (256, 3)) for _ in range(3)]
    gyro = [rng.normal(0.0, 0.5, (256, 3)) for _ in range(3)]
    rows = [(2 * k, 0, 1.0 + k, 800.0, a) for k, a in enumerate(accel)] + [(2 * k + 1, 1, 1.4 + k, 8000.0, g) for k, g in enumerate(gyro)]
    log = Batches(1000.0, rows)
    found = dataflash_raw.read(log, None, log.table)
    for name, parts, start, scale in (("raw_accel", accel, 1.0, 800.0), ("raw_gyro", gyro, 1.4, 8000.0)):
        signal = found[name]
        assert len(signal) == 768
        times = np.concatenate([start + k + np.arange(256) / 1000.0 for k in range(3)])
        np.testing.assert_allclose(signal.time, times, atol=1e-9)
        np.testing.assert_allclose(signal.values, np.concatenate(parts), atol=0.51 / scale)


def test_a_sensor_that_is_faster_than_needed_is_thinned():
    time = np.arange(0.0, 2.0, 1.0 / 8000.0)
    signal = raw_sensors.build("raw_gyro", time, np.zeros((time.size, 3)), "sensor_gyro_fifo")
    assert signal.rate_hz == pytest.approx(1000.0)
    assert raw_sensors.build("raw_gyro", time[::800], np.zeros((len(time[::800]), 3)), "sensor_gyro") is None


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(("autopilot", "name"), [("ardupilot", "x.bin"), ("px4", "x.ulg")])
def test_a_simulated_flight_in_which_an_imbalance_grew(autopilot, name, tmp_path):
    plan = scenario.from_table(
        {
            "duration_s": 50.0, "seed": 3, "autopilot": autopilot, "wind": {"speed_m_s": 3.0},
            "airframe": {"frame": "quad-x", "rotor_spread": 0.1},
            "sensors": {"imbalance": 8.0, "imbalance_rotor": 2, "imbalance_times": 3.0, "imbalance_onset_s": 28.0},
            "logging": {"esc": True, "raw_hz": 1000.0},
        }
    )  # fmt: skip
    simulate(plan).write(tmp_path / name)
    found = rotorwatch.diagnose(tmp_path / name)
    assert [(e.kind, e.rotors) for e in found.events if "balance" in e.kind] == [(kinds.UNBALANCED, (2,))]
    (event,) = (e for e in found.events if e.kind == kinds.UNBALANCED)
    assert event.onset_s == pytest.approx(28.0, abs=2.0) and event.extra["ratio"] == pytest.approx(3.0, rel=0.3)
    assert found.verdict == "healthy"


def test_unlike_tracks_of_blades_shake_once_per_turn_along_the_axis_and_where_they_pass():
    table = {
        "duration_s": 40.0, "seed": 3, "wind": {"speed_m_s": 3.0}, "airframe": {"frame": "quad-x", "rotor_spread": 0.1},
        "logging": {"esc": True, "raw_hz": 1000.0},
    }  # fmt: skip
    smooth, rough = (simulate(scenario.from_table({**table, "sensors": {"track_error": size}})).flight for size in (0.0, 6.0))
    shake = rough["raw_accel"].values - smooth["raw_accel"].values
    assert np.abs(shake[:, :2]).max() < 1e-9 < np.abs(shake[:, 2]).max()
    air = ((10.0, 30.0),)
    before, after = (imbalances.listen(flight, 4, air) for flight in (smooth, rough))
    assert values(before).max() < 0.5 < 1.5 < np.nanmax(values(after))
    assert max(f.blades for f in after.figures) > 1.5


def test_an_unbalance_put_into_a_flight_is_found_there_alone():
    flight = flown([1.0, 0.5, 1.2, 0.6], duration=30.0)
    for rotor, own in enumerate((1.0, 0.5, 1.2, 0.6), 1):
        more = imbalance.inject(flight, rotor, np.sqrt(3.0) * own, 15.0, phase=np.pi / 2)
        assert [f.rotors for f in unbalanced.findings(heard(more))] == [(rotor,)]
    for wrong in (
        {"rotor": 7}, {"onset": 99.0}, {"sensor": "accel"},
    ):  # fmt: skip
        with pytest.raises(ConfigError):
            imbalance.inject(flight, **({"rotor": 1, "amount": 1.0, "onset": 15.0} | wrong))


def test_drawn_flights_have_the_imbalance_that_they_say():
    drawn = imbalance.simulated(5, 4, 40.0)
    assert drawn.rotor == 0 and not unbalanced.findings(heard(drawn.flight))
    doubled = imbalance.simulated(4, 4, 60.0, times=3.0)
    assert [f.rotors for f in unbalanced.findings(heard(doubled.flight))] == [(doubled.rotor,)]
