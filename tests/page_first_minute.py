"""Time from a clone to the first touch on the page, by mouse, with `make run ARGS=--view`.

    python tests/page_first_minute.py CLONE           # clone that is set up and compiled
    python tests/page_first_minute.py CLONE --cold    # fresh clone, with empty caches and home

A headless browser waits for the page, opens it, and moves the fingertip like a mouse would: with shift down onto the
plane, then with ctrl along it. The touch is detected in the telemetry. Seconds count from the command and include the
set-up if there is one. Requires the environment of the tests and `make browser`.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from helpers.browser import Screen, browser, eventually, shown, why_none

from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.wire.client import Sample, subscribe
from softfinger.tools import measure

END_S: Final = 30.0
FELT_N: Final = 0.1
DOWN: Final = (0.0, 30.0)
ALONG: Final = (40.0, 0.0)
"""Ways of the mouse, pixels: a press of some 1 N, and a roll of half a radian."""


class Program:
    """`make run ARGS=--view` in a clone: its output and the times of the lines."""

    def __init__(self, clone: Path, environment: dict[str, str]) -> None:
        self.begun = time.monotonic()
        self._said: list[str] = []
        self._process = subprocess.Popen(
            ["make", "run", "ARGS=--view"],
            cwd=clone, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            start_new_session=True,
        )  # fmt: skip
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            print(f"{self.since():7.1f}  {line.rstrip()}", file=sys.stderr)
            self._said.append(line)

    def since(self) -> float:
        """Seconds since the command."""
        return time.monotonic() - self.begun

    def says(self, pattern: str) -> str:
        """Wait for a pattern in the output; return the match, or None if the program ends."""
        while (found := re.search(pattern, "".join(self._said))) is None:
            if self._process.poll() is not None:
                sys.exit("the program ended before it served a page")
            time.sleep(0.01)
        return found[1]

    def end(self) -> None:
        """As Ctrl-C does."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGINT)
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)


class Felt:
    """Telemetry: the latest tick, and the times of the first force and of the first rolling, s."""

    def __init__(self, endpoint: str, program: Program) -> None:
        self.newest: Sample | None = None
        self.force = self.rolled = 0.0
        self._endpoint, self._program = endpoint, program
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with subscribe(self._endpoint) as samples:
            for sample in samples:
                if not self.force and sample.contact.mode and sample.force[2] > FELT_N:
                    self.force = self._program.since()
                if not self.rolled and sample.contact.mode and abs(sample.contact.rolled) > 0.0:
                    self.rolled = self._program.since()
                self.newest = sample

    def ball(self, screen: Screen) -> tuple[float, float]:
        """Where the fingertip is on the screen, pixels."""
        assert self.newest is not None
        x, y, z = self.newest["proxy.position"]
        return screen.at((CM * x, CM * y, CM * z))


@contextmanager
def surroundings(clone: Path, cold: bool) -> Iterator[dict[str, str]]:
    """Return the environment of the program: the present one, or one with an empty home and empty caches."""
    kept = {key: value for key, value in os.environ.items() if key not in ("SOFTFINGER_CACHE_DIR", "VIRTUAL_ENV")}
    if not cold:
        yield kept
        return
    if (clone / ".venv").exists():
        sys.exit(f"{clone}: has been set up: --cold takes a new clone")
    with tempfile.TemporaryDirectory() as home:
        yield kept | {"HOME": home, "XDG_CACHE_HOME": f"{home}/.cache"}


def first_minute(program: Program) -> dict[str, float]:
    """Seconds from the command to each step."""
    with browser() as page:
        endpoint, address = program.says(r"telemetry on (\S+)"), program.says(r"(?m)^(http\S+)$")
        found = {"page served": program.since()}
        felt = Felt(endpoint, program)
        screen = shown(page, address)
        eventually(lambda: (screen.picture().std(axis=(0, 1)) > 5.0).all(), every_s=0.0)
        found["first picture"] = program.since()
        eventually(lambda: felt.newest is not None and screen.shows("free"), every_s=0.01)
        found["first tick on the page"] = program.since()

        def pressed() -> bool:
            screen.drag(felt.ball(screen), DOWN, "Shift")
            return felt.force > 0.0

        def rolled() -> bool:
            screen.drag(felt.ball(screen), ALONG, "Control")
            return felt.rolled > 0.0

        if not eventually(pressed) or not eventually(rolled):
            sys.exit("the finger did not follow the mouse")
        return found | {"first force": felt.force, "rolling": felt.rolled}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clone", type=Path, help="folder of a clone")
    parser.add_argument("--cold", action="store_true", help="with a home and caches that are empty; of a new clone")
    parser.add_argument("--json", action="store_true", help="as JSON")
    args = parser.parse_args()
    if why_none():
        parser.error(why_none())
    with surroundings(args.clone, args.cold) as environment:
        program = Program(args.clone, environment)
        try:
            found = first_minute(program)
        finally:
            program.end()
    measure.show({"seconds": found}, args.json, [f"{name:24}{value:8.1f} s" for name, value in found.items()])


if __name__ == "__main__":
    main()
