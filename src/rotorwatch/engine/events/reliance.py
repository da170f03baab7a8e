"""What a flight controller may rely on: the effectiveness of each rotor, and the rotors to leave out. It does not flap.

Events change with every tick, and a loss that is said to be over may begin again; control allocation must not follow each of these changes
(PX4 issue 28388). A loss is passed on at once, and a recovery only when it has lasted: to act on less than a rotor gives costs little, to
act on more costs control. A rotor is left out when no other rotors explain the motion and at least GRAVE of its thrust is certainly gone,
and then for the rest of the flight: a rotor without a command shows no recovery.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, REAL, TIME, Mask, Real, Reals, Struct, Time, array, copy, local, real
from rotorwatch.engine.events.decisions import GRAVE
from rotorwatch.engine.events.events import LOSS, Event
from rotorwatch.engine.intake.craft import YAW, Vehicle
from rotorwatch.engine.intake.sizes import ROTORS, TOGETHER

MOVED = 0.1  # least change of an effectiveness that is passed on
REFRESH_S = 0.5  # between two changes
RISES_S = 5.0  # for which a recovery must have lasted
LEAST = 0.1  # of the mean hover command, below which a rotor of a hovering vehicle has no authority left
SINGULAR = 0.01  # pivot of B E^2 B' below which a demand cannot be answered
# What a fixed mixer can still do: no level hover; roll, pitch and thrust; yaw as well.
UNABLE, LEVEL, TURNS = 0, 1, 2


class Reliance(Struct):
    """effectiveness, lower, upper: of each rotor, 1 healthy to 0 lost, with the 95 % interval, as last passed on."""

    effectiveness = array(REAL, ROTORS, fill=1.0)
    lower = array(REAL, ROTORS, fill=1.0)
    upper = array(REAL, ROTORS, fill=1.0)
    rises = array(TIME, ROTORS, fill=LASTS)  # s, since when more has been seen than was passed on
    flight: Time = LASTS  # s, start of the flight that this is of
    decided: Time = LASTS  # s, when a rotor was left out first
    changed: Time = -LASTS  # s, when anything was passed on last
    odds: Real = 0.0  # of the rotors that were left out first, against all other explanations, when that was decided
    left_out: Mask = 0
    stands: bool = True  # the losses for which rotors were left out are still among the events
    revision: int = 0  # changes with what is passed on

    def look(self, v: Vehicle, events: list[Event], count: int, start: Time, now: Time) -> bool:
        """Take over the events at `now` s; return whether anything is passed on. start: of the current flight [s]; LASTS on the ground,
        where all stays as it was."""
        if start >= LASTS:
            return False
        if start < self.flight or start > self.flight:
            self._begin(start)
        seen = local(REAL, ROTORS)
        low = local(REAL, ROTORS)
        high = local(REAL, ROTORS)
        for k in range(v.rotors):
            seen[k] = 1.0
            low[k] = 1.0
            high[k] = 1.0
        gone = 0
        named = 0
        odds: Real = 0.0
        for i in range(count):
            e = events[i]
            if e.kind == LOSS and e.alternative_count == 0 and e.end >= LASTS:
                named |= e.rotors
                place = 0
                lost = False
                for k in range(v.rotors):
                    if (e.rotors & (1 << k)) != 0 and place < TOGETHER:
                        stuck = e.size > 0.0  # it follows no command
                        seen[k] = 0.0 if stuck else 1.0 - e.loss[place]
                        low[k] = 0.0 if stuck else 1.0 - e.upper[place]
                        high[k] = 0.0 if stuck else 1.0 - e.lower[place]
                        if high[k] <= 1.0 - GRAVE:
                            gone |= 1 << k
                            lost = True
                        place += 1
                if lost:
                    odds = e.probability / (1.0 - e.probability)  # stated, and so below 1
        fresh = gone & ~self.left_out
        if fresh != 0 and self.left_out == 0:
            self.decided = now
            self.odds = odds
        self.left_out |= gone
        self.stands = (self.left_out & ~named) == 0
        moves = fresh != 0
        for k in range(v.rotors):
            if (self.left_out & (1 << k)) != 0:
                seen[k] = 0.0
                low[k] = 0.0
            if seen[k] <= self.effectiveness[k] + MOVED:
                self.rises[k] = LASTS
            elif self.rises[k] >= LASTS:
                self.rises[k] = now
            moves = moves or self._is_due(k, seen[k], now)
        if not moves:
            return False
        for k in range(v.rotors):
            if seen[k] < self.effectiveness[k] or self._is_due(k, seen[k], now):
                self.effectiveness[k] = seen[k]
                self.lower[k] = low[k]
                self.upper[k] = high[k]
        self.changed = now
        self.revision += 1
        return True

    def factors(self, v: Vehicle, out: Reals) -> int:
        """Write the mixer for these rotors into out (rotors, 4), row by row: thrust of each for a unit of the rate controller's roll,
        pitch, yaw and throttle (`Vehicle.mixer`; of the wrench where that is not known); return what it can do, UNABLE to TURNS. It is
        E B' (B E^2 B')^-1 B M: the wrench of the healthy mixer M through the pseudo-inverse of the effectiveness B with the rotors' own E;
        without yaw where a rotor would have next to nothing to give in hover."""
        if self._inverse(v, True, out):
            return TURNS
        return LEVEL if self._inverse(v, False, out) else UNABLE

    def _is_due(self, k: int, seen: Real, now: Time) -> bool:
        """Whether a change of rotor k is to be passed on."""
        falls = seen < self.effectiveness[k] - MOVED
        rose = now - self.rises[k] >= RISES_S
        return (falls or rose) and now - self.changed >= REFRESH_S

    def _begin(self, start: Time) -> None:
        fresh = Reliance()
        fresh.flight = start
        fresh.revision = self.revision + 1
        copy(self, fresh)

    def _inverse(self, v: Vehicle, yaw: bool, out: Reals) -> bool:
        """Write the pseudo-inverse, where there is one; return whether every rotor that is not left out then has LEAST of the mean
        command in hover."""
        gram = local(REAL, 4, 4)
        back = local(REAL, 4, 4)
        total: Real = 0.0
        for a in range(4):
            for b in range(4):
                for k in range(v.rotors):
                    e = self.effectiveness[k]
                    gram[a][b] += v.effectiveness[a][k] * v.effectiveness[b][k] * e * e
                    back[a][b] += v.effectiveness[a][k] * v.mixer[k][b] if v.mixer_known else 0.0
            if not v.mixer_known:
                back[a][a] = 1.0
        if not yaw:
            for a in range(4):
                gram[a][YAW] = 0.0
                gram[YAW][a] = 0.0
                back[YAW][a] = 0.0
                back[a][YAW] = 0.0
            gram[YAW][YAW] = 1.0
        for a in range(4):  # Gauss and Jordan, without exchanges: the matrix is positive definite
            if gram[a][a] < SINGULAR:
                return False
            pivot = 1.0 / gram[a][a]
            for b in range(4):
                gram[a][b] *= pivot
                back[a][b] *= pivot
            for row in range(4):
                share = gram[row][a]
                if row != a:
                    for b in range(4):
                        gram[row][b] -= share * gram[a][b]
                        back[row][b] -= share * back[a][b]
        least: Real = LASTS
        for k in range(v.rotors):
            for b in range(4):
                out[4 * k + b] = 0.0
                for a in range(4):
                    out[4 * k + b] += self.effectiveness[k] * v.effectiveness[a][k] * back[a][b]
            total += out[4 * k + 3]
            if self.effectiveness[k] > 0.0:
                least = min(least, out[4 * k + 3])
        return least >= LEAST * total / real(v.rotors)
