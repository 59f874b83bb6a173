"""Delta: three legs with motors in the base, and an end that does not rotate.

Leg i is at angle phi_i about z, which points away from the base. For the end at p

    u = cos phi x + sin phi y - r,   v = -sin phi x + cos phi y - s,   w = z
    theta3 = acos((v + f) / b),      L = e + b sin theta3
    l0 = w^2 + (u + c - a)^2 - L^2,  l1 = -4 a w,  l2 = w^2 + (u + c + a)^2 - L^2
    theta1 = 2 atan((-l1 - sqrt(l1^2 - 4 l0 l2)) / (2 l2)),  theta2 = acos((u + c - a cos theta1) / L)

theta1 is the angle of the motor's leg, 0 for a leg that points straight out, increasing towards z. Rows of K = d theta1
/ d p, with den = -a sin theta3 sin(theta1 - theta2):

    [cos phi cos theta2 sin theta3 - sin phi cos theta3, sin phi cos theta2 sin theta3 + cos phi cos theta3,
     sin theta2 sin theta3] / den

By virtual work, the torques tau of the legs for a force F at the end satisfy K^T tau = F.

Source: Stamper (1997). libnifalcon has the same delta, but squares sin theta2 in the third column; in the derivative of
the equations above it is not squared.
"""

from __future__ import annotations

from math import acos, atan, cos, isfinite, nan, sin, sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3


class Delta(NamedTuple):
    """Dimensions of a mechanism, m.

    arm       a, of the leg at the motor
    rod       b, of the parallelogram from leg to end
    end       c, from the end's centre to its joints
    joints    e, length that the joints at both ends add to a rod
    shift     f, along the axis of the joints
    base      r, from the centre to a motor's axis
    offset    s, distance of a leg from the radial line at its angle
    cos, sin  (3,) of the legs' angles phi
    home      (3,) within every leg's reach: initial value of a search without a last solution
    origin    (3,) workspace centre
    """

    arm: float
    rod: float
    end: float
    joints: float
    shift: float
    base: float
    offset: float
    cos: Vec3
    sin: Vec3
    home: Vec3
    origin: Vec3


_NEWTON_STEPS_MAX: Final = 30
"""Maximum number of Newton steps: 4 to 6 in a Falcon's workspace from home, more if steps have to be halved."""
_ANGLE_TOLERANCE: Final = 1e-12
"""rad: about 0.05 pm at the end, and a thousand times the rounding error of theta1."""
DET_MIN: Final = 0.0432
"""Minimum of a^3 det K: 0.6 to 13 in a Falcon's workspace; below it, a leg cannot push the end in some direction."""
DEN_MIN: Final = 1.0 / 600.0
"""Minimum of `den` / a: 0 for a stretched leg, whose angle does not determine the end."""

Rows = tuple[Vec3, Vec3, Vec3]


@jit
def _solve_leg(d: Delta, cos_phi: float, sin_phi: float, p: Vec3) -> tuple[float, Vec3]:
    """Return theta1 (rad) of one leg and its row of K (rad/m); NaN if the leg cannot reach or is stretched."""
    u = cos_phi * p[0] + sin_phi * p[1] - d.base
    v = -sin_phi * p[0] + cos_phi * p[1] - d.offset
    w = p[2]
    cos3 = (v + d.shift) / d.rod
    if not abs(cos3) < 1.0:
        return nan, (nan, nan, nan)
    sin3 = sqrt(1.0 - cos3 * cos3)
    reach = d.joints + d.rod * sin3
    l0 = w * w + (u + d.end - d.arm) * (u + d.end - d.arm) - reach * reach
    l1 = -4.0 * d.arm * w
    l2 = w * w + (u + d.end + d.arm) * (u + d.end + d.arm) - reach * reach
    discriminant = l1 * l1 - 4.0 * l0 * l2
    if not (discriminant >= 0.0 and w > 0.0):
        return nan, (nan, nan, nan)
    # form of the root without the difference of its two terms, which cancel for small l2; w > 0
    theta1 = 2.0 * atan(2.0 * l0 / (-l1 + sqrt(discriminant)))
    cos2 = (u + d.end - d.arm * cos(theta1)) / reach
    theta2 = acos(max(-1.0, min(1.0, cos2)))
    den = -d.arm * sin3 * sin(theta1 - theta2)
    if not abs(den) > DEN_MIN * d.arm:
        return nan, (nan, nan, nan)
    cos2, sin2 = cos(theta2), sin(theta2)
    return theta1, (
        (cos_phi * cos2 * sin3 - sin_phi * cos3) / den,
        (sin_phi * cos2 * sin3 + cos_phi * cos3) / den,
        sin2 * sin3 / den,
    )


