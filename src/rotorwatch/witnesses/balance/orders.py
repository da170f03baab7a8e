"""Orders of each rotor: what vibrates once per turn, and as often as blades pass, in windows of a flight.

The angle of rotor r is the integral of its measured speed w_r. In a window, each axis of the sensor is

    a(t) = motion + sum_r sum_k w_r(t)^p (C_rk cos k phi_r + S_rk sin k phi_r) + noise,      phi_r = integral of w_r dt,

with the motion a line and cosines up to MOTION_HZ. All rotors and orders are fitted together by least squares. p is 2 for an accelerometer
(an unbalance m e makes the force m e w^2) and 1 for a gyro (the integral of an angular acceleration that grows as w^2), so that the
coefficients c = C - j S are those of acceleration over speed squared. As the angles are known at the samples' own times, a tone above half
the sampling rate is fitted at its alias as well as any other.

This is order tracking by least squares with known phases, the time-variant discrete Fourier transform with its orthogonality compensation
matrix: J. R. Blough, "A survey of DSP methods for rotating machinery analysis, what is needed, what is available", J. Sound and Vibration
262 (2003) 707-720, section 5. The inverse of that matrix also says which rotors a window cannot tell apart.

The noise of a coefficient comes from the residual at neighbouring orders (NEIGHBOURS resolutions beside it), times the variance inflation
of the fit: vibration is not white, and what a varying speed smears is noise for its neighbours.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median

WINDOW_S, TURNS = 0.15, 15.0  # a window: this long, and at least so many turns of the slowest rotor
MOTION_HZ = 10.0
NEIGHBOURS = (-2.5, -1.5, 1.5, 2.5)  # resolutions 1/T
STANDING = 125.0  # rad/s; below 20 turns a second a tone cannot be distinguished from motion
LONGEST = 1.5  # typical sampling intervals: a longer one is a gap
SPEED_GAP_S = 0.125  # between two reports of a speed, to integrate it
MOST = 240  # windows of a flight, spread over it: enough for an interval of a tenth, within a tenth of a second
ENOUGH = 3.0  # samples of a window for each unknown: of more, every second, third .. is taken
CELLS = 1 << 15  # samples times columns fitted at once
TINY = 1e-4  # on the diagonal, beyond the rounding of products (4 bytes): two rotors at one speed have a fit, too
EXTRA = 2.0  # samples for each unknown, at least


class Windows(NamedTuple):
    """The fits of W windows, of R rotors and K orders. Coefficients: m (accelerometer: amplitude over speed squared) or rad (gyro).

    time (W,): middles [s]. speed (W, R): mean [rad/s], 0 of a rotor that stands. power (W, K, R): sum over the axes of the squared
    amplitude, its noise taken off; noise (W, K, R): that noise. phase (W, K, R): of the strongest axis, against the rotor's angle in the
    middle of the window [rad]. inflation (W, K, R): of the variance by the other columns, from 1; infinite of a rotor that stands.
    alike (W, R, R): correlation of the once-per-turn tones of two rotors, 0 to 1. left (W,): mean square of the residual. spectrum (W, F):
    amplitude of all axes together, at F frequencies up to half the sampling rate, without the fit, for pictures."""

    time: np.ndarray
    speed: np.ndarray
    power: np.ndarray
    noise: np.ndarray
    phase: np.ndarray
    inflation: np.ndarray
    alike: np.ndarray
    left: np.ndarray
    spectrum: np.ndarray

    def part(self, rows: np.ndarray) -> Windows:
        """Some of the windows."""
        return Windows(*(field[rows] for field in self))


def fit(
    time: np.ndarray, values: np.ndarray, speed: np.ndarray, exponent: float, orders: tuple[int, ...] = (1, 2), window_s: float = WINDOW_S,
    most: int = MOST,
) -> Windows | None:  # fmt: skip
    """The orders of each rotor; None where no window is whole.

    time (n,) s: of the samples; values (n, 3): m/s^2 or rad/s. speed (n, R): of the rotors at these times, rad/s, NaN where unknown.
    exponent: p above. window_s: length of a window; most: windows, spread over the flight."""
    rows = windows(time, speed, window_s, motions(window_s) + 2 * len(orders) * speed.shape[1])
    if not len(rows):
        return None
    rows = rows[:: -(-len(rows) // most)]
    step = max(1, CELLS // rows.shape[1] // (1 + speed.shape[1]))
    parts = [_fit(time, values, speed, exponent, orders, motions(window_s), rows[k : k + step]) for k in range(0, len(rows), step)]
    return Windows(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def motions(window_s: float) -> int:
    """Number of columns for the motion in a window."""
    return 2 + round(2.0 * window_s * MOTION_HZ)


def windows(time: np.ndarray, speed: np.ndarray, window_s: float, unknowns: int) -> np.ndarray:
    """(W, samples) rows of windows without a gap in the samples, in which all speeds are known; (0, 0) where they are too short for the
    unknowns."""
    if time.size < 2:
        return np.zeros((0, 0), int)
    interval = float(median(np.diff(time)))
    count = round(window_s / interval) if interval > 0.0 else 0
    if count < EXTRA * unknowns or count > time.size:
        return np.zeros((0, 0), int)
    wrong = np.r_[False, np.diff(time) > LONGEST * interval] | ~np.isfinite(speed).all(axis=1)
    edges = np.r_[0, np.flatnonzero(wrong), time.size]
    starts = [np.arange(a, b - count + 1, count) for a, b in itertools.pairwise(edges) if b - a >= count]
    starts = np.concatenate(starts) if starts else np.zeros(0, int)
    starts = starts[~np.isnan(speed[starts]).any(axis=1)]
    return starts[:, None] + np.arange(0, count, max(1, int(count / (ENOUGH * unknowns))))


def at(time: np.ndarray, reported: np.ndarray, speed: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(n, R) speeds at times (n,), between reports (m,) s of speed (m, R) with valid (m, R); NaN where two reports are too far apart, or
    only one of them is of a rotor that stood."""
    out, after, close = np.full((time.size, speed.shape[1]), np.nan), np.zeros(0, int), np.zeros(0, bool)
    for k in range(speed.shape[1]):
        known = valid[:, k]
        t, w = reported[known], speed[known, k]
        if t.size < 2:
            continue
        if k == 0 or not np.array_equal(known, valid[:, k - 1]):
            after = np.clip(np.searchsorted(t, time), 1, t.size - 1)
            close = (t[after] - t[after - 1] <= SPEED_GAP_S) & (time >= t[0]) & (time <= t[-1])
        near = close & ((w[after] > STANDING) == (w[after - 1] > STANDING))
        out[near, k] = np.interp(time[near], t, w)
    return out


