"""Moment against rolling: a soft finger that rolls gets less work back behind the contact than it puts in before it.

resist(patch, carried, bent, probe, last, area) -> Resistance
"""

from math import sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import relative_rotation
from softfinger.proxy.kernels.friction.contact_patch import LEAST_SHARE, LIMPEST, ContactPatch
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Probe, RollingLoss, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3

NOTHING = (-0.0, -0.0, -0.0)
"""What can be added to any number without a change, the sign of a zero included."""


class ResistanceInput(NamedTuple):
    """A patch as the resistance to rolling is to see it: see `ContactState` for the names.

    bend      where the object has carried it
    touches   a first touch: nothing has rolled
    """

    normal: Vec3
    share: float
    bend: Vec3
    touches: bool


class Resistance(NamedTuple):
    """What a tick's roll leaves: wind-up (3,), see `ContactState.bend`, and the moment (3,) N m on the hand."""

    bend: Vec3
    moment: Vec3


@by_type
def resist(patch: Any, carried: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch) -> Any:
    """The moment after the fingertip's rotation against the object since the `last` probe, in the tangent plane."""


@by_type
def resist_by_loss(
    rolling: Any, carried: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch
) -> Any:
    """`resist` of a patch that has lost share of elastic work, or None."""


@resist.of(None)
def resist_without_patch(
    patch: None, carried: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch
) -> Resistance:
    return Resistance((0.0, 0.0, 0.0), NOTHING)


@resist.otherwise
def resist_on_patch(
    patch: Any, carried: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch
) -> Resistance:
    return resist_by_loss(patch.rolling, carried, bent, probe, last, area)


@resist_by_loss.of(None)
def resist_without_loss(
    rolling: None, carried: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch
) -> Resistance:
    return Resistance((0.0, 0.0, 0.0), NOTHING)


@resist_by_loss.of(RollingLoss)
def resist_with_loss(
    rolling: RollingLoss, carried: Any, bent: ResistanceInput, probe: Probe, last: Probe, area: ContactPatch
) -> Resistance:
    """A spring against the roll whose anchor slips at 3/16 alpha a f_N, alpha the share of the work that is lost.

    Source of the moment: Greenwood, Minshall, Tabor (1961); Johnson (1985), section 9.1. The spring, by which it holds
    still at rest, is ours: it is wound after a way of the patch's radius.
    """
    roll = (0.0, 0.0, 0.0)
    if not bent.touches:
        turn = rotations.relative(probe.orientation, last.orientation)
        theta, axis = rotations.tilt(relative_rotation(carried, turn), bent.normal)
        roll = vec3.scale(theta, axis)
    return wind_resistance(rolling.share, area, bent.share, vec3.reject(bent.bend, bent.normal), roll)


@jit
def wind_resistance(loss: float, area: ContactPatch, share: float, bend: Vec3, roll: Vec3) -> Resistance:
    """The wind-up keeps its energy while load and share change, as that of torsion does: see `winding_unit`."""
    stiffness = max(loss * area.bending, LIMPEST)
    unit = sqrt(stiffness / max(share, LEAST_SHARE))
    wound = vec3.add(vec3.scale(1.0 / unit, bend), roll)
    size = vec3.norm(wound)
    if size > area.bend_max:
        wound = vec3.scale(area.bend_max / size, wound)
    return Resistance(vec3.scale(unit, wound), vec3.scale(-stiffness, wound))
