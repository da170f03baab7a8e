"""The vibration that unbalanced rotors send through a frame, as a sensor samples it.

A rotor with the unbalance U [kg m] pulls a vehicle of mass M with a force that turns with it, so that in the place of the sensor

    a(t) = Re sum_r  u_r w_r^2 H_r(w_r) exp(j phi_r),     phi_r = integral of w_r dt,     u = U / M  [1e-6 m = g mm per kg]

H_r (3,) is the frame: of a rigid one (1, -+j, 0), for the rotor's direction of turning; a real one bends, so that the axes are drawn around
that and pass a resonance. Blades that pass an arm shake at b phi_r, in proportion to w^2 as well. Blades that fly in unlike tracks lift
unlike: the thrust turns beside the axis and nods the frame once per turn, along the axis (`axial`). A gyro measures the integral of an
angular acceleration of the same form.

Tones are evaluated at the samples' own times: above half the sampling rate they alias as in a sensor that is read without a filter. A
low-pass or a mean before the log multiplies them by its gain at their frequency.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.flight import Signal
from rotorwatch.logs import esc_columns

MICRO = 1e-6
BENDS = 0.35  # standard deviation of a drawn frame's gain, on each axis
CHIP, TIP_M_S = 1.2e-4, 120.0  # radii, of a rotor with this tip speed in hover
TO_RATE = 0.5  # 1/m: angular acceleration of a drawn frame for an acceleration of 1 m/s^2


def chip(lost: float, usual: float) -> float:
    """Unbalance [g mm/kg] of a rotor that turns at `usual` rad/s in hover, one of whose blades lost a tip and a share of the rotor's
    thrust: 5 % of it with 5 % of the blade's length, 3 % of its mass, which is 0.4 % of the vehicle's (1.2e-4 radii)."""
    return CHIP * lost / 0.05 * TIP_M_S / usual / MICRO


class Frame(NamedTuple):
    """A frame with R rotors. gain (R, 3): complex, of each axis far below the resonance. resonance_hz, damping: of its bending."""

    gain: np.ndarray
    resonance_hz: float = np.inf
    damping: float = 0.05

    def response(self, speed: np.ndarray) -> np.ndarray:
        """H (n, R, 3) at speeds (n, R) rad/s."""
        ratio = speed / (2.0 * np.pi * self.resonance_hz)
        return self.gain / (1.0 - ratio**2 + 2j * self.damping * ratio)[..., None]


def axial(frame: Frame) -> Frame:
    """The same frame, as it passes what pulls along the rotors' axes."""
    return frame._replace(gain=np.tile(np.array([0.0, 0.0, 1.0], complex), (len(frame.gain), 1)))


def rigid(spins: np.ndarray) -> Frame:
    """A frame that does not bend; spins (R,): 1 or -1."""
    spins = np.asarray(spins, float)
    return Frame(np.stack([np.ones_like(spins), -1j * spins, np.zeros_like(spins)], axis=1).astype(complex))


def drawn(spins: np.ndarray, usual: float, rng: np.random.Generator) -> Frame:
    """A frame whose gains scatter and whose resonance lies from a half to three times the usual speed [rad/s], but not within a fifth of
    it."""
    still = rigid(spins)
    gain = still.gain + BENDS * (rng.standard_normal(still.gain.shape) + 1j * rng.standard_normal(still.gain.shape))
    ratio = 1.0
    while abs(ratio - 1.0) < 0.2:
        ratio = float(np.exp(rng.uniform(np.log(0.5), np.log(3.0))))
    return Frame(gain, ratio * usual / (2.0 * np.pi), float(rng.uniform(0.1, 0.3)))


def angles(time: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """(n, R) integral of speeds (n, R) rad/s over times (n,) s, from 0."""
    steps = 0.5 * (speed[1:] + speed[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, speed.shape[1])), np.cumsum(steps, axis=0)])


def acceleration(
    angle: np.ndarray, speed: np.ndarray, unbalance: np.ndarray, frame: Frame, passing: tuple[int, float] = (2, 0.0)
) -> np.ndarray:
    """(n, 3) m/s^2 of rotors at angles (n, R) rad and speeds (n, R) rad/s with unbalances (R,) or (n, R) in g mm/kg; passing: number of
    blades, and what their passing adds, in the same unit."""
    blades, size = passing
    tones = MICRO * unbalance * np.exp(1j * angle) + MICRO * size * np.exp(1j * blades * angle)
    return np.einsum("nr,nra->na", tones * speed**2, frame.response(speed)).real


def rate(angle: np.ndarray, speed: np.ndarray, unbalance: np.ndarray, frame: Frame) -> np.ndarray:
    """(n, 3) rad/s: the same of a gyro, TO_RATE times as much angular acceleration as acceleration."""
    tones = TO_RATE * MICRO * unbalance * np.exp(1j * angle) * speed / 1j
    return np.einsum("nr,nra->na", tones, frame.response(speed)).real


def reported(time: np.ndarray, speed: np.ndarray, rate_hz: float, delay_s: float = 0.0, step: float = 0.0, each: bool = False) -> Signal:
    """ESC telemetry of true speeds (n, R) rad/s at times (n,) s: rate_hz times a second, delay_s late, rounded to steps of `step` rad/s.
    each: one ESC after the other, as on a shared line, else all at once."""
    rows = np.arange(time[0] + delay_s, time[-1], 1.0 / rate_hz)
    rotors = speed.shape[1]
    late = [k / (rate_hz * rotors) if each else 0.0 for k in range(rotors)]
    values = np.stack([np.interp(rows - delay_s - late[k], time, speed[:, k]) for k in range(rotors)], axis=1)
    values = np.round(values / step) * step if step > 0.0 else values
    signal = esc_columns.build(rows, {"speed": values}, range(1, rotors + 1), "simulated", [])
    assert signal is not None
    return signal
