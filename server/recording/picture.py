"""Pictures of a run for general viewers: Foxglove messages with poses, frames and objects.

Objects are drawn at the pose of the scene or of the last `drive`; objects on a body of [world] are drawn in its frame.
An object with a motion of another kind is drawn at rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.proxy.heightmaps import read_heights, thin_map
from softfinger.proxy.pictures import make_relief
from softfinger.proxy.record import AT
from softfinger.server.recording.schemas import FRAME, POSE, SCENE, make_message_class

Record = NDArray[np.float64]

WORLD: Final = "world"
FINGERTIP: Final = "fingertip"
PROXY: Final = "proxy"
PLANE_M: Final = 0.3
"""Edge of the square drawn for a plane, and length of an infinite cylinder: half the workspace of a desktop device."""
SHEET_M: Final = 0.001
RING_POINTS: Final = 48
MAP_PIXELS: Final = 96
"""Maximum of drawn pixels along each side of a height map."""

_OBJECT: Final = {"r": 0.55, "g": 0.62, "b": 0.72, "a": 0.6}
_FINGER: Final = {"r": 0.9, "g": 0.55, "b": 0.35, "a": 0.9}
_FORCE: Final = {"r": 0.85, "g": 0.2, "b": 0.2, "a": 1.0}
_IDENTITY: Final = (1.0, 0.0, 0.0, 0.0)
DISPLAY_HZ: Final = 60.0
"""Pictures per second: the rate of a display."""
ARROW_M_PER_N: Final = 0.02
"""Length of a force arrow, m per N: 1 N is drawn twice as long as the radius of a fingertip."""


def select_displayed(records: Record, before: float) -> tuple[NDArray[np.int64], float]:
    """Return the indices of the records (n, RECORD_SIZE) to draw, and the number of the last picture.

    Parameters
    ----------
    before
        Number of the last picture, returned by the previous call; NaN for the first.
    """
    if not len(records):
        return np.empty(0, np.int64), before
    pictures = np.floor(records[:, AT.timestamp] * DISPLAY_HZ)
    return np.flatnonzero(pictures != np.concatenate(([before], pictures[:-1]))), float(pictures[-1])


def to_timestamp(time_ns: int) -> dict[str, int]:
    return {"seconds": time_ns // 10**9, "nanos": time_ns % 10**9}


def list_frame_names(finger: str) -> tuple[str, str]:
    return (f"{finger}/{FINGERTIP}", f"{finger}/{PROXY}") if finger else (FINGERTIP, PROXY)


def encode_pose(record: Record, time_ns: int) -> bytes:
    """Encode the measured pose of a record (RECORD_SIZE,)."""
    pose = _make_pose(_to_xyz(record, AT.probe_position), _to_wxyz(record, AT.probe_orientation))
    return _encode(POSE, timestamp=to_timestamp(time_ns), frame_id=WORLD, pose=pose)


def encode_frames(record: Record, time_ns: int, finger: str) -> list[bytes]:
    """Encode the frames of fingertip and proxy, both with the orientation of the fingertip."""
    orientation = _to_wxyz(record, AT.probe_orientation)
    positions = _to_xyz(record, AT.probe_position), _to_xyz(record, AT.proxy_position)
    return [
        _encode_frame(name, position, orientation, time_ns)
        for name, position in zip(list_frame_names(finger), positions, strict=True)
    ]


def name_body_frame(body: str) -> str:
    """Return the name of a body's frame, distinct from all frames of fingers."""
    return f"body/{body}"


def encode_bodies(bodies: Sequence[Mapping[str, Any]], time_ns: int) -> list[bytes]:
    return [
        _encode_frame(name_body_frame(body["name"]), body["position"], body["orientation"], time_ns) for body in bodies
    ]


def _encode_frame(name: str, position: Sequence[float], orientation: Sequence[float], time_ns: int) -> bytes:
    pose = {"translation": _make_vector(position), "rotation": _make_quaternion(orientation)}
    return _encode(FRAME, timestamp=to_timestamp(time_ns), parent_frame_id=WORLD, child_frame_id=name, **pose)


def encode_force(record: Record, time_ns: int, finger: str) -> bytes:
    """Encode the force on the hand as an arrow from the proxy."""
    force = record[AT.force : AT.force + 3]
    size = float(np.linalg.norm(force))
    name, timestamp = f"{list_frame_names(finger)[0]}/force", to_timestamp(time_ns)
    if not 0.0 < size < math.inf:
        return _encode(SCENE, deletions=[{"timestamp": timestamp, "type": 0, "id": name}])
    length = ARROW_M_PER_N * size
    arrow = {
        "pose": _make_pose(_to_xyz(record, AT.proxy_position), _make_rotation_from_x((force / size).tolist())),
        "shaft_length": 0.8 * length,
        "shaft_diameter": 0.001,
        "head_length": 0.2 * length,
        "head_diameter": 0.002,
        "color": _FORCE,
    }
    return _encode(SCENE, entities=[{"timestamp": timestamp, "frame_id": WORLD, "id": name, "arrows": [arrow]}])


def encode_scene(scene: schema.Scene, time_ns: int) -> bytes:
    """Encode every object and fingertip, complete, so that a viewer can start with any message."""
    timestamp = to_timestamp(time_ns)
    entities = [
        {"timestamp": timestamp, "frame_id": name_object_frame(obj), "id": obj.name, "frame_locked": True}
        | draw_object(obj)
        for obj in scene.object
    ]
    for finger in scene.fingers:
        _, frame = list_frame_names(finger.name)
        ball = {
            "pose": _make_pose((0.0, 0.0, 0.0)),
            "size": _make_vector([2.0 * finger.radius_m] * 3),
            "color": _FINGER,
        }
        entities.append(
            {"timestamp": timestamp, "frame_id": frame, "id": frame, "frame_locked": True, "spheres": [ball]}
        )
    return _encode(SCENE, entities=entities)


