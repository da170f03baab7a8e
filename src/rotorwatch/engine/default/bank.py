"""A bank of onset times: what a jump at each of them would have done to the filter's innovations since.

For every onset time the part M of a unit jump that the filter has not absorbed is carried along, and with it the information
matrix C and vector z of the jump's size nu (Willsky & Jones, IEEE TAC 21(1), 1976). For a measurement h s with innovation
nu_k of variance S and any gain K:

    phi = h M,   C += phi' phi / S,   z += phi' nu_k / S,   M <- A (M - K phi)

Slots are reused in turn: dense for recent onsets, sparse for older ones, and a group for losses that show gradually.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.core import Array
from rotorwatch.engine.default import plant
from rotorwatch.engine.estimator.bank import SLOW_S

SLOTS = 16  # of each group
STRIDES = {0.05: (1, 2, 4), 0.1: (1, 5, 3)}  # ticks between the slots of a group: for short ticks, and from SLOW_S on


class Bank(NamedTuple):
    """W slots, n_s states, q directions. M (W, n_s, q), C (W, q, q), z (W, q); age (W,): ticks since the onset, -1 unused;
    count: ticks so far; before (W, m): what was noted just before the onset."""

    M: Array
    C: Array
    z: Array
    age: Array
    count: Array
    before: Array


class Jumps:
    """directions (n_s, q): what a unit jump in each direction does to the state. dt: tick length in s, a number or traced."""

    def __init__(self, directions: np.ndarray, dt):
        numpy, (short, long) = plant.arrays(dt), (np.array(strides) for strides in STRIDES.values())
        slow, groups = dt >= SLOW_S, len(short)
        self.directions = directions
        self.stride = numpy.where(slow, np.repeat(long, SLOTS), np.repeat(short, SLOTS))
        self.log_stride = numpy.where(slow, np.log(np.repeat(long, SLOTS)), np.log(np.repeat(short, SLOTS)))
        self.reach = numpy.where(slow, float(SLOTS * long.max()), float(SLOTS * short.max()))  # ticks
        self.place = np.tile(np.arange(SLOTS), groups)
        # The last group holds losses that build up, as a controller reveals them.
        self.slow = np.repeat((*[False] * (groups - 1), True), SLOTS)
        self.decay = numpy.exp(-dt / plant.ANSWER_S)

    def init(self, noted: int) -> Bank:
        """All slots unused. noted: how many numbers are noted of an onset."""
        W, (n_s, q) = self.stride.size, self.directions.shape
        unused, none = np.full(W, -1, np.int32), np.int32(0)
        return Bank(np.zeros((W, n_s, q)), np.zeros((W, q, q)), np.zeros((W, q)), unused, none, np.zeros((W, noted)))

    def advance(self, bank: Bank, A, start, keep, noted) -> Bank:
        """One tick on: state transition A (n_s,); with `start` a slot of each group becomes a jump now, with noted (m,) of the time before;
        not `keep`: all unused."""
        import jax.numpy as jnp

        turn = (bank.count % self.stride == 0) & ((bank.count // self.stride) % SLOTS == self.place)
        new = turn & start
        since = jnp.where(new, 0, jnp.maximum(bank.age, -1) + 1)
        share = jnp.where(jnp.asarray(self.slow), (1.0 - self.decay) * self.decay**since, (since == 0) * 1.0)
        share = jnp.where(new | (bank.age >= 0), share, 0.0)
        fresh = new[:, None]
        M = jnp.where(fresh[:, :, None], 0.0, A[:, None] * bank.M) + share[:, None, None] * self.directions[None]
        C = jnp.where(fresh[:, :, None], 0.0, bank.C)
        z = jnp.where(fresh, 0.0, bank.z)
        age = jnp.where(new, 0, jnp.where(bank.age >= 0, bank.age + 1, -1))
        before = jnp.where(fresh, noted, bank.before)
        return Bank(M, C, z, jnp.where(keep, age, -1).astype(jnp.int32), bank.count + 1, before)

    @staticmethod
    def observe(bank: Bank, h, K, w, nu) -> Bank:
        """One scalar measurement: row h (n_s,), gain K (n_s,), w = 1 / S (0: not measured), innovation nu."""
        import jax.numpy as jnp

        phi = jnp.einsum("s,wsq->wq", h, bank.M)
        C = bank.C + (w * phi[:, :, None]) * phi[:, None, :]
        z = bank.z + (w * nu) * phi
        M = bank.M - K[None, :, None] * phi[:, None, :]
        return bank._replace(M=M, C=C, z=z)


def without_last(bank: Bank, variance) -> Bank:
    """The bank with its last direction integrated out: how large that is nobody asks, its prior variance (one, or one a slot) is known.

    C - c c' / (C_ll + 1 / variance), and z alike: what is left holds whatever the last direction did.
    """
    C, z = bank.C, bank.z
    c = C[:, :-1, -1]
    share = c / (C[:, -1, -1] + 1.0 / variance)[:, None]
    return bank._replace(
        M=bank.M[:, :, :-1], C=C[:, :-1, :-1] - share[:, :, None] * c[:, None, :], z=z[:, :-1] - share * z[:, -1:]
    )


def pick(bank: Bank, one_slot) -> tuple[Array, Array, Array]:
    """M, C, z of one slot; one_slot (W,) is 1 there and 0 elsewhere."""
    import jax.numpy as jnp

    return (
        jnp.einsum("w,wsq->sq", one_slot, bank.M),
        jnp.einsum("w,wab->ab", one_slot, bank.C),
        jnp.einsum("w,wa->a", one_slot, bank.z),
    )


def forget(bank: Bank, now) -> Bank:
    """Where `now`, all slots unused: what they were compared with has changed."""
    import jax.numpy as jnp

    return bank._replace(age=jnp.where(now, -1, bank.age).astype(jnp.int32))
