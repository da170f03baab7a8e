"""Outputs that part from the mixer: stuck at a value, off, or driven by something else.

`overrides` judges a whole flight; `Watch` goes on as samples come, and is what `overrides` runs. Loss of effectiveness never shows here:
the commands are what is compared.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.motion import allocation
from rotorwatch.motion.allocation import FLYING, NOISE_SD, PART, Comparison, Spans, hold, within

PART_STILL = 0.015  # of full thrust; as PART, for an output that does not move at all
PROVEN = 20  # comparisons a mixer must have passed before it can accuse an output
GIVEN_UP = np.linspace(0.0, 1.0, 11)  # shares of yaw that a mixer at its limits may give up
UNEXPLAINED = 0.25  # share of what outputs part by that a mixer may leave unexplained before it is not believed
AGREEING = 0.7  # share of the other outputs that must agree on what is common to all before one can be accused
CONFIRM_S, CONFIRM_SAMPLES = 0.25, 3  # how long an output must differ
STUCK_S = 1.0  # an output that does not move for this long while it should have, whatever limits the others, is stuck
SILENT_S = 0.5  # an output that does not move for this long while all others do is stuck
BACK_S = 0.5  # an output must follow again for this long before its override is over


@dataclass(frozen=True)
class Override:
    """An output that no longer follows the mixer.

    rotor: 1-based. kind: stuck, off or overridden. Times in s, end None while it lasts. reason: one sentence. asked: share of full
    thrust that the mixer asked for when it was noticed; None where the log does not say what the mixer asked for.
    """

    rotor: int
    kind: str
    onset: float
    detected: float
    end: float | None
    reason: str
    asked: float | None = None


def overrides(flight: Flight, vehicle: Vehicle, airborne: Spans) -> tuple[Override, ...]:
    """Outputs that stopped following the mixer in flight: stuck at a value, off, or driven by something else.

    airborne: ((start, end), ...) in s. With a ``control`` signal that the mixer is seen to follow, an output counts
    when it differs by more than 0.05 of full thrust (and six times the usual difference) for 0.25 s while no rotor is
    near its limits; limits explain neither an output below its minimum nor one that rests though it is asked to
    move against the others. Without it, only outputs that are off, or constant for 0.5 s while all others move, are found. Loss of
    effectiveness never shows here: the commands are what is compared. Causal: `detected` is when a live observer would have known.
    """
    if not flight.has("motors"):
        return ()
    watch = Watch(vehicle)
    if flight.has("control"):
        check = allocation.compare(flight, vehicle)
        if len(check.time) >= CONFIRM_SAMPLES:
            watch.compared(check, hold(flight["motors"].time, flight["motors"].values, check.time), airborne)
    watch.logged(flight["motors"], allocation.motor_thrusts(flight, vehicle).values, airborne)
    return watch.found()


class Watch:
    """The overrides of one vehicle, as its samples come. Pieces of any length, each sample once."""

    def __init__(self, vehicle: Vehicle):
        self._vehicle, n = vehicle, len(vehicle.rotors)
        self._departed, self._silent = _Departures(vehicle, n), _Silence(vehicle, n)

    def compared(self, check: Comparison, command: np.ndarray, airborne: Spans) -> None:
        """Go on with comparisons of m samples; command (m, n): the outputs logged in them."""
        if len(check.time):
            self._departed.on(check, command, within(check.time, airborne))

    def logged(self, motors: Signal, thrust: np.ndarray, airborne: Spans) -> None:
        """Go on with outputs as they are logged; thrust (m, n): their thrusts."""
        if len(motors):
            self._silent.on(motors, thrust, within(motors.time, airborne))

    def kept(self) -> bytes:
        """What it has come to, for `again`. As bytes: hundreds of small objects every second would be what garbage is looked for in."""
        return pickle.dumps((self._departed, self._silent), pickle.HIGHEST_PROTOCOL)

    def again(self, kept: bytes) -> None:
        """Go on from where it was `kept`."""
        self._departed, self._silent = pickle.loads(kept)

    def found(self) -> tuple[Override, ...]:
        """All overrides so far; the end of one that lasts is None."""
        found = self._departed.found() + self._silent.found()
        return tuple(o for o in _earliest(found) if not _balances(o, found, self._vehicle))


def _balances(one: Override, found: list[Override], vehicle: Vehicle) -> bool:
    """Does an output rest only because the one opposite it has been lost? What flies on balances its torque that way."""
    if one.kind != "off" or one.asked is not None:
        return False
    B = vehicle.effectiveness()[:2]
    return any(
        o.onset < one.onset
        and (o.end is None or one.onset < o.end)
        and np.abs(B[:, o.rotor - 1] + B[:, one.rotor - 1]).max() < 0.1
        for o in found
    )


def _earliest(found: list[Override]) -> tuple[Override, ...]:
    """Of overrides of one rotor that overlap in time, the one detected first."""
    kept: list[Override] = []
    for one in sorted(found, key=lambda o: (o.detected, o.rotor)):
        if not any(o.rotor == one.rotor and (o.end is None or one.onset < o.end) for o in kept):
            kept.append(one)
    return tuple(kept)


class Rest:
    """For each sample the time since which a value has stayed within `tolerance` of where it settled."""

    def __init__(self, tolerance: float):
        self._tolerance, self._anchor, self._since = tolerance, np.inf, 0.0

    def on(self, time: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(m,) s, for m more samples."""
        start: list[float] = []
        anchor, since, tolerance = self._anchor, self._since, self._tolerance
        for at, value in zip(time.tolist(), values.tolist()):  # plain numbers: several times as fast as those of arrays
            if abs(value - anchor) > tolerance:
                anchor, since = value, at
            start.append(since)
        self._anchor, self._since = anchor, since
        return np.array(start)


