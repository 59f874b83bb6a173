"""Command line: one program with verbs; the options and the module of a verb are imported when it is used.

Exit codes: 0 success or normal stop, 1 internal error, 2 invalid command line or configuration, 3 unusable recording,
4 device error, 5 real-time settings refused, 6 safety stop, 7 address in use, 8 malformed message, 9 no telemetry or no
answer, 10 `doctor` found a problem, 11 out of file descriptors, memory or disk space, 12 command refused by the daemon,
13 replayed forces differ from the recorded ones, 128 + N ended by signal N (130 Ctrl-C, 143 SIGTERM).
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
from softfinger.server import signals, standard_error

if TYPE_CHECKING:  # before `main` installs its handlers, Ctrl-C during an import ends with a traceback
    import argparse
    import logging

    from softfinger.server.arguments import Parser

NO_THREAD: Final = "can't start new thread"
"""Python's message at a limit of processes or of memory."""
NO_MAPPING: Final = "failed to map segment from shared object"
"""The system's message for an extension module at a limit of memory."""
DESCRIPTORS_MIN: Final = 64
"""File descriptors needed to load a compiler, open a device and publish; ZeroMQ aborts if it gets none."""


class Verb(NamedTuple):
    """Module of softfinger with `run(args) -> exit code`, or `run_<verb>` if it has several, and the verb's help text.

    `configure_<verb>(parser)` is in `options.py` of `server/verbs` or `tools/bench` for modules there, otherwise of
    `server` or `tools`. These files import neither numpy nor numba.
    """

    module: str
    help: str


VERBS: Final = {
    "run": Verb("server.verbs.run", "run the daemon: read a device, render contact, publish telemetry"),
    "simulate": Verb("server.verbs.simulate", "run the contact step offline on recorded poses or a simulated device"),
    "monitor": Verb("server.verbs.monitor", "show a live dashboard of a running daemon"),
    "view": Verb("server.verbs.view", "open a browser page of a daemon or a recording; the mouse can move the hand"),
    "record": Verb("server.verbs.record", "record a running daemon to a file: all telemetry, or only poses"),
    "info": Verb("server.recording.verb", "summarise a recording"),
    "export": Verb("server.recording.verb", "convert a recording to CSV, Parquet or npz"),
    "import": Verb("server.recording.verb", "convert a table of poses from another program"),
    "replay": Verb("server.recording.replay", "recompute the forces of a recording and compare them"),
    "ctl": Verb("server.verbs.ctl", "send a command to a running daemon: parameters, scene, force, marks"),
    "forward": Verb("server.gateway.verb", "forward telemetry and commands to other machines, with encryption"),
    "bridge": Verb("server.bridges.verb", "show a daemon or a recording in Foxglove or Rerun"),
    "keys": Verb("server.gateway.verb", "create CURVE key pairs for daemons and clients"),
    "devices": Verb("tools.devices", "list attached devices and the reasons why one cannot be opened"),
    "doctor": Verb("tools.doctor.verb", "check this machine, or write a report on an attached device"),
    "report": Verb("tools.report", "write an archive for a bug report"),
    "scenes": Verb("server.verbs.shipped", "list the shipped scenes"),
    "rigs": Verb("server.verbs.shipped", "list the shipped rigs"),
    "recordings": Verb("server.verbs.shipped", "list the shipped recordings"),
    "faults": Verb("server.verbs.shipped", "list the shipped faults for `run --inject`"),
    "experiments": Verb("server.verbs.shipped", "list the shipped experiments"),
    "materials": Verb("server.verbs.materials", "list the shipped materials and fingertips with their sources"),
    "experiment": Verb("server.experiment.verb", "run an experiment: trials, answers, a folder of results"),
    "figure": Verb("server.experiment.verb", "fit and plot the results of an experiment"),
    "check": Verb("server.verbs.check", "validate scene, rig and experiment files"),
    "schema": Verb("server.verbs.schema", "print the JSON Schema of the file formats and of telemetry"),
    "install": Verb("server.install.verb", "install or remove udev rules, limits, service, man page and completion"),
    "warmup": Verb("server.verbs.warmup", "compile the kernels in advance"),
    "accuracy": Verb("tools.accuracy.verb", "measure the accuracy and speed of the rolling methods"),
    "stability": Verb("tools.stability.verb", "measure the stiffest stable wall in closed loop"),
    "calibrate": Verb("tools.calibrate", "calibrate a Falcon's motor counts per N m with a known weight"),
    "bench": Verb("tools.bench.options", "measure cost per step, wake-up lateness and telemetry latency"),
}
"""All verbs. Verbs of `tools` are named, not imported: the server does not depend on the tools."""


