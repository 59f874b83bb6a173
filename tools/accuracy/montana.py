"""Montana's equations of contact: coordinates of the contact on both surfaces, and the contact angle.

The rolling methods use the same kinematics without coordinates (`rolling`), so that they have no poles and no charts.
This module has the published form, to check them and to show its cost.

    compute_chart(shape, u, v)  ->  SurfacePoint Gauss frame, metric M, curvature K and torsion T
    compute_rolling_rates(...)  ->  Coordinates  d/dt of (u_f, v_f, u_o, v_o, psi)

A chart f(u, v) is orthogonal and right-handed, with x along f_u, y along f_v and z = x x y the outward normal. Then
K = (x, y)^T (z_u / |f_u|, z_v / |f_v|) and T = y^T (x_u / |f_u|, x_v / |f_v|). The surfaces here are planes and
surfaces of revolution. Their charts follow the lines of curvature, so K is diagonal. An ellipsoid must have two equal
axes, the first two. The charts of sphere and ellipsoid have poles at v = +-pi/2.

Source: Montana (1988), The Kinematics of Contact and Grasp; Murray, Li, Sastry (1994), section 5.6.
"""

from math import cos, hypot, sin
from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Cylinder, Ellipsoid, Plane, Sphere, Torus, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3

Pair = tuple[float, float]
Profile = tuple[float, float, float, float, float, float]


class SurfacePoint(NamedTuple):
    """Surface at one of its points.

    point       (3,)    m
    x, y, z     (3,)    1    Gauss frame, z the unit normal
    metric      (2,)         |f_u|, |f_v|: the diagonal of M
    curvature   (2,)    1/m  diagonal of K, positive if convex
    torsion     (2,)    1/m  T
    """

    point: Vec3
    x: Vec3
    y: Vec3
    z: Vec3
    metric: Pair
    curvature: Pair
    torsion: Pair


class Coordinates(NamedTuple):
    """Contact coordinates.

    u_f, v_f   on the fingertip: longitude and latitude, rad
    u_o, v_o   on the object: m on a plane; otherwise the angle about the axis and the parameter of the profile
    psi        rad  contact angle: turning the contact frame of the object by -psi about its normal aligns the x axes
    """

    u_f: float
    v_f: float
    u_o: float
    v_o: float
    psi: float


@by_type
def compute_chart(shape: Any, u: float, v: float) -> Any:
    """Return the surface at the coordinates (u, v)."""


@by_type
def profile(shape: Any, v: float) -> Any:
    """Return distance from the axis and height at v, each with its first two derivatives."""


@compute_chart.of(Plane)
def compute_plane_chart(shape: Plane, u: float, v: float) -> SurfacePoint:
    x, y = rotations.tangent_frame(shape.normal)
    point = vec3.add_scaled(vec3.add_scaled(vec3.scale(shape.offset, shape.normal), u, x), v, y)
    return SurfacePoint(point, x, y, shape.normal, (1.0, 1.0), (0.0, 0.0), (0.0, 0.0))


@profile.of(Sphere)
def profile_of_sphere(shape: Sphere, v: float) -> Profile:
    c, s = shape.radius * cos(v), shape.radius * sin(v)
    return c, -s, -c, s, c, -s


@profile.of(Cylinder)
def profile_of_cylinder(shape: Cylinder, v: float) -> Profile:
    return shape.radius, 0.0, 0.0, v, 1.0, 0.0


@profile.of(Torus)
def profile_of_torus(shape: Torus, v: float) -> Profile:
    c, s = shape.minor * cos(v), shape.minor * sin(v)
    return shape.major + c, -s, -c, s, c, -s


@profile.of(Ellipsoid)
def profile_of_spheroid(shape: Ellipsoid, v: float) -> Profile:
    a, b = shape.semi_axes[0], shape.semi_axes[2]
    return a * cos(v), -a * sin(v), -a * cos(v), b * sin(v), b * cos(v), -b * sin(v)


def rotate_profile(shape: Any, u: float, v: float) -> SurfacePoint:
    """Return the chart of a profile rotated about the z axis; from inside, v is reversed so that z points inwards."""
    side = shape.side
    out, d_out, dd_out, up, d_up, dd_up = profile(shape, side * v)
    m = hypot(d_out, d_up)
    c, s = cos(u), sin(u)
    y = (side * d_out * c / m, side * d_out * s / m, side * d_up / m)
    z = (side * d_up * c / m, side * d_up * s / m, -side * d_out / m)
    bent = (d_out * dd_up - d_up * dd_out) / (m * m * m)
    return SurfacePoint(
        (out * c, out * s, up), (-s, c, 0.0), y, z,
        (out, m), (side * d_up / (m * out), side * bent), (-side * d_out / (m * out), 0.0),
    )  # fmt: skip


