"""Driver contract over the boards of helpers/far_ends.py: HID arms by a node or threads, boards on serial ports."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from helpers.described_boards import settled
from helpers.far_ends import FAR_RIGS, Far
from helpers.hid_devices import RefusedNode, RefusingBench
from helpers.rig_files import rig_options

from softfinger.config.load import load_rig
from softfinger.drivers import registry
from softfinger.drivers.base import Device
from softfinger.server.driver_contract import RATE_HZ, DriverContract

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
