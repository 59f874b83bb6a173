"""Progress display of long operations: a line below the log on a terminal, otherwise a line every few seconds.

An operation within another one in the same thread adds its share to the step of the outer one.
The line also shows that kernels are being compiled or loaded, which any long operation may have to do first.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Final, TextIO, TypeVar, cast

from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS
from softfinger.server.standard_error import NonBlockingStream, write_line

if TYPE_CHECKING:  # importing rich takes 50 ms, and only terminals need it
    from rich.progress import Progress, Task

Item = TypeVar("Item")
Result = TypeVar("Result")

log: Final = logging.getLogger(__name__)

QUIET_S: Final = 0.5
"""Shorter operations show nothing."""
PLAIN_PERIOD_S: Final = 5.0

CHUNK: Final = 16384
"""Ticks per progress report of an offline run, which passes on 12 MB of records at a time."""

_display_lock: Final = threading.Lock()
"""Held by the only display; operations of other threads show nothing."""
_this_thread: Final = threading.local()
"""`operations`: those that run in this thread, the innermost last."""


_quiet: Final = threading.Event()


def set_enabled(enabled: bool) -> None:
    if enabled:
        _quiet.clear()
    else:
        _quiet.set()


def on_terminal() -> bool:
    """Return whether standard error is a terminal that can redraw a line."""
    return sys.stderr.isatty() and os.environ.get("TERM") != "dumb"


def describe_compilation() -> str:
    """Return the progress of a compilation in this process; empty if there is none."""
    return str(COMPILE_PROGRESS)


@contextmanager
def show_progress(
    label: str, total: int | None = None, detail: Callable[[], str] = describe_compilation
) -> Iterator[Callable[[int], None]]:
    """Report progress of `label` to stderr during the block; call the result with the number done, out of `total`.

    While `detail` returns a text, that text follows the share. One thread at a time calls `detail`.
    """
    operations: list[_Operation] = _this_thread.__dict__.setdefault("operations", [])
    if operations:
        advance = operations[-1].advance
        display: AbstractContextManager[Callable[[float], None]] = nullcontext(
            lambda count: advance(count / (total or 1))
        )
    else:
        display = _open_display(label, total, detail)
    with display as show:
        operation = _Operation(show)
        operations.append(operation)
        try:
            yield operation.set_count
        finally:
            operations.remove(operation)


def map_with_progress(label: str, function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return `function(item)` of each item; report the progress of `label` after each."""
    results: list[Result] = []
    with show_progress(label, len(items)) as update:
        for item in items:
            results.append(function(item))
            update(len(results))
    return results


class _Operation:
    """Count of an operation that never decreases: a step may contain several operations."""

    def __init__(self, show: Callable[[float], None]) -> None:
        self._show, self._count, self._largest = show, 0, 0.0

    def set_count(self, number: int) -> None:
        self._count = number
        self.advance(0.0)

    def advance(self, share: float) -> None:
        """Set the share of the current step."""
        self._largest = max(self._largest, self._count + share)
        self._show(self._largest)


@contextmanager
def _open_display(label: str, total: int | None, detail: Callable[[], str]) -> Iterator[Callable[[float], None]]:
    """Yield the setter of the displayed count; it does nothing if another thread has the display."""
    if _quiet.is_set() or not _display_lock.acquire(blocking=False):
        yield lambda number: None
        return
    try:
        with _show_bar(label, total, detail) if on_terminal() else _show_lines(label, total, detail) as set_count:
            yield set_count
    finally:
        _display_lock.release()


def format_progress(
    label: str, count: float = 0, total: int | None = None, detail: Callable[[], str] = describe_compilation
) -> str:
    """Return the text of the progress line: `measuring: compiling kernel 1`, `measuring 40%: compiling kernel 9`."""
    text = detail()
    shown = f"{label} {count / total:.0%}" if total and (count or not text) else label
    return f"{shown}: {text}" if text else shown


@contextmanager
def report_compilation(kernels: str) -> Iterator[None]:
    """Report the compilation or loading of `kernels` during the block.

    The garbage collector is off until the end: it would take a tenth of the time of a compilation.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        with show_progress(kernels):
            yield
    finally:
        if collects:
            gc.enable()


@contextmanager
def name_warmup(scene: str) -> Iterator[None]:
    """Log the command that compiles a scene ahead, as soon as a kernel is compiled during the block."""
    COMPILE_PROGRESS.on_first = lambda: log.info(
        "compiling the kernels of this scene, once; `softfinger warmup %s` compiles them ahead", scene
    )
    try:
        yield
    finally:
        COMPILE_PROGRESS.on_first = None


@contextmanager
def show_counter() -> Iterator[Callable[[str], None] | None]:
    """Yield a function that shows a text in the last line of the terminal; None without a terminal."""
    if _quiet.is_set() or not on_terminal():
        yield None
        return
    with _display_lock:
        display = _display(False, describe_compilation)
        task = display.add_task("")
        with display:
            yield lambda text: display.update(task, description=text)


@contextmanager
def _show_bar(label: str, total: int | None, detail: Callable[[], str]) -> Iterator[Callable[[float], None]]:
    display = _display(total is not None, detail)
    task = display.add_task(label, total=total)
    timer = threading.Timer(QUIET_S, display.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda number: display.update(task, completed=number)
    finally:
        timer.cancel()
        timer.join()
        display.stop()


def _display(bar: bool, detail: Callable[[], str]) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column
    from rich.text import Text

    class Visible(Console):
        """Console that never hides the cursor: a stopped or killed process could not show it again."""

        def show_cursor(self, show: bool = True) -> bool:
            return False

    class _TaskText(TextColumn):
        """Column evaluated ten times a second, so it shows the current detail."""

        def render(self, task: Task) -> Text:
            return Text(format_progress(task.description, detail=detail), no_wrap=True, overflow="ellipsis")

    class _TaskShare(TaskProgressColumn):
        """Percentage that is empty while there is a detail: the operation waits for a compilation."""

        def render(self, task: Task) -> Text:
            return Text() if detail() else super().render(task)

    text = Column(no_wrap=True, overflow="ellipsis")
    columns: list[ProgressColumn] = [TimeElapsedColumn(), _TaskText("", table_column=text)]
    if bar:
        columns += [BarColumn(), _TaskShare()]
    # The terminal wraps long log lines. Redirected output does not go to the terminal. No thread waits for a terminal
    # that accepts nothing (Ctrl-S, a lost connection), because the end of the display would wait for that thread.
    stream = cast(TextIO, NonBlockingStream(sys.stderr))
    console = Visible(file=stream, soft_wrap=True, highlight=False)
    return Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty())


@contextmanager
def _show_lines(label: str, total: int | None, detail: Callable[[], str]) -> Iterator[Callable[[float], None]]:
    start_s, finished, count = time.monotonic(), threading.Event(), 0.0

    def set_count(number: float) -> None:
        nonlocal count
        count = number

    def report() -> None:
        wait = QUIET_S
        while not finished.wait(wait):
            text = format_progress(label, count, total, detail)
            write_line(f"{text} ... {time.monotonic() - start_s:.0f} s")
            wait = PLAIN_PERIOD_S

    reporter = threading.Thread(target=report, daemon=True)
    reporter.start()
    try:
        yield set_count
    finally:
        finished.set()
        reporter.join()
