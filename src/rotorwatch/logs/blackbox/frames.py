"""Frames of a Blackbox log, as a definition (`compiling.structs`): bytes in, rows of integers out.

A session's header lists for each kind of frame its fields, their encodings and their predictors. I frames stand alone; P frames hold the
difference to a prediction from the frames before. S: slow-changing states, G: GPS, H: its home, E: events.

A frame has neither a length nor a checksum. So a frame is valid if another begins where it ends, or the log ends there. After an invalid
one, or garbage, P frames are unusable until the next I frame.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import INT, Bytes, Ints, Struct, array, difference32, sum32
from rotorwatch.logs.blackbox.encodings import (
    NEG_14BIT,
    NOTHING,
    SIGNED_VB,
    TAG2_3S32,
    TAG2_3SVARIABLE,
    TAG8_4S16,
    TAG8_8SVB,
    UNSIGNED_VB,
    elias,
    neg_14bit,
    signed_vb,
    tag2_3s32,
    tag2_3svariable,
    tag8_4s16,
    tag8_4s16_v1,
    tag8_8svb,
    unsigned_vb,
)
from rotorwatch.logs.blackbox.frame_sizes import CYCLE, FIELDS, WIDTH

INTRA, INTER, SLOW, GPS, HOME = 0, 1, 2, 3, 4
_I, _P, _S, _G, _H, _E = 73, 80, 83, 71, 72, 69

ZERO, PREVIOUS, STRAIGHT_LINE, AVERAGE_2, MINTHROTTLE, MOTOR_0 = 0, 1, 2, 3, 4, 5
INCREMENT, HOME_COORDINATE, FIFTEEN_HUNDRED, VBATREF, LAST_TIME, MINMOTOR = 6, 7, 8, 9, 10, 11

SYNC_BEEP, ADJUSTMENT, RESUME, DISARM, MODES, IMU_FAILURE, LOG_END = 0, 13, 14, 15, 30, 40, 255

_LONGEST = 1024  # bytes of a frame; real ones have some 30, INAV's I frames up to 300
_LONGEST_GAP_US = 10000000  # of the main frames; a longer one is accepted when two I frames agree about it
_END = (69, 110, 100, 32, 111, 102, 32, 108, 111, 103, 0)  # End of log


class Layout(Struct):
    """Encoding of one kind of frame."""

    fields: int = 0  # 0: the header does not define it
    encoding = array(INT, FIELDS)  # of each field
    runs: int = 0  # neighbours that are read in one go: each from a field up to, but not with, another
    run_from = array(INT, FIELDS)
    run_to = array(INT, FIELDS)
    steps: int = 0  # neighbours for which the same is predicted
    predictor = array(INT, FIELDS)
    step_from = array(INT, FIELDS)
    step_to = array(INT, FIELDS)


class Stream(Struct):
    """A session: what its header says, how far it has been read, and what was damaged."""

    layouts = array(Layout, 5)
    version: int = 2
    time: int = 1  # fields of main frames
    motor: int = 0
    minthrottle: int = 0
    motor_low: int = 0
    vbatref: int = 0
    cycle: int = 1  # loops between two I frames
    skip = array(INT, CYCLE)  # loops from one frame to the next

    at: int = 0
    end: int = 0
    synced: bool = False  # whether P frames can be understood
    rows: int = 0  # in the buffer of main frames, of which the two last ones are
    previous: int = 0
    before: int = 0
    slow_rows: int = 0
    gps_rows: int = 0
    event_rows: int = 0

    frames: int = 0  # main frames in all
    last: int = 0  # time of the last one, us
    doubted: int = 0  # time of an I frame that did not fit
    known: bool = False
    doubtful: bool = False
    ended: bool = False  # the end that the firmware writes was there
    corrupt: int = 0  # frames
    orphans: int = 0  # P frames without an I frame
    garbage: int = 0  # bytes between frames
    home = array(INT, FIELDS)


def decode(s: Stream, data: Bytes, main: Ints, slow: Ints, gps: Ints, events: Ints, room: int, few: int) -> bool:
    """Read on until the session ends (True) or one of the buffers is full (False).

    main: rows of as many numbers as I frames have fields, up to `room` of them. slow, gps: likewise, with the number of main frames before
    them in front, up to `few`. events: rows of `WIDTH`."""
    while s.at < s.end:
        if s.rows >= room or s.slow_rows >= few or s.gps_rows >= few or s.event_rows >= few:
            return False
        marker = data[s.at]
        at = s.at + 1
        place = 0
        if marker == _P:
            place = s.rows * s.layouts[INTRA].fields
            at = _fields(s.layouts[INTER], s.version, data, at, main, place)
        elif marker == _I:
            place = s.rows * s.layouts[INTRA].fields
            at = _fields(s.layouts[INTRA], s.version, data, at, main, place)
        elif marker == _S:
            place = s.slow_rows * (s.layouts[SLOW].fields + 1) + 1
            at = _fields(s.layouts[SLOW], s.version, data, at, slow, place)
        elif marker == _G:
            place = s.gps_rows * (s.layouts[GPS].fields + 1) + 1
            at = _fields(s.layouts[GPS], s.version, data, at, gps, place)
        elif marker == _H:
            at = _fields(s.layouts[HOME], s.version, data, at, s.home, 0)
        elif marker == _E:
            place = s.event_rows * WIDTH
            at = _event(s, data, at, events, place)
        else:
            s.synced = False
            s.garbage += 1
            s.at += 1
            continue
        if at == 0 or at > s.end or at - s.at > _LONGEST or not (at == s.end or _begins(data[at])):
            # Its length is unreliable, too: the next frame may begin within it.
            s.synced = False
            s.corrupt += 1
            s.at += 1
            continue
        s.at = at
        if marker == _P:
            _inter(s, main)
        elif marker == _I:
            _intra(s, main)
        elif marker == _S:
            slow[place - 1] = s.frames
            _predict(s, s.layouts[SLOW], slow, place, -1, -1)
            s.slow_rows += 1
        elif marker == _G:
            gps[place - 1] = s.frames
            _predict(s, s.layouts[GPS], gps, place, -1, -1)
            s.gps_rows += 1
        elif marker == _H:
            _predict(s, s.layouts[HOME], s.home, 0, -1, -1)
        else:
            s.event_rows += 1
            if events[place + 1] == LOG_END:
                s.ended = True
                s.end = at
            elif events[place + 1] == RESUME:
                s.last = events[place + 2]
    return True


def _begins(byte: int) -> bool:
    """True if a frame begins with it."""
    return byte == _P or byte == _I or byte == _S or byte == _G or byte == _E or byte == _H


def _fields(layout: Layout, version: int, data: Bytes, at: int, out: Ints, place: int) -> int:
    """The fields of a frame as they are written; returns where it ends, 0 for frames that the header does not define."""
    bit = 0
    if layout.fields == 0:
        return 0
    for run in range(layout.runs):
        start = layout.run_from[run]
        how = layout.encoding[start]
        first = place + start
        last = place + layout.run_to[run]
        if how == SIGNED_VB:
            at = signed_vb(data, at, out, first, last)
        elif how == UNSIGNED_VB:
            at = unsigned_vb(data, at, out, first, last)
        elif how == TAG2_3S32:
            at = tag2_3s32(data, at, out, first)
        elif how == TAG8_4S16 and version > 1:
            at = tag8_4s16(data, at, out, first)
        elif how == TAG8_4S16:
            at = tag8_4s16_v1(data, at, out, first)
        elif how == TAG8_8SVB:
            at = tag8_8svb(data, at, out, first, last)
        elif how == NEG_14BIT:
            at = neg_14bit(data, at, out, first, last)
        elif how == TAG2_3SVARIABLE:
            at = tag2_3svariable(data, at, out, first)
        elif how == NOTHING:
            for i in range(first, last):
                out[i] = 0
        else:
            bit = 8 * at
            for i in range(first, last):
                bit = elias(data, bit, out, i, layout.encoding[i - place])
            at = bit + 7 >> 3
    return at


def _intra(s: Stream, main: Ints) -> None:
    """An I frame that is whole: keep it, if its time can be."""
    layout = s.layouts[INTRA]
    place = s.rows * layout.fields
    _predict(s, layout, main, place, s.previous * layout.fields if s.synced else -1, -1)
    time = main[place + s.time]
    if s.known and not _follows(time, s.last) and not (s.doubtful and _follows(time, s.doubted)):
        s.synced = False
        s.doubtful = True
        s.doubted = time
        return
    s.previous = s.rows
    s.before = s.rows
    _keep(s, time)


def _inter(s: Stream, main: Ints) -> None:
    """A P frame that is whole."""
    layout = s.layouts[INTRA]
    place = s.rows * layout.fields
    if not s.synced:
        s.orphans += 1
        return
    _predict(s, s.layouts[INTER], main, place, s.previous * layout.fields, s.before * layout.fields)
    time = main[place + s.time]
    if not _follows(time, s.last):
        s.synced = False
        s.orphans += 1
        return
    s.before = s.previous
    s.previous = s.rows
    _keep(s, time)


def _keep(s: Stream, time: int) -> None:
    s.rows += 1
    s.frames += 1
    s.last = time
    s.synced = True
    s.known = True
    s.doubtful = False


def _follows(time: int, last: int) -> bool:
    """True if a main frame can come after another; their clocks begin again after 71 minutes."""
    return 0 <= difference32(time, last) < _LONGEST_GAP_US


def _predict(s: Stream, layout: Layout, out: Ints, place: int, previous: int, before: int) -> None:
    """Add what is predicted to the fields of a frame. previous, before: places of the frames before it, -1: not to be used."""
    for step in range(layout.steps):
        what = layout.predictor[step]
        first = layout.step_from[step]
        last = layout.step_to[step]
        if what == AVERAGE_2 and before >= 0:
            for i in range(first, last):
                both = sum32(out[previous + i], out[before + i])
                out[place + i] = sum32(out[place + i], both - (both >> 31) >> 1)  # towards 0, as C divides
        elif what == PREVIOUS or what == AVERAGE_2:
            if previous >= 0:
                for i in range(first, last):
                    out[place + i] = sum32(out[place + i], out[previous + i])
        elif what == STRAIGHT_LINE:
            if before >= 0:
                for i in range(first, last):
                    slope = difference32(out[previous + i], out[before + i])
                    out[place + i] = sum32(out[place + i], sum32(out[previous + i], slope))
        elif what == INCREMENT:
            for i in range(first, last):
                out[place + i] = 1
                if previous >= 0:
                    loop = out[previous + i]
                    out[place + i] = sum32(loop, s.skip[(loop & 0x7FFFFFFF) % s.cycle])
        elif what == HOME_COORDINATE:
            for i in range(first, last):
                out[place + i] = sum32(out[place + i], s.home[i - first])
        else:
            offset = 0
            if what == MINTHROTTLE:
                offset = s.minthrottle
            elif what == MINMOTOR:
                offset = s.motor_low
            elif what == MOTOR_0:
                offset = out[place + s.motor]
            elif what == FIFTEEN_HUNDRED:
                offset = 1500
            elif what == VBATREF:
                offset = s.vbatref
            elif what == LAST_TIME:
                offset = s.last
            for i in range(first, last):
                out[place + i] = sum32(out[place + i], offset)


def _event(s: Stream, data: Bytes, at: int, out: Ints, place: int) -> int:
    """An event; returns where it ends, 0 where it is of no known kind."""
    kind = data[at]
    at += 1
    out[place] = s.frames
    out[place + 1] = kind
    out[place + 2] = s.last
    out[place + 3] = 0
    out[place + 4] = 0
    if kind == SYNC_BEEP:
        return unsigned_vb(data, at, out, place + 2, place + 3)
    if kind == ADJUSTMENT:
        out[place + 3] = data[at]
        at += 1
        if data[at - 1] < 128:
            return signed_vb(data, at, out, place + 4, place + 5)
        return at + 4  # a float
    if kind == RESUME:
        at = unsigned_vb(data, at, out, place + 3, place + 4)
        return unsigned_vb(data, at, out, place + 2, place + 3)
    if kind == DISARM or kind == IMU_FAILURE:
        return unsigned_vb(data, at, out, place + 3, place + 4)
    if kind == MODES:
        return unsigned_vb(data, at, out, place + 3, place + 5)
    if kind == LOG_END:
        for k in range(11):
            if data[at + k] != int(_END[k]):
                return 0
        s.end = at + 11  # what follows is no frame
        return at + 11
    return 0
