"""Motion and displayed force of a device with one or two degrees of freedom, in the world frame."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.schema import DeviceConfig
from softfinger.drivers.kinematics.options import Kinematics, Paddle, Pantograph
from softfinger.drivers.mounting import Mounting
from softfinger.proxy.kernels.numerics.rotations import rotate


class MotionSubspace(NamedTuple):
    """Arc or plane of the handle's motion, in the world.

    degrees  1 or 2
    axis     (3,)    of the arc, or normal of the plane
    origin   (3,) m  a point of the arc's axis, or of the plane
    centre   (3,) m  position of the handle in the middle of its range
    """

    degrees: int
    axis: Array
    origin: Array
    centre: Array

    def project_force(self, position: Array, force: Array) -> Array:
        """Return the displayed part (3,) of a force (N) at the handle's position: along the arc, or in the plane."""
        if self.degrees == 2:
            return np.asarray(force - (force @ self.axis) * self.axis)
        tangent = np.cross(self.axis, position - self.origin)
        length = float(np.linalg.norm(tangent))
        return 0.0 * force if length == 0.0 else np.asarray((force @ tangent) / length**2 * tangent)

    def describe(self) -> str:
        """Return a description of the handle's motion and of the forces that are not displayed."""
        if self.degrees == 2:
            motion = f"in the plane across ({_format_vector(self.axis)}) of the world; forces out of it"
        else:
            along = np.cross(self.axis, self.centre - self.origin)
            motion = f"on an arc, in its middle along ({_format_vector(along / np.linalg.norm(along))}) of the world; "
            motion += "forces across it"
        return f"{motion} are not displayed"


def make_subspace(kinematics: Kinematics | None, mounting: Mounting) -> MotionSubspace | None:
    """Return the subspace in which a mechanism moves; None if it has three degrees of freedom."""
    origin, rotation = mounting.frame()
    centre = np.array(origin)
    if isinstance(kinematics, Pantograph):  # z = 0
        return MotionSubspace(2, np.array(rotate(rotation, (0.0, 0.0, 1.0))), centre, centre)
    if isinstance(kinematics, Paddle):  # about y, from the joint upwards
        joint = centre + np.array(rotate(rotation, (0.0, 0.0, -float(kinematics.length_m))))
        return MotionSubspace(1, np.array(rotate(rotation, (0.0, 1.0, 0.0))), joint, centre)
    return None


def read_subspace(table: DeviceConfig) -> MotionSubspace | None:
    """Return the subspace in which a rig's device moves; None also for a driver whose options have other types."""
    try:
        kinematics: Any = msgspec.convert(table.options.get("kinematics"), Kinematics | None)
        return make_subspace(kinematics, msgspec.convert(table.options.get("mounting", {}), Mounting))
    except msgspec.ValidationError:
        return None


def rows(options: Any) -> list[tuple[str, str]]:
    """Return rows for `softfinger check` from a board's options: one for fewer than three degrees of freedom."""
    subspace = make_subspace(options.kinematics, options.mounting)
    return [] if subspace is None else [("  moves", subspace.describe())]


def _format_vector(vector: Array) -> str:
    return ", ".join(f"{round(float(value), 2) + 0.0:.2f}" for value in vector)