def main(argv: list[str] | None = None) -> int:
    if argv is None:
        set_up_process()
    open_streams()
    with contextlib.ExitStack() as handling:
        try:
            handling.enter_context(signals.handle_signals(ignore_after=argv is None))
            code = run_verb(sys.argv[1:] if argv is None else argv)
            sys.stdout.flush()
            return code
        except HapticError as error:
            return report_failure(str(error), error.exit_code)
        except signals.Interrupted as error:
            code = report_failure(
                f"ended by {signals.name_signal(error.number)}", signals.compute_exit_code(error.number)
            )
            if argv is None:  # all is closed; freeing an unfinished compilation would take seconds
                flush_or_discard(sys.stdout)
                os._exit(code)
            return code
        except KeyboardInterrupt:
            return signals.compute_exit_code(signal.SIGINT)
        except BrokenPipeError:
            # The reader of stdout has closed the pipe (`| head`): this is not an error, nor while closing.
            discard(sys.stdout)
            return 0
        except (OSError, MemoryError, RuntimeError, ImportError) as error:
            if isinstance(error, RuntimeError | ImportError) and not str(error).endswith((NO_THREAD, NO_MAPPING)):
                raise
            if {"-v", "--verbose"} & set(sys.argv):
                raise
            discard(sys.stdout)  # Python would retry the failed write at exit
            return report_failure(format_reason(error), Exhausted.exit_code)
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
    preparation.display = progress.show_progress
    module = importlib.import_module(f"softfinger.{VERBS[args.verb].module}")
    run = getattr(module, f"run_{args.verb}", None) or module.run
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
    """Return a log handler that writes to the current `sys.stderr`, which a progress line replaces; it never waits."""
    import logging

    class ToStderr(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            try:
                for line in self.format(record).splitlines():  # a writable pipe has room for a line
                    standard_error.write_line(line)
            except Exception:
                self.handleError(record)

    return ToStderr()


def report_failure(message: str, code: int) -> int:
    with contextlib.suppress(OSError):  # standard error may be closed, too
        standard_error.write_line(f"softfinger: {message}", standard_error.LAST_WAIT_S)
    return code


def format_reason(error: OSError | MemoryError | RuntimeError | ImportError) -> str:
    reason = "no thread can be started" if isinstance(error, RuntimeError) else "out of memory"
    if isinstance(error, FileNotFoundError) and error.filename is None:  # of os.getcwd
        reason = "the current folder was removed: change to another one"
    elif isinstance(error, OSError):
        reason = f"{error.strerror or error}" + (f": {error.filename}" if error.filename else "")
    return f"the system refused: {reason} (--verbose shows where)"


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
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < DESCRIPTORS_MIN and (hard < 0 or hard > soft):
        soft = DESCRIPTORS_MIN if hard < 0 else min(hard, DESCRIPTORS_MIN)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if 0 <= soft < DESCRIPTORS_MIN:
        raise Exhausted(f"this process may open {soft} files, but needs {DESCRIPTORS_MIN}: raise `ulimit -n`")


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
        description = f"{verb.help[0].upper()}{verb.help[1:]}."
        commands.add_parser(name, help=verb.help, description=description, configure=partial(add_options, name))
    return parser


def add_options(verb: str, parser: Parser) -> None:
    folder = VERBS[verb].module.rpartition(".")[0]
    if folder not in ("server.verbs", "tools.bench"):
        folder = folder.partition(".")[0]
    getattr(importlib.import_module(f"softfinger.{folder}.options"), f"configure_{verb}")(parser)


def add_completion(parser: argparse.ArgumentParser) -> None:
    """Add `--print-completion SHELL`, which prints the completion script for the options of all verbs."""
    import argparse

    class Print(argparse.Action):
        def __call__(self, *_: object) -> None:
            print(format_completion(str(_[2])))
            raise SystemExit(0)

    parser.add_argument(
        "--print-completion", action=Print, choices=["bash", "zsh", "tcsh"], help="print a completion script"
    )


def format_completion(shell: str) -> str:
    import shtab

    from softfinger.server.verbs.shipped import offer_names

    script: str = shtab.complete(offer_names(make_parser().complete()), shell)
    return script


if __name__ == "__main__":
    sys.exit(main())
