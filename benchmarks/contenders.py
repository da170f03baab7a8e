"""What benchmarks/run.py compares: one plant and its flights, rotorwatch's estimators on it, and the same methods in C++ (floor/)."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import discovery
from rotorwatch.base.backend import jax as load_jax
from rotorwatch_lab.compiling import native
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimators import mhe
from rotorwatch_lab.systems.rigid_body import RigidBody

DT = 0.01
METHODS = ("ukf", "ekf", "tsukf", "mhe")
LOSS, MORE, ROTOR = (0.2, 0.15, 1)  # of all rotors; of one in addition, after a third of the flight: off the bounds of the MHE
FLOOR = Path(__file__).resolve().parent / "floor"
COMPILER_FLAGS = ("-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-fPIC", "-shared", "-w")


@functools.cache
def plant() -> RigidBody:
    """12 states, 4 losses, 6 measurements: the quadrotor of Zhang et al. 2023."""
    return RigidBody.of(airframes.paper("uaf-02e"))


@functools.cache
def estimator(name: str):
    """The registered method with its defaults."""
    return discovery.estimator(name)(plant(), DT)


def outputs(out):
    """What every contender keeps of a step: states, losses, variances of the losses."""
    return out.x, out.theta, load_jax().numpy.diagonal(out.theta_cov)


def flight(rows: int, seed: int = 0, gaps: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, y, valid) of a controlled flight along slow curves. gaps: 2 % of the measurements are missing, and 1 % of the rows."""
    jax = load_jax()
    jnp, p, rng = jax.numpy, plant(), np.random.default_rng(seed)
    noise = rng.standard_normal((rows, p.n_y))
    mixer = np.linalg.pinv(np.vstack([p.B_tau, p.B_T]))
    theta = np.full((rows, p.n_theta), LOSS)
    theta[rows // 3 :, ROTOR] += MORE

    def fly(x, row):
        k, theta, noise = row
        goal = jnp.array([jnp.sin(0.003 * k), jnp.cos(0.002 * k), jnp.sin(0.001 * k) - 2.0])
        pull = jnp.clip(goal - x[:3] - 1.5 * x[6:9], -2.0, 2.0)
        tilt = jnp.array([pull[1], -pull[0], 0.0]) / p.gravity
        torque = p.J @ (40.0 * (tilt - x[3:6]) - 12.0 * x[9:])
        u = jnp.clip(mixer @ jnp.append(torque, p.m * (p.gravity - pull[2])) / (1.0 - LOSS), 0.05, 0.95)
        x = p.f(x, u, theta, DT)
        return x, (u, p.h(x, u, theta) + p.measured_sd * noise)

    table = (np.arange(rows), theta, noise)
    u, y = jax.jit(lambda table: jax.lax.scan(fly, np.zeros(12), table)[1])(table)
    valid = np.ones((rows, p.n_y), bool)
    if gaps:
        valid = rng.random(valid.shape) > 0.02
        valid[rng.random(rows) < 0.01] = False
    return np.array(u), np.array(y), valid


def jax_program(name: str):
    """A method as one JAX program over (B, T, ...) tables: all flights at once, (B, T, 20) outputs."""
    jax, method = load_jax(), estimator(name)

    def one(*table):
        def step(carry, row):
            carry, out = method.step(carry, *row)
            return carry, outputs(out)

        return jax.numpy.concatenate(jax.lax.scan(step, method.init(), table)[1], axis=1)

    return jax.jit(jax.vmap(one))


class Rotorwatch:
    """One of rotorwatch's estimators, `run` over a table with a backend."""

    def __init__(self, name: str, backend: str):
        self.method, self.backend = estimator(name), backend

    def __call__(self, u, y, valid) -> tuple[np.ndarray, ...]:
        """(T, 12), (T, 4), (T, 4): the outputs that are compared."""
        return run(self.method, u, y, valid, outputs, backend=self.backend)[1]


class NativeBatch:
    """The same as a library that threads may share: each call with a state of its own; ctypes lets other threads run."""

    def __init__(self, name: str):
        method = estimator(name)
        self.library = native.traced(method, (), outputs)
        self.start = native.flattened(method.init())

    def __call__(self, u, y, valid) -> np.ndarray:
        library = self.library
        state = library.pack(library.layout.state, library.state_type, self.start)
        return np.hstack(library.run(state, np.zeros(0), u, y, valid))


class Floor:
    """The C++ of folder floor/, run over a table."""

    def __init__(self, library: ctypes.CDLL, name: str):
        self._init, self._run = getattr(library, f"{name}_init"), getattr(library, f"{name}_run")
        self._size = getattr(library, f"{name}_bytes")()

    def __call__(self, u, y, valid) -> np.ndarray:
        """(T, 20) the outputs that are compared."""
        state = np.zeros(self._size // 8 + 16)
        start = ctypes.c_void_p(state.ctypes.data + -state.ctypes.data % 64)  # Eigen wants it aligned
        out = np.empty((len(u), 20))
        self._init(start)
        arrays = (np.ascontiguousarray(u), np.ascontiguousarray(y), np.ascontiguousarray(valid).view(np.uint8), out)
        self._run(ctypes.c_int32(len(u)), start, *(ctypes.c_void_p(a.ctypes.data) for a in arrays))
        return out


def eigen() -> Path:
    """Where Eigen's headers are: $EIGEN3_INCLUDE_DIR, the system, or the wheel cmeel-eigen. Exits with what to install."""
    places = [os.environ.get("EIGEN3_INCLUDE_DIR", ""), "/usr/include/eigen3", "/usr/local/include/eigen3"]
    wheel = importlib.util.find_spec("cmeel")
    if wheel is not None and wheel.origin:
        places.append(str(Path(wheel.origin).parents[1] / "cmeel.prefix" / "include" / "eigen3"))
    for place in places:
        if place and (Path(place) / "Eigen" / "Dense").exists():
            return Path(place)
    raise SystemExit("Eigen's headers are missing: install the extra `benchmark` or libeigen3-dev, or set EIGEN3_INCLUDE_DIR.")


def build_floor(folder: Path) -> ctypes.CDLL:
    """The C++ compiled into `folder`, for the plant's numbers. Exits where there is no compiler."""
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        raise SystemExit("A C++ compiler is missing: install g++ or clang++, or set CXX.")
    (folder / "numbers.hpp").write_text(_numbers(), encoding="utf-8")
    goal = folder / "floor.so"
    command = [compiler, *COMPILER_FLAGS, f"-I{folder}", f"-isystem{eigen()}", "-o", str(goal), str(FLOOR / "floor.cpp")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{compiler} cannot build benchmarks/floor:\n{done.stderr[:2000]}")
    return ctypes.CDLL(str(goal))


def _numbers() -> str:
    """numbers.hpp: what the plant and the methods are built from, matrices column by column as Eigen has them."""
    p, horizon, walk = plant(), estimator("mhe"), estimator("ukf")
    arrays = {
        "J": p.J, "J_INVERSE": p.J_inverse, "B_TAU": p.B_tau, "B_T": p.B_T, "WALK": p.walk, "R": p.R(None),
        "MHE_LEAST": horizon.least,
    }  # fmt: skip
    scalars = {
        "MASS": p.m, "GRAVITY": p.gravity, "DT": DT, "THETA_WALK": walk.theta_walk[0, 0], "THETA_VAR": walk.theta_var[0, 0],
        "MHE_THETA_SD": horizon.theta_sd, "MHE_WALK": horizon.walk, "MHE_LOW": horizon.low[-1], "MHE_HIGH": horizon.high[-1],
        "MHE_FLOOR": mhe.FLOOR, "MHE_REST": mhe.REST,
    }  # fmt: skip
    counts = {
        "MHE_INTERVALS": horizon.intervals, "MHE_SAMPLES": horizon.m, "MHE_ITERATIONS": horizon.iterations,
        "MHE_PASSES": horizon.passes,
    }  # fmt: skip
    lines = ["#pragma once", "namespace numbers {"]
    for name, value in arrays.items():
        flat = np.asarray(value, float).ravel(order="F")
        lines.append(f"inline constexpr double {name}[{flat.size}] = {{{', '.join(repr(float(v)) for v in flat)}}};")
    lines += [f"inline constexpr double {name} = {float(value)!r};" for name, value in scalars.items()]
    lines += [f"inline constexpr int {name} = {int(value)};" for name, value in counts.items()]
    return "\n".join([*lines, "}", ""])
