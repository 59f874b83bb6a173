"""Schema of an experiment's file, with checks across its keys."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.limits import Range
from softfinger.config.schema.fields import Complaint, Coordinate, Table, known, said, sized, within
from softfinger.server.experiment.schema_parts import (
    MARKS_MAX,
    TEXT,
    CatchTrials,
    Confidence,
    Label,
    Positive,
    Screen,
    Survey,
)

LEVELS: Final = Range(1, 200, "more levels cannot be told apart")
TRIALS: Final = Range(1, 2000, "longer than any session")
SECONDS: Final = Range(0.0, 600.0, "ten minutes are longer than any touch")
SHARE: Final = Range(0.0, 0.5, "half of the answers at random is no observer")
ONE: Final = "fingertip"
"""Name in an experiment for the finger of a scene with only one."""
WAYPOINTS: Final = Range(1, 10_000, "a path of a hand")

Seconds = Annotated[float, Meta(ge=SECONDS.low, le=SECONDS.high)]
Angle = Annotated[float, Meta(ge=limits.ANGLE_RAD.low, le=limits.ANGLE_RAD.high)]
Waypoint = tuple[Seconds, Coordinate, Coordinate, Coordinate]
Turn = tuple[Seconds, Angle, Angle, Angle]
Point = tuple[Coordinate, Coordinate, Coordinate]


class Task(Table, frozen=True, kw_only=True):
    """What a trial asks. The level is the number that changes from trial to trial."""

    kind: Annotated[
        Literal["compare", "rate", "trace"],
        said(
            "compare: two touches in random order, one of them the reference, which had more; rate: a touch, a number; "
            "trace: a movement to a target, timed"
        ),
    ]
    parameter: Annotated[
        str,
        sized(
            Range(1, 200, ""),
            "parameter that the level sets, or mass.BODY of a [world]",
            "object.table.material.stiffness_n_per_m",
        ),
    ]
    also: Annotated[
        dict[str, float],
        said("other parameters that the level sets, each the value times a factor", {"a.kinetic": 0.8}),
    ] = msgspec.field(default_factory=dict)
    reference: Annotated[Positive | None, said("compare: value of the reference", 500.0)] = None
    more: Annotated[
        Literal["up", "down"],
        said(
            "compare: whether more is a larger value, reference (1 + level), or a smaller one, reference / (1 + level)"
        ),
    ] = "up"
    question: Annotated[str, sized(TEXT, "question to the participant", "Which was stiffer?")]
    scale: Annotated[
        tuple[int, int] | None, said("rate: first and last mark of a rating scale; default: any number above 0", [1, 7])
    ] = None
    scale_ends: Annotated[
        tuple[Label, ...], said("rate: labels of the first and the last mark", ["not at all", "very"])
    ] = ()
    target_m: Annotated[Point | None, said("trace: where it ends", [0.0, 0.0, 0.0])] = None
    target_radius_m: Annotated[float, within(Range(1e-4, 1.0, "a target"), "trace: how near", 0.005)] = 0.005

    def value(self, level: float) -> float:
        """Return the parameter's value at a level; for a comparison, the reference changed by the fraction `level`."""
        if self.reference is None:
            return level
        return self.reference * (1.0 + level) if self.more == "up" else self.reference / (1.0 + level)

    @property
    def marks(self) -> tuple[str, ...]:
        """Marks of the rating scale."""
        return () if self.scale is None else tuple(map(str, range(self.scale[0], self.scale[1] + 1)))

    def faults(self) -> Iterator[Complaint]:
        if known(self.kind, self.scale, self.scale_ends):
            if self.scale is not None and self.kind != "rate":
                yield "scale", self.scale, "only rate has a scale"
            if self.scale is not None and not 1 <= self.scale[0] < self.scale[1] < self.scale[0] + MARKS_MAX:
                yield "scale", self.scale, f"must be the first mark, from 1, and the last of at most {MARKS_MAX}"
            if len(self.scale_ends) not in ((0,) if self.scale is None else (0, 2)):
                yield "scale_ends", self.scale_ends, "requires scale, and has two labels"
        if known(self.kind, self.reference) and (self.kind == "compare") != (self.reference is not None):
            yield "reference", self.reference, "compare needs a reference, and nothing else has one"
        if known(self.kind, self.target_m) and (self.kind == "trace") != (self.target_m is not None):
            yield "target_m", self.target_m, "trace needs a target_m, and nothing else has one"


