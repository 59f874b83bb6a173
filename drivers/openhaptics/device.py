"""Device of 3D Systems, opened through the maker's library.

The order of opening follows the maker's programs: initialise, start the library's thread, calibrate, schedule the
callback. The force is off until `arm`; then the callback sends it (`exchange`). The device never moves by itself: for
calibration, the user moves it to a known position.
"""

from __future__ import annotations

import ctypes
import logging
import math
import threading
import time
from collections.abc import Callable
from itertools import chain
from typing import Final, NoReturn

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DevicePermission, DeviceTimeout
from softfinger.drivers import open_devices
from softfinger.drivers.base import TORQUE_MAX_NM, DeviceInfo
from softfinger.drivers.block import Block, BlockDevice
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.openhaptics import exchange, library
from softfinger.drivers.openhaptics.block import AT
from softfinger.drivers.openhaptics.library import MODELS, UNKNOWN, WORKSPACE_MM
from softfinger.drivers.openhaptics.options import Options
from softfinger.drivers.openhaptics.scheduler import Scheduler, get_scheduler, wait_until
from softfinger.drivers.system import discovery, rules
from softfinger.drivers.system.claims import find_claims
from softfinger.drivers.system.discovery import SystemDevice

log: Final = logging.getLogger(__name__)

FIRST_FRAMES_S: Final = 2.0
"""Maximum wait of opening for the library's thread."""
ARM_S: Final = 1.0
STOP_S: Final = 0.1
"""Maximum wait of `stop` for a frame that sends zero; without one the library hangs, and is called in parallel."""
HANG_S: Final = 0.3
RELEASE_S: Final = 1.0
POLL_S: Final = 0.02
WARM: Final = 800
"""Of 1000: a warning about the motors starts here, and ends at COOL."""
COOL: Final = 700
FULL_DOF: Final = 6

ZERO: Final = (ctypes.c_double * 3)()