for _shape in (Sphere, Cylinder, Torus, Ellipsoid):
    compute_chart.of(_shape)(rotate_profile)


@jit
def compute_finger_axes(on_object: SurfacePoint, psi: float) -> tuple[Vec3, Vec3, Vec3]:
    """Return the contact frame of the fingertip in the object frame; its z points out of the fingertip, along -z_o.

    x_f = cos psi x_o - sin psi y_o, y_f = -sin psi x_o - cos psi y_o: the columns of R_psi.
    """
    c, s = cos(psi), sin(psi)
    x = vec3.add_scaled(vec3.scale(c, on_object.x), -s, on_object.y)
    y = vec3.add_scaled(vec3.scale(-s, on_object.x), -c, on_object.y)
    return x, y, vec3.scale(-1.0, on_object.z)


@jit
def compute_rates(radius: float, shape: Any, at: Coordinates, omega: Vec3, velocity: Pair) -> Coordinates:
    """Return the rates of the contact coordinates while the fingertip rolls, slides and spins on the object.

    radius         m      of the fingertip
    at                    Coordinates
    omega    (3,)  rad/s  fingertip against object, in the contact frame of the fingertip
    velocity (2,)  m/s    slip of the fingertip over the object at the contact, in the same frame
    returns               Coordinates per second

    Montana's equations, with K_f + R_psi K_o R_psi the relative curvature:
        M_f (u_f, v_f)' = (K_f + R K_o R)^-1 ((-omega_y, omega_x) - R K_o R (v_x, v_y))
        M_o (u_o, v_o)' = R (K_f + R K_o R)^-1 ((-omega_y, omega_x) + K_f (v_x, v_y))
        psi' = omega_z + T_f M_f (u_f, v_f)' + T_o M_o (u_o, v_o)'
    """
    finger = compute_chart(Sphere(radius, 1.0), at.u_f, at.v_f)
    surface = compute_chart(shape, at.u_o, at.v_o)
    c, s = cos(at.psi), sin(at.psi)
    k1, k2 = surface.curvature
    # R K R for diagonal K: symmetric, entries a, b / b, d.
    a, b, d = c * c * k1 + s * s * k2, -c * s * k1 + c * s * k2, s * s * k1 + c * c * k2
    kf = finger.curvature[0]
    determinant = (kf + a) * (kf + d) - b * b

    px, py = -omega[1] - a * velocity[0] - b * velocity[1], omega[0] - b * velocity[0] - d * velocity[1]
    fx, fy = ((kf + d) * px - b * py) / determinant, ((kf + a) * py - b * px) / determinant
    qx, qy = -omega[1] + kf * velocity[0], omega[0] + kf * velocity[1]
    gx, gy = ((kf + d) * qx - b * qy) / determinant, ((kf + a) * qy - b * qx) / determinant
    ox, oy = c * gx - s * gy, -s * gx - c * gy
    (f_u, f_v), (o_u, o_v) = finger.metric, surface.metric
    spin_rate = finger.torsion[0] * fx + finger.torsion[1] * fy + surface.torsion[0] * ox + surface.torsion[1] * oy
    return Coordinates(fx / f_u, fy / f_v, ox / o_u, oy / o_v, omega[2] + spin_rate)


@jit
def compute_rolling_rates(radius: float, shape: Any, at: Coordinates, w: Vec3) -> Coordinates:
    """Return the rates while rolling without slip at the angular velocity `w` (3,) rad/s in the object frame."""
    x, y, z = compute_finger_axes(compute_chart(shape, at.u_o, at.v_o), at.psi)
    return compute_rates(radius, shape, at, (vec3.dot(w, x), vec3.dot(w, y), vec3.dot(w, z)), (0.0, 0.0))


@jit
def advance(at: Coordinates, h: float, by: Coordinates) -> Coordinates:
    return Coordinates(
        at.u_f + h * by.u_f, at.v_f + h * by.v_f, at.u_o + h * by.u_o, at.v_o + h * by.v_o, at.psi + h * by.psi
    )
