"""Healthy flights are assessed before anything is learned from them: which are set aside, and with which words."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, logs
from rotorwatch.calibrate import calibrate
from rotorwatch.diagnose import diagnose
from rotorwatch.errors import ConfigError, VehicleError
from rotorwatch.witnesses.healthy import baselines
from rotorwatch.witnesses.healthy import whole_flight as wf
from rotorwatch.witnesses.healthy.baselines import Candidate, healthy, settle, unlike
from rotorwatch_lab.experiments.inject import inject
from rotorwatch_lab.experiments.studies import compare_flights
from test_calibrate import QUAD, flown, on_the_ground

SHARED = Path(__file__).resolve().parents[2] / "shared" / "flights"
shared = pytest.mark.skipif(not SHARED.is_dir(), reason="needs the test logs in ../shared/flights")


def names(kept):
    return [one.name for one in kept]


def test_one_flight_need_not_be_a_list(tmp_path):
    """A name is a file, not a sequence of letters."""
    assert baselines.several("x.bin") == ("x.bin",)
    assert baselines.several(tmp_path) == (tmp_path,)
    flight = flown()
    assert baselines.several(flight) == (flight,)
    with pytest.raises(Exception, match=r"nowhere\.bin: no such file"):
        diagnose(flight, baseline="nowhere.bin")
    assert "calibrated on one.bin" in calibrate(flight).source


def test_a_baseline_of_another_frame_is_named_in_one_sentence():
    with pytest.raises(VehicleError, match=r"hexa.bin: its frame is ardupilot-hexa-x with 6 rotors, not ardupilot-quad-x with 4"):
        diagnose(flown(), baseline=flown("hexa.bin", frame=2, rotors=6))


def test_a_frame_with_as_many_rotors_elsewhere_is_another_frame():
    plus = flown("plus.bin")
    plus = replace(plus, parameters={**plus.parameters, "FRAME_TYPE": 0})
    answer = diagnose(flown(), baseline=[plus, flown("two.bin")])
    assert answer.baseline == "1 healthy flight of the same build"
    (said,) = [w for w in answer.warnings if w.startswith("baseline: ")]
    assert "plus.bin was set aside" in said and "ardupilot-quad-plus, not ardupilot-quad-x" in said


def test_a_vehicle_of_another_frame_is_refused_and_one_that_differs_is_mentioned():
    with pytest.raises(VehicleError, match="commands 4 rotors but the frame ardupilot-hexa-x"):
        settle(flown(), airframes.named("ardupilot-hexa-x"), (), diagnose)
    _, source, reported = settle(flown(), airframes.named("ardupilot-quad-plus"), (), diagnose)
    assert source == "none" and "the log says ardupilot-quad-x" in reported[0] and "ardupilot-quad-plus" in reported[0]
    assert settle(flown(), QUAD, (), diagnose)[2] == ()


def test_a_flight_says_nothing_about_itself():
    with pytest.raises(VehicleError, match="cannot serve as its own baseline"):
        diagnose(flown(), baseline=flown())
    kept, aside = healthy([flown(), flown(), flown("two.bin")], diagnose)
    assert names(kept) == ["one.bin", "two.bin"] and "same flight as one.bin" in aside[0]


def test_a_faulty_flight_is_no_baseline():
    weak = replace(inject(flown("weak.bin"), QUAD, 2, 0.4, 25.0), name="weak.bin")
    kept, aside = healthy([weak, flown("two.bin"), flown("three.bin")], diagnose)
    assert names(kept) == ["two.bin", "three.bin"]
    assert "weak.bin was set aside: on its own it is diagnosed as" in aside[0] and "rotor 2" in aside[0]
    with pytest.raises(VehicleError, match=r"No healthy flight is left.*weak.bin"):
        diagnose(flown(), baseline=[weak])


def test_a_flight_too_short_to_be_assessed_is_not_suspicious():
    short = flown("short.bin").until(7.0)
    assert diagnose(short).verdict == "inconclusive"
    assert names(healthy([short], diagnose)[0]) == ["short.bin"]


def slower(flight):
    """Every second sample of it: 5 Hz to 10 Hz."""
    thin = {k: replace(s, time=s.time[::2], values=s.values[::2], valid=s.valid[::2]) for k, s in flight.signals.items()}
    return replace(flight, signals=thin)


def faster(flight, times=2):
    dense = {
        k: replace(
            s,
            time=np.arange(0.0, flight.duration, 0.1 / times),
            values=np.repeat(s.values, times, axis=0),
            valid=np.repeat(s.valid, times, axis=0),
        )
        for k, s in flight.signals.items()
    }
    return replace(flight, signals=dense)


def test_another_logging_rate_is_set_aside():
    fast = faster(flown("fast.bin"))
    assert "another rate: assessed every 0.05 s, not every 0.10 s" in unlike(Candidate(fast), Candidate(flown()))
    assert names(healthy([fast, flown("two.bin")], diagnose, of=Candidate(flown()))[0]) == ["two.bin"]


def set_to(flight, **parameters):
    return replace(flight, parameters={**flight.parameters, **parameters})


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (lambda: flown("heavy.bin", hover=0.64), "hovers at 64 % of full thrust, not at 40 %"),
        (lambda: set_to(flown("curve.bin"), MOT_THST_EXPO=0.0), "thrust curve .*expo 0.* rises differently"),
        (lambda: set_to(flown("wide.bin"), MOT_SPIN_MIN=0.02), "thrust curve .*1020 to 1950"),
    ],
)
def test_what_cannot_be_of_one_aircraft(other, says):
    import re

    assert re.search(says, unlike(Candidate(other()), Candidate(flown())))


@pytest.mark.parametrize(
    "other",
    [
        lambda: flown("full battery.bin", hover=0.33),
        lambda: flown("trim.bin", offset=(0.12, 0.01, -0.12, -0.01)),
        lambda: set_to(flown("limits.bin"), MOT_SPIN_MIN=0.166, MOT_SPIN_MAX=0.942),  # what a real build's two days differ by
    ],
)
def test_what_can_be_of_one_aircraft(other):
    assert unlike(Candidate(other()), Candidate(flown())) == ""


@pytest.mark.thorough
def test_motion_gains_that_one_aircraft_cannot_have(monkeypatch):
    """Simulated quads in gusts, one of them of four times the inertia: the gains say so, and only then."""

    def fly(seed):
        (flight,) = compare_flights.simulate(QUAD, [0.0], [0], [0.0], np.random.default_rng(seed))
        one = Candidate(replace(flight, name=f"flight {seed}"), QUAD)
        one.__dict__["air"] = ((compare_flights.LANDED_S, flight.duration),)
        return one

    first, second = fly(1), fly(2)
    monkeypatch.setattr(compare_flights, "INERTIA", compare_flights.INERTIA * np.array([4.0, 4.0, 1.0]))
    heavy = fly(3)
    assert unlike(second, first) == ""
    assert "a command turns it" in unlike(heavy, first) and "as slowly" in unlike(heavy, first)
    assert "as fast" in unlike(first, heavy)


def test_most_decide_what_the_build_is_and_a_draw_is_an_error():
    kept, aside = healthy([flown("heavy.bin", hover=0.64), flown(), flown("two.bin")], diagnose)
    assert names(kept) == ["one.bin", "two.bin"] and "heavy.bin was set aside" in aside[0]
    with pytest.raises(VehicleError, match=r"two.bin and heavy.bin are not of one build|heavy.bin .*one build only"):
        healthy([flown("heavy.bin", hover=0.64), flown("two.bin")], diagnose)


DAMAGED = (0.1 + 0.35, 0.0, -0.1, 0.0)


def test_the_one_that_hovers_otherwise_is_found_by_the_others():
    flights = [flown("a.bin"), flown("bent.bin", offset=DAMAGED), flown("b.bin"), flown("c.bin")]
    kept, aside = healthy(flights, diagnose)
    assert names(kept) == ["a.bin", "b.bin", "c.bin"]
    assert aside == ("bent.bin was set aside: its rotors share the load differently than in the 3 other flights",)


def test_of_two_that_differ_nobody_can_say_which_is_wrong():
    with pytest.raises(VehicleError, match=r"a.bin and bent.bin hover too differently.*add a third"):
        healthy([flown("a.bin"), flown("bent.bin", offset=DAMAGED)], diagnose)


def test_what_the_healthy_ones_of_a_set_cost():
    """Five healthy flights drawn from the model lose one in FALSE_ALARM of the cases, not in each of five tests."""
    from test_whole_flight import build, drawn

    rng, count, lost = np.random.default_rng(3), 200, 0
    for _ in range(count):
        spreads = build(rng, QUAD)
        flights = [drawn(rng, QUAD, spreads[0], spreads[1]) for _ in range(5)]
        rare = [wf.rarity(f, [g for g in flights if g is not f]) for f in flights]
        lost += min(rare) < wf.FALSE_ALARM / 5
    assert lost <= count * wf.FALSE_ALARM + 4 * np.sqrt(count * wf.FALSE_ALARM)


def test_unreadable_frames_and_flights_on_the_ground_are_named():
    nameless = replace(flown("nameless.bin"), autopilot="", parameters={})
    kept, aside = healthy([nameless, flown("two.bin"), on_the_ground()], diagnose)
    assert names(kept) == ["two.bin"]
    assert "does not say which airframe flew" in aside[0] and "ground.bin was set aside: it has no flight" in aside[1]
    with pytest.raises(ConfigError, match="at least one"):
        healthy([], diagnose)


@shared
def test_real_flights():
    """The healthy real flights pass, each against the others; a damaged one among them does not."""
    rrc = SHARED / "ardupilot-real-rrc"
    good = [logs.read(rrc / f"good_prop_{how}_2.bin.xz") for how in ("hover", "straight_line")]
    assert healthy(good, diagnose)[1] == ()
    normal = [logs.read(p) for p in sorted((SHARED / "crazypad").glob("normal_flight__E9*.xz"))]
    assert len(healthy(normal, diagnose)[0]) == len(normal) == 3
    cut = logs.read(next((SHARED / "crazypad").glob("cut_M2_3.5mm*E9*.xz")))
    kept, aside = healthy([*normal, cut], diagnose)
    assert len(kept) == 3 and cut.name in aside[0]
    with pytest.raises(VehicleError, match="two cannot show"):
        healthy([good[0], logs.read(rrc / "25_mm_cut_hover_2.bin.xz")], diagnose)
