"""The daemon on WoodenHaptics' third generation on a serial port of the guest's kernel: f_acm, dummy_hcd, cdc-acm."""

import re
from pathlib import Path
from typing import Any

import pytest
from helpers.rig_files import write_rig

from vm.cases import Cases
from vm.guest import Gadget, gadget
from vm.guest import loaded as loaded


class TestCases(Cases):
    """The common cases on a serial board."""

    kind = "serialboard"
    ids = ("16c0", "0483")
    name = "USB Serial"
    node = r"/dev/ttyACM\d+"
    bus = "serial"
    packets, force = "frames", "force"
    felt = 500  # mN
    held = r"is used by process {pid} \("
    forbidden = r"/dev/ttyACM\d+ may not be opened by this user"

    def test_the_attached_device_is_listed(self) -> None:
        """`devices` lists it by its port under its driver; the rig has to name it, because any Teensy has its ids.
        Unplugged, it is no longer listed."""
        with gadget("serialboard"):
            (device,) = self.listed()
        assert (device["driver"], device["state"], device["bus"]) == ("serial", "product", self.bus)
        assert (device["serial"], device["name"]) == ("SN42", self.name)
        assert device["rigs"] == ["woodenhaptics-v3"]
        assert re.fullmatch(self.node, device["node"])
        assert self.listed() == []

    def agrees(self, records: Any, saw: dict[str, Any]) -> None:
        super().agrees(records, saw)
        assert saw["faults"] == []

    def test_a_board_that_reads_no_more(self, pressed: Gadget, rig: str) -> None:
        ended = self.faulty("blocked", pressed, rig)
        assert ended.code == 4, ended.err
        assert re.search("no answer to a (read|write) in time", ended.err), ended.err
        pressed.ask("mend")
        self.works(pressed, rig)


@pytest.fixture
def rig(tmp_path: Path) -> str:
    """The shipped rig with the serial number of the board, and time-outs for an emulated processor."""
    return str(write_rig(tmp_path, "woodenhaptics-v3", serial="SN42", quiet_s=0.15, timeout_s=1.0))