class Procedure(Table, frozen=True, kw_only=True):
    """How the level of a trial is chosen."""

    kind: Annotated[
        Literal["constant", "staircase", "questplus"],
        said(
            "constant: every level equally often, in random order; staircase: `down` right answers in a row make it "
            "smaller, a wrong one larger (Levitt 1971); questplus: the level whose answer is expected to tell most "
            "(Watson 2017)"
        ),
    ]
    levels: Annotated[
        tuple[Positive, ...], sized(Range(0, 200, ""), "constant, questplus: the levels", [0.05, 0.1, 0.2])
    ] = ()
    repetitions: Annotated[int, within(TRIALS, "constant: trials of each level", 10)] = 1
    trials: Annotated[int, within(TRIALS, "staircase, questplus: trials of each condition", 40)] = 40
    start: Annotated[Positive, said("staircase: first level", 0.5)] = 0.5
    starts: Annotated[
        tuple[Positive, ...],
        sized(
            Range(0, 8, "a session"),
            "staircase: first levels of interleaved staircases, in place of start; they share a condition's trials",
            [0.6, 0.05],
        ),
    ] = ()
    step: Annotated[
        float, within(Range(1.01, 10.0, "a step"), "staircase: factor of a step; twice as large until it turned", 1.2)
    ] = 1.2
    down: Annotated[int, within(Range(1, 5, ""), "staircase: right answers before a step down", 2)] = 2
    smallest: Annotated[Positive, said("staircase: least level", 0.005)] = 0.005
    largest: Annotated[Positive, said("staircase: largest level", 1.0)] = 1.0

    def faults(self) -> Iterator[Complaint]:
        if not known(self.kind, self.levels, self.start, self.starts, self.trials, self.smallest, self.largest):
            return
        if self.kind != "staircase" and not self.levels:
            yield "levels", msgspec.UNSET, f"{self.kind} needs levels"
        if len(set(self.levels)) < len(self.levels):
            yield "levels", list(self.levels), "has a level twice"
        if self.starts and self.kind != "staircase":
            yield "starts", list(self.starts), "only a staircase has starts"
        elif len(self.starts) > self.trials:
            yield "starts", list(self.starts), f"is more staircases than the {self.trials} trials of a condition"
        for key, start in [("starts", each) for each in self.starts] or [("start", self.start)]:
            if self.kind == "staircase" and not self.smallest <= start <= self.largest:
                yield key, start, f"must be from smallest = {self.smallest:g} to largest = {self.largest:g}"


class Factor(Table, frozen=True, kw_only=True):
    """A factor of the design: a parameter with values, whole scenes, or sets of parameters by name."""

    name: Annotated[Label, said("name; a column of the table of trials")]
    parameter: Annotated[
        str,
        sized(
            TEXT,
            "parameter of the scene that takes the levels, or rig.guard.KEY; object.NAME.material takes names",
            "coupling.damping_ns_per_m",
        ),
    ] = ""
    levels: Annotated[tuple[float | Label, ...], sized(LEVELS, "its levels", [0.3, 0.6])]
    scenes: Annotated[dict[str, str], said("scene of each level, in place of a parameter")] = msgspec.field(
        default_factory=dict
    )
    values: Annotated[dict[str, dict[str, Any]], said("parameters of each level, in place of one parameter")] = (
        msgspec.field(default_factory=dict)
    )

    def faults(self) -> Iterator[Complaint]:
        if not known(self.parameter, self.levels, self.scenes, self.values):
            return
        if sum(map(bool, (self.parameter, self.scenes, self.values))) != 1:
            yield "parameter", self.parameter, "give one of parameter, scenes and values"
        names = {str(level) for level in self.levels}
        if len(names) < len(self.levels):
            yield "levels", list(self.levels), "has a level twice"
        for key, table in (("scenes", self.scenes), ("values", self.values)):
            if table and set(table) != names:
                yield key, sorted(table), f"must have the levels {', '.join(sorted(names))}"


