"""Effects of the workspace and of objects, the regions they act in, and what they remember."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Vec3


class BoxRegion(NamedTuple):
    """Where an effect acts: a box along the axes of the world; `edge` is the depth at which it is whole, m."""

    center: Vec3
    half_extents: Vec3
    edge: float


class SphereRegion(NamedTuple):
    """Where an effect acts: a ball; `edge` as in BoxRegion."""

    center: Vec3
    radius: float
    edge: float


class Touching(NamedTuple):
    """When an effect acts: while the object is touched, and by how much of itself."""

    share: float


class Viscosity(NamedTuple):
    """Force -damping * velocity, N s/m, in a region (None: everywhere)."""

    damping: float
    region: Any


class ConstantForce(NamedTuple):
    """The same force everywhere in a region, N, world frame."""

    force: Vec3
    region: Any


class Spring(NamedTuple):
    """Spring to a point of the world: m, N/m, m, and the largest force, N."""

    anchor: Vec3
    stiffness: float
    rest_length: float
    force_max: float
    region: Any


class BoxBoundary(NamedTuple):
    """Spring-damper towards the inside of a box along the axes of the world, at most `force_max`, N."""

    center: Vec3
    half_extents: Vec3
    stiffness: float
    damping: float
    force_max: float


class SphereBoundary(NamedTuple):
    """Spring-damper towards the inside of a ball, at most `force_max`, N."""

    center: Vec3
    radius: float
    stiffness: float
    damping: float
    force_max: float


class Vibration(NamedTuple):
    """Sine of an amplitude, N, and a frequency, Hz, along a unit vector."""

    amplitude: float
    frequency: float
    direction: Vec3
    region: Any


class NormalVibration(NamedTuple):
    """Sine along the normal of the touched surface."""

    amplitude: float
    frequency: float


class Magnet(NamedTuple):
    """Attraction to an object: N at its surface, none beyond `range`, m; exponent of the fall between."""

    force: float
    range: float
    exponent: float


class StickSlip(NamedTuple):
    """Texture of points that hold, N/m, up to a force, N."""

    stiffness: float
    force_max: float


class Anchor(NamedTuple):
    """Memory of StickSlip: the point that holds, in the object's frame, and 1 if there is one."""

    point: Vec3
    held: float


class Phase(NamedTuple):
    """Memory of a vibration: turns since its start, in [0, 1)."""

    turns: float
