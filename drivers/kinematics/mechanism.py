"""Mechanism of a device that a rig describes: pose from sensed numbers, commanded numbers from a force.

Kernels are compiled once for all mechanisms, and `kind` selects one. `fields.table` defines the indices of `values` and
`given`.
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

WHOLE: Final = 0
LIMITED: Final = 1
"""The force exceeds the maximum of the device, which displays a smaller one in the same direction."""
SINGULAR: Final = 2
"""The motors cannot hold the end in some direction: the force is smaller, or zero.

For a delta's joint angles: legs are collinear or do not meet, so the end has no position either.
"""
NONSENSE: Final = 3
"""The sensed numbers are not an orientation."""

SINGULAR_POSE: Final = (
    "the mechanism has been in a singular pose, where its motors cannot hold the handle: there it gives less force, or "
    "none"
)

_ZERO: Final = (0.0, 0.0, 0.0)
_NOWHERE: Final = (nan, nan, nan)
_NO_TURN: Final = (1.0, 0.0, 0.0, 0.0)


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


NONE: Final = Mechanism(
    chain.Chain(_ZERO, _ZERO, _ZERO, _ZERO, _ZERO, 0.0, _ZERO),
    0.0,
    pantograph.Pantograph(0.0, 0.0, 0.0, _ZERO),
    delta.Delta(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, _ZERO, _ZERO, _ZERO, _ZERO),
    0.0,
    0.0,
)


def kind_of(given: options.Kinematics, turns: bool) -> int:
    """Return the kind of a rig's kinematics; `turns`: True if the device senses an orientation."""
    kinds = {
        options.Cartesian: CARTESIAN, options.Chain: CHAIN, options.Paddle: PADDLE,
        options.Pantograph: PANTOGRAPH, options.Delta: DELTA,
    }  # fmt: skip
    return kinds[type(given)] + turns


def make_mechanism(given: options.Kinematics, force_max_n: float) -> Mechanism:
    """Return the mechanism that a rig describes."""
    made = NONE._replace(force_max=float(force_max_n))
    if isinstance(given, options.Chain):
        return made._replace(chain=chain.make_chain(given))
    if isinstance(given, options.Cartesian):
        return made
    made = made._replace(torque_max=float(given.torque_max_nm))
    if isinstance(given, options.Paddle):
        return made._replace(length=float(given.length_m))
    x, y, z = (float(v) for v in given.origin_m)
    if isinstance(given, options.Pantograph):
        base, inner, outer = float(given.base_m), float(given.inner_m), float(given.outer_m)
        return made._replace(pantograph=pantograph.Pantograph(base, inner, outer, (x, y, z)))
    return made._replace(delta=_make_delta(given, (x, y, z)))


def _make_delta(given: options.Delta, origin: Vec3) -> delta.Delta:
    base, end, arm, rod = (float(v) for v in (given.base_m, given.end_m, given.arm_m, given.rod_m))
    gap = base - end + 0.5 * arm  # for an arm at 60 degrees and the end on the axis
    one, two, three = (radians(v) for v in given.legs_deg)
    return delta.Delta(
        arm=arm,
        rod=rod,
        end=end,
        joints=0.0,
        shift=0.0,
        base=base,
        offset=0.0,
        cos=(cos(one), cos(two), cos(three)),
        sin=(sin(one), sin(two), sin(three)),
        home=(0.0, 0.0, sqrt(0.75) * arm + sqrt(rod * rod - gap * gap)),
        origin=origin,
    )


@jit
def end_of(kind: int, m: Mechanism, values: Any, last: Any) -> tuple[Vec3, Quaternion, int]:
    """Return position (3,) m and orientation of the end in the device's frame, and a status.

    The status is WHOLE, SINGULAR (the position is NaN) or NONSENSE.

    last  (3,) m, updated from tick to tick: last position of a delta
    """
    one, two, three = values[COUNTS], values[COUNTS + 1], values[COUNTS + 2]
    position, orientation, how = _ZERO, _NO_TURN, WHOLE
    if kind == PADDLE:
        position = paddle.forward(m.length, one)
    elif kind == PANTOGRAPH:
        position = pantograph.forward(m.pantograph, one, two)
    elif kind == DELTA:
        place, found = delta.forward(m.delta, (one, two, three), (last[0], last[1], last[2]))
        if not found:
            place, how = m.delta.home, SINGULAR
        last[0], last[1], last[2] = place
        position = vec3.sub(place, m.delta.origin) if found else _NOWHERE
    elif kind in (CHAIN, CHAIN_WITH_WRIST):
        angles = chain.angles_of(m.chain, (one, two, three))
        position = chain.forward(m.chain, angles)
        if kind == CHAIN_WITH_WRIST:
            wrist = (values[WRIST], values[WRIST + 1], values[WRIST + 2])
            orientation = chain.orientation_of(m.chain, angles, wrist)
    else:
        position = (values[POSITION], values[POSITION + 1], values[POSITION + 2])
        if kind == CARTESIAN_WITH_ORIENTATION:
            q = (values[QUATERNION], values[QUATERNION + 1], values[QUATERNION + 2], values[QUATERNION + 3])
            # the square of a finite float32 fits into a float64
            size = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
            if size > 0.0 and isfinite(size):
                orientation = normalize(q)
            else:
                how = NONSENSE
    return position, orientation, how


@jit
def drive(kind: int, m: Mechanism, values: Any, last: Any, force: Vec3, given: Any) -> int:
    """Compute the command `given` that displays a force (3,) N, device's frame; return WHOLE, LIMITED or SINGULAR."""
    one, two, three = values[COUNTS], values[COUNTS + 1], values[COUNTS + 2]
    if kind in (CHAIN, CHAIN_WITH_WRIST):
        current, cut = chain.currents_for(m.chain, chain.angles_of(m.chain, (one, two, three)), force)
        for k in range(3):
            given[CURRENT + k] = current[k]
        return LIMITED if cut else WHOLE
    if kind in (CARTESIAN, CARTESIAN_WITH_ORIENTATION):
        size = vec3.norm(force)
        cut = size > m.force_max
        if cut:
            force = vec3.scale(m.force_max / size, force)
        for k in range(3):
            given[FORCE + k] = force[k]
        return LIMITED if cut else WHOLE
    singular = False
    if kind == PADDLE:
        torque = paddle.torques_for(m.length, one, force)
    elif kind == PANTOGRAPH:
        torque, singular = pantograph.torques_for(m.pantograph, one, two, force)
    else:
        torque, able = delta.torques_for(m.delta, (last[0], last[1], last[2]), force)
        singular = not able
    most = max(abs(torque[0]), max(abs(torque[1]), abs(torque[2])))
    cut = most > m.torque_max
    if cut:
        torque = vec3.scale(m.torque_max / most, torque)
    for k in range(3):
        given[TORQUE + k] = torque[k]
    return SINGULAR if singular else LIMITED if cut else WHOLE
