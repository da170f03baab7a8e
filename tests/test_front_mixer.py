"""The mixer and its deviations (engine/intake/mixer.py, deviations.py): made-up flights with known answers, and Python against
C."""

from __future__ import annotations

import ctypes
import re
import subprocess

import numpy as np
import pytest

from embedded_c_parts import STRICT, compilers
from rotorwatch.base import medians
from rotorwatch.base.compiling import structs
from rotorwatch.base.compiling.translate import Translation
from rotorwatch.engine.intake import craft as vehicle
from rotorwatch.engine.intake import deviations, mixer, sizes
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.deviations import OFF, OVERRIDDEN, STUCK, Deviations, Override
from rotorwatch.engine.intake.mixer import Comparison, Mixer

LASTS = structs.LASTS
TYPES = {"rw_real": ctypes.c_double, "rw_time": ctypes.c_double, "int32_t": ctypes.c_int32, "bool": ctypes.c_bool}
FACTORS = np.array([[-0.5, 0.5, 0.5, 1.0], [0.5, -0.5, 0.5, 1.0], [0.5, 0.5, -0.5, 1.0], [-0.5, -0.5, -0.5, 1.0]])
TIMES = np.arange(1.0, 31.0, 1.0 / 16.0)  # s, exact in binary; as is how much later outputs come
LATER = 1.0 / 2048.0


def written(folder):
    """The definitions as C, in a folder; the header."""
    made = Translation([medians, vehicle, mixer, deviations], sizes)
    (folder / "rw_config.h").write_text("".join(f"#define RW_{k} {v}\n" for k, v in made.sizes.items()))
    (folder / "rw_front.h").write_text(made.header("Made for a test."))
    (folder / "rw_front.c").write_text(made.source("rw_front.h"))
    return made.header("Made for a test.")


class InC:
    """The definitions compiled in double precision. Structs are those of the header."""

    def __init__(self, folder):
        header = written(folder)
        command = [compilers()[0], *STRICT, "-O1", "-ffp-contract=off", "-fPIC", "-shared", str(folder / "rw_front.c")]
        subprocess.run([*command, "-o", str(folder / "front.so"), "-lm"], check=True)
        self.library = ctypes.CDLL(str(folder / "front.so"))
        self.kinds: dict[str, type[ctypes.Structure]] = {}
        sizes_of = {f"RW_{k}": v for k, v in vars(sizes).items() if k.isupper()}
        for body, name in re.findall(r"typedef struct \{\n(.*?)\n\} (\w+);", header, re.S):
            fields = []
            for kind, field, dims in re.findall(r"^ +(\w+) (\w+)((?:\[\w+\])*);", body, re.M):
                made = TYPES.get(kind) or self.kinds[kind]
                for dim in reversed(re.findall(r"\w+", dims)):
                    made = made * (sizes_of[dim] if dim in sizes_of else int(dim))
                fields.append((field, made))
            self.kinds[name] = type(name, (ctypes.Structure,), {"_fields_": fields})

    def new(self, kind, count=None):
        name = structs_name(kind)
        if count:
            return (self.kinds[name] * count)()
        one = self.kinds[name]()
        getattr(self.library, f"{name}_init")(ctypes.byref(one))
        return one

    def call(self, one, name, *args):
        function = getattr(self.library, f"{type(one).__name__}_{name}")
        return function(ctypes.byref(one), *map(passed, args))

    @staticmethod
    def reals(values):
        return (ctypes.c_double * len(values))(*values)

    @staticmethod
    def at(room, k):
        return room[k]


class InPython:
    """The same, as Python runs them."""

    @staticmethod
    def at(room, k):
        return room[k]

    def new(self, kind, count=None):
        return [kind() for _ in range(count)] if count else kind()

    def call(self, one, name, *args):
        return getattr(one, name)(*args)

    @staticmethod
    def reals(values):
        return list(values)


def structs_name(kind):
    return "rw_" + kind.__name__.lower()


def passed(value):
    for kind, made in ((bool, ctypes.c_bool), (int, ctypes.c_int32), (float, ctypes.c_double)):
        if isinstance(value, kind):
            return made(value)
    return ctypes.byref(value) if isinstance(value, ctypes.Structure) else value


