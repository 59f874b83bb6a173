"""Tables of an experiment's file for the participant's side: surveys, catch trials, confidence, the page's screen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from softfinger.config.fields import Complaint, Table, doc, is_usable, sized, within
from softfinger.config.limits import NAME_LENGTH, Range
from softfinger.server.wire.commands import CHOICE_LENGTH, CHOICES_MAX

TEXT: Final = Range(0, 4000, "a screen")
MARKS_MAX: Final = 20
"""Largest number of marks on the rating scale of a trial."""
POSITIVE: Final = Range(1e-9, 1e9, "a level above 0")
AT: Final = ("before", "between", "after")

Positive = Annotated[float, Meta(gt=0.0, le=POSITIVE.high)]
Label = Annotated[str, Meta(min_length=1, max_length=int(NAME_LENGTH.high), pattern=r"^[\w .+-]+$")]
Option = Annotated[str, Meta(min_length=1, max_length=CHOICE_LENGTH)]
Bound = Annotated[float, Meta(ge=-1e6, le=1e6)]


def find_repeated_names(key: str, tables: Sequence[Any]) -> Iterator[Complaint]:
    names = [table.name for table in tables if is_usable(table)] if is_usable(tables) else []
    if len(set(names)) < len(names):
        yield key, names, "has a name twice"


class Question(Table, frozen=True, kw_only=True):
    """Question of a survey; each screen shows one. The kinds are those of jsPsych."""

    name: Annotated[Label, doc("name of the question in the table of answers", "age")]
    kind: Annotated[
        Literal["text", "multi-choice", "likert", "number"],
        doc("text: free text; multi-choice: one of options; likert: a mark from min to max; number: from min to max"),
    ]
    prompt: Annotated[str, sized(Range(1, 4000, ""), "the question", "How old are you?")]
    options: Annotated[
        tuple[Option, ...], sized(Range(0, CHOICES_MAX, ""), "multi-choice: the answers", ["left", "right"])
    ] = ()
    min: Annotated[Bound, doc("likert, number: smallest answer", 18)] = 1.0
    max: Annotated[Bound, doc("likert, number: largest answer", 99)] = 7.0
    step: Annotated[Positive, doc("likert: distance between marks", 1)] = 1.0
    labels: Annotated[tuple[Option, ...], doc("likert: meaning of its two ends", ["very low", "very high"])] = ()

    @property
    def marks(self) -> tuple[str, ...]:
        return tuple(f"{self.min + k * self.step:g}" for k in range(1 + int((self.max - self.min) / self.step + 1e-9)))

    @property
    def text(self) -> str:
        ends = ", ".join(
            f"{mark}: {label}" for mark, label in zip((f"{self.min:g}", f"{self.max:g}"), self.labels, strict=False)
        )
        return f"{self.prompt}\n{ends}" if ends else self.prompt

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.kind, self.options, self.min, self.max, self.step, self.labels):
            return
        if (self.kind == "multi-choice") != (len(self.options) > 1):
            yield "options", list(self.options), "required for multi-choice, at least two, and for no other kind"
        if len(set(self.options)) < len(self.options):
            yield "options", list(self.options), "has an answer twice"
        if self.kind in ("likert", "number") and not self.min < self.max:
            yield "max", self.max, f"must be above min = {self.min:g}"
        elif self.kind == "likert" and (self.max - self.min) / self.step > CHOICES_MAX - 1 + 1e-9:
            yield "step", self.step, f"gives more than {CHOICES_MAX} marks"
        if len(self.labels) not in ((0, 2) if self.kind == "likert" else (0,)):
            yield "labels", list(self.labels), "two for likert, and for no other kind"


class SurveyFile(Table, frozen=True, kw_only=True):
    """Questions in a separate file, such as a published questionnaire."""

    title: Annotated[str, sized(Range(0, 200, ""), "title of its screens and in the report", "NASA-TLX")] = ""
    reference: Annotated[str, sized(TEXT, "publication, quoted in the report")] = ""
    score: Annotated[
        Literal["none", "mean"], doc("mean: the report has the mean of its likert questions, as the raw NASA-TLX")
    ] = "none"
    question: Annotated[tuple[Question, ...], sized(Range(0, 100, "a questionnaire"), "its questions, in order")] = ()

    def faults(self) -> Iterator[Complaint]:
        yield from find_repeated_names("question", self.question)


class Survey(SurveyFile, frozen=True, kw_only=True):
    """Survey before, between and after the blocks of trials."""

    name: Annotated[Label, doc("name in the table of answers", "demographics")]
    at: Annotated[
        tuple[Literal["before", "between", "after"], ...],
        doc("before: before the first trial; between: after each block but the last; after: after the last trial"),
    ]
    file: Annotated[
        str,
        sized(
            Range(0, 4096, ""), "file of its questions, shipped or in the folder of this file, instead of [[question]]"
        ),
    ] = ""

    def faults(self) -> Iterator[Complaint]:
        yield from super().faults()
        if is_usable(self.at) and not self.at:
            yield "at", [], f"must be one or more of {', '.join(AT)}"
        if is_usable(self.file, self.question) and bool(self.file) == bool(self.question):
            yield "file", self.file, "set either file or question"


class CatchTrials(Table, frozen=True, kw_only=True):
    """Trials with an obvious answer, mixed with the regular trials. Procedures and fits do not use them."""

    rate: Annotated[
        float, within(Range(0.0, 1.0, "one catch trial per trial"), "catch trials per other trial of a condition", 0.1)
    ]
    level: Annotated[Positive, doc("level of a catch trial", 1.0)]
    min_right: Annotated[
        float,
        within(
            Range(0.0, 1.0, "a share"), "participants with a smaller share of right catch trials are excluded", 0.75
        ),
    ] = 0.0


class Confidence(Table, frozen=True, kw_only=True):
    """Rating of confidence after each answer to a comparison."""

    question: Annotated[str, sized(Range(1, 4000, ""), "the question")] = "How sure are you?"
    scale: Annotated[tuple[int, int], doc("first and last mark", [1, 4])] = (1, 4)
    scale_ends: Annotated[tuple[Option, ...], doc("labels of the first and the last mark", ["a guess", "certain"])] = (
        "a guess",
        "certain",
    )

    @property
    def as_question(self) -> Question:
        low, high = self.scale
        return Question(
            name="confidence", kind="likert", prompt=self.question, min=low, max=high, labels=self.scale_ends
        )

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.scale) and not 1 <= self.scale[0] < self.scale[1] < self.scale[0] + MARKS_MAX:
            yield "scale", self.scale, f"must be the first mark, from 1, and the last of at most {MARKS_MAX}"
        if is_usable(self.scale_ends) and len(self.scale_ends) != 2:
            yield "scale_ends", list(self.scale_ends), "has two words"


class Screen(Table, frozen=True, kw_only=True):
    """Content and sound of the participant's page during trials."""

    masking_noise: Annotated[
        Literal["none", "white", "pink"], doc("noise that masks the sound of the device, made by the page")
    ] = "none"
    volume: Annotated[float, within(Range(0.0, 1.0, "full scale"), "volume of the noise", 0.2)] = 0.2
    colour: Annotated[
        str, Meta(pattern=r"^(#[0-9a-fA-F]{6})?$", description="colour of a patch", examples=["#3366cc"])
    ] = ""
    image: Annotated[
        str, sized(Range(0, 255, "a name of a file"), "image: PNG, JPEG or WebP in the folder of this file")
    ] = ""
    by: Annotated[
        dict[str, dict[str, str | float]],
        doc("other values in a condition, by its name, as in observer.by", {"rolling": {"colour": "#3366cc"}}),
    ] = msgspec.field(default_factory=dict)
