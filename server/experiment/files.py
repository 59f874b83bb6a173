"""Files of experiments: shipped ones by name, and scenes and rigs beside one's own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import fields

from softfinger.config.errors import ConfigError
from softfinger.config.load import EXPERIMENTS, build, find_in, load_rig, names_in, overridden, read_toml
from softfinger.config.schema import Rig, Scene
from softfinger.server.experiment.design import conditions
from softfinger.server.experiment.masses import scene_with
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.session import parameters


def shipped() -> list[str]:
    """Names of the experiments that come with the program."""
    return names_in(EXPERIMENTS)


def load(source: str | Path | Mapping[str, Any], changes: Mapping[str, Any]) -> tuple[ExperimentFile, Path]:
    """An experiment and the folder that its files are in; `changes` are other values by dotted key.

    Raises ConfigError with every fault of the file, or the first one of a scene that it makes.
    """
    if isinstance(source, Mapping):
        experiment, folder = build(ExperimentFile, source, "experiment"), Path()
    else:
        path = find_in(EXPERIMENTS, "experiment", source)
        experiment, folder = build(ExperimentFile, read_toml(path), str(path.name)), path.parent
    return (overridden(experiment, changes, "experiment") if changes else experiment), folder


def beside(folder: Path, name: str) -> str | Path:
    """What a scene's or rig's name in an experiment means: a shipped name, or a file beside the experiment."""
    return folder / name if name.endswith(".toml") else name


def check(experiment: ExperimentFile, folder: Path) -> None:
    """Raise ConfigError where a scene, a parameter or the rig cannot be used, before a participant finds out."""
    load_rig(beside(folder, experiment.rig))
    task, procedure = experiment.task, experiment.procedure
    ends = procedure.levels or (procedure.smallest, procedure.largest)
    for condition in conditions(experiment):
        name = condition.scene or experiment.scene
        for level in (min(ends), max(ends)):
            values = experiment.overrides | condition.changes | parameters(experiment, task.value(level))
            where = f"condition {condition.name}, level {level:g}"
            refuse_rig(values, where)
            scene_with(beside(folder, name), values, where)


def refuse_rig(paths: Iterable[str], where: str) -> None:
    """Raise ConfigError for a parameter of the rig, which a daemon takes when it starts."""
    own = {field.name for field in fields(Rig)} - {field.name for field in fields(Scene)}
    for path in paths:
        head, _, rest = path.partition(".")
        if (head == "rig" and rest) or head in own:
            raise ConfigError(
                f"{where}: {path}: a value of the rig changes with another start of the daemon alone, so it is no "
                "factor: run a session with --rig for each of its levels"
            )
