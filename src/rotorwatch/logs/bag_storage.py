"""Storage of ROS 2 bags: MCAP files and SQLite databases (.db3), read as topics with their messages' bytes.

MCAP: https://mcap.dev/spec. SQLite: tables topics, messages and, since ROS 2 Iron, message_definitions.
"""

from __future__ import annotations

import io
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rotorwatch.base import incoming, optional
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.logs import container

MCAP = b"\x89MCAP0\r\n"
SQLITE = b"SQLite format 3\0"
IN_MEMORY = hasattr(sqlite3.Connection, "deserialize")  # from Python 3.11 on
ZSTD = b"\x28\xb5\x2f\xfd"
NEEDED_BY = "Reading this bag"
PROGRESS_EVERY = 2000  # messages between two reports of progress
KEPT = 128  # bytes of overhead per message
LARGEST = 1 << 24  # bytes of a message that is wanted
CHANNEL, MESSAGE, SCHEMA = 4, 5, 3  # records of MCAP
MESSAGE_HEAD = struct.Struct("<HIQQ")
# Of SQLite: bytes of a value; virtual machine steps between checks for signals, and in all, per byte of the file and besides: a row
# takes ten or so.
VALUE, STEPS, STEPS_A_BYTE, STEPS_BESIDES = 1 << 26, 10_000, 10, 10_000_000
PLAIN = ("topics", "messages", "message_definitions")


@dataclass
class Topic:
    """A topic. kind: `package/msg/Type`; definition: its text, empty where the bag has none. stamps: ns, of receipt."""

    name: str
    kind: str
    definition: str = ""
    stamps: list[int] = field(default_factory=list)
    payloads: list[bytes] = field(default_factory=list)


@dataclass
class Bag:
    """The wanted topics, by name; others: name -> type of the rest, or of topics that are not ROS 2's; notes: sentences on damage. most:
    limit in bytes of its messages, unpacked, and of a single unpacking."""

    wanted: Callable[[str, str], bool]
    most: int
    topics: dict[str, Topic] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    held: int = 0

    def topic(self, name: str, kind: str, definition: str) -> Topic | None:
        """The topic for messages of that name; None for an unwanted one."""
        if not self.wanted(name, kind):
            self.others[name] = kind
            return None
        entry = self.topics.setdefault(name, Topic(name, kind))
        entry.definition = entry.definition or definition
        return entry

    def add(self, topic: Topic, stamp: int, data: bytes) -> None:
        """Add a message. Raises LogError where all messages together are more than a bag of this size can hold."""
        if data[:4] == ZSTD:  # rosbag2's compression of each message
            data = _message(data)
        self.held += len(data) + KEPT
        if self.held > self.most:
            raise container.too_much(self.most)
        topic.stamps.append(stamp)
        topic.payloads.append(data)


def _message(data: bytes) -> bytes:
    try:
        return _zstd(data, LARGEST)
    except ConfigError:
        raise
    except Exception:  # any error of a decompressor on damage
        return b""


def _zstd(data: bytes, most: int) -> bytes:
    """Decompress. Raises ValueError where the declared size is larger than `most`, and the decompressor's errors."""
    zstandard = optional.library("zstandard", NEEDED_BY)
    if zstandard.frame_content_size(data) > most:  # the decompressor would allocate the declared size
        raise ValueError("more than it can be")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=most)


def _unpacked(chunk, most: int) -> bytes:
    """The records in a chunk. Raises LogError where they are more than `most` bytes, and any other error on damage."""
    size = chunk.uncompressed_size
    if size > most:
        raise container.too_much(most)
    data = chunk.data
    if chunk.compression == "zstd":
        data = _zstd(data, size)
    elif chunk.compression == "lz4":
        lz4 = optional.library("lz4.frame", NEEDED_BY)
        data = lz4.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if len(data) > size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise ValueError("not what was packed")
    return data


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(kind, first byte, byte after the last) of the records in a chunk. Raises struct.error or ValueError on damage."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<BQ", data, at)
        at += 9
        if at + size > len(data):
            raise ValueError("a record that is longer than its chunk")
        yield kind, at, at + size
        at += size


