"""Meaning of the columns of the evidence: the hypotheses of `engine.estimator.hypotheses` as a table, in words."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rotorwatch.engine.estimator.hypotheses import DISTURBANCE, DISTURBANCES, hypothesis_count, kind_of, other_rotor_of, rotor_of, weight_of

KINDS = ("single", "pair", "recovery", "stuck", "disturbance")
AXES = ("roll", "pitch", "yaw", "common mode")


class Hypotheses(NamedTuple):
    """All hypotheses of an n-rotor vehicle, a column each: names; kinds, of KINDS; rotors: 0-based sets; fault (n_h,): bool; weight
    (n_h,): prior weights. pairs (n_pairs, 2): rotors. blocks: of each disturbance, the last columns, the axes of its step."""

    n: int
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    rotors: tuple[tuple[int, ...], ...]
    weight: np.ndarray
    fault: np.ndarray
    pairs: np.ndarray
    blocks: tuple[tuple[int, ...], ...]


@functools.cache
def list_hypotheses(n: int) -> Hypotheses:
    """List single losses, pairs, recoveries, rotors with constant thrust, and disturbances."""
    every = range(hypothesis_count(n))
    numbers = [kind_of(n, h) for h in every]
    rotors = tuple(tuple(i for i in (rotor_of(n, h), other_rotor_of(n, h)) if i >= 0) for h in every)
    blocks = tuple(tuple(a for a in range(4) if bits >> a & 1) for bits in DISTURBANCES)
    faults = len(numbers) - len(blocks)
    kinds = tuple(KINDS[number] for number in numbers)
    return Hypotheses(
        n=n,
        names=(*map(_fault, kinds, rotors[:faults]), *map(_disturbance, blocks)),
        kinds=kinds,
        rotors=rotors,
        weight=np.array([weight_of(number) for number in numbers]),
        fault=np.array([number != DISTURBANCE for number in numbers]),
        pairs=np.array([who for kind, who in zip(kinds, rotors) if kind == "pair"]),
        blocks=blocks,
    )


def _fault(kind: str, who: tuple[int, ...]) -> str:
    if kind == "pair":
        return f"rotors {who[0] + 1}+{who[1] + 1}"
    return f"rotor {who[0] + 1}" + {"recovery": " is well again", "stuck": " gives one thrust"}.get(kind, "")


def _disturbance(block: tuple[int, ...]) -> str:
    if len(block) > 2:
        return "torque bias" if len(block) == 3 else "any disturbance"
    return " and ".join(AXES[a] for a in block) + ("" if 3 in block else " bias")
