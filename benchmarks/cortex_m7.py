"""How many instructions does a step take on a Cortex-M7, and how much code and workspace?

    python benchmarks/cortex_m7.py                  # three filters
    python benchmarks/cortex_m7.py --diagnoser      # the whole diagnoser: a tick of its estimator, all of its code and memory

Needs arm-none-eabi-gcc and qemu-system-arm. Single precision, -Os. QEMU counts instructions, not cycles (-icount: one per nanosecond
of its clock, which SysTick tells at 25 MHz): a Cortex-M7 takes one to two cycles for each.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from contenders import METHODS, estimator

from rotorwatch.export.export_c import export_c
from rotorwatch.export.export_diagnoser import export_diagnoser

CORE = Path(__file__).resolve().parents[1] / "embedded" / "cortex-m7"
CHIP = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-std=c99", "-DROTORWATCH_FLOAT", "-Os")
STEPS, TICK = 20, 40  # instructions a tick
MAIN = """
#include "{name}.h"
#include <stdio.h>
#define SYSTICK ((volatile uint32_t *)0xE000E010u)
static {name}_state state;
static {name}_workspace work;
static {name}_out out;
int main(void)
{{
    static const rw_real u[4] = {{0.39f, 0.39f, 0.39f, 0.39f}}, y[6] = {{0}};
    static const bool valid[6] = {{true, true, true, true, true, true}};
    {name}_init(&state, &work);
    for (int k = 0; k < 100; ++k)
        {name}_step(&state, u, y, valid, &out, &work);
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5;
    for (int k = 0; k < {steps}; ++k)
        {name}_step(&state, u, y, valid, &out, &work);
    printf("%lu\\n", (unsigned long)(0xFFFFFFu - SYSTICK[2]));
    return 0;
}}
"""


# Ticks of a hover that is judged, with all onsets in use; then, of a flight that fills all blocks, the longest slice of the look at its
# trim, and the last one, which concludes.
DIAGNOSER = """
#include "rw_diagnoser.h"
#include <stdio.h>
#define SYSTICK ((volatile uint32_t *)0xE000E010u)
static rw_diagnoser d;
static unsigned long last;
static rw_real noise(void)
{{
    static uint32_t state = 1;
    state = state * 1664525u + 1013904223u;
    return (rw_real)(state >> 8) / (rw_real)16777216 - (rw_real)0.5;
}}
static unsigned long longest(rw_trim *t)
{{
    unsigned long most = 0;
    rw_real lacking[3] = {{0}}, thrust[RW_ROTORS];
    t->every = RW_LASTS;
    for (int k = 0; k < 20 * 165; ++k) {{
        for (int a = 0; a < 3; ++a) lacking[a] += (rw_real)0.01 * noise();
        for (int i = 0; i < RW_ROTORS; ++i) thrust[i] = 1 + (rw_real)0.2 * noise();
        rw_trim_tick(t, &rw_vehicle_default, 0.05, 0.05 * k, RW_JUDGE, true, lacking, thrust);
    }}
    SYSTICK[2] = 0;
    rw_trim_close(t, &rw_vehicle_default);
    most = 0xFFFFFFu - SYSTICK[2];
    for (bool more = true; more; most = last > most ? last : most) {{
        SYSTICK[2] = 0;
        more = rw_trim_step(t, &rw_vehicle_default);
        last = 0xFFFFFFu - SYSTICK[2];
    }}
    return most;
}}
int main(void)
{{
    static rw_inputs now;
    rw_engine *const e = &d.engine;
    rw_diagnoser_init(&d, &rw_vehicle_default, &rw_plan_default);
    for (int k = 0; k < RW_ROTORS; ++k) now.thrust[k] = 1;
    for (int a = 0; a < 4; ++a) now.valid[a] = true;
    now.load = now.wrench[3] = RW_ROTORS;
    now.full = 2;
    now.mode = RW_JUDGE;
    for (int k = 0; k < 80; ++k) rw_estimator_step(&e->estimator, &rw_plant_default, &now, &e->out);
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5;
    for (int k = 0; k < {steps}; ++k) rw_estimator_step(&e->estimator, &rw_plant_default, &now, &e->out);
    const unsigned long steps = 0xFFFFFFu - SYSTICK[2];
    printf("%lu %lu %lu %lu %lu %lu %lu\\n", steps, longest(&e->trim), last, (unsigned long)sizeof d,
           (unsigned long)sizeof e->estimator, (unsigned long)sizeof e->trim, (unsigned long)sizeof e->room);
    return 0;
}}
"""


def on_the_chip(folder: Path, chip: tuple[str, ...]) -> list[int]:
    """What a folder's sources print on the emulated board."""
    elf = str(folder / "m7.elf")
    sources = [*map(str, sorted(folder.glob("*.c"))), str(CORE / "startup.c")]
    link = ["--specs=rdimon.specs", "-T", str(CORE / "an500.ld"), "-lm"]
    subprocess.run(["arm-none-eabi-gcc", *chip, *sources, *link, "-o", elf], check=True)
    board = ["qemu-system-arm", "-M", "mps2-an500", "-nographic", "-semihosting", "-icount", "shift=0", "-kernel", elf]
    result = subprocess.run(board, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120, check=True)
    return [int(word) for word in result.stdout.split()]


def code_bytes(folder: Path, chip: tuple[str, ...], names: list[str]) -> int:
    """Code and tables of sources of the folder."""
    for name in names:
        subprocess.run(["arm-none-eabi-gcc", *chip, "-c", name, "-o", f"{name}.o"], check=True, cwd=folder)
    size = subprocess.run(
        ["arm-none-eabi-size", *(f"{name}.o" for name in names)], capture_output=True, text=True, check=True, cwd=folder
    )
    return sum(int(line.split()[0]) for line in size.stdout.splitlines()[1:])


def filters() -> None:
    """A row for each of three filters."""
    print("| method | thousand instructions a step | text kB | workspace kB |")
    print("|---|---|---|---|")
    for name in METHODS[:3]:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            made = export_c(estimator(name), folder)
            (folder / "example.c").write_text(MAIN.format(name=name, steps=STEPS))
            count = on_the_chip(folder, CHIP)[0] * TICK / STEPS
            text = code_bytes(folder, CHIP, [f"{name}.c"])
            print(f"| {name} | {count / 1e3:.0f} | {text / 1e3:.1f} | {made.workspace_bytes / 2e3:.1f} |")


def diagnoser() -> None:
    """A row for each vehicle and precision."""
    print(
        "| vehicle | precision | million instructions a tick | of the longest slice of a look at the trim | of its last one | code kB "
        "| memory kB | estimator's state kB | trim's kB | workspace kB |"
    )
    print("|---" * 10 + "|")
    for vehicle in ("ardupilot-quad-x", "ardupilot-hexa-x"):
        for precision, chip in (("single", CHIP), ("double", tuple(f for f in CHIP if "FLOAT" not in f))):
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch)
                written = export_diagnoser(folder, vehicle=vehicle)
                (folder / "example.c").write_text(DIAGNOSER.format(steps=STEPS))
                count, longest, last, *sizes = on_the_chip(folder, chip)
                text = code_bytes(folder, chip, [p.name for p in written if p.suffix == ".c" and p.name != "example.c"])
                counts = (count / STEPS, longest, last)
                row = [*(f"{n * TICK / 1e6:.2f}" for n in counts), *(f"{n / 1e3:.0f}" for n in (text, *sizes))]
                print(f"| {vehicle} | {precision} | {' | '.join(row)} |")


if __name__ == "__main__":
    diagnoser() if "--diagnoser" in sys.argv[1:] else filters()
