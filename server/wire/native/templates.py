"""The messages of a tick as bytes made once, into which a kernel puts the numbers of the tick.

A message has the same keys each time, so all but its numbers is the same: what is made here holds both frames with
their headers, and where in them each number of the record belongs. Numbers have one width, nine bytes in msgpack:
float64, or int64 where the table of the record says int. `contacts` lists the patches there are; each set of them has
a template.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.memory import put_big_endian
from softfinger.proxy.record import AT, FIELDS, NAMED, PATCHES, RECORD_SIZE
from softfinger.server.wire.protocol import SCHEMA, STATE, STATE_HZ, contact_topic, encode, nest
from softfinger.server.wire.zmtp import message

SETS: Final = 1 << PATCHES
"""Sets of patches that a message may list; bit i stands for patch i."""

_FLOAT: Final = 0
_INT: Final = 1
_SINCE: Final = 2  # a time since the epoch, sent as one of CLOCK_MONOTONIC
_NUMBERS: Final = {_FLOAT: b"\xcb" + bytes(8), _INT: b"\xd3" + bytes(8), _SINCE: b"\xcb" + bytes(8)}

_WORD: Final = 2.0**63
_FIRST_OBJECT: Final = AT.contacts0_object
_PATCH_SIZE: Final = AT.contacts1_object - AT.contacts0_object


class Shown(NamedTuple):
    """What `state` says beside the tick: name of the scene; ticks a second, 1/s; the epoch's offset to
    CLOCK_MONOTONIC, s."""

    scene: str = "unnamed"
    rate_hz: float = 1000.0
    epoch_s: float = 0.0


class Plan(NamedTuple):
    """What is sent of a tick.

    templates    (SETS x fingers + 1, longest) uint8, of each finger one for each set of patches, then that of `state`
    sizes        of each, bytes
    counts       numbers in each
    spots        (SETS x fingers + 1, most, 3) int64: of each number its first byte, its column in the record, its kind
    fingers      how many
    every        a tick of `contact` is sent in so many
    state_every  and one of `state`
    epoch_s      as of `Shown`
    """

    templates: NDArray[np.uint8]
    sizes: NDArray[np.int64]
    counts: NDArray[np.int64]
    spots: NDArray[np.int64]
    fingers: int
    every: int
    state_every: int
    epoch_s: float


class _Spot(NamedTuple):
    """Place of a number of the record."""

    kind: int
    column: int


def make_plan(fingers: Sequence[str], every: int, shown: Shown) -> Plan:
    """The plan for fingers of these names; a single one has the name ''."""
    made = [_made(contact_topic(finger), _contact(every, held)) for finger in fingers for held in range(SETS)]
    made.append(_made(STATE, _state(shown.scene)))
    longest, most = max(len(template) for template, _ in made), max(len(spots) for _, spots in made)
    templates = np.zeros((len(made), longest), np.uint8)
    spots = np.zeros((len(made), most, 3), np.int64)
    for number, (template, places) in enumerate(made):
        templates[number, : len(template)] = np.frombuffer(template, np.uint8)
        spots[number, : len(places)] = places
    sizes, counts = (np.array([len(each[part]) for each in made]) for part in range(2))
    state_every = max(1, round(shown.rate_hz / STATE_HZ))
    return Plan(templates, sizes, counts, spots, len(fingers), every, state_every, float(shown.epoch_s))


def _contact(every: int, held: int) -> dict[str, Any]:
    content = nest({"schema": SCHEMA, "every": every} | {f.name: _spots(f.name, f.kind == "int") for f in FIELDS})
    patches = [content.pop(f"contacts{i}") for i in range(PATCHES)]
    return content | {"contacts": [patch for i, patch in enumerate(patches) if held >> i & 1]}


def _state(scene: str) -> dict[str, Any]:
    return {
        "timestamp": _Spot(_SINCE, AT.timestamp),
        "sequence": _Spot(_INT, AT.tick),
        "position": _spots("probe.position", False),
        "velocity": _spots("probe.velocity", False),
        "force": _spots("force", False),
        "active_field": scene,
        "field_state": {
            "mode": _Spot(_INT, AT.contact_mode),
            "object": _Spot(_INT, AT.contact_object),
            "penetration": _Spot(_FLOAT, AT.contact_penetration),
        },
    }


def _spots(name: str, whole: bool) -> _Spot | list[_Spot]:
    field = NAMED[name]
    spots = [_Spot(_INT if whole else _FLOAT, field.at + i) for i in range(field.size)]
    return spots if field.size > 1 else spots[0]


def _made(topic: str, content: dict[str, Any]) -> tuple[bytes, list[tuple[int, int, int]]]:
    """Both frames of a message, and where its numbers are."""
    body, places = bytearray(), list[tuple[int, int, int]]()
    _pack(content, body, places)
    frames = message(topic.encode(), bytes(body))
    before = len(frames) - len(body)
    return frames, [(before + at, column, kind) for at, column, kind in places]


def _pack(value: Any, body: bytearray, places: list[tuple[int, int, int]]) -> None:
    packer, parts = msgpack.Packer(), list[Any]()
    if isinstance(value, _Spot):
        places.append((len(body) + 1, value.column, value.kind))
        body += _NUMBERS[value.kind]
        return
    if isinstance(value, dict):
        body += packer.pack_map_header(len(value))
        parts = [part for item in value.items() for part in item]
    elif isinstance(value, list):
        body += packer.pack_array_header(len(value))
        parts = value
    else:
        body += encode(value)
        return
    for part in parts:
        _pack(part, body, places)


@jit
def whole(value: float) -> int:
    """The integer of a field; 0 for what is none, such as a nan that a device reports as its buttons."""
    return int(value) if -_WORD <= value < _WORD else 0


@jit
def contact_template(plan: Plan, rows: NDArray[np.float64], row: int, finger: int) -> int:
    """Number of the template for the patches of a finger in a row, which has the records of all."""
    held = 0
    for i in range(PATCHES):
        if whole(rows[row, finger * RECORD_SIZE + _FIRST_OBJECT + i * _PATCH_SIZE]) >= 0:
            held |= 1 << i
    return finger * SETS + held


@jit
def write_message(
    plan: Plan, number: int, rows: NDArray[np.float64], row: int, finger: int, to: NDArray[np.uint8], begin: int
) -> None:
    """Write a finger's message by template `number` to `to` from byte `begin` on, where there is room for it.

    rows  (n, fingers x RECORD_SIZE), of which `row` is the tick's
    """
    for i in range(plan.sizes[number]):
        to[begin + i] = plan.templates[number, i]
    for k in range(plan.counts[number]):
        at, column, kind = plan.spots[number, k, 0], plan.spots[number, k, 1], plan.spots[number, k, 2]
        value = rows[row, finger * RECORD_SIZE + column]
        if kind == _INT:
            put_big_endian(to, begin + at, whole(value))
        elif kind == _SINCE:
            put_big_endian(to, begin + at, value - plan.epoch_s)
        else:
            put_big_endian(to, begin + at, value)
