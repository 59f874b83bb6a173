"""Order and limits of the requests that wait for the daemon."""

from __future__ import annotations

import msgpack
import pytest

from softfinger.server.socket_process.clients import (
    BUSY_MESSAGE,
    CLIENTS_MAX,
    QUEUED_BYTES_MAX,
    QUEUED_MAX,
    RequestQueue,
    encode_busy,
)

pytestmark = pytest.mark.plain

DISARM = msgpack.packb({"command_id": "a", "method": "disarm"})


def test_clients_take_turns() -> None:
    queue = RequestQueue()
    for client, body in ((b"a", b"1"), (b"a", b""), (b"a", b"3"), (b"b", b"4")):
        assert queue.add(client, body, False)
    assert [queue.pop() for _ in range(len(queue))] == [(b"a", b"1"), (b"b", b"4"), (b"a", b""), (b"a", b"3")]
    assert not queue


@pytest.mark.parametrize(("count", "body"), [(QUEUED_MAX, b""), (1, bytes(QUEUED_BYTES_MAX))])
def test_a_full_queue_refuses_only_clients_that_have_requests_in_it(count: int, body: bytes) -> None:
    queue = RequestQueue()
    assert all(queue.add(b"a", body, False) for _ in range(count))
    assert not queue.add(b"a", b"", False) and not queue.add(b"b", b"", True)
    others = [bytes([1, number // 256, number % 256]) for number in range(1, CLIENTS_MAX)]
    assert all(queue.add(other, b"", False) for other in others)
    assert not queue.add(b"b", b"", False)
    for _ in range(2):  # of the first client, which may have further ones, and of the second
        queue.pop()
    assert len(queue) == count + len(others) - 2
    assert queue.add(b"b", b"", False)


def test_a_request_that_turns_the_force_off_is_accepted_despite_a_flood() -> None:
    queue = RequestQueue()
    assert all(queue.add(b"a", b"", False) for _ in range(QUEUED_MAX))
    assert all(queue.add(b"a", DISARM, True) for _ in range(QUEUED_MAX))
    assert not queue.add(b"a", DISARM, False)
    assert queue.add(b"b", DISARM, True)


def test_a_refusal_has_the_id_of_its_request() -> None:
    def answered(body: bytes) -> str:
        answer = msgpack.unpackb(encode_busy(body))
        assert answer == {"command_id": answer["command_id"], "success": False, "result": {}, "error": BUSY_MESSAGE}
        return str(answer["command_id"])

    assert answered(DISARM) == "a"
    for body in (b"", b"\xc1", b"\x91" * 3000, msgpack.packb({"command_id": 1}), msgpack.packb({"a": 1})):
        assert answered(body) == ""
    assert answered(msgpack.packb({"command_id": 129 * "x"})) == ""
