"""Commanding a running daemon: a client that waits, and one for asyncio.

    with Control() as daemon:
        daemon.set_params({"object.table.material.stiffness_n_per_m": 800.0})
        print(daemon.get_state().force)

Each method of docs/protocol.md is a method here, and returns what the table there says. Both raise CommandRefused
for what the daemon does not do, NoAnswer where nothing comes in time.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self

import zmq
import zmq.asyncio

from softfinger.config.errors import CommandRefused
from softfinger.server.closing import Closing
from softfinger.server.keys import ClientKeys
from softfinger.server.wire.asking import (
    TIMEOUT_S,
    NoAnswer,
    R,
    answer_in,
    asking,
    connected,
    default_commands,
    given,
    no_answer,
    result_of,
    time_for,
)
from softfinger.server.wire.commands import (
    METHODS,
    Alive,
    Answer,
    Applied,
    Armed,
    Changed,
    Drive,
    Empty,
    Hand,
    Held,
    Hold,
    Mark,
    OfObject,
    Prompt,
    Prompted,
    Quaternion,
    RecordStart,
    RecordStarted,
    RecordStopped,
    SceneSet,
    SetScene,
    State,
    Stopping,
    Triangles,
    Vector,
    Zero,
    Zeroed,
)
from softfinger.server.wire.waits import milliseconds

P = ParamSpec("P")


class Control(Closing):
    """A client that waits for each answer, for at most `timeout_s` (None: what the method needs). One thread only.

    `endpoint` is what the daemon's first lines say; without one, that of this user's daemon on the usual telemetry.
    `keys` are for a server that wants some.
    """

    def __init__(
        self, endpoint: str | None = None, timeout_s: float | None = None, keys: ClientKeys | None = None
    ) -> None:
        self.endpoint, self.timeout_s, self._keys = endpoint or default_commands(), timeout_s, keys
        self._connect()

    def _connect(self) -> None:
        self._process = os.getpid()
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        connected(self._socket, self.endpoint, self._keys)

    def _move(self, endpoint: str) -> None:
        """Command what is at another endpoint."""
        self._socket.close()
        self.endpoint, self._keys = endpoint, None
        self._connect()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: commands on {self.endpoint}>"

    def ask(self, method: str, params: Any = Empty()) -> Any:  # noqa: B008 - frozen
        """Any method by name; returns the result as it came."""
        return self._ask(method, params, METHODS[method].result if method in METHODS else dict)

    def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        if self._process != os.getpid():  # a socket does not survive a fork: libzmq would wait without end
            self._connect()
        wait_s = time_for(method, self.timeout_s)
        if wait_s > TIMEOUT_S and self.timeout_s is None:
            self._check_answers(method)
        until = time.monotonic() + wait_s
        command_id, frames = asking(method, params, wait_s)
        sent = False
        while not sent and self._socket.poll(milliseconds(until - time.monotonic()), zmq.POLLOUT):
            # Where the peer is no ROUTER, or has left a thousand requests unanswered, there is nowhere to send to; and
            # libzmq may hang up at any moment.
            with contextlib.suppress(zmq.Again):
                self._socket.send_multipart(frames, zmq.NOBLOCK)
                sent = True
        while sent and self._socket.poll(milliseconds(until - time.monotonic())):
            answer = answer_in(self._socket.recv_multipart())
            if answer.get("command_id") == command_id:  # and none that came too late for an earlier request
                return result_of(answer, kind)
        raise no_answer(method, self.endpoint, wait_s)

    def _check_answers(self, method: str) -> None:
        """Raise NoAnswer if nobody answers a short request: no need then to wait for as long as `method` takes."""
        try:
            self._ask("get_state", Empty(), State)
        except CommandRefused:  # which is an answer, too
            return
        except NoAnswer as error:
            raise no_answer(method, self.endpoint, TIMEOUT_S) from error

    def get_state(self) -> State:
        """The newest tick in few numbers, of several fingers the first: position, velocity, force, contact."""
        return self._ask("get_state", Empty(), State)

    def heartbeat(self) -> Alive:
        """A sign of life, for a rig with `heartbeat_s`; gives the force back that was taken for want of one."""
        return self._ask("heartbeat", Empty(), Alive)

    def set_params(self, values: Mapping[str, Any]) -> Changed:
        """Parameters of the scene by dotted path, all between the same two ticks, or none; says what they were."""
        return self._ask("set_params", values, Changed)

    def set_scene(
        self, scene: str | Mapping[str, Any], overrides: Mapping[str, Any] | None = None, name: str = ""
    ) -> SceneSet:
        """Another scene, from zero force: the name of a shipped one or a mapping like a file. It is compiled first."""
        source = scene if isinstance(scene, str) else dict(scene)
        return self._ask("set_scene", SetScene(source, dict(overrides or {}), name), SceneSet)

    def reset_world(self) -> Applied:
        """The bodies of the scene's [world] back where they began, from zero force."""
        return self._ask("reset_world", Empty(), Applied)

    def drive(self, what: str | int, position_m: Vector, orientation_wxyz: Quaternion | None = None) -> Applied:
        """Put a driven object, by name or number, at a place (m, world) with an orientation (w, x, y, z)."""
        return self._ask("drive", Drive(what, position_m, given(orientation_wxyz)), Applied)

    def hand(
        self,
        position_m: Vector | None = None,
        orientation_wxyz: Quaternion | None = None,
        finger: str | int | None = None,
        release: bool = False,
    ) -> Applied:
        """Where (m, world) the hand on a simulated device wants to hold the fingertip, and how turned (w, x, y, z).

        What is left out stays as it is; `finger` by name or number, of one finger not needed. `release` lets the hand
        do again what its rig says. Refused for any other device, and for a hand that a puck leads.
        """
        return self._ask("hand", Hand(given(position_m), given(orientation_wxyz), given(finger), release), Applied)

    def hold(self, finger: str | int | None = None) -> Held:
        """The hand on a simulated device stays where it wants to be, with the force that it grips with; says where."""
        return self._ask("hold", Hold(given(finger)), Held)

    def arm(self) -> Armed:
        """Let the force fade in along the guard's ramp."""
        return self._ask("arm", Empty(), Armed)

    def disarm(self) -> Armed:
        """Take the force off every finger until `arm`; devices stay open, ticks go on. No emergency stop."""
        return self._ask("disarm", Empty(), Armed)

    def zero(
        self, position_m: Vector = (0.0, 0.0, 0.0), finger: str | int | None = None, reset: bool = False
    ) -> Zeroed:
        """Say where (m, world) the probe is now, for a finger by name or number; `reset` takes the offset away.

        Refused while there may be force: `disarm` first.
        """
        return self._ask("zero", Zero(position_m, given(finger), reset), Zeroed)

    def mark(self, label: str, data: Mapping[str, Any] | None = None) -> Applied:
        """An event with a label, into the telemetry and every recording of it."""
        return self._ask("mark", Mark(label, dict(data or {})), Applied)

    def get_prompt(self) -> Prompted:
        """What pages show the participant, and the answer to it."""
        return self._ask("get_prompt", Empty(), Prompted)

    def set_prompt(
        self,
        title: str = "",
        text: str = "",
        progress: tuple[int, int] = (0, 0),
        choices: Sequence[str] = (),
        number: tuple[float, float] | None = None,
    ) -> Prompted:
        """Show pages a title, a text, how much is done of how much, and a question: choices, or a number's range."""
        return self._ask("set_prompt", Prompt(title, text, *progress, tuple(choices), number), Prompted)

    def answer(self, value: str | float, prompt: int | None = None) -> Applied:
        """Answer the question of the prompt with this number, or of the one of now; refused where none is open."""
        return self._ask("answer", Answer(value, prompt), Applied)

    def record_start(self, file: str) -> RecordStarted:
        """Record every tick and event into a new .mcap below the rig's [recording] directory."""
        return self._ask("record_start", RecordStart(file), RecordStarted)

    def record_stop(self) -> RecordStopped:
        """End that recording; says how many ticks it has."""
        return self._ask("record_stop", Empty(), RecordStopped)

    def describe(self) -> dict[str, Any]:
        """Rig, scene, device, fingers, versions, and the wire itself as data."""
        return self._ask("describe", Empty(), dict)

    def mesh(self, what: str | int) -> Triangles:
        """The triangles of an object that is a mesh or a height map, by name or number, for a picture."""
        return self._ask("mesh", OfObject(what), Triangles)

    def stop(self) -> Stopping:
        """End the daemon in order."""
        return self._ask("stop", Empty(), Stopping)

    def close(self) -> None:
        """Disconnect. Any number of times."""
        self._socket.close()


