"""Conversion of a requested fingertip pose to a request to the device's simulated hand."""

from __future__ import annotations

from typing import NamedTuple

from softfinger.config.errors import ConfigError, HapticError
from softfinger.drivers.base import Device, LeadableHand
from softfinger.proxy.kernels.model import Pose, Quaternion, Vec3
from softfinger.proxy.kernels.numerics.rotations import normalize
from softfinger.proxy.kernels.numerics.tool import Tool, handle_of, tip_of


class NoSimulatedHand(HapticError):
    """The device has no hand that a program may lead."""


class RequestedPose(NamedTuple):
    """Requested pose of the fingertip.

    position     (3,) m  in the world
    orientation  fingertip to world, of any length but 0; None: unchanged
    present_orientation  present orientation of the fingertip
    """

    position: Vec3
    orientation: Quaternion | None
    present_orientation: Quaternion


def find_hand(device: Device) -> LeadableHand:
    """Return the hand of a device; raises NoSimulatedHand if it has no simulated one."""
    hand = device.hand()
    if hand is None:
        raise NoSimulatedHand(
            f"{device.info.name} has no hand that a program can move: use softfinger run --rig simulated-hand"
        )
    return hand


def hold(device: Device, tool: Tool | None, offset: Vec3) -> Pose:
    """Make the hand of `device` with `tool` keep its intention, and return the intended fingertip pose in the world.

    In a grip the intended pose is deeper than the actual one, because the object resists.

    offset  (3,) m  added to the position that the device senses

    Raises NoSimulatedHand if the device has no simulated hand.
    """
    hand = find_hand(device)
    hand.hold()
    tip: Pose = tip_of(tool, Pose(*hand.intends()))
    x, y, z = (p + o for p, o in zip(tip.position, offset, strict=True))
    return Pose((x, y, z), tip.orientation)


def lead_hand(device: Device, tool: Tool | None, offset: Vec3, requested: RequestedPose | None) -> None:
    """Make the hand of `device` with `tool` intend the pose `requested`; None: return to its configured intention.

    offset  (3,) m  added to the position that the device senses

    Raises NoSimulatedHand if the device has no simulated hand, ConfigError if it cannot reach or sense the pose.
    """
    hand, info = find_hand(device), device.info
    if requested is None:
        hand.release()
        return
    if requested.orientation is not None and info.sensed_dof < 6:
        raise ConfigError(f"hand: {info.name} measures no orientation: remove orientation_wxyz")
    if requested.orientation is not None and not any(requested.orientation):
        raise ConfigError("hand: orientation_wxyz all zero is not an orientation: [1, 0, 0, 0] turns nothing")
    tip = requested.present_orientation if requested.orientation is None else normalize(requested.orientation)
    handle = handle_of(tool, Pose(requested.position, tip))
    x, y, z = (p - o for p, o in zip(handle.position, offset, strict=True))
    low, high = info.workspace_min_m, info.workspace_max_m
    if not all(a <= p <= b for a, p, b in zip(low, (x, y, z), high, strict=True)):
        raise ConfigError(
            f"hand: position_m = {list(requested.position)} is outside the workspace of {info.name}, {list(low)} to "
            f"{list(high)} m"
        )
    hand.lead((x, y, z), None if requested.orientation is None else handle.orientation)
