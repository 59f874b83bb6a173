"""Page process of `run --view`, commands that show a daemon's telemetry, and opening of a browser.

The secret address is passed to the browser in a file, because all users of a machine can read the arguments of a
program.
"""

from __future__ import annotations

import html
import logging
import os
import secrets
import select
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from softfinger.config.errors import ConfigError
from softfinger.config.schema import find_runtime_folder
from softfinger.server.viewer.roles import Role
from softfinger.server.wire import DEFAULT_ENDPOINT
from softfinger.server.wire.endpoint import make_runtime_folder

log: Final = logging.getLogger(__name__)

START_TIMEOUT_S: Final = 60.0
"""Time limit for the page to print its address; it takes one second, or several on a busy machine."""
EXIT_TIMEOUT_S: Final = 2.0
"""Time limit for the page to exit; it takes a tenth of a second, or half a second if a browser does not read."""
RESTARTS: Final = 3
"""Maximum restarts of a crashed page per run."""
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
REQUESTED_EXIT_CODES: Final = (0, *(128 + number for number in _SIGNALS), *(-number for number in _SIGNALS))
"""Exit codes of a page stopped on request, also before it installs its signal handlers."""


def monitor_command(endpoint: str) -> str:
    """Return the shell command that shows the telemetry of an endpoint."""
    return f"{find_program_name()} monitor" + (
        "" if endpoint == DEFAULT_ENDPOINT else f" --endpoint {shlex.quote(endpoint)}"
    )


def find_program_name() -> str:
    """Return the shell command of this program."""
    argv0 = Path(sys.argv[0])
    return str(argv0) if argv0.name == "softfinger" and shutil.which("softfinger") is None else "softfinger"


def check_viewer() -> None:
    """Raise ConfigError if viser is not installed."""
    if find_spec("viser") is None:
        raise ConfigError("--view: the page needs viser: pip install 'softfinger[viewer]'")


def log_address(address: str) -> None:
    """Log the address of a page, alone on its line, for terminals and programs that look for addresses."""
    log.info("the page; to stop it: Ctrl-C\n%s", address)


class PageProcess:
    """Page process (`softfinger view`) of a daemon; its failures never stop the servo.

    Waits for the address of the page and logs it. A page that prints no address within START_TIMEOUT_S is killed. A
    page that crashes is restarted at the same address, at most RESTARTS times, so that an open browser can continue.

    Parameters
    ----------
    telemetry, commands
        Endpoints of the daemon.
    log_options
        Options for the log level of the page.
    on_event
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
        log_options: list[str],
        on_event: Callable[[str], None],
        role: Role = Role.OPERATOR,
    ) -> None:
        if commands is None:
            raise ConfigError("--view: the page needs commands: remove --commands off")
        self._arguments = ["view", "--endpoint", telemetry, "--commands", commands]
        self._arguments += [] if role == Role.OPERATOR else ["--role", role.value]
        self._log_options, self._on_event, self._restarts = log_options, on_event, 0
        self._is_final = self._restart_failed = False
        """`_is_final`: no restart follows. `_restart_failed`: a restart failed, and was reported."""
        self._process = self._spawn("")
        try:
            self._address = self._read_address()
            if self._address:
                log_address(self._address)
            else:
                self._process.wait()
                self.supervise()
        except BaseException:
            self.close()
            raise

    def _spawn(self, token: str, *options: str) -> subprocess.Popen[str]:
        """Start the page, which exits when its standard input is closed, and so with this process.

        The token is written to standard input, because other users can read arguments.
        """
        words = [*self._arguments, *self._log_options, "--print-address", "--until-eof", *options]
        command = [sys.executable, "-m", "softfinger.server.cli", *words]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert process.stdin is not None
        with suppress(BrokenPipeError):
            process.stdin.write(f"{token}\n")
            process.stdin.flush()
        return process

    def _read_address(self) -> str:
        """Return the printed address; empty if the page exits without one or is killed after START_TIMEOUT_S."""
        process = self._process
        assert process.stdout is not None
        with process.stdout as text:
            poller = select.poll()
            poller.register(text, select.POLLIN)
            if not poller.poll(START_TIMEOUT_S * 1000.0):
                process.kill()
            return text.readline().strip()

    def supervise(self) -> None:
        """Restart a crashed page, or report its exit once."""
        if self._is_final or (code := self._process.poll()) is None:
            return
        text = f"the page has ended, with exit code {code}; the servo continues"
        self._is_final = not self._address or code in REQUESTED_EXIT_CODES or self._restarts >= RESTARTS
        if self._is_final:
            text += f"; to see it again: {find_program_name()} {shlex.join(self._arguments)}"
        elif self._restart():
            text += f"; restart {self._restarts} of {RESTARTS}, at the same address"
        else:
            return
        log.warning("%s", text)
        if code not in REQUESTED_EXIT_CODES:
            self._on_event(text)

    def _restart(self) -> bool:
        """Restart the page at its port, with its token, without opening a browser.

        Returns False if the system has no file descriptor, process or memory left; the next `supervise` tries again.
        """
        url = urlsplit(self._address)
        try:
            self._process = self._spawn(url.path.strip("/"), "--port", str(url.port), "--no-open")
        except OSError as error:
            if not self._restart_failed:
                self._restart_failed = True
                text = f"the page cannot be started: {error}; retrying until the run ends"
                log.error("%s", text)
                self._on_event(text)
            return False
        self._restart_failed = False
        self._restarts += 1
        with suppress(RuntimeError):  # no thread is left: a new address, which is rare, is not logged
            threading.Thread(target=self._read_new_address, name="page", daemon=True).start()
        return True

    def _read_new_address(self) -> None:
        """Read the address in a separate thread: it takes a second, and the caller supervises the servo."""
        address = self._read_address()
        if address and address != self._address:  # its port was taken by another program
            self._address = address
            log_address(address)

    def close(self) -> None:
        """Stop the page, by SIGKILL if it does not exit within EXIT_TIMEOUT_S."""
        self._process.terminate()
        self._process.send_signal(signal.SIGCONT)  # a stopped page does not handle SIGTERM
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


REDIRECT_HTML: Final = """<!doctype html>
<meta charset="utf-8"><meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={address}">
<title>softfinger</title>
<a href="{address}">the page</a>
"""


@contextmanager
def open_browser(address: str) -> Iterator[None]:
    """Open a browser at a secret address by a file that exists during the block, so that the browser can reload it.

    The file is in this user's runtime folder, mode 600, and redirects to the address.
    """
    try:
        make_runtime_folder()
        path = find_runtime_folder() / f"page-{secrets.token_hex(8)}.html"
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except (ConfigError, OSError) as error:
        log.warning("no browser was opened: %s; open the address of the page", error)
        yield
        return
    try:
        with os.fdopen(file, "w") as out:
            out.write(REDIRECT_HTML.format(address=html.escape(address, quote=True)))
        webbrowser.open(path.as_uri())
        yield
    finally:
        path.unlink(missing_ok=True)
