"""Control of simulated hands: mouse on the fingertip, rotation handles, and sliders."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from math import degrees, radians
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.drivers.quaternions import conjugate, multiply
from softfinger.proxy.record import AT
from softfinger.server.viewer.inputs import Nudge, is_in_list, is_on_slider
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.viewer.target import (
    Target,
    drag_target,
    from_angles,
    mirror_motion,
    move_towards,
    nudge_target,
    to_angles,
)

SLIDER_UPDATE_S: Final = 0.2
"""Update period of sliders and handles while something else moves the finger."""
CONTROL_USED_S: Final = 0.5
"""Time after a person's last move of a slider or handle in which neither follows the finger."""
TARGET_VALID_S: Final = 1.0
"""Time after this page's last command in which its targets count as current; later, a recording or a program may have
moved the hands.
"""
HELP: Final = (
    "**Drag** the fingertip: it moves level; with **shift** up and down, which presses; with **ctrl** it rolls. Drag "
    "elsewhere to look around. Keys: **I J K L** level, **O** presses, **U** lifts, **N M** spin, **shift** rolls."
)
TWO_HANDS: Final = (
    "**Drag** a fingertip: both move, with **shift** up and down; the **wheel** closes and opens them. Left hand "
    "**A D W S** level, **E** up, **Q** down; right hand **J L I K**, **U** up, **O** down; **H G** together and "
    "apart. Choose a finger to drag it alone; **ctrl** rolls."
)
NO_HAND: Final = (
    "The page cannot move this fingertip: a person, a SpaceMouse or a recording does. `softfinger run --view` has a "
    "hand."
)
BOTH: Final = "both fingers"
"""Choice to move all fingers at once; no finger has this name, which contains a space."""
DRAG_MODES: Final = {"moves": "move", "presses or lifts": "press", "rolls": "roll", "pinches or opens": "pinch"}
"""Modes of a plain drag, by label: touch screens have no shift, ctrl or wheel."""
MARK: Final = "<span data-two-hands hidden></span>"
"""Marker for the page's scripts that two fingers can be moved."""


class MovableFinger(NamedTuple):
    """Finger that can be moved: name, radius (m), and corners (3,) m of its reach, world frame."""

    name: str
    radius: float
    low: Array
    high: Array


class HandCommands(NamedTuple):
    """Commands to the daemon.

    lead  move a finger to a target; None: release it to the motion of its simulated hand
    hold  stop a finger at the current goal of its hand; calls the second argument with that goal, the third on refusal
    """

    lead: Callable[[str, Target | None], None]
    hold: Callable[[str, Callable[[Target], None], Callable[[], None]], None]