@jit
def compute_leg_angles(d: Delta, p: Vec3) -> tuple[Vec3, Rows]:
    """Return leg angles (3,) rad for the end at `p` (3,) m from the base, and K (3, 3) rad/m; NaN out of reach."""
    angle1, row1 = _solve_leg(d, d.cos[0], d.sin[0], p)
    angle2, row2 = _solve_leg(d, d.cos[1], d.sin[1], p)
    angle3, row3 = _solve_leg(d, d.cos[2], d.sin[2], p)
    return (angle1, angle2, angle3), (row1, row2, row3)


@jit
def _compute_determinant(k: Rows) -> float:
    return vec3.dot(k[0], vec3.cross(k[1], k[2]))


@jit
def _solve_by_newton(d: Delta, theta: Vec3, start: Vec3) -> tuple[Vec3, bool]:
    p, step = start, (0.0, 0.0, 0.0)
    for iteration in range(_NEWTON_STEPS_MAX):
        at, k = compute_leg_angles(d, p)
        det = _compute_determinant(k)
        if not abs(det) * d.arm**3 > DET_MIN:  # also NaN: the step left the reach, so halve it
            if iteration == 0:
                return p, False
            step = vec3.scale(0.5, step)
            p = vec3.sub(p, step)
            continue
        residual = vec3.sub(theta, at)
        if max(abs(residual[0]), max(abs(residual[1]), abs(residual[2]))) <= _ANGLE_TOLERANCE:
            return p, True
        # K^-1 miss: the columns of K^-1 are the cross products of the rows of K over det K
        step = vec3.scale(residual[0] / det, vec3.cross(k[1], k[2]))
        step = vec3.add_scaled(step, residual[1] / det, vec3.cross(k[2], k[0]))
        step = vec3.add_scaled(step, residual[2] / det, vec3.cross(k[0], k[1]))
        p = vec3.add(p, step)
    return p, False


@jit
def forward(d: Delta, theta: Vec3, last: Vec3) -> tuple[Vec3, bool]:
    """Return the position (3,) m of the end, from the base, at leg angles `theta` (3,) rad, and True if it exists.

    Newton's method on `compute_leg_angles`: from the last solution, less than a millimetre away after a tick's motion,
    or from home if that fails.
    """
    p, converged = _solve_by_newton(d, theta, last)
    if not converged:
        p, converged = _solve_by_newton(d, theta, d.home)
    return p, converged


@jit
def compute_torques(d: Delta, p: Vec3, force: Vec3) -> tuple[Vec3, bool]:
    """Return leg torques (3,) N m for a force (3,) N on the hand at `p` (3,) m from the base, and True if they exist.

    Near a singular pose they do not, and are returned as 0.
    """
    _, k = compute_leg_angles(d, p)
    det = _compute_determinant(k)
    if not abs(det) * d.arm**3 > DET_MIN or not isfinite(det):
        return (0.0, 0.0, 0.0), False
    return (
        vec3.dot(vec3.cross(k[1], k[2]), force) / det,
        vec3.dot(vec3.cross(k[2], k[0]), force) / det,
        vec3.dot(vec3.cross(k[0], k[1]), force) / det,
    ), True