class Runs:
    """Spells of something wrong, as samples come: confirmed after `hold_s` and `samples` in a row, over when all is well for BACK_S."""

    def __init__(self, hold_s: float, samples: int):
        self._hold_s, self._samples = hold_s, samples
        self._onset: float | None = None
        self._count, self._low, self._high, self._well = 0, np.inf, -np.inf, None
        self._open: Override | None = None
        self._over: list[Override] = []

    @property
    def busy(self) -> bool:
        """In a spell, or in what may become one."""
        return self._open is not None or self._onset is not None

    def found(self) -> list[Override]:
        """All so far; the last may still last."""
        return [*self._over, *([self._open] if self._open else [])]

    def on(self, time, wrong, back, command, told: Callable) -> None:
        """More samples (m,): is it wrong, is it well, the output. told(k, onset s, lowest, highest output since) makes an Override of a
        spell that is confirmed by sample k."""
        flags, k = np.flatnonzero(wrong), 0
        while k < len(time):
            if self._open is None:
                if self._onset is None:
                    later = flags[np.searchsorted(flags, k) :]
                    if not len(later):
                        return
                    k = int(later[0])
                    self._onset, self._count, self._low, self._high = float(time[k]), 0, np.inf, -np.inf
                if not wrong[k]:
                    self._onset, k = None, k + 1
                    continue
                self._count += 1
                self._low, self._high = min(self._low, command[k]), max(self._high, command[k])
                if time[k] - self._onset < self._hold_s or self._count < self._samples:
                    k += 1
                    continue
                self._open, self._well = told(k, self._onset, self._low, self._high), None
            assert self._open is not None
            self._well = (time[k] if self._well is None else self._well) if back[k] else None
            if self._well is not None and time[k] - self._well >= BACK_S:
                self._over.append(replace(self._open, end=float(self._well)))
                self._open = self._onset = None
                continue
            k += 1


