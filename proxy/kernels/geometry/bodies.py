"""All objects of a scene asked in turn, each where its pose puts it.

Objects are of different types, so they stand in a tuple and are asked one after the other by an
unrolled loop. Many of one type stand together in it as `Rows`; `index` is an object's place: see
`entries`.
"""

from typing import Any, NamedTuple

from numba import literal_unroll

from softfinger.proxy.kernels.contact.rolling import OffsetPoint, Roll, roll
from softfinger.proxy.kernels.geometry import vec3
from softfinger.proxy.kernels.geometry.entries import has, member, places
from softfinger.proxy.kernels.geometry.frames import into, out_of, pose_values, turn_into, turn_out_of
from softfinger.proxy.kernels.geometry.mesh.contact import nearest_facet
from softfinger.proxy.kernels.geometry.mesh.triangle import beyond_edge
from softfinger.proxy.kernels.geometry.surfaces import (
    bend,
    closest,
    closest_or_bound,
    closest_within,
    follows,
    held_at,
    is_hollow,
    tangent_plane,
    transport,
)
from softfinger.proxy.kernels.geometry.surfaces.footing import gap_within, left_of
from softfinger.proxy.kernels.model import Facet, Heightmap, Material, Mesh, Pose, Quaternion, Vec3
from softfinger.proxy.kernels.native.dispatch import by_type
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.rows import Rows

NOBODY: Vec3 = (-1.0, -1.0, -1.0)
"""Places of no objects."""
EVERYWHERE = 1e300
ENOUGH = 1.0 - 1e-6
"""Share of the gap that is asked about, below which a triangle of a mesh need not be the very nearest: it is in the
way, and not by a rounding error."""
SWING = 0.2
"""Turn of the contact round a hollow in a tick, rad, past which it slides: no hand follows it thirty times a second."""


