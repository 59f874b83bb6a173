"""The command line: one program, a verb each, imported when it is asked for.

Exit codes: 0 done or stopped in order, 1 a defect in this program, 2 a bad command line or configuration,
3 a recording that cannot be used, 4 a device, 5 real-time settings refused, 6 a safety stop, 7 an address
in use, 8 a message that breaks the protocol, 9 no telemetry arrived, 10 `doctor` found something bad.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
from importlib.metadata import version
from typing import Final, NamedTuple

from softfinger.config.errors import HapticError


class Verb(NamedTuple):
    """Module with `configure(parser)` and `run(args) -> exit code`, and what the verb does."""

    module: str
    help: str


VERBS: Final = {
    "run": Verb("softfinger.server.run", "the daemon: device, contact, telemetry"),
    "simulate": Verb("softfinger.server.simulate", "the same step offline, over recorded poses"),
    "monitor": Verb("softfinger.server.monitor", "live dashboard of a running daemon"),
    "record": Verb("softfinger.server.record", "poses of a running daemon, for replay"),
    "devices": Verb("softfinger.server.devices", "what is attached, and why it cannot be opened"),
    "doctor": Verb("softfinger.tools.doctor.verb", "is this machine good enough; a report of an attached device"),
    "check": Verb("softfinger.server.check", "validate rig and scene files"),
    "schema": Verb("softfinger.server.schema_verb", "JSON Schema of rigs and scenes, schema of the telemetry"),
    "warmup": Verb("softfinger.server.warmup", "compile the kernels ahead"),
    "accuracy": Verb("softfinger.tools.accuracy.verb", "measure: rolling methods, speed against accuracy"),
    "stability": Verb("softfinger.tools.stability.verb", "measure: the stiffest stable wall, in closed loop"),
    "calibrate": Verb("softfinger.tools.calibrate", "measure: a Falcon's motor counts per N m, with a known weight"),
    "bench": Verb("softfinger.tools.bench.verb", "measure: cost per step, wake-up lateness, telemetry latency"),
}
"""Every verb. A verb of `tools` is named, not imported: the server does not depend on the tools."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = sys.argv[1:] if argv is None else argv
    # Only the verb that was asked for is imported: another verb's plotting library must not delay the first tick.
    parser = make_parser([word for word in words if word in VERBS][:1])
    args = parser.parse_args(words)
    logging.basicConfig(
        level=logging.DEBUG if args.verbose else logging.INFO,
        format="%(message)s" if sys.stderr.isatty() else "%(levelname)s %(message)s",
        stream=sys.stderr,
    )
    try:
        code: int = args.run(args)
        sys.stdout.flush()
        return code
    except HapticError as error:
        print(f"softfinger: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader of our output has left (`| head`): no complaint, and none while closing either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def make_parser(verbs: list[str] | None = None) -> argparse.ArgumentParser:
    """The parser, with the options of the named verbs, or of all."""
    parser = argparse.ArgumentParser(
        prog="softfinger",
        description="Real-time haptic rendering: soft-finger contact with rolling and torsion.",
        epilog=(__doc__ or "").partition("\n\n")[2],
    )
    parser.add_argument("--version", action="version", version=f"softfinger {version('softfinger')}")
    parser.add_argument("--verbose", action="store_true", help="log more")
    add_completion(parser)
    commands = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, verb in VERBS.items():
        command = commands.add_parser(name, help=verb.help, description=f"softfinger {name}: {verb.help}.")
        if verbs is None or name in verbs:
            module = importlib.import_module(verb.module)
            module.configure(command)
            command.set_defaults(run=module.run)
    return parser


def add_completion(parser: argparse.ArgumentParser) -> None:
    """`--print-completion SHELL`: the completion script, made from the options of every verb."""

    class Print(argparse.Action):
        def __call__(self, *_: object) -> None:
            import shtab

            print(shtab.complete(make_parser(), str(_[2])))
            raise SystemExit(0)

    parser.add_argument(
        "--print-completion", action=Print, choices=["bash", "zsh", "tcsh"], help="print a completion script"
    )


if __name__ == "__main__":
    sys.exit(main())
