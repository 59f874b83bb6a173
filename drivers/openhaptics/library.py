"""The maker's library: places to search, used functions with their prototypes, texts of its errors, device limits.

libHD is part of OpenHaptics. It is proprietary and not shipped; nothing here needs it until a device is opened.

Limits: from CHAI3D's driver for the name. It lacks the Touch X, which is assumed to have the limits of its predecessor,
the Desktop. The device itself may report a lower force (`HD_NOMINAL_MAX_FORCE`); the lower one applies.
"""

from __future__ import annotations

import ctypes
import platform
from ctypes import POINTER, c_char_p, c_double, c_int, c_int32, c_ubyte, c_uint32, c_ulong, c_ushort, c_void_p
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.drivers.base import ModelLimits
from softfinger.drivers.system import makers_library
from softfinger.drivers.system.makers_library import MakersLibrary

NAME: Final = "3D Systems' library"
DOWNLOAD: Final = "https://support.3dsystems.com (Touch device driver, and OpenHaptics for Linux developer edition)"
REMEDY: Final = f'library_file = "/path/to/libHD.so" under [device] of the rig   # from {DOWNLOAD}'
FOLDERS: Final = (Path("/usr/lib"), Path("/usr/lib64"), Path("/usr/lib/x86_64-linux-gnu"), Path("/usr/local/lib"))
SONAMES: Final = ("libHD.so", "libHD.so.3.4")
"""Names to try last, with the loader."""

INVALID_HANDLE: Final = 0xFFFFFFFF
PRIORITY_MAX: Final = 65535

# Parameters.
CURRENT_BUTTONS: Final = 0x2000
CURRENT_INKWELL_SWITCH: Final = 0x2002
CURRENT_POSITION: Final = 0x2050
CURRENT_TRANSFORM: Final = 0x2052
DEVICE_MODEL_TYPE: Final = 0x2501
DEVICE_SERIAL_NUMBER: Final = 0x2504
USABLE_WORKSPACE_DIMENSIONS: Final = 0x2551
OUTPUT_DOF: Final = 0x2554
CALIBRATION_STYLE: Final = 0x2555
NOMINAL_MAX_FORCE: Final = 0x2603
MOTOR_TEMPERATURE: Final = 0x2605
CURRENT_FORCE: Final = 0x2700
CURRENT_TORQUE: Final = 0x2701
FORCE_OUTPUT: Final = 0x4000

CALIBRATED: Final = 0x5000
NEEDS_UPDATE: Final = 0x5001
NEEDS_MANUAL_INPUT: Final = 0x5002

ENCODER_RESET: Final = 1
AUTO: Final = 2
INKWELL: Final = 4

# Errors.
INVALID_ENUM: Final = 0x0100
INVALID_INPUT_TYPE: Final = 0x0103
BAD_HANDLE: Final = 0x0104
WARM_MOTORS: Final = 0x0200
FORCE_ERROR: Final = 0x0204
DEVICE_FAULT: Final = 0x0300
ALREADY_INITIATED: Final = 0x0301
COMM_ERROR: Final = 0x0302
COMM_CONFIG_ERROR: Final = 0x0303
INVALID_LICENSE: Final = 0x0600

ERRORS: Final = {
    INVALID_ENUM: "it does not support a parameter",
    0x0101: "it refuses a value",
    0x0102: "it cannot do this now",
    INVALID_INPUT_TYPE: "it does not support this type of a parameter",
    BAD_HANDLE: "it no longer knows the device",
    WARM_MOTORS: "the motors are too warm",
    0x0201: "the force exceeded the maximum of the device",
    0x0202: "the force changed faster than the device allows",
    0x0203: "the handle was faster than the device allows",
    FORCE_ERROR: "the motors do not exert the force",
    DEVICE_FAULT: "the device has a fault",
    ALREADY_INITIATED: "the device is already in use",
    COMM_ERROR: "the device does not answer",
    COMM_CONFIG_ERROR: "the device's connection is not set up",
    0x0304: "its clock has failed",
    0x0400: "a frame was started inside a frame",
    0x0401: "a frame was ended without a start",
    0x0402: "a state was requested outside of a frame, or in a nested one",
    0x0500: "it does not support a priority",
    0x0501: "its scheduler is full",
    INVALID_LICENSE: "it has no licence",
}
"""Texts for the maker's error codes."""


class ErrorInfo(ctypes.Structure):
    """HDErrorInfo, which hdGetError returns by value: code, the device's code, and the device."""

    _fields_ = (("code", c_uint32), ("internal", c_int32), ("device", c_uint32))


