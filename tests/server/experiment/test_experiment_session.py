"""Sessions without a daemon: journal, resume after a kill, tables, figures, command line."""

import csv
import json
import random
import re
import shutil
import signal
import subprocess
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.called import called, read_stdout
from helpers.processes import COMMAND
from helpers.shortages import file_size_limit
from PIL import Image
from test_trial_order import make_tables

from softfinger.config.errors import ConfigError, Exhausted
from softfinger.config.schema import Scene
from softfinger.config.sources import EXPERIMENTS, FOLDERS, list_names
from softfinger.server import cli
from softfinger.server.experiment.analysis import fit_groups
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment, load_results
from softfinger.server.experiment.folder import ParticipantFolder, load
from softfinger.server.experiment.journal import Journal, read
from softfinger.server.experiment.report import _load_starts

pytestmark = pytest.mark.plain

OFFLINE = RunOptions(dry_run=True, no_daemon=True)


def read_table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def check_figure(figure: Path) -> None:
    with Image.open(figure.with_suffix(".png")) as picture:
        assert len(picture.convert("RGB").getcolors(1 << 20) or ()) > 50
    tags = [element.tag.partition("}")[2] for element in ET.parse(figure.with_suffix(".svg")).iter()]
    assert tags.count("path") + tags.count("text") > 20


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "name", [name for name in list_names(EXPERIMENTS) if name != "stiffness-and-workload"]
)  # tested elsewhere
def test_each_shipped_experiment_runs_from_design_to_figure(name: str, tmp_path: Path) -> None:
    read_stdout("experiment", name, "--dry-run", "--no-daemon", "--out", str(tmp_path / "out"))
    read_stdout("figure", str(tmp_path / "out"))
    figures = tmp_path / "out" / "figures"
    # Without a device there are no forces, so the figure `felt` is not drawn.
    assert {path.name for path in figures.iterdir()} == {"fit.png", "fit.svg", "numbers.csv", "numbers.json"}
    check_figure(figures / "fit")
    numbers = json.loads((figures / "numbers.json").read_text())
    same = read_table(figures / "numbers.csv")
    assert [row["condition"] for row in same] == [entry["condition"] for entry in numbers]
    for row, entry in zip(same, numbers, strict=True):
        key = "threshold" if "threshold" in entry else "exponent"
        assert float(row[key]) == entry[key] and entry[f"{key}_95_low"] <= entry[key] <= entry[f"{key}_95_high"]
    rows = read_table(tmp_path / "out" / "trials.csv")
    assert [int(row["trial"]) for row in rows] == list(range(1, len(rows) + 1))
    assert sum(entry["trials"] for entry in numbers) == sum(row["practice"] == "False" for row in rows)


REHEARSAL = [*COMMAND, "-q", "experiment", "friction-magnitude", "--dry-run", "--no-daemon", "--out"]


def test_a_killed_session_resumes_without_loss_or_repetition(tmp_path: Path, cases: Callable[[int, int], int]) -> None:
    words, rng, journal = [*REHEARSAL, str(tmp_path)], random.Random(7), tmp_path / "sub-01" / "sub-01_journal.jsonl"
    size = lambda: journal.stat().st_size if journal.exists() else 0  # noqa: E731
    for _ in range(cases(3, 50)):
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        until = size() + rng.randrange(1, 400)
        while size() < until and process.poll() is None:
            time.sleep(1e-4)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert subprocess.run(words, check=False, stdout=subprocess.DEVNULL).returncode == 0
    rows = load_results(tmp_path)
    assert [row["trial"] for row in rows] == list(range(1, len(rows) + 1))
    whole, keys = Experiment("friction-magnitude").rehearse(), ("trial", "level", "answer")
    assert [[row[key] for key in keys] for row in rows] == [[row[key] for key in keys] for row in whole]
    assert len(read(journal)) > 2 * len(rows)


def cut_journal(own: Path, entries: int, rest: bytes = b"") -> None:
    """Remove all but the first entries and the table, which a session writes at its end."""
    (journal,) = own.glob("*_journal.jsonl")
    journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:entries]) + rest)
    (own / f"{own.name}_trials.csv").unlink(missing_ok=True)


def test_an_adaptive_session_resumes_at_the_same_level(tmp_path: Path) -> None:
    experiment = Experiment("stiffness-discrimination", {"procedure.trials": 30})
    rows = experiment.run(tmp_path, 1, OFFLINE)
    journal = tmp_path / "sub-01" / "sub-01_journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    cut_journal(journal.parent, 31, lines[31][:17])  # last line truncated, as by a power cut
    resumed = experiment.run(tmp_path, 1, OFFLINE)
    assert [row["level"] for row in resumed] == [row["level"] for row in rows]
    assert [row["answer"] for row in resumed] == [row["answer"] for row in rows]


