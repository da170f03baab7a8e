"""From a log to a verdict, end to end: the command on real files, and what it promises whatever the flight."""

import csv
import functools
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rotorwatch
from rotorwatch import airframes, diagnose, logs
from rotorwatch.engine import definition, driver
from rotorwatch.engine.motion import air_spans, allocation
from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.flight import Signal
from rotorwatch.report import info

ROOT = Path(__file__).resolve().parents[1]
FLIGHTS = ROOT / ".." / "shared" / "flights"
SAMPLES = ROOT / "src" / "rotorwatch" / "samples"
HEALTHY = "quadx_healthy_hover.bin.xz"
FAULTY, ROTOR, LOSS, ONSET = "hexax_m3_mul0.80_square_wind.bin.xz", 3, 0.37, 47.60
SITL_FAULTS = {  # log: rotor, onset s
    "quadx_m1_mul0.90_hover.bin.xz": (1, 42.55),
    "quadx_m2_mul0.80_hover_wind.bin.xz": (2, 42.55),
    FAULTY: (ROTOR, ONSET),
}


def sample(name):
    path = SAMPLES / name
    return path if path.exists() else shared("ardupilot-sitl/" + name)


def shared(name):
    path = FLIGHTS / name
    if not path.exists():
        pytest.skip(f"the flight logs for tests are not here (../shared/flights/{name})")
    return path


@functools.cache
def flight(path):
    return logs.read(path)


@functools.cache
def assessed(path):
    return diagnose(flight(path))


def losses(diagnosis):
    return [e for e in diagnosis.events if e.kind == "loss_of_effectiveness"]


