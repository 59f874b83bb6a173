"""Where a body is, and how it moves by itself."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


class Place(NamedTuple):
    """Where a body is that is not turned: its origin, m."""

    position: Vec3


class Pose(NamedTuple):
    """Where a body is: its origin, m, and its rotation, body to world."""

    position: Vec3
    orientation: Quaternion


class Sinusoid(NamedTuple):
    """Motion to and fro, in the object's frame at rest: amplitude (3,) m, and rad about a unit axis; Hz, rad."""

    translation: Vec3
    axis: Vec3
    angle: float
    frequency: float
    phase: float


class Turntable(NamedTuple):
    """Steady rotation, in the object's frame at rest: rad/s about a unit axis through the pivot, m."""

    axis: Vec3
    rate: float
    pivot: Vec3


class Driven(NamedTuple):
    """Moved from outside: its pose is changed while running, by a command or a script."""


class Simulated(NamedTuple):
    """Moved by forces: rides on a body of a simulation.

    block  ReadOnly  of the simulation's addresses (query.bodies)
    body             number of the body in it
    """

    block: Any
    body: float
