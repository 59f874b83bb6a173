"""One tick with a hidraw node, in nopython mode: read all reports up to the latest, write one report.

The node may be the socket of `threads`, which behaves like one. `board_exchange` has the part that all boards share. A
device of this family answers each report, so the answer to the report of one tick is read in the next, without waiting.
A zero report wakes it.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, NamedTuple

from softfinger.drivers.base import HELD, LOST, OK, PROTOCOL, SAMPLE_BUTTONS, SAMPLE_GRIPPER, STALE, TIMEOUT
from softfinger.drivers.block import address, counter, lay_out, numbers, word
from softfinger.drivers.board_exchange import BOARD, busy, command, compile_functions, drain, pose, send_zero, wake
from softfinger.drivers.fields.table import BUTTONS, COMMANDED_SIZE, CONSTANT, GRIPPER, SENSED_SIZE, decode, encode
from softfinger.drivers.kinematics.mechanism import (
    FULL,
    INVALID,
    LIMITED,
    NO_MECHANISM,
    SINGULAR,
    Mechanism,
    force_to_command,
    forward_kinematics,
)
from softfinger.drivers.system.libc import EAGAIN, ETIMEDOUT, read_now, write_now
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.jit.pack import flatten, unpack_at
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import conjugate, multiply, normalize, rotate

DRAIN_MAX: Final = 256
"""Maximum number of reads per tick, four times the kernel's queue: a device that floods cannot block the loop."""
QUEUED_MAX: Final = 2
"""Maximum number of reports in the pump: one in transmission and the next.

With more, a force would be late; if some were skipped, successive forces of the device would differ by more than those
of two ticks.
"""
IN_SPARE: Final = 1
"""Additional bytes of a buffer, so that a report longer than described is detected."""


class Hid(NamedTuple):
    """Type that selects the kernels of this driver."""


class FrameConversion(NamedTuple):
    """Parameters of the conversion between reports and poses or forces.

    mechanism
    position     (3,) m  device's origin in the world
    orientation  (4,)    device to world
    """

    mechanism: Mechanism
    position: Vec3
    orientation: Quaternion


