"""Injection of faults between a driver and the loop, for tests and for `softfinger run --inject`.

A `FaultInjector` wraps a device and has the same two C functions. Runs without faults neither call nor compile them.
`stop` and `close` are passed to the device unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.config.schema import faults
from softfinger.config.schema.faults import NUMBERS, FaultBase, Faults, Injection
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
    LeadableHand,
    ZeroCommand,
)
from softfinger.drivers.block import Block, address, counter, lay_out, numbers, word
from softfinger.drivers.samples import copy_sample
from softfinger.drivers.system.libc import IO_SIGNATURE
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.memory import float64_array_at, float64_at, int64_at

WRENCH_SIZE: Final = 6
POSE_SIZE: Final = len(NUMBERS)

ROW: Final = 8
"""Columns of the fault table: action, first tick, tick after the last, period in ticks, then its parameters."""
ACTION, FIRST_TICK, END_TICK, PERIOD_TICKS, A, B, C = range(7)

REPEAT, SET_NUMBER, MOVE, BLOCK_READ, BLOCK_WRITE, TRUNCATE, FLIP = range(7)
TOGGLE_BUTTONS, FAIL_READ, FAIL_WRITE, UNPLUG, ZERO_FORCE, HOLD_FORCE = range(7, 13)
"""Actions of faults.

