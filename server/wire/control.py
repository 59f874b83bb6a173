"""Commanding a running daemon: a client that waits, and one for asyncio.

    with Control() as daemon:
        daemon.set_params({"object.table.material.stiffness_n_per_m": 800.0})
        print(daemon.get_state().force)

Each method of docs/protocol.md is a method here, and returns what the table there says. Both raise CommandRefused
for what the daemon does not do, NoAnswer where nothing comes in time.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import zmq

from softfinger.server.closing import Closing
from softfinger.server.keys import ClientKeys
from softfinger.server.wire.asking import (
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

if TYPE_CHECKING:
    from softfinger.server.wire.async_control import AsyncControl

__all__ = ["AsyncControl", "Control"]


def __getattr__(name: str) -> Any:
    """Import AsyncControl on first use: asyncio takes a third of the start of `softfinger ctl`."""
    if name != "AsyncControl":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from softfinger.server.wire.async_control import AsyncControl

    return AsyncControl


class Control(Closing):
    """A client that waits for each answer, for at most `timeout_s` (None: what the method needs). One thread only.

    `endpoint` is what the daemon's first lines say; without one, that of this user's daemon on the usual telemetry.
    `keys` are for a server that wants some.
    """

    def __init__(
        self, endpoint: str | None = None, timeout_s: float | None = None, keys: ClientKeys | None = None
    ) -> None:
        self.endpoint, self.timeout_s = endpoint or default_commands(), timeout_s
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        connected(self._socket, self.endpoint, keys)

    def _move(self, endpoint: str) -> None:
        """Command what is at another endpoint."""
        self._socket.close()
        self.endpoint, self._socket = endpoint, zmq.Context.instance().socket(zmq.DEALER)
        connected(self._socket, endpoint, None)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: commands on {self.endpoint}>"

    def ask(self, method: str, params: Any = Empty()) -> Any:  # noqa: B008 - frozen
        """Any method by name; returns the result as it came."""
        return self._ask(method, params, METHODS[method].result if method in METHODS else dict)

    def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        wait_s = time_for(method, self.timeout_s)
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
