"""What is found of losses put into real flights that never hover, and how often something is found where nothing is.

    python benchmarks/aerobatic.py LOG...

Losses: `rotorwatch inject` (docs/results.md) at three moments of each flight, on each rotor. False alarms: the flights as they are, and
surrogates: their blocks in pieces of ten seconds in another order, each with its thrusts, roll, pitch and yaw turned round at random. The
bound: what a test that knows the onset and the flight's own scatter would need to see a loss of 20 % in 95 of 100, at the same
false-alarm rate.
"""

from __future__ import annotations

import argparse
from statistics import NormalDist

import numpy as np

import rotorwatch as rw
from rotorwatch import airframes
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.driver import observe
from rotorwatch.engine.events.decisions import FALSE_ALARM_PERIOD_S
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import ASSESS, READY_S
from rotorwatch.witnesses.aerobatic import assess
from rotorwatch.witnesses.aerobatic.response import respond
from rotorwatch_lab.experiments.inject import inject

LOSSES, MOMENTS, PIECE, HOURS = (0.1, 0.2, 0.3, 0.5), (0.3, 0.5, 0.7), 10, 5.0


def found(flight, vehicle, air):
    """(events, seconds that were assessed) of a flight."""
    ticks = observe(flight, vehicle, air, READY_S)
    assert ticks is not None
    table, out = assess.estimate(flight, vehicle, air, ticks)
    return event_rows.read(out, table, vehicle.effectiveness()), float((table.mode == ASSESS).sum() * table.dt)


def surrogate(known: assess.Blocks, rng: np.random.Generator) -> assess.Blocks:
    """The blocks of a flight in another order."""
    pieces = np.array_split(np.arange(len(known.end)), max(1, len(known.end) // PIECE))
    order = np.concatenate([pieces[k] for k in rng.permutation(len(pieces))])
    middle = np.median(known.missing, axis=0)
    turned = np.concatenate([np.tile(rng.choice([-1.0, 1.0], 3), (len(pieces[k]), 1)) for k in range(len(pieces))])
    return assess.Blocks(known.start, known.end, middle + turned * (known.missing[order] - middle), known.thrust[order])


def alarmed(known: assess.Blocks, B: np.ndarray) -> bool:
    """Whether anything is announced in these blocks."""
    variance = assess.scatter(known)
    for k in range(assess.LEARN, len(known.end)):
        if assess.examine(assess.Blocks(*(x[: k + 1] for x in known)), B, variance, []).statistic > 0.0:
            return True
    return False


def bound_s(known: assess.Blocks, B: np.ndarray, loss: float) -> float:
    """Seconds until a loss is seen in 95 of 100, at best."""
    z, T = known.missing, known.thrust
    precision = assess._precision(z, assess.scatter(known))
    per_block = np.mean([(precision * (B[:3, i] * T[:, i : i + 1] * loss) ** 2).sum(axis=1).mean() for i in range(T.shape[1])])
    limit = np.sqrt(2.0 * np.log(FALSE_ALARM_PERIOD_S / assess.BLOCK_S * T.shape[1]))
    return float((limit + NormalDist().inv_cdf(0.95)) ** 2 / per_block * assess.BLOCK_S)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("logs", nargs="+")
    rng, rows, hours, alarms = np.random.default_rng(0), [], 0.0, 0
    for path in parser.parse_args().logs:
        flight = rw.read(path)
        vehicle, air = airframes.identify(flight), airborne(flight)
        seen = respond(flight, vehicle, air) if air else None
        if seen is None or len((known := assess.blocks(seen, air)).end) < 2 * assess.LEARN:
            continue
        announced, assessed = found(flight, vehicle, air)
        B = vehicle.effectiveness()
        false, flown = 0, 0.0
        while flown < HOURS * 3600.0 / 5:
            false += alarmed(surrogate(known, rng), B)
            flown += (len(known.end) - assess.LEARN) * assess.BLOCK_S
        hours, alarms = hours + flown / 3600.0, alarms + false
        print(
            f"{flight.name}: {assessed:.0f} s assessed, {len(announced)} announced; surrogates {false} in {flown / 3600:.1f} h; "
            f"lag {1e3 * seen.lag_s:.0f} ms; 20 % at best within {bound_s(known, B, 0.2):.0f} s", flush=True,
        )  # fmt: skip
        for loss in LOSSES:
            for rotor in range(1, len(vehicle.rotors) + 1):
                for moment in MOMENTS:
                    onset = float(known.start[int(moment * len(known.start))])
                    changed = inject(flight, vehicle, rotor, loss, onset)
                    announced, _ = found(changed, vehicle, air)
                    first = next((e for e in announced if e.detected_s >= onset), None)
                    rows.append((loss, first, rotor, onset))
    print(f"\nsurrogates: {alarms} false alarms in {hours:.1f} h\n")
    print("| loss | trials | found | right rotor | or among the candidates | delay, median s | error, median | inside the interval |")
    print("|---|---|---|---|---|---|---|---|")
    for loss in LOSSES:
        mine = [row[1:] for row in rows if row[0] == loss]
        hits = [(e, rotor, onset) for e, rotor, onset in mine if e is not None]
        right = [(e, onset) for e, rotor, onset in hits if e.rotors == (rotor,)]
        named = sum(e.rotors == (rotor,) or (rotor,) in e.alternatives for e, rotor, _ in hits)
        inside = sum(e.interval[0][0] <= loss <= e.interval[0][1] for e, _ in right)
        delay = f"{np.median([e.detected_s - onset for e, onset in right]):.1f}" if right else ""
        error = f"{np.median([e.loss[0] - loss for e, _ in right]):+.2f}" if right else ""
        print(f"| {loss:.0%} | {len(mine)} | {len(hits)} | {len(right)} | {named} | {delay} | {error} | {inside} |")


if __name__ == "__main__":
    main()
