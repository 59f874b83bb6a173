"""Functions that depend on the fingertip's form: contact points, curvature, torques and velocities.

The form is None for a ball, which has only a radius, or an EllipsoidTip. For an ellipsoid, `minkowski_objects` replaces
each object by the Minkowski sum of both, shrunk by a ball of the finger's radius. Detection, rest, slip and release
then treat the fingertip as this ball.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import FingertipForm, Many, MinkowskiSum, Probe, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.frames import pose_values
from softfinger.proxy.kernels.query.carry import compute_relative_rotation
from softfinger.proxy.kernels.shapes.minkowski import support_vector


@jit
def minkowski_objects(form: Any, radius: float, objects: Any, orientation: Quaternion) -> Any:
    """Return the objects as obstacles of a ball of the finger's radius; `orientation` fingertip to world."""
    if form is None:
        return objects
    turn = rotations.multiply(orientation, form.orientation)
    if isinstance(objects, Many):
        return replace(objects, "tip", FingertipForm(form.semi_axes, turn, radius))
    body = objects.body
    axes = rotations.multiply(rotations.conjugate(pose_values(body.pose).orientation), turn)
    return replace(objects, "body", replace(body, "shape", MinkowskiSum(body.shape, form.semi_axes, axes, radius)))


@jit
def compute_arm(form: Any, radius: float, orientation: Quaternion, normal: Vec3) -> Vec3:
    """Return the displacement (3,) m from the contact point to the fingertip's centre.

    orientation  fingertip to the frame of `normal`
    normal       (3,)  of the object
    """
    if form is None:
        return vec3.scale(radius, normal)
    return support_vector(form.semi_axes, rotations.multiply(orientation, form.orientation), normal)


@jit
def find_finger_point(form: Any, radius: float, inward: Vec3) -> Vec3:
    """Return the contact point (3,) m in the fingertip frame; `inward` (3,) is the object's normal in that frame."""
    if form is None:
        return vec3.scale(-radius, inward)
    return vec3.scale(-1.0, support_vector(form.semi_axes, form.orientation, inward))


@jit
def find_contact_point(form: Any, radius: float, orientation: Quaternion, center: Vec3, normal: Vec3) -> Vec3:
    """Return the contact point (3,) m, world frame, of a fingertip at `center` (3,) m on an object with that normal."""
    return vec3.sub(center, compute_arm(form, radius, orientation, normal))


@jit
def compute_radius_of_curvature(form: Any, radius: float, orientation: Quaternion, normal: Vec3) -> float:
    """Return the geometric mean of the two principal radii of curvature at the contact, m.

    For an ellipsoid 1 / sqrt(K) with the Gaussian curvature K = h^4 / (a b c)^2.
    """
    if form is None:
        return radius
    a = form.semi_axes
    h = vec3.dot(compute_arm(form, radius, orientation, normal), normal)
    return (a[0] / h) * (a[1] / h) * a[2]


@jit
def compute_torque(
    form: Any, radius: float, orientation: Quaternion, normal: Vec3, moment: float, pressing: Vec3, tangential: Vec3
) -> Vec3:
    """Return the torque (3,) N m about the centre.

    moment                      N m  about the normal
    pressing, tangential  (3,)  N    forces at the contact; the normal force of a ball acts through its centre
    """
    spin = vec3.scale(moment, normal)
    if form is None:
        return vec3.add_scaled(spin, -radius, vec3.cross(normal, tangential))
    return vec3.sub(spin, vec3.cross(compute_arm(form, radius, orientation, normal), vec3.add(pressing, tangential)))


@jit
def add_surface_velocity(
    form: Any, velocity: Vec3, carry: Any, probe: Probe, last: Probe, normal: Vec3, dt: float
) -> Vec3:
    """Return a velocity (3,) m/s with the normal component of the fingertip's surface at the contact.

    velocity  (3,) m/s  of the centre; like the result, relative to the object
    carry               motion of the object, see `make_carry`
    last                probe at the last tick
    dt        s         time since then; 0 if it has not rotated

    For an ellipsoid v - w x arm: rotating it changes its depth. Without this part, damping would generate energy.
    """
    if form is None or dt <= 0.0:
        return velocity
    turn = rotations.log(compute_relative_rotation(carry, rotations.relative(probe.orientation, last.orientation)))
    return vec3.add_scaled(velocity, -1.0 / dt, vec3.cross(turn, compute_arm(form, 0.0, probe.orientation, normal)))