class Design(Table, frozen=True, kw_only=True):
    """Conditions are all combinations of the factors' levels."""

    order: Annotated[
        Literal["random", "latin-square", "given"],
        said(
            "random: trials of all conditions mixed; latin-square: a block for each condition, in an order balanced "
            "over participants (Williams 1949); given: a block for each condition, in the order of the file"
        ),
    ] = "random"
    seed: Annotated[int, within(Range(0, 2**32 - 1, "32 bits"), "seed of every random choice", 1)]
    practice: Annotated[int, within(Range(0, 100, ""), "trials before the first one that counts", 2)] = 0
    break_every: Annotated[int, within(Range(0, 2000, ""), "trials between breaks; 0: none", 40)] = 0
    test_first: Annotated[
        Literal["balanced", "balanced-by-level"],
        said(
            "compare: half of the trials begin with the test: of all, or of those of each condition and level; of each "
            "condition and staircase if a procedure chooses the levels"
        ),
    ] = "balanced"


class Trial(Table, frozen=True, kw_only=True):
    """Times and places of a trial. The force is off whenever the scene changes."""

    touch_s: Annotated[
        float, within(Range(0.02, 600.0, "20 ticks"), "length of a touch, or of a movement at most", 2.0)
    ] = 2.0
    gap_s: Annotated[float, within(SECONDS, "pause without force before each touch, at least", 0.2)] = 0.2
    start_m: Annotated[
        Point | None,
        said("where a hand that can be led and has no motion waits; default: it is not led", [0.0, 0.0, 0.02]),
    ] = None


class Observer(Table, frozen=True, kw_only=True):
    """The simulated observer of a dry run: what a real one is thought to be like.

    A comparison is right with probability 1/2 + (1/2 - lapse) (1 - exp(-(level / threshold)^slope)) (Weibull); a number
    or a duration is scale level^exponent exp(noise n), n standard normal (Stevens 1957).
    """

    threshold: Annotated[Positive, said("compare: level at which 82 % are right, but for lapses", 0.15)] = 0.15
    slope: Annotated[float, within(Range(0.3, 20.0, ""), "compare: slope of the Weibull function", 2.0)] = 2.0
    lapse: Annotated[float, within(SHARE, "compare: share of wrong answers however large the level", 0.02)] = 0.02
    scale: Annotated[Positive, said("rate, trace: answer at level 1", 10.0)] = 10.0
    exponent: Annotated[float, within(Range(-5.0, 5.0, ""), "rate, trace: exponent", 0.8)] = 1.0
    noise: Annotated[float, within(Range(1e-3, 2.0, ""), "rate, trace: standard deviation of the logarithm", 0.2)] = 0.2
    answers: Annotated[
        dict[str, float | str],
        said("answers to questions of surveys, by name; of likert and number their mean", {"mental-demand": 60.0}),
    ] = msgspec.field(default_factory=dict)
    by: Annotated[
        dict[str, dict[str, Any]],
        said(
            "other values in a condition, by its name: the levels of all factors, with a comma between them",
            {"rolling": {}},
        ),
    ] = msgspec.field(default_factory=dict)


