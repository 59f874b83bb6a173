"""Rolling resistance: a soft finger recovers less work at the rear of a rolling contact than it spends at the front.

    resist(patch, carried, bent, probe, last, area) -> Resistance

`contact_friction` calls it for each contact.
"""

from math import sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.friction.contact_patch import MIN_SHARE, MIN_STIFFNESS, ContactPatch
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import ZERO, Probe, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.carry import compute_relative_rotation


class ResistanceInput(NamedTuple):
    """Contact input of the rolling resistance: see `ContactState` for the names.

    bend    moved with the object
    is_new  True at a first touch: nothing has rolled
    """

    normal: Vec3
    share: float
    bend: Vec3
    is_new: bool


class Resistance(NamedTuple):
    """Result of a roll in a tick: wind-up (3,), see `ContactState.bend`, and moment (3,) N m on the hand."""

    bend: Vec3
    moment: Vec3


NO_RESISTANCE = Resistance(ZERO, (-0.0, -0.0, -0.0))
"""A zero moment that can be added to any number without a change, including the sign of a zero."""


@jit
def resist(patch: Any, carry: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch) -> Resistance:
    """Return the Resistance after the fingertip's rotation relative to the object since the `last` probe.

    Only the rotation about an axis in the tangent plane counts.
    """
    if patch is None:
        return NO_RESISTANCE
    return resist_by_loss(patch.rolling, carry, bent, probe, last, area)


@jit
def resist_by_loss(
    rolling: Any, carry: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch
) -> Resistance:
    """Return `resist` for a patch with `rolling`, a RollingLoss or None.

    A spring acts against the roll; its anchor slips at 3/16 alpha a f_N, alpha the fraction of the work lost.

    Source of the moment: Greenwood, Minshall, Tabor (1961); Johnson (1985), section 9.1. The spring is not from these
    sources. It stops a finger at rest, and reaches the limit after rolling by the patch's radius.
    """
    if rolling is None:
        return NO_RESISTANCE
    roll = ZERO
    if not bent.is_new:
        turn = rotations.relative(probe.orientation, last.orientation)
        theta, axis = rotations.tilt(compute_relative_rotation(carry, turn), bent.normal)
        roll = vec3.scale(theta, axis)
    stiffness = max(rolling.share * area.bending, MIN_STIFFNESS)
    # The energy of the wind-up is constant while load and share change, see `compute_winding_unit`.
    unit = sqrt(stiffness / max(bent.share, MIN_SHARE))
    angle = vec3.add(vec3.scale(1.0 / unit, vec3.reject(bent.bend, bent.normal)), roll)
    size = vec3.norm(angle)
    if size > area.bend_max:
        angle = vec3.scale(area.bend_max / size, angle)
    return Resistance(vec3.scale(unit, angle), vec3.scale(-stiffness, angle))
