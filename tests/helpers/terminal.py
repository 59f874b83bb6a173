"""Pseudo terminal for tests: runs a program and interprets its output as a screen."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import termios
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from helpers.programs import Program

_PART = re.compile(r"\x1b\[([0-9;?]*)([A-Za-z])|(\r)|(\n)|([^\x1b\r\n])", re.DOTALL)


class Screen:
    """Contents of the screen after every byte. It supports only the control sequences of a progress display.

    The number of lines is unlimited. Longer lines wrap at the width of the terminal.
    """

    def __init__(self, columns: int) -> None:
        self.columns = columns
        self.lines: list[str] = [""]
        self.row = self.column = 0

    def feed(self, text: str) -> None:
        for part in _PART.finditer(text):
            number, command, back, down, letter = part.groups()
            if command == "A":
                self.row = max(0, self.row - int(number or 1))
            elif command == "K":
                line = self.lines[self.row]
                self.lines[self.row] = "" if number == "2" else line[: self.column]
            elif command in ("m", "h", "l"):  # colour; visibility of the cursor
                pass
            elif command:
                raise ValueError(f"the screen does not know {part.group()!r}")
            elif back:
                self.column = 0
            elif down:
                self._down()
            else:
                if self.column == self.columns:
                    self._down()
                    self.column = 0
                line = self.lines[self.row].ljust(self.column)
                self.lines[self.row] = line[: self.column] + letter + line[self.column + 1 :]
                self.column += 1

    def _down(self) -> None:
        self.row += 1
        if self.row == len(self.lines):
            self.lines.append("")


@contextmanager
def on_terminal(
    words: Sequence[str], rows: int = 24, columns: int = 80, **variables: str
) -> Iterator[tuple[subprocess.Popen[bytes], Iterator[str]]]:
    """Run a program on a terminal, and yield its output as it arrives."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    inherited = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR")}
    environment = inherited | {"TERM": "xterm-256color"} | variables

    def written() -> Iterator[str]:
        rest = b""
        while True:
            try:
                rest += os.read(ours, 65536)
            except OSError:  # Linux: the other side is closed
                return
            text = rest.decode(errors="ignore")
            if text.encode() == rest:  # no character is split
                rest = b""
                yield text

    with Program(words, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        try:
            yield process, written()
        finally:
            process.kill()
    os.close(ours)
