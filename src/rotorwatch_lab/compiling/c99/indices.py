"""Gathers and scatters as tables: for every element of the result, where it comes from; XLA's index conventions end here.

Positions are row-major; -1 stands for an index outside, which a gather fills and a scatter drops.
"""

from __future__ import annotations

import numpy as np

from rotorwatch_lab.compiling.c99.graph import Axis, Graph, Node, strides


def filling(kind: str, params):
    """The fill value of a gather for indices out of bounds."""
    fill_value = params.get("fill_value")
    if fill_value is not None:
        return fill_value
    return {"f": np.nan, "i": -(2**31), "l": -(2**63), "b": True}[kind]


def _windows(shape, dropped) -> list[int]:
    """The operand's axes that a window runs along: all but those dropped."""
    return [d for d in range(len(shape)) if d not in dropped]


def _positions(shape, index: np.ndarray, result, along: dict[int, int], sizes: dict[int, int], starts, batched, clip: bool) -> np.ndarray:
    """(result) positions in an operand of `shape`; windows that reach outside are -1 as a whole.

    along: axis of the result -> of the operand, inside a window; sizes: of a window along the operand's axes, else 1; starts: operand's
    axis of each component of the index; batched: pairs of axes that operand and index share."""
    grid = np.indices(result)
    batch = tuple(grid[d] for d in range(len(result)) if d not in along)
    at, inside = [np.zeros(result, int) for _ in shape], np.ones(result, bool)
    for k, d in enumerate(starts):
        start, most = index[(*batch, k)].astype(int), shape[d] - sizes.get(d, 1)
        at[d] = np.clip(start, 0, most) if clip else start
        inside &= (at[d] >= 0) & (at[d] <= most)
    for d, b in batched:
        at[d] = batch[b]
    for o, d in along.items():
        at[d] = at[d] + grid[o]
    flat = sum(s * np.where(inside, a, 0) for s, a in zip(strides(shape), at))
    return np.where(inside, flat, -1).astype(int)


def gathered(shape, index: np.ndarray, params, out_shape) -> np.ndarray:
    """(out_shape) positions in an operand of `shape` for a constant index."""
    dims = params["dimension_numbers"]
    along = zip(dims.offset_dims, _windows(shape, (*dims.collapsed_slice_dims, *dims.operand_batching_dims)))
    batched = zip(dims.operand_batching_dims, dims.start_indices_batching_dims)
    sizes = dict(enumerate(params["slice_sizes"]))
    return _positions(shape, index, out_shape, dict(along), sizes, dims.start_index_map, batched, "CLIP" in str(params["mode"]))


def run_time_gather(graph: Graph, shape, index: Node, params, out_shape):
    """The same for an index known at run time: (axes of the fixed part, index of each gathered axis as views of the result's shape,
    these axes, their largest start)."""
    dims, sizes = params["dimension_numbers"], params["slice_sizes"]
    width = len(out_shape)
    batch = [d for d in range(width) if d not in dims.offset_dims]
    steps = [[0] * width for _ in shape]
    for d, b in zip(dims.operand_batching_dims, dims.start_indices_batching_dims):
        steps[d][batch[b]] = 1
    for o, d in zip(dims.offset_dims, _windows(shape, (*dims.collapsed_slice_dims, *dims.operand_batching_dims))):
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
    windows = _windows(shape, (*dims.inserted_window_dims, *dims.operand_batching_dims))
    along = dict(zip(dims.update_window_dims, windows))
    sizes = {d: updates_shape[u] for u, d in along.items()}
    batched = zip(dims.operand_batching_dims, dims.scatter_indices_batching_dims)
    return _positions(shape, index, updates_shape, along, sizes, dims.scatter_dims_to_operand_dims, batched, "CLIP" in str(params["mode"]))


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
        view = regular(np.asarray(along))
        if view is None:
            return None
        axes.append(Axis(*view))
    return tuple(axes)
