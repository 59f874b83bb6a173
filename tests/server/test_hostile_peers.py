"""Malicious peers, each a process that sends raw bytes, against a publisher in another process.

They can reach only the publisher's process, which libzmq ends if they exceed its limits. The daemon, here a program
that publishes ticks at 1 kHz, restarts that process, counts restarts, does not grow, and has no gap in its ticks in
shared memory. A subscriber is served again, and the program ends in time.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.processes import COMMAND, read_memory
from helpers.programs import Program
from helpers.raw_peers import GREETING, dial, frame, greet
from helpers.waits import eventually
from test_peers_at_every_socket import wait_until_closed

from softfinger.proxy.record import AT
from softfinger.server.socket_process.peer_socket import FILES_MAX, MEMORY_MAX
from softfinger.server.wire.client import Subscription
from softfinger.server.wire.native.memory import Local
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time

SERVER = """
import json, sys, threading, time
sys.path.insert(0, sys.argv[2])
from helpers.telemetry_records import put, synthetic
from softfinger.server.wire.publisher import Publisher

def answer():
    for _ in sys.stdin:
        print(json.dumps([publisher.figures.lost, publisher.restarts]), flush=True)
    ended.set()

ended = threading.Event()
publisher = Publisher(sys.argv[1], backlog=int(sys.argv[4]), priority=1)
print(json.dumps([publisher.endpoint, publisher.ring()["name"], publisher.pids["telemetry"]]), flush=True)
threading.Thread(target=answer, daemon=True).start()
record, tick = synthetic(10), 0
due = time.monotonic()
while not ended.is_set():
    put(record, "tick", range(tick, tick + 10))
    tick += 10
    publisher.publish(record)
    due += float(sys.argv[3])
    time.sleep(max(0.0, due - time.monotonic()))
publisher.close()
"""

PEER = """
import os, struct, sys, time
from functools import partial
sys.path.insert(0, sys.argv[2])
from helpers.raw_peers import dial, frame, greet
dial, greeted = partial(dial, sys.argv[1]), partial(greet, sys.argv[1], b"SUB")

def attack(step):
    'With a connection each, again and again; being cut off is no reason to stop.'
    while time.monotonic() < END:
        try:
            step()
        except OSError:
            pass

sys.stdin.readline()
END = time.monotonic() + 120.0
kept = []
"""

STEPS = {
    # below any limit of size; their number fills memory
    "thousands of topics": """
    data = b"".join(frame(b"\\1" + os.urandom(200)) for _ in range(2000))
    with greeted() as made:
        while time.monotonic() < END:
            made.sendall(data)""",
    "one topic again and again": """
    data = frame(b"\\1contact") * 5000
    with greeted() as made:
        while time.monotonic() < END:
            made.sendall(data)""",
    "a frame that claims 2**63 bytes": """
    with greeted() as made:
        made.sendall(b"\\2" + struct.pack(">Q", 1 << 63) + bytes(4096))
        made.recv(1 << 16)
        while made.recv(1 << 16) and time.monotonic() < END:
            pass""",
    "connections that say nothing": """
    if len(kept) < 900:
        kept.append(dial())
    time.sleep(0.001)""",
    "subscribers to nothing": """
    if len(kept) < 900:
        kept.append(greeted())
    time.sleep(0.001)""",
    "connect and go": "    dial().close()",
    "pings, and never reading": """
    with greeted() as made:
        made.sendall(frame(b"\\1"))
        while time.monotonic() < END:
            made.sendall(frame(b"\\4PING\\0\\1" + bytes(16), 4))
            time.sleep(0.001)""",
    "subscribers who never read": """
    if len(kept) < 40:
        kept.append(greeted())
        kept[-1].sendall(frame(b"\\1"))
    time.sleep(0.01)""",
}
ATTACKS = {name: f"{PEER}def step():\n{step}\nattack(step)" for name, step in STEPS.items()}

TESTS = str(Path(__file__).parents[1])
SECONDS = 1.0
"""Time in which an unlimited attack among others fills 100 MB and opens all its connections."""
GROWN_BYTES = 32e6
"""Growth of the publishing program: interpreter and allocator, and nothing that peers send."""
BACKLOG = 8192
"""Messages that the publisher of these tests buffers for a subscriber."""
MESSAGE_BYTES = 2 * 64 + 1536
"""Two of libzmq's messages, 64 bytes each, and the data shared by all subscribers."""


