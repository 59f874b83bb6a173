"""Hand of a simulated device that a program leads: one thread writes the requested pose, the loop reads it.

A sequence lock protects the request: the loop never waits, and if the writer disappears, the last request remains in
effect. The hand moves smoothly and no faster than a person's, however far apart or rare the requests are.
`lead_hand` converts a requested pose of the fingertip.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp
from typing import Annotated, Final, NamedTuple

from softfinger.config.errors import ConfigError, HapticError
from softfinger.drivers.base import Device, LeadableHand
from softfinger.drivers.block import Block, lay_out, numbers, slot, slot_at, word
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float64_array_at, float64_at, int64_at
from softfinger.proxy.kernels.jit.seqlock import publish, refresh
from softfinger.proxy.kernels.model import Pose, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.rotations import normalize
from softfinger.proxy.kernels.numerics.tool import Tool, handle_of, tip_of

SPEED_MAX_M_PER_S: Final = 0.3
"""Maximum speed of the intention: a quick stroke."""
TURN_MAX_RAD_PER_S: Final = 6.0
"""Maximum angular speed of the intention: a turn of the wrist within a second."""
SMOOTHING_S: Final = 0.03
"""Time constant of the approach to the requested pose: a mouse sends about 20 positions per second."""

REQUEST_SIZE: Final = 8
"""Numbers of a request: mode, position (3,) m, orientation (4,), all 0 for an unchanged orientation."""
MODE_OWN: Final = 0.0
MODE_LED: Final = 1.0
MODE_HOLD: Final = 2.0
"""Modes: follow the configured intention, move to the requested pose, or hold the present intention."""


class Fields(NamedTuple):
    """Fields of a hand that a program may lead."""

    request: Annotated[int, slot("request of the writer", REQUEST_SIZE)]
    copied: Annotated[int, numbers("copy by the loop, possibly inconsistent", REQUEST_SIZE)]
    received: Annotated[int, numbers("last consistent copy by the loop", REQUEST_SIZE)]
    turn: Annotated[int, numbers("intended orientation of the hand", 4)]
    received_sequence: Annotated[int, word("sequence number of that copy, 0 before the first request")]


AT: Final = lay_out(Fields)


@jit
def receive(handle: int) -> None:
    """Copy a new request, if there is one."""
    at, received = int64_at(handle), float64_at(handle + 8 * AT.received)
    copied = float64_array_at(handle + 8 * AT.copied, REQUEST_SIZE)
    newest = refresh(slot_at(handle + 8 * AT.request, REQUEST_SIZE), at[AT.received_sequence], copied)
    if newest != at[AT.received_sequence]:
        at[AT.received_sequence] = newest
        for k in range(REQUEST_SIZE):
            received[k] = copied[k]


@jit
def compute_intention(
    handle: int, own: Vec3, own_turn: Quaternion, present: Vec3, dt: float
) -> tuple[Vec3, Quaternion]:
    """Return the intention one tick from now, position (3,) m and orientation, on the path to the requested pose.

    own, own_turn  (3,) m  configured intention, returned unchanged until the first request
    present        (3,) m  intention at this tick
    dt             s
    """
    at, received = int64_at(handle), float64_at(handle + 8 * AT.received)
    turn = float64_at(handle + 8 * AT.turn)
    position, orientation = own, own_turn
    if at[AT.received_sequence] > 0:
        before = (turn[0], turn[1], turn[2], turn[3])
        share = 1.0  # no smoothing on the return to the configured intention, so that the hand reaches it
        if received[0] == MODE_HOLD:
            position, orientation = present, before
        elif received[0] == MODE_LED:
            share = 1.0 - exp(-dt / SMOOTHING_S)
            position = (received[1], received[2], received[3])
            orientation = before
            if received[4] != 0.0 or received[5] != 0.0 or received[6] != 0.0 or received[7] != 0.0:
                orientation = (received[4], received[5], received[6], received[7])
        position = vec3.add(present, clamp_step(vec3.sub(position, present), share, SPEED_MAX_M_PER_S * dt))
        rotation_vector = rotations.log(rotations.relative(orientation, before))
        step = rotations.exp(clamp_step(rotation_vector, share, TURN_MAX_RAD_PER_S * dt))
        orientation = rotations.normalize(rotations.multiply(step, before))
    for k in range(4):
        turn[k] = orientation[k]
    return position, orientation


@jit
def clamp_step(displacement: Vec3, share: float, max_length: float) -> Vec3:
    """Return a fraction `share` of a displacement or rotation vector (3,), of at most the length `max_length`."""
    length = vec3.norm(displacement)
    if share * length <= max_length:
        return vec3.scale(share, displacement)
    return vec3.scale(max_length / length, displacement)


class HandWriter:
    """Writer's side of the hand. Use it from one thread only."""

    def __init__(self, orientation: Quaternion, goal: Callable[[], Vec3]) -> None:
        """Create a hand with the initial intention `orientation`; `goal` returns the intended position (3,) m."""
        self._block, self._goal = Block(AT), goal
        self._turn = self._block.numbers(AT.turn, 4)
        self._turn[:] = orientation
        self.handle: Final = self._block.handle
        """Handle for `compute_intention`, valid as long as this object."""
        self._slot = self._block.slot(AT.request, REQUEST_SIZE)
        self._request = self._slot.values.copy()

    def lead(self, position_m: Vec3, orientation: Quaternion | None = None) -> None:
        """Make the hand intend `position_m` (the device's frame is the world's) and the orientation; None: unchanged.

        orientation  unit quaternion, handle to world
        """
        self._publish_request(MODE_LED, position_m, orientation or (0.0, 0.0, 0.0, 0.0))

    def hold(self) -> None:
        """Make the hand keep its intention at the time of this request: a grip continues."""
        self._publish_request(MODE_HOLD, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))

    def release(self) -> None:
        self._publish_request(MODE_OWN, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))

    def intends(self) -> tuple[Vec3, Quaternion]:
        """Return the intended position (3,) m and orientation; components may be from two consecutive ticks."""
        w, x, y, z = self._turn.tolist()
        return self._goal(), (w, x, y, z)

    def _publish_request(self, mode: float, position: Vec3, orientation: Quaternion) -> None:
        self._request[:] = mode, *position, *orientation
        publish(self._slot, self._request)


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
