"""Real-time haptic rendering server: soft-finger contact with rolling and torsion at 1 kHz.

`Engine` renders the contact of a scene, pose by pose, in this process; `run_recording` a whole recording of poses, as
the daemon would; `Client` talks to a daemon that runs (`softfinger run`); `load_scene` reads a scene. docs/python.md
shows how they go together.

>>> import softfinger
>>> engine = softfinger.Engine("paper-plane")
>>> engine.step(position=[0.0, 0.0, 0.009], orientation=[1.0, 0.0, 0.0, 0.0]).force.round(6)
array([0., 0., 1.])
"""

# Installed, this file is softfinger/__init__.py: docs/decisions/0001-one-import-name.md.

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.config.load import load_scene
    from softfinger.proxy.engine import Engine
    from softfinger.server.offline.simulate import run_recording
    from softfinger.server.remote import Client

    __version__: str

__all__ = ["Client", "Engine", "__version__", "load_scene", "run_recording"]

_HOMES = {
    "Client": "softfinger.server.remote",
    "Engine": "softfinger.proxy.engine",
    "load_scene": "softfinger.config.load",
    "run_recording": "softfinger.server.offline.simulate",
}
"""Imported when they are asked for: the compiler alone takes half a second."""


def __getattr__(name: str) -> Any:
    if name == "__version__":  # reading the metadata takes longer than most imports here
        from importlib.metadata import version

        return version("softfinger")
    if name not in _HOMES:
        raise AttributeError(f"module 'softfinger' has no attribute {name!r}: it offers {', '.join(__all__)}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