class _Departures:
    """Overrides found by comparing each output with what the mixer asks of it."""

    def __init__(self, vehicle: Vehicle, n: int):
        self._low, self._span = vehicle.curve.u_min, vehicle.curve.u_max - vehicle.curve.u_min
        self._runs = [Runs(CONFIRM_S, CONFIRM_SAMPLES) for _ in range(n)]
        self._still = [Rest(self._span / 400.0) for _ in range(n)]
        self._rest = [Rest(1e-9) for _ in range(n)]
        self._own_at_rest = np.zeros(n)
        self._fitted, self._compared, self._power = 0, 0, 0.0
        self._unexplained = self._all = 0.0

    def found(self) -> list[Override]:
        return [o for runs in self._runs for o in runs.found()]

    def on(self, check: Comparison, command: np.ndarray, aloft: np.ndarray) -> None:
        low, span = self._low, self._span
        flying = aloft & (np.median(check.demand, axis=1) > FLYING)
        interior = (command > low + 0.01 * span) & (command < low + 0.99 * span)
        alone = np.where(
            command >= low + 0.99 * span, 0.0, _alone(check, interior)
        )  # full thrust is what a mixer at its limits asks for
        # How well the mixer has explained the outputs so far; a mixer that never did says nothing about single outputs.
        far = np.abs(alone)
        good = flying & np.all(far < PART, axis=1)
        past, self._fitted = _so_far(self._fitted, good)
        compared, self._compared = _so_far(self._compared, flying & np.isfinite(alone).all(axis=1))
        power, self._power = _so_far(self._power, np.where(good[:, None], far**2, 0.0).max(axis=1))
        proven = (past >= PROVEN) & (past > 0.7 * compared) & self._turns_as_asked(check, good)
        usual = 6.0 * np.sqrt(power / np.maximum(past, 1))
        limit, still_limit = np.maximum(PART, usual), np.maximum(PART_STILL, usual)
        own = check.asked - check.asked.mean(axis=1, keepdims=True)
        for k in range(command.shape[1]):
            still = self._still[k].on(check.time, command[:, k])
            off = (command[:, k] < low - 0.01 * span) & (check.asked[:, k] > 2 * FLYING)
            frozen = (check.time - still > 0.5) & interior[:, k]
            # At a limit the mixer takes from all others what it has too much, and in calm air they may rest: stuck is what does not
            # stir at all while it should have moved against them.
            rest = self._rest[k].on(check.time, command[:, k])
            settled = np.searchsorted(check.time, rest)
            here = rest >= check.time[0]
            before = np.where(here, own[np.minimum(settled, len(own) - 1), k], self._own_at_rest[k])
            self._own_at_rest[k] = before[-1]
            moved = np.abs(own[:, k] - before) > PART
            dead = (check.time - rest > STUCK_S) & interior[:, k] & moved & (np.abs(check.deviation[:, k]) > limit)
            wrong = proven & flying & ((far[:, k] > limit) | off | dead | (frozen & (far[:, k] > still_limit)))
            back = (np.abs(check.deviation[:, k]) < PART) & ~frozen

            def told(seen, onset, lowest, highest, k=k, still=still):
                kind = "overridden"
                if highest <= low + span / 400.0:
                    kind = "off"
                elif highest - lowest <= span / 400.0 and interior[seen, k]:
                    kind = "stuck"
                start = min(still[seen], onset) if kind == "stuck" else onset
                asked = np.clip(check.asked[seen, k], 0.0, check.top[seen, 0])
                reason = (
                    f"output {k + 1} was at {command[seen, k]:.4g} while the mixer asked for {asked:.0%} "
                    f"of full thrust and got {check.demand[seen, k]:.0%}"
                )
                return Override(k + 1, kind, float(start), float(check.known[seen]), None, reason, float(asked))

            self._runs[k].on(check.time, wrong, back | ~flying, command[:, k], told)

    def _turns_as_asked(self, check: Comparison, good: np.ndarray) -> np.ndarray:
        """(m,) bool: in the samples before that fitted, outputs parted from each other as they were asked to. A mixer that has the throttle
        right but another scale of roll, pitch and yaw fits as well, while nothing turns."""
        asked, got = (x - x.mean(axis=1, keepdims=True) for x in (check.asked, check.demand))
        unexplained, self._unexplained = _so_far(
            self._unexplained, np.where(good, ((got - asked) ** 2).sum(axis=1), 0.0)
        )
        all_, self._all = _so_far(self._all, np.where(good, (got**2 + NOISE_SD**2).sum(axis=1), 0.0))
        return unexplained < UNEXPLAINED * all_


