"""Functions that depend on the fingertip's form: contact points, curvature, torques and velocities.

The form is None for a ball, which has only a radius, or an EllipsoidTip. For an ellipsoid, `minkowski_objects` replaces
each object by the Minkowski sum of both, shrunk by a ball of the finger's radius. Detection, rest, slip and release
then treat the fingertip as this ball.
"""

from typing import Any

from softfinger.proxy.kernels.contact.carry import relative_rotation
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import EllipsoidTip, Many, MinkowskiSum, Probe, Quaternion, Single, Tip, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.frames import pose_values
from softfinger.proxy.kernels.shapes.minkowski import support_vector


@by_type
def minkowski_objects(form: Any, radius: float, objects: Any, orientation: Quaternion) -> Any:
    """Return the objects as obstacles of a ball of the finger's radius; `orientation` fingertip to world."""


@by_type
def point_on(form: Any, radius: float, inward: Vec3) -> Any:
    """Return the contact point (3,) m in the fingertip frame; `inward` (3,) is the object's normal in that frame."""


@by_type
def point_under(form: Any, radius: float, orientation: Quaternion, center: Vec3, normal: Vec3) -> Any:
    """Return the contact point (3,) m, world frame, of a fingertip at `center` (3,) m on an object with that normal."""


@by_type
def radius_of_curvature(form: Any, radius: float, orientation: Quaternion, normal: Vec3) -> Any:
    """Return the geometric mean of the two principal radii of curvature at the contact, m."""


@by_type
def torque_of(
    form: Any, radius: float, orientation: Quaternion, normal: Vec3, moment: float, pressing: Vec3, tangential: Vec3
) -> Any:
    """Return the torque (3,) N m about the centre.

    moment                      N m  about the normal
    pressing, tangential  (3,)  N    forces at the contact
    """


@by_type
def velocity_at(
    form: Any, velocity: Vec3, carried: Any, probe: Probe, last: Probe, normal: Vec3, dt: float
) -> Any:  # fmt: skip
    """Return a velocity (3,) m/s with the normal component of the fingertip's surface at the contact.

    velocity  (3,) m/s  of the centre; like the result, relative to the object
    carried             motion of the object, see `carry`
    last                probe at the last tick
    dt        s         time since then; 0 if it has not rotated
    """


# --- a ball: normal and tangential forces are separate, since normal forces act through its centre ------------------


@minkowski_objects.of(None)
def objects_for_ball(form: None, radius: float, objects: Any, orientation: Quaternion) -> Any:
    return objects


@point_on.of(None)
def point_on_ball(form: None, radius: float, inward: Vec3) -> Vec3:
    return vec3.scale(-radius, inward)


@point_under.of(None)
def point_under_ball(form: None, radius: float, orientation: Quaternion, center: Vec3, normal: Vec3) -> Vec3:
    return vec3.add_scaled(center, -radius, normal)


@radius_of_curvature.of(None)
def radius_of_curvature_of_ball(form: None, radius: float, orientation: Quaternion, normal: Vec3) -> float:
    return radius


@torque_of.of(None)
def torque_of_ball(
    form: None, radius: float, orientation: Quaternion, normal: Vec3, moment: float, pressing: Vec3, tangential: Vec3
) -> Vec3:
    return vec3.add_scaled(vec3.scale(moment, normal), -radius, vec3.cross(normal, tangential))


@velocity_at.of(None)
def velocity_of_ball(
    form: None, velocity: Vec3, carried: Any, probe: Probe, last: Probe, normal: Vec3, dt: float
) -> Vec3:
    return velocity


# --- an ellipsoid --------------------------------------------------------------------------------


@jit
def axes_in_world(form: EllipsoidTip, orientation: Quaternion) -> Quaternion:
    return rotations.multiply(orientation, form.orientation)


@minkowski_objects.of(EllipsoidTip)
def objects_for_ellipsoid(form: EllipsoidTip, radius: float, objects: Any, orientation: Quaternion) -> Any:
    return with_minkowski_sums(objects, Tip(form.semi_axes, axes_in_world(form, orientation), radius))


@by_type
def with_minkowski_sums(objects: Any, tip: Tip) -> Any:
    """Return the objects as the centre of an ellipsoidal fingertip sees them."""


@with_minkowski_sums.of(Single)
def single_with_minkowski_sum(objects: Single, tip: Tip) -> Single:
    body = objects.body
    axes = rotations.multiply(rotations.conjugate(pose_values(body.pose).orientation), tip.orientation)
    return replace(objects, "body", replace(body, "shape", MinkowskiSum(body.shape, tip.semi_axes, axes, tip.radius)))


@with_minkowski_sums.of(Many)
def many_with_minkowski_sums(objects: Many, tip: Tip) -> Many:
    return replace(objects, "tip", tip)


@point_on.of(EllipsoidTip)
def point_on_ellipsoid(form: EllipsoidTip, radius: float, inward: Vec3) -> Vec3:
    return vec3.scale(-1.0, support_vector(form.semi_axes, form.orientation, inward))


@point_under.of(EllipsoidTip)
def point_under_ellipsoid(
    form: EllipsoidTip, radius: float, orientation: Quaternion, center: Vec3, normal: Vec3
) -> Vec3:
    return vec3.sub(center, support_vector(form.semi_axes, axes_in_world(form, orientation), normal))


@radius_of_curvature.of(EllipsoidTip)
def radius_of_curvature_of_ellipsoid(form: EllipsoidTip, radius: float, orientation: Quaternion, normal: Vec3) -> float:
    """Return 1 / sqrt(K) with the Gaussian curvature K = h^4 / (a b c)^2."""
    a = form.semi_axes
    h = vec3.dot(support_vector(a, axes_in_world(form, orientation), normal), normal)
    return (a[0] / h) * (a[1] / h) * a[2]


@torque_of.of(EllipsoidTip)
def torque_of_ellipsoid(
    form: EllipsoidTip,
    radius: float,
    orientation: Quaternion,
    normal: Vec3,
    moment: float,
    pressing: Vec3,
    tangential: Vec3,
) -> Vec3:
    reach = support_vector(form.semi_axes, axes_in_world(form, orientation), normal)
    return vec3.sub(vec3.scale(moment, normal), vec3.cross(reach, vec3.add(pressing, tangential)))


@velocity_at.of(EllipsoidTip)
def velocity_of_ellipsoid(
    form: EllipsoidTip, velocity: Vec3, carried: Any, probe: Probe, last: Probe, normal: Vec3, dt: float
) -> Vec3:
    """Return v - w x arm: rotating an ellipsoid changes its depth. Without this part, damping would generate energy."""
    if dt <= 0.0:
        return velocity
    turn = rotations.log(relative_rotation(carried, rotations.relative(probe.orientation, last.orientation)))
    reach = support_vector(form.semi_axes, axes_in_world(form, probe.orientation), normal)
    return vec3.add_scaled(velocity, -1.0 / dt, vec3.cross(turn, reach))
