"""Leader arm on a bus of servos as pose input, with force on one joint: a driver of another package.

For arms such as LeRobot's SO-101 (Feetech STS3215) and GELLO (Dynamixel XL330). A thread reads all joints in one
transaction, computes the pose of the tip from the arm's URDF, and writes the torque of one joint. Servo loop and thread
exchange poses and forces through the block of the driver `haply`. Its functions for the loop suit all devices with a
thread: outdated forces are not sent, and no forces while poses are missing.

The bus is slower than the loop: see docs/devices/leader-arms.md.
"""

from __future__ import annotations

import logging
import math
import os
import termios
import threading
import time
from contextlib import suppress
from typing import Annotated, Final, Literal, NamedTuple
from xml.etree import ElementTree

import numpy as np
from softfinger_leader_bus import Bus, BusError, Dynamixel, Feetech

from softfinger.config.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from softfinger.config.files import expand_home
from softfinger.config.limits import DAMPING_NS_PER_M, STIFFNESS_N_PER_M, Range
from softfinger.config.schema import Table, doc, within
from softfinger.drivers import switch_interval
from softfinger.drivers.base import LOST, TIMEOUT, Device, DeviceIO, make_info
from softfinger.drivers.block import Block
from softfinger.drivers.haply import exchange
from softfinger.drivers.haply.exchange import (
    AT,
    POSE_SIZE,
    WRENCH_NUMBER,
    WRENCH_SIZE,
    WRITE_TIME,
)
from softfinger.drivers.mounting import Mounting
from softfinger.drivers.serial.port import set_raw
from softfinger.drivers.system.nodes import open_locked
from softfinger.proxy.kernels.jit.seqlock import publish, read
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics.rotations import about_x, about_y, about_z, exp, multiply, rotate
from softfinger.proxy.kernels.numerics.vec3 import add, scale

log: Final = logging.getLogger(__name__)

COUNTS_PER_TURN: Final = 4096
WAIT_S: Final = 0.02
"""Maximum duration of one transaction. Seven servos at 57600 Bd take 25 ms: set a higher baud rate in the servos."""
OPEN_WAIT_S: Final = 0.2
"""The same while the arm is opened."""
LAST_ZEROS: Final = 3
"""Attempts to send the last zero."""
WATCHDOG_UNITS: Final = 5
"""100 ms without a request, then a Dynamixel stops its motor."""
STOP_WAIT_S: Final = 1.0
BUSES: Final[dict[str, type[Bus]]] = {"feetech": Feetech, "dynamixel": Dynamixel}
_NUMBER: Final = Range(0.0, 100.0, "no such arm is stronger")
_COUNT_NM: Final = Range(1e-6, 1.0, "1750 counts are then 1.75 mN m and 1.75 kN m")


class Joint(Table, frozen=True, kw_only=True):
    """Servo of a joint."""

    name: Annotated[str, doc("of the joint in the URDF", "shoulder_pan")]
    servo: Annotated[int, within(Range(0, 252, "the ids of a bus"), "id", 1)]
    zero: Annotated[int, within(Range(-(2**20), 2**20, "256 turns"), "counts at the URDF's angle 0", 2048)] = 2048
    reversed: Annotated[bool, doc("counts fall while the angle grows", False)] = False


class Options(Table, frozen=True, kw_only=True):
    """Keys of [device] for `driver = "leader-arm"`."""

    path: Annotated[str, doc("serial port of the bus", "/dev/ttyACM0")]
    protocol: Annotated[Literal["feetech", "dynamixel"], doc("series of the servos", "feetech")]
    baud: Annotated[Literal[57600, 115200, 500000, 1000000, 2000000, 4000000], doc("of the bus", 1000000)] = 1000000
    urdf: Annotated[str, doc("file with the arm's joints", "/home/me/so101_new_calib.urdf")]
    tip: Annotated[str, doc("link of the fingertip in the URDF", "gripper_frame_link")]
    joint: tuple[Joint, ...]
    force_joint: Annotated[str, doc("joint that displays force; absent: none does", "shoulder_pan")] | None = None
    torque_per_count_nm: Annotated[float, within(_COUNT_NM, "N m of a count of the register of force", 0.002)] = 0.002
    torque_max_nm: Annotated[float, within(_NUMBER, "largest torque of that joint", 0.2)] = 0.2
    mounting: Mounting = Mounting()
    force_max_n: Annotated[float, within(_NUMBER, "most that it displays", 1.0)] = 1.0
    stiffness_max_n_per_m: Annotated[float, within(STIFFNESS_N_PER_M, "largest value rendered stably", 50.0)] = 50.0
    damping_max_ns_per_m: Annotated[float, within(DAMPING_NS_PER_M, "the same of damping", 0.5)] = 0.5
    workspace_radius_m: Annotated[float, within(Range(0.01, 2.0, "of arms on a table"), "about the origin", 0.4)] = 0.4
    quiet_s: Annotated[float, within(Range(0.01, 0.2, "of the bus"), "zero after so long without a pose", 0.05)] = 0.05
    timeout_s: Annotated[float, within(Range(0.05, 1.0, "of the bus"), "given up after so long", 0.25)] = 0.25


