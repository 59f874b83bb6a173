"""Schema of an experiment's file, with checks across its keys."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.fields import Complaint, Coordinate, Point, Table, doc, is_complete, is_usable, sized, within
from softfinger.config.limits import Range
from softfinger.server.experiment.schema_parts import (
    TEXT,
    CatchTrials,
    Confidence,
    Positive,
    Screen,
    Survey,
    find_repeated_names,
)
from softfinger.server.experiment.schema_trials import LEVELS, Design, Factor, Procedure, Task

SECONDS: Final = Range(0.0, 600.0, "longer than any touch")
SHARE: Final = Range(0.0, 0.5, "an observer with half of the answers at random is useless")
SINGLE_FINGER: Final = "fingertip"
"""Name in an experiment for the finger of a scene with only one."""

Seconds = Annotated[float, Meta(ge=SECONDS.low, le=SECONDS.high)]
Angle = Annotated[float, Meta(ge=limits.ANGLE_RAD.low, le=limits.ANGLE_RAD.high)]
Waypoint = tuple[Seconds, Coordinate, Coordinate, Coordinate]
Turn = tuple[Seconds, Angle, Angle, Angle]


class Trial(Table, frozen=True, kw_only=True):
    """Times and places of a trial. The force is off whenever the scene changes."""

    touch_s: Annotated[
        float, within(Range(0.02, 600.0, "20 ticks"), "length of a touch, or of a movement at most", 2.0)
    ] = 2.0
    gap_s: Annotated[float, within(SECONDS, "pause without force before each touch, at least", 0.2)] = 0.2
    start_m: Annotated[
        Point | None,
        doc(
            "position of a hand that can be moved, without a motion, between touches; default: it is not moved",
            [0.0, 0.0, 0.02],
        ),
    ] = None


class Observer(Table, frozen=True, kw_only=True):
    """Simulated observer of a dry run, with the parameters expected of a real one.

    A comparison is right with probability 1/2 + (1/2 - lapse) (1 - exp(-(level / threshold)^slope)) (Weibull); a number
    or a duration is scale level^exponent exp(noise n), n standard normal (Stevens 1957).
    """

    threshold: Annotated[Positive, doc("compare: level at which 82 % are correct, without lapses", 0.15)] = 0.15
    slope: Annotated[float, within(Range(0.3, 20.0, ""), "compare: slope of the Weibull function", 2.0)] = 2.0
    lapse: Annotated[float, within(SHARE, "compare: fraction of wrong answers at any level", 0.02)] = 0.02
    scale: Annotated[Positive, doc("rate, trace: answer at level 1", 10.0)] = 10.0
    exponent: Annotated[float, within(Range(-5.0, 5.0, ""), "rate, trace: exponent", 0.8)] = 1.0
    noise: Annotated[float, within(Range(1e-3, 2.0, ""), "rate, trace: standard deviation of the logarithm", 0.2)] = 0.2
    answers: Annotated[
        dict[str, float | str],
        doc("answers to questions of surveys, by name; of likert and number their mean", {"mental-demand": 60.0}),
    ] = msgspec.field(default_factory=dict)
    by: Annotated[
        dict[str, dict[str, Any]],
        doc(
            "other values in a condition, by its name: the levels of all factors, with a comma between them",
            {"rolling": {}},
        ),
    ] = msgspec.field(default_factory=dict)


class ExperimentFile(Table, frozen=True, kw_only=True):
    """Experiment file: properties shared by all trials."""

    title: Annotated[str, sized(Range(1, 200, ""), "title of the page and of the figures", "Stiffness discrimination")]
    scene: Annotated[
        str, sized(Range(1, 4096, ""), "scene: a shipped name, or a file in the folder of this one", "paper-plane")
    ]
    rig: Annotated[
        str, sized(Range(1, 4096, ""), "rig: a shipped name, or a file in the folder of this one", "omega-6")
    ] = "simulated-hand"
    instructions: Annotated[str, sized(TEXT, "first text that the participant reads")] = ""
    consent: Annotated[str, sized(TEXT, "text for the consent of the participant before the session")] = ""
    debriefing: Annotated[str, sized(TEXT, "text at the end of the session")] = ""
    overrides: Annotated[dict[str, Any], doc("parameters of the scene, or rig.guard.KEY, for all trials")] = (
        msgspec.field(default_factory=dict)
    )
    task: Task
    procedure: Procedure
    factor: Annotated[tuple[Factor, ...], sized(Range(0, 8, "a design"), "factors of the design")] = ()
    design: Design
    trial: Trial = Trial()
    motion: Annotated[
        dict[str, tuple[Waypoint, ...]],
        doc("path of the hand during a touch, t x y z, by finger; `fingertip` if there is only one"),
    ] = msgspec.field(default_factory=dict)
    turn: Annotated[
        dict[str, tuple[Turn, ...]],
        doc("rotation of the hand during a touch, t and a rotation vector (rad, world), by finger; default: none"),
    ] = msgspec.field(default_factory=dict)
    observer: Observer = Observer()
    survey: Annotated[tuple[Survey, ...], sized(Range(0, 20, "a session"), "surveys, in order")] = ()
    catch: CatchTrials | None = None
    confidence: Confidence | None = None
    screen: Screen = Screen()

    def faults(self) -> Iterator[Complaint]:
        task, procedure = self.task, self.procedure
        is_known = is_usable(task, procedure) and is_usable(task.kind, procedure.kind)
        if is_known and task.kind != "compare" and procedure.kind != "constant":
            fault = f"must be constant: answers of {task.kind} are not right or wrong"
            yield "procedure.kind", procedure.kind, fault
        yield from self._check_participants()
        if is_usable(self.motion, self.turn):
            for finger in self.turn.keys() - self.motion.keys():
                fault = "rotates a hand that [motion] does not move: add a path for the finger"
                yield f"turn.{finger}", msgspec.UNSET, fault
        if is_usable(self.motion, self.turn, self.trial) and is_usable(self.trial.touch_s):
            for key, paths in (("motion", self.motion), ("turn", self.turn)):
                for finger, path in paths.items():
                    times = [time for time, *_ in path]
                    if any(after <= before for before, after in pairwise(times)):
                        yield f"{key}.{finger}", times, "times must increase from point to point"
                    if path and path[-1][0] > self.trial.touch_s:
                        yield f"{key}.{finger}", msgspec.UNSET, f"ends at {path[-1][0]:g} s: set trial.touch_s to that"
        yield from find_repeated_names("factor", self.factor)
        if is_usable(self.factor):
            factors = [factor for factor in self.factor if is_usable(factor)]
            if math.prod(len(factor.levels) for factor in factors if is_usable(factor.levels)) > LEVELS.high:
                names = [factor.name for factor in factors]
                yield "factor", names, f"has more than {LEVELS.high:g} combinations"
        if is_complete(self.task) and is_complete(self.factor):
            for index, factor in enumerate(self.factor):
                changed = {factor.parameter}.union(*factor.values.values())
                for name in sorted(changed & {self.task.parameter, *self.task.also}):
                    yield f"factor[{index}]", name, "is set by the task, which replaces it: use another parameter"

    def _check_participants(self) -> Iterator[Complaint]:
        if is_usable(self.task) and is_usable(self.task.kind):
            for key, value in (("catch", self.catch), ("confidence", self.confidence)):
                if is_usable(value) and value is not None and self.task.kind != "compare":
                    fault = f"applies to compare only: answers of {self.task.kind} are not right or wrong"
                    yield key, msgspec.UNSET, fault
        yield from find_repeated_names("survey", self.survey)
        if is_usable(self.survey, self.design) and is_usable(self.design.order) and self.design.order == "random":
            for survey in self.survey:
                if is_usable(survey) and is_usable(survey.at) and "between" in survey.at:
                    fault = "random order has no blocks: use latin-square"
                    yield f"survey.{survey.name}.at", list(survey.at), fault
