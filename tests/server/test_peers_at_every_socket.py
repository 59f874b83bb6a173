"""Hostile peers at every socket that reads from peers: too large, malformed, slow, inconsistent subscriptions.

One daemon with a page and metrics, and one gateway. Each attack runs at each socket. Afterwards the owning process is
still the same one, has not stored the payload, and serves the next peer.
"""

import contextlib
import os
import random
import resource
import signal
import socket
import struct
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgpack
import numpy as np
import pytest
import viser
import zmq
from helpers.processes import COMMAND, find_child, read_memory
from helpers.programs import Program
from helpers.raw_peers import CUT_S, GREETING, dial, frame, greet, make_ready
from helpers.waits import until
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from softfinger.server.socket_process.peer_socket import COMMANDS_MEMORY_MAX, SocketContext
from softfinger.server.socket_process.subscribers import TOPICS_MAX, Subscribers
from softfinger.server.viewer.door.access import BROWSERS_MAX
from softfinger.server.wire.client import Subscription
from softfinger.server.wire.control import Control
from softfinger.server.wire.endpoint import listen

pytestmark = pytest.mark.real_time

LARGE = 45_000_000
"""Bytes of a message that no socket may read into memory. viser's own limit is 50 MB."""
GROWN_MAX = 20_000_000
"""Largest growth of a process during an attack, bytes: room for its own work, less than half of LARGE."""


class Peers(NamedTuple):
    """Address of each socket, and process id of each owner, by name."""

    addresses: dict[str, str]
    owners: dict[str, int]


OWNERS = {
    "telemetry": "publisher", "commands": "receiver", "forwarded telemetry": "gateway's telemetry",
    "forwarded commands": "gateway", "metrics": "daemon", "page": "page",
}  # fmt: skip
"""Owner of each socket: the process that reads it."""
CHILDREN = {
    "publisher": b"socket_process\0telemetry", "receiver": b"socket_process\0commands", "page": b"\0view\0",
}  # fmt: skip
"""Words in the command lines of the daemon's processes."""
ZMTP = {"telemetry": b"SUB", "commands": b"DEALER", "forwarded telemetry": b"SUB", "forwarded commands": b"DEALER"}
"""Sockets of ZeroMQ with the socket type of their peers."""


def read_after(program: Program, words: str) -> str:
    """Return the text up to a space after `words` in the stderr of a program, on the same line or the next."""
    for line in program.stderr:
        if words in line:
            return str((line.split(words)[1].split() or next(program.stderr).split())[0].rstrip(";,"))
    raise AssertionError(f"nothing was said of {words!r}")


@pytest.fixture(scope="module")
def peers() -> Iterator[Peers]:
    ends = ["--endpoint", "tcp://127.0.0.1:*", "--commands", "tcp://127.0.0.1:*", "--metrics", "0", "--view"]
    words = [*COMMAND, "run", "--realtime", "off", "--rate", "100", "--rig", "replay", *ends]
    with Program(words, stderr=subprocess.PIPE, text=True) as daemon:
        try:
            addresses = {"page": read_after(daemon, "the page; to stop it: Ctrl-C")}
            addresses |= {name: read_after(daemon, f"{name} on ") for name in ("telemetry", "commands", "metrics")}
            read_after(daemon, "real time: ")  # it is compiled and ticks
            words = ["forward", "--from", addresses["telemetry"], "--commands-from", addresses["commands"]]
            with socket.create_server(("127.0.0.1", 0)) as unused:
                addresses["forwarded telemetry"] = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
            words += ["--to", addresses["forwarded telemetry"], "--commands-to", "tcp://127.0.0.1:*"]
            with Program([*COMMAND, *words], stderr=subprocess.PIPE, text=True) as gateway:
                addresses["forwarded commands"] = read_after(gateway, "commands forwarded on ")
                owners = {name: find_child(daemon.pid, words) for name, words in CHILDREN.items()}
                owners |= {"daemon": daemon.pid, "gateway": gateway.pid}
                owners["gateway's telemetry"] = find_child(gateway.pid, b"\0--until-eof\0")
                try:
                    yield Peers(addresses, owners)
                    assert (daemon.poll(), gateway.poll()) == (None, None)
                    assert all(owners[name] == find_child(daemon.pid, words) for name, words in CHILDREN.items())
                finally:
                    gateway.terminate()
                    gateway.communicate(timeout=60.0)
        finally:
            daemon.terminate()
            daemon.communicate(timeout=60.0)
    assert (daemon.returncode, gateway.returncode) == (0, 0)