def command(*arguments, code):
    done = subprocess.run(
        [sys.executable, "-m", "rotorwatch.commands.cli", "diagnose", *map(str, arguments)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


# The command


def test_a_healthy_flight_exits_with_0_and_says_so():
    answer = json.loads(command(sample(HEALTHY), "--json", code=0).stdout)
    assert answer["schema"] == 3 and answer["verdict"] == "healthy" and answer["events"] == []
    assert [r["rotor"] for r in answer["rotors"]] == [1, 2, 3, 4]
    assert all(r["status"] == "healthy" and r["loss"] == 0 for r in answer["rotors"])
    flight = answer["flight"]
    assert flight["rotors"] == 4 and "quad" in flight["frame"]
    assert 0 < flight["airborne_s"][0] < flight["airborne_s"][1] <= flight["duration_s"]


def test_a_weak_rotor_exits_with_1_and_is_named_with_its_loss_and_time():
    answer = json.loads(command(sample(FAULTY), "--json", code=1).stdout)
    assert answer["verdict"] == "fault" and f"rotor {ROTOR}" in answer["reason"]
    (event,) = [e for e in answer["events"] if e["kind"] == "loss_of_effectiveness"]
    assert event["rotors"] == [ROTOR] and event["alternatives"] == [] and event["end_s"] is None
    assert 0 < event["detected_s"] - ONSET < 0.8
    assert abs(event["onset_s"] - ONSET) < 0.5
    assert abs(event["loss"][0] - LOSS) < 0.03
    assert event["interval"][0][0] <= LOSS + 0.02 and LOSS - 0.02 <= event["interval"][0][1]
    assert event["probability"] > 0.9
    states = {r["rotor"]: r for r in answer["rotors"]}
    assert states[ROTOR]["status"] == "degraded" and abs(states[ROTOR]["loss"] - LOSS) < 0.03
    assert all(states[k]["status"] == "healthy" for k in states if k != ROTOR)


@pytest.mark.parametrize("name", ["empty.bin", "header_only.bin"])
def test_a_hopeless_file_exits_with_2_and_one_sentence(name):
    done = command(shared("corrupt/" + name), "--json", code=2)
    assert done.stdout == "" and len(done.stderr.strip().splitlines()) == 1
    assert name in done.stderr


# Live: nothing of the future


@pytest.mark.parametrize("name", SITL_FAULTS)
def test_an_event_is_there_as_soon_as_it_was_announced(name):
    """Cut 0.2 s after the announcement: what a live observer would have had says the same, at the same time."""
    path = sample(name)
    (event,) = losses(assessed(path))
    assert event.rotors == (SITL_FAULTS[name][0],)
    (live,) = losses(diagnose(flight(path).until(event.detected_s + 0.2)))
    assert live.detected_s == event.detected_s and live.rotors == event.rotors
    assert losses(diagnose(flight(path).until(event.detected_s - 0.2))) == []


def spoilt(flight, after):
    """The same flight until `after`; then every value is garbage and messages stop."""
    rng = np.random.default_rng(0)

    def garbage(signal):
        late = (signal.time > after)[:, None]
        size = np.abs(signal.values).max(axis=0, initial=1.0)
        return replace(signal, values=np.where(late, size * rng.uniform(-3, 3, signal.values.shape), signal.values))

    return replace(
        flight, signals={k: garbage(s) for k, s in flight.signals.items()}, messages=tuple(m for m in flight.messages if m.time <= after)
    )


@pytest.mark.parametrize("later", [0.3, 3.0])  # sooner, garbage ends the loss, and one of a moment is none
def test_what_was_announced_does_not_depend_on_what_came_later(later, monkeypatch):
    path = sample(FAULTY)
    (event,) = losses(assessed(path))
    after = event.detected_s + later
    # Garbage is no log to trust, and the answer as a whole says so; what a live observer was given stands.
    monkeypatch.setattr("rotorwatch.engine.motion.trust.TESTS", ())
    found = [e for e in losses(diagnose(spoilt(flight(path), after))) if e.detected_s <= after]
    assert [(e.detected_s, e.rotors) for e in found][:1] == [(event.detected_s, event.rotors)]
    before = event.detected_s - 0.5
    assert [e for e in losses(diagnose(spoilt(flight(path), before))) if e.detected_s <= before] == []


# Healthy flights


HEALTHY_FLIGHTS = [
    "ardupilot-sitl/quadx_healthy_hover.bin.xz",
    "ardupilot-sitl/hexax_healthy_square_wind.bin.xz",
    "ardupilot-sitl/octa_healthy_circle_wind.bin.xz",
    "ardupilot-real-rrc/good_prop_hover_2.bin.xz",
    "ardupilot-real-rrc/good_prop_straight_line_2.bin.xz",
    "ardupilot-real-dronekit/log171.bin.xz",
    "ardupilot-real-twoflights/sample.bin.xz",
]


def test_every_flight_known_to_be_healthy_is_in_the_list():
    with shared("truth.csv").open() as table:
        rows = [r for r in csv.DictReader(table) if r["healthy"] == "1" and r["autopilot"].startswith("Ardu")]
    known = {r["path"].removeprefix("shared/flights/") for r in rows}
    assert known <= {*HEALTHY_FLIGHTS}


@pytest.mark.parametrize("name", HEALTHY_FLIGHTS)
def test_no_false_alarm(name):
    diagnosis = assessed(shared(name))
    assert losses(diagnosis) == [], diagnosis.reason
    if name.endswith("log171.bin.xz"):  # it lands, and turns over on the ground with its motors on
        assert diagnosis.verdict == "inconclusive" and "turned over on the ground" in diagnosis.reason
        return
    if name.endswith("good_prop_hover_2.bin.xz"):  # its wind hides 21 % of a rotor, and 20 % would matter
        assert diagnosis.verdict == "inconclusive" and "up to 21 % of one rotor could have gone" in diagnosis.headline
        return
    assert diagnosis.verdict == "healthy" and diagnosis.exit_code == 0
    assert all(r.loss == 0 and r.interval[1] > 0 for r in diagnosis.rotors)


def test_two_hops_in_one_file_are_both_flown_and_assessed():
    diagnosis = assessed(shared("ardupilot-real-twoflights/sample.bin.xz"))
    hops = diagnosis.flight["hops"]
    assert len(hops) >= 2 and hops[-1][0] - hops[0][1] > 500  # the gap between the flights
    trace = diagnosis.trace
    learning = [span for span in trace.blind if "take-off" in span[2]]
    assert len(learning) == len(hops)
    for start, end in hops:
        inside = (trace.time > start + 9) & (trace.time < end)
        assert not inside.any() or np.abs(trace.evidence["rotor 1"][inside]).max() > 0


# What the answer says of itself


def test_blind_time_without_a_baseline_is_8_s_and_said():
    diagnosis = assessed(sample(HEALTHY))
    (start, end, why), *_ = diagnosis.trace.blind
    assert start == pytest.approx(diagnosis.flight["airborne_s"][0], abs=1e-3) and why
    assert 0 < end - start <= 8.0
    assert any("8 s" in a and "--baseline" in a for a in diagnosis.assumptions)
    assert "this flight" in diagnosis.baseline or "own" in diagnosis.baseline


def test_blind_time_with_a_baseline_is_3_s():
    healthy = flight(sample(HEALTHY))
    motors = healthy["motors"]
    other = motors.values + np.random.default_rng(0).normal(0.0, 2.0, motors.values.shape)
    diagnosis = diagnose(
        healthy, baseline=replace(healthy, name="other", signals=healthy.signals | {"motors": replace(motors, values=other)})
    )
    (start, end, _), *_ = diagnosis.trace.blind
    assert 0 < end - start <= 3.0
    assert "1 healthy flight" in diagnosis.baseline
    assert not any("cannot be assessed without" in a for a in diagnosis.assumptions)
    assert diagnosis.whole_flight is not None and losses(diagnosis) == []


def test_a_log_without_motor_outputs_is_inconclusive_and_says_why():
    healthy = flight(sample(HEALTHY))
    bare = replace(healthy, signals={k: s for k, s in healthy.signals.items() if k != "motors"})
    diagnosis = diagnose(bare)
    assert diagnosis.verdict == "inconclusive" and diagnosis.exit_code == 3
    assert "motor outputs" in diagnosis.reason
    assert [r.status for r in diagnosis.rotors] == ["unobservable"] * 4
    json.loads(diagnosis.to_json())


def test_a_flight_that_never_took_off_is_inconclusive():
    healthy = flight(sample(HEALTHY))
    motors = healthy["motors"]
    ground = replace(healthy, signals={**healthy.signals, "motors": replace(motors, values=0 * motors.values + 1000)})
    diagnosis = diagnose(ground)
    assert diagnosis.verdict == "inconclusive" and "took off" in diagnosis.reason


def test_a_flight_of_a_few_seconds_is_inconclusive():
    healthy = flight(sample(HEALTHY))
    lift_off = assessed(sample(HEALTHY)).flight["airborne_s"][0]
    diagnosis = diagnose(healthy.until(lift_off + 5.0))
    assert diagnosis.verdict == "inconclusive" and losses(diagnosis) == []
    assert diagnosis.headline.startswith("Not assessed: 6 s of flight are needed, 5")


def test_an_unknown_estimator_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="default"):
        diagnose(sample(HEALTHY), estimator="crystal ball")


def test_progress_is_reported_in_order_and_all_the_way(monkeypatch):
    """No step of a diagnosis, nor of `info`, is silent: of a long log each takes seconds."""
    for module in (driver, air_spans):
        monkeypatch.setattr(module, "pieces", functools.partial(definition.pieces, most=1000))
    reported = []
    diagnose(sample(HEALTHY), progress=lambda share, text="": reported.append(share))
    assert reported == sorted(reported) and reported[-1] == 1.0 and max(np.diff(reported)) < 0.08
    reported = []
    info.info(flight(sample(HEALTHY)), progress=reported.append)
    assert reported == sorted(reported) and max(np.diff([0.0, *reported, 1.0])) < 0.25


# Other faults


def test_a_stuck_output_is_an_override_of_its_rotor_and_no_loss():
    healthy = flight(sample(HEALTHY))
    motors = healthy["motors"]
    values = motors.values.copy()
    values[motors.time > 60.0, 1] = values[motors.time > 60.0, 1][0] + 40.0
    diagnosis = diagnose(replace(healthy, signals={**healthy.signals, "motors": Signal(motors.time, values, motors.columns, motors.unit)}))
    overrides = [e for e in diagnosis.events if e.kind == "output_override"]
    assert [e.rotors for e in overrides] == [(2,)]
    assert 60.0 <= overrides[0].detected_s < 62.0
    assert not any(2 in e.rotors for e in losses(diagnosis))
    assert diagnosis.verdict == "fault" and "output 2" in diagnosis.reason


def weakened(flight, rotor, loss, spans, response_s=0.4):
    """The flight as if `rotor` (1-based) had lost `loss` during spans: the rotor is asked for more, the motion is the same.

    The rate controller's own signal would have to be changed alike, so it is left out.
    """
    vehicle = airframes.identify(flight)
    motors = flight["motors"]
    ratio = allocation.battery_ratio(flight, motors.time)
    share = np.zeros(len(motors))
    for start, end in spans:
        on, off = motors.time >= start, motors.time >= end
        share[on] = 1.0 - np.exp(-(motors.time[on] - start) / response_s)
        share[off] *= np.exp(-(motors.time[off] - end) / response_s)
    k = rotor - 1
    wanted = vehicle.curve(motors.values[:, k], ratio) * (1.0 + share * (1.0 / (1.0 - loss) - 1.0))
    grid = np.linspace(vehicle.curve.u_min, vehicle.curve.u_max, 2000)
    values = motors.values.copy()
    for i in np.flatnonzero(share > 0):
        values[i, k] = np.round(np.interp(wanted[i], vehicle.curve(grid, ratio[i]), grid))
    kept = {name: s for name, s in flight.signals.items() if name != "control"}
    return replace(flight, signals={**kept, "motors": Signal(motors.time, values, motors.columns, motors.unit)})


def test_an_intermittent_loss_is_announced_ended_and_announced_again():
    spans = ((50.0, 62.0), (80.0, 92.0))
    diagnosis = diagnose(weakened(flight(sample(HEALTHY)), 2, 0.25, spans))
    events = losses(diagnosis)
    assert [e.rotors for e in events] == [(2,), (2,)]
    for event, (start, end) in zip(events, spans, strict=True):
        assert start < event.detected_s < start + 2.0 and abs(event.onset_s - start) < 0.8
        assert event.end_s is not None and abs(event.end_s - end) < 1.5
        assert abs(event.loss[0] - 0.25) < 0.05
    assert diagnosis.verdict == "fault"


@pytest.mark.parametrize("loss", [0.1, 0.4])
def test_an_injected_loss_is_measured(loss):
    (event,) = losses(diagnose(weakened(flight(sample(HEALTHY)), 4, loss, ((60.0, 1e9),))))
    assert event.rotors == (4,) and event.end_s is None and 60.0 < event.detected_s < 62.0
    assert abs(event.loss[0] - loss) < 0.03
    assert event.interval[0][0] - 0.02 <= loss <= event.interval[0][1] + 0.02


# Damaged files

CORRUPT = sorted(p.name for p in (FLIGHTS / "corrupt").glob("*") if p.suffix != ".md")


@pytest.mark.parametrize("name", CORRUPT or ["missing"])
def test_a_damaged_file_gives_one_sentence_or_a_verdict_that_is_never_fault(name):
    path = shared("corrupt/" + name)
    try:
        diagnosis = diagnose(path)
    except RotorwatchError as error:
        assert len(str(error)) > 20 and "\n" not in str(error)
        return
    assert diagnosis.verdict != "fault"
    json.loads(diagnosis.to_json())


@pytest.mark.parametrize("estimator", ["default", "ekf"])
def test_a_flight_that_is_assessed_twice_gets_the_same_answer(estimator):
    """A case is not changed by its answer, nor by being assessed by other outputs: no sentence is said twice."""
    from rotorwatch.diagnose import estimated, prepare

    ready = prepare(flight(sample("quadx_healthy_hover.bin.xz")))
    before = ready.assumptions, ready.warnings
    done = estimated(ready, estimator)
    assessed = ready.by(done)
    first, again = assessed.answer(), assessed.answer()
    assert assessed.assumptions == (*before[0], *done.assumptions)
    assert (first.assumptions, first.warnings, first.end.headline) == (again.assumptions, again.warnings, again.end.headline)
    assert (ready.assumptions, ready.warnings) == before
    assert estimated(ready, estimator).assumptions == done.assumptions


def test_a_fast_table_with_its_vehicle_is_assessed_by_a_published_method(monkeypatch):
    """A table names no frame: the vehicle that is given is asked everywhere, also whether a fast log hovers."""
    from rotorwatch.witnesses.aerobatic import assess

    monkeypatch.setattr(assess, "LEAST_HZ", 1.0)
    table, craft = replace(flight(sample(HEALTHY)), autopilot="", parameters={}), airframes.named("ardupilot-quad-x")
    with pytest.raises(rotorwatch.VehicleError, match="--vehicle"):
        diagnose(table, estimator="ekf")
    assert diagnose(table, vehicle=craft, estimator="ekf").verdict == "healthy"
    assert rotorwatch.estimate(table, "ekf", vehicle=craft)
