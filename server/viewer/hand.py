"""The hand of the simulated device: a mouse on the fingertip, handles to turn it by, and sliders."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from math import asin, atan2, degrees, radians
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT
from softfinger.server.viewer.controls import on_list, on_slider
from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes.glyphs import UNTURNED, Quaternion, about, product
from softfinger.server.viewer.nodes.looks import CM

Array = NDArray[np.float64]

FOLLOWS_S: Final = 0.2
"""How often the sliders follow a finger that something else leads."""
GRAZING: Final = 0.05
"""Of the sine of the angle between a look and a plane: below it, a pixel would be a long way."""
HELP: Final = (
    "Take the white ball with the mouse: **drag** moves it, with **shift** up and down, which presses, with **ctrl** "
    "it rolls like a ball. Drag anywhere else to look around. Keys: **I J K L** level, **O** presses, **U** lifts, "
    "**N M** spin, **shift** rolls; **H G** move several fingers together and apart. Choose *both fingers*, and a drag "
    "of one leads both: towards the other one it pinches. A gamepad: left stick, triggers; right stick rolls, bumpers "
    "spin."
)
NO_HAND: Final = (
    "Nothing here is to be led: a person, a puck or a recording moves the fingertip. `softfinger run --view` has a "
    "hand."
)


class Target(NamedTuple):
    """Where the hand is to be: position (3,) m and orientation."""

    position: Array
    orientation: Quaternion


BOTH: Final = "both fingers"
"""In place of a finger, whose name has no space: several are led at once."""
HOW: Final = {"moves": "move", "presses or lifts": "press", "rolls": "roll"}
"""What a plain drag may do, by its name on the page: a touch screen has no shift and no ctrl."""


class Led(NamedTuple):
    """A finger that may be led: its name, radius m, and how far it reaches, corners (3,) m in the world."""

    name: str
    radius: float
    low: Array
    high: Array


def hit(eye: Array, through: Array, point: Array, normal: Array) -> Array | None:
    """Where the look from `eye` through a point meets the plane of `point` and `normal`; None where it hardly does."""
    look = through - eye
    slope = float(look @ normal) / float(np.linalg.norm(look) * np.linalg.norm(normal))
    if abs(slope) < GRAZING:
        return None
    way = float((point - eye) @ normal) / float(look @ normal)
    return eye + way * look if way > 0.0 else None


def moved(start: Target, eye: Array, grabbed: Array, pointer: Array, how: str, radius: float) -> Target | None:
    """What a drag makes of the target that it began with, all (3,) m; None where the look does not tell.

    how  "move" in a level plane, "press" up and down, or "roll", as a ball of `radius` on a level plane
    """
    up = np.array([0.0, 0.0, 1.0])
    if how == "press":
        facing = (grabbed - eye) * (1.0, 1.0, 0.0)
        if np.linalg.norm(facing) < GRAZING * np.linalg.norm(grabbed - eye):
            return None
        found = hit(eye, pointer, grabbed, facing)
        return None if found is None else Target(start.position + up * (found - grabbed)[2], start.orientation)
    found = hit(eye, pointer, grabbed, up)
    if found is None:
        return None
    way = (found - grabbed) * (1.0, 1.0, 0.0)
    if how == "move":
        return Target(start.position + way, start.orientation)
    return Target(start.position + way, product(rolled(way, radius), start.orientation))


def rolled(way: Array, radius: float) -> Quaternion:
    """How a ball turns that rolls a level way (3,) m; none of it where there is no way."""
    length = float(np.linalg.norm(way))
    return UNTURNED if length == 0.0 else about(np.cross((0.0, 0.0, 1.0), way), length / radius)


def nudged(start: Target, nudge: Nudge, radius: float) -> Target:
    """The target a piece of a way further, as a ball of `radius` m where it rolls."""
    roll = np.array([nudge.roll_x, nudge.roll_y, 0.0])
    turn = product(about(np.array([0.0, 0.0, 1.0]), nudge.spin), rolled(roll, radius))
    return Target(start.position + roll + (nudge.x, nudge.y, nudge.z), product(turn, start.orientation))


def mirrored(way: Array, line: Array) -> Array:
    """How one finger goes (3,) m when another goes `way`: along with it across their `line`, against it along that."""
    length = float(line @ line)
    return way if length == 0.0 else way - 2.0 * float(way @ line) / length * line


def closed(place: Array, middle: Array, way: float) -> Array:
    """A place (3,) m, `way` m nearer to the middle of all fingers, and not past it."""
    apart = middle - place
    distance = float(np.linalg.norm(apart))
    return place if distance == 0.0 else place + min(way, distance) / distance * apart


def from_angles(roll_x: float, roll_y: float, spin: float) -> Quaternion:
    """First about x, then y, then z, all of the world; rad."""
    x, y, z = (np.array(axis, dtype=np.float64) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    return product(about(z, spin), product(about(y, roll_y), about(x, roll_x)))


def to_angles(q: Quaternion) -> tuple[float, float, float]:
    """The angles of `from_angles`, rad."""
    w, x, y, z = q
    return (
        atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


class Hand:
    """What leads the hands of all fingers that may be led; `send(finger, target or None)` asks the daemon."""

    def __init__(self, gui: Any, api: Any, send: Callable[[str, Target | None], None]) -> None:
        self._send = send
        self._fingers: dict[str, Led] = {}
        self._targets: dict[str, Target] = {}
        self._seen: dict[str, Target] = {}
        self._begun: dict[str, tuple[dict[str, Target], Array]] = {}
        self._placed = 0.0
        self._help = gui.add_markdown(HELP)
        self._how = gui.add_dropdown("a drag", tuple(HOW))
        self._finger = gui.add_dropdown("finger", ("",), visible=False)
        names = (("x, mm", 60.0), ("y, mm", 60.0), ("height, mm", 60.0))
        turns = (("turned about x, deg", 90.0), ("about y, deg", 90.0), ("about z, deg", 180.0))
        self._sliders = [gui.add_slider(name, -end, end, 0.1, 0.0) for name, end in (*names, *turns)]
        for slider in self._sliders:
            slider.on_update(self._slid)
        self._handles = gui.add_checkbox("handles on the finger", False)
        self._handles.on_update(lambda event: self._show())
        self._let_go = gui.add_button("let go")
        self._let_go.on_click(lambda event: self._release())
        self._gizmo = api.add_transform_controls("/hand", scale=2.2, line_width=3.0, depth_test=False, visible=False)
        self._gizmo.on_update(self._turned)
        self.change([])

    def change(self, fingers: list[Led]) -> None:
        """Other fingers, or none, may be led."""
        self._fingers = {finger.name: finger for finger in fingers}
        self._targets.clear()
        self._seen.clear()
        self._help.content = HELP if fingers else NO_HAND
        if fingers:
            self._finger.options = (*self._fingers, BOTH) if len(fingers) > 1 else tuple(self._fingers)
        self._finger.visible = len(fingers) > 1
        for control in (self._how, *self._sliders, self._handles, self._let_go):
            control.disabled = not fingers
        self._show()

    def take(self, finger: str, ball: Any) -> None:
        """Let a mouse take hold of a finger's ball."""
        for modifier, how in ((None, None), ("shift", "press"), ("cmd/ctrl", "roll")):

            async def dragged(event: Any, how: str | None = how) -> None:  # in order: viser waits for one after another
                self._dragged(finger, event, how or self._plain())

            ball.on_drag("left", modifier=modifier)(dragged)

    def see(self, finger: str, row: Array) -> None:
        """Where the fingertip is (RECORD_SIZE,): where it is led from, and what the sliders show, until it is."""
        at = AT.probe_orientation
        w, x, y, z = row[at : at + 4].tolist()
        first = finger not in self._seen
        self._seen[finger] = Target(row[AT.probe_position : AT.probe_position + 3], (w, x, y, z))
        now = time.monotonic()
        if first or (finger not in self._targets and finger == self._chosen() and now - self._placed > FOLLOWS_S):
            self._show()
            self._placed = now

    def nudge(self, nudge: Nudge) -> None:
        """Go a piece of a way further with the finger that is chosen, or with all."""
        targets = self._targets_of(self._fingers)
        if not targets:
            return
        middle = np.mean([target.position for target in targets.values()], axis=0)
        led = self._led() if nudge.close == 0.0 else list(targets)
        for finger in filter(targets.__contains__, led):
            target = nudged(targets[finger], nudge, self._fingers[finger].radius)
            self._go(finger, Target(closed(target.position, middle, nudge.close), target.orientation))
        self._show()

    def _plain(self) -> str:
        return HOW[self._how.value] if on_list(self._how) else "move"

    def _chosen(self) -> str:
        only = len(self._fingers) < 2 or self._finger.value not in self._fingers
        return next(iter(self._fingers), "") if only else str(self._finger.value)

    def _led(self) -> list[str]:
        """The fingers that keys and a drag lead."""
        return list(self._fingers) if self._finger.value == BOTH else [self._chosen()]

    def _targets_of(self, fingers: Iterable[str]) -> dict[str, Target]:
        found = ((finger, self._target(finger)) for finger in fingers)
        return {finger: target for finger, target in found if target is not None}

    def _target(self, finger: str) -> Target | None:
        return self._targets.get(finger, self._seen.get(finger))

    def _go(self, finger: str, target: Target) -> None:
        if not np.isfinite((*target.position, *target.orientation)).all():
            return
        led = self._fingers[finger]
        self._targets[finger] = Target(np.clip(target.position, led.low, led.high), target.orientation)
        self._send(finger, self._targets[finger])

    def _dragged(self, finger: str, event: Any, how: str) -> None:
        if event.phase == "start":
            targets = self._targets_of({finger, *self._led()} if finger in self._led() else {finger})
            if finger in targets:
                self._begun[finger] = (targets, np.array(event.start_position) / CM)
        if finger not in self._begun or finger not in self._fingers:
            if event.phase == "start":
                self._send(finger, self._target(finger))  # which the daemon declines, with the reason
            return
        starts, grabbed = self._begun[finger]
        start = starts[finger]
        eye, pointer = np.array(event.client.camera.position) / CM, np.array(event.end_position) / CM
        target = moved(start, eye, grabbed, pointer, how, self._fingers[finger].radius)
        if target is not None:
            self._go(finger, target)
            for other in starts.keys() & self._fingers.keys() - {finger}:
                way = mirrored(target.position - start.position, starts[other].position - start.position)
                self._go(other, Target(starts[other].position + way, starts[other].orientation))
            if finger == self._chosen():
                self._place_sliders()
        if event.phase == "end":
            del self._begun[finger]
            self._show()

    def _slid(self, event: Any) -> None:
        if event.client is None or not self._fingers:  # set by this program, not by a person
            return
        if not all(map(on_slider, self._sliders)):
            self._place_sliders()
            return
        x, y, z, *angles = (slider.value for slider in self._sliders)
        turn = from_angles(*(radians(angle) for angle in angles))
        self._go(self._chosen(), Target(np.array([x, y, z]) / 1000.0, turn))
        self._place_handles()

    def _turned(self, event: Any) -> None:
        if event.client is not None and self._fingers:
            w, x, y, z = (float(part) for part in self._gizmo.wxyz)
            self._go(self._chosen(), Target(np.array(self._gizmo.position) / CM, (w, x, y, z)))
            self._place_sliders()

    def _release(self) -> None:
        for finger in self._fingers:
            self._targets.pop(finger, None)
            self._send(finger, None)

    def _show(self) -> None:
        self._gizmo.visible = bool(self._fingers) and self._handles.value
        self._place_sliders()
        self._place_handles()

    def _place_sliders(self) -> None:
        target = self._target(self._chosen())
        if target is not None:
            angles = (degrees(angle) for angle in to_angles(target.orientation))
            for slider, value in zip(self._sliders, (*(1000.0 * target.position), *angles), strict=True):
                shown = min(max(round(float(value), 1), slider.min), slider.max)
                if slider.value != shown:  # each is sent to every page
                    slider.value = shown

    def _place_handles(self) -> None:
        target = self._target(self._chosen())
        if target is not None:
            self._gizmo.position, self._gizmo.wxyz = CM * target.position, target.orientation
