"""Options of the verbs in this folder."""

from __future__ import annotations

import argparse


def configure_experiment(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Run the trials of one participant in their order, starting at the first one without an answer. After a crash "
        "or Ctrl-C the same command continues the session."
    )
    parser.add_argument("file", metavar="FILE", help="experiment file or the name of a shipped one")
    parser.add_argument("--out", metavar="FOLDER", help="folder for all participants (default: name of the experiment)")
    parser.add_argument(
        "--participant",
        type=int,
        default=1,
        metavar="N",
        help="number of the participant, from 1 (default: %(default)s)",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="let a simulated observer answer and a simulated hand move"
    )
    parser.add_argument("--no-daemon", action="store_true", help="with --dry-run: skip the rendering")
    parser.add_argument("--no-doctor", action="store_true", help="skip the check of the machine")
    parser.add_argument("--view", action="store_true", help="open a browser page for the participant")
    parser.add_argument("--rig", metavar="RIG", help="rig that replaces the experiment's")
    parser.add_argument("--endpoint", metavar="URL", help="endpoint for telemetry")
    parser.add_argument("--commands", metavar="URL", help="endpoint for commands")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a key of the file; repeatable"
    )


def configure_figure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Fit the answers of an experiment and write figures (PNG, SVG) and numbers (CSV, JSON). Existing figures are "
        "replaced."
    )
    parser.add_argument("folder", metavar="FOLDER", help="folder written by `softfinger experiment`")
    parser.add_argument("--out", metavar="FOLDER", help="output folder (default: FOLDER/figures)")
    parser.add_argument("--report", action="store_true", help="also write report.html, a page with all results")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