class OpenHaptics(BlockDevice):
    """Open device with its force off until `arm`. `stop` is final: to resume, open the device again.

    calibrates  False: open a device that is not calibrated too, to identify it
    """

    _functions = exchange.read, exchange.write

    def __init__(self, options: Options, calibrates: bool = True) -> None:
        self._library = library.load(options.library_file)
        self._options = options
        self._scheduler: Scheduler = get_scheduler(self._library)
        self._block = Block(AT)
        self._word = self._block.word
        self._ending = threading.Lock()
        self._warm = False
        with self._scheduler.pause():
            self._device = _open_library_device(self._library, options.name)
            # before the thread runs again, because the current device may be the same for all threads
            with undo_on_error(lambda: self._library.hdDisableDevice(self._device)):
                self.model, self.serial, self._style = self._read_identity()
                self.info = self._make_info()
        with undo_on_error(self._release):
            self.calibrated = self._calibrate(calibrates)
            self._set_up()

    def arm(self) -> None:
        word = self._word
        if word[AT.stopped]:
            return
        word[AT.armed] = 1
        if (
            wait_until(ARM_S, lambda: word[AT.output] == 1 or word[AT.status] < 0 or word[AT.stopped])
            and not word[AT.status]
        ):
            return
        word[AT.armed] = 0
        why = self.reason() or f"no frame of the library switched the motors on within {ARM_S:g} s"
        raise DeviceError(f"{self.info.name}: the force cannot be switched on: {why}: {_RETRY_REMEDY}")

    def stop(self) -> None:
        word = self._word
        word[AT.stopped] = 1
        word[AT.armed] = 0
        if not word[AT.open]:
            return
        with self._ending:
            if (
                not word[AT.has_sent_zero]
                and not wait_until(STOP_S, lambda: word[AT.has_sent_zero])
                and not self._zero_failure
            ):
                self._zero_failure = self._run_with_timeout(self._send_zero, HANG_S)

    def close(self) -> None:
        self.stop()
        if not self._word[AT.open]:
            return
        with self._ending:
            if self._word[AT.open]:
                self._run_with_timeout(self._release, RELEASE_S)
                self._word[AT.open] = 0
                counted = self.counts()
                log.info("%s: %s", self.info.name, ", ".join(f"{name} {value}" for name, value in counted.items()))

    def reason(self) -> str:
        if not self._word[AT.error]:
            return ""
        return library.format_error(self._library, int(self._word[AT.error]), int(self._word[AT.internal]))

    def warning(self) -> str:
        self._warm = int(self._word[AT.temperature]) >= (COOL if self._warm else WARM)
        messages = []
        if self._warm:
            messages.append("the motors are hot: pause, otherwise the device disables the force")
        if self._word[AT.docked]:
            messages.append("the stylus is in the inkwell, so no force is sent (inkwell = false ignores the switch)")
        if self._word[AT.late]:
            messages.append(
                f"frames of the library are more than force_age_max_s = {self._options.force_age_max_s:g} s apart, so "
                "there is no force: end other programs, try another USB port"
            )
        return "; ".join(messages)

    # --- opening --------------------------------------------------------------------------------

    def _read_identity(self) -> tuple[str, str, int]:
        """Return model, serial number and calibration styles; raises DeviceNotFound if the rig has another model."""
        call = self._library
        model = (call.hdGetString(library.DEVICE_MODEL_TYPE) or b"").decode(errors="replace")
        serial = (call.hdGetString(library.DEVICE_SERIAL_NUMBER) or b"").decode(errors="replace")
        style = self._read_integer(library.CALIBRATION_STYLE)
        library.pop_errors(call)  # a missing property shows in its value
        if self._options.model not in (None, model):
            raise DeviceNotFound(
                f"no device matches model = {self._options.model}: it is a {model}, serial {serial}: change [device] "
                "in the rig, or set `name` to another device of Touch_Setup"
            )
        if model not in MODELS:
            log.warning(
                "%s: its limits are unknown, so the lowest of all models apply: %g N, no torque", model, UNKNOWN[0]
            )
        return model, serial, style

    def _make_info(self) -> DeviceInfo:
        limits = MODELS.get(self.model, UNKNOWN)
        has_torque = self._read_integer(library.OUTPUT_DOF) == FULL_DOF and limits.torque_max_nm > 0.0
        self._word[AT.has_torque] = has_torque
        nominal_force = self._read_doubles(library.NOMINAL_MAX_FORCE, 1)[0]
        corners = self._read_doubles(library.USABLE_WORKSPACE_DIMENSIONS, FULL_DOF)  # in the library's frame
        if not all(-1e4 < a < b < 1e4 for a, b in zip(corners[:3], corners[3:], strict=True)):
            corners = [*chain(*WORKSPACE_MM)]
        x0, y0, z0, x1, y1, z1 = corners
        library.pop_errors(self._library)
        return DeviceInfo(
            name=f"{self.model or 'device of 3D Systems'}, serial {self.serial or 'unknown'}",
            sensed_dof=FULL_DOF,
            actuated_dof=FULL_DOF if has_torque else 3,
            force_max_n=min(limits.force_max_n, nominal_force)
            if math.isfinite(nominal_force) and nominal_force > 0.0
            else limits.force_max_n,
            torque_max_nm=limits.torque_max_nm if has_torque else TORQUE_MAX_NM,
            stiffness_max_n_per_m=limits.stiffness_max_n_per_m,
            damping_max_ns_per_m=limits.damping_max_ns_per_m,
            workspace_min_m=(x0 * 1e-3, -z1 * 1e-3, y0 * 1e-3),
            workspace_max_m=(x1 * 1e-3, -z0 * 1e-3, y1 * 1e-3),
        )

    def _calibrate(self, is_needed: bool) -> bool:
        """Calibrate the device in its best style: automatic, by the inkwell, or at the present position."""
        call = self._library
        best = next(
            (style for style in (library.AUTO, library.INKWELL, library.ENCODER_RESET) if self._style & style), 0
        )
        until, was_asked = time.monotonic() + self._options.calibration_wait_s, False
        while is_needed:
            call.hdMakeCurrentDevice(self._device)
            state = call.hdCheckCalibration()
            if state == library.NEEDS_UPDATE and best:
                if best == library.ENCODER_RESET and not self._options.reset_encoders:
                    break
                call.hdUpdateCalibration(best)
                state = call.hdCheckCalibration()
            self._raise_errors("calibration")
            if state == library.CALIBRATED:
                return True
            if state == library.NEEDS_MANUAL_INPUT and not was_asked:
                was_asked = True
                log.warning("%s: %s", self.info.name, _CALIBRATION_REMEDIES[best])
            if time.monotonic() > until:
                break
            time.sleep(POLL_S)
        if not is_needed:
            return bool(call.hdCheckCalibration() == library.CALIBRATED)
        raise DeviceError(f"{self.info.name} is not calibrated: {_CALIBRATION_REMEDIES[best]}, then start again")

    def _set_up(self) -> None:
        call, options, word = self._library, self._options, self._word
        self._block.set_functions(call)
        word[AT.device] = self._device
        word[AT.age_max] = round(options.force_age_max_s * 1e9)
        word[AT.started_at] = word[AT.read_at] = time.monotonic_ns()
        word[AT.has_inkwell] = options.inkwell and bool(self._style & library.INKWELL)
        word[AT.switch] = 1
        word[AT.has_temperature] = 1
        word[AT.output] = -1  # so that an output that a killed program left on is switched off
        word[AT.open] = 1
        self._scheduler.add(self._block)
        self._raise_errors("hdScheduleAsynchronous")
        if not wait_until(FIRST_FRAMES_S, lambda: word[AT.frames] > exchange.PROBES or word[AT.status] < 0):
            raise DeviceTimeout(
                f"{self.info.name}: the library's thread did not start within {FIRST_FRAMES_S:g} s: {_RETRY_REMEDY}"
            )
        if word[AT.status] < 0:
            raise DeviceError(f"{self.info.name} returns no pose: {self.reason()}: {_RETRY_REMEDY}")

    def _read_integer(self, parameter: int) -> int:
        value = ctypes.c_int()
        self._library.hdMakeCurrentDevice(self._device)
        self._library.hdGetIntegerv(parameter, ctypes.byref(value))
        return value.value

    def _read_doubles(self, parameter: int, count: int) -> list[float]:
        values = (ctypes.c_double * 16)(*[math.nan] * 16)
        self._library.hdMakeCurrentDevice(self._device)
        self._library.hdGetDoublev(parameter, values)
        return list(values)[:count]

    def _raise_errors(self, action: str) -> None:
        if errors := library.pop_errors(self._library):
            raise DeviceError(f"{action} failed: {'; '.join(map(str, errors))}: {_RETRY_REMEDY}")

    # --- ending ---------------------------------------------------------------------------------

    def _send_zero(self) -> str:
        """Send zero and switch the motors off from this thread, because the library's thread does not call any more.

        Returns why the motors may still be on; empty if the library reports them off.
        """
        call = self._library
        call.hdBeginFrame(self._device)
        call.hdSetDoublev(library.CURRENT_FORCE, ZERO)
        if self._word[AT.has_torque]:
            call.hdSetDoublev(library.CURRENT_TORQUE, ZERO)
        call.hdDisable(library.FORCE_OUTPUT)
        call.hdEndFrame(self._device)
        on, errors = call.hdIsEnabled(library.FORCE_OUTPUT), library.pop_errors(call)
        return ("; ".join(map(str, errors)) or "the motors stay on") if on else ""

    def _release(self) -> str:
        self._scheduler.remove(self._block)
        self._library.hdDisableDevice(self._device)
        library.pop_errors(self._library)  # so that they are not reported as errors of the next device
        return ""

    def _run_with_timeout(self, work: Callable[[], str], seconds: float) -> str:
        """Run `work`, which may hang in the library, in a thread; return its failure, or that of a timeout."""
        failed = ["the library hangs"]

        def run(_: object) -> None:
            failed[0] = work()

        open_devices.call_all(run, [self], seconds)
        if failed[0]:
            log.error("%s may still exert force: %s: switch the device off", self.info.name, failed[0])
        return failed[0]


