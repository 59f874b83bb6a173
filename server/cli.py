"""The command line: one program, a verb each, imported when it is asked for.

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
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from softfinger.config.errors import Exhausted, HapticError
from softfinger.server import signals

if TYPE_CHECKING:  # what is imported before `main` has its handlers, Ctrl-C ends with a traceback
    import argparse
    import logging

DESCRIPTORS_MIN: Final = 64
"""Files a process needs that loads a compiler, opens a device and publishes; ZeroMQ aborts when it gets none."""


class Verb(NamedTuple):
    """Module with `configure(parser)` and `run(args) -> exit code`, and what the verb does."""

    module: str
    help: str


VERBS: Final = {
    "run": Verb("softfinger.server.verbs.run", "the daemon: device, contact, telemetry"),
    "simulate": Verb("softfinger.server.verbs.simulate", "the same step offline, over recorded poses"),
    "monitor": Verb("softfinger.server.verbs.monitor", "live dashboard of a running daemon"),
    "view": Verb("softfinger.server.verbs.view", "a page in the browser: the picture, and a mouse for a hand"),
    "record": Verb("softfinger.server.verbs.record", "a running daemon into a file: everything, or the poses"),
    "info": Verb("softfinger.server.recording.verbs.info", "what is in a recording"),
    "export": Verb("softfinger.server.recording.verbs.export", "a recording as CSV, Parquet or npz"),
    "import": Verb("softfinger.server.recording.verbs.tables", "poses of another program, from any table of numbers"),
    "replay": Verb("softfinger.server.recording.verbs.replay", "a recording as a test: its poses through today's code"),
    "ctl": Verb("softfinger.server.verbs.ctl", "command a running daemon: parameters, scene, force, marks"),
    "forward": Verb(
        "softfinger.server.gateway.verbs.forward", "telemetry to other machines, by key, and to more subscribers"
    ),
    "bridge": Verb("softfinger.server.bridges.verb", "a daemon or a recording in Foxglove or Rerun"),
    "keys": Verb("softfinger.server.gateway.verbs.keys", "CURVE keys, by which daemon and clients know each other"),
    "devices": Verb("softfinger.tools.devices", "what is attached, and why it cannot be opened"),
    "doctor": Verb("softfinger.tools.doctor.verb", "is this machine good enough; a report of an attached device"),
    "report": Verb(
        "softfinger.tools.report", "what an issue needs, in an archive: black boxes, log, doctor, rig, scene"
    ),
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
    "bench": Verb("softfinger.tools.bench.verb", "measure: cost per step, wake-up lateness, telemetry latency"),
}
"""Every verb. A verb of `tools` is named, not imported: the server does not depend on the tools."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    if argv is None:
        set_up_process()
    open_streams()
    with signals.handled(to_the_end=argv is None):
        try:
            code = run_verb(sys.argv[1:] if argv is None else argv)
            sys.stdout.flush()
            return code
        except HapticError as error:
            return failed(str(error), error.exit_code)
        except signals.Interrupted as error:
            code = failed(f"ended by {signals.named(error.number)}", signals.code_of(error.number))
            if argv is None:  # everything is closed; to take a half-done compilation apart takes seconds
                flush_or_discard(sys.stdout)
                os._exit(code)
            return code
        except KeyboardInterrupt:
            return signals.code_of(signal.SIGINT)
        except BrokenPipeError:
            # The reader of our output has left (`| head`): no complaint, and none while closing either.
            discard(sys.stdout)
            return 0
        except (OSError, MemoryError) as error:
            if {"-v", "--verbose"} & set(sys.argv):
                raise
            discard(sys.stdout)  # what could not be written is not tried again while closing
            return failed(reason(error), Exhausted.exit_code)
        finally:
            flush_or_discard(sys.stdout)
            flush_or_discard(sys.stderr)


def run_verb(words: list[str]) -> int:
    """Parse the command line and run its verb; returns the exit code."""
    import logging

    from softfinger.server import progress

    check_descriptors()
    # Only the verb that was asked for is imported: another verb's plotting library must not delay the first tick.
    parser = make_parser([word for word in words if word in VERBS][:1])
    args = parser.parse_args(words)
    logging.basicConfig(
        level=logging.DEBUG if args.verbose else logging.WARNING if args.quiet else logging.INFO,
        format="%(message)s" if sys.stderr.isatty() else "%(levelname)s %(message)s",
        handlers=[to_stderr()],
    )
    progress.show(not args.quiet)
    signals.imported()
    if not gc.isenabled():  # what is imported by now stays, and is not looked through any more
        gc.freeze()
        gc.enable()
    code: int = args.run(args)
    return code


