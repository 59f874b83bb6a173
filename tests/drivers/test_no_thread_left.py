"""A system without threads, such as a container at its limit of processes: devices are stopped, with one error."""

from __future__ import annotations

import sys
import threading

import pytest
from helpers.programs import run_program

from softfinger.drivers import open_devices

pytestmark = pytest.mark.plain


class Device:
    """Device that records its calls; the one that `fails` raises an error."""

    def __init__(self, fails: bool = False) -> None:
        self.calls: list[str] = []
        self._fails = fails

    def stop(self) -> None:
        self.calls.append("stop")
        if self._fails:
            raise OSError("the port has gone")

    def close(self) -> None:
        self.calls.append("close")


@pytest.mark.parametrize("left", range(4))
def test_every_device_is_stopped_without_threads(left: int, monkeypatch: pytest.MonkeyPatch) -> None:
    started, start = list[threading.Thread](), threading.Thread.start

    def start_some(thread: threading.Thread) -> None:
        if len(started) == left:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_some)
    devices = [Device(), Device(fails=True), Device()]
    failures = open_devices.call_all(lambda device: device.stop(), devices)
    assert [device.calls for device in devices] == [["stop"]] * 3
    assert [(device, str(error)) for device, error in failures] == [(devices[1], "the port has gone")]


PROGRAM = """
from softfinger.server import cli
from softfinger.server.verbs import shipped

def run(args):
    raise RuntimeError("can't start new thread")

shipped.run = run
raise SystemExit(cli.main(["scenes"]))
"""


def test_a_verb_without_threads_ends_with_an_error() -> None:
    process = run_program([sys.executable, "-c", PROGRAM])
    assert process.returncode == 11
    assert process.stderr.startswith("softfinger: the system refused: no thread can be started")
