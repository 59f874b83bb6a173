"""Poses of objects, and their prescribed or simulated motions."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


class Place(NamedTuple):
    """Pose of an object without rotation: its origin, m."""

    position: Vec3


class Pose(NamedTuple):
    """Pose of an object: its origin, m, and its rotation, object to world."""

    position: Vec3
    orientation: Quaternion


class Sinusoid(NamedTuple):
    """Sinusoidal motion in the object's frame at rest: amplitudes (3,) m, and rad about a unit axis; Hz, rad."""

    translation: Vec3
    axis: Vec3
    angle: float
    frequency: float
    phase: float


class Turntable(NamedTuple):
    """Constant rotation in the object's frame at rest: rad/s about a unit axis through the pivot, m."""

    axis: Vec3
    rate: float
    pivot: Vec3


class Driven(NamedTuple):
    """External motion: a command or a script changes the pose at run time."""


class Simulated(NamedTuple):
    """Motion by forces: the object is attached to a body of a simulation.

    block  ReadOnly  addresses of the simulation (query.bodies)
    body             number of the body in the simulation
    """

    block: Any
    body: float
