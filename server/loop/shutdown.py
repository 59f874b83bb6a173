"""Shutdown: the last zero, each step whatever the one before it did, and the words for what ended a loop."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout, HapticError, SafetyStop
from softfinger.drivers import opened
from softfinger.drivers.base import FORCE_OFF, PROTOCOL, TIMEOUT, Device
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.server.loop import health

log: Final = logging.getLogger(__name__)

STOPPED: Final = 0
FINISHED: Final = 1
READ_FAILED: Final = 2
WRITE_FAILED: Final = 3
CRASHED: Final = 4
"""Ends of a loop, and of its thread; faults of server.loop.health go on from here."""


class Ended(NamedTuple):
    """How a loop ended: STOPPED ... CRASHED or a fault of server.loop.health, a device's last status, the error if it
    crashed, and the place of the finger whose device it was."""

    ending: int
    status: int
    error: BaseException | None = None
    finger: int = 0


def every(*steps: Callable[[], object], first: BaseException | None = None) -> BaseException | None:
    """Run each step; returns the first error, which is for the caller to raise. The others are logged here.

    first  the error that there was before, if any: then those of all steps are logged
    """
    for step in steps:
        try:
            step()
        except BaseException as error:  # an interrupt, too, must not keep the next step from its turn
            if first is None:
                first = error
            else:
                log.error("during shutdown, besides: %s", error if str(error) else type(error).__name__)
    return first


@jit
def write_zero(write: int, handle: int, wrench: NDArray[np.float64]) -> None:
    """The last act of every loop, whatever ended it. `wrench` (6,) is scratch; nobody is left to act on the status."""
    for i in range(6):
        wrench[i] = 0.0
    call_device(write, handle, wrench)


def stop(device: Device) -> None:
    """Stop a device; DeviceError if that fails or its zero is not confirmed, since then its force is unknown.

    A stop that fails is followed by a plain write of zero, the one way left; whoever else may be writing.
    """
    try:
        _named(device, device.stop, "be stopped")
    except BaseException:
        _write_plainly(device)
        raise
    if why := device.zero_failure():
        raise DeviceError(f"{device.info.name}: zero force is not confirmed ({why}): it may still push: switch it off")


def _write_plainly(device: Device) -> None:
    """Zero by the device's own write, whatever else goes on with it."""
    io, zero = device.io(), np.zeros(6)
    ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)(io.write)(io.handle, zero.ctypes.data)


def close(device: Device) -> None:
    """Close a device; DeviceError as of `stop`."""
    _named(device, device.close, "be closed")


def stop_all(devices: Sequence[Device]) -> None:
    """`stop` of each, at the same time: one that fails, or hangs, keeps no other from its zero.

    Raises the first error once all are done, or have had `opened.END_S`; the others are logged.
    """
    failures = opened.at_once(stop, devices)
    hung = [device for device, error in failures if isinstance(error, TimeoutError)]
    opened.at_once(_write_plainly, hung)  # which may hang as well
    _raise_first("be stopped", failures)


def close_all(devices: Sequence[Device]) -> None:
    """`close` of each, as `stop_all`."""
    _raise_first("be closed", opened.at_once(close, devices))


def _raise_first(what: str, failures: Sequence[tuple[Device, BaseException]]) -> None:
    errors = [
        _failed(device, what, str(error)) if isinstance(error, TimeoutError) else error for device, error in failures
    ]
    for other in errors[1:]:
        log.error("during shutdown, besides: %s", other)
    if errors:
        raise errors[0]


def _failed(device: Device, what: str, said: str) -> DeviceError:
    return DeviceError(f"{device.info.name} could not {what} ({said}): it may still display a force: switch it off")


def _named(device: Device, act: Callable[[], None], what: str) -> None:
    try:
        act()
    except HapticError:
        raise
    except Exception as error:
        said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise _failed(device, what, said) from error


def device_failure(device: Device, ended: Ended, finger: str = "") -> HapticError | None:
    """The error of a device that failed, in its own words and with what to do; None where it was not the device.

    finger  name of the one that it moves, if there are several
    """
    doing = "read" if ended.ending == READ_FAILED else "write"
    name, said = device.info.name + (f", finger '{finger}'" if finger else ""), device.reason()
    because = f" ({said})" if said else ""
    if ended.ending == health.NO_POSE:
        return DeviceError(
            f"{name}: no usable pose for {health.SILENCE_MAX_S:g} s{because}: zero force was commanded; "
            "see to its sensors and its cable, then start again"
        )
    if ended.ending == health.JUMPING:
        return DeviceError(
            f"{name}: its pose jumps again and again, farther than a hand comes in the time{because}: zero force was "
            "commanded; see to its sensors and its cable, then start again; where it was a hand, raise "
            "guard.speed_max_m_per_s or guard.turn_max_rad_per_s"
        )
    if ended.ending not in (READ_FAILED, WRITE_FAILED):
        return None
    if ended.status == FORCE_OFF:
        return SafetyStop(f"{name} turned its force off{because}: see to the cause, then start again")
    if ended.status == TIMEOUT:
        return DeviceTimeout(
            f"{name}: no answer to a {doing} in time{because}: check cable and power, then start again"
        )
    what = "answered what is not in its protocol" if ended.status == PROTOCOL else "is gone"
    return DeviceLost(f"{name} {what} (status {ended.status} on {doing}){because}: plug it in again, then start again")


def loop_failure(ended: Ended, ticks: int, missed: int, woken_late: bool) -> HapticError | None:
    """The error of a loop that could not go on with a device that could; None where it was not the loop.

    woken_late  whether most of the time it lost was lost before its thread was woken
    """
    if ended.ending == health.NO_FORCE:
        return SafetyStop(
            f"the scene gave no finite force for {health.SILENCE_MAX_S:g} s: zero force was commanded; "
            "softfinger check names values that do not go together, else report the scene"
        )
    if ended.ending != health.STARVED:
        return None
    where, remedy = "in the device's exchange", "see to the device and its cable, or take a lower servo.rate_hz"
    if woken_late:
        where, remedy = "before the servo thread was woken", "see softfinger doctor, or end other work"
    return SafetyStop(
        f"the servo lost more than {health.LOST_SHARE:.0%} of its time, mostly {where}, {missed} of "
        f"{ticks + missed} deadlines in all: zero force was commanded; {remedy}"
    )