@jit
def closest_on(body: Any, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """`closest` of one object in the world."""
    gap, point, normal = closest(body.shape, into(body.pose, x))
    return gap, out_of(body.pose, point), turn_out_of(body.pose, normal)


@jit
def closest_or_bound_on(body: Any, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    """`closest_or_bound` of one object in the world."""
    gap, point, normal, unsearched = closest_or_bound(body.shape, into(body.pose, x))
    return gap, out_of(body.pose, point), turn_out_of(body.pose, normal), unsearched


@jit
def closest_to_within(objects: Any, index: float, x: Vec3, left: int) -> tuple[float, Vec3, Vec3, int]:
    """`closest_within` of the object with that place."""
    gap, point, normal = 0.0, x, (0.0, 0.0, 1.0)
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            gap, foot, up, left = closest_within(body.shape, into(body.pose, x), left)
            point, normal = out_of(body.pose, foot), turn_out_of(body.pose, up)
        at += places(entry)
    return gap, point, normal, left


@jit
def held_by_at(
    objects: Any, index: float, center: Vec3, radius: float, normal: Vec3, left: int
) -> tuple[Vec3, Vec3, int]:
    """`held_at` of the object with that place, in the world."""
    point, up = center, normal
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            pose = body.pose
            foot, n, left = held_at(body.shape, into(pose, center), radius, turn_into(pose, normal), left)
            point, up = out_of(pose, foot), turn_out_of(pose, n)
        at += places(entry)
    return point, up, left


@jit
def material_of(objects: Any, index: float) -> Material:
    """Material of the object with that place; all have the same parts."""
    found = member(objects[0], 0.0).material
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = body.material
        at += places(entry)
    return found


@jit
def number_of(objects: Any, index: float) -> float:
    """Number in the scene file of the object with that place, -1 for none; several may make one object."""
    found = -1.0
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = body.number
        at += places(entry)
    return found


@jit
def roll_on(
    method: Any, objects: Any, index: float, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> Roll:
    """`roll` over the object with that place, in the world."""
    found = Roll(center, normal, (0.0, 0.0, 0.0), 0.0, 0.0, True)
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            pose = body.pose
            axis = turn_into(pose, (turn[1], turn[2], turn[3]))
            local = roll(
                method,
                body.shape,
                radius,
                into(pose, center),
                turn_into(pose, normal),
                (turn[0], axis[0], axis[1], axis[2]),
            )
            found = Roll(
                out_of(pose, local.center),
                turn_out_of(pose, local.normal),
                turn_out_of(pose, local.motion),
                local.theta,
                local.spin,
                local.whole,
            )
        at += places(entry)
    return found


@jit
def roll_flat_on(method: Any, objects: Any, index: float, radius: float, normal: Vec3, turn: Quaternion) -> Roll:
    """`roll` in the tangent plane of the object with that place; of the Roll, `motion` and the angles."""
    found = Roll(normal, normal, (0.0, 0.0, 0.0), 0.0, 0.0, True)
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            pose = body.pose
            n, axis = turn_into(pose, normal), turn_into(pose, (turn[1], turn[2], turn[3]))
            turned = (turn[0], axis[0], axis[1], axis[2])
            local = roll(method, tangent_plane(body.shape, n), radius, vec3.scale(radius, n), n, turned)
            found = Roll(normal, normal, turn_out_of(pose, local.motion), local.theta, local.spin, True)
        at += places(entry)
    return found


@jit
def is_inside(objects: Any, index: float) -> bool:
    """Whether the object with that place is touched from inside."""
    inside = False
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            inside = is_hollow(body.shape)
        at += places(entry)
    return inside


@jit
def swings_on(objects: Any, index: float, radius: float, center: Vec3, normal: Vec3, theta: float) -> bool:
    """Whether a roll by `theta` rad takes the contact round a hollow so far that its way cannot be followed.

    The contact turns by k r theta, k the curvature of the surface that the centre moves on: any number of times the
    roll in a hollow that the fingertip nearly fills.
    """
    swings = False
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            point = into(body.pose, vec3.add_scaled(center, -radius, normal))
            swings = bend(body.shape, radius, point, turn_into(body.pose, normal)) * radius * theta > SWING
        at += places(entry)
    return swings


@jit
def follows_on(objects: Any, index: float, radius: float, start: OffsetPoint, end: Vec3) -> bool:
    """`follows` of the object with that place, in the world."""
    leads = True
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            begun = into(body.pose, start.center)
            leads = follows(body.shape, radius, begun, turn_into(body.pose, start.normal), into(body.pose, end))
        at += places(entry)
    return leads


@jit
def pose_of(objects: Any, index: float) -> Pose:
    """Pose of the object with that place."""
    found = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = pose_values(body.pose)
        at += places(entry)
    return found


@jit
def transport_on(objects: Any, index: float, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    """`transport` on the object with that place; directions are the world's."""
    found = v
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            found = transport(body.shape, v, normal_from, normal_to)
        at += places(entry)
    return found


@by_type
def beside_of(shape: Any, x: Vec3) -> Any:
    """How far on in the tuple the object is that lies beyond the edge of this one at which `x` is; 0 for itself."""


@beside_of.otherwise
def beside_nothing(shape: Any, x: Vec3) -> float:
    return 0.0


@beside_of.of(Facet)
def beside_facet(shape: Facet, x: Vec3) -> float:
    return beyond_edge(shape.mesh, shape.number, x) - shape.number


@jit
def beside_on(objects: Any, index: float, x: Vec3) -> float:
    """Place of the object that is nearer to `x` (3,) m than the one with that place, whose edge it is beyond."""
    beyond = index
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            body = member(entry, index - at)
            beyond = index + beside_of(body.shape, into(body.pose, x))
        at += places(entry)
    return beyond


class Deepest(NamedTuple):
    """The object nearest to a point: the gap (m), its place, -1 for none, and what is left of the budget; below 0 it
    was used up on a mesh or a height map, and the gap may be only a bound below which nothing is."""

    gap: float
    place: float
    left: int


@by_type
def nearest_in(entry: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Any:
    """`deepest` among the objects of an entry that begins with the place `at`, as numbers in it."""


@nearest_in.otherwise
def nearest_of_object(entry: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Deepest:
    return nearest_of_shape(entry.shape, into(entry.pose, x), within, at, known, budget)


@by_type
def nearest_of_shape(shape: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Any:
    """The same of a shape, in its frame."""


@nearest_of_shape.otherwise
def gap_of_it(shape: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Deepest:
    gap, _, _ = closest(shape, x)
    return Deepest(gap, 0.0, budget)


@nearest_of_shape.of(Mesh)
def gap_of_nearest_facet(shape: Mesh, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Deepest:
    enough = ENOUGH * within if within < EVERYWHERE else 0.0
    known = (known[0] - at, known[1] - at, known[2] - at)
    gap, number, left = nearest_facet(shape, x, within, known, budget, enough)
    return Deepest(gap, number, left)


@nearest_of_shape.of(Heightmap)
def gap_over_heightmap(shape: Heightmap, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Deepest:
    near = gap_within(shape, x, within, budget)
    return Deepest(near.gap, 0.0, left_of(budget, near.whole, near.spent))


@nearest_in.of(Rows)
def smallest_gap_in_rows(entry: Any, x: Vec3, within: float, at: float, known: Vec3, budget: int) -> Deepest:
    smallest, number = 1e300, 0.0
    for i in range(len(entry)):
        body = entry[i]
        gap, _, budget = nearest_of_shape(body.shape, into(body.pose, x), within, at + i, known, budget)
        if gap < smallest:
            smallest, number = gap, float(i)
    return Deepest(smallest, number, budget)


@jit
def deepest(objects: Any, x: Vec3, within: float, known: Vec3, budget: int) -> Deepest:
    """Smallest gap of `x` (3,) m over all objects.

    within        m  gaps beyond it may be left out; of no object, then, is the gap 1e300
    known   (3,)     places of up to three objects, -1 for none, to which no equally near triangle of their mesh is
                     preferred
    budget           nodes and triangles of meshes, and tiles of height maps, that may be asked
    """
    smallest, index = 1e300, -1.0
    at = 0.0
    for entry in literal_unroll(objects):
        gap, number, budget = nearest_in(entry, x, within, at, known, budget)
        if gap < smallest:
            smallest, index = gap, at + number
        at += places(entry)
    return Deepest(smallest, index, budget)
