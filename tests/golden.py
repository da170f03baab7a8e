"""What is said of each sample log, to be held against what another version says: by `diagnose`, over a link, and on board.

    python -m tests.golden answers -o now.json --jobs 2                 # ../shared/flights; half an hour
    python -m tests.golden answers -o now.json --jobs 2 --only none     # diagnose alone; minutes
    python -m tests.golden compare tests/golden.json.xz now.json        # prints what differs; exit code 1 where anything does

Of each flight: verdict, headline, and of each event kind, rotors, candidates, onset, detection, end, sizes and intervals, with three
digits. `link`: what `watch` holds at the end of the flight sent over MAVLink at the rates that it asks for. `board`: the C library, fed the
log's own samples. Both are left out where they take no such flight.
"""

from __future__ import annotations

import argparse
import json
import lzma
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tests.link_flights import sent
from tests.onboard_law import events_in_c, flown

from rotorwatch import diagnose, logs
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.motion import tick_table
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import kinds
from rotorwatch.gathering import Gathered
from rotorwatch.witnesses.aerobatic import assess as aerobatic

SHARED = Path(__file__).resolve().parents[2] / "shared" / "flights"
TIME_S, SIZE = 0.0015, 0.0015  # by which rounded numbers may differ and be the same
MAV_TYPE = {3: 15, 4: 2, 6: 13, 8: 14, 10: 35, 12: 29}  # of a frame with so many rotors
BOARD = {kind.number: name for name, kind in kinds.table().items()}


def answers(path: Path, asked: Sequence[str] = ("link", "board")) -> dict:
    """Of one log: what `diagnose` says, and those that are asked beside it."""
    try:
        flight = logs.read(path)
        reported = diagnose(flight)
    except RotorwatchError as why:
        return {"refused": str(why).replace(str(path.parent), "")}
    found: dict = {"diagnose": {"verdict": reported.verdict, "headline": reported.headline, "events": events(reported.to_dict()["events"])}}
    for name in asked:
        ask = _link if name == "link" else _board
        try:
            aerobatic.decline(flight, "neither watch nor the library takes it.")
            found[name] = ask(flight, reported)
        except (RotorwatchError, LookupError, ValueError, StopIteration) as why:
            found[name] = {"left out": type(why).__name__}
    return found


def events(reported: list[dict]) -> list[dict]:
    """Events as the JSON has them, what is compared of them."""
    kept = ("kind", "rotors", "alternatives", "onset_s", "detected_s", "end_s", "loss", "interval")
    return rounded([{name: event[name] for name in kept} for event in reported])


def rounded(value: Any) -> Any:
    """Numbers with three digits."""
    if isinstance(value, float):
        return round(value, 3)
    if isinstance(value, dict):
        return {name: rounded(inner) for name, inner in value.items()}
    return [rounded(inner) for inner in value] if isinstance(value, (list, tuple)) else value


def _link(flight, reported) -> dict:
    said, _, _ = sent(flight, MAV_TYPE[len(reported.flight["geometry"])], "asked for")
    return {"events": events(said)}


def _board(flight, reported) -> dict:
    what = flown(flight)
    if what.dt > tick_table.SHORTEST_S / 2.0:
        raise ValueError("too slow for on board")
    with tempfile.TemporaryDirectory() as folder:
        rows, verdict, _ = events_in_c(Path(folder), what)

    def rotors(mask: float) -> list[int]:
        return [k + 1 for k in range(16) if int(mask) >> k & 1]

    def event(row) -> dict:
        loss = row[0] == 0
        return {
            "kind": BOARD[int(row[0])], "rotors": rotors(row[4]), "alternatives": [rotors(m) for m in row[10 : 10 + int(row[9])]],
            "onset_s": row[1], "detected_s": row[2], "end_s": None if row[3] >= LASTS else row[3], "loss": [row[5]] if loss else [],
            "interval": [[row[6], row[7]]] if loss else [],
        }  # fmt: skip

    return {"verdict": verdict, "events": rounded([event([float(v) for v in row]) for row in rows])}


def differences(old, new, where: str = "") -> list[str]:
    """What differs, a line each: numbers by more than rounding, and everything else."""
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*old, *(name for name in new if name not in old)]
        if not where.count(" ") > 1:  # who was asked in both
            names = [name for name in names if name not in ("link", "board") or (name in old and name in new)]
        return [line for name in names for line in differences(old.get(name), new.get(name), f"{where} {name}")]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [line for k, pair in enumerate(zip(old, new)) for line in differences(*pair, f"{where}[{k}]")]
    if isinstance(old, (int, float)) and isinstance(new, (int, float)):
        return [] if abs(old - new) <= (TIME_S if where.endswith("_s") else SIZE) else [f"{where}: {old} -> {new}"]
    return [] if old == new else [f"{where}: {_short(old)} -> {_short(new)}"]


def _short(value) -> str:
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return ", ".join(f"{e['kind']} {e['rotors']} {e['onset_s']}" for e in value)
    return str(value)


def read(path: str) -> dict:
    data = Path(path).read_bytes()
    return json.loads(lzma.decompress(data) if path.endswith(".xz") else data)


def write(found: dict, path: str) -> None:
    text = json.dumps(found, indent=0, sort_keys=True, ensure_ascii=False).encode()
    Path(path).write_bytes(lzma.compress(text) if path.endswith(".xz") else text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    ask = commands.add_parser("answers")
    ask.add_argument("folder", nargs="?", default=SHARED, type=Path)
    ask.add_argument("-o", "--output", required=True)
    ask.add_argument("--jobs", type=int, default=1)
    ask.add_argument("--only", default="link,board", help="whom to ask beside diagnose: link, board, both or none")
    compare = commands.add_parser("compare")
    compare.add_argument("old")
    compare.add_argument("new")
    given = parser.parse_args()
    if given.command == "compare":
        lines = differences(read(given.old), read(given.new))
        print("\n".join(lines) or "The same.")
        return int(bool(lines))
    paths, found = sorted(map(Path, Gathered([given.folder]))), {}
    work = partial(answers, asked=[name for name in ("link", "board") if name in given.only])
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        for path, answer in zip(paths, pool.map(work, paths)):
            found[path.relative_to(given.folder).as_posix()] = answer
            print(f"{len(found)} of {len(paths)}: {path.name}", file=sys.stderr, flush=True)
    write(found, given.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
