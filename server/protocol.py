"""The wire: topics, the keys of every message, encoding and strict decoding.

A message is exactly two frames, `[topic, msgpack map]`. The keys of `contact` come from the record
table in proxy/state.py; the keys of `event` and `health` are the tables below. docs/protocol.md
describes the same keys for readers, and a test compares the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import msgpack
import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError
from softfinger.proxy.state import FIELDS, OFFSET

SCHEMA: Final = 1
"""Raised when a key is removed or changes its meaning; a new key leaves it as it is."""

CONTACT: Final = "contact"
EVENT: Final = "event"
HEALTH: Final = "health"
TOPICS: Final = (CONTACT, EVENT, HEALTH)

MAX_BYTES: Final = 65536
"""Longest message body a client decodes; the longest one published is below 1 KiB."""


class ProtocolError(HapticError):
    """A message that does not follow docs/protocol.md."""

    exit_code = 8


class Key(NamedTuple):
    """One key of a message: dotted name, type (`int`, `float`, `float[3]`, `str`), unit, frame, meaning."""

    name: str
    type: str
    unit: str
    frame: str
    meaning: str


_SCHEMA_KEY: Final = Key("schema", "int", "1", "", "version of this protocol")
_TICK_KEY: Final = Key("tick", "int", "1", "", "tick the message belongs to, -1 before the first")

CONTACT_KEYS: Final = (
    _SCHEMA_KEY,
    Key("every", "int", "1", "", "one tick in this many is published"),
    *(Key(f.name, f"{f.kind}[{f.size}]" if f.size > 1 else f.kind, f.unit, f.frame, f.meaning) for f in FIELDS),
)

EVENT_KEYS: Final = (
    _SCHEMA_KEY,
    Key("timestamp", "float", "s", "", "time of the event since the epoch"),
    _TICK_KEY,
    Key("kind", "str", "", "", "contact, guard, servo, device, fault or lifecycle"),
    Key("name", "str", "", "", "what happened"),
)
"""Keys every event has."""

EVENT_EXTRA_KEYS: Final = {
    "contact": (
        Key("cause", "str", "", "", "why the mode changed: touch, drag, theta_max, stop, reverse or release"),
        Key("from", "int", "1", "", "contact mode before"),
        Key("to", "int", "1", "", "contact mode after"),
        Key("object", "int", "1", "", "index of the object touched or released"),
        Key("force", "float[3]", "N", "world", "force on the hand in this tick, after the guard"),
        Key("normal_force", "float", "N", "", "normal force before the guard"),
        Key("tangential_force", "float", "N", "", "magnitude of the tangential force before the guard"),
        Key("point", "float[3]", "m", "world", "contact point on the object"),
    ),
    "guard": (Key("count", "int", "1", "", "times it set in since the last event of this name"),),
    "servo": (
        Key("count", "int", "1", "", "deadlines missed since the last event of this name"),
        Key("total", "int", "1", "", "deadlines missed since the servo started"),
    ),
    "device": (
        Key("device", "str", "", "", "its name, as the system has it"),
        Key("bus", "str", "", "", "hid for a hidraw node, serial for a serial port, usb for a device on the bus"),
        Key("ids", "str", "", "", "vendor and product in hexadecimal digits, such as 046d:c626"),
        Key("serial", "str", "", "", "serial number, empty if it has none"),
        Key("node", "str", "", "", "node that a driver opens, empty if there is none"),
        Key("driver", "str", "", "", "driver that claims it, empty if none does"),
    ),
}
"""Keys that events of a kind add; kinds not listed here add what the event needs."""

_QUANTILES: Final = (("p50", "median"), ("p99", "99th percentile"), ("p999", "99.9th percentile"), ("max", "largest"))

HEALTH_KEYS: Final = (
    _SCHEMA_KEY,
    Key("timestamp", "float", "s", "", "time of the last tick counted, since the epoch"),
    _TICK_KEY,
    Key("rate", "float", "1/s", "", "ticks a second"),
    *(Key(f"late.{q}", "float", "s", "", f"{words} of servo.late") for q, words in _QUANTILES),
    *(Key(f"exec.{q}", "float", "s", "", f"{words} of servo.exec") for q, words in _QUANTILES),
    Key("missed", "int", "1", "", "deadlines missed since the servo started"),
    Key("drops", "int", "1", "", "ticks the publisher was too slow to take, since the servo started"),
    Key("guarded", "int", "1", "", "ticks in which the guard changed the output"),
    Key("energy", "float", "J", "", "work the hand did on the virtual object"),
    Key("energy_total", "float", "J", "", "the same, since the servo started"),
    Key("passivity.owed", "float", "J", "", "most energy the rendering gave beyond what it took in a contact"),
    Key("passivity.damped", "int", "1", "", "ticks in which damping was added because of that"),
    Key("modes.free", "int", "1", "", "ticks in mode free"),
    Key("modes.rolling", "int", "1", "", "ticks in mode rolling"),
    Key("modes.sliding", "int", "1", "", "ticks in mode sliding"),
)

_TYPES: Final[dict[str, Any]] = {
    "int": int,
    "float": float,
    "str": str,
    "float[3]": tuple[float, float, float],
    "float[4]": tuple[float, float, float, float],
}


def _struct(name: str, keys: Sequence[Key]) -> type[msgspec.Struct]:
    """Struct type that a message with these keys decodes to; dotted names become nested structs."""
    nested: dict[str, list[Key]] = {}
    fields: dict[str, Any] = {}
    for key in keys:
        parent, _, child = key.name.partition(".")
        if child:
            nested.setdefault(parent, []).append(key._replace(name=child))
        else:
            fields[parent] = _TYPES[key.type]
    fields |= {parent: _struct(f"{name}_{parent}", children) for parent, children in nested.items()}
    return msgspec.defstruct(name, list(fields.items()), frozen=True, gc=False, module=__name__)


ContactMessage: Final = _struct("ContactMessage", CONTACT_KEYS)
HealthMessage: Final = _struct("HealthMessage", HEALTH_KEYS)
_EventHead: Final = _struct("EventHead", EVENT_KEYS)

_ENCODER: Final = msgspec.msgpack.Encoder()
_DECODERS: Final[dict[str, msgspec.msgpack.Decoder[Any]]] = {
    CONTACT: msgspec.msgpack.Decoder(ContactMessage),
    HEALTH: msgspec.msgpack.Decoder(HealthMessage),
    EVENT: msgspec.msgpack.Decoder(_EventHead),
}

# (parent map, key, first column, columns, is an int): worked out once, walked for every tick.
_PLAN: Final = tuple((*f.name.rpartition(".")[::2], OFFSET[f.name], f.size, f.kind == "int") for f in FIELDS)
_PARENTS: Final = tuple(dict.fromkeys(parent for parent, *_ in _PLAN if parent))
_INT_COLUMNS: Final = [OFFSET[f.name] for f in FIELDS if f.kind == "int"]


def nest(flat: dict[str, Any]) -> dict[str, Any]:
    """Turn dotted names into nested maps."""
    top: dict[str, Any] = {}
    for name, value in flat.items():
        parent, _, child = name.rpartition(".")
        (top.setdefault(parent, {}) if parent else top)[child] = value
    return top


def _contact_map(values: list[float], every: int) -> dict[str, Any]:
    top: dict[str, Any] = {"schema": SCHEMA, "every": every}
    maps: dict[str, dict[str, Any]] = {parent: {} for parent in _PARENTS}
    maps[""] = top
    for parent, key, at, size, is_int in _PLAN:
        maps[parent][key] = int(values[at]) if is_int else values[at] if size == 1 else values[at : at + size]
    del maps[""]
    top.update(maps)
    return top


def contact_map(record: NDArray[np.float64], every: int = 1) -> dict[str, Any]:
    """Message map of one record, shape (RECORD_SIZE,)."""
    try:
        return _contact_map(record.tolist(), every)
    except (ValueError, OverflowError):  # a nan or inf where an integer belongs (a device's buttons): send 0
        usable = record.copy()
        usable[_INT_COLUMNS] = np.nan_to_num(record[_INT_COLUMNS], nan=0.0, posinf=0.0, neginf=0.0)
        return _contact_map(usable.tolist(), every)


def encode(message: dict[str, Any]) -> bytes:
    """msgpack bytes of a message map."""
    return _ENCODER.encode(message)


def decode(topic: bytes, body: bytes) -> Any:
    """Decode one message strictly.

    Returns a struct for `contact` and `health`, a dict for `event`, whose keys depend on its kind.
    Unknown keys are ignored. Raises ProtocolError for whatever is not in docs/protocol.md.
    """
    name = topic.decode("ascii", "replace")
    decoder = _DECODERS.get(name)
    if decoder is None:
        raise ProtocolError(
            f"unknown topic {name[:40]!r}: expected one of {', '.join(TOPICS)}; is another program publishing here?"
        )
    if len(body) > MAX_BYTES:
        raise ProtocolError(f"{name} message of {len(body)} bytes is longer than the limit {MAX_BYTES}")
    try:
        message: Any = decoder.decode(body)
        if message.schema == SCHEMA:
            # msgpack, not msgspec, for the open map: it checks a claimed length before it allocates.
            return message if name != EVENT else msgpack.unpackb(body)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        if _schema_of(body) in (SCHEMA, None):
            raise ProtocolError(f"{name} message does not follow the protocol: {error}") from error
    raise ProtocolError(
        f"{name} message has schema {_schema_of(body)}, this client understands {SCHEMA}: "
        "use the client of the server's version"
    )


class _SchemaOnly(msgspec.Struct):
    schema: int


def _schema_of(body: bytes) -> int | None:
    """Schema a message claims, None if it claims none; to explain why the rest did not fit."""
    try:
        return msgspec.msgpack.decode(body, type=_SchemaOnly).schema
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def wire_schema() -> dict[str, Any]:
    """All messages and their keys as plain data, for `softfinger schema`."""
    tables: dict[str, Sequence[Key]] = {CONTACT: CONTACT_KEYS, EVENT: EVENT_KEYS, HEALTH: HEALTH_KEYS}
    tables |= {f"{EVENT} of kind {kind}": keys for kind, keys in EVENT_EXTRA_KEYS.items()}
    return {
        "schema": SCHEMA,
        "frames": ["topic", "msgpack map"],
        "messages": {name: [key._asdict() for key in keys] for name, keys in tables.items()},
    }