def browser(address: str) -> ClientConnection:
    """Open the page's WebSocket like its script."""
    where = urlsplit(address)
    return connect(
        f"ws://127.0.0.1:{where.port}{where.path}", origin=Origin(f"http://127.0.0.1:{where.port}"), compression=None,
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None, max_queue=None,
    )  # fmt: skip


def wait_until_closed(peer: socket.socket) -> None:
    """Wait until the server has closed a connection; TimeoutError if it does not."""
    with contextlib.suppress(ConnectionError):  # connections with unread bytes are reset
        while peer.recv(1 << 16):
            pass


def send_too_large(name: str, address: str) -> None:
    """Send a message of LARGE bytes, announced by its header."""
    with greet(address, ZMTP[name]) if name in ZMTP else dial(address) as peer:
        with contextlib.suppress(ConnectionError):
            if name in ZMTP:
                peer.sendall(b"\2" + struct.pack(">Q", LARGE) + bytes(LARGE))
            else:
                peer.sendall(b"GET / HTTP/1.1\r\nX: " + b"x" * LARGE)
        wait_until_closed(peer)


def send_one_byte_too_large(name: str, address: str) -> None:
    """Send a frame of the largest documented size, which is accepted, and one a byte longer, refused."""
    most = 512 if name.endswith("telemetry") else 262144
    with greet(address, ZMTP[name]) as peer:
        peer.sendall(frame(bytes(most)))
        peer.settimeout(0.2)
        with contextlib.suppress(TimeoutError):
            assert peer.recv(1000), "a frame of the largest size is refused"
        peer.settimeout(CUT_S)
        peer.sendall(frame(bytes(most + 1)))
        wait_until_closed(peer)


def send_malformed(name: str, address: str) -> None:
    """Send random bytes, before and after a handshake."""
    chance = random.Random(name)
    for begin in (dial, *([lambda address: greet(address, ZMTP[name])] if name in ZMTP else [])):
        with begin(address) as peer:
            with contextlib.suppress(ConnectionError):
                peer.sendall(b"\x06" + chance.randbytes(100_000) + b"\r\n\r\n")  # not a valid start of a ZMTP frame
            wait_until_closed(peer)


def send_slowly(name: str, address: str) -> None:
    """Send a byte every 0.1 s: each byte is in time, but the complete request is not."""
    request = GREETING if name in ZMTP else b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 1000
    with dial(address) as peer, contextlib.suppress(ConnectionError):
        peer.settimeout(0.1)
        until = time.monotonic() + CUT_S
        for byte in request * 10:
            assert time.monotonic() < until, "it is not cut off"
            peer.sendall(bytes((byte,)))
            with contextlib.suppress(TimeoutError):
                while received := peer.recv(1000):
                    pass
                if not received:
                    return


REQUEST = frame(b"", 1) + frame(msgpack.packb({"command_id": "r", "method": "describe"}))


def send_without_reading(name: str, address: str) -> None:
    """Send requests and read no answer, until the server reads no more or closes the connection."""
    with greet(address, ZMTP[name]) as peer, contextlib.suppress(ConnectionError, TimeoutError):
        peer.settimeout(0.5)
        for _ in range(400):
            peer.sendall(50 * REQUEST)


ATTACKS: dict[str, Callable[[str, str], None]] = {
    "too large": send_too_large, "one byte too large": send_one_byte_too_large, "malformed": send_malformed,
    "unread answers": send_without_reading,
}  # fmt: skip
ONLY = {"one byte too large": (*ZMTP,), "unread answers": ("commands", "forwarded commands")}
"""Sockets of an attack that is not for all."""


def read_peak_memory(pid: int) -> int:
    """Return the peak memory (bytes) of a process since the last call, and reset it."""
    peak = read_memory(pid, "VmHWM")
    Path(f"/proc/{pid}/clear_refs").write_text("5")
    return peak


def is_serving(name: str, address: str) -> bool:
    if name.endswith("telemetry"):
        with Subscription(address, ("contact",)) as reader:
            return reader.receive(CUT_S) is not None
    if name.endswith("commands"):
        with Control(address, CUT_S) as control:
            return bool(control.describe())
    with urllib.request.urlopen(address, timeout=CUT_S) as answer:
        return bool(answer.status == 200)


