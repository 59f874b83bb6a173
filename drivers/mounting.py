"""Frame of a device in the world, as a rig configures it."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot
from typing import Annotated

from softfinger.config.schema import Complaint, Orientation, Point, Table, doc, is_usable
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics.rotations import normalize


class Mounting(Table, frozen=True, kw_only=True):
    """Pose of the device's frame in the world."""

    position_m: Annotated[Point, doc("origin", [0.0, 0.0, 0.0])] = (0.0, 0.0, 0.0)
    orientation_wxyz: Annotated[
        Orientation,
        doc("device to world: quaternion w, x, y, z", [1.0, 0.0, 0.0, 0.0]),
    ] = (1.0, 0.0, 0.0, 0.0)

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.orientation_wxyz) and hypot(*self.orientation_wxyz) == 0.0:
            fault = "all zero is not an orientation: [1, 0, 0, 0] turns nothing"
            yield "orientation_wxyz", self.orientation_wxyz, fault

    def frame(self) -> tuple[Vec3, Quaternion]:
        """Return the device's origin in the world (m), and the unit quaternion from device to world."""
        x, y, z = (float(v) for v in self.position_m)
        w, i, j, k = (float(v) for v in self.orientation_wxyz)
        return (x, y, z), normalize((w, i, j, k))
