"""Requests that arrive while the daemon starts, for example while it compiles: they are answered once it runs."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from helpers.waits import WAIT_S, eventually
from test_commands_at_once import make_daemon

from softfinger.server.app import Daemon
from softfinger.server.loop.switch_fields import STOPS_RECEIVED
from softfinger.server.socket_process.command_clients import BUSY_MESSAGE, QUEUED_MAX
from softfinger.server.socket_process.process import UNANSWERED_MAX
from softfinger.server.wire.client_requests import encode_request
from softfinger.server.wire.control import Control
from softfinger.server.wire.process_link import RequestHandlers

pytestmark = pytest.mark.real_time

REQUESTS: dict[str, dict[str, Any]] = {"mark": {"label": "early"}, "describe": {}, "get_state": {}, "disarm": {}}


@contextmanager
def connected(folder: Path) -> Iterator[tuple[Daemon, zmq.Socket[bytes]]]:
    """Yield a daemon before its start, and a client of its commands."""
    with (
        pytest.MonkeyPatch.context() as patch,
        make_daemon(patch, folder) as daemon,
        zmq.Context() as context,
        context.socket(zmq.DEALER) as client,
    ):
        client.linger = 0
        client.connect(daemon.commands_endpoint)
        yield daemon, client


def send(client: zmq.Socket[bytes], method: str, params: dict[str, Any] | None = None) -> None:
    client.send_multipart([b"", msgpack.packb({"command_id": method, "method": method, "params": params or {}})])


def wait_for_stop(daemon: Daemon) -> None:
    """Wait until a request that turns the force off has arrived."""
    assert eventually(lambda: daemon.servo.switch[STOPS_RECEIVED] == 1)


def assert_without_force(daemon: Daemon) -> None:
    """Assert that no force is displayed after the start."""
    assert eventually(lambda: daemon.servo.ticks > 300)  # the ramp takes 10
    assert not daemon.devices[0].wrenches.any()


@contextmanager
def starting(folder: Path, requests: dict[str, dict[str, Any]]) -> Iterator[tuple[Daemon, dict[str, bool]]]:
    """Send requests to a daemon, then start it; yield it, and the success of each request."""
    with connected(folder) as (daemon, client):
        for method, params in requests.items():
            send(client, method, params)
        wait_for_stop(daemon)  # the last one
        daemon.start()
        answers = dict[str, bool]()
        while len(answers) < len(requests) and client.poll(1000.0 * WAIT_S):
            answer = msgpack.unpackb(client.recv_multipart()[1])
            answers[answer["command_id"]] = answer["success"]
        yield daemon, answers
        daemon.stop()
        assert daemon.wait(WAIT_S) and not daemon.devices[0].wrenches.any()


def test_requests_before_the_start_are_answered(tmp_path: Path) -> None:
    with starting(tmp_path, REQUESTS) as (daemon, answers):
        assert answers.keys() == REQUESTS.keys()
        assert answers["mark"] and answers["describe"] and answers["disarm"]
        assert_without_force(daemon)


def test_a_stop_before_the_start_ends_the_run(tmp_path: Path) -> None:
    with starting(tmp_path, {"stop": {}}) as (daemon, answers):
        assert answers == {"stop": True}
        assert daemon.wait(WAIT_S)


def test_a_disarm_before_the_start_does_not_expire(tmp_path: Path) -> None:
    """Its client waits for a shorter time than a compilation takes; the force must nevertheless be off."""
    with connected(tmp_path) as (daemon, client):
        client.send_multipart(encode_request("mark", {"label": "early"}, 0.0)[1])
        client.send_multipart(encode_request("disarm", {}, 0.0)[1])
        wait_for_stop(daemon)
        daemon.start()
        answers = [msgpack.unpackb(client.recv_multipart()[1]) for _ in range(2)]
        assert sorted(answer["error"] or "" for answer in answers)[1].startswith("expired: ")
        assert [answer["result"] for answer in answers if answer["success"]] == [{"armed": False}]
        assert_without_force(daemon)


def test_a_kill_of_the_commands_process_loses_no_disarm(tmp_path: Path) -> None:
    with connected(tmp_path) as (daemon, client):
        send(client, "disarm")
        wait_for_stop(daemon)
        os.kill(daemon.publisher.pids["commands"], signal.SIGKILL)
        assert eventually(lambda: daemon.publisher.restarts == 1)
        daemon.start()
        assert_without_force(daemon)
        with Control(daemon.commands_endpoint, WAIT_S) as control:
            control.arm()
            assert eventually(lambda: daemon.devices[0].wrenches[-1].any())


def test_a_flood_does_not_delay_a_disarm(tmp_path: Path) -> None:
    """Nothing is answered before the start, so the flood remains in the process that receives it."""
    with connected(tmp_path) as (daemon, flood), Control(daemon.commands_endpoint) as second:
        for _ in range(QUEUED_MAX + UNANSWERED_MAX):
            send(flood, "get_state")
        second.post("disarm")
        wait_for_stop(daemon)
        assert flood.poll(1000.0 * WAIT_S)
        answer = {"command_id": "get_state", "success": False, "result": {}, "error": BUSY_MESSAGE}
        assert msgpack.unpackb(flood.recv_multipart()[1]) == answer


def test_requests_are_answered_in_their_order(tmp_path: Path) -> None:
    """Otherwise an `arm` of the start could follow a later `disarm`."""
    with connected(tmp_path) as (daemon, client):
        for _ in range(8):
            received = list[bytes]()
            client.send_multipart([b"", b"before"])
            assert not client.poll(100)  # it has arrived
            daemon.publisher.commands.serve(
                RequestHandlers(lambda _, body, received=received: received.append(body), lambda: None)
            )
            client.send_multipart([b"", b"after"])
            assert eventually(lambda received=received: len(received) == 2)
            daemon.publisher.commands.serve(None)
            assert received == [b"before", b"after"]
