"""The asyncio client of a daemon's commands, exported by `softfinger.server.wire.control`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from functools import wraps
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Self

import zmq
import zmq.asyncio

from softfinger.server.keys import ClientKeys
from softfinger.server.wire.asking import (
    R,
    answer_in,
    asking,
    connected,
    default_commands,
    no_answer,
    result_of,
    time_for,
)
from softfinger.server.wire.commands import METHODS, Empty
from softfinger.server.wire.control import Control
from softfinger.server.wire.waits import milliseconds

P = ParamSpec("P")


def _awaited(
    command: Callable[Concatenate[Control, P], R],
) -> Callable[Concatenate[AsyncControl, P], Coroutine[Any, Any, R]]:
    """A command of Control for asyncio: it returns what `_ask` returns, which is to be awaited there."""

    @wraps(command)
    async def asked(self: AsyncControl, /, *args: P.args, **kwargs: P.kwargs) -> R:
        answer: Any = command(self, *args, **kwargs)  # type: ignore[arg-type]
        return await answer  # type: ignore[no-any-return]

    return asked


class AsyncControl:
    """A client for asyncio: any number of requests may wait for their answers. Use it with `async with`."""

    def __init__(
        self, endpoint: str | None = None, timeout_s: float | None = None, keys: ClientKeys | None = None
    ) -> None:
        self.endpoint, self.timeout_s = endpoint or default_commands(), timeout_s
        self._socket: zmq.asyncio.Socket = zmq.asyncio.Context.instance().socket(zmq.DEALER)
        connected(self._socket, self.endpoint, keys)
        self._waiting: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._reader: asyncio.Task[None] | None = None

    async def ask(self, method: str, params: Any = Empty()) -> Any:  # noqa: B008 - frozen
        """Any method by name; returns the result as it came."""
        return await self._ask(method, params, METHODS[method].result if method in METHODS else dict)

    async def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        wait_s = time_for(method, self.timeout_s)
        command_id, frames = asking(method, params, wait_s)
        answer = self._waiting[command_id] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(milliseconds(wait_s) / 1000.0):
                await self._socket.send_multipart(frames)  # which waits as long as there is nowhere to send to
                return result_of(await answer, kind)
        except TimeoutError:
            raise no_answer(method, self.endpoint, wait_s) from None
        finally:
            del self._waiting[command_id]

    async def _read(self) -> None:
        while True:
            answer = answer_in(await self._socket.recv_multipart())
            waiting = self._waiting.get(str(answer.get("command_id")))
            if waiting is not None and not waiting.done():
                waiting.set_result(answer)

    get_state = _awaited(Control.get_state)
    heartbeat = _awaited(Control.heartbeat)
    set_params = _awaited(Control.set_params)
    set_scene = _awaited(Control.set_scene)
    reset_world = _awaited(Control.reset_world)
    drive = _awaited(Control.drive)
    hand = _awaited(Control.hand)
    hold = _awaited(Control.hold)
    arm = _awaited(Control.arm)
    disarm = _awaited(Control.disarm)
    zero = _awaited(Control.zero)
    mark = _awaited(Control.mark)
    get_prompt = _awaited(Control.get_prompt)
    set_prompt = _awaited(Control.set_prompt)
    answer = _awaited(Control.answer)
    record_start = _awaited(Control.record_start)
    record_stop = _awaited(Control.record_stop)
    describe = _awaited(Control.describe)
    mesh = _awaited(Control.mesh)
    stop = _awaited(Control.stop)

    async def close(self) -> None:
        """Disconnect. Any number of times."""
        if self._reader is not None:
            self._reader.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._reader
            self._reader = None
        self._socket.close()

    async def __aenter__(self) -> Self:
        self._reader = asyncio.create_task(self._read())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
