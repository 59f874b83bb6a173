"""A system without threads, such as a container at its limit of processes: devices are stopped, with one error."""

import sys
import threading

import pytest
from helpers.programs import run_program
from helpers.waits import until

from softfinger.config.load import load_rig
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers import open_devices
from softfinger.drivers.registry import open_device

pytestmark = pytest.mark.plain


class Device:
    """Device that records its calls; the one that `fails` raises an error."""

    def __init__(self, fails: bool = False, hangs: bool = False) -> None:
        self.calls: list[str] = []
        self._fails, self._hangs = fails, hangs
        self.free = threading.Event()

    def stop(self) -> None:
        self.calls.append("stop")
        if self._hangs:
            self.free.wait()
        if self._fails:
            raise OSError("the port has gone")

    def close(self) -> None:
        self.calls.append("close")


@pytest.fixture(autouse=True)
def _no_reserved_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_devices, "_reserved", [])


def leave_threads(left: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this number of threads start."""
    started, start = list[threading.Thread](), threading.Thread.start

    def start_some(thread: threading.Thread) -> None:
        if len(started) == left:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_some)


@pytest.mark.parametrize("left", range(4))
def test_every_device_is_stopped_without_threads(left: int, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_threads(left, monkeypatch)
    devices = [Device(), Device(fails=True), Device()]
    failures = open_devices.call_all(lambda device: device.stop(), devices)
    assert [device.calls for device in devices] == [["stop"]] * 3
    assert [(device, str(error)) for device, error in failures] == [(devices[1], "the port has gone")]


@pytest.mark.parametrize("hanging", range(3))
def test_a_device_that_hangs_delays_no_other_without_threads(hanging: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_devices, "STOP_TIMEOUT_S", 0.2)
    devices = [Device(hangs=number == hanging) for number in range(3)]
    open_devices.reserve_threads()
    leave_threads(0, monkeypatch)
    calls = 2 * len(open_devices._reserved)  # each call of the device that hangs takes a thread, if there is one
    for _ in range(calls):
        failures = open_devices.call_all(lambda device: device.stop(), devices)
        assert [(device, type(error)) for device, error in failures] == [(devices[hanging], TimeoutError)]
    sound = [device for device in devices if device is not devices[hanging]]
    assert [device.calls for device in sound] == [["stop"] * calls] * 2
    devices[hanging].free.set()
    until(lambda: len(open_devices._reserved) == open_devices.RESERVED_THREADS)  # not in the list of the next test


def test_a_device_is_opened_only_with_threads_for_its_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_threads(open_devices.RESERVED_THREADS - 1, monkeypatch)
    with pytest.raises(RuntimeError):
        open_device(find_single_device(load_rig("simulated")), 1000.0)


PROGRAM = """
import threading
from softfinger.server import cli
from softfinger.server.verbs import shipped

def refuse(_):
    raise {}

{} = refuse
raise SystemExit(cli.main(["scenes"]))
"""


NO_THREAD = """RuntimeError("can't start new thread")"""


@pytest.mark.parametrize(
    ("error", "refused", "reason"),
    [
        (NO_THREAD, "shipped.run", "no thread can be started"),
        (NO_THREAD, "threading.Thread.start", "no thread can be started"),
        ("ImportError('a.so: failed to map segment from shared object')", "shipped.run", "out of memory"),
    ],
)
def test_a_verb_without_threads_or_memory_ends_with_an_error(error: str, refused: str, reason: str) -> None:
    process = run_program([sys.executable, "-c", PROGRAM.format(error, refused)])
    assert process.returncode == 11
    assert process.stderr.startswith(f"softfinger: the system refused: {reason}")
