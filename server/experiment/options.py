"""Options of the verbs in this folder."""

from __future__ import annotations

from softfinger.server.arguments import Parser, add_flag, add_option


def configure_experiment(parser: Parser) -> None:
    parser.description = (
        "Run the trials of one participant in their order, starting at the first one without an answer. After a crash "
        "or Ctrl-C the same command continues the session."
    )
    add_option(parser, "file", "experiment file or the name of a shipped one", metavar="FILE")
    add_option(parser, "--out", "folder for all participants (default: name of the experiment)", metavar="FOLDER")
    add_option(parser, "--participant", "number of the participant, from 1", default=1, metavar="N")
    add_flag(parser, "--dry-run", "let a simulated observer answer and a simulated hand move")
    add_flag(parser, "--no-daemon", "with --dry-run: skip the rendering")
    add_flag(parser, "--no-doctor", "skip the check of the machine")
    add_flag(parser, "--view", "open a browser page for the participant")
    add_option(parser, "--rig", "rig that replaces the experiment's", metavar="RIG")
    add_option(parser, "--endpoint", "endpoint for telemetry", metavar="URL")
    add_option(parser, "--commands", "endpoint for commands", metavar="URL")
    add_option(
        parser, "--set", "override a key of the file; repeatable", default=[], metavar="KEY=VALUE", action="append"
    )


def configure_figure(parser: Parser) -> None:
    parser.description = (
        "Fit the answers of an experiment and write figures (PNG, SVG) and numbers (CSV, JSON). Existing figures are "
        "replaced."
    )
    add_option(parser, "folder", "folder written by `softfinger experiment`", metavar="FOLDER")
    add_option(parser, "--out", "output folder (default: FOLDER/figures)", metavar="FOLDER")
    add_flag(parser, "--report", "also write report.html, a page with all results")
    add_flag(parser, "--json", "print the numbers as JSON")
