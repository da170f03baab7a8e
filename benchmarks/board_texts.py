"""Texts that a pilot reads per flight, through the glue of the autopilot that flew; docs/pilot.md.

    python benchmarks/board_texts.py FOLDER|LOG... [--write docs/pilot.md]

Every log, also below a folder, that shows what a board would have seen (tests/board.py). Needs gcc and g++.
"""

import argparse
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
    """A row for each log: (name, minutes, number of `RWEV` records, texts, shortest time between two, differences from `diagnose`)."""
    for path in logs_of(given):
        try:
            flight = logs.read(path)
            name, what = board.autopilot_of(flight), board.shown(flight)
            reported = diagnose(flight)
        except (RotorwatchError, board.TooFew, IndexError, KeyError, ValueError) as why:
            print(f"{path.name}: {str(why)[:100]}", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory() as made:
            library = board.library(what, Path(made) / "library")
            flown = board.fly(board.build(name, library, Path(made)), what.table, Path(made))
        times = [time for time, *_ in flown.texts]
        apart = float(np.diff(times).min()) if len(times) > 1 else np.inf
        whole = any(e.kind == "loss_of_control" for e in reported.events) or bool(reported.doubts)
        differs = ["assessed after the flight"] if whole else board.differences(reported, flown)
        row = path.name, flight.duration / 60.0, len(flown.records.get("RWEV", [])), flown.texts, apart, differs
        print(row, file=sys.stderr)
        yield row


def page(found) -> str:
    """Number of flights by number of texts, and a paragraph: severities, spacing, agreement with `diagnose`."""
    flights = Counter(len(row[3]) for row in found)
    counts = range(max(flights) + 1)
    severity = Counter(severity for row in found for _, severity, _ in row[3])
    which = ", ".join(f"{severity[k]} {NAMES[k]}" for k in sorted(severity))
    minutes = [row[1] for row in found]
    apart = min(row[4] for row in found)
    compared = [row for row in found if row[5] != ["assessed after the flight"]]
    same = sum(not row[5] for row in compared)
    lines = [
        f"| texts in the flight | {' | '.join(map(str, counts))} |",
        "|---|" + "---|" * len(counts),
        f"| flights | {' | '.join(str(flights[k]) for k in counts)} |",
        "",
        f"{len(found)} flights of {min(minutes):.1f} to {max(minutes):.1f} minutes: {sum(severity.values())} texts ({which}), never two "
        f"within {apart:.1f} s.",
        f"Of the {len(compared)} flights without a loss of control or contradictory signals, {same} have the events of `diagnose` on",
        f"board: rotors, onsets within {board.ONSET_S:g} s, withdrawals.",
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
