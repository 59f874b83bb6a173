"""The daemon on Haply's emulated service: closed loop, faults, signals, a missing library, output of tools; ends of a
connection: the forces that two devices of one service received before."""

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.called import called
from helpers.haply_devices import ID, RIG, Service, opened, settle
from helpers.programs import Program, run_program
from helpers.rig_files import load_rig_in_process, write_rig
from helpers.waits import fresh, until

from softfinger.config.schema import Rig
from softfinger.config.sources import find
from softfinger.drivers.base import LOST, PROTOCOL, TIMEOUT, WITHHELD
from softfinger.drivers.haply.device import HaplyDevice
from softfinger.server.driver_contract import DeviceCaller
from softfinger.server.verbs.check import examine_file
from softfinger.tools.doctor import attached

pytestmark = pytest.mark.real_time

OTHER = "0A11"
PUSH_N = {ID: 1.5, OTHER: 1.0}
CONTINUATION, TEXT, BINARY, CLOSE, PING = 0x0, 0x1, 0x2, 0x8, 0x9
MAX = 262_144
"""Maximum bytes of a message that the driver accepts."""


def frame(opcode: int, payload: bytes = b"", fin: bool = True, bits: int = 0, claims: int | None = None) -> bytes:
    """Return a frame of a server (RFC 6455, 5.2); `bits` are the reserved bits, `claims` the announced length."""
    size = len(payload) if claims is None else claims
    if size < 126:
        length = bytes([size])
    elif size < 1 << 16:
        length = b"\x7e" + size.to_bytes(2, "big")
    else:
        length = b"\x7f" + size.to_bytes(8, "big")
    return bytes([fin << 7 | bits << 4 | opcode]) + length + payload


def close(code: int, reason: bytes = b"") -> bytes:
    return frame(CLOSE, code.to_bytes(2, "big") + reason)


BREACHES: dict[str, bytes] = {
    **{f"reserved bits {bits}": frame(TEXT, b"{}", bits=bits) for bits in (1, 2, 4, 7)},
    **{f"opcode {code:x}": frame(code, b"{}") for code in (3, 7, 0xB, 0xF)},
    "masked": bytes([0x81, 0x82, 1, 2, 3, 4]) + bytes([ord("{") ^ 1, ord("}") ^ 2]),
    "a byte too long": frame(TEXT, b" " * (MAX + 1)),
    "2^62 bytes claimed": frame(TEXT, claims=1 << 62),
    "2^63 bytes claimed": frame(TEXT, claims=1 << 63),
    "too long in parts": frame(TEXT, b" " * MAX, fin=False) + frame(CONTINUATION, b" "),
    "a fragmented ping": frame(PING, b"", fin=False),
    "a long ping": frame(PING, b" " * 126),
    "a continuation of nothing": frame(CONTINUATION, b"{}"),
    "a message inside another": frame(TEXT, b"{", fin=False) + frame(TEXT, b"}"),
    "a close inside a message": frame(TEXT, b"{", fin=False) + close(1000),
    "a close of one byte": frame(CLOSE, b"\x03"),
    "a close with a bad reason": close(1000, b"\xff\xfe"),
    **{f"a close with code {code}": close(code) for code in (0, 999, 1004, 1005, 1006, 1015, 2999, 5000, 65535)},
    "invalid UTF-8": frame(TEXT, b'{"inverse3":[{"device_id":"\xff\xfe"}]}'),
    "a list": frame(TEXT, b"[]"),
    "a number": frame(BINARY, b"7"),
    "null": frame(TEXT, b"null"),
    "noise": b"\xff" * 64,
}
GOODBYES: dict[str, bytes] = {
    **{
        f"close {code}": close(code, b"bye")
        for code in (1000, 1001, 1002, 1003, *range(1007, 1015), 3000, 4999)
    },
    "close without a code": frame(CLOSE),
    "an empty list": frame(TEXT, b"{}"),
    "other devices alone": frame(TEXT, b'{"inverse3":[],"minverse":[]}'),
}  # fmt: skip


@pytest.fixture(scope="module")
def service() -> Iterator[Service]:
    with Service(devices=(f"inverse3:{ID}", f"minverse:{OTHER}")) as running:
        yield running


@pytest.fixture
def pushing(service: Service) -> Iterator[list[HaplyDevice]]:
    devices = [opened(service, device_id=name, models=None) for name in (ID, OTHER)]
    for device, (name, force) in zip(devices, PUSH_N.items(), strict=True):
        servo = DeviceCaller(device)
        fresh(servo)
        wrench = (0.0, 0.0, force, 0.0, 0.0, 0.0)
        until(lambda servo=servo, name=name, wrench=wrench: servo.write(*wrench) < 0 or any(service.force(name)))
    yield devices
    service.set(raw=None, end=None, deaf=False, streams=False)
    for device in devices:
        device.close()


