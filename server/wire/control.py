"""Clients that command a running daemon: a blocking one, and one for asyncio.

    with Control() as daemon:
        daemon.set_params({"object.table.material.stiffness_n_per_m": 800.0})
        print(daemon.get_state().force)

Each method in docs/protocol.md is a method here, and returns the result documented there. Both clients raise
CommandRefused if the daemon refuses a command, and NoAnswer after a timeout.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, Final, ParamSpec, Self, Unpack

import zmq
import zmq.asyncio

from softfinger.config.arguments import check_mapping, check_text
from softfinger.config.errors import CommandRefused
from softfinger.config.overrides import CHANGES_EXAMPLE
from softfinger.drivers.closeable import Closeable
from softfinger.server.keys import ClientKeys, check_keys
from softfinger.server.wire import commands
from softfinger.server.wire.client_requests import (
    RESEND_S,
    RESENT,
    TIMEOUT_S,
    NoAnswer,
    R,
    choose_timeout,
    connect_commands,
    decode_answer,
    encode_request,
    extract_result,
    find_default_commands,
    make_no_answer_error,
    to_milliseconds,
    to_unset,
)

P = ParamSpec("P")
SCENE_EXAMPLE: Final = '{"fingertip": {"radius_m": 0.01}, "object": [...]}, or the name of a shipped scene'
DATA_EXAMPLE: Final = '{"trial": 7}'


class Control(Closeable):
    """Client that waits for each answer; for one thread only.

    Parameters
    ----------
    endpoint
        Command endpoint, which the daemon prints at its start; by default that of this user's daemon on the usual
        telemetry endpoint.
    timeout_s
        Longest wait for an answer, s; None selects it by method.
    keys
        Keys of the client, if the server requires them.
    """

    def __init__(
        self, endpoint: str | None = None, timeout_s: float | None = None, keys: ClientKeys | None = None
    ) -> None:
        to_milliseconds(timeout_s)  # raises ConfigError if it is no time
        self.endpoint = find_default_commands() if endpoint is None else check_text(endpoint, "endpoint", "ipc:///path")
        self.timeout_s, self._keys = timeout_s, check_keys(keys)
        self._connect()

    def _connect(self) -> None:
        self._process = os.getpid()
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        connect_commands(self._socket, self.endpoint, self._keys)

    def _move(self, endpoint: str) -> None:
        """Connect to another endpoint, without keys."""
        self._socket.close()
        self.endpoint, self._keys = endpoint, None
        self._connect()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: commands on {self.endpoint}>"

    def ask(self, method: str, params: Any = commands.Empty()) -> Any:  # noqa: B008 - frozen
        """Call a method by name; return the decoded result."""
        check_text(method, "method", "get_state")
        return self._ask(method, params, commands.METHODS[method].result if method in commands.METHODS else dict)

    def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        if self._process != os.getpid():  # a socket does not survive a fork: libzmq would wait forever
            self._connect()
        wait_s = choose_timeout(method, self.timeout_s)
        if wait_s > TIMEOUT_S and self.timeout_s is None:
            self._check_answers(method)
        until = time.monotonic() + to_milliseconds(wait_s) / 1000.0
        command_id, frames = encode_request(method, params, wait_s)
        send_at = now = time.monotonic()
        while now < until:
            # Sending is impossible if the peer is not a ROUTER or has left a thousand requests unanswered, and libzmq
            # may disconnect at any moment.
            if now >= send_at and self._socket.poll(to_milliseconds(until - now), zmq.POLLOUT):
                with contextlib.suppress(zmq.Again):
                    self._socket.send_multipart(frames, zmq.NOBLOCK)
                    send_at = now + RESEND_S if method in RESENT else until
            elif self._socket.poll(to_milliseconds(min(send_at, until) - now)):
                answer = decode_answer(self._socket.recv_multipart())
                if answer.get("command_id") == command_id:  # not a late answer to an earlier request
                    return extract_result(answer, kind)
            now = time.monotonic()
        raise make_no_answer_error(method, self.endpoint, wait_s)

    def post(self, method: str) -> None:
        """Send a request without parameters and ignore its answer."""
        with contextlib.suppress(zmq.Again):
            self._socket.send_multipart(encode_request(method, commands.Empty(), TIMEOUT_S)[1], zmq.NOBLOCK)

    def _check_answers(self, method: str) -> None:
        """Raise NoAnswer if a short request gets no answer, instead of waiting for as long as `method` may take."""
        try:
            self._ask("get_state", commands.Empty(), commands.StateResult)
        except CommandRefused:  # this is an answer, too
            return
        except NoAnswer as error:
            raise make_no_answer_error(method, self.endpoint, TIMEOUT_S) from error

    def get_state(self) -> commands.StateResult:
        """Return the latest tick of the first finger: position, velocity, force, contact."""
        return self._ask("get_state", commands.Empty(), commands.StateResult)

    def heartbeat(self) -> commands.HeartbeatResult:
        """Send a sign of life, for a rig with `heartbeat_s`; restores the force that a missed heartbeat removed."""
        return self._ask("heartbeat", commands.Empty(), commands.HeartbeatResult)

    def set_params(self, values: Mapping[str, Any]) -> commands.SetParamsResult:
        """Change parameters of the scene by dotted key, all between the same two ticks or none; return the changes."""
        return self._ask("set_params", values, commands.SetParamsResult)

    def set_scene(
        self, scene: str | Mapping[str, Any], overrides: Mapping[str, Any] | None = None, name: str = ""
    ) -> commands.SetSceneResult:
        """Replace the scene, starting from zero force: a shipped scene by name, or a mapping like a file.

        The new scene is compiled first.
        """
        source = scene if isinstance(scene, str) else dict(check_mapping(scene, "scene", SCENE_EXAMPLE))
        changes = dict(check_mapping({} if overrides is None else overrides, "overrides", CHANGES_EXAMPLE))
        return self._ask("set_scene", commands.SetScene(source, changes, name), commands.SetSceneResult)

    def reset_world(self) -> commands.AppliedResult:
        """Reset the bodies of the scene's [world] to their initial poses, at zero force."""
        return self._ask("reset_world", commands.Empty(), commands.AppliedResult)

    def drive(
        self, what: str | int, position_m: commands.Vector, orientation_wxyz: commands.Quaternion | None = None
    ) -> commands.AppliedResult:
        """Set the pose of a driven object, by name or index: position (m, world) and orientation (w, x, y, z)."""
        return self._ask("drive", commands.Drive(what, position_m, to_unset(orientation_wxyz)), commands.AppliedResult)

    def hand(
        self,
        position_m: commands.Vector | None = None,
        orientation_wxyz: commands.Quaternion | None = None,
        finger: str | int | None = None,
        release: bool = False,
    ) -> commands.AppliedResult:
        """Set the goal pose of the fingertip for the hand on a simulated device.

        Refused for any other device, and for a hand that is moved by a puck.

        Parameters
        ----------
        position_m
            Position, m, world; by default the present goal.
        orientation_wxyz
            Quaternion (w, x, y, z), fingertip to world; by default the present goal.
        finger
            Name or index of the finger; not needed for a single one.
        release
            Return the hand to the motion of its rig.
        """
        return self._ask(
            "hand",
            commands.HandTarget(to_unset(position_m), to_unset(orientation_wxyz), to_unset(finger), release),
            commands.AppliedResult,
        )

    def hold(self, finger: str | int | None = None) -> commands.HandPose:
        """Hold the hand on a simulated device at its present goal, with its grip force; return that goal."""
        return self._ask("hold", commands.Hold(to_unset(finger)), commands.HandPose)

    def arm(self) -> commands.ArmResult:
        """Let the force fade in along the guard's ramp."""
        return self._ask("arm", commands.Empty(), commands.ArmResult)

    def disarm(self) -> commands.ArmResult:
        """Turn off the force of all fingers until `arm`; ticks continue. Not an emergency stop."""
        return self._ask("disarm", commands.Empty(), commands.ArmResult)

    def zero(
        self, position_m: commands.Vector = (0.0, 0.0, 0.0), finger: str | int | None = None, reset: bool = False
    ) -> commands.ZeroResult:
        """Define the present position (m, world) of the probe; `reset` removes the offset.

        `finger` is a name or an index. Refused while the force may be on: `disarm` first.
        """
        return self._ask("zero", commands.Zero(position_m, to_unset(finger), reset), commands.ZeroResult)

    def mark(self, label: str, data: Mapping[str, Any] | None = None) -> commands.AppliedResult:
        """Publish an event with a label, which is also part of every recording."""
        return self._ask(
            "mark",
            commands.Mark(label, dict(check_mapping({} if data is None else data, "data", DATA_EXAMPLE))),
            commands.AppliedResult,
        )

    def get_prompt(self) -> commands.PromptResult:
        """Return the prompt that pages show the participant, and its answer."""
        return self._ask("get_prompt", commands.Empty(), commands.PromptResult)

    def set_prompt(
        self,
        title: str = "",
        text: str = "",
        progress: tuple[int, int] = (0, 0),
        choices: Sequence[str] = (),
        number: tuple[float, float] | None = None,
        text_length: int = 0,
        **screen: Unpack[commands.PromptScreen],
    ) -> commands.PromptResult:
        """Show a title, a text, progress (done, total) and a question on all pages.

        The answer is one of `choices`, a number in the range `number`, or a text of at most `text_length` characters.
        `screen` is what the participant's page adds: `colour`, `image`, `masking_noise`, `volume`, as in `Prompt`.
        """
        prompt = commands.Prompt(title, text, *progress, tuple(choices), number, text_length, **screen)
        return self._ask("set_prompt", prompt, commands.PromptResult)

    def answer(self, value: str | float, prompt: int | None = None) -> commands.AppliedResult:
        """Answer the question with this prompt number, by default the present one; refused if none is open."""
        return self._ask("answer", commands.Answer(value, prompt), commands.AppliedResult)

    def record_start(self, file: str) -> commands.RecordStartResult:
        """Record every tick and event into a new .mcap file below the rig's [recording] directory."""
        return self._ask("record_start", commands.RecordStart(file), commands.RecordStartResult)

    def record_stop(self) -> commands.RecordStopResult:
        """End the recording; return its number of ticks and other statistics."""
        return self._ask("record_stop", commands.Empty(), commands.RecordStopResult)

    def describe(self) -> dict[str, Any]:
        """Return rig, scene, device, fingers, versions, and the protocol as data."""
        return self._ask("describe", commands.Empty(), dict)

    def mesh(self, what: str | int) -> commands.MeshResult:
        """Return the triangles of an object that is a mesh or a height map, by name or index, for display."""
        return self._ask("mesh", commands.ObjectReference(what), commands.MeshResult)

    def stop(self) -> commands.StopResult:
        """End the daemon in order."""
        return self._ask("stop", commands.Empty(), commands.StopResult)

    def close(self) -> None:
        """Disconnect; may be called repeatedly."""
        self._socket.close()


