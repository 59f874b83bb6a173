"""Writing of a recording: ticks, events, pictures for viewers, and metadata of the run.

Topics: `contact`, or `finger/NAME` for each of several fingers, with every tick; `event`, and `mark` for marks; `pose`,
`tf`, `scene` and `forces` as Foxglove messages at the rate of a display. docs/operate/recordings.md lists them.
"""

from __future__ import annotations

import contextlib
import json
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from typing import IO, Any, Final, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.proxy.record import AT, FIELDS
from softfinger.server.recording import picture, schemas
from softfinger.server.recording.layout import make_tick_layout
from softfinger.server.recording.mcapfile import McapFile
from softfinger.server.wire.protocol import WORLD, name_contact_topic

Bytes = NDArray[np.uint8]
Times = NDArray[np.int64]

EVENT_TOPIC: Final = "event"
MARK_TOPIC: Final = "mark"
POSE_TOPIC: Final = "pose"
FRAME_TOPIC: Final = "tf"
SCENE_TOPIC: Final = "scene"
FORCE_TOPIC: Final = "forces"
LOG_TOPIC: Final = "log"
SCENE_PERIOD_S: Final = 1.0
"""After seeking, a player has the scene within this time."""
JSON: Final = "json"
"""Key of the JSON text in each table of metadata."""

_NS: Final = 1e9
_INTEGER_COLUMNS: Final = [field.at for field in FIELDS if field.kind == "int"]
_TIME_MAX_S: Final = 9e9  # MCAP times range from 1970 to 2554

PACKAGES: Final = ("softfinger", "numpy", "numba", "llvmlite", "msgspec", "pyzmq")


