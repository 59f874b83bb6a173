"""Commands to what does not answer: the clients wait for as long as they are told, and no longer."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from softfinger.server.wire.control import AsyncControl, Control, NoAnswer

WAIT_S = 0.05
ASKED = 5
"""Times: libzmq takes the first request before it has met the peer, and has nowhere to put one after it has."""


@pytest.fixture(params=["nobody", "publisher", "silent router"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """An address where no command is answered."""
    address = f"ipc://{tmp_path}/socket"
    kinds = {"publisher": zmq.XPUB, "silent router": zmq.ROUTER}
    if request.param not in kinds:
        yield address
        return
    with zmq.Context() as context, context.socket(kinds[request.param]) as peer:
        peer.linger = 0
        peer.bind(address)
        yield address


@pytest.mark.timeout(60)
def test_a_command_without_an_answer_ends(endpoint: str) -> None:
    """Also where libzmq has hung up on the peer, as it does on the telemetry's address."""
    with Control(endpoint, WAIT_S) as control:
        for _ in range(ASKED):
            with pytest.raises(NoAnswer, match=r"no answer to get_state from .* within 0\.05 s"):
                control.get_state()
            time.sleep(WAIT_S)


@pytest.mark.timeout(60)
def test_a_command_of_asyncio_without_an_answer_ends(endpoint: str) -> None:
    """The same, and the loop goes on meanwhile."""

    async def ask() -> None:
        async with AsyncControl(endpoint, WAIT_S) as control:
            for _ in range(ASKED):
                with pytest.raises(NoAnswer):
                    await control.get_state()
                await asyncio.sleep(WAIT_S)

    asyncio.run(ask())


@pytest.mark.timeout(60)
def test_more_requests_than_libzmq_keeps_end_each(tmp_path: Path) -> None:
    """It keeps a thousand for a peer that is not there."""
    with Control(f"ipc://{tmp_path}/nobody", 0.0) as control:
        for _ in range(1100):
            with pytest.raises(NoAnswer):
                control.get_state()
