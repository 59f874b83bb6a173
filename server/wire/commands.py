"""Commands on the wire: the envelope, and a table of every method with what it takes and gives.

A request is `[empty, msgpack map]` with `command_id`, `method` and `params`, the answer `[empty, msgpack map]` with
`command_id`, `success`, `result` and `error`: hapticore's envelope. Parsing, `softfinger schema`, docs/protocol.md,
the clients and the help of `softfinger ctl` all go by the table METHODS. The text of an error begins with its name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, NamedTuple

import msgpack
import msgspec
import numpy as np
from msgspec import Meta, Struct, inspect
from numpy.typing import NDArray

from softfinger.config.schema import Coordinate
from softfinger.proxy.record import AT

DEPTH_MAX: Final = 16
"""Maps and lists within each other; a scene has 6."""
NODES_MAX: Final = 16384
"""Values in a request: a scene of 256 objects has some 8000."""

ERROR_MAX: Final = 4096
"""Longest text of an error: a scene may have a thousand faults."""

ErrorName = Literal["malformed", "unknown_method", "bad_params", "refused", "busy", "superseded", "failed"]

ERRORS: Final[dict[ErrorName, str]] = {
    "malformed": "the message is not the envelope",
    "unknown_method": "there is no such method",
    "bad_params": "a parameter is missing, unknown, of another type or out of range",
    "refused": "the daemon cannot do this as things are",
    "busy": "too many requests, or the rendering is being replaced: ask again later",
    "superseded": "a later set_scene came before this one was compiled",
    "failed": "a defect of the daemon, which says more in its log",
}
"""Every name that an error may begin with."""


class Declined(Exception):
    """A request that is not done; nothing has changed."""

    def __init__(self, name: ErrorName, text: str, command_id: str = "") -> None:
        super().__init__(f"{name}: {text[:ERROR_MAX]}")
        self.name, self.command_id = name, command_id


class Empty(Struct, frozen=True, forbid_unknown_fields=True):
    """No parameters, or nothing to say."""


Name = Annotated[str, Meta(min_length=1, max_length=256)]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class State(Struct, frozen=True):
    """The newest tick, of several fingers that of the first, as hapticore has it: s (CLOCK_MONOTONIC), ticks, m, m/s,
    N in the world frame."""

    timestamp: float
    sequence: int
    position: Vector
    velocity: Vector
    force: Vector
    active_field: str
    field_state: dict[str, Any]


class Alive(Struct, frozen=True):
    """Within how many ms the next command has to come; 0: none has to."""

    timeout_ms: int


Values = Annotated[dict[Name, Any], Meta(min_length=1, max_length=1024)]
"""Values by dotted key of the scene; an object or a finger is named by its number or its name."""


class Change(Struct, frozen=True, rename={"before": "from", "after": "to"}):
    """A value before and after."""

    before: Any
    after: Any


class Changed(Struct, frozen=True):
    """What has changed, by dotted key, how many ticks had begun without it at the least, and in how many seconds from
    then on what acts on the force is there."""

    changed: dict[str, Change]
    tick: int
    ramp_s: float = 0.0


class SetScene(Struct, frozen=True, forbid_unknown_fields=True):
    """The name of a shipped scene, or the scene as its file holds it; values in place of its own; what to call it."""

    scene: Name | dict[str, Any]
    overrides: dict[Name, Any] = {}
    name: Annotated[str, Meta(max_length=64)] = ""


class SceneSet(Struct, frozen=True):
    """The scene that is rendered now, and the first tick with it."""

    active_field: str
    tick: int


class Drive(Struct, frozen=True, forbid_unknown_fields=True):
    """An object whose motion is driven, by name or number, and its pose in the world; its orientation may stay."""

    object: Name | Annotated[int, Meta(ge=0)]
    position_m: Vector
    orientation_wxyz: Quaternion | msgspec.UnsetType = msgspec.UNSET


class Hand(Struct, frozen=True, forbid_unknown_fields=True):
    """Where a hand that is computed is to hold the fingertip, and how turned; of which of several fingers; or
    `release`, back to what it does by itself."""

    position_m: tuple[Coordinate, Coordinate, Coordinate] | msgspec.UnsetType = msgspec.UNSET
    orientation_wxyz: Quaternion | msgspec.UnsetType = msgspec.UNSET
    finger: Name | Annotated[int, Meta(ge=0)] | msgspec.UnsetType = msgspec.UNSET
    release: bool = False


class Applied(Struct, frozen=True):
    """How many ticks had begun without it at the least."""

    tick: int


class Armed(Struct, frozen=True):
    """Whether force is given, or fades in."""

    armed: bool


class Zero(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the probe is to be now; of which of several fingers, by name or number; or `reset`, no offset any more."""

    position_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    finger: Name | Annotated[int, Meta(ge=0)] | msgspec.UnsetType = msgspec.UNSET
    reset: bool = False