def _so_far(before, more: np.ndarray) -> tuple[np.ndarray, float]:
    """(m,) sum of `before` and of what came before each sample; and the sum after the last."""
    total = before + np.concatenate([[0], np.cumsum(more)])
    return total[:-1], total[-1]


def _alone(check: Comparison, interior: np.ndarray) -> np.ndarray:
    """(m, n) by how much each output parts from the mixer by itself; NaN where nothing can be said.

    Where not all that is asked can be had, a mixer gives up throttle, for all outputs alike, and yaw, a share of it. Outputs that this
    explains are nobody's fault, nor are outputs that are all off by the same amount (a gain). An output is accused with what is left of
    its departure under the share of yaw that suits it best, of those under which the others agree. Where even throttle and yaw are not
    enough, each mixer has its own way to give up tilt: nothing is said. interior (m, n): away from the limits.
    """
    alone, agreed = _against_others(check.demand, check.asked, check.top, interior)
    odd = np.flatnonzero(~(np.abs(alone) < PART).all(axis=1) & ~check.yaw_granted)
    best = np.where(agreed[odd], alone[odd], np.nan)
    for share in GIVEN_UP:
        asked = check.asked[odd] - share * check.yaw[odd]
        off, agree = _against_others(check.demand[odd], asked, check.top[odd], interior[odd])
        best = np.where(agree & ~(np.abs(off) > np.abs(best)), off, best)
    alone[odd] = best
    possible = np.ptp(check.asked, axis=1) < 0.97 * check.top[:, 0]
    return np.where(possible[:, None], alone, np.nan)


def _against_others(demand, asked, top, interior) -> tuple[np.ndarray, np.ndarray]:
    """(m, n) departure of each output from what is asked and what the others have in common, within the limits; and whether they agree."""
    apart, alone, agreed = (
        np.where(interior, demand - asked, np.nan),
        np.empty(demand.shape),
        np.empty(demand.shape, bool),
    )
    for k in range(demand.shape[1]):
        rest = np.arange(demand.shape[1]) != k
        off = demand - np.clip(asked + _median(apart[:, rest])[:, None], 0.0, top)
        agreed[:, k] = np.sum(np.abs(off[:, rest]) < PART, axis=1) > AGREEING * rest.sum()
        alone[:, k] = np.where(agreed[:, k], off[:, k], np.nan)
    return alone, agreed


