"""What do the parts of the diagnoser on board, all but its estimator, take on a Cortex-M7?

    python benchmarks/cortex_m7_parts.py

A row for each part, of a quadrotor and a hexarotor, in single and in double precision: code with tables in flash, what it remembers, the
deepest stack of one of its functions, and the instructions of its largest call in twenty seconds of flight with all that can happen in it.
Needs arm-none-eabi-gcc and qemu-system-arm. -Os. QEMU counts instructions, not cycles, forty at a time; a Cortex-M7 takes one to two
cycles for each.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import rotorwatch
from rotorwatch import airframes
from rotorwatch.export import export_diagnoser

HERE = Path(__file__).resolve().parent
CORE = HERE.parent / "embedded" / "cortex-m7"
SOURCES = Path(rotorwatch.__file__).parent / "export" / "embedded_c"
CHIP = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-std=c99", "-Os", "-fstack-usage")
BOARD = ("qemu-system-arm", "-M", "mps2-an500", "-nographic", "-semihosting", "-icount", "shift=0", "-kernel")
TICK = 40  # instructions a tick of its clock
# Part -> its struct, what it is for, and how the names of its functions begin.
PARTS = {
    "losses": ("rw_losses", "losses", ("losses", "record", "course", "explanation_state", "onset", "found")),
    "report": ("rw_report", "one list of events", ("report", "event", "knock")),
    "changes": ("rw_changes", "what is new, in words", ("changes", "change", "known", "words")),
    "front": ("rw_front", "samples to the estimator's inputs, and outputs that do not follow the mixer", ("",)),
}


def written(n: int, folder: Path) -> None:
    """rw_config.h of n rotors, ticks of 0.05 s, motion at 100 Hz and outputs at 50 Hz, and the front end."""
    B = airframes.named({4: "ardupilot-quad-x", 6: "ardupilot-hexa-x"}[n]).effectiveness()
    values = export_diagnoser.settings(B, 0.05) | export_diagnoser.rates(50.0, 100.0, 100.0)
    (folder / "rw_config.h").write_text("".join(f"#define RW_{name} {value}\n" for name, value in values.items()))
    for name, text in export_diagnoser.definitions().items():
        if name.startswith("rw_front"):
            (folder / name).write_text(text)


def run(command, **options) -> str:
    return subprocess.run([str(c) for c in command], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True, **options).stdout


def measured(n: int, single: bool) -> dict[str, tuple[int, int, int, int]]:
    """Part -> code, state, stack in bytes, instructions."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        written(n, folder)
        flags = [*CHIP, f"-I{folder}", f"-I{SOURCES}", *(["-DROTORWATCH_FLOAT"] if single else [])]
        link = [CORE / "startup.c", "--specs=rdimon.specs", "-T", CORE / "an500.ld", "-lm"]
        run(["arm-none-eabi-gcc", *flags, folder / "rw_front.c", HERE / "cortex_m7_parts.c", *link, "-o", folder / "m7.elf"], cwd=folder)
        result = run([*BOARD, folder / "m7.elf"], timeout=120)
        calls = {part: int(count) * TICK for part, count in (line.split()[:2] for line in result.splitlines())}
        calls["losses"] += calls["list"]
        run(["arm-none-eabi-gcc", *flags, "-c", folder / "rw_front.c", "-o", folder / "part.o"], cwd=folder)
        (folder / "size.c").write_text(
            '#include "rw_front.h"\n' + "".join(f"char of_{part}[sizeof({struct})];\n" for part, (struct, *_) in PARTS.items())
        )
        run(["arm-none-eabi-gcc", *flags, "-c", folder / "size.c", "-o", folder / "size.o"], cwd=folder)
        states = {name: size for size, _, name in symbols(folder / "size.o")}
        stacks = [line.split("\t") for line in (folder / "part.su").read_text().splitlines()]
        code, stack = dict.fromkeys(PARTS, 0), dict.fromkeys(PARTS, 0)
        for size, kind, name in symbols(folder / "part.o"):
            if kind in "TtRr":
                code[part_of(name)] += size
        for place, size, _ in stacks:
            part = part_of(place.rpartition(":")[2])
            stack[part] = max(stack[part], int(size))
        return {part: (code[part], states[f"of_{part}"], stack[part], calls.get(part, 0)) for part in PARTS}


def symbols(file: Path) -> list[tuple[int, str, str]]:
    """(size, kind, name) of each symbol that has a size."""
    rows = [line.split() for line in run(["arm-none-eabi-nm", "-S", file]).splitlines()]
    return [(int(row[1], 16), row[2], row[3]) for row in rows if len(row) == 4]


def part_of(name: str) -> str:
    """The part of a function by its name."""
    return next(part for part, (*_, begins) in PARTS.items() if name.removeprefix("rw_").startswith(begins))


def main() -> None:
    for n, name in ((4, "quadrotor"), (6, "hexarotor")):
        for single in (True, False):
            print(f"\n{name}, {'single' if single else 'double'} precision\n")
            print("| part | | code, bytes | state, bytes | stack, bytes | thousand instructions, largest call |")
            print("|---|---|---|---|---|---|")
            rows = measured(n, single)
            for part, (code, state, stack, count) in rows.items():
                calls = f"{count / 1e3:.1f}" if count else ""
                print(f"| {part} | {PARTS[part][1]} | {code} | {state} | {stack} | {calls} |")
            code, state = (sum(row[k] for row in rows.values()) for k in (0, 1))
            print(f"| all | | {code} | {state} | | |")


if __name__ == "__main__":
    main()
