"""`forward`: telemetry to more subscribers, to other machines by key, or to Lab Streaming Layer; and commands back.

Telemetry of a gateway that also forwards commands is in a second process: its subscribers cannot delay commands.
`keys` creates CURVE key pairs, with which a daemon and its clients on other machines authenticate each other.
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from typing import Any, Final

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.config.schema import is_public
from softfinger.server import keys, signals
from softfinger.server.gateway.addresses import Addresses, find_addresses
from softfinger.server.gateway.forward import CommandPath, ForwardedServer, Forwarder, describe
from softfinger.server.gateway.lsl import Outlets
from softfinger.server.keys import ClientKeys, make_pair
from softfinger.server.progress import show_counter
from softfinger.server.socket_process.allowed import AllowedKeys
from softfinger.server.socket_process.peer_socket import KeyLock
from softfinger.server.wire.endpoint import BoundSocket, listen
from softfinger.server.wire.process_link import block_stop_signals

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
        self._restart_failed = False
        """A restart failed, and was reported."""
        self.exit_code = 0
        """Exit code after such an error, which the process has printed: wrong options, or an endpoint in use."""

    def _start(self) -> subprocess.Popen[bytes]:
        self._started_s = time.monotonic()
        # Signals are for the gateway, which then closes the standard input of this process.
        with block_stop_signals():
            return subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )

    def keep_running(self) -> bool:
        """Restart the process if it has ended. Return False if a restart would fail with the same error."""
        code = self._process.poll()
        if code in (ConfigError.exit_code, AddressInUse.exit_code):
            self.exit_code = code
        elif code is not None and time.monotonic() - self._started_s > RESTART_S:
            self._process.communicate()
            try:
                self._process = self._start()
            except OSError as error:  # no file descriptor, process or memory is left
                if not self._restart_failed:
                    self._restart_failed = True
                    log.error("the process that forwards telemetry cannot be started: %s; retrying", error)
            else:
                self._restart_failed = False
                log.warning("the process that forwards telemetry ended with code %d and was restarted", code)
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


log: Final = logging.getLogger(__name__)


def run_forward(args: argparse.Namespace) -> int:
    """Forward until a signal; returns 0, or the exit code of the signal."""
    if not (args.to or args.commands_to or args.lsl):
        raise ConfigError("nothing to do: add --to, --commands-to or --lsl")
    upstream = None if args.server_key is None else keys.read_keys(args)
    origin = find_addresses(args.source, upstream, args.commands_from)
    stop = threading.Event()
    with ExitStack() as stack:
        forward = (_open_commands if args.commands_to else _open_telemetry)(args, origin, upstream, stack)
        stack.callback(forward.close)
        for name, part in (("telemetry", forward.readers), ("commands", forward.commanders)):
            if part is not None:
                audience = "clients with a key" if part.peers.lock else "every client that can reach it"
                log.info("%s forwarded on %s, to %s", name, part.peers.endpoint, audience)
        if not args.commands_to:
            log.info(
                "telemetry is received from %s, also if the daemon starts later; to stop it: Ctrl-C", origin.telemetry
            )
        telemetry = TelemetryProcess(args, origin) if args.commands_to and (args.to or args.lsl) else None
        if telemetry is not None:
            stack.callback(telemetry.end)
        if args.until_eof:
            signals.call_at_end_of_input(stop.set)
        with signals.stop_on_signal(stop.set), show_counter() as show:
            if telemetry is None:
                forward.run(stop.is_set, show)
            else:  # the other process shows counts
                forward.run(lambda: stop.is_set() or not telemetry.keep_running())
        counts = (telemetry.end() if telemetry is not None else {}) | forward.statistics()
    if telemetry is not None and telemetry.exit_code:
        return telemetry.exit_code
    print(json.dumps(counts) if args.json else f"{describe(counts)}; {counts['seconds']:.1f} s", flush=True)
    return signals.stop_exit_code()


def _open_commands(
    args: argparse.Namespace, origin: Addresses, upstream: ClientKeys | None, stack: ExitStack
) -> Forwarder:
    lock = make_lock(args.commands_to, "--commands-to", args.keys, args.commanders)
    bound = bind(args.commands_to, "--commands-to", stack)
    return Forwarder(None, commands=CommandPath(ForwardedServer(origin.command_endpoint(), upstream), bound, lock))


def _open_telemetry(
    args: argparse.Namespace, origin: Addresses, upstream: ClientKeys | None, stack: ExitStack
) -> Forwarder:
    readers = None
    if args.to:
        lock = make_lock(args.to, "--to", args.keys, args.readers)
        readers = (bind(args.to, "--to", stack), lock)
    outlets = Outlets(origin.telemetry) if args.lsl else None
    return Forwarder(ForwardedServer(origin.telemetry, upstream), readers, outlets=outlets)


def make_lock(endpoint: str, flag: str, key_file: str | None, folder: str | None) -> KeyLock | None:
    """Return the lock of an endpoint; None if all peers that reach it may connect, which excludes other machines."""
    folder_flag = "--readers" if flag == "--to" else "--commanders"
    if folder is not None:
        if key_file is None:
            raise ConfigError(
                f"{folder_flag} {folder}: a connection with keys also needs a key on this side: add --keys FILE"
            )
        return KeyLock(keys.read_pair(key_file), AllowedKeys(folder))
    if is_public(endpoint):
        raise ConfigError(
            f"{flag} {endpoint} is open to the network: set the allowed clients with --keys FILE and {folder_flag} DIR "
            "(`softfinger keys` creates them), or use tcp://127.0.0.1:PORT"
        )
    return None


def bind(endpoint: str, flag: str, stack: ExitStack) -> BoundSocket:
    bound = listen(endpoint, flag, public=True)
    stack.enter_context(bound.files)
    return bound


def run_keys(args: argparse.Namespace) -> int:
    """Create CURVE key pairs, with which a daemon and its clients on other machines authenticate each other."""
    pairs = {name: make_pair(args.folder, name) for name in args.names}
    if args.json:
        print(json.dumps({name: {"public": str(p), "secret": str(s)} for name, (p, s) in pairs.items()}))
    else:
        for public, secret in pairs.values():
            print(f"{public}: public key: copy it to the other side\n{secret}: secret key: do not share it")
    return 0
