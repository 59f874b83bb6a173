"""Progress on a real pseudo terminal: it keeps clear of the log, and leaves nothing behind."""

from __future__ import annotations

import re
import signal
import sys

import pytest
from helpers.terminal import Screen, on_terminal

RUN = [sys.executable, "-m", "softfinger.server.cli", "run", "--endpoint", "tcp://127.0.0.1:*", "--realtime", "off"]

LOGGING = """
import logging, sys, time
from softfinger.server.cli import to_stderr
from softfinger.server.progress import counter, progress
logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[to_stderr()])
with progress("outer work [1]", 10) as done:
    time.sleep(2.0)
    for number in range(10):
        with progress("inner"):
            logging.info("log %d %s", number, "x" * 90)
        done(number)
        time.sleep(0.05)
with counter() as show:
    for number in range(10):
        show(f"{number} ticks; Ctrl-C stops")
        logging.info("count %d", number)
        time.sleep(0.05)
print("result")
"""


@pytest.mark.real_time  # what a reader that is held up gets in one piece with its end was never on the screen
@pytest.mark.parametrize("columns", [80, 40, 132])
def test_log_and_progress_never_share_a_line(columns: int) -> None:
    """After every piece of output, each line of the screen is a log's or the progress line; at the end there is none,
    and the log is whole."""
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


def test_run_counts_in_a_line_of_its_own() -> None:
    """The daemon on a terminal: the count goes on, in one line below the log, which is not touched."""
    screen, counts = Screen(80), []
    with on_terminal([*RUN, "--duration", "2"]) as (process, pieces):
        for piece in pieces:
            screen.feed(piece)
            lines = [line for line in screen.lines if "Ctrl-C stops" in line]
            assert len(lines) < 2
            for line in lines:
                found = re.fullmatch(r"\d:\d\d:\d\d (\d+) ticks, \d+ missed, \d+ records dropped; Ctrl-C stops *", line)
                assert found, line
                counts.append(int(found[1]))
        assert process.wait(30) == 0
    assert len(set(counts)) > 2 and counts == sorted(counts)
    assert screen.lines[-2:] == ["stopped after 2000 ticks; force is zero", ""]
    assert not any("Ctrl-C stops" in line for line in screen.lines)


def test_interrupted_run_leaves_a_clean_line() -> None:
    """Ctrl-C at the terminal: the progress line goes, the log's last line says that the force is zero."""
    screen = Screen(80)
    with on_terminal(RUN) as (process, pieces):
        for piece in pieces:
            screen.feed(piece)
            if any("Ctrl-C stops" in line for line in screen.lines):
                process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    assert re.fullmatch(r"stopped after \d+ ticks; force is zero", screen.lines[-2])
