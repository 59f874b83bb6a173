"""Motion of an object: prescribed, set by command, or that of a body of [world]."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar

from softfinger.config import limits
from softfinger.config.fields import Complaint, Point, Table, Vector, check_direction, doc, sized, within

Axis = Annotated[Vector, doc("rotation axis in the object frame, normalised", [0.0, 0.0, 1.0])]


class Sinusoid(Table, frozen=True, kw_only=True, tag_field="kind", tag="sinusoid"):
    """Sinusoidal motion about the pose of the object."""

    kind: ClassVar[str] = "sinusoid"
    translation_m: Annotated[
        Point,
        doc("amplitude of the translation, in the object frame", [0.0, 0.0, 0.01]),
    ] = (0.0, 0.0, 0.0)
    rotation_rad: Annotated[float, within(limits.ANGLE_RAD, "amplitude of the rotation about axis", 0.2)] = 0.0
    axis: Axis = (0.0, 0.0, 1.0)
    frequency_hz: Annotated[float, within(limits.MOTION_FREQUENCY_HZ, "frequency", 1.0)]
    phase_rad: Annotated[float, within(limits.ANGLE_RAD, "phase at the start", 0.0)] = 0.0

    def faults(self) -> Iterator[Complaint]:
        yield from check_direction("axis", self.axis)


class Turntable(Table, frozen=True, kw_only=True, tag_field="kind", tag="turntable"):
    """Rotation at a constant rate about an axis of the object."""

    kind: ClassVar[str] = "turntable"
    rate_rad_per_s: Annotated[float, within(limits.TURN_RATE_RAD_PER_S, "angular velocity, right-handed", 1.0)]
    axis: Axis = (0.0, 0.0, 1.0)
    pivot_m: Annotated[Point, doc("a point on the axis, in the object frame", [0.0, 0.0, 0.0])] = (0.0, 0.0, 0.0)

    def faults(self) -> Iterator[Complaint]:
        yield from check_direction("axis", self.axis)


class Driven(Table, frozen=True, kw_only=True, tag_field="kind", tag="driven"):
    """Pose set by the command `drive`. Before the first command the object does not move."""

    kind: ClassVar[str] = "driven"


class Body(Table, frozen=True, kw_only=True, tag_field="kind", tag="body"):
    """Object fixed to a body of [world]; its rest pose is given in the frame of the body."""

    kind: ClassVar[str] = "body"
    body: Annotated[str, sized(limits.NAME_LENGTH, "name of the body, or its number if it has no name", "box")]


Motion = Sinusoid | Turntable | Driven | Body
"""Any motion of an object."""
