"""Progress of what takes long: on a terminal a line that keeps clear of the log, elsewhere a line every few seconds.

Whatever is waited for may have to compile kernels first, or load those that are kept: while it does, the line says so.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from softfinger.proxy.kernels.jit.compiler.doing import DOING

if TYPE_CHECKING:  # rich takes 50 ms to import, and only a terminal needs it
    from rich.progress import Progress, Task

QUIET_S: Final = 0.5
"""What is done sooner shows nothing."""
PLAIN_PERIOD_S: Final = 5.0

CHUNK: Final = 16384
"""Ticks that an offline run does between two reports, and hands on at once: 12 MB of records."""

_shown: Final = threading.Lock()
"""There is one display: of what is reported within something reported, nothing is shown."""


_quiet: Final = threading.Event()


def show(wanted: bool) -> None:
    """Whether anything is shown from now on."""
    if wanted:
        _quiet.clear()
    else:
        _quiet.set()


def on_terminal() -> bool:
    """Whether there is a terminal to draw on."""
    return sys.stderr.isatty() and os.environ.get("TERM") != "dumb"


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Report on `what` to stderr while the block runs; call the result with how many of `total` are done."""
    if _quiet.is_set() or not _shown.acquire(blocking=False):
        yield lambda number: None
        return
    try:
        with _bar(what, total) if on_terminal() else _lines(what, total) as done:
            yield done
    finally:
        _shown.release()


def described(what: str, count: int = 0, total: int | None = None) -> str:
    """What is waited for: `simulating: compiling kernel 1`, and when that is done `simulating 40%`."""
    if doing := str(DOING):
        return f"{what}: {doing}"
    return f"{what} {count / total:.0%}" if total else what


@contextmanager
def making(kernels: str) -> Iterator[None]:
    """Report on `kernels` that are compiled or loaded; the garbage collector, which would take a tenth of the time of
    a compilation, comes behind it."""
    collects = gc.isenabled()
    gc.disable()
    try:
        with progress(kernels):
            yield
    finally:
        if collects:
            gc.enable()


@contextmanager
def counter() -> Iterator[Callable[[str], None] | None]:
    """On a terminal: call the result with a text, to show it in the last line. Elsewhere None."""
    if _quiet.is_set() or not on_terminal():
        yield None
        return
    with _shown:
        display = _display(bar=False)
        task = display.add_task("")
        with display:
            yield lambda text: display.update(task, description=text)


@contextmanager
def _bar(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    display = _display(bar=total is not None)
    task = display.add_task(what, total=total)
    timer = threading.Timer(QUIET_S, display.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda number: display.update(task, completed=number)
    finally:
        timer.cancel()
        timer.join()
        display.stop()


def _display(bar: bool) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column
    from rich.text import Text

    class Visible(Console):
        """The cursor stays: a process that is stopped or killed would leave the terminal without one."""

        def show_cursor(self, show: bool = True) -> bool:
            return False

    class What(TextColumn):
        """Asked for ten times a second, so it says what is done with kernels just now."""

        def render(self, task: Task) -> Text:
            return Text(described(task.description), no_wrap=True, overflow="ellipsis")

    class Share(TaskProgressColumn):
        """Nothing while kernels are made: 0 % would be what is not begun."""

        def render(self, task: Task) -> Text:
            return Text() if str(DOING) else super().render(task)

    text = Column(no_wrap=True, overflow="ellipsis")
    columns: list[ProgressColumn] = [
        TimeElapsedColumn(),
        What("", table_column=text),
    ]
    if bar:
        columns += [BarColumn(), Share()]
    # Long lines of the log are left to the terminal to wrap. Results for a pipe do not go to the terminal.
    console = Visible(stderr=True, soft_wrap=True, highlight=False)
    return Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty())


@contextmanager
def _lines(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    begun, finished, count = time.monotonic(), threading.Event(), 0

    def done(number: int) -> None:
        nonlocal count
        count = number

    def report() -> None:
        wait = QUIET_S
        while not finished.wait(wait):
            said = described(what, count, total)
            print(f"{said} ... {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
            wait = PLAIN_PERIOD_S

    reporter = threading.Thread(target=report, daemon=True)
    reporter.start()
    try:
        yield done
    finally:
        finished.set()
        reporter.join()
