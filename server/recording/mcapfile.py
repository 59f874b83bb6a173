"""Writer of MCAP files whose chunks are written completely, on request or when full.

The library's writer takes one message at a time, 10 us each, and ends a chunk only by its size. This one takes blocks
and can end a chunk at any time, which bounds the time span that a kill loses. The records are those of the library.
Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import tempfile
import time
import weakref
import zlib
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from struct import Struct
from typing import IO, Any, Final

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Times = NDArray[np.int64]

CHUNK_BYTES: Final = 64 * 1024
"""Uncompressed bytes of messages in a chunk; small, so that the loss of a chunk costs little."""
INDEX_KEPT: Final = 256 * 1024
"""Maximum bytes of the chunk index in memory, which is two minutes of it."""
ZSTD_LEVEL: Final = 1
"""Level 1 compresses ticks to a third; level 3 saves a few per cent more and takes twice as long."""

_HEAD: Final = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
"""Header of an MCAP message, without padding."""
_HEAD_COUNTED: Final = 22
"""Bytes of the header that count into the message's length."""
_INDEX_HEAD: Final = Struct("<BQHI")
"""Opcode, length, channel, and bytes of the entries of a message index."""


class McapFile:
    """Writer to an open unbuffered file, which the caller closes; errors of the file are raised unchanged."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._at = 0
        self._compressor = zstandard.ZstdCompressor(ZSTD_LEVEL)
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        # The index of chunks grows by 9 MB per hour and is written last: until then it is in an unnamed file.
        folder = str(Path(file.name).parent) if isinstance(file.name, str) else None
        self._chunks: Final = tempfile.SpooledTemporaryFile(max_size=INDEX_KEPT, dir=folder)  # noqa: SIM115
        weakref.finalize(self, self._chunks.close)  # `finish` is not reached if the disk is full
        self._chunk_count = 0
        self._metadata: list[records.MetadataIndex] = []
        self._pending: list[bytes | memoryview] = []
        self._pending_bytes = 0
        self._index: dict[int, list[NDArray[np.uint64]]] = {}  # by channel: times, and offsets in the chunk
        self.counts: Final[dict[int, int]] = {}
        """Messages written to the file, by channel."""
        self.worst_write_s = 0.0
        """Longest duration of a write, s."""
        self._span: tuple[int, int] | None = None
        self._write(MCAP0_MAGIC + _record(records.Header(profile="", library="softfinger")))

    @property
    def pending(self) -> bool:
        """Whether there are messages outside of any chunk."""
        return bool(self._index)

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._at

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a table of texts immediately."""
        data, at = _record(records.Metadata(name=name, metadata=dict(values))), self._at
        self._write(data)
        self._metadata.append(records.MetadataIndex(offset=at, length=len(data), name=name))

    def channel(self, topic: str, schema: str, descriptors: bytes) -> int:
        """Return the number of a new topic with protobuf messages of this type."""
        known = next((each for each in self._schemas if each.name == schema), None)
        if known is None:
            known = records.Schema(id=len(self._schemas) + 1, name=schema, encoding="protobuf", data=descriptors)
            self._schemas.append(known)
            self._add(_record(known))
        number = len(self._channels) + 1
        made = records.Channel(id=number, topic=topic, message_encoding="protobuf", metadata={}, schema_id=known.id)
        self._channels.append(made)
        self._add(_record(made))
        return number

    def message(self, channel: int, time_ns: int, data: bytes, sequence: int = 0) -> None:
        """Add one message."""
        head = np.zeros(1, _HEAD)
        head[0] = (Opcode.MESSAGE, _HEAD_COUNTED + len(data), channel, sequence, time_ns, time_ns)
        self._note(channel, np.array([time_ns]), np.array([self._pending_bytes]))
        self._add(head.tobytes() + data)
        self._end_if_full()

    def block(self, channel: int, times_ns: Times, messages: Bytes, sequences: NDArray[np.int64]) -> None:
        """Add messages (n, size) with their times (n,); full chunks are written, the remainder is pending."""
        size = messages.shape[1]
        done = 0
        while done < len(messages):
            room = max(1, -((self._pending_bytes - CHUNK_BYTES) // (_HEAD.itemsize + size)))
            some = slice(done, done + room)
            times = times_ns[some]
            whole = np.empty((len(times), _HEAD.itemsize + size), np.uint8)
            head = np.empty(len(times), _HEAD)
            head["opcode"], head["length"], head["channel"] = Opcode.MESSAGE, _HEAD_COUNTED + size, channel
            head["sequence"], head["log"], head["publish"] = sequences[some], times, times
            whole[:, : _HEAD.itemsize] = head.view(np.uint8).reshape(len(times), -1)
            whole[:, _HEAD.itemsize :] = messages[some]
            self._note(channel, times, self._pending_bytes + np.arange(len(times)) * whole.shape[1])
            self._add(whole.data.cast("B"))
            done += len(times)
            self._end_if_full()

    def flush(self) -> None:
        """End the chunk and write it to the file."""
        if not self._pending:
            return
        data = self._pending[0] if len(self._pending) == 1 else b"".join(self._pending)
        # Readers do not depend on message order, so the chunk's times are its minimum and maximum.
        first, last = _bounds(self._index)
        kept = self._compressor.compress(data)
        chunk = _record(
            records.Chunk(
                compression="zstd",
                data=kept,
                message_end_time=last,
                message_start_time=first,
                uncompressed_crc=zlib.crc32(data),
                uncompressed_size=len(data),
            )
        )
        offsets, indices, at = {}, [], self._at + len(chunk)
        for channel, entries in self._index.items():
            pairs = np.concatenate(entries).tobytes()
            offsets[channel] = at
            indices.append(_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(pairs), channel, len(pairs)) + pairs)
            at += len(indices[-1])
        index = records.ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self._at,
            compression="zstd",
            compressed_size=len(kept),
            message_end_time=last,
            message_index_length=sum(map(len, indices)),
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=len(data),
        )
        if self._index:
            before = self._span or (first, last)
            self._span = min(before[0], first), max(before[1], last)
        added = {channel: sum(map(len, entries)) for channel, entries in self._index.items()}
        self._pending, self._pending_bytes, self._index = [], 0, {}
        self._write(chunk + b"".join(indices))
        self._chunks.write(_record(index))
        self._chunk_count += 1
        for channel, count in added.items():
            self.counts[channel] = self.counts.get(channel, 0) + count

    def finish(self) -> None:
        """Write pending messages, and the summary with the indices for readers."""
        self.flush()
        self._write(_record(records.DataEnd(data_section_crc=0)))
        start = self._at
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=self._chunk_count,
            message_count=sum(self.counts.values()),
            message_end_time=(self._span or (0, 0))[1],
            message_start_time=(self._span or (0, 0))[0],
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_record, self._schemas)),
            (Opcode.CHANNEL, map(_record, self._channels)),
            (Opcode.STATISTICS, [_record(statistics)]),
            (Opcode.CHUNK_INDEX, self._chunk_indices()),
            (Opcode.METADATA_INDEX, map(_record, self._metadata)),
        ]
        crc, offsets = 0, b""
        for opcode, parts in groups:
            begin = self._at
            for part in parts:
                crc = zlib.crc32(part, crc)
                self._write(part)
            if self._at > begin:
                offsets += _record(
                    records.SummaryOffset(group_opcode=opcode, group_start=begin, group_length=self._at - begin)
                )
        footer = _record(records.Footer(summary_start=start, summary_offset_start=self._at, summary_crc=0))[:-4]
        crc = zlib.crc32(offsets + footer, crc)
        self._write(offsets + footer + crc.to_bytes(4, "little") + MCAP0_MAGIC)

    def _chunk_indices(self) -> Iterator[bytes]:
        self._chunks.seek(0)
        yield from iter(partial(self._chunks.read, INDEX_KEPT), b"")

    def _add(self, data: bytes | memoryview) -> None:
        self._pending.append(data)
        self._pending_bytes += len(data)

    def _note(self, channel: int, times: Times, offsets: NDArray[np.int64]) -> None:
        pairs = np.empty((len(times), 2), "<u8")
        pairs[:, 0], pairs[:, 1] = times, offsets
        self._index.setdefault(channel, []).append(pairs)

    def _end_if_full(self) -> None:
        if self._pending_bytes >= CHUNK_BYTES:
            self.flush()

    def _write(self, data: bytes) -> None:
        left, begun = memoryview(data), time.monotonic()
        while left:
            left = left[self._file.write(left) or 0 :]
        self.worst_write_s = max(self.worst_write_s, time.monotonic() - begun)
        self._at += len(data)


def _record(record: Any) -> bytes:
    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def _bounds(index: Mapping[int, list[NDArray[np.uint64]]]) -> tuple[int, int]:
    """Return the minimum and maximum time of a chunk; 0 without messages."""
    times = [pairs[:, 0] for entries in index.values() for pairs in entries]
    return min((int(t.min()) for t in times), default=0), max((int(t.max()) for t in times), default=0)
