"""Commands that switch the force off do not wait for requests of other clients or for the Python interpreter."""

import asyncio
import ctypes
import errno
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from helpers.faulty_device import FaultyDevice, registered
from helpers.pressed import pressed_scene
from helpers.waits import WAIT_S, eventually
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config.errors import SafetyStop
from softfinger.config.load import load_rig
from softfinger.server import signals
from softfinger.server.app import Daemon
from softfinger.server.loop.force_switch import UNREACHABLE_MAX_NS, count_unreachable, is_on, make_switch
from softfinger.server.loop.switch_fields import STOPS_HANDLED, STOPS_RECEIVED, UNREACHABLE_NS
from softfinger.server.services import command_service
from softfinger.server.services.command_service import URGENT_METHODS, WAITING_MAX
from softfinger.server.socket_process.command_clients import BURST
from softfinger.server.socket_process.force_off import SHORT_REQUEST_BYTES, ForceOffCounter, takes_force_off
from softfinger.server.states import DaemonState
from softfinger.server.wire import publisher
from softfinger.server.wire.commands import METHODS
from softfinger.server.wire.control import AsyncControl, Control
from softfinger.server.wire.envelope import parse
from softfinger.server.wire.native.switch import SharedSwitch

REPLACED_S = 60.0
"""Time until another process answers: SILENT_MAX_S and its start, on a busy machine."""
BEFORE = 48
"""Requests queued before the one under test; each takes 1 to 2 ms to answer."""


def make_daemon(monkeypatch: pytest.MonkeyPatch, folder: Path, **changes: Any) -> Daemon:
    """Return a daemon with a device that gets force; the slew limit lets it fall to zero within two ticks."""
    registered(monkeypatch)
    rig = load_rig("replay", {
        "device.driver": "faulty", "telemetry.endpoint": f"ipc://{folder}/telemetry", "servo.realtime": "off",
        "guard.ramp_s": 0.01, "guard.force_slew_n_per_s": 20_000.0, "recording.directory": str(folder), **changes,
    })  # fmt: skip
    return Daemon(rig, pressed_scene(), scene_name="pressed")


@contextmanager
def running(monkeypatch: pytest.MonkeyPatch, folder: Path, **changes: Any) -> Iterator[tuple[Daemon, FaultyDevice]]:
    with make_daemon(monkeypatch, folder, **changes) as daemon:
        daemon.start()
        (device,) = daemon.devices
        yield daemon, device
        daemon.stop()
        assert daemon.wait(WAIT_S)


def has_force(device: FaultyDevice) -> bool:
    """Return True if the last wrench of the device is a force."""
    wrenches = device.wrenches
    return len(wrenches) > 0 and bool(wrenches[-1].any())


class QueueingClient:
    """Client that sends without waiting for answers."""

    def __init__(self, endpoint: str) -> None:
        self._socket = zmq.Context.instance().socket(zmq.DEALER)
        self._socket.linger = 0
        self._socket.connect(endpoint)

    def send(self, method: str, params: Any, command_id: str) -> None:
        request = {"command_id": command_id, "method": method, "params": params}
        self._socket.send_multipart([b"", msgpack.packb(request)])

    def answers(self, wait_s: float = 0.0) -> Iterator[str]:
        """Yield the ids of answers until none arrives for `wait_s`."""
        while self._socket.poll(1000.0 * wait_s):
            yield msgpack.unpackb(self._socket.recv_multipart()[1])["command_id"]

    def close(self) -> None:
        self._socket.close()


def write_bodies(folder: Path) -> str:
    """Write a model that MuJoCo loads in tenths of a second, with more geoms than a scene may have."""
    body = '<body><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>'
    bodies = f'<replicate count="900" offset="1 0 0">{body}</replicate>'
    path = folder / "many.xml"
    path.write_text(f'<mujoco><option timestep="0.001"/><worldbody>{bodies}</worldbody></mujoco>')
    return str(path)


