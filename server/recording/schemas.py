"""Protobuf message types of a recording: descriptors built at run time and stored in the file.

Ticks follow the record table, and events the table of the wire. Messages of Foxglove's well-known types are recorded in
addition, so that its 3-D panel and Rerun can draw the run without knowing this program. Source of their fields:
https://github.com/foxglove/foxglove-sdk, schemas/proto/foxglove.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Final

import msgspec

from softfinger.proxy.record import FIELDS
from softfinger.server.wire import protocol
from softfinger.server.wire.protocol import EVENT_EXTRA_KEYS, EVENT_KEYS, Key

TICK: Final = "softfinger.Tick"
EVENT: Final = "softfinger.Event"
TOPIC_TYPES: Final = {protocol.WORLD: "softfinger.World", protocol.DEFORMATION: "softfinger.Deformation"}
"""Message types of the topics of a scene."""
POSE: Final = "foxglove.PoseInFrame"
FRAME: Final = "foxglove.FrameTransform"
SCENE: Final = "foxglove.SceneUpdate"
LOG: Final = "foxglove.Log"

REST_KEY: Final = "more"
"""Field of an event with all values that have no other field, as JSON: maps, and keys that are in no table."""

# Message: types and names of its fields in the order of their numbers, from 1. [X]: repeated; A|B: an enumeration.
_FOXGLOVE: Final = {
    "Vector3": "double x, double y, double z",
    "Point3": "double x, double y, double z",
    "Quaternion": "double x, double y, double z, double w",
    "Color": "double r, double g, double b, double a",
    "Pose": "Vector3 position, Quaternion orientation",
    "KeyValuePair": "string key, string value",
    "PoseInFrame": "google.protobuf.Timestamp timestamp, string frame_id, Pose pose",
    "Log": (
        "google.protobuf.Timestamp timestamp, UNKNOWN|DEBUG|INFO|WARNING|ERROR|FATAL level, "
        "string message, string name, string file, fixed32 line"
    ),
    "FrameTransform": (
        "google.protobuf.Timestamp timestamp, string parent_frame_id, string child_frame_id, "
        "Vector3 translation, Quaternion rotation"
    ),
    "ArrowPrimitive": (
        "Pose pose, double shaft_length, double shaft_diameter, double head_length, double head_diameter, Color color"
    ),
    "CubePrimitive": "Pose pose, Vector3 size, Color color",
    "SpherePrimitive": "Pose pose, Vector3 size, Color color",
    "CylinderPrimitive": "Pose pose, Vector3 size, double bottom_scale, double top_scale, Color color",
    "LinePrimitive": (
        "LINE_STRIP|LINE_LOOP|LINE_LIST type, Pose pose, double thickness, bool scale_invariant, "
        "[Point3] points, Color color, [Color] colors, [fixed32] indices"
    ),
    "TriangleListPrimitive": "Pose pose, [Point3] points, Color color, [Color] colors, [fixed32] indices",
    "TextPrimitive": "Pose pose, bool billboard, double font_size, bool scale_invariant, Color color, string text",
    "ModelPrimitive": (
        "Pose pose, Vector3 scale, Color color, bool override_color, string url, string media_type, bytes data"
    ),
    "SceneEntityDeletion": "google.protobuf.Timestamp timestamp, MATCHING_ID|ALL type, string id",
    "SceneEntity": (
        "google.protobuf.Timestamp timestamp, string frame_id, string id, "
        "google.protobuf.Duration lifetime, bool frame_locked, [KeyValuePair] metadata, "
        "[ArrowPrimitive] arrows, [CubePrimitive] cubes, [SpherePrimitive] spheres, "
        "[CylinderPrimitive] cylinders, [LinePrimitive] lines, [TriangleListPrimitive] triangles, "
        "[TextPrimitive] texts, [ModelPrimitive] models"
    ),
    "SceneUpdate": "[SceneEntityDeletion] deletions, [SceneEntity] entities",
}

_LISTS: Final = {
    TOPIC_TYPES[protocol.WORLD]: (protocol.WORLD_KEYS, "Body"),
    TOPIC_TYPES[protocol.DEFORMATION]: (protocol.DEFORMATION_KEYS, "Load"),
}
"""Keys of each of these types, and the type of the elements of its list."""
_BODY_PARTS: Final = (("position", 3), ("orientation", 4), ("velocity", 3), ("rate", 3))
_EVENT_FIELDS: Final = {
    key.name: key.type
    for keys in (EVENT_KEYS, *EVENT_EXTRA_KEYS.values())
    for key in keys
    if not key.type.startswith("map")
}
_PLAIN: Final = {"int": "sfixed64", "float": "double", "str": "string"}


@cache
def make_descriptor_set(name: str) -> bytes:
    """Return a message type and its dependencies as a serialized FileDescriptorSet.

    Dotted names of ticks become nested messages. Integers are sfixed64, so that every tick has the same length and
    layout.
    """
    from google.protobuf import descriptor_pb2

    files = descriptor_pb2.FileDescriptorSet()
    package, _, root = name.partition(".")
    if package == "foxglove":
        _add_foxglove(files, root, set())
    else:
        file = files.file.add(name=f"softfinger/{root.lower()}.proto", package=package, syntax="proto3")
        message = file.message_type.add(name=root)
        if name == TICK:
            _add_ticks(message)
        elif name in _LISTS:
            _add_list(message, *_LISTS[name])
        else:
            for key, kind in _EVENT_FIELDS.items():
                plain, _, size = kind.partition("[")
                _add_field(message, key, f"[{_PLAIN[plain]}]" if size else _PLAIN[plain])
            _add_field(message, REST_KEY, "string")
    return bytes(files.SerializeToString(deterministic=True))


@cache
def make_message_class(name: str) -> Any:
    """Return the class of a message type of this program's recordings."""
    return load_message_class(make_descriptor_set(name), name)


