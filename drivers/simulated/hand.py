"""The hand of a simulated device, led by a program: where it is asked to be, written by one thread, read by the loop.

A seqlock stands between them: the loop never waits, and a writer that has gone leaves the hand where it last asked
it to be. However far or seldom it asks, the hand goes there smoothly and no faster than a person's.
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
"""Of what the hand intends: a quick stroke."""
TURN_MAX_RAD_PER_S: Final = 6.0
"""Of what the hand intends: a turn of the wrist within a second."""
SMOOTHING_S: Final = 0.03
"""Time constant on the way to where it is asked to be: a mouse tells its place some 20 times a second."""

ASKED: Final = 8
"""Numbers of a request: what is asked, position (3,) m, orientation (4,), all 0 to leave it as it is."""
OWN: Final = 0.0
LED: Final = 1.0
HELD: Final = 2.0
"""What is asked: to do what it does by itself, to go there, or to stay where it wants to be."""
COUNTERS: Final = 8
"""Words of a seqlock's counter: a line of the cache."""


class Words(NamedTuple):
    """The words of a hand that may be led."""

    sequence: Annotated[int, numbers("counter of the seqlock", COUNTERS)]
    asked: Annotated[int, numbers("what is asked", ASKED)]
    copied: Annotated[int, numbers("the loop's copy, which may be torn", ASKED)]
    heard: Annotated[int, numbers("the loop's last whole copy", ASKED)]
    turn: Annotated[int, numbers("orientation that the hand intends", 4)]
    seen: Annotated[int, word("counter of that copy, 0 before the first request")]


AT: Final = lay_out(Words)


@jit
def hear(handle: int, slot: Slot, copied: Any) -> None:
    """Take what is asked by now. `slot` and `copied` are the words of these names as arrays."""
    at, heard = int64_at(handle), float64_at(handle + 8 * AT.heard)
    newest = refresh(slot, at[AT.seen], copied)
    if newest != at[AT.seen]:
        at[AT.seen] = newest
        for k in range(ASKED):
            heard[k] = copied[k]


@jit
def intended(handle: int, own: Vec3, own_turn: Quaternion, now: Vec3, dt: float) -> tuple[Vec3, Quaternion]:
    """What the hand intends a tick from now, position (3,) m and orientation: on its way to where it is asked to be.

    own, own_turn  (3,) m  what it intends by itself: exactly that, until it is first asked for something else
    now            (3,) m  what it intends at this tick
    dt             s
    """
    at, heard = int64_at(handle), float64_at(handle + 8 * AT.heard)
    turn = float64_at(handle + 8 * AT.turn)
    position, orientation = own, own_turn
    if at[AT.seen] > 0:
        before = (turn[0], turn[1], turn[2], turn[3])
        share = 1.0  # on the way back nothing is smoothed, so that it arrives
        if heard[0] == HELD:
            position, orientation = now, before
        elif heard[0] == LED:
            share = 1.0 - exp(-dt / SMOOTHING_S)
            position = (heard[1], heard[2], heard[3])
            orientation = before
            if heard[4] != 0.0 or heard[5] != 0.0 or heard[6] != 0.0 or heard[7] != 0.0:
                orientation = (heard[4], heard[5], heard[6], heard[7])
        position = vec3.add(now, shortened(vec3.sub(position, now), share, SPEED_MAX_M_PER_S * dt))
        way = rotations.log(rotations.relative(orientation, before))
        step = rotations.exp(shortened(way, share, TURN_MAX_RAD_PER_S * dt))
        orientation = rotations.normalize(rotations.multiply(step, before))
    for k in range(4):
        turn[k] = orientation[k]
    return position, orientation


@jit
def shortened(way: Vec3, share: float, most: float) -> Vec3:
    """A share of a way (3,), and not more of it than `most`."""
    length = vec3.norm(way)
    if share * length <= most:
        return vec3.scale(share, way)
    return vec3.scale(most / length, way)


class Hand:
    """The writer's side. One thread only."""

    def __init__(self, orientation: Quaternion, goal: Callable[[], Vec3]) -> None:
        """`orientation`: what the hand intends at first; `goal` (3,) m what it intends now."""
        self._block, self._goal = Block(AT), goal
        self._turn = self._block.numbers(AT.turn, 4)
        self._turn[:] = orientation
        self.handle: Final = self._block.handle
        """For `intended`, as long as this object."""
        self._sequence = self._block.word[AT.sequence : AT.sequence + COUNTERS]
        self._values = self._block.numbers(AT.asked, ASKED)
        self._request: Any = self._values.copy()

    def lead(self, position_m: Vec3, orientation: Quaternion | None = None) -> None:
        """Have the hand want to be at `position_m` (device's frame is the world's), turned so; None: as it is turned.

        orientation  unit quaternion, handle to world
        """
        self._ask(LED, position_m, orientation or (0.0, 0.0, 0.0, 0.0))

    def hold(self) -> None:
        """Have the hand stay where it wants to be when this is heard: what it grips it goes on gripping."""
        self._ask(HELD, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))

    def release(self) -> None:
        """Have the hand go back to what it intends by itself."""
        self._ask(OWN, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))

    def intends(self) -> tuple[Vec3, Quaternion]:
        """Where the hand wants to be, (3,) m, and how turned; components may be of two ticks."""
        w, x, y, z = self._turn.tolist()
        return self._goal(), (w, x, y, z)

    def _ask(self, what: float, position: Vec3, orientation: Quaternion) -> None:
        self._request[:] = what, *position, *orientation
        publish(Slot(self._sequence, self._values), self._request)
