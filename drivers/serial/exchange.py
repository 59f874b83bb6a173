"""One tick with a serial port, in nopython mode: read bytes up to the latest frame, write one frame.

`board_exchange` has the part that all boards share. Frames are WoodenHaptics' text (`frames`) or bytes that a rig
describes (`packets`). A board that answers each frame gets the next one only after its answer, because otherwise frames
queue in its buffers and forces are late; a zero after a force does not wait. A newline wakes WoodenHaptics, a zero
frame a described board; after a missing answer, `resync` bytes precede a zero.

If more frames are queued in the port than `queue` allows, they are dropped, a zero is sent, and forces are withheld
until the port has sent everything. If that takes longer than `timeout_after` or IGNORED_WRENCH_MAX_S, the device is
given up: a board that reads nothing keeps its force.
"""

from __future__ import annotations

from errno import EAGAIN
from typing import Any, Final, NamedTuple

from numba import types

from softfinger.drivers.base import HELD, IGNORED_WRENCH_MAX_S, LOST, OK, SAMPLE_BUTTONS, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.block import try_lock, unlock
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
    MODEL_LIKE,
    FrameConversion,
    convert_values,
    count_limited,
    encode_force,
    rotate_force_into_device,
    store_in_world,
)
from softfinger.drivers.kinematics.mechanism import FULL, LIMITED
from softfinger.drivers.samples import is_zero
from softfinger.drivers.serial import packets
from softfinger.drivers.serial.block import AT, CHUNK, TEXT
from softfinger.drivers.serial.frames import ANGLES, INFO, LOOKBACK, POSITION, decode_stream, encode
from softfinger.drivers.serial.queue import drop_frames, has_unsent, is_blocked, record_write
from softfinger.drivers.system.libc import read_monotonic_ns, read_waiting, write_now
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.jit.pack import unpack_at
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import about_x, about_y, about_z, multiply

DRAIN_MAX: Final = 16
"""Maximum number of reads per tick, four times the kernel's buffer: a device that floods cannot block the loop."""
BLOCKED_MAX_NS: Final = round(IGNORED_WRENCH_MAX_S * 1e9)
"""Maximum duration of a blocked port, also with a longer `timeout_s`."""


class Serial(NamedTuple):
    """Type that selects the kernels of this driver."""


@jit
def _read_text(handle: int, size: int) -> tuple[int, int]:
    """Read at most `size` bytes of text; return the number of bytes, or a status below 0, and of completed frames."""
    at, incoming = int64_at(handle), handle + 8 * AT.incoming
    count = read_waiting(at[BOARD.fd], incoming + LOOKBACK, size, handle + 8 * AT.ioctl_scratch)
    if count <= 0:
        return count, 0
    scratch, values = float64_at(handle + 8 * AT.scratch), float64_at(handle + 8 * DESCRIBED.values)
    return count, decode_stream(incoming, count, scratch, values)


@outlined
def _read_packets(handle: int, size: int) -> tuple[int, int]:
    """Read like `_read_text`, for frames that the rig describes."""
    at = int64_at(handle)
    count = read_waiting(at[BOARD.fd], at[AT.stream] + at[AT.stream_bytes], size, handle + 8 * AT.ioctl_scratch)
    if count <= 0:
        return count, 0
    at[AT.stream_bytes] += count
    table = (at[DESCRIBED.in_table], at[DESCRIBED.in_rows], handle + 8 * DESCRIBED.scratch_word)
    numbers = (float64_at(handle + 8 * AT.scratch), float64_at(handle + 8 * DESCRIBED.values))
    filled = int64_at(handle + 8 * AT.stream_bytes)
    return count, packets.decode_stream(at[AT.stream], filled, at[AT.by_length] != 0, at[AT.in_shape], table, numbers)


