"""The hand of the simulated device: a mouse on the fingertip, handles to turn it by, and sliders."""

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
"""How often the sliders follow a finger that something else leads."""
FRESH_S: Final = 1.0
"""For so long after this page has led them hands want what it told them; later a recording or a program may lead."""
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
"""In place of a finger, whose name has no space: several are led at once."""
HOW: Final = {"moves": "move", "presses or lifts": "press", "rolls": "roll", "pinches or opens": "pinch"}
"""What a plain drag may do, by its name on the page: a touch screen has no shift, no ctrl and no wheel."""
MARK: Final = "<span data-two-hands hidden></span>"
"""Tells the page's scripts that two fingers are to be led."""


class Led(NamedTuple):
    """A finger that may be led: its name, radius m, and how far it reaches, corners (3,) m in the world."""

    name: str
    radius: float
    low: Array
    high: Array


class HandCommands(NamedTuple):
    """Commands to the daemon.

    lead  a finger to a target; None: back to what its hand does by itself
    hold  a finger at the goal of its hand; the second argument is called with that goal, the third on a refusal
    """

    lead: Callable[[str, Target | None], None]
    hold: Callable[[str, Callable[[Target], None], Callable[[], None]], None]


class Hand:
    """What leads the hands of all fingers that may be led."""

    def __init__(self, gui: Any, api: Any, commands: HandCommands) -> None:
        self._commands = commands
        self._taking = threading.Lock()
        self._asked: set[str] = set()
        """Fingers that are asked where they are held; until all are known, what is to be done then waits."""
        self._then: list[Callable[[], None]] = []
        self._led_at = 0.0
        self._beyond: dict[str, Array] = {}
        """How far (3,) m the target of the chosen finger, once taken, is from what `sliders` and `handles` show."""
        self._fingers: dict[str, Led] = {}
        self._targets: dict[str, Target] = {}
        self._seen: dict[str, Target] = {}
        self._begun: dict[str, tuple[dict[str, Target], Array]] = {}
        self._placed = 0.0
        self._sides: tuple[str, ...] = ()
        self.interrupted: Callable[[], None] = lambda: None
        """Called when a person begins to lead."""
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
        """Other fingers, or none, may be led."""
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
        """Let a mouse take hold of a finger's ball."""
        for modifier, how in ((None, None), ("shift", "press"), ("cmd/ctrl", "roll")):

            async def dragged(event: Any, how: str | None = how) -> None:  # in order: viser waits for one after another
                if event.phase == "start":
                    self.interrupted()
                self.take_over(partial(self._dragged, finger, event, how or self._plain()))

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

    def take_over(self, then: Callable[[], None]) -> None:
        """Do `then` once it is known where every hand wants to be, and each stays there: a grip goes on gripping."""
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
            if finger not in self._asked:  # of a scene before
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
        """Go a piece of a way further with the finger that is chosen, or with all."""
        self.interrupted()
        nudges = dict.fromkeys(self._led(), nudge._replace(close=0.0))
        self.take_over(partial(self._nudge, nudges, nudge.close))

    def nudge_each(self, left: Nudge, right: Nudge, close: float) -> None:
        """Go a piece of a way further with the finger on the left and with that on the right, and both so far (m)
        towards each other."""
        self.interrupted()
        nudges = dict(zip(self.sides(), (left, right), strict=False))
        self.take_over(partial(self._nudge, nudges, close))

    def sides(self) -> tuple[str, ...]:
        """The finger that was on the left at first, and that on the right; none until both have been seen."""
        targets = self._targets_of(self._fingers)
        if not self._sides and len(targets) == len(self._fingers) > 1:
            by_x = sorted(targets, key=lambda finger: float(targets[finger].position[0]))
            self._sides = (by_x[0], by_x[-1])
        return self._sides

    def _nudge(self, nudges: dict[str, Nudge], close: float) -> None:
        targets = self._targets_of(self._fingers)
        if close != 0.0 and targets:
            targets = _closed(targets, close)
            for begun in self._begun.values():  # a drag goes on from there
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
        """The fingers that keys and a drag lead."""
        return list(self._fingers) if self._finger.value == BOTH else [self._chosen()]

    def _targets_of(self, fingers: Iterable[str]) -> dict[str, Target]:
        found = ((finger, self._target(finger)) for finger in fingers)
        return {finger: target for finger, target in found if target is not None}

    def _target(self, finger: str) -> Target | None:
        return self._targets.get(finger, self._seen.get(finger))

    def target(self, finger: str) -> Target:
        """Where a finger is to be or, until it is led, where it is; KeyError for one that has not been seen."""
        return self._targets.get(finger) or self._seen[finger]

    def radius(self, finger: str) -> float:
        """Of a finger that may be led, m."""
        return self._fingers[finger].radius

    def chosen(self) -> str | None:
        """The finger that is led where one alone is; its name may be empty. None where none may be led."""
        return self._chosen() if self._fingers else None

    def go(self, finger: str, target: Target) -> None:
        """Lead a finger as far as it reaches."""
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
                self._commands.lead(finger, self._target(finger))  # which the daemon declines, with the reason
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
        """Lead the chosen finger to what sliders or handles show, and place the others."""
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
                if slider.value != shown:  # each is sent to every page
                    slider.value = shown

    def _place_handles(self) -> None:
        self._beyond.pop("handles", None)
        target = self._target(self._chosen())
        if target is not None:
            self._gizmo.position, self._gizmo.wxyz = CM * target.position, target.orientation


def _closed(targets: dict[str, Target], way: float) -> dict[str, Target]:
    """All of them `way` m nearer to the middle of them."""
    middle = np.mean([target.position for target in targets.values()], axis=0)
    return {name: Target(closed(target.position, middle, way), target.orientation) for name, target in targets.items()}
