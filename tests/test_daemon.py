"""The daemon as its users run it: a process of its own, plain ZeroMQ clients, signals."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq
from faulty_device import FaultyDevice, Options

from softfinger.config.errors import DeviceLost, DeviceTimeout, RealtimeError, SafetyStop
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers import registry
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.state import OFFSET
from softfinger.server.app import Daemon
from softfinger.server.simulate import simulate
from softfinger.server.tuning import make_tuning

COMMAND = [sys.executable, "-m", "softfinger.server.cli"]


@contextmanager
def daemon(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`softfinger run` on an endpoint of its own, killed in the end if it still runs."""
    with zmq.Context() as context, context.socket(zmq.PUB) as probe:
        # Below the ports that the system gives to clients: there, one that connects early may meet itself.
        port = probe.bind_to_random_port("tcp://127.0.0.1", min_port=20_000, max_port=32_000)
        endpoint = f"tcp://127.0.0.1:{port}"
    process = subprocess.Popen([*COMMAND, "run", "--endpoint", endpoint, *words], stderr=subprocess.PIPE, text=True)
    try:
        yield process, endpoint
    finally:
        process.kill()
        process.communicate()


@contextmanager
def subscribed(endpoint: str, *topics: str) -> Iterator[zmq.Socket[bytes]]:
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger, socket.rcvhwm, socket.rcvtimeo = 0, 0, 120_000  # a cold start compiles first
        for topic in topics:
            socket.subscribe(topic)
        socket.connect(endpoint)
        yield socket


def test_plain_client_gets_every_tick_and_all_modes():
    """pyzmq and msgpack alone receive consecutive ticks from the shipped recording, in all three modes."""
    with daemon() as (_, endpoint), subscribed(endpoint, "contact") as socket:
        ticks, modes = [], set()
        while len(modes) < 3 or len(ticks) < 2000:
            frames = socket.recv_multipart()
            assert len(frames) == 2 and frames[0] == b"contact"
            message = msgpack.unpackb(frames[1])
            ticks.append(message["tick"])
            modes.add(message["contact"]["mode"])
            assert len(ticks) < 30_000
    assert np.array_equal(np.diff(ticks), np.ones(len(ticks) - 1))


def saved_forces(path: Path) -> np.ndarray:
    with np.load(path) as saved:
        return np.hstack([saved["force"], saved["torque"]])


def test_two_replays_and_simulate_are_bit_identical(tmp_path):
    """Two daemons and the offline run command the same forces to the last bit, and end with zero."""
    runs = []
    for name in ("a.npz", "b.npz"):
        words = ["--recording", "tap", "--once", "--forces", str(tmp_path / name), "--realtime", "off"]
        with daemon(*words) as (process, _):
            assert process.wait(180) == 0
        runs.append(saved_forces(tmp_path / name))
    assert runs[0].tobytes() == runs[1].tobytes()
    tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard)
    records = simulate(tuning, resample(load_poses("tap"), 1000.0), 1000.0)
    offline = np.hstack([records[:, OFFSET[name] : OFFSET[name] + 3] for name in ("force", "torque")])
    assert np.abs(offline).max() > 0.5
    assert runs[0][: len(offline)].tobytes() == offline.tobytes()
    assert not runs[0][len(offline) :].any() and len(runs[0]) > len(offline)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_stops_in_order_with_zero_force(number, tmp_path):
    """Either signal ends the daemon with exit code 0, and the last wrench written is zero."""
    forces = tmp_path / "forces.npz"
    with daemon("--forces", str(forces)) as (process, endpoint):
        with subscribed(endpoint, "contact") as socket:
            while np.linalg.norm(msgpack.unpackb(socket.recv_multipart()[1])["force"]) < 0.5:
                pass
        process.send_signal(number)
        assert process.wait(30) == 0
    written = saved_forces(forces)
    assert np.linalg.norm(written[-20:-2, :3], axis=1).max() > 0.1
    assert not written[-1].any()


def test_events_tell_every_transition(tmp_path):
    """Each mode change that simulate finds on the same poses arrives as an event with tick, cause and forces."""
    tuning = make_tuning(load_scene("paper-plane"), load_rig("replay").guard)
    records = simulate(tuning, resample(load_poses("press-roll-spin-drag"), 1000.0), 1000.0)
    expected = [int(row[OFFSET["tick"]]) for row in records if row[OFFSET["contact.cause"]]]
    seen = []
    with daemon("--once", "--realtime", "off") as (process, endpoint), subscribed(endpoint, "event") as socket:
        while True:
            event = msgpack.unpackb(socket.recv_multipart()[1])
            if event["kind"] == "contact":
                seen.append(event)
            elif event["kind"] == "lifecycle" and event["name"] == "stopped":
                break
        assert process.wait(30) == 0
    assert [event["tick"] for event in seen] == expected
    assert seen[0]["cause"] == "touch" and seen[-1]["cause"] == "release"
    assert all(len(event["force"]) == 3 and event["normal_force"] >= 0.0 for event in seen)