def name_object_frame(obj: schema.Object) -> str:
    return name_body_frame(obj.motion.body) if isinstance(obj.motion, schema.Body) else WORLD


def draw_object(obj: schema.Object) -> dict[str, Any]:
    """Return the primitives of an object; for shapes without a drawing function its name as a text."""
    at = _make_pose(obj.position_m, obj.orientation_wxyz)
    draw: Callable[[Any, Any], dict[str, Any]] | None = _SHAPES.get(obj.shape)
    if draw is None:
        return _draw_name(obj, at)
    return draw(obj, at)


def _draw_name(obj: schema.Object, at: Any) -> dict[str, Any]:
    return {"texts": [{"pose": at, "billboard": True, "font_size": 0.01, "color": _OBJECT, "text": obj.name}]}


def _make_cube(at: Any, size: Sequence[float]) -> dict[str, Any]:
    return {"cubes": [{"pose": at, "size": _make_vector(size), "color": _OBJECT}]}


def _make_ball(at: Any, size: Sequence[float]) -> dict[str, Any]:
    return {"spheres": [{"pose": at, "size": _make_vector(size), "color": _OBJECT}]}


def _make_tube(at: Any, radius: float, length: float) -> dict[str, Any]:
    size = _make_vector((2.0 * radius, 2.0 * radius, length))
    return {"cylinders": [{"pose": at, "size": size, "bottom_scale": 1.0, "top_scale": 1.0, "color": _OBJECT}]}


def _make_plane(obj: schema.Plane, at: Any) -> dict[str, Any]:
    below = _find_point_on_axis(obj, -0.5 * SHEET_M)  # its upper face is the plane
    return _make_cube(_make_pose(below, obj.orientation_wxyz), (PLANE_M, PLANE_M, SHEET_M))


def _make_capsule(obj: schema.Capsule, at: Any) -> dict[str, Any]:
    diameter = [2.0 * obj.radius_m] * 3
    ends = [_make_pose(_find_point_on_axis(obj, sign * 0.5 * obj.length_m)) for sign in (-1.0, 1.0)]
    balls = [{"pose": end, "size": _make_vector(diameter), "color": _OBJECT} for end in ends]
    return _make_tube(at, obj.radius_m, obj.length_m) | {"spheres": balls}


def _make_torus(obj: schema.Torus, at: Any) -> dict[str, Any]:
    angles = [2.0 * math.pi * k / RING_POINTS for k in range(RING_POINTS)]
    ring = [_make_vector((obj.major_radius_m * math.cos(a), obj.major_radius_m * math.sin(a), 0.0)) for a in angles]
    line = {"type": "LINE_LOOP", "pose": at, "thickness": 2.0 * obj.minor_radius_m, "points": ring, "color": _OBJECT}
    return {"lines": [line]}


def _make_heightmap(obj: schema.Heightmap, at: Any) -> dict[str, Any]:
    try:
        vertices, triangles = make_relief(*thin_map(read_heights(obj), obj.pitch_m, MAP_PIXELS))
    except ConfigError:  # the file was removed after the scene was loaded
        return _draw_name(obj, at)
    points, indices = [_make_vector(point) for point in vertices.tolist()], triangles.ravel().tolist()
    return {"triangles": [{"pose": at, "points": points, "color": _OBJECT, "indices": indices}]}


_SHAPES: Final[dict[str, Callable[[Any, Any], dict[str, Any]]]] = {
    "plane": _make_plane,
    "sphere": lambda obj, at: _make_ball(at, [2.0 * obj.radius_m] * 3),
    "cylinder": lambda obj, at: _make_tube(at, obj.radius_m, obj.length_m or PLANE_M),
    "capsule": _make_capsule,
    "box": lambda obj, at: _make_cube(at, obj.size_m),
    "ellipsoid": lambda obj, at: _make_ball(at, [2.0 * axis for axis in obj.semi_axes_m]),
    "torus": _make_torus,
    "heightmap": _make_heightmap,
}


def _find_point_on_axis(obj: schema.Object, along_z: float) -> tuple[float, ...]:
    """Return the point at `along_z` (m) on the object's z axis, world frame."""
    w, x, y, z = obj.orientation_wxyz
    axis = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
    return tuple(p + along_z * a for p, a in zip(obj.position_m, axis, strict=True))


def _encode(name: str, **fields: Any) -> bytes:
    return bytes(make_message_class(name)(**fields).SerializeToString())


def _make_pose(position: Sequence[float], orientation: Sequence[float] = _IDENTITY) -> dict[str, Any]:
    return {"position": _make_vector(position), "orientation": _make_quaternion(orientation)}


def _make_vector(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _make_quaternion(wxyz: Sequence[float]) -> dict[str, float]:
    return dict(zip("wxyz", wxyz, strict=True))


def _make_rotation_from_x(direction: Sequence[float]) -> tuple[float, ...]:
    """Return the unit quaternion of the shortest rotation from the x axis to a unit vector."""
    x, y, z = direction
    if x < -0.999999:
        return (0.0, 0.0, 0.0, 1.0)
    w = math.sqrt(0.5 * (1.0 + x))
    return (w, 0.0, -0.5 * z / w, 0.5 * y / w)


def _to_xyz(record: Record, at: int) -> list[float]:
    values: list[float] = record[at : at + 3].tolist()
    return values


def _to_wxyz(record: Record, at: int) -> list[float]:
    values: list[float] = record[at : at + 4].tolist()
    return values
