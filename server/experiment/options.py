"""Options of the verbs in this folder."""

from __future__ import annotations

from softfinger.server.arguments import Parser


def configure_experiment(parser: Parser) -> None:
    parser.description = (
        "Run the trials of one participant in their order, starting at the first one without an answer. After a crash "
        "or Ctrl-C the same command continues the session."
    )
    parser.argument("file", "FILE", "experiment file or the name of a shipped one")
    parser.argument("--out", "FOLDER", "folder for all participants (default: name of the experiment)")
    parser.argument("--participant", "N", "number of the participant, from 1", type=int, default=1)
    parser.flag("--dry-run", "let a simulated observer answer and a simulated hand move")
    parser.flag("--no-daemon", "with --dry-run: skip the rendering")
    parser.flag("--no-doctor", "skip the check of the machine")
    parser.flag("--view", "open a browser page for the participant")
    parser.argument("--rig", "RIG", "rig that replaces the experiment's")
    parser.argument("--endpoint", "URL", "endpoint for telemetry")
    parser.argument("--commands", "URL", "endpoint for commands")
    parser.argument("--set", "KEY=VALUE", "override a key of the file; repeatable", action="append", default=[])


def configure_figure(parser: Parser) -> None:
    parser.description = (
        "Fit the answers of an experiment and write figures (PNG, SVG) and numbers (CSV, JSON). Existing figures are "
        "replaced."
    )
    parser.argument("folder", "FOLDER", "folder written by `softfinger experiment`")
    parser.argument("--out", "FOLDER", "output folder (default: FOLDER/figures)")
    parser.flag("--report", "also write report.html, a page with all results")
    parser.flag("--json", "print the numbers as JSON")
