"""Contact patch of the fingertip under a load: its size, and the torsion that follows from it.

    compute_contact_patch(patch, radius, compliance, normal_force) -> ContactPatch
    adapt_torsion(torsion, area) -> torsion law of this tick
    compute_winding_unit(spring, area, share) -> sqrt(N m/rad)

Assumptions: fingertip and object are incompressible, with separate shear moduli, and the object is flat compared with
the fingertip.
"""

from math import pi, sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import HertzPatch, LimitSurface, PatchTorsion, SoftFingerProxy, Torsion

HERTZ_LEVER = 3.0 * pi / 16.0
"""Mean distance of Hertz's pressure from the centre, over the patch's radius."""
MIN_STIFFNESS = 1e-30
"""Smallest stiffness, N m/rad: a divisor, so not zero, but without a noticeable moment."""
MIN_SHARE = 1e-30
"""Smallest share of the load by which a stiffness is divided, for a patch without load."""


class ContactPatch(NamedTuple):
    """Patch in a tick.

    radius     m        a
    torsional  N m/rad  k_z, its stiffness against spin
    lever      m        largest moment about the normal over friction's largest force
    bending    N m/rad  stiffness against roll at a rolling loss of 1
    bend_max   rad      roll angle at which the rolling resistance reaches its limit
    """

    radius: float
    torsional: float
    lever: float
    bending: float
    bend_max: float


NO_PATCH = ContactPatch(radius=0.0, torsional=0.0, lever=0.0, bending=0.0, bend_max=0.0)


@jit
def make_contact_patch(a: float, lever: float, radius: float, compliance: float, normal_force: float) -> ContactPatch:
    """Return a patch of the radius a, at most the fingertip's.

    k_z = 16/3 a^3 / (1/G_f + 1/G_o): a disc stuck to two half-spaces in series (Reissner and Sagoci, 1944), and Hertz's
    contact before any slip (Lubkin, 1951; Mindlin and Deresiewicz, 1953).
    """
    a = min(a, radius)
    k_z = max(16.0 / 3.0 * a * a * a / compliance, MIN_STIFFNESS)
    # Moment 3/16 a f_N (Greenwood, Minshall, Tabor, 1961), reached after rolling by the patch's radius.
    bending = max(3.0 / 16.0 * radius * normal_force, MIN_STIFFNESS)
    return ContactPatch(radius=a, torsional=k_z, lever=lever * a, bending=bending, bend_max=a / radius)


@jit
def compute_contact_patch(patch: Any, radius: float, compliance: Any, normal_force: float) -> ContactPatch:
    """Return the patch of a fingertip of `radius`, m, on an object of shear compliance 1/G, m^2/N; None: no patch.

    HertzPatch  a^3 = 3 f_N r / (4 E*), with 1/E* = (1/G_f + 1/G_o) / 4 of incompressible bodies (Hertz, 1882)
    PowerPatch  a = c (f_N / 1 N)^gamma (Xydas and Kao, 1999)
    """
    if patch is None:
        return NO_PATCH
    both = patch.compliance + compliance
    if isinstance(patch, HertzPatch):
        a = (3.0 / 16.0 * normal_force * radius * both) ** (1.0 / 3.0)
        return make_contact_patch(a, HERTZ_LEVER, radius, both, normal_force)
    a = patch.at_newton * normal_force**patch.exponent if normal_force > 0.0 else 0.0
    return make_contact_patch(a, patch.lever, radius, both, normal_force)


@jit
def adapt_torsion(torsion: Any, contact_patch: ContactPatch) -> Any:
    """Return the torsion law with the coefficients of this tick."""
    if isinstance(torsion, (LimitSurface, SoftFingerProxy)):
        return replace(torsion, "law", adapt_spring(torsion.law, contact_patch))
    return adapt_spring(torsion, contact_patch)


@jit
def adapt_spring(spring: Any, contact_patch: ContactPatch) -> Any:
    if isinstance(spring, PatchTorsion):
        return Torsion(contact_patch.torsional, spring.friction * contact_patch.lever)
    return spring


@jit
def compute_winding_unit(spring: Any, contact_patch: ContactPatch, share: float) -> float:
    """Return the factor from a wind-up to its stored form: 1, or sqrt(k_z / w) if k_z changes with the load.

    w is the patch's share of the load, 1 with one object. The stored energy is w / 2 times the square of phi sqrt(k_z /
    w). It is constant while the load changes, and the moment is proportional to sqrt(k_z): pressing harder on a
    wound-up finger generates no energy, and a trembling hand loses none. Nor does it grow if it is transferred along
    with the share.
    """
    return sqrt(contact_patch.torsional / max(share, MIN_SHARE)) if isinstance(spring, PatchTorsion) else 1.0
