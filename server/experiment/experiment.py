"""Python interface to experiments: load one, rehearse it, run it with a participant or the simulated observer."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_rig
from softfinger.config.words import shown
from softfinger.server import signals
from softfinger.server.experiment import files, rigs
from softfinger.server.experiment.answers import DryRun, Participant
from softfinger.server.experiment.design import Condition, conditions
from softfinger.server.experiment.folder import Folder, load, read_trials
from softfinger.server.experiment.haptics import Haptics
from softfinger.server.experiment.interfaces import NullApparatus
from softfinger.server.experiment.journal import Entry, Journal, Memory
from softfinger.server.experiment.masses import load_changed_scene
from softfinger.server.experiment.session import Session, Stopped
from softfinger.server.progress import progress, report_compilation
from softfinger.server.viewer.door.process import PageProcess
from softfinger.server.viewer.roles import Role

log: Final = logging.getLogger(__name__)

PARTICIPANT_MAX: Final = 9999
DOCTOR_TIMEOUT_S: Final = 120.0
FIRST_TICK_S: Final = 30.0
EXIT_WAIT_S: Final = 0.0


class RunOptions(NamedTuple):
    """Options of a session.

    dry_run     the simulated observer answers
    no_daemon   without rendering: only the simulated observer, the journal and the tables
    doctor      run `softfinger doctor` first
    view        show the prompts to the participant on a page in the browser
    rig         values for the rig by dotted key, such as telemetry.endpoint
    """

    dry_run: bool = False
    no_daemon: bool = False
    doctor: bool = True
    view: bool = False
    rig: Mapping[str, Any] = {}


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
        self.file, self._folder = files.load(source, changes or {})
        files.check(self.file, self._folder)

    @property
    def conditions(self) -> list[Condition]:
        """All combinations of the factors' levels."""
        return conditions(self.file)

    def __repr__(self) -> str:
        return f"<Experiment: {self.file.title}>"

    def rehearse(self, participant: int = 1) -> list[Entry]:
        """Run the trials with the simulated observer, without daemon and files; return one row per trial."""
        journal, simulated = Memory(), DryRun(self.file, _check_participant(participant))
        session = Session(self.file, participant)
        session.welcome(journal, simulated)
        session.run(journal, NullApparatus(), simulated)
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
        participant_folder = Folder(
            Path(folder), self.file, _check_participant(participant), files.hashes(self.file, self._folder)
        )
        session = Session(self.file, participant, log.debug if running.no_daemon else log.info)
        session.check(participant_folder)
        participant_folder.check_answer_kind(running.dry_run)
        with ExitStack() as stack:
            # Lock an existing journal before the device is opened: another session may be using both.
            journal = (
                stack.enter_context(Journal(participant_folder.journal))
                if participant_folder.journal.exists()
                else None
            )
            if journal is None or not journal.of("finished"):
                self._run_unanswered(session, stack, journal, participant_folder, running)
            participant_folder.tables()
            return read_trials([participant_folder.journal])

    def _run_unanswered(
        self,
        session: Session,
        stack: ExitStack,
        journal: Journal | None,
        participant_folder: Folder,
        running: RunOptions,
    ) -> None:
        """Run the unanswered trials. Files are written only after the device ticks: earlier steps can fail."""
        simulated = DryRun(self.file, participant_folder.participant)
        if running.no_daemon:
            journal, _ = _begin_run(
                session, stack, journal, participant_folder, {"about.json": {"daemon": False}}, True
            )
            session.welcome(journal, simulated)
            with progress("rehearsing", len(session.trials)) as done:
                session.run(journal, NullApparatus(done), simulated, participant_folder)
            return
        rig = files.resolve_source(self._folder, self.file.rig)
        # Before the device is opened: the doctor needs access to it.
        run_files = {"doctor.json": run_doctor(str(rig))} if running.doctor else {}
        with self._start_daemon(participant_folder, rig, running) as (haptics, about):
            run_files |= {"about.json": about}
            journal, number = _begin_run(session, stack, journal, participant_folder, run_files, running.dry_run)
            participant = (
                None if running.dry_run else Participant(self.file, haptics, files.images(self.file, self._folder))
            )
            session.welcome(journal, participant or simulated)
            with record_ticks(haptics, f"{participant_folder.label}/{participant_folder.name(number, 'ticks.mcap')}"):
                session.run(journal, haptics, participant or simulated, participant_folder)
            if participant is not None:
                participant.end()

    @contextmanager
    def _start_daemon(
        self, participant_folder: Folder, rig: str | Path, running: RunOptions
    ) -> Iterator[tuple[Haptics, dict[str, Any]]]:
        """Start a daemon with rig and scene of the experiment; yield its `Haptics` and its description."""
        from softfinger.server.app import Daemon
        from softfinger.server.remote import Client

        values = {"recording.directory": str(participant_folder.root.absolute()), **running.rig}
        rig_values, scene_values = rigs.split(self.file.overrides, "overrides")
        scene = load_changed_scene(self._scene(self.file.scene), scene_values, "overrides")
        with ExitStack() as stack:
            daemon = stack.enter_context(
                Daemon(load_rig(rig, values | rig_values), scene, scene_name=Path(self.file.scene).stem[:64])
            )
            if daemon.commands_endpoint is None:
                raise ConfigError(
                    f"{rig}: takes no commands, and an experiment needs them: leave commands.endpoint out"
                )
            for where, name, parameters in files.level_extremes(self.file):
                condition_rig, condition_scene = rigs.split(parameters, where)
                scene_at_level = load_changed_scene(self._scene(name), condition_scene, where)
                try:
                    daemon.rendering.check(scene_at_level, load_rig(rig, values | condition_rig))
                except ConfigError as error:
                    raise ConfigError(f"{where}: {error}") from error
            parameters_by_location = ((where, parameters) for where, _, parameters in files.level_extremes(self.file))
            rigs.check_rated(parameters_by_location, [device.info for device in daemon.devices])
            stack.enter_context(signals.stop_on_signal(daemon.stop, daemon.pause))
            with report_compilation("kernels of the scene"):
                daemon.servo.compile()
            daemon.start()
            client = stack.enter_context(Client(daemon.publisher.endpoint, daemon.commands_endpoint))
            log.info("telemetry on %s, commands on %s", daemon.publisher.endpoint, daemon.commands_endpoint)
            polls = list[Callable[[], None]]()
            if running.view:
                log_options = [] if log.isEnabledFor(logging.INFO) else ["-q"]
                endpoints = daemon.publisher.endpoint, daemon.commands_endpoint
                page = PageProcess(*endpoints, log_options, daemon.publish_page_exit, Role.PARTICIPANT)
                stack.callback(page.close)
                polls.append(page.supervise)
            haptics = Haptics(
                client, self.file, self._scene, lambda: _poll(daemon.wait, polls),
                lambda changed: daemon.replace(rig=load_rig(rig, {**values, **changed})),
                daemon.recordings.last_written_tick,
            )  # fmt: skip
            yield haptics, client.describe()

    def _scene(self, name: str) -> str | Path:
        return files.resolve_source(self._folder, name)


