"""Control of simulated hands: mouse on the fingertip, rotation handles, and sliders."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from math import degrees, radians
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT
from softfinger.server.viewer.controls import on_list, on_slider
from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes.glyphs import inverse, product
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.viewer.target import Target, closed, from_angles, mirrored, moved, nudged, to_angles

Array = NDArray[np.float64]

FOLLOWS_S: Final = 0.2
"""Update period of the sliders while another source moves the finger."""
FRESH_S: Final = 1.0
"""Time after this page's last command in which its targets count as current; later, a recording or a program may have
moved the hands.
"""
HELP: Final = (
    "Take the white ball with the mouse: **drag** moves it, with **shift** up and down, which presses, with **ctrl** "
    "it rolls like a ball. Drag anywhere else to look around. Keys: **I J K L** level, **O** presses, **U** lifts, "
    "**N M** spin, **shift** rolls. A gamepad: left stick, triggers; right stick rolls, bumpers spin."
)
TWO_HANDS: Final = (
    "**Pinch**: drag one of the white balls, which moves both fingers, with **shift** up and down; turn the **wheel** "
    "meanwhile, or with **alt** at any time, to close and to open them. **Two hands on keys**: left hand **A D W S** "
    "level, **E** up, **Q** down; right hand **J L I K**, **U** up, **O** down; **H G** together and apart. Choose a "
    "finger to drag it alone; **ctrl** rolls. Drag anywhere else to look around."
)
NO_HAND: Final = (
    "Nothing here is to be led: a person, a puck or a recording moves the fingertip. `softfinger run --view` has a "
    "hand."
)
BOTH: Final = "both fingers"
"""Choice to move all fingers at once; no finger has this name, which contains a space."""
HOW: Final = {"moves": "move", "presses or lifts": "press", "rolls": "roll", "pinches or opens": "pinch"}
"""Modes of a plain drag, by label: touch screens have no shift, ctrl or wheel."""
MARK: Final = "<span data-two-hands hidden></span>"
"""Marker for the page's scripts that two fingers can be moved."""


class Led(NamedTuple):
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