def plain(value):
    """A struct of Python or of C as plain values; floats as bytes where there are many, every bit of them."""
    if isinstance(value, structs.Struct):
        return {name: plain(inner) for name, inner in vars(value).items()}
    if isinstance(value, ctypes.Structure):
        return {name: plain(getattr(value, name)) for name, _ in value._fields_}
    if isinstance(value, (list, ctypes.Array)):
        if isinstance(value[0], float) or (isinstance(value[0], (list, ctypes.Array)) and isinstance(value[0][0], float)):
            return (np.array(value) + 0.0).tobytes()  # a zero has no sign
        return [plain(inner) for inner in value]
    return (value + 0.0).hex() if isinstance(value, float) else value


def craft(one, known=True, rotors=4, rests=False):
    """A quad X whose outputs are 0 to 1 and thrusts straight lines."""
    one.rotors, one.mixer_known, one.rests_at_minimum = rotors, known, rests
    for k, factors in enumerate(FACTORS):
        for c, factor in enumerate(factors):
            one.mixer[k][c] = float(factor)
    for axis, row in enumerate([[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1]]):
        for k, value in enumerate(row):
            one.effectiveness[axis][k] = float(value)
    return one


def demands(time=TIMES):
    """(m, 4) what a rate controller demands in gentle flight."""
    waves = [np.sin(2 * np.pi * f * time + p) for f, p in ((0.9, 0.0), (0.7, 1.0), (0.4, 2.0), (0.2, 3.0))]
    return np.stack(waves, axis=1) * [0.1, 0.1, 0.1, 0.05] + [0.0, 0.0, 0.0, 0.45]


class Flown:
    """A flight run sample by sample: the rate controller at the times of `control`, outputs when they come, LATER than it if not said."""

    def __init__(self, way, control, outputs, known=True, times=TIMES, at=None, valid=None, compared=True, rests=False):
        self.way, self.v = way, craft(way.new(Vehicle), known, outputs.shape[1], rests)
        self.mixer, self.deviations = way.new(Mixer), way.new(Deviations)
        self.comparisons, self.rebuilt = [], []
        room = way.new(Comparison, sizes.PENDING + 1)
        at = times + LATER if at is None else at
        valid = np.ones(len(at), bool) if valid is None else valid
        rows = [(float(t), 1, i) for i, t in enumerate(times)] + [(float(t), 0, i) for i, t in enumerate(at)]
        for time, kind, i in sorted(rows):
            if kind == 0:
                output = way.reals(outputs[i].tolist())
                thrust = way.reals(np.clip(outputs[i], 0.0, 1.0).tolist())
                made = way.call(self.mixer, "outputs", self.v, time, output, bool(valid[i]), 1.0, room[0])
                way.call(self.deviations, "logged", self.v, time, output, thrust, bool(valid[i]), time > 2.0)
            else:
                rotors = outputs.shape[1]
                row, thrust, ok = way.reals(control[i].tolist()), way.reals([0.0] * rotors), [False] * rotors
                ok = ok if isinstance(way, InPython) else (ctypes.c_bool * rotors)()
                made = 0
                while way.call(self.mixer, "control", self.v, time, row, True, way.at(room, made)):
                    made += 1
                way.call(self.mixer, "thrust", self.v, time, row, True, 1.0, thrust, ok)
                self.rebuilt.append((plain(thrust), plain(ok)))
            for n in range(made):
                self.comparisons.append(plain(room[n]))
                if compared:
                    way.call(self.deviations, "compared", self.v, room[n], time > 2.0)

    def found(self):
        """(rotor, kind, onset, detected, end, demanded) of each override; the first rotor is 0."""
        room = self.way.new(Override, sizes.OVERRIDES)
        count = self.way.call(self.deviations, "found", self.v, room)
        return [(o.rotor, o.kind, o.onset, o.detected, o.end, o.demanded) for o in room[:count]]

    def shared(self):
        """Which of them left the mixer together with another output."""
        room = self.way.new(Override, sizes.OVERRIDES)
        return [o.shared for o in room[: self.way.call(self.deviations, "found", self.v, room)]]

    def everything(self):
        return self.comparisons, self.rebuilt, plain(self.mixer), plain(self.deviations), self.found(), self.shared()


@pytest.fixture(scope="module")
def in_c(tmp_path_factory):
    return InC(tmp_path_factory.mktemp("front_mixer"))


@pytest.fixture
def fly(in_c):
    """Fly in Python and in C, which must agree in every bit; the flight in Python."""

    def both(*args, **facts):
        ours, theirs = (Flown(way, *args, **facts) for way in (InPython(), in_c))
        for one, other in zip(ours.everything(), theirs.everything(), strict=True):
            assert one == other
        return ours

    return both


