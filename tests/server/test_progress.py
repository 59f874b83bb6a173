"""Progress display on a pseudo terminal: separate from the log, removed at the end, with the reason for a wait."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import numba
import pytest
import zmq
from helpers.programs import Program
from helpers.terminal import Screen, on_terminal
from numba.core import event

from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.kernels.jit.compiler.numba_internals import KernelCache
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS, CompileProgress
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.server.progress import name_warmup, progress_text
from softfinger.server.wire.commands import State

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


@pytest.mark.real_time  # a delayed reader may receive the progress line together with its removal
@pytest.mark.parametrize("columns", [80, *(pytest.param(width, marks=pytest.mark.exhaustive) for width in (40, 132))])
def test_log_and_progress_never_share_a_line(columns: int) -> None:
    """Each screen line belongs either to the log or to the progress, which is removed at the end. The log is
    complete."""
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
    """The count of a daemon on a terminal increases in one line below the log."""
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
    """After Ctrl-C the progress line is removed, and the last log line reports zero force."""
    screen = Screen(80)
    with on_terminal(RUN) as (process, pieces):
        for piece in pieces:
            screen.feed(piece)
            if any("Ctrl-C stops" in line for line in screen.lines):
                process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    assert re.fullmatch(r"stopped after \d+ ticks; force is zero", screen.lines[-2])


class Looking(Folder):
    """Folder of cached kernels that stores the progress text while a kernel is loaded."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.seen: list[str] = []

    def read(self, name: str) -> bytes | None:
        self.seen.append(progress_text("simulating", 3, 10))
        return super().read(name)


def test_a_wait_says_whether_it_compiles_or_loads(tmp_path: Path) -> None:
    """While a kernel is compiled or loaded the text shows that instead of a share of the work."""
    while_compiled: list[str] = []

    class Look(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            while_compiled.append(progress_text("simulating", 3, 10))

        def on_end(self, event: Any) -> None:
            pass

    def doubled(number: float) -> float:
        return 2.0 * number

    folder = Looking(tmp_path / "kernels")
    for _ in range(2):  # the second one finds the cached kernel
        kernel: Any = numba.njit(**OPTIONS)(doubled)
        kernel._cache = KernelCache(doubled, folder)
        assert progress_text("simulating", 3, 10) == "simulating 30%" and progress_text("simulating") == "simulating"
        with event.install_listener("numba:compile", Look()):
            kernel.compile((numba.float64,))
    assert len(while_compiled) == 1 and re.fullmatch(
        r"simulating: compiling kernel \d+( of at most \d+)?", while_compiled[0]
    )
    assert folder.seen == ["simulating: loading cached kernels"] * 2
    assert progress_text("simulating", 3, 10) == "simulating 30%"


def test_ctl_shows_that_the_daemon_compiles(tmp_path: Path) -> None:
    """`ctl set_scene` shows that it waits for a daemon that may compile, until the answer arrives."""
    endpoint = f"ipc://{tmp_path}/commands"
    with zmq.Context() as context, context.socket(zmq.ROUTER) as daemon:
        daemon.linger = 0
        daemon.rcvtimeo = 60_000  # ms: ctl chooses its first requests
        daemon.bind(endpoint)
        words = ["ctl", "set_scene", "scene=sphere", "--endpoint", endpoint]
        asking = Program(
            [sys.executable, "-m", "softfinger.server.cli", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with asking:
            assert asking.stderr is not None and asking.stdout is not None
            scene = {"active_field": "sphere", "tick": 7}
            state = State(0.0, 1, *[(0.0, 0.0, 0.0)] * 3, "", {})
            answers = {
                "describe": {"endpoints": {"telemetry": endpoint}},
                "get_state": msgspec.to_builtins(state),
                "set_scene": scene,
            }
            said, asked = "", ""
            while asked != "set_scene":  # ctl first requests the owner of this address
                sender, *_, request = daemon.recv_multipart()
                command = msgpack.unpackb(request)
                asked = command["method"]
                said = asking.stderr.readline() if asked == "set_scene" else ""
                answer = {"command_id": command["command_id"], "success": True, "result": answers[asked]}
                daemon.send_multipart([sender, b"", msgpack.packb(answer)])
            assert "tick: 7" in asking.stdout.read()
    assert said.startswith("set_scene: waiting for the daemon, which may have to compile") and asking.returncode == 0


def test_kernels_are_counted_towards_those_of_the_scene() -> None:
    """A callee compiles within its caller and has its own count; beyond the expected number there is no total."""
    counted, started = CompileProgress(), []
    counted.expect(2)
    counted.on_first = lambda: started.append(str(counted))
    texts = []
    for act in (counted.begin, counted.begin, counted.end, counted.end, counted.begin, counted.end):
        act()
        texts.append(str(counted))
    assert texts == [
        "compiling kernel 1 of at most 2",
        "compiling kernel 1 of at most 2",
        "compiling kernel 2 of at most 2",
        "",
        "compiling kernel 3",
        "",
    ]
    assert started == [""]  # once, before the first


def test_the_first_compilation_names_the_command_that_compiles_ahead(caplog: pytest.LogCaptureFixture) -> None:
    """The message is logged once, when a kernel is compiled: not for a cached scene, and not after the scene is
    compiled."""
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
