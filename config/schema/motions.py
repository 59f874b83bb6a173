"""How an object moves by itself, or that it is moved from outside."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar

from softfinger.config import limits
from softfinger.config.schema.fields import Complaint, Component, Coordinate, Table, direction_faults, said, within

Axis = Annotated[
    tuple[Component, Component, Component],
    said("axis of the rotation in the object's frame; its length does not count", [0.0, 0.0, 1.0]),
]


class Sinusoid(Table, frozen=True, kw_only=True, tag_field="kind", tag="sinusoid"):
    """To and fro about where the object rests, in its own frame."""

    kind: ClassVar[str] = "sinusoid"
    translation_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate], said("amplitude of the way, in the object's frame", [0.0, 0.0, 0.01])
    ] = (0.0, 0.0, 0.0)
    rotation_rad: Annotated[float, within(limits.ANGLE_RAD, "amplitude of the rotation about the axis", 0.2)] = 0.0
    axis: Axis = (0.0, 0.0, 1.0)
    frequency_hz: Annotated[float, within(limits.MOTION_FREQUENCY_HZ, "cycles per second", 1.0)]
    phase_rad: Annotated[float, within(limits.ANGLE_RAD, "where in its cycle it starts", 0.0)] = 0.0

    def faults(self) -> Iterator[Complaint]:
        yield from direction_faults("axis", self.axis)


class Turntable(Table, frozen=True, kw_only=True, tag_field="kind", tag="turntable"):
    """Turning steadily about an axis of the object."""

    kind: ClassVar[str] = "turntable"
    rate_rad_per_s: Annotated[float, within(limits.TURN_RATE_RAD_PER_S, "angular velocity, right-handed", 1.0)]
    axis: Axis = (0.0, 0.0, 1.0)
    pivot_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate],
        said("a point of the axis, in the object's frame", [0.0, 0.0, 0.0]),
    ] = (0.0, 0.0, 0.0)

    def faults(self) -> Iterator[Complaint]:
        yield from direction_faults("axis", self.axis)


class Driven(Table, frozen=True, kw_only=True, tag_field="kind", tag="driven"):
    """Moved from outside while running, by a command or a script; it rests where its pose says until then."""

    kind: ClassVar[str] = "driven"


Motion = Sinusoid | Turntable | Driven
"""Any motion of an object."""
