"""ESC telemetry of a flying vehicle: the rotors' speeds, and rotors that stop though they are commanded to turn.

The causal part of the rule of `esc.stopped`: a rotor below STANDS of its usual speed in REPORTS reports in a row, commanded more than
COMMANDED of its usual command, while two others turn; and that of `esc.following` where telemetry is fast. The vehicle's motion is
evaluated separately.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from rotorwatch.answer.wording import rotors
from rotorwatch.flight import Signal
from rotorwatch.flight.vehicle import ThrustCurve
from rotorwatch.logs.esc_columns import RPM
from rotorwatch.witnesses.esc.following import GAP_S, Follower, in_words
from rotorwatch.witnesses.esc.stopped import COMMANDED, OTHERS_TURN, REPORTS, STANDS

USUAL_REPORTS, LEAST = 300, 20  # reports for the usual speed
AGAIN_S = 2.0  # of turning before a stopped rotor counts as turning again


class Rotors:
    """The rotors of one vehicle. speed (n,): as last reported [rad/s], NaN where not; None without telemetry."""

    def __init__(self):
        self.speed: np.ndarray | None = None
        self._speeds: deque[np.ndarray] = deque(maxlen=USUAL_REPORTS)
        self._commands: deque[np.ndarray] = deque(maxlen=USUAL_REPORTS)
        self._bad = np.zeros(0, int)
        self._turned: dict[int, float] = {}  # stopped rotor, from 0 -> time since which it turns again
        self._command: np.ndarray | None = None
        self._sent = -np.inf
        self._follower: Follower | None = None

    def examine(self, esc: Signal | None, motors: Signal | None, flying: bool, curve: ThrustCurve | None = None) -> list[tuple[int, str]]:
        """Add telemetry, and the commands that came with it; returns (rotor, sentence) of new findings. curve: from commands to thrust."""
        before, since = self._command, self._sent
        if motors is not None and len(motors):
            self._command, self._sent = np.where(motors.valid[-1], motors.values[-1], 0.0), float(motors.time[-1])
        if esc is None or not len(esc) or self._command is None:
            return []
        changes, count = [], sum(name.startswith("speed") for name in esc.columns)
        speeds = np.where(esc.valid[:, :count], esc.values[:, :count], np.nan)
        for time, speed in zip(esc.time.tolist(), speeds):
            changes += self._report(time, speed, flying)
        if not flying or curve is None or self._command.size != count:
            return changes
        times, sent = np.array([since]), (self._command if before is None else before)[None]
        if motors is not None and len(motors) and motors.values.shape[1] == count:
            times, sent = np.append(times, motors.time), np.concatenate([sent, np.where(motors.valid, motors.values, 0.0)])
        row = np.maximum(np.searchsorted(times, esc.time, side="right") - 1, 0)
        return changes + self._left(esc.time, speeds, curve(sent[row]), esc.time - times[row] < GAP_S)

    def _left(self, time: np.ndarray, speeds: np.ndarray, thrust: np.ndarray, fresh: np.ndarray) -> list[tuple[int, str]]:
        """The rotor whose speed leaves what its command asks for (`esc.following`), the first one; none where anything is slow."""
        if self._follower is None or self._follower.size != thrust.shape[1]:
            self._follower = Follower(thrust.shape[1])
        known = list(self._follower.gone)
        left = self._follower.add(time, speeds, thrust, fresh)[: not known]
        back = [k for k in known if k not in self._follower.gone]
        reported = [(d.rotor + 1, f"the ESC of {rotors([d.rotor + 1])} reports a speed {in_words(d)} since {d.onset:.2f} s") for d in left]
        return reported + [(k + 1, f"the speed of {rotors([k + 1])} follows its command again at {time[-1]:.1f} s") for k in back]

    def _report(self, time: float, speed: np.ndarray, flying: bool) -> list[tuple[int, str]]:
        known = np.isfinite(speed)
        if self.speed is None or self.speed.size != speed.size:
            self.speed, self._bad = speed.copy(), np.zeros(speed.size, int)
            self._speeds.clear()
            self._commands.clear()
        self.speed = np.where(known, speed, self.speed)
        command = self._command
        if not flying or command is None or command.size != speed.size:
            self._bad[:] = 0
            return []
        usual = usual_command = np.zeros(speed.size)
        if len(self._speeds) >= LEAST:
            usual = np.nan_to_num(np.nanmedian(np.array(self._speeds), axis=0)) if known.any() else usual
            usual_command = np.median(np.array(self._commands), axis=0)
        turning = np.sort(np.where(usual > 0.0, self.speed / np.maximum(usual, 1e-9), 0.0))
        others = turning.size > 2 and turning[-2] > OTHERS_TURN
        stands = known & (usual > 0.0) & (self.speed < STANDS * usual) & (command > COMMANDED * usual_command) & others
        self._bad = np.where(known, np.where(stands, self._bad + 1, 0), self._bad)
        changes = []
        for k in np.flatnonzero(self._bad >= REPORTS).tolist():
            if k not in self._turned:
                changes.append((k + 1, f"the ESC of {rotors([k + 1])} reports a stopped motor at {time:.1f} s"))
            self._turned[k] = np.inf
        for k, since in list(self._turned.items()):
            if known[k] and not stands[k] and self.speed[k] > OTHERS_TURN * usual[k] > 0.0:
                self._turned[k] = min(since, time)
                if time - self._turned[k] >= AGAIN_S:
                    del self._turned[k]
                    changes.append((k + 1, f"the ESC of {rotors([k + 1])} reports that the motor turns again at {time:.1f} s"))
        if not self._bad.any() and known.any():
            self._speeds.append(np.where(known, speed, np.nan))
            self._commands.append(command)
        return changes

    def words(self) -> str:
        """Speeds in revolutions per minute."""
        if self.speed is None:
            return ""
        return "ESC " + " ".join("–" if np.isnan(s) else f"{s / RPM:.0f}" for s in self.speed.tolist()) + " rpm"
