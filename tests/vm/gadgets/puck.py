"""SpaceMouse in the guest's HID layer, which is deflected and reports it.

    python puck.py SOCKET '{"push": {"up": -350}, "buttons": 5}'

Keys of the case: push (deflection in counts, with the names of emulators/puck.py), buttons, reports: split or combined.
Lines over the socket: `seen`, `make lost`, `mend`, `quit`.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from emulators import puck

from vm.gadgets.hid import Uhid
from vm.gadgets.serving import serve

REPORT_PERIOD_S = 0.016


def descriptor(combined: bool) -> bytes:
    """Return a multi-axis controller: axes in report 1, or in 1 and 2, -350 to 350; buttons in 3; lamp in 4."""
    limits = bytes.fromhex("16a2fe265e01")

    def axes(number: int, usages: str) -> bytes:
        count = len(usages) // 4
        return (
            bytes([0xA1, 0, 0x85, number])
            + limits
            + bytes.fromhex(usages)
            + bytes([0x75, 16, 0x95, count, 0x81, 2, 0xC0])
        )

    moved = axes(1, "093009310932093309340935") if combined else axes(1, "093009310932") + axes(2, "093309340935")
    pressed = bytes.fromhex("a102850305091901292015002501750195208102c0")
    lamp = bytes.fromhex("a10285040508094b1500250175019501910295079103c0")
    return bytes.fromhex("05010908a101") + moved + pressed + lamp + b"\xc0"


class Puck:
    """The puck, its hand, and the lamp."""

    def __init__(self, case: dict) -> None:
        self.case = case
        self.written: list[str] = []
        combined = case.get("reports") == "combined"
        self.kind = puck.combined if combined else puck.split
        # For the older maker's ids, the kernel's driver requires a USB interface, which uhid does not have.
        ids = (0x256F, 0xC62E if combined else 0xC635)
        self.device = Uhid(
            *ids, "SpaceNavigator", descriptor(combined), lambda report: self.written.append(report.hex())
        )  # fmt: skip
        self.device.plug()
        threading.Thread(target=self._report, daemon=True).start()

    def _report(self) -> None:
        while True:
            for report in [*self.kind(**self.case.get("push", {})), puck.buttons(self.case.get("buttons", 0))]:
                self.device.send(report)
            time.sleep(REPORT_PERIOD_S)

    def seen(self) -> dict:
        return {"written": self.written}

    def make(self, case: str) -> None:
        if case != "lost":
            raise ValueError("no case of this device")
        self.device.unplug()

    def mend(self) -> None:
        self.device.plug()


if __name__ == "__main__":
    made = Puck(json.loads(sys.argv[2]))
    serve(sys.argv[1], made)
    made.device.unplug()
    os._exit(0)  # the threads wait for a host