@drain.of(Serial)
def _drain(driver: Serial, handle: int) -> int:
    at = int64_at(handle)
    blocked_max = min(at[BOARD.timeout_after], BLOCKED_MAX_NS)
    if at[AT.blocked_since] != 0 and is_blocked(handle) and at[AT.blocked_at] - at[AT.blocked_since] > blocked_max:
        return TIMEOUT
    frames = 0
    for _ in range(DRAIN_MAX):
        count, completed = _read_text(handle, CHUNK) if at[DESCRIBED.kind] == TEXT else _read_packets(handle, CHUNK)
        if count < 0:
            return LOST
        at[AT.bytes] += count
        at[BOARD.misread_bytes] += count
        frames += completed
        if count < CHUNK:
            break
    if frames > 0:
        at[AT.frames] += frames
        at[AT.drained] += frames - 1
        at[BOARD.misread_bytes] = 0
    return frames


@jit
def _convert_text(values: Any) -> tuple[Vec3, Quaternion]:
    """Return position (m) and orientation of a text frame: R = Rz(tA) Ry(-lambda) Rx(tD) Ry(tE)."""
    position = (1e-3 * values[POSITION], 1e-3 * values[POSITION + 1], 1e-3 * values[POSITION + 2])
    body = multiply(about_z(values[ANGLES]), about_y(-values[ANGLES + 1]))
    wrist = multiply(about_x(values[ANGLES + 2]), about_y(values[ANGLES + 3]))
    return position, multiply(body, wrist)


@convert_sample.of(Serial)
def _convert_frame(driver: Serial, handle: int) -> bool:
    if int64_at(handle)[DESCRIBED.kind] != TEXT:
        return convert_values(handle)
    model: FrameConversion = unpack_at(MODEL_LIKE, handle + 8 * DESCRIBED.model)
    values = float64_at(handle + 8 * DESCRIBED.values)
    position, rotation = _convert_text(values)
    store_in_world(handle, model, position, rotation)
    float64_at(handle + 8 * BOARD.sample)[SAMPLE_BUTTONS] = float(int(values[INFO]) & 0xFFFF)
    return True


@jit
def _write_bytes(handle: int, address: int, count: int) -> int:
    """Write bytes; return the number accepted, 0 if the port is full, or a status below 0."""
    accepted = write_now(int64_at(handle)[BOARD.fd], address, count)
    if accepted == -EAGAIN:
        return 0
    if accepted > 0:
        record_write(handle, accepted)
    return accepted if accepted >= 0 else LOST


@jit
def _write_rest(handle: int) -> int:
    """Write the remainder of a frame; return OK if it is complete, HELD if the port is full, or a status below 0."""
    at = int64_at(handle)
    if at[BOARD.unsent_bytes] > 0:
        accepted = _write_bytes(
            handle, at[AT.outgoing] + at[AT.out_total] - at[BOARD.unsent_bytes], at[BOARD.unsent_bytes]
        )
        if accepted < 0:
            return accepted
        at[BOARD.unsent_bytes] -= accepted
    return OK if at[BOARD.unsent_bytes] == 0 else HELD


@jit
def _encode_frame(handle: int, force: Vec3) -> int:
    """Encode a force (N, device's frame) into the frame; return FULL, or why it was limited."""
    at = int64_at(handle)
    frame = at[AT.outgoing] + at[AT.out_total] - at[AT.out_bytes]
    if at[DESCRIBED.kind] == TEXT:
        model: FrameConversion = unpack_at(MODEL_LIKE, handle + 8 * DESCRIBED.model)
        norm, force_max = vec3.norm(force), model.mechanism.force_max
        is_limited = norm > force_max
        encode(vec3.scale(force_max / norm, force) if is_limited else force, frame)
        return LIMITED if is_limited else FULL
    outcome = encode_force(handle, force, frame)
    packets.complete_frame(frame, at[AT.out_shape])
    return outcome


@outlined
def _send(handle: int, force: Vec3) -> int:
    """Write a force (N, device's frame).

    Return OK, STALE if it was limited, HELD if the port accepted none of it, or a status below 0.

    A partly written frame counts as sent, and is completed before anything else: the device would interpret a truncated
    one as another force.
    """
    at = int64_at(handle)
    status = _write_rest(handle)
    if status != OK:
        return status
    outcome = _encode_frame(handle, force)
    count = at[AT.out_total] if _awaits_answer(handle) or at[AT.maybe_torn] != 0 else at[AT.out_bytes]
    accepted = _write_bytes(handle, at[AT.outgoing] + at[AT.out_total] - count, count)
    if accepted <= 0:
        return accepted if accepted < 0 else HELD
    at[BOARD.unsent_bytes] = count - accepted
    at[AT.written] += 1
    at[BOARD.has_force] = 0 if is_zero(force, 3) else 1
    at[AT.bytes_at_send] = at[AT.bytes]
    if at[AT.by_length] != 0:
        at[AT.stream_bytes] = 0  # the answer starts here
    count_limited(handle, outcome)
    status = _write_rest(handle)
    if status < 0:
        return status
    return OK if outcome == FULL else STALE


