"""Configuration of a rig's [device] with `driver = "openhaptics"`."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from softfinger.config.limits import NAME_LENGTH, Range
from softfinger.config.schema import Table, doc, sized, within

CALIBRATION_S: Final = Range(0.0, 600.0, "time to put the stylus into the inkwell")
FORCE_AGE_S: Final = Range(0.002, 0.1, "two periods of the library's thread; a force older than 0.1 s is outdated")


class Options(Table, frozen=True, kw_only=True):
    """Selection of device and library, and largest age of a force. No option makes the device move by itself."""

    library_file: Annotated[str, doc("file of libHD; absent: searched for, see docs/devices/touch.md")] | None = None
    name: (
        Annotated[
            str, sized(NAME_LENGTH, "the device's name in Touch_Setup; absent: the default device", "Left Device")
        ]
        | None
    ) = None
    model: (
        Annotated[
            Literal[
                "Touch", "Touch X", "PHANTOM Omni", "PHANTOM Desktop",
                "PHANTOM Premium 1.5 6DOF", "PHANTOM Premium 3.0 6DOF",
            ],
            doc("the only kind of device to accept", "Touch"),
        ]
        | None
    ) = None  # fmt: skip
    inkwell: Annotated[bool, doc("send no force while the stylus is in the inkwell; false: ignore the switch")] = True
    reset_encoders: Annotated[
        bool, doc("if the encoders have no zeros, use the position DURING OPENING as the reset position")
    ] = False
    calibration_wait_s: Annotated[
        float, within(CALIBRATION_S, "time limit for placing the stylus in the inkwell during opening", 20.0)
    ] = 20.0
    force_age_max_s: Annotated[
        float, within(FORCE_AGE_S, "age above which the library's thread replaces a force by zero", 0.005)
    ] = 0.005
