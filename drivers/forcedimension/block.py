"""Block of memory that the C functions share with Python; its address is the device's handle."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.block import counter, function, lay_out, numbers, raw_bytes, word
from softfinger.drivers.system.libc import TIMESPEC_WORDS

STATUS_WORDS: Final = 17


class Fields(NamedTuple):
    """Fields of the block."""

    # functions of the library
    get_frame: Annotated[int, function("dhdGetPositionAndOrientationFrame")]
    get_buttons: Annotated[int, function("dhdGetButtonMask")]
    get_gripper: Annotated[int, function("dhdGetGripperAngleRad")]
    get_status: Annotated[int, function("dhdGetStatus")]
    get_error: Annotated[int, function("dhdErrorGetLast")]
    set_wrench: Annotated[int, function("dhdSetForceAndTorqueAndGripperForce")]
    get_position: Annotated[int, function("dhdGetPosition")]
    # settings
    id: Annotated[int, word("the library's number of the device")]
    has_frame: Annotated[
        int,
        word("whether the library returns a frame; otherwise it returns a position, and the rotation is the identity"),
    ]
    has_gripper: Annotated[int, word("whether the device has a gripper")]
    has_torque: Annotated[int, word("whether the device has motors for torque; otherwise no torque is sent")]
    status_every: Annotated[int, word("number of reads between two status requests")]
    started_at: Annotated[int, word("ns")]
    # written by several threads
    open: Annotated[int, word("whether the library may be called")]
    armed: Annotated[int, word("whether forces may be sent")]
    stopped: Annotated[int, word("permanent; set before `armed` is cleared, so that a concurrent `arm` has no effect")]
    lock: Annotated[int, word("lock: set during a call, since the library is not documented as thread-safe")]
    # counters and last errors
    reads: Annotated[int, counter("readings")]
    reads_guarded: Annotated[int, counter("reads answered with the previous reading, TIMEGUARD")]
    writes: Annotated[int, counter("forces sent")]
    writes_guarded: Annotated[int, counter("of these, withheld by the library, TIMEGUARD")]
    saturated: Annotated[int, counter("forces reduced to the limit of the motors")]
    error: Annotated[int, word("error code of the library at the failure")]
    cause: Annotated[int, word("reason for which the device disabled its force; -1: none")]
    faulty: Annotated[int, word("error code of the device, 0 for none")]
    # buffers of the calls
    timespec: Annotated[int, numbers("struct timespec of the clock", TIMESPEC_WORDS)]
    gripper: Annotated[int, numbers("rad", 1)]
    frame: Annotated[int, numbers("position, then the matrix row by row", 12)]
    status: Annotated[int, raw_bytes("int32 each", 4 * STATUS_WORDS)]
    sample: Annotated[int, numbers("last sample returned to the servo", SAMPLE_SIZE)]


AT: Final = lay_out(Fields)
