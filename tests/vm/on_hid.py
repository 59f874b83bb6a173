"""The daemon on a WoodenHaptics arm of the guest's kernel: a HID device on dummy_hcd's bus, its real hidraw node."""

import re
from pathlib import Path

import numpy as np
import pytest
from helpers.rig_files import write_rig
from test_hid_emulated import STROKE

from vm import contract_hid
from vm.cases import TICKS, Cases
from vm.guest import Gadget, contract, gadget, keep
from vm.guest import loaded as loaded


class TestCases(Cases):
    """The common cases on an arm."""

    kind = "woodenhaptics"
    ids = ("16c0", "0486")
    name = "Emulators Emulated arm"
    node = r"/dev/hidraw\d+"
    bus = "hid"
    packets, force = "reports", "motors"
    felt = 100  # mA
    held = r"is used by process {pid} \("
    forbidden = r"/dev/hidraw\d+ may not be opened by this user"

    def test_the_attached_device_is_listed(self) -> None:
        with gadget("woodenhaptics"):
            (device,) = self.listed()
        assert (device["driver"], device["state"], device["bus"]) == ("hid", "usable", self.bus)
        assert (device["serial"], device["name"]) == ("SN42", self.name)
        assert "woodenhaptics-2019" in device["rigs"]
        assert re.fullmatch(self.node, device["node"])
        assert self.listed() == []

    def test_closed_loop_without_a_bus(self, tmp_path: Path, rig: str) -> None:
        records_file = tmp_path / "records.npy"
        with gadget("woodenhaptics", bus="uhid", **STROKE) as arm:
            keep(rig, "paper-plane", TICKS, records_file)
            saw = arm.seen()
        self.agrees(np.load(records_file), saw)

    def test_an_arm_that_takes_no_report(self, pressed: Gadget, rig: str) -> None:
        ended = self.faulty("blocked", pressed, rig)
        assert ended.code in (4, 6), ended.err
        assert re.search(r"no answer to a (read|write) in time|no tick for 0\.\d+ s", ended.err), ended.err


@pytest.fixture
def rig(tmp_path: Path) -> str:
    """The shipped rig, with time-outs for an emulated processor."""
    return str(write_rig(tmp_path, "woodenhaptics-2019", kick_s=0.1, timeout_s=1.0))


def test_the_driver_contract() -> None:
    """All tests of the contract pass over the node, without a skip.

    They run on the bus, where an unread report delays the next: uhid drops reports beyond its queue without an error.
    """
    with gadget("woodenhaptics", place=[0.0, 0.0, 0.02]) as arm:
        output, code = contract(Path(contract_hid.__file__), arm)
    assert code == 0, output
    assert re.search(r"^\d+ passed in", output, re.MULTILINE), output
