"""Daemon with failing sinks, devices and threads, and the remaining files and processes."""

import ctypes
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgpack
import numpy as np
import pytest
from helpers.daemons import QUIET, make_daemon, subscribed
from helpers.faulty_device import registered
from helpers.programs import run_program
from helpers.waits import WAIT_S, eventually

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout, RealtimeError, SafetyStop
from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.record import AT
from softfinger.server.app import Daemon
from softfinger.server.loop.realtime import Setting, raise_priority
from softfinger.server.loop.rings import Rings
from softfinger.server.services import base
from softfinger.server.services.records import Sink
from softfinger.server.verbs.run import report_settings
from softfinger.tools.pages.hazards import compute_starvation_time_s

pytestmark = pytest.mark.real_time

SYS_TGKILL = {"x86_64": 234, "aarch64": 131}


class Failure(Exception):
    """Raised by a sink."""


def test_a_failing_sink_is_dropped_and_the_others_get_every_record():
    ticks, fragile = [], []

    def breaks(records, drops):
        fragile.append(len(records))
        raise Failure("no space left")

    sinks = [Sink("fragile", breaks), Sink("box", lambda records, drops: ticks.extend(records[:, AT.tick]))]
    with make_daemon(1500, sinks=sinks) as running, subscribed(running.publisher.endpoint, "event") as socket:
        assert eventually(lambda: running.publisher.figures.subscribers == 1)
        running.start()
        assert running.wait(60.0)
        assert eventually(lambda: "records" not in {thread.name for thread in threading.enumerate()})
        running.close()
        assert ticks == list(range(1500)) and len(fragile) == 1
        events = []
        while not events or events[-1]["name"] != "stopped":
            events.append(msgpack.unpackb(socket.recv_multipart()[1]))
    faults = [(event["name"], event["sink"], event["message"]) for event in events if event["kind"] == "fault"]
    assert faults == [("sink", "fragile", "no space left")]


def test_a_failing_vital_sink_ends_the_run():
    ticks = []

    def breaks(records, drops):
        if records[-1, AT.tick] >= 200:
            raise Failure("gone")

    sinks = [
        Sink("vital", breaks, lambda error: SafetyStop(f"nobody sees it: {error}")),
        Sink("box", lambda records, drops: ticks.extend(records[:, AT.tick])),
    ]
    with make_daemon(sinks=sinks) as running:
        running.start()
        with pytest.raises(SafetyStop, match="nobody sees it: gone"):
            running.wait(60.0)
        running.close()
        assert ticks == list(range(running.servo.ticks)) and len(ticks) > 200


def test_close_does_not_wait_for_a_slow_sink(monkeypatch, caplog):
    monkeypatch.setattr(base, "JOIN_S", 0.01)
    began, let_go, ticks = threading.Event(), threading.Event(), []

    def slow(records, drops):
        ticks.extend(records[:, AT.tick])
        began.set()
        assert let_go.wait(60.0)

    with make_daemon(300, sinks=[Sink("slow", slow)]) as running:
        running.start()
        assert began.wait(60.0) and running.wait(60.0)
        running.close()
        let_go.set()
        assert eventually(lambda: len(ticks) == 300)
        assert eventually(lambda: "records" not in {thread.name for thread in threading.enumerate()})
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


@pytest.fixture
def faulty(monkeypatch):
    return registered(monkeypatch)


def make_faulty_rig(realtime="off", **options):
    changes = QUIET | {"device.driver": "faulty", "servo.realtime": realtime}
    return load_rig("replay", changes | {f"device.{key}": value for key, value in options.items()})


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("lost", DeviceLost, "faulty"),
        ("timeout", DeviceTimeout, "faulty"),
        ("protocol", DeviceLost, "faulty"),
        ("write_lost", DeviceLost, "faulty"),
        ("stall", SafetyStop, "no tick for"),
    ],
)
def test_device_failure_is_named_and_force_is_zero(fault, error, message, faulty):
    with Daemon(make_faulty_rig(fault=fault, at=700, stall_us=900_000), load_scene("paper-plane")) as running:
        running.start()
        with pytest.raises(error, match=message):
            running.wait(60.0)
    assert eventually(lambda: not running.servo.is_running)  # a stalled one is still in its read
    assert faulty.device.wrenches.any() and not faulty.device.wrenches[-1].any()


def test_a_stall_does_not_end_a_run_without_a_hand(faulty):
    rig = make_faulty_rig(fault="stall", at=200, stall_us=900_000, own_clock=True)
    with Daemon(rig, load_scene("paper-plane"), 400) as running:
        running.start()
        assert running.wait(60.0) and running.servo.ticks == 400


