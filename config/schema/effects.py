"""Forces besides contact: those of the workspace and those of an object."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.schema.fields import (
    Complaint,
    Component,
    Coordinate,
    Length,
    Table,
    direction_faults,
    known,
    said,
    within,
)

Force = Annotated[float, Meta(ge=-limits.EFFECT_FORCE_N.high, le=limits.EFFECT_FORCE_N.high)]
Middle = Annotated[tuple[Coordinate, Coordinate, Coordinate], said("where its middle is in the world", [0.0, 0.0, 0.0])]
Edges = Annotated[tuple[Length, Length, Length], said("edges of a box along the axes of the world", [0.2, 0.2, 0.2])]
BallRadius = Annotated[float, within(limits.LENGTH_M, "radius of a ball in place of the box", 0.1)]
Direction = Annotated[
    tuple[Component, Component, Component], said("direction in the world; its length does not count", [0.0, 0.0, 1.0])
]
EffectDamping = Annotated[float, within(limits.DAMPING_NS_PER_M, "force against the velocity, per speed", 2.0)]
EffectStiffness = Annotated[float, within(limits.STIFFNESS_N_PER_M, "force per length", 200.0)]
ForceVector = Annotated[tuple[Force, Force, Force], said("force on the hand in the world", [0.0, 0.0, -1.0])]
Amplitude = Annotated[float, within(limits.EFFECT_FORCE_N, "amplitude of the force", 0.5)]
Frequency = Annotated[float, within(limits.FREQUENCY_HZ, "cycles per second", 100.0)]


def _extent_faults(size: object, radius: object) -> Iterator[Complaint]:
    if known(size, radius) and (size is None) == (radius is None):
        yield "radius_m", msgspec.UNSET, "give either size_m, for a box, or radius_m, for a ball"


class Region(Table, frozen=True, kw_only=True):
    """Where an effect of the workspace acts; without this table everywhere."""

    position_m: Middle = (0.0, 0.0, 0.0)
    size_m: Edges | None = None
    radius_m: BallRadius | None = None
    edge_m: Annotated[
        float, within(limits.EDGE_M, "depth inside the border at which the effect is whole; 0 is a step", 0.005)
    ] = 0.0

    def faults(self) -> Iterator[Complaint]:
        yield from _extent_faults(self.size_m, self.radius_m)


class EffectBase(Table, frozen=True, kw_only=True):
    """What every effect has: a kind, which selects its other keys."""

    kind: ClassVar[str]


class Viscosity(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="viscosity"):
    """A thick liquid: a force against the velocity of the probe."""

    kind: ClassVar[str] = "viscosity"
    damping_ns_per_m: EffectDamping
    region: Region | None = None


class ConstantForce(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="constant_force"):
    """A force that does not change: a weight, a wind."""

    kind: ClassVar[str] = "constant_force"
    force_n: ForceVector
    region: Region | None = None


class Spring(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="spring"):
    """A spring to a point of the world."""

    kind: ClassVar[str] = "spring"
    position_m: Annotated[
        tuple[Coordinate, Coordinate, Coordinate], said("the point it is fixed to, in the world", [0.0, 0.0, 0.05])
    ]
    stiffness_n_per_m: EffectStiffness
    rest_length_m: Annotated[
        float, within(limits.EDGE_M, "distance at which it neither pulls nor pushes; it pushes when nearer", 0.0)
    ] = 0.0
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "it never pulls or pushes harder", 3.0)]
    region: Region | None = None


class Vibration(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="vibration"):
    """A sinusoidal force, starting at zero."""

    kind: ClassVar[str] = "vibration"
    amplitude_n: Amplitude
    frequency_hz: Frequency
    direction: Direction
    region: Region | None = None

    def faults(self) -> Iterator[Complaint]:
        yield from direction_faults("direction", self.direction)


class Boundary(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="boundary"):
    """The end of the workspace: a spring and damper that push the probe's centre back in."""

    kind: ClassVar[str] = "boundary"
    position_m: Middle = (0.0, 0.0, 0.0)
    size_m: Edges | None = None
    radius_m: BallRadius | None = None
    stiffness_n_per_m: EffectStiffness
    damping_ns_per_m: EffectDamping = 0.0
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "it never pushes harder", 5.0)]

    def faults(self) -> Iterator[Complaint]:
        yield from _extent_faults(self.size_m, self.radius_m)


Effect = Viscosity | ConstantForce | Spring | Vibration | Boundary
"""Any effect of the workspace."""


class ObjectViscosity(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="viscosity"):
    """A sticky film: a force against the velocity over the object, while it is touched."""

    kind: ClassVar[str] = "viscosity"
    damping_ns_per_m: EffectDamping


class ObjectForce(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="constant_force"):
    """A force that does not change, while the object is touched."""

    kind: ClassVar[str] = "constant_force"
    force_n: ForceVector


class ObjectVibration(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="vibration"):
    """A running machine: a sinusoidal force, starting at zero on touch."""

    kind: ClassVar[str] = "vibration"
    amplitude_n: Amplitude
    frequency_hz: Frequency
    direction: (
        Annotated[
            tuple[Component, Component, Component],
            said("direction in the world; left out: along the normal of the contact", [1.0, 0.0, 0.0]),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        yield from direction_faults("direction", self.direction)


class Magnet(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="magnet"):
    """Attraction to the nearest point of the object's surface: force * (1 - gap / range)^exponent."""

    kind: ClassVar[str] = "magnet"
    force_n: Annotated[float, within(limits.EFFECT_FORCE_N, "pull at the surface, and while it is touched", 2.0)]
    range_m: Annotated[float, within(limits.LENGTH_M, "gap from which on there is no pull", 0.02)]
    exponent: Annotated[float, within(limits.EXPONENT, "how steeply the pull falls; 1 is a straight line", 2.0)] = 1.0


class StickSlip(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="stick_slip"):
    """A texture that holds the finger with a spring along the surface and lets go with a jerk."""

    kind: ClassVar[str] = "stick_slip"
    stiffness_n_per_m: EffectStiffness
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "force at which it lets go", 0.5)]


ObjectEffect = ObjectViscosity | ObjectForce | ObjectVibration | Magnet | StickSlip
"""Any effect of an object."""
