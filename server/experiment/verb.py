"""`softfinger experiment`: run an experiment with a participant, or with the simulated observer."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.server import signals
from softfinger.server.arguments import parse_parameter
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.session import Stopped
from softfinger.server.viewer.door.process import check_viewer

log: Final = logging.getLogger(__name__)


def run(args: argparse.Namespace) -> int:
    """Run the session; return 0, or the exit code of a stop by a signal."""
    if args.no_daemon and not args.dry_run:
        raise ConfigError("--no-daemon: only the simulated observer works without a daemon: add --dry-run")
    if args.view:
        check_viewer()
    changes: dict[str, Any] = dict(map(parse_parameter, args.set)) | ({"rig": args.rig} if args.rig else {})
    experiment = Experiment(args.file, changes)
    folder = Path(args.out or Path(args.file).stem)
    rig = {"telemetry.endpoint": args.endpoint, "commands.endpoint": args.commands}
    rig = {key: value for key, value in rig.items() if value is not None}
    running = RunOptions(args.dry_run, args.no_daemon, not args.no_doctor, args.view, rig)
    try:
        rows = experiment.run(folder, args.participant, running)
    except Stopped as stopped:
        log.info("%s", stopped)
        return signals.stop_exit_code()
    print(f"{len(rows)} trials of participant {args.participant} in {folder}; to see them: softfinger figure {folder}")
    return 0
