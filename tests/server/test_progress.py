"""Progress display on a pseudo terminal: separate from the log, removed at the end, with the reason for a wait."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from helpers.processes import COMMAND
from helpers.shares import collect_shares
from helpers.terminal import Screen, on_terminal
from helpers.waits import until
from numba.core import event

from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.kernels.jit.compiler.numba_internals import KernelCache
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS, CompileProgress
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server import progress as display
from softfinger.server.experiment.analysis import fit_groups
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.progress import format_progress, name_warmup
from softfinger.server.recording.export import export
from softfinger.server.recording.results import read_results
from softfinger.server.recording.tables import make_layout, read_table
from softfinger.server.verbs import check

RUN = [*COMMAND, "run", "--endpoint", "tcp://127.0.0.1:*", "--realtime", "off"]

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


def test_run_counts_in_a_separate_line() -> None:
    screen, counts, interrupted = Screen(80), list[int](), False
    with on_terminal(RUN) as (process, pieces):
        for piece in pieces:
            screen.feed(piece)
            lines = [line for line in screen.lines if "Ctrl-C stops" in line]
            assert len(lines) < 2
            for line in lines:
                match = re.fullmatch(r"\d:\d\d:\d\d (\d+) ticks, \d+ missed, \d+ records dropped; Ctrl-C stops *", line)
                assert match, line
                counts.append(int(match[1]))
            if len(set(counts)) == 3 and not interrupted:
                process.send_signal(signal.SIGINT)
                interrupted = True
        assert process.wait(30) == 0
    assert counts == sorted(counts)
    assert re.fullmatch(r"stopped after \d+ ticks; force is zero", screen.lines[-2])
    assert not any("Ctrl-C stops" in line for line in screen.lines)


@pytest.mark.exhaustive  # it has to last longer than a moment, on two processors
def test_stability_shows_its_share() -> None:
    screen, shares = Screen(80), []
    words = ["stability", "--map", "all", "--compare", "--points", "40"]
    with on_terminal([*COMMAND, *words]) as (process, pieces):
        for piece in pieces:
            screen.feed(piece)
            shares += [
                int(match[1]) for line in screen.lines if (match := re.search(r"finding limits .* (\d+)%", line))
            ]
        assert process.wait(30) == 0
    assert len(set(shares)) > 2 and shares == sorted(shares)


def test_lines_without_a_terminal_show_the_share(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(display, "QUIET_S", 1e-3)
    monkeypatch.setattr(display, "PLAIN_PERIOD_S", 1e-3)
    with display.show_progress("work", 4) as report_progress:
        for number in range(1, 4):
            report_progress(number)
            line = re.compile(rf"^work {25 * number}% \.\.\. \d+ s$", re.MULTILINE)
            until(lambda line=line: line.search(capsys.readouterr().err))


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
    read_table(table, make_layout("t,x,y,z", 1.0, 1.0, None, 0))
    read_results(tmp_path / "out.csv")
    fit_groups(study.file, rows)
    for label in ("writing csv", "reading in.csv", "reading out.csv", "fitting"):
        shares = shown[label]
        assert len(set(shares)) > 2 and shares == sorted(shares) and shares[-1] <= 1.0, label


def test_an_inner_operation_advances_the_step_of_the_outer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The share of an operation is added to the current step of the outer one, also over several levels, and never
    decreases."""
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


def test_check_reports_the_compilation_of_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[str] = []

    @contextmanager
    def report(kernels: str) -> Iterator[None]:
        reported.append(kernels)
        yield
        reported.append("end")

    monkeypatch.setattr(check, "report_compilation", report)
    monkeypatch.setattr(check, "summarize_rig", lambda rig: reported.append("summary") or [])
    check.examine_file("simulated")
    assert reported == ["kernels that call the device", "summary", "end"]


class ProgressFolder(Folder):
    """Folder of cached kernels that stores the progress text while a kernel is loaded."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.seen: list[str] = []

    def read(self, name: str) -> bytes | None:
        self.seen.append(format_progress("simulating", 3, 10))
        return super().read(name)


def test_the_progress_text_distinguishes_compiling_and_loading(tmp_path: Path) -> None:
    while_compiled: list[str] = []

    class Look(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            while_compiled.append(format_progress("simulating", 3, 10))

        def on_end(self, event: Any) -> None:
            pass

    def doubled(number: float) -> float:
        return 2.0 * number

    folder = ProgressFolder(tmp_path / "kernels")
    for _ in range(2):  # the second one finds the cached kernel
        kernel: Any = numba.njit(**OPTIONS)(doubled)
        kernel._cache = KernelCache(doubled, folder)
        assert (
            format_progress("simulating", 3, 10) == "simulating 30%" and format_progress("simulating") == "simulating"
        )
        with event.install_listener("numba:compile", Look()):
            kernel.compile((numba.float64,))
    assert len(while_compiled) == 1 and re.fullmatch(
        r"simulating: compiling kernel \d+( \(about \d+ with an empty cache\))?", while_compiled[0]
    )
    assert folder.seen == ["simulating: loading cached kernels"] * 2
    assert format_progress("simulating", 3, 10) == "simulating 30%"


def test_kernels_are_counted_towards_those_of_the_scene() -> None:
    counted, started = CompileProgress(), []
    counted.expect(2)
    counted.on_first = lambda: started.append(str(counted))
    texts = []
    for act in (counted.begin, counted.begin, counted.end, counted.end, counted.begin, counted.end):
        act()
        texts.append(str(counted))
    assert texts == [
        "compiling kernel 1 (about 2 with an empty cache)",
        "compiling kernel 1 (about 2 with an empty cache)",
        "compiling kernel 2 (about 2 with an empty cache)",
        "",
        "compiling kernel 3",
        "",
    ]
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
