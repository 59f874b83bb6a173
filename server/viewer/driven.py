"""Driven and moving objects: their poses during a recording, and handles to move them on the page."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NamedTuple

import msgspec

from softfinger.config import schema
from softfinger.server.viewer.nodes.glyphs import PoseTuple, Quaternion
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.wire import commands

Vector = tuple[float, float, float]

CONTROL_SIZE_CM: Final = 3.0
"""Distance from the centre of an object to the tips of its arrows."""


class DriveEvent(NamedTuple):
    """Tick, index of the driven object, and its new pose: position (3,) m and orientation; None: unchanged."""

    tick: int
    scene_index: int
    position: Vector
    orientation: Quaternion | None


def parse_drive(event: Mapping[str, Any], scene: schema.Scene) -> DriveEvent | None:
    """Return the drive in an event; None for other events and for objects that the scene does not have."""
    if (event["kind"], event["name"]) != ("command", "drive"):
        return None
    try:
        command = msgspec.convert(event.get("what"), commands.Drive)
    except msgspec.ValidationError:  # a recording may contain any value
        return None
    scene_index = next((k for k, obj in enumerate(scene.object) if obj.name == command.object), None)
    if scene_index is None:  # an object of another scene
        return None
    orientation = command.orientation_wxyz
    return DriveEvent(
        event["tick"], scene_index, command.position_m, None if orientation is msgspec.UNSET else orientation
    )


def find_initial_poses(scene: schema.Scene) -> dict[int, PoseTuple]:
    """Return the driven objects of a scene by index, with their initial poses."""
    return {
        scene_index: (obj.position_m, obj.orientation_wxyz)
        for scene_index, obj in enumerate(scene.object)
        if isinstance(obj.motion, schema.Driven)
    }


class DrivenPoses:
    """Poses of the driven objects at each tick of a recording, from its events in order of time."""

    def __init__(self, scene: schema.Scene, events: Iterable[Mapping[str, Any]]) -> None:
        self._poses = {scene_index: [pose] for scene_index, pose in find_initial_poses(scene).items()}
        self._ticks: dict[int, list[int]] = {scene_index: [] for scene_index in self._poses}
        for drive in filter(None, (parse_drive(event, scene) for event in events)):
            if drive.scene_index in self._poses:
                poses = self._poses[drive.scene_index]
                poses.append((drive.position, drive.orientation or poses[-1][1]))
                self._ticks[drive.scene_index].append(drive.tick)

    def at(self, tick: int) -> dict[int, PoseTuple]:
        return {
            scene_index: poses[bisect_right(self._ticks[scene_index], tick)]
            for scene_index, poses in self._poses.items()
        }


class RecordedBodies:
    """Poses of the bodies at each tick of a recording, from its messages of `world` in order of time."""

    def __init__(self, messages: Iterable[Mapping[str, Any]]) -> None:
        self._messages = list(messages)
        self._ticks = [message["tick"] for message in self._messages]

    def at(self, tick: int) -> dict[str, PoseTuple]:
        """Return the poses by body name; empty before the first message."""
        last = bisect_right(self._ticks, tick) - 1
        bodies = self._messages[last]["bodies"] if last >= 0 else ()
        return {body["name"]: (tuple(body["position"]), tuple(body["orientation"])) for body in bodies}


class ObjectControls:
    """Transform controls on each driven object, if switched on; `send(index, pose)` commands the daemon."""

    def __init__(self, gui: Any, api: Any, send: Callable[[int, PoseTuple], None]) -> None:
        self._api, self._send = api, send
        self._switch = gui.add_checkbox("move objects", False)
        self._switch.on_update(lambda event: self._show())
        self._poses: dict[int, PoseTuple] = {}
        self._nodes: dict[int, Any] = {}
        self._unsent: dict[int, PoseTuple] = {}
        self._dragged: set[int] = set()
        self.change({})

    def change(self, poses: dict[int, PoseTuple]) -> None:
        self._poses = dict(poses)
        self._unsent.clear()
        self._switch.disabled = not poses
        self._show()

    def update_pose(self, scene_index: int, position: Vector, orientation: Quaternion | None) -> None:
        """Update the pose of an object after any client drove it; a control that is being dragged does not move."""
        if scene_index in self._poses:
            self._poses[scene_index] = (position, orientation or self._poses[scene_index][1])
            if scene_index not in self._dragged:
                self._update_control(scene_index)

    def step(self) -> None:
        """Send the latest pose of each object moved since the last call."""
        for _ in range(len(self._unsent)):
            self._send(*self._unsent.popitem())

    def restore(self) -> None:
        """Move the controls back to the objects after a command was refused."""
        for scene_index in list(self._nodes):
            self._update_control(scene_index)

    def _show(self) -> None:
        for node in self._nodes.values():
            node.remove()
        self._nodes.clear()
        self._dragged.clear()
        if self._switch.value:
            for scene_index in self._poses:
                node = self._api.add_transform_controls(
                    f"/handles/{scene_index}", scale=CONTROL_SIZE_CM, line_width=3.0, depth_test=False
                )

                # In order: viser awaits each call.
                async def on_drag(event: Any, scene_index: int = scene_index) -> None:
                    self._on_drag(scene_index, event)

                node.on_update(on_drag)
                self._nodes[scene_index] = node
                self._update_control(scene_index)

    def _on_drag(self, scene_index: int, event: Any) -> None:
        # A control of a previous scene may still send events.
        if scene_index not in self._nodes or event.target is not self._nodes[scene_index]:
            return
        (self._dragged.discard if event.phase == "end" else self._dragged.add)(scene_index)
        if event.phase == "update":
            x, y, z = (float(part) / CM for part in event.target.position)
            w, i, j, k = (float(part) for part in event.target.wxyz)
            self._unsent[scene_index] = ((x, y, z), (w, i, j, k))

    def _update_control(self, scene_index: int) -> None:
        if scene_index in self._nodes:
            (x, y, z), orientation = self._poses[scene_index]
            self._nodes[scene_index].position, self._nodes[scene_index].wxyz = (CM * x, CM * y, CM * z), orientation
