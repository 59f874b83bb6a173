"""Parts of an object: motion (prescribed, by command, or of a body of [world]), texture, and linear elasticity."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.fields import (
    Complaint,
    Length,
    Point,
    Table,
    Vector,
    check_direction,
    doc,
    is_usable,
    sized,
    within,
)
from softfinger.config.schema.materials import Scale

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


Border = Literal["period", "clamp"]


class Texture(Table, frozen=True, kw_only=True):
    """Height and friction of a plane, cylinder or box from an array; its smallest value maps to 0, its largest to 1."""

    file: Annotated[str, sized(limits.FILE_NAME_LENGTH, "array (.npy, .npz, .csv) or grey picture (.pgm)", "ribs.csv")]
    size_m: Annotated[tuple[Length, Length], doc("size on the surface, along columns and rows", [0.02, 0.02])]
    border: Annotated[
        Border, doc("period: repeats; clamp: the border value continues; around a cylinder period only")
    ] = "period"
    height_m: (
        Annotated[
            float, within(limits.TEXTURE_HEIGHT_M, "height from value 0 to value 1; value 1 is on the surface", 1e-4)
        ]
        | None
    ) = None
    friction_scale: Annotated[tuple[Scale, Scale], doc("factors on friction at values 0 and 1", [0.5, 1.5])] | None = (
        None
    )
    speed_m_per_s: Annotated[
        float, within(limits.STROKE_M_PER_S, "fastest stroke to render at 1 kHz; finer detail is filtered out", 0.1)
    ] = 0.1

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.height_m, self.friction_scale) and self.height_m is None and self.friction_scale is None:
            fault = "is missing, as is friction_scale, so the texture has no effect: set one or both"
            yield "height_m", msgspec.UNSET, fault


class Below(Table, frozen=True, kw_only=True, tag_field="region", tag="below"):
    """Part of the object at or below a height."""

    z_m: Annotated[float, within(limits.COORDINATE_M, "largest z, in the object frame", 0.0001)]


class InBox(Table, frozen=True, kw_only=True, tag_field="region", tag="box"):
    """Part of the object inside a box along the axes."""

    low_m: Annotated[Point, doc("least x, y, z, in the object frame", [-0.05, -0.05, -0.01])]
    high_m: Annotated[Point, doc("largest x, y, z, in the object frame", [0.05, 0.05, 0.0001])]

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.low_m, self.high_m) and not all(a < b for a, b in zip(self.low_m, self.high_m, strict=True)):
            yield "high_m", self.high_m, f"must be above low_m = {list(self.low_m)} in each component"


class HalfSpace(Table, frozen=True, kw_only=True, tag_field="region", tag="half_space"):
    """Part of the object behind a plane."""

    point_m: Annotated[Point, doc("point of the plane, in the object frame", [0.0, 0.0, 0.0])]
    normal: Annotated[Vector, doc("normal of the plane, away from the region", [1.0, 0.0, 0.0])]

    def faults(self) -> Iterator[Complaint]:
        yield from check_direction("normal", self.normal)


FixedRegion = Below | InBox | HalfSpace
"""Any region; the key `region` selects the table."""


class Elastic(Table, frozen=True, kw_only=True):
    """Linear elastic body under the surface of a mesh."""

    youngs_pa: Annotated[float, within(limits.YOUNGS_PA, "Young's modulus", 1e5)]
    poisson: Annotated[float, within(limits.ELASTIC_POISSON, "Poisson's ratio", 0.45)]
    fixed: Annotated[
        tuple[FixedRegion, ...], doc("regions in which the body does not move", [{"region": "below", "z_m": 1e-4}])
    ]
    reach: Annotated[
        tuple[FixedRegion, ...], doc("compliant regions of the surface; the rest is rigid; default: everywhere")
    ] = ()
    resolution_m: Annotated[float, within(limits.ELASTIC_EDGE_M, "edge length of the volume mesh", 0.004)]
    patch_radius_m: (
        Annotated[
            float, within(limits.ELASTIC_EDGE_M, "radius of the area that carries a load; default: resolution_m", 0.004)
        ]
        | None
    ) = None
    density_kg_per_m3: (
        Annotated[
            float, within(limits.DENSITY_KG_PER_M3, "density, for the sag under gravity along -z of the object", 1100.0)
        ]
        | None
    ) = None
    damping_s: Annotated[
        float, within(limits.ELASTIC_DAMPING_S, "time constant of the surface (Kelvin-Voigt)", 0.01)
    ] = 0.0

    solution: (
        Annotated[
            str, sized(limits.FILE_NAME_LENGTH, "file of the solved body; default: it is solved, and cached", "pad.npz")
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.fixed) and not self.fixed:
            fault = 'has no region, so the body could move freely: add { region = "below", z_m = 0.0001 }'
            yield "fixed", msgspec.UNSET, fault

    @property
    def radius_m(self) -> float:
        """Radius of the loaded area, m."""
        return self.resolution_m if self.patch_radius_m is None else self.patch_radius_m
