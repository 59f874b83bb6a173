"""Buttons that play gestures with the simulated hand, or give the reason why one is impossible."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.proxy.record import AT
from softfinger.server.viewer.gestures import ONE_FINGER, Gesture, LiftedBox, Stage, compute_half_width, lift
from softfinger.server.viewer.hand import HandControls
from softfinger.server.viewer.nodes.bodies import BodyNodes

LIFT: Final = "lift a box"
LIFT_SCENE: Final = "lift-a-box"
"""Shipped scene with a box, and its fingers below."""
FINGERS: Final = ("thumb", "index")
MAX_STEP_S: Final = 0.2
"""Maximum time step; after a longer pause of the page, a gesture continues as if without pause."""
BUTTON_ORDER: Final = -1.0
"""Order of the buttons: above the other controls of the tab."""
ORIENTATION_DOF: Final = 6
"""Degrees of freedom of a device that senses orientation."""


class PageActions(NamedTuple):
    """Requests: `show_message(text, title)`, `reset_world()` of the bodies, `scene(name)` loads a scene."""

    show_message: Callable[[str, str], None]
    reset_world: Callable[[], None]
    scene: Callable[[str], None]


class GesturePlayer:
    """Gesture buttons; call `update` for each tick of a finger and `step` for each frame."""

    def __init__(self, gui: Any, hand: HandControls, actions: PageActions) -> None:
        self._hand, self._actions = hand, actions
        gui.add_button_group("play", (*ONE_FINGER, LIFT), order=BUTTON_ORDER).on_click(self._on_click)
        hand.on_interrupt = self.stop
        self._scene: schema.Scene | None = None
        self._bodies: BodyNodes | None = None
        self._sensed_dof: dict[str, int] = {}
        self._rows: dict[str, Array] = {}
        self._gesture: Gesture | None = None
        self._queued = self._after_scene = ""

    def change(self, scene: schema.Scene, bodies: BodyNodes | None, description: dict[str, Any]) -> None:
        scene_gesture = self._after_scene if description["scene_name"] == LIFT_SCENE else ""
        if scene != self._scene:  # otherwise its bodies were reset, possibly by the gesture itself
            self.stop()
        self._scene, self._bodies = scene, bodies
        self._sensed_dof = {entry["name"]: entry["device"]["sensed_dof"] for entry in description["fingers"]}
        if self._gesture is None:
            self._rows.clear()
        self._queued = ""
        if scene_gesture:
            self._queue(scene_gesture)

    def update(self, finger: str, row: Array) -> None:
        """Store the latest tick (RECORD_SIZE,) of a finger."""
        self._rows[finger] = row

    def step(self, dt: float) -> None:
        """Advance the gesture by `dt` s."""
        if self._queued and self._scene is not None and len(self._rows) == len(self._scene.fingers):
            name, self._queued = self._queued, ""
            obstacle = self._try_start(name)
            if obstacle:
                self._actions.show_message(obstacle, f"Cannot {name}:")
        if self._gesture is None:
            return
        try:
            goals = next(self._gesture) if self._is_new else self._gesture.send(min(dt, MAX_STEP_S))
        except StopIteration:
            self._gesture = None
            return
        self._is_new = False
        for finger, target in goals.items():
            self._hand.send_target(finger, target)

    _is_new = True

    def stop(self) -> None:
        """Cancel the gesture: a person moves the hand, or the scene was replaced."""
        self._gesture, self._queued, self._after_scene = None, "", ""

    def _on_click(self, event: Any) -> None:
        if event.client is not None and event.target.value in (*ONE_FINGER, LIFT):
            self.stop()
            self._queue(event.target.value)

    def _queue(self, name: str) -> None:
        """Start a gesture after all hands have stopped at their goals."""
        self._hand.hold_then(partial(setattr, self, "_queued", name))

    def _try_start(self, name: str) -> str:
        finger = self._hand.chosen_finger()
        if finger is None:
            return "the page cannot move this fingertip; use `softfinger run --view`"
        stage = Stage(
            self._hand.target, self._read_proxy, self._read_normal_force, self._hand.radius, self._measure_height
        )
        if name == LIFT:
            return self._try_lift(stage)
        obstacle = self._find_obstacle(name, finger)
        if not obstacle:
            self._start(ONE_FINGER[name](stage, finger))
        return obstacle

    def _start(self, gesture: Gesture) -> None:
        self._gesture, self._is_new = gesture, True

    def _read_proxy(self, finger: str) -> Array:
        return self._rows[finger][AT.proxy_position : AT.proxy_position + 3]

    def _read_normal_force(self, finger: str) -> float:
        return float(self._rows[finger][AT.contact_normal_force])

    def _measure_height(self, point: Array) -> float | None:
        projection = None if self._bodies is None else self._bodies.below(point)
        return None if projection is None else float(projection.point[2])

    def _find_obstacle(self, name: str, finger: str) -> str:
        """Return why a finger cannot perform a gesture here, else empty."""
        assert self._scene is not None and self._bodies is not None
        projection = self._bodies.below(self._read_proxy(finger))
        if projection is None:
            return "no object is below the fingertip: move it over one first"
        if projection.scene_index >= len(self._scene.object):
            return "the object below cannot be touched: move the fingertip over another one first"
        below = self._scene.object[projection.scene_index]
        if name == "roll" and self._scene.rolling is None:
            return "this scene has no `[rolling]`; the tab *Feel* switches it on"
        if name == "spin" and below.material.torsion is None:
            return f"{below.name} has no torsion (`material.torsion` of the scene)"
        if name in ("roll", "spin") and self._sensed_dof[finger] < ORIENTATION_DOF:
            return "this device does not measure its orientation"
        return ""

    def _try_lift(self, stage: Stage) -> str:
        assert self._scene is not None and self._bodies is not None
        sides = self._hand.sides()
        for scene_index, obj in enumerate(self._scene.object):
            if len(sides) > 1 and isinstance(obj, schema.Box) and isinstance(obj.motion, schema.Body):
                half = compute_half_width(obj.size_m, self._bodies.poses[scene_index][1])
                box = LiftedBox(partial(self._find_box_centre, scene_index), half, self._actions.reset_world)
                self._start(lift(stage, sides[0], sides[1], box))
                return ""
        if tuple(finger.name for finger in self._scene.fingers) != FINGERS or not sides:
            return "this needs two fingers and a box: end the program, and start `run --scene lift-a-box --view`"
        self._after_scene = LIFT
        self._actions.scene(LIFT_SCENE)
        return ""

    def _find_box_centre(self, scene_index: int) -> Array:
        assert self._bodies is not None
        return np.array(self._bodies.poses[scene_index][0])