class Zeroed(Struct, frozen=True):
    """What is added to the position that the device says, m, and how many ticks had begun without it at the least."""

    offset_m: Vector
    tick: int


class Mark(Struct, frozen=True, forbid_unknown_fields=True):
    """A label, and what belongs to it."""

    label: Annotated[str, Meta(min_length=1, max_length=256)]
    data: dict[str, Any] = {}


class RecordStart(Struct, frozen=True, forbid_unknown_fields=True):
    """A new file, below the daemon's folder of recordings."""

    file: Name


class RecordStarted(Struct, frozen=True):
    """The file, and the tick from which on all are in it."""

    file: str
    tick: int


class RecordStopped(Struct, frozen=True):
    """The file; ticks that it has, and those that the disk was too slow for; what ended it early; whether all is
    written; events that the disk was too slow for, and the longest that a write took."""

    file: str
    ticks: int
    dropped: int
    bytes: int
    error: str
    whole: bool
    events_dropped: int
    worst_write_s: float


class OfObject(Struct, frozen=True, forbid_unknown_fields=True):
    """An object, by name or number."""

    object: Name | Annotated[int, Meta(ge=0)]


class Triangles(Struct, frozen=True):
    """A mesh or a height map in the frame of its object, for pictures: x, y, z of each vertex as float32, m, and three
    vertices of each triangle as uint32, little-endian; how many triangles there are where none is left out."""

    vertices: bytes
    triangles: bytes
    of: int


class Stopping(Struct, frozen=True):
    """The daemon ends."""

    shutting_down: bool


class Method(NamedTuple):
    """What a method takes and gives, and what it does."""

    params: Any
    result: Any
    meaning: str


METHODS: Final = {
    "get_state": Method(Empty, State, "the newest tick, of several fingers that of the first"),
    "heartbeat": Method(Empty, Alive, "a sign of life; gives the force back that was taken for want of one"),
    "set_params": Method(Values, Changed, "parameters of the scene, all of them between the same two ticks, or none"),
    "set_scene": Method(SetScene, SceneSet, "another scene: compiled, then put in from zero force"),
    "drive": Method(Drive, Applied, "the pose of a driven object"),
    "hand": Method(Hand, Applied, "where the hand on a simulated device wants to be"),
    "arm": Method(Empty, Armed, "the force fades in"),
    "disarm": Method(Empty, Armed, "the force fades out, and stays out"),
    "zero": Method(Zero, Zeroed, "the probe is at a position now; without force only"),
    "mark": Method(Mark, Applied, "an event with a label, into the telemetry"),
    "record_start": Method(RecordStart, RecordStarted, "every tick and event into a new MCAP file of the daemon's"),
    "record_stop": Method(Empty, RecordStopped, "the end of that"),
    "describe": Method(Empty, dict[str, Any], "wire, rig, scene, fingers, versions, and what was compiled"),
    "mesh": Method(OfObject, Triangles, "the triangles of an object that is a mesh or a height map, for a picture"),
    "stop": Method(Empty, Stopping, "the daemon ends in order"),
}
"""Every method."""


class Request(NamedTuple):
    """A request that is well-formed: `params` is what the table says."""

    command_id: str
    method: str
    params: Any


class _Envelope(Struct, frozen=True):
    """Keys besides are ignored, as hapticore's clients may send more."""

    command_id: Annotated[str, Meta(max_length=128)]
    method: Annotated[str, Meta(max_length=64)]
    params: dict[str, Any] = {}


