"""Block of memory shared by the library's thread, the servo and Python; its address is the device's handle.

Poses and wrenches have one sequence lock each (`proxy.kernels.jit.seqlock`), so that neither thread waits for the
other. Every other field has a single writer.
"""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.block import address, counter, lay_out, numbers, word
from softfinger.drivers.system.libc import TIMESPEC_WORDS

SEQUENCE_WORDS: Final = 8

# Indices of a queued wrench, after force (N) and torque (N m), world frame.
WRITE_TIME: Final = 6
"""Time of the servo's write, ns since the device was opened."""
KNOWN_LAPSES: Final = 7
"""Number of lapses known to the servo."""
WRENCH_SIZE: Final = 8


class Fields(NamedTuple):
    """Fields of the block."""

    # addresses of the library's functions
    begin_frame: Annotated[int, address("hdBeginFrame")]
    end_frame: Annotated[int, address("hdEndFrame")]
    get_doubles: Annotated[int, address("hdGetDoublev")]
    get_integers: Annotated[int, address("hdGetIntegerv")]
    get_booleans: Annotated[int, address("hdGetBooleanv")]
    set_doubles: Annotated[int, address("hdSetDoublev")]
    get_error: Annotated[int, address("hdGetError")]
    enable: Annotated[int, address("hdEnable")]
    disable: Annotated[int, address("hdDisable")]
    is_enabled: Annotated[int, address("hdIsEnabled")]
    # settings
    device: Annotated[int, word("the library's handle of the device")]
    has_torque: Annotated[int, word("whether motors turn the handle: else no torque is sent")]
    age_max: Annotated[int, word("ns, of a force; the same between two frames")]
    started_at: Annotated[int, word("ns")]
    # written by Python
    open: Annotated[int, word("whether the library may be called")]
    armed: Annotated[int, word("whether a force may go out")]
    stopped: Annotated[int, word("for good")]
    is_leaving: Annotated[int, word("the callback is to give zero, and not to be called again")]
    # written by the library's thread
    frames: Annotated[int, counter("frames of the library's thread")]
    framed_at: Annotated[int, word("ns, the last one")]
    has_inkwell: Annotated[int, word("whether it is requested; cleared if the device refuses")]
    has_temperature: Annotated[int, word("the same of the motors' temperature")]
    docked: Annotated[int, word("whether the stylus is in the inkwell")]
    temperature: Annotated[int, word("of the warmest motor, 0 cold to 1000 hot")]
    output: Annotated[int, word("whether the motors are switched on; below 0: not known")]
    late: Annotated[int, word("whether the last frame was more than `age_max` after the previous one")]
    has_force: Annotated[int, word("whether the last frame gave a force")]
    has_sent_zero: Annotated[int, word("whether a frame since `stopped` has given zero")]
    has_left: Annotated[int, word("whether the callback is not called any more")]
    status: Annotated[int, word("0, or the status of the error that stopped it")]
    error: Annotated[int, word("the library's code of that")]
    internal: Annotated[int, word("the device's own code of that")]
    errors: Annotated[int, counter("errors that the library reported in frames")]
    lapses: Annotated[
        int, counter("forces that the library's thread withheld: old, late frame, not armed, stylus docked, fault")
    ]
    wrench_seen: Annotated[int, word("sequence of the wrench that it has")]
    # written by the servo
    reads: Annotated[int, counter("reads of the servo")]
    repeated: Annotated[int, counter("of these, without a new frame")]
    writes: Annotated[int, counter("forces given")]
    pose_seen: Annotated[int, word("sequence of the pose that it has")]
    read_at: Annotated[int, word("ns")]
    silence: Annotated[int, word("ns without a new frame, as far as it was listened")]
    known_lapses: Annotated[int, word("lapses reported to the guard")]
    # buffers
    frame_timespec: Annotated[int, numbers("for the clock, of the library's thread", TIMESPEC_WORDS)]
    servo_timespec: Annotated[int, numbers("for the clock, of the servo", TIMESPEC_WORDS)]
    position: Annotated[int, numbers("mm, the library's frame", 3)]
    matrix: Annotated[int, numbers("column by column", 16)]
    buttons: Annotated[int, word("mask, int32")]
    switch: Annotated[int, word("of the inkwell, one byte: 0 docked")]
    temperatures: Annotated[int, numbers("of the motors; six, as far as is known", 16)]
    vector: Annotated[int, numbers("a force or torque for the library", 3)]
    pose_sequence: Annotated[int, numbers("of the pose", SEQUENCE_WORDS)]
    pose: Annotated[int, numbers("of the last frame", SAMPLE_SIZE)]
    new_pose: Annotated[int, numbers("where a frame's pose is made", SAMPLE_SIZE)]
    read_pose: Annotated[int, numbers("where the servo takes it to", SAMPLE_SIZE)]
    sample: Annotated[int, numbers("the last one, as the servo got it", SAMPLE_SIZE)]
    wrench_sequence: Annotated[int, numbers("of the wrench", SEQUENCE_WORDS)]
    wrench: Annotated[int, numbers("of the last write", WRENCH_SIZE)]
    new_wrench: Annotated[int, numbers("where the servo makes it", WRENCH_SIZE)]
    read_wrench: Annotated[int, numbers("where the library's thread takes it to", WRENCH_SIZE)]
    last_wrench: Annotated[int, numbers("the last complete one that it read", WRENCH_SIZE)]


AT: Final = lay_out(Fields)