def _median(values: np.ndarray) -> np.ndarray:
    """(m,) median of the finite values (m, k) of each row; NaN with fewer than two."""
    count = np.isfinite(values).sum(axis=1)
    ordered = np.sort(values, axis=1)  # NaN last
    rows, middle = np.arange(len(values)), np.maximum(count - 1, 0)
    return np.where(count < 2, np.nan, 0.5 * (ordered[rows, middle // 2] + ordered[rows, (middle + 1) // 2]))


class _Silence:
    """Overrides that the outputs alone give away: one is off, or constant, while all others fly and move."""

    def __init__(self, vehicle: Vehicle, n: int):
        self._low, self._span = vehicle.curve.u_min, vehicle.curve.u_max - vehicle.curve.u_min
        self._rests_at_minimum = n == 4 and bool(vehicle.extra.get("rests_at_minimum", False))
        self._still = [Rest(1e-9) for _ in range(n)]
        self._runs = [(Runs(0.0, 1), Runs(0.3, 3), Runs(0.0, 1)) for _ in range(n)]
        self._time, self._thrust = np.empty(0), np.empty((0, n))  # the last SILENT_S of the samples before

    def found(self) -> list[Override]:
        return [o for ways in self._runs for runs in ways for o in runs.found()]

    def on(self, motors: Signal, thrust: np.ndarray, aloft: np.ndarray) -> None:
        low, span, time, n = self._low, self._span, motors.time, thrust.shape[1]
        inside = aloft & np.all(motors.valid, axis=1)
        stills = np.stack([self._still[j].on(time, motors.values[:, j]) for j in range(n)], axis=1)
        resting = (time[:, None] - stills > SILENT_S) & inside[:, None]
        low_ones = (motors.values <= low + 0.01 * span) & inside[:, None]
        known = np.where(motors.valid, thrust, np.nan)
        moved = self._moved(time, known, np.flatnonzero(resting.any(axis=1)))
        # Of each rotor: the least that another one has moved.
        least = np.where(
            moved <= moved.min(axis=1)[:, None], np.sort(moved, axis=1)[:, 1:2], moved.min(axis=1)[:, None]
        )
        left_behind = resting & (least > 0.03)
        if not (left_behind.any() or low_ones.any() or any(runs.busy for ways in self._runs for runs in ways)):
            return
        for k in range(n):
            others, command = np.delete(thrust, k, axis=1), motors.values[:, k]
            still = stills[:, k]
            interior = (command > low + 0.02 * span) & (command < low + 0.98 * span)
            stuck = left_behind[:, k] & interior
            # Below the minimum: no mixer asks for that. At the minimum, where outputs have nothing below it: no quad flies
            # on with a rotor at rest and the others off their limits (with more rotors, one opposite a dead one rests).
            flown = inside & (np.median(others, axis=1) > 2 * FLYING)
            below = flown & (command < low - 0.01 * span)
            idle = flown & (command <= low + 0.002 * span) & np.all((others > FLYING) & (others < 0.99), axis=1)
            idle &= self._rests_at_minimum
            ways = ((stuck, "stuck"), (below, "off"), (idle & (time - still > 1.0), "off"))
            for (wrong, kind), runs, from_rest in zip(ways, self._runs[k], (True, False, True)):
                back = (time - still < 0.2) if kind == "stuck" else (command > low + 0.01 * span)

                def told(
                    seen, onset, lowest, highest, k=k, kind=kind, still=still, command=command, from_rest=from_rest
                ):
                    start = still[seen] if from_rest else onset
                    what = "did not move" if kind == "stuck" else "was off"
                    reason = f"output {k + 1} {what} at {command[seen]:.4g} while all others flew on"
                    return Override(k + 1, kind, float(start), float(time[seen]), None, reason)

                runs.on(time, wrong, back | ~inside, command, told)

    def _moved(self, time: np.ndarray, thrust: np.ndarray, where: np.ndarray) -> np.ndarray:
        """(m, n) range of the thrusts over the last SILENT_S without the sample furthest off, of the samples `where`; 0 elsewhere.

        In calm air an output may rest: the others rest as well, but for one damaged record. What moves is off in more than one sample.
        """
        longer, before = np.concatenate([self._time, time]), len(self._time)
        all_ = np.concatenate([self._thrust, thrust])
        window = np.searchsorted(longer, time - SILENT_S, side="left")
        moved = np.zeros_like(thrust)
        for i in where:
            ordered = np.sort(all_[window[i] : before + i + 1], axis=0)  # NaN last
            last = np.isfinite(ordered).sum(axis=0) - 1
            lower, upper = (np.take_along_axis(ordered, np.maximum(last - k, 0)[None], 0)[0] for k in (1, 0))
            moved[i] = np.where(last > 1, np.minimum(upper - ordered[1 % len(ordered)], lower - ordered[0]), 0.0)
        keep = np.searchsorted(longer, longer[-1] - SILENT_S, side="left")
        self._time, self._thrust = longer[keep:], all_[keep:]
        return moved
