"""What both clients of commands do alike: the socket, a request and its parameters, the answer."""

from __future__ import annotations

import uuid
from typing import Any, Final, TypeVar

import msgpack
import msgspec
import numpy as np
import zmq

from softfinger.config.errors import CommandRefused, ConfigError, HapticError
from softfinger.config.schema import Telemetry, commands_beside, runtime_folder
from softfinger.server.keys import ClientKeys
from softfinger.server.publishing.setup import ANSWER_MAX, REQUEST_MAX
from softfinger.server.wire.endpoint import check_runtime_folder
from softfinger.server.wire.envelope import expiry

R = TypeVar("R")

TIMEOUT_S: Final = 5.0
SCENE_TIMEOUT_S: Final = 300.0
"""A scene is compiled first, which takes half a minute, and longer on a busy machine."""


class NoAnswer(HapticError):
    """No answer came from an endpoint."""

    exit_code = 9


def default_commands() -> str:
    """Where a daemon of this user takes commands whose rig says nothing of endpoints."""
    return commands_beside(Telemetry().endpoint)


def connected(socket: zmq.Socket[Any], endpoint: str, keys: ClientKeys | None) -> None:
    """Connect a DEALER to where a daemon takes commands. Where that cannot be it is closed: ConfigError."""
    socket.linger = 0
    # A name of its own, whose first byte is not 0: an answer finds it when the publisher was restarted meanwhile.
    socket.routing_id = b"c" + uuid.uuid4().bytes
    socket.maxmsgsize = ANSWER_MAX  # ZeroMQ hangs up on a peer that sends more, before it allocates
    socket.ipv6 = "[" in endpoint
    if keys is not None:
        keys.put_on(socket)
    try:
        if endpoint.startswith(f"ipc://{runtime_folder()}/"):
            check_runtime_folder()
    except ConfigError:
        socket.close()
        raise
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        socket.close()
        raise ConfigError(
            f"cannot connect to endpoint {endpoint!r}: {error}; it looks like ipc:///path or tcp://127.0.0.1:5556"
        ) from error


def asking(method: str, params: Any, wait_s: float) -> tuple[str, list[bytes]]:
    """A request's id and frames; ConfigError for what cannot be said in one."""
    command_id = uuid.uuid4().hex
    request = {"command_id": command_id, "method": method, "params": params, "expires": expiry(wait_s)}
    try:
        body = msgspec.msgpack.encode(request, enc_hook=_plain)
    except (TypeError, ValueError, OverflowError) as error:  # a text that is no Unicode is a ValueError
        raise ConfigError(f"{method}: cannot be sent: {error}") from error
    if len(body) > REQUEST_MAX:
        raise ConfigError(f"{method}: a request of {len(body)} bytes: a daemon takes at most {REQUEST_MAX}")
    return command_id, [b"", body]


def _plain(value: Any) -> Any:
    """Arrays and numbers of numpy, as they come from records and telemetry."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{value!r} is a {type(value).__name__}: give numbers, texts, lists and mappings")


def answer_in(frames: list[bytes]) -> dict[str, Any]:
    """The map of an answer; an empty one for what is none."""
    try:
        answer = msgpack.unpackb(frames[1]) if len(frames) == 2 else {}
    except Exception:  # of a dozen classes
        return {}
    return answer if isinstance(answer, dict) else {}


def result_of(answer: dict[str, Any], kind: type[R]) -> R:
    """What the daemon has answered; CommandRefused where it has not done what was asked."""
    if answer.get("success") is not True:
        raise CommandRefused(str(answer.get("error")))
    return msgspec.convert(answer.get("result"), kind)


def no_answer(method: str, endpoint: str, waited_s: float) -> NoAnswer:
    """The error, with what to look at."""
    return NoAnswer(
        f"no answer to {method} from {endpoint} within {waited_s:g} s: is the server running (softfinger run), "
        "as this user, and is this its [commands] endpoint, which its first lines say?"
    )


def time_for(method: str, timeout_s: float | None) -> float:
    """How long (s) to wait for an answer: what the user says, else what the method needs."""
    if timeout_s is not None:
        return timeout_s
    return SCENE_TIMEOUT_S if method in ("set_scene", "reset_world") else TIMEOUT_S


def given(value: R | None) -> R | msgspec.UnsetType:
    """A parameter that is left out where it is None."""
    return msgspec.UNSET if value is None else value


def number_of(text: str) -> str | float:
    """What a person wrote as an answer: a number where it is one."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return text.strip()[:64]
