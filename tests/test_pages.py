"""Every command of the guided pages runs as printed, in its order.

The kinds of fences: `sh` is for a terminal and runs here; a fence with a `title` is a file that the reader saves;
`console` needs the network, a device, a browser or time, and is only parsed (tests/test_docs.py).
"""

import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import dedent

import pytest
from helpers.programs import run_program
from test_packaging import dist, installed, wheel  # noqa: F401 - fixtures: a clean environment with the wheel in it

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = ("tutorial.md", "run-an-experiment.md")
FENCE = re.compile(r'^( *)```(\w+)(?: title="([^"]+)")?\n(.*?)^\1```$', re.MULTILINE | re.DOTALL)
STOP_S = 60.0

SHIM = """#!/bin/sh
# The program, on the endpoints of this test, and for a look where a reader would stay.
verb=$1; shift
case $verb in
    run)
        set -- --endpoint {telemetry} --commands {commands} --realtime off "$@"
        case "$*" in *--record*) ;; *--duration*) set -- "$@" --duration 1 ;; esac ;;
    record) set -- --endpoint {telemetry} "$@" ;;
    monitor) set -- --endpoint {telemetry} --once --timeout 400 "$@" ;;
    ctl) set -- --endpoint {commands} "$@" ;;
    doctor) set -- --seconds 1 "$@" ;;
    experiment) set -- --endpoint {telemetry} --commands {commands} "$@" ;;
esac
exec {program} "$verb" "$@"
"""


def fences(page: str) -> list[tuple[str, str, str]]:
    """Kind, title and text of each fence, in order."""
    return [(kind, title, dedent(text)) for _, kind, title, text in FENCE.findall((DOCS / page).read_text())]


def commands(text: str) -> list[str]:
    """Return the commands, one per line, unchanged."""
    return [line for line in text.splitlines() if shlex.split(line, comments=True)]


class Terminals:
    """The reader's terminals: one for the daemon, which runs until Ctrl-C, and one for everything else."""

    def __init__(self, folder: Path, interpreter: Path) -> None:
        """`folder` is the reader's working folder; the program is installed in the environment of `interpreter`."""
        self.folder = folder
        tools = folder / "bin"
        tools.mkdir()
        telemetry, wanted = (shlex.quote(f"ipc://{folder}/{name}") for name in ("t", "c"))
        program = shlex.quote(str(interpreter.with_name("softfinger")))
        shim = tools / "softfinger"
        shim.write_text(SHIM.format(telemetry=telemetry, commands=wanted, program=program))
        shim.chmod(0o755)
        (tools / "python").write_text(f'#!/bin/sh\nexec {shlex.quote(str(interpreter))} "$@"\n')
        (tools / "python").chmod(0o755)
        self.environment = {**os.environ, "PATH": f"{tools}:{os.environ['PATH']}"}
        self.daemon: subprocess.Popen[bytes] | None = None

    def type(self, command: str) -> None:
        """Run one command to its end, or leave the daemon running."""
        words = shlex.split(command, comments=True)
        if words[:2] == ["softfinger", "run"] and not {"--once", "--duration"} & set(words):
            self.stop()
            self.daemon = subprocess.Popen(words, cwd=self.folder, env=self.environment)
            self.type("softfinger monitor")  # a reader waits until it runs, which may take a compilation
            return
        process = run_program(["bash", "-c", command], cwd=self.folder, env=self.environment, timeout=500)
        # A machine that a doctor finds bad is none of the page's.
        assert process.returncode in ({0, 10} if words[1] == "doctor" else {0}), (
            f"{command}\n{process.stdout}{process.stderr}"
        )

    def stop(self) -> None:
        """Send Ctrl-C to the daemon unless it is already stopping; it must end normally."""
        if self.daemon is not None:
            self.daemon.send_signal(signal.SIGINT)
            assert self.daemon.wait(STOP_S) == 0
            self.daemon = None


@contextmanager
def terminals(folder: Path, interpreter: Path) -> Iterator[Terminals]:
    opened = Terminals(folder, interpreter)
    try:
        yield opened
        opened.stop()
    finally:
        if opened.daemon is not None:
            opened.daemon.kill()
            opened.daemon.wait()


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("page", "where"),
    [
        pytest.param("tutorial.md", "clone", marks=pytest.mark.exhaustive),
        pytest.param("tutorial.md", "wheel", marks=pytest.mark.exhaustive),
        pytest.param("run-an-experiment.md", "clone", marks=pytest.mark.exhaustive),
    ],
)
def test_a_page_works_as_printed(page: str, where: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    ran = 0
    interpreter = request.getfixturevalue("installed") / "python" if where == "wheel" else Path(sys.executable)
    with terminals(tmp_path, interpreter) as reader:
        for kind, title, text in fences(page):
            if title:
                (tmp_path / title).write_text(text)
            elif kind == "sh":
                for command in commands(text):
                    reader.type(command)
                    ran += 1
    assert ran > 5


@pytest.mark.parametrize("page", PAGES)
def test_files_to_save_are_used_and_valid(page: str) -> None:
    text = (DOCS / page).read_text()
    for kind, title, body in fences(page):
        if title:
            assert re.search(rf"^(?:softfinger .*|python ){re.escape(title)}", text, re.MULTILINE), title
        if kind == "toml":
            tomllib.loads(body)
