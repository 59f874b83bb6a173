"""The wrench of one of several patches, what becomes of the patch, and what is told of it."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.fingertip import point_under, roundness, torque_of
from softfinger.proxy.kernels.contact.patches import Motion, load_on, sheared
from softfinger.proxy.kernels.contact.rolling_resistance import Bent, resist
from softfinger.proxy.kernels.friction.footprint import footprint, torsion_under, winding_unit
from softfinger.proxy.kernels.friction.laws import turned
from softfinger.proxy.kernels.friction.machine import react
from softfinger.proxy.kernels.friction.torsion import share_of
from softfinger.proxy.kernels.geometry import vec3
from softfinger.proxy.kernels.geometry.bodies import material_of, number_of, pose_of
from softfinger.proxy.kernels.geometry.kinds import has_wide
from softfinger.proxy.kernels.model import (
    NO_PATCH,
    NO_PATCH_CONTACT,
    Coupling,
    Finger,
    PatchContact,
    PatchState,
    Quaternion,
    Vec3,
)
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.outlined import outlined_where
from softfinger.proxy.record import CAUSE_NONE


class Wrench(NamedTuple):
    """What a patch does to the hand, torque about the fingertip's centre, and what becomes of it.

    after    PatchState
    cause    of its change of mode
    theta    rad    roll in this tick
    spin     rad    torsional wind-up
    torsion  N m    moment about the normal
    radius   m      of the contact patch
    """

    after: PatchState
    cause: float
    theta: float
    spin: float
    normal_force: Vec3
    tangential_force: Vec3
    torque: Vec3
    torsion: float
    radius: float


@outlined_where(has_wide)
def wrench_of(rolling: Any, finger: Finger, objects: Any, patch: PatchState, motion: Motion) -> Wrench:
    """Friction and torsion of one of several patches: with its own load, its own law, and its share of the springs."""
    zero = (0.0, 0.0, 0.0)
    if patch.body < 0.0:
        return Wrench(
            after=NO_PATCH, cause=float(CAUSE_NONE), theta=0.0, spin=0.0,
            normal_force=zero, tangential_force=zero, torque=zero, torsion=0.0, radius=0.0,
        )  # fmt: skip
    material, share, normal = material_of(objects, patch.body), patch.share, patch.normal
    load = load_on(objects, patch, motion)
    orientation = motion.probe.orientation
    round_by = roundness(finger.form, finger.radius, orientation, normal)
    area = footprint(finger.patch, round_by, material.compliance, load.size)
    unit = winding_unit(material.torsion, area, share)
    seen, theta = sheared(rolling, objects, patch, motion, load.size, unit)
    kept = react(
        turned(material.friction, pose_of(objects, patch.body).orientation),
        torsion_under(share_of(material.torsion, share), area),
        Coupling(share * finger.coupling.stiffness, share * finger.coupling.damping),
        share * finger.torque_stiffness,
        seen,
    )
    bent = Bent(patch.body, normal, share, patch.bend, motion.touches)
    bend, bending = resist(finger.patch, objects, bent, motion.probe, motion.last, area)
    pressing = vec3.scale(load.size, load.along)
    torque = torque_of(finger.form, finger.radius, orientation, normal, kept.moment, pressing, kept.force)
    after = PatchState(
        body=patch.body,
        normal=normal,
        push=patch.push,
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
def outcome_of(objects: Any, wrench: Wrench, finger: Finger, orientation: Quaternion, center: Vec3) -> PatchContact:
    """What is told of a patch under the proxy at `center` (3,) m."""
    patch = wrench.after
    if patch.body < 0.0:
        return NO_PATCH_CONTACT
    return PatchContact(
        object=number_of(objects, patch.body),
        point=point_under(finger.form, finger.radius, orientation, center, patch.normal),
        normal=patch.normal,
        force=vec3.add(wrench.normal_force, wrench.tangential_force),
        mode=patch.mode,
        spin=wrench.spin,
    )
