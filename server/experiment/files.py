"""Files of an experiment: its tables, surveys and images, and the scenes and rigs that it names."""

from __future__ import annotations

import base64
import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from msgspec.structs import replace

from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_scene
from softfinger.config.schema import Scene
from softfinger.config.sources import EXPERIMENTS, find_in, read_toml
from softfinger.config.words import format_value
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.schema_parts import Survey, SurveyFile
from softfinger.server.experiment.session import list_parameters
from softfinger.server.experiment.trial_order import choose_by_condition, list_conditions
from softfinger.server.wire.commands import IMAGE_BYTES_MAX

IMAGES: Final = {"png": rb"\x89PNG\r\n\x1a\n", "jpeg": rb"\xff\xd8\xff", "webp": rb"RIFF....WEBP"}
"""First bytes of image files, by the name of their type."""
FILE_KEYS: Final = ("file", "solution")
"""Keys of an object and its tables whose values are files."""


def read(source: str | Path | Mapping[str, Any]) -> tuple[Mapping[str, Any], str, Path]:
    """Return the tables of an experiment, its name for messages, and the folder of its files."""
    if isinstance(source, Mapping):
        return source, "experiment", Path()
    path = find_in(EXPERIMENTS, "experiment", source)
    return read_toml(path), path.name, path.parent


def read_survey(survey: Survey, folder: Path) -> Survey:
    """Return a survey with the questions of its file; raises ConfigError with every fault of that."""
    if not survey.file:
        return survey
    path = find_in(EXPERIMENTS / "surveys", "survey", resolve_source(folder, survey.file))
    read = build(SurveyFile, read_toml(path), str(path.name))
    if not read.question:
        raise ConfigError(f"{path}: has no [[question]]")
    return replace(
        survey,
        file="",
        title=survey.title or read.title,
        reference=survey.reference or read.reference,
        score=read.score if survey.score == "none" else survey.score,
        question=read.question,
    )


def resolve_source(folder: Path, name: str) -> str | Path:
    """Return the scene or rig that a name in an experiment refers to: a shipped name, or a file in the same folder."""
    return folder / name if name.endswith(".toml") else name


def hash_files(experiment: ExperimentFile, folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files of an experiment: scenes, rig and images next to it, and files of the scenes."""
    images = list_image_names(experiment)
    scenes = {experiment.scene, *(name for factor in experiment.factor for name in factor.scenes.values())}
    scene_files = {name for name in scenes if name.endswith(".toml")}
    names = {*scene_files, *images, *({experiment.rig} if experiment.rig.endswith(".toml") else ())}
    for name in scene_files:
        names |= {os.path.relpath(file, folder) for file in _iter_files(load_scene(folder / name))}
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in sorted(names)}


def _iter_files(scene: Scene) -> Iterator[str]:
    """Yield the paths of the model, meshes, maps, textures and solutions of a scene."""
    if scene.world is not None:
        yield scene.world.model
    for item in scene.object:
        tables = item, getattr(item, "texture", None), getattr(item, "elastic", None)
        yield from (path for table in tables for key in FILE_KEYS if (path := getattr(table, key, None)) is not None)


def list_image_names(experiment: ExperimentFile) -> list[str]:
    return sorted(
        {choose_by_condition(experiment.screen, condition).image for condition in list_conditions(experiment)} - {""}
    )


def load_images(experiment: ExperimentFile, folder: Path) -> dict[str, str]:
    """Return the images of the participant's page as data URIs, by name; raises ConfigError as `read_image`."""
    return {name: read_image(name, folder) for name in list_image_names(experiment)}


def read_image(name: str, folder: Path) -> str:
    """Return an image of the participant's page as a data URI.

    Raises ConfigError if a file is outside the folder of the experiment, is not an image, or is too large.
    """
    setting = f"screen.image = {format_value(name)}"
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise ConfigError(f"{setting}: is outside the folder of the experiment {folder.resolve()}: copy it there")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{setting}: cannot be read: {error.strerror}") from error
    kind = next((kind for kind, start in IMAGES.items() if re.match(start, data, re.DOTALL)), None)
    if kind is None:
        raise ConfigError(f"{setting}: is not an image: use a PNG, JPEG or WebP file")
    if len(data) > IMAGE_BYTES_MAX:
        raise ConfigError(f"{setting}: has {len(data)} bytes: at most {IMAGE_BYTES_MAX}; make it smaller")
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def iter_level_extremes(experiment: ExperimentFile) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield location, scene and parameters of each condition at its lowest and highest level, and at the reference."""
    task, procedure = experiment.task, experiment.procedure
    levels = procedure.levels if procedure.kind != "staircase" else (procedure.smallest, procedure.largest)
    levels += () if experiment.catch is None else (experiment.catch.level,)
    named_values = [(f"level {level:g}", task.value(level)) for level in (min(levels), max(levels))]
    named_values += [] if task.reference is None else [("reference", task.reference)]
    for condition in list_conditions(experiment):
        for name, value in named_values:
            values = experiment.overrides | condition.changes | list_parameters(experiment, value)
            yield f"condition {condition.name}, {name}", condition.scene or experiment.scene, values
