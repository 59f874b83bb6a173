"""Exchange with Haply's Inverse Service, emulated in a separate process on real sockets: forces its device received."""

import argparse
import contextlib
import json
import math
import os
import re
import signal
import socketserver
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any, ClassVar

import numpy as np
import pytest
from helpers.haply_devices import ID, RIG, Service, opened, rig_options, settle
from helpers.shortages import refuse_threads
from helpers.waits import eventually, fresh, until

from softfinger.config.errors import ConfigError, DeviceBusy, DeviceError, DeviceNotFound
from softfinger.config.load import find
from softfinger.config.schema import Rig
from softfinger.drivers import switch_interval
from softfinger.drivers.base import HELD, LOST, OK, PROTOCOL, TIMEOUT, WITHHELD, Device
from softfinger.drivers.haply.device import HaplyDevice, identify, open_device
from softfinger.drivers.system import discovery
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server import driver_contract
from softfinger.server.driver_contract import DeviceCaller
from softfinger.server.verbs import devices

pytestmark = pytest.mark.real_time

GRIP = "wireless_verse_grip:7"
BOARD = SystemDevice("serial", 0x16C0, 0x0483, "Haply inverse3", "", "/dev/ttyACM0")


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    assert not [thread for thread in threading.enumerate() if thread.name == "haply exchange"]


class Bench(driver_contract.Bench):
    patience_s: ClassVar[float] = 10.0
    cannot: ClassVar[Mapping[str, str]] = {
        "permission": "the service opens the device, and every program of this machine may speak to the service"
    }

    def __init__(self, service: Service) -> None:
        self.service = service
        self.rival: Device | None = None

    def open(self) -> Device:
        self.device = opened(self.service)
        return self.device

    def displayed(self) -> tuple[float, ...]:
        settle(self.device)
        return self.service.force()

    def make(self, case: str) -> None:
        if case == "timeout":
            self.service.set(mute=True)
        elif case == "busy":
            self.rival = opened(self.service)
        else:
            self.service.do("vanish", id=ID)

    def mend(self) -> None:
        if self.rival is not None:
            self.rival.close()
        self.service.set(mute=False)
        self.service.do("return", id=ID)


@pytest.fixture(params=["3.5.0", pytest.param("3.1.1", marks=pytest.mark.exhaustive)])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    with Service(request.param) as service:
        yield Bench(service)


class TestContract(driver_contract.DriverContract):
    """The contract over both keys of a force."""


@pytest.fixture
def service() -> Iterator[Service]:
    with Service(grips=(GRIP,)) as running:
        yield running


@contextlib.contextmanager
def exchanging(service: Service, **changes: Any) -> Iterator[tuple[HaplyDevice, DeviceCaller]]:
    """Open a device, and wait for its first state."""
    with opened(service, **changes) as device:
        servo = DeviceCaller(device)
        fresh(servo)
        yield device, servo


def push_up(device: HaplyDevice, servo: DeviceCaller) -> None:
    """Write 1 N along z, and wait until it is sent."""
    servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    settle(device)


def at_rest(service: Service) -> None:
    until(lambda: not any(service.force()))


def first_failure(servo: DeviceCaller) -> int:
    return int(eventually(lambda: min(servo.read()[0], 0)))


def move_handle(servo: DeviceCaller, service: Service, to: dict[str, float]) -> list[float]:
    service.do("move", id=ID, to=to)
    for _ in range(2):  # one state with the old position may be unread, another in flight
        fresh(servo)
    return fresh(servo)


def test_pose_and_force_in_the_world(service: Service) -> None:
    half = math.sqrt(0.5)
    turn = {"position_m": [0.1, 0.2, 0.3], "orientation_wxyz": [half, 0.0, 0.0, half]}  # a quarter turn about z
    service.do("grip", id="7", to={"orientation": {"w": 1.0, "x": 1.0, "y": 0, "z": 0},
                                   "buttons": {"a": True, "b": False, "c": True}})  # fmt: skip
    with opened(service, mounting=turn) as device:
        assert device.info.sensed_dof == 6
        servo = DeviceCaller(device)
        sample = move_handle(servo, service, {"x": 0.01, "y": -0.1, "z": 0.17})
        np.testing.assert_allclose(sample[:3], (0.1 + 0.1, 0.2 + 0.01, 0.3 + 0.17), atol=1e-12)  # rounding
        np.testing.assert_allclose(sample[3:7], (0.5, 0.5, 0.5, 0.5), atol=1e-12)
        assert sample[8] == 5
        servo.write(0.5, -0.25, 1.0, 3.0, 3.0, 3.0)
        settle(device)
        np.testing.assert_allclose(service.force(), (-0.25, -0.5, 1.0), atol=1e-12)


