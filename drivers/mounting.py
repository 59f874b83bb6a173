"""Frame of a device in the world, as a rig configures it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from softfinger.config.fields import (
    Complaint,
    Orientation,
    Point,
    Table,
    check_orientation,
    doc,
    normalise_orientation,
)
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics.rotations import normalize


class Mounting(Table, frozen=True, kw_only=True):
    """Pose of the device's frame in the world."""

    position_m: Annotated[Point, doc("origin", [0.0, 0.0, 0.0])] = (0.0, 0.0, 0.0)
    orientation_wxyz: Annotated[
        Orientation, doc("device to world: quaternion w, x, y, z, normalised on load", [1.0, 0.0, 0.0, 0.0])
    ] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        normalise_orientation(self)

    def faults(self) -> Iterator[Complaint]:
        yield from check_orientation(self.orientation_wxyz)

    def frame(self) -> tuple[Vec3, Quaternion]:
        """Return the device's origin in the world (m), and the unit quaternion from device to world."""
        x, y, z = (float(v) for v in self.position_m)
        w, i, j, k = (float(v) for v in self.orientation_wxyz)
        return (x, y, z), normalize((w, i, j, k))