def after(time):
    """Which samples come at or after a time."""
    return TIMES >= time - 1e-9


def numbers(comparisons, name):
    return np.array([np.frombuffer(c[name])[:4] for c in comparisons])


def test_the_gain_is_learned_and_thrusts_are_rebuilt(fly):
    control = demands()
    flight = fly(control, 0.9 * control @ FACTORS.T)
    assert flight.mixer.gain == pytest.approx(0.9, abs=1e-9) and len(flight.comparisons) == len(TIMES)
    assert np.abs(numbers(flight.comparisons, "deviation")).max() < 1e-9
    rebuilt, trusted = flight.rebuilt[-1]
    assert np.frombuffer(rebuilt) == pytest.approx(0.9 * FACTORS @ control[-1]) and all(trusted)
    assert not any(flight.rebuilt[0][1]) and not flight.found()


def test_outputs_between_two_samples_of_the_rate_controller(fly):
    """... are compared with what it demanded in between, when the later one has come."""
    control = np.linspace([0.0, 0.0, 0.0, 0.4], [0.1, 0.0, 0.0, 0.5], len(TIMES))
    between = TIMES[:-1] + 0.02
    outputs = np.stack([np.interp(between, TIMES, x) for x in (control @ FACTORS.T).T], axis=1)
    flight = fly(control, outputs, at=between)
    assert np.abs(numbers(flight.comparisons, "deviation")).max() < 1e-9 and len(flight.comparisons) == len(between)
    assert [float.fromhex(c["known"]) for c in flight.comparisons] == list(TIMES[1:])


def test_more_outputs_than_can_wait(fly):
    times, at = np.array([1.0, 1.14]), np.arange(1.003, 1.139, 0.0001)
    flight = fly(demands(times), np.full((len(at), 4), 0.4), at=at, times=times)
    assert len(at) > sizes.PENDING
    assert [float.fromhex(c["time"]) for c in flight.comparisons] == at[-sizes.PENDING :].tolist()


def test_an_output_that_is_stuck(fly):
    control = demands()
    outputs = control @ FACTORS.T
    held = after(20.0) & ~after(25.0)
    outputs[held, 1] = outputs[np.argmax(held), 1]
    ((rotor, kind, onset, detected, end, demanded),) = fly(control, outputs).found()
    assert (rotor, kind) == (1, STUCK) and onset == 20.0 + LATER and 20.5 < detected < 21.0 and 25.0 <= end < 25.2
    assert abs(demanded - outputs[np.argmax(held), 1]) > 0.015


@pytest.mark.parametrize("compared", [True, False])
@pytest.mark.parametrize("seconds", [0.5, 1.0, 3.0, 8.0])
def test_outputs_that_all_repeat_were_missed_and_are_not_stuck(fly, seconds, compared):
    control = demands()
    outputs = control @ FACTORS.T
    for begin in (10.0, 20.0):
        held = after(begin) & ~after(begin + seconds)
        outputs[held] = outputs[np.argmax(held)]
    assert not fly(control, outputs, compared=compared).found()


@pytest.mark.parametrize("compared", [True, False])
def test_a_stuck_output_is_found_once_the_others_move_again(fly, compared):
    control = demands()
    outputs = control @ FACTORS.T
    outputs[after(20.0), 1] = outputs[np.argmax(after(20.0)), 1]
    held = after(20.2) & ~after(23.2)
    outputs[held] = outputs[np.argmax(held)]
    ((rotor, kind, _, detected, end, _),) = fly(control, outputs, compared=compared).found()
    assert (rotor, kind, end) == (1, STUCK, LASTS) and 23.2 < detected < 24.2


@pytest.mark.parametrize("compared", [True, False])
@pytest.mark.parametrize("step", [0.005, 0.01, 0.025, 0.05])
def test_coarse_outputs_are_not_stuck(fly, step, compared):
    control = demands()
    assert not fly(control, np.round(control @ FACTORS.T / step) * step, compared=compared).found()


@pytest.mark.parametrize("compared", [True, False])
def test_an_output_that_is_off(fly, compared):
    control = demands()
    outputs = control @ FACTORS.T
    outputs[after(20.0), 2] = -0.1
    ((rotor, kind, onset, detected, end, demanded),) = fly(control, outputs, compared=compared).found()
    assert (rotor, kind, onset, end) == (2, OFF, 20.0 + LATER, LASTS)
    assert detected == (20.25 if compared else 20.3125) + LATER
    wanted = (control @ FACTORS.T)[np.searchsorted(TIMES, 20.25), 2]
    assert demanded == (pytest.approx(wanted) if compared else -1.0)


