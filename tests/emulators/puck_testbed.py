"""Emulated SpaceMouse as a hidraw node of umockdev, and a program on it, as in testbed.py.

Keys of the first argument: push (deflection in counts, with the names of puck.py), buttons, unplug_after_s (after the
first write), unplug_when (a path, as soon as it exists), reports: split or combined. The reports sent to the puck are
the last line of standard output, as JSON.
"""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from gi.repository import GLib

from emulators import puck, testbed
from emulators.boards import Board, Interface, raw_hid

REPORT_PERIOD_MS = 16


class PuckBed(testbed.Bed):
    name = "SpaceNavigator"

    def __init__(self, case: dict) -> None:
        self.case, self.ids = case, (0x046D, 0xC626)
        self.descriptor = raw_hid(13)
        self.board = Board(*self.ids, self.name, (Interface(self.descriptor, 0x81, 0x02, 13, 13),))
        self.queue: list[bytes] = []
        self.written: list[bytes] = []
        self.unplugged = False
        self._wire()
        GLib.timeout_add(REPORT_PERIOD_MS, self._report)
        if "unplug_when" in case:
            GLib.timeout_add(REPORT_PERIOD_MS, self._unplug_when)

    def _report(self) -> bool:
        kind = puck.combined if self.case.get("reports") == "combined" else puck.split
        for report in [*kind(**self.case.get("push", {})), puck.buttons(self.case.get("buttons", 0))]:
            if len(self.queue) < 64:  # as many as the kernel queues
                self.queue.append(report)
                os.write(self.terminal, b"\1")
        return not self.unplugged

    def _unplug_when(self) -> bool:
        return self._unplug() if os.path.exists(self.case["unplug_when"]) else True

    def _unplug(self) -> bool:
        self.unplugged = True
        vendor, product = self.ids
        hid = f"/sys{testbed.DEVICE}/1-1:1.0/0003:{vendor:04X}:{product:04X}.0001"
        for path in (f"{hid}/hidraw/hidraw0", hid, f"/sys{testbed.DEVICE}/1-1:1.0", f"/sys{testbed.DEVICE}"):
            self.bed.uevent(path, "remove")
            self.bed.remove_device(path)
        return False

    def _past(self, event: str) -> bool:
        return self.unplugged

    def _write(self, _: object, client: object) -> bool:
        data = bytes(client.get_arg().retrieve())
        if not self.written and "unplug_after_s" in self.case:
            GLib.timeout_add(round(1000 * self.case["unplug_after_s"]), self._unplug)
        self.written.append(data)
        client.complete(len(data), 0)
        return True

    def seen(self) -> dict:
        return {"written": [data.hex() for data in self.written]}


if __name__ == "__main__":
    testbed.main(PuckBed)
