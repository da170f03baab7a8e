"""Any estimator as a C99 project for a flight controller: header, source, example and CMakeLists, from a published method's traced step or
the default estimator's definition (export_default.py).

rw.export_c("ukf", "out")                                  on the airframe of the method's paper
rw.export_c("ekf", "out", vehicle=vehicle_file.read("mine.toml"))   # of rotorwatch.flight
rw.export_c(MyEstimator(my_system, 0.01), "out", name="mine")
rw.export_c.export_allocator("out", vehicle="ardupilot-hexa-x", by="bounds")
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import airframes
from rotorwatch.base import discovery
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.toolkit import DAMPING, GAIN, PER_AXIS, Exported, any_multirotor, export_default, saved
from rotorwatch.toolkit import program as default_program
from rotorwatch_lab.compiling.c99.project import Field, Program, emit_program
from rotorwatch_lab.control import allocation
from rotorwatch_lab.published import log_plant

# Plant, airframe and step (s) of each method's paper; other methods use the first.
USUAL = ("rate_dynamics", "niermeyer-hexa", 0.01)
PAPERS = {
    "ukf": ("rigid_body", "uaf-02e", 0.01), "aukf": ("rigid_body", "uaf-02e", 0.01),
    "tsukf": ("rigid_body", "uaf-02e", 0.01), "atsukf": ("rigid_body", "uaf-02e", 0.01),
    "akf": ("port_hamiltonian_attitude", "rot-hexa", 0.001), "axkf": ("port_hamiltonian_attitude", "rot-hexa", 0.001),
    "intermediate": ("linear_hover", "f450", 0.01), "esmf": ("helicopter", "ruav-40kg", 0.02),
    "aesmf": ("helicopter", "ruav-40kg", 0.02), "aekf": ("helicopter", "ruav-40kg", 0.02),
    "adaptive_ekf": ("helicopter", "ruav-40kg", 0.02),
}  # fmt: skip
STATUS = "0 ok, 1 not ready, 2 no valid measurement"


def export_c(
    estimator: Any,
    out: str | Path,
    *,
    vehicle: Vehicle | str | None = None,
    dt: float | None = None,
    variable_dt: bool = False,
    name: str | None = None,
) -> Exported:
    """Write a C99 project of an estimator into a folder.

    estimator: a name (`discovery.estimators`), or an estimator object. out: the folder, created where missing. vehicle: from `calibrate`,
    an airframe's or a paper's name; None: the method's own paper's. dt: s, length of a step. variable_dt: the step of a published method
    takes dt as an argument. name: of files and functions. Raises ConfigError for unknown names, and c99.lower.Refused, with the line it
    comes from, for code that cannot be C."""
    called = name or (estimator if isinstance(estimator, str) else getattr(estimator, "name", "estimator"))
    identifier = re.sub(r"\W", "_", called)
    if not re.match(r"[A-Za-z]", identifier):
        raise ConfigError(f"{called!r} cannot be the name of a C function: begin it with a letter.")
    if estimator == "default":
        return export_default.export_default(out, vehicle=vehicle, dt=dt, variable_dt=variable_dt, name=identifier)
    method = prepare(estimator, vehicle, dt) if isinstance(estimator, str) else estimator
    program = program_of(method, identifier, variable_dt)
    return _written(program, Path(out), _example(program, method))


def _written(program: Program, folder: Path, example: str) -> Exported:
    texts = {f"{program.name}.h": program.header, f"{program.name}.c": program.source, "example.c": example}
    files = saved(folder, program.name, texts)
    bytes_ = sum(f.size * {"f": 8, "i": 4, "l": 8, "b": 1}[f.kind] for f in program.state)
    return Exported(program.name, folder, files, bytes_, program.workspace_bytes, program.digest)


def export_allocator(
    out: str | Path,
    *,
    vehicle: Vehicle | str = export_default.FRAME,
    by: str = "estimate",
    method: str = "bounded",
    candidates: int = 3,
    allocator: allocation.Allocator | None = None,
    name: str = "allocator",
) -> Exported:
    """Write a C99 project of the control allocation of a vehicle (`control.allocation.Allocator`) into the folder `out`.

    vehicle: a `Vehicle` or an airframe's name; thrusts and moments are then in its own units, largest lever and mean full thrust 1.
    allocator: your own one, in newtons. by, method: its input and its algorithm. candidates: rows of the belief's table of candidates, for
    by="posterior". Raises ConfigError."""
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise ConfigError(f"{name!r} cannot be the name of a C function: begin it with a letter.")
    if candidates < 1:
        raise ConfigError(f"candidates must be at least 1, not {candidates}.")
    if allocator is None:
        craft = airframes.named(vehicle) if isinstance(vehicle, str) else vehicle
        allocator = allocation.Allocator(allocation.rows(craft), by=by, method=method)
    program = allocator_program(allocator, name, candidates)
    return _written(program, Path(out), _allocator_example(program, allocator))


def allocator_program(allocator: allocation.Allocator, identifier: str, candidates: int = 3) -> Program:
    """The C of an allocator. Its step takes only the inputs in use: candidates and weights, or mean, lower and upper."""
    n, between = allocator.n, allocator.by == "posterior"
    share = "effectiveness: 1 healthy, 0 dead"
    inputs = [
        Field("demand", "f", (4,), "thrust (up), roll, pitch, yaw moment"),
        Field("mean", "f", (n,), share),
        Field("lower", "f", (n,), f"least {share}"),
        Field("upper", "f", (n,), f"largest {share}"),
        Field("candidates", "f", (candidates, n), f"a row for each set of weak rotors; {share}"),
        Field("weights", "f", (candidates,), "how likely each candidate is; they need not add up to 1"),
    ]
    inputs = inputs if between else inputs[:4]
    notes = {
        "u": "commands, shares of full thrust", "wrench": "what they should give", "error": "demand minus wrench",
        "worst": "largest |error| within the bounds", "granted": "1 where the error is nothing, else 0",
        "status": "0 ok, 1 demand or belief were no numbers: the last commands stay",
    }  # fmt: skip

    def step(_, carry, demand, mean, lower, upper, sets=None, weights=None):
        jnp = load_jax().numpy
        if not between:
            sets, weights = mean[None], jnp.ones(1)
        return allocator.step(carry, demand, allocation.Belief(mean, lower, upper, sets, weights))

    about = f"Control allocation for {n} rotors, {allocator.method}, driven by {allocator.by}."
    return emit_program(identifier, step, lambda _: allocator.init(), tuple(inputs), (), notes, about)


def _allocator_example(program: Program, allocator: allocation.Allocator) -> str:
    """A main that demands half the thrust of a vehicle whose first rotor is dead, and prints the commands."""
    n, name = allocator.n, program.name
    e = np.where(np.arange(n) == 0, 0.0, 1.0)
    values = {"demand": [allocator.size[0], 0, 0, 0], "mean": e, "lower": e, "upper": e}
    values |= {f.name: np.tile(e, f.shape[0]) for f in program.inputs if f.name == "candidates"}
    values |= {f.name: np.ones(f.size) for f in program.inputs if f.name == "weights"}
    rows = []
    for f in program.inputs:
        numbers = ", ".join(f"(rw_real){float(v)!r}" for v in np.ravel(values[f.name]))
        rows.append(f"    static const {f.declared} = {{{numbers}}};")
    return f"""/* Half of full thrust with a dead rotor. */
