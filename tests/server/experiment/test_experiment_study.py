"""Surveys, interleaved staircases, catch trials, consent, screen and typed answers, with the simulated observer."""

import csv
import hashlib
import io
import json
import os
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest
from helpers.called import read_stdout
from helpers.shares import collect_shares
from PIL import Image
from test_experiment_session import check_figure
from test_trial_order import PLAIN, make_file, make_tables

from softfinger.config.errors import ConfigError
from softfinger.server.experiment.analysis import fit_groups
from softfinger.server.experiment.answers import CHOICES, parse_answer, read_keyboard
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.folder import load
from softfinger.server.experiment.observer import SimulatedObserver
from softfinger.server.experiment.session import Stopped
from softfinger.server.experiment.trial_order import plan_trials
from softfinger.server.wire.commands import Prompt

pytestmark = pytest.mark.plain

STUDY = "stiffness-and-workload"
OFFLINE = RunOptions(dry_run=True, no_daemon=True)
RECORDED = {
    "curvature-by-rolling": "778b59d4b210ae6d 34124945ca001145",
    "friction-magnitude": "3f070152f122aaee 793bb4ed85dc7734",
    "path-tracing": "564a26843bb27eee 2c02301015026b00",
    "stiffness-discrimination": "58b64ac58e895c2b 880c0416a71f375f",
    "texture-roughness": "2f43b470c056546d 7df1ba64b202b3a6",
    "weight-of-a-box": "5e8e9b3580126d40 be93cbaf6016e608",
}
"""Hashes of the order and of all rows of participant 1, from before surveys and catch trials existed."""
TLX = {"name": "load", "at": ["after"], "file": "nasa-tlx"}
AGE = {"name": "age", "kind": "number", "prompt": "?", "min": 18, "max": 99}
HAND = {"name": "hand", "kind": "multi-choice", "prompt": "?", "options": ["left", "right"]}
CATCH = {"rate": 0.5, "level": 1.0, "min_right": 0.75}


Image.new("RGB", (2, 2), "red").save(_png := io.BytesIO(), "PNG")
PNG = _png.getvalue()


def hash_values(values: Any) -> str:
    return hashlib.sha256(msgspec.json.encode(values)).hexdigest()[:16]


def survey(**changed: Any) -> dict[str, Any]:
    return {"name": "about", "at": ["before"], "question": [AGE, HAND]} | changed


@pytest.mark.parametrize("name", RECORDED)
def test_a_file_without_the_new_keys_gives_the_same_trials(name: str) -> None:
    experiment = Experiment(name)
    order = [list(trial)[:5] for trial in plan_trials(experiment.file, 1)]
    assert f"{hash_values(order)} {hash_values(experiment.rehearse())}" == RECORDED[name]


def test_a_folder_of_an_older_version_can_be_resumed(tmp_path: Path) -> None:
    experiment = Experiment(make_tables())
    rows = experiment.run(tmp_path, 1, OFFLINE)
    description = json.loads((tmp_path / "experiment.json").read_text())
    for key in ("consent", "debriefing", "survey", "catch", "confidence", "screen"):
        description.pop(key, None)
    (tmp_path / "experiment.json").write_text(json.dumps(description))
    assert experiment.run(tmp_path, 1, OFFLINE) == rows
    assert len(experiment.run(tmp_path, 2, OFFLINE)) == len(rows)


def test_interleaved_staircases_are_independent() -> None:
    experiment = Experiment(STUDY)
    own = [row for row in experiment.rehearse() if row["condition"] == "4.0"]
    counted = [row for row in own if not row["practice"] and not row["catch"]]
    order = [row["staircase"] for row in counted]
    assert Counter(order) == {1: 30, 2: 30}
    assert all(set(order[k : k + 2]) == {1, 2} for k in range(0, 60, 2)) and order[::2] != [order[0]] * 30
    for number, start in enumerate(experiment.file.procedure.starts, 1):
        stairs = [row for row in counted if row["staircase"] == number]
        assert stairs[0]["level"] == start
        streak = 0
        for before, after in pairwise(stairs):
            streak = streak + 1 if before["right"] else 0
            change = after["level"] / before["level"]
            if not before["right"]:
                assert change > 1.0 or before["level"] == 1.0
            elif streak == 2:
                assert change < 1.0 or before["level"] == 0.01
                streak = 0
            else:
                assert change == 1.0


