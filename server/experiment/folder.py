"""Result folder of an experiment: names after BIDS, files that are written once, and tables made from the journals.

FOLDER/
    dataset_description.json, experiment.json     description, the same for all participants
    files.json                                    hashes of its scenes and their files, rig and images, if any
    participants.tsv, trials.csv                  tables of all participants, made from the journals
    surveys.csv                                   one row per answer to a survey, if there are any
    sub-01/
        sub-01_journal.jsonl                      events, one per line: the source of every table
        sub-01_order.csv, sub-01_design.json      trials as designed; seed, conditions
        sub-01_run-01_about.json                  versions, rig, scene, machine; of each start
        sub-01_run-01_doctor.json                 report of `softfinger doctor`
        sub-01_run-01_ticks.mcap                  every tick, with markers
        sub-01_trials.csv, sub-01_surveys.csv     one row per trial, and per answer to a survey
        trials/sub-01_trial-0001.csv              every tick of the touches of a trial
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.files import make_write_error, write_new_file
from softfinger.config.load import build, describe
from softfinger.config.materials import flatten_entry
from softfinger.config.words import format_value
from softfinger.server.experiment.journal import JSON_ERRORS, REPEAT_REMEDY, RESTORE_REMEDY, Entry, read
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.trial_order import Condition, PlannedTrial, list_conditions, plan_trials

JOURNAL: Final = "sub-*/sub-*_journal.jsonl"
BIDS_VERSION: Final = "1.10.0"


class ParticipantFolder:
    """Files of one participant's sessions. Nothing is written before `begin`.

    files  hashes of the scenes and the rig next to the experiment, by name

    Raises ConfigError if the folder belongs to another experiment, or has another design of this participant.
    """

    def __init__(self, root: Path, experiment: ExperimentFile, participant: int, files: Mapping[str, str]) -> None:
        self.root, self.participant = root, participant
        self.label: Final = f"sub-{participant:02d}"
        self.participant_dir: Final = root / self.label
        self.journal: Final = self.participant_dir / f"{self.label}_journal.jsonl"
        about = {"Name": experiment.title, "BIDSVersion": BIDS_VERSION, "DatasetType": "raw"}
        shared = {"experiment.json": describe(experiment), "files.json": files, "dataset_description.json": about}
        conditions = list_conditions(experiment)
        self._order = _make_rows(conditions, plan_trials(experiment, participant))
        design = {"seed": experiment.design.seed, "conditions": [condition._asdict() for condition in conditions]}
        self._texts = {root / name: _to_json(values) for name, values in shared.items() if values}
        self._texts[self.participant_dir / f"{self.label}_design.json"] = _to_json(design | {"trials": self._order})
        for path, text in self._texts.items():
            _check_same(path, text)

    def begin(self) -> None:
        """Write the missing files: description of the experiment, design and order.

        Raises ConfigError if a file exists with another content, or the errors of `make_write_error`.
        """
        try:
            (self.participant_dir / "trials").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise make_write_error(self.participant_dir / "trials", error, REPEAT_REMEDY) from error
        for path, text in self._texts.items():
            if not path.exists():
                _write(path, text)
            _check_same(path, text)
        order = self.participant_dir / f"{self.label}_order.csv"
        if not order.exists():
            write_csv(order, self._order)

    def check_answer_kind(self, dry_run: bool) -> None:
        """Raise ConfigError if the folder has answers of the other kind: participants or a dry run; or lost answers."""
        for journal in list_journals(self.root):
            if any(entry["kind"] == "started" and entry["dry_run"] != dry_run for entry in read(journal)):
                kind = "participants" if dry_run else "the simulated observer (--dry-run)"
                raise ConfigError(f"{journal}: has answers of {kind}: use another folder, --out FOLDER")

    def add_run(self, files: Mapping[str, Any]) -> int:
        """Write the files of a new start, by name, and return its number."""
        number = 1 + len(list(self.participant_dir.glob(f"{self.label}_run-*_about.json")))
        for name, values in files.items():
            _write_new(self.participant_dir / self.name(number, name), _to_json(values))
        return number

    def name(self, run: int, suffix: str) -> str:
        return f"{self.label}_run-{run:02d}_{suffix}"

    def ticks(self, number: int, attempt: int, rows: Iterable[Mapping[str, Any]]) -> None:
        suffix = f"_attempt-{attempt}" if attempt > 1 else ""
        _write_new(
            self.participant_dir / "trials" / f"{self.label}_trial-{number:04d}{suffix}.csv",
            format_csv(list(rows)).encode(),
        )

    def tables(self) -> None:
        write_csv(self.participant_dir / f"{self.label}_trials.csv", read_trials([self.journal]))
        journals = list_journals(self.root)
        write_csv(self.root / "trials.csv", read_trials(journals))
        if read_surveys([self.journal]):
            write_csv(self.participant_dir / f"{self.label}_surveys.csv", read_surveys([self.journal]))
            write_csv(self.root / "surveys.csv", read_surveys(journals))
        names = b"".join(f"{journal.parent.name}\n".encode() for journal in journals)
        _write(self.root / "participants.tsv", b"participant_id\n" + names)


def list_journals(root: Path) -> list[Path]:
    """Return the journals of all participants.

    Raises ConfigError if one has the name of another participant, or lacks trials of its table: their answers are lost.
    """
    journals = sorted(root.glob(JOURNAL))
    for journal in journals:
        if not journal.name.startswith(f"{journal.parent.name}_"):
            raise ConfigError(f"{journal}: is in the folder {journal.parent.name} of another participant: move it back")
    for table in sorted(root.glob("sub-*/sub-*_trials.csv")):
        journal = table.with_name(table.name.replace("trials.csv", "journal.jsonl"))
        with table.open(encoding="utf-8", errors="replace", newline="") as file:
            numbers = [row.get("trial") for row in csv.DictReader(file)]
        answered = {str(entry["trial"]) for entry in read(journal) if entry["kind"] == "done"}
        if lost := [number for number in dict.fromkeys(numbers) if number is not None and number not in answered]:
            raise ConfigError(
                f"{journal}: lacks the answers of trial {', '.join(lost[:5])}{', ...' * (len(lost) > 5)}, which "
                f"{table.name} has: {RESTORE_REMEDY}, or move the table to another folder to repeat the trials"
            )
    return journals


def _make_rows(conditions: Sequence[Condition], trials: Sequence[PlannedTrial]) -> list[Entry]:
    """Return the designed trials, one row each; columns of unused features are omitted."""
    unused = {name for name in ("catch", "staircase") if not any(getattr(trial, name) for trial in trials)}
    return [
        {key: value for key, value in trial._asdict().items() if key not in unused}
        | {"condition": conditions[trial.condition].name}
        for trial in trials
    ]


def _to_json(values: Any) -> bytes:
    return msgspec.json.format(msgspec.json.encode(values), indent=1) + b"\n"


def _check_same(path: Path, text: bytes) -> None:
    """Raise ConfigError if an existing file has another content than `text`."""
    if path.exists() and path.read_bytes() != text and not _is_same_experiment(path, text):
        try:
            msgspec.json.decode(path.read_bytes(), type=dict)
        except JSON_ERRORS as error:
            raise ConfigError(f"{path}: is damaged: {error}: {RESTORE_REMEDY}") from error
        raise ConfigError(
            f"{path}: belongs to an experiment with other values{_find_different_keys(path, text)}: name another "
            "folder (--out), or run the experiment with its earlier values"
        )


def _is_same_experiment(path: Path, text: bytes) -> bool:
    """Return True if a file describes the experiment of `text` and lacks only keys that are newer than the file."""
    if path.name != "experiment.json":
        return False
    try:
        existing, expected = (
            build(ExperimentFile, msgspec.json.decode(content), str(path)) for content in (path.read_bytes(), text)
        )
    except (ConfigError, *JSON_ERRORS):
        return False
    return existing == expected


def _find_different_keys(path: Path, text: bytes) -> str:
    """Return the keys of a JSON file with other values than in `text`, for a message."""
    try:
        existing, expected = (
            dict(flatten_entry(msgspec.json.decode(content))) for content in (path.read_bytes(), text)
        )
    except (*JSON_ERRORS, AttributeError):
        return ""
    keys = [key for key in expected | existing if expected.get(key, msgspec.UNSET) != existing.get(key, msgspec.UNSET)]
    return f" ({', '.join(keys[:4])}{', ...' if len(keys) > 4 else ''})"


def read_trials(journals: Iterable[Path]) -> list[Entry]:
    """Return a row for each answered trial, practice included, in the order of the journals."""
    rows = []
    for journal in journals:
        for entry in read(journal):
            if entry["kind"] == "done":
                row = {key: value for key, value in entry.items() if key not in ("kind", "levels")}
                rows.append({"participant": journal.parent.name} | row | entry.get("levels", {}))
    return rows


def read_surveys(journals: Iterable[Path]) -> list[Entry]:
    """Return a row for each answer to a question of a survey, in the order of the journals."""
    return [
        {"participant": journal.parent.name} | {key: value for key, value in entry.items() if key != "kind"}
        for journal in journals
        for entry in read(journal)
        if entry["kind"] == "survey"
    ]


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write or replace a table atomically."""
    _write(path, format_csv(rows).encode())


