"""Mechanism of a device that a rig describes: pose from sensed numbers, commanded numbers from a force.

Kernels are compiled once for all mechanisms, and `kind` selects one. `fields.table` defines the indices of `values` and
`command`.
"""

from __future__ import annotations

from math import cos, isfinite, nan, radians, sin, sqrt
from typing import Any, Final, NamedTuple

from softfinger.drivers.fields.table import COUNTS, CURRENT, FORCE, POSITION, QUATERNION, TORQUE, WRIST
from softfinger.drivers.kinematics import chain, delta, options, paddle, pantograph
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import normalize

CARTESIAN: Final = 0
CARTESIAN_WITH_ORIENTATION: Final = 1
CHAIN: Final = 2
CHAIN_WITH_WRIST: Final = 3
PADDLE: Final = 4
PANTOGRAPH: Final = 5
DELTA: Final = 6

FULL: Final = 0
LIMITED: Final = 1
"""The force exceeds the maximum of the device, which displays a smaller one in the same direction."""
SINGULAR: Final = 2
"""The motors cannot hold the end in some direction: the force is smaller, or zero.

For a delta's joint angles: legs are collinear or do not meet, so the end has no position either.
"""
INVALID: Final = 3
"""The sensed numbers are not an orientation."""

SINGULAR_POSE: Final = "the mechanism was in a singular pose, where its motors exert less force, or none"

_ZERO: Final = (0.0, 0.0, 0.0)
_NO_POSITION: Final = (nan, nan, nan)
_IDENTITY: Final = (1.0, 0.0, 0.0, 0.0)


class Mechanism(NamedTuple):
    """Parameters of every kind, of which one is used.

    length      m, of a paddle's handle
    force_max   N, of a cartesian device
    torque_max  N m, of a joint of a paddle, pantograph or delta
    """

    chain: chain.Chain
    length: float
    pantograph: pantograph.Pantograph
    delta: delta.Delta
    force_max: float
    torque_max: float


NO_MECHANISM: Final = Mechanism(
    chain.Chain(_ZERO, _ZERO, _ZERO, _ZERO, _ZERO, 0.0, _ZERO),
    0.0,
    pantograph.Pantograph(0.0, 0.0, 0.0, _ZERO),
    delta.Delta(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, _ZERO, _ZERO, _ZERO, _ZERO),
    0.0,
    0.0,
)


def find_kind(spec: options.Kinematics, has_orientation: bool) -> int:
    """Return the kind of a rig's kinematics; `has_orientation`: True if the device senses an orientation."""
    kinds = {
        options.Cartesian: CARTESIAN, options.Chain: CHAIN, options.Paddle: PADDLE,
        options.Pantograph: PANTOGRAPH, options.Delta: DELTA,
    }  # fmt: skip
    return kinds[type(spec)] + has_orientation


def make_mechanism(spec: options.Kinematics, force_max_n: float) -> Mechanism:
    mechanism = NO_MECHANISM._replace(force_max=float(force_max_n))
    if isinstance(spec, options.Chain):
        return mechanism._replace(chain=chain.make_chain(spec))
    if isinstance(spec, options.Cartesian):
        return mechanism
    mechanism = mechanism._replace(torque_max=float(spec.torque_max_nm))
    if isinstance(spec, options.Paddle):
        return mechanism._replace(length=float(spec.length_m))
    x, y, z = (float(v) for v in spec.origin_m)
    if isinstance(spec, options.Pantograph):
        base, inner, outer = float(spec.base_m), float(spec.inner_m), float(spec.outer_m)
        return mechanism._replace(pantograph=pantograph.Pantograph(base, inner, outer, (x, y, z)))
    return mechanism._replace(delta=_make_delta(spec, (x, y, z)))


