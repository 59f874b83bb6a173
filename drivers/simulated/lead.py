"""A hand that is computed, led by a program: from where its fingertip is to be to what its device is asked for."""

from __future__ import annotations

from typing import NamedTuple

from softfinger.config.errors import ConfigError, HapticError
from softfinger.drivers.base import Device, Led
from softfinger.proxy.kernels.model import Pose, Quaternion, Vec3
from softfinger.proxy.kernels.numerics.rotations import normalize
from softfinger.proxy.kernels.numerics.tool import Tool, handle_of, tip_of


class NoHand(HapticError):
    """There is no hand that a program may lead."""


class Wanted(NamedTuple):
    """Where a hand is to hold the fingertip.

    position     (3,) m  in the world
    orientation  fingertip to world, of any length but 0; None: as it is turned
    now          how the fingertip is turned
    """

    position: Vec3
    orientation: Quaternion | None
    now: Quaternion


def hand_of(device: Device) -> Led:
    """The hand on a device; NoHand where none is computed."""
    hand = device.hand()
    if hand is None:
        raise NoHand(
            f"no program leads the hand on {device.info.name}: it is a recording, a person or a puck; softfinger run "
            "--rig simulated-hand has one"
        )
    return hand


def hold(device: Device, tool: Tool | None, offset: Vec3) -> Pose:
    """Have the hand on `device`, which holds `tool`, stay where it wants to be; returns where it holds the fingertip
    then, in the world. Of a grip that is deeper than the fingertip comes, since what it grips resists.

    offset  (3,) m  what is added to the position that the device says

    Raises NoHand where none is computed.
    """
    hand = hand_of(device)
    hand.hold()
    tip: Pose = tip_of(tool, Pose(*hand.intends()))
    x, y, z = (p + o for p, o in zip(tip.position, offset, strict=True))
    return Pose((x, y, z), tip.orientation)


def lead(device: Device, tool: Tool | None, offset: Vec3, wanted: Wanted | None) -> None:
    """Have the hand on `device`, which holds `tool`, want to be there; None: do what it does by itself.

    offset  (3,) m  what is added to the position that the device says

    Raises NoHand where none is computed, ConfigError for what the device does not reach or sense.
    """
    hand, info = hand_of(device), device.info
    if wanted is None:
        hand.release()
        return
    if wanted.orientation is not None and info.sensed_dof < 6:
        raise ConfigError(f"hand: {info.name} senses no rotation: leave orientation_wxyz out")
    if wanted.orientation is not None and not any(wanted.orientation):
        raise ConfigError("hand: orientation_wxyz all zero is no orientation: [1, 0, 0, 0] turns nothing")
    tip = wanted.now if wanted.orientation is None else normalize(wanted.orientation)
    handle = handle_of(tool, Pose(wanted.position, tip))
    x, y, z = (p - o for p, o in zip(handle.position, offset, strict=True))
    low, high = info.workspace_min_m, info.workspace_max_m
    if not all(a <= p <= b for a, p, b in zip(low, (x, y, z), high, strict=True)):
        raise ConfigError(
            f"hand: position_m = {list(wanted.position)} is out of reach of {info.name}, whose handle goes from "
            f"{list(low)} to {list(high)} m"
        )
    hand.lead((x, y, z), None if wanted.orientation is None else handle.orientation)
