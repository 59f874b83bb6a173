"""WoodenHaptics' third generation as a USB serial port of the guest's kernel: f_acm at one end, cdc-acm at the other.

    python serialboard.py SOCKET '{"place": [0, 0, 0.01]}'

Keys of the case: place (m), press (m: downward motion of the hand), drag (m: sideways motion). Lines over the socket:
`seen`, `make CASE`, `mend`, `quit`; the cases:

lost      unplugged
timeout   receives, but does not answer
blocked   reads nothing
"""

from __future__ import annotations

import json
import os
import select
import sys
import threading
import time
import tty
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from emulators.hand import stroke
from emulators.serialboard import Board

from vm.gadgets import serving
from vm.gadgets.configfs import PLUG_S, Gadget, settle

IDS = (0x16C0, 0x0483)
TTYS = Path("/sys/class/tty")
POLL_MS = 100


class Port:
    """The board's end of the cable."""

    def __init__(self, case: dict) -> None:
        intention = stroke(tuple(case.get("place", (0.0, 0.0, 0.0))), case.get("press", 0.0), case.get("drag", 0.0))
        self.board = Board(intention, early_end=True)
        self.lock = threading.Lock()
        self.made = ""
        self.heard_at = time.monotonic()
        self.end = -1
        self.gadget = Gadget(1, *IDS, "Emulators", "USB Serial", "SN42")
        self.gadget.function("acm.board")
        self.number = (self.gadget.folder / "functions/acm.board/port_num").read_text().strip()
        threading.Thread(target=self._run, daemon=True).start()
        self.plug()

    def plug(self) -> None:
        self.gadget.plug()
        until = time.monotonic() + PLUG_S
        while self.node is None:
            if time.monotonic() > until:
                raise TimeoutError("the kernel makes no serial port of the device")
            time.sleep(0.01)
        settle()
        end = os.open(f"/dev/ttyGS{self.number}", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(end)
        self.end = end

    def unplug(self) -> None:
        self.gadget.unplug()
        end, self.end = self.end, -1
        if end >= 0:
            time.sleep(2 * POLL_MS / 1e3)  # the thread no longer uses it
            os.close(end)
        with self.lock:
            self.board.force = (0.0, 0.0, 0.0)  # its amplifiers have no power

    @property
    def node(self) -> str | None:
        """Port on the host's side, or None."""
        for path in TTYS.glob("ttyACM*"):
            return f"/dev/{path.name}"
        return None

    def _run(self) -> None:
        rest = b""
        while True:
            end = self.end
            poll = select.poll()
            if end < 0 or self.made == "blocked":
                time.sleep(POLL_MS / 1e3)
                rest = b""
                continue
            poll.register(end, select.POLLIN)
            if not poll.poll(POLL_MS):
                continue
            try:
                data = os.read(end, 4096)
            except OSError:
                data = b""
            if not data:  # no host
                time.sleep(POLL_MS / 1e3)
                continue
            rest += data
            while b"\n" in rest:
                line, _, rest = rest.partition(b"\n")
                with self.lock:
                    answer = self.board.answer(line + b"\n")
                    self.heard_at = time.monotonic()
                if self.made != "timeout":
                    with suppress(OSError):  # answers are lost if the buffer is full
                        os.write(end, answer)

    def seen(self) -> dict:
        serving.settle(lambda: self.heard_at)
        board = self.board
        with self.lock:
            most = [max((abs(words[k]) for words in board.sent), default=0) for k in range(3)]
            return {
                "frames": len(board.sent), "wakes": board.wakes, "force": board.force, "most": most,
                "faults": [fault.decode(errors="replace") for fault in board.faults],
            }  # fmt: skip

    def make(self, case: str) -> None:
        if case == "lost":
            self.unplug()
        self.made = case

    def mend(self) -> None:
        self.made = ""
        if not self.gadget.plugged:
            self.plug()


if __name__ == "__main__":
    port = Port(json.loads(sys.argv[2]))
    serving.serve(sys.argv[1], port)
    port.unplug()
    os._exit(0)  # the thread waits for a host
