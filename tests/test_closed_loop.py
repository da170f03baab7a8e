"""Flights in which what is believed of the rotors drives the allocation: they stay up where they would not, and nothing is foreseen."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rotorwatch.engine.bindings import program
from rotorwatch.engine.estimator.estimator_sizes import PLACES
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import batch, closed_loop, plan, store
from rotorwatch_lab.control import certified, spinning
from rotorwatch_lab.control.allocation import believed, rows
from rotorwatch_lab.simulation import control, loop, prepare, reconfigured, record_of, scenario
from rotorwatch_lab.simulation.multirotor import MULTIROTOR

pytest.importorskip("pyarrow")

PLAN = """
name = "small"
seed = 5
healthy = 0.25
estimators = ["default"]
detectors = []
[scenario]
duration_s = 28.0
rate_hz = 200
[scenario.airframe]
frame = "hexa-x"
thrust_to_weight = 2.2
[scenario.trajectory]
altitude_m = 5.0
land = false
[scenario.wind]
speed_m_s = 2.0
[scenario.logging]
profile = "fast"
[[faults]]
kind = "complete loss"
onset_s = 20.0
"""
WIDTH, DRIVERS = 4, ("nobody", "truth", "default")


@pytest.fixture
def run(run):
    """What is said: output, or the error."""

    def call(*argv):
        code, out, err = run(*argv)
        return code, out if code == 0 else err

    return call


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "small.toml"
    path.write_text(PLAN)
    return path, plan.read(path)


@pytest.fixture(scope="module")
def folder(asked, tmp_path_factory):
    """What the drivers made of the plan's first flights."""
    out = tmp_path_factory.mktemp("flown") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "CPU_WIDTH", WIDTH)
        closed_loop.run(asked[0], DRIVERS, out, WIDTH, jobs=1)
    return out


def test_a_hexa_without_a_rotor_falls_unless_somebody_notices(folder):
    rows = store.Folder(folder).table().to_pylist()

    def of(driver, faulty):
        return [r for r in rows if r["method"] == driver and r["faulty"] == faulty]

    def survived(driver, faulty):
        return [r["survived"] for r in of(driver, faulty)]

    assert len(survived("nobody", True)) >= 2 and not any(survived("nobody", True))
    assert all(survived("truth", True)) and all(survived("default", True))
    assert len(survived("nobody", False)) >= 1 and all(survived("nobody", False) + survived("default", False))
    assert all(r["first_s"] == pytest.approx(closed_loop.DELAY_S) for r in of("truth", True))
    for r in of("default", True):
        assert not r["false"] and 0.0 < r["first_s"] < 2.0
    assert all(r["beliefs"] == 0 and not r["false"] for r in of("default", False))
    assert any(r["right"] and r["recovered_s"] is not None for r in of("default", True))


def planned(**changes):
    asked = {
        "seed": 3, "duration_s": 20.0, "rate_hz": 200, "airframe": {"frame": "quad-x", "thrust_to_weight": 2.0},
        "trajectory": {"land": False, "altitude_m": 6.0}, "wind": {"speed_m_s": 1.0},
        "faults": [{"kind": "loss", "rotor": 2, "onset_s": 14.0, "strength": 0.6}],
    }  # fmt: skip
    s = scenario.from_table({**asked, **changes})
    return s, prepare.plan(s), rows(prepare.vehicle(s))


def flown(aircraft, s, numbers):
    return record_of(loop.fly_many(aircraft, loop.stack([numbers]), s.duration_s, s.rate_hz, s.record_hz), 0)


