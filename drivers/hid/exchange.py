"""One tick with a hidraw node, in nopython mode: read all reports up to the latest, write one report.

The node may be the socket of `report_threads`, which behaves like one. `board_exchange` has the part that all boards
share. A device of this family answers each report, so the answer to the report of one tick is read in the next, without
waiting. A zero report wakes it.
"""

from __future__ import annotations

from errno import EAGAIN, ETIMEDOUT
from typing import Annotated, Any, Final, NamedTuple

from softfinger.drivers.base import HELD, LOST, OK, PROTOCOL, STALE, TIMEOUT
from softfinger.drivers.block import address, counter, lay_out, word
from softfinger.drivers.board_exchange import (
    BOARD,
    compile_functions,
    convert_sample,
    drain,
    must_withhold,
    send_wrench,
    send_zero,
    wake,
)
from softfinger.drivers.described_board import (
    DESCRIBED,
    convert_values,
    count_limited,
    encode_force,
    rotate_force_into_device,
)
from softfinger.drivers.fields.table import decode
from softfinger.drivers.kinematics.mechanism import FULL
from softfinger.drivers.system.libc import read_now, write_now
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.model import Vec3

DRAIN_MAX: Final = 256
"""Maximum number of reads per tick, four times the kernel's queue: a device that floods cannot block the loop."""
QUEUED_MAX: Final = 2
"""Maximum number of reports queued for the threads: one in transmission and the next.

With more, a force would be late; if some were skipped, successive forces of the device would differ by more than those
of two ticks.
"""
IN_SPARE: Final = 1
"""Additional bytes of a buffer, so that a report longer than described is detected."""


class Hid(NamedTuple):
    """Type that selects the kernels of this driver."""


class Fields(NamedTuple):
    """Fields of this driver, after the fields of `described_board`."""

    reports: Annotated[int, counter("reports received")]
    drained: Annotated[int, counter("of these, skipped because a newer one had arrived")]
    written: Annotated[int, counter("reports sent, kicks included")]
    kicks: Annotated[int, counter("zero reports sent because no report arrived")]
    foreign: Annotated[int, counter("reports with another id, skipped")]
    held: Annotated[int, counter("forces not sent, because others were pending")]
    in_id: Annotated[int, word("id of input reports, 0 if they have none")]
    in_bytes: Annotated[int, word("bytes of an input report, with the id if there is one")]
    out_bytes: Annotated[int, word("bytes of an output report, always with an id")]
    in_buffer: Annotated[int, address("buffer of the next report; swapped with that of the latest")]
    latest_report: Annotated[int, address("the latest report")]
    out_buffer: Annotated[int, address("the last report sent")]
    accepted_address: Annotated[
        int, address("number of reports written by the threads, and flag of a hanging write; 0 without threads")
    ]


AT: Final = lay_out(Fields, after=DESCRIBED)


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


@convert_sample.of(Hid)
def _convert_report(driver: Hid, handle: int) -> bool:
    at, values = int64_at(handle), float64_at(handle + 8 * DESCRIBED.values)
    report = at[AT.latest_report] + (1 if at[AT.in_id] != 0 else 0)
    scratch_word = handle + 8 * DESCRIBED.scratch_word
    if not decode(report, at[DESCRIBED.in_table], at[DESCRIBED.in_rows], scratch_word, values):
        return False
    return convert_values(handle)


@jit
def _send(handle: int, force: Vec3) -> tuple[int, int]:
    """Write a force (3,) N, device's frame, as a report.

    Return OK, HELD if the device accepts nothing at the moment, or a status below 0; and the result of `encode_force`.
    """
    at = int64_at(handle)
    # The report id precedes the data; it is 0 if reports have none.
    outcome = encode_force(handle, force, at[AT.out_buffer] + 1)
    count = write_now(at[BOARD.fd], at[AT.out_buffer], at[AT.out_bytes])
    if count == at[AT.out_bytes]:
        at[AT.written] += 1
        return OK, outcome
    if count >= 0:
        return PROTOCOL, outcome
    if count == -EAGAIN:
        return HELD, outcome
    return TIMEOUT if count == -ETIMEDOUT else LOST, outcome


@jit
def _is_queue_full(handle: int) -> bool:
    """Return True if the maximum number of reports is queued for the threads; False without threads."""
    at = int64_at(handle)
    return bool(at[AT.accepted_address] != 0 and at[AT.written] - int64_at(at[AT.accepted_address])[0] >= QUEUED_MAX)


@must_withhold.of(Hid)
def _must_withhold(driver: Hid, handle: int, has_no_sample: bool) -> bool:
    return _is_queue_full(handle)


@send_zero.of(Hid)
def _send_zero(driver: Hid, handle: int) -> int:
    at = int64_at(handle)
    if at[BOARD.has_force] == 0 and _is_queue_full(handle):
        return OK  # the latest queued report is a zero
    status, _ = _send(handle, (0.0, 0.0, 0.0))
    if status == OK:
        at[BOARD.has_force] = 0
    return status


@wake.of(Hid)
def _wake(driver: Hid, handle: int) -> int:
    int64_at(handle)[AT.kicks] += 1
    return _send_zero(driver, handle)


@send_wrench.of(Hid)
def _send_wrench(driver: Hid, handle: int, wrench: Any) -> int:
    at = int64_at(handle)
    if _is_queue_full(handle):
        at[AT.held] += 1
        return HELD
    status, outcome = _send(handle, rotate_force_into_device(handle, wrench))
    count_limited(handle, outcome)
    if status != OK:
        return status
    at[BOARD.has_force] = 1
    return OK if outcome == FULL else STALE


read, write, disarm_and_zero = compile_functions(Hid())
