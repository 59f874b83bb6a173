"""Options of the verbs in this folder."""

from __future__ import annotations

import argparse


def configure_experiment(parser: argparse.ArgumentParser) -> None:
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


def configure_figure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Fit the answers of an experiment's folder and draw them as PNG and SVG, with the numbers as CSV and JSON. "
        "Earlier figures are replaced."
    )
    parser.add_argument("folder", metavar="FOLDER", help="folder written by `softfinger experiment`")
    parser.add_argument("--out", metavar="FOLDER", help="where figures go (default: FOLDER/figures)")
    parser.add_argument("--report", action="store_true", help="also write report.html, a page with all results")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
