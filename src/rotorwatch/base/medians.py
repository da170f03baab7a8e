"""Medians in definitions (docs/one-definition.md)."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import Real, Reals


def median(x: Reals, n: int) -> Real:
    """Median of the first n > 0 numbers, which are reordered."""
    upper = ranked(x, n, n // 2)
    return upper if n % 2 == 1 else 0.5 * (ranked(x, n, n // 2 - 1) + upper)


def ranked(x: Reals, n: int, k: int) -> Real:
    """The k-th smallest, from 0, of the first n numbers, which are reordered (Hoare's FIND, Communications of the ACM 4, 1961)."""
    low = 0
    high = n - 1
    while low < high:
        pivot = x[low + (high - low) // 2]
        i = low
        j = high
        while i <= j:
            while x[i] < pivot:
                i += 1
            while x[j] > pivot:
                j -= 1
            if i <= j:
                swapped = x[i]
                x[i] = x[j]
                x[j] = swapped
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            return x[k]
    return x[k]
