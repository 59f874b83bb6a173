"""One tick with a serial port, from nopython: bytes read up to the newest frame, one frame written.

What is the same for any board is in `conversation`. The device answers each frame it is sent, one for one. So a frame
goes out once the last one has been answered, or frames would pile up in the device's buffers and forces come late; a
zero after a force does not wait. A newline wakes the device.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, NamedTuple

from softfinger.drivers.base import HELD, LOST, OK, SAMPLE_BUTTONS, STALE
from softfinger.drivers.block import counter, lay_out, numbers, octets, word
from softfinger.drivers.conversation import TALK, busy, c_functions, command, drain, pose, send_zero, wake
from softfinger.drivers.serial.frames import (
    ANGLES,
    FRAME_BYTES,
    INFO,
    LOOKBACK,
    NUMBERS,
    POSITION,
    encode,
    take,
)
from softfinger.drivers.system.libc import EAGAIN, read_waiting, write_now
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at
from softfinger.proxy.kernels.jit.pack import flatten, unpack_at
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import (
    about_x,
    about_y,
    about_z,
    conjugate,
    multiply,
    normalize,
    rotate,
)

CHUNK: Final = 1024
"""Bytes of one read."""
DRAIN_MAX: Final = 16
"""Reads in one tick: four times what the kernel keeps for a port; a device that floods cannot hold the loop."""
ANSWERED: Final = FRAME_BYTES
"""Bytes that are an answer, whether they can be understood or not."""


class Serial(NamedTuple):
    """Marks the kernels of this driver."""


class Model(NamedTuple):
    """What turns a frame into a pose and a force into a frame.

    position     (3,) m  device's origin in the world
    orientation  (4,)    device to world
    force_max    N
    """

    position: Vec3
    orientation: Quaternion
    force_max: float


_MODEL_LIKE: Final = Model((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0)
MODEL_SIZE: Final = len(flatten(_MODEL_LIKE))


class Words(NamedTuple):
    """The words of this driver, behind those of the conversation."""

    bytes: Annotated[int, counter("bytes received")]
    frames: Annotated[int, counter("frames received")]
    drained: Annotated[int, counter("of these, older ones passed over for a newer")]
    written: Annotated[int, counter("frames sent")]
    held: Annotated[int, counter("forces not sent, because the last frame had no answer")]
    kicks: Annotated[int, counter("newlines sent into a silence")]
    cut: Annotated[int, counter("forces past the largest")]
    asked_at: Annotated[int, word("`bytes` when the last frame was sent; ANSWERED or more since then are its answer")]
    newline: Annotated[int, word("what wakes the device")]
    waiting: Annotated[int, word("bytes that the system has for this driver")]
    model: Annotated[int, numbers("a `Model`", MODEL_SIZE)]
    scratch: Annotated[int, numbers("of a frame being read", NUMBERS)]
    values: Annotated[int, numbers("of the newest frame", NUMBERS)]
    incoming: Annotated[int, octets("what was read last, and in front of it what may belong to it", LOOKBACK + CHUNK)]
    outgoing: Annotated[int, octets("the last frame sent", FRAME_BYTES)]


AT: Final = lay_out(Words, after=TALK)


@drain.of(Serial)
def _drain(driver: Serial, handle: int) -> int:
    at = int64_at(handle)
    incoming, frames = handle + 8 * AT.incoming, 0
    for _ in range(DRAIN_MAX):
        count = read_waiting(at[TALK.fd], incoming + LOOKBACK, CHUNK, handle + 8 * AT.waiting)
        if count < 0:
            return LOST
        at[AT.bytes] += count
        at[TALK.misread] += count
        frames += take(incoming, count, float64_at(handle + 8 * AT.scratch), float64_at(handle + 8 * AT.values))
        if count < CHUNK:
            break
    if frames > 0:
        at[AT.frames] += frames
        at[AT.drained] += frames - 1
        at[TALK.misread] = 0
    return frames


@pose.of(Serial)
def _pose(driver: Serial, handle: int) -> bool:
    # R = Rz(tA) Ry(-lambda) Rx(tD) Ry(tE)
    model = unpack_at(_MODEL_LIKE, handle + 8 * AT.model)
    values, kept = float64_at(handle + 8 * AT.values), float64_at(handle + 8 * TALK.sample)
    x, y, z = 1e-3 * values[POSITION], 1e-3 * values[POSITION + 1], 1e-3 * values[POSITION + 2]
    position = vec3.add(rotate(model.orientation, (x, y, z)), model.position)
    body = multiply(about_z(values[ANGLES]), about_y(-values[ANGLES + 1]))
    wrist = multiply(about_x(values[ANGLES + 2]), about_y(values[ANGLES + 3]))
    orientation = normalize(multiply(model.orientation, multiply(body, wrist)))
    for k in range(3):
        kept[k] = position[k]
    for k in range(4):
        kept[3 + k] = orientation[k]
    kept[SAMPLE_BUTTONS] = float(int(values[INFO]) & 0xFFFF)
    return True


@jit
def _put(handle: int, address: int, count: int) -> int:
    """Write bytes; how many the port took, 0 when it is full, or a status below 0."""
    taken = write_now(int64_at(handle)[TALK.fd], address, count)
    if taken == -EAGAIN:
        return 0
    return taken if taken >= 0 else LOST


@jit
def _finish(handle: int) -> int:
    """Write what is left of a frame; OK when nothing is, HELD when the port is full, or a status below 0."""
    at = int64_at(handle)
    if at[TALK.left] > 0:
        taken = _put(handle, handle + 8 * AT.outgoing + FRAME_BYTES - at[TALK.left], at[TALK.left])
        if taken < 0:
            return taken
        at[TALK.left] -= taken
    return OK if at[TALK.left] == 0 else HELD


@jit
def _send(handle: int, force: Vec3) -> int:
    """Write a force (N, device's frame); OK, HELD when the port took none of it, or a status below 0.

    A frame that went out in part counts as taken, and is finished before anything else: the device would read a cut
    one as another force.
    """
    at, outgoing = int64_at(handle), handle + 8 * AT.outgoing
    status = _finish(handle)
    if status != OK:
        return status
    encode(force, outgoing)
    taken = _put(handle, outgoing, FRAME_BYTES)
    if taken <= 0:
        return taken if taken < 0 else HELD
    at[TALK.left] = FRAME_BYTES - taken
    at[AT.written] += 1
    at[TALK.loaded] = 1 if force[0] != 0.0 or force[1] != 0.0 or force[2] != 0.0 else 0
    at[AT.asked_at] = at[AT.bytes]
    status = _finish(handle)
    return OK if status == HELD else status


@jit
def _asked(handle: int) -> bool:
    """Whether the last frame has no answer yet."""
    at = int64_at(handle)
    return bool(at[AT.bytes] - at[AT.asked_at] < ANSWERED)


@busy.of(Serial)
def _busy(driver: Serial, handle: int, deaf: bool) -> bool:
    return deaf or _asked(handle)


@send_zero.of(Serial)
def _send_zero(driver: Serial, handle: int) -> int:
    return _send(handle, (0.0, 0.0, 0.0))


@command.of(Serial)
def _command(driver: Serial, handle: int, wrench: Any) -> int:
    at = int64_at(handle)
    if _asked(handle):
        at[AT.held] += 1
        return HELD
    model = unpack_at(_MODEL_LIKE, handle + 8 * AT.model)
    force = rotate(conjugate(model.orientation), (wrench[0], wrench[1], wrench[2]))
    size = vec3.norm(force)
    if size <= model.force_max:
        return _send(handle, force)
    at[AT.cut] += 1
    status = _send(handle, vec3.scale(model.force_max / size, force))
    return STALE if status == OK else status


@wake.of(Serial)
def _wake(driver: Serial, handle: int) -> int:
    at = int64_at(handle)
    status = _finish(handle)
    if status == OK and at[TALK.loaded] != 0:
        status = _send(handle, (0.0, 0.0, 0.0))
    if status == OK and at[TALK.left] == 0:
        taken = _put(handle, handle + 8 * AT.newline, 1)
        status = LOST if taken < 0 else OK
        at[AT.kicks] += taken
    return status


read, write, silence = c_functions(Serial())
