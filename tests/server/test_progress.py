"""Progress display on a pseudo terminal, separate from the log, and lines on a standard error without a reader."""

import contextlib
import os
import re
import select
import sys
import threading
import time
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.shares import collect_shares
from helpers.terminal import Screen, on_terminal
from helpers.waits import until

from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS, CompileProgress
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server import progress as display
from softfinger.server.experiment.analysis import fit_groups
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.loop import servo_thread
from softfinger.server.offline import cost
from softfinger.server.progress import name_warmup
from softfinger.server.recording.export import export
from softfinger.server.recording.results import read_results
from softfinger.server.recording.tables import make_table_format, read_table
from softfinger.server.standard_error import write_line
from softfinger.server.verbs import check
from softfinger.tools import exchange
from softfinger.tools.stability import limit

LOGGING = """
import logging, sys, time
from softfinger.server.cli import to_stderr
from softfinger.server.progress import show_counter, show_progress
logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[to_stderr()])
with show_progress("outer work [1]", 10) as done:
    time.sleep(2.0)
    for number in range(10):
        with show_progress("inner"):
            logging.info("log %d %s", number, "x" * 90)
        done(number)
        time.sleep(0.05)
with show_counter() as show:
    for number in range(10):
        show(f"{number} ticks; Ctrl-C stops")
        logging.info("count %d", number)
        time.sleep(0.05)
print("result")
"""


@pytest.mark.real_time  # a delayed reader may receive the progress line together with its removal
@pytest.mark.parametrize("columns", [80, *(pytest.param(width, marks=pytest.mark.exhaustive) for width in (40, 132))])
def test_log_and_progress_never_share_a_line(columns: int) -> None:
    screen, shown = Screen(columns), set()
    with on_terminal([sys.executable, "-c", LOGGING], 24, columns) as (process, pieces):
        for piece in pieces:
            assert "\x1b[?25l" not in piece, "a program that is killed would leave no cursor"
            screen.feed(piece)
            for line in screen.lines:
                kinds = [kind for kind in ("outer", "inner", "Ctrl-C", "log ", "count ") if kind in line]
                assert len(kinds) < 2, line
                shown.update(kinds)
        assert process.wait(30) == 0
    assert shown == {"outer", "Ctrl-C", "log ", "count "}
    text = "\n".join(screen.lines)
    assert "outer" not in text and "Ctrl-C" not in text
    assert re.findall(r"log (\d)", text) == re.findall(r"count (\d)", text) == [str(n) for n in range(10)]
    assert screen.lines[-2:] == ["result", ""]


STOPPED = """
import termios
from softfinger.server.progress import show_counter
with show_counter() as show:
    show("ticks")
    termios.tcflow(2, termios.TCOOFF)  # as Ctrl-S
"""


def test_a_terminal_that_accepts_nothing_does_not_block_the_end() -> None:
    with on_terminal([sys.executable, "-c", STOPPED]) as (process, _):
        assert process.wait(30) == 0


def test_lines_without_a_terminal_show_the_share(monkeypatch, capsys):
    monkeypatch.setattr(display, "QUIET_S", 1e-3)
    monkeypatch.setattr(display, "PLAIN_PERIOD_S", 1e-3)
    with display.show_progress("work", 4) as report_progress:
        for number in range(1, 4):
            report_progress(number)
            line = re.compile(rf"^work {25 * number}% \.\.\. \d+ s$", re.MULTILINE)
            until(lambda line=line: line.search(capsys.readouterr().err))
    assert display.format_progress("work", 0, 4, lambda: "compiling") == "work: compiling"
    assert display.format_progress("work", 1, 4, lambda: "compiling") == "work 25%: compiling"