#include "{name}.h"

#include <stdio.h>

int main(void)
{{
{chr(10).join(rows)}
    static {name}_state state;
    static {name}_workspace work;
    static {name}_out out;

    {name}_init(&state, &work);
    {name}_step(&state, {", ".join(f.name for f in program.inputs)}, &out, &work);
    printf("status %d, commands", (int)out.status);
    for (int k = 0; k < {n}; ++k)
        printf(" %.6f", (double)out.u[k]);
    printf("\\n");
    return 0;
}}
"""


def prepare(name: str, vehicle: Vehicle | str | None = None, dt: float | None = None) -> Any:
    """The published method of that name on the plant of a vehicle: see `export_c`."""
    if name == "default-filter":
        raise ConfigError("default-filter is gone: give ekf with --vehicle, the filter alone, or default, which is all of it.")
    if name not in (known := discovery.estimators()):
        raise ConfigError(f"There is no estimator called {name!r}{meant(name, known)}; known are {', '.join(known)}.")
    if isinstance(vehicle, str):
        vehicle = vehicle if vehicle in airframes.papers() else airframes.named(vehicle)
    if isinstance(vehicle, Vehicle):
        p, usual = _learned(vehicle), export_default.LOG_DT
        c, any_vehicle = (np.reshape(x, (4, PER_AXIS)) for x in (p["x0"], any_multirotor(p["B"].shape[1])[0]))
        G = np.clip(c[:, GAIN], any_vehicle[:, GAIN] / 3, any_vehicle[:, GAIN] * 3)
        damping = np.maximum(c[:, DAMPING], 0.0) * [1.0, 1.0, 1.0, 0.0]
        step = dt or usual
        plant = log_plant.plant(log_plant.parameters(p["B"], G, damping, np.zeros(4), np.asarray(p["noise"]), step))
        return discovery.estimator(name)(plant, step)
    kind, paper, usual = PAPERS.get(name, USUAL)
    if vehicle is not None and vehicle != paper:
        kind, paper = USUAL[0], vehicle
    system, file = discovery.system(kind), airframes.paper(paper)
    try:
        plant = system.of(file) if hasattr(system, "of") else system(file)
    except KeyError as missing:
        raise ConfigError(f"The airframe {paper} does not say {missing}: the plant {kind} needs it.") from None
    return discovery.estimator(name)(plant, dt or usual)


def _learned(vehicle: Vehicle) -> dict:
    """Geometry, and the dynamics learned from healthy flights, or default ones."""
    return default_program.parameters(vehicle.effectiveness(), export_default.LOG_DT, (vehicle.identified or {}).get("dynamics"))


def program_of(method: Any, identifier: str, variable_dt: bool = False) -> Program:
    """The C of an estimator object, its fields described by the plant's names and units."""
    system = method.system
    n_u = system.n_u
    inputs = [
        Field("u", "f", (n_u,), _named(system, "u", n_u)),
        Field("y", "f", (system.n_y,), _named(system, "y", system.n_y)),
        Field("valid", "b", (system.n_y,), "which of y was measured; the others may hold anything"),
    ]
    inputs += [Field("dt", "f", (), "s since the step before")] * variable_dt
    x, theta = _named(system, "x", system.n_x), _named(system, "theta", system.n_theta)
    notes = {
        "x": x, "theta": f"{theta}; losses: 0 healthy, 1 dead", "status": STATUS, "innovation": "y minus its prediction",
        "s": "x, then theta",
    }  # fmt: skip
    notes |= {f"estimate_{k}": v for k, v in notes.items()}

    def step(_, carry, u, y, valid, dt=None):
        return method.step(carry, u, y, valid) if dt is None else method.step(carry, u, y, valid, dt)

    about = f"{method.name} on the plant {getattr(system, 'name', type(system).__name__)}, a step of {method.dt:g} s"
    about += ", or as long as dt says." if variable_dt else "."
    return emit_program(identifier, step, lambda _: method.init(), tuple(inputs), (), notes, about)


