"""Moment against rolling: a soft finger that rolls gets less work back behind the contact than it puts in before it.

resist(patch, objects, bent, probe, last, footprint) -> Resistance
"""

from math import sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import carry, turn_against
from softfinger.proxy.kernels.friction.footprint import LEAST_SHARE, LIMPEST, Footprint
from softfinger.proxy.kernels.geometry import rotations, vec3
from softfinger.proxy.kernels.model import Probe, RollingLoss, Vec3
from softfinger.proxy.kernels.native.dispatch import by_type
from softfinger.proxy.kernels.native.jit import jit

NOTHING = (-0.0, -0.0, -0.0)
"""What can be added to any number without a change, the sign of a zero included."""


class Bent(NamedTuple):
    """A patch as the resistance to rolling is to see it: see `PatchState` for the names.

    bend      where the object has carried it
    touches   a first touch: nothing has rolled
    """

    body: float
    normal: Vec3
    share: float
    bend: Vec3
    touches: bool


class Resistance(NamedTuple):
    """What a tick's roll leaves: wind-up (3,), see `PatchState.bend`, and the moment (3,) N m on the hand."""

    bend: Vec3
    moment: Vec3


@by_type
def resist(patch: Any, objects: Any, bent: Bent, probe: Probe, last: Probe, footprint: Footprint) -> Any:
    """The moment after the fingertip's rotation against the object since the `last` probe, in the tangent plane."""


@by_type
def lose(rolling: Any, objects: Any, bent: Bent, probe: Probe, last: Probe, footprint: Footprint) -> Any:
    """`resist` of a patch that has lost share of elastic work, or None."""


@resist.of(None)
def resist_without_patch(
    patch: None, objects: Any, bent: Bent, probe: Probe, last: Probe, footprint: Footprint
) -> Resistance:
    return Resistance((0.0, 0.0, 0.0), NOTHING)


@resist.otherwise
def resist_on_patch(
    patch: Any, objects: Any, bent: Bent, probe: Probe, last: Probe, footprint: Footprint
) -> Resistance:
    return lose(patch.rolling, objects, bent, probe, last, footprint)


@lose.of(None)
def lose_nothing(
    rolling: None, objects: Any, bent: Bent, probe: Probe, last: Probe, footprint: Footprint
) -> Resistance:
    return Resistance((0.0, 0.0, 0.0), NOTHING)


@lose.of(RollingLoss)
def lose_by_rolling(
    rolling: RollingLoss, objects: Any, bent: Bent, probe: Probe, last: Probe, footprint: Footprint
) -> Resistance:
    """A spring against the roll whose anchor slips at 3/16 alpha a f_N, alpha the share of the work that is lost.

    Source of the moment: Greenwood, Minshall, Tabor (1961); Johnson (1985), section 9.1. The spring, by which it holds
    still at rest, is ours: it is wound after a way of the patch's radius.
    """
    roll = (0.0, 0.0, 0.0)
    if not bent.touches:
        turn = rotations.relative(probe.orientation, last.orientation)
        theta, axis = rotations.tilt(turn_against(carry(objects, bent.body), turn), bent.normal)
        roll = vec3.scale(theta, axis)
    return wind_bend(rolling.share, footprint, bent.share, vec3.reject(bent.bend, bent.normal), roll)


@jit
def wind_bend(loss: float, footprint: Footprint, share: float, bend: Vec3, roll: Vec3) -> Resistance:
    """The wind-up keeps its energy while load and share change, as that of torsion does: see `winding_unit`."""
    stiffness = max(loss * footprint.bending, LIMPEST)
    unit = sqrt(stiffness / max(share, LEAST_SHARE))
    wound = vec3.add(vec3.scale(1.0 / unit, bend), roll)
    size = vec3.norm(wound)
    if size > footprint.bend_max:
        wound = vec3.scale(footprint.bend_max / size, wound)
    return Resistance(vec3.scale(unit, wound), vec3.scale(-stiffness, wound))
