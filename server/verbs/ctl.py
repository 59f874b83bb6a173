"""`softfinger ctl`: send one command to a running daemon and print the result."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.schema import make_commands_address
from softfinger.config.sources import read_toml
from softfinger.config.words import format_value, suggest
from softfinger.server import keys
from softfinger.server.arguments import parse_parameter
from softfinger.server.gateway.addresses import SEARCH_TIMEOUT_S, find_addresses
from softfinger.server.progress import show_progress
from softfinger.server.wire import DEFAULT_ENDPOINT
from softfinger.server.wire.client import Subscription, subscribe
from softfinger.server.wire.commands import METHODS
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import HEALTH, ProtocolError


def run(args: argparse.Namespace) -> int:
    if args.method not in METHODS:
        hint = suggest(args.method, METHODS)
        raise ConfigError(f"unknown method {format_value(args.method)}{hint}; methods are {', '.join(METHODS)}")
    params = dict(map(parse_parameter, args.params))
    scene = params.get("scene")
    if args.method == "set_scene" and isinstance(scene, str) and scene.endswith(".toml"):
        # Read here with the rights of this user: the daemon opens no file that a client names.
        params = {"name": Path(scene).stem[:64]} | params | {"scene": read_toml(scene)}
    lock = keys.read_keys(args)
    within_s = SEARCH_TIMEOUT_S if args.timeout is None else args.timeout
    with ExitStack() as early:
        if args.method == "disarm":  # the search waits for a daemon that is slow to describe itself
            for address in {args.endpoint, make_commands_address(args.endpoint)}:
                early.enter_context(Control(address, args.timeout, lock)).post(args.method)
        addresses = find_addresses(args.endpoint, lock, to_command=args.endpoint != DEFAULT_ENDPOINT, within_s=within_s)
        with (
            Control(addresses.command_endpoint(), args.timeout, lock) as daemon,
            show_progress(args.method, detail=_make_progress_reader(addresses.telemetry, lock)),
        ):
            result = msgspec.to_builtins(daemon.ask(args.method, params))
    if args.json:
        print(json.dumps(result))
    else:
        for key, value in result.items():
            print(f"{key}: {json.dumps(value)}")
    return 0


def _make_progress_reader(endpoint: str, lock: keys.ClientKeys | None) -> Callable[[], str]:
    """Return a function that returns the progress of the scene that the daemon prepares.

    It subscribes when it is first called: the display of a short command never calls it.
    """
    samples: Subscription | None = None
    text = waiting = "waiting for the daemon"

    def latest() -> str:
        nonlocal samples, text
        samples = samples or subscribe(endpoint, (HEALTH,), keys=lock)
        with suppress(ProtocolError):  # a daemon of an earlier version does not send its progress
            while (sample := samples.receive(0.0)) is not None:
                text = sample.data.preparing or waiting
        return text

    return latest
