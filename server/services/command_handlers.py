"""Handlers of the methods of the command endpoint. The file is as long as the list of methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import HapticError
from softfinger.config.load import add_objects_of_world, apply_overrides, build, describe, load_scene
from softfinger.config.overrides import find_value, to_indexed_key
from softfinger.config.sources import list_shipped
from softfinger.config.words import format_value, suggest
from softfinger.drivers.simulated.hand import RequestedPose, find_hand
from softfinger.proxy.pictures import Filed, make_picture
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.services.description import describe_daemon
from softfinger.server.services.prompts import Prompts
from softfinger.server.services.recordings import Recordings
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering
from softfinger.server.services.scene_changes import SceneChanges, SceneRequest
from softfinger.server.states import COMMANDED_REASON, NO_HEARTBEAT_REASON, NOT_ARMED_REASON, TOO_FAST_REASON
from softfinger.server.wire import commands as wire
from softfinger.server.wire.envelope import DeclinedRequest, Request
from softfinger.server.wire.protocol import describe_messages, encode
from softfinger.server.wire.publisher import Publisher

EVENT_BYTES_MAX: Final = 1024
"""Largest part of a request that is copied into an event: the publisher stores 40 000 messages for slow subscribers."""

OnResult = Callable[[Any], None]
"""Callback with the result of a deferred method, or the exception that ended it."""


class DaemonInterface(NamedTuple):
    """Interface of the commands to the daemon, other than the rendering.

    replace  renders a scene under a name, and returns its first tick
    """

    publisher: Publisher
    recordings: Recordings
    replace: Callable[[schema.Scene, str], int]
    event: Callable[..., None]
    stop: Callable[[], None]
    fail: Callable[[HapticError], None]


class CommandHandlers:
    """Handlers of all methods, each named as its method. They return the result or raise an exception.

    `set_scene` and `reset_world` return before the scene is compiled, and call `on_result` later.

    scene_name  name of the initial scene
    """

    def __init__(self, endpoint: str, rendering: Rendering, daemon: DaemonInterface, scene_name: str) -> None:
        self._endpoint, self._rendering, self._daemon, self._scene_name = endpoint, rendering, daemon, scene_name
        self._latest: NDArray[np.float64] | None = None
        self._led_fingers: Final = set[int]()
        """Indices of the fingers with hands moved by a program."""
        self.scenes: Final = SceneChanges(daemon.replace, daemon.publisher.set_preparing)
        prompts = Prompts(self.publish_change, lambda: rendering.servo.ticks)
        self.get_prompt, self.set_prompt, self.answer = prompts.get, prompts.set, prompts.answer
        self.sink: Final = Sink("commands", self._store_latest)

    def _store_latest(self, records: NDArray[np.float64], drops: int) -> None:
        self._latest = records[-1].copy()

    def _read_latest_record(self, finger_index: int = 0) -> NDArray[np.float64]:
        if self._latest is None:
            raise DeclinedRequest("refused", "there is no tick yet: repeat the request later")
        record: NDArray[np.float64] = self._latest.reshape(-1, RECORD_SIZE)[finger_index]
        return record

    def publish_change(self, name: str, command_id: str, change: Mapping[str, Any]) -> None:
        """Publish a change, shortened if it is too long to store for all subscribers."""
        content = dict(change)
        if len(encode(content)) > EVENT_BYTES_MAX:
            content = {"keys": len(change)}
        self._daemon.event("command", name, command_id=command_id, what=content)

    def get_state(self, request: Request) -> wire.StateResult:
        return wire.make_state(self._read_latest_record(), self._rendering.servo.epoch_s, self._scene_name)

    def heartbeat(self, request: Request) -> wire.HeartbeatResult:
        if self._rendering.force.is_inhibited_by(NO_HEARTBEAT_REASON):
            self._rendering.arm(NO_HEARTBEAT_REASON)
            self.publish_change("heartbeat", request.command_id, {"armed": self._rendering.force.is_requested})
        return wire.HeartbeatResult(round(1000 * (self._rendering.rig.commands.heartbeat_s or 0.0)))

    def set_params(self, request: Request) -> wire.SetParamsResult:
        before, after, tick = self._rendering.set_parameters(request.params, "set_params")
        old, new = describe(before), describe(after)
        paths = {key: to_indexed_key(old, key) for key in request.params}  # the change itself may rename the object
        changes = {key: wire.Change(find_value(old, path), find_value(new, path)) for key, path in paths.items()}
        changed = {key: change for key, change in changes.items() if change.before != change.after}
        if changed:
            self.publish_change("set_params", request.command_id, changed)
        return wire.SetParamsResult(changed, tick, self._rendering.rig.commands.ramp_s)

    def set_scene(self, request: Request, on_result: OnResult) -> None:
        params: wire.SetScene = request.params
        name = params.name or (params.scene if isinstance(params.scene, str) else "unnamed")
        if isinstance(params.scene, str) and params.scene not in list_shipped(schema.Scene):
            raise DeclinedRequest(
                "bad_params",
                f"no scene is called {format_value(params.scene)}{suggest(params.scene, list_shipped(schema.Scene))}; "
                f"shipped are {', '.join(list_shipped(schema.Scene))}; send another one as a complete map",
            )

        def read() -> schema.Scene:
            if isinstance(params.scene, str):
                scene = load_scene(params.scene)
            else:
                scene = add_objects_of_world(build(schema.Scene, params.scene, "set_scene"))
            return apply_overrides(scene, params.overrides, "set_scene") if params.overrides else scene

        self._change_scene(read, name, request, lambda tick: wire.SetSceneResult(name, tick), on_result)

    def reset_world(self, request: Request, on_result: OnResult) -> None:
        scene = self._rendering.scene
        if scene.world is None:
            raise DeclinedRequest("refused", "the scene has no [world]: there is nothing to reset")
        self._change_scene(lambda: scene, self._scene_name, request, wire.AppliedResult, on_result)

    def _change_scene(
        self,
        read: Callable[[], schema.Scene],
        name: str,
        request: Request,
        result: Callable[[int], Any],
        on_result: OnResult,
    ) -> None:
        """Read, compile and render a scene from zero force; the result is of its first tick."""

        def read_checked() -> schema.Scene:
            scene = read()
            self._rendering.check(scene, self._rendering.rig)  # before it is compiled
            return scene

        def finish(outcome: int | Exception) -> None:
            if isinstance(outcome, Exception):
                on_result(outcome)
                return
            self._scene_name = name
            self.publish_change(request.method, request.command_id, {"scene": name, "tick": outcome})
            on_result(result(outcome))

        self.scenes.request(SceneRequest(read_checked, name, finish))

    def drive(self, request: Request) -> wire.AppliedResult:
        params: wire.Drive = request.params
        scene_index, obj = self._find_object(params.object)
        if not isinstance(obj.motion, schema.Driven):
            raise DeclinedRequest(
                "refused", f'object {obj.name} is not driven: it needs motion = {{ kind = "driven" }}'
            )
        pose: dict[str, Any] = {"position_m": list(params.position_m)}
        if params.orientation_wxyz is not msgspec.UNSET:
            pose["orientation_wxyz"] = list(params.orientation_wxyz)
        _, _, tick = self._rendering.set_parameters({f"object.{scene_index}.{k}": v for k, v in pose.items()}, "drive")
        self.publish_change("drive", request.command_id, {"object": obj.name} | pose)
        return wire.AppliedResult(tick)

    def _find_object(self, key: str | int) -> tuple[int, schema.Object]:
        objects = self._rendering.scene.object
        names = [obj.name for obj in objects]
        scene_index = key if isinstance(key, int) else names.index(key) if key in names else len(names)
        if scene_index >= len(names):
            raise DeclinedRequest(
                "bad_params", f"there is no object {format_value(key)}; objects are {', '.join(names)}"
            )
        return scene_index, objects[scene_index]

    def hand(self, request: Request) -> wire.AppliedResult:
        params: wire.HandTarget = request.params
        finger_index = self._find_finger(params.finger)
        if params.release == (params.position_m is not msgspec.UNSET):  # both, or neither
            raise DeclinedRequest("bad_params", "give either position_m, the goal of the hand, or release")
        target = None
        if params.position_m is not msgspec.UNSET:
            turn = None if params.orientation_wxyz is msgspec.UNSET else params.orientation_wxyz
            find_hand(self._rendering.servo.devices[finger_index])  # raises NoSimulatedHand even before the first tick
            w, x, y, z = self._read_latest_record(finger_index)[AT.probe_orientation :][:4].tolist()
            target = RequestedPose(params.position_m, turn, (w, x, y, z))
        self._rendering.lead_hand(finger_index, target)
        self._publish_led(finger_index, not params.release, request)
        return wire.AppliedResult(self._rendering.servo.ticks)

    def hold(self, request: Request) -> wire.HandPose:
        finger_index = self._find_finger(request.params.finger)
        goal = self._rendering.hold_hand(finger_index)
        self._publish_led(finger_index, True, request)
        return wire.HandPose(goal.position, goal.orientation, self._rendering.servo.ticks)

    def _publish_led(self, finger_index: int, led: bool, request: Request) -> None:
        if (finger_index in self._led_fingers) != led:
            (self._led_fingers.add if led else self._led_fingers.discard)(finger_index)
            name = self._rendering.scene.fingers[finger_index].name
            self.publish_change(request.method, request.command_id, {"finger": name, "led": led})

    def _find_finger(self, key: str | int | msgspec.UnsetType) -> int:
        """Return the index of a finger given by name or index; a single finger need not be given.

        Raises DeclinedRequest if there is no such finger.
        """
        names = [finger.name for finger in self._rendering.scene.fingers]
        if key is msgspec.UNSET and len(names) > 1:
            raise DeclinedRequest("bad_params", f"there are several fingers: set finger to one of {', '.join(names)}")
        selected = 0 if key is msgspec.UNSET else key
        finger_index = (
            selected if isinstance(selected, int) else names.index(selected) if selected in names else len(names)
        )
        if finger_index >= len(names):
            choices = (
                f"fingers are {', '.join(names)}"
                if len(names) > 1
                else "the scene has a single finger: remove the parameter"
            )
            raise DeclinedRequest("bad_params", f"there is no finger {format_value(selected)}; {choices}")
        return finger_index

    def arm(self, request: Request) -> wire.ArmResult:
        before = self._rendering.force.is_requested
        self._rendering.arm(COMMANDED_REASON, NO_HEARTBEAT_REASON, NOT_ARMED_REASON, TOO_FAST_REASON)
        return self._publish_armed(request, before)

    def disarm(self, request: Request) -> wire.ArmResult:
        before = self._rendering.force.is_requested
        self._rendering.disarm(COMMANDED_REASON)
        return self._publish_armed(request, before)

    def _publish_armed(self, request: Request, before: bool) -> wire.ArmResult:
        if self._rendering.force.is_requested != before:
            self.publish_change(request.method, request.command_id, {"armed": self._rendering.force.is_requested})
        return wire.ArmResult(self._rendering.force.is_requested)

    def zero(self, request: Request) -> wire.ZeroResult:
        params: wire.Zero = request.params
        finger_index = self._find_finger(params.finger)
        if self._rendering.force.is_requested:
            raise DeclinedRequest(
                "refused", "the probe would jump while force is enabled: disarm first, and arm afterwards"
            )
        record = self._read_latest_record(finger_index)
        tick = self._rendering.set_offset(finger_index, None if params.reset else params.position_m, record)
        offset = self._rendering.offsets[finger_index]
        self.publish_change(
            "zero", request.command_id, {"finger": self._rendering.scene.fingers[finger_index].name, "offset_m": offset}
        )
        return wire.ZeroResult(offset, tick)

    def mark(self, request: Request) -> wire.AppliedResult:
        params: wire.Mark = request.params
        if len(encode(params.data)) > EVENT_BYTES_MAX:
            raise DeclinedRequest(
                "bad_params",
                f"data has more than {EVENT_BYTES_MAX} bytes: store the data elsewhere, and mark the name of its file",
            )
        tick = self._rendering.servo.ticks
        self._daemon.event("mark", "mark", command_id=request.command_id, label=params.label, data=params.data)
        return wire.AppliedResult(tick)

    def describe(self, request: Request) -> dict[str, Any]:
        publisher, about = self._daemon.publisher, describe_daemon(self._rendering, self._scene_name)
        endpoints = {"telemetry": publisher.endpoint, "commands": self._endpoint}
        interfaces = {"wire": describe_messages(), "ring": publisher.ring(), "commands": wire.make_schema()}
        return interfaces | {"endpoints": endpoints} | about

    def mesh(self, request: Request) -> wire.MeshResult:
        _, obj = self._find_object(request.params.object)
        if not isinstance(obj, Filed):
            raise DeclinedRequest(
                "refused", f"object {obj.name} is a {obj.shape} and no mesh: its table describes it completely"
            )
        (vertices, triangles), of = make_picture(obj)
        return wire.MeshResult(vertices.astype("<f4").tobytes(), triangles.astype("<u4").tobytes(), of)

    def record_start(self, request: Request) -> wire.RecordStartResult:
        params: wire.RecordStart = request.params
        file = str(self._daemon.recordings.begin(params.file, self._scene_name))
        self.publish_change("record_start", request.command_id, {"file": file})
        return wire.RecordStartResult(file, self._rendering.servo.ticks)

    def record_stop(self, request: Request) -> wire.RecordStopResult:
        file, recorded = self._daemon.recordings.end()
        self.publish_change("record_stop", request.command_id, {"file": str(file), "ticks": recorded.ticks})
        return wire.RecordStopResult(str(file), *recorded)

    def stop(self, request: Request) -> wire.StopResult:
        self._rendering.force.inhibit(COMMANDED_REASON)  # no force in the tick that ends the loop
        self._daemon.stop()
        self.publish_change("stop", request.command_id, {})
        return wire.StopResult(True)
