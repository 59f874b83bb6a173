"""Commands without an answer: the clients wait for their time-out and no longer."""

import asyncio
import math
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq
from helpers.waits import eventually

from softfinger.config.errors import ConfigError
from softfinger.server.cli import main
from softfinger.server.remote import Client
from softfinger.server.wire import client_requests
from softfinger.server.wire import control as control_module
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.client_requests import NoAnswer
from softfinger.server.wire.control import AsyncControl, Control
from softfinger.server.wire.envelope import DeclinedRequest, parse

WAIT_S = 0.05
FORK_S = 60.0
"""Limit of each step of a forked process, and of the process: a deadlock ends in a failed test."""
ASKED = 5
"""Number of requests: libzmq accepts the first one before it has met the peer, and cannot queue one afterwards."""


@pytest.fixture(params=["nobody", "publisher", "silent router"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    address = f"ipc://{tmp_path}/socket"
    kinds = {"publisher": zmq.XPUB, "silent router": zmq.ROUTER}
    if request.param not in kinds:
        yield address
        return
    with zmq.Context() as context, context.socket(kinds[request.param]) as peer:
        peer.linger = 0
        peer.bind(address)
        yield address


@pytest.fixture
def router(tmp_path: Path) -> Iterator[zmq.Socket[bytes]]:
    """Socket of a daemon, at ipc://{tmp_path}/socket."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.linger, socket.rcvtimeo = 0, 10_000
        socket.bind(f"ipc://{tmp_path}/socket")
        yield socket


def answer_next(router: zmq.Socket[bytes], result: dict[str, int]) -> None:
    client, empty, body = router.recv_multipart()
    answer = {"command_id": msgpack.unpackb(body)["command_id"], "success": True, "result": result}
    router.send_multipart([client, empty, msgpack.packb(answer)])


def test_a_command_without_an_answer_ends(endpoint: str) -> None:
    """Also if libzmq has disconnected from the peer, as it does at the telemetry's address."""
    no_answer = pytest.raises(NoAnswer, match=r"no answer to `get_state` from .* within 0\.05 s")

    async def ask() -> None:
        async with AsyncControl(endpoint, WAIT_S) as control:
            for _ in range(ASKED):
                with no_answer:
                    await control.get_state()
                await asyncio.sleep(WAIT_S)

    with Control(endpoint, WAIT_S) as control:
        for _ in range(ASKED):
            with no_answer:
                control.get_state()
            time.sleep(WAIT_S)
    asyncio.run(ask())


def test_a_command_that_may_compile_first_checks_for_a_daemon(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async def ask() -> None:
        async with AsyncControl(endpoint) as control:
            with pytest.raises(NoAnswer, match=rf"no answer to `reset_world` from .* within {WAIT_S:g} s"):
                await control.reset_world()

    monkeypatch.setattr(client_requests, "TIMEOUT_S", WAIT_S)
    monkeypatch.setattr(control_module, "TIMEOUT_S", WAIT_S)
    with Control(endpoint) as control, pytest.raises(NoAnswer, match=rf"no answer to `set_scene` .* {WAIT_S:g} s"):
        control.set_scene("sphere")
    asyncio.run(ask())


def run_in_a_fork(act: Callable[[], None]) -> int:
    """Return the wait status of a forked process that runs `act`: 0 without an exception."""
    child = os.fork()
    if child == 0:
        signal.alarm(int(FORK_S))
        try:
            act()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(1)
    return os.waitpid(child, 0)[1]


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_clients_continue_in_a_forked_process(router: zmq.Socket[bytes], tmp_path: Path) -> None:
    commands, telemetry = f"ipc://{tmp_path}/socket", f"ipc://{tmp_path}/telemetry"
    event = msgpack.packb({"schema": 1, "kind": "mark", "name": "mark", "tick": 1, "timestamp": 1.0})
    over = threading.Event()

    def serve() -> None:
        with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
            publisher.linger = 0
            publisher.bind(telemetry)
            while not over.is_set():
                publisher.send_multipart([b"event", event])
                if router.poll(10):
                    answer_next(router, {"timeout_ms": 7})

    async def ask(control: AsyncControl) -> int:
        async with control:
            return (await control.heartbeat()).timeout_ms

    serving = threading.Thread(target=serve)
    serving.start()
    try:
        with Control(commands, FORK_S) as control, subscribe(telemetry, ["event"]) as samples:
            waiting = AsyncControl(commands, FORK_S)

            def use_all() -> None:
                assert control.heartbeat().timeout_ms == 7 and samples.receive(FORK_S) is not None

            def act() -> None:
                use_all()
                assert asyncio.run(ask(waiting)) == 7
                control.close()
                samples.close()

            use_all()
            assert run_in_a_fork(act) == 0
            use_all()
            assert asyncio.run(ask(waiting)) == 7
    finally:
        over.set()
        serving.join()


def test_each_of_many_clients_of_a_publisher_ends(tmp_path: Path) -> None:
    """libzmq may disconnect at any moment after `connect`, also between polling and sending."""
    with zmq.Context() as context, context.socket(zmq.PUB) as peer:
        peer.linger = 0
        peer.bind(f"ipc://{tmp_path}/socket")
        for _ in range(300):
            with Control(f"ipc://{tmp_path}/socket", 0.003) as control:
                for _ in range(2):
                    with pytest.raises(NoAnswer):
                        control.get_state()


def test_more_requests_than_the_queue_of_libzmq_all_end(tmp_path: Path) -> None:
    """libzmq queues a thousand for a missing peer."""
    with Control(f"ipc://{tmp_path}/nobody", 0.0) as control:
        for _ in range(1100):
            with pytest.raises(NoAnswer):
                control.get_state()


def first_request(peer: zmq.Socket[bytes], ask: Callable[[float], object]) -> bytes:
    """Ask with longer and longer time-outs until a request arrives: a client that gives up discards it."""
    wait_s = WAIT_S
    while not peer.poll(0):
        ask(wait_s)
        wait_s *= 2.0
    return peer.recv_multipart()[-1]


@pytest.mark.parametrize("client", [Control, AsyncControl])
def test_a_request_has_an_expiry_time(client: type, router: zmq.Socket[bytes], tmp_path: Path) -> None:
    async def ask_async(wait_s: float) -> None:
        async with AsyncControl(f"ipc://{tmp_path}/socket", wait_s) as control:
            with pytest.raises(NoAnswer):
                await control.arm()

    def ask(wait_s: float) -> None:
        with Control(f"ipc://{tmp_path}/socket", wait_s) as control, pytest.raises(NoAnswer):
            control.arm()

    body = first_request(router, ask if client is Control else lambda wait_s: asyncio.run(ask_async(wait_s)))
    request = msgpack.unpackb(body)
    boot, until = request["expires"]
    assert eventually(lambda: time.monotonic() > until)  # it is computed after the start of the client's time-out
    with pytest.raises(DeclinedRequest, match=r"^expired: .* nothing was done"):
        parse(body)
    for expires in ([boot, until + 3600.0], ["another boot", until], None):
        assert parse(msgpack.packb(request | {"expires": expires})).method == "arm"


@pytest.mark.parametrize("wait_s", [math.inf, 3e6, 1e300])
def test_a_time_out_may_be_arbitrarily_long(wait_s: float, router: zmq.Socket[bytes], tmp_path: Path) -> None:
    async def ask() -> None:
        async with AsyncControl(f"ipc://{tmp_path}/socket", wait_s) as control:
            assert await control.ask("heard") == {"number": 1}

    with ThreadPoolExecutor() as pool, Control(f"ipc://{tmp_path}/socket", wait_s) as control:
        serving = pool.submit(answer_next, router, {"number": 1})
        asyncio.run(ask())
        serving.result()
        serving = pool.submit(answer_next, router, {"number": 2})
        assert control.ask("heard") == {"number": 2}
        serving.result()


def test_an_invalid_request_is_refused_before_sending(tmp_path: Path) -> None:
    with Control(f"ipc://{tmp_path}/nobody", 0.0) as control:
        for data, message in (
            ({"a": "y" * 300_000}, "a request of 300... bytes: a daemon accepts at most 262144"),
            ({"a": 10**30}, "mark: cannot be sent: "),
            ({"a": "\udcff"}, "mark: cannot be sent: "),
            ({"a": object()}, "use numbers, texts, lists and mappings"),
        ):
            with pytest.raises(ConfigError, match=message):
                control.mark("x", data)
        with pytest.raises(NoAnswer):
            control.mark("x", {"a": np.float64(1.0), "b": np.zeros(3)})
    with pytest.raises(ConfigError, match="timeout_s = nan: must be a number"):
        Control(f"ipc://{tmp_path}/nobody", math.nan)


@pytest.mark.parametrize("program", ["client", "ctl"])
def test_disarm_is_sent_before_the_daemon_is_searched_or_verified(program, router, tmp_path):
    port = router.bind_to_random_port("tcp://127.0.0.1")
    router.bind(f"ipc://{tmp_path}/t.commands")

    def by_client(wait_s: float) -> None:
        with Client(f"ipc://{tmp_path}/t", timeout_s=wait_s) as client, pytest.raises(NoAnswer):
            client.disarm()

    def by_ctl(wait_s: float) -> None:
        words = ["ctl", "--endpoint", f"tcp://127.0.0.1:{port}", "--timeout", str(wait_s), "disarm"]
        assert main(words) == NoAnswer.exit_code

    assert parse(first_request(router, by_client if program == "client" else by_ctl)).method == "disarm"
