"""Messages of a tick: rows of records, read from shared memory, and encoded as the maps of docs/protocol.md.

Contains no numpy. docs/protocol.md describes the memory, too, and `softfinger_ring.h` is the same reader in C.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator
from typing import Any, Final

import msgspec

from softfinger.proxy.record import FIELDS, NAMED, PATCHES, RECORD_SIZE, Field
from softfinger.server.socket_process.channel_messages import StateInfo, TickParameters

_WORD: Final = 2.0**63
_TICK: Final = NAMED["tick"].at
_LISTS: Final = [f"contacts{i}" for i in range(PATCHES)]
_CAPACITY: Final = 2
_WIDTH: Final = 3
_HEAD: Final = 8
_PAGE_BYTES: Final = 4096


def to_int(value: float) -> int:
    """Return the integer of a field; 0 if it has none, such as nan for the buttons of a device."""
    return int(value) if -_WORD <= value < _WORD else 0


class _MessageMap:
    """Map of a message, created once and filled from each record.

    content  keys that do not come from a record
    fields   fields of the record, with their dotted names in the map
    """

    def __init__(self, content: dict[str, Any], fields: list[tuple[str, Field]]) -> None:
        self.content = content
        self._integers: list[tuple[dict[str, Any], str, int]] = []
        self._numbers: list[tuple[dict[str, Any], str, int]] = []
        self._vectors: list[tuple[dict[str, Any], str, int, int]] = []
        for name, field in fields:
            parent, _, key = name.rpartition(".")
            inside = content.setdefault(parent, {}) if parent else content
            inside[key] = 0
            if field.kind == "int":
                self._integers.append((inside, key, field.at))
            elif field.size == 1:
                self._numbers.append((inside, key, field.at))
            else:
                self._vectors.append((inside, key, field.at, field.at + field.size))

    def fill(self, row: tuple[float, ...]) -> dict[str, Any]:
        """Return the map of a record (RECORD_SIZE,); the next call changes it."""
        for inside, key, at in self._integers:
            inside[key] = to_int(row[at])
        for inside, key, at in self._numbers:
            inside[key] = row[at]
        for inside, key, begin, end in self._vectors:
            inside[key] = row[begin:end]
        return self.content


class TickEncoder:
    """Encoder of a tick's row (fingers x RECORD_SIZE,) as messages."""

    def __init__(self, ticks: TickParameters, state_info: StateInfo) -> None:
        self._topics, self._every = [topic.encode() for topic in ticks.topics], ticks.every
        self._state_topic, self._state_hz = ticks.state.encode(), ticks.state_hz
        self._encode = msgspec.msgpack.Encoder().encode
        in_lists = {name: [f for f in FIELDS if f.name.startswith(f"{name}.")] for name in _LISTS}
        list_fields = {f.name for fields in in_lists.values() for f in fields}
        head = {"schema": ticks.schema, "every": ticks.every}
        self._contact = _MessageMap(head, [(f.name, f) for f in FIELDS if f.name not in list_fields])
        self._patches = [
            (NAMED[f"{name}.object"].at, _MessageMap({}, [(f.name.partition(".")[2], f) for f in fields]))
            for name, fields in in_lists.items()
        ]
        field_names = {
            "position": "probe.position",
            "velocity": "probe.velocity",
            "force": "force",
            "field_state.mode": "contact.mode",
            "field_state.object": "contact.object",
            "field_state.penetration": "contact.penetration",
        }
        content = {"timestamp": 0.0, "sequence": 0}
        self._state = _MessageMap(content, [(key, NAMED[name]) for key, name in field_names.items()])
        self.set_state_info(state_info)

    def set_state_info(self, state_info: StateInfo) -> None:
        self._state_every = max(1, round(state_info.rate_hz / self._state_hz))
        self._epoch_s = state_info.epoch_s
        self._state.content["active_field"] = state_info.scene

    def encode_row(self, row: tuple[float, ...]) -> Iterator[tuple[bytes, bytes]]:
        """Yield topic and body of each message that is due in this tick."""
        tick = to_int(row[_TICK])
        if tick % self._every == 0:
            for index, topic in enumerate(self._topics):
                record = row[index * RECORD_SIZE : (index + 1) * RECORD_SIZE]
                content = self._contact.fill(record)
                content["contacts"] = [patch.fill(record) for at, patch in self._patches if to_int(record[at]) >= 0]
                yield topic, self._encode(content)
        if tick % self._state_every == 0:
            state = self._state.fill(row)
            state["timestamp"], state["sequence"] = row[NAMED["timestamp"].at] - self._epoch_s, tick
            yield self._state_topic, self._encode(state)


class RowReader:
    """Reader of the rows from number `begin` on.

    file  descriptor of the shared memory, closed here
    bell  eventfd that signals new rows
    """

    def __init__(self, file: int, begin: int, bell: int) -> None:
        self._memory = mmap.mmap(file, 0, prot=mmap.PROT_READ)
        os.close(file)
        self._words = memoryview(self._memory).cast("q")
        self._capacity, width = self._words[_CAPACITY], self._words[_WIDTH]
        self._row = struct.Struct(f"{width}d")
        self._next, self.bell = begin, bell
        self.lost = 0
        """Rows that were overwritten before they were read."""

    def take(self) -> Iterator[tuple[float, ...]]:
        """Yield every available row, oldest first; skip to the middle of the ring if a full ring behind."""
        head = self._words[_HEAD]
        while self._next < head:
            if head - self._next >= self._capacity:
                to = head - self._capacity // 2
                self.lost += to - self._next
                self._next = to
            slot = self._next & (self._capacity - 1)
            row = self._row.unpack_from(self._memory, _PAGE_BYTES + slot * self._row.size)
            head = self._words[_HEAD]
            if head - self._next < self._capacity:  # it was not overwritten during the copy
                self._next += 1
                yield row
