"""Envelope of requests and answers, compatible with hapticore's; requests are decoded with limits.

A request is `[empty, msgpack map]` with `command_id`, `method`, `params` and optionally `expires`; an answer is
`[empty, msgpack map]` with `command_id`, `success`, `result` and `error`. The text of an error starts with its name.
"""

from __future__ import annotations

import math
import re
import time
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgpack
import msgspec
from msgspec import Meta, Struct

from softfinger.config.words import describe_pattern
from softfinger.server.socket_process.force_off import FORCE_OFF_METHODS
from softfinger.server.wire.commands import METHODS, ErrorName, describe_fields
from softfinger.server.wire.protocol import encode

DEPTH_MAX: Final = 16
"""Nesting depth of maps and lists; a scene has 6."""
NODES_MAX: Final = 16384
"""Number of values in a request: a scene of 256 objects has about 8000."""

ERROR_MAX: Final = 4096
"""Longest text of an error: a scene may have a thousand faults."""


class DeclinedRequest(Exception):
    """Rejection of a request; nothing has changed."""

    def __init__(self, name: ErrorName, text: str, command_id: str = "") -> None:
        super().__init__(f"{name}: {text[:ERROR_MAX]}")
        self.name, self.command_id = name, command_id


class Request(NamedTuple):
    """Valid request; the type of `params` is the one in the table of methods."""

    command_id: str
    method: str
    params: Any


class _Envelope(Struct, frozen=True):
    """Envelope of a request; other keys are ignored, because hapticore's clients may send more."""

    command_id: Annotated[str, Meta(max_length=128)]
    method: Annotated[str, Meta(max_length=64)]
    params: dict[str, Any] = {}
    expires: tuple[str, float] | None = None


def compute_expiry(wait_s: float) -> tuple[str, float] | None:
    """Return the expiry of a request: boot id of the client's machine, and time on its CLOCK_MONOTONIC, s.

    None if the boot id is unknown or the wait is infinite.
    """
    return (_BOOT, time.monotonic() + wait_s) if _BOOT and wait_s < math.inf else None


def _read_boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()
    except OSError:
        return ""


_BOOT: Final = _read_boot_id()


def _explain(error: msgspec.ValidationError) -> str:
    """Return msgspec's message with the parameter first: `release: Expected `bool`, got `str``."""
    text = re.sub(r"^Object missing required field `(\w+)`", r"\1 is missing", str(error))
    text = re.sub(r"matching regex '(.*)'", lambda match: describe_pattern(match[1]), text)
    return re.sub(r"^(.*) - at `\$\.?(.+)`$", r"\2: \1", text)


def parse(body: bytes) -> Request:
    """Decode and validate the body of a request, of bounded size; an empty one is a message with other frames.

    Raises DeclinedRequest if it is invalid or has expired.
    """
    if not body:
        raise DeclinedRequest("malformed", "a request has two frames: an empty one and a msgpack map")
    try:
        # msgpack, not msgspec: it checks a declared length before it allocates, and bounds its stack.
        decoded = msgpack.unpackb(body)
    except Exception as error:  # a dozen classes are possible
        raise DeclinedRequest("malformed", f"no msgpack: {type(error).__name__} {error}"[:200]) from error
    command_id = decoded.get("command_id") if isinstance(decoded, dict) else None
    command_id = command_id if isinstance(command_id, str) and len(command_id) <= 128 else ""
    if not _is_plain(decoded):
        raise DeclinedRequest(
            "malformed",
            f"deeper than {DEPTH_MAX}, or of more than {NODES_MAX} values, or of unsupported types",
            command_id,
        )
    try:
        envelope = msgspec.convert(decoded, _Envelope)
    except msgspec.ValidationError as error:
        raise DeclinedRequest("malformed", str(error), command_id) from error
    method = METHODS.get(envelope.method)
    if method is None:
        raise DeclinedRequest("unknown_method", f"{envelope.method!r}; methods are {', '.join(METHODS)}", command_id)
    try:
        params = msgspec.convert(envelope.params, method.params)
    except msgspec.ValidationError as error:
        text = f"{envelope.method}: {_explain(error)}; parameters are {describe_fields(method.params) or 'none'}"
        raise DeclinedRequest("bad_params", text, command_id) from error
    # The clock of another machine is unknown. A request that turns the force off does not expire.
    until = envelope.expires if envelope.method not in FORCE_OFF_METHODS else None
    if until is not None and until[0] == _BOOT and until[1] < time.monotonic():
        raise DeclinedRequest("expired", "its client stopped waiting: nothing was done", command_id)
    return Request(command_id, envelope.method, params)


def _is_plain(decoded: Any) -> bool:
    """Return whether a decoded value has only JSON's types with string keys, and is within limits; not recursive."""
    level, nodes = [decoded], 0
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


def encode_answer(command_id: str, result: Any) -> bytes:
    return encode({"command_id": command_id, "success": True, "result": result, "error": None})


def encode_refusal(reason: DeclinedRequest, command_id: str = "") -> bytes:
    refusal = {"command_id": reason.command_id or command_id, "success": False, "result": {}, "error": str(reason)}
    return encode(refusal)