def make_requests(folder: Path) -> dict[str, Any]:
    """Return parameters of each method that another client sends, large ones where possible."""
    long = "x" * 2 * SHORT_REQUEST_BYTES
    rubber = {"stiffness_n_per_m": 1000.0}
    return {
        "set_params": {f"object.{number}.{long[:200]}": 1.0 for number in range(1000)},
        "set_scene": {
            "scene": {"fingertip": {"radius_m": 0.01}, "world": {"model": write_bodies(folder), "material": rubber}}
        },
        "reset_world": {},
        "drive": {"object": "lid.top", "position_m": [0.0, 0.0, 0.0], "more": long},
        "hand": {"position_m": [0.0, 0.0, 0.0]},
        "hold": {},
        "mark": {"label": "x", "data": {"text": long}},
        "get_prompt": {},
        "set_prompt": {"text": long[:4096]},
        "answer": {"value": long},
        "record_start": {"file": "all.mcap"},
        "record_stop": {},
        "describe": {},
        "mesh": {"object": 0},
    }


@pytest.mark.real_time
def test_disarm_overtakes_every_request_of_another_client(monkeypatch, tmp_path):
    requests = make_requests(tmp_path)
    assert set(requests) == METHODS.keys() - URGENT_METHODS
    with running(monkeypatch, tmp_path) as (daemon, device):
        endpoint = str(daemon.commands_endpoint)
        with Control(endpoint, WAIT_S) as control:
            for method, params in requests.items():
                assert eventually(lambda: has_force(device)), method
                second = QueueingClient(endpoint)
                for number in range(BEFORE):
                    second.send("describe", {}, f"before {number}")
                second.send(method, params, "last")
                answered = [next(second.answers(WAIT_S))]  # so that all have arrived
                assert control.disarm().armed is False
                assert eventually(lambda: not has_force(device)), method
                answered += second.answers()
                assert "last" not in answered, method
                assert len(answered) < BEFORE, method
                while "last" not in answered:
                    answered.append(next(second.answers(WAIT_S)))
                second.close()
                assert not has_force(device)
                control.arm()
            second = QueueingClient(endpoint)
            for number in range(WAITING_MAX):
                second.send("describe", {}, str(number))
            assert next(second.answers(WAIT_S)) == "0"
            assert control.stop().shutting_down
            assert len(list(second.answers())) < WAITING_MAX - 1
            assert daemon.wait(WAIT_S)
            second.close()


@pytest.mark.real_time
@pytest.mark.parametrize("client", ["blocking", "asyncio"])
def test_a_lost_disarm_is_repeated(client, monkeypatch, tmp_path):
    async def disarm_in_task() -> Any:
        async with AsyncControl(endpoint, REPLACED_S) as control:
            await control.describe()
            os.kill(pid, signal.SIGSTOP)
            return await control.disarm()

    with running(monkeypatch, tmp_path) as (daemon, device):
        endpoint, pid = str(daemon.commands_endpoint), daemon.publisher.pids["commands"]
        assert eventually(lambda: has_force(device))
        if client == "asyncio":
            armed = asyncio.run(disarm_in_task())
        else:
            with Control(endpoint, REPLACED_S) as control:
                control.describe()
                os.kill(pid, signal.SIGSTOP)
                armed = control.disarm()
        assert armed.armed is False and daemon.publisher.pids["commands"] != pid
        assert eventually(lambda: not has_force(device))
        with Control(endpoint, WAIT_S) as control:  # the request that was lost does not count any more
            control.arm()
            assert eventually(lambda: has_force(device))


@pytest.mark.real_time
def test_subscribers_do_not_delay_disarm(monkeypatch, tmp_path):
    with running(monkeypatch, tmp_path) as (daemon, device), Control(str(daemon.commands_endpoint), WAIT_S) as control:
        assert eventually(lambda: has_force(device))
        os.kill(daemon.publisher.pids["telemetry"], signal.SIGSTOP)
        try:
            assert control.disarm().armed is False
            assert eventually(lambda: not has_force(device))
        finally:
            os.kill(daemon.publisher.pids["telemetry"], signal.SIGCONT)


KILL = ctypes.PyDLL(None).kill
"""Send a signal with the GIL."""
HOLD = ctypes.PyDLL(None).usleep
"""Sleep for a number of us with the GIL, so that no Python thread runs."""


