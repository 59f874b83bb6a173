"""Device with faults injected between driver and loop, for tests and for `softfinger run --inject`.

It wraps any driver behind the same two C functions. Runs without it neither call nor compile any of this. `stop` and
`close` go directly to the driver.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numba import carray, types
from numpy.typing import NDArray

from softfinger.config.schema.faults import (
    NUMBERS,
    Bounce,
    Corrupt,
    Disconnect,
    FaultBase,
    Faults,
    ForceOff,
    Frozen,
    Held,
    Infinite,
    Injection,
    NotANumber,
    Protocol,
    Short,
    Slow,
    Stale,
    Swallowed,
    Teleport,
    Timeout,
    Withheld,
)
from softfinger.drivers.base import (
    FORCE_OFF,
    HELD,
    LOST,
    OK,
    PROTOCOL,
    SAMPLE_BUTTONS,
    SAMPLE_SIZE,
    STALE,
    TIMEOUT,
    WITHHELD,
    Device,
    DeviceIO,
    LastWord,
    Led,
)
from softfinger.drivers.block import Block, address, counter, lay_out, numbers, word
from softfinger.drivers.system.libc import IO_SIGNATURE
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at

WRENCH_SIZE: Final = 6
POSE_SIZE: Final = len(NUMBERS)

ROW: Final = 8
"""Columns of the fault table: action, first tick, tick after the last, period in ticks, then its parameters."""
DOES, FIRST, BEHIND, EVERY, A, B, C = range(7)

REPEAT, PUT, MOVE, BLOCK_READ, BLOCK_WRITE, CUT, FLIP, PRESS, FAIL_READ, FAIL_WRITE, UNPLUG, ZERO, KEEP = range(13)
"""Actions of faults.

