"""Messages of a tick: conversion of a row of records into the encoded maps of docs/protocol.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import msgspec

from softfinger.proxy.record import FIELDS, NAMED, PATCHES, RECORD_SIZE, Field
from softfinger.server.socket_process.setup import StateInfo, TickParameters

_WORD: Final = 2.0**63
_TICK: Final = NAMED["tick"].at
_LISTS: Final = [f"contacts{i}" for i in range(PATCHES)]


def to_int(value: float) -> int:
    """Return the integer of a field; 0 if it has none, such as nan for the buttons of a device."""
    return int(value) if -_WORD <= value < _WORD else 0


class _Map:
    """Map that is created once and filled from successive rows.

    fields  with their dotted names in the map
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


class Messages:
    """Encoder of rows (fingers x RECORD_SIZE,)."""

    def __init__(self, ticks: TickParameters, state_info: StateInfo) -> None:
        self._topics, self._every = [topic.encode() for topic in ticks.topics], ticks.every
        self._state_topic, self._state_hz = ticks.state.encode(), ticks.state_hz
        self._encode = msgspec.msgpack.Encoder().encode
        in_lists = {name: [f for f in FIELDS if f.name.startswith(f"{name}.")] for name in _LISTS}
        list_fields = {f.name for fields in in_lists.values() for f in fields}
        head = {"schema": ticks.schema, "every": ticks.every}
        self._contact = _Map(head, [(f.name, f) for f in FIELDS if f.name not in list_fields])
        self._patches = [
            (NAMED[f"{name}.object"].at, _Map({}, [(f.name.partition(".")[2], f) for f in fields]))
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
        self._state = _Map(content, [(key, NAMED[name]) for key, name in field_names.items()])
        self.set_state_info(state_info)

    def set_state_info(self, state_info: StateInfo) -> None:
        self._state_every = max(1, round(state_info.rate_hz / self._state_hz))
        self._epoch_s = state_info.epoch_s
        self._state.content["active_field"] = state_info.scene

    def encode_row(self, row: tuple[float, ...]) -> Iterator[tuple[bytes, bytes]]:
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
