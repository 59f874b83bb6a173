"""Pantograph: two motors in the base and a loop of four links, which moves its end in a plane.

Motor 1 turns about (0, 0), motor 2 about (d, 0), each with an inner link of length l; two outer links of length L meet
at the end P, on the far side of the line from elbow A to elbow B. In the device's frame, with angles from the x axis,

    A = l (cos a, sin a),   B = (d, 0) + l (cos b, sin b),   h = B - A
    P = (A + B) / 2 + sqrt(L^2 - |h|^2 / 4) (-h_y, h_x) / |h| - origin

The outer links have constant lengths, (P - A) . (P' - A') = 0 and (P - B) . (P' - B') = 0, which gives P' = J q'. With
u = P - A, v = P - B and D = u_x v_y - u_y v_x

    dP/da = (u . A_a) (v_y, -v_x) / D,   dP/db = (v . B_b) (-u_y, u_x) / D,   tau = J^T f

If the outer links are collinear, D = 0: the motors cannot hold the end, and a small force would need any torque. So the
force fades out as |D| / L^2, the sine of the angle between the links, decreases from SINE_FULL to SINE_NONE.

Source: Campion, Wang and Hayward, The Pantograph Mk-II (2005), for equal links.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

SINE_FULL: Final = 0.2
"""Sine of the angle between the outer links (11.5 degrees) above which the full force is displayed."""
SINE_NONE: Final = 0.1
"""Sine (5.7 degrees) below which no force is displayed: torques are ten times those of links at a right angle."""


class Pantograph(NamedTuple):
    """Pantograph: base d, inner l and outer L, m; origin (3,) m, the workspace centre."""

    base: float
    inner: float
    outer: float
    origin: Vec3


@jit
def _compute_elbows(p: Pantograph, a: float, b: float) -> tuple[Vec3, Vec3]:
    return (p.inner * cos(a), p.inner * sin(a), 0.0), (p.base + p.inner * cos(b), p.inner * sin(b), 0.0)


@jit
def _end(p: Pantograph, a: float, b: float) -> Vec3:
    """Return the end without the origin subtracted; if the elbows are too far apart for the links, their midpoint."""
    elbow_a, elbow_b = _compute_elbows(p, a, b)
    h = vec3.sub(elbow_b, elbow_a)
    elbow_distance = sqrt(h[0] * h[0] + h[1] * h[1])
    height = sqrt(max(p.outer * p.outer - 0.25 * elbow_distance * elbow_distance, 0.0))
    normal = (-h[1] / elbow_distance, h[0] / elbow_distance, 0.0) if elbow_distance > 0.0 else (0.0, 1.0, 0.0)
    return vec3.add_scaled(vec3.scale(0.5, vec3.add(elbow_a, elbow_b)), height, normal)


@jit
def forward(p: Pantograph, a: float, b: float) -> Vec3:
    """Return the position (3,) m of the end in the device's frame, z = 0, at joint angles (rad)."""
    return vec3.sub(_end(p, a, b), p.origin)


@jit
def compute_jacobian(p: Pantograph, a: float, b: float) -> tuple[Vec3, Vec3, float]:
    """Return columns dP/da and dP/db, (3,) m/rad each, and the sine of the angle between the outer links.

    If the sine is 0, the columns are 0.
    """
    elbow_a, elbow_b = _compute_elbows(p, a, b)
    end = _end(p, a, b)
    u, v = vec3.sub(end, elbow_a), vec3.sub(end, elbow_b)
    cross = u[0] * v[1] - u[1] * v[0]
    sine = abs(cross) / (p.outer * p.outer)
    if not sine > 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    by_a = p.inner * (cos(a) * u[1] - sin(a) * u[0]) / cross
    by_b = p.inner * (cos(b) * v[1] - sin(b) * v[0]) / cross
    return (by_a * v[1], -by_a * v[0], 0.0), (-by_b * u[1], by_b * u[0], 0.0), sine


@jit
def compute_torques(p: Pantograph, a: float, b: float, force: Vec3) -> tuple[Vec3, bool]:
    """Return joint torques (3,) N m, the third 0, for a force (3,) N, device's frame, and True in a singular pose.

    The part of the force normal to the plane is not displayed.
    """
    by_a, by_b, sine = compute_jacobian(p, a, b)
    share = min((sine - SINE_NONE) / (SINE_FULL - SINE_NONE), 1.0)
    if share <= 0.0:
        return (0.0, 0.0, 0.0), True
    return (share * vec3.dot(by_a, force), share * vec3.dot(by_b, force), 0.0), share < 1.0
