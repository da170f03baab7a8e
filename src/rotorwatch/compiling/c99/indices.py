"""Gathers and scatters as tables: for every element of the result, where it comes from; XLA's index conventions end here.

Positions are row-major; -1 stands for an index outside, which a gather fills and a scatter drops.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.compiling.c99.graph import Axis, Graph, Node, strides


def filling(kind: str, params):
    """What a gather puts where the index is outside."""
    given = params.get("fill_value")
    if given is not None:
        return given
    return {"f": np.nan, "i": -(2**31), "l": -(2**63), "b": True}[kind]


def gathered(shape, index: np.ndarray, params, out_shape) -> np.ndarray:
    """(out_shape) positions in an operand of `shape` for a constant index."""
    dims, sizes = params["dimension_numbers"], params["slice_sizes"]
    grid = np.indices(out_shape)
    batch = tuple(grid[d] for d in range(len(out_shape)) if d not in dims.offset_dims)
    at, inside = [np.zeros(out_shape, int) for _ in shape], np.ones(out_shape, bool)
    for k, d in enumerate(dims.start_index_map):
        start, most = index[(*batch, k)].astype(int), shape[d] - sizes[d]
        if "CLIP" in str(params["mode"]):
            start = np.clip(start, 0, most)
        inside &= (start >= 0) & (start <= most)
        at[d] = start
    for d, b in zip(dims.operand_batching_dims, dims.start_indices_batching_dims):
        at[d] = batch[b]
    window_axes = [d for d in range(len(shape)) if d not in (*dims.collapsed_slice_dims, *dims.operand_batching_dims)]
    for o, d in zip(dims.offset_dims, window_axes):
        at[d] = at[d] + grid[o]
    flat = sum(s * np.where(inside, a, 0) for s, a in zip(strides(shape), at))
    return np.where(inside, flat, -1).astype(int)


def run_time_gather(graph: Graph, shape, index: Node, params, out_shape):
    """The same for an index known at run time: (axes of the fixed part, index of each gathered axis as views of the result's shape,
    these axes, their largest start)."""
    dims, sizes = params["dimension_numbers"], params["slice_sizes"]
    width = len(out_shape)
    batch = [d for d in range(width) if d not in dims.offset_dims]
    steps = [[0] * width for _ in shape]
    for d, b in zip(dims.operand_batching_dims, dims.start_indices_batching_dims):
        steps[d][batch[b]] = 1
    window_axes = [d for d in range(len(shape)) if d not in (*dims.collapsed_slice_dims, *dims.operand_batching_dims)]
    for o, d in zip(dims.offset_dims, window_axes):
        steps[d][o] = 1
    parts = []
    for k in range(len(dims.start_index_map)):
        start = [0] * (len(index.shape) - 1) + [k]
        one = graph.sliced(index, start, [*index.shape[:-1], k + 1])
        parts.append(graph.broadcast(graph.reshaped(one, index.shape[:-1]), out_shape, batch))
    axes = tuple(Axis(0, tuple(s)) for s in steps)
    return axes, parts, tuple(dims.start_index_map), tuple(shape[d] - sizes[d] for d in dims.start_index_map)


def scattered(shape, index: np.ndarray, params, updates_shape) -> np.ndarray:
    """(updates_shape) positions in an operand of `shape`; a window that reaches outside is dropped as a whole."""
    dims = params["dimension_numbers"]
    grid = np.indices(updates_shape)
    batch = tuple(grid[d] for d in range(len(updates_shape)) if d not in dims.update_window_dims)
    window = [d for d in range(len(shape)) if d not in (*dims.inserted_window_dims, *dims.operand_batching_dims)]
    size = dict(zip(window, (updates_shape[u] for u in dims.update_window_dims)))
    at, inside = [np.zeros(updates_shape, int) for _ in shape], np.ones(updates_shape, bool)
    for k, d in enumerate(dims.scatter_dims_to_operand_dims):
        start, most = index[(*batch, k)].astype(int), shape[d] - size.get(d, 1)
        if "CLIP" in str(params["mode"]):
            start = np.clip(start, 0, most)
        inside &= (start >= 0) & (start <= most)
        at[d] = start
    for d, b in zip(dims.operand_batching_dims, dims.scatter_indices_batching_dims):
        at[d] = batch[b]
    for u, d in zip(dims.update_window_dims, window):
        at[d] = at[d] + grid[u]
    flat = sum(s * np.where(inside, a, 0) for s, a in zip(strides(shape), at))
    return np.where(inside, flat, -1).astype(int)


def regular(table: np.ndarray) -> tuple[int, tuple[int, ...]] | None:
    """(offset, steps) when positions are offset + sum of steps[j] i_j; else None."""
    if table.size == 0 or table.min() < 0:
        return None
    first = int(table.reshape(-1)[0])
    steps = []
    for j, n in enumerate(table.shape):
        second = tuple(int(k == j) for k in range(table.ndim))
        steps.append(int(table[second]) - first if n > 1 else 0)
    grid = np.indices(table.shape)
    same = first + sum(m * g for m, g in zip(steps, grid))
    return (first, tuple(steps)) if np.array_equal(same, table) else None


def affine(table: np.ndarray, shape) -> tuple[Axis, ...] | None:
    """The view that a gather is, when each axis of the operand is indexed by a sum of multiples of the result's indices."""
    if table.size == 0 or table.min() < 0:
        return None
    axes = []
    for along in np.unravel_index(table, shape):
        found = regular(np.asarray(along))
        if found is None:
            return None
        axes.append(Axis(*found))
    return tuple(axes)