def test_a_signal_to_any_thread_does_not_end_it():
    """The system may deliver a signal to any thread, so each one gets many, including those of libraries."""
    syscall, number = ctypes.CDLL(None).syscall, SYS_TGKILL[os.uname().machine]
    before = signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        with make_daemon(changes={"servo.realtime": "auto"}) as running:
            running.start()
            threads = [int(entry) for entry in os.listdir("/proc/self/task")]
            assert len(threads) > 5
            for _ in range(50):
                for thread in threads:
                    syscall(number, os.getpid(), thread, signal.SIGUSR1)
                time.sleep(0.005)
            ticks = running.servo.ticks
            assert eventually(lambda: running.servo.ticks > ticks + 100)
            running.stop()
            assert running.wait(60.0)
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_a_hung_exchange_is_zeroed_by_the_supervisor(faulty, caplog):
    """Also if the device cannot be stopped; test_fingers_daemon.py tests a successful stop with two devices."""
    running = Daemon(make_faulty_rig(fault="hang", at=700, stop_fails=True), load_scene("paper-plane"))
    try:
        running.start()
        assert eventually(lambda: running.servo.ticks == 700 and len(faulty.device.wrenches) == 701)
        assert np.linalg.norm(faulty.device.wrenches[699]) > 0.9 and not faulty.device.wrenches[-1].any()
        with pytest.raises(SafetyStop, match="no tick for"), running:
            running.wait(60.0)
        assert running.servo.is_running  # still in the read
        assert "could not be stopped (OSError: the port has gone)" in caplog.text
    finally:
        faulty.device.release()  # the memory it reads must outlive the read
        assert eventually(lambda: not running.servo.is_running)


def test_a_publisher_that_waits_does_not_delay_the_zero(faulty, monkeypatch):
    released = threading.Event()
    with Daemon(make_faulty_rig(), load_scene("paper-plane")) as running:
        running.start()
        assert eventually(lambda: running.servo.ticks > 10 and faulty.device.wrenches[-1].any())
        monkeypatch.setattr(running.publisher, "send_event", lambda event: released.wait(WAIT_S))
        closing = threading.Thread(target=running.close)
        closing.start()
        try:
            assert eventually(lambda: not running.servo.is_running, WAIT_S / 4)
            assert not faulty.device.wrenches[-1].any()
        finally:
            released.set()
            closing.join()


def test_a_failed_stop_is_reported_and_everything_is_closed(faulty, caplog):
    running = Daemon(make_faulty_rig(stop_fails=True), load_scene("paper-plane"), 300)
    running.start()
    with (
        pytest.raises(DeviceError, match=r"could not be stopped \(OSError: the port has gone\).*switch it off"),
        running,
    ):
        running.wait(60.0)
    assert [act for act, *_ in faulty.device.acts] == ["arm", "stop", "close", "stop"]
    assert not faulty.device.wrenches[-1].any() and faulty.device.wrenches.any()
    assert not Path(f"/proc/{running.publisher.pids['telemetry']}").exists()
    assert not running.servo.is_running and running.servo.records.wake_fd == -1
    assert "could not be closed" in caplog.text


def test_the_device_is_armed_after_all_services_run(faulty):
    acts, threads = [], []
    reports = lambda settings: (acts.extend(faulty.device.acts), threads.extend(threading.enumerate()))  # noqa: E731
    with Daemon(make_faulty_rig(), load_scene("paper-plane"), 50, reports) as running:
        running.start()
        running.wait(60.0)
    assert acts == [] and {"records", "supervisor", "hotplug", "servo"} <= {thread.name for thread in threads}
    assert faulty.device.acts[0][::2] == ("arm", 0)


def test_repeated_stalls_end_the_run(faulty):
    hang_s = 0.24
    rig = make_faulty_rig(fault="stall", at=200, count=20, stall_us=round(1e6 * hang_s))
    with Daemon(rig, load_scene("paper-plane"), 5000) as running:
        running.start()
        with pytest.raises(SafetyStop, match=r"lost more than 50% .* in the device's exchange|no tick for"):
            running.wait(60.0)
    assert not faulty.device.wrenches[-1].any()
    reads = round(compute_starvation_time_s(hang_s) / (hang_s + 1e-3))
    assert not faulty.device.wrenches[200 + reads :].any()


HOG = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
sys.stdin.readline()
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(sys.argv[2])))
until = time.monotonic() + 2.0
while time.monotonic() < until:
    pass
"""


def read_cpu_seconds(pid: int) -> float:
    """Return the CPU time of a process so far, s."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def granted_fifo() -> bool:
    """Return True if this process may use SCHED_FIFO; tested in a thread that ends afterwards."""
    granted = []
    thread = threading.Thread(target=lambda: granted.append(raise_priority("any", threading.get_native_id(), 80).ok))
    thread.start()
    thread.join()
    return granted[0]


