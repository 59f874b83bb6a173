"""Reading of recordings chunk by chunk in bounded memory, up to the end of a possibly incomplete file.

A recording is untrusted input. Reading yields ticks and events or raises RecordingError, for any bytes. Files of other
versions are supported: the file describes its ticks, and fields are found by their telemetry names.
"""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.errors import RecordingError
from softfinger.config.files import open_input
from softfinger.drivers.mcap_messages import RECORD_BYTES_MAX, iter_mcap_records
from softfinger.proxy.record import FIELDS
from softfinger.server.progress import show_progress
from softfinger.server.recording.layout import Layout, TickField
from softfinger.server.recording.schemas import decode_event, decode_world, load_message_class
from softfinger.server.recording.writer import EVENT_TOPIC, JSON, MARK_TOPIC
from softfinger.server.wire.protocol import WORLD, find_finger

METADATA_MAX: Final = 256
"""Maximum of metadata tables read; this program writes about ten."""


class TickBlock(NamedTuple):
    """Block of ticks of a finger: `rows` (n, width) with the columns of `parts`."""

    finger: str
    parts: list[TickField]
    rows: Array

    def column(self, name: str) -> Array | None:
        """Return a field by its telemetry name, (n,) or (n, size); None if the file does not have it."""
        part = next((part for part in self.parts if part.name == name), None)
        if part is None:
            return None
        return self.rows[:, part.at] if part.size == 1 else self.rows[:, part.at : part.at + part.size]

    def missing(self) -> list[str]:
        """Return the fields of this version that the file lacks or has with another number of components."""
        present = {(part.name, part.size) for part in self.parts}
        return [field.name for field in FIELDS if (field.name, field.size) not in present]

    def records(self) -> Array:
        """Return the rows as records (n, RECORD_SIZE) of this version; raises RecordingError if a field is missing."""
        if self.column("force") is None:
            raise RecordingError("it has poses without forces: compute them with `softfinger simulate --poses`")
        if missing := self.missing():
            raise RecordingError(f"its ticks lack {', '.join(missing[:5])}: they were recorded by another version")
        if [(part.name, part.size) for part in self.parts] == [(field.name, field.size) for field in FIELDS]:
            return self.rows
        columns = [column for field in FIELDS if (column := self.column(field.name)) is not None]
        return np.column_stack(columns)


class Event(NamedTuple):
    """Event, a map as on the wire."""

    event: dict[str, Any]


class RecordedWorld(NamedTuple):
    """Message of `world`, a map as on the wire."""

    world: dict[str, Any]


class Note(NamedTuple):
    """Name and value of a table of metadata."""

    name: str
    value: Any


class Topic(NamedTuple):
    """Name of a topic, name of its schema, and number of its messages in the file."""

    name: str
    schema: str
    messages: int


class End(NamedTuple):
    """End of a file.

    cut     reason if it is incomplete, else empty
    unread  number of ticks in damaged parts before the first tick and after the last one that was read, by finger
    """

    topics: list[Topic]
    cut: str
    unread: Mapping[str, tuple[int, int]] = MappingProxyType({})


def explain_no_tick(end: End) -> str:
    """Return why a file has no tick, for a message: its damage, or its topics."""
    if end.cut:
        return f"has no tick: {end.cut}"
    if not end.topics or any(find_finger(topic.name) is not None for topic in end.topics):
        return "has no tick"
    names = ", ".join(repr(topic.name[:40]) for topic in end.topics[:5]) + ", ..." * (len(end.topics) > 5)
    return f"has no tick on topic 'contact' or 'finger/NAME': its topics are {names}"


class _Channel:
    def __init__(self, topic: str, schema: Any) -> None:
        self.topic, self.schema, self.messages = topic, schema, 0
        self.unread_before = self.unread_after = 0
        """Messages in damaged parts before the first message, and after the latest one."""
        self.finger = find_finger(topic)
        self.layout: Layout | None = None
        self._message_type: Any = None

    @property
    def message_type(self) -> Any:
        if self._message_type is None:
            if self.schema is None or self.schema.encoding != "protobuf":
                raise ValueError(f"messages of topic {self.topic[:40]!r} are not protobuf")
            self._message_type = load_message_class(self.schema.data, self.schema.name)
        return self._message_type

    def ticks(self, messages: list[bytes]) -> TickBlock:
        layout = self.layout = self.layout or Layout(self.message_type.FromString(messages[0]))
        rows = None
        if all(len(message) == layout.size for message in messages):
            rows = layout.decode(np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1))
        if rows is None:  # another program may encode the same values differently
            rows = np.array([layout.row(self.message_type.FromString(message)) for message in messages])
        return TickBlock(self.finger or "", layout.parts, rows)

    def count_unread(self, count: int) -> None:
        if self.messages:
            self.unread_after += count
        else:
            self.unread_before += count

    def contents(self, messages: list[bytes]) -> Iterator[TickBlock | Event | RecordedWorld]:
        """Decode messages of the channel; those of topics that this program does not read are only counted."""
        self.messages += len(messages)
        self.unread_after = 0
        if self.finger is not None:
            yield self.ticks(messages)
        elif self.topic in (EVENT_TOPIC, MARK_TOPIC):
            for message in messages:
                yield Event(decode_event(self.message_type.FromString(message)))
        elif self.topic == WORLD:
            for message in messages:
                yield RecordedWorld(decode_world(self.message_type.FromString(message)))


