"""Masses as parameters of an experiment: `mass.BODY` is `world.mass_kg` of the scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource, add_objects_of_world, apply_overrides, load_scene
from softfinger.config.schema import Scene

PREFIX: Final = "mass."


def split(values: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, Any]]:
    """Return masses (kg) by body, and the parameters of the scene."""
    masses = {path.removeprefix(PREFIX): value for path, value in values.items() if path.startswith(PREFIX)}
    return masses, {path: value for path, value in values.items() if not path.startswith(PREFIX)}


def load_changed_scene(source: SceneSource, values: Mapping[str, Any], where: str) -> Scene:
    """Return a scene with changed values, including masses.

    Raises ConfigError, with `where`, if the scene lacks a value.
    """
    masses, parameters = split(values)
    scene = load_scene(source)
    if not masses:
        return apply_overrides(scene, parameters, where) if parameters else scene
    if scene.world is None:
        raise ConfigError(
            f"{where}: {PREFIX}{next(iter(masses))}: the scene has no [world], so it has no bodies with a mass"
        )
    changed = apply_overrides(scene, {**parameters, "world.mass_kg": scene.world.mass_kg | masses}, where)
    try:
        return add_objects_of_world(changed)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
