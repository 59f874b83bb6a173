"""Daemon of a session: rig and scene of the experiment, recording of all ticks, the participant's page."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_rig
from softfinger.server import signals
from softfinger.server.experiment.files import iter_level_extremes, resolve_source
from softfinger.server.experiment.haptics import Haptics
from softfinger.server.experiment.parameters import check_device_limits, load_changed_scene, split_rig
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.session import Stopped
from softfinger.server.progress import report_compilation, show_progress
from softfinger.server.remote import Client
from softfinger.server.viewer.door.process import PageProcess
from softfinger.server.viewer.roles import Role

log: Final = logging.getLogger(__name__)

DOCTOR_TIMEOUT_S: Final = 120.0


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


@contextmanager
def start_daemon(
    experiment: ExperimentFile, folder: Path, results: Path, running: RunOptions
) -> Iterator[tuple[Haptics, dict[str, Any]]]:
    """Start a daemon with rig and scene of an experiment; yield its `Haptics` and its description.

    folder   of the experiment's files
    results  folder of all participants, in which it records
    """
    from softfinger.server.app import Daemon

    rig, scene_of = resolve_source(folder, experiment.rig), partial(resolve_source, folder)
    values = {"recording.directory": str(results.absolute()), **running.rig}
    rig_values, scene_values = split_rig(experiment.overrides, "overrides")
    scene = load_changed_scene(scene_of(experiment.scene), scene_values, "overrides")
    with ExitStack() as stack:
        daemon = stack.enter_context(
            Daemon(load_rig(rig, values | rig_values), scene, scene_name=Path(experiment.scene).stem[:64])
        )
        if daemon.commands_endpoint is None:
            raise ConfigError(f"{rig}: accepts no commands, but an experiment needs them: remove commands.endpoint")
        for location, name, parameters in iter_level_extremes(experiment):
            condition_rig, condition_scene = split_rig(parameters, location)
            scene_at_level = load_changed_scene(scene_of(name), condition_scene, location)
            try:
                daemon.rendering.check(scene_at_level, load_rig(rig, values | condition_rig))
            except ConfigError as error:
                raise ConfigError(f"{location}: {error}") from error
        parameters_by_location = ((location, parameters) for location, _, parameters in iter_level_extremes(experiment))
        check_device_limits(parameters_by_location, [device.info for device in daemon.devices])
        stack.enter_context(signals.stop_on_signal(daemon.stop, daemon.pause, daemon.switch_file))
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
            client, experiment, scene_of, lambda: _poll(daemon.wait, polls),
            lambda changed: daemon.replace(rig=load_rig(rig, {**values, **changed})),
            daemon.recordings.last_written_tick,
        )  # fmt: skip
        yield haptics, client.describe()


def run_doctor(rig: str) -> Any:
    """Run `softfinger doctor` in a separate process; return its report on this machine, or its failure."""
    command = [sys.executable, "-m", "softfinger.server.cli", "doctor", "--json", "--seconds", "1", "--rig", rig]
    try:
        with show_progress("checking the machine"):
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
    """Call all `polls`; raise Stopped if the run was stopped, or the error that ended the daemon."""
    for poll in polls:
        poll()
    if ended(0.0):
        raise Stopped("stopped; the same command continues at this trial")
