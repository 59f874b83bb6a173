"""Weights as a parameter: `mass.BODY` of a scene's [world] is written into a copy of its MuJoCo model."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource, completed, load_scene, overridden
from softfinger.config.schema import Scene

PREFIX: Final = "mass."


def split(values: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, Any]]:
    """Masses (kg) by body, and the parameters that are a scene's."""
    masses = {path.removeprefix(PREFIX): value for path, value in values.items() if path.startswith(PREFIX)}
    return masses, {path: value for path, value in values.items() if not path.startswith(PREFIX)}


def scene_with(source: SceneSource, values: Mapping[str, Any], where: str, folder: Path | None = None) -> Scene:
    """A scene with other values, masses among them; copies of models are kept in `folder` (None: for this call alone).

    Raises ConfigError for what the scene does not have.
    """
    masses, others = split(values)
    scene = load_scene(source)
    if not masses:
        return overridden(scene, others, where) if others else scene
    if scene.world is None:
        raise ConfigError(
            f"{where}: {PREFIX}{next(iter(masses))}: the scene has no [world], and so no body with a mass"
        )
    with tempfile.TemporaryDirectory() as passing:
        name = "-".join(f"{body}-{mass:.9g}" for body, mass in sorted(masses.items()))
        model = (folder or Path(passing)) / f"{Path(scene.world.model).stem}-{name}.xml"
        model.write_bytes(with_masses(Path(scene.world.model), masses, where))
        mapping = msgspec.structs.replace(
            scene, object=(), world=msgspec.structs.replace(scene.world, model=str(model))
        )
        completed_scene = completed(mapping)
        return overridden(completed_scene, others, where) if others else completed_scene


def with_masses(model: Path, masses: Mapping[str, float], where: str) -> bytes:
    """A MuJoCo model (MJCF) with other masses (kg) of bodies, whose inertia goes with them."""
    try:
        tree = ET.parse(model)  # of a file that MuJoCo has read
    except (OSError, ET.ParseError) as error:
        raise ConfigError(f"{model}: cannot be read as MJCF: {error}") from error
    for body, mass in masses.items():
        geoms = [geom for each in tree.iter("body") if each.get("name") == body for geom in each.findall("geom")]
        if len(geoms) != 1 or "mass" not in geoms[0].attrib:
            raise ConfigError(
                f"{where}: {PREFIX}{body}: the model has no body of that name with one geom that has a mass"
            )
        geoms[0].set("mass", f"{mass:.9g}")
    return ET.tostring(tree.getroot())
