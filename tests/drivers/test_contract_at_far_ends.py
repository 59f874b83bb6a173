"""The devices of helpers/far_ends.py: driver contract, and forces received after signals, faults and a stop."""

import logging
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.closed_loop import assert_engine_agrees, records_of_daemon
from helpers.described_boards import settled
from helpers.far_ends import FAR_ENDS, FAR_RIGS, Far, slowly, when_forced
from helpers.haply_devices import ID
from helpers.hid_devices import RefusedNode, RefusingBench
from helpers.rig_files import rig_options
from helpers.waits import repeated, until

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers import registry
from softfinger.drivers.base import Device
from softfinger.proxy.record import AT
from softfinger.server.cli import main
from softfinger.server.driver_contract import RATE_HZ, DeviceCaller, DriverContract

pytestmark = pytest.mark.real_time


class Board(NamedTuple):
    """Entry of FAR_RIGS with its options, a shipped rig with changed keys, and the step of a displayed force (N)."""

    name: str
    rig: str
    force_step_n: float
    options: Mapping[str, Any] = {}
    keys: Mapping[str, Any] = {}


def arm(rig: str, through: str = "node") -> Board:
    # An encoder count and 1 mA of a motor are 8 mN at the end of an arm.
    return Board("hid", rig, 0.012, {"rig": rig}, {"through": through})


BOARDS = {
    "arm of generation 1": arm("woodenhaptics-2015"),
    "arm of generation 2": arm("woodenhaptics-polhem-v1"),
    "arm through threads": arm("woodenhaptics-polhem-v1", "thread"),
    "arm with LPC1768": arm("woodenhaptics-2019-lpc1768"),
    # A text frame has millinewtons: half of one, and rounding.
    "text with a newline": Board("serial", "woodenhaptics-v3", 0.5e-3 * 1.001),
    "text with two newlines": Board("serial", "woodenhaptics-v3", 0.5e-3 * 1.001, {"early_end": True}),
    "2DIY": Board("haply-2diy", "haply-2diy", 1e-6),
    # The duty has 255 steps and its square is the torque: 0.017 N at 1 N.
    "Hapkit": Board("hapkit", "hapkit", 0.02),
}
NIGHTLY = ("arm with LPC1768",)


class FarBench(RefusingBench):
    far: Far
    device: Device
    lost = False

    def __init__(
        self, board: Board, folder: Path, patch: pytest.MonkeyPatch, node: RefusedNode, undo: ExitStack
    ) -> None:
        super().__init__(node)
        self.board, self.force_step_n = board, board.force_step_n
        self._folder, self._patch, self._undo = folder, patch, undo

    def open_path(self, path: str) -> Device:
        driver = registry.load("hid" if self.board.name == "hid" else "serial")
        device: Device = driver.open_device(rig_options(self.board.rig, path=path, **self.board.keys), RATE_HZ)
        return device

    def open_emulated(self) -> Device:
        self._undo.close()
        options = {"timeout_s": 0.5, **self.board.options, **self.board.keys}
        self.far = self._undo.enter_context(FAR_RIGS[self.board.name](self._folder, self._patch, **options))
        self.lost = False
        self.device = registry.open_device(load_rig(self.far.rig).device, RATE_HZ)
        return self.device

    def part(self, *force: float) -> tuple[float, ...]:
        return self.far.part(force)

    def displayed(self) -> tuple[float, ...]:
        if self.lost:  # without power
            return (0.0, 0.0, 0.0)
        counts = self.device.counts()
        written = counts["written"] - counts.get("dropped", 0)
        settled(self.far.count_frames, lambda frames: frames >= written, 5.0)
        forces = self.far.forces_since(-1)
        return tuple(forces[-1, 1:]) if len(forces) else (0.0, 0.0, 0.0)

    def faults(self) -> Mapping[str, Callable[[], object]]:
        return {"lost": self.unplug, "timeout": lambda: self.far.hush and self.far.hush()}

    def unplug(self) -> None:
        self.far.unplug()
        self.lost = True


@pytest.fixture(params=[pytest.param(name, marks=[pytest.mark.exhaustive] * (name in NIGHTLY)) for name in BOARDS])
def bench(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FarBench]:
    with RefusedNode() as node, ExitStack() as undo:
        yield FarBench(BOARDS[request.param], tmp_path, monkeypatch, node, undo)


class TestContract(DriverContract):
    """The contract over each board."""


CONTACT_N = 0.3
"""Less than the force of any of these hands."""
SIGNAL_S = 1.0
"""Maximum time from a signal to the last force (`server/signals.py`)."""
SIGNALS = {signal.SIGTERM: 0, signal.SIGINT: 0, signal.SIGHUP: 129, signal.SIGQUIT: 131,
           signal.SIGUSR1: 138, signal.SIGXCPU: 152}  # fmt: skip