def received(service: Service, name: str, after: float = 0.0) -> list[tuple[float, ...]]:
    """Return the forces (N) that the service received for a device, from a time (s, monotonic clock) on, in order."""
    return [tuple(force) for at, force in service.commands(name) if at > after]


def end_with(service: Service, devices: list[HaplyDevice], raw: bytes, end: str | None = None) -> list[int]:
    service.set(raw=raw.hex(), end=end)
    statuses = []
    for device in devices:
        servo = DeviceCaller(device, arm=False)
        until(lambda servo=servo: servo.read()[0] < 0)
        statuses.append(servo.read()[0])
        until(lambda device=device: not device._thread.is_running)
    return statuses


@pytest.mark.parametrize("case", [*BREACHES, *GOODBYES])
def test_the_last_force_before_an_end_is_zero(case: str, service: Service, pushing: list[HaplyDevice]) -> None:
    raw = (BREACHES | GOODBYES)[case]
    assert end_with(service, pushing, raw) == [PROTOCOL if case in BREACHES else LOST] * 2
    for device, name in zip(pushing, (ID, OTHER), strict=True):
        forces = received(service, name)
        assert forces[-1] == (0.0, 0.0, 0.0) and any(any(force) for force in forces)
        device.stop()
        assert not device.zero_failure()


def test_a_service_that_only_stops_sending_receives_a_zero(service: Service, pushing: list[HaplyDevice]) -> None:
    assert end_with(service, pushing, b"", "fin") == [LOST, LOST]
    for name in (ID, OTHER):  # the service may read the zero after the end of the loop
        until(lambda name=name: received(service, name)[-1] == (0.0, 0.0, 0.0))


def test_a_reset_lets_no_zero_through(service: Service, pushing: list[HaplyDevice]) -> None:
    assert end_with(service, pushing, b"", "rst") == [LOST, LOST]
    for name, force in PUSH_N.items():
        assert received(service, name)[-1] == (0.0, 0.0, force) and not any(service.force(name))


@pytest.mark.scaled
def test_the_last_force_is_zero_after_random_bytes(service: Service, cases: Callable[[int, int], int]) -> None:
    draw = random.Random(7)
    for _ in range(cases(20, 1000)):
        raw = b"".join(
            frame(draw.randrange(16), draw.randbytes(draw.choice((0, 2, 20, 200))), draw.random() < 0.8,
                  draw.choice((0, 0, 0, draw.randrange(8))), draw.choice((None, None, draw.randrange(1 << 63))))
            for _ in range(draw.randrange(1, 4))
        )  # fmt: skip
        with opened(service, device_id=ID) as device:
            servo = DeviceCaller(device)
            fresh(servo)
            servo.write(0.0, 0.0, 1.5, 0.0, 0.0, 0.0)
            settle(device)
            service.set(raw=raw.hex())
            until(lambda servo=servo: servo.read()[0] in (PROTOCOL, LOST, TIMEOUT))
            service.set(raw=None)
            device.stop()
        assert received(service, ID)[-1] == (0.0, 0.0, 0.0), raw.hex()


def test_no_force_follows_a_stop_before_arm(service: Service) -> None:
    """A signal stops the device from another thread while the servo thread arms it."""
    with opened(service, device_id=ID) as device:
        device.stop()
        device.arm()
        servo = DeviceCaller(device, arm=False)
        fresh(servo)
        stopped_at = time.monotonic()
        assert servo.write(0.0, 0.0, 1.5, 0.0, 0.0, 0.0) == WITHHELD
        settle(device)
        assert not any(any(force) for force in received(service, ID, stopped_at))


def test_a_service_that_stops_reading_gets_one_more_force(service: Service, pushing: list[HaplyDevice]) -> None:
    service.set(deaf=True)
    deaf_at = time.monotonic()
    servos = [DeviceCaller(device, arm=False) for device in pushing]
    failed: set[int] = set()

    def push() -> bool:
        for number, servo in enumerate(servos):
            if servo.read()[0] == TIMEOUT:
                failed.add(number)
            servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        return len(failed) == 2

    until(push)
    assert [servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) for servo in servos] == [WITHHELD] * 2
    for device in pushing:
        device.stop()
        device.stop()
        assert "has not answered it for 1 s" in device.zero_failure()
        device.close()
    service.set(deaf=False)
    for name in (ID, OTHER):
        until(lambda name=name: not any(service.force(name)))
        late = received(service, name, deaf_at)
        assert sum(any(force) for force in late) <= 1 and late[-1] == (0.0, 0.0, 0.0)


