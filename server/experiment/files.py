"""Files of experiments: shipped ones by name, and scenes and rigs beside one's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softfinger.config.load import EXPERIMENTS, build, find_in, load_rig, names_in, overridden, read_toml
from softfinger.server.experiment import rigs
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
    rig = beside(folder, experiment.rig)
    load_rig(rig)
    task, procedure = experiment.task, experiment.procedure
    ends = procedure.levels or (procedure.smallest, procedure.largest)
    for condition in conditions(experiment):
        name = condition.scene or experiment.scene
        for level in (min(ends), max(ends)):
            values = experiment.overrides | condition.changes | parameters(experiment, task.value(level))
            where = f"condition {condition.name}, level {level:g}"
            of_rig, of_scene = rigs.split(values, where)
            load_rig(rig, of_rig)
            scene_with(beside(folder, name), of_scene, where)
