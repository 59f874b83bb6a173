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
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.keys import ClientKeys
from softfinger.server.viewer.displayed import handles
from softfinger.server.viewer.driven import Handles, drive_of, resting
from softfinger.server.viewer.hand import Hand, HandCommands, Led
from softfinger.server.viewer.inputs import Gamepad, TwoHands, add_keys
from softfinger.server.viewer.nodes import meshes
from softfinger.server.viewer.nodes.bodies import Place
from softfinger.server.viewer.page import Page, began_of, scene_of
from softfinger.server.viewer.play import SENSES, Ask, Play
from softfinger.server.viewer.prompt import PromptPanel
from softfinger.server.viewer.roles import ALLOWED, Role
from softfinger.server.viewer.target import Target
from softfinger.server.viewer.tuning import Tuning
from softfinger.server.viewer.wire import Asker, Live, Request
from softfinger.server.wire.commands import Held, Triangles

WAITING: Final = "no daemon answers yet: is `softfinger run` running, and are these its endpoints?"
COMPILING: Final = "the scene is compiled, which takes up to half a minute; the old one goes on meanwhile"
ASK_AGAIN_S: Final = 1.0
SETS: Final = ("set_params", "set_scene")
POSE: Final = ("position_m", "orientation_wxyz")


class LivePage:
    """Data source of a page from a daemon, which may start later; call `step` for each frame."""

    def __init__(
        self, page: Page, daemon: Addresses, keys: ClientKeys | None = None, role: Role = Role.OPERATOR
    ) -> None:
        commands, may = daemon.command_endpoint(), ALLOWED[role]
        self._page = page
        self._live = Live(daemon.telemetry, keys)
        self._asker = Asker(commands, keys, may=may)
        self._slow = Asker(commands, keys, may=may)  # separate, so that the hand moves while a scene is compiled
        self._described: dict[str, Any] | None = None
        self._fresh = threading.Event()
        self._sent = deque[tuple[int, int, Triangles]]()
        """Received triangles of objects from files: number of the drawn scene, index of the object."""
        self._scene: schema.Scene | None = None
        self._first = -1
        self._drawn = 0
        self._turning: set[str] = set()
        """Fingers with devices that sense orientation."""
        self._since = 0.0
        gui = page.server.gui
        self._prompt = PromptPanel(gui, self._asker, self._refused, answers=may is None)
        changing = page.tabs if may is None else gui.add_tab_group(visible=False)
        with changing.add_tab("Hand"):
            self._hand = Hand(gui, page.server.scene, HandCommands(self._send, self._hold))
            ask = Ask(page.say, self._put_back, lambda name: self._set_scene("scene", {"scene": name}))
            self._play = Play(gui, self._hand, ask)
            add_keys(gui, self._hand.nudge)
            self._handles = Handles(gui, page.server.scene, self._drive)
            gui.add_button_group("force", ("on", "off")).on_click(self._switch)
        with changing.add_tab("Feel"):
            self._tuning = Tuning(gui, self._set_params, self._set_scene)
        page.add_views()
        self._gamepad, self._two_hands = Gamepad(gui), TwoHands(gui)
        page.say(WAITING)

    def step(self, dt: float) -> None:
        """Show the data received in the last `dt` s."""
        news = self._live.take()
        if self._fresh.is_set():
            self._fresh.clear()
            self._change()
        self._since += dt
        if self._scene is None and self._since > ASK_AGAIN_S:
            self._look()
        while self._sent:
            self._draw(*self._sent.popleft())
        for event in news.events:
            self._prompt.hear(event)
            self._hear(event)
        self._prompt.step()
        if self._live.problem:
            self._page.say(self._live.problem)
        if (nudge := self._gamepad.moved(dt)) is not None:
            self._hand.nudge(nudge)
        if (moved := self._two_hands.moved()) is not None:
            self._hand.nudge_each(*moved)
        self._handles.step()
        for finger, rows in news.ticks.items():
            self._hand.see(finger, rows[-1])
            self._play.see(finger, rows[-1])
        self._play.step(dt)
        self._page.ride(news.bodies)
        self._page.show({finger: rows[rows[:, AT.tick] >= self._first] for finger, rows in news.ticks.items()})

    def _look(self) -> None:
        """Request the daemon's description."""
        self._since = 0.0
        self._prompt.look()
        self._asker.ask("describe", Request("describe", {}, self._is_described, lambda text: None))

    def _is_described(self, described: dict[str, Any]) -> None:
        self._described = described
        self._fresh.set()

    def _change(self) -> None:
        """Show the described scene."""
        described = self._described
        assert described is not None
        try:
            scene = scene_of(described)
        except HapticError as error:
            self._page.say(str(error))
            return
        if self._scene is None:
            self._page.say("")
        elif described["since"] >= self._first and _form(scene) == _form(self._scene):
            self._go_on(scene, described)
            return
        self._scene, self._first = scene, int(described["since"])
        self._drawn += 1
        self._page.change(scene, began_of(described), handles(described))
        self._handles.change(resting(scene))
        self._tuning.change(scene, described["scene_name"])
        for number, thing in enumerate(scene.object):
            if isinstance(thing, Filed):
                came = partial(self._keep, self._drawn, number)
                self._asker.ask(f"mesh {number}", Request("mesh", {"object": number}, came, self._page.say))
        self._turning = {each["name"] for each in described["fingers"] if each["device"]["sensed_dof"] >= SENSES}
        parts = {finger.name: finger for finger in scene.fingers}
        self._hand.change([_led(each, parts[each["name"]]) for each in described["fingers"] if each["led"]])
        self._play.change(scene, self._page.bodies, described)
        for name, nodes in self._page.fingers.items():
            self._hand.take(name, nodes.ball)

    def _go_on(self, scene: schema.Scene, described: dict[str, Any]) -> None:
        """Show new parameters or a reset world without drawing the objects again, so that a drag continues."""
        self._scene = scene
        for nodes in self._page.fingers.values():
            nodes.change(scene)
        self._tuning.change(scene, described["scene_name"])
        if described["since"] != self._first:
            self._first = int(described["since"])
            self._page.begin_again(began_of(described))
            for number in resting(scene):
                thing = scene.object[number]
                self._page.drive(number, thing.position_m, thing.orientation_wxyz)
            self._handles.change(resting(scene))
            self._play.change(scene, self._page.bodies, described)

    def _keep(self, drawn: int, number: int, triangles: Triangles) -> None:
        self._sent.append((drawn, number, triangles))

    def _draw(self, drawn: int, number: int, sent: Triangles) -> None:
        """Draw the triangles of an object, unless the scene was replaced."""
        if drawn != self._drawn:
            return
        try:
            self._page.draw(number, meshes.sent(sent.vertices, sent.triangles))
        except ValueError as error:
            self._page.say(f"object {number}: {error}")

    def _hear(self, event: dict[str, Any]) -> None:
        if self._scene is not None and (drive := drive_of(event, self._scene)) is not None:
            self._page.drive(drive.number, drive.position, drive.orientation)
            self._handles.see(drive.number, drive.position, drive.orientation)
        elif event["kind"] == "lifecycle" or (event["kind"] == "command" and event["name"] in SETS):
            self._look()

    def _send(self, finger: str, target: Target | None) -> None:
        params: dict[str, Any] = {"finger": finger} if finger else {}
        if target is None:
            params["release"] = True
        else:
            params["position_m"] = [float(x) for x in target.position]
            if finger in self._turning:  # other devices refuse an orientation
                params["orientation_wxyz"] = list(target.orientation)
        self._asker.ask(f"hand {finger}", Request("hand", params, lambda result: None, self._refused))

    def _hold(self, finger: str, done: Callable[[Target], None], failed: Callable[[], None]) -> None:
        def held(answer: Held) -> None:
            done(Target(np.array(answer.position_m), answer.orientation_wxyz))

        def refused(text: str) -> None:
            failed()
            self._refused(text)

        self._asker.ask(f"hold {finger}", Request("hold", {"finger": finger} if finger else {}, held, refused))

    def _drive(self, number: int, place: Place) -> None:
        params = {"object": number, "position_m": list(place[0]), "orientation_wxyz": list(place[1])}
        self._asker.ask(f"drive {number}", Request("drive", params, lambda result: None, self._refused))

    def _put_back(self) -> None:
        self._asker.ask("world", Request("reset_world", {}, lambda result: None, self._refused))

    def _switch(self, event: Any) -> None:
        method = "arm" if event.target.value == "on" else "disarm"
        self._asker.ask(
            "force", Request(method, {}, lambda result: self._page.say(f"force {event.target.value}"), self._refused)
        )

    def _set_params(self, name: str, values: dict[str, Any]) -> None:
        self._asker.ask(name, Request("set_params", values, lambda result: self._look(), self._refused))

    def _set_scene(self, name: str, values: dict[str, Any]) -> None:
        self._page.say(COMPILING)
        self._slow.ask(name, Request("set_scene", values, lambda result: self._page.say(""), self._refused))

    def _refused(self, text: str) -> None:
        self._page.say(text, "Not done:")
        self._tuning.restore()
        self._handles.restore()

    def close(self) -> None:
        for part in (self._live, self._asker, self._slow):
            part.close()


def _form(scene: schema.Scene) -> dict[str, Any]:
    """Return the visible part of a scene, without the poses of driven objects, which events report."""
    plain, driven = describe(scene), resting(scene)
    objects = [
        {key: value for key, value in each.items() if key not in (POSE if number in driven else ()) + ("material",)}
        for number, each in enumerate(plain["object"])
    ]
    model = None if scene.world is None else scene.world.model
    return {key: plain.get(key) for key in ("fingertip", "finger")} | {"object": objects, "model": model}


def _led(described: dict[str, Any], finger: schema.FingerParts) -> Led:
    low, high = (np.array(described["device"][f"workspace_{end}_m"]) + described["offset_m"] for end in ("min", "max"))
    return Led(finger.name, finger.radius_m, low, high)
