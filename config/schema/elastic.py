"""Linear elasticity of a mesh object: material, fixed regions, and resolution of the volume mesh."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import msgspec

from softfinger.config import limits
from softfinger.config.fields import Complaint, Point, Table, Vector, check_direction, doc, is_usable, sized, within


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
