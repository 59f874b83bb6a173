"""Warnings of devices that still work, reported to the log and to subscribers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, Final

from softfinger.drivers.base import Device
from softfinger.server.services.base import Worker

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 0.5
NAME: Final = "device_warning"


class DeviceWarnings(Worker):
    """Service that polls the devices for warnings, and reports each once, when it starts or changes."""

    def __init__(self, devices: Callable[[], Sequence[Device]], event: Callable[..., Any]) -> None:
        super().__init__("device warnings")
        self._devices, self._event = devices, event
        self._reported: set[tuple[str, str]] = set()

    def work(self) -> None:
        while not self.closing.wait(PERIOD_S):
            self.check()

    def check(self) -> None:
        now = {(device.info.name, device.warning()) for device in self._devices()}
        for name, warning in sorted(now - self._reported):
            if warning:
                log.warning("%s: %s", name, warning)
                self._event("fault", NAME, message=f"{name}: {warning}")
        self._reported = now

    def handle_failure(self, error: Exception) -> None:
        """Publish an event; the run continues, because rendering does not depend on this service."""
        self._event("fault", NAME, message=f"warnings of devices are no longer published: {error}")