class Error(NamedTuple):
    """Error from the library's stack."""

    code: int
    internal: int
    text: str

    def __str__(self) -> str:
        return self.text


_ENUM: Final = c_uint32
_HANDLE: Final = c_uint32

PROTOTYPES: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "hdInitDevice": (_HANDLE, (c_char_p,)),
    "hdDisableDevice": (None, (_HANDLE,)),
    "hdMakeCurrentDevice": (None, (_HANDLE,)),
    "hdBeginFrame": (None, (_HANDLE,)),
    "hdEndFrame": (None, (_HANDLE,)),
    "hdEnable": (None, (_ENUM,)),
    "hdDisable": (None, (_ENUM,)),
    "hdIsEnabled": (c_ubyte, (_ENUM,)),
    "hdGetDoublev": (None, (_ENUM, POINTER(c_double))),
    "hdGetIntegerv": (None, (_ENUM, POINTER(c_int))),
    "hdGetBooleanv": (None, (_ENUM, POINTER(c_ubyte))),
    "hdGetString": (c_char_p, (_ENUM,)),
    "hdSetDoublev": (None, (_ENUM, POINTER(c_double))),
    "hdGetError": (ErrorInfo, ()),
    "hdGetErrorString": (c_char_p, (c_uint32,)),
    "hdCheckCalibration": (_ENUM, ()),
    "hdUpdateCalibration": (None, (_ENUM,)),
    "hdStartScheduler": (None, ()),
    "hdStopScheduler": (None, ()),
    "hdScheduleAsynchronous": (c_ulong, (c_void_p, c_void_p, c_ushort)),
    "hdUnschedule": (None, (c_ulong,)),
}
"""Result and parameters of every function used."""

ERRORS_MAX: Final = 64
"""Maximum number of errors removed from the stack at once: the library may add one for each failed call of a frame."""


LIBRARY: Final = MakersLibrary(
    name=f"{NAME} libHD",
    sonames=SONAMES,
    prototypes=PROTOTYPES,
    advice=f"install the Touch driver and OpenHaptics ({DOWNLOAD}), or set `library_file` in [device]",
    needs=f"it exists for x86_64 only (this is {platform.machine()}) and requires libPhantomIOLib42.so of the "
    "Touch driver",
    version=f"OpenHaptics 3.4, {DOWNLOAD}",
)


def load(file: str | None) -> ctypes.CDLL:
    return makers_library.load(LIBRARY, file, [folder / "libHD.so*" for folder in FOLDERS])


def pop_errors(library: ctypes.CDLL) -> list[Error]:
    """Remove all errors from the library's stack and return them, oldest first."""
    errors: list[Error] = []
    for _ in range(ERRORS_MAX):
        error = library.hdGetError()
        if error.code == 0:
            break
        errors.append(Error(error.code, error.internal, format_error(library, error.code, error.internal)))
    return errors[::-1]


def format_error(library: ctypes.CDLL, code: int, internal: int) -> str:
    """Return an error as text: this program's text, the library's text, and its numbers."""
    words = (library.hdGetErrorString(code) or b"").decode(errors="replace")
    known_text = ERRORS.get(code)
    detail = f", '{words}'" if words else ""
    return f"{known_text or 'an unknown error'} (error 0x{code:04x}{detail}, device code {internal})"


TOUCH: Final = ModelLimits(3.3, 0.0, 400.0, 4.0)
DESKTOP: Final = ModelLimits(7.9, 0.0, 1000.0, 5.0)

MODELS: Final = {
    "Touch": TOUCH,
    "Touch X": DESKTOP,
    "PHANTOM Omni": ModelLimits(3.3, 0.0, 700.0, 5.0),
    "PHANTOM Desktop": DESKTOP,
    "PHANTOM Premium 1.5 6DOF": ModelLimits(8.5, 0.188, 800.0, 5.0),
    "PHANTOM Premium 3.0 6DOF": ModelLimits(22.0, 0.188, 1000.0, 5.0),
}
"""Limits by `HD_DEVICE_MODEL_TYPE`."""

UNKNOWN: Final = TOUCH
"""Limits for unlisted names: the lowest of all, without torque."""

WORKSPACE_MM: Final = ((-80.0, -60.0, -35.0), (80.0, 60.0, 35.0))
"""Workspace of a Touch according to its maker, library's frame: for devices that report no usable one."""
