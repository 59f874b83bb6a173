"""Poses of objects, and their prescribed or simulated motions."""

from typing import NamedTuple

import numpy as np

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.model.vectors import ZERO, Quaternion, Vec3

STILL, DRIVEN, SINUSOID, TURNTABLE, SIMULATED = 0.0, 1.0, 2.0, 3.0, 4.0
"""Kinds of `Motion`: none, external, two functions of time, and by forces."""


class Place(NamedTuple):
    """Pose of an object without rotation: its origin, m."""

    position: Vec3


class Pose(NamedTuple):
    """Pose of an object: its origin, m, and its rotation, object to world."""

    position: Vec3
    orientation: Quaternion


class Motion(NamedTuple):
    """Motion of an object; fields of other kinds are 0.

    DRIVEN     a command or a script changes the pose at run time
    SINUSOID   oscillation in the object's frame at rest: amplitudes `translation`, m, and `angle`, rad, about the unit
               `axis`; `frequency`, Hz, and `phase`, rad
    TURNTABLE  rotation in the object's frame at rest: `rate`, rad/s, about the unit `axis` through the `pivot`, m
    SIMULATED  the object is attached to the body number `body` of the simulation at the addresses `block`
               (query.bodies)
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


NO_BLOCK = ReadOnly(np.zeros(1, np.int64))
"""Placeholder for the addresses of a simulation."""
NO_MOTION = Motion(
    kind=STILL,
    block=NO_BLOCK,
    body=0.0,
    translation=ZERO,
    axis=ZERO,
    pivot=ZERO,
    angle=0.0,
    frequency=0.0,
    phase=0.0,
    rate=0.0,
)
"""Motion of one of many objects that cannot move; that of a single one is None."""
