"""`bench telemetry`: latency from the tick to the subscriber, end to end, over real sockets and processes.

One process runs the daemon, and each subscriber is a separate process. Further sources run in turn, so that
disturbances of the machine affect all of them. If there is a compiler, one is a sender in C over libzmq that does
nothing else. With `--forward`, the source is `softfinger forward`, by CURVE with `--keys`.
"""

from __future__ import annotations

import argparse
import os
import shlex
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import zmq

from softfinger.config.errors import ConfigError
from softfinger.proxy.record import AT, NAMED, PATCHES, RECORD_SIZE
from softfinger.server.keys import client_keys, make_pair
from softfinger.server.progress import show_progress
from softfinger.server.socket_process.channel_messages import StateInfo, TickParameters
from softfinger.server.socket_process.tick_messages import TickEncoder
from softfinger.server.wire.client import NoTelemetry
from softfinger.server.wire.protocol import CONTACT, SCHEMA, STATE, STATE_HZ
from softfinger.tools.measure import (
    Array,
    compile_c,
    compute_quantiles,
    draw_exceedance,
    format_microseconds,
    show_and_draw,
)

START_S: Final = 180.0
"""Longest time for a cold daemon to compile."""
START_POLL_MS: Final = 500

TURN_S: Final = 10.0
SOURCE: Final = Path(__file__).with_name("reference_sender.c")
_EIGHT_BYTES: Final = 2**50 + 1
"""A tick that is encoded in eight bytes, like those of the C sender; no `state` message is sent with it."""

FORWARD: Final = "forward"


class SourceResult(NamedTuple):
    """Data of the subscribers of a source: (n, 2) tick, latency s, of each; and the source's share of a processor."""

    arrivals: list[Array]
    load: float


class PublisherProcess(NamedTuple):
    """Publisher: its process, the endpoint, and the client's key files, empty if no key is needed."""

    process: subprocess.Popen[Any]
    endpoint: str
    keys: tuple[str, ...] = ()


def run(args: argparse.Namespace) -> int:
    turns = max(1, round(args.seconds / TURN_S))
    with tempfile.TemporaryDirectory() as folder:
        sources = list_commands(args, Path(folder))
        results: dict[str, list[SourceResult]] = {name: [] for name in sources}
        for _ in range(turns):
            for name, words in sources.items():
                results[name].append(measure(name, words, args, args.seconds / turns))
    result: dict[str, Any] = {"subscribers": args.subscribers, "rate_hz": args.rate, "seconds": args.seconds}
    latencies: dict[str, Array] = {}
    for name, parts in results.items():
        arrivals = [rows for part in parts for rows in part.arrivals]
        latencies[name] = np.concatenate([rows[:, 1] for rows in arrivals])
        result[name] = {
            "latency": compute_quantiles(latencies[name], round(args.rate)),
            "messages": sum(len(rows) for rows in arrivals),
            "lost": int(sum((np.diff(rows[:, 0]) - 1).sum() for rows in arrivals)),
            "load": float(np.mean([part.load for part in parts])),
        }
    lines = [f"tick to subscriber, {args.subscribers} subscribers at {args.rate:g} Hz, us"]
    own = result["daemon"]["latency"]["blocks"]
    for name in results:
        latency = result[name]["latency"]["blocks"]
        cells = "  ".join(f"{q} {format_microseconds(latency[q])} ({latency[q] / own[q]:4.2f})" for q in ("p50", "p99"))
        loss_text = f"lost {result[name]['lost']} of {result[name]['messages']}"
        lines.append(f"  {name:<10} {cells}   {loss_text}   processor {100.0 * result[name]['load']:4.1f} %")
    lines.append("  medians over blocks of a second; in brackets the ratio to the daemon")
    texts = ("tick to subscriber", "messages later than this", "")
    return show_and_draw(args, result, lines, lambda path: draw_exceedance(path, latencies, 1.0, *texts))


