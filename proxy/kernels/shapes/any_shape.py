"""A shape with its kind as data: its kernels are called by the addresses in its table (`kernel_table`).

A missing kernel is replaced by the default, which calls `closest` and `curvature` of the table. So the code for many
objects is compiled once for all kinds, and only the kinds in use are compiled. A shape of another package needs no
additions.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import PLAIN, jit
from softfinger.proxy.kernels.model import (
    CREASED,
    FACETED,
    FLAT,
    SMOOTH,
    WORLD_PLANE,
    AnyShape,
    Box,
    CappedCylinder,
    Capsule,
    Ellipsoid,
    Heightmap,
    Mesh,
    MinkowskiSum,
    Plane,
    Pose,
    Sphere,
    Torus,
    Vec3,
)
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.shapes.charts import Chart, chart
from softfinger.proxy.kernels.shapes.composite import (
    NearestObject,
    nearest_of_shape,
    neighbour_of,
    raised_clear,
    shade_normal,
)
from softfinger.proxy.kernels.shapes.kernel_table import (
    CHART,
    CLOSEST,
    CLOSEST_FROM,
    CLOSEST_OR_BOUND,
    CLOSEST_WITHIN,
    CONCAVITY,
    CONSTRAINT,
    CURVATURE,
    FOLLOWS,
    MEETS,
    MINKOWSKI,
    NEAREST,
    NEIGHBOUR,
    RAISED,
    SHADED,
    SLOTS,
    TRANSPORT,
    TRAVEL,
    KernelSlot,
    ShapeRow,
    call_kernel,
    is_two_sided,
    kernel_table,
)
from softfinger.proxy.kernels.shapes.minkowski import nearest_on_minkowski_sum
from softfinger.proxy.kernels.shapes.plane import closest_on_plane, travel_to_plane
from softfinger.proxy.kernels.shapes.protocol import (
    closest,
    closest_from,
    closest_or_bound,
    closest_within,
    concavity,
    constraint_at,
    curvature,
    follows,
    hollow_from_inside,
    is_hollow,
    meets,
    transport,
    travel,
    travel_to_shape,
    turn_along,
)

FOOT: Final = (0.0, ZERO, ZERO)
FOOT_AND_BUDGET: Final = (0.0, ZERO, ZERO, 0)
FOOT_AND_FLAG: Final = (0.0, ZERO, ZERO, 0.0)
POINT_AND_BUDGET: Final = (ZERO, ZERO, 0)
NO_CURVATURE: Final = (0.0, 0.0, ZERO)
NO_MEETING: Final = (0.0, 0.0, 0)
NO_OBJECT: Final = NearestObject(0.0, 0.0, 0)
NO_CHART: Final = Chart(0.0, 0.0, ZERO, ZERO, 0.0, ZERO)
UP: Final = (1.0, 0.0, 0.0, 0.0)


SLOTS.update(
    {
        CLOSEST: KernelSlot(closest, (ZERO,), FOOT),
        CLOSEST_FROM: KernelSlot(closest_from, (ZERO, ZERO, 0), FOOT_AND_BUDGET),
        CLOSEST_OR_BOUND: KernelSlot(closest_or_bound, (ZERO,), FOOT_AND_FLAG),
        CLOSEST_WITHIN: KernelSlot(closest_within, (ZERO, 0), FOOT_AND_BUDGET),
        CONSTRAINT: KernelSlot(constraint_at, (ZERO, 0.0, ZERO, 0), POINT_AND_BUDGET),
        CURVATURE: KernelSlot(curvature, (0.0, ZERO, ZERO), NO_CURVATURE),
        TRANSPORT: KernelSlot(transport, (ZERO, ZERO, ZERO), ZERO),
        CONCAVITY: KernelSlot(concavity, (0.0, ZERO, ZERO), 0.0),
        FOLLOWS: KernelSlot(follows, (0.0, ZERO, ZERO, ZERO), True),
        TRAVEL: KernelSlot(travel, (ZERO, ZERO, 0.0, True), 0.0),
        MEETS: KernelSlot(meets, (ZERO, ZERO, 0.0, True, 0), NO_MEETING),
        NEAREST: KernelSlot(nearest_of_shape, (ZERO, 0.0, ZERO, 0), NO_OBJECT),
        NEIGHBOUR: KernelSlot(neighbour_of, (ZERO,), 0.0),
        RAISED: KernelSlot(raised_clear, (ZERO, 0.0), ZERO),
        SHADED: KernelSlot(shade_normal, (Pose(ZERO, UP), ZERO, ZERO), ZERO),
        CHART: KernelSlot(chart, (0.0, ZERO, ZERO), NO_CHART),
    }
)


def make_any_shape(shape: Any, pose: Any, needs: frozenset[int]) -> AnyShape:
    """Return a shape as AnyShape; its pose is None in the world frame."""
    kind = type(shape)
    plane = WORLD_PLANE if pose is None else FLAT
    surface = {Mesh: FACETED, Heightmap: CREASED, Plane: plane}.get(kind, SMOOTH)
    side = float(shape.side) if is_two_sided(shape) else 1.0
    return AnyShape(ShapeRow([shape]), kernel_table(shape, needs), 0.0, side, surface, compute_reach(shape))


# --- the shape's protocol, by address ------------------------------------------------------------


def _plane_of(shape: AnyShape) -> Plane:
    s = shape.sizes
    return Plane((s[0], s[1], s[2]), s[3])


plane_of: Any = (lambda shape: shape.sizes[0]) if PLAIN else jit(_plane_of)
"""A flat shape as a Plane: it takes less time than a call by address."""


@closest.of(AnyShape)
def closest_on_any(shape: AnyShape, x: Vec3) -> tuple[float, Vec3, Vec3]:
    if shape.surface >= FLAT:
        return closest_on_plane(plane_of(shape), x)
    return call_kernel(shape, CLOSEST, FOOT, (x,))


@curvature.of(AnyShape)
def curvature_of_any(shape: AnyShape, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    return call_kernel(shape, CURVATURE, NO_CURVATURE, (radius, point, normal))


@closest_from.of(AnyShape)
def closest_on_any_from(shape: AnyShape, x: Vec3, start: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    if shape.kernels[CLOSEST_FROM] != 0:
        return call_kernel(shape, CLOSEST_FROM, FOOT_AND_BUDGET, (x, start, budget))
    gap, point, normal = closest(shape, x)
    return gap, point, normal, budget


@closest_within.of(AnyShape)
def closest_on_any_within(shape: AnyShape, x: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    if shape.kernels[CLOSEST_WITHIN] != 0:
        return call_kernel(shape, CLOSEST_WITHIN, FOOT_AND_BUDGET, (x, budget))
    gap, point, normal = closest(shape, x)
    return gap, point, normal, budget


@closest_or_bound.of(AnyShape)
def closest_on_any_or_bound(shape: AnyShape, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    if shape.kernels[CLOSEST_OR_BOUND] != 0:
        return call_kernel(shape, CLOSEST_OR_BOUND, FOOT_AND_FLAG, (x,))
    gap, point, normal = closest(shape, x)
    return gap, point, normal, 0.0


@constraint_at.of(AnyShape)
def constraint_of_any(
    shape: AnyShape, center: Vec3, radius: float, normal: Vec3, budget: int
) -> tuple[Vec3, Vec3, int]:
    if shape.kernels[CONSTRAINT] != 0:
        return call_kernel(shape, CONSTRAINT, POINT_AND_BUDGET, (center, radius, normal, budget))
    _, point, up = closest(shape, center)
    return point, up, budget


@transport.of(AnyShape)
def transport_on_any(shape: AnyShape, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    if shape.surface >= FLAT:
        return v
    if shape.kernels[TRANSPORT] != 0:
        return call_kernel(shape, TRANSPORT, ZERO, (v, normal_from, normal_to))
    return turn_along(v, normal_from, normal_to)


is_hollow.of(AnyShape)(hollow_from_inside)


@concavity.of(AnyShape)
def concavity_of_any(shape: AnyShape, radius: float, point: Vec3, normal: Vec3) -> float:
    if shape.kernels[CONCAVITY] != 0:
        return call_kernel(shape, CONCAVITY, 0.0, (radius, point, normal))
    if shape.side > 0.0:
        return 0.0
    k1, k2, _ = curvature(shape, radius, point, normal)
    return max(-min(k1, k2), 0.0)


@follows.of(AnyShape)
def follows_on_any(shape: AnyShape, radius: float, start: Vec3, normal: Vec3, end: Vec3) -> bool:
    if shape.kernels[FOLLOWS] != 0:
        return call_kernel(shape, FOLLOWS, True, (radius, start, normal, end))
    return True


@travel.of(AnyShape)
def travel_to_any(shape: AnyShape, start: Vec3, end: Vec3, radius: float, in_contact: bool) -> float:
    if shape.surface >= FLAT:
        return travel_to_plane(plane_of(shape), start, end, radius, in_contact)
    if shape.kernels[TRAVEL] != 0:
        return call_kernel(shape, TRAVEL, 0.0, (start, end, radius, in_contact))
    return travel_to_shape(shape, start, end, radius, in_contact)


@meets.of(AnyShape)
def meets_any(
    shape: AnyShape, start: Vec3, end: Vec3, radius: float, in_contact: bool, budget: int
) -> tuple[float, float, int]:
    if shape.kernels[MEETS] != 0:
        return call_kernel(shape, MEETS, NO_MEETING, (start, end, radius, in_contact, budget))
    return travel(shape, start, end, radius, in_contact), 0.0, budget


@nearest_of_shape.of(AnyShape)
def nearest_of_any(shape: AnyShape, x: Vec3, within: float, known: Vec3, budget: int) -> NearestObject:
    if shape.kernels[NEAREST] != 0:
        return call_kernel(shape, NEAREST, NO_OBJECT, (x, within, known, budget))
    gap, _, _ = closest(shape, x)
    return NearestObject(gap, 0.0, budget)


@neighbour_of.of(AnyShape)
def neighbour_on_any(shape: AnyShape, x: Vec3) -> float:
    if shape.kernels[NEIGHBOUR] != 0:
        return call_kernel(shape, NEIGHBOUR, 0.0, (x,))
    return 0.0


@raised_clear.of(AnyShape)
def raised_clear_of_any(shape: AnyShape, x: Vec3, radius: float) -> Vec3:
    if shape.kernels[RAISED] != 0:
        return call_kernel(shape, RAISED, ZERO, (x, radius))
    return x


@shade_normal.of(AnyShape)
def shade_any(shape: AnyShape, pose: Pose, normal: Vec3, position: Vec3) -> Vec3:
    if shape.kernels[SHADED] != 0:
        return call_kernel(shape, SHADED, ZERO, (pose, normal, position))
    return normal


@chart.of(AnyShape)
def chart_of_any(shape: AnyShape, fade: float, x: Vec3, normal: Vec3) -> Chart:
    return call_kernel(shape, CHART, NO_CHART, (fade, x, normal))


@nearest_on_minkowski_sum.of(AnyShape)
def nearest_over_any(shape: AnyShape, grown: MinkowskiSum, x: Vec3) -> tuple[float, Vec3, Vec3]:
    return call_kernel(shape, MINKOWSKI, FOOT, (grown, x))


_ANY: Final = AnyShape(ReadOnly([0.0]), ReadOnly(np.zeros(1, np.int64)), 0.0, 1.0, SMOOTH, 0.0)
SLOTS[MINKOWSKI] = KernelSlot(nearest_on_minkowski_sum, (MinkowskiSum(_ANY, ZERO, UP, 0.0), ZERO), FOOT)


def compute_reach(shape: Any) -> float:
    """Return `reach` of `AnyShape`, m."""
    match shape:
        case Sphere(side=1.0):
            return shape.radius
        case CappedCylinder():
            return math.hypot(shape.radius, shape.half_length)
        case Capsule(side=1.0):
            return shape.radius + shape.half_length
        case Box():
            return math.hypot(*shape.half_extents)
        case Ellipsoid(side=1.0):
            return max(shape.semi_axes)
        case Torus(side=1.0):
            return shape.major + shape.minor
        case Mesh() if shape.row[0].side > 0.0:
            return math.hypot(*shape.row[0].center) + 0.5 * shape.row[0].size
        case Heightmap():
            return float(shape.pitch * shape.coefficients.array.max())  # a B-spline is below its largest coefficient
    return math.inf