def measure_zero_share(device: FaultyDevice, act: Callable[[], object] = lambda: None) -> float:
    """Hold the GIL for 1 s; return the share of the wrenches of that time that are zero and follow the last force.

    act  called with the GIL immediately before
    """
    count = len(device.wrenches)
    act()
    HOLD(1_000_000)
    wrenches = device.wrenches
    return (len(wrenches) - 1 - int(np.flatnonzero(wrenches.any(axis=1))[-1])) / (len(wrenches) - count)


@pytest.mark.real_time
def test_the_force_ends_while_python_does_nothing(monkeypatch, tmp_path):
    with running(monkeypatch, tmp_path, **{"commands.heartbeat_s": 0.3}) as (daemon, device):
        endpoint = str(daemon.commands_endpoint)
        with Control(endpoint, WAIT_S) as control:
            while not has_force(device):
                control.heartbeat()
                time.sleep(0.005)  # more than 100 requests in 0.1 s are refused
            assert measure_zero_share(device) > 0.5
            assert control.describe()["armed"] is False and not has_force(device)
            control.heartbeat()
            assert eventually(lambda: has_force(device))
    with running(monkeypatch, tmp_path) as (daemon, device):
        endpoint = str(daemon.commands_endpoint)
        with Control(endpoint, WAIT_S) as control:
            second = QueueingClient(endpoint)
            second.send("get_state", {}, "connected")
            assert next(second.answers(WAIT_S)) == "connected"
            assert eventually(lambda: has_force(device))
            for number in range(BURST + 1):
                second.send("arm", {}, str(number))
            second.send("disarm", {}, "off")
            assert measure_zero_share(device) > 0.45
            assert "off" in second.answers(WAIT_S) and not has_force(device)
            second.send("disarm", {"now": True}, "declined")  # switches the force off until it is declined
            assert next(second.answers(WAIT_S)) == "declined"
            second.close()
            assert control.describe()["armed"] is False
            control.arm()
            assert eventually(lambda: has_force(device))


@pytest.mark.real_time
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGALRM])
def test_a_signal_ends_the_force_while_python_does_nothing(number, monkeypatch, tmp_path):
    """As while a library holds the interpreter lock for seconds to parse a large mesh."""
    with running(monkeypatch, tmp_path) as (daemon, device), signals.handle_signals():
        signals.mark_imported()
        with signals.stop_on_signal(daemon.stop, daemon.pause, daemon.switch_file):
            assert eventually(lambda: has_force(device))
            with ThreadPoolExecutor() as pool:  # the signal would end the sleep of the main thread
                assert pool.submit(measure_zero_share, device, lambda: KILL(os.getpid(), number)).result() > 0.5
            assert daemon.wait(WAIT_S) and not has_force(device)


@pytest.mark.real_time
def test_a_signal_ends_the_run_in_a_sandbox_that_refuses_splice(monkeypatch, tmp_path):
    def refuse(*_: object, **__: object) -> int:
        raise PermissionError(errno.EPERM, "not permitted")

    monkeypatch.setattr(os, "splice", refuse)
    with running(monkeypatch, tmp_path) as (daemon, device), signals.handle_signals():
        signals.mark_imported()
        with signals.stop_on_signal(daemon.stop, daemon.pause, daemon.switch_file):
            assert eventually(lambda: has_force(device))
            os.kill(os.getpid(), signal.SIGTERM)
            assert daemon.wait(WAIT_S) and not has_force(device)


@pytest.mark.real_time
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGPROF])
def test_the_force_ends_with_the_process_of_commands_and_returns_after_arm(number, monkeypatch, tmp_path):
    """Also while Python does nothing; the process is replaced, and neither that nor heartbeats restore the force."""
    with running(monkeypatch, tmp_path, **{"commands.heartbeat_s": 60.0}) as (daemon, device):
        assert eventually(lambda: has_force(device))
        pid = daemon.publisher.pids["commands"]
        os.kill(pid, number)
        assert measure_zero_share(device) > 0.5
        with Control(str(daemon.commands_endpoint), REPLACED_S) as control:
            control.heartbeat()
            assert control.describe()["armed"] is False and daemon.publisher.pids["commands"] != pid
            count = len(device.wrenches)
            assert eventually(lambda: len(device.wrenches) > count + 300)  # the ramp takes 10
            assert not device.wrenches[count:].any()
            control.arm()
            assert eventually(lambda: has_force(device))