def list_commands(args: argparse.Namespace, folder: Path) -> dict[str, list[str]]:
    """Return the command line of each source; `ENDPOINT` is replaced by its endpoint."""
    daemon = ["run", "--endpoint", "ENDPOINT", "--commands", "off", "--rate", repr(args.rate)]
    lines = {}
    if (program := compile_reference(folder)) is not None:
        lines["c"] = [*program, "ENDPOINT", repr(args.rate), CONTACT, *write_message(folder)]
    lines["daemon"] = [sys.executable, "-m", "softfinger.server.cli", *daemon]
    if args.forward:
        lines[FORWARD] = lines["daemon"]
    return lines


def compile_reference(folder: Path) -> list[str] | None:
    """Compile the C sender; returns it with the library that it has to load, None if there is no C compiler."""
    program = compile_c(SOURCE, folder, "-ldl")
    if program is None:
        return None
    maps = os.fsdecode(Path("/proc/self/maps").read_bytes()).splitlines()
    libraries = {line.split(maxsplit=5)[5] for line in maps if "libzmq" in line}  # pyzmq has loaded one
    if not libraries:
        raise ConfigError("pyzmq has its own libzmq here: install pyzmq from its wheel")
    return [str(program), libraries.pop()]


def write_message(folder: Path) -> list[str]:
    """Write a file with the map of a message in free space; returns it with the positions of time and tick."""
    record, path = [0.0] * RECORD_SIZE, folder / "body"
    for i in range(PATCHES):
        record[NAMED[f"contacts{i}.object"].at] = -1.0
    record[AT.timestamp], record[AT.tick] = 1.5, float(_EIGHT_BYTES)
    ((_, message),) = TickEncoder(
        TickParameters(SCHEMA, 1, [CONTACT], STATE, STATE_HZ), StateInfo(rate_hz=1e9)
    ).encode_row(tuple(record))
    path.write_bytes(message)
    return [
        str(path),
        *(str(message.index(value)) for value in (struct.pack(">d", 1.5), struct.pack(">q", _EIGHT_BYTES))),
    ]


def measure(name: str, words: list[str], args: argparse.Namespace, seconds: float) -> SourceResult:
    """Run a turn of a source; the share of a processor is that of the forwarding process if there is one."""
    with zmq.Context() as context, context.socket(zmq.PUB) as probe:
        endpoint = f"tcp://127.0.0.1:{probe.bind_to_random_port('tcp://127.0.0.1')}"
    with tempfile.TemporaryDirectory() as folder_name, ExitStack() as running:
        started = [endpoint if word == "ENDPOINT" else word for word in words]
        publisher = PublisherProcess(running.enter_context(run_source(started, endpoint)), endpoint)
        if name == FORWARD:
            publisher = running.enter_context(forward(publisher.endpoint, args.keys, Path(folder_name)))
        start_cpu_s, begun = measure_processor_s(publisher.process.pid), time.monotonic()
        ticks_of_subscribers = subscribe_all(name, publisher, args.subscribers, seconds, Path(folder_name))
        return SourceResult(
            ticks_of_subscribers,
            (measure_processor_s(publisher.process.pid) - start_cpu_s) / (time.monotonic() - begun),
        )


def measure_processor_s(pid: int) -> float:
    """Return the processor time of a process and its children."""
    fields = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()
    children = " ".join(path.read_text("ascii") for path in Path(f"/proc/{pid}/task").glob("*/children")).split()
    own_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return own_s + sum(measure_processor_s(int(child)) for child in children)


@contextmanager
def run_process(words: list[str], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """Run a process until the block ends."""
    with subprocess.Popen(words, **options) as process:
        try:
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=30.0)


@contextmanager
def run_source(words: list[str], endpoint: str) -> Iterator[subprocess.Popen[Any]]:
    """Run a process that publishes at an endpoint until the block ends; yields it after its first message."""
    with run_process(words, stderr=subprocess.DEVNULL, process_group=0) as process:  # Ctrl-C does not reach it
        await_messages(endpoint, words, process)
        yield process