@pytest.mark.thorough
def test_nothing_changes_before_the_first_belief():
    """To the last bit the flight of the autopilot alone, as long as no entry has begun."""
    s, numbers, B = planned()
    craft = reconfigured.Reconfigured(B)
    never = flown(craft, s, numbers._replace(schedule=reconfigured.schedule(4, [], 2)))
    plain = flown(MULTIROTOR, s, numbers)
    np.testing.assert_allclose(never.p, plain.p, atol=1e-9)
    entry = reconfigured.entry(4, 10.0, [0.8, 1.0, 1.0, 1.0])
    later = flown(craft, s, numbers._replace(schedule=reconfigured.schedule(4, [entry], 2)))
    before = later.time < 10.0
    for name in ("p", "q", "command", "accel"):
        assert (getattr(later, name)[before] == getattr(never, name)[before]).all(), name
    assert np.abs(later.command[~before] - never.command[~before]).max() > 0.01


@pytest.mark.thorough
def test_a_quad_that_cannot_hover_still_turns_and_stays():
    """60 % of a rotor at twice the weight: while it turns it holds its place, and without that it comes down."""
    s, numbers, B = planned()
    craft = reconfigured.Reconfigured(B)
    e = np.array([1.0, 0.4, 1.0, 1.0])
    entry = closed_loop._entry(s, 14.2, e, e, e)
    assert entry.turning == 1.0
    for entries, stays in (([entry], True), ([], False)):
        record = flown(craft, s, numbers._replace(schedule=reconfigured.schedule(4, entries, 2)))
        late = record.time > 14.0
        assert ((-record.p[late, 2]).min() > 5.0) == stays
        if stays:
            assert np.abs(record.omega[late][-1, 2]) > 3.0 and np.hypot(*(record.p[-1, :2])) < 3.0


def test_all_explanations_drive_the_allocation():
    """While two rotors may be the one that is gone, commands suit both with their weights; by the estimate they suit the first only."""
    s, numbers, _ = planned(faults=[])
    e = np.ones((reconfigured.PLACES, 4))
    e[0, 1], e[1, 2] = 0.6, 0.7
    weights = np.array([0.7, 0.3, 0.0, 0.0])
    made = closed_loop._entry(s, 11.0, e[0], e[0], e[0], e, weights)
    schedule = reconfigured.schedule(4, [made], 1)
    craft = reconfigured.Reconfigured(rows(prepare.vehicle(s)), "posterior")
    now: Any = SimpleNamespace(target=control.Target(np.array([1.0, 0, 0, 0]), 0.0, 0.3))
    body, _, own = craft.start(numbers)
    demand, free = craft.mixed(numbers._replace(schedule=schedule), now, 12.0, body, np.zeros(3), np.zeros(3), own)
    wanted = craft.allocator.B @ np.full(4, 0.3)
    belief = believed(weights @ e, candidates=e, weights=weights)
    asked = craft.allocator.step(craft.allocator.init(), wanted, belief)[1]
    np.testing.assert_allclose(demand, asked.u, atol=1e-9)
    assert np.asarray(asked.error)[1:3] != pytest.approx(0.0, abs=1e-4) and free == 1.0
    np.testing.assert_allclose(craft.effectiveness(numbers._replace(schedule=schedule), 12.0), weights @ e)
    assert (np.asarray(craft.effectiveness(numbers._replace(schedule=schedule), 10.0)) == 1.0).all()