def _named(system, letter: str, count: int) -> str:
    """`p, q, r [rad/s]`: names and units of a variable, as far as the plant has them."""
    names = list(getattr(system, f"{letter}_names", ()))
    units = list(getattr(system, f"{letter}_units", ("",) * len(names)))
    parts: list[str] = []
    for k, (n, unit) in enumerate(zip(names, units)):
        last = k + 1 == len(names) or units[k + 1] != unit
        parts.append(f"{n} [{unit}]" if last and unit else n)
    return ", ".join(parts)


def _example(program: Program, method: Any) -> str:
    """A main that steps on constant measurements, those of a healthy vehicle, and prints the losses."""
    jax = load_jax()
    system, n_u, name = method.system, method.system.n_u, program.name
    u = np.full(n_u, 0.5)
    y = np.asarray(jax.jit(system.h)(np.asarray(system.x0, float), u, np.zeros(system.n_theta)))
    shown = next(f for f in program.out if f.name in ("theta", "estimate_theta"))
    status = next(f for f in program.out if f.name in ("status", "estimate_status"))
    has_dt = any(f.name == "dt" for f in program.inputs)
    values = {"u": u, "y": y, "valid": np.ones(system.n_y, bool)}
    rows = []
    for f in program.inputs:
        if f.shape:
            numbers = ", ".join(("true" if v else "false") if f.kind == "b" else f"(rw_real){float(v)!r}" for v in values[f.name])
            rows.append(f"    static const {f.declared} = {{{numbers}}};")
    call = ["&state", "u", "y", "valid", *([f"(rw_real){method.dt!r}"] if has_dt else []), "&out", "&work"]
    return f"""/* A thousand steps of {name} on measurements that do not change. */
#include "{name}.h"

#include <stdio.h>

int main(void)
{{
{chr(10).join(rows)}
    static {name}_state state;
    static {name}_workspace work;
    static {name}_out out;

    {name}_init(&state, &work);
    for (int k = 0; k < 1000; ++k)
        {name}_step({", ".join(call)});
    printf("status %d, losses", (int)out.{status.name});
    for (int k = 0; k < {shown.size}; ++k)
        printf(" %.6f", (double)out.{shown.name}[k]);
    printf("\\n");
    return 0;
}}
"""
