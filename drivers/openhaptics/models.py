"""What each of 3D Systems' devices can do, by the name that its library gives it.

Limits: those that CHAI3D's driver has for the name. A Touch X, which is not there, is assumed to have those of the
Desktop that it has followed. The device itself may say less force (`HD_NOMINAL_MAX_FORCE`); the smaller counts.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Limits(NamedTuple):
    """N, N m (0: no motors turn the handle), N/m, N s/m."""

    force_max_n: float
    torque_max_nm: float
    stiffness_max_n_per_m: float
    damping_max_ns_per_m: float


TOUCH: Final = Limits(3.3, 0.0, 400.0, 4.0)
DESKTOP: Final = Limits(7.9, 0.0, 1000.0, 5.0)

MODELS: Final = {
    "Touch": TOUCH,
    "Touch X": DESKTOP,
    "PHANTOM Omni": Limits(3.3, 0.0, 700.0, 5.0),
    "PHANTOM Desktop": DESKTOP,
    "PHANTOM Premium 1.5 6DOF": Limits(8.5, 0.188, 800.0, 5.0),
    "PHANTOM Premium 3.0 6DOF": Limits(22.0, 0.188, 1000.0, 5.0),
}
"""By `HD_DEVICE_MODEL_TYPE`."""

UNKNOWN: Final = TOUCH
"""For a device of a name that is not listed: the least of any, and no torque."""

WORKSPACE_MM: Final = ((-80.0, -60.0, -35.0), (80.0, 60.0, 35.0))
"""Of a Touch, as its maker has it, in the library's frame: for a device that says nothing usable of its own."""
