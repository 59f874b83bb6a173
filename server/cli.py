"""Command line: one program with verbs; the options and the module of a verb are imported when it is used.

Exit codes: 0 done or stopped in order, 1 a defect in this program, 2 a bad command line or configuration,
3 a recording that cannot be used, 4 a device, 5 real-time settings refused, 6 a safety stop, 7 an address
in use, 8 a message that breaks the protocol, 9 no telemetry or no answer arrived, 10 `doctor` found something bad,
11 the system has no files, memory or disk left, 12 the daemon refused a command, 13 a replay gives other forces than
were recorded, 128 and the number of a signal that ended it: 130 Ctrl-C, 143 SIGTERM.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import os
import signal
import sys
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from softfinger.config.errors import Exhausted, HapticError
from softfinger.server import signals

if TYPE_CHECKING:  # before `main` installs its handlers, Ctrl-C during an import ends with a traceback
    import argparse
    import logging

    from softfinger.server.arguments import Parser

DESCRIPTORS_MIN: Final = 64
"""File descriptors needed to load a compiler, open a device and publish; ZeroMQ aborts if it gets none."""


class Verb(NamedTuple):
    """Module with `run(args) -> exit code`, and the help text of the verb.

    `options.py` in the folder of the module defines `configure_<verb>(parser)`; it imports neither numpy nor numba.
    """

    module: str
    help: str


VERBS: Final = {
    "run": Verb("softfinger.server.verbs.run", "the daemon: device, contact, telemetry"),
    "simulate": Verb("softfinger.server.verbs.simulate", "the same step offline, over recorded poses"),
    "monitor": Verb("softfinger.server.verbs.monitor", "live dashboard of a running daemon"),
    "view": Verb("softfinger.server.verbs.view", "a page in the browser: the picture, and a mouse for a hand"),
    "record": Verb("softfinger.server.verbs.record", "a running daemon into a file: everything, or the poses"),
    "info": Verb("softfinger.server.recording.verbs.info", "content of a recording"),
    "export": Verb("softfinger.server.recording.verbs.export", "a recording as CSV, Parquet or npz"),
    "import": Verb("softfinger.server.recording.verbs.tables", "poses of another program, from any table of numbers"),
    "replay": Verb("softfinger.server.recording.verbs.replay", "a recording as a test: its poses through today's code"),
    "ctl": Verb("softfinger.server.verbs.ctl", "command a running daemon: parameters, scene, force, marks"),
    "forward": Verb(
        "softfinger.server.gateway.verbs.forward", "telemetry to other machines, by key, and to more subscribers"
    ),
    "bridge": Verb("softfinger.server.bridges.verb", "a daemon or a recording in Foxglove or Rerun"),
    "keys": Verb("softfinger.server.gateway.verbs.keys", "CURVE keys, by which daemon and clients know each other"),
    "devices": Verb("softfinger.tools.devices", "attached devices, and why one cannot be opened"),
    "doctor": Verb("softfinger.tools.doctor.verb", "is this machine good enough; a report of an attached device"),
    "report": Verb("softfinger.tools.report", "archive for an issue: black boxes, log, doctor, rig, scene"),
    "scenes": Verb("softfinger.server.verbs.shipped", "the scenes that are shipped, a line each"),
    "rigs": Verb("softfinger.server.verbs.shipped", "the rigs that are shipped, a line each"),
    "recordings": Verb("softfinger.server.verbs.shipped", "the recordings that are shipped, a line each"),
    "faults": Verb("softfinger.server.verbs.shipped", "the faults that are shipped for `run --inject`, a line each"),
    "experiments": Verb("softfinger.server.verbs.shipped", "the experiments that are shipped, a line each"),
    "materials": Verb(
        "softfinger.server.verbs.materials", "the materials and fingertips that are shipped, with sources"
    ),
    "experiment": Verb("softfinger.server.experiment.verb", "an experiment: trials, answers, a folder of results"),
    "figure": Verb("softfinger.server.experiment.figure_verb", "an experiment's folder as figures and numbers"),
    "check": Verb("softfinger.server.verbs.check", "validate rig and scene files"),
    "schema": Verb("softfinger.server.verbs.schema", "JSON Schema of rigs and scenes, schema of the telemetry"),
    "install": Verb("softfinger.server.install.verb", "udev rules, limits, service, man page, completion; and back"),
    "warmup": Verb("softfinger.server.verbs.warmup", "compile the kernels ahead"),
    "accuracy": Verb("softfinger.tools.accuracy.verb", "measure: rolling methods, speed against accuracy"),
    "stability": Verb("softfinger.tools.stability.verb", "measure: the stiffest stable wall, in closed loop"),
    "calibrate": Verb("softfinger.tools.calibrate", "measure: a Falcon's motor counts per N m, with a known weight"),
    "bench": Verb("softfinger.tools.bench.options", "measure: cost per step, wake-up lateness, telemetry latency"),
}
"""All verbs. Verbs of `tools` are named, not imported: the server does not depend on the tools."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    if argv is None:
        set_up_process()
    open_streams()
    with signals.handle_signals(ignore_after=argv is None):
        try:
            code = run_verb(sys.argv[1:] if argv is None else argv)
            sys.stdout.flush()
            return code
        except HapticError as error:
            return report_failure(str(error), error.exit_code)
        except signals.Interrupted as error:
            code = report_failure(f"ended by {signals.signal_name(error.number)}", signals.exit_code(error.number))
            if argv is None:  # all is closed; freeing an unfinished compilation would take seconds
                flush_or_discard(sys.stdout)
                os._exit(code)
            return code
        except KeyboardInterrupt:
            return signals.exit_code(signal.SIGINT)
        except BrokenPipeError:
            # The reader of stdout has closed the pipe (`| head`): this is no error, nor while closing.
            discard(sys.stdout)
            return 0
        except (OSError, MemoryError) as error:
            if {"-v", "--verbose"} & set(sys.argv):
                raise
            discard(sys.stdout)  # Python would retry the failed write at exit
            return report_failure(reason(error), Exhausted.exit_code)
        finally:
            flush_or_discard(sys.stdout)
            flush_or_discard(sys.stderr)


