"""Tool on the device's handle, such as a stylus: transforms the handle's pose to the tip, and a wrench back.

The fingertip is the tool's tip. With d the displacement from the handle to the tip, world frame, the torque about the
handle is that about the tip plus d x F: the power F . v + tau . w is then the same at both ends for any motion.

The servo loop applies the tool between device and contact, so that it works with every driver, and before the guard, so
that the torque of a long tool is clamped where the device exerts it. Without a tool (None) no code is compiled for it.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Pose, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import conjugate, multiply, normalize, rotate


class Tool(NamedTuple):
    """Pose of the tip relative to the handle.

    lever  (3,) m  from handle to tip, in the tip's frame: the contact stores only the tip's orientation
    turn           unit quaternion, tip to handle
    """

    lever: Vec3
    turn: Quaternion


@jit
def tip_of(tool: Any, handle: Pose) -> Pose:
    """Return the pose of the tip, world frame."""
    if tool is None:
        return handle
    tip = multiply(handle.orientation, tool.turn)
    return Pose(vec3.add(handle.position, rotate(tip, tool.lever)), tip)


@jit
def about_handle(tool: Any, tip: Quaternion, force: Vec3, torque: Vec3) -> Vec3:
    """Return the torque (3,) N m about the handle of a wrench at the tip.

    All vectors are in the world frame; `tip` is the tip's orientation.
    """
    if tool is None:
        return torque
    return vec3.add(torque, vec3.cross(rotate(tip, tool.lever), force))


@jit
def about_tip(tool: Any, tip: Quaternion, force: Vec3, torque: Vec3) -> Vec3:
    """Return the torque (3,) N m about the tip of a wrench at the handle: the inverse of `about_handle`."""
    if tool is None:
        return torque
    return vec3.sub(torque, vec3.cross(rotate(tip, tool.lever), force))


def handle_of(tool: Tool | None, tip: Pose) -> Pose:
    """Return the pose of the handle from that of the tip: the inverse of `tip_of`."""
    if tool is None:
        return tip
    turn = multiply(tip.orientation, conjugate(tool.turn))
    return Pose(vec3.sub(tip.position, rotate(tip.orientation, tool.lever)), turn)


def make_tool(offset: Vec3, orientation: Quaternion) -> Tool:
    """Return a tool from the pose of its tip in the handle's frame.

    offset       (3,)  m  position of the tip
    orientation  (4,)     quaternion, tip to handle; not zero, normalised here
    """
    turn = normalize(orientation)
    return Tool(rotate(conjugate(turn), offset), turn)
