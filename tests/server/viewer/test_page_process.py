"""The page as a process: its address, the secrecy of its token, and its restarts."""

from __future__ import annotations

import os
import re
import shlex
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.error import URLError
from urllib.parse import urlsplit
from urllib.request import url2pathname, urlopen

import pytest
from helpers.browser import browser, eventually, shown, why_none
from helpers.processes import COMMAND, find_child
from helpers.programs import Program
from helpers.waits import ends_within

from softfinger.server.viewer.door import process as of_page
from softfinger.server.viewer.door.process import RESTARTS
from softfinger.server.viewer.page import Page

pytestmark = pytest.mark.real_time

WAIT_S = 280.0
"""Limit of a test that hangs, below the five minutes after which tests/run.py ends all tests."""


def find_page(process: subprocess.Popen[str]) -> int:
    """Wait for the page's process."""
    return find_child(process.pid, b"\0view\0")


def get_status(process: subprocess.Popen[str], address: str) -> int:
    while process.poll() is None:
        try:
            with urlopen(address, timeout=WAIT_S) as answer:
                return int(answer.status)
        except URLError:
            time.sleep(0.02)
    raise AssertionError("the daemon has ended")


@contextmanager
def run_with_page(*more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    ends = ["--endpoint", "tcp://127.0.0.1:*", "--commands", "tcp://127.0.0.1:*"]
    command = [*COMMAND, "run", "--realtime", "off", *ends, "--view", *more]
    with Program(command, stderr=subprocess.PIPE, text=True, process_group=0) as process:
        assert process.stderr is not None
        timer = threading.Timer(WAIT_S, os.killpg, (process.pid, signal.SIGKILL))
        timer.start()
        try:
            first = next(line for line in process.stderr if "compiling kernel" not in line)
            assert first.endswith("the page; to stop it: Ctrl-C\n")
            address = next(process.stderr)
            assert address.startswith("http://localhost:")
            yield process, address.rstrip()
        finally:
            timer.cancel()
            process.kill()


def test_a_page_that_ends_is_restarted_at_the_same_address() -> None:
    with run_with_page() as (process, address):
        assert process.stderr is not None
        page = find_page(process)
        assert urlsplit(address).path.strip("/") not in Path(f"/proc/{page}/cmdline").read_text()
        os.kill(page, signal.SIGKILL)
        ended = next(line for line in process.stderr if "the page has ended" in line)
        assert f"exit code -9; the servo continues; restart 1 of {RESTARTS}" in ended
        assert get_status(process, address) == 200
        page = Path(f"/proc/{find_page(process)}")
        process.kill()
        until = time.monotonic() + WAIT_S
        with suppress(OSError):  # it has exited
            while "State:\tZ" not in (page / "status").read_text():  # a zombie if no process reaps it
                assert time.monotonic() < until
                time.sleep(0.01)


def test_a_page_that_hangs_at_start_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hangs = tmp_path / "python"
    hangs.write_text("#!/bin/sh\nexec sleep 600\n")
    hangs.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(hangs))
    monkeypatch.setattr(of_page, "START_TIMEOUT_S", 0.2)
    reports: list[str] = []
    shown = of_page.PageProcess(f"ipc://{tmp_path}/t", f"ipc://{tmp_path}/c", [], reports.append)
    shown.supervise()
    shown.close()
    assert len(reports) == 1 and "the page has ended, with exit code -9" in reports[0]


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # the pipe of each crashed page, until collected
def test_a_page_that_crashes_repeatedly_restarts_three_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "python"
    page.write_text("#!/bin/sh\necho http://localhost:1/secret/\nexit 3\n")
    page.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(page))
    reports: list[str] = []
    crashing = of_page.PageProcess(f"ipc://{tmp_path}/t", f"ipc://{tmp_path}/c", [], reports.append)
    assert eventually(lambda: crashing.supervise() or len(reports) > RESTARTS)
    crashing.supervise()
    crashing.close()
    last = r"with exit code 3; .*; (?:restart (\d) of 3|to see it again: .*view)"
    numbers = [re.search(last, text) for text in reports]
    assert [number and number[1] for number in numbers] == ["1", "2", "3", None]


def test_a_stopped_page_ends_with_the_daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "python"
    page.write_text("#!/bin/sh\necho http://localhost:1/secret/\nexec sleep 600\n")
    page.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(page))
    shown = of_page.PageProcess(f"ipc://{tmp_path}/t", f"ipc://{tmp_path}/c", [], lambda text: None)
    os.kill(shown._process.pid, signal.SIGSTOP)
    shown.close()
    assert shown._process.returncode == -signal.SIGTERM


def test_a_browser_that_does_not_read_does_not_delay_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    page, read = Page("127.0.0.1", 0), threading.Event()
    stop = page.server.stop
    monkeypatch.setattr(page.server, "stop", lambda: read.wait() and stop())  # as viser waits for a browser
    with ends_within(60):
        page.close()
    read.set()


BROWSER = """#!/bin/sh
printf '%s\\n' "$@" > "{seen}/words.new"
mv "{seen}/words.new" "{seen}/words"
"""


def test_a_browser_opens_the_page_through_a_private_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "browser"
    program.write_text(BROWSER.format(seen=tmp_path))
    program.chmod(0o755)
    monkeypatch.setenv("BROWSER", f"{shlex.quote(str(program))} %s")
    monkeypatch.setenv("DISPLAY", ":0")
    command = [*COMMAND, "view", "tap", "--port", "8320"]
    with Program([*command, "--print-address"], stdout=subprocess.PIPE, text=True, kill_at_end=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        while not (tmp_path / "words").exists():
            assert process.poll() is None
            time.sleep(0.01)
        (word,) = (tmp_path / "words").read_text().splitlines()
        file = Path(url2pathname(urlsplit(word).path))
        assert urlsplit(address).path.strip("/") not in word
        assert stat.S_IMODE(file.stat().st_mode) == 0o600 and stat.S_IMODE(file.parent.stat().st_mode) == 0o700
        assert address in file.read_text()
        process.send_signal(signal.SIGINT)
        process.wait()
        assert not file.exists()


@pytest.mark.system
@pytest.mark.skipif(bool(why_none()), reason=why_none())
def test_an_open_browser_reconnects_to_a_restarted_page() -> None:
    with run_with_page() as (process, address), browser() as page:
        threading.Thread(target=process.communicate, daemon=True).start()  # reads stderr, so that it does not block
        screen = shown(page, address)

        def tick() -> int:
            match = re.search(r"tick (\d+)", screen.page.inner_text("body"))
            return int(match[1]) if match else -1

        assert eventually(lambda: tick() > 0)
        os.kill(find_page(process), signal.SIGKILL)
        before = tick()
        assert eventually(lambda: tick() > before + 2000)  # two seconds in real time