@contextmanager
def translate_errors(path: str | Path, action: str = "written") -> Iterator[None]:
    """Raise RecordingError in place of an OSError of the block, in which the file is read or written."""
    try:
        yield
    except FileExistsError as error:
        raise RecordingError(f"{path}: already exists: a recording does not overwrite files") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be {action}: {error.strerror or error}") from error


def read_contents(path: str | Path) -> Iterator[TickBlock | Event | RecordedWorld | Note | End]:
    """Yield the contents of a recording in file order, followed by an End; report the progress.

    Raises
    ------
    RecordingError
        If the file is not a readable recording.
    """
    with (
        translate_errors(path, "read"),
        open_input(path) as file,
        show_progress(f"reading {Path(path).name}", os.fstat(file.fileno()).st_size) as advance,
    ):
        for part in _read_contents(Path(path), file):
            advance(file.tell())
            yield part


def _read_contents(path: Path, file: IO[bytes]) -> Iterator[TickBlock | Event | RecordedWorld | Note | End]:
    from mcap.exceptions import EndOfFile
    from mcap.records import Channel, Chunk, Footer, Message, MessageIndex, Metadata, Schema

    schemas: dict[int, Any] = {}
    channels: dict[int, _Channel] = {}
    notes = 0
    if not os.fstat(file.fileno()).st_size:
        raise RecordingError(f"{path}: is empty")
    cut = "it has no index at its end: it is still being written, its writer was killed, or the disk was full"
    damage: list[str] = []
    known = 0
    """Number of damaged parts before the latest readable one."""
    summary = cache(partial(_read_summary, file))

    def skip_damage(error: Exception) -> None:
        damage.append(f"a part is damaged, and its ticks are missing: {type(error).__name__}: {str(error)[:120]}")
        for record in summary():  # the part may have declared channels
            if isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                channels.setdefault(record.id, _Channel(record.topic, schemas.get(record.schema_id)))

    try:
        for outer in iter_mcap_records(file, skip_damage):
            messages_by_channel: dict[int, list[bytes]] = {}
            known = len(damage) if isinstance(outer, Chunk) else known
            for record in _unpack_chunk(outer.data) if isinstance(outer, Chunk) else (outer,):
                if isinstance(record, tuple):
                    messages_by_channel.setdefault(record[0], []).append(record[1])
                elif isinstance(record, Message):
                    messages_by_channel.setdefault(record.channel_id, []).append(record.data)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels.setdefault(record.id, _Channel(record.topic, schemas.get(record.schema_id)))
                elif isinstance(record, MessageIndex) and len(damage) > known and record.channel_id in channels:
                    channels[record.channel_id].count_unread(len(record.records))
                elif isinstance(record, Metadata) and notes < METADATA_MAX:
                    notes += 1
                    try:
                        yield _make_note(record)
                    except ValueError as error:
                        damage.append(f"metadata '{record.name[:40]}' is damaged: {error}")
                elif isinstance(record, Footer) and record.summary_start:
                    cut = ""
            for channel_id, messages in messages_by_channel.items():
                if channel_id in channels or not damage:  # a damaged part may have declared it
                    yield from channels[channel_id].contents(messages)
    except (GeneratorExit, OSError, RecordingError):
        raise
    except Exception as error:  # the decoders raise exceptions of many types on damaged bytes
        if not isinstance(error, EndOfFile | struct.error):
            cut = f"{type(error).__name__}: {str(error)[:120]}"
        if not channels:
            raise RecordingError(f"{path}: not a readable MCAP recording: {cut}") from error
    if damage:
        cut = damage[0] + (f", and {len(damage) - 1} more" if len(damage) > 1 else "")
        if not channels:
            raise RecordingError(f"{path}: not a readable MCAP recording: {cut}")
    yield _make_end(channels.values(), cut)


def _make_note(record: Any) -> Note:
    """Return the value of a metadata record; raises ValueError if it is damaged."""
    table = record.metadata
    return Note(record.name, json.loads(table[JSON]) if set(table) == {JSON} else dict(table))


def _make_end(channels: Collection[_Channel], cut: str) -> End:
    topics = [Topic(item.topic, item.schema.name if item.schema else "", item.messages) for item in channels]
    unread = {item.finger: (item.unread_before, item.unread_after) for item in channels if item.finger is not None}
    return End(topics, cut, unread)


def _read_summary(file: IO[bytes]) -> list[Any]:
    """Return the schemas and channels at the end of a file, whose position does not change; empty if it has none."""
    from mcap.reader import SeekingReader

    position = file.tell()
    file.seek(0)
    try:
        summary = SeekingReader(file, record_size_limit=RECORD_BYTES_MAX).get_summary()
        return [] if summary is None else [*summary.schemas.values(), *summary.channels.values()]
    except Exception:  # no summary, or a damaged one
        return []
    finally:
        file.seek(position)


_HEAD: Final = struct.Struct("<BQ")
_MESSAGE: Final = 5
_SCHEMA, _CHANNEL = 3, 4


def _unpack_chunk(data: bytes) -> Iterator[Any]:
    """Yield the records of an unpacked chunk; for messages, of which there are many, only channel and data."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Schema

    at, end = 0, len(data)
    while at < end:
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if at + length > end:
            raise ValueError("a record is longer than its chunk")
        if opcode == _MESSAGE:
            if length < 22:
                raise ValueError("a message without a header")
            yield data[at] | data[at + 1] << 8, data[at + 22 : at + length]
        elif opcode in (_SCHEMA, _CHANNEL):
            stream = ReadDataStream(io.BytesIO(data[at : at + length]))
            yield (Schema if opcode == _SCHEMA else Channel).read(stream)
        at += length
