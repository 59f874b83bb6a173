"""Telemetry protocol: topics, keys of all messages, encoding and strict decoding.

A message consists of exactly two frames, `[topic, msgpack map]`. The keys of `contact`, and of the topics of several
fingers, come from the record table in proxy/record.py; all other keys are in the tables below.
docs/reference/telemetry.md is generated from them, and docs/protocol.md explains them.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import GenericAlias
from typing import Any, Final, NamedTuple

import msgpack
import msgspec

from softfinger.config.errors import HapticError
from softfinger.drivers import poses
from softfinger.proxy.record import FIELDS, PATCHES, Field

SCHEMA: Final = 1
"""Version of the protocol, incremented when a key is removed or changes its meaning; a new key does not change it."""

CONTACT: Final = poses.TOPIC
EVENT: Final = "event"
HEALTH: Final = "health"
STATE: Final = "state"
SCHEMA_TOPIC: Final = "schema"
WORLD: Final = "world"
DEFORMATION: Final = "deformation"
SCENE_TOPICS: Final = (WORLD, DEFORMATION)
"""Topics of scenes with moving bodies, and with an elastic object."""
TOPICS: Final = (CONTACT, EVENT, HEALTH, STATE, SCHEMA_TOPIC)
"""Topics of a server with a single finger."""
FINGERS: Final = poses.FINGER_TOPIC_PREFIX
"""Prefix of the topics of several fingers, which replace `contact`: this and the finger's name."""

PICTURE_HZ: Final = 60.0
"""Rate of `world`, and largest rate of `deformation`: the rate at which pictures are drawn."""

STATE_HZ: Final = 200.0
"""Rate of `state`; the nearest rate is used that divides the tick rate."""

MAX_BYTES: Final = 65536
"""Longest message body that a client decodes; the longest one of a tick is below 1.5 KiB."""


class ProtocolError(HapticError):
    """Message that does not follow docs/protocol.md."""

    exit_code = 8


class Key(NamedTuple):
    """Key of a message: dotted name, type (`int`, `float`, `float[3]`, `str`, `map`), unit, frame, meaning."""

    name: str
    type: str
    unit: str
    frame: str
    meaning: str


SCHEMA_KEY: Final = Key("schema", "int", "1", "", "version of this protocol")
_TICK_KEY: Final = Key("tick", "int", "1", "", "tick of the message, -1 before the first")

_LISTS: Final = [f"contacts{i}" for i in range(PATCHES)]
"""Fields of a record that become maps in the list `contacts` of a message, one for each existing patch."""


def _to_key(field: Field) -> Key:
    parent, dot, child = field.name.partition(".")
    name = f"contacts[].{child}" if parent in _LISTS else f"{parent}{dot}{child}"
    kind = f"{field.kind}[{field.size}]" if field.size > 1 else field.kind
    return Key(name, kind, field.unit, field.frame, field.meaning)


CONTACT_KEYS: Final = (
    SCHEMA_KEY,
    Key("every", "int", "1", "", "one tick in this many is published"),
    *dict.fromkeys(_to_key(field) for field in FIELDS),
)

EVENT_KEYS: Final = (
    SCHEMA_KEY,
    Key("timestamp", "float", "s", "", "time of the event since the epoch"),
    _TICK_KEY,
    Key("kind", "str", "", "", "contact, guard, elastic, servo, device, command, mark, fault, state or lifecycle"),
    Key("name", "str", "", "", "what happened"),
)

_FINGER_KEY: Final = Key("finger", "str", "", "", "name of the finger, empty for a single one")

