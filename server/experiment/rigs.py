"""Values of the rig as parameters: `rig.guard.KEY`, which a running daemon takes from zero force on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from msgspec.structs import fields

from softfinger.config.errors import ConfigError
from softfinger.config.schema import Guard, Rig, Scene

PREFIX: Final = "rig."
FIXED: Final = frozenset({"arm", "workspace"})
"""Of the guard: who may arm is no stimulus, and a workspace is compiled."""
CHANGING: Final = frozenset(f"{PREFIX}guard.{each.name}" for each in fields(Guard) if each.name not in FIXED)
"""What can change between two touches; the devices stay open."""
_TABLES: Final = {each.name for each in fields(Rig)} - {each.name for each in fields(Scene)}


def split(values: Mapping[str, Any], where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of the rig by its dotted key, and the parameters that are a scene's.

    Raises ConfigError for a value of the rig that needs another start of the daemon.
    """
    for path in values:
        of_rig = path.startswith(PREFIX) or path.partition(".")[0] in _TABLES
        if of_rig and path not in CHANGING:
            raise ConfigError(
                f"{where}: {path}: needs another start of the daemon, so it is no factor: run a session with --rig for "
                f"each of its levels; of the rig there are {', '.join(sorted(CHANGING))}"
            )
    ours = {path.removeprefix(PREFIX): value for path, value in values.items() if path in CHANGING}
    return ours, {path: value for path, value in values.items() if path not in CHANGING}
