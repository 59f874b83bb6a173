"""Telemetry of a gateway that also forwards commands, in a second process: its subscribers cannot delay commands."""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
import time
from typing import Any, Final

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.server.gateway.addresses import Addresses

log: Final = logging.getLogger(__name__)

RESTART_S: Final = 1.0
"""Shortest time from one start of the process to the next."""
EXIT_TIMEOUT_S: Final = 5.0
"""Time for the process to end by itself; libzmq may block it for longer."""


class TelemetryProcess:
    """`softfinger forward` without the options of commands; started again if it ends.

    After a flood of topics, libzmq blocks the thread of the socket for 20 to 50 s (docs/decisions/0006).
    """

    def __init__(self, args: argparse.Namespace, origin: Addresses) -> None:
        values = {
            "--from": origin.telemetry, "--commands-from": origin.commands, "--to": args.to, "--keys": args.keys,
            "--readers": args.readers, "--server-key": args.server_key,
        }  # fmt: skip
        flags = {"--until-eof": True, "--json": True, "--lsl": args.lsl, "--quiet": args.quiet}
        words = [flag for flag, is_set in flags.items() if is_set]
        words += [word for option, value in values.items() if value is not None for word in (option, value)]
        self._command: Final = [sys.executable, "-m", "softfinger.server.cli", "forward", *words]
        self._process = self._start()
        self.exit_code = 0
        """Exit code after such an error, which the process has printed: wrong options, or an endpoint in use."""

    def _start(self) -> subprocess.Popen[bytes]:
        self._started_s = time.monotonic()
        # In a separate session: Ctrl-C reaches the gateway, which then closes the standard input of this process.
        return subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)

    def keep_running(self) -> bool:
        """Start the process again if it has ended. Return False after an error that a new start would repeat."""
        code = self._process.poll()
        if code in (ConfigError.exit_code, AddressInUse.exit_code):
            self.exit_code = code
        elif code is not None and time.monotonic() - self._started_s > RESTART_S:
            log.warning("the process that forwards telemetry ended with code %d and was restarted", code)
            self._process.communicate()
            self._process = self._start()
        return self.exit_code == 0

    def end(self) -> dict[str, Any]:
        """End the process, and return its statistics, if it has printed any; may be called repeatedly."""
        try:
            printed, _ = self._process.communicate(timeout=EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            printed, _ = self._process.communicate()
        statistics: dict[str, Any] = json.loads(printed or "{}")
        return statistics
