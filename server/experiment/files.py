"""Files of experiments: shipped ones by name, and scenes and rigs beside one's own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
    guard = load_rig(rig).guard
    for where, scene, values in ends(experiment):
        of_rig, of_scene = rigs.split(values, where)
        rigs.check_motors(guard, of_rig, where)
        load_rig(rig, of_rig)
        scene_with(beside(folder, scene), of_scene, where)


def ends(experiment: ExperimentFile) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Where in the design, scene and parameters of each condition, at both ends of its levels and at the reference."""
    task, procedure = experiment.task, experiment.procedure
    levels = procedure.levels or (procedure.smallest, procedure.largest)
    touches = [(f"level {level:g}", task.value(level)) for level in (min(levels), max(levels))]
    touches += [] if task.reference is None else [("reference", task.reference)]
    for condition in conditions(experiment):
        for name, value in touches:
            values = experiment.overrides | condition.changes | parameters(experiment, value)
            yield f"condition {condition.name}, {name}", condition.scene or experiment.scene, values
