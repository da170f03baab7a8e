"""Random numbers from a counter: the same ones on every machine, alone, in a batch and in C, and no state but the counter.

    uniform(counter, stream) = (mix(mix(counter) + stream c) + 1/2) / 2^31

mix scrambles 31 bits by shifts and products. Counter-based generators: Salmon, Moraes, Dror and Shaw, Parallel random numbers: as
easy as 1, 2, 3, Proc. SC 2011. This one is far simpler than theirs, and good enough to move particles, for nothing else.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.backend import jnp, lax
from rotorwatch.core import Array

BITS = 2**31 - 1
FACTOR, STREAM = 0x45D9F3B, 0x3504F333  # odd, with their bits spread evenly


def mix(x: Array) -> Array:
    """int32 of 31 bits from int32 of 31 bits, each bit depending on all."""
    for _ in range(2):
        x = jnp.bitwise_xor(x, lax.div(x, jnp.full_like(x, 65536)))
        x = jnp.bitwise_and(x * np.int32(FACTOR), np.int32(BITS))  # overflows wrap around
    return jnp.bitwise_xor(x, lax.div(x, jnp.full_like(x, 65536)))


def uniform(counter: Array, count: int) -> Array:
    """(count,) numbers strictly between 0 and 1, of a counter (int32, not negative): one stream each."""
    streams = (np.arange(1, count + 1, dtype=np.int64) * STREAM & BITS).astype(np.int32)
    key = mix(jnp.asarray(counter, jnp.int32))
    return (mix(jnp.bitwise_and(key + jnp.asarray(streams), np.int32(BITS))) + 0.5) / 2.0**31
