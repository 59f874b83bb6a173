"""SpaceMouse: driver contract, reports, rate control against closed forms, faults."""

import contextlib
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numba
import numpy as np
import pytest
from emulators import puck as emulated
from helpers.hid_devices import RefusedNode, RefusingBench, ends
from scipy.spatial.transform import Rotation

from softfinger.config.errors import ConfigError, DeviceNotFound
from softfinger.config.load import build, load_rig, load_scene
from softfinger.drivers.base import LOST, OK, PROTOCOL, STALE, Device
from softfinger.drivers.simulated.device import Options as SimulatedOptions
from softfinger.drivers.simulated.device import SimulatedDevice
from softfinger.drivers.spacemouse import device as spacemouse
from softfinger.drivers.spacemouse.device import SpaceMouse, find_puck, open_device
from softfinger.drivers.spacemouse.puck import Options, decode, make_parameters, move
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller, DriverContract
from softfinger.server.offline.simulate import simulate_devices

PAST = 350 - 15
"""Counts beyond the usual deadband at full deflection."""


class PuckBench(RefusingBench):
    cannot: ClassVar[Mapping[str, str]] = {"timeout": "a puck that nobody touches sends nothing, for ever"}

    def __init__(self, node: RefusedNode) -> None:
        super().__init__(node)
        self.end: socket.socket | None = None
        self.device: Any = None

    def open_path(self, path: str) -> Device:
        return open_device(Options(path=path), RATE_HZ)

    def open_emulated(self) -> Device:
        self.unplug()
        fd, self.end = ends()
        self.device = SpaceMouse(Options(), fd, RATE_HZ)
        return self.device

    def displayed(self) -> tuple[float, ...]:
        return tuple(self.device.read_log().wrench[-1].tolist())

    def faults(self) -> Mapping[str, Callable[[], object]]:
        return {"lost": self.unplug}

    def unplug(self) -> None:
        if self.end is not None:
            self.end.close()


@pytest.fixture
def bench() -> Iterator[PuckBench]:
    with RefusedNode() as node:
        made = PuckBench(node)
        yield made
        made.unplug()


class TestContract(DriverContract):
    """The contract over the SpaceMouse."""


@contextlib.contextmanager
def puck(**options: Any) -> Iterator[tuple[SpaceMouse, DeviceCaller, socket.socket]]:
    fd, end = ends()
    with end, SpaceMouse(build(Options, options, "test"), fd, RATE_HZ) as device:
        yield device, DeviceCaller(device), end


