"""How often does the log reader in C say what `diagnose` says, and how long does it take?

    python benchmarks/log_reader.py [FOLDER]        # of ULog and DataFlash logs; ../shared/flights, some minutes

Of losses: the same rotors, the onset within SAME_S and the size within SAME. Times are of the processor, also with the code as WebAssembly
in Node where that can be built, for logs of ABOUT_MB.
"""

from __future__ import annotations

import json
import lzma
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from rotorwatch import diagnose, logs
from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.export.export_log_reader import export_log_reader
from rotorwatch.flight.kinds import LOSS

SHARED = Path(__file__).resolve().parents[2] / "shared" / "flights"
FORMATS = ("dataflash", "PX4 ULog")
SAME_S, SAME = 0.1, 0.02
ABOUT_MB = 3.5, 4.5
FLAGS = ("-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
NODE = """
import {{ readFileSync }} from "node:fs";
import {{ assess }} from "{folder}/rotorwatch.mjs";
const module = await WebAssembly.compile(readFileSync("{folder}/rotorwatch.wasm")), data = readFileSync(process.argv[2]);
const spent = [];
for (let k = 0; k < 3; k++) {{
  const before = process.cpuUsage();
  await assess(module, data, "log");
  spent.push(process.cpuUsage(before).user / 1e3);
}}
console.log(Math.min(...spent));
"""


def build(folder: Path) -> tuple[Path, Path | None]:
    """(the command, a script for Node or None) in a folder."""
    try:
        export_log_reader(folder, page=True)
    except ConfigError as why:
        print(why, file=sys.stderr)
        export_log_reader(folder)
    command, script = folder / "rotorwatch-c", folder / "timed.mjs"
    subprocess.run(["cc", *FLAGS, "-o", command, *sorted(folder.glob("rw_*.c")), "-lm"], check=True)
    script.write_text(NODE.format(folder=folder))
    return command, script if (folder / "rotorwatch.wasm").exists() else None


def ran(command: Path, log: Path) -> tuple[dict, float]:
    """(the answer to a log, user time of the processor in ms)."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    done = subprocess.run([command, log], capture_output=True, text=True, check=False)
    return json.loads(done.stdout), 1e3 * (resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before)


def same(event: dict, other: dict) -> bool:
    near = all(abs(a - b) <= SAME for a, b in zip(event["loss"], other["loss"]))
    return event["rotors"] == other["rotors"] and abs(event["onset_s"] - other["onset_s"]) <= SAME_S and near


def main(folder: Path) -> None:
    counts, refused, times = Counter(), Counter(), []
    with tempfile.TemporaryDirectory() as scratch:
        command, script = build(Path(scratch))
        raw = Path(scratch) / "log"
        for path in sorted(folder.rglob("*")):
            if path.is_dir() or not path.name.lower().removesuffix(".xz").endswith((".bin", ".ulg", ".log")):
                continue
            try:
                flight = logs.read(path)
                if flight.format not in FORMATS:
                    continue
                reported = diagnose(flight)
                raw.write_bytes(lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes())
            except (RotorwatchError, lzma.LZMAError):
                continue
            answer, spent = ran(command, raw)
            counts["diagnose"] += 1
            if "error" in answer:
                refused[answer["error"]] += 1
                continue
            counts["assessed"] += 1
            if ABOUT_MB[0] <= raw.stat().st_size / 1e6 <= ABOUT_MB[1]:
                node = subprocess.run(["node", script, raw], capture_output=True, text=True, check=True).stdout if script else "nan"
                times.append((min(spent, ran(command, raw)[1]), float(node)))
            if reported.doubts:
                counts["doubted"] += 1
                continue
            one, other = ([e for e in events if e["kind"] == LOSS] for events in (answer["events"], reported.to_dict()["events"]))
            counts["same"] += len(one) == len(other) and all(map(same, one, other))
            counts["both"] += bool(one and other)
            counts["agree"] += any(same(a, b) for a in one for b in other)
            counts["only here"] += bool(one and not other)
            counts["only diagnose"] += bool(other and not one)
            if bool(one) != bool(other) or (one and not any(same(a, b) for a in one for b in other)):
                print(f"{path.name}: {reported.verdict}, {len(other)} losses; here {answer['verdict']}, {len(one)}", file=sys.stderr)
    rows = [
        ("logs that `diagnose` assesses", counts["diagnose"]),
        ("of these assessed by rotorwatch-c", counts["assessed"]),
        ("of these without a contradiction that `diagnose` finds", counts["assessed"] - counts["doubted"]),
        ("the same losses, or none in both", counts["same"]),
        ("a loss in both; with the same rotor, onset and size", f"{counts['both']}; {counts['agree']}"),
        ("a loss in rotorwatch-c alone; in `diagnose` alone", f"{counts['only here']}; {counts['only diagnose']}"),
    ]
    if times:
        native, node = np.median(np.array(times), axis=0)
        rows.append((f"ms for a log of 4 MB, native; in Node ({len(times)} logs)", f"{native:.0f}; {node:.0f}"))
    print("| of ULog and DataFlash logs | number |\n|---|---|")
    print("\n".join(f"| {what} | {number} |" for what, number in rows))
    print("\nRefused: " + "; ".join(f"{number} {why}" for why, number in refused.most_common()))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else SHARED)