_MODEL_LIKE: Final = FrameConversion(NO_MECHANISM, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
MODEL_SIZE: Final = len(flatten(_MODEL_LIKE))


class Fields(NamedTuple):
    """Fields of this driver, after the fields of `board_exchange`."""

    reports: Annotated[int, counter("reports received")]
    drained: Annotated[int, counter("of these, skipped because a newer one had arrived")]
    written: Annotated[int, counter("reports sent, kicks included")]
    kicks: Annotated[int, counter("zero reports sent because no report arrived")]
    cut: Annotated[int, counter("wrenches above the limit of the motors")]
    singular: Annotated[
        int, counter("forces reduced and samples without a position because the mechanism was in a singular pose")
    ]
    foreign: Annotated[int, counter("reports with another id, skipped")]
    held: Annotated[int, counter("forces not sent, because others were pending")]
    kind: Annotated[int, word("kind of mechanism")]
    in_id: Annotated[int, word("id of input reports, 0 if they have none")]
    in_bytes: Annotated[int, word("bytes of an input report, with the id if there is one")]
    out_bytes: Annotated[int, word("bytes of an output report, always with an id")]
    in_rows: Annotated[int, word("fields of an input report")]
    out_rows: Annotated[int, word("fields of an output report")]
    in_table: Annotated[int, address("(in_rows, ROW) float64")]
    out_table: Annotated[int, address("(out_rows, ROW) float64")]
    in_buffer: Annotated[int, address("buffer of the next report; swapped with that of the latest")]
    latest_report: Annotated[int, address("the latest report")]
    out_buffer: Annotated[int, address("the last report sent")]
    accepted_address: Annotated[
        int, address("number of reports written by the threads, and flag of a hanging write; 0 without threads")
    ]
    scratch: Annotated[int, word("buffer for one field")]
    values: Annotated[int, numbers("values of the latest report", SENSED_SIZE)]
    command: Annotated[int, numbers("values of the report being written", COMMANDED_SIZE)]
    has_orientation: Annotated[int, word("whether the device measures its orientation")]
    last_position: Annotated[int, numbers("last position of a delta mechanism, m", 3)]
    model: Annotated[int, numbers("a `FrameConversion`", MODEL_SIZE)]


AT: Final = lay_out(Fields, after=BOARD)


@drain.of(Hid)
def _drain(driver: Hid, handle: int) -> int:
    at = int64_at(handle)
    if at[AT.accepted_address] != 0 and int64_at(at[AT.accepted_address])[1] != 0:
        return TIMEOUT
    count_read, size = 0, at[AT.in_bytes]
    for _ in range(DRAIN_MAX):
        count = read_now(at[BOARD.fd], at[AT.in_buffer], size + IN_SPARE)
        if count == -EAGAIN:
            break
        if count <= 0:
            return LOST
        if at[AT.in_id] != 0 and uint8_at(at[AT.in_buffer])[0] != at[AT.in_id]:
            at[AT.foreign] += 1
            continue
        if count != size:
            return PROTOCOL
        if count_read > 0:
            at[AT.drained] += 1
        count_read += 1
        at[AT.reports] += 1
        spare = at[AT.latest_report]
        at[AT.latest_report] = at[AT.in_buffer]
        at[AT.in_buffer] = spare
    return count_read


@pose.of(Hid)
def _pose(driver: Hid, handle: int) -> bool:
    at = int64_at(handle)
    model = unpack_at(_MODEL_LIKE, handle + 8 * AT.model)
    values, sample = float64_at(handle + 8 * AT.values), float64_at(handle + 8 * BOARD.sample)
    report = at[AT.latest_report] + (1 if at[AT.in_id] != 0 else 0)
    if not decode(report, at[AT.in_table], at[AT.in_rows], handle + 8 * AT.scratch, values):
        return False
    last_position = float64_at(handle + 8 * AT.last_position)
    position, rotation, outcome = forward_kinematics(at[AT.kind], model.mechanism, values, last_position)
    if outcome == INVALID:
        return False
    at[AT.singular] += outcome == SINGULAR
    orientation = (
        normalize(multiply(model.orientation, rotation)) if at[AT.has_orientation] != 0 else (1.0, 0.0, 0.0, 0.0)
    )
    position = vec3.add(rotate(model.orientation, position), model.position)
    for k in range(3):
        sample[k] = position[k]
    for k in range(4):
        sample[3 + k] = orientation[k]
    sample[SAMPLE_BUTTONS] = values[BUTTONS]
    sample[SAMPLE_GRIPPER] = values[GRIPPER]
    return True


@jit
def _send(handle: int) -> int:
    """Write the report; return OK, HELD if the device accepts nothing at the moment, or a status below 0."""
    at = int64_at(handle)
    count = write_now(at[BOARD.fd], at[AT.out_buffer], at[AT.out_bytes])
    if count == at[AT.out_bytes]:
        at[AT.written] += 1
        return OK
    if count >= 0:
        return PROTOCOL
    if count == -EAGAIN:
        return HELD
    return TIMEOUT if count == -ETIMEDOUT else LOST


@jit
def _clear_command(handle: int) -> None:
    values = float64_at(handle + 8 * AT.command)
    for k in range(COMMANDED_SIZE):
        values[k] = 0.0
    values[CONSTANT] = 1.0


@jit
def _encode(handle: int) -> bool:
    at = int64_at(handle)
    values = float64_at(handle + 8 * AT.command)
    # The report id precedes the data; it is 0 if reports have none.
    return encode(values, at[AT.out_table], at[AT.out_rows], handle + 8 * AT.scratch, at[AT.out_buffer] + 1)


@jit
def _is_queue_full(handle: int) -> bool:
    """Return True if the pump has the maximum number of reports."""
    at = int64_at(handle)
    return bool(at[AT.accepted_address] != 0 and at[AT.written] - int64_at(at[AT.accepted_address])[0] >= QUEUED_MAX)


@busy.of(Hid)
def _busy(driver: Hid, handle: int, has_no_sample: bool) -> bool:
    return _is_queue_full(handle)


@jit
def _write_zero(handle: int) -> int:
    at = int64_at(handle)
    if at[BOARD.has_force] == 0 and _is_queue_full(handle):
        return OK  # the latest queued report is a zero
    _clear_command(handle)
    _encode(handle)
    status = _send(handle)
    if status == OK:
        at[BOARD.has_force] = 0
    return status


@send_zero.of(Hid)
def _send_zero(driver: Hid, handle: int) -> int:
    return _write_zero(handle)


@wake.of(Hid)
def _wake(driver: Hid, handle: int) -> int:
    int64_at(handle)[AT.kicks] += 1
    return _write_zero(handle)


@jit
def _encode_wrench(handle: int, wrench: Any) -> int:
    """Encode a wrench into the report; return FULL, or why it was limited."""
    at = int64_at(handle)
    _clear_command(handle)
    model = unpack_at(_MODEL_LIKE, handle + 8 * AT.model)
    values, command_values = float64_at(handle + 8 * AT.values), float64_at(handle + 8 * AT.command)
    force = rotate(conjugate(model.orientation), (wrench[0], wrench[1], wrench[2]))
    outcome = force_to_command(
        at[AT.kind], model.mechanism, values, float64_at(handle + 8 * AT.last_position), force, command_values
    )
    return LIMITED if _encode(handle) and outcome == FULL else outcome


@command.of(Hid)
def _command(driver: Hid, handle: int, wrench: Any) -> int:
    at = int64_at(handle)
    if _is_queue_full(handle):
        at[AT.held] += 1
        return HELD
    outcome = _encode_wrench(handle, wrench)
    status = _send(handle)
    if status == OK:
        at[BOARD.has_force] = 1
    if outcome != FULL:
        at[AT.singular if outcome == SINGULAR else AT.cut] += 1
        if status == OK:
            status = STALE
    return status


read, write, silence = compile_functions(Hid())
