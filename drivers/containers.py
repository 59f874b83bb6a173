"""MCAP files of foreign origin, read in bounded memory whatever sizes they claim.

They may be compressed: a few kilobytes of file can stand for gigabytes. Nothing is unpacked that is larger than the
limits here, which no file of this program comes near.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import IO, Any, Final

RECORD_BYTES_MAX: Final = 16 << 20
"""Of one record of an MCAP file, and of one of its chunks unpacked; this program's chunks have 64 KiB."""
SCHEMA_BYTES_MAX: Final = 16 << 20
"""Of all descriptions of messages in an MCAP file; this program's has 3 KB."""


def mcap_messages(file: IO[bytes], topic: str | None) -> Iterator[tuple[Any, Any, Any]]:
    """Schema (None without one), channel and message of each message of a topic, None for all, in file order.

    A schema is handed out once its first message comes. Raises ValueError for what breaks a limit, and whatever the
    library raises on damaged bytes.
    """
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import breakup_chunk

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    described = 0
    for outer in mcap_records(file):
        for record in breakup_chunk(outer) if isinstance(outer, Chunk) else (outer,):
            if isinstance(record, Schema):
                described = within_limit(described, record)
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record if topic in (None, record.topic) else None
            elif isinstance(record, Message) and (channel := channels[record.channel_id]) is not None:
                yield schemas[channel.schema_id] if channel.schema_id else None, channel, record


def mcap_records(file: IO[bytes]) -> Iterator[Any]:
    """Every record in file order, chunks unpacked and whole; raises as `mcap_messages`."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_BYTES_MAX)
    for record in reader.records:
        yield _unpacked(record) if isinstance(record, Chunk) else record


def within_limit(described: int, schema: Any) -> int:
    """Bytes of the descriptions so far, with this one; ValueError beyond the limit."""
    described += len(schema.data) + len(schema.name)
    if described > SCHEMA_BYTES_MAX:
        raise ValueError(f"its descriptions of messages have more than {SCHEMA_BYTES_MAX:,} bytes")
    return described


def _unpacked(chunk: Any) -> Any:
    """The chunk with its records as they are. The library would make as many bytes of them as the data say."""
    size = chunk.uncompressed_size
    if size > RECORD_BYTES_MAX:
        raise ValueError(f"a chunk has {size:,} bytes unpacked, may have {RECORD_BYTES_MAX:,}")
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            chunk.data = stream.read(size)
    elif chunk.compression == "lz4":
        import lz4.frame

        chunk.data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
    elif chunk.compression:
        raise ValueError(f"compressed by {chunk.compression[:20]!r}, which is not known here")
    if len(chunk.data) != size:
        raise ValueError(f"a chunk has {len(chunk.data):,} bytes, says {size:,}")
    if chunk.uncompressed_crc and zlib.crc32(chunk.data) != chunk.uncompressed_crc:
        raise ValueError("a chunk's checksum is not that of its bytes")
    chunk.compression = ""
    return chunk