def parse(body: bytes | None) -> Request:
    """A request's body, of bounded size; None stands for a message of other frames. Raises Declined."""
    if body is None:
        raise Declined("malformed", "a request has two frames: an empty one and a msgpack map")
    try:
        # msgpack, not msgspec: it checks a claimed length before it allocates, and its stack has an end.
        given = msgpack.unpackb(body)
    except Exception as error:  # of a dozen classes
        raise Declined("malformed", f"no msgpack: {type(error).__name__} {error}"[:200]) from error
    command_id = given.get("command_id") if isinstance(given, dict) else None
    command_id = command_id if isinstance(command_id, str) and len(command_id) <= 128 else ""
    if not _is_plain(given):
        raise Declined(
            "malformed", f"deeper than {DEPTH_MAX}, of more than {NODES_MAX} values, or not of plain ones", command_id
        )
    try:
        envelope = msgspec.convert(given, _Envelope)
    except msgspec.ValidationError as error:
        raise Declined("malformed", str(error), command_id) from error
    method = METHODS.get(envelope.method)
    if method is None:
        raise Declined("unknown_method", f"{envelope.method!r}: there are {', '.join(METHODS)}", command_id)
    try:
        params = msgspec.convert(envelope.params, method.params)
    except msgspec.ValidationError as error:
        raise Declined("bad_params", f"{envelope.method}: {error}", command_id) from error
    return Request(command_id, envelope.method, params)


def _is_plain(given: Any) -> bool:
    """Whether a decoded value is of JSON's types with texts as keys, and bounded; without recursion."""
    level, nodes = [given], 0
    for _ in range(DEPTH_MAX + 1):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                if not all(isinstance(key, str) for key in value):
                    return False
                below += value.values()
            elif isinstance(value, list):
                below += value
            elif not (value is None or isinstance(value, bool | int | float | str)):
                return False
        if not below:
            return True
        nodes += len(below)
        if nodes > NODES_MAX:
            return False
        level = below
    return False


_ENCODER: Final = msgspec.msgpack.Encoder()


def answered(command_id: str, result: Any) -> bytes:
    """The answer to what was done."""
    return _ENCODER.encode({"command_id": command_id, "success": True, "result": result, "error": None})


def declined(reason: Declined, command_id: str = "") -> bytes:
    """The answer to what was not done."""
    said = {"command_id": reason.command_id or command_id, "success": False, "result": {}, "error": str(reason)}
    return _ENCODER.encode(said)


def state_of(record: NDArray[np.float64], epoch_s: float, scene: str) -> State:
    """State of a record (RECORD_SIZE,); `epoch_s` is the epoch's offset to CLOCK_MONOTONIC, s."""
    row = record.tolist()
    mode, touched, depth = row[AT.contact_mode], row[AT.contact_object], row[AT.contact_penetration]
    return State(
        timestamp=row[AT.timestamp] - epoch_s,
        sequence=int(row[AT.tick]),
        position=tuple(row[AT.probe_position : AT.probe_position + 3]),
        velocity=tuple(row[AT.probe_velocity : AT.probe_velocity + 3]),
        force=tuple(row[AT.force : AT.force + 3]),
        active_field=scene,
        field_state={"mode": int(mode), "object": int(touched), "penetration": depth},
    )


def schema() -> dict[str, Any]:
    """Every method with the JSON Schema of its parameters and its result, and the errors."""
    return {
        "title": "Commands",
        "frames": ["", "msgpack map"],
        "request": ["command_id", "method", "params"],
        "answer": ["command_id", "success", "result", "error"],
        "methods": {
            name: {
                "meaning": method.meaning,
                "params": msgspec.json.schema(method.params),
                "result": msgspec.json.schema(method.result),
            }
            for name, method in METHODS.items()
        },
        "errors": dict(ERRORS),
    }


def fields(kind: Any) -> str:
    """What a map of this type holds, for people; what stands in brackets may be left out."""
    info = inspect.type_info(kind)
    if isinstance(info, inspect.StructType):
        return ", ".join(map(_field, info.fields))
    return "a value for each dotted key" if kind is Values else _words(info)


def _field(field: inspect.Field) -> str:
    said = f"{field.encode_name}: {_words(field.type)}"
    return said if field.required else f"[{said}]"


_PLAIN: Final = {
    inspect.StrType: "text",
    inspect.BytesType: "bytes",
    inspect.IntType: "integer",
    inspect.FloatType: "number",
}


def _words(info: inspect.Type) -> str:
    match info:
        case inspect.Metadata():
            return _words(info.type)
        case inspect.UnionType():
            return " or ".join(_words(each) for each in info.types if not isinstance(each, inspect.NoneType))
        case inspect.TupleType():
            return f"{len(info.item_types)} numbers"
        case inspect.DictType():
            return "map"
    return _PLAIN.get(type(info), "true or false")


def table() -> Mapping[str, tuple[str, str, str]]:
    """For each method its parameters, its result and what it does, in words."""
    return {name: (fields(m.params), fields(m.result), m.meaning) for name, m in METHODS.items()}