def _awaited(
    command: Callable[Concatenate[Control, P], R],
) -> Callable[Concatenate[AsyncControl, P], Coroutine[Any, Any, R]]:
    """A command of Control for asyncio: it returns what `_ask` returns, which is to be awaited there."""

    @wraps(command)
    async def asked(self: AsyncControl, /, *args: P.args, **kwargs: P.kwargs) -> R:
        answer: Any = command(self, *args, **kwargs)  # type: ignore[arg-type]
        return await answer  # type: ignore[no-any-return]

    return asked


class AsyncControl:
    """A client for asyncio: any number of requests may wait for their answers. Use it with `async with`."""

    def __init__(
        self, endpoint: str | None = None, timeout_s: float | None = None, keys: ClientKeys | None = None
    ) -> None:
        self.endpoint, self.timeout_s, self._keys = endpoint or default_commands(), timeout_s, keys
        self._connect()

    def _connect(self) -> None:
        self._process = os.getpid()
        self._socket: zmq.asyncio.Socket = zmq.asyncio.Context.instance().socket(zmq.DEALER)
        connected(self._socket, self.endpoint, self._keys)
        self._waiting: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._reader: asyncio.Task[None] | None = None

    async def ask(self, method: str, params: Any = Empty()) -> Any:  # noqa: B008 - frozen
        """Any method by name; returns the result as it came."""
        return await self._ask(method, params, METHODS[method].result if method in METHODS else dict)

    async def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        if self._process != os.getpid():  # as in Control
            self._connect()
            self._reader = asyncio.create_task(self._read())
        wait_s = time_for(method, self.timeout_s)
        if wait_s > TIMEOUT_S and self.timeout_s is None:
            await self._check_answers(method)
        command_id, frames = asking(method, params, wait_s)
        answer = self._waiting[command_id] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(milliseconds(wait_s) / 1000.0):
                await self._socket.send_multipart(frames)  # which waits as long as there is nowhere to send to
                return result_of(await answer, kind)
        except TimeoutError:
            raise no_answer(method, self.endpoint, wait_s) from None
        finally:
            del self._waiting[command_id]

    async def _check_answers(self, method: str) -> None:
        """Raise NoAnswer as in Control."""
        try:
            await self._ask("get_state", Empty(), State)
        except CommandRefused:
            return
        except NoAnswer as error:
            raise no_answer(method, self.endpoint, TIMEOUT_S) from error

    async def _read(self) -> None:
        while True:
            answer = answer_in(await self._socket.recv_multipart())
            waiting = self._waiting.get(str(answer.get("command_id")))
            if waiting is not None and not waiting.done():
                waiting.set_result(answer)

    get_state = _awaited(Control.get_state)
    heartbeat = _awaited(Control.heartbeat)
    set_params = _awaited(Control.set_params)
    set_scene = _awaited(Control.set_scene)
    reset_world = _awaited(Control.reset_world)
    drive = _awaited(Control.drive)
    hand = _awaited(Control.hand)
    hold = _awaited(Control.hold)
    arm = _awaited(Control.arm)
    disarm = _awaited(Control.disarm)
    zero = _awaited(Control.zero)
    mark = _awaited(Control.mark)
    get_prompt = _awaited(Control.get_prompt)
    set_prompt = _awaited(Control.set_prompt)
    answer = _awaited(Control.answer)
    record_start = _awaited(Control.record_start)
    record_stop = _awaited(Control.record_stop)
    describe = _awaited(Control.describe)
    mesh = _awaited(Control.mesh)
    stop = _awaited(Control.stop)

    async def close(self) -> None:
        """Disconnect. Any number of times."""
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