def _write_new(path: Path, data: bytes) -> None:
    """Write a new file atomically. Raises ConfigError if it exists."""
    if path.exists():
        raise ConfigError(f"{path}: already exists, and data of participants is never overwritten: move it away")
    _write(path, data)


def _write(path: Path, data: bytes) -> None:
    """Write or replace a file atomically."""
    try:
        with write_new_file(path) as file:
            file.write(data)
    except OSError as error:
        raise make_write_error(path, error, REPEAT_REMEDY) from error


def format_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format rows as CSV with a header; columns are in the order of their first appearance."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def load(root: Path) -> tuple[ExperimentFile, list[Entry]]:
    """Return the experiment of a folder and its trials. Raises ConfigError if the folder is not of an experiment."""
    path = root / "experiment.json"
    try:
        values = msgspec.json.decode(path.read_bytes())
    except (OSError, *JSON_ERRORS) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"{path}: cannot be read: {reason}: check that `softfinger experiment` wrote this folder"
        ) from error
    experiment = build(ExperimentFile, values, str(path))
    rows = read_trials(list_journals(root))
    _check_answers(root, experiment, rows)
    return experiment, rows


def _check_answers(root: Path, experiment: ExperimentFile, rows: Sequence[Entry]) -> None:
    """Raise ConfigError if an answer is not of the experiment: the analysis would fail, or leave it out."""
    names = [condition.name for condition in list_conditions(experiment)]
    is_comparison = experiment.task.kind == "compare"
    for row in rows:
        fault = ""
        if row["condition"] not in names:
            fault = f"condition = {format_value(row['condition'])}: must be one of {'; '.join(names)}"
        elif is_comparison and row["right"] is None:
            fault = "right = null: must be true or false"
        elif not is_comparison and isinstance(row["answer"], str):
            fault = f"answer = {format_value(row['answer'])}: must be a number"
        if fault:
            label = row["participant"]
            raise ConfigError(f"{root / label}/{label}_journal.jsonl: trial {row['trial']}: {fault}: {RESTORE_REMEDY}")
