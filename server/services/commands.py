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
from softfinger.config.load import add_objects_of_world, apply_overrides, build, describe, load_scene
from softfinger.config.overrides import index_entries, value_at
from softfinger.config.sources import list_shipped
from softfinger.config.words import format_value, near
from softfinger.drivers import switch_interval
from softfinger.drivers.simulated.lead import RequestedPose, hand_of
from softfinger.proxy.pictures import Filed, picture_of
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop import shutdown
from softfinger.server.publishing.brake import SHORT
from softfinger.server.services.base import JOIN_S
from softfinger.server.services.compilation import NotCompiled, SceneChanges, SceneRequest, Superseded
from softfinger.server.services.description import describe_daemon
from softfinger.server.services.prompts import Prompts
from softfinger.server.services.recordings import Recordings
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering, Replacing
from softfinger.server.states import COMMANDED, FAST, SILENT, UNARMED
from softfinger.server.wire import commands as wire
from softfinger.server.wire.envelope import Declined, Request, encode_answer, encode_refusal, parse
from softfinger.server.wire.link import RequestHandlers
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


class DaemonInterface(NamedTuple):
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
    report      publishes the progress of a scene in preparation; empty: there is none
    """

    replace: Callable[[schema.Scene, str], int]
    ring: Callable[[], dict[str, Any]]
    telemetry: str
    serve: Callable[[RequestHandlers | None], None]
    reply: Callable[[bytes, bytes], None]
    event: Callable[..., None]
    stop: Callable[[], None]
    fail: Callable[[HapticError], None]
    recordings: Recordings
    report: Callable[[str], None]


class CommandService:
    """Service that answers the requests of an endpoint.

    scene_name  name of the initial scene
    """

    def __init__(self, endpoint: str, rendering: Rendering, daemon: DaemonInterface, scene_name: str) -> None:
        self.endpoint: Final = endpoint
        self._rendering, self._daemon, self._scene_name = rendering, daemon, scene_name
        self._heartbeat_s = rendering.rig.commands.heartbeat_s
        self._started = False
        self._last_request_s = 0.0
        self._logged_s = -LOG_PERIOD_S
        self._latest: NDArray[np.float64] | None = None
        self._led_fingers: Final = set[int]()
        """Indices of the fingers with hands moved by a program."""
        self._scenes = SceneChanges(daemon.replace, daemon.report)
        self._queue: Final = SimpleQueue[tuple[bytes, Request | bytes, bool] | None]()
        self._pending_counts: Final = Counter[bytes]()
        """Number of requests of each client in `_queue` or being answered; protected by `_counts_lock`."""
        self._counts_lock = threading.Lock()
        self._thread = threading.Thread(target=self._run_queue, name="commands", daemon=True)
        prompts = Prompts(self._publish_change, lambda: rendering.servo.ticks)
        self._get_prompt, self._set_prompt, self._answer = prompts.get, prompts.set, prompts.answer
        self.sink: Final = Sink("commands", self._store_latest)

    def start(self) -> None:
        switch_interval.shorten()
        self._started = True
        self._scenes.start()
        self._thread.start()
        self._note_alive()
        self._daemon.serve(RequestHandlers(self._receive, self._check_periodically))

    def stop(self) -> None:
        failed = shutdown.run_all_steps(self._scenes.stop, self._stop_queue, lambda: self._daemon.serve(None))
        if self._started:
            self._started = False
            switch_interval.restore()
        if failed is not None:
            raise failed

    def _stop_queue(self) -> None:
        self._queue.put(None)
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)

    def _store_latest(self, records: NDArray[np.float64], drops: int) -> None:
        self._latest = records[-1].copy()

    # --- requests --------------------------------------------------------------------------------------

    def _receive(self, client: bytes, body: bytes | None, too_much: bool) -> bytes | None:
        """Answer a request, or queue it; never waits."""
        command_id = ""
        try:
            if body is not None and len(body) > SHORT:
                self._enqueue(client, body, too_much)
                return None
            request = self._parse(body, too_much)
            command_id = request.command_id
            if request.method in AT_ONCE:
                return self._handle(request)
            self._enqueue(client, request, too_much)
            return None
        except Exception as error:
            return encode_refusal(self._as_declined(error), command_id)

    def _parse(self, body: bytes | None, too_much: bool) -> Request:
        """Return the parsed request and count it as a sign of life; raises Declined."""
        request = parse(body)
        if too_much:
            raise Declined("busy", "too many requests from this client: ask more slowly", request.command_id)
        self._check_heartbeat()  # a heartbeat missed before this request counts as missed
        self._note_alive()
        return request

    def _note_alive(self) -> None:
        self._last_request_s = time.monotonic()
        if self._heartbeat_s is not None:
            self._rendering.force.end_at(round(1e9 * (self._last_request_s + self._heartbeat_s)))

    def _enqueue(self, client: bytes, message: Request | bytes, too_much: bool) -> None:
        with self._counts_lock:
            if self._pending_counts[client] >= WAITING_MAX:
                raise Declined("busy", "too many requests of this client wait for their turn: wait for answers first")
            self._pending_counts[client] += 1
        self._queue.put((client, message, too_much))

    def _run_queue(self) -> None:
        """Answer queued requests one after the other; runs in its own thread."""
        while (item := self._queue.get()) is not None:
            started = time.monotonic()
            client, message, too_much = item
            answer = self._answer_queued(client, message, too_much)
            if answer is not None:
                self._daemon.reply(client, answer)
            with self._counts_lock:
                self._pending_counts[client] -= 1
                if not self._pending_counts[client]:
                    del self._pending_counts[client]
            time.sleep(min(time.monotonic() - started, REST_MAX_S))

    def _answer_queued(self, client: bytes, message: Request | bytes, too_much: bool) -> bytes | None:
        command_id = ""
        try:
            request = self._parse(message, too_much) if isinstance(message, bytes) else message
            command_id = request.command_id
            if request.method == "set_scene":
                self._set_scene(client, request)
                return None
            if request.method == "reset_world":
                self._reset_world(client, request)
                return None
            return self._handle(request)
        except Exception as error:
            return encode_refusal(self._as_declined(error), command_id)

    def _handle(self, request: Request) -> bytes:
        """Handle a request and return the answer."""
        return encode_answer(request.command_id, getattr(self, f"_{request.method}")(request))

    def _as_declined(self, error: Exception) -> Declined:
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

    def _check_periodically(self) -> None:
        try:
            self._check_heartbeat()
        except Exception as error:
            log.exception("commands failed")
            self._daemon.serve(None)
            self._daemon.event("fault", "commands", message=str(error))
            self._daemon.fail(SafetyStop(f"commands cannot be taken: {error}; the heartbeat cannot be checked"))

    def _check_heartbeat(self) -> None:
        """Record a missed heartbeat, if it is missed.

        The loop has already turned the force off, and the next request does not turn it on again.
        """
        if self._heartbeat_s is None or time.monotonic() - self._last_request_s <= self._heartbeat_s:
            return
        if not self._rendering.force.is_inhibited_by(SILENT):
            self._rendering.disarm(SILENT)
            log.warning(
                "commands: none for %.2f s: the force is taken off until the next heartbeat",
                time.monotonic() - self._last_request_s,
            )
            self._publish_change("heartbeat_missed", "", {"after_s": self._heartbeat_s})

    def _publish_change(self, name: str, command_id: str, change: Mapping[str, Any]) -> None:
        """Publish a change, shortened if it is too long to store for all subscribers."""
        content = dict(change)
        if len(encode(content)) > EVENT_BYTES_MAX:
            content = {"keys": len(change)}
        self._daemon.event("command", name, command_id=command_id, what=content)

    # --- methods --------------------------------------------------------------------------------------

    def _get_state(self, request: Request) -> wire.State:
        if self._latest is None:
            raise Declined("refused", "there has been no tick yet: ask again later")
        return wire.state_of(self._latest[:RECORD_SIZE], self._rendering.servo.epoch_s, self._scene_name)

    def _heartbeat(self, request: Request) -> wire.Alive:
        if self._rendering.force.is_inhibited_by(SILENT):
            self._rendering.arm(SILENT)
            self._publish_change("heartbeat", request.command_id, {"armed": self._rendering.force.is_requested})
        return wire.Alive(round(1000 * (self._heartbeat_s or 0.0)))

    def _set_params(self, request: Request) -> wire.Changed:
        before, after, tick = self._rendering.set_parameters(request.params, "set_params")
        old, new = describe(before), describe(after)
        paths = {key: index_entries(old, key) for key in request.params}  # the change itself may rename the object
        changes = {key: wire.Change(value_at(old, path), value_at(new, path)) for key, path in paths.items()}
        changed = {key: change for key, change in changes.items() if change.before != change.after}
        if changed:
            self._publish_change("set_params", request.command_id, changed)
        return wire.Changed(changed, tick, self._rendering.rig.commands.ramp_s)

    def _set_scene(self, client: bytes, request: Request) -> None:
        params: wire.SetScene = request.params
        name = params.name or (params.scene if isinstance(params.scene, str) else "unnamed")
        if isinstance(params.scene, str) and params.scene not in list_shipped(schema.Scene):
            raise Declined(
                "bad_params",
                f"no scene is called {format_value(params.scene)}{near(params.scene, list_shipped(schema.Scene))}; "
                f"shipped are {', '.join(list_shipped(schema.Scene))}; send another one as a complete map",
            )

        def read() -> schema.Scene:
            if isinstance(params.scene, str):
                scene = load_scene(params.scene)
            else:
                scene = add_objects_of_world(build(schema.Scene, params.scene, "set_scene"))
            return apply_overrides(scene, params.overrides, "set_scene") if params.overrides else scene

        self._change_scene(read, name, client, request, lambda tick: wire.SceneSet(name, tick))

    def _reset_world(self, client: bytes, request: Request) -> None:
        scene = self._rendering.scene
        if scene.world is None:
            raise Declined("refused", "the scene has no [world]: there is nothing to be put back")
        self._change_scene(lambda: scene, self._scene_name, client, request, wire.Applied)

    def _change_scene(
        self, read: Callable[[], schema.Scene], name: str, client: bytes, request: Request, result: Callable[[int], Any]
    ) -> None:
        """Read, compile and render a scene from zero force, and answer with the `result` of its first tick."""

        def checked() -> schema.Scene:
            scene = read()
            self._rendering.check(scene, self._rendering.rig)  # before it is compiled
            return scene

        def done(outcome: int | Exception) -> None:
            if isinstance(outcome, Exception):
                self._daemon.reply(client, encode_refusal(self._as_declined(outcome), request.command_id))
                return
            self._scene_name = name
            self._publish_change(request.method, request.command_id, {"scene": name, "tick": outcome})
            self._daemon.reply(client, encode_answer(request.command_id, result(outcome)))

        self._scenes.request(SceneRequest(checked, name, done))

    def _drive(self, request: Request) -> wire.Applied:
        params: wire.Drive = request.params
        scene_index, obj = self._object(params.object)
        if not isinstance(obj.motion, schema.Driven):
            raise Declined("refused", f'object {obj.name} is not driven: it needs motion = {{ kind = "driven" }}')
        pose: dict[str, Any] = {"position_m": list(params.position_m)}
        if params.orientation_wxyz is not msgspec.UNSET:
            pose["orientation_wxyz"] = list(params.orientation_wxyz)
        _, _, tick = self._rendering.set_parameters({f"object.{scene_index}.{k}": v for k, v in pose.items()}, "drive")
        self._publish_change("drive", request.command_id, {"object": obj.name} | pose)
        return wire.Applied(tick)

    def _object(self, key: str | int) -> tuple[int, schema.Object]:
        """Return the index of an object, and the object."""
        objects = self._rendering.scene.object
        names = [obj.name for obj in objects]
        scene_index = key if isinstance(key, int) else names.index(key) if key in names else len(names)
        if scene_index >= len(names):
            raise Declined("bad_params", f"no object is {format_value(key)}: there are {', '.join(names)}")
        return scene_index, objects[scene_index]

    def _hand(self, request: Request) -> wire.Applied:
        params: wire.Hand = request.params
        finger_index = self._finger(params.finger)
        if params.release == (params.position_m is not msgspec.UNSET):  # both, or neither
            raise Declined("bad_params", "give either position_m, the goal of the hand, or release")
        target = None
        if params.position_m is not msgspec.UNSET:
            turn = None if params.orientation_wxyz is msgspec.UNSET else params.orientation_wxyz
            hand_of(self._rendering.servo.devices[finger_index])  # raises NoSimulatedHand even before the first tick
            target = RequestedPose(params.position_m, turn, self._orientation(finger_index))
        self._rendering.lead_hand(finger_index, target)
        self._publish_led(finger_index, not params.release, request)
        return wire.Applied(self._rendering.servo.ticks)

    def _hold(self, request: Request) -> wire.Held:
        finger_index = self._finger(request.params.finger)
        goal = self._rendering.hold_hand(finger_index)
        self._publish_led(finger_index, True, request)
        return wire.Held(goal.position, goal.orientation, self._rendering.servo.ticks)

    def _publish_led(self, finger_index: int, led: bool, request: Request) -> None:
        """Publish when a program starts or stops moving a hand; every record has its pose."""
        if (finger_index in self._led_fingers) != led:
            (self._led_fingers.add if led else self._led_fingers.discard)(finger_index)
            name = self._rendering.scene.fingers[finger_index].name
            self._publish_change(request.method, request.command_id, {"finger": name, "led": led})

    def _orientation(self, finger_index: int) -> wire.Quaternion:
        """Return the orientation of a finger."""
        if self._latest is None:
            raise Declined("refused", "there has been no tick yet: ask again later")
        at = AT.probe_orientation
        w, x, y, z = self._latest.reshape(-1, RECORD_SIZE)[finger_index][at : at + 4].tolist()
        return w, x, y, z

    def _finger(self, key: str | int | msgspec.UnsetType) -> int:
        """Return the index of a finger given by name or index; a single finger need not be given. Raises Declined."""
        names = [finger.name for finger in self._rendering.scene.fingers]
        if key is msgspec.UNSET and len(names) > 1:
            raise Declined("bad_params", f"there are several fingers: give finger, one of {', '.join(names)}")
        selected = 0 if key is msgspec.UNSET else key
        finger_index = (
            selected if isinstance(selected, int) else names.index(selected) if selected in names else len(names)
        )
        if finger_index >= len(names):
            choices = (
                f"there are {', '.join(names)}" if len(names) > 1 else "there is one, without a name: leave it out"
            )
            raise Declined("bad_params", f"no finger is {format_value(selected)}: {choices}")
        return finger_index

    def _arm(self, request: Request) -> wire.Armed:
        before = self._rendering.force.is_requested
        self._rendering.arm(COMMANDED, SILENT, UNARMED, FAST)
        return self._publish_armed(request, before)

    def _disarm(self, request: Request) -> wire.Armed:
        before = self._rendering.force.is_requested
        self._rendering.disarm(COMMANDED)
        return self._publish_armed(request, before)

    def _publish_armed(self, request: Request, before: bool) -> wire.Armed:
        if self._rendering.force.is_requested != before:
            self._publish_change(request.method, request.command_id, {"armed": self._rendering.force.is_requested})
        return wire.Armed(self._rendering.force.is_requested)

    def _zero(self, request: Request) -> wire.Zeroed:
        params: wire.Zero = request.params
        finger_index = self._finger(params.finger)
        if self._rendering.force.is_requested:
            raise Declined(
                "refused", "there may be force, and the probe would jump under it: disarm first, and arm after"
            )
        if self._latest is None:
            raise Declined("refused", "there has been no tick yet: ask again later")
        record = self._latest.reshape(-1, RECORD_SIZE)[finger_index]
        tick = self._rendering.set_offset(finger_index, None if params.reset else params.position_m, record)
        offset = self._rendering.offsets[finger_index]
        self._publish_change(
            "zero", request.command_id, {"finger": self._rendering.scene.fingers[finger_index].name, "offset_m": offset}
        )
        return wire.Zeroed(offset, tick)

    def _mark(self, request: Request) -> wire.Applied:
        params: wire.Mark = request.params
        if len(encode(params.data)) > EVENT_BYTES_MAX:
            raise Declined(
                "bad_params", f"data has more than {EVENT_BYTES_MAX} bytes: store the data elsewhere, and mark its name"
            )
        tick = self._rendering.servo.ticks
        self._daemon.event("mark", "mark", command_id=request.command_id, label=params.label, data=params.data)
        return wire.Applied(tick)

    def _describe(self, request: Request) -> dict[str, Any]:
        about = describe_daemon(self._rendering, self._scene_name)
        endpoints = {"telemetry": self._daemon.telemetry, "commands": self.endpoint}
        return {
            "wire": wire_schema(), "ring": self._daemon.ring(), "commands": wire.schema(), "endpoints": endpoints,
        } | about  # fmt: skip

    def _mesh(self, request: Request) -> wire.Triangles:
        _, obj = self._object(request.params.object)
        if not isinstance(obj, Filed):
            raise Declined(
                "refused", f"object {obj.name} is a {obj.shape} and no mesh: its table describes it completely"
            )
        (vertices, triangles), of = picture_of(obj)
        return wire.Triangles(vertices.astype("<f4").tobytes(), triangles.astype("<u4").tobytes(), of)

    def _record_start(self, request: Request) -> wire.RecordStarted:
        params: wire.RecordStart = request.params
        file = str(self._daemon.recordings.begin(params.file, self._scene_name))
        self._publish_change("record_start", request.command_id, {"file": file})
        return wire.RecordStarted(file, self._rendering.servo.ticks)

    def _record_stop(self, request: Request) -> wire.RecordStopped:
        file, recorded = self._daemon.recordings.end()
        self._publish_change("record_stop", request.command_id, {"file": str(file), "ticks": recorded.ticks})
        return wire.RecordStopped(str(file), *recorded)

    def _stop(self, request: Request) -> wire.Stopping:
        self._publish_change("stop", request.command_id, {})
        self._daemon.stop()
        return wire.Stopping(True)
