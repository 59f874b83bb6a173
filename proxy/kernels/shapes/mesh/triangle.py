"""Single triangle: its point nearest to x, the feature of that point (face, edge, corner), and the side of x."""

from typing import NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.model import Mesh, Triangles, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import Z_AXIS, any_tangent, compute_direction

FACE_FEATURE = 6
"""Number of the face as a feature of the triangle; 0 to 2 are its edges, 3 to 5 its corners."""
CORNER_TRIANGLES_MAX = 12
"""Limit of the triangles visited round a corner, in each direction."""
SAME_DISTANCE_SHARE = 1e-11
"""Share by which squared distances from an edge or a corner must differ, so that the difference is not rounding."""
CORNER_SHARE = 100.0 * SAME_DISTANCE_SHARE
"""Limit for a foot point on an edge: its squared distance from a corner as a share of that from x. Below it, another
triangle round the corner may be closer, while the one across the edge is closer only by rounding."""
ON_TRIANGLE_SHARE = 1e-14
"""Distance, as a share of the mesh's size, below which the direction from the triangle to a point is rounding."""


class Corners(NamedTuple):
    """Vertices (3,) m of a triangle."""

    a: Vec3
    b: Vec3
    c: Vec3


class Foot(NamedTuple):
    """Nearest point of a triangle.

    point             (3,)  m
    squared_distance        m^2
    feature                 number of the edge or corner that it is on, otherwise FACE_FEATURE
    weights           (3,)  barycentric coordinates
    """

    point: Vec3
    squared_distance: float
    feature: int
    weights: Vec3


@jit
def read_vertex(mesh: Triangles, vertex: int) -> Vec3:
    first = 3 * vertex
    return (mesh.vertices[first], mesh.vertices[first + 1], mesh.vertices[first + 2])


@jit
def read_corners(mesh: Triangles, triangle: int) -> Corners:
    first = 3 * triangle
    return Corners(
        read_vertex(mesh, int(mesh.corners[first])),
        read_vertex(mesh, int(mesh.corners[first + 1])),
        read_vertex(mesh, int(mesh.corners[first + 2])),
    )


@jit
def find_foot(corners: Corners, x: Vec3, feature: int, weights: Vec3) -> Foot:
    """Compute the point relative to a corner: a weighted sum of all corners would have the rounding of coordinates."""
    a, b, c = corners
    if feature == FACE_FEATURE:
        point = vec3.add_scaled(vec3.add_scaled(a, weights[1], vec3.sub(b, a)), weights[2], vec3.sub(c, a))
    elif feature == 0:
        point = vec3.add_scaled(a, weights[1], vec3.sub(b, a))
    elif feature == 1:
        point = vec3.add_scaled(b, weights[2], vec3.sub(c, b))
    elif feature == 2:
        point = vec3.add_scaled(c, weights[0], vec3.sub(a, c))
    else:
        point = a if feature == 3 else (b if feature == 4 else c)
    offset = vec3.sub(x, point)
    return Foot(point, vec3.dot(offset, offset), feature, weights)


@jit
def find_foot_on(corners: Corners, x: Vec3) -> Foot:
    """Find the nearest point by Voronoi regions of corners and edges: Ericson, Real-Time Collision Detection, 5.1.5."""
    a, b, c = corners
    ab, ac, ax = vec3.sub(b, a), vec3.sub(c, a), vec3.sub(x, a)
    d1, d2 = vec3.dot(ab, ax), vec3.dot(ac, ax)
    if d1 <= 0.0 and d2 <= 0.0:
        return find_foot(corners, x, 3, (1.0, 0.0, 0.0))
    bx = vec3.sub(x, b)
    d3, d4 = vec3.dot(ab, bx), vec3.dot(ac, bx)
    if d3 >= 0.0 and d4 <= d3:
        return find_foot(corners, x, 4, (0.0, 1.0, 0.0))
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        share = d1 / (d1 - d3) if d1 > d3 else 0.0
        return find_foot(corners, x, 0, (1.0 - share, share, 0.0))
    cx = vec3.sub(x, c)
    d5, d6 = vec3.dot(ab, cx), vec3.dot(ac, cx)
    if d6 >= 0.0 and d5 <= d6:
        return find_foot(corners, x, 5, (0.0, 0.0, 1.0))
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        share = d2 / (d2 - d6) if d2 > d6 else 0.0  # weight of c
        return find_foot(corners, x, 2, (1.0 - share, 0.0, share))
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        total = (d4 - d3) + (d5 - d6)
        share = (d4 - d3) / total if total > 0.0 else 0.0
        return find_foot(corners, x, 1, (0.0, 1.0 - share, share))
    scale = 1.0 / (va + vb + vc)
    v, w = vb * scale, vc * scale
    return find_foot(corners, x, FACE_FEATURE, (1.0 - v - w, v, w))


