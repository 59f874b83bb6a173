"""Where the bodies of a scene are, published some 60 times a second; nothing in a scene without a [world]."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.bodies import motion_size
from softfinger.proxy.kernels.jit.seqlock import Slot, read
from softfinger.proxy.kernels.model import Scene
from softfinger.proxy.kernels.query.bodies import MOTION_SIZE
from softfinger.server.loop.servo_thread import Servo
from softfinger.server.services.base import Worker
from softfinger.server.wire.protocol import WORLD_HZ

log: Final = logging.getLogger(__name__)

IDLE_S: Final = 0.2
"""How often it is looked whether another scene has bodies, or theirs have failed."""


class WorldState(Worker):
    """Reads what the servo tells of the bodies.

    publish  sends where they were in a tick (`Publisher.world`)
    event    publishes an event
    """

    def __init__(
        self, servo: Servo, publish: Callable[[int, list[dict[str, Any]]], None], event: Callable[..., Any]
    ) -> None:
        super().__init__("world")
        self._servo, self._publish, self._event = servo, publish, event
        self._motion: Slot | None = None
        self._sequence, self._values = 0, np.empty(0)
        self._told: Any = None
        """The bodies whose fault was told."""

    def work(self) -> None:
        wait_s = IDLE_S
        while not self.closing.wait(wait_s):
            wait_s = self._look()

    def _look(self) -> float:
        """Publish what is new; returns after how long (s) to look again. Nothing of a loop that ended is held on to."""
        shared, scene = self._servo.shared, self._servo.tuning.scene
        self._tell_fault(scene)
        if scene.bodies is None or len(shared.motion.values) != motion_size(scene):  # or a loop with others begins now
            self._motion = None
            return IDLE_S
        if self._motion is not shared.motion:  # another loop has begun, or the first
            self._motion, self._sequence = shared.motion, 0
            self._values = np.empty_like(shared.motion.values)
            read.compile(tuple(map(numba.typeof, (self._motion, self._sequence, self._values))))  # type: ignore[attr-defined]
        newest = read(self._motion, self._sequence, self._values)
        if newest != self._sequence:
            self._sequence = newest
            self._publish(int(self._values[0]), told(scene.bodies.block.owner.names, self._values))
        return 1.0 / WORLD_HZ

    def _tell_fault(self, scene: Scene) -> None:
        """Once for bodies that stand still; those that are put back are others."""
        owner = None if scene.bodies is None else scene.bodies.block.owner
        if owner is None or owner is self._told or (failure := owner.failure) is None:
            return
        self._told = owner
        message = f"{failure}; then softfinger ctl reset_world puts them back"
        log.error("%s", message)
        self._event("fault", "bodies", message=message)

    def failed(self, error: Exception) -> None:
        """The page stands still; what is felt goes on."""
        self._event("fault", "world", message=str(error))


def told(names: list[str], values: NDArray[np.float64]) -> list[dict[str, Any]]:
    """The bodies of a message, from what `query.bodies.tell_motion` has written."""
    return [
        {
            "name": name,
            "position": row[:3],
            "orientation": row[3:7],
            "velocity": row[7:10],
            "rate": row[10:13],
        }
        for name, row in zip(names, values[1:].reshape(-1, MOTION_SIZE).tolist(), strict=True)
    ]
