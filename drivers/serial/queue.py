"""Frames that a port has accepted but not sent: how many there are, and how to drop them.

A port accepts frames long before the line has carried them. Without a limit, a board that reads slowly or not at all
would later receive forces that are seconds old. TIOCOUTQ gives the bytes that wait in the system: UARTs and USB serial
chips count bytes, a USB modem (cdc-acm) a whole buffer for each write, a pseudo terminal nothing. Bytes in a chip's own
buffer are not counted.
"""

from __future__ import annotations

from typing import Final

from softfinger.drivers.conversation import TALK
from softfinger.drivers.serial.block import AT
from softfinger.drivers.system.libc import count_unsent, drop_unsent, monotonic_ns
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import int64_at

QUEUE_MAX: Final = 2
"""Frames that may wait: one that is being sent, the next behind it. As many reports wait in `hid`."""


@jit
def count_write(handle: int, size: int) -> None:
    """Count a write of `size` bytes that the port has taken."""
    at = int64_at(handle)
    at[AT.writes] += 1
    at[AT.put] += size


@jit
def is_blocked(handle: int) -> bool:
    """Return whether more than QUEUE_MAX frames wait, or did and have not all been sent since."""
    at = int64_at(handle)
    if at[AT.countable] == 0:
        return False
    unsent = count_unsent(at[TALK.fd], handle + 8 * AT.waiting)
    if unsent <= 0:  # a port that is gone is told by the next read
        at[AT.writes] = at[AT.put] = at[AT.blocked_since] = 0
        return False
    if unsent > at[AT.put]:  # buffers and not bytes: after the first write since 0, one buffer
        at[AT.unit] = max(at[AT.unit], -(-unsent // max(at[AT.writes], 1)))
    if at[AT.blocked_since] == 0:
        if unsent <= QUEUE_MAX * at[AT.unit]:
            return False
        at[AT.blocked_since] = monotonic_ns(handle + 8 * TALK.timespec)
        at[AT.blocked] += 1
    at[AT.blocked_at] = monotonic_ns(handle + 8 * TALK.timespec)
    return True


@jit
def is_waiting(handle: int) -> bool:
    """Return whether anything waits."""
    at = int64_at(handle)
    return at[AT.countable] != 0 and count_unsent(at[TALK.fd], handle + 8 * AT.waiting) > 0


@jit
def drop_frames(handle: int) -> None:
    """Drop every byte that the port has not sent, also the rest of a frame that it has not taken."""
    at = int64_at(handle)
    drop_unsent(at[TALK.fd])
    at[AT.dropped] += 1
    at[TALK.left] = 0
    at[AT.torn] = 1
