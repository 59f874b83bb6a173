"""Friction, torsion and rolling resistance of one contact, either the only one or one of several.

A contact is first predicted as if it stuck: object, probe and roll move it. `apply_friction` then computes how much of
this motion slips.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.fingertip import add_surface_velocity, compute_radius_of_curvature
from softfinger.proxy.kernels.contact.normal import compute_normal_force
from softfinger.proxy.kernels.contact.resistance import resist
from softfinger.proxy.kernels.contact.texture import apply_grip, apply_relief
from softfinger.proxy.kernels.friction.contact_patch import (
    ContactPatch,
    adapt_torsion,
    compute_contact_patch,
    compute_winding_unit,
)
from softfinger.proxy.kernels.friction.laws import rotate_law
from softfinger.proxy.kernels.friction.stick_slip import stick_slip
from softfinger.proxy.kernels.friction.torsion import find_spring, scale_stiffness
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import (
    ActiveSet,
    Constraint,
    ContactState,
    Coupling,
    Finger,
    FrictionInput,
    FrictionResult,
    Material,
    ProbeMotion,
    Quaternion,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import pose_values
from softfinger.proxy.kernels.query.carry import compute_relative_velocity, make_carry
from softfinger.proxy.kernels.query.container import find_object


class Ground(NamedTuple):
    """Properties of the object under a contact, apart from its shape.

    scene_index  index in the scene file
    material     with the friction at the contact point
    orientation  object to world
    carry        motion in this tick, see `make_carry`
    """

    scene_index: float
    material: Material
    orientation: Quaternion
    carry: Any


class Prediction(NamedTuple):
    """Contact as if it stuck during the tick.

    contact              with `push` and `normal` of this tick, `deflection` of the last tick moved with the object,
                         and `rolled_part` including the roll
    deflection  (3,) m   with the motion of this tick
    twist           rad  rotation about the normal
    is_new               True if the contact starts in this tick: nothing has moved it yet
    """

    contact: ContactState
    deflection: Vec3
    twist: float
    is_new: bool


class NormalForce(NamedTuple):
    """Normal force, N, and the unit vector (3,) of its direction on the hand."""

    size: float
    direction: Vec3


class ContactForces(NamedTuple):
    """Result of friction for one contact.

    result             FrictionResult
    patch              ContactPatch
    unit               of the torsional wind-up, see `compute_winding_unit`
    load     N         normal force during friction
    bend     (3,)      wind-up against rolling, see `ContactState.bend`
    bending  (3,) N m  its moment
    """

    result: FrictionResult
    patch: ContactPatch
    unit: float
    load: float
    bend: Vec3
    bending: Vec3


@jit
def find_ground(objects: Any, index: float) -> Ground:
    """Return the Ground of object `index`; `objects` have complete materials."""
    body = find_object(objects, index)
    return Ground(body.scene_index, body.material, pose_values(body.pose).orientation, make_carry(body))


@jit
def find_textured_ground(objects: Any, index: float, active: ActiveSet, center: Vec3) -> Ground:
    """Return `find_ground` with the friction that its texture has under the proxy's `center` (3,) m."""
    body = find_object(objects, index)
    body = apply_grip(body, index, active, center)
    return Ground(body.scene_index, body.material, pose_values(body.pose).orientation, make_carry(body))


@jit
def compute_load(
    finger: Finger, objects: Any, ground: Ground, constraint: Constraint, motion: ProbeMotion, is_new: bool
) -> NormalForce:
    """Return the normal force of a constraint; `is_new` is True in the first tick of a contact."""
    probe, last, dt = motion
    velocity = compute_relative_velocity(ground.carry, probe.velocity, last.position, dt)
    if not is_new:
        velocity = add_surface_velocity(finger, velocity, ground.carry, motion, constraint.normal)
    body = find_object(objects, constraint.object_index)
    depth, direction = apply_relief(body, constraint.depth, constraint.normal, probe.position)
    return NormalForce(compute_normal_force(ground.material.normal, depth, vec3.dot(velocity, direction)), direction)


@jit
def apply_friction(
    finger: Finger, objects: Any, ground: Ground, predicted: Prediction, motion: ProbeMotion
) -> ContactForces:
    """Compute friction, torsion and rolling resistance of a contact, which has the load share of the springs."""
    contact, material, share = predicted.contact, ground.material, predicted.contact.share
    constraint = Constraint(contact.object_index, contact.normal, contact.push)
    load = compute_load(finger, objects, ground, constraint, motion, predicted.is_new).size
    curvature_radius = compute_radius_of_curvature(finger, motion.probe.orientation, contact.normal)
    patch = compute_contact_patch(finger.patch, curvature_radius, material.compliance, load)
    unit = compute_winding_unit(find_spring(material.torsion), patch, share)
    result = stick_slip(
        rotate_law(material.friction, ground.orientation),
        adapt_torsion(scale_stiffness(material.torsion, share), patch),
        Coupling(
            share * finger.coupling.stiffness,
            share * finger.coupling.damping,
            share * finger.coupling.torsional_damping,
        ),
        share * finger.torque_stiffness,
        FrictionInput(
            radius=finger.radius,
            resolution=finger.position_resolution,
            dt=motion.dt,
            mode=contact.mode,
            normal=contact.normal,
            deflection=predicted.deflection,
            deflection_before=contact.deflection,
            rolled_part=contact.rolled_part,
            slip_speed=contact.slip_speed,
            slip_deflection=contact.slip_deflection,
            spin=contact.spin / unit,
            twist=predicted.twist,
            spin_slip_speed=contact.spin_slip_speed,
            spin_slip_angle=contact.spin_slip_angle / unit,
            normal_force=load,
        ),
    )
    bend, bending_moment = resist(finger, ground.carry, contact, predicted.is_new, motion, patch)
    return ContactForces(result, patch, unit, load, bend, bending_moment)


@jit
def with_friction_result(predicted: Prediction, forces: ContactForces) -> ContactState:
    """Return the predicted contact with the result of friction."""
    friction, unit = forces.result, forces.unit
    return replace(
        predicted.contact, "mode", friction.mode, "deflection", friction.deflection,
        "rolled_part", friction.rolled_part, "spin", friction.spin * unit,
        "slip_speed", friction.slip_speed, "slip_deflection", friction.slip_deflection,
        "spin_slip_speed", friction.spin_slip_speed, "spin_slip_angle", friction.spin_slip_angle * unit,
        "bend", forces.bend,
    )  # fmt: skip
