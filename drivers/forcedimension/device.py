"""Device of Force Dimension, opened through the maker's library.

The maker prescribes the order of opening: open, calibrate if needed and allowed, end the library's regulation, apply
settings. If a step fails, the device is stopped and closed. `arm` switches on force and watchdog: the watchdog measures
real time since the last force, and kernels are compiled between opening and the first tick.
"""

from __future__ import annotations

import ctypes
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final, NoReturn

import numpy as np

from softfinger.config.errors import DeviceError, DeviceTimeout
from softfinger.drivers import open_devices
from softfinger.drivers.base import DeviceInfo, make_info
from softfinger.drivers.block import Block, BlockDevice
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.forcedimension import exchange, library, selection
from softfinger.drivers.forcedimension.exchange import AT
from softfinger.drivers.forcedimension.options import WATCHDOG_UNIT_S, Options
from softfinger.drivers.system.discovery import SystemDevice

log: Final = logging.getLogger(__name__)

ZERO: Final = (0.0,) * 7
ZERO_TRIES: Final = 20
NO_ANSWER: Final = "the library has not answered"
LOCK_WAIT_S: Final = 0.1
"""Maximum wait of `stop` for a running exchange; a slower one hangs, and the device is stopped in parallel to it."""

HANG_WAIT_S: Final = 0.3
"""Maximum wait for a call in parallel to a hanging one, because the library may block it too."""

NO_WATCHDOG: Final = (
    "firmware before 3.0 has no watchdog, so the force persists if this program is killed: keep a hand "
    "at the force button and set watchdog_s = 0 in the rig's [device] table, or have the maker renew the firmware"
)


