"""Hand of a simulated device that a program leads: one thread writes the requested pose, the loop reads it.

A sequence lock protects the request: the loop never waits, and if the writer disappears, the last request remains in
effect. The hand moves smoothly and no faster than a person's, however far apart or rare the requests are.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp
from typing import Annotated, Any, Final, NamedTuple

from softfinger.drivers.block import Block, lay_out, numbers, word
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at
from softfinger.proxy.kernels.jit.seqlock import Slot, publish, refresh
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3

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
COUNTERS: Final = 8
"""Size of a sequence counter in int64: one cache line."""


class Fields(NamedTuple):
    """Fields of a hand that a program may lead."""

    sequence: Annotated[int, numbers("counter of the seqlock", COUNTERS)]
    request: Annotated[int, numbers("of the writer", REQUEST_SIZE)]
    copied: Annotated[int, numbers("copy by the loop, possibly inconsistent", REQUEST_SIZE)]
    received: Annotated[int, numbers("last consistent copy by the loop", REQUEST_SIZE)]
    turn: Annotated[int, numbers("intended orientation of the hand", 4)]
    received_sequence: Annotated[int, word("sequence number of that copy, 0 before the first request")]


AT: Final = lay_out(Fields)


@jit
def receive(handle: int, slot: Slot, copied: Any) -> None:
    """Copy a new request, if there is one. `slot` and `copied` are the fields of these names as arrays."""
    at, received = int64_at(handle), float64_at(handle + 8 * AT.received)
    newest = refresh(slot, at[AT.received_sequence], copied)
    if newest != at[AT.received_sequence]:
        at[AT.received_sequence] = newest
        for k in range(REQUEST_SIZE):
            received[k] = copied[k]


@jit
def compute_intention(handle: int, own: Vec3, own_turn: Quaternion, now: Vec3, dt: float) -> tuple[Vec3, Quaternion]:
    """Return the intention one tick from now, position (3,) m and orientation, on the path to the requested pose.

    own, own_turn  (3,) m  configured intention, returned unchanged until the first request
    now            (3,) m  intention at this tick
    dt             s
    """
    at, received = int64_at(handle), float64_at(handle + 8 * AT.received)
    turn = float64_at(handle + 8 * AT.turn)
    position, orientation = own, own_turn
    if at[AT.received_sequence] > 0:
        before = (turn[0], turn[1], turn[2], turn[3])
        share = 1.0  # no smoothing on the return to the configured intention, so that the hand reaches it
        if received[0] == MODE_HOLD:
            position, orientation = now, before
        elif received[0] == MODE_LED:
            share = 1.0 - exp(-dt / SMOOTHING_S)
            position = (received[1], received[2], received[3])
            orientation = before
            if received[4] != 0.0 or received[5] != 0.0 or received[6] != 0.0 or received[7] != 0.0:
                orientation = (received[4], received[5], received[6], received[7])
        position = vec3.add(now, clamp_step(vec3.sub(position, now), share, SPEED_MAX_M_PER_S * dt))
        rotation_vector = rotations.log(rotations.relative(orientation, before))
        step = rotations.exp(clamp_step(rotation_vector, share, TURN_MAX_RAD_PER_S * dt))
        orientation = rotations.normalize(rotations.multiply(step, before))
    for k in range(4):
        turn[k] = orientation[k]
    return position, orientation


@jit
def clamp_step(rotation_vector: Vec3, share: float, max_length: float) -> Vec3:
    """Return a fraction `share` of a displacement (3,), of at most the length `max_length`."""
    length = vec3.norm(rotation_vector)
    if share * length <= max_length:
        return vec3.scale(share, rotation_vector)
    return vec3.scale(max_length / length, rotation_vector)


class HandWriter:
    """Writer's side of the hand. Use it from one thread only."""

    def __init__(self, orientation: Quaternion, goal: Callable[[], Vec3]) -> None:
        """Create a hand with the initial intention `orientation`; `goal` returns the intended position (3,) m."""
        self._block, self._goal = Block(AT), goal
        self._turn = self._block.numbers(AT.turn, 4)
        self._turn[:] = orientation
        self.handle: Final = self._block.handle
        """Handle for `compute_intention`, valid as long as this object."""
        self._sequence = self._block.word[AT.sequence : AT.sequence + COUNTERS]
        self._values = self._block.numbers(AT.request, REQUEST_SIZE)
        self._request: Any = self._values.copy()

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
        publish(Slot(self._sequence, self._values), self._request)