EVENT_EXTRA_KEYS: Final = {
    "contact": (
        Key("cause", "str", "", "", "cause of the change: touch, drag, theta_max, stop, reverse, release or restart"),
        Key("from", "int", "1", "", "contact mode before"),
        Key("to", "int", "1", "", "contact mode after"),
        Key("object", "int", "1", "", "index of the object touched or released"),
        Key("force", "float[3]", "N", "world", "force on the hand in this tick, after the guard"),
        Key("normal_force", "float", "N", "", "normal force before the guard"),
        Key("tangential_force", "float", "N", "", "magnitude of the tangential force before the guard"),
        Key("point", "float[3]", "m", "world", "contact point on the object"),
        _FINGER_KEY,
    ),
    "guard": (
        Key("count", "int", "1", "", "interventions since the last event of this name"),
        _FINGER_KEY,
        Key("message", "str", "", "", "remedy; empty if there is none"),
    ),
    "elastic": (
        Key("nonlinear", "int", "bits", "", "limits of linear elasticity that are exceeded, as `contact.nonlinear`"),
        Key("displacement", "float[3]", "m", "world", "displacement of the surface at the contact"),
        _FINGER_KEY,
        Key("message", "str", "", "", "remedy"),
    ),
    "servo": (
        Key("count", "int", "1", "", "deadlines missed since the last event of this name"),
        Key("total", "int", "1", "", "deadlines missed since the servo started"),
    ),
    "device": (
        Key("device", "str", "", "", "name, from the system"),
        Key("bus", "str", "", "", "hid (hidraw node), serial (port) or usb (device on the bus)"),
        Key("ids", "str", "", "", "vendor and product ids, hexadecimal, such as 046d:c626"),
        Key("serial", "str", "", "", "serial number, empty if it has none"),
        Key("node", "str", "", "", "node that a driver opens, empty if there is none"),
        Key("driver", "str", "", "", "driver that claims it, empty if none does"),
    ),
    "command": (
        Key("command_id", "str", "", "", "id of the request, empty if there was none"),
        Key("what", "map", "", "", "changes; for set_params `from` and `to` of each key"),
    ),
    "mark": (
        Key("command_id", "str", "", "", "id of the request"),
        Key("label", "str", "", "", "as given"),
        Key("data", "map", "", "", "as given"),
    ),
    "state": (
        Key("before", "str", "", "", "state before; the name of the event is the new one"),
        Key("cause", "str", "", "", "cause"),
    ),
}
"""Additional keys by kind of event; events of other kinds have the keys they need."""

_QUANTILES: Final = (("p50", "median"), ("p99", "99th percentile"), ("p999", "99.9th percentile"), ("max", "largest"))

HEALTH_KEYS: Final = (
    SCHEMA_KEY,
    Key("timestamp", "float", "s", "", "time of the last tick, since the epoch"),
    _TICK_KEY,
    Key("rate", "float", "1/s", "", "ticks a second"),
    *(Key(f"late.{q}", "float", "s", "", f"{words} of servo.late") for q, words in _QUANTILES),
    *(Key(f"exec.{q}", "float", "s", "", f"{words} of servo.exec") for q, words in _QUANTILES),
    Key("missed", "int", "1", "", "deadlines missed since the servo started"),
    Key("drops", "int", "1", "", "ticks that the publisher lost, since the servo started"),
    Key("guarded", "int", "1", "", "ticks in which the guard changed the output"),
    Key("energy", "float", "J", "", "work of the hand on the virtual objects"),
    Key("energy_total", "float", "J", "", "the same, since the servo started"),
    Key("passivity.owed", "float", "J", "", "largest energy that the rendering generated in a contact"),
    Key("passivity.damped", "int", "1", "", "ticks in which the passivity controller added damping"),
    Key("limits.speed", "float", "m/s", "", "largest smoothed speed of the handle; 0 without that limit"),
    Key("limits.heat", "float", "1", "", "largest heat of the motors; 1 is that of the continuous force"),
    Key("limits.energy", "float", "J", "", "largest energy that contacts gave to the hand"),
    Key("modes.free", "int", "1", "", "ticks in mode free"),
    Key("modes.rolling", "int", "1", "", "ticks in mode rolling"),
    Key("modes.sliding", "int", "1", "", "ticks in mode sliding"),
    Key("subscribers", "int", "1", "", "connections with a subscription"),
    Key("lost", "int", "1", "", "least number of messages lost by slow subscribers, since the server started"),
    Key("refused", "int", "1", "", "connections refused or closed because of their messages, since the server started"),
    Key("restarts", "int", "1", "", "restarts of the processes of telemetry and commands since the server started"),
    Key("state", "str", "", "", "state of the daemon: starting, ready, armed, faulted or stopping"),
    Key("preparing", "str", "", "", "progress of a scene in preparation, such as `compiling kernel 12`; or empty"),
)