_RETRY_REMEDY: Final = "check cable and power, run the maker's Touch_Diagnostic, then start again"
_CALIBRATION_REMEDIES: Final = {
    0: "it cannot be calibrated by a program: calibrate it with the maker's Touch_Setup or Touch_Diagnostic",
    library.AUTO: "move the handle through its full range",
    library.INKWELL: "put the stylus into the inkwell",
    library.ENCODER_RESET: (
        "hold the handle in its reset position, the arms at right angles, while it is opened, and set "
        "reset_encoders = true in the rig's [device] table"
    ),
}


def identify(device: SystemDevice, options: Options) -> dict[str, str | int | bool]:
    """Return the library's description of the device that the options select; no force is switched on, no calibration.

    Raises DeviceNotFound, DeviceBusy, DevicePermission or DeviceError.
    """
    with OpenHaptics(options, calibrates=False) as opened:
        return {"model": opened.model, "serial": opened.serial, "calibrated": opened.calibrated}


def open_device(options: Options, rate_hz: float) -> OpenHaptics:
    """Open a device of 3D Systems.

    Raises DeviceNotFound, DeviceBusy, DevicePermission, DeviceTimeout or DeviceError, each with the remedy.
    """
    return OpenHaptics(options)


def _open_library_device(call: ctypes.CDLL, name: str | None) -> int:
    library.pop_errors(call)  # discard earlier errors
    device = call.hdInitDevice(None if name is None else name.encode())
    errors = library.pop_errors(call)
    if device != library.INVALID_HANDLE and not errors:
        return int(device)
    if device != library.INVALID_HANDLE:
        call.hdDisableDevice(device)
    _raise_open_error(name, errors)