def test_stopped_is_told_however_late_the_close():
    """The last event leaves even when the publisher thread ended long before the daemon is closed."""
    rig = load_rig("replay", {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"})
    with (
        Daemon(rig, load_scene("paper-plane"), 2000) as running,
        subscribed(running.publisher.endpoint, "event", "contact") as socket,
    ):
        running.start()
        assert socket.recv_multipart()  # subscribed
        running.wait(60.0)
        while any(thread.name == "publisher" for thread in threading.enumerate()):
            time.sleep(0.01)
        running.close()
        socket.rcvtimeo = 5000
        last = None
        while last != "stopped":
            last = msgpack.unpackb(socket.recv_multipart()[1]).get("name")


class FaultyDriver:
    """A driver module as the registry gives it, for a device that breaks."""

    Options = Options

    def __init__(self) -> None:
        self.device: FaultyDevice | None = None

    def open_device(self, options: Options, rate_hz: float) -> FaultyDevice:
        self.device = FaultyDevice(options)
        return self.device


@pytest.fixture
def faulty(monkeypatch):
    driver = FaultyDriver()
    load = registry.load
    monkeypatch.setattr(registry, "load", lambda name: driver if name == "faulty" else load(name))
    return driver


def faulty_rig(**options):
    changes = {"device.driver": "faulty", "telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"}
    return load_rig("replay", changes | {f"device.{key}": value for key, value in options.items()})


@pytest.mark.parametrize(
    ("fault", "error"),
    [("lost", DeviceLost), ("timeout", DeviceTimeout), ("protocol", DeviceLost), ("write_lost", DeviceLost)],
)
def test_device_failure_is_named_and_force_is_zero(fault, error, faulty):
    """Each way a device fails gives its own error, after the device was told zero."""
    with Daemon(faulty_rig(fault=fault, at=200), load_scene("paper-plane"), 1000) as running:
        running.start()
        with pytest.raises(error, match="faulty"):
            running.wait(60.0)
    assert not faulty.device.wrenches[-1].any()


def test_stalled_servo_is_stopped_and_zeroed(faulty):
    """When the device's exchange hangs, the supervisor zeroes the device from outside and says so."""
    with Daemon(faulty_rig(fault="stall", at=200, stall_us=900_000), load_scene("paper-plane")) as running:
        running.start()
        with pytest.raises(SafetyStop, match="no tick for"):
            running.wait(60.0)
    assert not faulty.device.wrenches[-1].any()


def test_failing_publisher_stops_the_servo(faulty):
    """If telemetry cannot be published, the servo stops with zero force instead of running unseen."""
    with Daemon(faulty_rig(), load_scene("paper-plane")) as running:
        running.start()
        running.publisher._socket.close()  # the socket breaks under the publisher
        running.publisher._socket = None
        with pytest.raises(SafetyStop, match="telemetry"):
            running.wait(60.0)
        running.publisher._socket = zmq.Context.instance().socket(zmq.PUB)
    assert not faulty.device.wrenches[-1].any()


LEFT_BEHIND = """
import os, threading
from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import Daemon
rig = load_rig("replay", {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"})
scene = load_scene("paper-plane")
def once():
    with Daemon(rig, scene, 50) as running:
        running.start()
        running.wait(60.0)
    return threading.active_count(), len(os.listdir("/proc/self/fd"))
print(once() == once() == once())
"""


def test_nothing_is_left_behind():
    """After a daemon has closed, its threads and file descriptors are gone; asked of a process without others."""
    done = subprocess.run([sys.executable, "-c", LEFT_BEHIND], capture_output=True, text=True, timeout=300)
    assert done.stdout == "True\n", done.stderr


def test_required_realtime_that_is_refused_does_not_start(tmp_path):
    """Without the right to real time, `--realtime require` ends with its exit code and what to do, at zero force."""
    forces = tmp_path / "forces.csv"
    code = (
        "import ctypes, resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "header, no_capabilities = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()\n"
        "assert ctypes.CDLL(None).capset(header, no_capabilities) == 0\n"
        "from softfinger.server import cli\n"
        "sys.exit(cli.main(['run', '--endpoint', 'tcp://127.0.0.1:*', '--realtime', 'require', '--duration', '1',\n"
        "                   '--forces', sys.argv[1]]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(forces)], capture_output=True, text=True, timeout=300)
    assert done.returncode == RealtimeError.exit_code, done.stderr
    assert "sched_fifo" in done.stderr and "rtprio" in done.stderr
    rows = np.loadtxt(forces, delimiter=",", skiprows=1, ndmin=2)
    assert len(rows) and not rows[:, 1:].any()
