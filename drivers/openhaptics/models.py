"""Limits of each of 3D Systems' devices, by the name in its library.

Limits: from CHAI3D's driver for the name. It lacks the Touch X, which is assumed to have the limits of its predecessor,
the Desktop. The device itself may report a lower force (`HD_NOMINAL_MAX_FORCE`); the lower one applies.
"""

from __future__ import annotations

from typing import Final

from softfinger.drivers.base import ModelLimits

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