STATE_KEYS: Final = (
    Key("timestamp", "float", "s", "", "time of the tick on CLOCK_MONOTONIC"),
    Key("sequence", "int", "1", "", "tick"),
    Key("position", "float[3]", "m", "world", "measured fingertip centre"),
    Key("velocity", "float[3]", "m/s", "world", "filtered probe velocity"),
    Key("force", "float[3]", "N", "world", "force on the hand as commanded, after the guard"),
    Key("active_field", "str", "", "", "name of the scene"),
    Key("field_state.mode", "int", "1", "", "contact mode"),
    Key("field_state.object", "int", "1", "", "index of the touched object in the scene, -1 none"),
    Key("field_state.penetration", "float", "m", "", "depth of the probe behind the proxy along the normal"),
)
"""Keys of hapticore's state message, without additions: its client decodes it into a record of exactly these."""

WORLD_KEYS: Final = (
    SCHEMA_KEY,
    Key("timestamp", "float", "s", "", "when it was sent, since the epoch"),
    _TICK_KEY,
    Key("bodies[].name", "str", "", "", "name of the body in the model, or its number"),
    Key("bodies[].position", "float[3]", "m", "world", "origin of its frame"),
    Key("bodies[].orientation", "float[4]", "1", "world", "quaternion w, x, y, z, body to world"),
    Key("bodies[].velocity", "float[3]", "m/s", "world", "velocity of the origin"),
    Key("bodies[].rate", "float[3]", "rad/s", "world", "angular velocity"),
)

DEFORMATION_KEYS: Final = (
    SCHEMA_KEY,
    Key("timestamp", "float", "s", "", "when it was sent, since the epoch"),
    _TICK_KEY,
    Key("loads[].finger", "str", "", "", "name of the finger, empty for a single one"),
    Key("loads[].object", "int", "1", "", "index of the elastic object in the scene"),
    Key("loads[].force", "float[3]", "N", "object", "load on the object"),
    Key("loads[].point", "float[3]", "m", "object", "centre of the loaded patch on the undeformed surface"),
    Key("loads[].patch_radius", "float", "m", "", "radius of the loaded patch"),
)

SCHEMA_KEYS: Final = (
    SCHEMA_KEY,
    Key("timestamp", "float", "s", "", "when the server was started, since the epoch"),
    Key("topics", "str[]", "", "", "all topics"),
    Key("commands", "str", "", "", "endpoint for commands, empty if there is none"),
    Key("messages", "map", "", "", "keys of each kind of message: name, type, unit, frame, meaning"),
)

_TYPES: Final[dict[str, Any]] = {"int": int, "float": float, "str": str}


def _make_struct(name: str, keys: Sequence[Key]) -> type[msgspec.Struct]:
    """Return the struct type for messages with these keys; dotted names become structs, `[]` tuples of structs."""
    nested: dict[str, list[Key]] = {}
    fields: dict[str, Any] = {}
    for key in keys:
        parent, _, child = key.name.partition(".")
        if child:
            nested.setdefault(parent, []).append(key._replace(name=child))
        else:
            kind, _, size = key.type.partition("[")  # `[3]` is a tuple of that size
            fields[parent] = GenericAlias(tuple, (_TYPES[kind],) * int(size[:-1])) if size else _TYPES[kind]
    for parent, children in nested.items():
        element = _make_struct(f"{name}_{parent.removesuffix('[]')}", children)
        fields[parent.removesuffix("[]")] = GenericAlias(tuple, (element, ...)) if parent.endswith("[]") else element
    return msgspec.defstruct(name, list(fields.items()), frozen=True, gc=False, module=__name__)


ContactMessage: Final = _make_struct("ContactMessage", CONTACT_KEYS)
HealthMessage: Final = _make_struct("HealthMessage", HEALTH_KEYS)
StateMessage: Final = _make_struct("StateMessage", STATE_KEYS)
WorldMessage: Final = _make_struct("WorldMessage", WORLD_KEYS)
DeformationMessage: Final = _make_struct("DeformationMessage", DEFORMATION_KEYS)

_ENCODER: Final = msgspec.msgpack.Encoder()
_DECODERS: Final[dict[str, msgspec.msgpack.Decoder[Any]]] = {
    CONTACT: msgspec.msgpack.Decoder(ContactMessage),
    HEALTH: msgspec.msgpack.Decoder(HealthMessage),
    EVENT: msgspec.msgpack.Decoder(_make_struct("EventHead", EVENT_KEYS)),
    STATE: msgspec.msgpack.Decoder(StateMessage),
    WORLD: msgspec.msgpack.Decoder(WorldMessage),
    DEFORMATION: msgspec.msgpack.Decoder(DeformationMessage),
    SCHEMA_TOPIC: msgspec.msgpack.Decoder(_make_struct("SchemaHead", SCHEMA_KEYS[:2])),
}
_OPEN: Final = (EVENT, SCHEMA_TOPIC)
"""Topics with messages that may have further keys."""


