"""Logs altered so that every record is sound and the whole is not what flew: order of outputs, clocks, frames, ranges, axes, records
twice. How often a rotor is accused that had lost nothing:

    python -m tests.altered_logs ../shared/flights/FLIGHT:ROTORS ...        # ROTORS that truly lost thrust, as 1+3, or nothing
    python -m tests.altered_logs                                            # flights of ../shared, some minutes
"""

from __future__ import annotations

import argparse
import itertools
import random
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotorwatch import diagnose, logs
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import Flight, Signal

SHARED = Path(__file__).resolve().parents[2] / "shared" / "flights"
FLIGHTS = (
    "ardupilot-sitl/quadx_m1_mul0.90_hover.bin.xz:1", "ardupilot-sitl/quadx_healthy_hover.bin.xz:", "open/px4_q61_healthy_turn_lin.ulg.xz:",
    "ardupilot-sitl/hexax_healthy_square_wind.bin.xz:", "ardupilot-sitl/hexax_m3_mul0.80_square_wind.bin.xz:3",
    "ardupilot-sitl/octa_m7_mul0.70_square_wind.bin.xz:7", "ardupilot-real-rrc/good_prop_hover_2.bin.xz:",
    "ardupilot-real-rrc/good_prop_straight_line_2.bin.xz:", "open/px4_q17_m1_50_square.ulg.xz:1", "open/px4_h10_m2_15_hover.ulg.xz:2",
    "open/ap_quad_wind12_gust_m3_g0.85.bin.xz:3", "open/px4_q15_m4_30_hover_wind.ulg.xz:4", "open/ap_light_m3_g0.8.bin.xz:3",
    "wild/healthy-real-1.bin.xz:", "wild/healthy-real-2.bin.xz:",
)  # fmt: skip
SOME = 8  # orders of outputs of one flight
AXES = {"xy": (1, 0, 2), "yz": (0, 2, 1), "xz": (2, 1, 0), "xyz": (1, 2, 0)}
SIGNS = {"-x": (-1, 1, 1), "-y": (1, -1, 1), "-z": (1, 1, -1), "-y-z": (1, -1, -1)}
PARAMETERS = (
    ("FRAME_TYPE", (0.0, 2.0, 3.0, 12.0, 14.0)), ("MOT_PWM_MIN", (500.0, 1300.0)), ("MOT_PWM_MAX", (1700.0, 2500.0)),
    ("MOT_SPIN_MIN", (0.0, 0.4)), ("MOT_SPIN_MAX", (0.6,)), ("MOT_THST_EXPO", (0.0, 1.0)), ("MOT_YAW_HEADROOM", (1000.0,)),
)  # fmt: skip
SCALED = (("CA_ROTOR0_PX", (0.0, -1.0, 0.5, 2.0, 10.0)), ("CA_ROTOR1_PY", (0.0, -1.0, 3.0)), ("CA_ROTOR0_KM", (-1.0,)))


def with_signals(flight: Flight, **signals: Signal | None) -> Flight:
    """The flight with other signals; None leaves one out."""
    return replace(flight, signals={k: v for k, v in {**flight.signals, **signals}.items() if v is not None}, checked=False)


def with_values(flight: Flight, name: str, values: np.ndarray) -> Flight:
    """The flight with other values of a signal."""
    signal = flight[name]
    return with_signals(flight, **{name: signal.with_arrays(signal.time, np.ascontiguousarray(values), signal.valid)})


def rows_of(signal: Signal, rows: np.ndarray) -> Signal:
    """Samples of a signal, in that order."""
    return signal.with_arrays(*(np.ascontiguousarray(x[rows]) for x in (signal.time, signal.values, signal.valid)))


def later(signal: Signal, seconds: float, after: float = -np.inf) -> Signal:
    """The signal with time stamps that are late from a moment on, in the order of time."""
    time = signal.time + np.where(signal.time >= after, seconds, 0.0)
    return rows_of(signal.with_arrays(time, signal.values, signal.valid), np.argsort(time, kind="stable"))


def reordered(flight: Flight, rows: tuple[int, ...]) -> Flight:
    """The flight with outputs in another order."""
    motors = flight["motors"]
    valid = np.ascontiguousarray(motors.valid[:, list(rows)])
    return with_signals(flight, motors=motors.with_arrays(motors.time, np.ascontiguousarray(motors.values[:, list(rows)]), valid))


def slower(flight: Flight, rate_hz: float) -> Flight:
    """The flight with outputs at so many Hz."""
    motors = flight["motors"]
    return with_signals(flight, motors=rows_of(motors, np.unique(np.floor(motors.time * rate_hz), return_index=True)[1]))


def doubled(flight: Flight) -> Flight:
    """The flight with every sample twice."""
    return with_signals(flight, **{k: rows_of(s, np.repeat(np.arange(len(s)), 2)) for k, s in flight.signals.items()})


