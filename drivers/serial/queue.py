"""Frames that a port has accepted but not sent: their number, and how to drop them.

A port accepts frames long before the line transmits them. Without a limit, a board that reads slowly or not at all
would later receive forces that are seconds old. TIOCOUTQ returns the bytes queued in the system: UARTs and USB serial
chips count bytes, a USB modem (cdc-acm) a full buffer for each write, a pseudo terminal nothing. Bytes in the buffer of
a chip are not counted.
"""

from __future__ import annotations

from typing import Final

from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.serial.block import AT
from softfinger.drivers.system.libc import count_unsent, drop_unsent, read_monotonic_ns
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import int64_at

QUEUE_MAX: Final = 2
"""Maximum number of queued frames: one in transmission and the next. `hid` has the same limit for reports."""


@jit
def record_write(handle: int, size: int) -> None:
    """Count a write of `size` bytes that the port has accepted."""
    at = int64_at(handle)
    at[AT.writes] += 1
    at[AT.queued_bytes] += size


@jit
def is_blocked(handle: int) -> bool:
    """Return True if more than QUEUE_MAX frames are queued, or were, and have not all been sent since."""
    at = int64_at(handle)
    if at[AT.counts_unsent] == 0:
        return False
    unsent = count_unsent(at[BOARD.fd], handle + 8 * AT.ioctl_scratch)
    if unsent <= 0:  # the next read reports a disconnected port
        at[AT.writes] = at[AT.queued_bytes] = at[AT.blocked_since] = 0
        return False
    if unsent > at[AT.queued_bytes]:  # it counts buffers, not bytes: one buffer per write since the last 0
        at[AT.frame_units] = max(at[AT.frame_units], -(-unsent // max(at[AT.writes], 1)))
    if at[AT.blocked_since] == 0:
        if unsent <= QUEUE_MAX * at[AT.frame_units]:
            return False
        at[AT.blocked_since] = read_monotonic_ns(handle + 8 * BOARD.timespec)
        at[AT.blocked] += 1
    at[AT.blocked_at] = read_monotonic_ns(handle + 8 * BOARD.timespec)
    return True


@jit
def has_unsent(handle: int) -> bool:
    """Return True if any byte is queued."""
    at = int64_at(handle)
    return at[AT.counts_unsent] != 0 and count_unsent(at[BOARD.fd], handle + 8 * AT.ioctl_scratch) > 0


@jit
def drop_frames(handle: int) -> None:
    """Drop every byte that the port has not sent, and the remainder of a frame that it has partly accepted."""
    at = int64_at(handle)
    drop_unsent(at[BOARD.fd])
    at[AT.dropped] += 1
    at[BOARD.unsent_bytes] = 0
    at[AT.maybe_torn] = 1
