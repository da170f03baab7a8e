"""Real faults in public: docs/real-faults.md and docs/real_faults.csv, from checkouts of the repositories in docs/real_faults.toml.

    git clone https://github.com/AerialRoboticsUUST/CrazyPAD checkouts/AerialRoboticsUUST+CrazyPAD    # and so on
    python docs/make_real_faults.py checkouts            # those that are there; results of the others stay as they are
    python docs/make_real_faults.py                      # the page alone, from the results

Needs `rotorwatch[research]`. Converted tables go to checkouts/converted, finished flights to checkouts/kept: the same call goes on from
there. No file of a repository goes into this one: the table holds labels and answers.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomllib

from rotorwatch import logs
from rotorwatch.errors import RotorwatchError
from rotorwatch_lab.experiments import counting, evaluate, real_flights, tools
from rotorwatch_lab.experiments.labels import Fault, labelled
from rotorwatch_lab.experiments.real_flights import rules

HERE = Path(__file__).resolve().parent
LIST, ROWS, PAGE = HERE / "real_faults.toml", HERE / "real_faults.csv", HERE / "real-faults.md"
NUMBERS = ("onset_s", "size", "end_s", "delay_s", "onset_error_s", "loss", "low", "high", "size_error", "healthy_s")
OTHERS = {
    "ardupilot-thrust-loss": "ArduPilot's thrust-loss check", "px4-esc-current": "PX4's check of ESC current",
    "px4-current-residual": "PX4's current residual", rules.REVIEW: "Flight Review's motor rule",
    "autopilot-message": "the autopilot's message",
}  # fmt: skip
OUTCOMES = (("right",), ("among", "partly"), evaluate.WRONG, ("missed", "astray"))
COLUMNS = ("repository", "group", *evaluate.ROW, *OTHERS)


def assessed(source: Mapping[str, Any], checkout: Path, out: Path, jobs: int) -> list[dict[str, Any]]:
    """The rows of a source, with the outcome of each of OTHERS: right, wrong, none, or empty where it cannot be run."""
    out.mkdir(parents=True, exist_ok=True)
    recipe = real_flights.recipe(source["recipe"])
    more = {key: source[key] for key in ("patterns", "seen") if key in source}
    found = list(recipe.flights(checkout, out, **more))
    result: list[dict[str, Any]] = []
    for group in dict.fromkeys(row["group"] for row in found):
        mine = [row for row in found if row["group"] == group]
        plain = [{key: value for key, value in row.items() if key != "group"} for row in mine]
        answers = evaluate.evaluate(plain, jobs, keep=out.parent.parent / "kept")["flights"]
        known = {flight.name: flight for flight in labelled(((f"row {k}", row) for k, row in enumerate(plain)), "rows", Path())}
        others = {name: _others(flight) for name, flight in known.items()}
        for answer in answers:
            path = Path(answer["path"])
            inside = path.relative_to(checkout) if path.is_relative_to(checkout) else Path(path.name)
            label = {"repository": source["repository"], "group": group, "label_source": source["label"]}
            sentence = (answer["sentence"] or "").replace(answer["path"], path.name)
            result.append(answer | label | {"path": inside.as_posix(), "sentence": sentence} | next(others[answer["path"]]))
    return result


def _others(flight: Any) -> Iterator[dict[str, str]]:
    """Outcome of each rule of OTHERS on each fault of a flight, by its alarms up to the next one; on a healthy flight once."""
    try:
        vehicle = None
        if flight.vehicle:
            from rotorwatch.flight import vehicle_file

            vehicle = vehicle_file.read(flight.vehicle)
        found, others = rules.findings(logs.read(flight.path), vehicle), OTHERS
    except RotorwatchError:
        found, others = (), ()
    faults = flight.faults or (Fault((), float("inf")),)
    edges = [-float("inf"), *(fault.onset_s - counting.EARLY_S for fault in faults[1:]), float("inf")]
    for fault, start, end in zip(faults, edges, edges[1:]):
        said = {}
        for name in others:
            raised = [counting.Alarm(f["time_s"], ((f["rotor"],),)) for f in found if f["detector"] == name and start <= f["time_s"] < end]
            counted = counting.count(raised, fault.rotors, fault.onset_s)
            said[name] = "false" if counted.false else "right" if counted.right else "wrong" if raised else "none"
        yield said


def read() -> list[dict[str, Any]]:
    """Rows of earlier calls."""
    if not ROWS.exists():
        return []
    with ROWS.open(encoding="utf-8", newline="") as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    for row in rows:
        row |= {key: float(row[key]) if row[key] else None for key in NUMBERS}
        row |= {key: {"True": True, "False": False}.get(row[key]) for key in ("found", "holds")}
        row |= {"false_alarms": int(row["false_alarms"] or 0), "healthy_s": row["healthy_s"] or 0.0}
    return rows


def write(rows: Sequence[Mapping[str, Any]]) -> None:
    """Keep the rows."""
    with ROWS.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(COLUMNS)
        for row in rows:
            out.writerow([f"{v:.4f}" if isinstance(v := row.get(key), float) else "" if v is None else v for key in COLUMNS])


INTRODUCTION = """# Real faults

