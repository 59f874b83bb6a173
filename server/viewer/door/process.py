"""How a run is seen: the page of `run --view`, a process of its own, and the commands that show what is published."""

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
"""Time that the page has to say its address; by itself it takes a second, several on a busy machine."""
END_S: Final = 10.0
"""Time that the page has to end; by itself it takes a tenth of a second."""
RESTARTS: Final = 3
"""How often a page that has died is started again in a run."""
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ASKED: Final = (0, *(128 + number for number in _SIGNALS), *(-number for number in _SIGNALS))
"""Exit codes of a page that somebody has ended, be it before it listens to signals."""


def shown_by(endpoint: str) -> str:
    """The command that shows what is published on an endpoint, as a shell would find this program."""
    return f"{program()} monitor" + ("" if endpoint == DEFAULT_ENDPOINT else f" --endpoint {shlex.quote(endpoint)}")


def program() -> str:
    """This program, as a shell would find it."""
    called = Path(sys.argv[0])
    return str(called) if called.name == "softfinger" and shutil.which("softfinger") is None else "softfinger"


def check_viewer() -> None:
    """Raise ConfigError where a page cannot be shown."""
    if find_spec("viser") is None:
        raise ConfigError("--view: the page needs viser: pip install 'softfinger[viewer]'")


class Shown:
    """`softfinger view` of a daemon, a process of its own: nothing that goes wrong there stops the servo.

    Says where the page is, and waits for that; ConfigError where the daemon takes no commands (None). `loudness` is the
    option for what it logs. A page that says no address within START_S is ended. One that dies is started again at the
    same address, RESTARTS times, so that a browser that shows it goes on; `tell` is called with what has happened.
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
        """It ends with its standard input, so with this process; that begins with the token, of which none sees."""
        command = [sys.executable, "-m", "softfinger.server.cli", *self._words, *self._loudness, "--print-address"]
        words = [*command, "--until-eof", *more]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert process.stdin is not None
        with suppress(BrokenPipeError):
            process.stdin.write(f"{token}\n")
            process.stdin.flush()
        return process

    def _said(self) -> str:
        """The address that it says; empty where it ends before that, or has to be ended, since it says nothing."""
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
        """Restart a page that has died, or report once that it has ended."""
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
        """Not by whoever looks after the servo, for the page takes a second."""
        address = self._said()
        if address and address != self._address:  # another program has taken its port meanwhile
            self._address = address
            log.info("the page is %s now", address)

    def close(self) -> None:
        """End it; by force where it does not."""
        self._process.terminate()
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