def test_the_device_names_its_thread(service: Service) -> None:
    with opened(service) as device:
        threads = [thread.native_id for thread in threading.enumerate() if thread.name == "haply exchange"]
        assert device.thread_ids() == threads and len(threads) == 1


def test_without_a_grip_there_is_no_orientation() -> None:
    with Service() as alone, opened(alone) as device:
        assert device.info.sensed_dof == 3
        np.testing.assert_allclose(fresh(DeviceCaller(device))[:7], (0, 0, 0, 1, 0, 0, 0), atol=1e-12)  # rounding


def test_a_wired_grip_has_one_button() -> None:
    with Service(grips=("verse_grip:61548",)) as wired:
        wired.do("grip", id="61548", to={"button": True})
        with opened(wired, grip="61548") as device:
            assert fresh(DeviceCaller(device))[8] == 1


def test_a_message_is_sent_after_the_last_is_answered(service: Service) -> None:
    late_s = 0.02
    service.set(late_s=late_s)
    with exchanging(service) as (device, servo):
        before, statuses, begun = device.counts(), [], time.monotonic()
        for n in range(1, 51):
            statuses.append(servo.write(0.01 * n, 0.0, 0.0, 0.0, 0.0, 0.0))
            time.sleep(0.001)
        settle(device)
        after = device.counts()
        assert after["messages"] - before["messages"] <= (time.monotonic() - begun) / late_s + 2
        assert abs(after["messages"] - after["states"]) <= 2  # the first state, and one in flight
        assert after["unasked"] == 0
        assert set(statuses) == {OK, HELD}
        expected = [0.01 * n for n, status in enumerate(statuses, 1) if status == OK]
        forces = [force[0] for force, _ in groupby(force for _, force in service.commands()) if any(force)]
        assert forces == pytest.approx(expected, abs=1e-12)  # rounding
        assert after["held"] == statuses.count(HELD)


def test_a_force_is_under_the_key_of_an_older_service() -> None:
    with Service("3.4.2") as old, exchanging(old) as (device, servo):
        push_up(device, servo)
        assert old.force() == (0.0, 0.0, 1.0) and '"set_cursor_force":{"values"' in old.do("seen")["said"][0]


@pytest.mark.parametrize(
    ("page", "message"),
    [
        ('{"project_version":"4.0.0.0"}', "version 4.0.0.0; this driver supports 3.1 to 3.x"),
        ('{"project_version":"new"}', "the version 'new', which is not a version number"),
        ('{"project_version":' + 9000 * "[", "returns no version"),
    ],
    ids=["next", "no number", "deep"],
)
def test_a_service_of_another_version_is_rejected(page: str, message: str, service: Service) -> None:
    service.set(pages={"/version": page})
    with pytest.raises(DeviceError, match=message):
        opened(service)
    opened(service, version="3.5").close()