@pytest.mark.skipif(not granted_fifo(), reason="needs the right to SCHED_FIFO")
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs a processor for the hog alone")
def test_a_real_time_hog_does_not_delay_the_supervisor(faulty):
    """The supervisor reacts in time although a process with the servo's priority never sleeps on its processor."""
    rig = make_faulty_rig(fault="hang", at=700, realtime="auto")
    cpu, applied = max(os.sched_getaffinity(0)), []
    hog = subprocess.Popen([sys.executable, "-c", HOG, str(cpu), str(rig.servo.priority)], stdin=subprocess.PIPE)
    with Daemon(rig, load_scene("paper-plane"), None, applied.extend) as running:
        try:
            running.start()
            os.sched_setaffinity(running.supervisor.native_id, {cpu})
            assert eventually(lambda: running.servo.ticks == 700)
            started_s = read_cpu_seconds(hog.pid)
            hog.stdin.close()  # it starts
            assert eventually(lambda: len(faulty.device.wrenches) == 701)
            hogged_s = read_cpu_seconds(hog.pid) - started_s
            with pytest.raises(SafetyStop, match="no tick for"):
                running.wait(60.0)
        finally:
            faulty.device.release()
            hog.kill()
            hog.wait()
    assert [(s.ok, s.detail) for s in applied if s.name == "sched_fifo_supervisor"] == [(True, "priority 81")]
    # The supervisor notices after 0.25 s. A thread of lower priority runs when the hog has used 0.95 s of CPU time:
    # Linux then throttles real-time processes (sched_rt_runtime_us).
    assert hogged_s < 0.9


@pytest.mark.parametrize(("failing", "error"), [("publisher", "telemetry"), ("relay", "ticks cannot be received")])
def test_a_failing_publisher_or_relay_stops_the_servo(failing, error, faulty, monkeypatch):
    if failing == "relay":
        monkeypatch.setattr(Rings, "iter_feeds", lambda self: iter([None]))  # no source of records
    with Daemon(make_faulty_rig(), load_scene("paper-plane")) as running:
        running.start()
        if failing == "publisher":
            running.publisher._link.failed = True  # as if its thread had failed
        with pytest.raises(SafetyStop, match=error):
            running.wait(60.0)
    assert not faulty.device.wrenches[-1].any()


LEFT_BEHIND = """
import contextlib, os, threading
from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import Daemon
from softfinger.server.loop.servo_thread import ServoThread
rig = load_rig("replay", {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"})
scene = load_scene("paper-plane")
def once():
    with Daemon(rig, scene, 50) as running:
        running.start()
        running.wait(60.0)
    with contextlib.suppress(TypeError):  # an error after the device is open
        Daemon(rig, scene, sinks=None)
    return threading.active_count(), len(os.listdir("/proc/self/fd"))
print(once() == once() == once())
"""


def test_threads_and_descriptors_are_closed():
    completed = run_program([sys.executable, "-c", LEFT_BEHIND])
    assert completed.stdout == "True\n", completed.stderr


POWERLESS = """
import ctypes, resource, sys
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
header, no_capabilities = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
assert ctypes.CDLL(None).capset(header, no_capabilities) == 0
from softfinger.server import cli
sys.exit(cli.main(sys.argv[1:]))
"""


def test_refused_settings_with_the_same_advice_are_one_warning(caplog):
    names = ("sched_fifo", "mlockall", "sched_fifo_relay", "timer_slack")
    advice = ("raise rtprio", "raise memlock", "raise rtprio", "")
    is_granted = (False, False, False, True)
    report_settings([Setting(*row) for row in zip(names, is_granted, ["EPERM"] * 4, advice, strict=True)])
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        "real time: sched_fifo, sched_fifo_relay refused: EPERM; raise rtprio",
        "real time: mlockall refused: EPERM; raise memlock",
    ]


def test_required_realtime_that_is_refused_does_not_start(tmp_path):
    forces = tmp_path / "forces.csv"
    words = ["run", "--endpoint", "tcp://127.0.0.1:*", "--realtime", "require", "--duration", "1", "--forces", forces]
    completed = run_program([sys.executable, "-c", POWERLESS, *words])
    assert completed.returncode == RealtimeError.exit_code, completed.stderr
    assert "sched_fifo" in completed.stderr and "rtprio" in completed.stderr
    rows = np.loadtxt(forces, delimiter=",", skiprows=1, ndmin=2)
    assert len(rows) and not rows[:, 1:].any()
