"""Loading of experiments with their scenes and rigs, shipped or next to the experiment's file."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_rig, overridden
from softfinger.config.sources import EXPERIMENTS, find_in, names_in, read_toml
from softfinger.config.words import near, shown
from softfinger.server.experiment import rigs
from softfinger.server.experiment.design import Condition, conditions
from softfinger.server.experiment.masses import load_changed_scene
from softfinger.server.experiment.observer import observer_for
from softfinger.server.experiment.schema import ONE, ExperimentFile
from softfinger.server.experiment.schema_parts import Screen, Survey, SurveyFile
from softfinger.server.experiment.session import CONSENT, consent_question, parameters
from softfinger.server.wire.commands import IMAGE_BYTES_MAX

IMAGES: Final = {"png": rb"\x89PNG\r\n\x1a\n", "jpeg": rb"\xff\xd8\xff", "webp": rb"RIFF....WEBP"}
"""First bytes of image files, by the name of their type."""


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
    experiment = overridden(experiment, changes, "experiment") if changes else experiment
    surveys = tuple(_with_questions(survey, folder) for survey in experiment.survey)
    return (replace(experiment, survey=surveys) if surveys else experiment), folder


def _with_questions(survey: Survey, folder: Path) -> Survey:
    """Return a survey with the questions of its file."""
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


def hashes(experiment: ExperimentFile, folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each scene and of the rig that are files next to the experiment."""
    images = image_names(experiment)
    names = {
        experiment.scene,
        experiment.rig,
        *images,
        *(name for factor in experiment.factor for name in factor.scenes.values()),
    }
    paths = {name: folder / name for name in sorted(names) if name.endswith(".toml") or name in images}
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
    images(experiment, folder)


def image_names(experiment: ExperimentFile) -> list[str]:
    """Return the names of all images of the participant's page."""
    return sorted({screen_for(experiment, condition).image for condition in conditions(experiment)} - {""})


def screen_for(experiment: ExperimentFile, condition: Condition) -> Screen:
    """Return the screen in a condition: values of the condition replace the general ones."""
    return replace(experiment.screen, **experiment.screen.by.get(condition.name, {}))


def images(experiment: ExperimentFile, folder: Path) -> dict[str, str]:
    """Return the images of the participant's page as data URIs, by name.

    Raises ConfigError if a file is outside the experiment's folder, is no image, or is too large.
    """
    _check_by("screen", experiment.screen, experiment.screen.by, experiment)
    uris = {}
    for name in image_names(experiment):
        where = f"screen.image = {shown(name)}"
        path = (folder / name).resolve()
        if not path.is_relative_to(folder.resolve()):
            raise ConfigError(f"{where}: is outside the experiment's folder {folder.resolve()}: copy it there")
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ConfigError(f"{where}: cannot be read: {error.strerror}") from error
        kind = next((kind for kind, start in IMAGES.items() if re.match(start, data, re.DOTALL)), None)
        if kind is None:
            raise ConfigError(f"{where}: is no image: give a PNG, JPEG or WebP file")
        if len(data) > IMAGE_BYTES_MAX:
            raise ConfigError(f"{where}: has {len(data)} bytes: at most {IMAGE_BYTES_MAX}; make it smaller")
        uris[name] = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return uris


def level_extremes(experiment: ExperimentFile) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield location, scene and parameters of each condition at its lowest and highest level, and at the reference."""
    task, procedure = experiment.task, experiment.procedure
    levels = procedure.levels if procedure.kind != "staircase" else (procedure.smallest, procedure.largest)
    levels += () if experiment.catch is None else (experiment.catch.level,)
    named_values = [(f"level {level:g}", task.value(level)) for level in (min(levels), max(levels))]
    named_values += [] if task.reference is None else [("reference", task.reference)]
    for condition in conditions(experiment):
        for name, value in named_values:
            values = experiment.overrides | condition.changes | parameters(experiment, value)
            yield f"condition {condition.name}, {name}", condition.scene or experiment.scene, values


def _check_observer(experiment: ExperimentFile) -> None:
    """Raise ConfigError if a value of the observer is invalid or belongs to an unknown condition or question."""
    _check_by("observer", experiment.observer, experiment.observer.by, experiment)
    questions = {question.name: question for survey in experiment.survey for question in survey.question}
    if experiment.consent:
        questions |= {CONSENT: consent_question(experiment)}
    everywhere = [observer_for(experiment, condition).answers for condition in conditions(experiment)]
    for name, answer in {key: value for answers in everywhere for key, value in answers.items()}.items():
        where = f"observer.answers.{name} = {shown(answer)}"
        if name not in questions:
            raise ConfigError(f"{where}: no survey has this question{near(name, list(questions))}")
        question = questions[name]
        if question.kind == "multi-choice" and answer not in question.options:
            raise ConfigError(f"{where}: must be one of {', '.join(question.options)}")
        if question.kind in ("likert", "number") and not isinstance(answer, int | float):
            raise ConfigError(f"{where}: must be a number from {question.min:g} to {question.max:g}")


def _check_by(key: str, table: Struct, by: Mapping[str, Mapping[str, Any]], experiment: ExperimentFile) -> None:
    """Raise ConfigError if a value of a table in a condition is invalid, or there is no such condition."""
    names = [condition.name for condition in conditions(experiment)]
    for name, values in by.items():
        if name not in names:
            raise ConfigError(
                f"{key}.by: no condition is called {shown(name)}{near(name, names)}; there are "
                f"{'; '.join(names)}: the levels of all factors, with a comma between them"
            )
        overridden(table, values, f"{key}.by.{name}")
