"""Page process of `run --view`, and the commands that show a daemon's telemetry."""

from __future__ import annotations

import logging
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from softfinger.config.errors import ConfigError
from softfinger.server.viewer.roles import Role
from softfinger.server.wire.client import DEFAULT_ENDPOINT

log: Final = logging.getLogger(__name__)

START_S: Final = 60.0
"""Time limit for the page to print its address; it takes one second, or several on a busy machine."""
END_S: Final = 10.0
"""Time limit for the page to exit; it takes a tenth of a second."""
RESTARTS: Final = 3
"""Maximum restarts of a crashed page per run."""
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ASKED: Final = (0, *(128 + number for number in _SIGNALS), *(-number for number in _SIGNALS))
"""Exit codes of a page stopped on request, also before it installs its signal handlers."""


def shown_by(endpoint: str) -> str:
    """Return the shell command that shows the telemetry of an endpoint."""
    return f"{program()} monitor" + ("" if endpoint == DEFAULT_ENDPOINT else f" --endpoint {shlex.quote(endpoint)}")


def program() -> str:
    """Return the shell command of this program."""
    called = Path(sys.argv[0])
    return str(called) if called.name == "softfinger" and shutil.which("softfinger") is None else "softfinger"


def check_viewer() -> None:
    """Raise ConfigError if viser is not installed."""
    if find_spec("viser") is None:
        raise ConfigError("--view: the page needs viser: pip install 'softfinger[viewer]'")


class Shown:
    """Page process (`softfinger view`) of a daemon; its failures never stop the servo.

    Waits for the address of the page and logs it. A page that prints no address within START_S is killed. A page that
    crashes is restarted at the same address, at most RESTARTS times, so that an open browser can continue.

    Parameters
    ----------
    telemetry, commands
        Endpoints of the daemon.
    loudness
        Options for the log level of the page.
    tell
        Called with a sentence when the page has crashed or restarted.
    role
        Role of the user.

    Raises
    ------
    ConfigError
        If `commands` is None.
    """

    def __init__(
        self,
        telemetry: str,
        commands: str | None,
        loudness: list[str],
        tell: Callable[[str], None],
        role: Role = Role.OPERATOR,
    ) -> None:
        if commands is None:
            raise ConfigError("--view: the page asks by commands what is rendered: leave --commands off out")
        self._words = ["view", "--endpoint", telemetry, "--commands", commands]
        self._words += [] if role == Role.OPERATOR else ["--role", role.value]
        self._loudness, self._tell, self._restarts = loudness, tell, 0
        self._over = self._waits = False
        """`_over`: no restart follows. `_waits`: a restart failed, and was reported."""
        self._process = self._started("")
        try:
            self._address = self._said()
            if self._address:
                log.info("the page is %s; to stop it: Ctrl-C", self._address)
            else:
                self._process.wait()
                self.look()
        except BaseException:
            self.close()
            raise

    def _started(self, token: str, *more: str) -> subprocess.Popen[str]:
        """Start the page, which exits when its standard input is closed, and so with this process.

        The token is written to standard input, because other users can read arguments.
        """
        command = [sys.executable, "-m", "softfinger.server.cli", *self._words, *self._loudness, "--print-address"]
        words = [*command, "--until-eof", *more]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert process.stdin is not None
        with suppress(BrokenPipeError):
            process.stdin.write(f"{token}\n")
            process.stdin.flush()
        return process

    def _said(self) -> str:
        """Return the printed address; empty if the page exits without one or is killed after START_S."""
        process = self._process
        assert process.stdout is not None
        ender = threading.Timer(START_S, process.kill)
        ender.daemon = True
        ender.start()
        try:
            with process.stdout as said:
                return said.readline().strip()
        finally:
            ender.cancel()

    def look(self) -> None:
        """Restart a crashed page, or report its exit once."""
        if self._over or (code := self._process.poll()) is None:
            return
        said = f"the page has ended, with exit code {code}; the servo goes on"
        self._over = not self._address or code in ASKED or self._restarts >= RESTARTS
        if self._over:
            said += f"; to see it again: {program()} {shlex.join(self._words)}"
        elif self._restart():
            said += f"; it is started again, {self._restarts} of {RESTARTS} times, at the same address"
        else:
            return
        log.warning("%s", said)
        if code not in ASKED:
            self._tell(said)

    def _restart(self) -> bool:
        """Restart the page at its port, with its token, without opening a browser.

        Returns False if the system has no file descriptor, process or memory left; the next `look` tries again.
        """
        where = urlsplit(self._address)
        try:
            self._process = self._started(where.path.strip("/"), "--port", str(where.port), "--no-open")
        except OSError as error:
            if not self._waits:
                self._waits = True
                said = f"the page cannot be started: {error}; it is tried again as long as the run goes on"
                log.error("%s", said)
                self._tell(said)
            return False
        self._waits = False
        self._restarts += 1
        threading.Thread(target=self._listen_again, name="page", daemon=True).start()
        return True

    def _listen_again(self) -> None:
        """Read the address in a separate thread: it takes a second, and the caller supervises the servo."""
        address = self._said()
        if address and address != self._address:  # its port was taken by another program
            self._address = address
            log.info("the page is %s now", address)

    def close(self) -> None:
        """Stop the page, by SIGKILL if it does not exit within END_S."""
        self._process.terminate()
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