@contextlib.contextmanager
def unharmed(peers: Peers, name: str) -> Iterator[None]:
    """Assert that the owner of a socket does not grow during the block, and serves afterwards."""
    pid = peers.owners[OWNERS[name]]
    assert is_serving(name, peers.addresses[name])
    read_peak_memory(pid)
    before = read_peak_memory(pid)
    yield
    assert read_peak_memory(pid) - before < GROWN_MAX
    assert is_serving(name, peers.addresses[name])


@pytest.mark.parametrize(
    ("name", "attack"), [(name, attack) for name in OWNERS for attack in ATTACKS if name in ONLY.get(attack, OWNERS)]
)
def test_a_socket_refuses_and_serves_on(name: str, attack: str, peers: Peers) -> None:
    with unharmed(peers, name):
        ATTACKS[attack](name, peers.addresses[name])


READY = GREETING + make_ready(b"DEALER")
RAW: dict[str, tuple[bytes, bytes]] = {
    "frames without end": (READY, frame(bytes(60_000), 1)),
    "a frame of 2^62 bytes": (READY, b"\2" + struct.pack(">Q", 1 << 62)),
    "answers that are not read": (READY, 50 * REQUEST),
    "pings": (READY, 500 * frame(b"\4PING\0\0" + bytes(16), 4)),
    "another mechanism": (b"", GREETING.replace(b"NULL", b"CURV")),
    "a subscriber": (GREETING, make_ready(b"SUB")),
    "no ZMTP": (b"", 100 * b"GET / HTTP/1.1\r\n\r\n"),
    "nothing": (b"", b""),
}
"""First bytes of a peer at the socket for commands, and those that it then sends again and again."""


def test_raw_peers_delay_no_tick_and_no_request(peers: Peers) -> None:
    """Five peers of each kind at once, while other clients connect and send requests."""
    address, daemon, ended = peers.addresses["commands"], peers.owners["daemon"], threading.Event()

    def attack(first: bytes, others: bytes) -> None:
        while not ended.is_set():
            with contextlib.suppress(OSError), dial(address, 0.2) as peer:
                peer.sendall(first)
                for _ in range(400):
                    peer.sendall(others)
                    if ended.wait(0.0 if others else 0.02):
                        break

    read_peak_memory(daemon)
    before = read_peak_memory(daemon)
    with (
        Subscription(peers.addresses["telemetry"], ("contact",)) as reader,
        ThreadPoolExecutor(5 * len(RAW)) as threads,
    ):
        attacks = [threads.submit(attack, *sent) for sent in RAW.values() for _ in range(5)]
        try:
            ticks = list[int]()
            while len(ticks) < 50:
                assert is_serving("commands", address)
                ticks += [sample.tick for sample in iter(lambda: reader.receive(0.0), None)]
        finally:
            ended.set()
        for future in attacks:
            future.result()
    assert (np.diff(ticks) == 1).all() and is_serving("commands", address)
    assert read_peak_memory(daemon) - before < GROWN_MAX
    # frames without end fill the process up to its limit; if libzmq ends it there, the daemon restarts it
    receiver = peers.owners["receiver"] = find_child(daemon, CHILDREN["receiver"])
    assert resource.prlimit(receiver, resource.RLIMIT_DATA)[0] == COMMANDS_MEMORY_MAX


@pytest.mark.parametrize(
    "names", [[name for name in OWNERS if name != "page"], pytest.param(["page"], marks=pytest.mark.exhaustive)],
    ids=["2 s", "10 s"],
)  # fmt: skip
def test_slow_peers_are_cut_off(names: list[str], peers: Peers) -> None:
    with ThreadPoolExecutor() as threads, contextlib.ExitStack() as owners:
        for name in names:
            owners.enter_context(unharmed(peers, name))
        cut = [threads.submit(send_slowly, name, peers.addresses[name]) for name in names]
        assert all(is_serving(name, peers.addresses[name]) for name in names)
        for future in cut:
            future.result()


@pytest.mark.parametrize("message", [bytes(LARGE), [bytes(32768)] * 1300, bytes(65537)],
                         ids=["one frame", "fragments", "a byte too many"])  # fmt: skip
def test_the_page_refuses_a_large_message_at_its_header(message: Any, peers: Peers) -> None:
    with unharmed(peers, "page"), browser(peers.addresses["page"]) as large:
        large.recv(timeout=CUT_S)
        with contextlib.suppress(ConnectionClosed):  # at the first excessive fragment
            large.send(message)
        with contextlib.suppress(ConnectionClosed):
            while large.recv(timeout=CUT_S):
                pass
        assert large.protocol.close_code == CloseCode.MESSAGE_TOO_BIG