def read_mcap(data, bag: Bag, progress=None) -> None:
    """Put the messages of an MCAP file, bytes or a memory map, into the bag.

    Its index is not used: it is at the end of the file, which an interrupted recording lacks."""
    records = optional.library("mcap.records", NEEDED_BY)
    reader = optional.library("mcap.stream_reader", NEEDED_BY)
    source = optional.library("mcap.data_stream", NEEDED_BY)
    stream = data if hasattr(data, "seek") else io.BytesIO(data)
    stream.seek(0)
    schemas: dict[int, tuple[str, str, str]] = {}
    channels: dict[int, Topic | None] = {}
    valid_records, lost, unfolded = 0, 0, 0

    def put(channel: int, stamp: int, data: bytes) -> None:
        topic = channels.get(channel)
        if topic is not None:
            bag.add(topic, stamp, data)

    def take(record) -> None:
        if isinstance(record, records.Schema):
            schemas[record.id] = record.name, record.encoding, record.data.decode("utf-8", "replace")
        elif isinstance(record, records.Channel):
            kind, encoding, text = schemas.get(record.schema_id, ("", "", ""))
            if record.message_encoding != "cdr":
                bag.others[record.topic] = kind
                channels[record.id] = None
            else:
                channels[record.id] = bag.topic(record.topic, kind, text if encoding == "ros2msg" else "")
        elif isinstance(record, records.Message):
            put(record.channel_id, record.log_time, record.data)

    def take_inside(inside: bytes) -> None:
        for kind, start, end in _records(inside):
            if kind == MESSAGE:
                channel, _, stamp, _ = MESSAGE_HEAD.unpack_from(inside, start)
                if channels.get(channel) is not None:
                    put(channel, stamp, inside[start + MESSAGE_HEAD.size : end])
            elif kind in (CHANNEL, SCHEMA):
                of = records.Channel if kind == CHANNEL else records.Schema
                take(of.read(source.ReadDataStream(io.BytesIO(inside[start:end]))))

    try:
        for record in reader.StreamReader(stream, emit_chunks=True, record_size_limit=len(data)).records:
            if isinstance(record, records.DataEnd):
                break
            valid_records += 1
            if not isinstance(record, records.Chunk):
                take(record)
                continue
            try:
                unfolded += record.uncompressed_size
                if unfolded > incoming.MOST:
                    raise container.too_much(incoming.MOST)
                inside = b""  # free the last chunk first
                inside = _unpacked(record, bag.most)
                for _ in _records(inside):  # a damaged chunk is left out as a whole
                    pass
                take_inside(inside)
            except (ConfigError, LogError):
                raise
            except Exception:  # any error of a decompressor or a parser on damage
                lost += 1
                continue
            if progress:
                progress(min(0.9, 0.9 * stream.tell() / max(1, len(data))))
    except (ConfigError, LogError):
        raise
    except Exception:
        if not valid_records:
            raise LogError("this MCAP file is too damaged to be read") from None
        bag.notes.append("the MCAP file is cut off or damaged; what comes before that place was read")
    if lost:
        bag.notes.append(f"{lost} chunk{'s' if lost > 1 else ''} of the MCAP file {'are' if lost > 1 else 'is'} damaged and skipped")


