"""Definitions of the messages that are read, from the file next to this one, for bags without their own.

Where releases of PX4 differ in the fields that are used, each form is there, and the values decide between them (`fits`): quaternions have
length 1, flags are 0 or 1, a sample is not younger than its message.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np


@cache
def _definitions() -> dict[str, list[str]]:
    """Type, as `package/Type` -> its definition in each of its forms, with those of the types inside it."""
    outer, _, inside = Path(__file__).with_suffix(".msg").read_text("utf-8").partition("INSIDE OTHERS")
    by_kind: dict[str, list[str]] = {}
    for part in outer.split("\nMSG: ")[1:]:
        kind, _, fields = part.partition("\n")
        by_kind.setdefault(kind, []).append(fields + inside.replace("\nMSG: ", "\n=\nMSG: "))
    return by_kind


def forms(kind: str) -> tuple[str, ...]:
    """The definitions that a message of this type may have; none for types that are not read."""
    return tuple(_definitions().get(kind.replace("/msg/", "/"), ()))


def fits(kind: str, columns: Mapping[str, np.ndarray]) -> bool:
    """True if these values can be those of a px4_msgs message of this type; True for all others."""
    if not kind.startswith("px4_msgs/"):
        return True
    if "timestamp_sample" in columns:
        late = columns["timestamp"].astype(np.int64) - columns["timestamp_sample"].astype(np.int64)
        known = columns["timestamp_sample"] > 0
        if not _mostly((late >= -1_000_000) & (late < 10_000_000), known):
            return False
    for name in ("q", "q_d"):
        if f"{name}[0]" in columns:
            q = np.stack([columns[f"{name}[{k}]"] for k in range(4)], axis=1).astype(np.float64)
            with np.errstate(invalid="ignore", over="ignore"):
                return _mostly(np.abs((q * q).sum(axis=1) - 1.0) < 0.05)
    flags = [c for n, c in columns.items() if n.endswith("_valid") or n in ("connected", "landed", "freefall", "maybe_landed", "armed")]
    if not all(_mostly(c <= 1) for c in flags):
        return False
    if "voltage_filtered_v" in columns:  # a filtered voltage is near the voltage, a current is not
        volts, slow = columns["voltage_v"], columns["voltage_filtered_v"]
        with np.errstate(invalid="ignore", over="ignore"):
            return _mostly(np.abs(slow - volts) <= 0.1 * np.abs(volts))
    if "arming_state" in columns:
        return _mostly((columns["arming_state"] <= 6) & (columns["nav_state"] <= 40))
    return True


def _mostly(fine: np.ndarray, among: np.ndarray | None = None) -> bool:
    fine = fine if among is None else fine[among]
    return fine.size == 0 or float(fine.mean()) > 0.9
