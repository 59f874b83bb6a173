"""The gateway as a service: a process beside the daemon, for endpoints that other machines reach.

The daemon itself then publishes and answers in a folder of its own user, and `softfinger forward`, started here, hands
on from there to whoever has a key.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Final

from softfinger.config import schema
from softfinger.config.schema import is_public
from softfinger.server.services.base import JOIN_S, Worker
from softfinger.server.wire.endpoint import Bound, listen

log: Final = logging.getLogger(__name__)


class Gateway(Worker):
    """Binds those endpoints of a rig that are open to the network; started, a process serves them.

    telemetry, commands  the endpoints that are left to the daemon itself; None: no commands
    public               those that are open to the network, by the name of their table; empty: nothing is to be started

    The end of the process is an event, and the run goes on; it is not started again. Raises ConfigError for keys that
    cannot be used, AddressInUse and ConfigError as `listen`; nothing stays open then.
    """

    def __init__(self, rig: schema.Rig, event: Callable[..., Any]) -> None:
        super().__init__("gateway")
        self._event, self._files = event, ExitStack()
        self._process: subprocess.Popen[bytes] | None = None
        self._words: list[str] = []
        self._bound: list[Bound] = []
        self.public: Final[dict[str, str]] = {}
        self.telemetry, self.commands = rig.telemetry.endpoint, rig.commands_endpoint
        with ExitStack() as files:
            folder = ""
            if is_public(self.telemetry) or is_public(self.commands or ""):
                folder = files.enter_context(_private_folder())
            if is_public(self.telemetry):
                bound = self._open("telemetry", self.telemetry, files)
                self.telemetry = f"ipc://{folder}/telemetry"
                self._words += ["--from", self.telemetry, "--to", bound.endpoint]
                self._words += ["--to-fd", str(bound.listener.fileno())]
            if self.commands is not None and is_public(self.commands):
                bound = self._open("commands", self.commands, files)
                self.commands = f"ipc://{folder}/commands"
                self._words += ["--commands-from", self.commands, "--commands-to", bound.endpoint]
                self._words += ["--commands-to-fd", str(bound.listener.fileno())]
            if self.public:
                from softfinger.server.gateway.allowed import key_options  # and with it libzmq, which takes time

                assert rig.security is not None  # else these endpoints are faults of the rig
                self._words += key_options(rig.security)
            self._files = files.pop_all()

    def _open(self, name: str, endpoint: str, files: ExitStack) -> Bound:
        bound = listen(endpoint, f"[{name}] endpoint", public=True)
        files.enter_context(bound.files)
        self._bound.append(bound)
        self.public[name] = bound.endpoint
        return bound

    def start(self) -> None:
        # A session of its own: Ctrl-C and the end of a terminal are for the daemon, and this ends with its pipe.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "softfinger.server.cli", "forward", "--until-eof", *self._words],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
            pass_fds=[bound.listener.fileno() for bound in self._bound],
        )
        for bound in self._bound:  # the process has them now, and with its end nobody is to wait there
            bound.files.close()
        super().start()

    def work(self) -> None:
        assert self._process is not None
        code = self._process.wait()
        if not self.closing.is_set():
            said = f"the gateway has ended with code {code}: nobody on another machine hears or commands any more"
            log.error("%s", said)
            self._event("fault", "gateway", message=said)

    def failed(self, error: Exception) -> None:
        """The process serves whether or not this one waits for its end."""
        self._event("fault", "gateway", message=str(error))

    def stop(self) -> None:
        self.closing.set()
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            try:
                self._process.wait(JOIN_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        super().stop()
        self._files.close()


def _private_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder that only this user may enter."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    return tempfile.TemporaryDirectory(prefix="softfinger-", dir=runtime if os.path.isdir(runtime) else None)