class Link(NamedTuple):
    """Joint of the chain: pose in the previous link at angle 0, unit axis, and name; fixed without a name."""

    position: Vec3
    orientation: Quaternion
    axis: Vec3
    name: str


def read_chain(file: str, tip: str, names: set[str]) -> list[Link]:
    """Return the joints of a URDF from its base to the link `tip`. Raises ConfigError."""
    try:
        joints = {
            joint.find("child").get("link"): joint for joint in ElementTree.parse(expand_home(file)).iter("joint")
        }
    except (OSError, ElementTree.ParseError, AttributeError) as error:
        raise ConfigError(f"[device] urdf = '{file}' cannot be read: {error}: name a URDF file") from error
    chain, link = list[Link](), tip
    while (joint := joints.pop(link, None)) is not None:
        origin, axis = joint.find("origin"), joint.find("axis")
        place = {} if origin is None else origin.attrib
        roll, pitch, yaw = _floats(place.get("rpy", "0 0 0"))
        turn = multiply(about_z(yaw), multiply(about_y(pitch), about_x(roll)))
        name = joint.get("name", "") if joint.get("type") in ("revolute", "continuous") else ""
        about = _floats("1 0 0" if axis is None else axis.get("xyz", "1 0 0"))
        chain.append(Link(_floats(place.get("xyz", "0 0 0")), turn, about, name))
        link = joint.find("parent").get("link")
    turning = {one.name for one in chain if one.name}
    if not chain or turning != names:
        raise ConfigError(
            f"[device] tip = '{tip}': the joints on the way to that link in {file} are {sorted(turning)}, and "
            f"[[device.joint]] names {sorted(names)}: give a servo for each, and no other"
        )
    return chain[::-1]


def forward(chain: list[Link], angles: dict[str, float]) -> tuple[Vec3, Quaternion, dict[str, tuple[Vec3, Vec3]]]:
    """Return pose of the tip at joint angles (rad), and position and axis of each joint, in the base frame."""
    position, orientation, joints = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), {}
    for link in chain:
        position = add(position, rotate(orientation, link.position))
        orientation = multiply(orientation, link.orientation)
        if link.name:
            joints[link.name] = position, rotate(orientation, link.axis)
            orientation = multiply(orientation, exp(scale(angles[link.name], link.axis)))
    return position, orientation, joints


