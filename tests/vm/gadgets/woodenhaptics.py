"""WoodenHaptics arm as a HID device of the guest's kernel.

    python woodenhaptics.py SOCKET '{"arm": "woody-2019", "bus": "usb", "place": [0, 0, 0.01]}'

Keys of the case: arm (a row of the emulator's table), bus (usb or uhid), place (m), press (m: downward motion of the
hand), drag (m: sideways motion). Lines over the socket: `displayed`, `seen`, `make CASE`, `mend`, `quit`; the cases:

not_found, lost   unplugged
busy              another program has locked its node
permission        its node is not accessible
timeout           does not answer
blocked           accepts no report
"""

from __future__ import annotations

import fcntl
import json
import os
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from emulators.hand import stroke
from emulators.woodenhaptics import Woody

from vm.gadgets.hid import HidDevice, Uhid, UsbHid
from vm.gadgets.serving import serve, settle

IDS = (0x16C0, 0x0486)
REPORT_BYTES = 64
# Vendor page, one input and one output report of 64 bytes, without ids.
DESCRIPTOR = bytes.fromhex("06abff0a0002a1017508150026ff00954009018102954009029102c0")


class Board:
    """The arm's board between the kernel and the emulated mechanism."""

    def __init__(self, case: dict) -> None:
        intention = stroke(tuple(case.get("place", (0.0, 0.0, 0.0))), case.get("press", 0.0), case.get("drag", 0.0))
        self.woody = Woody(case.get("arm", "woody-2019"), 2, intention)
        self.lock = threading.Lock()
        self.mute = False
        self.taken_at = time.monotonic()
        self.rival: int | None = None
        self.device: HidDevice
        if case.get("bus", "usb") == "usb":
            self.device = UsbHid(*IDS, "Emulated arm", DESCRIPTOR, REPORT_BYTES, self.take)
        else:
            self.device = Uhid(*IDS, "Emulated arm", DESCRIPTOR, self.take)
        self.device.plug()

    def take(self, report: bytes) -> None:
        with self.lock:
            answer = self.woody.answer(report)
            self.taken_at = time.monotonic()
        if not self.mute:
            self.device.send(answer)

    def displayed(self) -> tuple[float, ...]:
        settle(lambda: self.taken_at)
        with self.lock:
            a, b, c = (i / 1e3 for i in self.woody.milliamperes)
            force = self.woody.arm.force(self.woody.place, (a, b, c))
        return (0.0, 0.0, 0.0) if self.device.node is None else force

    def seen(self) -> dict:
        settle(lambda: self.taken_at)
        with self.lock:
            woody = self.woody
            most = [max((abs(words[k]) for words in woody.sent), default=0) for k in range(3)]
            return {
                "reports": len(woody.sent), "last": list(woody.sent[-1][:3]) if woody.sent else [],
                "most": most, "place": woody.place, "motors": woody.milliamperes,
            }  # fmt: skip

    def make(self, case: str) -> None:
        node = self.device.node or ""
        if case in ("not_found", "lost"):
            self.device.unplug()
            with self.lock:
                self.woody.milliamperes = (0, 0, 0)  # its amplifiers have no power
        elif case == "busy":
            self.rival = os.open(node, os.O_RDWR)
            fcntl.flock(self.rival, fcntl.LOCK_EX)
        elif case == "permission":
            os.chmod(node, 0)
        elif case == "timeout":
            self.mute = True
        elif case == "blocked":
            self.device.blocked = True
        else:
            raise ValueError(f"no case of this device: {case}")

    def mend(self) -> None:
        self.mute = self.device.blocked = False
        if self.rival is not None:
            os.close(self.rival)
            self.rival = None
        if self.device.node is None:
            self.device.plug()
        else:
            os.chmod(self.device.node, 0o600)


if __name__ == "__main__":
    board = Board(json.loads(sys.argv[2]))
    serve(sys.argv[1], board)
    board.device.unplug()
    os._exit(0)  # the thread waits for a host
