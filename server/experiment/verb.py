"""`softfinger experiment`: run an experiment with a participant or an observer; `figure`: draw its results."""

from __future__ import annotations

import argparse
import json
import logging
import math
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.config.files import make_write_error, write_new_file
from softfinger.server import signals
from softfinger.server.arguments import parse_parameter
from softfinger.server.experiment.analysis import find_excluded_participants, fit_groups, format_fit, make_table
from softfinger.server.experiment.daemon import RunOptions
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.figures import draw, draw_session
from softfinger.server.experiment.folder import list_journals, load, read_surveys, write_csv
from softfinger.server.experiment.report import write_report
from softfinger.server.experiment.session import Stopped
from softfinger.server.experiment.surveys import compare_scores, survey_table
from softfinger.server.progress import show_progress
from softfinger.server.viewer.door.process import check_viewer

log: Final = logging.getLogger(__name__)


def run_experiment(args: argparse.Namespace) -> int:
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


def run_figure(args: argparse.Namespace) -> int:
    """Draw, print and return 0. Raises ConfigError if the folder has no answers, or errors of `make_write_error`."""
    root = Path(args.folder)
    experiment, rows = load(root)
    groups = fit_groups(experiment, rows)
    numbers = make_table(groups)
    out = Path(args.out) if args.out else root / "figures"
    journals = list_journals(root)
    answers, excluded = read_surveys(journals), find_excluded_participants(experiment, rows)
    surveys = survey_table(experiment, answers, excluded)
    text = json.dumps([replace_nan(row) for row in numbers], indent=1)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with show_progress("drawing", 2 + args.report) as update:
            paths = draw(experiment, groups, out)
            update(1)
            paths += draw_session(experiment, rows, surveys, groups, out)
            update(2)
            if args.report:
                report, compared = out / "report.html", compare_scores(experiment, answers, excluded)
                with write_new_file(report) as file:
                    file.write(write_report(experiment, rows, groups, (surveys, compared), root, paths).encode())
                paths.append(report)
        write_csv(out / "numbers.csv", numbers)
        with write_new_file(out / "numbers.json") as file:
            file.write(text.encode() + b"\n")
        if surveys:
            write_csv(out / "surveys.csv", surveys)
    except OSError as error:
        raise make_write_error(out, error, "make room, or name another folder: --out FOLDER") from error
    if args.json:
        print(text)
        return 0
    for group in groups:
        print(f"{group.participant}, {group.condition}: {format_fit(group.fit)}; {group.trials} trials")
    print(f"drawn: {', '.join(str(path) for path in paths)}")
    return 0


def replace_nan(row: dict[str, Any]) -> dict[str, Any]:
    """Replace nan by None: JSON has no nan."""
    return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}
