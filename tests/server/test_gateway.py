"""Daemon open to other machines by key, for authorized and other clients; and forwarding by a program."""

import contextlib
import itertools
import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import msgpack
import numpy as np
import pytest
import zmq
from helpers.called import called, read_stdout
from helpers.daemons import subscribed
from helpers.encoder import contact_map
from helpers.processes import COMMAND
from helpers.programs import Program
from helpers.telemetry_records import synthetic
from helpers.waits import eventually, repeated
from zmq.utils.monitor import recv_monitor_message

from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import Daemon
from softfinger.server.gateway import verb
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.gateway.forward import CLIENTS_MAX, Commanders
from softfinger.server.keys import ClientKeys, client_keys, make_pair
from softfinger.server.socket_process.peer_socket import SocketContext
from softfinger.server.socket_process.subscribers import SUBSCRIPTIONS_PER_S
from softfinger.server.wire.control import Control
from softfinger.server.wire.endpoint import listen
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time

WAIT_S = 60.0
"""Generous bound: a compilation on a busy machine."""


class KeyRing:
    """Keys of a server, a reader, a commander and a stranger, and the folders of authorized keys."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("server", "stranger"):
            make_pair(folder / "keys", name)
        for name, may in (("reader", "readers"), ("commander", "commanders")):
            (folder / may).mkdir()
            self.add(name, may)
        (folder / "rig.toml").write_text(
            '[device]\ndriver = "replay"\nrecording = "press-roll-spin-drag"\n[servo]\nrealtime = "off"\n'
            '[telemetry]\nendpoint = "tcp://0.0.0.0:*"\n'
            '[security]\nkey = "keys/server.key_secret"\nreaders = "readers"\ncommanders = "commanders"\n'
        )

    @property
    def rig(self) -> Path:
        return self.folder / "rig.toml"

    def add(self, name: str, may: str) -> None:
        """Make a key, and authorize it."""
        public, _ = make_pair(self.folder / "keys", name)
        (self.folder / may / public.name).write_bytes(public.read_bytes())

    def of(self, name: str) -> ClientKeys:
        return client_keys(self.folder / "keys" / f"{name}.key_secret", self.folder / "keys" / "server.key")

    def options(self, name: str) -> list[str]:
        own = self.folder / "keys" / f"{name}.key_secret"
        return ["--keys", str(own), "--server-key", str(self.folder / "keys" / "server.key")]


@pytest.fixture
def key_ring(tmp_path: Path) -> KeyRing:
    return KeyRing(tmp_path)


_AWAY = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
"""libzmq does not retry after either event."""


class Listener:
    """Subscriber, or client that sends a request; counts messages, accepted and rejected connections."""

    def __init__(self, context: zmq.Context, endpoint: str, keys: ClientKeys | None = None, asks: bool = False) -> None:
        self.socket = context.socket(zmq.DEALER if asks else zmq.SUB)
        self.socket.linger, self.socket.reconnect_ivl, self.socket.rcvhwm = 0, 20, 0
        self.monitor = self.socket.get_monitor_socket(_AWAY | zmq.EVENT_HANDSHAKE_SUCCEEDED)
        if not asks:
            self.socket.subscribe(b"")
        if keys is not None:
            keys.apply_to(self.socket)
        self.socket.connect(endpoint.replace("0.0.0.0", "127.0.0.1"))
        self.messages = self.away = self.let_in = 0
        self.events: list[dict[str, Any]] = []
        if asks:
            self.socket.send_multipart([b"", msgpack.packb({"command_id": "1", "method": "stop", "params": {}})])

    def look(self) -> Self:
        while self.socket.poll(0):
            topic, body = self.socket.recv_multipart()
            self.messages += 1
            if topic == b"event":
                self.events.append(msgpack.unpackb(body))
        while self.monitor.poll(0):
            event = recv_monitor_message(self.monitor)["event"]
            self.away += bool(event & _AWAY)
            self.let_in += event == zmq.EVENT_HANDSHAKE_SUCCEEDED
        return self


@contextlib.contextmanager
def serving(key_ring: KeyRing) -> Iterator[tuple[Daemon, zmq.Context]]:
    """Run a daemon open to other machines; yield it and a context for clients."""
    with Daemon(load_rig(key_ring.rig), load_scene("paper-plane")) as daemon, zmq.Context() as context:
        try:
            daemon.start()
            yield daemon, context
        finally:
            context.destroy(0)


def test_clients_need_a_key_to_read_or_command(key_ring: KeyRing) -> None:
    with serving(key_ring) as (daemon, context):
        telemetry, commands = daemon.public["telemetry"], daemon.public["commands"]
        assert telemetry.startswith("tcp://0.0.0.0:") and not commands.endswith(":0")
        strangers, nobodies = (None, key_ring.of("stranger")), list[Listener]()
        nobodies += [Listener(context, telemetry, keys) for keys in (*strangers, key_ring.of("commander"))]
        nobodies += [Listener(context, commands, keys, asks=True) for keys in (*strangers, key_ring.of("reader"))]
        reader = Listener(context, telemetry, key_ring.of("reader"))
        assert eventually(lambda: reader.look().messages > 500)
        assert eventually(lambda: all(nobody.look().away for nobody in nobodies))
        assert not any(nobody.messages or nobody.let_in for nobody in nobodies)
        with Control(commands.replace("0.0.0.0", "127.0.0.1"), WAIT_S, key_ring.of("commander")) as control:
            assert control.get_state().active_field == "unnamed" and control.mark("a").tick > 0
        for words, who, endpoint in (
            ("monitor --once --json --endpoint", "reader", telemetry),
            ("ctl heartbeat --json --endpoint", "commander", commands),
        ):
            local = endpoint.replace("0.0.0.0", "127.0.0.1")
            assert json.loads(read_stdout(*words.split(), local, *key_ring.options(who)))
        key_ring.add("second", "readers")  # its key is removed later
        second = Listener(context, telemetry, key_ring.of("second"))
        assert eventually(lambda: second.look().messages > 100)
        (key_ring.folder / "readers" / "second.key").unlink()
        before = second.look().let_in
        assert eventually(lambda: second.look().away)
        count, reader_count = second.messages, reader.look().messages
        assert second.let_in == before and eventually(lambda: reader.look().messages > reader_count + 500)
        assert second.look().messages == count
        daemon.stop()
        assert daemon.wait(60.0)
        daemon.close()
        assert eventually(lambda: [event for event in reader.look().events if event["name"] == "stopped"])
        assert any(event["kind"] == "mark" for event in reader.events)


def test_a_restarted_publisher_requires_keys(key_ring: KeyRing) -> None:
    with serving(key_ring) as (daemon, context):
        own = Listener(context, daemon.publisher.endpoint)
        reader = Listener(context, daemon.public["telemetry"], key_ring.of("reader"))
        assert eventually(lambda: own.look().messages > 10 and reader.look().messages > 10)
        os.kill(daemon.publisher.pids["telemetry"], signal.SIGKILL)
        assert eventually(lambda: daemon.publisher.restarts == 1)
        count = reader.look().messages
        assert eventually(lambda: reader.look().messages > count + 500)
        stranger = Listener(context, daemon.public["telemetry"], key_ring.of("stranger"))
        assert eventually(lambda: stranger.look().away) and not stranger.messages
        assert eventually(lambda: own.look().let_in == 2)


@contextlib.contextmanager
def forwarding(*words: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """Run `softfinger forward`; yield it and its endpoint."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "kill_at_end": True}
    with Program([*COMMAND, "forward", "--json", *words], **pipes) as process:
        message = next((line for line in process.stderr if "forwarded on" in line), "")
        yield process, message.partition("forwarded on ")[2].partition(",")[0]


