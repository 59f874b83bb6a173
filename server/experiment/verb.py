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


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Run an experiment: the trials of one participant in their order, from the first one without an answer. "
        "After a crash or Ctrl-C the same command continues the session."
    )
    parser.add_argument("file", metavar="FILE", help="an experiment's .toml, or the name of a shipped one")
    parser.add_argument("--out", metavar="FOLDER", help="folder for all participants; default: the experiment's name")
    parser.add_argument("--participant", type=int, default=1, metavar="N", help="number, from 1 (default: %(default)s)")
    parser.add_argument("--dry-run", action="store_true", help="the simulated observer answers; a led hand moves")
    parser.add_argument("--no-daemon", action="store_true", help="with --dry-run: render nothing, in no time")
    parser.add_argument("--no-doctor", action="store_true", help="do not look at the machine first")
    parser.add_argument("--view", action="store_true", help="a page in the browser for the participant")
    parser.add_argument("--rig", metavar="RIG", help="in place of the experiment's")
    parser.add_argument("--endpoint", metavar="URL", help="where telemetry is published")
    parser.add_argument("--commands", metavar="URL", help="where commands are taken")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="another value for a key of the file"
    )


def run(args: argparse.Namespace) -> int:
    """Run the session; return 0, or the exit code of a stop by a signal."""
    if args.no_daemon and not args.dry_run:
        raise ConfigError("--no-daemon: only the simulated observer needs none: give --dry-run too")
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