def run_verb(words: list[str]) -> int:
    """Parse the command line, run its verb and return the exit code."""
    import logging

    from softfinger.proxy import progress as preparation
    from softfinger.server import progress

    check_descriptors()
    args = make_parser().parse_args(words)
    logging.basicConfig(
        level=logging.DEBUG if args.verbose else logging.WARNING if args.quiet else logging.INFO,
        format="%(message)s" if sys.stderr.isatty() else "%(levelname)s %(message)s",
        handlers=[to_stderr()],
    )
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it reports its font cache
    progress.set_enabled(not args.quiet)
    preparation.display = progress.progress
    run = importlib.import_module(VERBS[args.verb].module).run
    signals.mark_imported()
    if not gc.isenabled():  # imported objects are never garbage: exclude them from collections
        gc.freeze()
        gc.enable()
    code: int = run(args)
    return code


def set_up_process() -> None:
    """Set up the process for a fast start, before large imports; `run_verb` enables the garbage collector again."""
    gc.disable()  # imports create no garbage, and each collection would scan their objects
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # no matrix here is large enough for two threads
    if isinstance(sys.stdout, io.TextIOWrapper):  # names in a scene may have characters that the terminal cannot encode
        sys.stdout.reconfigure(errors="backslashreplace")


def to_stderr() -> logging.Handler:
    """Return a log handler that always writes to the current `sys.stderr`, which a progress line replaces."""
    import logging

    class ToStderr(logging.StreamHandler[Any]):
        @property
        def stream(self) -> Any:
            return sys.stderr

        @stream.setter
        def stream(self, _: Any) -> None:
            pass

    return ToStderr()


def report_failure(message: str, code: int) -> int:
    """Print the error that stops the program; return `code`."""
    with contextlib.suppress(OSError):  # standard error may be closed, too
        print(f"softfinger: {message}", file=sys.stderr, flush=True)
    return code


def reason(error: OSError | MemoryError) -> str:
    """Return a message with the error of the system and a hint."""
    reason = "out of memory"
    if isinstance(error, OSError):
        reason = f"{error.strerror or error}" + (f": {error.filename}" if error.filename else "")
    return f"the system refused: {reason} (with --verbose: where)"


def open_streams() -> None:
    """Replace closed standard streams (`>&-`) by the null device; otherwise a device would get their numbers."""
    for fd, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(fd)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if fd else "r"))  # noqa: SIM115 - open until the process exits


def flush_or_discard(stream: Any) -> None:
    """Flush a stream before Python exits; discard its data if it is closed, because Python would exit with code 120."""
    try:
        stream.flush()
    except OSError:
        discard(stream)


def discard(stream: Any) -> None:
    """Redirect a stream to the null device, which discards its buffered data."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


def check_descriptors() -> None:
    """Raise the limit of open files to DESCRIPTORS_MIN if needed; raises Exhausted if that is not allowed."""
    try:
        import resource
    except ImportError:  # Windows
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < DESCRIPTORS_MIN and (hard < 0 or hard > soft):
        soft = DESCRIPTORS_MIN if hard < 0 else min(hard, DESCRIPTORS_MIN)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if 0 <= soft < DESCRIPTORS_MIN:
        raise Exhausted(f"this process may open {soft} files, and needs {DESCRIPTORS_MIN}: raise `ulimit -n`")


def make_parser() -> Parser:
    """Return the parser; its `complete` adds the options of all verbs, which are otherwise added when one is used."""
    from importlib.metadata import version

    from softfinger.server.arguments import Parser

    parser = Parser(
        prog="softfinger",
        description="Real-time haptic rendering: soft-finger contact with rolling and torsion.",
        epilog=(__doc__ or "").partition("\n\n")[2],
    )
    parser.add_argument("--version", action="version", version=f"softfinger {version('softfinger')}")
    parser.set_defaults(verbose=False, quiet=False)
    add_completion(parser)
    commands = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, verb in VERBS.items():
        description = f"softfinger {name}: {verb.help}."
        commands.add_parser(name, help=verb.help, description=description, configure=partial(add_options, name))
    return parser


def add_options(verb: str, parser: Parser) -> None:
    """Add the options of a verb to its parser."""
    folder = VERBS[verb].module.rpartition(".")[0]
    getattr(importlib.import_module(f"{folder}.options"), f"configure_{verb}")(parser)


def add_completion(parser: argparse.ArgumentParser) -> None:
    """Add `--print-completion SHELL`, which prints the completion script for the options of all verbs."""
    import argparse

    class Print(argparse.Action):
        def __call__(self, *_: object) -> None:
            print(completion(str(_[2])))
            raise SystemExit(0)

    parser.add_argument(
        "--print-completion", action=Print, choices=["bash", "zsh", "tcsh"], help="print a completion script"
    )


def completion(shell: str) -> str:
    """Return the completion script for bash, zsh or tcsh."""
    import shtab

    from softfinger.server.verbs.shipped import offer_names

    script: str = shtab.complete(offer_names(make_parser().complete()), shell)
    return script


if __name__ == "__main__":
    sys.exit(main())
