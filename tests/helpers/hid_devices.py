"""HID devices for the tests: the driver at one end of a packet socket, an emulated device in a thread at the other.

A packet socket preserves the boundaries of reports, as a hidraw node does, and needs no privileges. For the variant
with threads it replaces hidapi's calls. Enumeration, descriptor and permissions of a node are tested on umockdev.
"""

import fcntl
import os
import select
import socket
import tempfile
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

from emulators.hand import Vector
from emulators.woodenhaptics import Woody

from helpers.rig_files import rig_options
from softfinger.drivers.base import Device
from softfinger.drivers.hid.device import HidDevice, Options
from softfinger.drivers.hid.link import ReportLink, make_thread_link
from softfinger.server import driver_contract

RIGS = {
    "woodenhaptics-2019": "woody-2019",
    "woodenhaptics-2015": "woody-2015",
    "woodenhaptics-polhem-v1": "polhem-v1",
    "woodenhaptics-2019-lpc1768": "woody-2019",
    "woodenhaptics-polhem-v1-lpc1768": "polhem-v1",
    "woodenhaptics-aluhaptics-v2": "aluhaptics-v2",
    "woodenhaptics-vintage": "vintage",
}
"""Shipped rigs and the rows of the emulator's table."""


def described(**changes: Any) -> dict[str, Any]:
    """A user-defined cartesian device: numbered reports, floats, quaternion, buttons, gripper, forces in mN."""
    fields = [("x", 0), ("y", 4), ("z", 8), ("qw", 12), ("qx", 16), ("qy", 20), ("qz", 24)]
    scale = {"x": 1e-3, "y": 1e-3, "z": 1e-3}
    return {
        "vendor_id": 0xF055, "product_id": 0x0001, "force_max_n": 4.0, "stiffness_max_n_per_m": 900.0,
        "damping_max_ns_per_m": 3.0, "workspace_radius_m": 0.05, "kinematics": {"kind": "cartesian"},
        "reports": {
            "input": {
                "bytes": 30, "id": 3,
                "field": [
                    *({"meaning": m, "offset": at, "type": "float32", "scale": scale.get(m, 1.0)} for m, at in fields),
                    {"meaning": "buttons", "offset": 28, "type": "uint8"},
                    {"meaning": "gripper", "offset": 29, "type": "uint8", "scale": 0.01},
                ],
            },
            "output": {
                "bytes": 12, "id": 4,
                "field": [
                    {"meaning": f"force_{k}", "offset": 4 * n, "type": "int32", "scale": 1000.0}
                    for n, k in enumerate("xyz")
                ],
            },
        },
        **changes,
    }  # fmt: skip


class Answering(AbstractContextManager[Any]):
    """Thread that answers reports until it is muted or the socket is closed."""

    def __init__(self, end: socket.socket, answer: Callable[[bytes], bytes | None]) -> None:
        self.end, self._answer = end, answer
        self.mute = threading.Event()
        """If set, the device receives but does not answer."""
        self.deaf = threading.Event()
        """If set, the device reads nothing."""
        self.answered = 0
        self.idle_before: list[float] = []
        """Latest time (s) before each report at which there was none to read."""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        idle_at = time.monotonic()
        # Reports that the driver sent before it closed its end can still be read; only the answers are lost.
        while True:
            now = time.monotonic()
            try:
                if not select.select([self.end], [], [], 0.0)[0]:
                    idle_at = now
                data = self.end.recv(4096)
            except ConnectionResetError:
                continue
            if not data:
                return
            self.idle_before.append(idle_at)
            while self.deaf.is_set():
                time.sleep(0.0002)
            reply = self._answer(data)
            if reply is not None and not self.mute.is_set():
                with suppress(BrokenPipeError, ConnectionResetError):
                    self.end.send(reply)
            self.answered += 1

    def settle(self, device: HidDevice) -> None:
        """Wait until every report of the driver has been read and answered."""
        until = time.monotonic() + 10.0
        sent = device.counts()["written"]
        if device.threads is not None:
            assert device.threads.flush(sent, until), "hidapi does not take the driver's reports"
        while self.answered < sent:
            assert time.monotonic() < until, "the emulated device does not take its reports"
            time.sleep(0.0002)

    def unplug(self) -> None:
        """Close the device's end; may be called repeatedly."""
        if self.end.fileno() >= 0:
            with suppress(OSError):  # the other end is closed
                self.end.shutdown(socket.SHUT_RDWR)
            self._thread.join()
            self.end.close()

    def __exit__(self, *_: object) -> None:
        self.unplug()


