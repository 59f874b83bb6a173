"""Commands of the page: a daemon that is slow to answer one command gets the others."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import msgpack
import pytest
import zmq

from softfinger.server.gateway.addresses import Addresses
from softfinger.server.viewer.live import LivePage
from softfinger.server.viewer.page import Page

pytestmark = pytest.mark.real_time

WAIT_MS = 60_000


def test_the_force_is_switched_off_while_no_other_command_is_answered(tmp_path: Path) -> None:
    """The daemon gets `disarm` by a connection on which no other request of the page waits for its answer."""
    endpoint = f"ipc://{tmp_path}/commands"
    with (
        zmq.Context() as context,
        context.socket(zmq.ROUTER) as daemon,
        closing(Page("127.0.0.1", 0)) as page,
        closing(LivePage(page, Addresses(f"ipc://{tmp_path}/telemetry", endpoint))) as live,
    ):
        daemon.linger = 0
        daemon.bind(endpoint)
        live._request_description()
        live._reset_world()
        received = dict[str, bytes]()
        while not {"reset_world", "get_prompt"} <= received.keys():
            assert daemon.poll(WAIT_MS), received
            client, _, body = daemon.recv_multipart()
            request = msgpack.unpackb(body)
            received[request["method"]] = client
            if request["method"] == "get_state":  # a request that may take minutes first checks for a daemon
                refusal = {"command_id": request["command_id"], "success": False, "result": None, "error": "refused: "}
                daemon.send_multipart([client, b"", msgpack.packb(refusal)])
        live._switch_force(SimpleNamespace(target=SimpleNamespace(value="off")))
        while "disarm" not in received:
            assert daemon.poll(WAIT_MS), received
            client, _, body = daemon.recv_multipart()
            received[msgpack.unpackb(body)["method"]] = client
        assert list(received.values()).count(received["disarm"]) == 1