def _make_delta(spec: options.Delta, origin: Vec3) -> delta.Delta:
    base, end, arm, rod = (float(v) for v in (spec.base_m, spec.end_m, spec.arm_m, spec.rod_m))
    gap = base - end + 0.5 * arm  # for an arm at 60 degrees and the end on the axis
    a, b, c = (radians(v) for v in spec.legs_deg)
    return delta.Delta(
        arm=arm,
        rod=rod,
        end=end,
        joints=0.0,
        shift=0.0,
        base=base,
        offset=0.0,
        cos=(cos(a), cos(b), cos(c)),
        sin=(sin(a), sin(b), sin(c)),
        home=(0.0, 0.0, sqrt(0.75) * arm + sqrt(rod * rod - gap * gap)),
        origin=origin,
    )


@jit
def forward_kinematics(kind: int, m: Mechanism, values: Any, last_position: Any) -> tuple[Vec3, Quaternion, int]:
    """Return position (3,) m and orientation of the end in the device's frame, and a status.

    The status is FULL, SINGULAR (the position is NaN) or INVALID.

    last_position  (3,) m, updated from tick to tick: that of a delta
    """
    a, b, c = values[COUNTS], values[COUNTS + 1], values[COUNTS + 2]
    position, orientation, status = _ZERO, _IDENTITY, FULL
    if kind == PADDLE:
        position = paddle.forward(m.length, a)
    elif kind == PANTOGRAPH:
        position = pantograph.forward(m.pantograph, a, b)
    elif kind == DELTA:
        end_position, converged = delta.forward(
            m.delta, (a, b, c), (last_position[0], last_position[1], last_position[2])
        )
        if not converged:
            end_position, status = m.delta.home, SINGULAR
        last_position[0], last_position[1], last_position[2] = end_position
        position = vec3.sub(end_position, m.delta.origin) if converged else _NO_POSITION
    elif kind in (CHAIN, CHAIN_WITH_WRIST):
        angles = chain.compute_angles(m.chain, (a, b, c))
        position = chain.forward(m.chain, angles)
        if kind == CHAIN_WITH_WRIST:
            wrist = (values[WRIST], values[WRIST + 1], values[WRIST + 2])
            orientation = chain.compute_orientation(m.chain, angles, wrist)
    else:
        position = (values[POSITION], values[POSITION + 1], values[POSITION + 2])
        if kind == CARTESIAN_WITH_ORIENTATION:
            q = (values[QUATERNION], values[QUATERNION + 1], values[QUATERNION + 2], values[QUATERNION + 3])
            # the square of a finite float32 fits into a float64
            norm = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
            if norm > 0.0 and isfinite(norm):
                orientation = normalize(q)
            else:
                status = INVALID
    return position, orientation, status


@jit
def compute_command(kind: int, m: Mechanism, values: Any, last_position: Any, force: Vec3, command: Any) -> int:
    """Compute the `command` that displays a force (3,) N, device's frame; return FULL, LIMITED or SINGULAR."""
    a, b, c = values[COUNTS], values[COUNTS + 1], values[COUNTS + 2]
    if kind in (CHAIN, CHAIN_WITH_WRIST):
        current, is_limited = chain.compute_currents(m.chain, chain.compute_angles(m.chain, (a, b, c)), force)
        for k in range(3):
            command[CURRENT + k] = current[k]
        return LIMITED if is_limited else FULL
    if kind in (CARTESIAN, CARTESIAN_WITH_ORIENTATION):
        norm = vec3.norm(force)
        is_limited = norm > m.force_max
        if is_limited:
            force = vec3.scale(m.force_max / norm, force)
        for k in range(3):
            command[FORCE + k] = force[k]
        return LIMITED if is_limited else FULL
    is_singular = False
    if kind == PADDLE:
        torque = paddle.compute_torques(m.length, a, force)
    elif kind == PANTOGRAPH:
        torque, is_singular = pantograph.compute_torques(m.pantograph, a, b, force)
    else:
        torque, exists = delta.compute_torques(m.delta, (last_position[0], last_position[1], last_position[2]), force)
        is_singular = not exists
    torque_norm = max(abs(torque[0]), max(abs(torque[1]), abs(torque[2])))
    is_limited = torque_norm > m.torque_max
    if is_limited:
        torque = vec3.scale(m.torque_max / torque_norm, torque)
    for k in range(3):
        command[TORQUE + k] = torque[k]
    return SINGULAR if is_singular else LIMITED if is_limited else FULL
