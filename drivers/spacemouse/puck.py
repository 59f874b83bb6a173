"""Reports of a 3Dconnexion puck, and the motion of a fingertip from its deflection.

Rate control: the puck springs back to its centre, so its deflection is a velocity, not a position.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Final, NamedTuple

from softfinger.config.limits import Range
from softfinger.config.schema import Complaint, Point, Table, doc, is_usable, within
from softfinger.drivers.base import OK, PROTOCOL, STALE
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import exp, multiply, normalize

DEADBAND: Final = Range(0.0, 300.0, "an axis ends at 350 counts")
GAIN_M_PER_S: Final = Range(0.0, 3e-3, "1 m/s at full deflection")
GAIN_RAD_PER_S: Final = Range(0.0, 3e-2, "10 rad/s at full deflection")
HOLD_S: Final = Range(0.05, 3600.0, "reports arrive every few hundredths of a second while the puck is moved")

TRANSLATION: Final = 1
ROTATION: Final = 2
BUTTONS: Final = 3
SPLIT_BYTES: Final = 7
COMBINED_BYTES: Final = 13
BUTTON_BYTES_MAX: Final = 6  # 48 buttons, which a float64 represents exactly
REPORT_MAX: Final = 64


class Options(Table, frozen=True, kw_only=True):
    """Keys of a puck: `[device]` of `driver = "spacemouse"`, or the `puck` of a simulated device."""

    path: Annotated[str, doc("node, in place of looking for one", "/dev/hidraw0")] | None = None
    serial: Annotated[str, doc("serial number, if several are attached", "SN42")] | None = None
    deadband: Annotated[float, within(DEADBAND, "counts that move nothing, of 350", 15.0)] = 15.0
    gain_m_per_s: Annotated[float, within(GAIN_M_PER_S, "speed per count above the deadband", 2e-4)] = 2e-4
    gain_rad_per_s: Annotated[float, within(GAIN_RAD_PER_S, "turning speed per count above it", 3e-3)] = 3e-3
    invert: Annotated[
        tuple[bool, bool, bool, bool, bool, bool], doc("axes to invert: x, y, z, about x, about y, about z")
    ] = (False, False, False, False, False, False)
    start_m: Annotated[Point, doc("initial position of the fingertip", [0.0, 0.0, 0.03])] = (0.0, 0.0, 0.03)
    workspace_min_m: Annotated[Point, doc("lower corner of its box", [-0.1, -0.1, -0.1])] = (-0.1, -0.1, -0.1)
    workspace_max_m: Annotated[Point, doc("upper corner", [0.1, 0.1, 0.1])] = (0.1, 0.1, 0.1)
    hold_s: Annotated[float, within(HOLD_S, "time without a report after which the puck counts as released", 2.0)] = 2.0
    led: Annotated[bool, doc("switch on its light while it is in use", True)] = True

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.start_m, self.workspace_min_m, self.workspace_max_m):
            return
        if any(low > high for low, high in zip(self.workspace_min_m, self.workspace_max_m, strict=True)):
            yield "workspace_min_m", self.workspace_min_m, f"is above workspace_max_m = {list(self.workspace_max_m)}"
        elif any(
            not low <= at <= high
            for low, at, high in zip(self.workspace_min_m, self.start_m, self.workspace_max_m, strict=True)
        ):
            yield "start_m", self.start_m, "is outside of the workspace: choose a position inside"


class PuckParameters(NamedTuple):
    """Options of a puck, converted for kernels.

    deadband     counts
    linear       (3,) m/s per count, negative for an inverted axis
    angular      (3,) rad/s per count, likewise
    low, high    (3,) m  corners of the box, world frame
    """

    deadband: float
    linear: Vec3
    angular: Vec3
    low: Vec3
    high: Vec3


def make_parameters(options: Options) -> PuckParameters:
    signs = [-1.0 if is_inverted else 1.0 for is_inverted in options.invert]
    v, w = options.gain_m_per_s, options.gain_rad_per_s
    x0, y0, z0 = (float(a) for a in options.workspace_min_m)
    x1, y1, z1 = (float(a) for a in options.workspace_max_m)
    return PuckParameters(
        float(options.deadband),
        (signs[0] * v, signs[1] * v, signs[2] * v),
        (signs[3] * w, signs[4] * w, signs[5] * w),
        (x0, y0, z0),
        (x1, y1, z1),
    )


@jit
def _read_axis(report: Any, at: int) -> float:
    value = int(report[at]) + 256 * int(report[at + 1])
    return float(value - 65536 if value > 32767 else value)


@jit
def decode(report: Any, count: int, deflection: Any, buttons: Any) -> int:
    """Decode a report of `count` bytes into `deflection` (6,) counts and `buttons` (1,), one bit each.

    deflection  x, y, z and the rotations about them, world axes: x right, y away from the user, z up
    returns     OK, STALE for a report of another kind, PROTOCOL for a report that is too short

    The device has y towards the user and z down, which is the world rotated by half a turn about x, so components y and
    z change sign, also of rotation vectors. In the convention of other drivers these are x = w0, y = -w1, z = -w2, and
    nose down: pitch = -w3; to the right: roll = -w4; clockwise from above: yaw = w5.
    """
    if count < 1:
        return PROTOCOL
    kind = report[0]
    if kind == BUTTONS:
        mask, scale = 0.0, 1.0
        for k in range(1, min(count, BUTTON_BYTES_MAX + 1)):
            mask += scale * float(report[k])
            scale *= 256.0
        buttons[0] = mask
        return OK
    if kind not in (TRANSLATION, ROTATION):
        return STALE
    if count < SPLIT_BYTES:
        return PROTOCOL
    first, axes = 0, 3
    if kind == ROTATION:
        first = 3
    elif count >= COMBINED_BYTES:
        axes = 6
    for k in range(axes):
        value = _read_axis(report, 1 + 2 * k)
        deflection[first + k] = value if (first + k) % 3 == 0 else -value
    return OK


@jit
def _subtract_deadband(deadband: float, counts: float) -> float:
    """Return the counts beyond the deadband, so that the speed is continuous at its edge."""
    if counts > deadband:
        return counts - deadband
    if counts < -deadband:
        return counts + deadband
    return 0.0


@jit
def move(
    setup: PuckParameters, position: Vec3, orientation: Quaternion, deflection: Any, dt: float
) -> tuple[Vec3, Quaternion]:
    """Return the fingertip after `dt` (s) of a constant deflection (6,) counts.

    Velocities are in the world frame; the position is clamped to the box, the orientation is unlimited.
    """
    d = setup.deadband
    step = (
        dt * setup.linear[0] * _subtract_deadband(d, deflection[0]),
        dt * setup.linear[1] * _subtract_deadband(d, deflection[1]),
        dt * setup.linear[2] * _subtract_deadband(d, deflection[2]),
    )
    turn = (
        dt * setup.angular[0] * _subtract_deadband(d, deflection[3]),
        dt * setup.angular[1] * _subtract_deadband(d, deflection[4]),
        dt * setup.angular[2] * _subtract_deadband(d, deflection[5]),
    )
    new_position = vec3.add(position, step)
    inside = (
        min(max(new_position[0], setup.low[0]), setup.high[0]),
        min(max(new_position[1], setup.low[1]), setup.high[1]),
        min(max(new_position[2], setup.low[2]), setup.high[2]),
    )
    return inside, normalize(multiply(exp(turn), orientation))