class ForceDimension(BlockDevice):
    """Open device with its force off until `arm`. `stop` is final: to resume, open the device again."""

    _functions = exchange.read, exchange.write

    def __init__(self, options: Options, rate_hz: float) -> None:
        if options.watchdog_s != 0.0 and options.watchdog_s < 2.0 / rate_hz:
            least = math.ceil(2e3 / rate_hz * 1e3) / 1e6
            raise DeviceError(
                f"watchdog_s = {options.watchdog_s:g} is shorter than two ticks at {rate_hz:g} Hz: "
                f"give at least {least:g}, or 0 for none"
            )
        self._library = selection.load(options.library_file)
        self._options = options
        self._closing = threading.Lock()
        self._block = Block(AT)
        self._word = self._block.word
        self._word[AT.cause] = -1
        self._id, self._model = selection.open_selected(self._library, options)
        with undo_on_error(self.close):
            self._set_up(rate_hz)
            self.info = self._make_info()

    def arm(self) -> None:
        block = self._block.handle
        if not exchange.lock_library.ctypes(block):
            return  # a stop has the lock; after a stop the device must not be armed
        try:
            self._switch_force_on()
        finally:
            exchange.unlock_library.ctypes(block)

    def stop(self) -> None:
        if self._word[AT.stopped] and self._zero_failure in ("", NO_ANSWER):  # done, or in progress
            return
        self._word[AT.stopped] = 1  # before the lock: the loop sends no force after the zero
        self._word[AT.armed] = 0
        if self._word[AT.open]:
            self._zero_failure = NO_ANSWER
            self._run_locked(self._switch_force_off)

    def close(self) -> None:
        self.stop()
        # Once: another thread or a signal handler may close it at the same time, and the next device reuses its id.
        if not self._word[AT.open] or not self._closing.acquire(blocking=False):
            return
        self._word[AT.open] = 0
        self._run_locked(lambda: self._library.drdClose(self._id))
        reads, repeated, writes, withheld, cut = self.counts().values()
        if repeated or withheld or cut:
            log.info(
                "%s: of %d reads %d repeated the last reading; of %d forces %d were withheld, %d at the motors' limit",
                self._model.full_name, reads, repeated, writes, withheld, cut,
            )  # fmt: skip

    def reason(self) -> str:
        messages = []
        if self._word[AT.error]:
            number = int(self._word[AT.error])
            text = self._library.dhdErrorGetStr(number) or b""
            messages.append(f"the library's error {number}, {text.decode(errors='replace')}")
        cause = int(self._word[AT.cause])
        if cause >= 0:
            messages.append(library.FORCE_OFF_CAUSES.get(cause, f"the device gives no cause ({cause})"))
        if self._word[AT.faulty]:
            messages.append(f"its error code is {self._word[AT.faulty]}")
        return "; ".join(messages)

    def _switch_force_off(self) -> None:
        call = self._library
        is_sent = False
        for _ in range(ZERO_TRIES):
            # 1 (TIMEGUARD) may mean that it was not sent; -1 that the device is disconnected.
            if call.dhdSetForceAndTorqueAndGripperForce(*ZERO, self._id) in (0, 2):
                is_sent = True
                break
            time.sleep(0.001)
        is_off = call.dhdEnableForce(0, self._id) in library.SUCCESS
        is_braked = call.dhdStop(self._id) in library.SUCCESS  # switches to brake mode
        self._zero_failure = (
            "" if is_sent or is_off or is_braked else f"the library reports: {library.format_error(call)}"
        )
        if not self._options.brakes:
            call.dhdSetBrakes(0, self._id)

    def _switch_force_on(self) -> None:
        call, word = self._library, self._word
        word[AT.armed] = 1
        try:
            self._set_watchdog(self._options.watchdog_s)
            # The watchdog may require a force already before dhdEnableForce. Whether the library accepts one then is
            # not documented, so the result is ignored.
            call.dhdSetForceAndTorqueAndGripperForce(*ZERO, self._id)
            if not word[AT.stopped]:
                self._call_checked("dhdEnableForce", call.dhdEnableForce, 1)
                self._call_checked(
                    "dhdSetForceAndTorqueAndGripperForce", call.dhdSetForceAndTorqueAndGripperForce, *ZERO
                )
        finally:
            if word[AT.stopped]:  # during one of these calls that hung, so it took effect after the stop
                self._switch_force_off()

    def _run_locked(self, work: Callable[[], object]) -> None:
        """Run `work` while the loop is not inside the library; if a call of the loop hangs, run it in parallel."""
        if self._call_until_done(exchange.lock_library, LOCK_WAIT_S):
            try:
                work()
            finally:
                exchange.unlock_library.ctypes(self._block.handle)
            return
        if open_devices.call_all(lambda _: work(), [self], HANG_WAIT_S):
            log.error(
                "%s: a call of the library hangs and blocks all others; only the device's watchdog can remove force: "
                "switch the device off",
                self._model.full_name,
            )

    def _set_up(self, rate_hz: float) -> None:
        call, options, word = self._library, self._options, self._word
        word[AT.id] = self._id
        word[AT.open] = 1
        word[AT.started_at] = time.monotonic_ns()
        word[AT.status_every] = max(1, round(options.status_period_s * rate_hz))
        # CHAI3D and cisst: the angle of a left-handed gripper is negative
        word[AT.gripper_sign] = call.dhdHasGripper(self._id) * (-1 if call.dhdIsLeftHanded(self._id) else 1)
        word[AT.has_torque] = call.dhdHasActiveWrist(self._id) and self._model.limits.torque_max_nm > 0.0
        self._block.set_functions(call)
        if not self._model.name:
            log.warning(
                "%s: its limits are unknown, so the lowest of all models apply: %g N, no torque; "
                "start with a soft scene",
                self._model.full_name, self._model.limits.force_max_n,
            )  # fmt: skip
        self._choose_pose()
        self._calibrate()
        self._call_checked(
            "drdStop", call.drdStop, True
        )  # ends the library's regulation, so that this program sets the force
        self._call_checked("dhdEnableForce", call.dhdEnableForce, 0)  # a killed program may have left it on
        if call.dhdSetBrakes(int(options.brakes), self._id) not in library.SUCCESS and not options.brakes:
            log.warning("%s: does not release its brakes, so brakes = false has no effect", self._model.full_name)
        self._call_checked(
            "dhdSetGravityCompensation", call.dhdSetGravityCompensation, int(options.gravity_compensation)
        )
        self._call_checked("dhdSetMaxForce", call.dhdSetMaxForce, self._model.limits.force_max_n)
        self._set_watchdog(0.0)  # until `arm`; fails here if the device has no watchdog
        if options.velocity_threshold is not None:
            with self._enter_expert_mode():
                self._call_checked("dhdSetVelocityThreshold", call.dhdSetVelocityThreshold, options.velocity_threshold)

    def _choose_pose(self) -> None:
        """Select frame or position: the frame is documented only for devices with a wrist."""
        call, word = self._library, self._word
        at = word[AT.frame :].view(np.float64)
        at[3:12] = np.eye(3).ravel()
        pointers = [at[k:].ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for k in range(4)]
        word[AT.has_frame] = (
            call.dhdHasWrist(self._id)
            or call.dhdGetPositionAndOrientationFrame(*pointers, self._id) in library.SUCCESS
            or call.dhdGetPosition(*pointers[:3], self._id) not in library.SUCCESS  # neither works: the loop reports it
        )
        at[3:12] = np.eye(3).ravel()

    def _calibrate(self) -> None:
        if self._library.drdIsInitialized(self._id):
            return
        if not self._options.calibrate:
            raise DeviceError(
                f"{self._model.full_name} is not calibrated: calibrate it with the maker's tools, or set "
                "calibrate = true in the rig's [device] table; the device then MOVES BY ITSELF: keep clear of it"
            )
        log.warning("%s calibrates itself now and MOVES: keep clear", self._model.full_name)
        self._call_checked("drdAutoInit", self._library.drdAutoInit)

    def _set_watchdog(self, seconds: float) -> None:
        with self._enter_expert_mode():
            code = self._library.dhdSetWatchdog(round(seconds / WATCHDOG_UNIT_S), self._id)
            if code not in library.SUCCESS and self._options.watchdog_s > 0.0:
                self._raise_refused("dhdSetWatchdog", NO_WATCHDOG)

    @contextmanager
    def _enter_expert_mode(self) -> Iterator[None]:
        """Enter the expert mode that some settings need; report errors inside, before the mode ends."""
        if self._library.dhdEnableExpertMode() < 0:
            self._raise_refused("dhdEnableExpertMode")
        try:
            yield
        finally:
            self._library.dhdDisableExpertMode()

    def _call_checked(self, name: str, function: Callable[..., int], *arguments: Any) -> None:
        if function(*arguments, self._id) not in library.SUCCESS:
            self._raise_refused(name)

    def _raise_refused(self, name: str, advice: str = "switch it off and on, then start again") -> NoReturn:
        message = f"{self._model.full_name} refused {name}: {library.format_error(self._library)}"
        if self._library.dhdErrorGetLast() == library.ERROR_TIMEOUT:
            raise DeviceTimeout(f"{message}: check cable and power, then start again")
        raise DeviceError(f"{message}: {advice}")

    def _make_info(self) -> DeviceInfo:
        call, limits = self._library, self._model.limits
        name = f"{self._model.full_name}, serial {selection.read_serial(call, self._id)}"
        info = make_info(limits, name, sensed_dof=6 if call.dhdHasWrist(self._id) else 3)
        has_torque = self._word[AT.has_torque]
        return replace(info, actuated_dof=6, torque_max_nm=limits.torque_max_nm) if has_torque else info


def identify(device: SystemDevice, options: Options) -> dict[str, str | int | bool]:
    """Return the library's description of the device that the options select, or of the first; switches no force on.

    USB does not identify which of several attached devices is `device`: select one in the options.

    Raises DeviceNotFound, DeviceBusy, DevicePermission or DeviceError.
    """
    call = selection.load(options.library_file)
    number, model = selection.open_selected(call, options)
    try:
        return {
            "model": model.full_name,
            "serial": selection.read_serial(call, number),
            "system_type": call.dhdGetSystemType(number),
            "calibrated": bool(call.drdIsInitialized(number)),
        }
    finally:
        call.drdClose(number)


def open_device(options: Options, rate_hz: float) -> ForceDimension:
    """Open a device of Force Dimension.

    Raises DeviceNotFound, DeviceBusy, DevicePermission or DeviceError, each with the remedy.
    """
    return ForceDimension(options, rate_hz)
