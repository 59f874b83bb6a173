"""Python interface to experiments: load one, rehearse it, run it with a participant or the simulated observer."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from softfinger.config.arguments import describe_refusal
from softfinger.config.errors import ConfigError
from softfinger.config.words import format_value
from softfinger.server.experiment import checks, files
from softfinger.server.experiment.answers import Participant
from softfinger.server.experiment.daemon import RunOptions, record_ticks, run_doctor, start_daemon
from softfinger.server.experiment.folder import ParticipantFolder, load, read_trials
from softfinger.server.experiment.interfaces import Stimulus, TouchResult
from softfinger.server.experiment.journal import Entry, Journal, MemoryJournal
from softfinger.server.experiment.observer import SimulatedObserver
from softfinger.server.experiment.session import Session
from softfinger.server.experiment.trial_order import Condition, list_conditions
from softfinger.server.progress import show_progress

log: Final = logging.getLogger(__name__)

PARTICIPANT_MAX: Final = 9999


class Experiment:
    """Experiment with participants.

    Parameters
    ----------
    source
        File, name of a shipped experiment, or mapping with the contents of a file.
    changes
        Replacement values by dotted key, such as {"design.seed": 2, "procedure.trials": 60}.

    Raises
    ------
    ConfigError
        With every fault of the file, of its scenes and of its rig.

    Examples
    --------
    >>> from softfinger import Experiment
    >>> rows = Experiment("stiffness-discrimination").rehearse(participant=1)
    >>> len(rows), rows[0]["answer"] in ("first", "second")
    (82, True)
    """

    def __init__(self, source: str | Path | Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> None:
        self.file, self._folder = checks.load(source, {} if changes is None else changes)

    @property
    def conditions(self) -> list[Condition]:
        return list_conditions(self.file)

    def __repr__(self) -> str:
        return f"<Experiment: {self.file.title}>"

    def rehearse(self, participant: int = 1) -> list[Entry]:
        """Run the trials with the simulated observer, without daemon and files; return one row per trial."""
        journal, simulated = MemoryJournal(), SimulatedObserver(self.file, _check_participant(participant))
        session = Session(self.file, participant)
        session.welcome(journal, simulated)
        session.run(journal, lambda stimulus: TouchResult({}, []), simulated)
        return [entry for entry in journal.entries if entry["kind"] == "done"]

    def run(self, folder: str | Path, participant: int, running: RunOptions = RunOptions()) -> list[Entry]:  # noqa: B008
        """Run the unanswered trials of a participant, and write the results into a folder.

        The daemon runs in this process, on the rig of the experiment.

        Parameters
        ----------
        folder
            Result folder, shared by all participants; created if it does not exist.
        participant
            Number, from 1.
        running
            Options of the session.

        Returns
        -------
        list of Entry
            All answered trials of the participant, one row each.

        Raises
        ------
        Stopped
            If a signal ends the session.
        ConfigError
            If the folder belongs to another experiment, or the rig takes no commands.
        HapticError
            Errors that end a daemon.
        """
        participant_folder = ParticipantFolder(
            _as_path(folder), self.file, _check_participant(participant), files.hash_files(self.file, self._folder)
        )
        session = Session(self.file, participant, log.debug if running.no_daemon else log.info)
        participant_folder.check_answer_kind(running.dry_run)
        with ExitStack() as stack:
            # Lock an existing journal before the device is opened: another session may be using both.
            journal = (
                stack.enter_context(Journal(participant_folder.journal))
                if participant_folder.journal.exists()
                else None
            )
            if journal is None or not journal.entries_of("finished"):
                self._run_unanswered(session, stack, journal, participant_folder, running)
            participant_folder.tables()
            return read_trials([participant_folder.journal])

    def _run_unanswered(
        self,
        session: Session,
        stack: ExitStack,
        journal: Journal | None,
        participant_folder: ParticipantFolder,
        running: RunOptions,
    ) -> None:
        """Run the unanswered trials. Files are written only after the device ticks: earlier steps can fail."""
        simulated = SimulatedObserver(self.file, participant_folder.participant)
        if running.no_daemon:
            journal, _ = _begin_run(stack, journal, participant_folder, {"about.json": {"daemon": False}}, True)
            session.welcome(journal, simulated)
            with show_progress("rehearsing", len(session.trials)) as update:

                def present(stimulus: Stimulus) -> TouchResult:
                    update(stimulus.trial)
                    return TouchResult({}, [])

                session.run(journal, present, simulated, participant_folder)
            return
        # Before the device is opened: the doctor needs access to it.
        rig = files.resolve_source(self._folder, self.file.rig)
        run_files = {"doctor.json": run_doctor(str(rig))} if running.doctor else {}
        with start_daemon(self.file, self._folder, participant_folder.root, running) as (haptics, about):
            run_files |= {"about.json": about}
            journal, number = _begin_run(stack, journal, participant_folder, run_files, running.dry_run)
            participant = (
                None if running.dry_run else Participant(self.file, haptics, files.load_images(self.file, self._folder))
            )
            session.welcome(journal, participant or simulated)
            with record_ticks(haptics, f"{participant_folder.label}/{participant_folder.name(number, 'ticks.mcap')}"):
                session.run(journal, haptics.touch, participant or simulated, participant_folder)
            if participant is not None:
                participant.end()


def _begin_run(
    stack: ExitStack,
    journal: Journal | None,
    participant_folder: ParticipantFolder,
    run_files: Mapping[str, Any],
    dry_run: bool,
) -> tuple[Journal, int]:
    """Append a start to the journal; return the journal and the number of the start.

    run_files  additional files of the start, by name
    """
    participant_folder.begin()
    if journal is None:
        journal = stack.enter_context(Journal(participant_folder.journal))
    number = participant_folder.add_run(run_files)
    journal.write("started", run=number, dry_run=dry_run, time=time.time())
    return journal, number


def load_results(folder: str | Path) -> list[Entry]:
    """Return all answered trials of an experiment's folder, one row each, from its journals."""
    return load(Path(folder))[1]


def _as_path(folder: str | Path) -> Path:
    try:
        return Path(folder)
    except TypeError:
        raise ConfigError(describe_refusal("folder", folder, "a path")) from None


def _check_participant(participant: int) -> int:
    if type(participant) is not int or not 1 <= participant <= PARTICIPANT_MAX:
        raise ConfigError(f"participant = {format_value(participant)}: must be an integer from 1 to {PARTICIPANT_MAX}")
    return participant
