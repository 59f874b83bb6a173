"""Command protocol: a table of all methods with their parameters and results.

Requests (`envelope.py`), `softfinger schema`, the reference page, the clients and the help of `softfinger ctl` all use
the table METHODS.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypedDict

import msgspec
from msgspec import Meta, Struct, inspect

from softfinger.config.fields import Coordinate, Orientation, normalise_orientation
from softfinger.proxy.record import AT

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ErrorName = Literal["malformed", "unknown_method", "bad_params", "refused", "busy", "superseded", "expired", "failed"]

ERRORS: Final[dict[ErrorName, str]] = {
    "malformed": "the message does not have the envelope of a request",
    "unknown_method": "the method does not exist",
    "bad_params": "a parameter is missing, unknown, of another type or out of range",
    "refused": "the daemon cannot do this in its current state",
    "busy": "too many requests, or a scene is being replaced: repeat the request later",
    "superseded": "a later set_scene arrived before this one was compiled",
    "expired": "the client stopped waiting before the daemon handled the request: nothing was done",
    "failed": "a defect of the daemon; its log has details",
}
"""Names with which an error may start."""


class Empty(Struct, frozen=True, forbid_unknown_fields=True):
    """No parameters."""


Name = Annotated[str, Meta(min_length=1, max_length=256)]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class StateResult(Struct, frozen=True):
    """State of the first fingertip.

    `timestamp` is in s on CLOCK_MONOTONIC; position (m), velocity (m/s) and force (N) are in the world frame;
    `field_state` has `mode`, `object` and `penetration`.
    """

    timestamp: float
    sequence: int
    position: Vector
    velocity: Vector
    force: Vector
    active_field: str
    field_state: dict[str, Any]


class HeartbeatResult(Struct, frozen=True):
    """Time within which the next command must arrive, ms; 0: no heartbeat is required."""

    timeout_ms: int


VALUES: Final = (
    "Keys are those of the scene file, with the index or the name of an object or finger: "
    "`object.0.material.friction.static`, `object.table.material.friction.static`, `finger.thumb.radius_m`."
)
Values = Annotated[dict[Name, Any], Meta(min_length=1, max_length=1024, description=VALUES)]


class Change(Struct, frozen=True, rename={"before": "from", "after": "to"}):
    """Value before and after the change."""

    before: Any
    after: Any


class SetParamsResult(Struct, frozen=True):
    """Keys with a new value.

    `changed` has `from` and `to` of each. Parameters that act on the force reach their value `ramp_s` after `tick`.
    """

    changed: dict[str, Change]
    tick: int
    ramp_s: float = 0.0


class SetScene(Struct, frozen=True, forbid_unknown_fields=True):
    """Scene to render.

    `scene` is the name of a shipped scene, or the content of a scene file as a map. `overrides` are values as in
    `set_params`; `name` becomes `active_field`.
    """

    scene: Name | dict[str, Any]
    overrides: dict[Name, Any] = {}
    name: Annotated[str, Meta(max_length=64)] = ""


class SetSceneResult(Struct, frozen=True):
    """The new scene, and the first tick that renders it."""

    active_field: str
    tick: int


class Drive(Struct, frozen=True, forbid_unknown_fields=True):
    """Pose in the world of an object with `motion = { kind = "driven" }`.

    Without `orientation_wxyz` the orientation does not change.
    """

    object: Name | Annotated[int, Meta(ge=0)]
    position_m: Vector
    orientation_wxyz: Quaternion | msgspec.UnsetType = msgspec.UNSET


class HandTarget(Struct, frozen=True, forbid_unknown_fields=True):
    """Goal pose of the fingertip in the world.

    Without `orientation_wxyz` the orientation does not change. `release` returns the hand to the motion of its rig.
    """

    position_m: tuple[Coordinate, Coordinate, Coordinate] | msgspec.UnsetType = msgspec.UNSET
    orientation_wxyz: Orientation | msgspec.UnsetType = msgspec.UNSET
    finger: Name | Annotated[int, Meta(ge=0)] | msgspec.UnsetType = msgspec.UNSET
    release: bool = False

    def __post_init__(self) -> None:
        normalise_orientation(self)


class Hold(Struct, frozen=True, forbid_unknown_fields=True):
    """`finger` is a name or an index."""

    finger: Name | Annotated[int, Meta(ge=0)] | msgspec.UnsetType = msgspec.UNSET


class HandPose(Struct, frozen=True):
    """Goal pose of the hand in the world. In a grip it is deeper in the object than the fingertip."""

    position_m: Vector
    orientation_wxyz: Quaternion
    tick: int


class AppliedResult(Struct, frozen=True):
    """At least `tick` ticks had started without the change; the second tick after it has the change."""

    tick: int


class ArmResult(Struct, frozen=True):
    """`armed` is true if the force is on or fading in."""

    armed: bool


class Zero(Struct, frozen=True, forbid_unknown_fields=True):
    """`position_m` is the new position of the probe in the world; `reset` removes the offset."""

    position_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    finger: Name | Annotated[int, Meta(ge=0)] | msgspec.UnsetType = msgspec.UNSET
    reset: bool = False


class ZeroResult(Struct, frozen=True):
    """`offset_m` is added to the position that the device reports."""

    offset_m: Vector
    tick: int


class Mark(Struct, frozen=True, forbid_unknown_fields=True):
    """Label, and data to store with it."""

    label: Annotated[str, Meta(min_length=1, max_length=256)]
    data: dict[str, Any] = {}


CHOICE_LENGTH: Final = 64
CHOICES_MAX: Final = 21
"""Largest number of choices: the marks 0, 5, ..., 100 of the NASA-TLX."""
TEXT_ANSWER_MAX: Final = 1000
"""Largest number of characters in a free-text answer."""
IMAGE_BYTES_MAX: Final = 98304
"""Largest file of an image in a prompt; as base64 it fits into a request."""
Choice = Annotated[str, Meta(min_length=1, max_length=CHOICE_LENGTH)]


class Prompt(Struct, frozen=True, forbid_unknown_fields=True):
    """Prompt that pages show to the participant.

    It has a `title`, a `text` and a progress bar with `done` of `of` (0: no bar). The answer is one of `choices`, or a
    `number` from the first to the second value, or a free text of at most `text_length` characters. Without any of
    them it needs no answer. The participant's page also shows a patch of a `colour`, an `image` (a data URI), and plays
    a `masking_noise` with a `volume`.
    """

    title: Annotated[str, Meta(max_length=256)] = ""
    text: Annotated[str, Meta(max_length=4096)] = ""
    done: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    of: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    choices: Annotated[tuple[Choice, ...], Meta(max_length=CHOICES_MAX)] = ()
    number: tuple[float, float] | None = None
    text_length: Annotated[int, Meta(ge=0, le=TEXT_ANSWER_MAX)] = 0
    colour: Annotated[str, Meta(pattern=r"^(#[0-9a-fA-F]{6})?$")] = ""
    image: Annotated[
        str, Meta(max_length=150_000, pattern=r"^(data:image/(png|jpeg|webp);base64,[A-Za-z0-9+/=]+)?$")
    ] = ""
    masking_noise: Annotated[str, Meta(pattern="^(none|white|pink)$")] = "none"
    volume: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.2


class PromptScreen(TypedDict, total=False):
    """Keys of a prompt for the page of the participant only."""

    colour: str
    image: str
    masking_noise: str
    volume: float


class PromptResult(Struct, frozen=True):
    """Current prompt.

    `number` counts prompts; `open` is true while the prompt waits for an answer. `answer` arrived `after_s` after the
    prompt.
    """

    number: int
    prompt: Prompt
    open: bool
    answer: str | float | None = None
    after_s: float = 0.0


class Answer(Struct, frozen=True, forbid_unknown_fields=True):
    """Answer of the participant.

    `value` is one of the prompt's `choices`, a number or a text. `prompt` is the number of the prompt (default:
    current).
    """

    value: Annotated[str, Meta(min_length=1, max_length=TEXT_ANSWER_MAX)] | float
    prompt: Annotated[int, Meta(ge=0)] | None = None


class RecordStart(Struct, frozen=True, forbid_unknown_fields=True):
    """New file whose name ends in `.mcap`.

    Its folder exists below `[recording] directory` of the rig. Absolute paths, `..` and links are refused.
    """

    file: Name


class RecordStartResult(Struct, frozen=True):
    """File name, and the first tick that is recorded."""

    file: str
    tick: int


class RecordStopResult(Struct, frozen=True):
    """Result of a recording.

    `ticks` were written; `dropped` ticks and `events_dropped` events were lost because the disk was too slow. `error`
    is the reason if the recording ended early. `whole` is false while writes are pending. `worst_write_s` is the
    longest write.
    """

    file: str
    ticks: int
    dropped: int
    bytes: int
    error: str
    whole: bool
    events_dropped: int
    worst_write_s: float


class ObjectReference(Struct, frozen=True, forbid_unknown_fields=True):
    """An object of shape `mesh` or `heightmap`."""

    object: Name | Annotated[int, Meta(ge=0)]


class MeshResult(Struct, frozen=True):
    """Triangles of an object.

    `vertices` are x, y, z of each vertex in the object frame (m, float32), `triangles` three vertex indices each
    (uint32, counter-clockwise seen from outside), both little-endian. At most 50000 triangles are sent; `of` is their
    number in the file.
    """

    vertices: bytes
    triangles: bytes
    of: int


class StopResult(Struct, frozen=True):
    """The daemon is shutting down."""

    shutting_down: bool


class Method(NamedTuple):
    """Parameters, result and description of a method."""

    params: Any
    result: Any
    meaning: str


METHODS: Final = {
    "get_state": Method(Empty, StateResult, "Return the latest tick of the first finger."),
    "heartbeat": Method(Empty, HeartbeatResult, "Send a heartbeat; restores the force that a missed one removed."),
    "set_params": Method(
        Values, SetParamsResult, "Change parameters of the scene, all between the same two ticks or none."
    ),
    "set_scene": Method(SetScene, SetSceneResult, "Compile another scene, then switch to it at zero force."),
    "reset_world": Method(Empty, AppliedResult, "Return the bodies of [world] to their initial poses, at zero force."),
    "drive": Method(Drive, AppliedResult, "Set the pose of a driven object."),
    "hand": Method(HandTarget, AppliedResult, "Set the goal of the hand on a simulated device."),
    "hold": Method(Hold, HandPose, "Keep the current goal of the hand on a simulated device, and return it."),
    "arm": Method(Empty, ArmResult, "Fade the force in."),
    "disarm": Method(Empty, ArmResult, "Reduce the force to zero and keep it there."),
    "zero": Method(Zero, ZeroResult, "Define the current position of the probe; only while disarmed."),
    "mark": Method(Mark, AppliedResult, "Publish an event with a label."),
    "get_prompt": Method(Empty, PromptResult, "Return the prompt and its answer."),
    "set_prompt": Method(Prompt, PromptResult, "Show a text or a question on every page."),
    "answer": Method(Answer, AppliedResult, "Answer the question of the prompt; the first answer counts."),
    "record_start": Method(RecordStart, RecordStartResult, "Record every tick and event into a new MCAP file."),
    "record_stop": Method(Empty, RecordStopResult, "End the recording."),
    "describe": Method(Empty, dict[str, Any], "Return protocol, rig, scene, fingers, versions and compiled features."),
    "mesh": Method(ObjectReference, MeshResult, "Return the triangles of a mesh or height map, for display."),
    "stop": Method(Empty, StopResult, "End the daemon in order."),
}


def make_state(record: NDArray[np.float64], epoch_s: float, scene: str) -> StateResult:
    """Return the state of a record (RECORD_SIZE,); `epoch_s` is the offset of the epoch from CLOCK_MONOTONIC, s."""
    row = record.tolist()
    mode, touched, depth = row[AT.contact_mode], row[AT.contact_object], row[AT.contact_penetration]
    return StateResult(
        timestamp=row[AT.timestamp] - epoch_s,
        sequence=int(row[AT.tick]),
        position=tuple(row[AT.probe_position : AT.probe_position + 3]),
        velocity=tuple(row[AT.probe_velocity : AT.probe_velocity + 3]),
        force=tuple(row[AT.force : AT.force + 3]),
        active_field=scene,
        field_state={"mode": int(mode), "object": int(touched), "penetration": depth},
    )


@cache
def make_schema() -> dict[str, Any]:
    """Return all methods with the JSON Schema of their parameters and results, and all errors.

    It takes 6 ms, and each answer to `describe` contains it.
    """
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


def describe_fields(kind: Any) -> str:
    """Describe the fields of a map of this type for people; optional ones are in brackets."""
    info = inspect.type_info(kind)
    if isinstance(info, inspect.StructType):
        return ", ".join(map(_describe_field, info.fields))
    return "a value for each dotted key" if kind is Values else _describe_type(info)


def _describe_field(field: inspect.Field) -> str:
    text = f"{field.encode_name}: {_describe_type(field.type)}"
    return text if field.required else f"[{text}]"


_PLAIN: Final = {
    inspect.StrType: "text",
    inspect.BytesType: "bytes",
    inspect.IntType: "integer",
    inspect.FloatType: "number",
}


def _describe_type(info: inspect.Type) -> str:
    match info:
        case inspect.Metadata():
            return _describe_type(info.type)
        case inspect.UnionType():
            return " or ".join(
                _describe_type(member) for member in info.types if not isinstance(member, inspect.NoneType)
            )
        case inspect.TupleType():
            return f"{len(info.item_types)} numbers"
        case inspect.DictType() | inspect.StructType():
            return "map"
        case inspect.VarTupleType():
            return "list"
    return _PLAIN.get(type(info), "true or false")


def make_table() -> Mapping[str, tuple[str, str, str]]:
    """Return parameters, result and description of each method as text."""
    return {name: (describe_fields(m.params), describe_fields(m.result), m.meaning) for name, m in METHODS.items()}
