"""Block of memory that the C functions share with Python; its address is the device's handle."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.block import address, counter, lay_out, numbers, raw_bytes, word
from softfinger.drivers.system.libc import TIMESPEC_WORDS

STATUS_WORDS: Final = 17


class Fields(NamedTuple):
    """Fields of the block."""

    # addresses of the library's functions
    get_frame: Annotated[int, address("dhdGetPositionAndOrientationFrame")]
    get_buttons: Annotated[int, address("dhdGetButtonMask")]
    get_gripper: Annotated[int, address("dhdGetGripperAngleRad")]
    get_status: Annotated[int, address("dhdGetStatus")]
    get_error: Annotated[int, address("dhdErrorGetLast")]
    set_wrench: Annotated[int, address("dhdSetForceAndTorqueAndGripperForce")]
    get_position: Annotated[int, address("dhdGetPosition")]
    # settings
    id: Annotated[int, word("the library's number of the device")]
    has_frame: Annotated[
        int, word("whether the library returns its frame; otherwise its position, and `frame` is the identity")
    ]
    has_gripper: Annotated[int, word("whether it has one")]
    has_torque: Annotated[int, word("whether motors turn the handle: else no torque is sent")]
    status_every: Annotated[int, word("reads from one question for the status to the next")]
    started_at: Annotated[int, word("ns")]
    # written by several threads
    open: Annotated[int, word("whether the library may be called")]
    armed: Annotated[int, word("whether a force may go out")]
    stopped: Annotated[int, word("permanent; set before `armed` is cleared, so that a concurrent `arm` has no effect")]
    lock: Annotated[int, word("lock: set during a call, since the library is not documented as thread-safe")]
    # counters and last errors
    reads: Annotated[int, counter("readings")]
    reads_guarded: Annotated[int, counter("reads that the library answered with the last reading, TIMEGUARD")]
    writes: Annotated[int, counter("forces given")]
    writes_guarded: Annotated[int, counter("of these, withheld by the library, TIMEGUARD")]
    saturated: Annotated[int, counter("forces that the motors could not give in full")]
    error: Annotated[int, word("of the library, at the failure")]
    cause: Annotated[int, word("why the device turned its force off; -1: it did not")]
    faulty: Annotated[int, word("its error code, if not 0")]
    # buffers of the calls
    timespec: Annotated[int, numbers("for the clock", TIMESPEC_WORDS)]
    gripper: Annotated[int, numbers("rad", 1)]
    frame: Annotated[int, numbers("position, then the matrix row by row", 12)]
    status: Annotated[int, raw_bytes("int32 each", 4 * STATUS_WORDS)]
    sample: Annotated[int, numbers("the last one, as the servo got it", SAMPLE_SIZE)]


AT: Final = lay_out(Fields)
