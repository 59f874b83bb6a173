"""Page of a running daemon: picture of its ticks, controls of its scene, and mouse control of the hand."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from softfinger.config import schema
from softfinger.config.errors import HapticError
from softfinger.config.load import describe
from softfinger.proxy.pictures import Filed
from softfinger.proxy.record import AT
from softfinger.server import surface_meshes
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.keys import ClientKeys
from softfinger.server.viewer.displayed import find_low_dof_devices
from softfinger.server.viewer.driven import ObjectControls, find_initial_poses, parse_drive
from softfinger.server.viewer.hand import HandCommands, HandControls, MovableFinger
from softfinger.server.viewer.inputs import Gamepad, TwoHands, add_keys
from softfinger.server.viewer.nodes.glyphs import PoseTuple
from softfinger.server.viewer.page import Page, parse_scene, parse_scene_start
from softfinger.server.viewer.play import ORIENTATION_DOF, GesturePlayer, PageActions
from softfinger.server.viewer.prompt import PromptPanel
from softfinger.server.viewer.roles import ALLOWED, Role
from softfinger.server.viewer.target import Target
from softfinger.server.viewer.tuning import SceneControls
from softfinger.server.viewer.wire import CommandQueue, QueuedCommand, TelemetryReceiver, ignore
from softfinger.server.wire.commands import HandPose, MeshResult

NO_DAEMON_TEXT: Final = "no daemon answers: check that `softfinger run` is running with these endpoints"
NO_TICKS_TEXT: Final = "no tick for 3 s: the picture shows the last one; check that `softfinger run` is running"
SILENCE_S: Final = 3.0
NEW_SCENE_TEXT: Final = "the new scene is being prepared; the old one is rendered until then"
REQUEST_PERIOD_S: Final = 1.0
SCENE_COMMANDS: Final = ("set_params", "set_scene")
POSE_KEYS: Final = ("position_m", "orientation_wxyz")


class LivePage:
    """Data source of a page from a daemon, which may start later; call `step` for each frame."""

    def __init__(
        self, page: Page, daemon: Addresses, keys: ClientKeys | None = None, role: Role = Role.OPERATOR
    ) -> None:
        commands, allowed_methods = daemon.command_endpoint(), ALLOWED[role]
        self._page = page
        self._telemetry = TelemetryReceiver(daemon.telemetry, keys)
        self._commands = CommandQueue(commands, keys, allowed_methods=allowed_methods)
        # Separate queues: the hand moves, and the force can be switched off, while another command is pending.
        self._scene_commands = CommandQueue(commands, keys, allowed_methods=allowed_methods)
        self._force_commands = CommandQueue(commands, keys, allowed_methods=allowed_methods)
        self._description: dict[str, Any] | None = None
        self._has_new_description = threading.Event()
        self._received_meshes = deque[tuple[int, int, MeshResult]]()
        """Received triangles of objects from files: scene number, object index."""
        self._scene: schema.Scene | None = None
        self._is_outdated = True
        """True if the description has to be requested: it is unknown, or the event of a change may be lost."""
        self._first_tick = -1
        self._scene_number = 0
        self._orientable_fingers: set[str] = set()
        self._since_request_s = self._silent_s = 0.0
        gui = page.server.gui
        self._prompt = PromptPanel(gui, self._commands, self._show_refusal, can_answer=allowed_methods is None)
        control_tabs = page.tabs if allowed_methods is None else gui.add_tab_group(visible=False)
        with control_tabs.add_tab("Hand"):
            self._hand = HandControls(gui, page.server.scene, HandCommands(self._lead_hand, self._hold_hand))
            actions = PageActions(
                page.show_message, self._reset_world, lambda name: self._set_scene("scene", {"scene": name})
            )
            self._play = GesturePlayer(gui, self._hand, actions)
            add_keys(gui, self._hand.nudge)
            self._object_controls = ObjectControls(gui, page.server.scene, self._drive_object)
            gui.add_button_group("force", ("on", "off")).on_click(self._switch_force)
        with control_tabs.add_tab("Feel"):
            self._tuning = SceneControls(gui, self._set_params, self._set_scene)
        page.add_views()
        self._gamepad, self._two_hands = Gamepad(gui), TwoHands(gui)
        page.show_message(NO_DAEMON_TEXT)

    def step(self, dt: float) -> None:
        """Show the data received in the last `dt` s."""
        received = self._telemetry.take()
        self._report_silence(dt, bool(received.ticks))
        if self._has_new_description.is_set():
            self._has_new_description.clear()
            self._show_description()
        self._since_request_s += dt
        self._is_outdated |= received.has_lost
        if self._is_outdated and self._since_request_s > REQUEST_PERIOD_S:
            self._request_description()
        while self._received_meshes:
            self._draw_mesh(*self._received_meshes.popleft())
        for event in received.events:
            self._prompt.handle_event(event)
            self._handle_event(event)
        self._prompt.step()
        if self._telemetry.problem:
            self._page.show_message(self._telemetry.problem)
        if (nudge := self._gamepad.increment(dt)) is not None:
            self._hand.nudge(nudge)
        if (steps := self._two_hands.increment()) is not None:
            self._hand.nudge_each(*steps)
        self._object_controls.step()
        for finger, rows in received.ticks.items():
            self._hand.update_pose(finger, rows[-1])
            self._play.update(finger, rows[-1])
        self._play.step(dt)
        self._page.preparing = received.preparing
        self._page.move_bodies(received.bodies)
        self._page.show({finger: rows[rows[:, AT.tick] >= self._first_tick] for finger, rows in received.ticks.items()})

    def _report_silence(self, dt: float, has_ticks: bool) -> None:
        """Show a message from SILENCE_S after the last tick until the next one."""
        was_silent = self._silent_s > SILENCE_S
        self._silent_s = 0.0 if has_ticks else self._silent_s + dt
        if self._scene is not None and (self._silent_s > SILENCE_S) != was_silent:
            if was_silent:
                self._page.clear_message(NO_TICKS_TEXT)
            else:
                self._page.show_message(NO_TICKS_TEXT)

    def _request_description(self) -> None:
        self._since_request_s, self._is_outdated = 0.0, False
        self._prompt.request()
        self._commands.submit("describe", QueuedCommand("describe", {}, self._store_description, self._set_outdated))

    def _store_description(self, description: dict[str, Any]) -> None:
        if description != self._description:
            self._description = description
            self._has_new_description.set()

    def _set_outdated(self, error: str) -> None:
        self._is_outdated = True

    def _show_description(self) -> None:
        description = self._description
        assert description is not None
        try:
            scene = parse_scene(description)
        except HapticError as error:
            self._page.show_message(str(error))
            return
        if self._scene is None:
            self._page.show_message("")
        elif description["since"] >= self._first_tick and _select_visible_parts(scene) == _select_visible_parts(
            self._scene
        ):
            self._update_scene(scene, description)
            return
        self._scene, self._first_tick = scene, int(description["since"])
        self._scene_number += 1
        self._page.change(scene, parse_scene_start(description), find_low_dof_devices(description))
        self._object_controls.change(find_initial_poses(scene))
        self._tuning.change(scene, description["scene_name"])
        for scene_index, obj in enumerate(scene.object):
            if isinstance(obj, Filed):
                on_mesh = partial(self._store_mesh, self._scene_number, scene_index)
                request = QueuedCommand("mesh", {"object": scene_index}, on_mesh, self._page.show_message)
                self._commands.submit(f"mesh {scene_index}", request)
        self._orientable_fingers = {
            finger["name"] for finger in description["fingers"] if finger["device"]["sensed_dof"] >= ORIENTATION_DOF
        }
        finger_parts = {finger.name: finger for finger in scene.fingers}
        self._hand.change(
            [
                _find_movable_finger(finger, finger_parts[finger["name"]])
                for finger in description["fingers"]
                if finger["led"]
            ]
        )
        self._play.change(scene, self._page.bodies, description)
        for name, nodes in self._page.fingers.items():
            self._hand.attach_drag(name, nodes.ball)

    def _update_scene(self, scene: schema.Scene, description: dict[str, Any]) -> None:
        """Show new parameters or a reset world without drawing the objects again, so that a drag continues."""
        self._scene = scene
        for nodes in self._page.fingers.values():
            nodes.scene = scene
        self._tuning.change(scene, description["scene_name"])
        if description["since"] != self._first_tick:
            self._first_tick = int(description["since"])
            self._page.restart(parse_scene_start(description))
            for scene_index in find_initial_poses(scene):
                obj = scene.object[scene_index]
                self._page.drive(scene_index, obj.position_m, obj.orientation_wxyz)
            self._object_controls.change(find_initial_poses(scene))
            self._play.change(scene, self._page.bodies, description)

    def _store_mesh(self, scene_number: int, scene_index: int, triangles: MeshResult) -> None:
        self._received_meshes.append((scene_number, scene_index, triangles))

    def _draw_mesh(self, scene_number: int, scene_index: int, mesh: MeshResult) -> None:
        """Draw the triangles of an object, unless the scene was replaced."""
        if scene_number != self._scene_number:
            return
        try:
            self._page.draw(scene_index, surface_meshes.decode_mesh(mesh.vertices, mesh.triangles))
        except ValueError as error:
            self._page.show_message(f"object {scene_index}: {error}")

    def _handle_event(self, event: dict[str, Any]) -> None:
        if self._scene is not None and (drive := parse_drive(event, self._scene)) is not None:
            self._page.drive(drive.scene_index, drive.position, drive.orientation)
            self._object_controls.update_pose(drive.scene_index, drive.position, drive.orientation)
        elif event["kind"] == "lifecycle" or (event["kind"] == "command" and event["name"] in SCENE_COMMANDS):
            self._request_description()

    def _send(self, name: str, method: str, params: dict[str, Any], on_result: Callable[[Any], None] = ignore) -> None:
        self._commands.submit(name, QueuedCommand(method, params, on_result, self._show_refusal))

    def _lead_hand(self, finger: str, target: Target | None) -> None:
        params: dict[str, Any] = {"finger": finger} if finger else {}
        if target is None:
            params["release"] = True
        else:
            params["position_m"] = target.position.tolist()
            if finger in self._orientable_fingers:  # other devices refuse an orientation
                params["orientation_wxyz"] = target.orientation.tolist()
        self._send(f"hand {finger}", "hand", params)

    def _hold_hand(self, finger: str, on_pose: Callable[[Target], None], on_failure: Callable[[], None]) -> None:
        def on_hold(answer: HandPose) -> None:
            on_pose(Target(np.array(answer.position_m), np.array(answer.orientation_wxyz)))

        def on_refused(text: str) -> None:
            on_failure()
            self._show_refusal(text)

        params = {"finger": finger} if finger else {}
        self._commands.submit(f"hold {finger}", QueuedCommand("hold", params, on_hold, on_refused))

    def _drive_object(self, scene_index: int, pose: PoseTuple) -> None:
        params = {"object": scene_index, "position_m": list(pose[0]), "orientation_wxyz": list(pose[1])}
        self._send(f"drive {scene_index}", "drive", params)

    def _reset_world(self) -> None:
        self._scene_commands.submit("world", QueuedCommand("reset_world", {}, on_error=self._show_refusal))

    def _switch_force(self, event: Any) -> None:
        value: str = event.target.value
        report = lambda _: self._page.show_message(f"force {value}")  # noqa: E731
        request = QueuedCommand("arm" if value == "on" else "disarm", {}, report, self._show_refusal)
        self._force_commands.submit("force", request)

    def _set_params(self, name: str, values: dict[str, Any]) -> None:
        self._send(name, "set_params", values, lambda _: self._request_description())

    def _set_scene(self, name: str, values: dict[str, Any]) -> None:
        self._page.show_message(NEW_SCENE_TEXT)

        def on_refused(text: str) -> None:
            self._page.clear_message(NEW_SCENE_TEXT)
            self._show_refusal(text)

        request = QueuedCommand("set_scene", values, lambda _: self._page.clear_message(NEW_SCENE_TEXT), on_refused)
        self._scene_commands.submit(name, request)

    def _show_refusal(self, text: str) -> None:
        self._tuning.show()
        self._object_controls.restore()
        self._page.show_message(text, "Not done:")

    def close(self) -> None:
        for part in (self._telemetry, self._commands, self._scene_commands, self._force_commands):
            part.close()


def _select_visible_parts(scene: schema.Scene) -> dict[str, Any]:
    """Return the visible part of a scene, without the poses of driven objects, which events report."""
    plain, driven = describe(scene), find_initial_poses(scene)
    objects = [
        {
            key: value
            for key, value in obj.items()
            if key not in (POSE_KEYS if scene_index in driven else ()) + ("material",)
        }
        for scene_index, obj in enumerate(plain["object"])
    ]
    model = None if scene.world is None else scene.world.model
    return {key: plain.get(key) for key in ("fingertip", "finger")} | {"object": objects, "model": model}


def _find_movable_finger(description: dict[str, Any], finger: schema.FingerParts) -> MovableFinger:
    low, high = (
        np.array(description["device"][f"workspace_{end}_m"]) + description["offset_m"] for end in ("min", "max")
    )
    return MovableFinger(finger.name, finger.radius_m, low, high)