@pytest.mark.parametrize("name", ["check", "stability", "exchange"])
def test_verbs_that_compile_name_the_number_of_kernels(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """They stop at the first kernel, at which the progress line has the number of kernels to come."""
    monkeypatch.setattr(servo_thread, "PLAIN", False)

    def stop(*_: object) -> None:
        COMPILE_PROGRESS.begin()
        try:
            raise InterruptedError(str(COMPILE_PROGRESS))
        finally:
            COMPILE_PROGRESS.end()

    monkeypatch.setattr(cost, "make_touching_poses", stop)
    monkeypatch.setattr(limit, "run_rows", stop)
    monkeypatch.setattr(exchange, "exchange_loop", SimpleNamespace(compile=stop))
    call, number = {
        "check": (lambda: check.add_costs(check.examine_file("paper-plane")), 260),
        "stability": (limit.compile_search, limit.KERNELS),
        "exchange": (exchange.compile_exchange, exchange.KERNELS),
    }[name]
    with pytest.raises(InterruptedError, match=rf"^compiling kernel 1 \(about {number} with an empty cache\)$"):
        call()


def test_long_waits_report_their_share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records, table, study = tmp_path / "in.npz", tmp_path / "in.csv", Experiment("stiffness-discrimination")
    np.savez(records, records=np.random.default_rng(1).normal(size=(2000, RECORD_SIZE)))
    table.write_text("".join(f"{number} 0 0 0.01\n" for number in range(3000)))
    rows = [
        row | row["levels"] | {"participant": name}
        for number, name in enumerate("abcd", 1)
        for row in study.rehearse(number)
    ]
    shown = collect_shares(monkeypatch)
    export(records, tmp_path / "out.csv")
    read_table(table, make_table_format("t,x,y,z", 1.0, 1.0, None, 0))
    read_results(tmp_path / "out.csv")
    fit_groups(study.file, rows)
    for label in ("writing csv", "reading in.csv", "reading out.csv", "fitting"):
        shares = shown[label]
        assert len(set(shares)) > 2 and shares == sorted(shares) and shares[-1] <= 1.0, label


def test_an_inner_operation_advances_the_step_of_the_outer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = collect_shares(monkeypatch)
    with display.show_progress("outer", 2) as report_outer:
        with display.show_progress("inner", 4) as report_inner:
            report_inner(1)
            with display.show_progress("innermost", 2) as report_innermost:
                report_innermost(1)
            report_inner(4)
        with display.show_progress("second inner", 2) as report_inner:
            report_inner(1)
        report_outer(1)
        with display.show_progress("without a share"):
            pass
        report_outer(2)
    with display.show_progress("next", 4) as report_outer:
        report_outer(1)
    assert shown == {"outer": [0.125, 0.1875, 0.5, 0.5, 0.5, 1.0], "next": [0.25]}


def test_kernels_are_counted_towards_those_of_the_scene() -> None:
    counted, started = CompileProgress(), []
    counted.expect(2)
    counted.on_first = lambda: started.append(str(counted))
    texts = []
    for act in (counted.begin, counted.begin, counted.end, counted.end, counted.begin, counted.end):
        act()
        texts.append(str(counted))
    assert texts == [
        "compiling kernel 1 (about 2 with an empty cache)", "compiling kernel 1 (about 2 with an empty cache)",
        "compiling kernel 2 (about 2 with an empty cache)", "", "compiling kernel 3", "",
    ]  # fmt: skip
    assert started == [""]  # once, before the first


def test_the_first_compilation_names_the_command_that_compiles_ahead(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        with name_warmup("mine.toml"), COMPILE_PROGRESS.loading():
            pass
        assert not caplog.messages
        with name_warmup("mine.toml"):
            for _ in range(2):
                COMPILE_PROGRESS.begin()
                COMPILE_PROGRESS.end()
        COMPILE_PROGRESS.begin()
        COMPILE_PROGRESS.end()
    (message,) = caplog.messages
    assert "`softfinger warmup mine.toml`" in message


@contextlib.contextmanager
def full_pipe() -> Iterator[FileIO]:
    """Replace the standard error by a full pipe; yield its end for reading."""
    reader, writer = os.pipe()
    for end in (reader, writer):
        os.set_blocking(end, False)  # a write that would wait raises instead
    with open(reader, "rb", buffering=0) as log_file, open(writer, "w") as stream:
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writer, bytes(select.PIPE_BUF))
        with contextlib.redirect_stderr(stream):
            yield log_file


def test_the_last_line_waits_for_its_reader() -> None:
    with full_pipe() as log_file:

        def resume() -> None:
            time.sleep(0.1)  # the line is waiting by then, usually
            log_file.read(16 * select.PIPE_BUF)

        resuming = threading.Thread(target=resume)
        resuming.start()
        write_line("last", wait_s=20.0)
        resuming.join()
        assert (log_file.read(32 * select.PIPE_BUF) or b"").endswith(b"last\n")


def test_unread_lines_are_dropped_and_counted() -> None:
    with full_pipe() as log_file:
        write_line("first")
        write_line("second", wait_s=0.01)
        while log_file.read(select.PIPE_BUF):
            pass
        write_line("third")
        assert log_file.read(200) == b"(2 lines are missing here: they were not read in time)\nthird\n"
        write_line(1_000_000 * "x")  # longer than the pipe, such as a traceback
        while log_file.read(select.PIPE_BUF):
            pass
        write_line("fourth")
        assert log_file.read(200) == b"(1 lines are missing here: they were not read in time)\nfourth\n"
        write_line("fourth")
        assert log_file.read(200) == b"fourth\n"