def test_catch_trials_are_added_and_not_fitted() -> None:
    experiment = Experiment(STUDY)
    rows = [row | {"participant": "sub-01"} for row in experiment.rehearse()]
    catch = [row for row in rows if row["catch"]]
    assert Counter(row["condition"] for row in catch) == {"0.0": 6, "4.0": 6}
    assert {row["level"] for row in catch} == {1.0} and not any(row["practice"] for row in catch)
    assert sum(row["test_first"] for row in catch) == 6
    trials = plan_trials(experiment.file, 1)
    counted = [trial.condition for trial in trials if not trial.practice]
    assert [trial.number for trial in trials] == list(range(1, 137)) and counted == sorted(counted)
    assert [group.trials for group in fit_groups(experiment.file, rows)] == [60, 60]


def test_the_test_comes_first_in_half_of_the_trials_of_each_level() -> None:
    for repetitions in (4, 5):
        procedure = {"kind": "constant", "levels": [0.1, 0.2, 0.4], "repetitions": repetitions}
        design = {"seed": 5, "test_first": "balanced-by-level"}
        first, count = Counter[Any](), Counter[Any]()
        for trial in plan_trials(make_file(procedure=procedure, design=design), 1):
            count[trial.condition, trial.level] += 1
            first[trial.condition, trial.level] += trial.test_first
        assert set(count.values()) == {repetitions}
        assert set(first.values()) == ({2} if repetitions == 4 else {2, 3})


def test_a_study_runs_from_consent_to_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, script = tmp_path / "out", "<script>alert(1)</script>"
    for number in ("1", "2"):
        words = ["experiment", STUDY, "--dry-run", "--no-daemon", "--out", str(out), "--participant", number]
        read_stdout(*words, "--set", f"observer.answers.strategy={script}", "--set", f"task.question=Which {script}?")
    answers = list(csv.DictReader((out / "surveys.csv").read_text().splitlines()))
    assert [row["question"] for row in answers[:3]] == ["age", "hand", "mental-demand"]
    assert Counter((row["survey"], row["at"], row["block"], row["condition"]) for row in answers) == {
        ("demographics", "before", "0", ""): 4,
        ("workload", "between", "1", "0.0"): 6, ("workload", "between", "1", "4.0"): 6,
        ("workload", "after", "2", "4.0"): 6, ("workload", "after", "2", "0.0"): 6,
        ("remarks", "after", "2", ""): 2,
    }  # fmt: skip
    assert {"staircase", "catch", "confidence"} <= set((out / "trials.csv").read_text().splitlines()[0].split(","))
    (out / "sub-03").mkdir()
    (out / "sub-03" / "sub-03_journal.jsonl").write_text('{"kind": "consent", "agreed": false}\n')
    shares = collect_shares(monkeypatch)
    read_stdout("figure", str(out), "--report")
    assert len(set(shares["drawing"])) > 12 and shares["drawing"][-1] == 1.0
    for name in ("staircases", "confidence", "surveys"):
        check_figure(out / "figures" / name)
    assert (out / "figures" / "surveys.csv").exists()
    page = (out / "figures" / "report.html").read_text()
    assert "<script" not in page and page.count("&lt;script&gt;alert(1)") >= 3
    assert page.count("data:image/png;base64,") == 4 and 'src="http' not in page and "<link" not in page
    for text in (
        "2 interleaved staircases of 60 trials together per condition, starting at 0.8 and 0.05",
        "Hart, S. G. and Staveland", "2 simulated observers took part", "of 12", "condition (damping)", "χ²(2) =",
        "ratio within participants", "4.0 to 0.0", "NASA-TLX: damping", "4.0 less 0.0", "answered “first”",
        "80 % of the answers are right", "Its answers were: age ", "crosses: wrong answers",
        "<td>sub-03</td><td>0</td><td>0</td><td>none</td><td>none</td><td>did not agree</td>",
    ):  # fmt: skip
        assert text in page