REPEAT          repeat the sample, with status A
SET_NUMBER      set number A of the pose to B
MOVE            add A, B, C (m) to the position
BLOCK_READ      block for A (us) while reading; BLOCK_WRITE: while writing
TRUNCATE        set the numbers from index A to zero
FLIP            flip a bit of the pose
TOGGLE_BUTTONS  toggle buttons A
FAIL_READ       fail with status A while reading; FAIL_WRITE: while writing
UNPLUG          report a disconnected device
ZERO_FORCE      write zero, and read with status A
HOLD_FORCE      keep the previous force, and write with status A
"""

US_PER_S: Final = 1e6
BLOCK_US: Final = 500_000
"""Longest single wait: usleep need not accept a second."""

_usleep: Any = types.ExternalFunction("usleep", types.int32(types.uint32))


class Fields(NamedTuple):
    """Fields of an injected device."""

    ticks: Annotated[int, word("reads so far")]
    injected_ticks: Annotated[int, counter("reads and writes with a fault")]
    last_fault: Annotated[int, word("index of the last fault, -1 before the first")]
    last_fault_tick: Annotated[int, word("tick of the last fault")]
    has_sample: Annotated[int, word("whether an earlier sample exists")]
    random: Annotated[int, word("state of the random numbers")]
    read: Annotated[int, word("function of the driver")]
    write: Annotated[int, word("function of the driver")]
    handle: Annotated[int, word("handle of the driver")]
    faults: Annotated[int, address("(count, ROW) float64")]
    length: Annotated[int, word("number of faults")]
    sample: Annotated[int, numbers("the latest sample that the loop read", SAMPLE_SIZE)]
    wrench: Annotated[int, numbers("wrench sent to the driver", WRENCH_SIZE)]


AT: Final = lay_out(Fields)


@jit
def _is_active(row: Any, tick: int) -> bool:
    return bool(row[FIRST_TICK] <= tick < row[END_TICK] and (tick - int(row[FIRST_TICK])) % int(row[PERIOD_TICKS]) == 0)


@jit
def _combine(status: int, other_status: int) -> int:
    """Return the more severe of two statuses: a failure, otherwise the larger one."""
    if status < 0 or other_status < 0:
        return min(status, other_status)
    return max(status, other_status)


@jit
def _record(word: Any, index: int, tick: int) -> None:
    word[AT.injected_ticks] += 1
    word[AT.last_fault] = index
    word[AT.last_fault_tick] = tick


@jit
def _block_for(microseconds: float) -> None:
    remaining_us = int(microseconds)
    while remaining_us > 0:
        _usleep(min(remaining_us, BLOCK_US))
        remaining_us -= BLOCK_US


@jit
def _replace_read(handle: int, tick: int) -> tuple[int, bool]:
    """Apply a tick's faults that replace the read. Return the status, and True to repeat the previous sample.

    A status below zero fails the read.
    """
    word = int64_at(handle)
    status, is_repeated = OK, False
    for index in range(word[AT.length]):
        row = float64_at(word[AT.faults] + 8 * ROW * index)
        if not _is_active(row, tick):
            continue
        action = int(row[ACTION])
        if action in (REPEAT, ZERO_FORCE, FAIL_READ):
            status = _combine(status, int(row[A]))
            is_repeated |= action == REPEAT
        elif action == UNPLUG:
            status = _combine(status, LOST)
        elif action == BLOCK_READ:
            _block_for(row[A])
        if action != HOLD_FORCE and action != BLOCK_WRITE and action != FAIL_WRITE:
            _record(word, index, tick)
    return status, is_repeated


@jit
def _corrupt_sample(handle: int, tick: int) -> None:
    """Apply a tick's faults to the sample that was read."""
    word = int64_at(handle)
    sample = float64_at(handle + 8 * AT.sample)
    bits = int64_at(handle + 8 * AT.sample)
    for index in range(word[AT.length]):
        row = float64_at(word[AT.faults] + 8 * ROW * index)
        if not _is_active(row, tick):
            continue
        action = int(row[ACTION])
        if action == SET_NUMBER:
            sample[int(row[A])] = row[B]
        elif action == MOVE:
            for i in range(3):
                sample[i] += row[A + i]
        elif action == TRUNCATE:
            for i in range(int(row[A]), SAMPLE_SIZE):
                sample[i] = 0.0
        elif action == TOGGLE_BUTTONS:
            sample[SAMPLE_BUTTONS] = float(int(sample[SAMPLE_BUTTONS]) ^ int(row[A]))
        elif action == FLIP:
            # Knuth's linear congruential generator (MMIX); only its upper bits are random
            state = word[AT.random] * 6364136223846793005 + 1442695040888963407
            word[AT.random] = state
            number = (state >> 33) & 0x3FFFFFFF
            bits[number % POSE_SIZE] ^= 1 << ((number // POSE_SIZE) % 63)


@c_function(IO_SIGNATURE, on_demand=True)
def _read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    last_sample = float64_array_at(handle + 8 * AT.sample, SAMPLE_SIZE)
    tick = word[AT.ticks]
    word[AT.ticks] = tick + 1
    status, is_repeated = _replace_read(handle, tick)
    if status < 0:
        return status
    if not (is_repeated and word[AT.has_sample]):
        status = _combine(status, call_device(word[AT.read], word[AT.handle], last_sample))
        if status < 0:
            return int(status)
        word[AT.has_sample] = 1
        _corrupt_sample(handle, tick)
    copy_sample(last_sample, sample)
    return int(status)


@c_function(IO_SIGNATURE, on_demand=True)
def _write(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    commanded = float64_array_at(handle + 8 * AT.wrench, WRENCH_SIZE)
    for i in range(WRENCH_SIZE):
        commanded[i] = wrench[i]
    tick, status, is_delivered = word[AT.ticks] - 1, OK, True
    for index in range(word[AT.length]):
        row = float64_at(word[AT.faults] + 8 * ROW * index)
        if not _is_active(row, tick):
            continue
        action = int(row[ACTION])
        if action == BLOCK_WRITE:
            _block_for(row[A])
        elif action == ZERO_FORCE:
            status = _combine(status, WITHHELD)
            for i in range(WRENCH_SIZE):
                commanded[i] = 0.0
        elif action == UNPLUG:
            status, is_delivered = _combine(status, LOST), False
        elif action in (HOLD_FORCE, FAIL_WRITE):
            status, is_delivered = _combine(status, int(row[A])), False
        if action in (BLOCK_WRITE, HOLD_FORCE, FAIL_WRITE):
            _record(word, index, tick)
    if not is_delivered:
        return int(status)
    return int(_combine(status, call_device(word[AT.write], word[AT.handle], commanded)))


class FaultInjector(Device):
    """Open device with faults. It takes ownership of the device: stop and close this one instead.

    For any wrapped device `own_clock` is False: poses are checked for jumps, and ticks use the measured time.
    """

    def __init__(self, device: Device, table_of_faults: Faults, rate_hz: float, finger: str = "") -> None:
        self._device = device
        self.info = replace(device.info, own_clock=False)
        self._faults = [fault for fault in table_of_faults.fault if fault.finger in ("", finger)]
        self._block = block = Block(AT)
        io, at = device.io(), block.word
        at[AT.read], at[AT.write], at[AT.handle] = io
        at[AT.last_fault] = -1
        at[AT.random] = next((fault.seed for fault in self._faults if isinstance(fault, faults.Corrupt)), 1)
        at[AT.length] = len(self._faults)
        block.set_address(AT.faults, make_fault_table(self._faults, rate_hz))

    def io(self) -> DeviceIO:
        return DeviceIO(_read.address, _write.address, self._block.handle)

    def arm(self) -> None:
        self._device.arm()

    def stop(self) -> None:
        self._device.stop()

    def close(self) -> None:
        self._device.close()

    def reason(self) -> str:
        index = int(self._block.word[AT.last_fault])
        if index < 0:
            return self._device.reason()
        description = f"injected: {self._faults[index].kind} in tick {int(self._block.word[AT.last_fault_tick])}"
        return "; ".join(filter(None, [self._device.reason(), description]))

    def warning(self) -> str:
        return self._device.warning()

    def zero_failure(self) -> str:
        return self._device.zero_failure()

    def hand(self) -> LeadableHand | None:
        return self._device.hand()

    def zero_command(self) -> ZeroCommand | None:
        return self._device.zero_command()

    def thread_ids(self) -> list[int]:
        return self._device.thread_ids()

    def counts(self) -> dict[str, int]:
        return self._device.counts() | self._block.counts()


def make_fault_table(injections: list[Injection], rate_hz: float) -> NDArray[np.float64]:
    """Return the fault table for the kernels (count, ROW)."""
    rows = np.zeros((len(injections), ROW))
    for row, fault in zip(rows, injections, strict=True):
        row[FIRST_TICK], row[END_TICK] = fault.window(rate_hz)
        row[PERIOD_TICKS] = fault.every_ticks
        action, *parameters = _ACTIONS[type(fault)](fault)
        row[ACTION] = action
        row[A : A + len(parameters)] = parameters
    return rows


def _on(fault: Any, read: int, write: int) -> int:
    return read if fault.on == "read" else write


_ACTIONS: Final[dict[type[FaultBase], Callable[[Any], tuple[float, ...]]]] = {
    faults.Stale: lambda fault: (REPEAT, STALE),
    faults.Frozen: lambda fault: (REPEAT, OK),
    faults.NotANumber: lambda fault: (SET_NUMBER, NUMBERS.index(fault.number), np.nan),
    faults.Infinite: lambda fault: (SET_NUMBER, NUMBERS.index(fault.number), np.inf),
    faults.Teleport: lambda fault: (MOVE, *fault.offset_m),
    faults.Slow: lambda fault: (_on(fault, BLOCK_READ, BLOCK_WRITE), US_PER_S * fault.block_s),
    faults.Short: lambda fault: (TRUNCATE, fault.numbers),
    faults.Corrupt: lambda fault: (FLIP,),
    faults.Bounce: lambda fault: (TOGGLE_BUTTONS, fault.buttons),
    faults.Disconnect: lambda fault: (UNPLUG,),
    faults.Timeout: lambda fault: (_on(fault, FAIL_READ, FAIL_WRITE), TIMEOUT),
    faults.Protocol: lambda fault: (_on(fault, FAIL_READ, FAIL_WRITE), PROTOCOL),
    faults.ForceOff: lambda fault: (ZERO_FORCE, FORCE_OFF),
    faults.Withheld: lambda fault: (ZERO_FORCE, WITHHELD),
    faults.HeldForce: lambda fault: (HOLD_FORCE, HELD),
    faults.Swallowed: lambda fault: (HOLD_FORCE, OK),
}
"""Action of each fault and its parameters."""
