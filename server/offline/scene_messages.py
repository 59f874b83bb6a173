"""Messages of an offline run on the topics of its scene, `world` and `deformation`, at the rate of pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.proxy.bodies import count_motion_values, decode_motion
from softfinger.proxy.kernels import model as kernels
from softfinger.proxy.kernels.query.bodies import write_motion
from softfinger.proxy.record import AT
from softfinger.server.wire.protocol import DEFORMATION, PICTURE_HZ, SCHEMA, WORLD

if TYPE_CHECKING:  # only for scenes with an elastic object
    from softfinger.proxy.elastic.loads import ContactLoad


class SceneMessages:
    """Collects the messages of a run with simulated time.

    scene    None: no messages
    pending  topics and messages, maps as on the wire, in order of time; the consumer removes them
    """

    def __init__(self, scene: schema.Scene | None, rate_hz: float) -> None:
        self._fingers = [finger.name for finger in scene.fingers] if scene is not None else []
        self._elastic_object = scene.elastic_object if scene is not None else None
        self._rate_hz = rate_hz
        self._has_topics = scene is not None and (scene.world is not None or scene.elastic_object is not None)
        self._loads: list[ContactLoad] = []
        self.pending: Final = deque[tuple[str, dict[str, Any]]]()

    def split(self, scene: kernels.Scene, first: int, records: Array) -> Iterator[tuple[int, slice]]:
        """Split the ticks of `records` (n, fingers, RECORD_SIZE) after each tick with messages.

        Yields the number of the first tick and the rows of each part. The caller runs these ticks before it advances
        the iterator, which then adds the messages. The last tick of `records` always has messages.
        """
        ends = [len(records)]
        if self._has_topics:
            pictures = np.floor(np.arange(first - 1, first + len(records)) * (PICTURE_HZ / self._rate_hz))
            ends = [*(np.flatnonzero(np.diff(pictures[:-1])) + 1).tolist(), len(records)]
        for start, end in pairwise([0, *ends]):
            yield first + start, slice(start, end)
            if self._has_topics:
                self._add(scene, records[end - 1])

    def _add(self, scene: kernels.Scene, rows: Array) -> None:
        """Add the messages of a tick from the records (fingers, RECORD_SIZE) and the bodies after its step."""
        tick = int(rows[0, AT.tick])
        head = {"schema": SCHEMA, "timestamp": float(rows[0, AT.timestamp]), "tick": tick}
        if scene.bodies is not None:
            motion = np.empty(count_motion_values(scene))
            write_motion(scene.bodies, tick, motion)
            self.pending.append((WORLD, head | {"bodies": decode_motion(scene.bodies.block.owner.names, motion)}))
        if self._elastic_object is not None:
            from softfinger.proxy.elastic.loads import compute_contact_loads, has_changed

            loads = compute_contact_loads(self._elastic_object, dict(zip(self._fingers, rows, strict=True)))
            if has_changed(self._loads, loads):
                self._loads = loads
                self.pending.append((DEFORMATION, head | {"loads": [load._asdict() for load in loads]}))


NO_MESSAGES: Final = SceneMessages(None, 1.0)