class LeaderArm(Device):
    """Open arm. All motors are off but that of `force_joint`, and that one until `arm`."""

    def __init__(self, options: Options, chain: list[Link], fd: int) -> None:
        self._options, self._chain, self._fd, self._zero_failure = options, chain, fd, ""
        self._bus = BUSES[options.protocol](fd, OPEN_WAIT_S)
        self._servo_of = {joint.name: joint.servo for joint in options.joint}
        self._jacobian = np.zeros(3)
        self.failure = ""
        self._block = Block(AT)
        times = exchange.ServiceTimes(options.quiet_s, options.timeout_s, stale=0.05)
        exchange.init_exchange(self._block, options.mounting, options.force_max_n, times)
        name = f"leader arm of {len(options.joint)} {options.protocol} servos at {options.path}"
        actuated_dof = 0 if options.force_joint is None else 1
        self.info = make_info(options, name, sensed_dof=min(6, len(options.joint)), actuated_dof=actuated_dof)
        self._poses = self._block.slot(AT.pose, POSE_SIZE)
        self._wrenches = self._block.slot(AT.wrench, WRENCH_SIZE)
        self._wrench, self._copy, self._sequence, self._sent = np.zeros(WRENCH_SIZE), np.zeros(WRENCH_SIZE), 0, 0
        read(self._wrenches, -1, self._copy)  # compile it before the thread runs
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="leader arm", daemon=True)
        try:
            self._prepare()
            self._bus.wait_s = WAIT_S
            self._thread.start()
        except BaseException:
            self._close_files()
            raise

    def io(self) -> DeviceIO:
        return DeviceIO(exchange.read.address, exchange.write.address, self._block.handle)

    def arm(self) -> None:
        word = self._block.word
        before, until = int(word[AT.states]), time.monotonic() + self._options.timeout_s
        while word[AT.states] == before and not word[AT.stopped]:
            if word[AT.failed] < 0:
                raise DeviceLost(f"{self.info.name}: {self.failure}")
            if time.monotonic() > until:
                raise DeviceTimeout(f"{self.info.name}: no pose: check the cable and the supply of the servos")
            time.sleep(1e-3)
        word[AT.dropped_reported] = word[AT.dropped]
        word[AT.armed] = 1

    def stop(self) -> None:
        word = self._block.word
        word[AT.stopped] = 1  # first, because a concurrent `arm` may set `armed` again
        word[AT.armed] = 0
        if self._options.force_joint is None or word[AT.wake] < 0:
            return
        word[AT.stops_requested] += 1
        until = time.monotonic() + (0.1 if self._zero_failure else STOP_WAIT_S)
        while self._thread.is_alive() and word[AT.stops_answered] < word[AT.stops_requested]:
            if time.monotonic() > until:
                break
            time.sleep(1e-3)
        is_confirmed = word[AT.stops_answered] == word[AT.stops_requested]
        self._zero_failure = "" if is_confirmed else self.failure or "the servo has not confirmed it"

    def zero_failure(self) -> str:
        return self._zero_failure

    def close(self) -> None:
        self.stop()
        self._is_closing.set()
        self._thread.join(STOP_WAIT_S)
        if self._thread.is_alive():
            log.error("%s: the thread of the bus hangs; the port stays open", self.info.name)
        else:
            self._close_files()

    def reason(self) -> str:
        return self.failure

    def counts(self) -> dict[str, int]:
        return self._block.counts()

    def is_settled(self) -> bool:
        """Return True if the servo has confirmed the latest wrench, or no longer can."""
        return bool(self._block.word[AT.answered] >= self._block.word[AT.written]) or not self._thread.is_alive()

    def _close_files(self) -> None:
        wake, port = int(self._block.word[AT.wake]), self._fd
        self._block.word[AT.wake] = self._fd = -1
        for fd in (wake, port):
            if fd >= 0:
                os.close(fd)

    # --- bus ------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Switch every motor off, set up the one that displays force, and read a pose. Raises DeviceError."""
        bus, joint = self._bus, self._options.force_joint
        try:
            for servo in self._servo_of.values():
                bus.write(bus.enable, servo, 0)
            self._read_pose()
            if joint is None:
                return
            servo = self._servo_of[joint]
            (mode,) = bus.read(bus.mode, [servo])
            if mode != bus.force_mode:
                raise DeviceError(
                    f"servo {servo} is in mode {mode}, and follows forces in mode {bus.force_mode} only: set register "
                    f"{bus.mode.address} with the maker's program, which stores it for good"
                )
            if bus.watchdog is not None:
                bus.write(bus.watchdog, servo, 0)  # a servo with an expired one refuses forces
                bus.write(bus.watchdog, servo, WATCHDOG_UNITS)
            bus.write(bus.force, servo, 0)
            bus.write(bus.enable, servo, 1)
        except BusError as error:
            raise DeviceTimeout(
                f"{self.info.name}: {error}: check path, baud, ids of [[device.joint]] and the supply of the servos"
            ) from error
        except OSError as error:
            raise DeviceLost(f"{self.info.name}: the port was removed: {error}: plug it in again") from error

    def _read_pose(self) -> None:
        try:
            counts = self._bus.read(self._bus.position, list(self._servo_of.values()))
        except OSError as error:
            raise DeviceLost(f"{self.info.name}: the port was removed: {error}: plug it in again") from error
        angles = {
            joint.name: (-1 if joint.reversed else 1) * (count - joint.zero) * math.tau / COUNTS_PER_TURN
            for joint, count in zip(self._options.joint, counts, strict=True)
        }
        position, orientation, joints = forward(self._chain, angles)
        if self._options.force_joint is not None:
            place, axis = joints[self._options.force_joint]
            self._jacobian = np.cross(axis, np.subtract(position, place))
        publish(self._poses, np.array([*position, *orientation, 0.0, time.monotonic_ns()]))
        self._block.word[AT.states] += 1

    def _run(self) -> None:
        word, last = self._block.word, time.monotonic()
        switch_interval.shorten()
        try:
            while not self._is_closing.is_set():
                failure: BusError | None = None
                for step in (self._read_pose, self._send_force):  # a zero also goes out if poses are missing
                    try:
                        step()
                    except BusError as error:
                        failure = error
                if failure is None:
                    last = time.monotonic()
                elif time.monotonic() - last > self._options.timeout_s:
                    raise DeviceTimeout(str(failure))
        except (DeviceLost, DeviceTimeout, OSError) as error:
            self.failure = str(error)
            word[AT.failed] = TIMEOUT if isinstance(error, DeviceTimeout) else LOST
        except Exception as error:  # after a defect here, the loop must not wait forever
            log.exception("%s: the exchange failed", self.info.name)
            self.failure, word[AT.failed] = repr(error), LOST
        finally:
            switch_interval.restore()
            self._end()

    def _end(self) -> None:
        """Send a last zero and switch the motor off, also to a servo that may not answer."""
        joint, word = self._options.force_joint, self._block.word
        if joint is None:
            return
        failure = ""
        for _ in range(LAST_ZEROS):
            try:
                with suppress(BusError):  # an expired watchdog; a motor that is off exerts no force
                    self._bus.write(self._bus.force, self._servo_of[joint], 0)
                self._bus.write(self._bus.enable, self._servo_of[joint], 0)
                word[AT.stops_answered] = word[AT.stops_requested]
                return
            except (BusError, OSError) as error:
                failure = str(error)
        self.failure = self.failure or failure

    def _send_force(self) -> None:
        """Write the torque of the latest force, or zero if none may be sent, and wait for the confirmation."""
        word, joint = self._block.word, self._options.force_joint
        sequence = read(self._wrenches, self._sequence, self._copy)
        if sequence != self._sequence:
            self._sequence, self._wrench[:] = sequence, self._copy
        force, number, stops = self._wrench[:3], int(self._wrench[WRENCH_NUMBER]), int(word[AT.stops_requested])
        is_armed = word[AT.armed] and not word[AT.stopped]
        is_old = not is_armed or time.monotonic_ns() - self._wrench[WRITE_TIME] > word[AT.stale]
        if force.any() and is_old:
            self._wrench[:3] = 0.0
            word[AT.dropped] += 1
        if joint is not None:
            per_count = self._options.torque_per_count_nm
            limit = min(self._options.torque_max_nm, self._bus.force_max * per_count)
            counts = round(min(max(float(self._jacobian @ self._wrench[:3]), -limit), limit) / per_count)
            if counts or self._sent or stops > word[AT.stops_answered]:
                self._bus.write(self._bus.force, self._servo_of[joint], self._bus.encode_force(counts))
                self._sent = counts
        word[AT.handled] = word[AT.answered] = number
        word[AT.stops_answered] = stops


def open_device(options: Options, rate_hz: float) -> LeaderArm:
    """Open the arm; raises ConfigError, DeviceNotFound, DeviceBusy, DevicePermission, DeviceTimeout or DeviceError."""
    names = {joint.name for joint in options.joint}
    if options.force_joint is not None and options.force_joint not in names:
        raise ConfigError(f"[device] force_joint = '{options.force_joint}': no [[device.joint]] has that name")
    chain = read_chain(options.urdf, options.tip, names)
    fd = open_locked(options.path, "sudo usermod -aG dialout $USER, and log in again")
    try:
        set_raw(fd, options.baud)
    except (OSError, termios.error) as error:
        os.close(fd)
        raise DeviceError(f"{options.path} is not a serial port: {error}: name the port of the bus as path") from error
    return LeaderArm(options, chain, fd)


def _floats(text: str) -> tuple[float, float, float]:
    x, y, z = map(float, text.split())
    return x, y, z
