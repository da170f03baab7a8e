"""Write docs/comparison.md and docs/comparison.csv: all methods on the same simulated flights, and which of them keep a vehicle up.

    python benchmarks/compare.py [--jobs 2] [--frames quad-x] [--flights 256] [--closed-loop] [--out FOLDER]
                                 [--methods NAME,NAME --name -more]

Runs `rotorwatch benchmark` on the plans in benchmarks/comparison and, with --closed-loop, `rotorwatch closed-loop
plans/survival-methods.toml`; without, that part of the page stays as it is. Results are kept in --out: what is there is not flown again,
and a run that was interrupted goes on where it was.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from pathlib import Path

from rotorwatch.base import discovery
from rotorwatch_lab.campaign import benchmark, closed_loop, ranking

ROOT = Path(__file__).resolve().parents[1]
PAGE, DATA = ROOT / "docs" / "comparison.md", ROOT / "docs" / "comparison.csv"
FRAMES = ("quad-x", "hexa-x", "octa-x", "octaquad-x", "y6")
UP_DATA = ROOT / "docs" / "comparison-closed-loop.csv"
UP_PLAN, UP_FLIGHTS = ROOT / "plans" / "survival-methods.toml", 240
UP = """
## Survival in closed loop

{flights} flights of `{plan}` ([closed loop](control.md#closed-loop)): quad X and hexa X, losses of 10 % to 100 % of one rotor or two, wind
to 9 m/s. A method's estimates drive the allocation; `nobody` keeps the autopilot's mixer, `truth` knows every loss after 0.1 s.
The first ones (all, also by frame: [comparison-closed-loop.csv](comparison-closed-loop.csv)):

"""
PAIR = ("detected", "right")
SHOWN = ("detected", "delay_s", "right", "own_false_alarms_h")  # scores of the first frame on the page; the file has all
COLUMNS = (
    *("frame", "method", "like_first", "found_percent", "found_low", "found_high", "delay_s", "right_percent", "size_error"),
    *("coverage_percent", "own_alarms_h", "us_per_step"),
)
UP_COLUMNS = ("driver", "stays up, of those that the truth saves, %", "acted falsely, flights an hour", "first acted after, s")
UP_FRAMES = ("quad-x", "hexa-x")
UP_SHOWN = 10  # drivers on the page, besides nobody


def percent(share: dict | None) -> str:
    """A share in per cent, which the head of its column says, with its interval."""
    return "-" if share is None else "{:.0f} ({:.0f}–{:.0f})".format(*(100 * share[k] for k in ("value", "low", "high")))


def unsigned(cell: str) -> str:
    """A cell of the ranking as `percent` writes it."""
    return cell.replace(" %", "").replace(" to ", "–")


def bare(cell: str) -> str:
    """A value without its interval, which the results' files keep."""
    return cell.partition(" (")[0]


def number(value: dict | None) -> str:
    """A number with its interval."""
    return "-" if value is None else "{:.2f} ({:.2f} to {:.2f})".format(*(value[k] for k in ("value", "low", "high")))


def staying_up(found: dict) -> tuple[str, list[list[str]]]:
    """The closed loop, the best first: the first ones in Markdown, and all rows of comparison-closed-loop.csv with the shares by frame."""
    lines = [f"| {' | '.join(UP_COLUMNS)} |", "|---" * len(UP_COLUMNS) + "|"]
    rows = [["driver", "stays_up_percent", *(f"{frame}_percent" for frame in UP_FRAMES), "acted_falsely_h", "first_acted_s"]]
    for name, m in sorted(found["drivers"].items(), key=lambda row: -row[1]["of_possible"]["value"]):
        share, false, first = percent(m["of_possible"]), bare(number(m["false_h"])), bare(number(m["first_s"]))
        frames = [bare(percent(m["possible_by_frame"][frame])) for frame in UP_FRAMES]
        if len(rows) <= UP_SHOWN or name == "nobody":
            lines.append(f"| `{name}` | {share} | {false} | {first} |")
        rows.append([name, share, *frames, false, first])
    return UP.format(flights=found["flights"], plan=UP_PLAN.relative_to(ROOT)) + "\n".join(lines) + "\n", rows


def name_of(ranked: dict) -> str:
    """The frame that a ranking is of."""
    return ranked["plan"]["name"].removeprefix("comparison-")


def table(ranked: dict) -> str:
    """The ranking of the first frame in Markdown."""
    plan, rows = ranked["plan"], ranked["rows"]
    scores = rows[0]["scores"]
    count = f"{plan['flights']} flights, {scores['clear_faults']:.0f} clear faults, {scores['healthy_h']:.1f} healthy hours"
    heads = [ranking.COLUMNS[key] + (", %" if key in ranking.SHARES else "") for key in SHOWN]
    lines = [f"\n## {name_of(ranked)}\n", f"{count}.\n", f"| method | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    for row in rows:
        found, *rest = [ranking.cell(key, row["scores"].get(key)) for key in SHOWN]
        mark = ranking.mark(row).lstrip("0123456789")
        method = f"`{row['name']}` {mark}".strip()
        lines.append(f"| {method} | {unsigned(' | '.join([found, *map(bare, rest)]))} |")
    return "\n".join(lines + [f"\nNot run: `{e['name']}`: {e['failed']}" for e in ranked["failed"]]) + "\n"


def others(frames: list[dict]) -> str:
    """The other frames in one table, in the order of the first of them: share found and share with the right rotor, in per cent."""
    scores = [{row["name"]: row["scores"] for row in ranked["rows"]} for ranked in frames]
    names = dict.fromkeys(name for found in scores for name in found)
    counts = ", ".join(f"{ranked['rows'][0]['scores']['clear_faults']:.0f}" for ranked in frames)
    hours = [ranked["rows"][0]["scores"]["healthy_h"] for ranked in frames]
    lines = [
        "\n## Other frames\n",
        f"Found and right rotor, %. [comparison.csv](comparison.csv) has all scores, and methods flown on {name_of(frames[0])} alone.",
        f"{frames[0]['plan']['flights']} flights each; {counts} clear faults, {min(hours):.1f} to {max(hours):.1f} healthy hours.\n",
        f"| method | {' | '.join(map(name_of, frames))} |",
        "|---" * (len(frames) + 1) + "|",
    ]
    for name in names:
        if any(name in found for found in scores[1:]):
            cells = [", ".join(value(found[name][key]) for key in PAIR) if name in found else "-" for found in scores]
            lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def value(score: dict | None) -> str:
    """A share in per cent without its interval."""
    return "-" if score is None else f"{100 * score['value']:.0f}"


def rows(ranked: dict) -> list[list[str]]:
    """Rows of comparison.csv: one for each method of a frame."""
    found = []
    for row in ranked["rows"]:
        scores, share = row["scores"], row["scores"]["detected"]
        limits = [f"{100 * share[key]:.0f}" for key in ("value", "low", "high")]
        rest = [bare(ranking.cell(key, scores.get(key))) for key in list(ranking.COLUMNS)[1:]]
        like = "yes" if ranking.mark(row).endswith("=") else ""
        found.append([name_of(ranked), row["name"], like, *limits, *(unsigned(cell).replace("-", "") for cell in rest)])
    return found


def put(part: str, text: str) -> None:
    """Put what was made between the page's comments of that name; the words around it are written by hand."""
    begin, end = f"<!-- {part}: made by benchmarks/compare.py -->\n", f"<!-- end of {part} -->"
    before, rest = PAGE.read_text(encoding="utf-8").split(begin)
    PAGE.write_text(before + begin + text + end + rest.split(end)[1], encoding="utf-8")


def write(path: Path, rows_: list) -> None:
    """Write rows as comma-separated values."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows_)


def main() -> None:
    """Fly what is missing, write the tables into the page."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--jobs", type=int)
    arguments.add_argument("--frames", default=",".join(FRAMES), help="whose tables are made")
    arguments.add_argument("--flights", type=int, help="of a frame, instead of its plan's number")
    arguments.add_argument("--closed-loop", action="store_true", help="also fly with the estimates in the loop")
    arguments.add_argument("--methods", default="all")
    arguments.add_argument("--name", default="", help="of a run of other methods, such as -new: its rows join those that are kept")
    arguments.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "rotorwatch-comparison")
    options = arguments.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    ranked: list[dict] = []
    for frame in options.frames.split(","):
        out = options.out / f"{frame}{options.name}.json"
        if not out.exists():
            plan = benchmark.read(ROOT / "benchmarks" / "comparison" / f"{frame}.toml")
            plan = plan._replace(flights=options.flights or plan.flights)
            benchmark.run(plan, options.methods.split(","), out, options.jobs, notify=print)
        ranked.append(ranking.rank(sorted(options.out.glob(f"{frame}*.json"))))
    put("frames", table(ranked[0]) + (others(ranked[1:]) if ranked[1:] else ""))
    write(DATA, [COLUMNS, *(row for one in ranked for row in rows(one))])
    if options.closed_loop:
        drivers = [closed_loop.NOBODY, closed_loop.TRUTH, "default", *sorted(set(discovery.estimators()) - {"default"})]
        found = closed_loop.run(UP_PLAN, drivers, options.out / "closed-loop", UP_FLIGHTS, options.jobs)
        text, rows_ = staying_up(found)
        put("closed loop", text)
        write(UP_DATA, rows_)


if __name__ == "__main__":
    main()
