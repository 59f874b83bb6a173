"""Command service: receives, queues and answers the requests of the command endpoint.

The thread that serves the publisher receives requests. It answers the methods URGENT_METHODS, which turn the force off
or keep it on; these read no file and never wait. Another thread answers all other methods in order of arrival, so that
they do not delay `disarm`. A third thread (`scene_changes.py`) reads, compiles and answers `set_scene`.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from functools import partial
from queue import SimpleQueue
from typing import Any, Final

from softfinger.config.errors import ConfigError, HapticError, SafetyStop
from softfinger.drivers import switch_interval
from softfinger.server.loop import shutdown
from softfinger.server.services.base import JOIN_S
from softfinger.server.services.command_handlers import CommandHandlers, DaemonInterface
from softfinger.server.services.rendering import Rendering, SceneReplacement
from softfinger.server.services.scene_changes import CompilerFailure, SupersededRequest
from softfinger.server.socket_process.force_off import SHORT_REQUEST_BYTES
from softfinger.server.states import NO_HEARTBEAT_REASON, UNREACHABLE_REASON
from softfinger.server.wire.envelope import DeclinedRequest, Request, encode_answer, encode_refusal, parse
from softfinger.server.wire.process_link import RequestHandlers

log: Final = logging.getLogger(__name__)

LOG_PERIOD_S: Final = 10.0

URGENT_METHODS: Final = frozenset({"get_state", "heartbeat", "arm", "disarm", "zero", "stop"})
"""Methods answered before all others. Requests longer than SHORT_REQUEST_BYTES are none of these: they are queued
before they are decoded, which takes milliseconds."""
WAITING_MAX: Final = 100
"""Largest number of queued requests of a client; further ones are answered with `busy`."""
REST_MAX_S: Final = 0.1
"""Longest pause after a queued request: queued requests use at most half of a processor."""
DEFERRED: Final = frozenset({"set_scene", "reset_world"})
"""Methods that compile, and are answered by another thread."""
START_S: Final = 60.0
"""Time for which the start waits for the process that receives requests; it takes half a second, or several."""
POLL_S: Final = 0.005


class CommandService:
    """Service that answers the requests of an endpoint."""

    def __init__(self, endpoint: str, rendering: Rendering, daemon: DaemonInterface, scene_name: str) -> None:
        self._handlers: Final = CommandHandlers(endpoint, rendering, daemon, scene_name)
        self.sink: Final = self._handlers.sink
        self._rendering, self._daemon = rendering, daemon
        assert daemon.publisher.commands is not None
        self._process: Final = daemon.publisher.commands
        self._heartbeat_s = rendering.rig.commands.heartbeat_s
        self._started = False
        self._last_request_s = 0.0
        self._logged_s = -LOG_PERIOD_S
        self._queue: Final = SimpleQueue[tuple[bytes, Request | bytes, float] | None]()
        """Client, request, and the time of its arrival, s on the monotonic clock."""
        self._pending_counts: Final = Counter[bytes]()
        """Number of requests of each client in `_queue` or being answered; protected by `_counts_lock`."""
        self._counts_lock = threading.Lock()
        self._thread = threading.Thread(target=self._run_queue, name="commands", daemon=True)

    def start(self) -> None:
        switch_interval.shorten()
        self._started = True
        self._handlers.scenes.start()
        self._thread.start()
        self._note_alive(time.monotonic())
        self._process.serve(RequestHandlers(self._receive, self._check_periodically))
        self._await_process()

    def _await_process(self) -> None:
        """Wait until requests are received, as there is no force before; raises SafetyStop if this takes too long.

        A stop, and a process that cannot be started, end the run after the start.
        """
        until, rendering = time.monotonic() + START_S, self._rendering
        while not (rendering.force.is_reachable or rendering.servo.shared.stop[0] or self._daemon.publisher.has_failed):
            if time.monotonic() > until:
                raise SafetyStop(
                    f"the process that receives commands is not ready after {START_S:g} s: no command could stop the "
                    "force; end other work, then start again"
                )
            time.sleep(POLL_S)

    def stop(self) -> None:
        restore = [switch_interval.restore] if self._started else []
        self._started = False
        steps = self._handlers.scenes.stop, self._stop_queue, lambda: self._process.serve(None), *restore
        shutdown.complete_all_steps(*steps)

    def _stop_queue(self) -> None:
        self._queue.put(None)
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)

    def _receive(self, client: bytes, body: bytes) -> bytes | None:
        """Answer a request, or queue it; never waits."""
        command_id, arrived_s = "", time.monotonic()
        try:
            if len(body) > SHORT_REQUEST_BYTES:
                self._enqueue(client, body, arrived_s)
                return None
            request = self._parse(body, arrived_s)
            command_id = request.command_id
            if request.method in URGENT_METHODS:
                return self._handle(request)
            self._enqueue(client, request, arrived_s)
            return None
        except Exception as error:
            return encode_refusal(self._as_declined(error), command_id)

    def _parse(self, body: bytes, arrived_s: float) -> Request:
        """Return the parsed request and count it as a sign of life at its arrival; raises DeclinedRequest."""
        request = parse(body)
        self._check_heartbeat()  # a heartbeat missed before this request counts as missed
        self._note_alive(arrived_s)
        return request

    def _note_alive(self, arrived_s: float) -> None:
        self._last_request_s = max(self._last_request_s, arrived_s)
        if self._heartbeat_s is not None:
            self._rendering.force.set_deadline(round(1e9 * (self._last_request_s + self._heartbeat_s)))

    def _enqueue(self, client: bytes, message: Request | bytes, arrived_s: float) -> None:
        with self._counts_lock:
            if self._pending_counts[client] >= WAITING_MAX:
                raise DeclinedRequest("busy", "too many requests of this client are waiting: wait for answers first")
            self._pending_counts[client] += 1
        self._queue.put((client, message, arrived_s))

    def _run_queue(self) -> None:
        """Answer queued requests one after the other; runs in its own thread."""
        while (item := self._queue.get()) is not None:
            started = time.monotonic()
            client = item[0]
            answer = self._answer_queued(*item)
            if answer is not None:
                self._process.reply(client, answer)
            with self._counts_lock:
                self._pending_counts[client] -= 1
                if not self._pending_counts[client]:
                    del self._pending_counts[client]
            time.sleep(min(time.monotonic() - started, REST_MAX_S))

    def _answer_queued(self, client: bytes, message: Request | bytes, arrived_s: float) -> bytes | None:
        command_id = ""
        try:
            request = self._parse(message, arrived_s) if isinstance(message, bytes) else message
            command_id = request.command_id
            if request.method in DEFERRED:
                getattr(self._handlers, request.method)(request, partial(self._reply, client, command_id))
                return None
            return self._handle(request)
        except Exception as error:
            return encode_refusal(self._as_declined(error), command_id)

    def _handle(self, request: Request) -> bytes:
        return encode_answer(request.command_id, getattr(self._handlers, request.method)(request))

    def _reply(self, client: bytes, command_id: str, outcome: Any) -> None:
        if isinstance(outcome, Exception):
            answer = encode_refusal(self._as_declined(outcome), command_id)
        else:
            answer = encode_answer(command_id, outcome)
        self._process.reply(client, answer)

    def _as_declined(self, error: Exception) -> DeclinedRequest:
        match error:
            case DeclinedRequest():
                return error
            case SupersededRequest():
                return DeclinedRequest("superseded", str(error))
            case CompilerFailure():
                return DeclinedRequest("failed", str(error))
            case ConfigError():
                return DeclinedRequest("bad_params", str(error))
            case SceneReplacement():
                return DeclinedRequest("busy", str(error))
            case HapticError():
                return DeclinedRequest("refused", str(error))
            case OSError() | MemoryError():  # out of file descriptors, processes, memory or disk space
                return DeclinedRequest("refused", f"the system refused: {error or 'out of memory'}")
        if time.monotonic() - self._logged_s > LOG_PERIOD_S:  # rarely, because a client must not fill the log
            self._logged_s = time.monotonic()
            log.error("a command failed", exc_info=error)
        return DeclinedRequest("failed", f"{type(error).__name__}: {error}"[:500])

    def _check_periodically(self) -> None:
        try:
            self._check_heartbeat()
            self._rendering.force.note_guard(UNREACHABLE_REASON, not self._rendering.force.is_reachable)
        except Exception as error:
            log.exception("commands failed")
            self._process.serve(None)
            self._daemon.event("fault", "commands", message=str(error))
            self._daemon.fail(SafetyStop(f"commands cannot be received: {error}; the heartbeat cannot be checked"))

    def _check_heartbeat(self) -> None:
        """Record a missed heartbeat, if it is missed.

        The loop has already turned the force off, and the next request does not turn it on again.
        """
        if self._heartbeat_s is None or time.monotonic() - self._last_request_s <= self._heartbeat_s:
            return
        if not self._rendering.force.is_inhibited_by(NO_HEARTBEAT_REASON):
            self._rendering.disarm(NO_HEARTBEAT_REASON)
            log.warning(
                "commands: none for %.2f s: zero force until the next heartbeat",
                time.monotonic() - self._last_request_s,
            )
            self._handlers.publish_change("heartbeat_missed", "", {"after_s": self._heartbeat_s})