class Hand:
    """Controls of all fingers that can be moved."""

    def __init__(self, gui: Any, api: Any, commands: HandCommands) -> None:
        self._commands = commands
        self._taking = threading.Lock()
        self._asked: set[str] = set()
        """Fingers with a pending `hold`; the actions in `_then` wait until there are none."""
        self._then: list[Callable[[], None]] = []
        self._led_at = 0.0
        self._beyond: dict[str, Array] = {}
        """Offset (3,) m of the chosen finger's target from the pose that `sliders` or `handles` show after `hold`."""
        self._fingers: dict[str, Led] = {}
        self._targets: dict[str, Target] = {}
        self._seen: dict[str, Target] = {}
        self._begun: dict[str, tuple[dict[str, Target], Array]] = {}
        self._placed = 0.0
        self._sides: tuple[str, ...] = ()
        self.interrupted: Callable[[], None] = lambda: None
        """Called when a person starts to move a finger."""
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
        self._mark = gui.add_html(MARK, visible=False)
        self._gizmo = api.add_transform_controls("/hand", scale=2.2, line_width=3.0, depth_test=False, visible=False)
        self._gizmo.on_update(self._turned)
        self.change([])

    def change(self, fingers: list[Led]) -> None:
        """Set the fingers that can be moved."""
        self._fingers = {finger.name: finger for finger in fingers}
        for kept in (self._targets, self._seen, self._begun, self._beyond):
            kept.clear()
        with self._taking:
            self._asked, self._then, self._led_at = set(), [], 0.0
        self._sides = ()
        several = len(fingers) > 1
        self._help.content = TWO_HANDS if several else HELP if fingers else NO_HAND
        if fingers:
            self._finger.options = (BOTH, *self._fingers) if several else tuple(self._fingers)
        self._finger.visible = self._mark.visible = several
        for control in (self._how, *self._sliders, self._handles, self._let_go):
            control.disabled = not fingers
        self._show()

    def take(self, finger: str, ball: Any) -> None:
        """Let a mouse drag a finger's ball."""
        for modifier, how in ((None, None), ("shift", "press"), ("cmd/ctrl", "roll")):

            async def dragged(event: Any, how: str | None = how) -> None:  # in order: viser awaits each call
                if event.phase == "start":
                    self.interrupted()
                self.take_over(partial(self._dragged, finger, event, how or self._plain()))

            ball.on_drag("left", modifier=modifier)(dragged)

    def see(self, finger: str, row: Array) -> None:
        """Store the pose of a tick (RECORD_SIZE,): the start of the next motion, and shown by the sliders before it."""
        at = AT.probe_orientation
        w, x, y, z = row[at : at + 4].tolist()
        first = finger not in self._seen
        self._seen[finger] = Target(row[AT.probe_position : AT.probe_position + 3], (w, x, y, z))
        now = time.monotonic()
        if first or (finger not in self._targets and finger == self._chosen() and now - self._placed > FOLLOWS_S):
            self._show()
            self._placed = now

    def take_over(self, then: Callable[[], None]) -> None:
        """Call `then` after every hand has stopped at its current goal, so that a grip does not open."""
        with self._taking:
            self._then.append(then)
            stale = not self._asked and time.monotonic() - self._led_at > FRESH_S
            if stale:
                self._asked = set(self._fingers)
        if stale:
            for finger in tuple(self._fingers):
                self._commands.hold(finger, partial(self._is_held, finger), self._not_held)
        self._go_on()

    def _is_held(self, finger: str, target: Target) -> None:
        with self._taking:
            if finger not in self._asked:  # a finger of a previous scene
                return
            shown = self._target(finger)
            if shown is not None and finger == self._chosen():
                self._beyond = dict.fromkeys(("sliders", "handles"), target.position - shown.position)
            self._targets[finger], self._led_at = target, time.monotonic()
            self._asked.discard(finger)
        self._go_on()

    def _not_held(self) -> None:
        with self._taking:
            self._asked, self._then = set(), []

    def _go_on(self) -> None:
        with self._taking:
            if self._asked:
                return
            now, self._then = self._then, []
        for each in now:
            each()

    def nudge(self, nudge: Nudge) -> None:
        """Move the chosen finger, or all, by an increment."""
        self.interrupted()
        nudges = dict.fromkeys(self._led(), nudge._replace(close=0.0))
        self.take_over(partial(self._nudge, nudges, nudge.close))

    def nudge_each(self, left: Nudge, right: Nudge, close: float) -> None:
        """Move the left and the right finger by increments, and both by `close` (m) towards each other."""
        self.interrupted()
        nudges = dict(zip(self.sides(), (left, right), strict=False))
        self.take_over(partial(self._nudge, nudges, close))

    def sides(self) -> tuple[str, ...]:
        """Return the fingers that were leftmost and rightmost at first; empty until all have been measured."""
        targets = self._targets_of(self._fingers)
        if not self._sides and len(targets) == len(self._fingers) > 1:
            by_x = sorted(targets, key=lambda finger: float(targets[finger].position[0]))
            self._sides = (by_x[0], by_x[-1])
        return self._sides

    def _nudge(self, nudges: dict[str, Nudge], close: float) -> None:
        targets = self._targets_of(self._fingers)
        if close != 0.0 and targets:
            targets = _closed(targets, close)
            for begun in self._begun.values():  # a drag in progress continues from there
                begun[0].update(_closed(begun[0], close))
        for finger, start in targets.items():
            if finger in nudges or close != 0.0:
                self.go(finger, nudged(start, nudges.get(finger, Nudge()), self._fingers[finger].radius))
        self._show()

    def _plain(self) -> str:
        return HOW[self._how.value] if on_list(self._how) else "move"

    def _chosen(self) -> str:
        only = len(self._fingers) < 2 or self._finger.value not in self._fingers
        return next(iter(self._fingers), "") if only else str(self._finger.value)

    def _led(self) -> list[str]:
        """Return the fingers that keys and a drag move."""
        return list(self._fingers) if self._finger.value == BOTH else [self._chosen()]

    def _targets_of(self, fingers: Iterable[str]) -> dict[str, Target]:
        found = ((finger, self._target(finger)) for finger in fingers)
        return {finger: target for finger, target in found if target is not None}

    def _target(self, finger: str) -> Target | None:
        return self._targets.get(finger, self._seen.get(finger))

    def target(self, finger: str) -> Target:
        """Return the target of a finger, or its measured pose before any target; raises KeyError without either."""
        return self._targets.get(finger) or self._seen[finger]

    def radius(self, finger: str) -> float:
        """Return the radius of a finger, m."""
        return self._fingers[finger].radius

    def chosen(self) -> str | None:
        """Return the name of the chosen finger, which may be empty; None if no finger can be moved."""
        return self._chosen() if self._fingers else None

    def go(self, finger: str, target: Target) -> None:
        """Command a finger to a target, clamped to its reach."""
        if not np.isfinite((*target.position, *target.orientation)).all():
            return
        led = self._fingers[finger]
        self._targets[finger] = Target(np.clip(target.position, led.low, led.high), target.orientation)
        self._led_at = time.monotonic()
        self._commands.lead(finger, self._targets[finger])

    def _dragged(self, finger: str, event: Any, how: str) -> None:
        if event.phase == "start":
            targets = self._targets_of({finger, *self._led()} if finger in self._led() else {finger})
            if finger in targets:
                self._begun[finger] = (targets, np.array(event.start_position) / CM)
        if finger not in self._begun or finger not in self._fingers:
            if event.phase == "start":
                self._commands.lead(finger, self._target(finger))  # the daemon refuses it and gives the reason
            return
        starts, grabbed = self._begun[finger]
        start = starts[finger]
        eye, pointer = np.array(event.client.camera.position) / CM, np.array(event.end_position) / CM
        target = moved(start, eye, grabbed, pointer, "move" if how == "pinch" else how, self._fingers[finger].radius)
        if target is not None:
            self.go(finger, target)
            way, turn = target.position - start.position, product(target.orientation, inverse(start.orientation))
            for other in starts.keys() & self._fingers.keys() - {finger}:
                there = starts[other]
                along = mirrored(way, there.position - start.position) if how == "pinch" else way
                self.go(other, Target(there.position + along, product(turn, there.orientation)))
            if finger == self._chosen():
                self._place_sliders()
        if event.phase == "end":
            del self._begun[finger]
            self._show()

    def _slid(self, event: Any) -> None:
        if event.client is None or not self._fingers:  # set by this program, not by a person
            return
        self.interrupted()
        if not all(map(on_slider, self._sliders)):
            self._place_sliders()
            return
        x, y, z, *angles = (slider.value for slider in self._sliders)
        turn = from_angles(*(radians(angle) for angle in angles))
        self.take_over(partial(self._put, "sliders", Target(np.array([x, y, z]) / 1000.0, turn), self._place_handles))

    def _put(self, what: str, shown: Target, others: Callable[[], None]) -> None:
        """Move the chosen finger to the pose shown by sliders or handles, and update the other ones."""
        self.go(self._chosen(), Target(shown.position + self._beyond.get(what, 0.0), shown.orientation))
        others()

    def _turned(self, event: Any) -> None:
        if event.client is not None and self._fingers:
            self.interrupted()
            w, x, y, z = (float(part) for part in self._gizmo.wxyz)
            shown = Target(np.array(self._gizmo.position) / CM, (w, x, y, z))
            self.take_over(partial(self._put, "handles", shown, self._place_sliders))

    def _release(self) -> None:
        self.interrupted()
        self._led_at = 0.0
        for finger in self._fingers:
            self._targets.pop(finger, None)
            self._commands.lead(finger, None)

    def _show(self) -> None:
        self._gizmo.visible = bool(self._fingers) and self._handles.value
        self._place_sliders()
        self._place_handles()

    def _place_sliders(self) -> None:
        self._beyond.pop("sliders", None)
        target = self._target(self._chosen())
        if target is not None:
            angles = (degrees(angle) for angle in to_angles(target.orientation))
            for slider, value in zip(self._sliders, (*(1000.0 * target.position), *angles), strict=True):
                shown = min(max(round(float(value), 1), slider.min), slider.max)
                if slider.value != shown:  # each change is sent to every page
                    slider.value = shown

    def _place_handles(self) -> None:
        self._beyond.pop("handles", None)
        target = self._target(self._chosen())
        if target is not None:
            self._gizmo.position, self._gizmo.wxyz = CM * target.position, target.orientation


def _closed(targets: dict[str, Target], way: float) -> dict[str, Target]:
    """Return the targets moved by `way` m towards their common centre."""
    middle = np.mean([target.position for target in targets.values()], axis=0)
    return {name: Target(closed(target.position, middle, way), target.orientation) for name, target in targets.items()}