def test_the_error_lists_available_devices() -> None:
    with Service(
        devices=("inverse3:049D", "minverse:0A11"), grips=("wireless_verse_grip:1", "wireless_verse_grip:2")
    ) as two:
        with pytest.raises(DeviceNotFound, match=r"2 devices.*device_id: inverse3 049D, minverse 0A11"):
            opened(two, models=None)
        with pytest.raises(DeviceNotFound, match=r"device_id = 'FFFF'.*lists inverse3 049D, minverse 0A11.*plug it in"):
            opened(two, device_id="FFFF")
        with pytest.raises(DeviceNotFound, match=r"2 VerseGrips.*name one with grip.*wireless_verse_grip 1"):
            opened(two, device_id="0A11", models=None)
        with pytest.raises(DeviceNotFound, match=r"no VerseGrip '3'.*pair it"):
            opened(two, device_id="0A11", models=None, grip="3")
        with exchanging(two, device_id="0A11", models=None, grip="none") as (device, servo):
            servo.write(0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
            settle(device)
            assert (two.force("0A11"), two.force("049D")) == ((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    with Service(devices=()) as empty, pytest.raises(DeviceNotFound, match=r"lists no device: plug it in"):
        opened(empty)


def test_the_error_without_a_service_names_the_one_to_start() -> None:
    with Service() as ended:
        port = ended.port
    with pytest.raises(
        DeviceNotFound, match=rf"no Inverse Service on port {port}.*systemctl start haply-inverse-service"
    ):
        open_device(rig_options(port), 1000.0)
    with pytest.raises(ConfigError, match=r"port of format 3.0"):
        rig_options(10000)


@pytest.mark.parametrize("enveloped", [False, True])
def test_filters_are_set_as_in_the_rig(enveloped: bool, service: Service) -> None:
    service.set(enveloped=enveloped, version_enveloped=enveloped)
    assert identify(BOARD, rig_options(service.port))["service"] == "3.5.0.0"
    changed = {"force_gate": 0.0, "damping": 0.5, "gravity_compensation": False, "torque_scaling": False}
    opened(service, filters=changed).close()
    filters = service.do("settings", id=ID)
    for name in ("home_return", "gravity_compensation", "torque_scaling"):
        assert not filters[name]["enabled"]
    session = service.do("seen")["sessions"]
    requests = service.do("seen")["asked"]
    assert f'POST /inverse3/{ID}/config/force_gate?session={session} {{"gain":0.0}}' in requests
    assert f'POST /inverse3/{ID}/config/damping?session={session} {{"scalar":0.5}}' in requests
    applied = '{"gain":0.9}'
    for page, answer, words in (
        (f"force_gate?session={session + 1}", f'{{"ok":true,"data":{applied}}}' if enveloped else applied, r"0\.9"),
        ("torque_scaling", '{"ok":false,"error":"locked"}', "locked"),
    ):
        service.set(pages={f"/inverse3/{ID}/config/{page}": answer})
        with pytest.raises(DeviceError, match=rf"refused /inverse3/049D/config/{page.partition('?')[0]}.*{words}"):
            opened(service)


def test_a_wrong_version_in_the_rig_is_rejected(service: Service) -> None:
    """A service of 3.5 ignores forces under the key of 3.4, so a rig with that version is rejected."""
    with pytest.raises(DeviceError, match=r"version = 3\.4 .*is version 3\.5\.0\.0.*remove version"):
        opened(service, version="3.4")
    opened(service, version="3.5").close()


def test_another_kind_of_device_is_refused() -> None:
    with Service(devices=("minverse:0A11",)) as mini:
        with pytest.raises(DeviceNotFound, match=r"lists minverse 0A11.*for inverse3, inverse3x.*haply-minverse"):
            opened(mini)
        opened(mini, models=["minverse"]).close()
        opened(mini, models=None).close()
        mini.set(types={"0A11": "inverse3x"})
        opened(mini).close()
        mini.set(types={"0A11": "new"})
        with pytest.raises(DeviceNotFound, match="rig is for"):
            opened(mini)
    with Service(devices=("inverse3:049D", "minverse:0A11")) as both, opened(both) as device:
        assert "inverse3 049D" in device.info.name


def test_filters_of_an_older_service() -> None:
    with Service("3.3.0") as old:
        opened(old, filters={"torque_scaling": False, "gravity_scale": 0.8}).close()
        filters = old.do("settings", id=ID)
        assert filters["torque_scaling"] == {"enabled": False}
        assert filters["gravity_compensation"] == {"enabled": True, "scaling_factor": 0.8}
        with pytest.raises(DeviceError, match=r"force_gate and damping can only be set at a service of 3.5"):
            opened(old, filters={"force_gate": 0.0})


def test_a_workspace_that_was_moved_is_refused(service: Service) -> None:
    """A mount or workspace that rotates, moves or scales positions would also affect forces, so it is rejected, at top
    level and below `transform`, as is one of unknown form. An empty mount is accepted."""
    still = {"position": {"x": 0, "y": 0, "z": 0}, "rotation": {"w": 1, "x": 0, "y": 0, "z": 0}}
    none, doubled = ({**still, "scale": dict.fromkeys("xyz", size)} for size in (1, 2))
    for place in (
        {"mount": doubled},
        {"mount": {"transform": doubled}},
        {"mount": {"transform": still}},
        {"mount": {"offset": 1}},
        {"mount": none, "transform": doubled},
    ):
        service.set(**place)
        with pytest.raises(DeviceError, match=r"moves, turns or scales.*reset mount and workspace"):
            opened(service)
    service.set(transform=none)
    for mount in ({}, {"transform": {}}, {"transform": none}, None):
        service.set(mount=mount)
        opened(service).close()


def test_a_workspace_that_is_moved_during_a_run_ends_it(service: Service) -> None:
    with exchanging(service) as (device, servo):
        push_up(device, servo)
        service.set(
            transform={
                "position": {"x": 0, "y": 0, "z": 0},
                "rotation": {"w": 1, "x": 0, "y": 0, "z": 0},
                "scale": {"x": 2, "y": 1, "z": 1},
            }
        )
        assert first_failure(servo) == LOST
        assert "moves, turns or scales its positions" in device.reason()
        at_rest(service)


def test_a_device_without_a_state_is_one_clear_error(service: Service) -> None:
    for key in ("state", "config"):
        service.set(spoil=f'{{"session_id":1,"inverse3":[{{"device_id":"{ID}","{key}":null}}]}}')
        with pytest.raises(DeviceError, match=f"^inverse3 {ID}: the service lists it without a state: switch it on"):
            opened(service)
    service.set(spoil=None)


def test_warnings_of_the_service_are_reported(service: Service) -> None:
    with exchanging(service) as (device, _):
        assert device.warning() == ""
        for status, warning in (
            ({"power_supply": False, "calibrated": False}, "no power supply and exerts no force; it is not calibrated"),
            ({"power_supply": True, "calibrated": True}, ""),
        ):
            service.do("status", id=ID, to=status)
            until(lambda warning=warning: warning in device.warning() and bool(warning) == bool(device.warning()))


def test_the_lock_is_for_one_service() -> None:
    with Service() as first, Service() as second, opened(first), opened(second):
        for service in (first, second):
            with pytest.raises(DeviceBusy, match=f"on port {service.port} is in use by this program"):
                opened(service)


def test_an_old_wrench_becomes_zero(service: Service) -> None:
    with exchanging(service, stale_s=0.02) as (device, servo):
        begun = time.monotonic()
        push_up(device, servo)
        until(lambda: servo.read()[0] == WITHHELD)
        at_rest(service)
        forces = [row[3] for row in service.log() if row[0] >= begun]
        assert 1.0 in forces
        fresh(servo)


BAD: dict[str, tuple[str, int, str]] = {
    "no JSON": ("}{", PROTOCOL, "malformed"),
    "no state": (f'{{"inverse3":[{{"device_id":"{ID}"}}]}}', PROTOCOL, "missing required field `state`"),
    "deep": ('{"a":' + 5000 * "[", PROTOCOL, "the service answered"),
    "huge": ('{"a":"' + 300_000 * "x" + '"}', PROTOCOL, "over size limit|262144"),
    "a name that steers terminals": (
        '{"inverse3":[{"device_id":"\\u001b[2J","state":{}}]}', PROTOCOL, "matching regex",
    ),
    "null": (f'{{"inverse3":[{{"device_id":"{ID}","state":null}}]}}', LOST, "lists it without a state"),
    "nobody": ("{}", LOST, "inverse3 049D is no longer in the service's list"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_malformed_message_ends_the_exchange(case: str, service: Service) -> None:
    text, wanted, reason = BAD[case]
    with exchanging(service) as (device, servo):
        push_up(device, servo)
        service.set(spoil=text)
        assert first_failure(servo) == wanted
        assert re.search(reason, device.reason()), device.reason()
        assert len(device.reason()) < 400 and "\x1b" not in device.reason()
        assert servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == wanted
        at_rest(service)
    service.set(spoil=None)
    opened(service).close()


def test_a_grip_that_disappears_is_a_loss(service: Service) -> None:
    """If the grip in use is no longer listed, the device is lost: otherwise its orientation would be frozen."""
    with exchanging(service) as (device, servo):
        service.do("vanish", id="7")
        assert first_failure(servo) == LOST
        assert "wireless_verse_grip 7 is no longer in the service's list" in device.reason()


def test_a_stopped_service_blocks_no_call(service: Service) -> None:
    device = opened(service, timeout_s=0.3)
    servo = DeviceCaller(device)
    fresh(servo)
    push_up(device, servo)
    os.kill(service.process.pid, signal.SIGSTOP)
    try:
        assert first_failure(servo) == TIMEOUT
        device.stop()
        device.close()
        assert "has not answered" in device.zero_failure()
    finally:
        os.kill(service.process.pid, signal.SIGCONT)
    at_rest(service)


def test_the_service_of_a_rig_is_queried_without_usb(service, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(discovery, "list_attached", list)
    rig = tmp_path / "rig.toml"
    rig.write_text(find(RIG, Rig).read_text("utf-8").replace("port = 10001", f"port = {service.port}"))
    arguments = argparse.Namespace(json=True, ask=True, rig=rig)
    assert devices.run(arguments) == 0
    (entry,) = json.loads(capsys.readouterr().out)["devices"]
    assert (entry["bus"], entry["state"], entry["rigs"]) == ("service", "usable", [str(rig)])
    reply = {"service": "3.5.0.0", "devices": ["inverse3 049D"], "grips": ["wireless_verse_grip 7"]}
    assert entry["said"] == reply
    service.kill()
    assert devices.run(arguments) == 0
    (entry,) = json.loads(capsys.readouterr().out)["devices"]
    assert entry["state"] == "service" and "systemctl start haply-inverse-service" in entry["remedy"]


def test_the_switch_interval_is_short_while_a_device_is_open() -> None:
    before = sys.getswitchinterval()
    with Service(devices=(f"inverse3:{ID}", "minverse:0A11")) as both:
        first, second = opened(both, device_id=ID), opened(both, device_id="0A11", models=None)
        assert before > switch_interval.SHORT_INTERVAL_S
        # It is stored in microseconds.
        assert sys.getswitchinterval() == pytest.approx(switch_interval.SHORT_INTERVAL_S, rel=1e-2)
        first.close()
        assert sys.getswitchinterval() < before
        second.close()
    assert sys.getswitchinterval() == before


def test_a_device_without_a_thread_is_released(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    interval, files = sys.getswitchinterval(), len(os.listdir("/proc/self/fd"))
    refuse_threads(monkeypatch, "haply exchange")
    with pytest.raises(RuntimeError):
        opened(service)
    assert sys.getswitchinterval() == interval and len(os.listdir("/proc/self/fd")) == files
    monkeypatch.undo()
    opened(service).close()


def test_a_device_leaks_no_descriptor(service: Service) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(20):
        device: HaplyDevice = opened(service)
        device.close()
    assert len(os.listdir("/proc/self/fd")) <= before


@contextlib.contextmanager
def listening(reply: bytes, after: str) -> Iterator[int]:
    """Answer each connection with these bytes; `after` them close, wait, or drip further bytes. Yield the port."""
    over = threading.Event()

    class Answer(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            with contextlib.suppress(OSError):
                self.request.recv(65536)
                self.request.sendall(reply)
                while after == "drip" and not over.wait(0.02):
                    self.request.sendall(b"x")
            if after == "wait":
                over.wait()

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,)).start()
        try:
            yield server.server_address[1]
        finally:
            over.set()
            server.shutdown()


@pytest.mark.parametrize("version", [None, "3.5"], ids=["asked its version", "asked for a WebSocket"])
@pytest.mark.parametrize(
    ("reply", "after"),
    [
        (b"", "close"), (b"", "wait"), (b"\xff\x00" * 2000, "close"),
        (b"HTTP/1.1 200 OK\r\nA: " + 300_000 * b"x", "wait"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 999999999\r\n\r\n{", "wait"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", "close"),
        (b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n", "wait"),
        (b"HTTP/1.1 200 OK\r\nA: ", "drip"),
    ],
    ids=["closes", "waits", "noise", "an endless head", "an endless body", "a bad chunk", "a false key", "drips"],
)  # fmt: skip
def test_another_program_on_the_port_is_rejected_in_time(reply: bytes, after: str, version: str | None) -> None:
    with listening(reply, after) as port, pytest.raises(DeviceError):
        open_device(rig_options(port, version=version), 1000.0)
