"""Publication of the topics of a scene: poses of its bodies, about 60 times per second, and loads on an elastic object.

Nothing is published for a scene without a [world] or an elastic object.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.bodies import count_motion_values, decode_motion
from softfinger.proxy.kernels.jit.seqlock import Slot, read
from softfinger.proxy.kernels.model import Scene
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.services.base import Worker
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering
from softfinger.server.wire.protocol import DEFORMATION, PICTURE_HZ, WORLD

if TYPE_CHECKING:  # only for scenes with an elastic object
    from softfinger.proxy.elastic.loads import ContactLoad


log: Final = logging.getLogger(__name__)

IDLE_S: Final = 0.2
"""Interval of the check for a scene with bodies, and for a fault of the bodies."""


class WorldPublisher(Worker):
    """Service that publishes the poses of the bodies, read from the servo.

    publish  publishes a message of a topic with the content of a tick
    event    publishes an event
    """

    def __init__(
        self, servo: ServoThread, publish: Callable[[str, int, dict[str, Any]], None], event: Callable[..., Any]
    ) -> None:
        super().__init__("world")
        self._servo, self._publish, self._event = servo, publish, event
        self._motion: Slot | None = None
        self._sequence, self._values = 0, np.empty(0)
        self._reported: Any = None
        """Bodies whose fault has been reported."""

    def work(self) -> None:
        wait_s = IDLE_S
        while not self.closing.wait(wait_s):
            wait_s = self._publish_latest()

    def _publish_latest(self) -> float:
        """Publish the latest motion and return the time (s) until the next check.

        Drops references to a loop that has finished, or that is about to be replaced by one with other bodies.
        """
        shared, scene = self._servo.shared, self._servo.tuning.scene
        self._report_fault(scene)
        if scene.bodies is None or len(shared.motion.values) != count_motion_values(scene):
            self._motion = None
            return IDLE_S
        if self._motion is not shared.motion:  # the first loop, or another one has started
            self._motion, self._sequence = shared.motion, 0
            self._values = np.empty_like(shared.motion.values)
            read.compile(tuple(map(numba.typeof, (self._motion, self._sequence, self._values))))  # type: ignore[attr-defined]
        newest = read(self._motion, self._sequence, self._values)
        if newest != self._sequence:
            self._sequence = newest
            bodies = decode_motion(scene.bodies.block.owner.names, self._values)
            self._publish(WORLD, int(self._values[0]), {"bodies": bodies})
        return 1.0 / PICTURE_HZ

    def _report_fault(self, scene: Scene) -> None:
        """Report a fault once; after a reset, the bodies are new objects."""
        owner = None if scene.bodies is None else scene.bodies.block.owner
        if owner is None or owner is self._reported or (failure := owner.failure) is None:
            return
        self._reported = owner
        message = f"{failure}; then softfinger ctl reset_world puts them back"
        log.error("%s", message)
        self._event("fault", "bodies", message=message)

    def handle_failure(self, error: Exception) -> None:
        """Publish an event; the page stops moving, but rendering continues."""
        self._event("fault", "world", message=str(error))


class DeformationPublisher:
    """Publisher of the loads on an elastic object, derived from the records of the servo.

    publish  publishes a message of a topic with the content of a tick
    """

    def __init__(
        self, rendering: Rendering, fingers: Sequence[str], publish: Callable[[str, int, dict[str, Any]], None]
    ) -> None:
        self._rendering, self._fingers, self._publish = rendering, list(fingers), publish
        self._loads: list[ContactLoad] = []
        self._due_s = -np.inf
        self.sink: Final = Sink("deformation", self._take)

    def _take(self, records: NDArray[np.float64], drops: int) -> None:
        """Publish the loads in the last of `records` (n, fingers x RECORD_SIZE) if they have changed."""
        rows = records[-1].reshape(-1, RECORD_SIZE)
        elastic_object, now = self._rendering.scene.elastic_object, float(rows[0, AT.timestamp])
        if (elastic_object is None and not self._loads) or self._due_s - 1.0 / PICTURE_HZ <= now < self._due_s:
            return
        from softfinger.proxy.elastic.loads import has_changed

        loads = self._read_loads(elastic_object, rows)
        if has_changed(self._loads, loads):
            self._loads, self._due_s = loads, now + 1.0 / PICTURE_HZ
            self._publish(DEFORMATION, int(rows[0, AT.tick]), {"loads": [load._asdict() for load in loads]})

    def _read_loads(self, elastic_object: schema.Mesh | None, rows: NDArray[np.float64]) -> list[ContactLoad]:
        """Return the loads; none in ticks of the scene before."""
        if elastic_object is None or rows[0, AT.tick] < self._rendering.since:
            return []
        from softfinger.proxy.elastic.loads import compute_contact_loads

        return compute_contact_loads(elastic_object, dict(zip(self._fingers, rows, strict=True)))
