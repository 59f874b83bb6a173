"""Driven and moving objects: their poses during a recording, and handles to move them on the page."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NamedTuple

import msgspec

from softfinger.config import schema
from softfinger.server.viewer.nodes.bodies import Place
from softfinger.server.viewer.nodes.glyphs import Quaternion
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.wire import commands

Vector = tuple[float, float, float]

HANDLE_CM: Final = 3.0
"""Distance from the centre of an object to the tips of its arrows."""


class Drive(NamedTuple):
    """Tick, index of the driven object, and its new pose: position (3,) m and orientation; None: unchanged."""

    tick: int
    number: int
    position: Vector
    orientation: Quaternion | None


def drive_of(event: Mapping[str, Any], scene: schema.Scene) -> Drive | None:
    """Return the drive in an event; None for other events and for objects that the scene does not have."""
    if (event["kind"], event["name"]) != ("command", "drive"):
        return None
    try:
        told = msgspec.convert(event.get("what"), commands.Drive)
    except msgspec.ValidationError:  # a recording may contain any value
        return None
    number = next((k for k, thing in enumerate(scene.object) if thing.name == told.object), None)
    if number is None:  # an object of another scene
        return None
    turn = told.orientation_wxyz
    return Drive(event["tick"], number, told.position_m, None if turn is msgspec.UNSET else turn)


def resting(scene: schema.Scene) -> dict[int, Place]:
    """Return the driven objects of a scene by index, with their initial poses."""
    return {
        number: (thing.position_m, thing.orientation_wxyz)
        for number, thing in enumerate(scene.object)
        if isinstance(thing.motion, schema.Driven)
    }


class Drives:
    """Poses of the driven objects at each tick of a recording, from its events in order of time."""

    def __init__(self, scene: schema.Scene, events: Iterable[Mapping[str, Any]]) -> None:
        self._places = {number: [place] for number, place in resting(scene).items()}
        self._ticks: dict[int, list[int]] = {number: [] for number in self._places}
        for drive in filter(None, (drive_of(event, scene) for event in events)):
            if drive.number in self._places:
                places = self._places[drive.number]
                places.append((drive.position, drive.orientation or places[-1][1]))
                self._ticks[drive.number].append(drive.tick)

    def at(self, tick: int) -> dict[int, Place]:
        """Return the poses by object index."""
        return {number: places[bisect_right(self._ticks[number], tick)] for number, places in self._places.items()}


class Worlds:
    """Poses of the bodies at each tick of a recording, from its messages of `world` in order of time."""

    def __init__(self, messages: Iterable[Mapping[str, Any]]) -> None:
        self._messages = list(messages)
        self._ticks = [message["tick"] for message in self._messages]

    def at(self, tick: int) -> dict[str, Place]:
        """Return the poses by body name; empty before the first message."""
        newest = bisect_right(self._ticks, tick) - 1
        bodies = self._messages[newest]["bodies"] if newest >= 0 else ()
        return {body["name"]: (tuple(body["position"]), tuple(body["orientation"])) for body in bodies}


class Handles:
    """Transform controls on each driven object, if switched on; `send(index, place)` commands the daemon."""

    def __init__(self, gui: Any, api: Any, send: Callable[[int, Place], None]) -> None:
        self._api, self._send = api, send
        self._switch = gui.add_checkbox("move objects", False)
        self._switch.on_update(lambda event: self._show())
        self._places: dict[int, Place] = {}
        self._nodes: dict[int, Any] = {}
        self._wanted: dict[int, Place] = {}
        self._held: set[int] = set()
        self.change({})

    def change(self, places: dict[int, Place]) -> None:
        """Set the driven objects by index, with their poses."""
        self._places = dict(places)
        self._wanted.clear()
        self._switch.disabled = not places
        self._show()

    def see(self, number: int, position: Vector, orientation: Quaternion | None) -> None:
        """Update the pose of an object after any client drove it; a control that is being dragged does not move."""
        if number in self._places:
            self._places[number] = (position, orientation or self._places[number][1])
            if number not in self._held:
                self._put(number)

    def step(self) -> None:
        """Send the latest pose of each object moved since the last call."""
        for _ in range(len(self._wanted)):
            self._send(*self._wanted.popitem())

    def restore(self) -> None:
        """Move the controls back to the objects after a command was refused."""
        for number in list(self._nodes):
            self._put(number)

    def _show(self) -> None:
        for node in self._nodes.values():
            node.remove()
        self._nodes.clear()
        self._held.clear()
        if self._switch.value:
            for number in self._places:
                node = self._api.add_transform_controls(
                    f"/handles/{number}", scale=HANDLE_CM, line_width=3.0, depth_test=False
                )

                async def pulled(event: Any, number: int = number) -> None:  # in order: viser awaits each call
                    self._pulled(number, event)

                node.on_update(pulled)
                self._nodes[number] = node
                self._put(number)

    def _pulled(self, number: int, event: Any) -> None:
        if number not in self._nodes or event.target is not self._nodes[number]:  # a control of a previous scene
            return
        (self._held.discard if event.phase == "end" else self._held.add)(number)
        if event.phase == "update":
            x, y, z = (float(part) / CM for part in event.target.position)
            w, i, j, k = (float(part) for part in event.target.wxyz)
            self._wanted[number] = ((x, y, z), (w, i, j, k))

    def _put(self, number: int) -> None:
        if number in self._nodes:
            (x, y, z), turn = self._places[number]
            self._nodes[number].position, self._nodes[number].wxyz = (CM * x, CM * y, CM * z), turn