"""Signals of a terminal, a shell, systemd, other programs and the kernel, with the exit code of each."""


def when_pressed(far: Far, act: Callable[[], object]) -> AbstractContextManager[list[float]]:
    def begin(over: threading.Event) -> None:
        while not over.wait(0.005) and far.count_frames() <= 50:
            pass
        far.press()

    return when_forced(far, CONTACT_N, act, begin)


def words(far: Far, folder: Path) -> list[str]:
    return ["run", "--rig", far.rig, "--scene", "paper-plane", "--endpoint", f"ipc://{folder}/t",
            "--commands", f"ipc://{folder}/c", "--duration", "60"]  # fmt: skip


BRIEFLY = ("openhaptics", "haply", "haply-2diy", "hapkit", "serial", "forcedimension", "falcon")
CASES = [
    pytest.param(
        number, name, id=f"{number.name}-{name}",
        marks=() if number is signal.SIGTERM and name in BRIEFLY else pytest.mark.exhaustive,
    )
    for number in SIGNALS
    for name in FAR_RIGS
]  # fmt: skip


@pytest.mark.parametrize(("number", "name"), CASES)
def test_a_signal_in_contact_ends_the_force_within_a_second(number, name, tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    with FAR_RIGS[name](tmp_path, monkeypatch) as far:
        with when_pressed(far, lambda: os.kill(os.getpid(), number)) as sent:
            code = main(words(far, tmp_path))
        settled(far.newest, lambda size: size == 0.0)
        forces = far.forces_since(0)
    assert sent and code == SIGNALS[number] and "force is zero" in caplog.text
    sizes = np.linalg.norm(forces[:, 1:], axis=1)
    assert sizes.max() > CONTACT_N and sizes[-1] == 0.0
    last = forces[np.flatnonzero(sizes)[-1] + 1, 0]  # the zero after the last force
    assert last - sent[0] < SIGNAL_S


@pytest.mark.parametrize("name", ["openhaptics", "forcedimension", "haply", "serial"])
def test_the_forces_of_the_loop_reach_the_motors(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("paper-plane")
    with FAR_RIGS[name](tmp_path, monkeypatch) as far, when_pressed(far, lambda: None):
        rig = load_rig(far.rig, {"telemetry.endpoint": f"ipc://{tmp_path}/t", "guard.ramp_s": 0.01})
        records = records_of_daemon(rig, scene, 2500)
        forces = far.forces_since(0)[:, 1:]
    assert assert_engine_agrees(records, scene, 1000.0) > 300
    sizes = np.linalg.norm(forces, axis=1).tolist()  # a driver's library has other axes
    ticks = iter(np.linalg.norm(records[:, AT.force : AT.force + 3], axis=1).tolist())
    changes = [size for size, _ in groupby(sizes) if size]  # a force is sent again if there is no new one
    assert len(changes) > 50
    assert all(any(abs(size - tick) <= far.resolution for tick in ticks) for size in changes)
    assert max(sizes) > CONTACT_N and sizes[-1] == 0.0


STOPS = {"hid": 20, "serial": 20, "replay": 30}
"""Number of stops on devices that open within milliseconds; the others are stopped once."""


@pytest.mark.parametrize("name", FAR_ENDS)
def test_no_force_follows_a_stop_during_writes(name: str, tmp_path: Path) -> None:
    for _ in range(STOPS.get(name, 1)):
        with FAR_ENDS[name](tmp_path) as far, far.device:
            servo = DeviceCaller(far.device)

            def write(servo: DeviceCaller = servo) -> None:
                servo.read()
                servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

            with repeated(write, every_s=0.0):
                until(lambda far=far: far.so_far()[:, 1:].any())
                far.device.stop()
                stopped = len(far.received())
                time.sleep(0.02)
                assert not far.received()[stopped - 1 :, 1:].any()


class Fault(NamedTuple):
    """Action on a device in contact and error text; `zero` unless the device is then unreachable."""

    act: Callable[[Far], object]
    message: str
    zero: bool = True
    brief: bool = False
    code: int = 4


def answers(spoil: Callable[[bytes], bytes]) -> Callable[[Far], object]:
    return lambda far: setattr(far.device, "spoil", spoil)


def late(answer: bytes) -> bytes:
    time.sleep(1.5)
    return answer


def nothing_but_null(far: Far) -> None:
    """Send null, as the maker's JSON writes a NaN."""
    far.device.set(
        spoil=f'{{"inverse3":[{{"device_id":"{ID}","state":{{"cursor_position":{{"x":null,"y":0,"z":0}}}}}}]}}'
    )


def unplug(far: Far) -> None:
    far.unplug()


def set_knobs(**knobs: float) -> Callable[[Far], object]:
    return lambda far: far.device.update(**knobs)


def delay_a_frame(far: Far) -> None:
    far.device.update(delay_at=far.device["frames"] + 2, delay_s=0.9)


def turned_round(far: Far) -> None:
    slowly(lambda share: far.device.turn(0.094 + 1.9 * share))


NO_POSE = "no usable pose for 0.5 s"
SILENT = "no answer to a read in time"
NO_FRAME = "violates its protocol .*its last bytes are "
FAULTS: dict[str, dict[str, Fault]] = {
    "openhaptics": {
        "unplugged": Fault(set_knobs(unplugged=1), "Touch, serial 70001 is gone.*does not answer", brief=True),
        "silent": Fault(set_knobs(hang_at=0), SILENT, brief=True),
        "dropped callback": Fault(set_knobs(drop_at=0), SILENT),
        "late frame": Fault(delay_a_frame, SILENT, brief=True),
        "hot": Fault(lambda far: far.device.push(0x200, 0), "disabled its force.*too warm", brief=True, code=6),
        "no number": Fault(set_knobs(mirror=1), NO_POSE),
    },
    "forcedimension": {
        "unplugged": Fault(
            set_knobs(unplugged=1), "omega.3, serial 1230 is gone.*error 2, communication error", brief=True
        ),
        "silent": Fault(set_knobs(fail_read=0, error=7), f"{SILENT}.*error 7, timeout", brief=True),
        "no write": Fault(set_knobs(fail_write=0, error=2), "on write.*error 2, communication error", brief=True),
        "force button": Fault(set_knobs(force_on=0, cause=1), "disabled its force.*button", brief=True, code=6),
        "error code": Fault(set_knobs(error_word=3), "error code is 3", brief=True, code=6),
    },
    "haply": {
        "unplugged": Fault(unplug, "inverse3 049D is no longer in the service's list", brief=True),
        "killed": Fault(lambda far: far.device.kill(), "connection", zero=False, brief=True),
        "silent": Fault(lambda far: far.device.set(mute=True), SILENT, brief=True),
        "garbage": Fault(lambda far: far.device.set(spoil="<html>"), "answered '<html>'", brief=True),
        "no number": Fault(nothing_but_null, NO_POSE),
        "later than it may be": Fault(lambda far: far.device.set(late_s=1.5), SILENT),
    },
    "haply-2diy": {
        "unplugged": Fault(unplug, r"serial at /dev/pts/\d+ is gone", zero=False, brief=True),
        "silent": Fault(lambda far: far.device.mute.set(), SILENT, brief=True),
        "no number": Fault(answers(lambda answer: answer[:1] + b"\xff\xff\xff\x7f" + answer[5:]), NO_FRAME, brief=True),
        "torn": Fault(answers(lambda answer: answer[:5]), f"{SILENT}|violates its protocol", brief=True),
        "later than it may be": Fault(answers(late), SILENT),
    },
    "hapkit": {
        "unplugged": Fault(unplug, "is gone", zero=False),
        "silent": Fault(lambda far: far.device.hush(), SILENT),
        "out of range": Fault(turned_round, "violates its protocol"),
    },
    "serial": {
        "unplugged": Fault(unplug, r"serial 16c0:0483 at /dev/pts/\d+ is gone", zero=False, brief=True),
        "silent": Fault(lambda far: far.device.hush(), SILENT, brief=True),
        "garbage": Fault(answers(lambda frame: frame.replace(b".", b",")), f"{NO_FRAME}b'.*,", brief=True),
        "no number": Fault(answers(lambda frame: frame[:1] + b"     nan".ljust(8) + frame[9:]), NO_FRAME),
        "later than it may be": Fault(answers(late), SILENT),
    },
}


@pytest.mark.parametrize(
    ("name", "case"),
    [
        pytest.param(name, case, id=f"{fault}-{name}", marks=() if case.brief else pytest.mark.exhaustive)
        for name, faults in FAULTS.items()
        for fault, case in faults.items()
    ],
)
def test_a_fault_in_contact_ends_the_run_without_force(name, case, tmp_path, monkeypatch, capsys):
    with FAR_RIGS[name](tmp_path, monkeypatch) as far:
        with when_pressed(far, lambda: case.act(far)) as acted:
            code = main(words(far, tmp_path))
        assert not case.zero or settled(far.newest, lambda size: size == 0.0) == 0.0
    stderr = capsys.readouterr().err
    assert acted and code == case.code, stderr
    errors: list[Any] = [line for line in stderr.splitlines() if line.startswith("softfinger: ")]
    assert len(errors) == 1 and re.search(case.message, errors[0]), stderr