class FinishedSession:
    """Session of participant 1 with 36 trials, and its journal."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.experiment = folder, Experiment(make_tables())
        self.rows = self.run()
        self.journal = folder / "sub-01" / "sub-01_journal.jsonl"
        self.lines = self.journal.read_bytes().splitlines(keepends=True)

    def run(self, participant: int = 1) -> list[dict[str, Any]]:
        return self.experiment.run(self.folder, participant, OFFLINE)

    def write(self, *lines: bytes) -> None:
        self.journal.write_bytes(b"".join(lines))


@pytest.fixture
def finished(tmp_path: Path) -> FinishedSession:
    return FinishedSession(tmp_path)


def test_a_finished_session_is_not_repeated(finished: FinishedSession) -> None:
    assert finished.run() == finished.rows and finished.journal.read_bytes() == b"".join(finished.lines)


def test_a_folder_keeps_to_one_experiment(finished: FinishedSession) -> None:
    finished.experiment = Experiment(make_tables(), {"task.reference": 600.0, "design.seed": 6})
    message = r"belongs to an experiment with other values \(task.reference, design.seed\)"
    for participant in (1, 2):
        with pytest.raises(ConfigError, match=message):
            finished.run(participant)


def test_a_folder_does_not_mix_rehearsals_with_participants(finished: FinishedSession) -> None:
    for participant in (1, 2):
        with pytest.raises(ConfigError, match=r"answers of the simulated observer \(--dry-run\): use another folder"):
            finished.experiment.run(finished.folder, participant)
    finished.write(re.sub(rb'"dry_run":true(.*),"crc32":\d+', rb'"dry_run":false\1', b"".join(finished.lines)))
    with pytest.raises(ConfigError, match="answers of participants: use another folder"):
        finished.run()


def test_a_partly_written_journal_entry_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with Journal(path) as journal:
        journal.write("begun", trial=1)
        with (
            file_size_limit(path.stat().st_size + 5),
            pytest.raises(Exhausted, match="cannot be written: File too large: earlier answers are stored"),
        ):
            journal.write("done", trial=1)
        assert read(path) == journal.entries == [{"kind": "begun", "trial": 1}]
        journal.write("begun", trial=2)
    assert [entry["trial"] for entry in read(path)] == [1, 2]


def test_a_partly_written_table_of_ticks_is_removed(tmp_path: Path) -> None:
    file = Experiment(make_tables()).file
    folder = ParticipantFolder(tmp_path, file, 1, {})
    folder.begin()
    table = tmp_path / "sub-01" / "trials" / "sub-01_trial-0001.csv"
    rows = [{"tick": tick} for tick in range(1000)]
    with (
        file_size_limit((tmp_path / "experiment.json").stat().st_size + 100),
        pytest.raises(Exhausted, match="cannot be written: File too"),
    ):
        folder.ticks(1, 1, rows)
    assert not list(table.parent.iterdir())
    folder.ticks(1, 1, rows)
    assert len(table.read_text().splitlines()) == 1001
    with pytest.raises(ConfigError, match="already exists, and data of participants is never overwritten"):
        folder.ticks(1, 1, rows)


def test_sessions_at_once_in_one_folder_leave_one_table(tmp_path: Path) -> None:
    words = [*REHEARSAL, str(tmp_path / "out"), "--participant"]
    processes = [subprocess.Popen([*words, str(number)], stdout=subprocess.DEVNULL) for number in (1, 2, 3)]
    assert [process.wait(100.0) for process in processes] == [0, 0, 0]
    Experiment("friction-magnitude").run(tmp_path / "out", 1, OFFLINE)  # writes the tables again
    names = {row["participant"] for row in read_table(tmp_path / "out" / "trials.csv")}
    assert names == {"sub-01", "sub-02", "sub-03"}
    assert not list((tmp_path / "out").rglob("*.part"))


def test_one_session_of_a_participant_at_a_time(tmp_path: Path) -> None:
    with Journal(tmp_path / "j.jsonl"), pytest.raises(ConfigError, match="another session of this participant"):
        Journal(tmp_path / "j.jsonl")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"kind":"begun"}', "missing required field `trial`"),
        ('{"kind":"begun","trial":"3"}', r"Expected `int`, got `str` - at `\$.trial`"),
        ('{"kind":"started"}', "missing required field `dry_run`"),
        ('{"kind":"done","trial":1}', "missing required field `practice`"),
        ('{"kind":"survey"}', "missing required field `survey`"),
        ('{"trial":3}', "missing required field `kind`"),
        ('{"kind":[]}', r"Expected `str`, got `array` - at `\$.kind`"),
        ('{"ki', "is not an entry"),
    ],
)
def test_an_edited_journal_entry_is_refused(line: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "j.jsonl").write_text('{"kind":"begun","trial":1}\n' + line + '\n{"kind":"finished"}\n')
    with pytest.raises(ConfigError, match=rf"j\.jsonl: line 2:? .*{message}.*: restore"):
        read(tmp_path / "j.jsonl")


def test_a_lost_line_of_a_journal_is_noticed(finished: FinishedSession) -> None:
    """Any lost line but the last, which a kill may also lose; and a line that occurs twice."""
    lines = finished.lines
    for lost in range(len(lines) - 1):
        finished.write(*lines[:lost], *lines[lost + 1 :])
        with pytest.raises(ConfigError, match=f"line {lost + 1}: entry {lost + 1} is missing between .* restore"):
            finished.run()
    answer = next(index for index, line in enumerate(lines) if b'"done","entry":5,' in line)
    finished.write(*lines[:answer], *lines[answer + 3 :])
    message = "line 5: entries 5 to 7 are missing between 'begun' of trial 2 and 'begun' of"
    with pytest.raises(ConfigError, match=message):
        load_results(finished.folder)
    finished.write(*lines[:5], *lines[4:])
    with pytest.raises(ConfigError, match="line 6: is entry 5, must be entry 6: restore"):
        load_results(finished.folder)


@pytest.mark.parametrize("remaining", [None, b"", b"[]\n", b"\xff\xfe\0\n\xff\n", 8])
def test_the_end_of_a_lost_journal_is_noticed(remaining: bytes | int | None, finished: FinishedSession) -> None:
    """The tables of a finished session have the answers: they must not be replaced."""
    table = finished.folder / "trials.csv"
    before = table.read_bytes()
    if remaining is None:
        finished.journal.unlink()
    else:
        finished.write(*([remaining] if isinstance(remaining, bytes) else finished.lines[:remaining]))
    lost = "lacks the answers of trial (1|4, 5), .* restore|line 1 is not an entry of a journal: restore"
    for participant in (1, 2):
        with pytest.raises(ConfigError, match=rf"sub-01_journal\.jsonl: ({lost}|line 1: .*missing)"):
            finished.run(participant)
    with pytest.raises(ConfigError, match=lost):
        load_results(finished.folder)
    assert table.read_bytes() == before and not (finished.folder / "sub-02").exists()


def test_a_journal_may_end_with_zeros_after_a_power_failure(finished: FinishedSession) -> None:
    for rest in (bytes(300), b'{"kin' + bytes(40), b"{"):
        cut_journal(finished.journal.parent, 7, rest)
        assert [row["answer"] for row in finished.run()] == [row["answer"] for row in finished.rows]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"right":true', '"right":null', "trial 1: right = null: must be true or false"),
        ('"condition":"', '"condition":"x', "trial 1: condition = 'x.*': must be one of"),
        ('"level":', '"level":-', r"line 3: Expected `float` > 0.0 - at `\$.level`"),
    ],
)
def test_an_edited_answer_is_refused(old: str, new: str, message: str, finished: FinishedSession) -> None:
    text = finished.journal.read_text().replace('"right":false', '"right":true').replace(old, new)
    finished.journal.write_text(text)
    with pytest.raises(ConfigError, match=r"journal\.jsonl: line 3: 'done' of trial 1 was edited later: restore the"):
        load(finished.folder)
    finished.journal.write_text(re.sub(r',"crc32":\d+', "", text))
    with pytest.raises(ConfigError, match=rf"sub-01_journal\.jsonl: {message}.*: restore the file from a copy"):
        load(finished.folder)


def test_damaged_files_of_a_folder_are_named(tmp_path: Path, finished: FinishedSession) -> None:
    about, described = tmp_path / "sub-01" / "sub-01_run-01_about.json", tmp_path / "experiment.json"
    whole = about.read_bytes()
    about.write_bytes(whole[:10])
    with pytest.raises(ConfigError, match=r"sub-01_run-01_about\.json: is damaged: .*: restore the file from a copy"):
        _load_starts(tmp_path)
    about.write_bytes(whole)
    whole = described.read_bytes()
    for damaged in (whole[:100], whole.replace(b"title", b"\xffitle"), b"[" * 100_000):
        described.write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"experiment\.json: is damaged: .*: restore the file from a copy"):
            finished.run()
        with pytest.raises(ConfigError, match=r"experiment\.json: cannot be read: "):
            load(tmp_path)
    shutil.copytree(tmp_path / "sub-01", tmp_path / "sub-07")
    described.unlink()
    with pytest.raises(ConfigError, match=r"sub-01_journal\.jsonl: is in the folder sub-07 of another participant"):
        finished.run()


def test_a_title_of_any_characters_is_drawn(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Experiment(make_tables(title="Worth $\\bad{ or $5? \u6f22\u5b57\u6f22")).run(tmp_path, 1, OFFLINE)
    assert cli.main(["figure", str(tmp_path)]) == 0
    check_figure(tmp_path / "figures" / "fit")
    assert caplog.text.count("the font of the figures lacks the characters \u6f22\u5b57: set font.family") == 1


@pytest.mark.usefixtures("finished")
def test_figures_that_cannot_be_written_are_one_error(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "fit.png").write_bytes(b"old")
    with file_size_limit(2000):
        result = called("figure", str(tmp_path))
    fault = f"{tmp_path / 'figures'}: cannot be written: File too large: make room, or name another folder"
    assert result.returncode == Exhausted.exit_code and fault in result.stderr
    assert (tmp_path / "figures" / "fit.png").read_bytes() == b"old"


def test_a_session_continues_without_a_lost_answer(finished: FinishedSession) -> None:
    first, rest = finished.lines[:4], finished.lines[5:-1]
    finished.write(*first, *rest)
    with pytest.raises(ConfigError) as refused:
        finished.run()
    line = re.search(r"insert a line (\{.*\})", str(refused.value))
    finished.write(*first, f"{line[1]}\n".encode(), *rest)
    with pytest.raises(ConfigError, match=r"lacks the answers of trial 2, which sub-01_trials\.csv has: restore"):
        finished.run()
    (finished.folder / "sub-01" / "sub-01_trials.csv").unlink()
    resumed = finished.run()
    assert [(row["trial"], row["attempt"]) for row in resumed if row["attempt"] > 1] == [(2, 2)]
    levels = [(row["trial"], row["level"]) for row in finished.rows]
    assert sorted((row["trial"], row["level"]) for row in resumed) == levels


def test_a_journal_of_an_earlier_version_is_continued(finished: FinishedSession) -> None:
    finished.write(*(re.sub(rb'"entry":\d+,|,"crc32":\d+', b"", line) for line in finished.lines))
    cut_journal(finished.journal.parent, 9)
    assert [row["answer"] for row in finished.run()] == [row["answer"] for row in finished.rows]
    journal = finished.journal.read_bytes()
    assert b'"entry":10,' in journal and b'"entry":9,' not in journal
    assert "entry" not in (finished.folder / "trials.csv").read_text()


def test_several_participants_are_fitted_one_by_one_and_together(tmp_path: Path) -> None:
    experiment = Experiment(make_tables(factor=[]))
    for participant in (1, 2):
        experiment.run(tmp_path, participant, OFFLINE)
    groups = fit_groups(*load(tmp_path))
    assert [group.participant for group in groups] == ["sub-01", "sub-02", "all participants"]
    assert groups[2].trials == groups[0].trials + groups[1].trials == 24
    assert (tmp_path / "participants.tsv").read_text() == "participant_id\nsub-01\nsub-02\n"


def test_a_participant_is_a_number(tmp_path: Path) -> None:
    for name in ("../x", "Zoë", True, 1.0):
        with pytest.raises(ConfigError, match="must be an integer from 1 to 9999"):
            Experiment(make_tables()).run(tmp_path / "out", name, OFFLINE)
    assert not (tmp_path / "out").exists()


def test_a_missing_or_changed_scene_stops_a_session(tmp_path: Path) -> None:
    scene, file, out = tmp_path / "mine.toml", tmp_path / "e.toml", tmp_path / "out"
    shutil.copy(FOLDERS[Scene] / "paper-plane.toml", scene)
    file.write_text((EXPERIMENTS / "friction-magnitude.toml").read_text().replace('"paper-plane"', '"mine.toml"'))
    rows = Experiment(file).run(out, 1, OFFLINE)
    cut_journal(out / "sub-01", 21)
    scene.rename(tmp_path / "moved.toml")
    with pytest.raises(ConfigError, match=r"mine\.toml: no such file"):
        Experiment(file).run(out, 1, OFFLINE)
    scene.write_text((tmp_path / "moved.toml").read_text() + "# another\n")
    with pytest.raises(ConfigError, match=r"files\.json: belongs to an experiment with other values \(mine\.toml\)"):
        Experiment(file).run(out, 1, OFFLINE)
    (tmp_path / "moved.toml").rename(scene)
    assert Experiment(file).run(out, 1, OFFLINE) == rows