def _fit(time, values, speed, exponent, orders, first, rows) -> tuple[np.ndarray, ...]:
    """The fields of `Windows` of the windows `rows` (W, n); first: number of columns of the motion."""
    t, y, w = time[rows], values[rows], speed[rows]
    n, rotors = rows.shape[1], speed.shape[1]
    turns = (w > STANDING).all(axis=1)  # (W, R)
    y = (y - y.mean(axis=1, keepdims=True)).astype(np.float32)
    x = (2.0 * (t - 0.5 * (t[:, :1] + t[:, -1:])) / np.maximum(t[:, -1:] - t[:, :1], 1e-9)).astype(np.float32)
    angle = np.zeros(w.shape)
    np.cumsum(0.5 * (w[:, 1:] + w[:, :-1]) * np.diff(t, axis=1)[..., None], axis=1, out=angle[:, 1:])
    angle = np.remainder(angle - angle[:, n // 2, None], 2.0 * np.pi).astype(np.float32)
    mean = w.mean(axis=1)
    reference = np.where(turns, mean, 1.0)
    weight = np.where(turns[:, None], (w / reference[:, None]) ** exponent, 0.0).astype(np.float32)
    turn = np.empty(w.shape, np.complex64)  # of minus the angle
    turn.real, turn.imag = np.cos(angle), -np.sin(angle)
    tones = np.empty((*rows.shape, len(orders), rotors), np.complex64)
    tones[..., 0, :] = weight * turn ** orders[0] if orders[0] != 1 else weight * turn
    for k in range(1, len(orders)):
        tones[..., k, :] = tones[..., k - 1, :] * (turn if orders[k] - orders[k - 1] == 1 else turn ** (orders[k] - orders[k - 1]))
    tones = tones.reshape(*rows.shape, -1)
    size = first + 2 * len(orders) * rotors
    X = np.empty((*rows.shape, size), np.float32)
    X[..., 0], X[..., 1] = 1.0, x
    X[..., 2:first] = np.cos(0.5 * np.pi * np.arange(1, first - 1) * (x[..., None] + 1.0))
    X[..., first:] = tones.view(np.float32)  # cosine and minus sine of each
    turned = X.transpose(0, 2, 1)
    gram = (turned @ X).astype(float)
    scale = np.sqrt(np.einsum("wii->wi", gram))
    none = scale < 1e-6
    scale[none] = 1.0
    gram /= scale[:, :, None] * scale[:, None, :]
    gram[:, range(size), range(size)] += none + TINY
    inverse = np.linalg.inv(gram)
    found = (inverse @ ((turned @ y) / scale[..., None])) / scale[..., None]
    residual = y - X @ found.astype(np.float32)
    c = found[:, first::2] + 1j * found[:, first + 1 :: 2]  # (W, K R, 3)
    diagonal = np.einsum("wii->wi", inverse)
    inflation = 0.5 * (diagonal[:, first::2] + diagonal[:, first + 1 :: 2])
    # The residual beside each tone: the mean square of its amplitude at NEIGHBOURS, summed over the axes.
    beside = np.exp(-1j * np.pi * np.array(NEIGHBOURS) * x[0, :, None]).astype(np.complex64)  # (n, neighbours)
    half = np.maximum(0.5 * np.square(scale[:, first:]).reshape(len(rows), -1, 2).sum(axis=2), 1e-9)
    noise, free = np.zeros(half.shape), np.zeros(half.shape)
    factor = (np.linalg.cholesky(inverse) / scale[..., None]).transpose(0, 2, 1).astype(np.float32)
    for one in beside.T:
        near = (tones * one[:, None]).view(np.float32)  # (W, n, 2 K R)
        shifted = (near.transpose(0, 2, 1) @ residual).reshape(*half.shape, -1)
        noise += np.square(shifted).sum(axis=2)
        taken = np.square(factor @ (turned @ near)).sum(axis=1).reshape(*half.shape, 2).sum(axis=2)
        free += 2.0 * half - taken  # the fit takes up a part of what is there
    noise *= 2.0 * inflation / np.maximum(free, TINY) / half
    unit = np.tile(reference ** (2.0 * exponent), (1, len(orders)))  # a rate of amplitude G is an angular acceleration w G, over w^2
    power = (np.abs(c) ** 2).sum(axis=2)
    strongest = np.argmax(np.abs(c), axis=2)
    phase = np.angle(np.take_along_axis(c, strongest[..., None], axis=2)[..., 0])
    blocks = gram[:, first : first + 2 * rotors, first : first + 2 * rotors].reshape(len(rows), rotors, 2, rotors, 2)
    alike = np.sqrt(0.5 * np.square(blocks).sum(axis=(2, 4))) * ~np.eye(rotors, dtype=bool)
    shape = (len(rows), len(orders), rotors)
    heard = np.tile(turns, (1, len(orders)))
    return (
        t[:, n // 2],
        np.where(turns, mean, 0.0),
        np.where(heard, (power - noise) / unit, 0.0).reshape(shape),
        np.where(heard, noise / unit, 0.0).reshape(shape),
        phase.reshape(shape),
        np.where(heard, inflation, np.inf).reshape(shape),
        alike,
        np.square(residual).sum(axis=2).mean(axis=1),
        2.0 / n * np.sqrt(np.square(np.abs(np.fft.rfft(y * np.hanning(n)[:, None].astype(np.float32), axis=1))).sum(axis=2)),
    )
