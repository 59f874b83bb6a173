"""Common parts of both command clients: the socket, requests with their parameters, and answers."""

from __future__ import annotations

import math
import uuid
from typing import Any, Final, TypeVar

import msgpack
import msgspec
import numpy as np
import zmq

from softfinger.config.arguments import describe_refusal, to_number
from softfinger.config.errors import CommandRefused, ConfigError, HapticError
from softfinger.config.schema import Telemetry, find_runtime_folder, make_commands_address
from softfinger.drivers.closeable import undo_on_error
from softfinger.server.keys import ClientKeys
from softfinger.server.socket_process.channel_messages import ANSWER_MAX, REQUEST_MAX
from softfinger.server.socket_process.force_off import FORCE_OFF_METHODS
from softfinger.server.wire.endpoint import check_runtime_folder
from softfinger.server.wire.envelope import compute_expiry

R = TypeVar("R")

LONGEST_MS: Final = (1 << 31) - 1
"""25 days: the largest timeout of a socket."""

TIMEOUT_S: Final = 5.0
SCENE_TIMEOUT_S: Final = 300.0
"""A scene is compiled first, which takes half a minute, and longer on a busy machine."""

RESEND_S: Final = 0.25
RESENT: Final = FORCE_OFF_METHODS
"""Methods sent again after RESEND_S without an answer: a request is lost if the publisher process ends before it has
read it, and these may be executed twice."""


class NoAnswer(HapticError):
    """No answer arrived from an endpoint."""

    exit_code = 9


def find_default_commands() -> str:
    """Return the default command endpoint of a daemon of this user."""
    return make_commands_address(Telemetry().endpoint)


def connect(socket: zmq.Socket[Any], endpoint: str, keys: ClientKeys | None, size_max: int) -> None:
    """Connect a client's socket to a server; if that fails, close it and raise ConfigError.

    size_max  bytes of a frame; ZeroMQ disconnects a peer that sends more, before it allocates
    """
    socket.linger, socket.maxmsgsize, socket.ipv6 = 0, size_max, "[" in endpoint
    if keys is not None:
        keys.apply_to(socket)
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        socket.close()
        raise ConfigError(
            f"cannot connect to endpoint {endpoint!r}: {error}; endpoints look like ipc:///path or tcp://127.0.0.1:5555"
        ) from error


def connect_commands(socket: zmq.Socket[Any], endpoint: str, keys: ClientKeys | None) -> None:
    """Connect a DEALER to the commands of a daemon; if that fails, close it and raise ConfigError."""
    # A unique name that does not start with 0: an answer reaches it even if the publisher was restarted in between.
    socket.routing_id = b"c" + uuid.uuid4().bytes
    with undo_on_error(socket.close):
        if endpoint.startswith(f"ipc://{find_runtime_folder()}/"):
            check_runtime_folder()
    connect(socket, endpoint, keys, ANSWER_MAX)


def encode_request(method: str, params: Any, wait_s: float) -> tuple[str, list[bytes]]:
    """Return the id and the frames of a request; raises ConfigError if it cannot be encoded."""
    command_id = uuid.uuid4().hex
    request = {"command_id": command_id, "method": method, "params": params, "expires": compute_expiry(wait_s)}
    try:
        body = msgspec.msgpack.encode(request, enc_hook=_to_plain)
    except (TypeError, ValueError, OverflowError) as error:  # text that is not valid Unicode raises a ValueError
        raise ConfigError(f"{method}: cannot be sent: {error}") from error
    if len(body) > REQUEST_MAX:
        raise ConfigError(f"{method}: a request of {len(body)} bytes: a daemon accepts at most {REQUEST_MAX}")
    return command_id, [b"", body]


def _to_plain(value: Any) -> Any:
    """Convert arrays and numbers of NumPy, as they come from records and telemetry."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{value!r} is a {type(value).__name__}: use numbers, texts, lists and mappings")


def decode_answer(frames: list[bytes]) -> dict[str, Any]:
    """Return the map of an answer, or an empty one if it is invalid."""
    try:
        answer = msgpack.unpackb(frames[1]) if len(frames) == 2 else {}
    except Exception:  # a dozen classes are possible
        return {}
    return answer if isinstance(answer, dict) else {}


def extract_result(answer: dict[str, Any], kind: type[R]) -> R:
    """Return the result in an answer; raises CommandRefused if the daemon refused the request."""
    if answer.get("success") is not True:
        raise CommandRefused(str(answer.get("error")))
    return msgspec.convert(answer.get("result"), kind)


def make_no_answer_error(method: str, endpoint: str, waited_s: float) -> NoAnswer:
    """Return the error, with possible causes."""
    return NoAnswer(
        f"no answer to `{method}` from {endpoint} within {waited_s:g} s: is the server running (softfinger run), "
        "as this user, has it compiled its scene, and is this the [commands] endpoint that it prints at the start?"
        + ask_for_keys(endpoint)
    )


def ask_for_keys(endpoint: str) -> str:
    """Return a further possible cause for an endpoint on another machine."""
    is_remote = endpoint.startswith("tcp:") and not endpoint.startswith("tcp://127.")
    return " Does it require keys (--keys, --server-key)?" if is_remote else ""


def choose_timeout(method: str, timeout_s: float | None) -> float:
    """Return the time (s) to wait for an answer: the user's value, or the default of the method."""
    if timeout_s is not None:
        return timeout_s
    return SCENE_TIMEOUT_S if method in ("set_scene", "reset_world") else TIMEOUT_S


def to_milliseconds(seconds: float | None) -> int:
    """Return a timeout in ms, at most LONGEST_MS; -1, without limit, for None. Raises ConfigError for anything else."""
    if seconds is None:
        return -1
    wait_s = to_number(seconds)
    if math.isnan(wait_s):
        raise ConfigError(describe_refusal("timeout_s", seconds, "a number of seconds, inf, or None"))
    return round(min(max(0.0, 1000.0 * wait_s), LONGEST_MS))


def to_unset(value: R | None) -> R | msgspec.UnsetType:
    """Return a parameter, or UNSET for None."""
    return msgspec.UNSET if value is None else value


def parse_number(text: str) -> str | float:
    """Convert the text of an answer to a number, if it is one."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return text.strip()[:64]
