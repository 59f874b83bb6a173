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
from softfinger.server.experiment.answers import DryRun, Person
from softfinger.server.experiment.design import Condition, conditions
from softfinger.server.experiment.folder import Folder, load, trials_in
from softfinger.server.experiment.haptics import Haptics
from softfinger.server.experiment.journal import Entry, Journal, Memory
from softfinger.server.experiment.masses import scene_with
from softfinger.server.experiment.session import Nothing, Session, Stopped
from softfinger.server.viewer.door.process import Shown
from softfinger.server.viewer.roles import Role

log: Final = logging.getLogger(__name__)

PARTICIPANT_MAX: Final = 9999
DOCTOR_S: Final = 120.0
FIRST_TICK_S: Final = 30.0
ENDED_S: Final = 0.0


class Running(NamedTuple):
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
        journal = Memory()
        Session(self.file, _checked(participant)).run(journal, Nothing(), DryRun(self.file, participant))
        return [entry for entry in journal.entries if entry["kind"] == "done"]

    def run(self, folder: str | Path, participant: int, running: Running = Running()) -> list[Entry]:  # noqa: B008
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
        own = Folder(Path(folder), self.file, _checked(participant), files.hashes(self.file, self._folder))
        session = Session(self.file, participant, log.debug if running.no_daemon else log.info)
        session.check(own)
        own.check_same(running.dry_run)
        with ExitStack() as opened:
            # Lock an existing journal before the device is opened: another session may be using both.
            journal = opened.enter_context(Journal(own.journal)) if own.journal.exists() else None
            if journal is None or not journal.of("finished"):
                self._go_on(session, opened, journal, own, running)
            own.tables()
            return trials_in([own.journal])

    def _go_on(
        self, session: Session, opened: ExitStack, journal: Journal | None, own: Folder, running: Running
    ) -> None:
        """Run the unanswered trials. Files are written only after the device ticks: earlier steps can fail."""
        dry = DryRun(self.file, own.participant)
        if running.no_daemon:
            journal, _ = _begun(session, opened, journal, own, {"about.json": {"daemon": False}}, True)
            session.run(journal, Nothing(), dry, own)
            return
        rig = files.beside(self._folder, self.file.rig)
        # Before the device is opened: the doctor needs access to it.
        kept = {"doctor.json": doctors_answer(str(rig))} if running.doctor else {}
        with self._rendered(own, rig, running) as (haptics, about):
            kept |= {"about.json": about}
            journal, number = _begun(session, opened, journal, own, kept, running.dry_run)
            person = None if running.dry_run else Person(self.file, haptics)
            if person is not None:
                person.instruct()
            with recorded(haptics, f"{own.label}/{own.name(number, 'ticks.mcap')}"):
                session.run(journal, haptics, person or dry, own)
            if person is not None:
                person.end()

    @contextmanager
    def _rendered(self, own: Folder, rig: str | Path, running: Running) -> Iterator[tuple[Haptics, dict[str, Any]]]:
        """Start a daemon with rig and scene of the experiment; yield its `Haptics` and its description."""
        from softfinger.server.app import Daemon
        from softfinger.server.remote import Client

        values = {"recording.directory": str(own.root.absolute()), **running.rig}
        of_rig, of_scene = rigs.split(self.file.overrides, "overrides")
        scene = scene_with(self._scene(self.file.scene), of_scene, "overrides")
        with ExitStack() as opened:
            daemon = opened.enter_context(
                Daemon(load_rig(rig, values | of_rig), scene, scene_name=Path(self.file.scene).stem[:64])
            )
            if daemon.commands_endpoint is None:
                raise ConfigError(
                    f"{rig}: takes no commands, and an experiment needs them: leave commands.endpoint out"
                )
            for where, name, parameters in files.ends(self.file):
                rig_there, scene_there = rigs.split(parameters, where)
                there = scene_with(self._scene(name), scene_there, where)
                try:
                    daemon.rendering.check(there, load_rig(rig, values | rig_there))
                except ConfigError as error:
                    raise ConfigError(f"{where}: {error}") from error
            asked = ((where, parameters) for where, _, parameters in files.ends(self.file))
            rigs.check_rated(asked, [device.info for device in daemon.devices])
            opened.enter_context(signals.asked(daemon.stop, daemon.pause))
            daemon.start()
            client = opened.enter_context(Client(daemon.publisher.endpoint, daemon.commands_endpoint))
            log.info("telemetry on %s, commands on %s", daemon.publisher.endpoint, daemon.commands_endpoint)
            looks = list[Callable[[], None]]()
            if running.view:
                loudness = [] if log.isEnabledFor(logging.INFO) else ["-q"]
                ends = daemon.publisher.endpoint, daemon.commands_endpoint
                page = Shown(*ends, loudness, daemon.page_ended, Role.PARTICIPANT)
                opened.callback(page.close)
                looks.append(page.look)
            haptics = Haptics(
                client, self.file, self._scene, lambda: _check(daemon.wait, looks),
                lambda changed: daemon.replace(rig=load_rig(rig, {**values, **changed})),
                daemon.recordings.last_written_tick,
            )  # fmt: skip
            yield haptics, client.describe()

    def _scene(self, name: str) -> str | Path:
        return files.beside(self._folder, name)


def _begun(
    session: Session, opened: ExitStack, journal: Journal | None, own: Folder, kept: Mapping[str, Any], dry_run: bool
) -> tuple[Journal, int]:
    """Append a start to the journal; return the journal and the number of the start.

    kept  additional files of the start, by name
    """
    session.begin(own)
    number = own.run()
    if journal is None:
        journal = opened.enter_context(Journal(own.journal))
    for name, values in kept.items():
        own.keep(own.name(number, name), values)
    journal.write("started", run=number, dry_run=dry_run, time=time.time())
    return journal, number


def results(folder: str | Path) -> list[Entry]:
    """Return all answered trials of an experiment's folder, one row each, from its journals."""
    return load(Path(folder))[1]


def doctors_answer(rig: str) -> Any:
    """Run `softfinger doctor` in a separate process; return its report on this machine, or its failure."""
    words = [sys.executable, "-m", "softfinger.server.cli", "doctor", "--json", "--seconds", "1", "--rig", rig]
    try:
        said = subprocess.run(words, capture_output=True, timeout=DOCTOR_S, check=False)
        return msgspec.json.decode(said.stdout)
    except (subprocess.TimeoutExpired, msgspec.DecodeError) as error:
        return {"failed": str(error)}


@contextmanager
def recorded(haptics: Haptics, file: str) -> Iterator[None]:
    """Record all ticks and markers during the block, in a file of the rig's recording folder."""
    haptics.client.record_start(file)
    try:
        yield
    finally:
        try:
            haptics.release()
        finally:
            haptics.client.record_stop()


def _check(ended: Callable[[float], bool], looks: Iterable[Callable[[], None]]) -> None:
    """Poll the viewer; raise the error that ended the daemon, or Stopped."""
    for look in looks:
        look()
    if ended(ENDED_S):
        raise Stopped("stopped; the same command goes on at this trial")


def _checked(participant: int) -> int:
    if type(participant) is not int or not 1 <= participant <= PARTICIPANT_MAX:
        raise ConfigError(f"participant = {shown(participant)}: must be a whole number from 1 to {PARTICIPANT_MAX}")
    return participant
