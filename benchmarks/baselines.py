"""Which rotor is accused, with how much certainty, when few healthy flights are given to compare with?

    python benchmarks/baselines.py [--flights ../shared/flights] [--sizes 2 3 6] [--most 60] [--check 0] [--json OUT]

Every combination of 2, 3 and 6 healthy flights of a real vehicle, or `--most` of them drawn with a fixed seed, is the baseline for every
other flight of that vehicle. Flights whose damage `truth.csv` calls no larger than what healthy flights differ by are taken for healthy
as well; "uncut" counts the combinations without them. Flights are read once, and set aside from a baseline as the program does it
(witnesses/healthy/baselines.py); `--check N` asks `diagnose` itself for N of the cases, and ends with 1 where it answers otherwise.

right, wrong: one set of rotors named with certainty. part: some of several damaged rotors. among: `ambiguous`, the damaged rotors among
those that it may be. not among: `ambiguous`, with other rotors or the centre of mass alone. not announced: healthy, or the baseline was
refused. Of flights without damage: fault, ambiguous, not flagged; a hung weight is no damage, but something is wrong with it.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import random
import re
from collections import Counter, defaultdict
from pathlib import Path

from rotorwatch import logs
from rotorwatch.diagnose import diagnose
from rotorwatch.engine.events.decisions import MENTIONED
from rotorwatch.errors import VehicleError
from rotorwatch.witnesses.healthy import whole_flight
from rotorwatch.witnesses.healthy.baselines import Candidate, healthy

FLIGHTS = Path(__file__).resolve().parents[1] / "../shared/flights"
GROUPS = ("ardupilot-real-rrc", "crazypad")
LIKE_HEALTHY = re.compile("within flight-to-flight spread|very small effect")
DAMAGED = ("right", "wrong", "part", "among", "not among", "not announced")
HEALTHY = ("fault", "ambiguous", "not flagged")


def vehicles(folder: Path) -> dict[str, list[dict]]:
    """Vehicle -> its rows of truth.csv: path, damaged (rotors), teaches (may be a baseline), uncut, flight (a Candidate)."""
    found = defaultdict(list)
    with open(folder / "truth.csv") as table:
        for row in csv.DictReader(table):
            group = next((g for g in GROUPS if f"/{g}/" in row["path"]), None)
            if group is None:
                continue
            name = row["firmware"].split()[-1] if group == "crazypad" else "real quad"
            path = folder / group / Path(row["path"]).name
            uncut = row["healthy"] == "1" and "weight" not in row["notes"]
            damaged = tuple(int(r) for r in row["faulty_rotors"].split("+")) if row["faulty_rotors"] else ()
            found[name].append(
                {
                    "path": path,
                    "damaged": damaged,
                    "uncut": uncut,
                    "teaches": uncut or bool(LIKE_HEALTHY.search(row["notes"])),
                    "flight": Candidate(logs.read(path)),
                }
            )
    return dict(found)


def assessed(flight: Candidate, baseline) -> whole_flight.WholeFlight | None:
    """As `diagnose` compares whole flights; None where it refuses the baseline."""
    try:
        accepted, _ = healthy(baseline, diagnose, None, flight)
    except VehicleError:
        return None
    return whole_flight.assess(flight.features, [one.features for one in accepted], flight.vehicle)


def outcome(found: whole_flight.WholeFlight | None, damaged: tuple[int, ...]) -> str:
    """A column of the table."""
    verdict = found.verdict if found else "inconclusive"
    if not damaged:
        return {"fault": "fault", "ambiguous": "ambiguous"}.get(verdict, "not flagged")
    if not found or verdict in ("healthy", "inconclusive"):
        return "not announced"
    if verdict == "fault":
        return "right" if found.rotors == damaged else "part" if set(found.rotors) < set(damaged) else "wrong"
    named = {r for c in found.causes if c.probability > MENTIONED for r in c.rotors} | set(found.rotors)
    return "among" if set(damaged) <= named else "not among"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=Path, default=FLIGHTS)
    parser.add_argument("--sizes", type=int, nargs="+", default=[2, 3, 6])
    parser.add_argument("--most", type=int, default=60, help="combinations of one size of one vehicle")
    parser.add_argument("--check", type=int, default=0, help="cases that are given to diagnose as a whole")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rng, cases = random.Random(1), []
    for vehicle, rows in vehicles(options.flights).items():
        pool = [r for r in rows if r["teaches"]]
        for size in options.sizes:
            chosen = list(itertools.combinations(pool, size))
            chosen = rng.sample(chosen, min(options.most, len(chosen)))
            for baseline, row in itertools.product(chosen, rows):
                if row in baseline:
                    continue
                found = assessed(row["flight"], [b["flight"] for b in baseline])
                cases.append((vehicle, size, all(b["uncut"] for b in baseline), row, baseline, found))
    counts, flights = Counter(), defaultdict(Counter)
    for vehicle, size, uncut, row, _, found in cases:
        verdict = outcome(found, row["damaged"])
        for scope in ("all", "uncut") if uncut else ("all",):
            counts[vehicle, size, scope, verdict] += 1
        flights[vehicle, row["path"].name][verdict] += 1
    print(f"| vehicle | baseline | {' | '.join(DAMAGED)} | {' | '.join(HEALTHY)} |\n{'|---' * (2 + len(DAMAGED + HEALTHY))}|")
    for vehicle, size, scope in sorted({key[:3] for key in counts}):
        row = [str(counts[vehicle, size, scope, verdict]) for verdict in DAMAGED + HEALTHY]
        print(f"| {vehicle} | {size}{', uncut' if scope == 'uncut' else ''} | {' | '.join(row)} |")
    print(f"\n{len(cases)} cases. By flight, all sizes:\n\n| vehicle | flight | answers |\n|---|---|---|")
    for (vehicle, name), verdict in sorted(flights.items()):
        print(f"| {vehicle} | {name.split('.bin')[0].split('.usd')[0]} | {', '.join(f'{k} {v}' for k, v in verdict.most_common())} |")
    differ = 0
    for vehicle, size, _, row, baseline, found in rng.sample(cases, min(options.check, len(cases))):
        differ += not agrees(row, baseline, found, f"{vehicle}, {size}: {row['path'].name}")
    if options.check:
        print(f"\ndiagnose: {differ} of {min(options.check, len(cases))} cases differ.")
    if options.json:
        table = [{"vehicle": v, "baseline": k, "scope": s, "answer": a, "count": c} for (v, k, s, a), c in sorted(counts.items())]
        options.json.write_text(json.dumps(table, indent=1))
    return int(differ > 0)


def agrees(row, baseline, found, name: str) -> bool:
    """Whether diagnose finds the same of the whole flight, and accuses no other rotor with certainty; a line where not."""
    try:
        answer = diagnose(row["flight"].flight, baseline=[b["flight"].flight for b in baseline])
    except VehicleError as why:
        if found is not None:
            print(f"- {name}: {why}")
        return found is None
    whole = answer.whole_flight
    same = found is not None and whole is not None and (whole["verdict"], tuple(whole["rotors"])) == (found.verdict, found.rotors)
    sure = {r for e in answer.events if e.kind == "loss_of_effectiveness" and not e.alternatives for r in e.rotors}
    if not same or sure - set(row["damaged"]):
        print(f"- {name}: {whole and (whole['verdict'], whole['rotors'])}, in flight {sorted(sure)}; here {found and found.verdict}")
    return same and not sure - set(row["damaged"])


if __name__ == "__main__":
    raise SystemExit(main())
