"""Loading of experiments with their scenes and rigs, shipped or next to the experiment's file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from softfinger.config.errors import ConfigError
from softfinger.config.load import EXPERIMENTS, build, find_in, load_rig, names_in, overridden, read_toml
from softfinger.config.words import near, shown
from softfinger.server.experiment import rigs
from softfinger.server.experiment.design import conditions
from softfinger.server.experiment.masses import load_changed_scene
from softfinger.server.experiment.schema import ONE, ExperimentFile
from softfinger.server.experiment.session import parameters


def shipped() -> list[str]:
    """Return the names of the shipped experiments."""
    return names_in(EXPERIMENTS)


def load(source: str | Path | Mapping[str, Any], changes: Mapping[str, Any]) -> tuple[ExperimentFile, Path]:
    """Return an experiment and the folder of its files; `changes` are replacement values by dotted key.

    Raises ConfigError with every fault of the file.
    """
    if isinstance(source, Mapping):
        experiment, folder = build(ExperimentFile, source, "experiment"), Path()
    else:
        path = find_in(EXPERIMENTS, "experiment", source)
        experiment, folder = build(ExperimentFile, read_toml(path), str(path.name)), path.parent
    return (overridden(experiment, changes, "experiment") if changes else experiment), folder


def resolve_source(folder: Path, name: str) -> str | Path:
    """Return the scene or rig that a name in an experiment refers to: a shipped name, or a file in the same folder."""
    return folder / name if name.endswith(".toml") else name


def hashes(experiment: ExperimentFile, folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each scene and of the rig that are files next to the experiment."""
    names = {
        experiment.scene,
        experiment.rig,
        *(name for factor in experiment.factor for name in factor.scenes.values()),
    }
    paths = {name: folder / name for name in sorted(names) if name.endswith(".toml")}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in paths.items()}


def check(experiment: ExperimentFile, folder: Path) -> None:
    """Raise ConfigError if a scene, a parameter or the rig is unusable, before a session with a participant."""
    rig = resolve_source(folder, experiment.rig)
    guard = load_rig(rig).guard
    fingers = set[str]()
    for where, name, values in level_extremes(experiment):
        rig_values, scene_values = rigs.split(values, where)
        rigs.check_motors(guard, rig_values, where)
        load_rig(rig, rig_values)
        scene = load_changed_scene(resolve_source(folder, name), scene_values, where)
        fingers |= {finger.name for finger in scene.finger} or {ONE}
    for finger in sorted(experiment.motion.keys() - fingers):
        raise ConfigError(f"motion.{finger}: no scene has this finger; there are {', '.join(sorted(fingers))}")
    _check_observer(experiment)


def level_extremes(experiment: ExperimentFile) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield location, scene and parameters of each condition at its lowest and highest level, and at the reference."""
    task, procedure = experiment.task, experiment.procedure
    levels = procedure.levels if procedure.kind != "staircase" else (procedure.smallest, procedure.largest)
    named_values = [(f"level {level:g}", task.value(level)) for level in (min(levels), max(levels))]
    named_values += [] if task.reference is None else [("reference", task.reference)]
    for condition in conditions(experiment):
        for name, value in named_values:
            values = experiment.overrides | condition.changes | parameters(experiment, value)
            yield f"condition {condition.name}, {name}", condition.scene or experiment.scene, values


def _check_observer(experiment: ExperimentFile) -> None:
    """Raise ConfigError if a value of the observer is invalid or belongs to an unknown condition."""
    names = [condition.name for condition in conditions(experiment)]
    for name, values in experiment.observer.by.items():
        if name not in names:
            raise ConfigError(
                f"observer.by: no condition is called {shown(name)}{near(name, names)}; there are "
                f"{'; '.join(names)}: the levels of all factors, with a comma between them"
            )
        overridden(experiment.observer, values, f"observer.by.{name}")
