"""Forces in addition to contact: effects of the workspace and of an object."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.fields import (
    Complaint,
    Lengths,
    Point,
    Table,
    Vector,
    check_direction,
    doc,
    is_usable,
    make_tag_attribute,
    within,
)

Force = Annotated[float, Meta(ge=-limits.EFFECT_FORCE_N.high, le=limits.EFFECT_FORCE_N.high)]
Middle = Annotated[Point, doc("centre in the world", [0.0, 0.0, 0.0])]
Edges = Annotated[Lengths, doc("edge lengths of a box along the world axes", [0.2, 0.2, 0.2])]
BallRadius = Annotated[float, within(limits.LENGTH_M, "radius of a ball, in place of size_m", 0.1)]
Direction = Annotated[Vector, doc("direction in the world; normalised", [0.0, 0.0, 1.0])]
EffectDamping = Annotated[float, within(limits.DAMPING_NS_PER_M, "force per speed, against the velocity", 2.0)]
EffectStiffness = Annotated[float, within(limits.STIFFNESS_N_PER_M, "stiffness", 200.0)]
ForceVector = Annotated[tuple[Force, Force, Force], doc("force on the hand in the world", [0.0, 0.0, -1.0])]
Amplitude = Annotated[float, within(limits.EFFECT_FORCE_N, "amplitude", 0.5)]
Frequency = Annotated[float, within(limits.FREQUENCY_HZ, "frequency", 100.0)]


def _check_extent(size: object, radius: object) -> Iterator[Complaint]:
    if is_usable(size, radius) and (size is None) == (radius is None):
        yield "radius_m", msgspec.UNSET, "give either size_m, for a box, or radius_m, for a ball"


class Region(Table, frozen=True, kw_only=True):
    """Region in which an effect other than a boundary acts; without this table it acts everywhere."""

    position_m: Middle = (0.0, 0.0, 0.0)
    size_m: Edges | None = None
    radius_m: BallRadius | None = None
    edge_m: Annotated[
        float, within(limits.EDGE_M, "border over which the effect rises linearly from zero; 0: a step", 0.005)
    ] = 0.0

    def faults(self) -> Iterator[Complaint]:
        yield from _check_extent(self.size_m, self.radius_m)


class EffectBase(Table, frozen=True, kw_only=True):
    """Base of all effects; the kind selects the other keys."""

    kind: ClassVar[str] = make_tag_attribute()


class Viscosity(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="viscosity"):
    """Viscous drag against the velocity of the probe."""

    damping_ns_per_m: EffectDamping
    region: Region | None = None


class ConstantForce(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="constant_force"):
    """Constant force."""

    force_n: ForceVector
    region: Region | None = None


class Spring(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="spring"):
    """Spring to a fixed point."""

    position_m: Annotated[Point, doc("anchor in the world", [0.0, 0.0, 0.05])]
    stiffness_n_per_m: EffectStiffness
    rest_length_m: Annotated[float, within(limits.EDGE_M, "free length; a shorter spring pushes", 0.0)] = 0.0
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "largest force", 3.0)]
    region: Region | None = None


class Vibration(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="vibration"):
    """Sinusoidal force; the phase starts at zero."""

    amplitude_n: Amplitude
    frequency_hz: Frequency
    direction: Direction
    region: Region | None = None

    def faults(self) -> Iterator[Complaint]:
        yield from check_direction("direction", self.direction)


class Boundary(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="boundary"):
    """Workspace limit: spring and damper push the probe centre back inside."""

    position_m: Middle = (0.0, 0.0, 0.0)
    size_m: Edges | None = None
    radius_m: BallRadius | None = None
    stiffness_n_per_m: EffectStiffness
    damping_ns_per_m: EffectDamping = 0.0
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "largest force", 5.0)]

    def faults(self) -> Iterator[Complaint]:
        yield from _check_extent(self.size_m, self.radius_m)


Effect = Viscosity | ConstantForce | Spring | Vibration | Boundary
"""Any effect of the workspace."""


class ObjectViscosity(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="viscosity"):
    """Viscous drag against the velocity relative to the object, while the object is touched."""

    damping_ns_per_m: EffectDamping


class ObjectForce(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="constant_force"):
    """Constant force while the object is touched."""

    force_n: ForceVector


class ObjectVibration(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="vibration"):
    """Sinusoidal force while the object is touched; the phase starts at zero at each touch."""

    amplitude_n: Amplitude
    frequency_hz: Frequency
    direction: (
        Annotated[Vector, doc("direction in the world, normalised; default: the contact normal", [1.0, 0.0, 0.0])]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        yield from check_direction("direction", self.direction)


class Magnet(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="magnet"):
    """Attraction to the nearest surface point: force_n (1 - gap / range_m)^exponent."""

    force_n: Annotated[float, within(limits.EFFECT_FORCE_N, "attraction at the surface and in contact", 2.0)]
    range_m: Annotated[float, within(limits.LENGTH_M, "gap at which the attraction reaches zero", 0.02)]
    exponent: Annotated[float, within(limits.EXPONENT, "exponent of the decay; 1: linear", 2.0)] = 1.0


class StickSlip(EffectBase, frozen=True, kw_only=True, tag_field="kind", tag="stick_slip"):
    """Stick-slip texture: a tangential spring to an anchor that jumps to the finger at force_max_n."""

    stiffness_n_per_m: EffectStiffness
    force_max_n: Annotated[float, within(limits.EFFECT_FORCE_N, "spring force at which the anchor jumps", 0.5)]


ObjectEffect = ObjectViscosity | ObjectForce | ObjectVibration | Magnet | StickSlip
"""Any effect of an object."""
