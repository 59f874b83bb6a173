"""Tables of an experiment's file for its trials: task, procedure, factors and design."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal

import msgspec

from softfinger.config.fields import Complaint, Point, Table, doc, is_usable, sized, within
from softfinger.config.limits import Range
from softfinger.server.experiment.schema_parts import MARKS_MAX, TEXT, Label, Positive

LEVELS: Final = Range(1, 200, "more levels cannot be distinguished")
TRIALS: Final = Range(1, 2000, "longer than any session")


class Task(Table, frozen=True, kw_only=True):
    """Task of a trial. The procedure sets its level."""

    kind: Annotated[
        Literal["compare", "rate", "trace"],
        doc(
            "compare: two touches in random order, one of them the reference: which had more; rate: a touch, a number; "
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
        dict[str, float], doc("further parameters that the level sets, each multiplied by a factor", {"a.kinetic": 0.8})
    ] = msgspec.field(default_factory=dict)
    reference: Annotated[Positive | None, doc("compare: value of the reference", 500.0)] = None
    more: Annotated[
        Literal["up", "down"],
        doc(
            "compare: whether more is a larger value, reference (1 + level), or a smaller one, reference / (1 + level)"
        ),
    ] = "up"
    question: Annotated[str, sized(TEXT, "question to the participant", "Which was stiffer?")]
    scale: Annotated[
        tuple[int, int] | None, doc("rate: first and last mark of a rating scale; default: any number above 0", [1, 7])
    ] = None
    scale_ends: Annotated[
        tuple[Label, ...], doc("rate: labels of the first and the last mark", ["not at all", "very"])
    ] = ()
    target_m: Annotated[Point | None, doc("trace: where it ends", [0.0, 0.0, 0.0])] = None
    target_radius_m: Annotated[float, within(Range(1e-4, 1.0, "a target"), "trace: how near", 0.005)] = 0.005

    def value(self, level: float) -> float:
        """Return the parameter's value at a level; for a comparison, the reference changed by the fraction `level`."""
        if self.reference is None:
            return level
        return self.reference * (1.0 + level) if self.more == "up" else self.reference / (1.0 + level)

    @property
    def marks(self) -> tuple[str, ...]:
        return () if self.scale is None else tuple(map(str, range(self.scale[0], self.scale[1] + 1)))

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.kind, self.scale, self.scale_ends):
            if self.scale is not None and self.kind != "rate":
                yield "scale", self.scale, "only rate has a scale"
            if self.scale is not None and not 1 <= self.scale[0] < self.scale[1] < self.scale[0] + MARKS_MAX:
                yield "scale", self.scale, f"must be the first mark, from 1, and the last of at most {MARKS_MAX}"
            if len(self.scale_ends) not in ((0,) if self.scale is None else (0, 2)):
                yield "scale_ends", self.scale_ends, "requires scale, and has two labels"
        if is_usable(self.kind, self.reference) and (self.kind == "compare") != (self.reference is not None):
            yield "reference", self.reference, "required for compare, and for no other task"
        if is_usable(self.kind, self.target_m) and (self.kind == "trace") != (self.target_m is not None):
            yield "target_m", self.target_m, "required for trace, and for no other task"


