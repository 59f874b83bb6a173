"""The example of a leader arm on emulated bus servos: contract, pose and force, faults of the bus, its time."""

import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from emulators.bus_servos import DYNAMIXEL, FEETECH, BusServos, Registers, crc16
from helpers.shortages import refuse_threads
from helpers.waits import eventually, until
from scipy.spatial.transform import Rotation

from softfinger.config.errors import ConfigError, DeviceError, DeviceTimeout
from softfinger.config.load import build, load_rig
from softfinger.drivers import registry
from softfinger.drivers.base import HELD, OK, TIMEOUT, WITHHELD
from softfinger.server.driver_contract import RATE_HZ, Bench, DeviceCaller, DriverContract

FOLDER = Path(__file__).parents[1] / "examples" / "leader_arm"
sys.path.insert(0, str(FOLDER))
import softfinger_leader_arm as leader  # noqa: E402
from softfinger_leader_bus import Dynamixel, Feetech  # noqa: E402

pytestmark = pytest.mark.real_time

SERIES = {"feetech": FEETECH, "dynamixel": DYNAMIXEL}
IDS = {"yaw": 1, "pitch": 2, "roll": 3}
LEVER_M, NM_PER_COUNT = 0.2, 0.0005
URDF = f"""
<robot name="arm">
  <joint name="yaw" type="revolute"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 -0.25" rpy="0 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="pitch" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="0 0 0.07" rpy="{math.pi / 2} 0 0"/><axis xyz="0 0 -1"/></joint>
  <joint name="roll" type="continuous"><parent link="b"/><child link="c"/>
    <origin xyz="0 {LEVER_M} 0" rpy="0 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="tip" type="fixed"><parent link="c"/><child link="tip"/></joint>
  <joint name="jaw" type="revolute"><parent link="c"/><child link="jaw"/><axis xyz="1 0 0"/></joint>
</robot>
"""
"""A yaw joint, a pitch joint about the world's y 0.18 m below the origin, and a tip 0.2 m above it."""


@pytest.fixture(scope="session")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(URDF)
    return path


def arm_options(arm: BusServos | str, urdf: Path, **changes: Any) -> leader.Options:
    """Keys of the rig for an emulated arm; a thread of a busy machine may answer late."""
    path, table = (arm, FEETECH) if isinstance(arm, str) else (arm.path, arm.table)
    options = {
        "path": path, "protocol": "feetech" if table is FEETECH else "dynamixel", "urdf": str(urdf), "tip": "tip",
        "joint": [{"name": name, "servo": servo} for name, servo in IDS.items()], "force_joint": "pitch",
        "torque_per_count_nm": NM_PER_COUNT, "torque_max_nm": 0.4, "force_max_n": 2.0, "quiet_s": 0.2, "timeout_s": 0.5,
    }  # fmt: skip
    return build(leader.Options, {**options, **changes}, "[device]")


def emulated(table: Registers = FEETECH, **how: Any) -> BusServos:
    return BusServos(table, dict.fromkeys(IDS.values(), 2048), **how)


def force_x(arm: BusServos) -> float:
    """Force (N) of the pitch joint's motor at the tip, along the world's x while the arm is upright."""
    return arm.servos[IDS["pitch"]].force(time.monotonic()) * NM_PER_COUNT / LEVER_M


def pushed(servo: DeviceCaller, arm: BusServos, newtons: float) -> None:
    """Write a force until the motor has it: the bus is slower than the loop."""

    def has_force() -> bool:
        assert servo.read()[0] >= 0 and servo.write(newtons, 0.0, 0.0, 0.0, 0.0, 0.0) in (OK, HELD, WITHHELD)
        return abs(force_x(arm) - newtons) <= NM_PER_COUNT / LEVER_M

    until(has_force)


class ArmBench(Bench):
    """The emulated arm. When lost, it has no power and its port has no path."""

    force_step_n = NM_PER_COUNT / LEVER_M
    patience_s = 10.0
    cannot: ClassVar[dict[str, str]] = {
        "permission": "a pseudo terminal belongs to its user",
        "lost": "its far end closes with the emulator",
    }

    def __init__(self, arm: BusServos, urdf: Path) -> None:
        self.arm, self.urdf, self.path = arm, urdf, arm.path
        self.rival: leader.LeaderArm | None = None

    def open(self) -> leader.LeaderArm:
        options = arm_options(self.arm, self.urdf, path=self.path)
        self.device = leader.open_device(options, RATE_HZ)
        return self.device

    def part(self, *force: float) -> tuple[float, ...]:
        return force[0], 0.0, 0.0

    def displayed(self) -> tuple[float, ...]:
        eventually(self.device.is_settled)
        return (force_x(self.arm), 0.0, 0.0, 0.0, 0.0, 0.0)

    def make(self, case: str) -> None:
        match case:
            case "not_found":
                self.path = "/dev/no-such-port"
            case "busy":
                self.rival = self.open()
            case "timeout":
                for servo in self.arm.servos.values():
                    servo.mute = True

    def mend(self) -> None:
        self.path = self.arm.path
        if self.rival is not None:
            self.rival.close()
            self.rival = None
        for servo in self.arm.servos.values():
            servo.mute = False


