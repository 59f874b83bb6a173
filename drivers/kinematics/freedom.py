"""Motion and displayed force of a device with one or two degrees of freedom, in the world frame."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config.schema import DeviceConfig
from softfinger.drivers.kinematics.options import Kinematics, Paddle, Pantograph
from softfinger.drivers.mounting import Mounting
from softfinger.proxy.kernels.numerics.rotations import rotate

Array = NDArray[np.float64]


class Freedom(NamedTuple):
    """Arc or plane of the handle's motion, in the world.

    degrees  1 or 2
    axis     (3,)    of the arc, or normal of the plane
    origin   (3,) m  a point of the arc's axis, or of the plane
    middle   (3,) m  position of the handle in the middle of its range
    """

    degrees: int
    axis: Array
    origin: Array
    middle: Array

    def displayed(self, position: Array, force: Array) -> Array:
        """Return the displayed part (3,) of a force (N) at the handle's position: along the arc, or in the plane."""
        if self.degrees == 2:
            return np.asarray(force - (force @ self.axis) * self.axis)
        tangent = np.cross(self.axis, position - self.origin)
        length = float(np.linalg.norm(tangent))
        return 0.0 * force if length == 0.0 else np.asarray((force @ tangent) / length**2 * tangent)

    def words(self) -> str:
        """Return a description of the handle's motion and of the forces that are not displayed."""
        if self.degrees == 2:
            where = f"in the plane across ({_components(self.axis)}) of the world; forces out of it"
        else:
            along = np.cross(self.axis, self.middle - self.origin)
            where = f"on an arc, in its middle along ({_components(along / np.linalg.norm(along))}) of the world; "
            where += "forces across it"
        return f"{where} are shown, not displayed"


def freedom_of(kinematics: Kinematics | None, mounting: Mounting) -> Freedom | None:
    """Return the freedom of a mechanism; None if it has three degrees."""
    place, turned = mounting.frame()
    middle = np.array(place)
    if isinstance(kinematics, Pantograph):  # z = 0
        return Freedom(2, np.array(rotate(turned, (0.0, 0.0, 1.0))), middle, middle)
    if isinstance(kinematics, Paddle):  # about y, from the joint upwards
        joint = middle + np.array(rotate(turned, (0.0, 0.0, -float(kinematics.length_m))))
        return Freedom(1, np.array(rotate(turned, (0.0, 1.0, 0.0))), joint, middle)
    return None


def freedom_of_table(table: DeviceConfig) -> Freedom | None:
    """Return the freedom of a rig's device; None also for an external driver with other options of these names."""
    try:
        kinematics: Any = msgspec.convert(table.options.get("kinematics"), Kinematics | None)
        return freedom_of(kinematics, msgspec.convert(table.options.get("mounting", {}), Mounting))
    except msgspec.ValidationError:
        return None


def freedom_rows(kinematics: Kinematics | None, mounting: Mounting) -> list[tuple[str, str]]:
    """Return rows for `softfinger check`: one for fewer than three degrees of freedom, else none."""
    freedom = freedom_of(kinematics, mounting)
    return [] if freedom is None else [("  moves", freedom.words())]


def _components(vector: Array) -> str:
    return ", ".join(f"{round(float(value), 2) + 0.0:.2f}" for value in vector)