def test_a_session_resumes_within_a_survey(tmp_path: Path) -> None:
    experiment = Experiment(STUDY, {"procedure.trials": 4})
    experiment.run(tmp_path, 1, OFFLINE)
    journal, table = tmp_path / "sub-01" / "sub-01_journal.jsonl", tmp_path / "surveys.csv"
    lines, whole = journal.read_bytes().splitlines(keepends=True), table.read_bytes()
    for place in (2, 3, [b'"between"' in line for line in lines].index(True) + 2, len(lines) - 3):
        journal.write_bytes(b"".join(lines[:place]))
        (tmp_path / "sub-01" / "sub-01_trials.csv").unlink()  # written when a session ends
        experiment.run(tmp_path, 1, OFFLINE)
        assert table.read_bytes() == whole


def test_without_consent_there_is_no_trial(tmp_path: Path) -> None:
    declined = Experiment(STUDY, {"observer.answers": {"consent": "I do not agree"}})
    for _ in range(2):
        with pytest.raises(Stopped, match="did not agree"):
            declined.run(tmp_path, 1, OFFLINE)
    assert load(tmp_path)[1] == []
    text = (tmp_path / "sub-01" / "sub-01_journal.jsonl").read_text()
    assert text.count('"consent"') == 2 and '"survey"' not in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"catch": CATCH | {"rate": 1.5}}, "catch.rate = 1.5"),
        ({"catch": {"rate": 0.1}}, "level"),
        ({"confidence": {"scale": [4, 1]}}, "the first mark, from 1"),
        ({"task.kind": "rate", "task.reference": None, "confidence": {}}, "applies to compare only"),
        ({"survey": [survey(question=[AGE | {"kind": "slider"}])]}, "kind = 'slider'"),
        ({"survey": [survey(question=[AGE, AGE])]}, "has a name twice"),
        ({"survey": [survey(at=[])]}, "must be one or more of before"),
        ({"survey": [survey(at=["between"])]}, "random order has no blocks"),
        ({"survey": [survey(file="nasa-tlx")]}, "set either file or question"),
        ({"survey": [TLX | {"file": "nasa-tlz"}]}, "did you mean 'nasa-tlx'"),
        ({"survey": [survey(question=[HAND | {"options": ["left"]}])]}, "required for multi-choice"),
        ({"survey": [survey(question=[HAND | {"options": ["left", "left"]}])]}, "has an answer twice"),
        ({"survey": [survey(question=[AGE | {"labels": ["a", "b"]}])]}, "for no other kind"),
        ({"survey": [survey(question=[AGE | {"max": 10}])]}, "must be above min = 18"),
        ({"survey": [survey(question=[AGE | {"kind": "likert"}])]}, "more than 21 marks"),
        ({"survey": [survey()], "observer.answers": {"hand": "none"}}, "must be one of left, right"),
        ({"survey": [survey()], "observer.answers": {"age": "old"}}, "must be a number from 18 to 99"),
        ({"survey": [survey()], "observer.answers": {"age": 17}}, "must be a number from 18 to 99"),
        ({"procedure.starts": [0.1]}, "only a staircase has starts"),
        ({"procedure.kind": "staircase", "procedure.starts": [0.1, 2.0]}, "starts = 2.0: must be from smallest"),
        ({"procedure.kind": "staircase", "procedure.starts": [0.1, 0.2], "procedure.trials": 1}, "more staircases"),
        ({"design.test_first": "balance"}, "did you mean 'balanced'"),
        ({"screen.colour": "red"}, "screen.colour = 'red'"),
        ({"screen.by": {"3.0": {"colour": "#ffffff"}}}, "screen.by: no condition is called '3.0'"),
        ({"screen.image": "none.png"}, "cannot be read: No such file"),
    ],
)
def test_an_unusable_survey_is_refused_before_the_session(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Experiment(make_tables() | {key: value for key, value in changes.items() if "." not in key},
                   {key: value for key, value in changes.items() if "." in key})  # fmt: skip


def test_an_image_is_a_file_of_the_study(tmp_path: Path) -> None:
    folder, outside = tmp_path / "study", tmp_path / "outside.png"
    folder.mkdir()
    outside.write_bytes(PNG)
    (folder / "link.png").symlink_to(outside)
    (folder / "text.png").write_text("no image")
    (folder / "large.png").write_bytes(PNG + bytes(200_000))
    (folder / "good.png").write_bytes(PNG)
    text = PLAIN.replace("scene.toml", "paper-plane") + 'screen = { image = "NAME" }\n'
    for name, message in (
        ("../outside.png", "outside the folder of the experiment"),
        (str(outside), "outside the folder of the experiment"),
        ("link.png", "outside the folder of the experiment"),
        ("text.png", "is not an image: use a PNG, JPEG or WebP"),
        ("large.png", "at most 98304"),
        ("gone.png", "cannot be read"),
    ):
        (folder / "e.toml").write_text(text.replace("NAME", name))
        with pytest.raises(ConfigError, match=message):
            Experiment(folder / "e.toml")
    (folder / "e.toml").write_text(text.replace("NAME", "good.png"))
    Experiment(folder / "e.toml").run(tmp_path / "out", 1, OFFLINE)
    (folder / "good.png").write_bytes(PNG + b"\0")
    with pytest.raises(ConfigError, match=r"other values \(good\.png\)"):
        Experiment(folder / "e.toml").run(tmp_path / "out", 2, OFFLINE)


NUMBER = Prompt("t", "?", number=(0.5, 2.5))
TEXT = Prompt("t", "?", text_length=5)


@pytest.mark.parametrize(
    ("prompt", "typed", "answer", "rest"),
    [
        (NUMBER, "1,75\n", 1.75, ""),
        (NUMBER, " 1.75 \n2", 1.75, "2"),
        (NUMBER, "1.000,5\n", "1.000,5", ""),  # not a number: the daemon refuses it
        (NUMBER, "1.7", None, "1.7"),
        (NUMBER, "\n", None, ""),
        (TEXT, "größer\n", "größe", ""),
        (TEXT, "  \n", None, ""),
        (Prompt("t", "?", choices=CHOICES), "x2", "second", ""),
        (Prompt("t", "?", choices=("a b", "c")), "a b\n", "a b", ""),
    ],
)
def test_a_line_is_an_answer(prompt: Prompt, typed: str, answer: Any, rest: str) -> None:
    assert parse_answer(prompt, typed, 0) == (answer, rest)


@pytest.mark.parametrize(("buttons", "answer"), [(1, "first"), (2, "second"), (3, "first"), (4, None), (6, "second")])
def test_the_first_two_buttons_answer(buttons: int, answer: str | None) -> None:
    assert parse_answer(Prompt("t", "?", choices=CHOICES), "", buttons) == (answer, "")


def test_a_character_split_between_two_reads_is_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    """A read returns at most 256 bytes, which splits an ü."""
    text = "a" + 300 * "ü" + "\n"
    reader, writer = os.pipe()
    with os.fdopen(reader) as stdin, os.fdopen(writer, "w") as typed:
        monkeypatch.setattr("sys.stdin", stdin)
        typed.write(text)
        typed.flush()
        with read_keyboard(single=False) as keys:
            assert "".join(keys() for _ in range(4)) == text


def test_simulated_numbers_are_within_their_bounds() -> None:
    height = {"name": "height", "kind": "number", "prompt": "?", "min": 0.5, "max": 2.5}
    survey = {"name": "s", "at": ["before"], "question": [height]}
    for changes, expected in (({}, {1.0, 2.0}), ({"observer": {"answers": {"height": 0.5}}}, {0.5, 1.0})):
        file = Experiment(make_tables(survey=[survey], **changes)).file
        (question,) = file.survey[0].question
        assert {SimulatedObserver(file, 1).survey(question, None, number) for number in range(200)} == expected
