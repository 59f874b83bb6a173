"""A device of Force Dimension, opened through the maker's library.

The order of opening is the maker's: open, calibrate if that is needed and allowed, end the library's own regulation,
settings, force on. Whatever fails on the way, the device is stopped and closed again.
"""

from __future__ import annotations

import ctypes
import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NoReturn

import numpy as np

from softfinger.config.errors import (
    DeviceBusy,
    DeviceError,
    DeviceNotFound,
    DevicePermission,
    DeviceTimeout,
)
from softfinger.drivers.base import Device, DeviceInfo, DeviceIO
from softfinger.drivers.discovery import Attached
from softfinger.drivers.forcedimension import exchange, library, usb
from softfinger.drivers.forcedimension.models import MODELS, Model
from softfinger.drivers.forcedimension.options import WATCHDOG_UNIT_S, Options

log: Final = logging.getLogger(__name__)

TORQUE_MAX_NM: Final = 1e2
"""Where no motor turns the handle, torque is taken and not sent: it belongs to the contact and to telemetry."""

ZERO_TRIES: Final = 20
LOCK_WAIT_S: Final = 0.1
"""How long `stop` waits for an exchange under way; one that takes longer hangs, and the device is stopped over it."""

HANG_WAIT_S: Final = 0.3
"""How long a call over a hanging one is waited for: the library may let it wait too."""

LOOP_CALLS: Final = {
    exchange.GET_FRAME: "dhdGetPositionAndOrientationFrame",
    exchange.GET_BUTTONS: "dhdGetButtonMask",
    exchange.GET_GRIPPER: "dhdGetGripperAngleRad",
    exchange.GET_STATUS: "dhdGetStatus",
    exchange.GET_ERROR: "dhdErrorGetLast",
    exchange.SET_WRENCH: "dhdSetForceAndTorqueAndGripperForce",
}


COUNTERS: Final = {
    "reads": exchange.READS,
    "reads_guarded": exchange.READS_GUARDED,
    "writes": exchange.WRITES,
    "writes_guarded": exchange.WRITES_GUARDED,
    "saturated": exchange.SATURATED,
}


