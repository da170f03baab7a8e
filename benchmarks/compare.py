"""Makes docs/comparison.md: all methods on the same simulated flights, a table for each frame, and which of them keep a vehicle up.

    python benchmarks/compare.py [--jobs 2] [--frames quad-x] [--closed-loop] [--out FOLDER] [--methods NAME,NAME --name -more]

Runs `rotorwatch benchmark` on the plans in benchmarks/comparison and, with --closed-loop, `rotorwatch closed-loop
plans/survival-methods.toml`; without, that part of the page stays as it is. Results are kept in --out: what is there is not flown again,
and a run that was interrupted goes on where it was.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from rotorwatch.base import discovery
from rotorwatch_lab.campaign import benchmark, closed_loop, ranking

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "comparison.md"
FRAMES = ("quad-x", "hexa-x", "octa-x", "octaquad-x", "y6")
UP_PLAN, UP_FLIGHTS = ROOT / "plans" / "survival-methods.toml", 240
UP = """
## Does the vehicle stay up

{flights} flights of `{plan}` ([closed loop](control.md#closed-loop)): quad X and hexa X, losses of 10 % to all of one rotor or two, wind to
9 m/s. The losses that a method estimates drive the allocation; `nobody` keeps the autopilot's mixer, `truth` knows every loss after 0.1 s.

"""
UP_COLUMNS = (
    "driver",
    "stays up, of those that the truth saves, %",
    "quad X, %",
    "hexa X, %",
    "acted falsely, flights an hour",
    "first acted after, s",
)


def percent(share: dict | None) -> str:
    """A share in per cent, which the head of its column says, with its interval."""
    return (
        "-" if share is None else "{:.0f} ({:.0f}–{:.0f})".format(*(100 * share[k] for k in ("value", "low", "high")))
    )


def unsigned(cell: str) -> str:
    """A cell of the ranking as `percent` writes it."""
    return cell.replace(" %", "").replace(" to ", "–")


def bare(cell: str) -> str:
    """A value without its interval, which the results' files keep."""
    return cell.partition(" (")[0]


def number(value: dict | None) -> str:
    """A number with its interval."""
    return "-" if value is None else "{:.2f} ({:.2f} to {:.2f})".format(*(value[k] for k in ("value", "low", "high")))


def staying_up(found: dict) -> str:
    """The closed loop in Markdown, the best first."""
    lines = [f"| {' | '.join(UP_COLUMNS)} |", "|---" * len(UP_COLUMNS) + "|"]
    for name, m in sorted(found["drivers"].items(), key=lambda row: -row[1]["of_possible"]["value"]):
        frames = [bare(percent(m["possible_by_frame"][f])) for f in ("quad-x", "hexa-x")]
        cells = [
            f"`{name}`",
            percent(m["of_possible"]),
            *frames,
            bare(number(m["false_h"])),
            bare(number(m["first_s"])),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return UP.format(flights=found["flights"], plan=UP_PLAN.relative_to(ROOT)) + "\n".join(lines) + "\n"


def table(ranked: dict, told: set[str]) -> str:
    """One frame's ranking in Markdown. told: machines that a table before it has named; those of this one are added."""
    frame = ranked["plan"]["name"].removeprefix("comparison-")
    plan, rows = ranked["plan"], ranked["rows"]
    scores = rows[0]["scores"]
    count = (
        f"{plan['flights']} flights, {scores['clear_faults']:.0f} clear faults, {scores['healthy_h']:.1f} healthy hours"
    )
    lines = [
        f"\n## {frame}\n",
        "; ".join([count, *dict.fromkeys(m for m in ranked["machines"].values() if m not in told)]) + ".\n",
    ]
    keys = [key for key in ranking.COLUMNS if not (told and key == "us_per_step")]  # of a quad, whatever the frame
    told |= set(ranked["machines"].values())
    heads = [ranking.COLUMNS[key] + (", %" if key in ranking.SHARES else "") for key in keys]
    lines += [
        f"| method | {' | '.join(heads)} |",
        "|---" * (len(heads) + 1) + "|",
    ]
    for row in rows:
        found, *rest = [ranking.cell(key, row["scores"].get(key)) for key in keys]
        mark = ranking.mark(row).lstrip("0123456789")
        method = f"`{row['name']}` {mark}".strip()
        lines.append(f"| {method} | {unsigned(' | '.join([found, *map(bare, rest)]))} |")
    return "\n".join(lines + [f"\nNot run: `{e['name']}`: {e['failed']}" for e in ranked["failed"]]) + "\n"


def put(part: str, text: str) -> None:
    """Put what was made between the page's comments of that name; the words around it are written by hand."""
    begin, end = f"<!-- {part}: made by benchmarks/compare.py -->\n", f"<!-- end of {part} -->"
    before, rest = PAGE.read_text(encoding="utf-8").split(begin)
    PAGE.write_text(before + begin + text + end + rest.split(end)[1], encoding="utf-8")


def main() -> None:
    """Fly what is missing, write the tables into the page."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--jobs", type=int)
    arguments.add_argument("--frames", default=",".join(FRAMES), help="whose tables are made")
    arguments.add_argument("--closed-loop", action="store_true", help="also fly with the estimates in the loop")
    arguments.add_argument("--methods", default="all")
    arguments.add_argument(
        "--name", default="", help="of a run of other methods, such as -new: its rows join those that are kept"
    )
    arguments.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "rotorwatch-comparison")
    options = arguments.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    tables: list[str] = []
    told: set[str] = set()
    for frame in options.frames.split(","):
        out = options.out / f"{frame}{options.name}.json"
        if not out.exists():
            plan = ROOT / "benchmarks" / "comparison" / f"{frame}.toml"
            benchmark.run(plan, options.methods.split(","), out, options.jobs, notify=print)
        tables.append(table(ranking.rank(sorted(options.out.glob(f"{frame}*.json"))), told))
    put("frames", "".join(tables))
    if options.closed_loop:
        drivers = [closed_loop.NOBODY, closed_loop.TRUTH, "default", *sorted(set(discovery.estimators()) - {"default"})]
        put(
            "closed loop",
            staying_up(closed_loop.run(UP_PLAN, drivers, options.out / "closed-loop", UP_FLIGHTS, options.jobs)),
        )


if __name__ == "__main__":
    main()
