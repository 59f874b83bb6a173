"""The maker's library: places to search, and used functions with their full prototypes.

libdrd contains libdhd. It is proprietary and not shipped; nothing here needs it until a device is opened.
"""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Mapping
from ctypes import POINTER, c_bool, c_byte, c_char_p, c_double, c_int, c_ubyte, c_uint, c_ushort
from pathlib import Path
from typing import Any, Final

from softfinger.config.files import find_home_folder
from softfinger.drivers.system import makers_library
from softfinger.drivers.system.makers_library import MakersLibrary

NAME: Final = "Force Dimension's library"
DOWNLOAD: Final = "https://www.forcedimension.com/software/sdk"
REMEDY: Final = f"export FDSDK=/path/to/sdk   # from {DOWNLOAD}"
SONAMES: Final = ("libdrd.so", "libdrd.so.3")
"""Names to try last, with the loader. The maker documents no file name, so folders are searched by pattern."""

SUCCESS: Final = (0, 1, 2)
"""Success; success with the last reading repeated (TIMEGUARD); success at the motors' limit (MOTOR_SATURATED)."""

ERROR_COM, ERROR_BUSY, ERROR_NO_DRIVER, ERROR_NO_DEVICE, ERROR_TIMEOUT, ERROR_IN_USE = 2, 3, 4, 5, 7, 20

FORCE_OFF_CAUSES: Final = {
    1: "the force button was pressed",
    2: "the handle was faster than the velocity threshold",
    3: "the watchdog expired without a force",
    4: "by a call of the library",
    5: "USB was disconnected",
    6: "the dead-man switch was released",
}
"""Texts by the 15th entry of the status."""

_ID: Final = c_byte  # a C char; -1 is the default device
_DOUBLE: Final = POINTER(c_double)

PROTOTYPES: Final[Mapping[str, tuple[Any, tuple[Any, ...]]]] = {
    "dhdErrorGetLast": (c_int, ()),
    "dhdErrorGetLastStr": (c_char_p, ()),
    "dhdErrorGetStr": (c_char_p, (c_int,)),
    "dhdGetSDKVersion": (None, (POINTER(c_int),) * 4),
    "dhdGetDeviceCount": (c_int, ()),
    "drdOpenID": (c_int, (_ID,)),
    "drdClose": (c_int, (_ID,)),
    "dhdGetSystemType": (c_int, (_ID,)),
    "dhdGetSerialNumber": (c_int, (POINTER(c_ushort), _ID)),
    "dhdHasWrist": (c_bool, (_ID,)),
    "dhdHasActiveWrist": (c_bool, (_ID,)),
    "dhdHasGripper": (c_bool, (_ID,)),
    "dhdIsLeftHanded": (c_bool, (_ID,)),
    "drdIsInitialized": (c_bool, (_ID,)),
    "drdAutoInit": (c_int, (_ID,)),
    "drdStop": (c_int, (c_bool, _ID)),
    "dhdEnableExpertMode": (c_int, ()),
    "dhdDisableExpertMode": (c_int, ()),
    "dhdSetWatchdog": (c_int, (c_ubyte, _ID)),
    "dhdSetVelocityThreshold": (c_int, (c_uint, _ID)),
    "dhdSetMaxForce": (c_int, (c_double, _ID)),
    "dhdSetGravityCompensation": (c_int, (c_int, _ID)),
    "dhdSetBrakes": (c_int, (c_int, _ID)),
    "dhdEnableForce": (c_int, (c_ubyte, _ID)),
    "dhdStop": (c_int, (_ID,)),
    "dhdGetStatus": (c_int, (POINTER(c_int), _ID)),
    "dhdGetPositionAndOrientationFrame": (c_int, (_DOUBLE, _DOUBLE, _DOUBLE, _DOUBLE, _ID)),
    "dhdGetPosition": (c_int, (_DOUBLE, _DOUBLE, _DOUBLE, _ID)),
    "dhdGetButtonMask": (c_uint, (_ID,)),
    "dhdGetGripperAngleRad": (c_int, (_DOUBLE, _ID)),
    "dhdSetForceAndTorqueAndGripperForce": (c_int, (*(c_double,) * 7, _ID)),
}
"""Result and parameters of every function used; double[3][3] is passed as a pointer to its first element."""


def list_patterns(environ: Mapping[str, str]) -> list[Path]:
    """Return the places to search, in order; the last part of each is a glob pattern."""
    build = Path("lib") / "release" / f"lin-{platform.machine()}-gcc" / "libdrd.so*"
    kits = [Path(environ[name]) / build for name in ("FDSDK", "FORCEDIM_SDK") if environ.get(name)]
    home = environ.get("HOME") or find_home_folder()
    user_paths = [Path(home) / ".local" / "lib" / "libdrd.so*"] if home else []
    return [*kits, *user_paths, Path("/usr/local/lib/libdrd.so*")]


LIBRARY: Final = MakersLibrary(
    name="Force Dimension's library libdrd",
    sonames=SONAMES,
    prototypes=PROTOTYPES,
    advice=f"install the maker's SDK ({DOWNLOAD}), then set FDSDK to its folder, or set `library_file` in the "
    "rig's [device] table",
    needs=f"the build for {platform.machine()} and libusb-1.0 are required",
    version=f"SDK 3.17 or a later 3.x, {DOWNLOAD}",
)


def load(file: str | None, environ: Mapping[str, str] = os.environ) -> ctypes.CDLL:
    unset = [f"${name} is not set" for name in ("FDSDK", "FORCEDIM_SDK") if not environ.get(name)]
    note = f" ({', '.join(unset)})" if unset else ""
    return makers_library.load(LIBRARY, file, list_patterns(environ), note)


def format_error(library: ctypes.CDLL) -> str:
    """Return the library's text for this thread's last error."""
    text = library.dhdErrorGetLastStr()
    number = library.dhdErrorGetLast()
    return f"{text.decode(errors='replace')} (error {number})" if text else f"error {number}"