def test_an_output_that_something_else_drives(fly):
    control = demands()
    outputs = control @ FACTORS.T
    outputs[after(20.0) & ~after(22.0), 3] += 0.2
    ((rotor, kind, onset, _, end, _),) = fly(control, outputs).found()
    assert (rotor, kind, onset, end) == (3, OVERRIDDEN, 20.0 + LATER, 22.0 + LATER)


def test_outputs_alone_show_one_that_does_not_move_and_one_at_rest(fly):
    control = demands()
    outputs = control @ FACTORS.T
    outputs[after(10.0) & ~after(15.0), 0] = 0.45
    outputs[after(20.0) & ~after(23.0), 3] = 0.0
    stuck, off = fly(control, outputs, compared=False, rests=True).found()
    assert stuck[:3] == (0, STUCK, 10.0 + LATER) and stuck[4] == 15.0 + LATER
    assert off[:3] == (3, OFF, 20.0 + LATER) and off[4] == 23.0 + LATER
    assert [o[:2] for o in fly(control, outputs, compared=False).found()] == [(0, STUCK)]  # may rest at its minimum


def test_a_mixer_at_its_limits_that_gives_up_yaw_is_not_accused(fly):
    control = demands()
    there = after(20.0) & ~after(24.0)
    control[there, 2:] = 0.7, 0.3
    given_up = control.copy()
    given_up[there, 2] = 0.35
    flight = fly(control, given_up @ FACTORS.T)
    assert (np.abs(numbers(flight.comparisons, "deviation"))[there] > mixer.PART).all(axis=0).any()
    assert [c["yaw_granted"] for c in flight.comparisons] == (~there).tolist() and not flight.found()
    one_off = given_up @ FACTORS.T
    one_off[after(20.25) & ~after(24.0), 0] += 0.2
    assert fly(control, one_off).found()[0][:2] == (0, OVERRIDDEN)


def test_a_mixer_beyond_its_limits_gives_up_yaw_that_it_grants_within_them(fly):
    """PX4 gives up yaw and throttle for an output that is at full thrust, however small the yaw; what is left of yaw varies."""
    control = demands()
    there = after(20.0) & ~after(24.0)
    control[there] = [-0.2, 0.2, 0.2, 0.8]
    given_up = control.copy()
    given_up[there, 2] = np.linspace(0.05, 0.15, there.sum())
    outputs = given_up @ FACTORS.T
    outputs -= np.maximum(outputs.max(axis=1, keepdims=True) - 1.0, 0.0)
    flight = fly(control, outputs)
    assert all(c["yaw_granted"] for c in flight.comparisons) and not flight.found()
    off = (np.abs(numbers(flight.comparisons, "deviation")) > mixer.PART).any(axis=1)
    assert off[there].all() and not off[~there].any()


def test_a_mixer_that_does_not_raise_the_throttle_gives_up_tilt(fly):
    """PX4 without airmode takes roll and then pitch from an output that is at zero, as after a touch-down."""
    control = demands()
    there = after(20.0) & ~after(24.0)
    control[there] = np.linspace([-0.3, -0.3, 0.05, 0.25], [-0.25, -0.3, 0.05, 0.12], int(there.sum()))
    given_up = control.copy()
    for k in np.flatnonzero(there):
        least = (control[k] * [1.0, 1.0, 0.0, 1.0]) @ FACTORS[2]  # of the lowest output, which has no other limit
        given_up[k, 0] -= 2.0 * min(least, 0.0)
    outputs = np.maximum(given_up @ FACTORS.T, 0.0)
    flight = fly(control, outputs)
    assert (np.abs(numbers(flight.comparisons, "deviation"))[there] > mixer.PART).any() and not flight.found()
    raised = control @ FACTORS.T
    raised -= np.minimum(raised.min(axis=1, keepdims=True), 0.0)
    assert not fly(control, raised).found()
    raised[after(20.5) & ~after(22.0), 0] += 0.5  # by nothing that is given up
    assert [o[:2] for o in fly(control, raised).found()] == [(0, OVERRIDDEN)]


