"""Texts that a pilot reads per flight, through the glue of the autopilot that flew, before and after they were made few; docs/pilot.md.

    python benchmarks/board_texts.py FOLDER|LOG... [--write docs/pilot.md]

Every log, also below a folder, that shows what a board would have seen (tests/board.py). Before: each change of an event, of 2 points and
more, was a text. Needs gcc and g++.
"""

import argparse
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests import board

from rotorwatch import logs
from rotorwatch.diagnose import diagnose
from rotorwatch.errors import RotorwatchError

NAMES = {2: "critical", 4: "warning", 5: "notice", 6: "information"}
BEGIN, END = "<!-- made by benchmarks/board_texts.py -->", "<!-- end -->"


def logs_of(given: list[Path]) -> list[Path]:
    found = [path for one in given for path in (sorted(one.rglob("*")) if one.is_dir() else [one])]
    return [p for p in found if p.suffix in (".xz", ".bin", ".ulg") and not {"corrupt", "damaged"} & set(p.parts)]


def rows(given: list[Path]):
    """A row for each log: (name, minutes, before, texts, shortest time between two, what was told, how it differs from diagnose)."""
    for path in logs_of(given):
        try:
            flight = logs.read(path)
            name, what = board.autopilot_of(flight), board.shown(flight)
            told = diagnose(flight)
        except (RotorwatchError, board.TooFew, IndexError, KeyError, ValueError) as why:
            print(f"{path.name}: {str(why)[:100]}", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory() as made:
            library = board.library(what, Path(made) / "library")
            flown = board.fly(board.build(name, library, Path(made)), what.table, Path(made))
        times = [time for time, *_ in flown.texts]
        apart = float(np.diff(times).min()) if len(times) > 1 else np.inf
        whole = any(e.kind == "loss_of_control" for e in told.events) or bool(told.doubts)
        differs = ["judged after the flight"] if whole else board.differences(told, flown)
        row = path.name, flight.duration / 60.0, len(flown.records.get("RWEV", [])), flown.texts, apart, differs
        print(row, file=sys.stderr)
        yield row


def page(found) -> str:
    lines = ["| flight | minutes | texts before | now | of which |", "|---|---|---|---|---|"]
    for name, minutes, before, texts, _, _ in sorted(found, key=lambda row: -row[2]):
        count = Counter(severity for _, severity, _ in texts)
        which = ", ".join(f"{count[k]} {NAMES[k]}" for k in sorted(count)) or "-"
        shown = re.sub(r"[.](bin|ulg|log|tlog)([.]xz)?$", "", name).replace("_", " ")
        lines.append(f"| {shown} | {minutes:.1f} | {before} | {len(texts)} | {which} |")
    total, now = sum(row[2] for row in found), sum(len(row[3]) for row in found)
    apart = min(row[4] for row in found)
    compared = [row for row in found if row[5] != ["judged after the flight"]]
    same = sum(not row[5] for row in compared)
    lines += [
        "",
        f"{len(found)} flights: {total} texts before, {now} now; never two within {apart:.1f} s. Of the {len(compared)} of them that "
        f"`diagnose` judges as they fly, {same} have the same events on board: rotors, onsets within {board.ONSET_S:g} s, what was "
        "withdrawn.",
    ]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", type=Path, nargs="+", metavar="FOLDER|LOG")
    parser.add_argument("--write", type=Path, help="page whose table is made anew")
    given = parser.parse_args()
    made = page(list(rows(given.logs)))
    print(made)
    if given.write:
        text = given.write.read_text()
        before, after = text.split(BEGIN)[0], text.split(END)[1]
        given.write.write_text(f"{before}{BEGIN}\n\n{made}\n\n{END}{after}")


if __name__ == "__main__":
    main()