def _raise_open_error(name: str | None, errors: list[library.Error]) -> NoReturn:
    messages = "; ".join(map(str, errors)) or "the library gives no reason"
    subject = "the default device" if name is None else f"the device '{name}'"
    # devices with Ethernet or FireWire are not listed
    attached = [
        device
        for device in discovery.list_attached()
        if any(claim.driver == "openhaptics" for claim in find_claims(device))
    ]
    if any(error.code == library.ALREADY_INITIATED for error in errors):
        raise DeviceBusy(
            f"{subject} is in use by another program, or twice in this rig: {messages}: end the other program, then "
            "start again"
        )
    if any(error.code == library.INVALID_LICENSE for error in errors):
        raise DeviceError(f"{subject} cannot be opened: {messages}: install the developer edition's licence")
    for device in attached:
        if device.node and not discovery.is_permitted(device.node):
            permit = rules.explain_permission(device.vendor, device.product)
            raise DevicePermission(f"{device} may not be opened by this user: {permit}")
        if device.node and (holder := discovery.find_holder(device.node)) is not None:
            raise DeviceBusy(f"{device} is used by {holder}: end that process, then start again ({messages})")
    if not attached:
        raise DeviceNotFound(
            f"{subject} does not answer: {messages}: check power and cable (USB, Ethernet or FireWire; for USB `lsusb` "
            "shows 2988 or 0301:2988), and that Touch_Setup "
            f"{'has a default device' if name is None else 'has that name'} for this user ($GTDD_HOME/config, else "
            "~/.3dsystems/config)"
        )
    raise DeviceError(
        f"{subject} cannot be opened, and {attached[0]} is attached: {messages}: run Touch_Setup, then start again"
    )