def set_up_process() -> None:
    """What makes a start shorter, before anything large is imported; `run_verb` puts the garbage collector back."""
    gc.disable()  # nothing that an import makes is garbage, and it would be looked through again and again
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # no matrix here is large enough for two
    if isinstance(sys.stdout, io.TextIOWrapper):  # names in a scene may be of letters that the terminal has not
        sys.stdout.reconfigure(errors="backslashreplace")


def to_stderr() -> logging.Handler:
    """Logs to what standard error is at the time: while a progress line is shown, that keeps clear of it."""
    import logging

    class ToStderr(logging.StreamHandler[Any]):
        @property
        def stream(self) -> Any:
            return sys.stderr

        @stream.setter
        def stream(self, _: Any) -> None:
            pass

    return ToStderr()


def failed(message: str, code: int) -> int:
    """Say what ended the program; returns `code`."""
    with contextlib.suppress(OSError):  # standard error has gone as well
        print(f"softfinger: {message}", file=sys.stderr, flush=True)
    return code


def reason(error: OSError | MemoryError) -> str:
    """What the system refused, and how to look further."""
    said = "out of memory"
    if isinstance(error, OSError):
        said = f"{error.strerror or error}" + (f": {error.filename}" if error.filename else "")
    return f"the system refused: {said} (with --verbose: where)"


def open_streams() -> None:
    """Put the null device where a standard stream was closed (`>&-`), else a device or socket would become it."""
    for fd, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(fd)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest that is free, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if fd else "r"))  # noqa: SIM115 - for as long as the process


def flush_or_discard(stream: Any) -> None:
    """Leave nothing to be written while Python ends: where nobody reads it, the exit code would be 120."""
    try:
        stream.flush()
    except OSError:
        discard(stream)


def discard(stream: Any) -> None:
    """Let what a stream still holds go nowhere."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


def check_descriptors() -> None:
    """Raise Exhausted where this process may not open the files that it needs."""
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


def make_parser(verbs: list[str] | None = None) -> argparse.ArgumentParser:
    """The parser, with the options of the named verbs, or of all."""
    from softfinger.server.arguments import Parser

    parser = Parser(
        prog="softfinger",
        description="Real-time haptic rendering: soft-finger contact with rolling and torsion.",
        epilog=(__doc__ or "").partition("\n\n")[2],
    )
    parser.set_defaults(verbose=False, quiet=False)
    add_version(parser)
    add_completion(parser)
    commands = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, verb in VERBS.items():
        command = commands.add_parser(name, help=verb.help, description=f"softfinger {name}: {verb.help}.")
        if verbs is None or name in verbs:
            module = importlib.import_module(verb.module)
            module.configure(command)
            command.set_defaults(run=module.run)
    return parser


def add_version(parser: argparse.ArgumentParser) -> None:
    """Add `--version`, which alone reads the metadata: most verbs need no import that takes as long."""
    import argparse

    class Print(argparse.Action):
        def __call__(self, *_: object) -> None:
            from importlib.metadata import version

            print(f"softfinger {version('softfinger')}")
            raise SystemExit(0)

    parser.add_argument("--version", action=Print, nargs=0, help="show program's version number and exit")


def add_completion(parser: argparse.ArgumentParser) -> None:
    """`--print-completion SHELL`: the completion script, made from the options of every verb."""
    import argparse

    class Print(argparse.Action):
        def __call__(self, *_: object) -> None:
            print(completion(str(_[2])))
            raise SystemExit(0)

    parser.add_argument(
        "--print-completion", action=Print, choices=["bash", "zsh", "tcsh"], help="print a completion script"
    )


def completion(shell: str) -> str:
    """The completion script for bash, zsh or tcsh."""
    import shtab

    from softfinger.server.verbs.shipped import offer_names

    script: str = shtab.complete(offer_names(make_parser()), shell)
    return script


if __name__ == "__main__":
    sys.exit(main())