@jit
def _awaits_answer(handle: int) -> bool:
    """Return True if the last frame has no answer yet."""
    at = int64_at(handle)
    return bool(at[AT.bytes] - at[AT.bytes_at_send] < at[AT.answer_bytes])


@jit
def _write_zero(handle: int) -> int:
    """Send a zero; two after a possibly torn frame, because the board uses the first one to complete that frame."""
    at = int64_at(handle)
    status = _send(handle, (0.0, 0.0, 0.0))
    if status == OK and at[AT.maybe_torn] != 0 and at[BOARD.unsent_bytes] == 0:
        status = _send(handle, (0.0, 0.0, 0.0))
        at[AT.maybe_torn] = 1 if status == HELD else 0
    return status


@must_withhold.of(Serial)
def _must_withhold(driver: Serial, handle: int, has_no_sample: bool) -> bool:
    blocked = is_blocked(handle)  # called in each tick, because it records the start
    return has_no_sample or blocked or _awaits_answer(handle)


@jit
def _drop_old(handle: int) -> None:
    """Drop queued forces that would delay a zero: too many of them, or any if the board is silent."""
    at = int64_at(handle)
    if at[BOARD.has_force] == 0:
        return
    is_silent = read_monotonic_ns(handle + 8 * BOARD.timespec) - at[BOARD.sampled_at] > at[BOARD.quiet]
    if is_blocked(handle) or (is_silent and has_unsent(handle)):
        drop_frames(handle)


@send_zero.of(Serial)
def _send_zero(driver: Serial, handle: int) -> int:
    _drop_old(handle)
    return _write_zero(handle)


@jit
def _withhold(handle: int) -> int:
    """Replace all queued forces by a zero; return WITHHELD, or a status below 0."""
    at = int64_at(handle)
    status = WITHHELD
    if at[BOARD.has_force] != 0:
        drop_frames(handle)
        status = _write_zero(handle)
    return status if status < 0 else WITHHELD


@send_wrench.of(Serial)
def _send_wrench(driver: Serial, handle: int, wrench: Any) -> int:
    at = int64_at(handle)
    if _awaits_answer(handle):
        at[AT.held] += 1
        return HELD
    if is_blocked(handle):
        return _withhold(handle)
    return _send(handle, rotate_force_into_device(handle, wrench))


@wake.of(Serial)
def _wake(driver: Serial, handle: int) -> int:
    at = int64_at(handle)
    if is_blocked(handle) and at[BOARD.has_force] == 0:
        return OK
    _drop_old(handle)
    status = _write_rest(handle)
    if status == OK and at[DESCRIBED.kind] != TEXT:
        at[AT.kicks] += 1
        return _write_zero(handle)
    if status == OK and at[BOARD.has_force] != 0:
        status = _write_zero(handle)
    if status == OK and at[BOARD.unsent_bytes] == 0:
        accepted = _write_bytes(handle, handle + 8 * AT.newline, 1)
        status = LOST if accepted < 0 else OK
        at[AT.kicks] += accepted
    return status


read, write, disarm_and_zero = compile_functions(Serial())


@c_function(types.int64(types.int64))
def discard(handle: int) -> int:
    """Disarm and drop unsent bytes; return 1 if it is done, 0 if it must be tried again."""
    at = int64_at(handle)
    at[BOARD.armed] = 0
    if not try_lock(handle, BOARD.lock):
        return 0  # a write is in progress
    if at[BOARD.fd] >= 0:
        drop_frames(handle)
    unlock(handle, BOARD.lock)
    return 1