def orders(n: int) -> list[tuple[int, ...]]:
    """Wrong orders of n outputs: any of four, exchanges and cycles of more."""
    some, own = random.Random(1), tuple(range(n))
    if n == 4:
        return some.sample([p for p in itertools.permutations(own) if p != own], SOME)
    swaps = [tuple(b if k == a else a if k == b else k for k in own) for a, b in itertools.combinations(own, 2)]
    return [*some.sample(swaps, SOME - 3), own[1:] + own[:1], (3, 0, 1, 2, *own[4:]), tuple(some.sample(own, n))]


def altered(flight: Flight) -> Iterator[tuple[str, str, Callable[[], Flight]]]:
    """(kind, name, the altered flight) of everything that can be done to a flight."""
    motors, middle = flight["motors"], 0.5 * flight.duration
    n, alone = motors.values.shape[1], with_signals(flight, control=None)
    for p in orders(n):
        yield "order", str(p), lambda p=p: reordered(flight, p)
        yield "order, no controller", str(p), lambda p=p: reordered(alone, p)
    for s in (0.1, 0.2, 0.3, 1.0, -0.2):
        yield "late outputs", f"{s} s", lambda s=s: with_signals(flight, motors=later(motors, s))
        yield "late outputs, no controller", f"{s} s", lambda s=s: with_signals(alone, motors=later(motors, s))
    for s in (0.1, 0.3, -0.3, 2.0):
        yield "outputs' clock steps", f"{s} s", lambda s=s: with_signals(flight, motors=later(motors, s, middle))
    for rate in (3.0, 1.0):
        yield "slow outputs", f"{rate:g} Hz", lambda rate=rate: slower(flight, rate)
        yield "slow outputs, no controller", f"{rate:g} Hz", lambda rate=rate: slower(alone, rate)
    for names in (("gyro",), ("gyro", "rates"), ("gyro", "rates", "accel"), ("gyro", "rates", "accel", "attitude"), ("accel",)):
        yield "signals missing", " ".join(names), lambda names=names: with_signals(flight, **dict.fromkeys(names))
    yield "records twice", "all", lambda: doubled(flight)
    for k, value in itertools.product(range(min(n, 4)), (0.0, float(np.median(motors.values)))):
        column = np.arange(n) == k
        yield (
            "output stands still",
            f"{k + 1} {value:g}",
            lambda c=column, v=value: with_values(flight, "motors", np.where(c, v, motors.values)),
        )
    if flight.has("gyro"):
        turns = [(name, order, (1, 1, 1)) for name, order in AXES.items()] + [(name, (0, 1, 2), signs) for name, signs in SIGNS.items()]
        for name, order, signs in turns:
            values = flight["gyro"].values[:, list(order)] * signs
            yield "gyro's axes", name, lambda values=values: with_values(flight, "gyro", values)
    known = flight.parameters
    values = [(name, v) for name, some in PARAMETERS if "FRAME_CLASS" in known for v in some]
    values += [(name, known[name] * factor) for name, factors in SCALED if name in known for factor in factors]
    for name, value in values:
        yield (
            "parameter",
            f"{name} {value:g}",
            lambda name=name, value=value: replace(flight, parameters={**known, name: value}, checked=False),
        )


def said(flight: Flight, truth: set[int]) -> str:
    """What a diagnosis says: `wrong` where a rotor that lost nothing is accused without an alternative, `right`, else its verdict."""
    try:
        answer = diagnose(flight)
    except RotorwatchError:
        return "refused"
    events = [e for e in answer.events if e.kind in ("loss_of_effectiveness", "output_override") and not e.alternatives]
    accused = {rotor for event in events for rotor in event.rotors}
    return "wrong" if accused - truth else "right" if accused else answer.verdict


def main(arguments: list[str]) -> int:
    """Prints a table of kinds of alteration against what is said; 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flights", nargs="*", default=[str(SHARED / flight) for flight in FLIGHTS])
    counts: dict[str, Counter] = defaultdict(Counter)
    for one in parser.parse_args(arguments).flights:
        path, _, truth = one.rpartition(":")
        flight = logs.read(path)
        for kind, name, make in altered(flight):
            answer = said(make(), {int(k) for k in truth.split("+") if k})
            counts[kind][answer] += 1
            if answer == "wrong":
                print(f"wrong: {Path(path).name}, {kind} {name}", file=sys.stderr)
        print(f"{Path(path).name} done", file=sys.stderr)
    counts["all"] = sum(counts.values(), Counter())
    words = ("wrong", "right", "healthy", "ambiguous", "inconclusive", "crashed", "refused")
    print(f"{'':28}" + "".join(f"{word:>13}" for word in words))
    for kind, found in counts.items():
        print(f"{kind:28}" + "".join(f"{found[word]:13}" for word in words))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
