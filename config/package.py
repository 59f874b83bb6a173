"""Real-time haptic rendering server: soft-finger contact with rolling and torsion at 1 kHz.

`Engine` renders the contact of a scene in this process, pose by pose. `run_recording` renders a recording of poses as
the daemon would. `Client` connects to a running daemon (`softfinger run`). `load_scene` reads a scene. `ContactMode`
names the contact modes. The exceptions that these raise are exported, too; all derive from `HapticError`.
docs/python.md shows how to combine them.

>>> import softfinger
>>> engine = softfinger.Engine("paper-plane")
>>> engine.step(position=[0.0, 0.0, 0.009], orientation=[1.0, 0.0, 0.0, 0.0]).force.round(6)
array([0., 0., 1.])
"""

# The wheel installs this file as softfinger/__init__.py: docs/decisions/0001-one-import-name.md.

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.config.errors import *
    from softfinger.config.load import load_scene
    from softfinger.proxy.engine import Engine
    from softfinger.proxy.pose_checks import PoseError
    from softfinger.proxy.record import ContactMode
    from softfinger.proxy.records import NoField
    from softfinger.server.experiment.experiment import Experiment
    from softfinger.server.offline.simulate import run_recording
    from softfinger.server.remote import Client
    from softfinger.server.wire.client import NoTelemetry
    from softfinger.server.wire.client_requests import NoAnswer
    from softfinger.server.wire.protocol import ProtocolError

    __version__: str

__all__ = [
    "AddressInUse",
    "Client",
    "CommandRefused",
    "ConfigError",
    "ContactMode",
    "DeviceBusy",
    "DeviceError",
    "DeviceLost",
    "DeviceNotFound",
    "DevicePermission",
    "DeviceTimeout",
    "Different",
    "Engine",
    "Exhausted",
    "Experiment",
    "HapticError",
    "NoAnswer",
    "NoField",
    "NoTelemetry",
    "PoseError",
    "ProtocolError",
    "RealtimeError",
    "RecordingError",
    "SafetyStop",
    "Unfit",
    "__version__",
    "load_scene",
    "run_recording",
]

_HOMES = {
    "Client": "softfinger.server.remote",
    "ContactMode": "softfinger.proxy.record",
    "Engine": "softfinger.proxy.engine",
    "Experiment": "softfinger.server.experiment.experiment",
    "NoAnswer": "softfinger.server.wire.client_requests",
    "NoField": "softfinger.proxy.records",
    "NoTelemetry": "softfinger.server.wire.client",
    "PoseError": "softfinger.proxy.pose_checks",
    "ProtocolError": "softfinger.server.wire.protocol",
    "load_scene": "softfinger.config.load",
    "run_recording": "softfinger.server.offline.simulate",
}
"""Module of each public name except the errors; imported on first use, since the compiler takes half a second."""


def __getattr__(name: str) -> Any:
    if name == "__version__":  # reading the metadata takes longer than most imports here
        from importlib.metadata import version

        return version("softfinger")
    if name not in __all__:
        from softfinger.config.words import suggest

        hint = suggest(name, __all__)
        raise AttributeError(f"module 'softfinger' has no attribute {name!r}{hint}: it offers {', '.join(__all__)}")
    import gc
    from importlib import import_module

    collects = gc.isenabled()
    gc.disable()  # an import creates no garbage, and each collection would scan the objects of numba
    try:
        return getattr(import_module(_HOMES.get(name, "softfinger.config.errors")), name)
    finally:
        if collects:
            gc.enable()


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
