"""How exact is the allocation, and how long does a step of it take as native code and on a Cortex-M7?

Exact: random demands on all frames with random losses, against SciPy's solver of bounded least squares.

python benchmarks/allocation.py exact                 100,000 demands on every frame against SciPy, three ways of belief
python benchmarks/allocation.py exact --demands 1000
python benchmarks/allocation.py time                  native code of this computer, one step after the other
python benchmarks/allocation.py instructions          emulated Cortex-M7; needs arm-none-eabi-gcc and qemu-system-arm
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.compiling import native
from rotorwatch_lab.control import allocation
from rotorwatch_lab.control.allocation import DRIVEN_BY, Allocator, Belief
from rotorwatch_lab.export_c import allocator_program

FRAMES = ("ardupilot-quad-x", "ardupilot-hexa-x", "ardupilot-octa-x", "ardupilot-dodecahexa-x")
WAYS = (*(("bounded", by) for by in DRIVEN_BY), ("pseudo-inverse", "estimate"))
ROWS, REPEATS = 2000, 7
CORE = Path(__file__).resolve().parents[1] / "embedded" / "cortex-m7"
CHIP = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-std=c99", "-O2")
STEPS, TICK = 64, 40  # demands; instructions a tick of the emulated clock
MAIN = """
#include "allocator.h"
#include <stdio.h>
#define SYSTICK ((volatile uint32_t *)0xE000E010u)
static allocator_state state;
static allocator_workspace work;
static allocator_out out;
{tables}
int main(void)
{{
    allocator_init(&state, &work);
    SYSTICK[1] = 0xFFFFFF;
    for (int k = 0; k < {steps}; ++k) {{
        SYSTICK[2] = 0;
        SYSTICK[0] = 5;
        for (int again = 0; again < {again}; ++again)
            allocator_step(&state, {arguments}, &out, &work);
        printf("%lu\\n", (unsigned long)(0xFFFFFFu - SYSTICK[2]));
    }}
    return 0;
}}
"""


MOST = 12  # rotors
SETS = 3  # candidates of an ambiguous belief


class Problems(NamedTuple):
    """Demands (N, 4) on a vehicle B (4, n) and what is believed of its rotors: `Belief` with a leading N."""

    B: np.ndarray
    demand: np.ndarray
    belief: Belief


class Row(NamedTuple):
    """A frame's worst difference of a command from the oracle's; bounded: share of commands at 0 or 1; turns: the most; None for
    "posterior"."""

    frame: str
    rotors: int
    by: str
    demands: int
    worst: float
    bounded: float
    turns: int | None


def frames() -> list[str]:
    """Every airframe of up to MOST rotors, but those of the same geometry."""
    found: dict[bytes, str] = {}
    for name in airframes.names():
        B = allocation.rows(airframes.named(name))
        if B.shape[1] <= MOST:
            found.setdefault(np.round(B, 6).tobytes(), name)
    return sorted(found.values())


def problems(frame: str, count: int, seed: int = 0) -> Problems:
    """Random demands, a third of them small, a third large, a third beyond what the vehicle can do, a fifth exactly at a corner of it;
    a quarter of the rotors weak, one in sixteen dead; bounds about the mean; candidates with other rotors weak."""
    B = allocation.rows(airframes.named(frame))
    n = B.shape[1]
    rng = np.random.default_rng([seed, n, sum(frame.encode())])

    def losses(*shape):
        e = np.where(rng.random(shape) < 0.25, rng.random(shape), 1.0)
        return np.where(rng.random(shape) < 1.0 / 16.0, 0.0, e)

    mean = losses(count, n)
    half = np.abs(B).sum(axis=1) / 2.0
    demand = rng.random((count, n)) @ B.T * rng.choice([0.5, 1.0, 2.0], (count, 1))
    demand += half * rng.standard_normal((count, 4)) * rng.choice([0.0, 0.2, 1.0], (count, 1))
    corner = rng.random(count) < 0.2
    demand = np.where(corner[:, None], (mean * (rng.random((count, n)) < 0.5)) @ B.T, demand)
    lower = np.maximum(mean - rng.choice([0.0, 0.1, 1.0], (count, 1)) * rng.random((count, n)), 0.0)
    upper = np.minimum(mean + rng.choice([0.0, 0.1, 1.0], (count, 1)) * rng.random((count, n)), 1.0)
    return Problems(B, demand, Belief(mean, lower, upper, losses(count, SETS, n), rng.random((count, SETS))))


def oracle(allocator: Allocator, demand: np.ndarray, belief: Belief) -> np.ndarray:
    """u (n,) of one problem, by SciPy from the definition: rows stacked, bounded-variable least squares of Stark and Parker."""
    from scipy.optimize import lsq_linear

    half = np.abs(allocator.B).sum(axis=1) / 2.0
    W = np.diag(allocator.weights / np.where(half > 0.0, half, 1.0))
    C, b, n, root = W @ allocator.B, W @ demand, allocator.n, np.sqrt(allocator.eps)
    if allocator.by == "posterior":
        share = np.sqrt(belief.weights / belief.weights.sum())
        blocks = [(s * C * e, s * b) for s, e in zip(share, belief.candidates, strict=True)]
        mean = share**2 @ belief.candidates
    else:
        mean = belief.mean
        blocks = [(C * mean, b)]
    if allocator.by == "bounds":
        spread = np.sqrt((belief.upper - mean) * (mean - belief.lower))
        blocks.append((np.diag(spread * np.linalg.norm(C, axis=0)), np.zeros(n)))
    ridge = root * np.eye(n)
    free = np.linalg.lstsq(np.vstack([C * mean, ridge]), np.append(b, np.zeros(n)), rcond=None)[0]
    A = np.vstack([*(block for block, _ in blocks), ridge])
    y = np.concatenate([*(right for _, right in blocks), root * np.clip(free, 0.0, 1.0)])
    return lsq_linear(A, y, (0.0, 1.0), method="bvls", tol=1e-15, max_iter=300).x


def solver(allocator: Allocator):
    """Compiled: demands (N, 4) and beliefs -> (`Allocation` with a leading N, turns (N,))."""
    jax = load_jax()

    def one(demand, belief):
        return allocator.step_counting(allocator.init(), demand, belief)[1:]

    return jax.jit(jax.vmap(one))


def compare(frame: str, count: int, by: str = "estimate", seed: int = 0, run: Any = None) -> Row:
    """One frame's row. run: what `solver` made for this allocator, if there already is one."""
    posed = problems(frame, count, seed)
    allocator = Allocator(posed.B, by=by)
    out, turns = (run or solver(allocator))(posed.demand, posed.belief)
    u, turns = np.asarray(out.u), np.asarray(turns)
    worst = 0.0
    for k in range(count):
        belief = Belief(*(leaf[k] for leaf in posed.belief))
        worst = max(worst, float(np.abs(u[k] - oracle(allocator, posed.demand[k], belief)).max()))
    at = float(((u == 0.0) | (u == 1.0)).mean())
    return Row(frame, allocator.n, by, count, worst, at, None if by == "posterior" else int(turns.max()))