def over(servo: DeviceCaller, reads: int = 5) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the time (s), the displacement (3,) and the samples of some reads, 2 ms apart."""
    samples = []
    for _ in range(reads):
        status, sample = servo.read()
        assert status == OK
        samples.append(sample)
        time.sleep(0.002)
    table = np.array(samples)
    return float(table[-1, 7] - table[0, 7]), table[-1, :3] - table[0, :3], table


@pytest.mark.parametrize("kind", [emulated.split, emulated.combined])
@pytest.mark.parametrize(
    ("deflection", "direction", "axis"),
    [
        ({"right": 350}, (1, 0, 0), (0, 0, 0)),
        ({"right": -350}, (-1, 0, 0), (0, 0, 0)),
        ({"away": 350}, (0, 1, 0), (0, 0, 0)),
        ({"up": 350}, (0, 0, 1), (0, 0, 0)),
        ({"nose_down": 350}, (0, 0, 0), (-1, 0, 0)),
        ({"roll_right": 350}, (0, 0, 0), (0, 1, 0)),
        ({"clockwise": 350}, (0, 0, 0), (0, 0, -1)),
        ({"nose_down": -350, "clockwise": 350}, (0, 0, 0), (1, 0, -1)),
    ],
)
def test_a_deflection_moves_or_rotates_the_fingertip(kind, deflection, direction, axis):
    with puck() as (_, servo, end):
        for report in kind(**deflection):
            end.send(report)
        seconds, displacement, table = over(servo)
    assert seconds > 0.006
    # for any clock: rounding of sums of a few centimetres, and of four products of unit quaternions
    np.testing.assert_allclose(displacement, np.array(direction) * 2e-4 * PAST * seconds, rtol=0, atol=1e-15)
    first, last = (Rotation.from_quat(row[[4, 5, 6, 3]]) for row in (table[0], table[-1]))
    turned = (last * first.inv()).as_rotvec()
    np.testing.assert_allclose(turned, np.array(axis) * 3e-3 * PAST * seconds, rtol=0, atol=1e-14)
    assert any(axis) or (table[:, 3:7] == (1.0, 0.0, 0.0, 0.0)).all()


def test_a_puck_in_its_deadband_does_not_move() -> None:
    with puck(deadband=20.0) as (_, servo, end):
        end.send(emulated.combined(right=20, away=-20, clockwise=20)[0])
        _, displacement, table = over(servo)
        assert not displacement.any()
        assert np.ptp(table[:, 3:7], axis=0).max() == 0.0
        end.send(emulated.combined(right=21)[0])
        seconds, displacement, _ = over(servo)
        np.testing.assert_allclose(displacement, (2e-4 * seconds, 0, 0), rtol=0, atol=1e-15)


def test_axes_can_be_inverted() -> None:
    with puck(invert=[True, False, False, False, False, True]) as (_, servo, end):
        end.send(emulated.combined(right=350, up=350, clockwise=350)[0])
        _, displacement, table = over(servo)
    assert displacement[0] < 0 < displacement[2]
    assert table[-1, 6] > 0


def test_buttons_and_lamp() -> None:
    fd, end = ends()
    with end:
        with SpaceMouse(Options(), fd, RATE_HZ) as device:
            servo = DeviceCaller(device)
            assert emulated.LED[end.recv(64)] is True
            end.send(emulated.combined(right=350)[0])
            end.send(emulated.buttons(0x80000005))
            _, displacement, table = over(servo)
            assert displacement[0] > 0.0
            assert set(table[:, 8]) == {float(0x80000005)}
            end.send(emulated.buttons(0))
            assert servo.read()[1][8] == 0.0
        assert emulated.LED[end.recv(64)] is False
    with puck(led=False) as (_, _, end):
        end.setblocking(False)
        with pytest.raises(BlockingIOError):
            end.recv(64)


def test_a_silent_puck_stops_moving_the_fingertip() -> None:
    with puck(hold_s=0.05) as (_, servo, end):
        end.send(emulated.combined(right=350)[0])
        servo.read()
        time.sleep(0.06)
        end.send(emulated.buttons(1))
        servo.read()
        _, displacement, table = over(servo)
        assert not displacement.any()
        assert 0.0 < table[0, 0] <= 2e-4 * PAST * 0.051  # one read more than the hold, of at most 50 ms


def test_a_pause_is_no_jump() -> None:
    with puck() as (_, servo, end):
        end.send(emulated.combined(right=350)[0])
        before = servo.read()[1]
        time.sleep(0.2)
        after = servo.read()[1]
    assert after[0] - before[0] == pytest.approx(2e-4 * PAST * 0.05, abs=1e-15)


def test_reports_of_a_full_queue_are_ignored() -> None:
    """The kernel loses reports beyond 64, so after a full queue the fingertip rests until a new report."""
    with puck() as (_, servo, end):
        for _ in range(spacemouse.QUEUE):
            end.send(emulated.combined(right=350)[0])
        assert not over(servo)[1].any()
        end.send(emulated.combined(right=350)[0])
        assert over(servo)[1][0] > 0.0


def test_short_reports_and_foreign_ones() -> None:
    with puck() as (_, servo, end):
        for foreign in (b"\x17\x5a", bytes(range(23, 103))):  # the second is longer than the driver's buffer
            end.send(foreign)
            assert servo.read()[0] == OK
        for cut in (emulated.combined(right=1)[0][:5], emulated.split(right=1)[1][:6]):
            end.send(cut)
            assert servo.read()[0] == PROTOCOL


@numba.njit
def wild(reports: np.ndarray, counts: np.ndarray, setup: Any, deflection: np.ndarray, buttons: np.ndarray) -> Any:
    outcomes = np.zeros(3, np.int64)
    position, orientation = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    for n in range(len(counts)):
        status = decode(reports[n], counts[n], deflection, buttons)
        outcomes[0 if status == OK else 1 if status == STALE else 2] += 1
        position, orientation = move(setup, position, orientation, deflection, 0.001)
        unit = sum([q * q for q in orientation])
        if not (np.abs(deflection).max() <= 32768.0 and abs(unit - 1.0) < 1e-12 and 0.0 <= buttons[0] < 2.0**48):
            outcomes[0] = -1
            return outcomes
        for k in range(3):
            if not abs(position[k]) <= 0.1:
                outcomes[0] = -1
                return outcomes
    return outcomes


@pytest.mark.scaled
def test_reports_leave_a_pose_in_the_box(cases: Callable[[int, int], int]) -> None:
    generator = np.random.default_rng(8)
    total = np.zeros(3, np.int64)
    deflection, buttons = np.zeros(6), np.zeros(1)
    number = cases(1, 10)
    for _ in range(number):
        reports = generator.integers(0, 256, (100_000, 64), dtype=np.uint8)
        reports[::2, 0] = generator.integers(1, 4, 50_000)
        counts = generator.integers(0, 65, 100_000)
        total += wild(reports, counts, make_parameters(Options()), deflection, buttons)
    assert total.sum() == number * 100_000 and total.min() > number * 1_000


FREE = {"friction_n": [0.0, 0.0, 0.0], "damping_ns_per_m": [0.0, 0.0, 0.0], "resolution_m": 0.0, "delay_ticks": 0}


@contextlib.contextmanager
def led(**options: Any) -> Iterator[tuple[SimulatedDevice, DeviceCaller, socket.socket]]:
    fd, end = ends()
    built = build(SimulatedOptions, {"puck": {}, **options}, "test")
    with end, SimulatedDevice(built, RATE_HZ, (fd, "puck")) as device:
        yield device, DeviceCaller(device), end


def test_a_puck_leads_the_hand_of_the_simulated_device() -> None:
    """After 300 ticks of deflection the handle rests at gain times time, independent of the clock."""
    with led(**FREE) as (_, servo, end):
        servo.read()
        end.send(emulated.combined(right=350, clockwise=350)[0])
        for _ in range(300):
            assert servo.read()[0] == OK
        end.send(emulated.combined()[0])
        end.send(emulated.buttons(2))
        for _ in range(5000):  # the handle oscillates with a time constant 2 m / b below 0.1 s
            status, sample = servo.read()
    assert status == OK
    assert sample[8] == 2.0
    np.testing.assert_allclose(sample[:3], (2e-4 * PAST * 0.3, 0.0, 0.03), rtol=0, atol=1e-12)
    turned = Rotation.from_quat([*sample[4:7], sample[3]]).as_rotvec()
    np.testing.assert_allclose(turned, (0.0, 0.0, -3e-3 * PAST * 0.3), rtol=0, atol=1e-12)


def test_the_simulated_device_is_lost_with_its_puck() -> None:
    with led() as (device, servo, end):
        servo.read()
        end.close()
        assert servo.read()[0] == LOST
        assert device.reason() == "its hand is moved by puck"


def test_a_puck_excludes_other_goals() -> None:
    for key, value in (("recording", "tap"), ("position_m", [0.0, 0.0, 0.0])):
        with pytest.raises(ConfigError, match=rf"{key} = .*follows the SpaceMouse"):
            build(SimulatedOptions, {"puck": {}, key: value}, "rig")
    rig = load_rig("simulated-spacemouse")
    with pytest.raises(ConfigError, match="cannot run offline"):
        list(simulate_devices(load_scene("paper-plane"), rig, 0.1))


def test_selection_of_a_puck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = {
        "hidraw0": "0003:000016C0:00000486",
        "hidraw3": "0003:0000046D:0000C626",
        "hidraw4": "0005:0000256F:0000C63A",
    }
    attach(tmp_path, "hidraw0", nodes)
    whole = spacemouse.discovery.iter_hidraw_nodes
    monkeypatch.setattr(spacemouse.discovery, "iter_hidraw_nodes", lambda: whole(tmp_path))
    with pytest.raises(DeviceNotFound, match=r"no SpaceMouse is attached: .*Thing \(16c0:0486\) at /dev/hidraw0"):
        find_puck(Options())
    attach(tmp_path, "hidraw3", nodes)
    assert find_puck(Options()).node == "/dev/hidraw3"
    attach(tmp_path, "hidraw4", nodes)
    with pytest.raises(DeviceNotFound, match=r"2 SpaceMice are attached: select one .*hidraw3 \(serial 'hidraw3'\)"):
        find_puck(Options())
    assert find_puck(Options(serial="hidraw4")).product == 0xC63A
    assert find_puck(Options(path="/dev/hidraw3")).vendor == 0x046D
    with pytest.raises(DeviceNotFound, match="no SpaceMouse with serial = 'SN1'"):
        find_puck(Options(serial="SN1"))


def attach(root: Path, name: str, nodes: dict[str, str]) -> None:
    folder = root / spacemouse.discovery.HIDRAW / name / "device"
    folder.mkdir(parents=True)
    (folder / "uevent").write_text(f"HID_ID={nodes[name]}\nHID_NAME=Thing\nHID_UNIQ={name}\n")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"start_m": [0.0, 0.0, 0.2]}, "start_m = .*outside of the workspace"),
        ({"workspace_min_m": [0.2, 0.0, 0.0]}, "workspace_min_m = .*is above workspace_max_m"),
        ({"start_m": "here"}, "start_m = 'here'"),
    ],
)
def test_wrong_options_are_named(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(Options, wrong, "rig [device]")