def _make_awaitable(
    command: Callable[Concatenate[Control, P], R],
) -> Callable[Concatenate[AsyncControl, P], Coroutine[Any, Any, R]]:
    """Convert a command of Control for asyncio: the awaitable returned by `_ask` is awaited."""

    @wraps(command)
    async def awaited(self: AsyncControl, /, *args: P.args, **kwargs: P.kwargs) -> R:
        answer: Any = command(self, *args, **kwargs)  # type: ignore[arg-type]
        return await answer  # type: ignore[no-any-return]

    return awaited


class AsyncControl:
    """Client for asyncio, used with `async with`; any number of requests may wait for their answers."""

    def __init__(
        self, endpoint: str | None = None, timeout_s: float | None = None, keys: ClientKeys | None = None
    ) -> None:
        to_milliseconds(timeout_s)  # raises ConfigError if it is no time
        self.endpoint = find_default_commands() if endpoint is None else check_text(endpoint, "endpoint", "ipc:///path")
        self.timeout_s, self._keys = timeout_s, check_keys(keys)
        self._connect()

    def _connect(self) -> None:
        self._process = os.getpid()
        self._socket: zmq.asyncio.Socket = zmq.asyncio.Context.instance().socket(zmq.DEALER)
        connect_commands(self._socket, self.endpoint, self._keys)
        self._waiting: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._reader: asyncio.Task[None] | None = None

    async def ask(self, method: str, params: Any = commands.Empty()) -> Any:  # noqa: B008 - frozen
        """Call a method by name; return the decoded result."""
        check_text(method, "method", "get_state")
        return await self._ask(method, params, commands.METHODS[method].result if method in commands.METHODS else dict)

    async def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        if self._process != os.getpid():  # as in Control
            self._connect()
            self._reader = asyncio.create_task(self._read())
        wait_s = choose_timeout(method, self.timeout_s)
        if wait_s > TIMEOUT_S and self.timeout_s is None:
            await self._check_answers(method)
        command_id, frames = encode_request(method, params, wait_s)
        answer = self._waiting[command_id] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(to_milliseconds(wait_s) / 1000.0):
                await self._socket.send_multipart(frames)  # waits as long as sending is impossible
                while method in RESENT and not (await asyncio.wait([answer], timeout=RESEND_S))[0]:
                    await self._socket.send_multipart(frames)
                return extract_result(await answer, kind)
        except TimeoutError:
            raise make_no_answer_error(method, self.endpoint, wait_s) from None
        finally:
            del self._waiting[command_id]

    async def _check_answers(self, method: str) -> None:
        """Raise NoAnswer as in Control."""
        try:
            await self._ask("get_state", commands.Empty(), commands.StateResult)
        except CommandRefused:
            return
        except NoAnswer as error:
            raise make_no_answer_error(method, self.endpoint, TIMEOUT_S) from error

    async def _read(self) -> None:
        while True:
            answer = decode_answer(await self._socket.recv_multipart())
            future = self._waiting.get(str(answer.get("command_id")))
            if future is not None and not future.done():
                future.set_result(answer)

    get_state = _make_awaitable(Control.get_state)
    heartbeat = _make_awaitable(Control.heartbeat)
    set_params = _make_awaitable(Control.set_params)
    set_scene = _make_awaitable(Control.set_scene)
    reset_world = _make_awaitable(Control.reset_world)
    drive = _make_awaitable(Control.drive)
    hand = _make_awaitable(Control.hand)
    hold = _make_awaitable(Control.hold)
    arm = _make_awaitable(Control.arm)
    disarm = _make_awaitable(Control.disarm)
    zero = _make_awaitable(Control.zero)
    mark = _make_awaitable(Control.mark)
    get_prompt = _make_awaitable(Control.get_prompt)
    set_prompt = _make_awaitable(Control.set_prompt)
    answer = _make_awaitable(Control.answer)
    record_start = _make_awaitable(Control.record_start)
    record_stop = _make_awaitable(Control.record_stop)
    describe = _make_awaitable(Control.describe)
    mesh = _make_awaitable(Control.mesh)
    stop = _make_awaitable(Control.stop)

    async def close(self) -> None:
        """Disconnect; may be called repeatedly."""
        if self._reader is not None:
            self._reader.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._reader
            self._reader = None
        self._socket.close()

    async def __aenter__(self) -> Self:
        if self._process != os.getpid():
            self._connect()
        self._reader = asyncio.create_task(self._read())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
