"""PX4 ULog files, through pyulog. File format: https://docs.px4.io/main/en/dev_log/ulog_file_format.html"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message
from rotorwatch.logs import parameter_ranges, px4_reports, px4_topics, series, ulog_data
from rotorwatch.logs.parameter_ranges import is_parameter

FORMAT = "PX4 ULog"
ENDINGS = (".ulg",)

_MAGIC = b"ULog\x01\x12\x35"
_BUFFER = 1 << 18  # bytes
_CIRCLES = 1000  # times that a parser may return to an earlier position
_ENOUGH = 20  # samples of a topic that is logged all the time
_BEGINS_WITHIN_US = 30e6  # some topic after the header
_MOST_FIELDS = 20_000  # flattened; PX4's largest message has about 400


def sniff(head: bytes, name: str) -> bool:
    """True for a ULog header; never by name, a ULog without it cannot be read."""
    return head.startswith(_MAGIC)


def read(data, name: str, progress=None) -> Flight:
    """Read a ULog of any PX4 from 1.6 on. Times count from the log's own start time stamp.

    Raises LogError when the definitions are damaged or no topic of interest is left."""
    from pyulog import ULog

    log, damaged, cut = _whole(ULog, data, progress)
    tables = {(d.name, d.multi_id): d.data for d in log.data_list if d.name in (*px4_topics.TOPICS, *px4_topics.RAW)}
    start, notes = _start(log, tables)
    topics = px4_topics.Topics(tables, start)
    parameters, impossible = parameter_ranges.checked({k: float(v) for k, v in log.initial_parameters.items() if is_parameter(k, v)})
    signals, facts = px4_topics.signals(topics, parameters)
    warnings = [*notes, *impossible, *topics.notes]
    if damaged:
        warnings.insert(0, "parts of the log are damaged; what is intact was read")
    elif cut:
        warnings.insert(0, "the log ends in the middle of a record; everything before it was read")
    messages = px4_topics.messages(topics) + px4_reports.events(log, start) + _log_messages(log, start)
    end = series.end_of(signals)
    kind = px4_topics.MAV_TYPES.get(int(parameters.get("MAV_TYPE", 0)), ("", 0))[0]
    changed = ((t, k, v) for t, k, v in log.changed_parameters if is_parameter(k, v))
    return Flight(
        format=FORMAT,
        autopilot="PX4",
        signals=signals,
        duration=end,
        firmware=_firmware(log),
        vehicle_type=kind,
        parameters=parameters,
        parameter_changes=tuple((max(0.0, (int(t) - start) * 1e-6), k, float(v)) for t, k, v in changed),
        messages=tuple(sorted((m for m in messages if m.time <= end + 1), key=lambda m: m.time)),
        warnings=tuple(warnings),
        start_us=start,
        facts={**facts, **_board(log)},
    )


def _board(log) -> dict:
    """sys_uuid and ver_hw of the autopilot's board, where the log names them."""
    info = getattr(log, "msg_info_dict", {})
    texts = {key: info.get(key) for key in ("sys_uuid", "ver_hw")}
    return {key: text for key, text in texts.items() if isinstance(text, str) and text.strip("0 ")}