@jit
def compute_face_normal(corners: Corners) -> Vec3:
    """Return the unit normal (3,), towards the side from which the corners are counter-clockwise."""
    area_vector = vec3.cross(vec3.sub(corners.b, corners.a), vec3.sub(corners.c, corners.a))
    _, normal = compute_direction(area_vector, Z_AXIS)
    return normal


@jit
def compute_pseudonormal(mesh: Triangles, triangle: int, corners: Corners, feature: int) -> Vec3:
    """Return the pseudonormal (3,), not of unit length, of the feature that the nearest point is on.

    It distinguishes outside from inside: at an edge the sum of the normals of both faces, at a corner that of all,
    weighted by their angles. Source: Baerentzen and Aanaes, Signed distance computation using the angle weighted
    pseudonormal, 2005.
    """
    normal = compute_face_normal(corners)
    if feature < 3:
        neighbour = int(mesh.across[3 * triangle + feature])
        if neighbour >= 0:
            normal = vec3.add(normal, compute_face_normal(read_corners(mesh, neighbour)))
    elif feature < FACE_FEATURE:
        first = 3 * int(mesh.corners[3 * triangle + feature - 3])
        normal = (mesh.upward[first], mesh.upward[first + 1], mesh.upward[first + 2])
    return normal


@jit
def is_nearer(foot: Foot, square: float) -> bool:
    """Return True if a foot point on another triangle is closer than a shared edge or corner at that squared distance.

    On an edge or a corner, it has to be closer by more than rounding: otherwise two triangles could alternate.
    """
    return (
        foot.squared_distance <= square
        if foot.feature == FACE_FEATURE
        else foot.squared_distance < square * (1.0 - SAME_DISTANCE_SHARE)
    )


@jit
def find_nearer_round_corner(mesh: Triangles, start: int, feature: int, x: Vec3, square: float) -> int:
    """Return the closest of the triangles round a corner if it is closer to `x` than the corner, otherwise -1.

    feature       corner 0, 1 or 2 of the triangle `start`
    square   m^2  squared distance of the corner

    Visits the triangles connected by edges, up to CORNER_TRIANGLES_MAX in each direction, without a descent: for most
    of them the corner is the nearest point, so their distances do not show where a closer one is.
    """
    vertex, nearest = mesh.corners[3 * start + feature], -1
    for side in (0, 2):  # across the edge that starts at the corner, and across the one that ends there
        triangle, corner = start, feature
        for _ in range(CORNER_TRIANGLES_MAX):
            triangle = int(mesh.across[3 * triangle + (corner + side) % 3])
            if triangle < 0 or triangle == start:
                break
            corner = 0
            while corner < 2 and mesh.corners[3 * triangle + corner] != vertex:
                corner += 1
            foot = find_foot_on(read_corners(mesh, triangle), x)
            if is_nearer(foot, square):
                nearest, square = triangle, foot.squared_distance
        if triangle == start:
            break
    return nearest


@jit
def find_near_corner(corners: Corners, foot: Foot) -> int:
    """Return the index of the corner at a foot point, or close to a foot point on an edge; -1 if there is none."""
    if foot.feature >= 3:
        return foot.feature - 3
    for i in range(3):
        offset = vec3.sub(foot.point, corners[i])
        if vec3.dot(offset, offset) <= CORNER_SHARE * foot.squared_distance:
            return i
    return -1