class Procedure(Table, frozen=True, kw_only=True):
    """Rule for the level of each trial."""

    kind: Annotated[
        Literal["constant", "staircase", "questplus"],
        doc(
            "constant: every level equally often, in random order; staircase: `down` right answers in a row make it "
            "smaller, a wrong one larger (Levitt 1971); questplus: the level with the most informative answer "
            "(Watson 2017)"
        ),
    ]
    levels: Annotated[
        tuple[Positive, ...], sized(Range(0, 200, ""), "constant, questplus: the levels", [0.05, 0.1, 0.2])
    ] = ()
    repetitions: Annotated[int, within(TRIALS, "constant: trials of each level", 10)] = 1
    trials: Annotated[int, within(TRIALS, "staircase, questplus: trials of each condition", 40)] = 40
    start: Annotated[Positive, doc("staircase: first level", 0.5)] = 0.5
    starts: Annotated[
        tuple[Positive, ...],
        sized(
            Range(0, 8, "a session"),
            "staircase: first levels of interleaved staircases, instead of start; they share the trials of a condition",
            [0.6, 0.05],
        ),
    ] = ()
    step: Annotated[
        float,
        within(Range(1.01, 10.0, "a step"), "staircase: factor of a step; squared before the second reversal", 1.2),
    ] = 1.2
    down: Annotated[int, within(Range(1, 5, ""), "staircase: right answers before a step down", 2)] = 2
    smallest: Annotated[Positive, doc("staircase: least level", 0.005)] = 0.005
    largest: Annotated[Positive, doc("staircase: largest level", 1.0)] = 1.0

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.kind, self.levels, self.start, self.starts, self.trials, self.smallest, self.largest):
            return
        if self.kind != "staircase" and not self.levels:
            yield "levels", msgspec.UNSET, f"{self.kind} needs levels"
        if len(set(self.levels)) < len(self.levels):
            yield "levels", list(self.levels), "has a level twice"
        if self.starts and self.kind != "staircase":
            yield "starts", list(self.starts), "only a staircase has starts"
        elif len(self.starts) > self.trials:
            yield "starts", list(self.starts), f"has more staircases than a condition has trials, {self.trials}"
        for key, start in [("starts", value) for value in self.starts] or [("start", self.start)]:
            if self.kind == "staircase" and not self.smallest <= start <= self.largest:
                yield key, start, f"must be from smallest = {self.smallest:g} to largest = {self.largest:g}"


class Factor(Table, frozen=True, kw_only=True):
    """Factor of the design: a parameter with values, whole scenes, or sets of parameters by name."""

    name: Annotated[Label, doc("name; a column of the table of trials")]
    parameter: Annotated[
        str,
        sized(
            TEXT,
            "parameter of the scene that takes the levels, or rig.guard.KEY; object.NAME.material takes names",
            "coupling.damping_ns_per_m",
        ),
    ] = ""
    levels: Annotated[tuple[float | Label, ...], sized(LEVELS, "its levels", [0.3, 0.6])]
    scenes: Annotated[dict[str, str], doc("scene of each level, instead of a parameter")] = msgspec.field(
        default_factory=dict
    )
    values: Annotated[dict[str, dict[str, Any]], doc("parameters of each level, instead of one parameter")] = (
        msgspec.field(default_factory=dict)
    )

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.parameter, self.levels, self.scenes, self.values):
            return
        if sum(map(bool, (self.parameter, self.scenes, self.values))) != 1:
            yield "parameter", self.parameter, "set one of parameter, scenes and values"
        names = {str(level) for level in self.levels}
        if len(names) < len(self.levels):
            yield "levels", list(self.levels), "has a level twice"
        for key, table in (("scenes", self.scenes), ("values", self.values)):
            if table and set(table) != names:
                yield key, sorted(table), f"must have the levels {', '.join(sorted(names))}"


class Design(Table, frozen=True, kw_only=True):
    """Design of the session; conditions are all combinations of the factors' levels."""

    order: Annotated[
        Literal["random", "latin-square", "given"],
        doc(
            "random: trials of all conditions mixed; latin-square: a block for each condition, in an order balanced "
            "over participants (Williams 1949); given: a block for each condition, in the order of the file"
        ),
    ] = "random"
    seed: Annotated[int, within(Range(0, 2**32 - 1, "32 bits"), "seed of every random choice", 1)]
    practice: Annotated[int, within(Range(0, 100, ""), "trials before the first one that counts", 2)] = 0
    break_every: Annotated[int, within(Range(0, 2000, ""), "trials between breaks; 0: none", 40)] = 0
    test_first: Annotated[
        Literal["balanced", "balanced-by-level"],
        doc(
            "compare: half of the trials begin with the test: of all trials, or of those of each condition and level; "
            "of each condition and staircase if a procedure chooses the levels"
        ),
    ] = "balanced"
