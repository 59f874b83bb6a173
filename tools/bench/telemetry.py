"""`bench telemetry`: from the tick to the subscriber, end to end, over real sockets and processes.

One process runs the daemon, each subscriber is a process of its own. Beside it, the reference: a bare
loop that sends a message of the same size at the same rate, to the same number of subscribers.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import zmq

from softfinger.server.client import NoTelemetry
from softfinger.server.figures import figure, save
from softfinger.server.progress import progress
from softfinger.tools.measure import Array, add_output_options, microseconds, quantiles, show

START_S: Final = 180.0
"""How long a cold daemon may take to compile."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--subscribers", type=int, default=8, help="processes that subscribe (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to measure (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="ticks per second (%(default)s)")
    parser.add_argument("--transport", choices=["tcp", "ipc"], default="tcp", help="default: %(default)s")
    add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("reference", "daemon"):
            with source(name, args, Path(folder)) as endpoint:
                await_messages(endpoint)
                found[name] = subscribe_all(name, endpoint, args, Path(folder))
    block = round(args.rate)
    result: dict[str, Any] = {"subscribers": args.subscribers, "rate_hz": args.rate, "seconds": args.seconds}
    for name, parts in found.items():
        result[name] = {
            "latency": quantiles(np.concatenate([part[:, 1] for part in parts]), block),
            "messages": sum(len(part) for part in parts),
            "lost": int(sum((np.diff(part[:, 0]) - 1).sum() for part in parts)),
        }
    result["p50_daemon_over_reference"] = result["daemon"]["latency"]["p50"] / result["reference"]["latency"]["p50"]
    lines = [f"tick to subscriber, {args.subscribers} subscribers at {args.rate:g} Hz over {args.transport}, us"]
    for name in found:
        latency = result[name]["latency"]
        cells = "  ".join(f"{q} {microseconds(latency[q])}" for q in ("p50", "p99", "p999", "max"))
        lines.append(f"  {name:<10} {cells}   lost {result[name]['lost']} of {result[name]['messages']}")
    lines.append(f"  p50 of the daemon over a bare sender: {result['p50_daemon_over_reference']:.2f}")
    show(result, args.json, lines)
    if args.plot:
        draw(args.plot, found)
    return 0


@contextmanager
def source(name: str, args: argparse.Namespace, folder: Path) -> Iterator[str]:
    """A process that publishes until the block ends; gives its endpoint."""
    if args.transport == "ipc":
        endpoint = f"ipc://{folder}/{name}.sock"
    else:
        with zmq.Context() as context, context.socket(zmq.PUB) as probe:
            endpoint = f"tcp://127.0.0.1:{probe.bind_to_random_port('tcp://127.0.0.1')}"
    words = {
        "daemon": ["-m", "softfinger.server.cli", "run", "--endpoint", endpoint, "--rate", repr(args.rate)],
        "reference": ["-m", "softfinger.tools.bench.telemetry", "send", endpoint, repr(args.rate)],
    }[name]
    with subprocess.Popen([sys.executable, *words], stderr=subprocess.PIPE) as process:
        try:
            yield endpoint
        finally:
            process.terminate()
            process.communicate(timeout=30.0)


def await_messages(endpoint: str) -> None:
    """Wait for the first message; the kernels may have to be compiled."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger = 0
        socket.subscribe(b"contact")
        socket.connect(endpoint)
        with progress("waiting for the first message"):
            if not socket.poll(int(START_S * 1000)):
                raise NoTelemetry(f"nothing arrived from {endpoint} within {START_S:g} s: does `softfinger run` start?")


def subscribe_all(name: str, endpoint: str, args: argparse.Namespace, folder: Path) -> list[Array]:
    """Messages of every subscriber, (n, 2): tick, latency s."""
    paths = [folder / f"{name}-{number}.npy" for number in range(args.subscribers)]
    words = [sys.executable, "-m", "softfinger.tools.bench.telemetry", "receive", endpoint, repr(args.seconds)]
    processes = [subprocess.Popen([*words, str(path)]) for path in paths]
    with progress(f"measuring the {name}", round(args.seconds)) as done:
        begun = time.monotonic()
        while any(process.poll() is None for process in processes):
            done(min(int(time.monotonic() - begun), round(args.seconds)))
            time.sleep(0.5)
    failed = [process.returncode for process in processes if process.returncode]
    if failed:
        raise NoTelemetry(f"{len(failed)} of {args.subscribers} subscribers failed: see their messages above")
    return [np.load(path) for path in paths]


def receive(endpoint: str, seconds: float, path: str) -> None:
    """A subscriber: notes each message's tick and age as it arrives, and saves them at the end."""
    import msgpack

    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.rcvhwm, socket.rcvtimeo, socket.linger = 0, 5000, 0
        socket.subscribe(b"contact")
        socket.connect(endpoint)
        seen: list[tuple[float, bytes]] = []
        end = time.monotonic() + seconds + 1.0
        while time.monotonic() < end:
            _, body = socket.recv_multipart()
            seen.append((time.time(), body))
    # Decoded afterwards: what a subscriber does with a message is its own affair. The first second is the
    # start of all the others.
    messages = [(at, msgpack.unpackb(body)) for at, body in seen if at > seen[0][0] + 1.0]
    np.save(path, np.array([(message["tick"], at - message["timestamp"]) for at, message in messages]))


def send(endpoint: str, rate_hz: float) -> None:
    """The reference: a loop that does nothing but send a message of a tick's size on time."""
    import msgpack

    from softfinger.proxy.state import RECORD_SIZE
    from softfinger.server.protocol import contact_map

    message = contact_map(np.zeros(RECORD_SIZE), 1)
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.sndhwm = 0
        socket.linger = 0
        socket.bind(endpoint)
        tick, due = 0, time.monotonic()
        while True:
            due += 1.0 / rate_hz
            time.sleep(max(due - time.monotonic(), 0.0))
            message["tick"], message["timestamp"] = tick, time.time()
            socket.send_multipart([b"contact", msgpack.packb(message)])
            tick += 1


def draw(path: Path, found: dict[str, list[Array]]) -> None:
    drawing = figure()
    axes = drawing.add_subplot()
    for name, parts in found.items():
        latency = np.sort(np.concatenate([part[:, 1] for part in parts])) * 1e6
        axes.loglog(latency.clip(1.0), 1.0 - np.arange(len(latency)) / len(latency), label=name)
    axes.set_xlabel("tick to subscriber, us")
    axes.set_ylabel("share of messages later than this")
    axes.legend()
    axes.grid(True, alpha=0.3)
    save(drawing, path)


if __name__ == "__main__":
    role, *rest = sys.argv[1:]
    if role == "receive":
        receive(rest[0], float(rest[1]), rest[2])
    elif role == "send":
        send(rest[0], float(rest[1]))
    else:
        raise SystemExit(f"{role}: send or receive")
