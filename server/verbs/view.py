"""`softfinger view`: show a running daemon or a recording on a page in the browser."""

from __future__ import annotations

import argparse
import logging
import os
import socket
import sys
from contextlib import nullcontext
from typing import Final

from softfinger.config.errors import ConfigError
from softfinger.server import keys, signals
from softfinger.server.gateway.addresses import find_addresses
from softfinger.server.verbs.options import PAGE_HOST
from softfinger.server.viewer.roles import Role

log: Final = logging.getLogger(__name__)

NICE: Final = 5


def run(args: argparse.Namespace) -> int:
    """Serve the page until a signal, or for a duration. Raises ConfigError if viser is not installed."""
    try:
        from softfinger.server.viewer.page import Page, run_frames
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "viser":
            raise
        raise ConfigError("the page needs viser: pip install 'softfinger[viewer]'") from None
    if not 0 <= args.port < 65536:
        raise ConfigError(f"--port {args.port} is not a port: must be 0 to 65535")
    _check_host(args.host)
    from softfinger.server.viewer.door.process import log_address, open_browser
    from softfinger.server.viewer.live import LivePage
    from softfinger.server.viewer.playback import RecordedPage, load
    from softfinger.server.viewer.prompt import ParticipantPage

    recording = None if args.recording is None else load(args.recording, args.scene)
    if args.host == PAGE_HOST:  # probably on the machine of a servo, which may run without real-time priority
        os.nice(NICE)
    lock = keys.read_keys(args)
    stop_requests = list[bool]()
    token = sys.stdin.readline().strip() or None if args.until_eof else None
    if args.until_eof:
        signals.call_at_end_of_input(lambda: stop_requests.append(True))
    page = Page(args.host, args.port, tuple(args.allow_host), token)
    try:
        if recording is None:
            daemon = find_addresses(args.endpoint, lock, args.commands)
            source: LivePage | ParticipantPage | RecordedPage = (
                ParticipantPage(page, daemon, lock)
                if args.role == Role.PARTICIPANT
                else LivePage(page, daemon, lock, Role(args.role))
            )
        else:
            source = RecordedPage(page, recording, args.tick)
        try:
            if args.print_address:
                print(page.address, flush=True)
                os.dup2(2, 1)  # the reader expects one line; a browser may write to standard output
            else:
                log_address(page.address)
            if args.host != PAGE_HOST:
                log.warning(
                    "anyone with this address can command the daemon, and it is sent unencrypted over the network"
                )
            opening = nullcontext() if args.no_open or not _can_open() else open_browser(page.address)
            with signals.stop_on_signal(lambda: stop_requests.append(True)), opening:
                run_frames(source.step, stop_requests, args.duration)
        finally:
            source.close()
    finally:
        page.close()
    return signals.stop_exit_code()


def _check_host(host: str) -> None:
    """Raise ConfigError if nothing can listen on a host; viser would wait forever."""
    try:
        found = socket.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        socket.create_server(found[0][4][:2], family=found[0][0]).close()
    except (OSError, UnicodeError) as error:
        reason = (error.strerror if isinstance(error, OSError) else "") or error
        raise ConfigError(f"--host {host}: {reason}: must be an address or a name of this machine") from None


def _can_open() -> bool:
    """Return True if a screen is available; without one, some browsers would start in the terminal."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
