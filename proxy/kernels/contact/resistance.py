"""Rolling resistance: a soft finger recovers less work at the rear of a rolling contact than it spends at the front.

    resist(finger, carry, contact, is_new, motion, patch) -> Resistance

`contact_friction` calls it for each contact.
"""

from math import sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.friction.contact_patch import MIN_SHARE, MIN_STIFFNESS, ContactPatch
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import ZERO, ContactState, Finger, ProbeMotion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.carry import compute_relative_rotation


class Resistance(NamedTuple):
    """Result of a roll in a tick: wind-up (3,), see `ContactState.bend`, and moment (3,) N m on the hand."""

    bend: Vec3
    moment: Vec3


NO_RESISTANCE = Resistance(ZERO, (-0.0, -0.0, -0.0))
"""A zero moment that can be added to any number without a change, including the sign of a zero."""


@jit
def resist(
    finger: Finger, carry: Any, contact: ContactState, is_new: bool, motion: ProbeMotion, patch: ContactPatch
) -> Resistance:
    """Return the Resistance after the fingertip's rotation relative to the object since the last tick.

    Only the rotation about an axis in the tangent plane counts, and none at a first touch (`is_new`). A spring acts
    against it; its anchor slips at 3/16 alpha a f_N, alpha the fraction of the work lost.

    Source of the moment: Greenwood, Minshall, Tabor (1961); Johnson (1985), section 9.1. The spring is not from these
    sources. It stops a finger at rest, and reaches the limit after rolling by the patch's radius.
    """
    if finger.patch is None or finger.patch.rolling is None:
        return NO_RESISTANCE
    roll = ZERO
    if not is_new:
        turn = rotations.relative(motion.probe.orientation, motion.last.orientation)
        path = rotations.roll_unit_ball(compute_relative_rotation(carry, turn), contact.normal)
        roll = vec3.cross(contact.normal, path)
    stiffness = max(finger.patch.rolling.share * patch.bending, MIN_STIFFNESS)
    # The energy of the wind-up is constant while load and share change, see `compute_winding_unit`.
    unit = sqrt(stiffness / max(contact.share, MIN_SHARE))
    angle = vec3.add(vec3.scale(1.0 / unit, vec3.reject(contact.bend, contact.normal)), roll)
    size = vec3.norm(angle)
    if size > patch.bend_max:
        angle = vec3.scale(patch.bend_max / size, angle)
    return Resistance(vec3.scale(unit, angle), vec3.scale(-stiffness, angle))
