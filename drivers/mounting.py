"""Options that the rigs of several drivers share: frame of the device in the world, its limits, its timeout."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

from msgspec import Meta

from softfinger.config import limits
from softfinger.config.fields import (
    Complaint,
    Orientation,
    Point,
    Table,
    check_orientation,
    doc,
    is_usable,
    normalise_orientation,
    within,
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


class MountedOptions(Table, frozen=True, kw_only=True):
    """Options of a device that reports neither its place nor its limits."""

    mounting: Mounting = Mounting()
    force_max_n: Annotated[float, within(limits.FORCE_MAX_N, "largest force displayed", 5.0)]
    stiffness_max_n_per_m: Annotated[
        float, within(limits.STIFFNESS_N_PER_M, "largest stiffness rendered stably", 1000.0)
    ]
    damping_max_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "largest damping rendered stably", 8.0)]
    workspace_radius_m: Annotated[float, Meta(gt=0.0, le=1.0), doc("about the device's origin", 0.1)]


def check_timeout(options: Any, key: str, action: str) -> Iterator[Complaint]:
    """Yield a complaint if `timeout_s` is shorter than the time at `key`, after which `action` is taken."""
    least_s = getattr(options, key)
    if is_usable(least_s, options.timeout_s) and options.timeout_s < least_s:
        yield "timeout_s", options.timeout_s, f"must be at least {key} = {least_s:g}, so that a {action} is sent first"