def read_report(process: subprocess.Popen[str]) -> Any:
    line = process.stdout.readline()
    assert line, "the publisher has ended"
    return json.loads(line)


@contextmanager
def publishing(endpoint: str, period_s: float = 0.01) -> Iterator[tuple[subprocess.Popen[str], list[Any]]]:
    """Run a process that publishes ten ticks a period; yield it with its endpoint, ring and publisher's pid."""
    words = [sys.executable, "-W", "error", "-c", SERVER, endpoint, TESTS, str(period_s)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with Program([*words, str(BACKLOG)], **pipes) as process:
        try:
            yield process, read_report(process)
        finally:
            process.kill()


def count_losses(process: subprocess.Popen[str]) -> tuple[int, int]:
    """Return the numbers of messages that a subscriber lost, and of restarts."""
    process.stdin.write("\n")
    process.stdin.flush()
    lost, restarts = read_report(process)
    return lost, restarts


def end_publisher(process: subprocess.Popen[str]) -> None:
    process.stdin.close()
    assert process.wait(60.0) == 0


def check_ticks(local: Local, healthy: Subscription, seconds: float) -> None:
    """Read for `seconds`. No tick in memory may be missing."""
    end = time.monotonic() + seconds
    before: float | None = None
    while time.monotonic() < end:
        rows = local.take(5.0)
        assert len(rows), "no ticks come"
        ticks = rows[:, AT.tick]
        assert (np.diff(ticks) == 1.0).all() and (before is None or ticks[0] == before + 1.0)
        before = float(ticks[-1])
        while healthy.receive(0.0) is not None:
            pass
    assert local.lost == 0


def make_endpoint(transport: str, folder: Path) -> str:
    return "tcp://127.0.0.1:*" if transport == "tcp" else f"ipc://{folder}/telemetry"


MANY = ("connections that say nothing", "subscribers to nothing", "subscribers who never read", "connect and go")
TOGETHER = {"by what they send": tuple(name for name in ATTACKS if name not in MANY), "by how many they are": MANY}
"""All attacks, in groups that do not block each other."""


@pytest.mark.parametrize("transport", ["tcp", pytest.param("ipc", marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("names", TOGETHER.values(), ids=TOGETHER)
def test_groups_of_malicious_peers_do_not_affect_the_daemon(names, transport, tmp_path):
    with publishing(make_endpoint(transport, tmp_path)) as (process, (bound, ring, pid)):
        with Subscription(bound, ("contact",)) as healthy, Local(ring) as local:
            assert healthy.receive(60.0) is not None  # the kernels may have to be compiled
            before = read_memory(process.pid, "VmHWM")
            with ExitStack() as ends:
                peers = []
                for name in names:
                    program = [sys.executable, "-c", ATTACKS[name], bound, TESTS]
                    peers.append(subprocess.Popen(program, stdin=subprocess.PIPE))
                    ends.callback(peers[-1].wait)
                    ends.callback(peers[-1].kill)
                for peer in peers:  # at once, because running attacks would slow the next start
                    peer.stdin.close()
                local.take(0.0)
                check_ticks(local, healthy, SECONDS)
                assert all(peer.poll() is None for peer in peers), "an attack was over"
                with contextlib.suppress(FileNotFoundError):  # no longer a process
                    assert read_memory(pid, "VmHWM") < 1.5 * MEMORY_MAX
            check_ticks(local, healthy, 0.2)
            with Subscription(bound, ("contact",)) as late:
                assert late.receive(60.0) is not None
            assert healthy.receive(60.0) is not None, "a healthy subscriber is not served again"
            grown = read_memory(process.pid, "VmHWM") - before
            files = len(os.listdir(f"/proc/{process.pid}/fd"))
        end_publisher(process)
    assert grown < GROWN_BYTES
    assert files < 64  # files of the interpreter and the listener


SUBSCRIBE = frame(b"\1contact")


def test_unfinished_handshakes_are_disconnected() -> None:
    with Publisher("tcp://127.0.0.1:*") as publisher, ExitStack() as peers:
        patient = peers.enter_context(greet(publisher.endpoint, b"SUB"))
        unfinished = [peers.enter_context(dial(publisher.endpoint)) for _ in range(3)]
        for peer, sent in zip(unfinished, (b"", GREETING[:20], GREETING), strict=True):
            peer.sendall(sent)
        for peer in unfinished:
            wait_until_closed(peer)
        assert eventually(lambda: publisher.figures.refused == 3)
        patient.sendall(SUBSCRIBE)
        assert eventually(lambda: publisher.figures.subscribers == 1)


def test_connections_are_limited_by_open_files() -> None:
    with Publisher("tcp://127.0.0.1:*") as publisher, ExitStack() as peers:
        for _ in range(FILES_MAX):
            try:
                peer = peers.enter_context(greet(publisher.endpoint, b"SUB", 1.0))
            except (TimeoutError, ConnectionError):
                break
            peer.sendall(SUBSCRIBE)
        assert eventually(lambda: publisher.figures.subscribers > FILES_MAX // 2)
        time.sleep(0.5)  # for peers that could connect, and must not
        assert publisher.figures.subscribers < FILES_MAX
        peers.close()
        assert eventually(lambda: publisher.figures.subscribers == 0)
        with Subscription(publisher.endpoint, ("schema",)) as late:
            assert late.receive(60.0) is not None
        assert publisher.restarts == 0


STOPPED = """
import sys
from softfinger.server.wire.client import subscribe
with subscribe(sys.argv[1], ("contact", "event", "health")) as samples:
    for sample in samples:
        print(sample.tick, flush=True)
"""


@contextmanager
def subscribers_that_do_not_read(endpoint: str) -> Iterator[None]:
    """Run a subscriber that is suspended after its first tick, and connections that never read."""
    silent = [sys.executable, "-c", ATTACKS["subscribers who never read"], endpoint, TESTS]
    words = [sys.executable, "-c", STOPPED, endpoint]
    with (
        Program(words, stdout=subprocess.PIPE, text=True, kill_at_end=True) as stopped,
        Program(silent, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL, kill_at_end=True),
    ):
        assert stopped.stdout.readline()
        stopped.send_signal(signal.SIGSTOP)
        yield


@pytest.mark.parametrize("transport", ["tcp", pytest.param("ipc", marks=pytest.mark.exhaustive)])
def test_subscribers_that_are_stopped_or_never_read(transport: str, tmp_path: Path) -> None:
    with (
        publishing(make_endpoint(transport, tmp_path), period_s=0.002) as (process, (bound, _, pid)),
        subscribers_that_do_not_read(bound),
        Subscription(bound, ("contact",)) as watching,
    ):
        before = read_memory(pid, "VmRSS")

        def is_backlog_full() -> bool:
            assert all(watching.receive(60.0) is not None for _ in range(1000))
            return count_losses(process)[0] > 0

        assert eventually(is_backlog_full)  # the system's buffers are full before
        grown = read_memory(pid, "VmHWM") - before
        assert count_losses(process)[1] == 0
        end_publisher(process)
    assert grown < 1.5 * BACKLOG * (41 * 2 * 64 + MESSAGE_BYTES)


def test_the_daemon_ends_while_a_subscriber_is_stopped() -> None:
    words = [*COMMAND, "run", "--endpoint", "tcp://127.0.0.1:*"]
    with Program(words, stderr=subprocess.PIPE, text=True, kill_at_end=True) as daemon:
        bound = next(line for line in daemon.stderr if "telemetry on" in line).split("telemetry on ")[1].strip()
        rest = threading.Thread(target=daemon.stderr.read)  # the daemon must not block on a full pipe
        rest.start()
        with subscribers_that_do_not_read(bound):
            time.sleep(1.0)
            daemon.terminate()
            assert daemon.wait(60.0) == 0
        rest.join()
