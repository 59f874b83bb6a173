"""Rolling in closed form: exact path for a constant angular velocity within the tick.

    unroll(shape, radius, center, normal, w) -> Roll            w: rotation vector of the tick

On all these surfaces the normal rotates at a constant rate, k times w or a component of it. The turning share
k = r / (r + R) is 0 on a plane, 1 on an edge or a corner (R = 0), and negative inside a hollow (R = -R_hollow). Motion
and spin are integrals of sines over the tick.
"""

from math import sin
from typing import Any

from softfinger.proxy.kernels.contact.rolling.base import Roll, land, roll
from softfinger.proxy.kernels.contact.rolling.integrated import integrate_by_midpoint
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import AnyShape, Cylinder, Facet, Plane, Quaternion, RotationVector, Sphere, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes import unroll
from softfinger.proxy.kernels.shapes.kernel_table import SLOTS, UNROLL, KernelSlot, call_kernel


@jit
def compute_turning_share(radius: float, distance: float) -> float:
    """Return k = r / (r + R) for `distance` = r + R; 0 if the fingertip fills a hollow and cannot roll."""
    return radius / distance if distance != 0.0 else 0.0


@jit
def turn_about(axis: Vec3, angle: float, v: Vec3) -> Vec3:
    """Rotate `v` by `angle` rad about the unit vector `axis`."""
    across = vec3.cross(axis, v)
    s = sin(0.5 * angle)
    return vec3.add_scaled(vec3.add_scaled(v, sin(angle), across), 2.0 * s * s, vec3.cross(axis, across))


@jit
def roll_over_sphere(radius: float, share: float, normal: Vec3, w: Vec3) -> tuple[Vec3, Vec3, float]:
    """Return normal (3,), motion (3,) m and spin (rad) after rolling by `w` over a sphere.

    n <- exp(k w) n, so w . n is constant. The centre moves on a small circle. Unrolled into the tangent plane, it is an
    arc that turns by k w . n; its chord is the motion.
    """
    spin = vec3.dot(w, normal)
    end = rotations.rotate(rotations.exp(vec3.scale(share, w)), normal)
    half = 0.5 * share * spin
    arc = vec3.scale(radius, vec3.cross(w, end))
    motion = vec3.scale(rotations.sinc_of_root(half * half), turn_about(end, -half, arc))
    return end, motion, spin


@jit
def roll_over_cylinder(radius: float, share: float, axis: Vec3, normal: Vec3, w: Vec3) -> tuple[Vec3, Vec3, float]:
    """Return normal (3,), motion (3,) m and spin (rad) after rolling by `w` over a cylinder; `axis` is a unit vector.

    The normal rotates about the axis by k w . axis at a constant rate. Travel along the axis and spin are the integrals
    of r (n x axis) . w and n . w over that rotation: their values at half the angle, times sin(h) / h with h half the
    angle. The cylinder unrolls into a plane, so the motion is the sum of the travels round and along the axis.
    """
    around = vec3.dot(w, axis)
    half = 0.5 * share * around
    half_way, end = turn_about(axis, half, normal), turn_about(axis, 2.0 * half, normal)
    mean = rotations.sinc_of_root(half * half)
    travel = radius * mean * vec3.dot(vec3.cross(half_way, axis), w)
    motion = vec3.add_scaled(vec3.scale(radius * around, vec3.cross(axis, end)), travel, axis)
    return end, motion, mean * vec3.dot(half_way, w)


@roll.of(RotationVector)
def roll_rotation_vector(
    method: RotationVector, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> Roll:
    """Roll by a constant angular velocity between the two poses, exact to rounding; for shapes with `unroll`."""
    return unroll(shape, radius, center, normal, rotations.log(turn))


NO_ROLL = Roll(ZERO, ZERO, ZERO, 0.0, 0.0, True)
SLOTS[UNROLL] = KernelSlot(unroll, (0.0, ZERO, ZERO, ZERO), NO_ROLL)


@unroll.of(AnyShape)
def unroll_on_any(shape: AnyShape, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    return call_kernel(shape, UNROLL, NO_ROLL, (radius, center, normal, w))


@unroll.of(Facet)
def unroll_on_facet(shape: Facet, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Roll in closed form on the face; round edges and corners, where the normal rotates, by the midpoint rule."""
    return integrate_by_midpoint(shape, radius, center, normal, w)


@unroll.of(Plane)
def unroll_on_plane(shape: Plane, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    motion = vec3.scale(radius, vec3.cross(w, normal))
    center, end = land(shape, radius, vec3.add(center, motion))
    return Roll(center, end, motion, vec3.norm(motion) / radius, vec3.dot(w, normal), True)


@unroll.of(Sphere)
def unroll_on_sphere(shape: Sphere, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    distance = radius + shape.side * shape.radius
    end, motion, spin = roll_over_sphere(radius, compute_turning_share(radius, distance), normal, w)
    center, end = land(shape, radius, vec3.scale(distance, end))
    return Roll(center, end, motion, vec3.norm(motion) / radius, spin, True)


@unroll.of(Cylinder)
def unroll_on_cylinder(shape: Cylinder, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    distance = radius + shape.side * shape.radius
    end, motion, spin = roll_over_cylinder(radius, compute_turning_share(radius, distance), (0.0, 0.0, 1.0), normal, w)
    moved = (distance * end[0], distance * end[1], center[2] + motion[2])
    center, end = land(shape, radius, moved)
    return Roll(center, end, motion, vec3.norm(motion) / radius, spin, True)