@outlined
def nearer_neighbour(shape: Mesh, triangle: float, x: Vec3) -> float:
    """Return the triangle across the edge or round the corner nearest to `x`, if it is closer; otherwise this one."""
    mesh, k = shape.row[0], int(triangle)
    corners = read_corners(mesh, k)
    foot = find_foot_on(corners, x)
    if foot.feature == FACE_FEATURE:
        return triangle
    if foot.feature < 3:
        neighbour = int(mesh.across[3 * k + foot.feature])
        if neighbour >= 0 and is_nearer(find_foot_on(read_corners(mesh, neighbour), x), foot.squared_distance):
            return float(neighbour)
    corner = find_near_corner(corners, foot)
    nearer = find_nearer_round_corner(mesh, k, corner, x, foot.squared_distance) if corner >= 0 else -1
    return triangle if nearer < 0 else float(nearer)


@outlined
def offset_curvature_on_triangle(
    shape: Mesh, triangle: float, radius: float, x: Vec3, normal: Vec3
) -> tuple[float, float, Vec3]:
    """Return both curvatures of the surface on which a centre at `x` (3,) m moves, 1/m, and the tangent of the first.

    It is a plane over the face, a cylinder round an edge, and a sphere round a corner, with the fingertip's radius.
    """
    mesh, k = shape.row[0], int(triangle)
    corners = read_corners(mesh, k)
    feature = find_foot_on(corners, x).feature
    if feature == FACE_FEATURE:
        return 0.0, 0.0, any_tangent(normal)
    if feature >= 3:
        return 1.0 / radius, 1.0 / radius, any_tangent(normal)
    first, second = corners[feature], corners[(feature + 1) % 3]
    _, across = compute_direction(vec3.cross(normal, vec3.sub(second, first)), any_tangent(normal))
    return 1.0 / radius, 0.0, across


@outlined
def compute_shaded_normal(shape: Mesh, triangle: float, x: Vec3, normal: Vec3) -> Vec3:
    """Return the unit normal (3,) interpolated from the vertices at the point of a triangle nearest to `x` (3,) m.

    It is on the side of `normal`, and equal to it if the vertices' normals cancel.
    """
    mesh, k = shape.row[0], int(triangle)
    foot = find_foot_on(read_corners(mesh, k), x)
    total = (0.0, 0.0, 0.0)
    for i in range(3):
        first = 3 * int(mesh.corners[3 * k + i])
        total = vec3.add_scaled(
            total, foot.weights[i], (mesh.upward[first], mesh.upward[first + 1], mesh.upward[first + 2])
        )
    _, smooth = compute_direction(total, normal)
    return smooth if vec3.dot(smooth, normal) >= 0.0 else vec3.scale(-1.0, smooth)


@outlined
def closest_on_triangle(shape: Mesh, triangle: float, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """Return the signed gap (m) of `x` (3,) m from a triangle, the nearest point (3,) m and the unit normal (3,) there.

    The normal points to the side of the fingertip; on an open mesh, to the side of x.
    """
    mesh, k = shape.row[0], int(triangle)
    corners = read_corners(mesh, k)
    foot = find_foot_on(corners, x)
    normal = compute_face_normal(corners)
    offset = vec3.sub(x, foot.point)
    if foot.feature == FACE_FEATURE:
        gap = vec3.dot(offset, normal)
        if mesh.side < 0.0 or (mesh.side == 0.0 and gap < 0.0):
            return -gap, foot.point, vec3.scale(-1.0, normal)
        return gap, foot.point, normal
    distance, outward = compute_direction(offset, normal)
    if mesh.side == 0.0:
        return distance, foot.point, outward
    pseudo = compute_pseudonormal(mesh, k, corners, foot.feature)
    if distance <= ON_TRIANGLE_SHARE * mesh.size:
        _, outward = compute_direction(pseudo, normal)
    elif vec3.dot(outward, pseudo) < 0.0:
        distance, outward = -distance, vec3.scale(-1.0, outward)
    return mesh.side * distance, foot.point, vec3.scale(mesh.side, outward)
