"""The location of a rotor, in words, as seen from behind the vehicle: 'rear left', 'right, lower'."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.flight.vehicle import SAME_ARM, Rotor

STRAIGHT = 22.4  # degrees: within this of an axis, a rotor is in front, at the side or at the rear; else in a corner
SIDES = ("front", "right", "rear", "left")
CORNERS = ("front right", "rear right", "rear left", "front left")


def names(rotors: Sequence[Rotor]) -> tuple[str, ...]:
    """A name for each rotor, all different; x forward, y right. Empty names when rotors have no places.

    Two rotors of one corner are distinguished by the side they are nearer to, or as inner and outer; two on one arm as upper and lower: as
    in the vehicle's description, else the one with less thrust, else the one listed later is the lower one."""
    at = np.array([(r.x, r.y) for r in rotors], float).reshape(-1, 2)
    reach = np.abs(at).max(initial=0.0)
    if reach <= 0.0:
        return ("",) * len(rotors)
    same = np.linalg.norm(at[:, None] - at[None], axis=2) < SAME_ARM * reach
    arms = sorted({tuple(np.flatnonzero(row).tolist()) for row in same})
    first = [arm[0] for arm in arms]
    words = [_side(*at[k]) for k in first]
    for word in set(words):
        alike = [j for j, w in enumerate(words) if w == word]
        if len(alike) > 1:
            for j, detail in zip(alike, _distinguished(at[[first[j] for j in alike]], word), strict=True):
                words[j] = f"{word}, {detail}"
    out = [""] * len(rotors)
    for arm, word in zip(arms, words, strict=True):
        for k, level in zip(arm, _levels([rotors[k] for k in arm]), strict=True):
            out[k] = f"{word}, {level}" if level else word
    return tuple(out)


def _side(x: float, y: float) -> str:
    if np.hypot(x, y) < 1e-9:
        return "centre"
    angle = float(np.degrees(np.arctan2(y, x))) % 360.0
    nearest = round(angle / 90.0) % 4
    off = (angle - 90.0 * nearest + 180.0) % 360.0 - 180.0
    return SIDES[nearest] if abs(off) <= STRAIGHT else CORNERS[int(angle // 90.0)]


def _distinguished(at: np.ndarray, word: str) -> list[str]:
    """Words that distinguish rotors with the same place: the nearer side, inner and outer, else the angle from the nose."""
    angle, radius = np.degrees(np.arctan2(at[:, 1], at[:, 0])), np.hypot(*at.T)
    if len(at) == 2 and np.ptp(angle) > 10.0 and " " in word:
        end = word.split()[0]
        ahead = np.abs(at[:, 0])
        return [f"nearer the {end}" if a == ahead.max() else "nearer the side" for a in ahead]
    if len(at) == 2 and np.ptp(radius) > SAME_ARM * radius.max():
        return ["outer" if r == radius.max() else "inner" for r in radius]
    return [f"at {a:.0f}°" if len(set(np.round(angle))) == len(at) else f"number {k + 1}" for k, a in enumerate(angle)]


def _levels(arm: Sequence[Rotor]) -> list[str]:
    if len(arm) != 2:
        return [""] if len(arm) == 1 else [f"level {k + 1}" for k in range(len(arm))]
    lower = [bool(getattr(r, "lower", False)) for r in arm]
    if sum(lower) != 1:
        lower = [r.share < max(a.share for a in arm) for r in arm]
    if sum(lower) != 1:
        lower = [False, True]
    return ["lower" if low else "upper" for low in lower]
