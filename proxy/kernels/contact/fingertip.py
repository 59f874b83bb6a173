"""Functions that depend on the fingertip's form: contact points, curvature, torques and velocities.

The form is None for a ball, which has only a radius, or an EllipsoidTip. For an ellipsoid, `minkowski_objects` replaces
each object by the Minkowski sum of both, shrunk by a ball of the finger's radius. Detection, rest, slip and release
then treat the fingertip as this ball.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Finger, FingertipForm, Many, MinkowskiSum, ProbeMotion, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.frames import pose_values
from softfinger.proxy.kernels.query.carry import compute_relative_rotation
from softfinger.proxy.kernels.shapes.minkowski import support_vector


@jit
def minkowski_objects(finger: Finger, objects: Any, orientation: Quaternion) -> Any:
    """Return the objects as obstacles of a ball of the finger's radius; `orientation` fingertip to world."""
    if finger.form is None:
        return objects
    semi_axes, to_world = finger.form.semi_axes, rotations.multiply(orientation, finger.form.orientation)
    if isinstance(objects, Many):
        return replace(objects, "tip", FingertipForm(semi_axes, to_world, finger.radius))
    body = objects.body
    axes = rotations.multiply(rotations.conjugate(pose_values(body.pose).orientation), to_world)
    return replace(objects, "body", replace(body, "shape", MinkowskiSum(body.shape, semi_axes, axes, finger.radius)))


@jit
def compute_arm(finger: Finger, orientation: Quaternion, normal: Vec3) -> Vec3:
    """Return the displacement (3,) m from the contact point to the fingertip's centre.

    orientation  fingertip to the frame of `normal`
    normal       (3,)  of the object
    """
    if finger.form is None:
        return vec3.scale(finger.radius, normal)
    return support_vector(finger.form.semi_axes, rotations.multiply(orientation, finger.form.orientation), normal)


@jit
def find_finger_point(finger: Finger, inward: Vec3) -> Vec3:
    """Return the contact point (3,) m in the fingertip frame; `inward` (3,) is the object's normal in that frame."""
    if finger.form is None:
        return vec3.scale(-finger.radius, inward)
    return vec3.scale(-1.0, support_vector(finger.form.semi_axes, finger.form.orientation, inward))


@jit
def find_contact_point(finger: Finger, orientation: Quaternion, center: Vec3, normal: Vec3) -> Vec3:
    """Return the contact point (3,) m, world frame, of a fingertip at `center` (3,) m on an object with that normal."""
    return vec3.sub(center, compute_arm(finger, orientation, normal))


@jit
def compute_radius_of_curvature(finger: Finger, orientation: Quaternion, normal: Vec3) -> float:
    """Return the geometric mean of the two principal radii of curvature at the contact, m.

    For an ellipsoid 1 / sqrt(K) with the Gaussian curvature K = h^4 / (a b c)^2.
    """
    if finger.form is None:
        return finger.radius
    a = finger.form.semi_axes
    h = vec3.dot(compute_arm(finger, orientation, normal), normal)
    return (a[0] / h) * (a[1] / h) * a[2]


@jit
def compute_torque(
    finger: Finger, orientation: Quaternion, normal: Vec3, moment: float, pressing: Vec3, tangential: Vec3
) -> Vec3:
    """Return the torque (3,) N m about the centre.

    moment                      N m  about the normal
    pressing, tangential  (3,)  N    forces at the contact; the normal force of a ball acts through its centre
    """
    spin = vec3.scale(moment, normal)
    if finger.form is None:
        return vec3.add_scaled(spin, -finger.radius, vec3.cross(normal, tangential))
    return vec3.sub(spin, vec3.cross(compute_arm(finger, orientation, normal), vec3.add(pressing, tangential)))


@jit
def add_surface_velocity(finger: Finger, velocity: Vec3, carry: Any, motion: ProbeMotion, normal: Vec3) -> Vec3:
    """Return a velocity (3,) m/s with the normal component of the fingertip's surface at the contact.

    velocity  (3,) m/s  of the centre; like the result, relative to the object
    carry               motion of the object, see `make_carry`

    For an ellipsoid v - w x arm: rotating it changes its depth. Without this part, damping would generate energy.
    """
    probe, last, dt = motion
    if finger.form is None or dt <= 0.0:
        return velocity
    turn = rotations.log(compute_relative_rotation(carry, rotations.relative(probe.orientation, last.orientation)))
    return vec3.add_scaled(velocity, -1.0 / dt, vec3.cross(turn, compute_arm(finger, probe.orientation, normal)))
