"""A tool on the device's handle, such as a stylus: from the handle's pose to the tip's, and a wrench back.

The fingertip is the tool's tip. With d the way from the handle to the tip, in the world, the handle's torque is that
about the tip plus d x F: then F . v + tau . w is the same power at either end, whatever the hand does.

It stands between the device and the contact, so every driver has it, and before the guard, which limits what the
device is given: the torque of a long tool is clamped where it acts. Without a tool (None) nothing of it is compiled.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Pose, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import conjugate, multiply, normalize, rotate


class Tool(NamedTuple):
    """Where the tip is on the handle.

    lever  (3,) m  from handle to tip, in the tip's frame, which alone the contact remembers
    turn           unit quaternion, tip to handle
    """

    lever: Vec3
    turn: Quaternion


@by_type
def tip_of(tool: Any, handle: Pose) -> Any:
    """Pose of the tip."""


@by_type
def about_handle(tool: Any, tip: Quaternion, force: Vec3, torque: Vec3) -> Any:
    """Torque (3,) N m about the handle of a wrench at the tip, whose orientation is `tip`; world frame."""


@by_type
def about_tip(tool: Any, tip: Quaternion, force: Vec3, torque: Vec3) -> Any:
    """Torque (3,) N m about the tip of a wrench at the handle."""


@tip_of.of(None)
def tip_is_handle(tool: None, handle: Pose) -> Pose:
    return handle


@about_handle.of(None)
def same_about_handle(tool: None, tip: Quaternion, force: Vec3, torque: Vec3) -> Vec3:
    return torque


@about_tip.of(None)
def same_about_tip(tool: None, tip: Quaternion, force: Vec3, torque: Vec3) -> Vec3:
    return torque


@tip_of.of(Tool)
def tip_of_tool(tool: Tool, handle: Pose) -> Pose:
    tip = multiply(handle.orientation, tool.turn)
    return Pose(vec3.add(handle.position, rotate(tip, tool.lever)), tip)


@about_handle.of(Tool)
def about_handle_of_tool(tool: Tool, tip: Quaternion, force: Vec3, torque: Vec3) -> Vec3:
    return vec3.add(torque, vec3.cross(rotate(tip, tool.lever), force))


@about_tip.of(Tool)
def about_tip_of_tool(tool: Tool, tip: Quaternion, force: Vec3, torque: Vec3) -> Vec3:
    return vec3.sub(torque, vec3.cross(rotate(tip, tool.lever), force))


def handle_of(tool: Tool | None, tip: Pose) -> Pose:
    """Pose of the handle whose tip is there: the inverse of `tip_of`."""
    if tool is None:
        return tip
    turn = multiply(tip.orientation, conjugate(tool.turn))
    return Pose(vec3.sub(tip.position, rotate(tip.orientation, tool.lever)), turn)


def make_tool(offset: Vec3, orientation: Quaternion) -> Tool:
    """The tool whose tip is at `offset` (3,) m on the handle, turned by `orientation` (not zero), tip to handle."""
    turn = normalize(orientation)
    return Tool(rotate(conjugate(turn), offset), turn)