def _pyulog(ulog, file, **options):
    """(log, damaged): pyulog with its prints suppressed and its exceptions turned into a LogError."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            log = ulog(file, **options)
    except Exception as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise LogError(f"this {FORMAT} is too damaged to be read ({why})") from error
    return log, bool(log.file_corruption)


def _whole(ulog, data, progress):
    """(log, damaged, cut): all topics of interest. Of an intact log pyulog reads all but the data, and `ulog_data` that."""
    topics = [*px4_topics.TOPICS, px4_reports.EVENTS]
    data_messages = ulog_data.messages(data, topics, {px4_topics.SPEEDS: px4_topics.RAW})
    if data_messages is not None:
        _check_definitions(data_messages.formats)
        log, damaged = _pyulog(ulog, _File(data_messages.rest, progress), message_name_filter_list=[*topics, *px4_topics.RAW])
        if not damaged and data_messages.fill(log):
            return log, False, data_messages.cut
    else:
        header = _pyulog(ulog, _File(data), parse_header_only=True)[0]
        _check_definitions({name: kind.fields for name, kind in header.message_formats.items()})
    file = _File(data, progress)
    return *_pyulog(ulog, file, message_name_filter_list=topics), file.cut


def _check_definitions(formats: Mapping[str, Sequence[tuple[str, int, str]]]) -> None:
    """Refuse message definitions that are recursive or flatten to absurd sizes: only damage causes that. formats: name -> (type, count,
    name) of each field."""
    sizes: dict[str, int] = {}

    def size(name, depth=0):
        if depth > 10:
            raise LogError(f"this {FORMAT} has damaged message definitions and cannot be read")
        if name not in sizes:
            total = 0
            for kind, count, _ in formats[name]:
                total += max(1, count) * (size(kind, depth + 1) if kind in formats else 1)
            if total > _MOST_FIELDS:
                raise LogError(f"this {FORMAT} has damaged message definitions and cannot be read")
            sizes[name] = total
        return sizes[name]

    for name in formats:
        size(name)


def _start(log, tables) -> tuple[int, list[str]]:
    """(us of second 0, warnings): the header's time stamp, or the earliest data where the header's is impossible.

    Data begins within a second of the header; topics that are logged when they change may begin before or after it."""
    start, first = int(log.start_timestamp), []
    for table in tables.values():
        stamp = np.asarray(table.get("timestamp", ()), np.float64)
        if stamp.size >= _ENOUGH:
            first.append(int(stamp[series.steady(stamp * 1e-6)[0]]))
    if first and not any(abs(t - start) < _BEGINS_WITHIN_US for t in first):
        return min(first), ["the header's start time is damaged; times count from the earliest data"]
    return start, []


def _firmware(log) -> str:
    """Release ("v1.13.0"), else the first digits of the commit."""
    with contextlib.suppress(Exception):
        release = log.get_version_info_str()
        commit = str(log.msg_info_dict.get("ver_sw", ""))[:8]
        return f"PX4 {release or commit}".strip()
    return "PX4"


def _log_messages(log, start) -> list[Message]:
    """Texts and logging gaps."""
    texts = [*log.logged_messages, *(m for group in log.logged_messages_tagged.values() for m in group)]
    out = []
    for m in texts:
        severe = m.log_level in b"0123"
        out.append(Message(max(0.0, (int(m.timestamp) - start) * 1e-6), "error" if severe else "text", m.message.strip()))
    for gap in log.dropouts:
        seconds = gap.duration / 1000
        if seconds > 0:
            time = max(0.0, (int(gap.timestamp) - start) * 1e-6)
            out.append(Message(time, "dropout", f"logging gap of {gap.duration} ms", seconds))
    return out


class _File:
    """A read-only file over bytes without a copy, which ends for good when a parser runs in circles.

    At damage the parser goes back to one byte after its last position. A parser that repeatedly goes back to a position, or that seeks more
    often than once in eight bytes, is stuck. Then this file stays at its end. cut: a read got less than it requested."""

    def __init__(self, data, progress=None):
        self._size = len(data)
        self._file = io.BufferedReader(_Bytes(data, progress), _BUFFER)
        self._read, self.tell = self._file.read, self._file.tell
        self._left, self._circles, self._furthest = self._size // 8 + 50_000, _CIRCLES, 0
        self.cut = False

    def read(self, count=-1) -> bytes:
        block = self._read(count)
        if len(block) < count and (block or count != 3):
            self.cut = True
        return block

    def seek(self, offset, whence=0) -> int:
        self._left -= 1
        at = offset + (0, self.tell(), self._size)[whence]
        if at < 0:
            raise ValueError("seek before the start of the file")
        self._circles -= at <= self._furthest
        self._furthest = max(self._furthest, at)
        return self._file.seek(at if self._left >= 0 and self._circles >= 0 else max(at, self._size))

    def close(self) -> None:
        """The data belongs to the caller and stays open."""


class _Bytes(io.RawIOBase):
    """Bytes or a memory map as the file below a buffer. progress: counts from a half on."""

    def __init__(self, data, progress):
        self._data, self._at, self._progress = data, 0, progress

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        part = self._data[self._at : self._at + len(buffer)]
        buffer[: len(part)] = part
        self._at += len(part)
        if self._progress and self._at <= len(self._data):
            self._progress(0.5 + 0.5 * self._at / max(1, len(self._data)))
        return len(part)

    def seek(self, offset, whence=0) -> int:
        self._at = offset + (0, self._at, len(self._data))[whence]
        return self._at

    def tell(self) -> int:
        return self._at
