"""Write docs/ranking.md: the methods of all results in benchmarks/results, ranked; and compute results again from their seeds.

    python docs/make_ranking.py                                         the page, of every file in the folder
    python docs/make_ranking.py --check benchmarks/results/mine.json    flies the plan again; exit code 1 where a score is another

A method of no package is a file beside its results, of the same name (benchmarks/results/mine.py).
"""

from __future__ import annotations

import math
import sys
import tempfile
from pathlib import Path
from typing import Any

from rotorwatch.base import files
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import benchmark, benchmark_plan, ranking, results_file

HERE = Path(__file__).parent
FOLDER = "../benchmarks/results"
RESULTS, PAGE = HERE / FOLDER, HERE / "ranking.md"
SHOWN = ("detected", "delay_s", "right", "loss_rmse", "coverage", "own_false_alarms_h")
# Another processor rounds otherwise: so large a share of flights and of a number may differ.
ALIKE = 0.02
HEAD = """# Ranking

Results of all who have entered theirs on the plan `{plan}` (version {version}, {flights} flights); made by `python docs/make_ranking.py`.
[Columns](benchmark.md#scores): *found* within {within:g} s at {rate:g} false alarms an hour; `=`: not significantly different from the
first.

"""
ENTER = """
To enter yours, run in `benchmarks/results`, with its file there unless it is in a package on PyPI:

```sh
rotorwatch benchmark quick --method mine:Mine -o mine.json
python ../../docs/make_ranking.py
```

and open a pull request with these files and this page. CI flies the plan again from its seeds (`--check mine.json`) and refuses scores that
do not come out.
"""


def page(paths: list[Path]) -> str:
    """The page of these results, which are of one plan. Raises ConfigError."""
    ranked = ranking.rank(paths)
    plan = ranked["plan"]
    head = HEAD.format(
        plan=plan["name"], version=plan["version"], flights=plan["flights"], within=plan["within_s"], rate=plan["false_alarms_h"]
    )
    lines = [["", "method", "from", *(ranking.COLUMNS[key] for key in SHOWN), "results"], ["---"] * (len(SHOWN) + 4)]
    for row in ranked["rows"]:
        whose = f"{row['package']} {row['version']}" if row["version"] else f"[its file]({FOLDER}/{row['file'].removesuffix('.json')}.py)"
        cells = [ranking.cell(key, row["scores"].get(key)) for key in SHOWN]
        lines.append([ranking.mark(row), f"`{row['name']}`", whose, *cells, f"[{row['file']}]({FOLDER}/{row['file']})"])
    return head + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n" + ENTER


def check(path: Path) -> list[str]:
    """Sentences on what comes out differently when the methods of a results file fly its plan again. Raises ConfigError."""
    stated = results_file.read(path)
    plan = benchmark_plan.parsed(stated["plan"]["text"], stated["plan"]["name"])
    sys.path.insert(0, str(path.resolve().parent))
    with tempfile.TemporaryDirectory() as folder:
        names = [entry["name"] if entry["version"] else entry["path"] for entry in stated["methods"] if entry["scores"]]
        again = benchmark.run(plan, names, Path(folder) / "again.json")
    found = {entry["name"]: entry["scores"] for entry in again["methods"]}
    flights = stated["plan"]["flights"]
    return [
        f"{path.name}: {entry['name']}: {key} is {_brief(entry['scores'].get(key))} in the file and {_brief(scores[key])} computed again."
        for entry in stated["methods"]
        if entry["scores"] and (scores := found[entry["name"]])
        for key in scores
        if key != "us_per_step" and not _alike(entry["scores"].get(key), scores[key], flights)
    ]


def _alike(stated: Any, again: Any, flights: int) -> bool:
    """Whether both say the same but for rounding."""
    if isinstance(again, list) and isinstance(stated, list):
        return len(set(stated) ^ set(again)) <= ALIKE * flights
    if isinstance(again, dict) and isinstance(stated, dict):
        if "value" in again:
            return "value" in stated and _alike(stated["value"], again["value"], flights)
        other = set(stated) ^ set(again) | {k for k in set(stated) & set(again) if abs(stated[k] - again[k]) > ALIKE}
        return len(other) <= ALIKE * flights
    if stated is None or again is None or isinstance(again, list | dict) or isinstance(stated, list | dict):
        return stated is again
    return math.isclose(stated, again, rel_tol=ALIKE, abs_tol=ALIKE)


def _brief(value: Any) -> str:
    value = value["value"] if isinstance(value, dict) and "value" in value else value
    return f"{value:.4g}" if isinstance(value, float) else f"a list of {len(value)}" if isinstance(value, list | dict) else str(value)


if __name__ == "__main__":
    try:
        wrong = [line for name in sys.argv[2:] for line in check(Path(name))] if "--check" in sys.argv[1:2] else []
        if len(sys.argv) == 1:
            files.writable(PAGE, "the page")
            PAGE.write_text(page(sorted(RESULTS.glob("*.json"))), encoding="utf-8")
    except ConfigError as why:
        sys.exit(str(why))
    sys.exit("\n".join(wrong) if wrong else 0)
