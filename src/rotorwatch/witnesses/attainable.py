"""Every thrust and moment that a vehicle can still give, exactly, and how far hover is from their limits.

Commands within [0, 1] reach the zonotope Z = {B u}. It is bounded by planes h with h w <= sum_i max(h b_i, 0); every facet is spanned by
as many columns of B as Z has dimensions less one, so trying all of them finds every plane (McMullen, On zonotopes, Transactions of the
American Mathematical Society 159, 1971; for aircraft Durham, Constrained control allocation, Journal of Guidance, Control, and
Dynamics 16, 1993). With the planes known, how far one can go in a direction is a minimum over them, without a search.

The least distance of hover from a plane is the available control authority index (Du, Quan, Yang and Cai, Controllability analysis for
multirotor helicopter rotor degradation and failure, Journal of Guidance, Control, and Dynamics 38, 2015): hover can be held against
any disturbance if, and only if, it lies inside.
"""

from __future__ import annotations

from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.errors import ConfigError

SAME = 1e-9  # relative: what is smaller is rounding
MOST = 200_000  # sets of columns


class Planes(NamedTuple):
    """Z = {w: normals w <= limits, flat w = 0}. normals (k, m) of length 1, limits (k,); flat (j, m): directions that Z has no size in."""

    normals: np.ndarray
    limits: np.ndarray
    flat: np.ndarray

    def reach(self, start, direction) -> float:
        """The largest t >= 0 for which start + t direction lies in Z; -inf where start itself does not. direction is not 0."""
        start, direction = np.asarray(start, float), np.asarray(direction, float)
        scale = SAME * max(np.abs(self.limits).max(initial=0.0), 1e-300)
        if (np.abs(self.flat @ start) > scale).any() or (self.normals @ start > self.limits + scale).any():
            return -np.inf
        if (np.abs(self.flat @ direction) > SAME * np.linalg.norm(direction)).any():
            return 0.0
        speed = self.normals @ direction
        on = speed > SAME * np.linalg.norm(direction)
        room = np.maximum(self.limits - self.normals @ start, 0.0)
        return float((room[on] / speed[on]).min(initial=np.inf))

    def depth(self, point) -> float:
        """Distance of a point to the nearest plane, negative outside; 0 at most where Z is flat."""
        point = np.asarray(point, float)
        inside = float((self.limits - self.normals @ point).min(initial=np.inf))
        if not len(self.flat):
            return inside
        return min(inside, 0.0) - float(np.abs(self.flat @ point).max())


def planes(B) -> Planes:
    """The planes of Z = {B u: 0 <= u <= 1}, B (m, n). Raises ConfigError for NaN and for too many columns to try all sets."""
    B = checks.finite("B", np.asarray(B, float))
    m = B.shape[0]
    columns = B[:, np.abs(B).max(axis=0) > 0.0]
    if not columns.size:
        return Planes(np.zeros((0, m)), np.zeros(0), np.eye(m))
    U, size, _ = np.linalg.svd(columns)
    rank = int((size > SAME * size[0]).sum())
    basis, flat = U[:, :rank], U[:, rank:].T
    G = basis.T @ columns
    if comb(G.shape[1], rank - 1) > MOST:
        raise ConfigError(f"{G.shape[1]} rotors are too many to find all limits of their thrusts and moments.")
    # Columns of one direction are one for this: fewer sets, the same planes.
    unit = G / np.linalg.norm(G, axis=0)
    unit = unit * np.where(unit[np.abs(unit).argmax(axis=0), np.arange(unit.shape[1])] < 0.0, -1.0, 1.0)
    unit = np.unique(np.round(unit, 12), axis=1)
    if rank == 1:
        normals = np.ones((1, 1))
    else:
        sets = np.array(list(combinations(range(unit.shape[1]), rank - 1)), int)
        spans = np.moveaxis(unit[:, sets], 1, 0)  # (sets, rank, rank - 1)
        # The normal is what the minors say: zero where the columns do not span a plane.
        minors = [(-1.0) ** k * np.linalg.det(np.delete(spans, k, axis=1)) for k in range(rank)]
        normals = np.stack(minors, axis=1)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > SAME] / length[length > SAME, None]
    normals = np.unique(np.round(np.vstack([normals, -normals]), 12), axis=0)
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    return Planes(normals @ basis.T, np.maximum(normals @ G, 0.0).sum(axis=1), flat)


class Margins(NamedTuple):
    """About hover. lift: the largest thrust over weight, moments zero. roll, pitch, yaw: the largest moment that can be had at hover
    to either side, all others zero [N m] (or the units of B). depth: distance of hover from the nearest limit, each channel as a share
    of `size`; above zero: full control."""

    lift: float
    roll: float
    pitch: float
    yaw: float
    depth: float


def margins(B, weight: float, size=None, free_yaw: bool = False) -> Margins:
    """Margins of a vehicle with B (4, n): thrust, roll, pitch, yaw moment at full command, losses applied. size (4,): what depth counts
    as 1 of each channel, default: half of what all rotors of B give. free_yaw: the yaw moment may be whatever comes out; it is then NaN.
    Margins of moments are 0, and -inf where hover cannot be held at all."""
    B = np.asarray(B, float)
    half = np.abs(B).sum(axis=1) / 2.0 if size is None else np.asarray(size, float)
    half = np.where(half > 0.0, half, 1.0)
    rows = 3 if free_yaw else 4
    Z = planes(B[:rows] / half[:rows, None])
    hover, axes = np.zeros(rows), np.eye(rows)
    hover[0] = weight / half[0]
    lift = Z.reach(np.zeros(rows), axes[0]) * half[0] / weight
    sides = [min(Z.reach(hover, axes[k]), Z.reach(hover, -axes[k])) * half[k] for k in range(1, rows)]
    return Margins(lift, sides[0], sides[1], np.nan if free_yaw else sides[2], Z.depth(hover))
