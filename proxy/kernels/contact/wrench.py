"""The wrench of one of several contacts, what becomes of the contact, and what is told of it."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.contacts import Lever, Motion, levered, load_on, shear
from softfinger.proxy.kernels.contact.fingertip import point_under, radius_of_curvature, torque_of
from softfinger.proxy.kernels.contact.resistance import ResistanceInput, resist
from softfinger.proxy.kernels.friction.contact_patch import contact_patch, torsion_under, winding_unit
from softfinger.proxy.kernels.friction.laws import turned
from softfinger.proxy.kernels.friction.stick_slip import stick_slip
from softfinger.proxy.kernels.friction.torsion import share_of
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    NO_OUTCOME,
    ContactOutcome,
    ContactState,
    Coupling,
    Finger,
    Quaternion,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.objects import material_of, number_of, pose_of
from softfinger.proxy.record import CAUSE_NONE


class Wrench(NamedTuple):
    """What a contact does to the hand, torque about the fingertip's centre, and what becomes of it.

    after    ContactState
    cause    of its change of mode
    theta    rad    roll in this tick
    spin     rad    torsional wind-up
    torsion  N m    moment about the normal
    radius   m      of the contact patch
    """

    after: ContactState
    cause: float
    theta: float
    spin: float
    normal_force: Vec3
    tangential_force: Vec3
    torque: Vec3
    torsion: float
    radius: float


@jit
def wrench_of(
    rolling: Any, finger: Finger, objects: Any, contact: ContactState, lever: Lever, motion: Motion
) -> Wrench:
    """Friction and torsion of one of several contacts: with its own load, its own law, and its share of the springs."""
    zero = (0.0, 0.0, 0.0)
    if contact.body < 0.0:
        return Wrench(
            after=NO_CONTACT, cause=float(CAUSE_NONE), theta=0.0, spin=0.0,
            normal_force=zero, tangential_force=zero, torque=zero, torsion=0.0, radius=0.0,
        )  # fmt: skip
    material, share, normal = material_of(objects, contact.body), contact.share, contact.normal
    load = load_on(objects, contact, motion)
    orientation = motion.probe.orientation
    round_by = radius_of_curvature(finger.form, finger.radius, orientation, normal)
    area = contact_patch(finger.patch, round_by, material.compliance, load.size)
    unit = winding_unit(material.torsion, area, share)
    seen, theta = shear(rolling, objects, contact, lever, motion, load.size, unit)
    kept = stick_slip(
        turned(material.friction, pose_of(objects, contact.body).orientation),
        torsion_under(share_of(material.torsion, share), area),
        Coupling(
            share * finger.coupling.stiffness,
            share * finger.coupling.damping,
            share * finger.coupling.torsional_damping,
        ),
        share * finger.torque_stiffness,
        seen,
    )
    bent = ResistanceInput(contact.body, normal, share, contact.bend, motion.touches)
    bend, bending = resist(finger.patch, objects, bent, motion.probe, motion.last, area)
    pressing = vec3.scale(load.size, load.along)
    turning = levered(lever, normal, kept.force)
    torque = torque_of(finger.form, finger.radius, orientation, normal, kept.moment, pressing, turning)
    after = ContactState(
        body=contact.body,
        normal=normal,
        push=contact.push,
        share=share,
        mode=kept.mode,
        deflection=kept.deflection,
        rolled_part=kept.rolled_part,
        spin=kept.spin * unit,
        slip_speed=kept.slip_speed,
        slip_deflection=kept.slip_deflection,
        spin_slip_speed=kept.spin_slip_speed,
        spin_slip_angle=kept.spin_slip_angle * unit,
        bend=bend,
    )
    return Wrench(
        after=after,
        cause=kept.cause,
        theta=theta,
        spin=kept.spin,
        normal_force=pressing,
        tangential_force=kept.force,
        torque=vec3.add(torque, bending),
        torsion=kept.moment,
        radius=area.radius,
    )


@jit
def outcome_of(objects: Any, wrench: Wrench, finger: Finger, orientation: Quaternion, center: Vec3) -> ContactOutcome:
    """What is told of a contact under the proxy at `center` (3,) m."""
    contact = wrench.after
    if contact.body < 0.0:
        return NO_OUTCOME
    return ContactOutcome(
        object=number_of(objects, contact.body),
        point=point_under(finger.form, finger.radius, orientation, center, contact.normal),
        normal=contact.normal,
        force=vec3.add(wrench.normal_force, wrench.tangential_force),
        mode=contact.mode,
        spin=wrench.spin,
        torque=wrench.torque,
    )
