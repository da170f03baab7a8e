"""How many instructions does a step take on a Cortex-M7, and how much code and workspace?

    python benchmarks/cortex_m7.py

Needs arm-none-eabi-gcc and qemu-system-arm. Single precision, -Os. QEMU counts instructions, not cycles (-icount: one per nanosecond
of its clock, which SysTick tells at 25 MHz): a Cortex-M7 takes one to two cycles for each.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from contenders import METHODS, estimator

from rotorwatch.export_c import export_c

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


def main() -> None:
    print("| method | thousand instructions a step | text kB | workspace kB |")
    print("|---|---|---|---|")
    for name in METHODS[:3]:
        with tempfile.TemporaryDirectory() as scratch:
            folder, elf = Path(scratch), str(Path(scratch) / "m7.elf")
            made = export_c(estimator(name), folder)
            (folder / "count.c").write_text(MAIN.format(name=name, steps=STEPS))
            sources = [str(folder / f"{name}.c"), str(folder / "count.c"), str(CORE / "startup.c")]
            link = ["--specs=rdimon.specs", "-T", str(CORE / "an500.ld"), "-lm"]
            subprocess.run(["arm-none-eabi-gcc", *CHIP, *sources, *link, "-o", elf], check=True)
            subprocess.run(["arm-none-eabi-gcc", *CHIP, "-c", sources[0], "-o", str(folder / "one.o")], check=True)
            board = [
                "qemu-system-arm",
                "-M",
                "mps2-an500",
                "-nographic",
                "-semihosting",
                "-icount",
                "shift=0",
                "-kernel",
                elf,
            ]
            said = subprocess.run(
                board, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=True
            )
            size = subprocess.run(
                ["arm-none-eabi-size", str(folder / "one.o")], capture_output=True, text=True, check=True
            )
            count = int(said.stdout) * TICK / STEPS
            text = int(size.stdout.splitlines()[1].split()[0])
            print(f"| {name} | {count / 1e3:.0f} | {text / 1e3:.1f} | {made.workspace_bytes / 2e3:.1f} |")


if __name__ == "__main__":
    main()
