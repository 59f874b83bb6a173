"""Replacement of the scene while the daemon runs: compiled in a separate process, then exchanged.

A compilation of half a minute cannot be interrupted within a process. A separate process therefore compiles into the
cache, and the daemon loads the result. `command_handlers.py` requests the changes.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, Final, NamedTuple

from softfinger.config import schema
from softfinger.config.errors import HapticError
from softfinger.config.load import build, describe, load_rig
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers.registry import open_device
from softfinger.proxy import progress as preparation
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS
from softfinger.proxy.kernels.jit.decorators import KERNEL_FOLDER
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tick import Tuning
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.progress import PLAIN_PERIOD_S, QUIET_S, format_progress
from softfinger.server.services.base import Worker
from softfinger.server.signals import call_at_end_of_input
from softfinger.server.wire.process_link import block_stop_signals

log: Final = logging.getLogger(__name__)

NICE: Final = 10
"""Niceness of the compiler, below the priority of the daemon."""
REPORT_PERIOD_S: Final = 1.0
"""Time between two reports of the compiler, that of `health`, which publishes them."""


class SupersededRequest(HapticError):
    """Request for a scene that was replaced by a later request."""


class CompilerFailure(HapticError):
    """Compiler process that failed."""


class SceneRequest(NamedTuple):
    """Request to replace the scene.

    read   returns the validated scene
    reply  called with the first tick of the scene, or with the error
    """

    read: Callable[[], schema.Scene]
    name: str
    reply: Callable[[int | Exception], None]


class SceneChanges(Worker):
    """Service that applies the latest requested scene; an earlier one is cancelled while it is being compiled.

    replace  renders a scene under a name, and returns its first tick
    report   publishes the progress of the scene in preparation; empty: there is none
    """

    def __init__(self, replace: Callable[[schema.Scene, str], int], report: Callable[[str], None]) -> None:
        super().__init__("scenes")
        self._replace, self._report = replace, report
        self._changed = threading.Condition()
        self._next: SceneRequest | None = None
        self._compiler: subprocess.Popen[str] | None = None

    def request(self, change: SceneRequest) -> None:
        """Replace the scene once it is compiled; returns at once."""
        with self._changed:
            before, self._next = self._next, change
            self._end_compiler()
            self._changed.notify()
        if before is not None:
            before.reply(_make_superseded_error())

    def stop(self) -> None:
        with self._changed:
            self.closing.set()
            self._end_compiler()
            self._changed.notify()
        super().stop()

    def work(self) -> None:
        before, preparation.display = preparation.display, self._display
        while (change := self._take_next_change()) is not None:
            try:
                scene = change.read()
                self._compile(scene, change.name)
                outcome: int | Exception = self._replace(scene, change.name)
            except Exception as error:
                outcome = error
            self._report("")
            change.reply(outcome)
        preparation.display = before

    def handle_failure(self, error: Exception) -> None:
        """Do nothing: only `reply` can have raised, so one client gets no answer, and rendering is not affected."""

    @contextmanager
    def _display(self, operation: str, total: int) -> Iterator[Callable[[int], None]]:
        log.info("%s", operation)
        try:
            yield lambda number: self._report(format_progress(operation, number, total))
        finally:
            self._report("")

    def _take_next_change(self) -> SceneRequest | None:
        with self._changed:
            while self._next is None and not self.closing.is_set():
                self._changed.wait()
            change, self._next = self._next, None
            return None if self.closing.is_set() else change

    def _compile(self, scene: schema.Scene, name: str) -> None:
        """Compile the loop of a scene into the cache; raises SupersededRequest if a later scene has been requested."""
        if ServoThread.has_compiled(make_tuning(scene, schema.Guard())) or KERNEL_FOLDER.problem() is not None:
            return  # if the cache cannot be written, a separate process is useless
        with tempfile.TemporaryFile("w+") as errors:
            code = self._run_compiler(scene, name, errors)
            if code:
                errors.seek(0)
                log.error("the compiler of a scene ended with %d: %s", code, errors.read().strip())
                raise CompilerFailure("the scene could not be compiled: see the daemon's log")

    def _run_compiler(self, scene: schema.Scene, name: str, errors: IO[str]) -> int:
        """Run a process that fills the cache and return its exit code; its errors are in `errors`."""
        with self._changed:
            if self._next is not None or self.closing.is_set():
                raise _make_superseded_error()
            with block_stop_signals():
                compiler = self._compiler = subprocess.Popen(
                    [sys.executable, "-P", "-m", __name__],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    text=True,
                    start_new_session=True,
                )
        try:
            assert compiler.stdin is not None and compiler.stdout is not None
            with suppress(BrokenPipeError):
                # Not closed yet: the compiler exits when its standard input ends, as when the daemon dies.
                compiler.stdin.write(json.dumps(describe(scene)) + "\n")
                compiler.stdin.flush()
            with compiler.stdout as output:
                log_at_s = 0.0
                for line in output:
                    self._report(line.rstrip())
                    if time.monotonic() >= log_at_s:
                        log.info("scene %s: %s", name, line.rstrip())
                        log_at_s = time.monotonic() + PLAIN_PERIOD_S
            code = compiler.wait()
        finally:
            with self._changed:
                self._compiler = None
                is_superseded = self._next is not None or self.closing.is_set()
            with suppress(BrokenPipeError):
                compiler.stdin.close()  # type: ignore[union-attr]
        if is_superseded:
            raise _make_superseded_error()
        return code

    def _end_compiler(self) -> None:
        if self._compiler is not None:
            self._compiler.kill()


def _make_superseded_error() -> SupersededRequest:
    return SupersededRequest("another scene was requested, or the daemon ends, before this one was compiled")


def compile_loop(scene: schema.Scene) -> Tuning:
    """Compile the loop of a scene, with any device, since it is the same for all; return the tuning."""
    rig = load_rig("replay")
    with open_device(find_single_device(rig), rig.servo.rate_hz) as device:
        tuning = make_tuning(scene, rig.guard)
        servo = ServoThread([device] * len(scene.fingers), tuning, rig.servo.rate_hz)
        servo.compile()
        servo.close()
    return tuning


def main() -> None:
    """Compile the loop of the scene on standard input, a line of JSON; exit when standard input ends.

    Prints lines with the progress to standard output if anything has to be compiled; functions in the cache are only
    loaded.
    """
    os.nice(NICE)
    COMPILE_PROGRESS.on_first = lambda: threading.Thread(target=_report_progress, daemon=True).start()
    scene = build(schema.Scene, json.loads(sys.stdin.readline()), "the scene")
    call_at_end_of_input(lambda: os._exit(1))
    compile_loop(scene)


def _report_progress() -> None:
    print("compiling kernels that are not cached, in another process", flush=True)
    wait = QUIET_S
    while True:
        time.sleep(wait)
        if kernel := str(COMPILE_PROGRESS):
            print(kernel, flush=True)
        wait = REPORT_PERIOD_S


if __name__ == "__main__":
    main()
