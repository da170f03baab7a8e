"""Rotors that stop though they are commanded to turn, or turn without load, until the vehicle is down: by ESC telemetry alone.

A quadrotor without one rotor tumbles within half a second, and the motion of a tumbling vehicle is no evidence. Its ESC needs two reports.
A dead motor reports speed 0. A motor without its propeller turns but draws almost no current: current over the speed's power for the
propeller's load falls to a fraction.

Where the vehicle flies on upright with a rotor reported as stopped, and no loss was found, the telemetry is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.answer.ledger import explained
from rotorwatch.answer.wording import rotors, seconds
from rotorwatch.base.arrays import median
from rotorwatch.flight.diagnosis import Event
from rotorwatch.witnesses.esc import causes, ratios
from rotorwatch.witnesses.esc.telemetry import Binned

USUAL = 0.75
STANDS = 0.2  # of its usual speed
COMMANDED = 0.5  # of its usual command
OTHERS_TURN = 0.4  # of their usual speed
TURNS, UNLOADED = 0.6, 0.35  # of its usual speed; of the usual current at that speed
REPORTS, UNLOADED_REPORTS, UNLOADED_S = 2, 3, 0.5
DOWN_S = 0.4  # before the end of the flight: propellers stop in the ground
FLIES_ON_S = 3.0
LEAST_LOSS, LEAST_UNLOADED = 0.95, 0.6


def find(bins: Binned, events: Sequence[Event], air, upset: np.ndarray) -> tuple[tuple[Event, ...], list[str]]:
    """(losses of rotors that are stopped or have no load, warnings). upset (T,) bool: bins in which the vehicle tumbles."""
    out, warnings = [], []
    for start, end in air:
        inside = (bins.report_time > start) & (bins.report_time < end)
        usual = _usual(bins.speed, bins.speed_known & inside[:, None])
        commanded = _usual(bins.commanded, np.broadcast_to(inside[:, None], bins.commanded.shape))
        # Two others turn: the motors were not switched off.
        turns = np.partition(bins.speed / np.maximum(usual, 1e-9), -2, axis=1)[:, -2] > OTHERS_TURN
        for k in np.flatnonzero(usual > 0.0):
            rotor = int(k) + 1
            turning = (bins.commanded[:, k] > COMMANDED * commanded[k]) & turns
            at = np.flatnonzero(inside & bins.speed_known[:, k])
            spell = _last(at, bins.speed[at, k] < STANDS * usual[k], turning, REPORTS)
            if spell is not None:
                onset, known = _times(bins, spell)
                later = (bins.time > onset) & (bins.time < end) & ~upset
                claim = _stands(rotor, onset, known)
                if onset > end - DOWN_S or explained(claim, events):
                    continue
                if np.count_nonzero(later) * bins.width > FLIES_ON_S:
                    warnings.append(
                        f"The ESC of {rotors([rotor])} reports a stopped motor from {seconds(onset)} on, but the vehicle flies on "
                        "without a loss: its telemetry has failed, and it is not used from there."
                    )
                else:
                    out.append(claim)
                continue
            at = at[bins.amps_known[at, k] & (bins.speed[at, k] > TURNS * usual[k])]
            if at.size <= UNLOADED_REPORTS:
                continue
            load = bins.amps[at, k] / bins.speed[at, k] ** ratios.CURRENT_POWER[0]
            load /= np.quantile(load, USUAL)
            spell = _last(at, load < UNLOADED, turning, UNLOADED_REPORTS)
            if spell is not None:
                onset, known = _times(bins, spell)
                lasted = bins.report_time[at[-1]] - onset
                claim = _unloaded(rotor, onset, known, float(median(load[at >= spell[1]])))
                if onset < end - DOWN_S and lasted > UNLOADED_S and not explained(claim, events):
                    out.append(claim)
    return tuple(out), warnings


def _last(at: np.ndarray, bad: np.ndarray, commanded: np.ndarray, reports: int) -> tuple[int, int, int] | None:
    """(report before, first report, report that makes it certain) of the stretch of bad reports that lasts to the end; None without one.

    The rotor must be commanded to turn in `reports` of them. A stretch that ends is a gap of the telemetry."""
    if not bad.any() or bad.all() or not bad[-1]:
        return None
    first = at.size - int(np.argmin(bad[::-1]))
    counted = [int(i) for i in at[first:] if commanded[i]]
    return (int(at[first - 1]), int(at[first]), counted[reports - 1]) if len(counted) >= reports else None


def _times(bins: Binned, spell: tuple[int, int, int]) -> tuple[float, float]:
    """(onset, time at which it was certain) s."""
    before, first, known = (float(bins.report_time[i]) for i in spell)
    return 0.5 * (before + first), known


def _usual(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(n,) upper quartile of the valid values (m, n), as most of a flight may be flown without the rotor; 0 without any."""
    return np.array([np.quantile(v[ok], USUAL) if ok.any() else 0.0 for v, ok in zip(values.T, valid.T)])


def _stands(rotor: int, onset: float, known: float) -> Event:
    parts = {"speed": (1.0, LEAST_LOSS, 1.0), "propeller": (0.0, 0.0, 1.0)}
    sentence = f"the motor has been stopped since {seconds(onset)} although commanded to turn, "
    return causes.loss(rotor, onset, known, (1.0, LEAST_LOSS, 1.0), (0.0, 0.95, 0.04, 0.01), parts, sentence, 0.0)


def _unloaded(rotor: int, onset: float, known: float, load: float) -> Event:
    loss = 1.0 - load
    parts = {"speed": (0.0, 0.0, 0.1), "propeller": (loss, LEAST_UNLOADED, 1.0)}
    sentence = f"since {seconds(onset)} the motor has drawn only a fraction of the current that its speed needs, "
    size = max(loss, LEAST_UNLOADED), LEAST_UNLOADED, 1.0
    return causes.loss(rotor, onset, known, size, (0.95, 0.02, 0.0, 0.03), parts, sentence, 1.0, load)