def test_the_page_has_a_bounded_number_of_browsers(peers: Peers) -> None:
    address = peers.addresses["page"]
    with contextlib.ExitStack() as opened:
        first = browser(address)
        first.recv(timeout=CUT_S)
        for _ in range(BROWSERS_MAX - 1):
            opened.enter_context(browser(address)).recv(timeout=CUT_S)
        assert get_refusal_code(address) == CloseCode.TRY_AGAIN_LATER
        first.close()
        until(lambda: get_refusal_code(address) is None, CUT_S, "none is accepted after one has closed")


def get_refusal_code(address: str) -> int | None:
    """Return the code with which the page closes another browser, or None if it is accepted."""
    with browser(address) as late, contextlib.suppress(ConnectionClosed):
        late.recv(timeout=CUT_S)
        return None
    return late.protocol.close_code


def test_forwarded_commands_do_not_depend_on_telemetry(peers: Peers) -> None:
    pid = peers.owners["gateway's telemetry"]
    os.kill(pid, signal.SIGSTOP)
    assert is_serving("forwarded commands", peers.addresses["forwarded commands"])
    os.kill(pid, signal.SIGKILL)
    assert is_serving("forwarded telemetry", peers.addresses["forwarded telemetry"])
    assert is_serving("forwarded commands", peers.addresses["forwarded commands"])
    peers.owners["gateway's telemetry"] = find_child(peers.owners["gateway"], b"\0--until-eof\0")
    assert peers.owners["gateway's telemetry"] != pid


@contextlib.contextmanager
def reading() -> Iterator[tuple[Subscribers, list[bytes], Callable[[Callable[[], bool]], None], str]]:
    """Yield readers at a socket, the topics that they read, a function that runs them until a condition, the address"""
    topics_read, bound = list[bytes](), listen("tcp://127.0.0.1:*", "endpoint")
    with zmq.Context() as context, bound.files:
        readers = Subscribers(SocketContext(context, None), bound, None, 1000, topics_read.append)

        def run_until(condition: Callable[[], bool]) -> None:
            end = time.monotonic() + CUT_S
            while not condition():
                assert time.monotonic() < end, (readers.connection_count, topics_read)
                readers.take()
                readers.peers.process_events()

        yield readers, topics_read, run_until, bound.endpoint
        readers.peers.close()


def test_subscribers_are_the_connections_that_subscribe() -> None:
    chance, subscriptions = random.Random(7), dict[socket.socket, dict[bytes, int]]()
    with reading() as (readers, topics_read, run_until, endpoint), contextlib.ExitStack() as ends:
        for number in range(120):
            if len(subscriptions) < 4 and chance.random() < 0.5:
                subscriptions[ends.enter_context(greet(endpoint, b"SUB"))] = {}
            if not subscriptions:
                continue
            peer, topic = chance.choice([*subscriptions]), chance.choice([b"", b"a", b"ab"])
            if chance.random() < 0.1:
                peer.close()
                del subscriptions[peer]
            else:
                ends_it, count = chance.random() < 0.6, subscriptions[peer].get(topic, 0)
                subscriptions[peer][topic] = max(count - 1, 0) if ends_it else count + 1
                sync = b"sync%d" % number
                peer.sendall(frame((b"\0" if ends_it else b"\1") + topic) + frame(b"\1" + sync))
                run_until(lambda sync=sync: sync in topics_read)
                with_sync = sum(
                    subscriber is peer or any(topics.values()) for subscriber, topics in subscriptions.items()
                )
                assert readers.connection_count == with_sync
                peer.sendall(frame(b"\0" + sync))
            run_until(
                lambda: readers.connection_count == sum(any(topics.values()) for topics in subscriptions.values())
            )
        assert len(topics_read) > 60


def test_topics_of_one_peer_are_counted_up_to_a_bound() -> None:
    with reading() as (readers, topics_read, run_until, endpoint), greet(endpoint, b"SUB") as peer:
        for number in range(2 * TOPICS_MAX):
            peer.sendall(frame(b"\1%d" % number))
        run_until(lambda: len(topics_read) >= 2 * TOPICS_MAX)
        assert readers.connection_count == 1
        (topics,) = readers._topics.values()
        assert len(topics) == TOPICS_MAX
