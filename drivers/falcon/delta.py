"""The Falcon's mechanism: a delta of three legs, motors in the base, a knob that does not turn.

In the device's frame (x to the right, y up, z out to the user) leg i stands at angle phi_i about z. For the knob at p

    u = cos phi x + sin phi y - r,   v = -sin phi x + cos phi y - s,   w = z
    theta3 = acos((v + f) / b),      L = d + e + b sin theta3
    l0 = w^2 + (u + c - a)^2 - L^2,  l1 = -4 a w,  l2 = w^2 + (u + c + a)^2 - L^2
    theta1 = 2 atan((-l1 - sqrt(l1^2 - 4 l0 l2)) / (2 l2)),  theta2 = acos((u + c - a cos theta1) / L)

theta1 is the motor's leg. Rows of K = d theta1 / d p, with den = -a sin theta3 sin(theta1 - theta2):

    [cos phi cos theta2 sin theta3 - sin phi cos theta3, sin phi cos theta2 sin theta3 + cos phi cos theta3,
     sin theta2 sin theta3] / den

Virtual work gives the torques of the legs for a force F at the knob: K^T tau = F.

Source: Stamper (1997), with the dimensions of libnifalcon, which squares sin theta2 in the third column; the
derivative of the equations above has it once.
"""

from __future__ import annotations

from math import acos, atan, cos, isfinite, nan, pi, sin, sqrt
from typing import Final

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

A: Final = 0.060
B: Final = 0.1025
C: Final = 0.01443
D: Final = 0.01125
E: Final = 0.01125
F: Final = -0.025
R: Final = 0.0400
S: Final = -0.02309
"""Lengths of the mechanism, m."""

_LEGS: Final = (105.0 * pi / 180.0, -15.0 * pi / 180.0, -135.0 * pi / 180.0)
_COS: Final = (cos(_LEGS[0]), cos(_LEGS[1]), cos(_LEGS[2]))
_SIN: Final = (sin(_LEGS[0]), sin(_LEGS[1]), sin(_LEGS[2]))

RAD_PER_COUNT: Final = 0.01425 / 0.110 * 2.0 * pi / 1280.0
"""Leg angle to an encoder count: drum over leg radius, counts of the motor's turn."""
THETA_ZERO: Final = 35.0 * pi / 180.0
"""Leg angle (rad) at encoder count 0."""

HOME: Final = (0.0, 0.0, 0.11)
"""m: where a search without a last solution begins; within every leg's reach."""

_STEPS_MAX: Final = 30
"""Newton's method takes 4 to 6 steps over the workspace from HOME, more where steps have to be halved."""
_SOLVED: Final = 1e-12
"""rad: some 0.05 pm at the knob, and a thousand times the rounding of theta1."""
DET_MIN: Final = 2e2
"""1/m^3, of det K: 3e3 to 6e4 in the workspace; below, a leg can no longer push the knob in some direction."""
DEN_MIN: Final = 1e-4
"""m, of `den`: 0 where a leg is stretched, and its angle no longer follows the knob."""

Rows = tuple[Vec3, Vec3, Vec3]


@jit
def _leg(cos_phi: float, sin_phi: float, p: Vec3) -> tuple[float, Vec3]:
    """theta1 (rad) of one leg and its row of K (rad/m); NaN where the leg does not reach or is stretched."""
    u = cos_phi * p[0] + sin_phi * p[1] - R
    v = -sin_phi * p[0] + cos_phi * p[1] - S
    w = p[2]
    cos3 = (v + F) / B
    if not abs(cos3) < 1.0:
        return nan, (nan, nan, nan)
    sin3 = sqrt(1.0 - cos3 * cos3)
    reach = D + E + B * sin3
    l0 = w * w + (u + C - A) * (u + C - A) - reach * reach
    l1 = -4.0 * A * w
    l2 = w * w + (u + C + A) * (u + C + A) - reach * reach
    inside = l1 * l1 - 4.0 * l0 * l2
    if not (inside >= 0.0 and w > 0.0):
        return nan, (nan, nan, nan)
    # the root in the form that does not subtract its two terms, which cancel where l2 is small; w > 0
    theta1 = 2.0 * atan(2.0 * l0 / (-l1 + sqrt(inside)))
    cos2 = (u + C - A * cos(theta1)) / reach
    theta2 = acos(max(-1.0, min(1.0, cos2)))
    den = -A * sin3 * sin(theta1 - theta2)
    if not abs(den) > DEN_MIN:
        return nan, (nan, nan, nan)
    cos2, sin2 = cos(theta2), sin(theta2)
    return theta1, (
        (cos_phi * cos2 * sin3 - sin_phi * cos3) / den,
        (sin_phi * cos2 * sin3 + cos_phi * cos3) / den,
        sin2 * sin3 / den,
    )


@jit
def inverse(p: Vec3) -> tuple[Vec3, Rows]:
    """Leg angles (3,) rad for the knob at `p` (3,) m, device's frame, and K (3, 3) rad/m; NaN out of reach."""
    one, row1 = _leg(_COS[0], _SIN[0], p)
    two, row2 = _leg(_COS[1], _SIN[1], p)
    three, row3 = _leg(_COS[2], _SIN[2], p)
    return (one, two, three), (row1, row2, row3)


@jit
def _determinant(k: Rows) -> float:
    return vec3.dot(k[0], vec3.cross(k[1], k[2]))


@jit
def _newton(theta: Vec3, start: Vec3) -> tuple[Vec3, bool]:
    p, step = start, (0.0, 0.0, 0.0)
    for tried in range(_STEPS_MAX):
        at, k = inverse(p)
        det = _determinant(k)
        if not abs(det) > DET_MIN:  # NaN too: the step went out of reach, so half of it
            if tried == 0:
                return p, False
            step = vec3.scale(0.5, step)
            p = vec3.sub(p, step)
            continue
        miss = vec3.sub(theta, at)
        if max(abs(miss[0]), max(abs(miss[1]), abs(miss[2]))) <= _SOLVED:
            return p, True
        # K^-1 miss: the columns of K^-1 are the cross products of K's rows over det K
        step = vec3.scale(miss[0] / det, vec3.cross(k[1], k[2]))
        step = vec3.add_scaled(step, miss[1] / det, vec3.cross(k[2], k[0]))
        step = vec3.add_scaled(step, miss[2] / det, vec3.cross(k[0], k[1]))
        p = vec3.add(p, step)
    return p, False


@jit
def forward(theta: Vec3, last: Vec3) -> tuple[Vec3, bool]:
    """Position (3,) m of the knob at leg angles `theta` (3,) rad, and whether there is one.

    Newton's method on `inverse` from the last solution, which a tick's motion leaves by less than a millimetre; from
    HOME where that fails.
    """
    p, found = _newton(theta, last)
    if not found:
        p, found = _newton(theta, HOME)
    return p, found


@jit
def torques_for(p: Vec3, force: Vec3) -> tuple[Vec3, bool]:
    """Torques (3,) N m of the legs for a force (3,) N on the hand at `p` (3,) m, and whether the legs can give it.

    Near a singular place they cannot, and the torques are 0.
    """
    _, k = inverse(p)
    det = _determinant(k)
    if not abs(det) > DET_MIN or not isfinite(det):
        return (0.0, 0.0, 0.0), False
    return (
        vec3.dot(vec3.cross(k[1], k[2]), force) / det,
        vec3.dot(vec3.cross(k[2], k[0]), force) / det,
        vec3.dot(vec3.cross(k[0], k[1]), force) / det,
    ), True
