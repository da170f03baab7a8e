"""CMake files for exported C, and an example program for the diagnoser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Exported:
    """What was written. state_bytes, workspace_bytes: in double precision; digest: of the definition, as in the header."""

    name: str
    folder: Path
    files: tuple[Path, ...]
    state_bytes: int
    workspace_bytes: int
    digest: str


def saved(folder: Path, name: str, texts: dict[str, str]) -> tuple[Path, ...]:
    """The files of a project, written."""
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in (texts := {**texts, "CMakeLists.txt": cmake(name)}).items():
        (folder / file).write_text(text, encoding="utf-8")
    return tuple(folder / file for file in texts)


def cmake(name: str, sources: Sequence[str] = ()) -> str:
    """CMakeLists.txt of a library of these sources, by default NAME.c, and of example.c."""
    return f"""cmake_minimum_required(VERSION 3.10)
project({name} C)

option(ROTORWATCH_FLOAT "single precision" OFF)

add_library({name} STATIC {" ".join(sources) or f"{name}.c"})
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
set_target_properties({name} PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF)
if(ROTORWATCH_FLOAT)
  target_compile_definitions({name} PUBLIC ROTORWATCH_FLOAT)
endif()
if(UNIX)
  target_link_libraries({name} PUBLIC m)
endif()

add_executable(example example.c)
target_link_libraries(example PRIVATE {name})
"""


def log_reader_cmake(sources: Sequence[str]) -> str:
    """CMakeLists.txt of the log reader: a library of these sources and the command rotorwatch-c."""
    return f"""cmake_minimum_required(VERSION 3.10)
project(rotorwatch_c C)

if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
add_library(rw_log STATIC {" ".join(sources)})
target_include_directories(rw_log PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
set_target_properties(rw_log PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF)
target_compile_options(rw_log PRIVATE -O3 -ffp-contract=off -fno-math-errno -fno-trapping-math)
target_link_libraries(rw_log PUBLIC m)

add_executable(rotorwatch-c rw_main.c)
target_link_libraries(rotorwatch-c PRIVATE rw_log)
"""


def diagnoser_example(output_hz: float, motion_hz: float) -> str:
    """example.c of the diagnoser: a minute of hover, in which one rotor is commanded more than the others from 30 s on."""
    return f"""/* A minute of hover made up on the spot: take-off, and from 30 s on rotor 1 needs more than the others for the same motion.
   Replace the numbers by your sensors and outputs. Prints what is announced. */
#include "rw_diagnoser.h"

#include <stdio.h>

static rw_diagnoser d; /* all its memory */

int main(void)
{{
    const rw_vehicle *v = &rw_vehicle_default;
    const rw_real still[3] = {{0, 0, 0}}, upright[4] = {{1, 0, 0, 0}};
    const rw_rotors all = (rw_rotors)((1u << RW_ROTORS) - 1u);
    rw_notification news[2 * RW_EVENTS];
    uint32_t noise = 1;
    rw_real output[RW_ROTORS];
    rw_time next = 0;

    rw_diagnoser_init(&d, v, &rw_plan_default);
    for (int k = 0; k < (int)(60 * {motion_hz:g}); ++k) {{
        const rw_time t = k / (rw_time){motion_hz:g};
        rw_real rate[3], force[3] = {{0, 0, (rw_real)-9.81}};
        for (int a = 0; a < 3; ++a) {{ /* what a sensor adds: numbers from -1 to 1, made by a rule */
            noise = noise * 1664525u + 1013904223u;
            rate[a] = still[a] + (rw_real)0.01 * ((rw_real)(noise >> 16) / 32768 - 1);
            force[a] += 20 * (rate[a] - still[a]);
        }}
        rw_diagnoser_gyro(&d, t, rate, true);
        rw_diagnoser_accel(&d, t, force, true);
        rw_diagnoser_attitude(&d, t, upright);
        if (t >= next) {{
            next += 1 / (rw_time){output_hz:g};
            for (int i = 0; i < RW_ROTORS; ++i) {{ /* at rest for 2 s, then in hover */
                const rw_real share = t < 2 ? (rw_real)0.05 : t >= 30 && i == 0 ? (rw_real)0.6 : (rw_real)0.5;
                output[i] = v->u_min + share * (v->u_max - v->u_min);
            }}
            rw_diagnoser_outputs(&d, t, output, all);
        }}
        const int n = rw_diagnoser_poll(&d, news);
        for (int i = 0; i < n; ++i) {{
            char text[RW_TEXT];
            rw_diagnoser_words(&news[i], text);
            printf("%6.2f s  %s\\n", (double)t, text);
        }}
    }}
    printf("verdict: %s\\n", rw_diagnoser_verdict_text(&d));
    return 0;
}}
"""
