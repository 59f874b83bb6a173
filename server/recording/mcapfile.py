"""Writer of MCAP files whose chunks are written completely, on request or when full.

The library's writer takes one message at a time, 10 us each, and ends a chunk only by its size. This one takes blocks
and can end a chunk at any time, which bounds the time span that a kill loses. The records are those of the library.
Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import tempfile
import time
import weakref
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from importlib.metadata import version
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
INDEX_MEMORY_BYTES: Final = 256 * 1024
"""Maximum bytes of the chunk index in memory, which is two minutes of it."""
ZSTD_LEVEL: Final = 1
"""Level 1 compresses ticks to a third; level 3 saves a few per cent more and takes twice as long."""

_MESSAGE_HEADER: Final = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
"""Header of an MCAP message, without padding."""
_COUNTED_HEADER_BYTES: Final = 22
"""Bytes of the header that count into the message's length."""
_INDEX_HEADER: Final = Struct("<BQHI")
"""Opcode, length, channel, and bytes of the entries of a message index."""


class McapFile:
    """Writer to an open unbuffered file, which the caller closes; errors of the file are raised unchanged."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.size = 0
        """Bytes written."""
        self._compressor = zstandard.ZstdCompressor(ZSTD_LEVEL)
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        # The index of chunks grows by 9 MB per hour and is written last: until then it is in an unnamed file.
        folder = str(Path(file.name).parent) if isinstance(file.name, str) else None
        self._chunks: Final = tempfile.SpooledTemporaryFile(max_size=INDEX_MEMORY_BYTES, dir=folder)  # noqa: SIM115
        weakref.finalize(self, self._chunks.close)  # `finish` is not reached if the disk is full
        self._chunk_count = 0
        self._metadata: list[records.MetadataIndex] = []
        self._pending: list[bytes | memoryview] = []
        self._pending_bytes = 0
        self._index: dict[int, list[NDArray[np.uint64]]] = {}  # by channel: times, and offsets in the chunk
        self.counts: Final[dict[int, int]] = {}
        """Messages written to the file, by channel."""
        self.worst_write_s = 0.0
        self._time_range: tuple[int, int] | None = None
        self._write(MCAP0_MAGIC + _record(records.Header(profile="", library=f"softfinger {version('softfinger')}")))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a table of texts immediately."""
        data, offset = _record(records.Metadata(name=name, metadata=dict(values))), self.size
        self._write(data)
        self._metadata.append(records.MetadataIndex(offset=offset, length=len(data), name=name))

    def channel(self, topic: str, schema: str, descriptors: bytes) -> int:
        schema_record = next((record for record in self._schemas if record.name == schema), None)
        if schema_record is None:
            schema_record = records.Schema(
                id=len(self._schemas) + 1, name=schema, encoding="protobuf", data=descriptors
            )
            self._schemas.append(schema_record)
            self._add(_record(schema_record))
        number = len(self._channels) + 1
        channel = records.Channel(
            id=number, topic=topic, message_encoding="protobuf", metadata={}, schema_id=schema_record.id
        )
        self._channels.append(channel)
        self._add(_record(channel))
        return number

    def message(self, channel: int, time_ns: int, data: bytes) -> None:
        self.block(channel, np.array([time_ns]), np.frombuffer(data, np.uint8)[None], np.zeros(1, np.int64))

    def block(self, channel: int, times_ns: Times, messages: Bytes, sequences: NDArray[np.int64]) -> None:
        """Add messages (n, size) with their times (n,); full chunks are written, the remainder is pending."""
        size = messages.shape[1]
        written = 0
        while written < len(messages):
            fitting = max(1, -((self._pending_bytes - CHUNK_BYTES) // (_MESSAGE_HEADER.itemsize + size)))
            block = slice(written, written + fitting)
            times = times_ns[block]
            encoded = np.empty((len(times), _MESSAGE_HEADER.itemsize + size), np.uint8)
            header = np.empty(len(times), _MESSAGE_HEADER)
            header["opcode"], header["length"] = Opcode.MESSAGE, _COUNTED_HEADER_BYTES + size
            header["channel"], header["sequence"] = channel, sequences[block]
            header["log"] = header["publish"] = times
            encoded[:, : _MESSAGE_HEADER.itemsize] = header.view(np.uint8).reshape(len(times), -1)
            encoded[:, _MESSAGE_HEADER.itemsize :] = messages[block]
            pairs = np.empty((len(times), 2), "<u8")
            pairs[:, 0], pairs[:, 1] = times, self._pending_bytes + np.arange(len(times)) * encoded.shape[1]
            self._index.setdefault(channel, []).append(pairs)
            self._add(encoded.data.cast("B"))
            written += len(times)
            if self._pending_bytes >= CHUNK_BYTES:
                self.flush()

    def flush(self) -> None:
        if not self._pending:
            return
        data = self._pending[0] if len(self._pending) == 1 else b"".join(self._pending)
        # Readers do not depend on message order, so the chunk's times are its minimum and maximum.
        first, last = _find_bounds(self._index)
        compressed = self._compressor.compress(data)
        chunk = _record(
            records.Chunk(
                compression="zstd",
                data=compressed,
                message_end_time=last,
                message_start_time=first,
                uncompressed_crc=zlib.crc32(data),
                uncompressed_size=len(data),
            )
        )
        offsets, indices, offset = {}, [], self.size + len(chunk)
        for channel, entries in self._index.items():
            pairs = np.concatenate(entries).tobytes()
            offsets[channel] = offset
            indices.append(_INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + len(pairs), channel, len(pairs)) + pairs)
            offset += len(indices[-1])
        index = records.ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self.size,
            compression="zstd",
            compressed_size=len(compressed),
            message_end_time=last,
            message_index_length=sum(map(len, indices)),
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=len(data),
        )
        if self._index:
            previous = self._time_range or (first, last)
            self._time_range = min(previous[0], first), max(previous[1], last)
        added = {channel: sum(map(len, entries)) for channel, entries in self._index.items()}
        self._pending, self._pending_bytes, self._index = [], 0, {}
        self._write(chunk + b"".join(indices))
        for channel, count in added.items():
            self.counts[channel] = self.counts.get(channel, 0) + count
        self._chunks.write(_record(index))
        self._chunk_count += 1

    def finish(self) -> None:
        """Write pending messages, and the summary with the indices for readers."""
        self.flush()
        data_size = self.size
        try:
            self._write_summary()
        except OSError:
            self.size = data_size
            raise

    def finish_without_summary(self) -> None:
        """End the file after the data, if the disk accepts 50 bytes.

        Without this end the library's reader raises an error before the first message.
        """
        self._truncate()
        footer = records.Footer(summary_start=0, summary_offset_start=0, summary_crc=0)
        self._write(_record(records.DataEnd(data_section_crc=0)) + _record(footer) + MCAP0_MAGIC)

    def _truncate(self) -> None:
        """Remove what a failed write left after the last complete one."""
        os.ftruncate(self._file.fileno(), self.size)
        os.lseek(self._file.fileno(), self.size, os.SEEK_SET)

    def _write_summary(self) -> None:
        self._write(_record(records.DataEnd(data_section_crc=0)))
        start = self.size
        statistics = records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=self._chunk_count,
            message_count=sum(self.counts.values()),
            message_end_time=(self._time_range or (0, 0))[1],
            message_start_time=(self._time_range or (0, 0))[0],
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_record, self._schemas)),
            (Opcode.CHANNEL, map(_record, self._channels)),
            (Opcode.STATISTICS, [_record(statistics)]),
            (Opcode.CHUNK_INDEX, self._iter_chunk_indices()),
            (Opcode.METADATA_INDEX, map(_record, self._metadata)),
        ]
        crc, offsets = 0, b""
        for opcode, parts in groups:
            group_start = self.size
            for part in parts:
                crc = zlib.crc32(part, crc)
                self._write(part)
            if self.size > group_start:
                offsets += _record(
                    records.SummaryOffset(
                        group_opcode=opcode, group_start=group_start, group_length=self.size - group_start
                    )
                )
        footer = _record(records.Footer(summary_start=start, summary_offset_start=self.size, summary_crc=0))[:-4]
        crc = zlib.crc32(offsets + footer, crc)
        self._write(offsets + footer + crc.to_bytes(4, "little") + MCAP0_MAGIC)

    def _iter_chunk_indices(self) -> Iterator[bytes]:
        self._chunks.seek(0)
        yield from iter(partial(self._chunks.read, INDEX_MEMORY_BYTES), b"")

    def _add(self, data: bytes | memoryview) -> None:
        self._pending.append(data)
        self._pending_bytes += len(data)

    def _write(self, data: bytes) -> None:
        remaining, start_s = memoryview(data), time.monotonic()
        try:
            while remaining:
                remaining = remaining[self._file.write(remaining) or 0 :]
        except OSError:
            with suppress(OSError):
                self._truncate()
            raise
        self.worst_write_s = max(self.worst_write_s, time.monotonic() - start_s)
        self.size += len(data)


def _record(record: Any) -> bytes:
    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def _find_bounds(index: Mapping[int, list[NDArray[np.uint64]]]) -> tuple[int, int]:
    """Return the minimum and maximum time of a chunk; 0 without messages."""
    times = [pairs[:, 0] for entries in index.values() for pairs in entries]
    return min((int(t.min()) for t in times), default=0), max((int(t.max()) for t in times), default=0)
