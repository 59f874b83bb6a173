"""Records and messages of MCAP files, in file order up to the end of the file, also of damaged files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import IO, Any, Final

RECORD_BYTES_MAX: Final = 16 << 20
"""Maximum bytes of a record, and of an unpacked chunk; the library has no limit. Chunks of this program have 64 KiB."""


def iter_mcap_messages(file: IO[bytes], topic: str | None) -> Iterator[tuple[Any, Any, Any]]:
    """Yield schema (None without one), channel and message of each message of a topic (None: all), in file order.

    Raises ValueError if a size exceeds the limit, and any error of the library for damaged bytes.
    """
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import breakup_chunk

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    for outer in iter_mcap_records(file):
        for record in breakup_chunk(outer) if isinstance(outer, Chunk) else (outer,):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record if topic in (None, record.topic) else None
            elif isinstance(record, Message) and (channel := channels[record.channel_id]) is not None:
                yield schemas[channel.schema_id] if channel.schema_id else None, channel, record


def iter_mcap_records(file: IO[bytes], on_damage: Callable[[Exception], None] | None = None) -> Iterator[Any]:
    """Yield every record in file order, chunks unpacked; raises like `iter_mcap_messages`.

    on_damage  receives the error of each chunk that cannot be unpacked, which is then skipped
    """
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, get_chunk_data_stream

    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_BYTES_MAX)
    for record in reader.records:
        if isinstance(record, Chunk):
            try:
                if record.uncompressed_size > RECORD_BYTES_MAX:
                    message = f"a chunk has {record.uncompressed_size:,} bytes unpacked, may have {RECORD_BYTES_MAX:,}"
                    raise ValueError(message)
                stream, length = get_chunk_data_stream(record, validate_crc=True)
            except Exception as error:  # the decoders raise exceptions of many types on damaged bytes
                if on_damage is None:
                    raise
                on_damage(error)
                continue
            record.data, record.compression = stream.read(length), ""
        yield record
