"""Makes docs/comparison.md: all methods on the same simulated flights, a table for each frame.

    python benchmarks/compare.py [--jobs 2] [--out FOLDER] [--methods NAME,NAME --name -more]

Runs `rotorwatch benchmark` on the plans in benchmarks/comparison. Results files are kept in --out: frames that have one are not
flown again, and a run that was interrupted goes on where it was.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from rotorwatch.campaign import benchmark, ranking

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "comparison.md"
FRAMES = ("quad-x", "hexa-x", "octa-x")
COLUMNS = {**ranking.COLUMNS, "own_detected": "found at its own threshold"}
HEAD = """# Comparison

Every method on the same simulated flights, the default diagnosis among them, with 95 % intervals. Published methods run with their
defaults on rotational dynamics learned from each flight's first seconds ([methods](methods/index.md)); the default on its own plant.
Events are read from all of them the same way. The tables are made by `python benchmarks/compare.py`; a method of yours flies the same
with `rotorwatch benchmark benchmarks/comparison/hexa-x.toml --method my_file:Mine -o mine.json`, and your own logs with
`rotorwatch compare healthy1.bin healthy2.bin --losses 0.2,0.4`.

- **found**: clear faults that are found within 10 s, with each method's threshold set so that 2 false alarms are left in an hour of
  healthy flight. Which rotor is named does not count here. **delay**: median, at the same threshold.
- **right rotor**: share of clear faults whose first event names that rotor alone, at the method's own threshold. On a hexarotor opposite
  rotors look alike at first: naming both counts as not right.
- **size error**: RMS error of announced losses ten seconds after the onset; **coverage**: share of those whose 95 % interval holds the
  loss. Both are of the losses that were announced: read them beside the last column.
- **own alarms/h**: false alarms at the method's own threshold.
- **us a step**: microseconds of one step of a quad in a compiled loop.
- `=`: not told apart from the first by these flights. `over`: a rule without a threshold, with more false alarms than 2 an hour.

What each of the scores means in detail, and their limits: [benchmark](benchmark.md#scores). Flights: 50 s of hover, squares,
figures of eight, climbs and turns, wind to 8 m/s, .8 to 8 kg, logs of ArduPilot and PX4 at their fast rates; 60 % with a loss of one
rotor from 5 % to all.
"""


def table(ranked: dict) -> str:
    """One frame's ranking in Markdown."""
    plan, rows = ranked["plan"], ranked["rows"]
    scores = rows[0]["scores"]
    count = (
        f"{plan['flights']} flights, {scores['clear_faults']:.0f} clear faults, {scores['healthy_h']:.1f} healthy hours"
    )
    lines = [
        f"\n## {plan['name'].removeprefix('comparison-')}\n",
        f"{count}; {'; '.join(ranked['machines'].values())}.\n",
    ]
    lines += [f"| | method | {' | '.join(COLUMNS.values())} |", "|---" * (len(COLUMNS) + 2) + "|"]
    for row in rows:
        cells = (ranking.cell(key, row["scores"].get(key)) for key in COLUMNS)
        lines.append(f"| {ranking.mark(row)} | `{row['name']}` | {' | '.join(cells)} |")
    return "\n".join(lines + [f"\nNot run: `{e['name']}`: {e['failed']}" for e in ranked["failed"]]) + "\n"


def main() -> None:
    """Fly what is missing, write the page."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--jobs", type=int)
    arguments.add_argument("--methods", default="all")
    arguments.add_argument(
        "--name", default="", help="of a run of other methods, such as -new: its rows join those that are kept"
    )
    arguments.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "rotorwatch-comparison")
    asked = arguments.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    pages = []
    for frame in FRAMES:
        out = asked.out / f"{frame}{asked.name}.json"
        if not out.exists():
            plan = ROOT / "benchmarks" / "comparison" / f"{frame}.toml"
            benchmark.run(plan, asked.methods.split(","), out, asked.jobs, tell=print)
        pages.append(table(ranking.rank(sorted(asked.out.glob(f"{frame}*.json")))))
    PAGE.write_text(HEAD + "".join(pages), encoding="utf-8")


if __name__ == "__main__":
    main()
