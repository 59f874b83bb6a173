"""Configuration of a rig's [device] with `driver = "forcedimension"`."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from softfinger.config.limits import Range
from softfinger.config.schema import Table, doc, within

WATCHDOG_UNIT_S: Final = 125e-6
"""Unit of the library's watchdog, which it stores in one byte."""

WATCHDOG_S: Final = Range(0.0, 255 * WATCHDOG_UNIT_S, "the library stores one byte in units of 125 us; 0: none")
NUMBER: Final = Range(0, 126, "the library counts its devices in a char")
SERIAL: Final = Range(0, 65535, "the library returns 16 bits")
VELOCITY_THRESHOLD: Final = Range(0, 2**32 - 1, "the library accepts 32 bits; the unit is the vendor's")
STATUS_S: Final = Range(0.001, 1.0, "polled at most every tick; a disabled force must be detected within a second")


class Options(Table, frozen=True, kw_only=True):
    """Selection of device and library, and permitted operations. Options that move the device are off by default."""

    library_file: (
        Annotated[str, doc("file of libdrd; default: searched for, see docs/devices/forcedimension.md")] | None
    ) = None
    model: (
        Annotated[
            Literal[
                "omega.3", "omega.6", "omega.7", "delta.3",
                "sigma.3", "sigma.6", "sigma.7", "lambda.3", "lambda.6", "lambda.7",
            ],
            doc("the only kind of device to accept", "omega.6"),
        ]
        | None
    ) = None  # fmt: skip
    serial: Annotated[int, within(SERIAL, "serial number of the only device to accept")] | None = None
    number: Annotated[int, within(NUMBER, "index of the device in the library, from 0", 0)] | None = None
    calibrate: Annotated[bool, doc("calibrate the device if necessary: IT MOVES BY ITSELF")] = False
    gravity_compensation: Annotated[
        bool, doc("let the library compensate the weight of the handle, in addition to the force; the guard ignores it")
    ] = False
    brakes: Annotated[bool, doc("brake the handle while the force is off; false: the handle falls")] = True
    watchdog_s: Annotated[
        float,
        within(
            WATCHDOG_S,
            "time without a force after which the device disables its force, at least two ticks; 0: never",
            0.03,
        ),
    ] = 0.03
    velocity_threshold: (
        Annotated[
            int,
            within(
                VELOCITY_THRESHOLD,
                "speed above which the device disables its force, in the maker's unit; default: unchanged",
            ),
        ]
        | None
    ) = None
    status_period_s: Annotated[
        float, within(STATUS_S, "period of the status requests that detect a disabled force", 0.05)
    ] = 0.05
