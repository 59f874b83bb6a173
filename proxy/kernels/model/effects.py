"""Effects of the workspace and of objects: parameters, regions, and states between ticks."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Vec3


class BoxRegion(NamedTuple):
    """Region of an effect: a box aligned with the world axes.

    edge  m  depth inside the box at which the effect reaches its full strength
    """

    center: Vec3
    half_extents: Vec3
    edge: float


class SphereRegion(NamedTuple):
    """Region of an effect: a ball; `edge` as in BoxRegion."""

    center: Vec3
    radius: float
    edge: float


class TouchCondition(NamedTuple):
    """Condition of an effect: it acts with `share` (0 to 1) of its strength while the object is touched."""

    share: float


class Viscosity(NamedTuple):
    """Force -damping * velocity, N s/m, in a region (None: everywhere)."""

    damping: float
    region: Any


class ConstantForce(NamedTuple):
    """Uniform force in a region (None: everywhere), N, world frame."""

    force: Vec3
    region: Any


class Spring(NamedTuple):
    """Spring to a point of the world: anchor m, stiffness N/m, rest length m, and the largest force, N."""

    anchor: Vec3
    stiffness: float
    rest_length: float
    force_max: float
    region: Any


class BoxBoundary(NamedTuple):
    """Spring-damper towards the inside of a box aligned with the world axes, at most `force_max`, N."""

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
    """Sinusoidal force of an amplitude, N, and a frequency, Hz, along a unit vector."""

    amplitude: float
    frequency: float
    direction: Vec3
    region: Any


class NormalVibration(NamedTuple):
    """Sinusoidal force of an amplitude, N, and a frequency, Hz, along the normal of the touched surface."""

    amplitude: float
    frequency: float


class Magnet(NamedTuple):
    """Attraction to an object.

    force     N  at its surface
    range     m  gap beyond which there is no force
    exponent     shape of the decrease in between
    """

    force: float
    range: float
    exponent: float


class StickSlip(NamedTuple):
    """Texture of points where the fingertip sticks: spring of a stiffness, N/m, that breaks at a force, N."""

    stiffness: float
    force_max: float


class Anchor(NamedTuple):
    """State of StickSlip: the point where the fingertip sticks, in the object's frame, and 1 if there is one."""

    point: Vec3
    is_set: float


class Phase(NamedTuple):
    """State of a vibration: turns since its start, in [0, 1)."""

    turns: float