class ForceDimension(Device):
    """An open device with its force on. `stop` takes the force off for good: to go on, open it again."""

    def __init__(self, options: Options, rate_hz: float) -> None:
        _check_watchdog(options.watchdog_s, rate_hz)
        self._library = _load(options.library_file)
        self._options = options
        self._word = np.zeros(exchange.WORDS, dtype=np.int64)
        self._word[exchange.CAUSE] = -1
        self._id, self._model = _find(self._library, options)
        try:
            self._set_up(rate_hz)
            self.info = self._info()
        except BaseException:
            self.close()
            raise

    def io(self) -> DeviceIO:
        return DeviceIO(exchange.read.address, exchange.write.address, self._word.ctypes.data)

    def stop(self) -> None:
        if not self._word[exchange.ARMED]:
            return
        self._word[exchange.ARMED] = 0  # before the lock: no force of the loop's follows the zero
        self._alone(self._take_force_off)

    def close(self) -> None:
        self.stop()
        if not self._word[exchange.OPEN]:
            return
        self._word[exchange.OPEN] = 0
        self._alone(lambda: self._library.drdClose(self._id))
        reads, repeated, writes, held, cut = self.counts().values()
        if repeated or held or cut:
            log.info(
                "%s: of %d reads %d repeated the last reading; of %d forces %d were held back, %d at the motors' limit",
                self._model.full_name, reads, repeated, writes, held, cut,
            )  # fmt: skip

    def reason(self) -> str:
        said = []
        if self._word[exchange.ERROR]:
            number = int(self._word[exchange.ERROR])
            text = self._library.dhdErrorGetStr(number) or b""
            said.append(f"the library's error {number}, {text.decode(errors='replace')}")
        cause = int(self._word[exchange.CAUSE])
        if cause >= 0:
            said.append(library.FORCE_OFF_CAUSES.get(cause, f"the device gives no cause ({cause})"))
        if self._word[exchange.FAULTY]:
            said.append(f"its error word is {self._word[exchange.FAULTY]}")
        return "; ".join(said)

    def counts(self) -> dict[str, int]:
        return {name: int(self._word[at]) for name, at in COUNTERS.items()}

    def _take_force_off(self) -> None:
        call = self._library
        for _ in range(ZERO_TRIES):
            # 1, TIMEGUARD, may mean that it was held back; -1 that the device is gone.
            if call.dhdSetForceAndTorqueAndGripperForce(*(0.0,) * 7, self._id) in (0, 2):
                break
            time.sleep(0.001)
        call.dhdEnableForce(0, self._id)
        call.dhdStop(self._id)
        if self._options.brakes:
            call.dhdSetBrakes(1, self._id)

    def _alone(self, work: Callable[[], object]) -> None:
        """Run `work` while the loop is not in the library; where a call of the loop hangs, over it."""
        block = self._word.ctypes.data
        deadline = time.monotonic() + LOCK_WAIT_S
        while not exchange.lock.ctypes(block):
            if time.monotonic() > deadline:
                break
            time.sleep(0.0001)
        else:
            try:
                work()
            finally:
                exchange.unlock.ctypes(block)
            return
        over = threading.Thread(target=work, name="forcedimension stop", daemon=True)
        over.start()
        over.join(HANG_WAIT_S)
        if over.is_alive():
            log.error(
                "%s: the library hangs and lets nothing past; what is left is the device's own watchdog: switch it off",
                self._model.full_name,
            )

    def _set_up(self, rate_hz: float) -> None:
        call, options, word = self._library, self._options, self._word
        word[exchange.ID] = self._id
        word[exchange.OPEN] = 1
        word[exchange.STARTED_NS] = time.monotonic_ns()
        word[exchange.STATUS_EVERY] = max(1, round(options.status_period_s * rate_hz))
        word[exchange.HAS_GRIPPER] = call.dhdHasGripper(self._id)
        word[exchange.TURNS] = call.dhdHasActiveWrist(self._id)
        for place, name in LOOP_CALLS.items():
            word[place] = library.address(call, name)
        self._calibrate()
        self._do("drdStop", call.drdStop, True)  # ends the library's regulation, leaves the force to us
        self._do("dhdSetGravityCompensation", call.dhdSetGravityCompensation, int(options.gravity_compensation))
        self._do("dhdSetMaxForce", call.dhdSetMaxForce, self._model.limits.force_max_n)
        self._guard_by_device()
        if options.brakes:
            self._do("dhdSetBrakes", call.dhdSetBrakes, 0)
        word[exchange.ARMED] = 1  # from here on a failure has to take the force off
        self._do("dhdEnableForce", call.dhdEnableForce, 1)
        self._do("dhdSetForceAndTorqueAndGripperForce", call.dhdSetForceAndTorqueAndGripperForce, *(0.0,) * 7)

    def _calibrate(self) -> None:
        if self._library.drdIsInitialized(self._id):
            return
        if not self._options.calibrate:
            raise DeviceError(
                f"{self._model.full_name} is not calibrated: calibrate it with the maker's tools, or set "
                "calibrate = true in the rig's [device] table; the device then MOVES BY ITSELF: keep clear of it"
            )
        log.warning("%s calibrates itself now: it moves, keep clear", self._model.full_name)
        self._do("drdAutoInit", self._library.drdAutoInit)

    def _guard_by_device(self) -> None:
        """Watchdog and velocity threshold, which the library lets only experts set."""
        call, options = self._library, self._options
        if call.dhdEnableExpertMode() < 0:
            self._refused("dhdEnableExpertMode")
        try:
            self._do("dhdSetWatchdog", call.dhdSetWatchdog, round(options.watchdog_s / WATCHDOG_UNIT_S))
            if options.velocity_threshold is not None:
                self._do("dhdSetVelocityThreshold", call.dhdSetVelocityThreshold, options.velocity_threshold)
        finally:
            call.dhdDisableExpertMode()

    def _do(self, name: str, function: Callable[..., int], *arguments: Any) -> None:
        if function(*arguments, self._id) not in library.SUCCESS:
            self._refused(name)

    def _refused(self, name: str) -> NoReturn:
        what = f"{self._model.full_name} refused {name}: {library.error_text(self._library)}"
        if self._library.dhdErrorGetLast() == library.ERROR_TIMEOUT:
            raise DeviceTimeout(f"{what}: check cable and power, then start again")
        raise DeviceError(f"{what}: switch it off and on, then start again")

    def _info(self) -> DeviceInfo:
        call, limits = self._library, self._model.limits
        wrist, turns = call.dhdHasWrist(self._id), bool(self._word[exchange.TURNS])
        reach = limits.workspace_radius_m
        return DeviceInfo(
            name=f"{self._model.full_name}, serial {_serial(call, self._id)}",
            sensed_dof=6 if wrist else 3,
            actuated_dof=6 if turns else 3,
            force_max_n=limits.force_max_n,
            torque_max_nm=limits.torque_max_nm if turns else TORQUE_MAX_NM,
            stiffness_max_n_per_m=limits.stiffness_max_n_per_m,
            damping_max_ns_per_m=limits.damping_max_ns_per_m,
            workspace_min_m=(-reach, -reach, -reach),
            workspace_max_m=(reach, reach, reach),
        )


def identify(device: Attached, options: Options) -> dict[str, str | int | bool]:
    """What the library says of the device that the options name, or of the first that opens; no force is switched on.

    Of several that are attached, nothing says which of them is `device` on the bus: name one in the options.

    Raises DeviceNotFound, DeviceBusy, DevicePermission or DeviceError.
    """
    call = _load(options.library_file)
    number, model = _find(call, options)
    try:
        return {
            "model": model.full_name,
            "serial": _serial(call, number),
            "system_type": call.dhdGetSystemType(number),
            "calibrated": bool(call.drdIsInitialized(number)),
        }
    finally:
        call.drdClose(number)


