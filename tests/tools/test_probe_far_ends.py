"""`devices --probe --push` on the emulated device of every driver: what its far end was given, whatever ended it.

Simulated and replayed devices have no far end; `test_probe` has them.
"""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from emulators.hapkit import COMPILER as CXX
from emulators.hapkit import HANDLE_M, PULLEY_M, SECTOR_M, Hapkit
from emulators.hapkit import NO_COMPILER as NO_CXX
from emulators.haply2diy import Port
from emulators.serialboard import Board, Cable
from helpers import haply_devices, usb_stub
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.described_boards import force_at, settled
from helpers.drd_stub import SOURCE as DRD
from helpers.drd_stub import Stub
from helpers.far_ends import Given, compiled, needs, sketch_library
from helpers.hd_stub import SOURCE as HD
from helpers.hd_stub import HdStub
from helpers.hid_devices import woody
from numpy.typing import NDArray
from test_device_report import checked, environment, home

from softfinger.config.load import find
from softfinger.config.schema import Rig
from softfinger.server.cli import main
from softfinger.tools.doctor import probe, report

__all__ = ["home"]  # a fixture

pytestmark = pytest.mark.real_time

PATIENT = {"quiet_s": 0.2, "timeout_s": 1.0}
"""A thread of a busy machine may answer late."""


class Far(NamedTuple):
    """What is behind a rig.

    rig         file of the rig
    given       forces from that number on, in their order (n, 3) N; of -1 the newest
    unplug      pull the cable
    resolution  N, of what the motors take
    sees        the axes along which it is pushed
    powerless   without its cable it gives no force; others would keep the last, which is all that can be said here
    """

    rig: str
    given: Callable[[int], NDArray[np.float64]]
    unplug: Callable[[], None]
    resolution: float = 1e-6
    sees: str = "xyz"
    powerless: bool = False


def rig_file(folder: Path, name: str, **keys: object) -> str:
    """A shipped rig with these keys of [device], without real-time settings, its force there after 50 ms."""
    text = find(name, Rig).read_text()
    for key in keys:
        text = re.sub(rf"^{key} = .*\n", "", text, flags=re.MULTILINE)
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
    text = text.replace("[device]\n", f"[device]\n{lines}").replace('realtime = "auto"', 'realtime = "off"')
    file = folder / f"my-{name}.toml"
    file.write_text(re.sub(r"^ramp_s = \S+", "ramp_s = 0.05", text, flags=re.MULTILINE))
    return str(file)


