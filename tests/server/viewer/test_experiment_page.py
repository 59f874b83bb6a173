"""Experiments through the page: a session, a daemon and a page, controlled in Chromium."""

import csv
from pathlib import Path

import pytest
from helpers.browser import eventually, shown, why_none
from helpers.experiment_page import STUDY, session
from helpers.waits import WAIT_S

from softfinger.server.experiment.experiment import load_results
from softfinger.server.recording.run import load_run
from softfinger.server.viewer.prompt import assign_keys
from softfinger.tools.bench.view import run_viewer


@pytest.mark.real_time
@pytest.mark.exhaustive
@pytest.mark.skipif(bool(why_none()), reason=why_none())
def test_a_whole_experiment_through_the_page(tmp_path: Path) -> None:
    """Answers are given by button and by key; the page of a watcher shows the same and has nothing to answer with."""
    with session(tmp_path, STUDY) as run:
        assert run.waits("Which plate is stiffer?", "Your answers are stored without <b>your name</b>.")
        for width in (390, 2560, 840):
            run.page.set_viewport_size({"width": width, "height": 520})
            assert eventually(lambda: abs(run.middle("I agree") - width / 2) < 10.0), width  # noqa: B023 - called at once
        agree = run.page.get_by_role("button", name="I agree")
        assert agree.bounding_box()["width"] > 500.0  # the column has 640 pixels, also after the window was narrow
        run.click("I agree")
        assert run.waits("About you: question 1 of 2", "Which hand?")
        run.write("your answer", "the <b>left</b> one")
        run.click("answer")
        assert run.waits("About you: question 2 of 2", "How old?")
        run.write("your number", "29")
        run.click("answer")
        assert run.waits("Which plate is stiffer?", "guess if you are not sure")
        with run_viewer("--endpoint", f"ipc://{tmp_path}/t", "--role", "watcher") as (_, address):
            watcher = shown(run.page.context.browser.new_page(), address)
            assert eventually(lambda: watcher.shows("guess if you are not sure"))
            assert not watcher.page.get_by_role("button", name="begin").count()
            assert not watcher.page.get_by_role("tab", name="Feel").count()
            assert watcher.page.get_by_role("tab", name="Plots").count()
            watcher.page.close()
        assert not run.page.get_by_role("tab").count() and not run.page.get_by_text("tick").count()
        run.click("begin")
        assert run.waits("Block 1 of 2, trial 1 of 4")  # a touch is too short to check its text
        assert run.waits("Which was stiffer?")
        assert run.page.locator("[data-colour='#4477aa']").is_visible()
        picture = run.page.locator("img[src^='data:image/png']")
        assert picture.evaluate("image => image.naturalWidth") == 40
        assert eventually(lambda: run.page.locator("body[data-noise='running 0.5']").count())
        run.page.keyboard.down("1")
        assert run.waits("How sure are you?", "1: a guess, 4: certain")
        assert eventually(lambda: run.page.locator("body[data-noise='running 0']").count())
        run.click("3")
        assert run.waits("Block 1 of 2, trial 2 of 4", "Which was stiffer?")
        for _ in range(10):  # a pressed key repeats, but answers only once
            run.page.keyboard.down("1")
        run.page.keyboard.up("1")
        run.page.keyboard.press("2")
        assert run.waits("How sure are you?")
        run.page.keyboard.press("4")
        assert run.waits("How hard was it?", "0: very low, 100: very high")
        run.page.keyboard.press("5")  # first digit of 50, which has no key
        assert run.waits("How hard was it?")
        run.click("95")
        assert run.waits("A break", "2 of 4 trials are done.")
        run.page.keyboard.press("Enter")
        for number, answer in ((3, "second"), (4, "first")):
            assert run.waits(f"Block 2 of 2, trial {number} of 4", "Which was stiffer?")
            assert run.page.locator("[data-colour='#ee6677']").is_visible()
            run.click(answer)
            assert run.waits("How sure are you?")
            run.click("1")
        assert run.waits("The plates had other <i>damping</i>.")
        run.click("go on")
        assert run.process.wait(WAIT_S) == 0
    rows = load_results(tmp_path / "out")
    assert [row["answer"] for row in rows] == ["first", "second", "second", "first"]
    assert [row["damping"] for row in rows] == [0.0, 0.0, 2.0, 2.0]
    assert [row["confidence"] for row in rows] == [3.0, 4.0, 1.0, 1.0]
    with (tmp_path / "out" / "surveys.csv").open() as file:
        surveys = [(row["question"], row["condition"], row["answer"]) for row in csv.DictReader(file)]
    assert surveys == [("remark", "", "the <b>left</b> one"), ("age", "", "29.0"), ("effort", "0.0", "95.0")]
    own = tmp_path / "out" / "sub-01"
    files = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert files == {
        "experiment.json", "dataset_description.json", "participants.tsv", "trials.csv", "sub-01/sub-01_journal.jsonl",
        "sub-01/sub-01_design.json", "sub-01/sub-01_order.csv", "sub-01/sub-01_trials.csv",
        "files.json", "surveys.csv", "sub-01/sub-01_surveys.csv",
        "sub-01/sub-01_run-01_about.json", "sub-01/sub-01_run-01_ticks.mcap",
        *(f"sub-01/trials/sub-01_trial-{number:04d}.csv" for number in range(1, 5)),
    }  # fmt: skip
    events = load_run(own / "sub-01_run-01_ticks.mcap", ("force",)).events
    answers = [event["what"]["value"] for event in events if event.get("name") == "answer"]
    assert answers == ["first", "3", "second", "4", "95", "go on", "second", "1", "first", "1"]


@pytest.mark.plain
def test_each_choice_has_its_key() -> None:
    assert assign_keys(("first", "second")) == {"1": "first", "2": "second"}
    assert assign_keys(("3", "4", "5")) == {"3": "3", "4": "4", "5": "5"}
    assert assign_keys(("0", "1", "2")) == {"0": "0", "1": "1", "2": "2"}
    assert assign_keys(("go on",)) == {"enter": "go on"}
    assert len(assign_keys(tuple(f"choice {k}" for k in range(12)))) == 10


@pytest.mark.plain
@pytest.mark.parametrize("marks", [range(0, 101, 5), range(1, 11), range(-3, 4)])
def test_a_scale_with_longer_marks_has_no_keys(marks: range) -> None:
    """The first character of 50 is 5 and of 10 is 1, and the fifth mark of -3 to 3 is 1."""
    assert assign_keys(tuple(map(str, marks))) == {}
