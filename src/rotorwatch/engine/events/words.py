"""Text of an event for the pilot, as a MAVLink STATUSTEXT, and its severity. Texts count rotors from 1."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import LASTS, LETTER, Real, Small, Struct, array
from rotorwatch.engine.events.decisions import GRAVE, MATTERS, WORN
from rotorwatch.engine.events.events import CONTACT, LOSS, OUTPUT_OVERRIDE, TURNED_MOUNT, Event
from rotorwatch.engine.intake.deviations import OVERRIDDEN
from rotorwatch.engine.intake.sizes import ROTORS, TOGETHER

CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY

MOST = 50  # characters of a STATUSTEXT
_ROOM = 70  # characters of the buffer; longer than MOST, so that a text is only cut at its end


class Words(Struct):
    """Buffer of a zero-terminated text."""

    at = array(LETTER, 71)
    length: Small = 0

    def event(self, e: Event, withdrawn: bool, what: str) -> None:
        """Write the text of an event. what: description of an event that is not a loss."""
        self._add("rotorwatch: ")
        many = _several(e.rotors)
        over = e.kind != CONTACT and e.end < LASTS
        if e.rotors != 0:
            self._add("rotors " if many else "rotor ")
            self._rotors(e.rotors)
            self._add(" ")
        if e.kind == LOSS and e.size > 0.0:
            self._add("stuck at ")
            self._times(e.size)
            self._add("x hover")
        elif e.kind == LOSS:
            self._add("lost ")
            place = 0
            for k in range(ROTORS):
                if (e.rotors & (1 << k)) != 0 and place < TOGETHER:
                    if place > 0:
                        self._add("/")
                    self._percent(e.loss[place])
                    place += 1
            self._add(" %")
            if not many:
                self._add(" (")
                self._percent(e.lower[0])
                self._add("-")
                self._percent(e.upper[0])
                self._add(")")
        else:
            self._add(what)
        if withdrawn:
            self._add(" withdrawn")
        elif over:
            self._add(" is over")
        elif e.alternative_count > 0 and e.kind != CONTACT:
            others = Words()
            for i in range(e.alternative_count):
                others._add("," if i > 0 else " or ")
                others._rotors(e.alternatives[i])
            if self.length + others.length <= MOST:
                for i in range(others.length):
                    self.at[self.length] = others.at[i]
                    self.length += 1
            else:
                self._add(" or others")
        self.length = min(self.length, MOST)
        self.at[self.length] = 0

    def _add(self, more: str) -> None:
        for i in range(len(more)):
            if self.length < _ROOM:
                self.at[self.length] = ord(more[i])
                self.length += 1

    def _number(self, value: int) -> None:
        """Append a number below 1000."""
        for i in range(3):
            left = value if i == 2 else value // 10 if i == 1 else value // 100
            if (left > 0 or i == 2) and self.length < _ROOM:
                self.at[self.length] = 48 + left % 10
                self.length += 1

    def _percent(self, share: Real) -> None:
        """Append a share, 0 to 1, in percent."""
        self._number(int(100.0 * min(max(share, 0.0), 1.0) + 0.5))

    def _times(self, factor: Real) -> None:
        """Append a factor, with one decimal below 10 (2.1), else without (14)."""
        tenths = int(10.0 * min(max(factor, 0.0), 999.0) + 0.5)
        if tenths >= 100:
            self._number((tenths + 5) // 10)
        else:
            self._number(tenths // 10)
            self._add(".")
            self._number(tenths % 10)

    def _rotors(self, rotors: int) -> None:
        """Append a set of rotors, as 1+3."""
        more = False
        for k in range(ROTORS):
            if (rotors & (1 << k)) != 0:
                if more:
                    self._add("+")
                self._number(k + 1)
                more = True


def severity(e: Event, withdrawn: bool) -> int:
    """MAV_SEVERITY of an event. CRITICAL: a loss of GRAVE or more, a stuck rotor, or an output that is STUCK or OFF. WARNING: such an event
    with alternative sets of rotors, a loss of MATTERS or more, an OVERRIDDEN output, or a turned mount. NOTICE: a smaller loss, or a
    contact. INFO: an event that is over or withdrawn, or a loss below WORN."""
    if withdrawn or (e.kind != CONTACT and e.end < LASTS):
        return INFO
    if e.kind == CONTACT:
        return NOTICE
    if e.kind == LOSS and e.size <= 0.0 and e.largest() < GRAVE:
        return WARNING if e.largest() >= MATTERS else NOTICE if e.largest() >= WORN else INFO
    if e.alternative_count > 0 or e.kind == TURNED_MOUNT or (e.kind == OUTPUT_OVERRIDE and e.detail == OVERRIDDEN):
        return WARNING
    return CRITICAL


def _several(rotors: int) -> bool:
    return (rotors & (rotors - 1)) != 0
