"""Requests and answers on the wire: hapticore's envelope, read with limits.

A request is `[empty, msgpack map]` with `command_id`, `method`, `params` and perhaps `expires`, the answer
`[empty, msgpack map]` with `command_id`, `success`, `result` and `error`. The text of an error begins with its name.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgpack
import msgspec
from msgspec import Meta, Struct

from softfinger.server.wire.commands import METHODS, ErrorName

DEPTH_MAX: Final = 16
"""Maps and lists within each other; a scene has 6."""
NODES_MAX: Final = 16384
"""Values in a request: a scene of 256 objects has some 8000."""

ERROR_MAX: Final = 4096
"""Longest text of an error: a scene may have a thousand faults."""


class Declined(Exception):
    """A request that is not done; nothing has changed."""

    def __init__(self, name: ErrorName, text: str, command_id: str = "") -> None:
        super().__init__(f"{name}: {text[:ERROR_MAX]}")
        self.name, self.command_id = name, command_id


class Request(NamedTuple):
    """A request that is well-formed: `params` is what the table says."""

    command_id: str
    method: str
    params: Any


class _Envelope(Struct, frozen=True):
    """Keys besides are ignored, as hapticore's clients may send more."""

    command_id: Annotated[str, Meta(max_length=128)]
    method: Annotated[str, Meta(max_length=64)]
    params: dict[str, Any] = {}
    expires: tuple[str, float] | None = None


def expiry(wait_s: float) -> tuple[str, float] | None:
    """Until when a request counts whose client waits so long: the boot of its machine, and s on CLOCK_MONOTONIC there.

    None where nothing is known of the boot, or the wait has no end.
    """
    return (_BOOT, time.monotonic() + wait_s) if _BOOT and wait_s < math.inf else None


def _boot() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""


_BOOT: Final = _boot()


def parse(body: bytes | None) -> Request:
    """A request's body, of bounded size; None stands for a message of other frames. Raises Declined."""
    if body is None:
        raise Declined("malformed", "a request has two frames: an empty one and a msgpack map")
    try:
        # msgpack, not msgspec: it checks a claimed length before it allocates, and its stack has an end.
        given = msgpack.unpackb(body)
    except Exception as error:  # of a dozen classes
        raise Declined("malformed", f"no msgpack: {type(error).__name__} {error}"[:200]) from error
    command_id = given.get("command_id") if isinstance(given, dict) else None
    command_id = command_id if isinstance(command_id, str) and len(command_id) <= 128 else ""
    if not _is_plain(given):
        raise Declined(
            "malformed", f"deeper than {DEPTH_MAX}, of more than {NODES_MAX} values, or not of plain ones", command_id
        )
    try:
        envelope = msgspec.convert(given, _Envelope)
    except msgspec.ValidationError as error:
        raise Declined("malformed", str(error), command_id) from error
    method = METHODS.get(envelope.method)
    if method is None:
        raise Declined("unknown_method", f"{envelope.method!r}: there are {', '.join(METHODS)}", command_id)
    try:
        params = msgspec.convert(envelope.params, method.params)
    except msgspec.ValidationError as error:
        raise Declined("bad_params", f"{envelope.method}: {error}", command_id) from error
    # Of another machine's clock nothing is known.
    if envelope.expires is not None and envelope.expires[0] == _BOOT and envelope.expires[1] < time.monotonic():
        raise Declined("expired", "its client has given up waiting: nothing was done", command_id)
    return Request(command_id, envelope.method, params)


def _is_plain(given: Any) -> bool:
    """Whether a decoded value is of JSON's types with texts as keys, and bounded; without recursion."""
    level, nodes = [given], 0
    for _ in range(DEPTH_MAX + 1):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                if not all(isinstance(key, str) for key in value):
                    return False
                below += value.values()
            elif isinstance(value, list):
                below += value
            elif not (value is None or isinstance(value, bool | int | float | str)):
                return False
        if not below:
            return True
        nodes += len(below)
        if nodes > NODES_MAX:
            return False
        level = below
    return False


_ENCODER: Final = msgspec.msgpack.Encoder()


def answered(command_id: str, result: Any) -> bytes:
    """The answer to what was done."""
    return _ENCODER.encode({"command_id": command_id, "success": True, "result": result, "error": None})


def declined(reason: Declined, command_id: str = "") -> bytes:
    """The answer to what was not done."""
    said = {"command_id": reason.command_id or command_id, "success": False, "result": {}, "error": str(reason)}
    return _ENCODER.encode(said)