def nest(flat: dict[str, Any]) -> dict[str, Any]:
    top: dict[str, Any] = {}
    for name, value in flat.items():
        parent, _, child = name.rpartition(".")
        (top.setdefault(parent, {}) if parent else top)[child] = value
    return top


def name_contact_topic(finger: str) -> str:
    """Return the topic of a finger's ticks; a single finger, without a name, has `contact`."""
    return FINGERS + finger if finger else CONTACT


def find_finger(topic: str) -> str | None:
    """Return the name of the finger of a topic, empty for a single finger; None if the topic has no ticks."""
    if topic == CONTACT:
        return ""
    return topic.removeprefix(FINGERS) if topic.startswith(FINGERS) else None


def encode(message: Any) -> bytes:
    """Encode a message as msgpack, its texts as in `replace_undecoded`."""
    try:
        return _ENCODER.encode(message)
    except UnicodeEncodeError:
        return _ENCODER.encode(replace_undecoded(msgspec.to_builtins(message)))


def replace_undecoded(value: Any) -> Any:
    r"""Replace bytes of file names that are not UTF-8 by `\udcXX`, because messages are UTF-8."""
    match value:
        case str():
            return value.encode(errors="backslashreplace").decode()
        case dict():
            return {key: replace_undecoded(entry) for key, entry in value.items()}
        case list() | tuple():
            return [replace_undecoded(entry) for entry in value]
    return value


def decode(topic: bytes, body: bytes) -> Any:
    """Decode one message strictly; unknown keys are ignored.

    Returns
    -------
    Any
        A struct for `contact`, `finger/...`, `health`, `state`, `world` and `deformation`; a dict for `schema` and for
        `event`, which has further keys by kind.

    Raises
    ------
    ProtocolError
        If the message does not follow docs/protocol.md.
    """
    name = topic.decode("ascii", "replace")
    decoder = _DECODERS.get(CONTACT if name.startswith(FINGERS) else name)
    if decoder is None:
        raise ProtocolError(
            f"unknown topic {name[:40]!r}: expected one of {', '.join((*TOPICS, *SCENE_TOPICS))} or {FINGERS}NAME; "
            "check that no other program publishes here"
        )
    if len(body) > MAX_BYTES:
        raise ProtocolError(f"{name} message of {len(body)} bytes is longer than the limit {MAX_BYTES}")
    try:
        message: Any = decoder.decode(body)
        if name == STATE or message.schema == SCHEMA:  # a `state` message has no schema
            # msgpack, not msgspec, for the open map: it checks a declared length before it allocates.
            return msgpack.unpackb(body) if name in _OPEN else message
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        if name == STATE or _read_schema(body) in (SCHEMA, None):
            raise ProtocolError(f"{name} message does not follow the protocol: {error}") from error
    raise ProtocolError(
        f"{name} message has schema {_read_schema(body)}, this client understands {SCHEMA}: "
        "use the client of the server's version"
    )


class _SchemaOnly(msgspec.Struct):
    schema: int


def _read_schema(body: bytes) -> int | None:
    """Return the schema number in a message, None without one; used to explain why decoding failed."""
    try:
        return msgspec.msgpack.decode(body, type=_SchemaOnly).schema
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def describe_messages() -> dict[str, Any]:
    """Return all messages and their keys as plain data, for `softfinger schema`."""
    tables: dict[str, Sequence[Key]] = {CONTACT: CONTACT_KEYS, EVENT: EVENT_KEYS, HEALTH: HEALTH_KEYS}
    tables |= {STATE: STATE_KEYS, WORLD: WORLD_KEYS, DEFORMATION: DEFORMATION_KEYS, SCHEMA_TOPIC: SCHEMA_KEYS}
    tables |= {f"{EVENT} of kind {kind}": keys for kind, keys in EVENT_EXTRA_KEYS.items()}
    return {
        "schema": SCHEMA,
        "frames": ["topic", "msgpack map"],
        "messages": {name: [key._asdict() for key in keys] for name, keys in tables.items()},
    }