@pytest.mark.real_time
def test_the_force_returns_when_a_process_of_commands_continues(monkeypatch, tmp_path):
    """It has lost no request, so a person need not arm; a `disarm` that waited for it has its effect."""
    monkeypatch.setattr(publisher, "SILENT_MAX_S", WAIT_S)
    with running(monkeypatch, tmp_path) as (daemon, device):
        second = QueueingClient(str(daemon.commands_endpoint))
        pid = daemon.publisher.pids["commands"]
        for method, armed in (("get_state", True), ("disarm", False)):
            assert eventually(lambda: has_force(device) and daemon.states.now is DaemonState.ARMED)
            os.kill(pid, signal.SIGSTOP)
            assert eventually(lambda: not has_force(device))
            assert eventually(lambda: daemon.states.now is DaemonState.FAULTED)
            second.send(method, {}, method)
            os.kill(pid, signal.SIGCONT)
            assert next(second.answers(WAIT_S)) == method
            assert daemon.rendering.force.is_requested is armed
        assert eventually(lambda: daemon.states.now is DaemonState.READY)
        assert eventually(lambda: not has_force(device))
        assert daemon.publisher.pids["commands"] == pid
        second.close()


@pytest.mark.real_time
def test_no_tick_before_commands_can_be_received(monkeypatch, tmp_path):
    monkeypatch.setattr(command_service, "START_S", 0.1)
    with make_daemon(monkeypatch, tmp_path) as daemon:
        os.kill(daemon.publisher.pids["commands"], signal.SIGSTOP)
        daemon.publisher._switch.require_process()  # it may have started
        with pytest.raises(SafetyStop, match=r"^the process that receives commands is not ready"):
            daemon.start()
        assert daemon.servo.ticks == 0
    (device,) = daemon.devices
    assert not device.wrenches.any()


@given(st.integers(125_000, 1_000_000_000), st.integers(0, 1000))
def test_the_force_is_off_while_no_request_is_read(period: int, ticks: int) -> None:
    """The process of commands resets the time; without this process, as with `--commands off`, no time counts."""
    switch = make_switch()
    for _ in range(ticks):
        count_unreachable(switch, period)
    assert is_on(switch, 0)
    switch[UNREACHABLE_NS] = 0
    for _ in range(ticks):
        count_unreachable(switch, period)
    assert is_on(switch, 0) == (ticks * period <= UNREACHABLE_MAX_NS)
    switch[UNREACHABLE_NS] = 0
    assert is_on(switch, 0)


@pytest.mark.plain
def test_a_process_that_exits_leaves_a_disarm():
    """Requests to turn the force off that it did not pass on are not counted separately: the counts become equal."""
    switch = SharedSwitch()
    ForceOffCounter(os.dup(switch.file)).count(2)
    assert (switch.words[STOPS_RECEIVED], switch.words[STOPS_HANDLED]) == (2, 0)
    (request,) = switch.replace_process()
    assert parse(request).method == "disarm"
    assert (switch.words[STOPS_RECEIVED], switch.words[STOPS_HANDLED]) == (2, 1)
    switch.count_handled(request)
    assert switch.words[STOPS_RECEIVED] == switch.words[STOPS_HANDLED]
    switch.close()


@pytest.mark.plain
def test_which_requests_take_the_force_off():
    def request(**keys: Any) -> bytes:
        return bytes(msgpack.packb(keys))

    assert takes_force_off(request(command_id="a", method="disarm", params={}))
    assert takes_force_off(request(method="stop", other=[1, {"a": None}], command_id="a"))
    for body in (
        b"", b"disarm", request(method="arm", command_id="disarm"), request(command_id="stop"),
        request(method="record_stop"), request(method=["disarm"]), msgpack.packb(["method", "disarm"]),
        request(method="disarm", data="x" * SHORT_REQUEST_BYTES),
        b"\x91" * 2000 + b"disarm", b"\xdf\xff\xff\xff\xffdisarm",
    ):  # fmt: skip
        assert not takes_force_off(body), body
