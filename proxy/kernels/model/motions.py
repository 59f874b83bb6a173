"""Poses of objects, and their prescribed or simulated motions."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3

STILL, DRIVEN, SINUSOID, TURNTABLE, SIMULATED = 0.0, 1.0, 2.0, 3.0, 4.0
"""Kinds of `Motion`."""


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


class Motion(NamedTuple):
    """Motion of one of many objects, as numbers; fields of other kinds are 0.

    kind         STILL, DRIVEN, SINUSOID, TURNTABLE or SIMULATED
    block, body  of Simulated
    translation  of Sinusoid
    axis         of Sinusoid or Turntable
    pivot        of Turntable
    angle, frequency, phase, rate
    """

    kind: float
    block: ReadOnly
    body: float
    translation: Vec3
    axis: Vec3
    pivot: Vec3
    angle: float
    frequency: float
    phase: float
    rate: float


class Simulated(NamedTuple):
    """Motion by forces: the object is attached to a body of a simulation.

    block  ReadOnly  addresses of the simulation (query.bodies)
    body             number of the body in the simulation
    """

    block: Any
    body: float
