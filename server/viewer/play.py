"""Buttons that play gestures with the simulated hand, or give the reason why one is impossible."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.record import AT
from softfinger.server.viewer.gestures import ONE_FINGER, Box, Gesture, Stage, half_width, lift
from softfinger.server.viewer.hand import Hand
from softfinger.server.viewer.nodes.bodies import Bodies

Array = NDArray[np.float64]

LIFT: Final = "lift a box"
LIFTED: Final = "lift-a-box"
"""Shipped scene with a box, and its fingers below."""
FINGERS: Final = ("thumb", "index")
LONGEST_S: Final = 0.2
"""Maximum time step; after a longer pause of the page, a gesture continues as if without pause."""
FIRST: Final = -1.0
"""Order of the buttons: above the other controls of the tab."""
SENSES: Final = 6
"""Degrees of freedom of a device that senses orientation."""


class Ask(NamedTuple):
    """Requests: `say(text, title)` to the user, `put_back()` resets the bodies, `scene(name)` loads a scene."""

    say: Callable[[str, str], None]
    put_back: Callable[[], None]
    scene: Callable[[str], None]


class Play:
    """Gesture buttons; call `see` for each tick of a finger and `step` for each frame."""

    def __init__(self, gui: Any, hand: Hand, ask: Ask) -> None:
        self._hand, self._ask = hand, ask
        gui.add_button_group("play", (*ONE_FINGER, LIFT), order=FIRST).on_click(self._clicked)
        hand.interrupted = self.stop
        self._scene: schema.Scene | None = None
        self._bodies: Bodies | None = None
        self._senses: dict[str, int] = {}
        self._forces: dict[str, float] = {}
        self._gesture: Gesture | None = None
        self._wanted = self._after = ""

    def change(self, scene: schema.Scene, bodies: Bodies | None, described: dict[str, Any]) -> None:
        """Set a new scene, with the daemon's description."""
        after = self._after if described["scene_name"] == LIFTED else ""
        if scene != self._scene:  # otherwise its bodies were reset, possibly by the gesture itself
            self.stop()
        self._scene, self._bodies = scene, bodies
        self._senses = {each["name"]: each["device"]["sensed_dof"] for each in described["fingers"]}
        self._forces = dict.fromkeys(self._senses, 0.0) if self._gesture else {}
        self._wanted = ""
        if after:
            self._want(after)

    def see(self, finger: str, row: Array) -> None:
        """Update the force from the latest tick (RECORD_SIZE,) of a finger."""
        self._forces[finger] = float(row[AT.contact_normal_force])

    def step(self, dt: float) -> None:
        """Advance the gesture by `dt` s."""
        if self._wanted and self._scene is not None and len(self._forces) == len(self._scene.fingers):
            wanted, self._wanted = self._wanted, ""
            why = self._begin(wanted)
            if why:
                self._ask.say(why, f"Cannot {wanted}:")
        if self._gesture is None:
            return
        try:
            goals = next(self._gesture) if self._fresh else self._gesture.send(min(dt, LONGEST_S))
        except StopIteration:
            self._gesture = None
            return
        self._fresh = False
        for finger, target in goals.items():
            self._hand.go(finger, target)

    _fresh = True

    def stop(self) -> None:
        """Cancel the gesture: a person moves the hand, or the scene was replaced."""
        self._gesture, self._wanted, self._after = None, "", ""

    def _clicked(self, event: Any) -> None:
        if event.client is not None and event.target.value in (*ONE_FINGER, LIFT):
            self.stop()
            self._want(event.target.value)

    def _want(self, name: str) -> None:
        """Start a gesture after all hands have stopped at their goals."""
        self._hand.take_over(partial(setattr, self, "_wanted", name))

    def _begin(self, name: str) -> str:
        """Start a gesture; return why it is impossible, else empty."""
        finger = self._hand.chosen()
        if finger is None:
            return "nothing here is to be led; `softfinger run --view` has a hand"
        stage = Stage(self._hand.target, lambda finger: self._forces[finger], self._hand.radius, self._height)
        if name == LIFT:
            return self._begin_lift(stage)
        why = self._why_not(name, finger)
        if not why:
            self._start(ONE_FINGER[name](stage, finger))
        return why

    def _start(self, gesture: Gesture) -> None:
        self._gesture, self._fresh = gesture, True

    def _height(self, point: Array) -> float | None:
        foot = None if self._bodies is None else self._bodies.below(point)
        return None if foot is None else float(foot.point[2])

    def _why_not(self, name: str, finger: str) -> str:
        """Return why a finger cannot perform a gesture here, else empty."""
        assert self._scene is not None and self._bodies is not None
        foot = self._bodies.below(self._hand.target(finger).position)
        if foot is None:
            return "nothing lies below the fingertip: move it over an object first"
        if foot.number >= len(self._scene.object):
            return "no finger touches what lies below: move the fingertip over another object first"
        below = self._scene.object[foot.number]
        if name == "roll" and self._scene.rolling is None:
            return "this scene has no `[rolling]`; the tab *Feel* switches it on"
        if name == "spin" and below.material.torsion is None:
            return f"{below.name} has no torsion (`material.torsion` of the scene)"
        if name in ("roll", "spin") and self._senses[finger] < SENSES:
            return "this device does not sense how it is turned"
        return ""

    def _begin_lift(self, stage: Stage) -> str:
        assert self._scene is not None and self._bodies is not None
        number = next(
            (
                number
                for number, thing in enumerate(self._scene.object)
                if isinstance(thing, schema.Box) and isinstance(thing.motion, schema.Body)
            ),
            None,
        )
        sides = self._hand.sides()
        if number is None or len(sides) < 2:
            return self._fetch_a_box()
        thing = self._scene.object[number]
        assert isinstance(thing, schema.Box)
        half = half_width(thing.size_m, self._bodies.places[number][1])
        box = Box(lambda: self._middle(number), half, self._ask.put_back)
        self._start(lift(stage, sides[0], sides[1], box))
        return ""

    def _middle(self, number: int) -> Array:
        assert self._bodies is not None
        return np.array(self._bodies.places[number][0])

    def _fetch_a_box(self) -> str:
        """Request the scene with a box, if the fingers match it."""
        assert self._scene is not None
        if tuple(finger.name for finger in self._scene.fingers) != FINGERS or not self._hand.sides():
            return "it takes two fingers and a box: end the program, and begin with `run --scene lift-a-box --view`"
        self._after = LIFT
        self._ask.scene(LIFTED)
        return ""