Every real flight with a known fault, and every healthy one, that we found in public repositories, and what `rotorwatch diagnose` says of
them. Made by `python docs/make_real_faults.py` from [sources](real_faults.toml) and [every flight's answer](real_faults.csv); outcomes are
those of [`rotorwatch evaluate`](evaluate.md). No flight is left out for its answer, and none of the files is part of rotorwatch.

## Sources
"""
CAUSES = """
## What goes wrong, and why

- Cuts up to 20 mm of the quadrotor's propellers change the balance of commands no more than healthy vehicles differ: alone they are
  `healthy` within a bound, which is above the loss. Those of 25 mm are `ambiguous`, rotor 1 first.
- Cuts of 10 mm: a tenth less of rotor 1 moves the balance of roll, pitch and yaw by 0.03 of an arm length each. Flights with good
  propellers differ by 0.06 in pitch; in straight lines the cut ones differ from them by 0.07 in pitch and 0.06 in yaw, the other way.
- OpenHA: in flight the end of the first loss is found 3 s late. At first it looks like a torque from outside: commands fall faster than the
  motors, and the end seems larger than the loss.
- Rotors switched off, 10 Hz of commands: later ones are reported from within 0.13 s of the switch, one 2 s late; one is missed, in a flight
  of which the notes say that three rotors were off and kept turning at idle.
- A weight hung near rotor 3 of the Crazyflie looks like a weak rotor 3, once with certainty: it yaws the vehicle as much as it rolls it,
  by 0.1 of an arm length, as no weight does outside of the rotor's wake.
- Cuts up to 2 mm of one of its propellers move roll, pitch and yaw by 0.01 to 0.04 of an arm length, by which healthy flights differ, too.
  Of two cut on one side yaw says little: the centre of mass is likelier, and a pair below 5 % is not named.
- Prototypes (erlerobot/logs), one alarm: it shakes on a bench. None is accused where the likeliest rotor leaves torques unexplained (one
  turns over out of a hover, one lies on the ground with an attitude that drifts), or where all rotors lacking thrust alike explain as much
  (one flies with failed position estimates at full throttle that does not lift it, one is turned hard from side to side). Two more turn
  over and one hits the ground: pushed up as it begins, or with motors long at idle, they accuse no rotor. In the F450 one output is far
  above the others before the loss is said to begin, a second after take-off.
- Telemetry of outputs every half second (adaptive-IGE-ardupilot), and FPV flights without a calm second, end as `inconclusive`.
"""
RULES = """
PX4's rules need currents from the ESCs, ArduPilot's throttle, velocity and attitude, Flight Review's the outputs: where a log lacks them a
rule finds nothing. They are rewritten from their descriptions (`rotorwatch/detectors`, `rotorwatch_lab/experiments/real_flights/rules.py`)
and run on every flight, whatever its autopilot. A fault is right where the first alarm names its rotor alone.

## Logs that are refused
"""


def page(sources: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> str:
    """The page."""
    there = [s for s in sources if any(r["repository"] == s["repository"] for r in rows)]
    assessed = [r for r in rows if not r["headline"].startswith("Not assessed")]
    once = [r for r in assessed if not r["rotor"] and "against" not in r["group"]]
    everything, alone = evaluate.summarise(assessed), evaluate.summarise(once)
    links = (f"[{s['repository']}](https://github.com/{s['repository']})" for s in there)
    heads = ("repository", "commit", "licence", "what it is", "how the label is known")
    about = [[link, s["commit"][:7], s["licence"], s["about"], s["label"]] for link, s in zip(links, there)]
    rates = (
        f"\n{alone['healthy_h']:.2f} h of healthy flight that could be assessed, each flight once: {_rate(alone)}.\n"
        f"With the healthy time of faulty flights, and flights once more against others, {everything['healthy_h']:.2f} h:\n"
        f"{_rate(everything)}. Every alarm in healthy flight:\n"
    )
    parts = [
        INTRODUCTION, tools.table(heads, about), "\n## Faults\n", _faults(there, [r for r in rows if r["rotor"]]), "\n## Healthy flights\n",
        _healthy(there, [r for r in rows if not r["rotor"]]), rates, _alarms(rows), "\n## Other rules on the same flights\n", _rules(rows),
        RULES, _refused(rows), CAUSES,
    ]  # fmt: skip
    return "\n".join(parts).rstrip() + "\n"


def _groups(sources: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> Iterable[tuple[str, str, list[Mapping[str, Any]]]]:
    for source in sources:
        mine = [r for r in rows if r["repository"] == source["repository"]]
        for group in dict.fromkeys(r["group"] for r in mine):
            yield source["repository"].partition("/")[2], group, [r for r in mine if r["group"] == group]


def _faults(sources: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> str:
    def line(name: str, group: str, mine: list[Mapping[str, Any]]) -> list[Any]:
        answered = [r for r in mine if r["outcome"] != evaluate.REFUSED]
        count = [sum(r["outcome"] in outcomes for r in answered) for outcomes in OUTCOMES]
        delays = sorted(r["delay_s"] for r in answered if r["delay_s"] is not None)
        losses = [r["loss"] for r in answered if r["loss"] is not None]
        size = f"{min(losses):.0%} to {max(losses):.0%}" if len(losses) > 1 else f"{losses[0]:.0%}" if losses else ""
        true = {f"{r['size']:.0%}" for r in mine if r["size"] is not None}
        broken = ", ".join(dict.fromkeys(r["rotor"] for r in mine))
        delay = f"{delays[len(delays) // 2]:.1f} s" if delays and any(r["onset_s"] for r in mine) else ""
        return [name, group, broken, len(answered), *count, delay, " ".join(sorted(true)), size]

    heads = ("source", "what is wrong", "rotor", "faults", "right", "among", "wrong", "missed", "delay", "true loss", "loss said")
    return tools.table(heads, (line(*g) for g in _groups(sources, rows)))


def _healthy(sources: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> str:
    def line(name: str, group: str, mine: list[Mapping[str, Any]]) -> list[Any]:
        answered = [r for r in mine if r["outcome"] != evaluate.REFUSED]
        verdicts = {v: sum(r["verdict"] == v for r in answered) for v in ("healthy", "inconclusive", "ambiguous", "fault", "crashed")}
        hours = sum(r["healthy_s"] for r in answered) / 3600.0
        return [name, group, len(answered), f"{hours:.2f}", *verdicts.values(), sum(r["false_alarms"] for r in answered)]

    heads = ("source", "flights", "number", "hours", "healthy", "inconclusive", "ambiguous", "fault", "crashed", "alarms")
    return tools.table(heads, (line(*g) for g in _groups(sources, rows)))


def _rate(summary: Mapping[str, Any]) -> str:
    rate = summary["false_alarms_h"]
    return (
        "none"
        if rate is None
        else f"{rate['n']} alarm{'' if rate['n'] == 1 else 's'}, {rate['value']:.2f} an hour (95 % {rate['low']:.2f} to {rate['high']:.2f})"
    )


def _alarms(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = [[r["path"], r["headline"]] for r in rows if r["false_alarms"]]
    return tools.table(("flight", "answer"), lines) if lines else "None."


def _rules(rows: Sequence[Mapping[str, Any]]) -> str:
    alone = [r for r in rows if "against" not in r["group"] and r["outcome"] != evaluate.REFUSED]
    faulty, healthy = [r for r in alone if r["rotor"]], [r for r in alone if not r["rotor"]]

    def line(key: str, name: str) -> list[Any]:
        of = [sum(r.get(key) == word for r in faulty) for word in ("right", "wrong")]
        return [name, *of, sum(r.get(key) == "false" for r in faulty), sum(r.get(key) == "false" for r in healthy)]

    ours = [sum(r["outcome"] == "right" for r in faulty), sum(r["outcome"] in evaluate.WRONG for r in faulty)]
    ours += [sum(r["false_alarms"] > 0 for r in faulty), sum(r["false_alarms"] > 0 for r in healthy)]
    heads = ("rule", f"right of {len(faulty)} faults", "wrong rotor", "alarm before a fault", f"alarm in {len(healthy)} healthy flights")
    return tools.table(heads, [["rotorwatch", *ours], *(line(*item) for item in OTHERS.items())])


def _refused(rows: Sequence[Mapping[str, Any]]) -> str:
    counts: dict[tuple[str, str], int] = {}
    for r in rows:
        if r["outcome"] == evaluate.REFUSED:
            key = r["repository"].partition("/")[2], (r["sentence"].partition(": ")[2] or r["sentence"])
            counts[key] = counts.get(key, 0) + 1
    return tools.table(("source", "logs", "reason"), ([name, n, why] for (name, why), n in counts.items())) if counts else "None."


def main() -> int:
    """The command."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", nargs="?", type=Path, help="folder with checkouts, OWNER+NAME each")
    arguments.add_argument("--only", default="", help="part of a repository's name")
    arguments.add_argument("--jobs", type=int, default=2)
    given = arguments.parse_args()
    sources, rows = tomllib.loads(LIST.read_text(encoding="utf-8"))["sources"], read()
    for source in sources if given.folder else ():
        checkout = given.folder.resolve() / source["repository"].replace("/", "+")
        if not checkout.is_dir() or given.only not in source["repository"]:
            print(f"{source['repository']}: not there", file=sys.stderr)
            continue
        print(source["repository"], file=sys.stderr)
        name = source["repository"]
        fresh = assessed(source, checkout, given.folder.resolve() / "converted" / checkout.name, given.jobs)
        rows = [row for row in rows if row["repository"] != name] + fresh
        order = [s["repository"] for s in sources]
        rows.sort(key=lambda row: order.index(row["repository"]))
        write(rows)
    PAGE.write_text(page(sources, read()), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
