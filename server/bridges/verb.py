"""`softfinger bridge`: show a running daemon or a recording in Foxglove or Rerun."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final

from softfinger.config.errors import ConfigError
from softfinger.config.schema import Scene
from softfinger.server import keys, signals
from softfinger.server.bridges import foxglove, rerun
from softfinger.server.gateway.addresses import find_addresses
from softfinger.server.recording import live
from softfinger.server.recording.writer import Topics, parse_scene

log: Final = logging.getLogger(__name__)


def run(args: argparse.Namespace) -> int:
    if args.viewer == "foxglove":
        if args.recording or args.save or args.connect:
            raise ConfigError("Foxglove opens a recording (.mcap) itself; --save and --connect are for Rerun")
        server = foxglove.Server(args.port)
        try:
            log.info("in Foxglove open the connection %s, or %s", server.url, server.app)
            return follow(args, lambda fingers, scene: Topics(server, fingers, scene))
        finally:
            server.close()
    stream = rerun.stream(args.save and Path(args.save), args.connect)
    try:
        if args.recording:
            log.info("%d ticks shown", rerun.show_recording(args.recording, stream))
            return 0
        return follow(args, lambda fingers, scene: rerun.RerunSink(stream, fingers, scene))
    finally:
        stream.flush()


def follow(args: argparse.Namespace, show: Callable[[list[str], Scene | None], live.TickReceiver]) -> int:
    """Forward the data of the daemon to a viewer until the daemon ends, times out, or a limit or signal stops it."""
    stop: list[bool] = []
    lock = keys.read_keys(args)
    addresses = find_addresses(args.endpoint, lock, args.commands)
    job = live.RecordingJob(addresses, lock, args.duration, args.timeout, lambda: bool(stop))
    with signals.stop_on_signal(lambda: stop.append(True)), live.subscribe_all(job) as wire:
        first_samples, fingers, about = live.receive_first(wire, job)
        batcher = live.TickBatcher(show(fingers, parse_scene(about)), fingers)
        end_reason = live.record_until_end(wire, job, first_samples, batcher)
    log.info("ticks %d to %d, %d lost; %s", batcher.first, batcher.last, batcher.lost, end_reason)
    return signals.stop_exit_code()
