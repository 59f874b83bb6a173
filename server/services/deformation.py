"""Publication of the loads on an elastic object, when they change; nothing for a scene without one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering
from softfinger.server.wire.protocol import DEFORMATION, PICTURE_HZ

if TYPE_CHECKING:  # only for scenes with an elastic object
    from softfinger.proxy.elastic.loads import ContactLoad


class Deformation:
    """Derives the loads from the records of the servo.

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