class Api:
    """hidapi's device on the end of a packet socket."""

    def __init__(self, fd: int) -> None:
        self._end = socket.socket(fileno=fd)
        self.ready = threading.Event()
        """While cleared, writes hang."""
        self.ready.set()
        self.hung = threading.Event()
        """Set when a write hangs."""
        self.refuses = False
        """If true, writes fail, as libusb's do after a second."""
        self.closed = 0

    def read(self, max_length: int, timeout_ms: int = 0) -> list[int]:
        if not select.select([self._end], [], [], timeout_ms / 1e3)[0]:
            return []
        try:
            data = self._end.recv(max_length)
        except OSError:
            data = b""
        if not data:
            raise OSError("read error")
        return list(data)

    def write(self, buff: bytes) -> int:
        if not self.ready.is_set():
            self.hung.set()
            self.ready.wait()
        try:
            return -1 if self.refuses else self._end.send(buff)
        except OSError:
            return -1

    def close(self) -> None:
        self.closed += 1
        self._end.close()


def opened(options: Options, fd: int, through: str = "node") -> HidDevice:
    """Return the driver on a packet socket: as a node, or through threads with hidapi's calls."""
    return HidDevice(options, ReportLink(fd) if through == "node" else make_thread_link(Api(fd), options))


def ends() -> tuple[int, socket.socket]:
    """Return the driver's file descriptor (non-blocking) and the device's end."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    return ours.detach(), theirs


@contextmanager
def woody(
    rig: str = "woodenhaptics-2019",
    intention: Callable[[float], Vector] = lambda _: (0.01, 0.02, -0.015),
    through: str = "node",
    **changes: Any,
) -> Iterator[tuple[HidDevice, Woody, Answering]]:
    """Open a device with the emulated arm of its rig; its limits allow for late answers of a busy machine."""
    options = rig_options(rig, **{"timeout_s": 0.5, **changes})
    generation = 1 if options.reports.name == "woodenhaptics-v1" else 2
    arm = Woody(RIGS[rig], generation, intention, options.reports.input.bytes)
    fd, end = ends()
    with Answering(end, arm.answer) as answering, opened(options, fd, through) as device:
        yield device, arm, answering


class RefusedNode(AbstractContextManager[Any]):
    """Regular file instead of a hidraw node that is in use or forbidden."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(dir="/tmp")
        Path(self._folder.name).chmod(0o755)
        self.path = Path(self._folder.name) / "hidraw9"
        self._undo = ExitStack()

    def make(self, case: str) -> None:
        """Apply a case from now on: busy or permission."""
        self.path.unlink(missing_ok=True)  # it may have been made unreadable
        self.path.touch()
        if case == "busy":
            fcntl.flock(self._undo.enter_context(self.path.open("rb")), fcntl.LOCK_EX)
        elif case == "permission":
            self.path.chmod(0)
            user = os.geteuid()
            if user == 0:  # file modes do not restrict root
                os.seteuid(65534)
                self._undo.callback(os.seteuid, user)

    def mend(self) -> None:
        """Undo `make`; may be called repeatedly."""
        self._undo.close()

    def __exit__(self, *_: object) -> None:
        self.mend()
        self._folder.cleanup()


class RefusingBench(driver_contract.Bench):
    """Bench of a node or port: refusals come from a `RefusedNode`, faults of the open device from `faults`."""

    patience_s: ClassVar[float] = 10.0

    def __init__(self, node: RefusedNode) -> None:
        self.node, self.case = node, ""

    def open(self) -> Device:
        if self.case:
            return self.open_path(f"{self.node.path}-none" if self.case == "not_found" else str(self.node.path))
        return self.open_emulated()

    @abstractmethod
    def open_path(self, path: str) -> Device:
        """Open the device of a path, which is refused."""

    @abstractmethod
    def open_emulated(self) -> Device:
        """Open the emulated device."""

    @abstractmethod
    def faults(self) -> Mapping[str, Callable[[], object]]:
        """Return functions that cause a fault, by its case."""

    def make(self, case: str) -> None:
        if case in self.faults():
            self.faults()[case]()
        else:
            self.case = case
            if case != "not_found":
                self.node.make(case)

    def mend(self) -> None:
        self.node.mend()
        self.case = ""