def test_forwarded_messages_equal_published_ones() -> None:
    records = np.delete(synthetic(3000), [100, 101, 102, 2000], axis=0)
    with (
        Publisher("tcp://127.0.0.1:*") as publisher,
        forwarding("--from", publisher.endpoint, "--to", "tcp://127.0.0.1:*") as (process, endpoint),
        subscribed(endpoint, "") as first,
        subscribed(endpoint, "") as second,
    ):
        for socket in (first, second):  # until each is known to receive messages
            while not socket.poll(10):
                publisher.event("mark", "mark", label="are you there")
        publisher.publish(records)
        assert eventually(lambda: publisher.figures.subscribers == 1)
        for socket in (first, second):
            frames = [socket.recv_multipart()]
            while len(contacts := [body for topic, body in frames if topic == b"contact"]) < len(records):
                frames.append(socket.recv_multipart())
            assert [msgpack.unpackb(body) for body in contacts] == [contact_map(record) for record in records]
        process.send_signal(signal.SIGINT)
        content = json.loads(process.stdout.read())
        assert process.wait(WAIT_S) == 0
    assert content["messages"] >= len(records) and content["lost"] == 4
    assert content["telemetry"]["connections_max"] == 2 and content["telemetry"]["refused"] == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "add --to, --commands-to or --lsl"),
        (["--to", "tcp://0.0.0.0:*"], "is open to the network: set the allowed clients"),
        (["--commands-to", "tcp://0.0.0.0:*", "--keys", "keys/server.key_secret"], "--commanders DIR"),
        (["--to", "tcp://127.0.0.1:*", "--readers", "readers"], "add --keys FILE"),
        (["--to", "tcp://127.0.0.1:*", "--server-key", "keys/server.key"], "requires --keys FILE"),
        (["--to", "nowhere"], "is not an endpoint"),
        (["--to", "tcp://127.0.0.1:*", "--from", "nowhere"], "cannot connect to endpoint 'nowhere'"),
    ],
)  # fmt: skip
def test_invalid_forwarding_options_are_refused(key_ring, words, message, monkeypatch):
    monkeypatch.chdir(key_ring.folder)
    result = called("forward", *words)
    assert result.returncode == 2 and message in result.stderr and result.stderr.count("\n") == 1, result.stderr


