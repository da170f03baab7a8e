"""How a ROS 2 bag is stored: MCAP files and SQLite databases (.db3), as topics with their messages' bytes.

MCAP: https://mcap.dev/spec. SQLite: tables topics, messages and, since ROS 2 Iron, message_definitions.
"""

from __future__ import annotations

import io
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rotorwatch.base import optional
from rotorwatch.errors import ConfigError, LogError

MCAP = b"\x89MCAP0\r\n"
SQLITE = b"SQLite format 3\0"
IN_MEMORY = hasattr(sqlite3.Connection, "deserialize")  # from Python 3.11 on
ZSTD = b"\x28\xb5\x2f\xfd"
NEEDED_BY = "Reading this bag"
PROGRESS_EVERY = 2000  # messages between two reports of progress


@dataclass
class Topic:
    """One topic. kind: `package/msg/Type`; definition: its text, empty where the bag has none. stamps: ns, of receipt."""

    name: str
    kind: str
    definition: str = ""
    stamps: list[int] = field(default_factory=list)
    payloads: list[bytes] = field(default_factory=list)


@dataclass
class Bag:
    """The wanted topics, by name; others: name -> type of those that were not, or are not ROS 2's; notes: what was damaged."""

    wanted: Callable[[str, str], bool]
    topics: dict[str, Topic] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    packed: int = 0

    def topic(self, name: str, kind: str, definition: str) -> Topic | None:
        """The topic to put messages into; None for one that is not wanted."""
        if not self.wanted(name, kind):
            self.others[name] = kind
            return None
        found = self.topics.setdefault(name, Topic(name, kind))
        found.definition = found.definition or definition
        return found

    def add(self, topic: Topic, stamp: int, data: bytes) -> None:
        if data[:4] == ZSTD:  # rosbag2's compression of each message
            data = _unpacked(data)
        topic.stamps.append(stamp)
        topic.payloads.append(data)


def _unpacked(data: bytes) -> bytes:
    zstandard = optional.library("zstandard", NEEDED_BY)
    try:
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=1 << 24)
    except zstandard.ZstdError:
        return b""


def read_mcap(data, bag: Bag, progress=None) -> None:
    """Put the messages of an MCAP file, bytes or a memory map, into the bag.

    Its index is not used: it is the end of the file, which a recording that was interrupted does not have.
    """
    records = optional.library("mcap.records", NEEDED_BY)
    reader = optional.library("mcap.stream_reader", NEEDED_BY)
    stream = data if hasattr(data, "seek") else io.BytesIO(data)
    stream.seek(0)
    schemas: dict[int, tuple[str, str, str]] = {}
    channels: dict[int, Topic | None] = {}
    found, lost = 0, 0

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
            topic = channels.get(record.channel_id)
            if topic is not None:
                bag.add(topic, record.log_time, record.data)

    try:
        for record in reader.StreamReader(stream, emit_chunks=True, record_size_limit=len(data)).records:
            if isinstance(record, records.DataEnd):
                break
            found += 1
            if not isinstance(record, records.Chunk):
                take(record)
                continue
            try:
                inside = reader.breakup_chunk(record, validate_crc=True)
            except Exception:  # whatever a decompressor or a parser makes of damage
                lost += 1
                continue
            for one in inside:
                take(one)
            if progress:
                progress(min(0.9, 0.9 * stream.tell() / max(1, len(data))))
    except ConfigError:
        raise
    except Exception:
        if not found:
            raise LogError("this MCAP file is too damaged to be read") from None
        bag.notes.append("the MCAP file is cut off or damaged; what comes before that place was read")
    if lost:
        bag.notes.append(
            f"{lost} chunk{'s' if lost > 1 else ''} of the MCAP file {'are' if lost > 1 else 'is'} damaged and left out"
        )


@contextmanager
def _opened(source: Path | bytes) -> Iterator[sqlite3.Connection]:
    """The database in a file, or in these bytes."""
    with ExitStack() as stack:
        place: Any = source
        if not isinstance(source, Path) and not IN_MEMORY:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rotorwatch-"))) / "bag.db3"
            place.write_bytes(source)
        if isinstance(place, Path):
            base = sqlite3.connect(f"{place.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        else:
            base = sqlite3.connect(":memory:")
            base.deserialize(place)
        stack.enter_context(closing(base))
        base.text_factory = lambda text: text.decode("utf-8", "replace")
        yield base


def read_sqlite(source: Path | bytes, bag: Bag, progress=None) -> None:
    """Put the messages of a .db3 file, a path or its bytes, into the bag."""
    with _opened(source) as base:
        definitions = dict(
            _rows(
                base,
                "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'",
            )
        )
        topics: dict[int, Topic] = {}
        try:
            for number, name, kind, encoding in base.execute("SELECT id, name, type, serialization_format FROM topics"):
                if encoding != "cdr":
                    bag.others[str(name)] = str(kind)
                elif (topic := bag.topic(str(name), str(kind), str(definitions.get(kind, "")))) is not None:
                    topics[int(number)] = topic
        except (sqlite3.Error, TypeError, ValueError) as error:
            raise LogError("this database is no ROS 2 bag, or too damaged to be read") from error
        most = next(_rows(base, "SELECT max(rowid) FROM messages"), (None,))[0] or 1
        wanted_ids = ",".join(map(str, topics))
        done = 0
        try:
            for row, number, stamp, data in base.execute(
                f"SELECT rowid, topic_id, timestamp, data FROM messages WHERE topic_id IN ({wanted_ids}) ORDER BY rowid"
            ):
                if isinstance(data, bytes) and isinstance(stamp, int):
                    bag.add(topics[number], stamp, data)
                done += 1
                if progress and done % PROGRESS_EVERY == 0:
                    progress(min(0.9, 0.9 * row / most))
        except sqlite3.Error:
            bag.notes.append("the database is damaged; what could be read of it was read")


def _rows(base: sqlite3.Connection, query: str) -> Iterator:
    """The rows of a query; none where the table is not there or damaged."""
    try:
        yield from base.execute(query)
    except sqlite3.Error:
        return
