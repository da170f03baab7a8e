"""Definitions as their Python lines run them: structs made from arrays, and read as arrays."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from rotorwatch.base.compiling import running, structs
from rotorwatch.engine.bindings import program
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.estimator.hypotheses import NOTHING
from rotorwatch.engine.estimator.plant import THETA, Inputs, Plant, Rows, rows, set_plant

S = TypeVar("S", bound=structs.Struct)


def made(kind: type[S], **fields: Any) -> S:
    """A struct; arrays fill as much of a field as they have."""
    one = kind()
    running.Rows(kind, None, [one]).set(**fields)
    return one


def filled(one: S, **fields: Any) -> S:
    """The same struct with other values."""
    running.Rows(type(one), None, [one]).set(**fields)
    return one


def copied(one: S) -> S:
    """A struct of its own."""
    other = type(one)()
    structs.copy(other, one)
    return other


def array(one: Any, *shape: int) -> np.ndarray:
    """A field as an array, or as much of it."""
    return np.array(one)[tuple(slice(0, s) for s in shape)]


def lower(C: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., n, n) as the definitions keep them: row by row, each up to its diagonal."""
    return C[(..., *np.tril_indices(C.shape[-1]))]


def plant(B: np.ndarray, dt: float = 0.05, **known: Any) -> Plant:
    """A vehicle's plant with ticks of dt seconds. known: fields beside `program.parameters`."""
    names = ("rotors", "dt", "effect", "lower", "mean", "variance", "noise", "noise_weight")
    usual = program.steps(dt, B).plant
    found = made(Plant, **({name: usual[name][0] for name in names} | known))
    set_plant(found)
    return found


def room(*shape: int) -> list:
    """Zeros for a function to write."""
    return structs.local(structs.REAL, *shape)


def logs(nats: Any, weight: Any) -> np.ndarray:
    """Log Bayes factors: of weight e^nats, as the definitions keep them; NOTHING where there is no weight."""
    weight = np.asarray(weight)
    return np.where(weight > 0.0, np.asarray(nats) + np.log(np.where(weight > 0.0, weight, 1.0)), NOTHING)


def tick(u: np.ndarray, n: int) -> Inputs:
    """A row (n + 13,) of inputs, as `engine.bindings.plant.packed` lays them out."""
    return made(
        Inputs, thrust=u[:n], turn=u[n : n + 3], load=u[n + 3], rate=u[n + 4 : n + 7], forward=u[n + 7], right=u[n + 8],
        full=u[n + 9], expo=u[n + 10], expo_sd=u[n + 11], axial=np.nan_to_num(u[n + 12]), valid=np.ones(4, bool),
    )  # fmt: skip


def measured(p: Plant, u: np.ndarray, s: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """h (4, states) and drag (n,) of a tick whose inputs are a row u (n + 13,); s: state, zeros where there is none."""
    now, out, states = tick(u, p.rotors), Rows(), THETA + p.rotors
    s = np.zeros(states) if s is None else s
    rows(p, now, now.thrust, now.forward, now.right, s.tolist(), out)
    return array(out.h, 4, states), array(out.drag, p.rotors)


def unpacked(kind: type[S], record: Any, lane: int = 0) -> S:
    """A struct of what machine code has written; lane: of what stands side by side there, and alone here."""
    one = kind()
    for name, field in kind.declared():
        inner = field.kind if isinstance(field, structs.Array) else field
        value = record[name]
        if (inner if isinstance(inner, str) else structs.SCALARS.get(kind.__annotations__.get(name))) == structs.EACH:
            setattr(one, name, value[..., lane].tolist())
        elif isinstance(field, structs.Array) and not isinstance(inner, str):
            lanes = range(ENGINE.lanes if isinstance(field.shape[0], structs.Packed) else 1)
            setattr(one, name, [unpacked(inner, each, lane) for each in value for lane in lanes])
        else:
            setattr(one, name, unpacked(field, value) if isinstance(field, type) else value.tolist())
    return one