@pytest.mark.parametrize("asked", [-0.05, 0.1])
def test_an_output_rests_at_its_minimum_where_the_mixer_asks_for_that(fly, asked):
    """The controller takes one output to its end, against a vehicle that is held or whose motors are swapped; or it does not."""
    control = demands()
    there = after(20.0) & ~after(23.0)
    control[there] = [0.3 - asked, asked - 0.3, 0.0, 0.3]
    control[:, 3] += 0.02 * np.sin(7.0 * TIMES)
    outputs = np.maximum(control @ FACTORS.T, 0.0)
    outputs[there, 0] = 0.0
    assert [o[:2] for o in fly(control, outputs, rests=True).found()] == ([] if asked < 0.0 else [(0, OFF)])


def test_outputs_that_leave_the_mixer_at_the_same_samples_are_the_logs_doing(fly, monkeypatch):
    monkeypatch.setitem(globals(), "FACTORS", np.vstack([FACTORS, FACTORS]))
    control = demands()
    outputs = control @ FACTORS.T
    outputs[after(20.0) & ~after(22.0), 1] += 0.2
    outputs[after(20.0) & ~after(22.0), 3] -= 0.2
    outputs[after(25.0) & ~after(27.0), 2] += 0.2
    flight = fly(control, outputs)
    assert [o[0] for o in flight.found()] == [1, 3, 2] and flight.shared() == [True, True, False]


@pytest.mark.parametrize("wanted", [(0.1, 0.1), (1.0, 1.6)])
def test_an_output_that_rests_with_one_at_its_limit_is_not_stuck(fly, wanted):
    """Rotors 0 and 3 differ in yaw alone: with the first at full thrust, throttle given up for that, and yaw beyond 0.1 as well, the other
    may not move. wanted: yaw at the beginning and at the end."""
    control = demands()
    there = after(20.0)
    control[there] = [0.0, 0.0, 0.1, 0.85]
    control[there, 0] = np.linspace(-0.05, -0.45, there.sum())
    outputs = control @ FACTORS.T
    outputs -= np.maximum(outputs.max(axis=1, keepdims=True) - 1.0, 0.0)
    control[there, 2] = np.linspace(*wanted, there.sum())
    assert np.ptp(outputs[after(26.0), 3]) < 1e-9 and not fly(control, outputs).found()


def test_a_mixer_that_is_not_known_is_learned(fly):
    control = demands()
    outputs = control @ FACTORS.T @ np.diag([1.0, 0.9, 1.1, 1.0])
    outputs[after(28.0), 1] += 0.15
    flight = fly(control, outputs, known=False)
    ours = np.array(flight.mixer.weights)[:4, [0, 2, 3]].T
    assert ours == pytest.approx((np.diag([1.0, 1.1, 1.0]) @ FACTORS[[0, 2, 3]]), abs=0.01)
    assert [o[:2] for o in flight.found()] == [(1, OVERRIDDEN)]


def test_a_landing_that_is_known_later_ends_what_lasted(fly):
    control = demands()
    outputs = control @ FACTORS.T
    outputs[after(20.0), 2] = -0.1
    flight = fly(control, outputs)
    flight.deviations.landed(25.0, LASTS)
    assert flight.found()[0][4] == LASTS  # until the next comparison
    one = Comparison()
    one.time = one.known = 31.0
    flight.deviations.compared(flight.v, one, False)
    assert flight.found()[0][4] == 25.0


def test_of_two_opposite_outputs_the_one_that_balances_is_not_reported(fly):
    """Rotors 0 and 1 are opposite: a quad that flies on with one lost rests the other."""
    control = demands()
    outputs = control @ FACTORS.T
    outputs[after(20.0), 0] = -0.1
    outputs[after(21.0), 1] = -0.1
    assert [o[:2] for o in fly(control, outputs, compared=False).found()] == [(0, OFF)]


@pytest.mark.parametrize("known", [True, False])
def test_python_and_c_agree_whatever_comes(fly, known):
    rng = np.random.default_rng(5)
    for _ in range(3):
        m = 500
        times, at = np.cumsum(rng.uniform(0.01, 0.08, m)), np.cumsum(rng.uniform(0.005, 0.09, m))
        control = demands(times) + rng.normal(0.0, 0.03, (m, 4)) + [0.0, 0.0, rng.choice([0.0, 0.4]), 0.0]
        outputs = demands(at) @ FACTORS.T * rng.uniform(0.7, 1.2)
        for _ in range(12):
            first, k = int(rng.integers(m)), int(rng.integers(4))
            part = slice(first, first + int(rng.integers(80)))
            outputs[part, k] = rng.choice([outputs[first, k], -0.1, 0.0, 1.0, 0.3, np.nan])
        fly(control, outputs, known, times=times, at=at, valid=np.isfinite(outputs).all(axis=1))
