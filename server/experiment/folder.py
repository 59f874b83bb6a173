"""The folder of an experiment: names after BIDS, files that are written once, tables made from the journals.

FOLDER/
    dataset_description.json, experiment.json     what it is, the same for all participants
    participants.tsv, trials.csv                  tables of all, made from the journals
    sub-01/
        sub-01_journal.jsonl                      what happened, a line each: the source of every table
        sub-01_order.csv, sub-01_design.json      the trials as designed; seed, conditions
        sub-01_run-01_about.json                  versions, rig, scene, machine; of each start
        sub-01_run-01_doctor.json                 what `softfinger doctor` found
        sub-01_run-01_ticks.mcap                  every tick, with markers
        sub-01_trials.csv                         a row a trial
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
from softfinger.config.files import new_file, open_recording
from softfinger.config.load import describe
from softfinger.server.experiment.design import Condition, Planned
from softfinger.server.experiment.journal import Entry, read
from softfinger.server.experiment.schema import ExperimentFile

JOURNAL: Final = "sub-*/sub-*_journal.jsonl"
BIDS_VERSION: Final = "1.10.0"


class Folder:
    """What one participant's sessions write.

    Raises ConfigError where the folder is of another experiment.
    """

    def __init__(self, root: Path, experiment: ExperimentFile, participant: int) -> None:
        self.root, self.participant = root, participant
        self.label: Final = f"sub-{participant:02d}"
        self.own: Final = root / self.label
        (self.own / "trials").mkdir(parents=True, exist_ok=True)
        self._same("experiment.json", describe(experiment), root)
        about = {"Name": experiment.title, "BIDSVersion": BIDS_VERSION, "DatasetType": "raw"}
        self._same("dataset_description.json", about, root)
        self.journal: Final = self.own / f"{self.label}_journal.jsonl"

    def begin(self, experiment: ExperimentFile, conditions: Sequence[Condition], trials: Sequence[Planned]) -> None:
        """Write the design and the order; ConfigError where those that are there differ."""
        rows = [trial._asdict() | {"condition": conditions[trial.condition].name} for trial in trials]
        design = {"seed": experiment.design.seed, "conditions": [each._asdict() for each in conditions]}
        self._same(f"{self.label}_design.json", design | {"trials": rows}, self.own)
        order = self.own / f"{self.label}_order.csv"
        if not order.exists():
            write_csv(order, rows)

    def run(self) -> int:
        """The number of the next start, from 1."""
        return 1 + len(list(self.own.glob(f"{self.label}_run-*_about.json")))

    def name(self, run: int, what: str) -> str:
        """Of a file of a start."""
        return f"{self.label}_run-{run:02d}_{what}"

    def keep(self, name: str, values: Any) -> None:
        """A new JSON file of this participant."""
        with open_recording(self.own / name) as file:
            file.write(msgspec.json.format(msgspec.json.encode(values), indent=1) + b"\n")

    def ticks(self, number: int, attempt: int, rows: Iterable[Mapping[str, Any]]) -> None:
        """A new table of the ticks of a trial."""
        again = f"_attempt-{attempt}" if attempt > 1 else ""
        with open_recording(self.own / "trials" / f"{self.label}_trial-{number:04d}{again}.csv") as file:
            file.write(csv_text(list(rows)).encode())

    def tables(self) -> None:
        """Make the tables anew from the journals."""
        write_csv(self.own / f"{self.label}_trials.csv", trials_in([self.journal]))
        journals = sorted(self.root.glob(JOURNAL))
        write_csv(self.root / "trials.csv", trials_in(journals))
        with new_file(self.root / "participants.tsv") as file:
            file.write(b"participant_id\n" + b"".join(f"{each.parent.name}\n".encode() for each in journals))

    def _same(self, name: str, values: Any, where: Path) -> None:
        """A JSON file that has these values, now or already."""
        path, text = where / name, msgspec.json.format(msgspec.json.encode(values), indent=1) + b"\n"
        if not path.exists():
            with new_file(path) as file:
                file.write(text)
        elif path.read_bytes() != text:
            raise ConfigError(
                f"{path}: is of an experiment with other values: name another folder, or run the experiment as it was"
            )


def trials_in(journals: Iterable[Path]) -> list[Entry]:
    """A row for each trial that has been answered, practice included, in the order of the journals."""
    rows = []
    for journal in journals:
        for entry in read(journal):
            if entry["kind"] == "done":
                row = {key: value for key, value in entry.items() if key not in ("kind", "levels")}
                rows.append({"participant": journal.parent.name} | row | entry.get("levels", {}))
    return rows


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A table in place of the one that is there, whole or not at all."""
    with new_file(path) as file:
        file.write(csv_text(rows).encode())


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A header and a line a row; columns in the order of their first appearance."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def load(root: Path) -> tuple[ExperimentFile, list[Entry]]:
    """The experiment of a folder, and its trials; ConfigError where it is no such folder."""
    from softfinger.config.load import build

    path = root / "experiment.json"
    try:
        values = msgspec.json.decode(path.read_bytes())
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(
            f"{path}: cannot be read: {error}: is this a folder that `softfinger experiment` made?"
        ) from error
    return build(ExperimentFile, values, str(path)), trials_in(sorted(root.glob(JOURNAL)))
