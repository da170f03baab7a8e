"""How much faster is a GPU than two cores of the processor, with a batch of flights through the published methods?

    python benchmarks/gpu.py [--methods ukf,ekf,tsukf,mhe] [--flights 4096] [--rounds 5]

On the GPU all flights go through JAX's program of the method at once; on the processor through native code, flight by flight in two
threads, which is the fastest that there is. Both give the same to 1e-9 before anything is timed; compiling is not counted. Microseconds of
one step of one flight: the median of the rounds, both in turn. Without a GPU it says so.
"""

from __future__ import annotations

import argparse
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from contenders import METHODS, NativeBatch, flight, jax_program
from run import BATCH_STEPS, same

from rotorwatch.base.backend import jax as load_jax

THREADS = 2


def gpus() -> list:
    """JAX's GPUs; none where it has no driver for any."""
    try:
        return load_jax().devices("gpu")
    except RuntimeError:
        return []


def on(device, method: str):
    """A function of (B, T, ...) tables: all flights at once on the device; tables that lie there stay there."""
    jax, program = load_jax(), jax_program(method)

    def call(*tables) -> np.ndarray:
        with jax.default_device(device):
            return np.asarray(program(*(jax.device_put(a, device) for a in tables)))

    return call


def on_cores(method: str):
    """The same by native code in threads."""
    run = NativeBatch(method)

    def call(*tables) -> np.ndarray:
        with ThreadPoolExecutor(THREADS) as pool:
            return np.stack(list(pool.map(lambda rows: run(*rows), zip(*tables, strict=True))))

    return call


def timed(work) -> float:
    """Seconds by the clock."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", type=lambda text: text.split(","), default=METHODS)
    parser.add_argument("--flights", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    found = gpus()
    if not found:
        print('JAX finds no GPU on this computer; where there is one, install its driver for JAX: pip install "jax[cuda12]".')
        return
    print(f"{found[0].device_kind}; {options.flights} flights of {BATCH_STEPS} steps\n")
    print("| method | two cores us | GPU us | times faster |\n|---|---|---|---|")
    for method in options.methods:
        count = options.flights
        tables = tuple(np.ascontiguousarray(a.reshape(count, BATCH_STEPS, -1)) for a in flight(count * BATCH_STEPS))
        gpu, cores = on(found[0], method), on_cores(method)
        same(method, cores(*tables).reshape(-1, 20), gpu(*tables).reshape(-1, 20), "the GPU")
        rounds = [(timed(partial(cores, *tables)), timed(partial(gpu, *tables))) for _ in range(options.rounds)]
        ours, theirs = (1e6 * statistics.median(s) / (count * BATCH_STEPS) for s in zip(*rounds, strict=True))
        print(f"| {method} | {ours:.2f} | {theirs:.3f} | {statistics.median(a / b for a, b in rounds):.1f} |", flush=True)


if __name__ == "__main__":
    main()
