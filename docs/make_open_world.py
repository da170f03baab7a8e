"""Fly plans/open.toml; write docs/results.md's table and docs/open_world.csv: `docs/make_open_world.py -o DIR [--flights N] [--jobs N]`.

The campaign is that of `rotorwatch campaign`, and goes on where it was stopped; after a change of the diagnosis give a new folder.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path

from rotorwatch_lab.campaign import open_world

ROOT = Path(__file__).resolve().parents[1]
PAGE, DATA = ROOT / "docs" / "results.md", ROOT / "docs" / "open_world.csv"
START, END = "<!-- table made by docs/make_open_world.py -->\n", "<!-- end of the table -->\n"


def filled(page: str, summary: dict) -> str:
    """The page with the tables of this summary in their place."""
    return page[: page.index(START) + len(START)] + open_world.markdown(summary, brief=True) + page[page.index(END) :]


def write(summary: dict) -> None:
    """Write the page's tables, and the file with all columns."""
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), summary), encoding="utf-8")
    with open(DATA, "w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(open_world.table(summary))


if __name__ == "__main__":
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("-o", "--out", required=True, type=Path, help="folder of the campaign")
    ask.add_argument("--flights", type=int, default=2000)
    ask.add_argument("--jobs", type=int, default=2)
    given = ask.parse_args()
    command = ["campaign", ROOT / "plans" / "open.toml", "--flights", given.flights, "--jobs", given.jobs, "-o", given.out]
    subprocess.run([sys.executable, "-m", "rotorwatch", *map(str, command)], check=True, stdout=subprocess.DEVNULL)
    summary = json.loads((given.out / "summary.json").read_text(encoding="utf-8"))
    write(summary)
