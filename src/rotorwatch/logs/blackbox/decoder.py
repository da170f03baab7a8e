"""Sessions of a Blackbox log as integer tables: runs the definition in `frames`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotorwatch.base.compiling.running import Definition
from rotorwatch.errors import LogError
from rotorwatch.logs import container
from rotorwatch.logs.blackbox import encodings, frame_sizes, frames, header
from rotorwatch.logs.blackbox.header import Header

FILES = [f"logs/blackbox/{name}.py" for name in ("encodings", "frames", "sizes")]
BLACKBOX = Definition("blackbox", (encodings, frames), frame_sizes, FILES)
CELLS, FEW = 1 << 21, 4096
"""Numbers of main frames, and rows of other frames, that are read before the buffers are emptied."""
MOST_CELLS = 200_000_000
"""Numbers of frames that are kept: 90 minutes of 35 fields at 1 kHz; of a small log fewer, by the limit of all that is packed."""


@dataclass(frozen=True)
class Table:
    """Frames of one kind. columns: name -> (n,) integers; before (n,): number of main frames before each."""

    columns: Mapping[str, np.ndarray]
    before: np.ndarray

    def __len__(self) -> int:
        return len(self.before)


class Session(NamedTuple):
    """A session. main, slow, gps: its frames; time (n,) of main frames, us, unwrapped. events (m, 5): main frames before, kind, time, and
    two numbers. corrupt: incomplete frames; orphans: P frames without an I frame before them; garbage: bytes between frames; ended: whether
    the firmware's end mark is there; cut: whether not all was read."""

    header: Header
    main: Table
    slow: Table
    gps: Table
    events: np.ndarray
    time: np.ndarray
    corrupt: int
    orphans: int
    garbage: int
    ended: bool
    cut: bool

    def clock(self, stamp: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Times (k,) us on the scale of `time`, from 32-bit stamps of the same clock after so many main frames."""
        if not self.time.size:
            return np.asarray(stamp, np.int64)
        near = np.clip(np.asarray(before) - 1, 0, self.time.size - 1)
        low = self.main.columns["time"][near].astype(np.uint32)
        return self.time[near] + (np.asarray(stamp).astype(np.uint32) - low).astype(np.int32)


def decode(
    data, start: int, end: int, progress: Callable[[float], None] | None = None, wanted: Callable[[str], bool] = lambda name: True
) -> Session:
    """The session whose header begins at byte `start`; it ends before `end`. wanted: whether a field of main frames is kept, besides
    time.

    Raises LogError where the header is too damaged, or no main frame is readable."""
    about = header.read(data, start, end)
    size = end - about.start
    raw = np.zeros(size + frame_sizes.PADDING, np.uint8)
    raw[:size] = np.frombuffer(data, np.uint8, size, about.start)
    stream = BLACKBOX.new(frames.Stream)
    header.fill(stream, about)
    stream.set(end=size)
    widths = [len(about.layouts[k].names) if k in about.layouts else 0 for k in "ISG"]
    room = max(min(CELLS // widths[0], size // 8), 64)
    main = np.zeros((room + 1, widths[0]), np.int32)  # a frame is decoded before it is validated
    slow, gps = (np.zeros((FEW + 1, width + 1), np.int32) for width in widths[1:])
    events = np.zeros((FEW + 1, frame_sizes.WIDTH), np.int32)
    chunks: list[list[np.ndarray]] = [[], [], [], []]
    names = about.layouts["I"].names
    used = np.array([k for k, name in enumerate(names) if name == "time" or wanted(name)])
    done, cells, first = False, 0, 0
    most = min(MOST_CELLS, container.most(size) // main.itemsize)
    while not done and cells < most:
        done = BLACKBOX.call(frames.decode, stream, raw, main, slow, gps, events, room, FEW)
        counts = [int(stream[name][0]) for name in ("rows", "slow_rows", "gps_rows", "event_rows")]
        for table, count, pieces in zip((main, slow, gps, events), counts, chunks):
            some = slice(first, count) if table is main else slice(count)
            pieces.append(table[some, used] if table is main and used.size < len(names) else table[some].copy())
        cells += sum(pieces[-1].size for pieces in chunks)
        # Keep the two last frames at the front: the next ones are coded as differences to them.
        two = [int(stream["before"][0]), int(stream["previous"][0])]
        main[:2], first = main[two].copy(), 2
        stream.set(rows=2, before=0, previous=1, slow_rows=0, gps_rows=0, event_rows=0)
        if progress:
            progress(float(stream["at"][0]) / max(size, 1))
    rows = [pieces[0] if len(pieces) == 1 else np.concatenate(pieces) for pieces in chunks]
    whole = _table(about, "I", used, rows[0], 0)
    slow_frames, gps_frames = (_table(about, kind, np.arange(table.shape[1] - 1), table, 1) for kind, table in zip("SG", rows[1:]))
    if not len(whole):
        raise LogError("the session holds no frames that can be read")
    corrupt, orphans, garbage = (int(stream[name][0]) for name in ("corrupt", "orphans", "garbage"))
    time, ended = _unwrapped(whole.columns["time"]), bool(stream["ended"][0])
    return Session(about, whole, slow_frames, gps_frames, rows[3], time, corrupt, orphans, garbage, ended, not done)


def _table(about: Header, kind: str, used: np.ndarray, rows: np.ndarray, prefix: int) -> Table:
    """used: fields in the rows; prefix: count of numbers before them."""
    if kind not in about.layouts:
        return Table({}, np.zeros(0, np.int32))
    layout = about.layouts[kind]
    columns = {
        layout.names[field]: rows[:, prefix + k] if layout.signed[field] else rows[:, prefix + k].view(np.uint32)
        for k, field in enumerate(used)
    }
    return Table(columns, rows[:, 0] if prefix else np.arange(len(rows)))


def _unwrapped(stamps: np.ndarray) -> np.ndarray:
    """(n,) int64 us: an unwrapped 32-bit clock."""
    steps = np.diff(stamps.astype(np.uint32)).astype(np.int32)  # of unsigned numbers, modulo 2^32
    first = int(stamps[:1].astype(np.uint32)[0]) if stamps.size else 0
    return first + np.r_[0, np.cumsum(steps, dtype=np.int64)][: stamps.size]