class HandControls:
    """Controls of all fingers that can be moved."""

    def __init__(self, gui: Any, api: Any, commands: HandCommands) -> None:
        self._commands = commands
        self._lock = threading.Lock()
        self._pending_holds: set[str] = set()
        """Fingers with a pending `hold`; the actions in `_after_hold` wait until there are none."""
        self._after_hold: list[Callable[[], None]] = []
        self._last_command_s = 0.0
        self._target_offsets: dict[str, Array] = {}
        """Offset (3,) m of the chosen finger's target from the pose that `sliders` or `handles` show after `hold`."""
        self._fingers: dict[str, MovableFinger] = {}
        self._targets: dict[str, Target] = {}
        self._poses: dict[str, Target] = {}
        self._active_drags: dict[str, tuple[dict[str, Target], Array]] = {}
        self._sliders_updated_s = self._control_used_s = 0.0
        self._sides: tuple[str, ...] = ()
        self.on_interrupt: Callable[[], None] = lambda: None
        """Called when a person starts to move a finger."""
        self._help = gui.add_markdown("")
        self._drag_mode = gui.add_dropdown("a drag", tuple(DRAG_MODES))
        self._finger = gui.add_dropdown("finger", ("",), visible=False)
        names = (("x, mm", 60.0), ("y, mm", 60.0), ("z, mm", 60.0))
        turns = (("about x, deg", 90.0), ("about y, deg", 90.0), ("about z, deg", 180.0))
        self._sliders = [gui.add_slider(name, -end, end, 0.1, 0.0) for name, end in (*names, *turns)]
        for slider in self._sliders:
            slider.on_update(self._on_slider)
        self._handles = gui.add_checkbox("handles", False)
        self._handles.on_update(lambda event: self._show())
        self._release_button = gui.add_button("let go")
        self._release_button.on_click(lambda event: self._release())
        self._mark = gui.add_html(MARK, visible=False)
        self._gizmo = api.add_transform_controls("/hand", scale=2.2, line_width=3.0, depth_test=False, visible=False)
        self._gizmo.on_update(self._on_gizmo)
        self.change([])
        self._help.content = ""  # whether a finger can be moved is unknown before the daemon describes them

    def change(self, fingers: list[MovableFinger]) -> None:
        self._fingers = {finger.name: finger for finger in fingers}
        for memory in (self._targets, self._poses, self._active_drags, self._target_offsets):
            memory.clear()
        with self._lock:
            self._pending_holds, self._after_hold, self._last_command_s = set(), [], 0.0
        self._sides = ()
        several = len(fingers) > 1
        self._help.content = TWO_HANDS if several else HELP if fingers else NO_HAND
        if fingers:
            self._finger.options = (BOTH, *self._fingers) if several else tuple(self._fingers)
        self._finger.visible = self._mark.visible = several
        for control in (self._drag_mode, *self._sliders, self._handles, self._release_button):
            control.disabled = not fingers
        self._show()

    def attach_drag(self, finger: str, ball: Any) -> None:
        for modifier, mode in ((None, None), ("shift", "press"), ("cmd/ctrl", "roll")):

            async def on_drag(event: Any, mode: str | None = mode) -> None:  # in order: viser awaits each call
                if event.phase == "start":
                    self.on_interrupt()
                self.hold_then(partial(self._on_drag, finger, event, mode or self._find_drag_mode()))

            ball.on_drag("left", modifier=modifier)(on_drag)

    def update_pose(self, finger: str, row: Array) -> None:
        """Store the pose of a tick (RECORD_SIZE,), the start of the next motion, and let sliders and handles follow.

        They show the target of a finger that this page moves, and the pose of other fingers.
        """
        first = finger not in self._poses
        self._poses[finger] = Target(
            row[AT.probe_position : AT.probe_position + 3], row[AT.probe_orientation : AT.probe_orientation + 4]
        )
        now = time.monotonic()
        if first or (
            finger == self._find_chosen_finger()
            and now - self._sliders_updated_s > SLIDER_UPDATE_S
            and now - self._control_used_s > CONTROL_USED_S
        ):
            self._show()
            self._sliders_updated_s = now

    def hold_then(self, action: Callable[[], None]) -> None:
        """Call `action` after every hand has stopped at its current goal, so that a grip does not open."""
        with self._lock:
            self._after_hold.append(action)
            stale = not self._pending_holds and time.monotonic() - self._last_command_s > TARGET_VALID_S
            if stale:
                self._pending_holds = set(self._fingers)
        if stale:
            for finger in tuple(self._fingers):
                self._commands.hold(finger, partial(self._on_hold, finger), self._on_hold_refused)
        self._run_after_hold()

    def _on_hold(self, finger: str, target: Target) -> None:
        with self._lock:
            if finger not in self._pending_holds:  # a finger of a previous scene
                return
            pose = self._target(finger)
            if pose is not None and finger == self._find_chosen_finger():
                self._target_offsets = dict.fromkeys(("sliders", "handles"), target.position - pose.position)
            self._targets[finger], self._last_command_s = target, time.monotonic()
            self._pending_holds.discard(finger)
        self._run_after_hold()

    def _on_hold_refused(self) -> None:
        with self._lock:
            self._pending_holds, self._after_hold = set(), []

    def _run_after_hold(self) -> None:
        with self._lock:
            if self._pending_holds:
                return
            actions, self._after_hold = self._after_hold, []
        for action in actions:
            action()

    def nudge(self, nudge: Nudge) -> None:
        self.on_interrupt()
        nudges = dict.fromkeys(self._list_moved_fingers(), nudge._replace(close=0.0))
        self.hold_then(partial(self._nudge, nudges, nudge.close))

    def nudge_each(self, left: Nudge, right: Nudge, close: float) -> None:
        """Move the left and the right finger by increments, and both by `close` (m) towards each other."""
        self.on_interrupt()
        nudges = dict(zip(self.sides(), (left, right), strict=False))
        self.hold_then(partial(self._nudge, nudges, close))

    def sides(self) -> tuple[str, ...]:
        """Return the fingers that were leftmost and rightmost at first; empty until all have been measured."""
        targets = self._list_targets(self._fingers)
        if not self._sides and len(targets) == len(self._fingers) > 1:
            by_x = sorted(targets, key=lambda finger: float(targets[finger].position[0]))
            self._sides = (by_x[0], by_x[-1])
        return self._sides

    def _nudge(self, nudges: dict[str, Nudge], close: float) -> None:
        targets = self._list_targets(self._fingers)
        if close != 0.0 and targets:
            targets = _move_towards_centre(targets, close)
            for drag in self._active_drags.values():  # a drag in progress continues from there
                drag[0].update(_move_towards_centre(drag[0], close))
        for finger, start in targets.items():
            if finger in nudges or close != 0.0:
                self.send_target(finger, nudge_target(start, nudges.get(finger, Nudge()), self._fingers[finger].radius))
        self._show()

    def _find_drag_mode(self) -> str:
        return DRAG_MODES[self._drag_mode.value] if is_in_list(self._drag_mode) else "move"

    def _find_chosen_finger(self) -> str:
        return str(self._finger.value) if self._finger.value in self._fingers else next(iter(self._fingers), "")

    def _list_moved_fingers(self) -> list[str]:
        return list(self._fingers) if self._finger.value == BOTH else [self._find_chosen_finger()]

    def _list_targets(self, fingers: Iterable[str]) -> dict[str, Target]:
        return {finger: target for finger in fingers if (target := self._target(finger)) is not None}

    def _target(self, finger: str) -> Target | None:
        return self._targets.get(finger, self._poses.get(finger))

    def target(self, finger: str) -> Target:
        """Return the target of a finger, or its measured pose before any target; raises KeyError without either."""
        return self._targets.get(finger) or self._poses[finger]

    def radius(self, finger: str) -> float:
        """Return the radius of a finger, m."""
        return self._fingers[finger].radius

    def chosen_finger(self) -> str | None:
        """Return the name of the chosen finger, which may be empty; None if no finger can be moved."""
        return self._find_chosen_finger() if self._fingers else None

    def send_target(self, finger: str, target: Target) -> None:
        """Command a finger to a target, clamped to its reach."""
        if not np.isfinite((*target.position, *target.orientation)).all():
            return
        movable = self._fingers[finger]
        self._targets[finger] = Target(np.clip(target.position, movable.low, movable.high), target.orientation)
        self._last_command_s = time.monotonic()
        self._commands.lead(finger, self._targets[finger])

    def _on_drag(self, finger: str, event: Any, mode: str) -> None:
        if event.phase == "start":
            moved = self._list_moved_fingers()
            targets = self._list_targets({finger, *moved} if finger in moved else {finger})
            if finger in targets:
                self._active_drags[finger] = (targets, np.array(event.start_position) / CM)
        if finger not in self._active_drags or finger not in self._fingers:
            if event.phase == "start":
                self._commands.lead(finger, self._target(finger))  # the daemon refuses it and gives the reason
            return
        starts, grabbed = self._active_drags[finger]
        start = starts[finger]
        eye, pointer = np.array(event.client.camera.position) / CM, np.array(event.end_position) / CM
        one_mode = "move" if mode == "pinch" else mode
        target = drag_target(start, eye, grabbed, pointer, one_mode, self._fingers[finger].radius)
        if target is not None:
            self.send_target(finger, target)
            displacement = target.position - start.position
            rotation = multiply(target.orientation, conjugate(start.orientation))
            for follower in starts.keys() & self._fingers.keys() - {finger}:
                position, orientation = starts[follower]
                motion = mirror_motion(displacement, position - start.position) if mode == "pinch" else displacement
                self.send_target(follower, Target(position + motion, multiply(rotation, orientation)))
            if finger == self._find_chosen_finger():
                self._update_sliders()
        if event.phase == "end":
            del self._active_drags[finger]
            self._show()

    def _on_slider(self, event: Any) -> None:
        if event.client is None or not self._fingers:  # set by this program, not by a person
            return
        self.on_interrupt()
        self._control_used_s = time.monotonic()
        if not all(map(is_on_slider, self._sliders)):
            self._update_sliders()
            return
        x, y, z, *angles = (slider.value for slider in self._sliders)
        pose = Target(np.array([x, y, z]) / 1000.0, from_angles(*(radians(angle) for angle in angles)))
        self.hold_then(partial(self._apply_control, "sliders", pose, self._update_handles))

    def _apply_control(self, control: str, pose: Target, update_others: Callable[[], None]) -> None:
        """Move the chosen finger to the pose shown by sliders or handles, and update the other ones."""
        position = pose.position + self._target_offsets.get(control, 0.0)
        self.send_target(self._find_chosen_finger(), Target(position, pose.orientation))
        update_others()

    def _on_gizmo(self, event: Any) -> None:
        if event.client is not None and self._fingers:
            self.on_interrupt()
            self._control_used_s = time.monotonic()
            pose = Target(np.array(self._gizmo.position) / CM, np.array(self._gizmo.wxyz))
            self.hold_then(partial(self._apply_control, "handles", pose, self._update_sliders))

    def _release(self) -> None:
        self.on_interrupt()
        self._last_command_s = 0.0
        for finger in self._fingers:
            self._targets.pop(finger, None)
            self._commands.lead(finger, None)

    def _show(self) -> None:
        self._gizmo.visible = bool(self._fingers) and self._handles.value
        self._update_sliders()
        self._update_handles()

    def _update_sliders(self) -> None:
        self._target_offsets.pop("sliders", None)
        target = self._target(self._find_chosen_finger())
        if target is not None:
            angles = (degrees(angle) for angle in to_angles(target.orientation))
            for slider, value in zip(self._sliders, (*(1000.0 * target.position), *angles), strict=True):
                rounded = min(max(round(float(value), 1), slider.min), slider.max)
                if slider.value != rounded:  # each change is sent to every page
                    slider.value = rounded

    def _update_handles(self) -> None:
        self._target_offsets.pop("handles", None)
        target = self._target(self._find_chosen_finger())
        if target is not None:
            self._gizmo.position, self._gizmo.wxyz = CM * target.position, target.orientation


def _move_towards_centre(targets: dict[str, Target], distance_m: float) -> dict[str, Target]:
    centre = np.mean([target.position for target in targets.values()], axis=0)
    return {name: Target(move_towards(at, centre, distance_m), turn) for name, (at, turn) in targets.items()}