def test_explanations_become_entries():
    """The default diagnosis holds as many as an entry; what is expected of the rotors decides when one is entered."""
    assert reconfigured.PLACES == PLACES
    s, _, _ = planned(faults=[])
    T = 400
    ticks = SimpleNamespace(time=10.0 + 0.05 * np.arange(T), dt=0.05, thrust=np.ones((T, 4)), mode=np.full(T, 2.0))
    out = program.TickOutput(*[None] * len(program.TickOutput._fields))._replace(
        active=np.zeros((T, 4, 4), bool), each=np.zeros((T, 4, 4)), share=np.tile([1.0, 0, 0, 0], (T, 1)),
        theta=np.zeros((T, 4)), theta_sd=np.zeros((T, 4)),
    )  # fmt: skip
    assert closed_loop._next(s, ticks, out, [], "posterior") is None
    out.active[100:, 0, 0] = out.active[100:, 1, 1] = True
    out.each[100:, 0, 0], out.each[100:, 1, 1], out.theta[100:, 0] = 0.2, 0.3, 0.2
    out.share[100:] = [0.6, 0.4, 0, 0]
    made = closed_loop._next(s, ticks, out, [], "posterior")
    assert made is not None and made.since == pytest.approx(15.0 + closed_loop.DELAY_S)
    np.testing.assert_allclose(made.candidates[:2], [[0.8, 1, 1, 1], [1, 0.7, 1, 1]])
    np.testing.assert_allclose(made.weights, [0.6, 0.4, 0, 0])
    assert closed_loop._next(s, ticks, out, [made], "posterior") is None
    out.share[200:] = [1.0, 0, 0, 0]  # decided: rotor 2 is well, by 0.12
    later = closed_loop._next(s, ticks, out, [made], "posterior")
    assert later is not None and later.since == pytest.approx(20.0 + closed_loop.DELAY_S) and later.weights[1] == 0.0
    # By the estimate that is nothing new: the first explanation is the same.
    alone = closed_loop._next(s, ticks, out, [], "estimate")
    assert alone is not None
    np.testing.assert_allclose(alone.candidates, np.tile([0.8, 1, 1, 1], (4, 1)))
    assert closed_loop._next(s, ticks, out, [alone], "estimate") is None
    # A rotor that is left alone shows nothing: what was expected of it stays.
    ticks.thrust[150:, 1] = 0.0
    assert closed_loop._next(s, ticks, out, [made], "posterior") is None


def test_acting_is_certified_for_all_that_is_possible():
    """A loss of 30 %: acting is better where no less than half of it is possible, and never where no loss is."""
    _, _, B = planned(faults=[])
    craft, n = reconfigured.Reconfigured(B), 4
    allocate, demand = closed_loop._commands(craft), B @ np.full(4, 0.5)
    old, new = (np.asarray(allocate(demand, believed(e))) for e in (np.ones(n), np.array([1.0, 0.7, 1.0, 1.0])))
    np.testing.assert_allclose(old, 0.5, atol=1e-3)
    assert new[1] > old[1]

    def better(low, high, *others, commands=new):
        lower, upper = (np.array([1.0, e, 1.0, 1.0]) for e in (low, high))
        possible = certified.possible([1.0, 0.7, 1.0, 1.0], lower, upper, np.reshape(others, (-1, n)))
        assert len(possible) == 3 + len(others)
        return certified.is_better(craft.allocator, demand, old, commands, possible)

    assert better(0.55, 0.8) and not better(0.55, 0.95)
    assert not better(0.65, 0.75, np.ones(n))  # it may be none
    assert not better(0.65, 0.75, [0.7, 1.0, 1.0, 1.0])  # or the opposite rotor
    assert better(0.0, 0.8) and not better(0.0, 0.8, commands=old)  # of a dead rotor it makes no difference
    one = certified.possible([1.0, 0.0], [1.0, 0.0], [1.0, 0.0], np.zeros((0, 2)))
    np.testing.assert_array_equal(one, [[1.0, 0.0], [1.0, 0.0]])