def open_device(options: Options, rate_hz: float) -> ForceDimension:
    """Open a device of Force Dimension.

    Raises DeviceNotFound, DeviceBusy, DevicePermission or DeviceError, each with what to do.
    """
    return ForceDimension(options, rate_hz)


def _find(call: ctypes.CDLL, options: Options) -> tuple[int, Model]:
    """Open the device that the options name, or the first that opens; its ID and what it is."""
    count = call.dhdGetDeviceCount()
    if count <= 0:
        _nothing_found(call, count)
    numbers = range(count) if options.number is None else [options.number]
    passed: list[str] = []
    failed: DeviceError | None = None
    for number in numbers:
        device = call.drdOpenID(number)
        if device < 0:
            failed = failed or _not_opened(call, number)
            continue
        try:
            kind, serial = call.dhdGetSystemType(device), _serial(call, device)
            model = MODELS.get(kind)
            wanted = options.serial in (None, serial) and (model is None or options.model in (None, model.name))
            if wanted and model is not None:
                return device, model
        except BaseException:
            call.drdClose(device)
            raise
        passed.append(f"{model.full_name if model else f'a device of unknown type {kind}'}, serial {serial}")
        call.drdClose(device)
    if failed is not None:
        raise failed
    wishes = {"model": options.model, "serial": options.serial, "number": options.number}
    asked = ", ".join(f"{key} = {value}" for key, value in wishes.items() if value is not None)
    raise DeviceNotFound(
        f"no device fits {asked or 'this driver'}: attached are {'; '.join(passed)}: "
        "change [device] in the rig, or attach the device"
    )


def _load(named: str | None) -> ctypes.CDLL:
    """The library; without it, the error also names what is attached, since USB shows that much."""
    try:
        loaded = library.load(named)
    except DeviceNotFound as error:
        seen = [str(device) if device.permitted else usb.how_to_permit(device) for device in usb.attached()]
        attached = f". Attached over USB: {'; '.join(seen)}" if seen else ""
        raise DeviceNotFound(f"{error}{attached}") from None
    parts = [ctypes.c_int() for _ in range(4)]
    loaded.dhdGetSDKVersion(*map(ctypes.byref, parts))
    log.info("Force Dimension's library, version %s", ".".join(str(part.value) for part in parts))
    return loaded


def _serial(call: ctypes.CDLL, device: int) -> int:
    serial = ctypes.c_ushort()
    if call.dhdGetSerialNumber(ctypes.byref(serial), device) < 0:
        raise DeviceError(f"serial number: {library.error_text(call)}: switch the device off and on, then start again")
    return serial.value


def _nothing_found(call: ctypes.CDLL, count: int) -> NoReturn:
    seen = usb.attached()
    for device in seen:
        if not device.permitted:
            raise DevicePermission(usb.how_to_permit(device))
    if count < 0:
        raise DeviceError(f"the devices cannot be counted: {library.error_text(call)}: check cable and power")
    if seen:
        raise DeviceError(f"the library does not see {seen[0]}: switch the device on, or off and on again")
    raise DeviceNotFound("no device of Force Dimension is attached: check cable and power (USB vendor 1451)")


def _not_opened(call: ctypes.CDLL, number: int) -> DeviceError:
    code, text = call.dhdErrorGetLast(), library.error_text(call)
    if code in (library.ERROR_BUSY, library.ERROR_IN_USE):
        by = ", ".join(name for device in usb.attached() for name in usb.holders(device)) or "another process"
        return DeviceBusy(f"device {number} is held by {by} ({text}): end that, then start again")
    if code == library.ERROR_NO_DEVICE:
        return DeviceNotFound(f"device {number} is not there any more ({text}): check cable and power")
    if code in (library.ERROR_COM, library.ERROR_NO_DRIVER):
        for device in usb.attached():
            if not device.permitted:
                return DevicePermission(usb.how_to_permit(device))
    if code == library.ERROR_TIMEOUT:
        return DeviceTimeout(f"device {number} did not answer when opened ({text}): switch it off and on")
    return DeviceError(f"device {number} cannot be opened: {text}: check cable and power, then start again")


def _check_watchdog(watchdog_s: float, rate_hz: float) -> None:
    if watchdog_s == 0.0 or watchdog_s >= 2.0 / rate_hz:
        return
    least = math.ceil(2e3 / rate_hz * 1e3) / 1e6
    raise DeviceError(
        f"watchdog_s = {watchdog_s:g} is shorter than two ticks at {rate_hz:g} Hz: "
        f"give at least {least:g}, or 0 for none"
    )
