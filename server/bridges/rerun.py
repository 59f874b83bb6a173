"""View of a recording or a live run in Rerun: objects, fingertips and forces in space, plots and events over time.

`world` is the scene. Below it are `objects/NAME`, objects on a body of [world] in `bodies/NAME`, and for each finger
its fingertip, its proxy and its force. `plots/...` are the telemetry's fields of these names at every tick; `events` is
a log. The timelines are `time` and `tick`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.schema import Body, Object, Scene
from softfinger.proxy.records import Records
from softfinger.server.recording import picture
from softfinger.server.recording.contents import read_recording
from softfinger.server.recording.reader import End, Event, Note, RecordedWorld, TickBlock
from softfinger.server.recording.writer import apply_drive, compute_event_time_ns, compute_times_ns, parse_scene
from softfinger.server.wire.protocol import WORLD

log: Final = logging.getLogger(__name__)

PLOTTED: Final = (
    "force", "torque", "contact.mode", "contact.penetration", "contact.spin", "contact.torsion", "servo.late",
)  # fmt: skip


def stream(save: Path | None = None, connect: str | None = None) -> Any:
    """Return a Rerun recording stream: into a file, to a running viewer, or to a viewer that is started here.

    Raises ConfigError if rerun-sdk is not installed, or if the file or viewer is not available.
    """
    try:
        import rerun
    except ImportError as error:
        raise ConfigError(f"rerun-sdk is not installed ({error}): pip install 'softfinger[rerun]'") from error
    stream: Any = rerun.RecordingStream("softfinger")
    try:
        if save is not None:
            stream.save(str(save))
        elif connect is not None:
            stream.connect_grpc(connect)
        else:
            stream.spawn()
    except RuntimeError as error:
        option = f"--save {save}" if save else f"--connect {connect}" if connect else "its viewer cannot be started"
        raise ConfigError(f"{option}: Rerun reports: {error}") from error
    return stream


class RerunSink:
    """Logs the data of a daemon or a recording to a Rerun stream."""

    def __init__(self, stream: Any, fingers: Sequence[str], scene: Scene | None) -> None:
        import rerun

        self._rr: Any = rerun
        self._stream = stream
        self._pictures = dict.fromkeys(fingers, np.nan)
        self._scene = scene
        stream.log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        radii = {finger.name: finger.radius_m for finger in scene.fingers} if scene else {}
        for name in fingers:
            ball = self._rr.Ellipsoids3D(radii=[radii.get(name, 0.01)], colors=[(230, 140, 90)])
            stream.log(f"world/{picture.list_frame_names(name)[0]}", ball, static=True)
            proxy = self._rr.Points3D([(0.0, 0.0, 0.0)], radii=[0.001], colors=[(255, 255, 255)])
            stream.log(f"world/{picture.list_frame_names(name)[1]}", proxy, static=True)
        self._draw_objects()

    def ticks(self, records: Array, finger: str) -> None:
        """Log records (n, RECORD_SIZE) of a finger."""
        rows = Records(records)
        for field in PLOTTED:
            path = f"plots/{finger}/{field}" if finger else f"plots/{field}"
            values = np.asarray(rows[field], np.float64).reshape(len(rows), -1)
            series = self._rr.Scalars.columns(scalars=values.ravel())
            self._send(path, rows, series.partition([values.shape[1]] * len(rows)))
        indices, self._pictures[finger] = picture.select_displayed(records, self._pictures[finger])
        if len(indices):
            self._send_poses(Records(records[indices]), finger)

    def event(self, event: Mapping[str, Any]) -> None:
        """Log an event, a map as on the wire."""
        self._stream.set_time("time", timestamp=np.datetime64(compute_event_time_ns(event), "ns"))
        self._stream.log("events", self._rr.TextLog(f"{event['kind']} {event['name']}: {event.get('message', '')}"))
        if self._scene is not None and (driven_scene := apply_drive(self._scene, event)) is not None:
            self._scene = driven_scene
            self._draw_objects()

    def message(self, topic: str, message: Mapping[str, Any]) -> None:
        """Log the poses in a message of `world`, a map as on the wire; other topics are not drawn."""
        if topic != WORLD:
            return
        self._stream.set_time("time", timestamp=np.datetime64(compute_event_time_ns(message), "ns"))
        self._stream.set_time("tick", sequence=message["tick"])
        for body in message["bodies"]:
            w, x, y, z = body["orientation"]
            transform = self._rr.Transform3D(translation=body["position"], quaternion=[x, y, z, w])
            self._stream.log(f"world/bodies/{body['name']}", transform)
        self._stream.disable_timeline("tick")

    def _send_poses(self, rows: Records, name: str) -> None:
        tip, proxy = (f"world/{frame}" for frame in picture.list_frame_names(name))
        rotation = rows["probe.orientation"][:, [1, 2, 3, 0]]  # Rerun expects w last
        transform = self._rr.Transform3D.columns
        self._send(tip, rows, transform(translation=rows["probe.position"], quaternion=rotation))
        self._send(proxy, rows, transform(translation=rows["proxy.position"], quaternion=rotation))
        arrows = self._rr.Arrows3D.columns(
            origins=rows["proxy.position"], vectors=picture.ARROW_M_PER_N * rows["force"]
        )
        self._send(f"world/{name}/force" if name else "world/force", rows, arrows)

    def _send(self, path: str, rows: Records, columns: Any) -> None:
        times = compute_times_ns(np.asarray(rows)).astype("datetime64[ns]")
        index = self._rr.TimeColumn
        time_columns = [index("time", timestamp=times), index("tick", sequence=rows["tick"])]
        self._stream.send_columns(path, time_columns, columns)

    def _draw_objects(self) -> None:
        for obj in self._scene.object if self._scene else ():
            for kind, primitives in picture.draw_object(obj).items():
                for number, primitive in enumerate(primitives):
                    path = f"{_make_entity_path(obj)}/{kind}{number}"
                    for part in self._iter_parts(kind, primitive):
                        self._stream.log(path, part, static=True)

    def _iter_parts(self, kind: str, primitive: Mapping[str, Any]) -> Iterator[Any]:
        rr, at = self._rr, primitive["pose"]
        yield rr.Transform3D(
            translation=list(at["position"].values()), quaternion=[at["orientation"][axis] for axis in "xyzw"]
        )
        color = [[round(255 * primitive["color"][part]) for part in "rgba"]]
        size = list(primitive.get("size", {}).values())
        if kind == "cubes":
            yield rr.Boxes3D(sizes=[size], colors=color, fill_mode="solid")
        elif kind == "spheres":
            yield rr.Ellipsoids3D(half_sizes=[[0.5 * side for side in size]], colors=color, fill_mode="solid")
        elif kind == "cylinders":
            yield rr.Cylinders3D(radii=[0.5 * size[0]], lengths=[size[2]], colors=color, fill_mode="solid")
        elif kind == "lines":
            points = [list(point.values()) for point in primitive["points"]]
            yield rr.LineStrips3D([[*points, points[0]]], radii=[0.5 * primitive["thickness"]], colors=color)
        elif kind == "triangles":
            points, indices = [list(point.values()) for point in primitive["points"]], primitive["indices"]
            yield rr.Mesh3D(
                vertex_positions=points, triangle_indices=np.reshape(indices, (-1, 3)), albedo_factor=color[0]
            )
        else:
            yield rr.Points3D([(0.0, 0.0, 0.0)], labels=[primitive["text"]], colors=color)


def _make_entity_path(obj: Object) -> str:
    motion = obj.motion
    return f"world/bodies/{motion.body}/{obj.name}" if isinstance(motion, Body) else f"world/objects/{obj.name}"


def show_recording(recording: str | Path, stream: Any) -> int:
    """Log a complete recording; return the number of ticks. Raises RecordingError if the file has nothing to show."""
    about: dict[str, Any] = {}
    fingers: list[str] = []
    for part in read_recording(recording):  # first pass: metadata and fingers
        if isinstance(part, Note):
            about[part.name] = part.value
        elif isinstance(part, TickBlock) and part.finger not in fingers:
            fingers.append(part.finger)
    sink, count = RerunSink(stream, fingers, parse_scene(about)), 0
    for part in read_recording(recording):
        if isinstance(part, TickBlock):
            sink.ticks(part.records(), part.finger)
            count += len(part.rows)
        elif isinstance(part, Event):
            sink.event(part.event)
        elif isinstance(part, RecordedWorld):
            sink.message(WORLD, part.world)
        elif isinstance(part, End) and part.cut:
            log.warning("%s is incomplete: %s", recording, part.cut)
    return count