def load_message_class(descriptors: bytes, name: str) -> Any:
    """Return the class of a message type in a FileDescriptorSet; damaged descriptors raise the library's exceptions."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def encode_event(event: Mapping[str, Any]) -> bytes:
    """Encode an event, a map as on the wire."""
    names = {key.name for key in _list_keys(event)}
    fields = {key: value for key, value in event.items() if key in names and key in _EVENT_FIELDS}
    # A value may have a type of the wire, such as the change of a parameter.
    more = msgspec.to_builtins({key: value for key, value in event.items() if key not in fields})
    # `from` is a keyword in Python and cannot be a keyword argument.
    message = make_message_class(EVENT)(**fields | ({REST_KEY: json.dumps(more)} if more else {}))
    return bytes(message.SerializeToString())


def encode_topic(topic: str, message: Mapping[str, Any]) -> bytes:
    """Encode a message of a topic of the scene, a map as on the wire."""
    return bytes(make_message_class(TOPIC_TYPES[topic])(**message).SerializeToString())


def log_message(time_ns: int, level: int, name: str, text: str) -> bytes:
    """Encode a line of the log; Foxglove numbers levels from 1, `logging` in steps of ten."""
    message = make_message_class(LOG)(level=min(max(level // 10, 0), 5), message=text, name=name)
    message.timestamp.FromNanoseconds(time_ns)
    return bytes(message.SerializeToString())


def decode_event(message: Any) -> dict[str, Any]:
    """Return the map of a decoded event, without keys that the file does not have."""
    head = {"kind": message.kind}
    names = [key.name for key in _list_keys(head) if key.name in message.DESCRIPTOR.fields_by_name]
    event = {name: getattr(message, name) for name in names if name in _EVENT_FIELDS}
    event = {name: list(value) if _EVENT_FIELDS[name].endswith("]") else value for name, value in event.items()}
    more = json.loads(message.more) if message.more else {}
    return event | (more if isinstance(more, dict) else {})


def decode_world(message: Any) -> dict[str, Any]:
    """Return the map of a decoded message of `world`; raises ValueError for a body with a wrong number of values."""
    bodies = []
    for body in message.bodies:
        values = {"name": body.name} | {name: list(getattr(body, name)) for name, _ in _BODY_PARTS}
        if any(len(values[name]) != size for name, size in _BODY_PARTS):
            raise ValueError(f"the body {body.name[:40]!r} has other numbers than a pose and its rates")
        bodies.append(values)
    return {"schema": message.schema, "timestamp": message.timestamp, "tick": message.tick, "bodies": bodies}


def _list_keys(event: Mapping[str, Any]) -> Iterator[Key]:
    yield from EVENT_KEYS
    yield from EVENT_EXTRA_KEYS.get(event["kind"], ())


def _add_ticks(top: Any) -> None:
    nested: dict[str, Any] = {}
    for field in FIELDS:
        message, parent_type = top, f".{TICK}"
        *parents, leaf = field.name.split(".")
        for depth, parent in enumerate(parents):
            type_name, key = parent.capitalize(), ".".join(parents[: depth + 1])
            parent_type = f"{parent_type}.{type_name}"
            if key not in nested:
                nested[key] = message.nested_type.add(name=type_name)
                _add_field(message, parent, parent_type)
            message = nested[key]
        plain = _PLAIN[field.kind]
        _add_field(message, leaf, f"[{plain}]" if field.size > 1 else plain)


def _add_list(message: Any, keys: Sequence[Key], nested: str) -> None:
    """Add the keys of a topic with one list of maps; the keys of an element form a message of the type `nested`."""
    element, list_name = message.nested_type.add(name=nested), ""
    for key in keys:
        plain, _, size = key.type.partition("[")
        parent, _, name = key.name.rpartition(".")
        list_name = parent or list_name
        _add_field(element if parent else message, name, f"[{_PLAIN[plain]}]" if size else _PLAIN[plain])
    _add_field(message, list_name.removesuffix("[]"), f"[.softfinger.{message.name}.{nested}]")


def _add_foxglove(files: Any, name: str, added: set[str]) -> None:
    """Add one file per Foxglove message, dependencies first, as in Foxglove's schemas."""
    from google.protobuf import duration_pb2, timestamp_pb2

    well_known = {"google.protobuf.Timestamp": timestamp_pb2, "google.protobuf.Duration": duration_pb2}
    fields = [field.split(" ") for field in _FOXGLOVE[name].split(", ")]
    added.add(name)
    paths: dict[str, str] = {}
    for kind in [kind.strip("[]") for kind, _ in fields]:
        if kind in well_known:
            paths[kind] = well_known[kind].DESCRIPTOR.name
            if kind not in added:
                well_known[kind].DESCRIPTOR.CopyToProto(files.file.add())
        elif kind in _FOXGLOVE:
            paths[kind] = f"foxglove/{kind}.proto"
            if kind not in added:
                _add_foxglove(files, kind, added)
        added.add(kind)
    file = files.file.add(name=f"foxglove/{name}.proto", package="foxglove", syntax="proto3")
    file.dependency.extend(paths.values())
    message = file.message_type.add(name=name)
    for kind, key in fields:
        bare = kind.strip("[]")
        if "|" in kind:
            values = message.enum_type.add(name=key.capitalize())
            for number, value in enumerate(kind.split("|")):
                values.value.add(name=value, number=number)
            kind = f".foxglove.{name}.{key.capitalize()}="
        elif bare in paths:
            kind = kind.replace(bare, f".{bare}" if bare in well_known else f".foxglove.{bare}")
        _add_field(message, key, kind)


def _add_field(message: Any, name: str, kind: str) -> None:
    """Add a field with the next number. kind: a plain type, `.a.Message`, `.an.Enumeration=`; in [] if repeated."""
    from google.protobuf import descriptor_pb2

    kinds = descriptor_pb2.FieldDescriptorProto
    bare = kind.strip("[]")
    label = kinds.LABEL_REPEATED if kind.startswith("[") else kinds.LABEL_OPTIONAL
    field = message.field.add(name=name, number=len(message.field) + 1, label=label)
    if not bare.startswith("."):
        field.type = kinds.Type.Value(f"TYPE_{bare.upper()}")
    else:
        field.type = kinds.TYPE_ENUM if bare.endswith("=") else kinds.TYPE_MESSAGE
        field.type_name = bare.removesuffix("=")
