"""Haptic arm of three joints with capstan drives: the WoodenHaptics family.

Body a turns about z by A and carries two links in its plane x z, both driven from it: b of length Lb at angle B from
the vertical, c of length Lc at angle C below the horizontal. In the device's frame

    theta_i = dir_i 2 pi n_i / N  d_capstan,i / d_body,i                n_i counts, N counts a turn
    x = cos A (Lb sin B + Lc sin C) - ox
    y = sin A (Lb sin B + Lc sin C) - oy
    z = La + Lb cos B - Lc cos C - oz
    tau = J^T f,    I_i = tau_i dir_i (d_capstan,i / d_body,i) / k_i    k_i torque constant
    R = Rz(A) Ry(pi/2 - C) Rx(D) Ry(E) Rx(F)                            D, E, F the wrist

Source: configuration and kinematics of the WoodenHaptics family (Forsslund et al., haptikfabrikenapi).
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

from softfinger.drivers.kinematics import options
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import about_x, about_y, about_z, multiply


class Chain(NamedTuple):
    """Arm.

    offset        (3,) counts    added to the counts of encoders a, b, c
    per_count     (3,) rad       dir 2 pi / N  d_capstan / d_body
    link          (3,) m         La, Lb, Lc
    origin        (3,) m         workspace centre, from the foot of the arm
    per_torque    (3,) A/(N m)   dir (d_capstan / d_body) / k
    current_max   A              maximum per motor
    wrist         (3,) rad       per count of encoders d, e, f; all 0 without a wrist
    """

    offset: Vec3
    per_count: Vec3
    link: Vec3
    origin: Vec3
    per_torque: Vec3
    current_max: float
    wrist: Vec3


def make_chain(chain_options: options.Chain) -> Chain:
    def to_vec3(values: list[float]) -> Vec3:
        return (float(values[0]), float(values[1]), float(values[2]))

    ratio = [
        (-1.0 if aligned else 1.0) * capstan / body
        for aligned, capstan, body in zip(
            chain_options.aligned, chain_options.capstan_m, chain_options.body_m, strict=True
        )
    ]
    wrist = 2.0 * pi / chain_options.wrist_counts_per_turn if chain_options.wrist_counts_per_turn else 0.0
    return Chain(
        offset=(0.0, 0.0, 0.0),
        per_count=to_vec3([2.0 * pi / chain_options.counts_per_turn * r for r in ratio]),
        link=to_vec3(list(chain_options.link_m)),
        origin=to_vec3(list(chain_options.origin_m)),
        per_torque=to_vec3([r / k for r, k in zip(ratio, chain_options.torque_constant_nm_per_a, strict=True)]),
        current_max=float(chain_options.current_max_a),
        wrist=to_vec3([wrist if aligned else -wrist for aligned in chain_options.wrist_aligned]),
    )


@jit
def compute_angles(chain: Chain, counts: Vec3) -> Vec3:
    """Return joint angles A, B, C (3,) rad for counts of the encoders."""
    o, k = chain.offset, chain.per_count
    return ((counts[0] + o[0]) * k[0], (counts[1] + o[1]) * k[1], (counts[2] + o[2]) * k[2])


@jit
def forward(chain: Chain, angles: Vec3) -> Vec3:
    """Return the position (3,) m of the end in the device's frame."""
    (a, b, c), (la, lb, lc), (ox, oy, oz) = angles, chain.link, chain.origin
    reach = lb * sin(b) + lc * sin(c)
    return (cos(a) * reach - ox, sin(a) * reach - oy, la + lb * cos(b) - lc * cos(c) - oz)


@jit
def compute_jacobian(chain: Chain, angles: Vec3) -> tuple[Vec3, Vec3, Vec3]:
    """Return the columns dp/dA, dp/dB, dp/dC of the Jacobian, (3,) m/rad each, device's frame."""
    (a, b, c), (_, lb, lc) = angles, chain.link
    ca, sa = cos(a), sin(a)
    reach = lb * sin(b) + lc * sin(c)
    return (
        (-sa * reach, ca * reach, 0.0),
        (lb * ca * cos(b), lb * sa * cos(b), -lb * sin(b)),
        (lc * ca * cos(c), lc * sa * cos(c), lc * sin(c)),
    )


@jit
def compute_currents(chain: Chain, angles: Vec3, force: Vec3) -> tuple[Vec3, bool]:
    """Return motor currents (3,) A for a force (3,) N at the end in the device's frame, and True if they were limited.

    If a current exceeds the maximum, all three are scaled down, so that the force keeps its direction. The transposed
    Jacobian needs no inverse: the links of a stretched arm bear part of the force, and the currents are finite.
    """
    by_a, by_b, by_c = compute_jacobian(chain, angles)
    k = chain.per_torque
    current = (vec3.dot(by_a, force) * k[0], vec3.dot(by_b, force) * k[1], vec3.dot(by_c, force) * k[2])
    largest = max(abs(current[0]), max(abs(current[1]), abs(current[2])))
    if largest > chain.current_max:
        return vec3.scale(chain.current_max / largest, current), True
    return current, False


@jit
def compute_orientation(chain: Chain, angles: Vec3, wrist: Vec3) -> Quaternion:
    """Return the orientation of the end in the device's frame: Rz(A) Ry(pi/2 - C) Rx(D) Ry(E) Rx(F).

    wrist  (3,) counts of encoders d, e, f
    """
    d, e, f = wrist[0] * chain.wrist[0], wrist[1] * chain.wrist[1], wrist[2] * chain.wrist[2]
    base = multiply(about_z(angles[0]), about_y(0.5 * pi - angles[2]))
    return multiply(base, multiply(multiply(about_x(d), about_y(e)), about_x(f)))