@cache
def list_package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that determine results: the table `versions` of a recording."""
    return {"python": platform.python_version()} | {name: version(name) for name in PACKAGES}


class MessageSink(Protocol):
    """Receiver of messages: a file or a server."""

    def channel(self, topic: str, schema: str, descriptors: bytes) -> int:
        """Return the number of a new topic with protobuf messages of this type."""

    def message(self, channel: int, time_ns: int, data: bytes) -> None:
        """Write one message."""

    def block(self, channel: int, times_ns: Times, messages: Bytes, sequences: NDArray[np.int64]) -> None:
        """Write messages (n, size) with their times (n,)."""


class Topics:
    """Writer of a run's messages to their topics.

    Parameters
    ----------
    fingers
        Names of several fingers; one empty name for a single finger.
    scene
        Scene to draw in addition to the fingers; None: no scene.
    with_pictures
        Whether to write the topics for viewers.
    """

    def __init__(
        self,
        sink: MessageSink,
        fingers: Sequence[str] = ("",),
        scene: schema.Scene | None = None,
        with_pictures: bool = True,
    ) -> None:
        self._sink = sink
        self._layout = make_tick_layout()
        ticks = schemas.make_descriptor_set(schemas.TICK)
        self._ticks = {finger: sink.channel(name_contact_topic(finger), schemas.TICK, ticks) for finger in fingers}
        self._topics: dict[str, int] = {}
        self._with_pictures = with_pictures
        self._last_pictures: dict[str, float] = {}
        self._scene = scene
        self._scene_due_s = 0.0

    def ticks(self, records: Array, finger: str = "") -> None:
        """Write records (n, RECORD_SIZE) of a finger; raises ValueError if an integer field has a fraction."""
        messages = np.empty((len(records), self._layout.size), np.uint8)
        self._layout.encode(records, messages)
        times = compute_times_ns(records)
        sequences = records[:, AT.tick].astype(np.int64) & 0xFFFFFFFF
        self._sink.block(self._ticks[finger], times, messages, sequences)
        if self._with_pictures:
            self._draw(records, times, finger)

    def event(self, event: Mapping[str, Any]) -> None:
        """Write an event, a map as on the wire."""
        topic = MARK_TOPIC if event["kind"] == "mark" else EVENT_TOPIC
        self._add(topic, schemas.EVENT, compute_event_time_ns(event), schemas.encode_event(event))
        if self._scene is not None and (driven_scene := apply_drive(self._scene, event)) is not None:
            self.set_scene(driven_scene)

    def message(self, topic: str, message: Mapping[str, Any]) -> None:
        """Write a message of a topic of the scene, a map as on the wire."""
        time_ns = compute_event_time_ns(message)
        self._add(topic, schemas.TOPIC_TYPES[topic], time_ns, schemas.encode_topic(topic, message))
        if self._with_pictures and topic == WORLD:
            for frame in picture.encode_bodies(message["bodies"], time_ns):
                self._add(FRAME_TOPIC, schemas.FRAME, time_ns, frame)

    def log(self, time_s: float, level: int, name: str, text: str) -> None:
        """Write a line of the log: time (s) since the epoch, level of `logging`, name of the logger, text."""
        time_ns = compute_event_time_ns({"timestamp": time_s})
        self._add(LOG_TOPIC, schemas.LOG, time_ns, schemas.log_message(time_ns, level, name, text))

    def set_scene(self, scene: schema.Scene) -> None:
        self._scene, self._scene_due_s = scene, 0.0

    def _draw(self, records: Array, times: NDArray[np.int64], finger: str) -> None:
        rows, self._last_pictures[finger] = picture.select_displayed(records, self._last_pictures.get(finger, np.nan))
        for row in rows:
            time_ns = int(times[row])
            at = f"{POSE_TOPIC}/{finger}" if finger else POSE_TOPIC
            self._add(at, schemas.POSE, time_ns, picture.encode_pose(records[row], time_ns))
            for message in picture.encode_frames(records[row], time_ns, finger):
                self._add(FRAME_TOPIC, schemas.FRAME, time_ns, message)
            self._add(FORCE_TOPIC, schemas.SCENE, time_ns, picture.encode_force(records[row], time_ns, finger))
            now = float(records[row, AT.timestamp])
            if self._scene is not None and now >= self._scene_due_s:
                self._scene_due_s = now + SCENE_PERIOD_S
                self._add(SCENE_TOPIC, schemas.SCENE, time_ns, picture.encode_scene(self._scene, time_ns))

    def _add(self, topic: str, kind: str, time_ns: int, message: bytes) -> None:
        if topic not in self._topics:
            self._topics[topic] = self._sink.channel(topic, kind, schemas.make_descriptor_set(kind))
        self._sink.message(self._topics[topic], time_ns, message)


class RecordingFile(Topics):
    """Recording in an unbuffered file, which `close` closes; errors of the file are raised unchanged.

    Parameters
    ----------
    file
        Open, empty file.
    fingers
        Names of several fingers; one empty name for a single finger.
    about
        Tables of metadata by name; the scene in `scene` is drawn.
    with_pictures
        Whether to write the topics for viewers.
    """

    def __init__(
        self,
        file: IO[bytes],
        fingers: Sequence[str] = ("",),
        about: Mapping[str, Any] | None = None,
        with_pictures: bool = True,
    ) -> None:
        self._file = file
        try:
            self.mcap: Final = McapFile(file)
            for name, value in (about or {}).items():
                self.note(name, value)
            super().__init__(self.mcap, fingers, parse_scene(about or {}) if with_pictures else None, with_pictures)
        except BaseException:
            file.close()
            raise

    def note(self, name: str, value: Any) -> None:
        self.mcap.metadata(name, {JSON: json.dumps(value)})

    def count(self, finger: str = "") -> int:
        return self.mcap.counts.get(self._ticks[finger], 0)

    def flush(self) -> None:
        self.mcap.flush()

    def close(self) -> None:
        """Write pending messages and the index, and close the file even if that fails; may be called repeatedly."""
        if not self._file.closed:
            try:
                self.mcap.finish()
            except OSError:
                self.close_early()
                raise
            finally:
                self._file.close()

    def close_early(self) -> None:
        """Close the file after a failed write: it has all complete chunks, and no index; may be called repeatedly."""
        if not self._file.closed:
            with self._file, contextlib.suppress(OSError):
                self.mcap.finish_without_summary()


def round_integer_fields(records: Array) -> Array:
    """Round the integer fields of records (n, RECORD_SIZE) in place; non-finite ones, of a damaged record, become 0."""
    records[:, _INTEGER_COLUMNS] = np.rint(np.nan_to_num(records[:, _INTEGER_COLUMNS], nan=0.0, posinf=0.0, neginf=0.0))
    return records


def compute_times_ns(records: Array) -> NDArray[np.int64]:
    """Return the times of records (n, RECORD_SIZE) in nanoseconds since the epoch, clamped to the range of MCAP."""
    seconds = np.nan_to_num(records[:, AT.timestamp], nan=0.0, posinf=0.0, neginf=0.0)
    return np.rint(np.clip(seconds, 0.0, _TIME_MAX_S) * _NS).astype(np.int64)


def compute_event_time_ns(event: Mapping[str, Any]) -> int:
    """Return the time of an event or message in nanoseconds since the epoch, clamped to the range of MCAP."""
    return round(min(max(float(event["timestamp"]), 0.0), _TIME_MAX_S) * _NS)


def parse_scene(about: Mapping[str, Any]) -> schema.Scene | None:
    """Return the scene in a daemon's description; None if it has no scene that can be drawn."""
    try:
        return build(schema.Scene, about["scene"], "scene")
    except (KeyError, ConfigError):  # unknown scene, or shapes that are not installed here
        return None


def apply_drive(scene: schema.Scene, event: Mapping[str, Any]) -> schema.Scene | None:
    """Return the scene with the pose set by an event of `drive`; None for other events."""
    content = event.get("what")
    if (event["kind"], event["name"]) != ("command", "drive") or not isinstance(content, dict):
        return None
    pose = {key: tuple(content[key]) for key in ("position_m", "orientation_wxyz") if key in content}
    return msgspec.structs.replace(
        scene,
        object=tuple(
            msgspec.structs.replace(obj, **pose) if obj.name == content.get("object") else obj for obj in scene.object
        ),
    )
