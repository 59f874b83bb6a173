"""Loading of an experiment with every check that is possible before a session; all faults in one error."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from msgspec.structs import replace

from softfinger.config.arguments import check_mapping
from softfinger.config.errors import ConfigError
from softfinger.config.fields import is_complete, is_usable
from softfinger.config.load import FaultyConfig, apply_overrides, attempt, build_changed, load_rig, load_scene
from softfinger.config.schema import Rig, Scene
from softfinger.config.schema.pairing import pair_devices
from softfinger.config.words import format_value, suggest
from softfinger.server.experiment.files import iter_level_extremes, read, read_image, read_survey, resolve_source
from softfinger.server.experiment.parameters import check_motors, load_changed_scene, split_rig
from softfinger.server.experiment.schema import SINGLE_FINGER, ExperimentFile
from softfinger.server.experiment.session import CONSENT, make_consent_question
from softfinger.server.experiment.trial_order import list_conditions

C = TypeVar("C", bound=Scene | Rig)
PartFaults = Callable[[Any, str], list[str]]
"""Further check of a scene or rig with its name; of a faulty one, with UNSET in the place of what is unusable."""
CONDITION_TABLES: Final = ("task", "procedure", "factor", "overrides", "catch")
"""Tables that determine the parameters of every condition."""


def load(
    source: str | Path | Mapping[str, Any],
    changes: Mapping[str, Any],
    part_faults: PartFaults = lambda config, name: [],
) -> tuple[ExperimentFile, Path]:
    """Return an experiment and the folder of its files.

    changes      replacement values by dotted key
    part_faults  further check of each scene and of the rig

    Raises FaultyConfig with every fault of the file, and of the surveys, scenes, rig and images that it names.
    """
    tables, name, folder = read(source)
    faults, faulty = list[str](), set[str]()
    try:
        sources = dict.fromkeys(check_mapping(changes, "changes", '{"procedure.trials": 60}'), "experiment")
        experiment = build_changed(ExperimentFile, tables, name, changes, sources)
    except FaultyConfig as error:
        experiment = error.config
        faults += map(str, error.faults)
        faulty = {re.split(r"[.\[]", fault.key)[0] for fault in error.faults if not isinstance(fault, str)}
    if is_usable(experiment) and "" not in faulty:
        checks = _Checks(experiment, folder, frozenset(faulty), faults)
        checks.files(part_faults)
        checks.check_conditions()
        experiment = checks.experiment
    if faults:
        raise FaultyConfig(faults, experiment)
    return experiment, folder


class _Checks:
    """Checks of an experiment; each is skipped if a table that it needs is in `faulty`, and appends to `faults`."""

    def __init__(self, experiment: ExperimentFile, folder: Path, faulty: frozenset[str], faults: list[str]) -> None:
        self.experiment, self._folder, self._faulty, self._faults = experiment, folder, faulty, faults
        self._rig: Rig | None = None
        self._scenes = dict[str, Scene | None]()

    def _are_sound(self, *tables: str) -> bool:
        return self._faulty.isdisjoint(tables)

    def files(self, part_faults: PartFaults) -> None:
        experiment = self.experiment
        surveys = [
            attempt(partial(read_survey, survey, self._folder), self._faults) if is_complete(survey) else None
            for survey in (experiment.survey if is_usable(experiment.survey) else ())
        ]
        if None in surveys:
            self._faulty |= {"survey"}
        elif surveys:
            self.experiment = replace(experiment, survey=tuple(surveys))
        if self._are_sound("rig"):
            self._rig = self._load_part(load_rig, experiment.rig, part_faults)
        names = [experiment.scene] if self._are_sound("scene") else []
        for factor in experiment.factor if is_usable(experiment.factor) else ():
            names += factor.scenes.values() if is_usable(factor) and is_usable(factor.scenes) else []
        for name in dict.fromkeys(names):
            self._scenes[name] = scene = self._load_part(load_scene, name, part_faults)
            if scene is not None and self._rig is not None:
                faults = list[str]()
                attempt(partial(pair_devices, scene, self._rig), faults)
                self._faults += [f"scene {name}, rig {experiment.rig}: {fault}" for fault in faults]
        if self._are_sound("screen"):
            images = [experiment.screen.image, *(values.get("image") for values in experiment.screen.by.values())]
            for image in dict.fromkeys(image for image in images if image and isinstance(image, str)):
                attempt(partial(read_image, image, self._folder), self._faults)

    def _load_part(self, load: Callable[[str | Path], C], name: str, part_faults: PartFaults) -> C | None:
        """Return a scene or rig, None if it cannot be loaded."""
        try:
            config = load(resolve_source(self._folder, name))
        except FaultyConfig as error:
            self._faults += [*map(str, error.faults), *part_faults(error.config, name)]
        except ConfigError as error:
            self._faults.append(str(error))
        else:
            self._faults += part_faults(config, name)
            return config
        return None

    def check_conditions(self) -> None:
        experiment = self.experiment
        if self._are_sound(*CONDITION_TABLES, "scene"):
            self._faults += self._check_parameters()
        if self._are_sound("motion", "scene", "factor") and None not in self._scenes.values():
            fingers = {finger.name for scene in self._scenes.values() if scene for finger in scene.finger or ()}
            fingers |= {SINGLE_FINGER} if any(scene and not scene.finger for scene in self._scenes.values()) else set()
            self._faults += [
                f"motion.{finger}: no scene has this finger; there are {', '.join(sorted(fingers))}"
                for finger in sorted(experiment.motion.keys() - fingers)
            ]
        if self._are_sound("observer", "survey", "consent"):
            self._faults += dict.fromkeys(_answer_faults(experiment))
        if not self._are_sound("factor"):
            return
        for table in ("observer", "screen"):
            if self._are_sound(table):
                self._faults += self._check_conditions(table)

    def _check_parameters(self) -> list[str]:
        """Return the faults of the parameters at the extremes of each condition, each fault once."""
        distinct = dict[str, str]()
        for location, name, values in iter_level_extremes(self.experiment):
            faults, rig, scene = list[str](), self._rig, self._scenes[name]
            parameters = attempt(partial(split_rig, values, location), faults)
            if parameters is not None and rig is not None:
                attempt(partial(check_motors, rig.guard, parameters[0], location), faults)
                attempt(partial(apply_overrides, rig, parameters[0], location), faults)
            if parameters is not None and scene is not None:
                attempt(partial(load_changed_scene, scene, parameters[1], location), faults)
            for fault in faults:
                distinct.setdefault(fault.removeprefix(f"{location}: "), fault)
        return list(distinct.values())

    def _check_conditions(self, key: str) -> list[str]:
        table, names = getattr(self.experiment, key), [condition.name for condition in list_conditions(self.experiment)]
        faults = list[str]()
        for name, values in table.by.items():
            if name not in names:
                faults.append(
                    f"{key}.by: no condition is called {format_value(name)}{suggest(name, names)}; there are "
                    f"{'; '.join(names)}: the levels of all factors, with a comma between them"
                )
            attempt(partial(apply_overrides, table, values, f"{key}.by.{name}"), faults)
        return faults


def _answer_faults(experiment: ExperimentFile) -> Iterator[str]:
    questions = {question.name: question for survey in experiment.survey for question in survey.question}
    if experiment.consent:
        questions |= {CONSENT: make_consent_question(experiment)}
    observer = experiment.observer
    everywhere = [observer.answers, *(values.get("answers", {}) for values in observer.by.values())]
    for name, answer in (item for answers in everywhere if isinstance(answers, Mapping) for item in answers.items()):
        location = f"observer.answers.{name} = {format_value(answer)}"
        if name not in questions:
            yield f"{location}: no survey has this question{suggest(name, list(questions))}"
            continue
        question = questions[name]
        if question.kind == "multi-choice" and answer not in question.options:
            yield f"{location}: must be one of {', '.join(question.options)}"
        is_in_range = isinstance(answer, int | float) and question.min <= answer <= question.max
        if question.kind in ("likert", "number") and not is_in_range:
            yield f"{location}: must be a number from {question.min:g} to {question.max:g}"
