"""Command service: handlers for all methods of the command endpoint.

The thread that serves the publisher receives requests. It answers the methods AT_ONCE, which turn the force off or keep
it on; these read no file and never wait. Another thread answers all other methods in order of arrival, so that they do
not delay `disarm`. A third thread (`compilation.py`) reads, compiles and answers `set_scene`. The file is as long as
the list of methods.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from queue import SimpleQueue
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError, HapticError, SafetyStop
from softfinger.config.load import build, completed, describe, load_scene, numbered, overridden, shipped, value_at
from softfinger.config.words import near, shown
from softfinger.drivers import switch_interval
from softfinger.drivers.simulated.lead import RequestedPose, hand_of
from softfinger.proxy.pictures import Filed, picture_of
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop import shutdown
from softfinger.server.publishing.brake import SHORT
from softfinger.server.services.base import JOIN_S
from softfinger.server.services.compilation import Change, NotCompiled, SceneChanges, Superseded
from softfinger.server.services.description import described
from softfinger.server.services.prompts import Prompts
from softfinger.server.services.recordings import Recordings
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering, Replacing
from softfinger.server.states import COMMANDED, FAST, SILENT, UNARMED
from softfinger.server.wire import commands as wire
from softfinger.server.wire.envelope import Declined, Request, answered, declined, parse
from softfinger.server.wire.link import Answering
from softfinger.server.wire.protocol import encode, wire_schema

log: Final = logging.getLogger(__name__)

EVENT_BYTES_MAX: Final = 1024
"""Largest part of a request that is copied into an event: the publisher stores 40 000 messages for slow subscribers."""

LOG_PERIOD_S: Final = 10.0

AT_ONCE: Final = frozenset({"get_state", "heartbeat", "arm", "disarm", "zero", "stop"})
"""Methods answered before all others. Requests longer than SHORT are none of these; they take milliseconds to decode,
and are queued first."""
WAITING_MAX: Final = 100
"""Largest number of queued requests of a client; further ones are answered with `busy`."""
REST_MAX_S: Final = 0.1
"""Longest pause after a queued request: queued requests use at most half of a processor."""


class Doing(NamedTuple):
    """Interface of the commands to the daemon, other than the rendering.

    replace     renders a scene under a name, and returns its first tick
    ring        returns where local readers find every tick, in the format of `describe`
    telemetry   endpoint of the telemetry
    serve       sets the handler of requests; None removes it
    reply       sends a deferred answer to a client
    event       publishes an event
    stop        ends the run in order
    fail        ends the run with an error
    recordings  service that records
    """

    replace: Callable[[schema.Scene, str], int]
    ring: Callable[[], dict[str, Any]]
    telemetry: str
    serve: Callable[[Answering | None], None]
    reply: Callable[[bytes, bytes], None]
    event: Callable[..., None]
    stop: Callable[[], None]
    fail: Callable[[HapticError], None]
    recordings: Recordings


class Commands:
    """Service that answers the requests of an endpoint.

    scene_name  name of the initial scene
    """

    def __init__(self, endpoint: str, rendering: Rendering, doing: Doing, scene_name: str) -> None:
        self.endpoint: Final = endpoint
        self._rendering, self._doing, self._scene_name = rendering, doing, scene_name
        self._heartbeat_s = rendering.rig.commands.heartbeat_s
        self._started = False
        self._heard_s = 0.0
        self._logged_s = -LOG_PERIOD_S
        self._newest: NDArray[np.float64] | None = None
        self._led: Final = set[int]()
        """Indices of the fingers with hands moved by a program."""
        self._scenes = SceneChanges(doing.replace)
        self._turns: Final = SimpleQueue[tuple[bytes, Request | bytes, bool] | None]()
        self._waiting: Final = Counter[bytes]()
        """Number of requests of each client in `_turns` or being answered; protected by `_counting`."""
        self._counting = threading.Lock()
        self._thread = threading.Thread(target=self._take_turns, name="commands", daemon=True)
        prompts = Prompts(self._tell, lambda: rendering.servo.ticks)
        self._get_prompt, self._set_prompt, self._answer = prompts.get, prompts.set, prompts.answer
        self.sink: Final = Sink("commands", self._keep)

    def start(self) -> None:
        switch_interval.shorten()
        self._started = True
        self._scenes.start()
        self._thread.start()
        self._note_alive()
        self._doing.serve(Answering(self._take, self._each_period))

    def stop(self) -> None:
        failed = shutdown.every(self._scenes.stop, self._stop_turns, lambda: self._doing.serve(None))
        if self._started:
            self._started = False
            switch_interval.restore()
        if failed is not None:
            raise failed

    def _stop_turns(self) -> None:
        self._turns.put(None)
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)

    def _keep(self, records: NDArray[np.float64], drops: int) -> None:
        self._newest = records[-1].copy()

    # --- requests --------------------------------------------------------------------------------------

    def _take(self, client: bytes, body: bytes | None, too_much: bool) -> bytes | None:
        """Answer a request, or queue it; never waits."""
        command_id = ""
        try:
            if body is not None and len(body) > SHORT:
                self._wait_turn(client, body, too_much)
                return None
            request = self._heard(body, too_much)
            command_id = request.command_id
            if request.method in AT_ONCE:
                return self._done(request)
            self._wait_turn(client, request, too_much)
            return None
        except Exception as error:
            return declined(self._declined(error), command_id)

    def _heard(self, body: bytes | None, too_much: bool) -> Request:
        """Return the parsed request and count it as a sign of life; raises Declined."""
        request = parse(body)
        if too_much:
            raise Declined("busy", "too many requests from this client: ask more slowly", request.command_id)
        self._look_after()  # a heartbeat missed before this request counts as missed
        self._note_alive()
        return request

    def _note_alive(self) -> None:
        self._heard_s = time.monotonic()
        if self._heartbeat_s is not None:
            self._rendering.force.end_at(round(1e9 * (self._heard_s + self._heartbeat_s)))

    def _wait_turn(self, client: bytes, given: Request | bytes, too_much: bool) -> None:
        with self._counting:
            if self._waiting[client] >= WAITING_MAX:
                raise Declined("busy", "too many requests of this client wait for their turn: wait for answers first")
            self._waiting[client] += 1
        self._turns.put((client, given, too_much))

    def _take_turns(self) -> None:
        """Answer queued requests one after the other; runs in its own thread."""
        while (turn := self._turns.get()) is not None:
            begun = time.monotonic()
            client, given, too_much = turn
            answer = self._answer_in_turn(client, given, too_much)
            if answer is not None:
                self._doing.reply(client, answer)
            with self._counting:
                self._waiting[client] -= 1
                if not self._waiting[client]:
                    del self._waiting[client]
            time.sleep(min(time.monotonic() - begun, REST_MAX_S))

    def _answer_in_turn(self, client: bytes, given: Request | bytes, too_much: bool) -> bytes | None:
        command_id = ""
        try:
            request = self._heard(given, too_much) if isinstance(given, bytes) else given
            command_id = request.command_id
            if request.method == "set_scene":
                self._set_scene(client, request)
                return None
            if request.method == "reset_world":
                self._reset_world(client, request)
                return None
            return self._done(request)
        except Exception as error:
            return declined(self._declined(error), command_id)

    def _done(self, request: Request) -> bytes:
        """Handle a request and return the answer."""
        return answered(request.command_id, getattr(self, f"_{request.method}")(request))

    def _declined(self, error: Exception) -> Declined:
        """Convert an exception into an answer."""
        match error:
            case Declined():
                return error
            case Superseded():
                return Declined("superseded", str(error))
            case NotCompiled():
                return Declined("failed", str(error))
            case ConfigError():
                return Declined("bad_params", str(error))
            case Replacing():
                return Declined("busy", str(error))
            case HapticError():
                return Declined("refused", str(error))
        if time.monotonic() - self._logged_s > LOG_PERIOD_S:  # rarely, because a client must not fill the log
            self._logged_s = time.monotonic()
            log.error("a command failed", exc_info=error)
        return Declined("failed", f"{type(error).__name__}: {error}"[:500])

    def _each_period(self) -> None:
        try:
            self._look_after()
        except Exception as error:
            log.exception("commands failed")
            self._doing.serve(None)
            self._doing.event("fault", "commands", message=str(error))
            self._doing.fail(SafetyStop(f"commands cannot be taken: {error}; nobody would see the heartbeat end"))

    def _look_after(self) -> None:
        """Record a missed heartbeat, if it is missed.

        The loop has already turned the force off, and a request alone does not turn it on again.
        """
        if self._heartbeat_s is None or time.monotonic() - self._heard_s <= self._heartbeat_s:
            return
        if not self._rendering.force.kept_off(SILENT):
            self._rendering.disarm(SILENT)
            log.warning(
                "commands: none for %.2f s: the force is taken off until the next heartbeat",
                time.monotonic() - self._heard_s,
            )
            self._tell("heartbeat_missed", "", {"after_s": self._heartbeat_s})

    def _tell(self, name: str, command_id: str, what: Mapping[str, Any]) -> None:
        """Publish a change, shortened if it is too long to store for all subscribers."""
        told = dict(what)
        if len(encode(told)) > EVENT_BYTES_MAX:
            told = {"keys": len(what)}
        self._doing.event("command", name, command_id=command_id, what=told)

    # --- methods --------------------------------------------------------------------------------------

    def _get_state(self, request: Request) -> wire.State:
        if self._newest is None:
            raise Declined("refused", "there has been no tick yet: ask again later")
        return wire.state_of(self._newest[:RECORD_SIZE], self._rendering.servo.epoch_s, self._scene_name)

    def _heartbeat(self, request: Request) -> wire.Alive:
        if self._rendering.force.kept_off(SILENT):
            self._rendering.arm(SILENT)
            self._tell("heartbeat", request.command_id, {"armed": self._rendering.force.wanted})
        return wire.Alive(round(1000 * (self._heartbeat_s or 0.0)))

    def _set_params(self, request: Request) -> wire.Changed:
        before, after, tick = self._rendering.set_parameters(request.params, "set_params")
        old, new = describe(before), describe(after)
        ways = {key: numbered(old, key) for key in request.params}  # the change itself may rename the object
        each = {key: wire.Change(value_at(old, way), value_at(new, way)) for key, way in ways.items()}
        changed = {key: change for key, change in each.items() if change.before != change.after}
        if changed:
            self._tell("set_params", request.command_id, changed)
        return wire.Changed(changed, tick, self._rendering.rig.commands.ramp_s)

    def _set_scene(self, client: bytes, request: Request) -> None:
        asked: wire.SetScene = request.params
        name = asked.name or (asked.scene if isinstance(asked.scene, str) else "unnamed")
        if isinstance(asked.scene, str) and asked.scene not in shipped(schema.Scene):
            raise Declined(
                "bad_params",
                f"no scene is called {shown(asked.scene)}{near(asked.scene, shipped(schema.Scene))}; shipped are "
                f"{', '.join(shipped(schema.Scene))}; one of your own is given whole",
            )

        def read() -> schema.Scene:
            if isinstance(asked.scene, str):
                scene = load_scene(asked.scene)
            else:
                scene = completed(build(schema.Scene, asked.scene, "set_scene"))
            return overridden(scene, asked.overrides, "set_scene") if asked.overrides else scene

        self._go_on_with(read, name, client, request, lambda tick: wire.SceneSet(name, tick))

    def _reset_world(self, client: bytes, request: Request) -> None:
        scene = self._rendering.scene
        if scene.world is None:
            raise Declined("refused", "the scene has no [world]: there is nothing to be put back")
        self._go_on_with(lambda: scene, self._scene_name, client, request, wire.Applied)

    def _go_on_with(
        self,
        read: Callable[[], schema.Scene],
        name: str,
        client: bytes,
        request: Request,
        result: Callable[[int], Any],
    ) -> None:
        """Read, compile and render a scene from zero force, and answer with the `result` of its first tick."""

        def checked() -> schema.Scene:
            scene = read()
            self._rendering.check(scene, self._rendering.rig)  # before it is compiled
            return scene

        def done(outcome: int | Exception) -> None:
            if isinstance(outcome, Exception):
                self._doing.reply(client, declined(self._declined(outcome), request.command_id))
                return
            self._scene_name = name
            self._tell(request.method, request.command_id, {"scene": name, "tick": outcome})
            self._doing.reply(client, answered(request.command_id, result(outcome)))

        self._scenes.ask(Change(checked, name, done))

    def _drive(self, request: Request) -> wire.Applied:
        asked: wire.Drive = request.params
        number, thing = self._object(asked.object)
        if not isinstance(thing.motion, schema.Driven):
            raise Declined(
                "refused", f'object {thing.name} is not driven: its scene says motion = {{ kind = "driven" }}'
            )
        pose: dict[str, Any] = {"position_m": list(asked.position_m)}
        if asked.orientation_wxyz is not msgspec.UNSET:
            pose["orientation_wxyz"] = list(asked.orientation_wxyz)
        _, _, tick = self._rendering.set_parameters({f"object.{number}.{k}": v for k, v in pose.items()}, "drive")
        self._tell("drive", request.command_id, {"object": thing.name} | pose)
        return wire.Applied(tick)

    def _object(self, asked: str | int) -> tuple[int, schema.Object]:
        """Return the index of an object, and the object."""
        objects = self._rendering.scene.object
        names = [thing.name for thing in objects]
        number = asked if isinstance(asked, int) else names.index(asked) if asked in names else len(names)
        if number >= len(names):
            raise Declined("bad_params", f"no object is {shown(asked)}: there are {', '.join(names)}")
        return number, objects[number]

    def _hand(self, request: Request) -> wire.Applied:
        asked: wire.Hand = request.params
        place = self._finger(asked.finger)
        if asked.release == (asked.position_m is not msgspec.UNSET):  # both, or neither
            raise Declined("bad_params", "say either position_m, where the hand is to be, or release")
        wanted = None
        if asked.position_m is not msgspec.UNSET:
            turn = None if asked.orientation_wxyz is msgspec.UNSET else asked.orientation_wxyz
            hand_of(self._rendering.servo.devices[place])  # raises NoSimulatedHand even before the first tick
            wanted = RequestedPose(asked.position_m, turn, self._turned(place))
        self._rendering.lead(place, wanted)
        self._tell_led(place, not asked.release, request)
        return wire.Applied(self._rendering.servo.ticks)

    def _hold(self, request: Request) -> wire.Held:
        place = self._finger(request.params.finger)
        goal = self._rendering.hold(place)
        self._tell_led(place, True, request)
        return wire.Held(goal.position, goal.orientation, self._rendering.servo.ticks)

    def _tell_led(self, place: int, led: bool, request: Request) -> None:
        """Publish when a program starts or stops moving a hand; every record has its pose."""
        if (place in self._led) != led:
            (self._led.add if led else self._led.discard)(place)
            name = self._rendering.scene.fingers[place].name
            self._tell(request.method, request.command_id, {"finger": name, "led": led})

    def _turned(self, place: int) -> wire.Quaternion:
        """Return the orientation of a finger."""
        if self._newest is None:
            raise Declined("refused", "there has been no tick yet: ask again later")
        at = AT.probe_orientation
        w, x, y, z = self._newest.reshape(-1, RECORD_SIZE)[place][at : at + 4].tolist()
        return w, x, y, z

    def _finger(self, asked: str | int | msgspec.UnsetType) -> int:
        """Return the index of a finger given by name or index; a single finger need not be given. Raises Declined."""
        names = [finger.name for finger in self._rendering.scene.fingers]
        if asked is msgspec.UNSET and len(names) > 1:
            raise Declined("bad_params", f"there are several fingers: say finger, one of {', '.join(names)}")
        given = 0 if asked is msgspec.UNSET else asked
        place = given if isinstance(given, int) else names.index(given) if given in names else len(names)
        if place >= len(names):
            there = f"there are {', '.join(names)}" if len(names) > 1 else "there is one, without a name: leave it out"
            raise Declined("bad_params", f"no finger is {shown(given)}: {there}")
        return place

    def _arm(self, request: Request) -> wire.Armed:
        before = self._rendering.force.wanted
        self._rendering.arm(COMMANDED, SILENT, UNARMED, FAST)
        return self._switched(request, before)

    def _disarm(self, request: Request) -> wire.Armed:
        before = self._rendering.force.wanted
        self._rendering.disarm(COMMANDED)
        return self._switched(request, before)

    def _switched(self, request: Request, before: bool) -> wire.Armed:
        if self._rendering.force.wanted != before:
            self._tell(request.method, request.command_id, {"armed": self._rendering.force.wanted})
        return wire.Armed(self._rendering.force.wanted)

    def _zero(self, request: Request) -> wire.Zeroed:
        asked: wire.Zero = request.params
        place = self._finger(asked.finger)
        if self._rendering.force.wanted:
            raise Declined(
                "refused", "there may be force, and the probe would jump under it: disarm first, and arm after"
            )
        if self._newest is None:
            raise Declined("refused", "there has been no tick yet: ask again later")
        seen = self._newest.reshape(-1, RECORD_SIZE)[place]
        tick = self._rendering.move(place, None if asked.reset else asked.position_m, seen)
        offset = self._rendering.offsets[place]
        self._tell(
            "zero", request.command_id, {"finger": self._rendering.scene.fingers[place].name, "offset_m": offset}
        )
        return wire.Zeroed(offset, tick)

    def _mark(self, request: Request) -> wire.Applied:
        asked: wire.Mark = request.params
        if len(encode(asked.data)) > EVENT_BYTES_MAX:
            raise Declined("bad_params", f"data has more than {EVENT_BYTES_MAX} bytes: mark what is kept elsewhere")
        tick = self._rendering.servo.ticks
        self._doing.event("mark", "mark", command_id=request.command_id, label=asked.label, data=asked.data)
        return wire.Applied(tick)

    def _describe(self, request: Request) -> dict[str, Any]:
        about = described(self._rendering, self._scene_name)
        endpoints = {"telemetry": self._doing.telemetry, "commands": self.endpoint}
        return {
            "wire": wire_schema(), "ring": self._doing.ring(), "commands": wire.schema(), "endpoints": endpoints,
        } | about  # fmt: skip

    def _mesh(self, request: Request) -> wire.Triangles:
        _, thing = self._object(request.params.object)
        if not isinstance(thing, Filed):
            raise Declined("refused", f"object {thing.name} is a {thing.shape} and no mesh: its table says all")
        (vertices, triangles), of = picture_of(thing)
        return wire.Triangles(vertices.astype("<f4").tobytes(), triangles.astype("<u4").tobytes(), of)

    def _record_start(self, request: Request) -> wire.RecordStarted:
        asked: wire.RecordStart = request.params
        file = str(self._doing.recordings.begin(asked.file, self._scene_name))
        self._tell("record_start", request.command_id, {"file": file})
        return wire.RecordStarted(file, self._rendering.servo.ticks)

    def _record_stop(self, request: Request) -> wire.RecordStopped:
        file, recorded = self._doing.recordings.end()
        self._tell("record_stop", request.command_id, {"file": str(file), "ticks": recorded.ticks})
        return wire.RecordStopped(str(file), *recorded)

    def _stop(self, request: Request) -> wire.Stopping:
        self._tell("stop", request.command_id, {})
        self._doing.stop()
        return wire.Stopping(True)