@contextmanager
def open_haptics(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    needs(COMPILER, NO_COMPILER)
    stub = HdStub(compiled(HD, "libHD.so.3.4.0", "-pthread"))
    stub.reset()

    def unplug() -> None:
        stub["unplugged"] = 1

    rig = rig_file(folder, "touch", library_file=str(stub.path), force_age_max_s=0.1)
    yield Far(rig, lambda first: stub.journal()["force"][first:], unplug, powerless=True)
    stub.reset()


@contextmanager
def force_dimension(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    needs(COMPILER, NO_COMPILER)
    stub = Stub(compiled(DRD, "libdrd.so.3.17.5"))
    stub.reset()

    def unplug() -> None:
        stub["unplugged"] = 1

    rig = rig_file(folder, "omega-3", library_file=str(stub.path), watchdog_s=0.0)
    yield Far(rig, lambda first: stub.log()[first:, 1:], unplug, powerless=True)
    stub.reset()


@contextmanager
def falcon(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    needs(COMPILER, NO_COMPILER)
    library = compiled(usb_stub.SOURCE, usb_stub.SONAME)
    stub = usb_stub.UsbStub(library)
    stub.reset()
    stub["logged"] = 0

    def unplug() -> None:
        stub["unplugged"] = 1

    rig = rig_file(folder, "falcon", counts_per_nm=10000.0, kick_s=0.15, timeout_s=2.0)
    with usb_stub.in_place_of_libusb(library):
        yield Far(rig, lambda first: stub.log()[first:, :3], unplug, usb_stub.FalconBench.force_step_n)
    stub.reset()


@contextmanager
def hid(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    """The arm has no node: what opens a device gets it from here."""
    with woody(timeout_s=2.0) as (device, arm, answering):
        patch.setattr(report, "open_device", lambda *_: device)

        def given(first: int) -> NDArray[np.float64]:
            sent = np.array(list(arm.sent)[first:], float).reshape(-1, 7)[:, :3] * 1e-3
            return np.array([arm.arm.force(arm.place, tuple(row)) for row in sent]).reshape(-1, 3)

        # half a milliampere in each of three motors
        yield Far(rig_file(folder, "woodenhaptics-2019", timeout_s=2.0), given, answering.unplug, 0.01)


@contextmanager
def haply(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    with haply_devices.Service() as service:
        service.do("hand", id=haply_devices.ID, at=[0.0, 0.0, 0.03], press=0.0, drag=0.0)

        def given(first: int) -> NDArray[np.float64]:
            return np.array([service.force()] if first < 0 else [row[1:] for row in service.log()]).reshape(-1, 3)

        def unplug() -> None:
            service.do("vanish", id=haply_devices.ID)

        rig = rig_file(folder, "haply-inverse3", port=service.port, stale_s=0.2, **PATIENT)
        yield Far(rig, given, unplug, powerless=True)


@contextmanager
def serial(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    with Cable(Board(lambda _: (0.01, 0.02, -0.015))) as cable:

        def given(first: int) -> NDArray[np.float64]:
            return np.array(list(cable.board.sent)[first:], float).reshape(-1, 7)[:, :3] * 1e-3

        yield Far(rig_file(folder, "woodenhaptics-v3", path=cable.path, **PATIENT), given, cable.pull, 1e-3)


@contextmanager
def two_diy(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    board = Given()
    with Port(board) as port:

        def given(first: int) -> NDArray[np.float64]:
            rows = [force_at(board.angles, torques) for torques in list(board.given)[first:]]
            return np.array(rows).reshape(-1, 3)

        yield Far(
            rig_file(folder, "haply-2diy", path=port.path, **PATIENT), given, port.pull, 1e-6, "xz", powerless=True
        )


@contextmanager
def hapkit(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Far]:
    needs(CXX, NO_CXX)
    with Hapkit(sketch_library()) as board:

        def given(first: int) -> NDArray[np.float64]:
            changes = board.changes()
            rows = np.zeros((len(changes), 3))
            rows[:, 2] = [torque * SECTOR_M / PULLEY_M / HANDLE_M for _, torque in changes]
            return rows[first:]

        # a duty cycle of one in 255, whose torque is 0.03 N m duty^2: at 0.2 N duty is 0.2
        yield Far(rig_file(folder, "hapkit", path=board.path, **PATIENT), given, board.pull, 0.01, "z")


FAR: dict[str, Any] = {
    "openhaptics": open_haptics, "forcedimension": force_dimension, "falcon": falcon, "hid": hid, "haply": haply,
    "serial": serial, "haply-2diy": two_diy, "hapkit": hapkit,
}  # fmt: skip


@contextmanager
def when_pushed(far: Far, act: Callable[[], object] | None) -> Iterator[None]:
    """Do something, once, when the far end has more than half of a push."""
    over = threading.Event()

    def wait() -> None:
        while act is not None and not over.wait(0.002):
            newest = far.given(-1)
            if len(newest) and np.linalg.norm(newest[-1]) > 0.5 * probe.PUSH_N and not over.is_set():
                act()
                return

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


BRIEFLY = ("openhaptics", "haply", "haply-2diy", "hapkit")
"""Whose every way out is tried each time; the others' with the exhaustive tests."""
CASES = [
    pytest.param(way, name, marks=() if name in BRIEFLY or way == "Ctrl-C" else pytest.mark.exhaustive)
    for way in ("whole", "Ctrl-C", "unplugged")
    for name in FAR
]


@pytest.mark.parametrize(("way", "name"), CASES)
def test_the_far_end_has_no_more_than_a_push_and_zero_at_last(
    way: str, name: str, home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A fifth of a newton along each axis that the device has, and back; the report is written, also when the user
    ends it, or the cable is pulled, in a push. Nothing reaches a motor whose cable is pulled, not even a zero."""
    for key, value in environment(home).items():
        monkeypatch.setenv(key, value)
    monkeypatch.chdir(home)
    monkeypatch.setattr(probe, "PART_S", 0.1)
    monkeypatch.setattr(probe, "PUSH_S", 0.4)
    with open(os.devnull) as nobody, FAR[name](home, monkeypatch) as far:
        monkeypatch.setattr(sys, "stdin", nobody)
        acts = {"whole": None, "Ctrl-C": lambda: os.kill(os.getpid(), signal.SIGINT), "unplugged": far.unplug}
        with when_pushed(far, acts[way]):
            code = main(["devices", "--probe", "mine.json", "--push", "--rig", far.rig])
        ends = way != "unplugged" or far.powerless
        settled(lambda: far.given(-1), lambda newest: not newest.any() or not ends)
        sizes = np.linalg.norm(far.given(0), axis=1)
    said = capsys.readouterr()
    assert code == {"whole": 0, "Ctrl-C": 130, "unplugged": 4}[way], said.err
    assert sizes[-1] == 0.0 or not ends
    assert 0.5 * probe.PUSH_N < sizes.max() <= probe.PUSH_N + far.resolution
    found = checked(home / "mine.json", home)
    assert found["ended"] == {"whole": "in full", "Ctrl-C": "cut short by the user", "unplugged": "by a fault"}[way]
    assert "hold the handle lightly: it pushes with 0.2 N" in said.err
    if way == "whole":
        assert [push["axis"] for push in found["pushes"]] == [f"+{axis}" for axis in far.sees]
        assert sizes.max() > 0.9 * probe.PUSH_N
        assert bool(found["freedom"]) == (far.sees != "xyz") and ("it moves " in said.out) == (far.sees != "xyz")