@contextmanager
def forward(endpoint: str, keys: bool, folder: Path) -> Iterator[PublisherProcess]:
    """Run a process that forwards from an endpoint; its keys, if any, are in the folder."""
    words = [sys.executable, "-m", "softfinger.server.cli", "forward", "--from", endpoint, "--to", "tcp://127.0.0.1:*"]
    pair: tuple[str, ...] = ()
    if keys:
        make_pair(folder, "server")
        public, _ = make_pair(folder, "client")
        (folder / "readers").mkdir(mode=0o755)
        (folder / "readers" / public.name).write_bytes(public.read_bytes())
        words += ["--keys", str(folder / "server.key_secret"), "--readers", str(folder / "readers")]
        pair = str(folder / "client.key_secret"), str(folder / "server.key")
    with run_process(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line_with_endpoint = next((line for line in process.stderr if "forwarded on " in line), "")
        yield PublisherProcess(process, line_with_endpoint.partition("forwarded on ")[2].partition(",")[0], pair)


def await_messages(endpoint: str, words: list[str], process: subprocess.Popen[Any]) -> None:
    """Wait for the first message of a process, which may have to compile its kernels.

    Raises NoTelemetry if the process ends before it, or after START_S.
    """
    deadline = time.monotonic() + START_S
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger = 0
        socket.subscribe(b"contact")
        socket.connect(endpoint)
        with show_progress("the daemon starts, and compiles kernels that are not cached"):
            while not socket.poll(START_POLL_MS):
                code = process.poll()
                if code is not None or time.monotonic() > deadline:
                    reason = f"within {START_S:g} s" if code is None else f"before it ended with exit code {code}"
                    raise NoTelemetry(f"nothing arrived from {endpoint} {reason}: run `{shlex.join(words)}` to see why")


def subscribe_all(
    name: str, publisher: PublisherProcess, subscribers: int, seconds: float, folder: Path
) -> list[Array]:
    """Return the messages of every subscriber, (n, 2): tick, latency s."""
    paths = [folder / f"{number}.npy" for number in range(subscribers)]
    words = [sys.executable, "-m", "softfinger.tools.bench.telemetry", publisher.endpoint, repr(seconds)]
    processes = [subprocess.Popen([*words, str(path), *publisher.keys]) for path in paths]
    with show_progress(f"measuring: {name}", round(seconds)) as advance:
        begun = time.monotonic()
        while any(process.poll() is None for process in processes):
            advance(min(int(time.monotonic() - begun), round(seconds)))
            time.sleep(0.5)
    failed = [process.returncode for process in processes if process.returncode]
    if failed:
        raise NoTelemetry(f"{len(failed)} of {subscribers} subscribers failed: see their messages above")
    return [np.load(path) for path in paths]


def receive(endpoint: str, seconds: float, path: str, *keys: str) -> None:
    """Run a subscriber that records tick and age of each message on arrival, and saves them at the end."""
    import msgpack

    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.rcvhwm, socket.rcvtimeo, socket.linger = 0, 10_000, 0
        if keys:
            client_keys(*keys).apply_to(socket)
        socket.subscribe(b"contact")
        socket.connect(endpoint)
        arrivals: list[tuple[float, bytes]] = []
        end = time.monotonic() + seconds + 1.0
        while time.monotonic() < end:
            _, body = socket.recv_multipart()
            arrivals.append((time.time(), body))
    # Messages are decoded afterwards, since their use by a subscriber is not measured. In the first second the other
    # subscribers start.
    messages = [(at, msgpack.unpackb(body)) for at, body in arrivals if at > arrivals[0][0] + 1.0]
    np.save(path, np.array([(message["tick"], at - message["timestamp"]) for at, message in messages]))


if __name__ == "__main__":
    receive(sys.argv[1], float(sys.argv[2]), *sys.argv[3:])