def test_a_certified_entry_waits_until_nothing_else_is_possible_and_goes_as_far_as_the_interval_lets_it():
    s, numbers, B = planned(faults=[])
    T = 300
    ticks = SimpleNamespace(time=10.0 + 0.05 * np.arange(T), dt=0.05, thrust=np.ones((T, 4)), mode=np.full(T, 2.0))
    out = program.TickOutput(*[None] * len(program.TickOutput._fields))._replace(
        active=np.zeros((T, 4, 4), bool), each=np.zeros((T, 4, 4)), share=np.tile([0.9, 0.1, 0, 0], (T, 1)),
        theta=np.zeros((T, 4)), theta_sd=np.full((T, 4), 0.01),
    )  # fmt: skip
    out.active[100:, 0, 0], out.each[100:, 0, 0], out.theta[100:, 0] = True, 0.3, 0.3
    out.share[200:] = [1.0, 0, 0, 0]
    craft = reconfigured.Reconfigured(B)

    def entered(by, *entries):
        certify = closed_loop._certifier(craft, numbers, out, list(entries)) if by == closed_loop.CERTIFIED else None
        return closed_loop._next(s, ticks, out, list(entries), by, certify)

    first, sure = entered("estimate"), entered(closed_loop.CERTIFIED)
    assert first is not None and first.since == pytest.approx(15.0 + closed_loop.DELAY_S)
    assert sure is not None and sure.since == pytest.approx(20.0 + closed_loop.DELAY_S)
    np.testing.assert_array_equal(sure.mean, first.mean)
    assert entered(closed_loop.CERTIFIED, sure) is None
    out.each[100:, 0, 0], out.theta[100:, 0], out.theta_sd[:] = 0.2, 0.2, 0.06  # 8 to 32 %: 14 % are too much by 6 at most
    part = entered(closed_loop.CERTIFIED)
    assert part is not None and part.mean[0] == pytest.approx(0.86) and part.lower[0] == pytest.approx(0.68)
    out.theta_sd[:] = 0.08  # from 4 % on: what may be acted on is too little
    assert entered(closed_loop.CERTIFIED) is None and entered("estimate") is not None


def test_the_feedback_is_the_hovers_own():
    s, _, _ = planned()
    entry = closed_loop._entry(s, 0.0, *[np.array([1.0, 0.4, 1.0, 1.0])] * 3)
    hover, gains = entry.hover, entry.gains
    u = spinning.feedback(hover, gains, hover.u, hover.omega, hover.down, 1.0)
    np.testing.assert_allclose(u, hover.u, atol=1e-12)


def test_the_command_goes_on_and_says_who_survives(asked, folder, run):
    """With all parts there nothing is flown again."""
    before = {p.name: p.stat().st_mtime_ns for p in (folder / "parts").iterdir()}
    arguments = ["closed-loop", asked[0], "--flights", WIDTH, "--drivers", ",".join(DRIVERS), "--jobs", 1, "-o", folder]
    code, text = run(*arguments, "--json")
    assert code == 0, text
    found = json.loads(text)["drivers"]
    assert found["nobody"]["survived"]["value"] == 0.0 and found["truth"]["of_possible"]["value"] == 1.0
    assert found["default"]["of_possible"]["n"] == found["truth"]["survived"]["n"] == found["nobody"]["faulty"]
    code, text = run(*arguments)
    assert code == 0 and "survived, hexa-x | 0 % (0 to " in text
    assert before == {p.name: p.stat().st_mtime_ns for p in (folder / "parts").iterdir()}


def test_bad_requests_are_one_sentence(asked, tmp_path):
    with pytest.raises(ConfigError, match="land = false"):
        closed_loop.fly(
            plan.read(_written(tmp_path, PLAN.replace("land = false", "land = true").replace("28.0", "60.0"))), range(2), "nobody"
        )
    with pytest.raises(ConfigError, match="nonesuch"):
        closed_loop.run(asked[1], ["nonesuch"], tmp_path / "x", 2)
    with pytest.raises(ConfigError, match="at least one driver"):
        closed_loop.run(asked[1], [], tmp_path / "x", 2)
    with pytest.raises(ConfigError, match="by must be one of estimate, bounds, posterior, certified, not guess"):
        closed_loop.run(asked[1], ["default"], tmp_path / "x", 2, by="guess")
    with pytest.raises(ConfigError, match="ekf has one explanation at a time"):
        closed_loop.run(asked[1], ["truth", "ekf"], tmp_path / "x", 2, by="posterior")
    stuck = PLAN.replace('"complete loss"', '"stuck"')
    with pytest.raises(ConfigError, match="losses and complete losses, not stuck"):
        closed_loop.fly(plan.read(_written(tmp_path, stuck)), range(2), "truth")


def _written(folder, text):
    path = folder / "plan.toml"
    path.write_text(text)
    return path
