"""Displayed part of the force of a device with one or two degrees of freedom."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import metadata
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.drivers.kinematics.subspace import MotionSubspace, read_subspace
from softfinger.proxy.record import AT

GUIDE: Final = "devices/serial.md#one-or-two-degrees-of-freedom-in-a-three-dimensional-scene"
DISPLAYED_ALONG: Final = {1: "along its line", 2: "in its plane"}


class LowDofDevice(NamedTuple):
    """Device that moves on a line or in a plane, and the offset (3,) m of its fingertip from its handle."""

    freedom: MotionSubspace
    offset: Array

    def displayed_force(self, row: Array) -> Array:
        """Return the part (3,) N of a tick's force that the device displays."""
        position, force = (row[at : at + 3] for at in (AT.probe_position, AT.force))
        return self.freedom.project_force(position - self.offset, force)

    def format_html(self, row: Array) -> str:
        displayed = self.displayed_force(row)
        missing = float(np.linalg.norm(row[AT.force : AT.force + 3] - displayed))
        degrees = "one degree" if self.freedom.degrees == 1 else "two degrees"
        return (
            f"displayed: {np.linalg.norm(displayed):.2f} N {DISPLAYED_ALONG[self.freedom.degrees]}; "
            f"not displayed (grey dashes): {missing:.2f} N. "
            f'<a href="{find_documentation_url()}/{GUIDE}" target="_blank" rel="noreferrer" '
            f'style="color: inherit">A device of {degrees} of freedom</a>'
        )


def find_documentation_url() -> str:
    urls = dict(str(line).split(", ", 1) for line in metadata("softfinger").get_all("Project-URL") or ())
    return urls["Documentation"]


def find_low_dof_devices(description: Mapping[str, Any]) -> dict[str, LowDofDevice]:
    """Return the devices with fewer than three degrees of freedom, by finger, from a daemon's description."""
    try:
        rig = build(schema.Rig, description["rig"], "the daemon's rig")
    except (ConfigError, KeyError):  # a driver that is not installed here, or an older recording
        return {}
    devices = {}
    for finger in description.get("fingers", ({"name": ""},)):
        table = rig.tables.get("device" if rig.device is not None else f"devices.{finger['name']}")
        freedom = None if table is None else read_subspace(table)
        if freedom is not None:
            devices[finger["name"]] = LowDofDevice(freedom, np.array(finger.get("offset_m", (0.0, 0.0, 0.0))))
    return devices