class _Database:
    """An untrusted database of so many bytes: only plain tables are read, nothing in it is executed, and signals are let through."""

    def __init__(self, base: sqlite3.Connection, size: int):
        self._base, self._left = base, STEPS_BESIDES + STEPS_A_BYTE * size
        self._why: BaseException | None = None
        base.text_factory = lambda text: text.decode("utf-8", "replace")
        if hasattr(base, "setlimit"):  # from Python 3.11 on
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, VALUE)
        base.execute("PRAGMA trusted_schema=OFF")
        base.execute("PRAGMA query_only=ON")
        base.set_authorizer(self._allows)
        self._asked = self._stops()
        next(self._asked)
        base.set_progress_handler(self._asked.__next__, STEPS)

    @staticmethod
    def _allows(action: int, one: str | None, other: str | None, base: str | None, view: str | None) -> int:
        """SQLite authorizer for a statement being prepared: reading the three tables, and not by way of a view."""
        read = action == sqlite3.SQLITE_READ and one in (*PLAIN, "sqlite_master")
        known = action == sqlite3.SQLITE_PRAGMA and one == "table_xinfo"
        counted = action == sqlite3.SQLITE_FUNCTION and other == "max"
        fine = view is None and (action == sqlite3.SQLITE_SELECT or read or known or counted)
        return sqlite3.SQLITE_OK if fine else sqlite3.SQLITE_DENY

    def _stops(self) -> Iterator[bool]:
        """True to stop, for SQLite's progress handler. SQLite swallows exceptions raised here; signals raise where this waits, inside
        the try."""
        while True:
            try:
                yield self._why is not None
                self._left -= STEPS
                if self._left < 0:
                    raise LogError("this database takes too long to read for its size; it is damaged or malicious")
            except GeneratorExit:
                return
            except BaseException as why:
                self._why = why

    def rows(self, query: str) -> Iterator:
        """Rows of a query. Raises sqlite3.Error, LogError where it takes too long, and exceptions of signals."""
        try:
            yield from self._base.execute(query)
        except sqlite3.Error as error:
            if self._why is not None:
                raise self._why from None
            if str(error) == "interrupted":
                raise KeyboardInterrupt from None
            raise

    def there(self, table: str) -> bool:
        """True if this is a table whose columns are all stored, not computed."""
        try:
            columns = list(self.rows(f"PRAGMA table_xinfo({table})"))
            kind = list(self.rows(f"SELECT type FROM sqlite_master WHERE name = '{table}' AND rootpage > 0"))
        except sqlite3.Error:
            return False
        return kind == [("table",)] and not any(column[-1] for column in columns)


@contextmanager
def _opened(source: Path | bytes) -> Iterator[_Database]:
    """The database in a file, or in these bytes."""
    with ExitStack() as stack:
        place: Any = source
        if not isinstance(source, Path) and not IN_MEMORY:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rotorwatch-"))) / "bag.db3"
            place.write_bytes(source)
        if isinstance(place, Path):
            base, size = (sqlite3.connect(f"{place.resolve().as_uri()}?mode=ro&immutable=1", uri=True), place.stat().st_size)
        else:
            base, size = sqlite3.connect(":memory:"), len(place)
            base.deserialize(place)
        stack.enter_context(closing(base))
        yield _Database(base, size)


def read_sqlite(source: Path | bytes, bag: Bag, progress=None) -> None:
    """Put the messages of a .db3 file, a path or its bytes, into the bag."""
    with _opened(source) as base:
        if not base.there("topics") or not base.there("messages"):
            raise LogError("this database is not a ROS 2 bag, or is too damaged to be read")
        definitions: dict[Any, Any] = {}
        if base.there("message_definitions"):
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
            with suppress(sqlite3.Error):
                definitions = dict(base.rows(query))
        topics: dict[int, Topic] = {}
        try:
            for number, name, kind, encoding in base.rows("SELECT id, name, type, serialization_format FROM topics"):
                if encoding != "cdr":
                    bag.others[str(name)] = str(kind)
                elif (topic := bag.topic(str(name), str(kind), str(definitions.get(kind, "")))) is not None:
                    topics[int(number)] = topic
        except (sqlite3.Error, TypeError, ValueError) as error:
            raise LogError("this database is not a ROS 2 bag, or is too damaged to be read") from error
        wanted_ids = ",".join(map(str, topics))
        done = 0
        try:
            most = next(base.rows("SELECT max(rowid) FROM messages"))[0] or 1
            for row, number, stamp, data in base.rows(
                f"SELECT rowid, topic_id, timestamp, data FROM messages WHERE topic_id IN ({wanted_ids}) ORDER BY rowid"
            ):
                if isinstance(data, bytes) and isinstance(stamp, int):
                    bag.add(topics[number], stamp, data)
                done += 1
                if progress and done % PROGRESS_EVERY == 0:
                    progress(min(0.9, 0.9 * row / most))
        except sqlite3.Error:
            bag.notes.append("the database is damaged; what could be read of it was read")
