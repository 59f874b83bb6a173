"""The daemon on a Falcon of the guest's kernel: a device on dummy_hcd's bus, usbfs, the real libusb."""

import random
import re
from pathlib import Path
from typing import Any

import pytest
from test_falcon_emulated import CONTRACT, FIRMWARE_BYTES, rig_with

from vm.cases import Cases
from vm.guest import Gadget, contract, daemon, gadget
from vm.guest import loaded as loaded


class TestCases(Cases):
    """The common cases on a Falcon."""

    kind = "falcon"
    ids = ("0403", "cb48")
    name = "FALCON HAPTIC"
    node = r"/dev/bus/usb/\d{3}/\d{3}"
    bus = "usb"
    packets, force = "steps", "motors"
    felt = 100  # motor counts: 1 N is some 240
    held = "is used by another program: close it first"
    forbidden = "may not be opened by this user: .*install --system"

    def test_the_attached_device_is_listed(self, tmp_path: Path) -> None:
        path = tmp_path / "firmware.bin"
        path.write_bytes(bytes(FIRMWARE_BYTES))
        with gadget("falcon", serial="SN7"):
            (without,) = self.listed()
            (device,) = self.listed(rig=rig_with(tmp_path, firmware=str(path)))
        assert (device["driver"], device["state"], without["state"]) == ("falcon", "usable", "firmware")
        assert (device["serial"], device["name"], device["rigs"]) == ("SN7", self.name, ["falcon"])
        assert re.fullmatch(self.node, device["node"])
        assert self.listed() == []

    def agrees(self, records: Any, saw: dict[str, Any]) -> None:
        super().agrees(records, saw)
        assert saw["state"] == 8, "the last packet leaves the light red"

    @pytest.mark.parametrize(
        ("case", "message"),
        [
            ("blocked", "no answer to a (read|write) in time"),
            ("stalled", r"is gone .status -1 on read.*libusb's error 4"),
        ],
    )
    def test_faults_of_an_endpoint(self, case: str, message: str, pressed: Gadget, rig: str) -> None:
        ended = self.faulty(case, pressed, rig)
        assert ended.code == 4 and re.search(message, ended.err), ended.err
        for line in ("mend", "make lost", "mend"):
            pressed.ask(line)
        self.works(pressed, rig)


@pytest.fixture
def rig(tmp_path: Path) -> str:
    return rig_with(tmp_path)


def test_firmware_is_sent_on_request(tmp_path: Path) -> None:
    path = tmp_path / "firmware.bin"
    path.write_bytes(random.Random(FIRMWARE_BYTES).randbytes(FIRMWARE_BYTES))
    with gadget("falcon", firmware=FIRMWARE_BYTES, spoil=1) as falcon:
        with daemon(rig_with(tmp_path), "--duration", "0.1") as refused:
            assert refused.end(120) == 4, refused.err
        assert "no firmware runs in the Falcon: set `firmware`" in refused.err
        with daemon(rig_with(tmp_path, firmware=str(path)), "--duration", "0.1") as running:
            assert running.end(180) == 0, running.err
        saw = falcon.seen()
    assert saw["runs"] and saw["loads"] == 2
    assert re.search(r"try 1 of 10: byte 3\d\d\d of 7324 was returned as", running.err)


def test_the_driver_contract() -> None:
    with gadget("falcon", place=[0.0, 0.0, 0.02]) as falcon:
        output, code = contract(CONTRACT, falcon)
    assert code == 0, output
    assert re.search(r"^\d+ passed in", output, re.MULTILINE), output