REPEAT       repeat the sample, with status A
PUT          set number A of the pose to B
MOVE         add A, B, C (m) to the position
BLOCK_READ   block for A (us) while reading; BLOCK_WRITE: while writing
CUT          set the numbers from index A to zero
FLIP         flip a bit of the pose
PRESS        toggle buttons A
FAIL_READ    fail with status A while reading; FAIL_WRITE: while writing
UNPLUG       report a disconnected device
ZERO         write zero, and read with status A
KEEP         keep the previous force, and write with status A
"""

US_PER_S: Final = 1e6
BLOCK_US: Final = 500_000
"""Longest single wait: usleep need not accept a second."""

_usleep: Any = types.ExternalFunction("usleep", types.int32(types.uint32))


class Words(NamedTuple):
    """Fields of an injected device."""

    ticks: Annotated[int, word("reads so far")]
    injected_ticks: Annotated[int, counter("reads and writes in which a fault has acted")]
    newest: Annotated[int, word("index of the fault that acted last, -1 before the first")]
    newest_tick: Annotated[int, word("in which it has")]
    known: Annotated[int, word("whether there is a sample of before")]
    random: Annotated[int, word("state of the random numbers")]
    read: Annotated[int, word("the driver's")]
    write: Annotated[int, word("the driver's")]
    handle: Annotated[int, word("the driver's")]
    faults: Annotated[int, address("(count, ROW) float64")]
    length: Annotated[int, word("how many faults there are")]
    sample: Annotated[int, numbers("the newest sample, as the loop was given it", SAMPLE_SIZE)]
    wrench: Annotated[int, numbers("what the driver is given", WRENCH_SIZE)]


AT: Final = lay_out(Words)


@jit
def _acts(row: Any, tick: int) -> bool:
    return bool(row[FIRST] <= tick < row[BEHIND] and (tick - int(row[FIRST])) % int(row[EVERY]) == 0)


@jit
def _note(word: Any, place: int, tick: int) -> None:
    word[AT.injected_ticks] += 1
    word[AT.newest] = place
    word[AT.newest_tick] = tick


@jit
def _block(microseconds: float) -> None:
    left = int(microseconds)
    while left > 0:
        _usleep(min(left, BLOCK_US))
        left -= BLOCK_US


@jit
def _instead(handle: int, tick: int) -> tuple[int, bool]:
    """Apply a tick's faults that replace the read. Return the status, and True to repeat the previous sample.

    A status below zero fails the read.
    """
    word = int64_at(handle)
    status, again = OK, False
    for place in range(word[AT.length]):
        row = float64_at(word[AT.faults] + 8 * ROW * place)
        if not _acts(row, tick):
            continue
        does = int(row[DOES])
        if does in (REPEAT, ZERO, FAIL_READ):
            status = int(row[A])
            again |= does == REPEAT
        elif does == UNPLUG:
            status = LOST
        elif does == BLOCK_READ:
            _block(row[A])
        if does != KEEP and does != BLOCK_WRITE and does != FAIL_WRITE:
            _note(word, place, tick)
    return status, again


@jit
def _spoil(handle: int, tick: int) -> None:
    """Apply a tick's faults to the sample that was read."""
    word = int64_at(handle)
    sample = float64_at(handle + 8 * AT.sample)
    bits = int64_at(handle + 8 * AT.sample)
    for place in range(word[AT.length]):
        row = float64_at(word[AT.faults] + 8 * ROW * place)
        if not _acts(row, tick):
            continue
        does = int(row[DOES])
        if does == PUT:
            sample[int(row[A])] = row[B]
        elif does == MOVE:
            for i in range(3):
                sample[i] += row[A + i]
        elif does == CUT:
            for i in range(int(row[A]), SAMPLE_SIZE):
                sample[i] = 0.0
        elif does == PRESS:
            sample[SAMPLE_BUTTONS] = float(int(sample[SAMPLE_BUTTONS]) ^ int(row[A]))
        elif does == FLIP:
            # Knuth's linear congruential generator (MMIX); only its upper bits are random
            state = word[AT.random] * 6364136223846793005 + 1442695040888963407
            word[AT.random] = state
            drawn = (state >> 33) & 0x3FFFFFFF
            bits[drawn % POSE_SIZE] ^= 1 << ((drawn // POSE_SIZE) % 63)


@c_function(IO_SIGNATURE, on_demand=True)
def _read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    kept = carray(float64_at(handle + 8 * AT.sample), (SAMPLE_SIZE,))
    tick = word[AT.ticks]
    word[AT.ticks] = tick + 1
    status, again = _instead(handle, tick)
    if status < 0:
        return status
    if not (again and word[AT.known]):
        said = call_device(word[AT.read], word[AT.handle], kept)
        if said < 0:
            return int(said)
        status = max(status, said)
        word[AT.known] = 1
        _spoil(handle, tick)
    for i in range(SAMPLE_SIZE):
        sample[i] = kept[i]
    return int(status)


@c_function(IO_SIGNATURE, on_demand=True)
def _write(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    given = carray(float64_at(handle + 8 * AT.wrench), (WRENCH_SIZE,))
    for i in range(WRENCH_SIZE):
        given[i] = wrench[i]
    tick, status, arrives = word[AT.ticks] - 1, OK, True
    for place in range(word[AT.length]):
        row = float64_at(word[AT.faults] + 8 * ROW * place)
        if not _acts(row, tick):
            continue
        does = int(row[DOES])
        if does == BLOCK_WRITE:
            _block(row[A])
        elif does == ZERO:
            status = WITHHELD
            for i in range(WRENCH_SIZE):
                given[i] = 0.0
        elif does == UNPLUG:
            status, arrives = LOST, False
        elif does in (KEEP, FAIL_WRITE):
            status, arrives = int(row[A]), False
        if does in (BLOCK_WRITE, KEEP, FAIL_WRITE):
            _note(word, place, tick)
    if not arrives:
        return int(status)
    said = call_device(word[AT.write], word[AT.handle], given)
    return int(said if said < 0 else max(status, said))


class Injected(Device):
    """Open device with faults. It takes ownership of the device: stop and close this one instead.

    For any wrapped device `own_clock` is False: poses are checked for jumps, and ticks use the measured time.
    """

    def __init__(self, device: Device, faults: Faults, rate_hz: float, finger: str = "") -> None:
        self._device = device
        self.info = replace(device.info, own_clock=False)
        self._faults = [fault for fault in faults.fault if fault.finger in ("", finger)]
        self._rate_hz = rate_hz
        self._block = block = Block(AT)
        io, at = device.io(), block.word
        at[AT.read], at[AT.write], at[AT.handle] = io
        at[AT.newest] = -1
        at[AT.random] = next((fault.seed for fault in self._faults if isinstance(fault, Corrupt)), 1)
        at[AT.length] = len(self._faults)
        block.point(AT.faults, table(self._faults, rate_hz))

    def io(self) -> DeviceIO:
        return DeviceIO(_read.address, _write.address, self._block.handle)

    def arm(self) -> None:
        self._device.arm()

    def stop(self) -> None:
        self._device.stop()

    def close(self) -> None:
        self._device.close()

    def reason(self) -> str:
        place = int(self._block.word[AT.newest])
        if place < 0:
            return self._device.reason()
        said = f"injected: {self._faults[place].kind} in tick {int(self._block.word[AT.newest_tick])}"
        return "; ".join(filter(None, [self._device.reason(), said]))

    def warning(self) -> str:
        return self._device.warning()

    def zero_failure(self) -> str:
        return self._device.zero_failure()

    def hand(self) -> Led | None:
        return self._device.hand()

    def last_word(self) -> LastWord | None:
        return self._device.last_word()

    def counts(self) -> dict[str, int]:
        return self._device.counts() | self._block.counts()


def table(faults: list[Injection], rate_hz: float) -> NDArray[np.float64]:
    """Return the fault table for the kernels (count, ROW)."""
    rows = np.zeros((len(faults), ROW))
    for row, fault in zip(rows, faults, strict=True):
        row[FIRST], row[BEHIND] = fault.window(rate_hz)
        row[EVERY] = fault.every_ticks
        does, *own = _deed(fault)
        row[DOES] = does
        row[A : A + len(own)] = own
    return rows


def _deed(fault: FaultBase) -> tuple[float, ...]:
    """Return the action of a fault and its parameters."""
    match fault:
        case Stale():
            return REPEAT, STALE
        case Frozen():
            return REPEAT, OK
        case NotANumber():
            return PUT, NUMBERS.index(fault.number), np.nan
        case Infinite():
            return PUT, NUMBERS.index(fault.number), np.inf
        case Teleport():
            return MOVE, *fault.offset_m
        case Slow():
            return BLOCK_READ if fault.on == "read" else BLOCK_WRITE, US_PER_S * fault.block_s
        case Short():
            return CUT, fault.numbers
        case Corrupt():
            return (FLIP,)
        case Bounce():
            return PRESS, fault.buttons
        case Disconnect():
            return (UNPLUG,)
        case Timeout():
            return FAIL_READ if fault.on == "read" else FAIL_WRITE, TIMEOUT
        case Protocol():
            return FAIL_READ if fault.on == "read" else FAIL_WRITE, PROTOCOL
        case ForceOff():
            return ZERO, FORCE_OFF
        case Withheld():
            return ZERO, WITHHELD
        case Held():
            return KEEP, HELD
        case Swallowed():
            return KEEP, OK
    raise TypeError(f"{fault!r} is no fault")
