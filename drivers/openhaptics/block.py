"""Block of memory shared by the library's thread, the servo and Python; its address is the device's handle.

Pose and wrench have a sequence lock each, so that neither thread waits for the other. Every other field has a single
writer.
"""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.block import counter, function, lay_out, numbers, slot, word
from softfinger.drivers.system.libc import TIMESPEC_WORDS

# Indices of a queued wrench, after force (N) and torque (N m), world frame.
WRITE_TIME: Final = 6
"""Time of the servo's write, ns since the device was opened."""
KNOWN_LAPSES: Final = 7
"""Number of lapses known to the servo."""
WRENCH_SIZE: Final = 8


class Fields(NamedTuple):
    """Fields of the block."""

    # functions of the library
    begin_frame: Annotated[int, function("hdBeginFrame")]
    end_frame: Annotated[int, function("hdEndFrame")]
    get_doubles: Annotated[int, function("hdGetDoublev")]
    get_integers: Annotated[int, function("hdGetIntegerv")]
    get_booleans: Annotated[int, function("hdGetBooleanv")]
    set_doubles: Annotated[int, function("hdSetDoublev")]
    get_error: Annotated[int, function("hdGetError")]
    enable: Annotated[int, function("hdEnable")]
    disable: Annotated[int, function("hdDisable")]
    is_enabled: Annotated[int, function("hdIsEnabled")]
    # settings
    device: Annotated[int, word("the library's handle of the device")]
    has_torque: Annotated[int, word("whether the device has motors for torque; otherwise no torque is sent")]
    age_max: Annotated[int, word("largest age of a force, and largest time between two frames, ns")]
    started_at: Annotated[int, word("ns")]
    # written by Python
    open: Annotated[int, word("whether the library may be called")]
    armed: Annotated[int, word("whether forces may be sent")]
    stopped: Annotated[int, word("permanent: a later `arm` has no effect")]
    is_leaving: Annotated[int, word("whether the callback must send zero and end")]
    # written by the library's thread
    frames: Annotated[int, counter("frames of the library's thread")]
    framed_at: Annotated[int, word("time of the last frame, ns")]
    has_inkwell: Annotated[int, word("whether the inkwell switch is read; cleared if the device does not support it")]
    has_temperature: Annotated[int, word("the same for the motor temperature")]
    docked: Annotated[int, word("whether the stylus is in the inkwell")]
    temperature: Annotated[int, word("temperature of the warmest motor, 0 cold to 1000 hot")]
    output: Annotated[int, word("whether the motors are enabled; below 0: unknown")]
    late: Annotated[int, word("whether the last frame was more than `age_max` after the previous one")]
    has_force: Annotated[int, word("whether the last frame sent a force")]
    has_sent_zero: Annotated[int, word("whether a frame since `stopped` has sent zero")]
    has_left: Annotated[int, word("whether the callback has ended")]
    status: Annotated[int, word("status of the error that ended it, 0 for none")]
    error: Annotated[int, word("error code of the library")]
    internal: Annotated[int, word("internal error code of the device")]
    errors: Annotated[int, counter("errors that the library reported in frames")]
    lapses: Annotated[
        int, counter("forces that the library's thread withheld: old, late frame, not armed, stylus docked, fault")
    ]
    wrench_seen: Annotated[int, word("sequence number of the last wrench read")]
    # written by the servo
    reads: Annotated[int, counter("reads of the servo")]
    repeated: Annotated[int, counter("of these, without a new frame")]
    writes: Annotated[int, counter("forces sent")]
    pose_seen: Annotated[int, word("sequence number of the last pose read")]
    read_at: Annotated[int, word("ns")]
    silence: Annotated[int, word("time without a new frame, without pauses of the servo, ns")]
    known_lapses: Annotated[int, word("lapses reported to the guard")]
    # buffers
    frame_timespec: Annotated[int, numbers("struct timespec of the library's thread", TIMESPEC_WORDS)]
    servo_timespec: Annotated[int, numbers("struct timespec of the servo", TIMESPEC_WORDS)]
    position: Annotated[int, numbers("position in the library's frame, mm", 3)]
    matrix: Annotated[int, numbers("transform, column by column", 16)]
    buttons: Annotated[int, word("button mask, int32")]
    switch: Annotated[int, word("inkwell switch, one byte: 0 docked")]
    temperatures: Annotated[int, numbers("motor temperatures; probably six", 16)]
    vector: Annotated[int, numbers("force or torque for the library", 3)]
    pose: Annotated[int, slot("pose of the last frame", SAMPLE_SIZE)]
    new_pose: Annotated[int, numbers("buffer for the pose of a frame", SAMPLE_SIZE)]
    read_pose: Annotated[int, numbers("buffer for the servo's copy of the pose", SAMPLE_SIZE)]
    sample: Annotated[int, numbers("last sample returned to the servo", SAMPLE_SIZE)]
    wrench: Annotated[int, slot("wrench of the last write", WRENCH_SIZE)]
    new_wrench: Annotated[int, numbers("buffer for the wrench of a write", WRENCH_SIZE)]
    read_wrench: Annotated[int, numbers("buffer for the thread's copy of the wrench", WRENCH_SIZE)]
    last_wrench: Annotated[int, numbers("last complete copy of the wrench", WRENCH_SIZE)]


AT: Final = lay_out(Fields)
