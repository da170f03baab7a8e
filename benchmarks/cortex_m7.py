"""How many instructions does a step take on a Cortex-M7, and how much code, memory and stack?

    python benchmarks/cortex_m7.py                  # three filters, in single precision
    python benchmarks/cortex_m7.py --diagnoser      # the whole diagnoser, in a flight; a quarter of an hour for all vehicles

Needs arm-none-eabi-gcc and qemu-system-arm. -Os. QEMU counts instructions, not cycles (-icount: one per nanosecond
of its clock, which SysTick tells at 25 MHz): a Cortex-M7 takes one to two cycles for each.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from contenders import METHODS, estimator

from rotorwatch.export.export_diagnoser import export_diagnoser
from rotorwatch_lab.export_c import export_c

CORE = Path(__file__).resolve().parents[1] / "embedded" / "cortex-m7"
CHIP = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-std=c99", "-DROTORWATCH_FLOAT", "-Os")
STEPS, TICK = 20, 40  # instructions a tick of SysTick
SECONDS = 145  # of flight
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


# A flight with all that can happen in it: rest, hover in which a rotor loses thrust, a knock, a descent on little thrust of which it is not
# known for seconds whether it is the ground, hover again, a spin, the same descent once more, and the landing. The work is done in pieces,
# and each of them, and each feed, poll and text, is counted; so is the deepest stack.
DIAGNOSER = """
#include "rw_text.h"
#include <stdio.h>
#define SYSTICK ((volatile uint32_t *)0xE000E010u)
#define BEGIN (since = SYSTICK[2])
#define TOOK ((since - SYSTICK[2]) & 0xFFFFFFu)
#define COUNTED(most, call) do {{ BEGIN; call; took = TOOK; if (took > most) most = took; }} while (0)
enum {{ HZ = 100, DEEP = 16384 }};
static rw_diagnoser d;
static rw_texts reported;
static unsigned long since, took, feeds, pieces, landing, polls, texts, said, tick, whole, steady, ticks;
static rw_real noise(void)
{{
    static uint32_t state = 1;
    state = state * 1664525u + 1013904223u;
    return (rw_real)(state >> 8) / (rw_real)16777216 - (rw_real)0.5;
}}
static void sample(rw_time t)
{{
    const bool low = (t >= 100 && t < 104) || t >= 132, over = t >= 138;
    const rw_real still[4] = {{1, 0, 0, 0}}, v[3] = {{0, 0, low && !over ? 1 : 0}};
    rw_real rate[3], force[3] = {{0, 0, (rw_real)-9.81}}, output[RW_ROTORS];
    for (int a = 0; a < 3; ++a) {{
        rate[a] = (rw_real)0.02 * noise() + (a == 2 && t >= 120 && t < 124 ? 15 : 0);
        force[a] += (rw_real)0.4 * noise() + (t >= 60 && t < (rw_time)60.03 ? 30 : 0);
    }}
    COUNTED(feeds, rw_diagnoser_gyro(&d, t, rate, true));
    COUNTED(feeds, rw_diagnoser_accel(&d, t, force, true));
    COUNTED(feeds, rw_diagnoser_attitude(&d, t, still));
    COUNTED(feeds, rw_diagnoser_velocity_ned(&d, t, v));
    for (int i = 0; i < RW_ROTORS; ++i) {{
        const rw_real share = t < 2 || over ? (rw_real)0.02 : low ? (rw_real)0.1 : t >= 80 && i == 0 ? (rw_real)0.6 : (rw_real)0.5;
        output[i] = rw_vehicle_default.u_min
            + (share + (rw_real)0.02 * noise()) * (rw_vehicle_default.u_max - rw_vehicle_default.u_min);
    }}
    COUNTED(feeds, rw_diagnoser_outputs(&d, t, output, (rw_rotors)((1u << RW_ROTORS) - 1u)));
    if (t >= 140) COUNTED(feeds, rw_diagnoser_state(&d, t, 1, 0));
}}
static void work(rw_time t)
{{
    for (bool more = true; more;) {{
        const bool assessed = d.engine.underway && d.engine.tick.mode == RW_ASSESS;
        BEGIN;
        more = rw_diagnoser_work(&d);
        took = TOOK;
        if (t < 139) {{ if (took > pieces) pieces = took; }}
        else if (took > landing) landing = took;
        if (assessed) {{
            tick += took;
            if (!d.engine.underway) {{
                if (tick > whole) whole = tick;
                if (t > 20 && t < 25) {{ steady += tick; ++ticks; }}
                tick = 0;
            }}
        }}
    }}
}}
int main(void)
{{
    static rw_notification news[2 * RW_EVENTS];
    char text[RW_TEXT];
    volatile unsigned char *const top = (volatile unsigned char *)__builtin_frame_address(0) - 512;
    unsigned long deep = DEEP;
    rw_diagnoser_init(&d, &rw_vehicle_default, &rw_plan_default);
    rw_diagnoser_defer(&d);
    rw_texts_init(&reported);
    for (int k = 1; k <= DEEP; ++k) top[-k] = 0xA5;
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5;
    for (int k = 0; k < {seconds} * HZ; ++k) {{
        const rw_time t = k / (rw_time)HZ;
        sample(t);
        work(t);
        if (k % 10 == 0) {{
            COUNTED(polls, rw_diagnoser_poll(&d, news));
            COUNTED(texts, said += rw_diagnoser_text(&d, &reported, t, RW_NOTICE, text) > 0);
        }}
    }}
    if (!said) return 1; /* nothing of all that was found */
    while (deep > 0 && top[-(long)deep] == 0xA5) --deep;
    printf("%lu %lu %lu %lu %lu %lu %lu %lu %lu\\n", (unsigned long)sizeof d, deep + 512, ticks ? steady / ticks : 0, whole,
           pieces, landing, feeds, polls, texts);
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
    result = subprocess.run(board, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=1800, check=True)
    return [int(word) for word in result.stdout.split()]


def code_bytes(folder: Path, chip: tuple[str, ...], names: list[str]) -> tuple[int, int]:
    """Code and tables of sources of the folder; the largest frame of one of their functions on the stack."""
    for name in names:
        command = ["arm-none-eabi-gcc", *chip, "-fstack-usage", "-c", name, "-o", f"{Path(name).stem}.o"]
        subprocess.run(command, check=True, cwd=folder)
    size = subprocess.run(
        ["arm-none-eabi-size", *(f"{Path(name).stem}.o" for name in names)], capture_output=True, text=True, check=True, cwd=folder
    )
    frames = [line.split("\t") for path in folder.glob("*.su") for line in path.read_text().splitlines()]
    assert all(kind == "static" for _, _, kind in frames)
    return sum(int(line.split()[0]) for line in size.stdout.splitlines()[1:]), max(int(bytes) for _, bytes, _ in frames)


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
            text = code_bytes(folder, CHIP, [f"{name}.c"])[0]
            print(f"| {name} | {count / 1e3:.0f} | {text / 1e3:.1f} | {made.workspace_bytes / 2e3:.1f} |")


def diagnoser() -> None:
    """A row for each vehicle and precision."""
    print(
        "| vehicle | flash, kB | memory, kB | stack, bytes | largest frame | million instructions an assessed tick | at most | thousand",
        end=" ",
    )
    print("of the longest piece | after the landing | of a feed | of a poll and a text |")
    print("|---" * 11 + "|")
    for vehicle in ("quad", "hexa", "octa"):
        for precision, chip in (("single", CHIP), ("double", tuple(f for f in CHIP if "FLOAT" not in f))):
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch)
                written = export_diagnoser(folder, vehicle=f"ardupilot-{vehicle}-x", rate_hz=100.0)
                (folder / "example.c").write_text(DIAGNOSER.format(seconds=SECONDS))
                size, stack, *counts = on_the_chip(folder, chip)
                names = [p.name for p in written if p.suffix == ".c" and p.name != "example.c"]
                text, frame = code_bytes(folder, chip, names)
                tick, whole, piece, landing, feed, poll, said = (n * TICK for n in counts)
                millions = [f"{n / 1e6:.2f}" for n in (tick, whole)]
                thousands = [f"{n / 1e3:.0f}" for n in (max(piece, landing), landing)] + [f"{feed / 1e3:.1f}", f"{(poll + said) / 1e3:.0f}"]
                row = [f"{text / 1e3:.0f}", f"{size / 1e3:.0f}", str(stack), str(frame), *millions, *thousands]
                print(f"| {vehicle}, {precision} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    diagnoser() if "--diagnoser" in sys.argv[1:] else filters()