class ExperimentFile(Table, frozen=True, kw_only=True):
    """What all trials share."""

    title: Annotated[str, sized(Range(1, 200, ""), "title of the page and of the figures", "Stiffness discrimination")]
    scene: Annotated[
        str, sized(Range(1, 4096, ""), "scene: a shipped name, or a file in the folder of this one", "paper-plane")
    ]
    rig: Annotated[
        str, sized(Range(1, 4096, ""), "rig: a shipped name, or a file in the folder of this one", "omega-6")
    ] = "simulated-hand"
    instructions: Annotated[str, sized(TEXT, "first text that the participant reads")] = ""
    consent: Annotated[str, sized(TEXT, "text that the participant has to agree to before anything else")] = ""
    debriefing: Annotated[str, sized(TEXT, "what the participant reads last")] = ""
    overrides: Annotated[dict[str, Any], said("parameters of the scene, or rig.guard.KEY, that hold throughout")] = (
        msgspec.field(default_factory=dict)
    )
    task: Task
    procedure: Procedure
    factor: Annotated[tuple[Factor, ...], sized(Range(0, 8, "a design"), "factors of the design")] = ()
    design: Design
    trial: Trial = Trial()
    motion: Annotated[
        dict[str, tuple[Waypoint, ...]],
        said("where a led hand goes in a touch, t x y z, by finger; `fingertip` where there is one"),
    ] = msgspec.field(default_factory=dict)
    turn: Annotated[
        dict[str, tuple[Turn, ...]],
        said("how it is turned in a touch, t and a rotation vector (rad, world), by finger; default: as it is"),
    ] = msgspec.field(default_factory=dict)
    observer: Observer = Observer()
    survey: Annotated[tuple[Survey, ...], sized(Range(0, 20, "a session"), "surveys, in order")] = ()
    catch: CatchTrials | None = None
    confidence: Confidence | None = None
    screen: Screen = Screen()

    def faults(self) -> Iterator[Complaint]:
        if known(self.task, self.procedure) and self.task.kind != "compare" and self.procedure.kind != "constant":
            yield "procedure.kind", self.procedure.kind, f"must be constant: a {self.task.kind} is not right or wrong"
        yield from self._participant_faults()
        if known(self.motion, self.turn):
            for finger in self.turn.keys() - self.motion.keys():
                yield (
                    f"turn.{finger}",
                    msgspec.UNSET,
                    "turns a hand that [motion] does not move: give the finger a path",
                )
        if known(self.motion, self.turn, self.trial) and known(self.trial.touch_s):
            for key, paths in (("motion", self.motion), ("turn", self.turn)):
                for finger, path in paths.items():
                    if path and path[-1][0] > self.trial.touch_s:
                        yield f"{key}.{finger}", msgspec.UNSET, f"ends at {path[-1][0]:g} s: make trial.touch_s as long"
        if known(self.factor):
            names = [factor.name for factor in self.factor if known(factor)]
            if len(set(names)) < len(names):
                yield "factor", names, "has a name twice"
            if math.prod(len(each.levels) for each in self.factor if known(each) and known(each.levels)) > LEVELS.high:
                yield "factor", names, f"has more than {LEVELS.high:g} combinations"

    def _participant_faults(self) -> Iterator[Complaint]:
        if known(self.task):
            for key, value in (("catch", self.catch), ("confidence", self.confidence)):
                if known(value) and value is not None and self.task.kind != "compare":
                    yield key, msgspec.UNSET, f"goes with compare: a {self.task.kind} is not right or wrong"
        if known(self.survey):
            names = [survey.name for survey in self.survey if known(survey)]
            if len(set(names)) < len(names):
                yield "survey", names, "has a name twice"
            if known(self.design) and known(self.design.order) and self.design.order == "random":
                for survey in self.survey:
                    if known(survey) and known(survey.at) and "between" in survey.at:
                        yield (
                            f"survey.{survey.name}.at",
                            list(survey.at),
                            "random order has no blocks: take latin-square",
                        )