def study(demands: int, by: str = "estimate", progress: Any = None) -> list[Row]:
    """`demands` in all, spread over every frame."""
    names = frames()
    rows = []
    for k, name in enumerate(names):
        rows.append(compare(name, -(-demands // len(names)), by))
        if progress:
            progress((k + 1) / len(names), name)
    return rows


def arguments(program, problem: Problems, rows: int) -> list[np.ndarray]:
    """The step's inputs in its order, a row per demand."""
    known = {"demand": problem.demand, **problem.belief._asdict()}
    return [np.ascontiguousarray(known[f.name][:rows], float) for f in program.inputs]


def exact(demands: int) -> None:
    print("| rotors | driven by | demands | worst difference | commands at 0 or 1 | most turns of 24 |")
    print("|---|---|---|---|---|---|")
    for by in DRIVEN_BY:
        rows = study(demands, by)
        for n in sorted({row.rotors for row in rows}):
            some = [row for row in rows if row.rotors == n]
            turns = max((row.turns for row in some if row.turns is not None), default="-")
            share = np.mean([row.bounded for row in some])
            worst, count = max(row.worst for row in some), sum(row.demands for row in some)
            print(f"| {n} | {by} | {count:,} | {worst:.1e} | {share:.0%} | {turns} |", flush=True)


def timed() -> None:
    print("| frame | method | mean us | 99th percentile us | longest us |")
    print("|---|---|---|---|---|")
    for frame in FRAMES:
        problem = problems(frame, ROWS)
        for method, by in WAYS:
            program = allocator_program(Allocator(problem.B, by=by, method=method), "allocator", SETS)
            library = ctypes.CDLL(str(native.build(program.header, program.source, "allocator")))
            columns = arguments(program, problem, ROWS)
            state, out, work = np.zeros(64), np.zeros((ROWS, 64)), np.zeros(program.workspace_bytes // 8 + 8)

            def each(count, again, run=library.allocator_run, columns=columns, state=state, out=out, work=work):
                """us of a step for every demand by itself, the fastest of `again` runs of `count` equal steps."""
                best = np.full(ROWS, np.inf)
                for k in range(ROWS):
                    same = [np.repeat(column[k : k + 1], count, axis=0) for column in columns]
                    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (state, *same, out, work)]
                    for _ in range(again):
                        begin = time.perf_counter()
                        run(ctypes.c_int32(count), *pointers)
                        best[k] = min(best[k], (time.perf_counter() - begin) / count * 1e6)
                return best

            us = each(30, REPEATS)
            name = method if method == "pseudo-inverse" else f"bounded, {by}"
            print(f"| {frame} | {name} | {us.mean():.2f} | {np.quantile(us, 0.99):.2f} | {us.max():.2f} |", flush=True)


def instructions() -> None:
    """Of the hardest among 2,000 demands, those with most turns, and of usual ones."""
    print("| frame | method | precision | thousand instructions, mean | most | text kB | workspace kB |")
    print("|---|---|---|---|---|---|---|")
    for frame in FRAMES:
        problem = problems(frame, ROWS)
        for method, by in WAYS:
            allocator = Allocator(problem.B, by=by, method=method)
            program = allocator_program(allocator, "allocator", SETS)
            turns = np.asarray(solver(Allocator(problem.B, by="bounds" if by == "bounds" else "estimate"))(
                problem.demand, problem.belief)[1])  # fmt: skip
            chosen = np.r_[np.argsort(-turns, kind="stable")[: STEPS // 2], np.arange(STEPS // 2)]
            columns = [column[chosen] for column in arguments(program, problem, ROWS)]
            for single in (False, True):
                counts, text = _counted(program, columns, single)
                last = counts[STEPS // 2 :].mean()
                size = program.workspace_bytes / (2e3 if single else 1e3)
                name = method if method == "pseudo-inverse" else f"bounded, {by}"
                word = "single" if single else "double"
                print(
                    f"| {frame} | {name} | {word} | {last / 1e3:.1f} | {counts.max() / 1e3:.1f} | {text / 1e3:.1f} | {size:.1f} |",
                    flush=True,
                )


def _counted(program, columns, single: bool) -> tuple[np.ndarray, int]:
    """(instructions of a step for each row, bytes of code)."""
    again, rows = 10, len(columns[0])
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "allocator.h").write_text(program.header)
        (folder / "allocator.c").write_text(program.source)
        tables, names = [], []
        for field, column in zip(program.inputs, columns, strict=True):
            values = ", ".join(repr(float(v)) for v in column.ravel())
            tables.append(f"static const rw_real {field.name}[] = {{{values}}};")
            names.append(f"{field.name} + {field.size} * k")
        main = MAIN.format(tables="\n".join(tables), steps=rows, again=again, arguments=", ".join(names))
        (folder / "count.c").write_text(main)
        flags = [*CHIP, *(["-DROTORWATCH_FLOAT"] if single else [])]
        elf = str(folder / "m7.elf")
        sources = [str(folder / "allocator.c"), str(folder / "count.c"), str(CORE / "startup.c")]
        link = ["--specs=rdimon.specs", "-T", str(CORE / "an500.ld"), "-lm"]
        subprocess.run(["arm-none-eabi-gcc", *flags, *sources, *link, "-o", elf], check=True)
        subprocess.run(["arm-none-eabi-gcc", *flags, "-c", sources[0], "-o", str(folder / "one.o")], check=True)
        board = ["qemu-system-arm", "-M", "mps2-an500", "-nographic", "-semihosting", "-icount", "shift=0", "-kernel", elf]
        result = subprocess.run(board, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300, check=True)
        size = subprocess.run(["arm-none-eabi-size", str(folder / "one.o")], capture_output=True, text=True, check=True)
    return np.array(result.stdout.split(), float) * TICK / again, int(size.stdout.splitlines()[1].split()[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("exact", "time", "instructions"))
    parser.add_argument("--demands", type=int, default=100_000)
    options = parser.parse_args()
    {"exact": lambda: exact(options.demands), "time": timed, "instructions": instructions}[options.what]()


if __name__ == "__main__":
    main()