def _begin_run(
    session: Session,
    stack: ExitStack,
    journal: Journal | None,
    participant_folder: Folder,
    run_files: Mapping[str, Any],
    dry_run: bool,
) -> tuple[Journal, int]:
    """Append a start to the journal; return the journal and the number of the start.

    run_files  additional files of the start, by name
    """
    session.begin(participant_folder)
    number = participant_folder.next_run()
    if journal is None:
        journal = stack.enter_context(Journal(participant_folder.journal))
    for name, values in run_files.items():
        participant_folder.write_json(participant_folder.name(number, name), values)
    journal.write("started", run=number, dry_run=dry_run, time=time.time())
    return journal, number


def results(folder: str | Path) -> list[Entry]:
    """Return all answered trials of an experiment's folder, one row each, from its journals."""
    return load(Path(folder))[1]


def run_doctor(rig: str) -> Any:
    """Run `softfinger doctor` in a separate process; return its report on this machine, or its failure."""
    command = [sys.executable, "-m", "softfinger.server.cli", "doctor", "--json", "--seconds", "1", "--rig", rig]
    try:
        with progress("checking the machine"):
            process = subprocess.run(command, capture_output=True, timeout=DOCTOR_TIMEOUT_S, check=False)
        return msgspec.json.decode(process.stdout)
    except (subprocess.TimeoutExpired, msgspec.DecodeError) as error:
        return {"failed": str(error)}


@contextmanager
def record_ticks(haptics: Haptics, file: str) -> Iterator[None]:
    """Record all ticks and markers during the block, in a file of the rig's recording folder."""
    haptics.client.record_start(file)
    try:
        yield
    finally:
        try:
            haptics.release()
        finally:
            haptics.client.record_stop()


def _poll(ended: Callable[[float], bool], polls: Iterable[Callable[[], None]]) -> None:
    """Poll the viewer; raise the error that ended the daemon, or Stopped."""
    for poll in polls:
        poll()
    if ended(EXIT_WAIT_S):
        raise Stopped("stopped; the same command continues at this trial")


def _check_participant(participant: int) -> int:
    if type(participant) is not int or not 1 <= participant <= PARTICIPANT_MAX:
        raise ConfigError(f"participant = {shown(participant)}: must be an integer from 1 to {PARTICIPANT_MAX}")
    return participant