@pytest.fixture
def bench(urdf: Path) -> Iterator[ArmBench]:
    with emulated() as arm:
        yield ArmBench(arm, urdf)


class TestContract(DriverContract):
    """The contract with Feetech servos; the series differ only in packets and registers."""


def test_published_packets() -> None:
    """A ping of servo 1, from Feetech's manual, and from Robotis' page on protocol 2.0."""
    assert Feetech(-1, 0.0).packet(1, 1, b"").hex(" ") == "ff ff 01 02 01 fb"
    ping = Dynamixel(-1, 0.0).packet(1, 1, b"")
    assert ping.hex(" ") == "ff ff fd 00 01 03 00 01 19 4e" and crc16(ping[:-2]) == 0x4E19


@pytest.mark.parametrize("protocol", SERIES)
def test_pose_and_force(protocol: str, urdf: Path) -> None:
    with emulated(SERIES[protocol]) as arm, leader.open_device(arm_options(arm, urdf), RATE_HZ) as device:
        servo = DeviceCaller(device)
        assert (device.info.sensed_dof, device.info.actuated_dof) == (3, 1)
        yaw, pitch, roll = (round(angle * 4096 / math.tau) for angle in (0.5, -0.3, 1.0))
        for name, counts in (("yaw", yaw), ("pitch", pitch), ("roll", roll)):
            arm.servos[IDS[name]].turn_to(2048 + counts)
        a, b, c = (counts * math.tau / 4096 for counts in (yaw, pitch, roll))
        reach = LEVER_M * math.sin(b)
        wanted = (reach * math.cos(a), reach * math.sin(a), -0.18 + LEVER_M * math.cos(b))
        until(lambda: np.allclose(servo.read()[1][:3], wanted, rtol=0.0, atol=1e-9))  # rounding
        w, x, y, z = servo.read()[1][3:7]
        turn = Rotation.from_euler("ZYX", [a, b, math.pi / 2]) * Rotation.from_euler("Y", c)
        assert 2.0 * math.atan2(math.hypot(x, y, z), w) == pytest.approx(turn.magnitude(), abs=1e-9)
        for motor in arm.servos.values():
            motor.turn_to(2048)
        until(lambda: np.allclose(servo.read()[1][:3], (0.0, 0.0, 0.02), rtol=0.0, atol=1e-9))
        for newtons in (0.5, -0.5):
            pushed(servo, arm, newtons)
        for wrench in ((0.0, 0.5, 0.5), (0.0, 0.0, -1.0)):  # across the motor's part

            def has_no_force(wrench: tuple[float, float, float] = wrench) -> bool:
                assert servo.read()[0] >= 0
                servo.write(*wrench, 0.0, 0.0, 0.0)
                return force_x(arm) == 0.0

            until(has_no_force)
        assert [arm.servos[number].memory[arm.table.enable] for number in IDS.values()] == [0, 1, 0]
        device.stop()
        device.arm()
        assert servo.write(0.5, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD


@pytest.mark.parametrize(("protocol", "most"), [("feetech", 1000), ("dynamixel", 1750)])
def test_a_force_beyond_the_register_is_limited(protocol: str, most: int, urdf: Path) -> None:
    with emulated(SERIES[protocol]) as arm:
        with leader.open_device(arm_options(arm, urdf, torque_per_count_nm=1e-4), RATE_HZ) as device:
            servo, motor = DeviceCaller(device), arm.servos[IDS["pitch"]]

            def has_force() -> bool:
                assert servo.read()[0] >= 0
                servo.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # 2000 counts
                return motor.force(time.monotonic()) != 0

            until(has_force)
        assert motor.log[0][1] == most and motor.log[-1][1] == 0


@pytest.mark.parametrize("protocol", SERIES)
def test_damaged_and_late_answers_are_not_believed(protocol: str, urdf: Path) -> None:
    with emulated(SERIES[protocol]) as arm, leader.open_device(arm_options(arm, urdf), RATE_HZ) as device:
        servo = DeviceCaller(device)
        arm.damage[2] = 3
        arm.stray = arm.encode(2, b"")  # confirms an earlier write
        requests = arm.requests

        def is_read() -> bool:
            status, sample = servo.read()
            assert status in (OK, 1, WITHHELD)
            assert sample[:3] == pytest.approx((0.0, 0.0, 0.02), abs=1e-9)
            return not arm.damage[2] and arm.requests >= requests + 10

        until(is_read)


def test_an_arm_without_a_thread_is_released(urdf: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with emulated() as arm:
        interval, files = sys.getswitchinterval(), len(os.listdir("/proc/self/fd"))
        refuse_threads(monkeypatch)
        with pytest.raises(RuntimeError):
            leader.open_device(arm_options(arm, urdf), RATE_HZ)
        assert sys.getswitchinterval() == interval and len(os.listdir("/proc/self/fd")) == files


def test_a_motor_that_confirms_nothing_ends_the_run(urdf: Path) -> None:
    with emulated() as arm:
        device = leader.open_device(arm_options(arm, urdf, timeout_s=0.1), RATE_HZ)
        servo = DeviceCaller(device)
        pushed(servo, arm, 0.5)
        motor = arm.servos[IDS["pitch"]]
        motor.store = lambda *_: setattr(motor, "mute", True)
        while (status := servo.read()[0]) >= 0:
            servo.write(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            time.sleep(0.001)
        assert status == TIMEOUT and force_x(arm) != 0.0
        device.close()
        assert "servo 2" in device.zero_failure()


def test_a_dynamixel_stops_by_itself(urdf: Path) -> None:
    with emulated(DYNAMIXEL) as arm:
        device = leader.open_device(arm_options(arm, urdf), RATE_HZ)
        servo = DeviceCaller(device)
        pushed(servo, arm, 0.5)
        transact, device._bus._transact = device._bus._transact, lambda *_: time.sleep(0.01) or {1: b"", 2: b"", 3: b""}
        until(lambda: force_x(arm) == 0.0)
        device._bus._transact = transact  # the program continues, but the servo now refuses every goal
        device.close()
        assert not device.zero_failure() and not arm.servos[IDS["pitch"]].memory[DYNAMIXEL.enable]
        with leader.open_device(arm_options(arm, urdf), RATE_HZ) as device:
            pushed(DeviceCaller(device), arm, 0.5)


def test_the_rig_of_an_so101_is_complete() -> None:
    registry.add("leader-arm", leader)
    rig = load_rig(FOLDER / "so101.toml")
    options = registry.read_options(rig.device)
    assert [joint.servo for joint in options.joint] == [1, 2, 3, 4, 5]
    assert options.force_joint == "shoulder_pan" and rig.guard.force_max_n <= options.force_max_n


def test_refusals(urdf: Path, tmp_path: Path) -> None:
    with emulated() as arm:
        with pytest.raises(ConfigError, match=r"joints on the way to that link .*\['pitch', 'roll', 'yaw'\]"):
            leader.open_device(arm_options(arm, urdf, joint=[{"name": "yaw", "servo": 1}], force_joint=None), RATE_HZ)
        with pytest.raises(ConfigError, match="torque_per_count_nm = 0"):
            arm_options(arm, urdf, torque_per_count_nm=0.0)
        (tmp_path / "none.urdf").write_text("no robot")
        with pytest.raises(ConfigError, match=r"cannot be read.*name a URDF"):
            leader.open_device(arm_options(arm, tmp_path / "none.urdf"), RATE_HZ)
        with pytest.raises(ConfigError, match=r"no \[\[device.joint\]\] has that name"):
            leader.open_device(arm_options(arm, urdf, force_joint="elbow"), RATE_HZ)
        arm.servos[2].memory[FEETECH.mode] = 0
        mode = "servo 2 is in mode 0, and follows forces in mode 2 only: set register 33"
        with pytest.raises(DeviceError, match=mode):
            leader.open_device(arm_options(arm, urdf), RATE_HZ)
        arm.servos[3].mute = True
        with pytest.raises(DeviceTimeout, match=r"servo 3 has not answered.*check path, baud"):
            leader.open_device(arm_options(arm, urdf, force_joint=None), RATE_HZ)
    with pytest.raises(DeviceError, match="is not a serial port"):
        leader.open_device(arm_options(str(urdf), urdf), RATE_HZ)