def test_a_gateway_without_file_descriptors_continues_and_retries(monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    monkeypatch.setattr(verb, "RESTART_S", 0.0)
    args = SimpleNamespace(to=None, keys=None, readers=None, server_key=None, lsl=False, quiet=True)
    forwarded = verb.TelemetryProcess(args, Addresses("none", None))
    forwarded._process.kill()
    forwarded._process.wait()
    with monkeypatch.context() as refused:
        refused.setattr(forwarded, "_command", ["/dev/null/no program"])
        assert forwarded.keep_running() and forwarded.keep_running()
    assert forwarded.keep_running() and forwarded._process.poll() is None
    status = Path(f"/proc/{forwarded._process.pid}/status").read_text()
    blocked = next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigBlk"))
    assert blocked >> signal.SIGTERM - 1 & 1  # it ends by the end of its input, not by a signal to all processes
    forwarded.end()
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING"]


def test_a_client_beyond_the_limit_replaces_the_one_that_was_silent_longest() -> None:
    with contextlib.ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        stack.callback(context.destroy, 0)
        server = context.socket(zmq.ROUTER)
        server.bind("inproc://server")
        bound = listen("tcp://127.0.0.1:*", "--commands")
        stack.callback(bound.files.close)
        gateway = Commanders(SocketContext(context, None), "inproc://server", None, bound, None)
        stack.callback(gateway.close)
        clients = [context.socket(zmq.DEALER) for _ in range(CLIENTS_MAX + 1)]

        def ask(client: int) -> bytes:
            """Send a request; return the name of the connection on which it reaches the server."""
            clients[client].send(b"%d" % client)
            assert eventually(lambda: gateway.take() or server.poll(0)) and server.poll(1000.0 * WAIT_S)
            name, body = server.recv_multipart()
            assert body == b"%d" % client
            return bytes(name)

        for client in clients:
            client.connect(gateway.peers.endpoint)
        names = [ask(client) for client in range(CLIENTS_MAX)]
        assert ask(0) == names[0]
        names.append(ask(CLIENTS_MAX))
        assert len(set(names)) == CLIENTS_MAX + 1 and len(gateway.sockets) == CLIENTS_MAX
        assert [ask(client) for client in (0, CLIENTS_MAX, 2)] == [names[client] for client in (0, CLIENTS_MAX, 2)]
        assert ask(1) != names[1]


def test_a_key_that_floods_is_blocked(key_ring: KeyRing) -> None:
    key_ring.add("second", "readers")
    locked = ["--keys", str(key_ring.folder / "keys" / "server.key_secret")]
    locked += ["--readers", str(key_ring.folder / "readers")]
    firsts = itertools.count(0, 50)
    with (
        Publisher("tcp://127.0.0.1:*") as publisher,
        zmq.Context() as context,
        repeated(lambda: publisher.publish(synthetic(50, first_tick=next(firsts)))),
    ):
        with forwarding("--from", publisher.endpoint, "--to", "tcp://0.0.0.0:*", *locked) as (process, endpoint):
            reader = Listener(context, endpoint, key_ring.of("reader"))
            flood = Listener(context, endpoint, key_ring.of("second"))
            assert eventually(lambda: reader.look().messages > 100 and flood.look().messages > 100)
            topics = itertools.count()

            def flooded() -> bool:
                for number in itertools.islice(topics, 2 * SUBSCRIPTIONS_PER_S):
                    flood.socket.subscribe(f"topic {number}")
                return process.poll() is not None or bool(flood.look().away)

            assert eventually(flooded) and process.poll() is None
            assert "second is blocked" in next(line for line in process.stderr if "blocked" in line)
            count, reader_count = flood.messages, reader.look().messages
            assert eventually(lambda: reader.look().messages > reader_count + 500)
            assert flood.look().messages == count
        context.destroy(0)
