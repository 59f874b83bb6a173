"""Shutdown of devices, in which a failed step skips no other, and the errors for each end of a loop."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout, HapticError, SafetyStop
from softfinger.drivers import open_devices
from softfinger.drivers.base import FORCE_OFF, PROTOCOL, TIMEOUT, Device
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.server.loop import fault_detection

log: Final = logging.getLogger(__name__)

STOPPED: Final = 0
FINISHED: Final = 1
READ_FAILED: Final = 2
WRITE_FAILED: Final = 3
CRASHED: Final = 4
"""Reasons for the end of a loop, and of its thread; the faults of server.loop.fault_detection have the next numbers."""


class LoopEnd(NamedTuple):
    """End of a loop.

    ending  STOPPED ... CRASHED or a fault of server.loop.fault_detection
    status  last status of a device
    error   exception, if the loop crashed
    finger  index of the finger of that device
    """

    ending: int
    status: int
    error: BaseException | None = None
    finger: int = 0


def run_all_steps(*steps: Callable[[], object], first: BaseException | None = None) -> BaseException | None:
    """Run every step, also after an error; return the first error, for the caller to raise, and log further ones.

    first  an earlier error, if any: then the errors of all steps are logged
    """
    for step in steps:
        try:
            step()
        except BaseException as error:  # an interrupt, too, must not prevent the next step
            if first is None:
                first = error
            else:
                log.error("during shutdown, besides: %s", error if str(error) else type(error).__name__)
    return first


def complete_all_steps(*steps: Callable[[], object]) -> None:
    """Run every step, also after an error; raise the first error after all of them."""
    if (failed := run_all_steps(*steps)) is not None:
        raise failed


@jit
def write_zero(write: int, handle: int, wrench: NDArray[np.float64]) -> None:
    """Write zero, the last act of every loop, and ignore the status; `wrench` (6,) is scratch."""
    for i in range(6):
        wrench[i] = 0.0
    call_device(write, handle, wrench)


def stop(device: Device) -> None:
    """Stop a device; raises DeviceError on failure, because its force is then unknown.

    After a failed stop, zero is written directly, as the last resort, even if another thread may be writing.
    """
    try:
        _call_checked(device, device.stop, "be stopped")
    except BaseException:
        _write_zero_directly(device)
        raise


def _write_zero_directly(device: Device) -> None:
    """Write zero by the device's write function, without regard to other calls in progress."""
    io, zero = device.io(), np.zeros(6)
    ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)(io.write)(io.handle, zero.ctypes.data)


def close(device: Device) -> None:
    _call_checked(device, device.close, "be closed")


def stop_all(devices: Sequence[Device]) -> None:
    """Stop all devices in parallel: one that fails or hangs does not delay the zero force of another.

    Raises the first error after all calls have returned, or after `open_devices.STOP_TIMEOUT_S`; logs further ones.
    """
    failures = open_devices.call_all(stop, devices)
    hung = [device for device, error in failures if isinstance(error, TimeoutError)]
    open_devices.call_all(_write_zero_directly, hung)  # this write may hang as well
    _raise_first("be stopped", failures)


def close_all(devices: Sequence[Device]) -> None:
    _raise_first("be closed", open_devices.call_all(close, devices))


@contextmanager
def close_on_error(devices: Sequence[Device]) -> Iterator[None]:
    """Close the devices if the block raises an error, which is then raised; errors of closing are logged."""
    try:
        yield
    except BaseException as error:
        run_all_steps(lambda: close_all(devices), first=error)
        raise


def confirm_zero(devices: Sequence[Device]) -> None:
    """Raise DeviceError if a stopped device does not confirm zero force."""
    for device in devices:
        if why := device.zero_failure():
            raise DeviceError(
                f"{device.info.name}: zero force is not confirmed ({why}): it may still apply a force: switch it off"
            )


def _raise_first(action: str, failures: Sequence[tuple[Device, BaseException]]) -> None:
    errors = [
        _make_device_error(device, action, str(error)) if isinstance(error, TimeoutError) else error
        for device, error in failures
    ]
    for later_error in errors[1:]:
        log.error("during shutdown, besides: %s", later_error)
    if errors:
        raise errors[0]


def _make_device_error(device: Device, action: str, text: str) -> DeviceError:
    return DeviceError(f"{device.info.name} could not {action} ({text}): it may still apply a force: switch it off")


def _call_checked(device: Device, act: Callable[[], None], action: str) -> None:
    try:
        act()
    except HapticError:
        raise
    except Exception as error:
        text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise _make_device_error(device, action, text) from error


def describe_failure(device: Device, ended: LoopEnd, finger: str = "") -> HapticError | None:
    """Return the error of a device that failed, with its reason and the remedy; None if no device failed.

    finger  name of the device's finger, if there are several
    """
    action = "read" if ended.ending == READ_FAILED else "write"
    name, text = device.info.name + (f", finger '{finger}'" if finger else ""), device.reason()
    because = f" ({text})" if text else ""
    if ended.ending == fault_detection.NO_POSE:
        return DeviceError(
            f"{name}: no usable pose for {fault_detection.NO_FORCE_MAX_S:g} s{because}: zero force was commanded; "
            "check its sensors and its cable, then start again"
        )
    if ended.ending == fault_detection.JUMPING:
        return DeviceError(
            f"{name}: its pose jumps repeatedly, farther than a hand can move in that time{because}: zero force was "
            "commanded; check its sensors and its cable, then start again; if a hand moved it, raise "
            "guard.speed_max_m_per_s or guard.turn_max_rad_per_s"
        )
    if ended.ending not in (READ_FAILED, WRITE_FAILED):
        return None
    if ended.status == FORCE_OFF:
        return SafetyStop(f"{name} disabled its force{because}: correct the cause, then start again")
    if ended.status == TIMEOUT:
        return DeviceTimeout(
            f"{name}: no answer to a {action} in time{because}: check cable and power, then start again"
        )
    text = "sent an answer that violates its protocol" if ended.status == PROTOCOL else "is gone"
    return DeviceLost(f"{name} {text} (status {ended.status} on {action}){because}: plug it in again, then start again")


def describe_loop_failure(ended: LoopEnd, ticks: int, missed: int, woken_late: bool) -> HapticError | None:
    """Return the error of a loop that failed although its devices work; None if the loop did not fail.

    woken_late  whether most of the lost time was lost before its thread was woken
    """
    if ended.ending == fault_detection.NO_FORCE:
        return SafetyStop(
            f"the scene gave no finite force for {fault_detection.NO_FORCE_MAX_S:g} s: zero force was commanded; "
            "run softfinger check to find inconsistent values, or report the scene"
        )
    if ended.ending != fault_detection.STARVED:
        return None
    phase, remedy = "in the device's exchange", "check the device and its cable, or reduce servo.rate_hz"
    if woken_late:
        phase, remedy = "before the servo thread was woken", "see softfinger doctor, or end other work"
    return SafetyStop(
        f"the servo lost more than {fault_detection.LOST_SHARE:.0%} of its time, mostly {phase}, {missed} of "
        f"{ticks + missed} deadlines in all: zero force was commanded; {remedy}"
    )