def test_a_service_that_sends_without_reading_gets_no_force() -> None:
    room = 2048
    with Service(room=room) as service, opened(service) as device:
        servo = DeviceCaller(device)
        fresh(servo)
        until(lambda: servo.write(0.0, 0.0, 1.5, 0.0, 0.0, 0.0) < 0 or any(service.force()))
        service.set(streams=True)
        service.set(deaf=True)
        deaf_at, warned, statuses = time.monotonic(), set(), set()

        def push() -> bool:
            servo.write(0.0, 0.0, 1.5, 0.0, 0.0, 0.0)
            statuses.add(servo.read()[0])
            warned.add(device.warning())
            return PROTOCOL in statuses

        until(push)
        assert WITHHELD in statuses and any("reads no messages" in words for words in warned)
        assert "unexpected states" in device.reason()
        device.stop()
        assert "has not read it" in device.zero_failure()
        service.set(streams=False)
        service.set(deaf=False)
        until(lambda: not any(service.force()))
        late = received(service, ID, deaf_at)
        # Linux doubles `room`; a message has more than 60 bytes; two may wait in the driver, and one was being
        # answered.
        assert sum(any(force) for force in late) <= 2 * room / 60 + 3


PATIENT = {"stale_s": 0.2, "quiet_s": 0.2, "timeout_s": 1.0}
"""Times for a busy machine, where a process may answer late."""


def rig(service: Service, **changes: Any) -> Rig:
    return load_rig_in_process(RIG, {"port": service.port, **PATIENT}, changes)


def pushes(service: Service) -> None:
    until(lambda: service.force()[2] >= 0.5, 240.0)  # a process may have to compile first


def command_line(service: Service, folder: Path, endpoint: str) -> list[str]:
    mine = write_rig(folder, RIG, port=service.port, **PATIENT)
    command = [sys.executable, "-m", "softfinger.server.cli", "run", "--rig", str(mine), "--realtime", "off"]
    return [*command, "--scene", "paper-plane", "--endpoint", f"ipc://{folder}/{endpoint}"]


@contextlib.contextmanager
def pushing_daemon(service: Service, folder: Path) -> Iterator[subprocess.Popen[str]]:
    service.do("move", id=ID, to={"x": 0.0, "y": -0.12, "z": 0.159})
    words = command_line(service, folder, "a")
    with Program(words, stderr=subprocess.PIPE, text=True, kill_at_end=True) as running:
        pushes(service)
        yield running


def test_a_killed_daemon_leaves_no_lock_and_no_force(tmp_path: Path) -> None:
    with Service() as service, pushing_daemon(service, tmp_path) as running:
        running.kill()
        running.wait(60)
        opened(service).close()
        until(lambda: not any(service.force()))


def test_a_second_daemon_is_refused_and_an_unconfirmed_zero_is_reported(tmp_path: Path) -> None:
    with Service() as service, pushing_daemon(service, tmp_path) as running:
        second = called(*command_line(service, tmp_path, "b")[3:])
        assert second.returncode == 4
        assert re.search(rf"inverse3 {ID} .* in use by process {running.pid} \(.*end that one first", second.stderr)
        service.do("move", id=ID, to={"x": 0.0, "y": -0.12, "z": 0.1591})  # a static pose has no force
        pushes(service)
        service.set(deaf=True)
        running.send_signal(signal.SIGTERM)
        stderr = running.communicate(timeout=60)[1]
        assert running.returncode == 4, stderr
        assert "zero force is not confirmed" in stderr
        assert "force is zero" not in stderr


@pytest.mark.exhaustive
def test_a_missing_library_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "websockets.py").write_text("raise ImportError('not installed')")
    environ = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "softfinger.server.cli", "run", "-q", "--rig", RIG]
    command += ["--endpoint", f"ipc://{tmp_path}/a"]
    process = run_program(command, env=environ)
    assert process.returncode == 4
    assert len(process.stderr.strip().splitlines()) == 1, process.stderr
    assert "pip install 'softfinger[haply]'" in process.stderr


def test_check_lists_the_filters(tmp_path: Path) -> None:
    mine = tmp_path / "rig.toml"
    text = find(RIG, Rig).read_text()
    mine.write_text(text[: text.index("[device.filters]")] + "[device.filters]\nforce_gate = 0.0\n")
    rows = dict(examine_file(str(mine)).summary)
    assert rows["  filters"].startswith(
        "force gate 0, damping 0, gravity compensation times 1, torque scaling on, home return off"
    )


def test_doctor_queries_the_service() -> None:
    with Service() as service:
        row = attached.check_inverse_service(rig(service).device.options)
        assert (row.state, row.seen) == ("good", f"version 3.5.0.0, lists inverse3 {ID}")
        service.do("vanish", id=ID)
        assert attached.check_inverse_service(rig(service).device.options).state == "bad"
    row = attached.check_inverse_service(rig(service).device.options)
    assert row.state == "bad" and "systemctl start haply-inverse-service" in row.remedy
