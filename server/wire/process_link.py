"""Process with ZeroMQ sockets, as the daemon uses it: started, restarted if it exits, and exchanging messages with it.

A single thread monitors it and receives the requests of its clients. No other thread waits for it: messages to it are
queued or dropped while it is restarted or does not read.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import FileIO
from typing import Final, NamedTuple

import msgspec

from softfinger.server.socket_process.channel import Channel, Message
from softfinger.server.socket_process.channel_messages import REST_MAX_S, Figures, Kind

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 0.02
"""Interval of calls of `each_period` without requests."""
STABLE_S: Final = 10.0
"""A process that has run for this long is restarted without a pause."""
PAUSE_S: Final = 0.1
PAUSE_MAX_S: Final = 1.0
"""Pause before a restart: doubled each time the process exits early, up to this. Clients get no answer meanwhile."""
LOG_PERIOD_S: Final = 10.0
"""Shortest interval of log messages about peers: a peer must not fill the log."""
RECONNECT_S: Final = 1.0
"""Time after a new process is ready until subscribers have reconnected, and can receive an event about it."""
EXIT_TIMEOUT_S: Final = 1.0
"""Time after a request to end until the process is killed."""
SILENT_MAX_S: Final = 2.0
"""Time without a message, of which there is one in each PERIOD_S of the process, after which it hangs."""
ERRORS_MAX: Final = 4096
"""Largest part of the standard error of a process that is logged, bytes."""
MODULE: Final = "softfinger.server.socket_process"
NO_CLIENT: Final = b"\0"
"""Name of no client, which gets no answer."""
STOP_SIGNALS: Final = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
"""Signals that the daemon handles, and that may also be sent to all its processes, such as by systemd."""
Send = Callable[[Kind, bytes, bytes], object]
"""Function that sends a message: kind, key and body."""


@contextmanager
def block_stop_signals() -> Iterator[None]:
    """Block STOP_SIGNALS in this thread, and so in processes that it starts, from their first instruction on."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class RequestHandlers(NamedTuple):
    """Handlers of requests; both are called in the thread of the link, and must not raise.

    answer       is called with a client and its request (empty: not two frames); returns the answer, or None if `reply`
                 sends it later; must not wait
    each_period  is called every PERIOD_S or sooner
    """

    answer: Callable[[bytes, bytes], bytes | None]
    each_period: Callable[[], None]


class SocketProcess:
    """Process with ZeroMQ sockets, from construction until `close`.

    name          of its endpoints: telemetry or commands
    setup         sends a new process its setup, and the messages that it needs after that
    files         file descriptors that the process inherits
    event         is called with a description of each failure of the process
    on_handled    is called with each request that was answered or queued
    on_exit       is called when the process exits; returns requests to handle in place of those that it did not pass on
    silent_max_s  time without a message, s, after which a process that was ready is killed
    """

    def __init__(
        self,
        name: str,
        setup: Callable[[Send], None],
        files: list[int],
        event: Callable[[str], None],
        on_handled: Callable[[bytes], None] = lambda body: None,
        on_exit: Callable[[], list[bytes]] = list,
        silent_max_s: float = math.inf,
    ) -> None:
        self.name: Final = name
        self._setup, self._files, self._event = setup, list(files), event
        self._on_handled, self._on_exit, self._silent_max_s = on_handled, on_exit, silent_max_s
        self._handlers: RequestHandlers | None = None
        self._requests: list[Message] = []
        """Requests to be answered, in their order. Without handlers they wait; the process limits their number."""
        self._earlier_figures, self._present_figures = Figures(), Figures()
        self._logged, self._logged_s = Figures(), -LOG_PERIOD_S
        self._started_s = 0.0
        self._received_s = math.inf
        """Time of the last message of the process; infinite before the first."""
        self._pause_s = 0.0
        self._ready = self._restart_failed = False
        """`_ready`: a process has been ready. `_restart_failed`: a restart failed, and was reported."""
        self.restarts = 0
        self._restart_reports: list[str] = []
        """Texts about restarts, published when the process is ready: before that, it would drop the event."""
        self._delayed_events: list[tuple[float, str]] = []
        """Events about the process, with the time at which to send them."""
        self.failed = False
        """The process cannot be started, or the thread that monitors it has failed."""
        self._until_s: float | None = None
        self._replacing = threading.Lock()
        """Locked while one process replaces another, so that a message is sent to the new one."""
        self._process, self._channel, self._errors = self._start()
        self._thread = threading.Thread(target=self._run, name=f"{name} process", daemon=True)
        self._thread.start()

    def send(self, kind: Kind, key: bytes = b"", body: bytes = b"") -> bool:
        """Send a message to the process, from any thread; False if it is dropped."""
        with self._replacing:
            return self._channel.send(kind, key, body)

    def reply(self, client: bytes, body: bytes) -> None:
        """Send a deferred answer to a client; from any thread. It is dropped if the client has disconnected."""
        self.send(Kind.DEFERRED_ANSWER, client, body)

    def serve(self, handlers: RequestHandlers | None) -> None:
        """Set the handlers of requests, also of earlier ones; None: requests wait until there are handlers again."""
        self._handlers = handlers

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def figures(self) -> Figures:
        """Totals of all processes so far, and the present number of subscribers."""
        before, now = self._earlier_figures, self._present_figures
        return Figures(
            now.subscribers, before.lost + now.lost, before.refused + now.refused, before.missed + now.missed
        )

    def close(self, linger_s: float) -> None:
        """End the process after it has sent its queued messages, for at most `linger_s`. Call it once."""
        self.send(Kind.END)
        self._until_s = time.monotonic() + linger_s + EXIT_TIMEOUT_S
        self._thread.join(linger_s + 2.0 * EXIT_TIMEOUT_S)

    def _is_ending(self) -> bool:
        return self._until_s is not None

    def _start(self) -> tuple[subprocess.Popen[bytes], Channel, FileIO]:
        with ExitStack() as undo:
            own_end, child_end = map(undo.enter_context, socket.socketpair())
            # A separate session: Ctrl-C and the end of a terminal are handled by the daemon; this process ends with the
            # channel.
            # Standard error in memory: a pipe without a reader would block the process in its last message.
            errors = undo.enter_context(open(os.memfd_create("softfinger-errors"), "r+b", buffering=0))
            with block_stop_signals():
                process = subprocess.Popen(
                    [sys.executable, "-m", MODULE, self.name, str(child_end.fileno())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=errors,
                    start_new_session=True,
                    pass_fds=[child_end.fileno(), *self._files],
                )
            child_end.close()
            undo.pop_all()
        self._started_s, self._received_s = time.monotonic(), math.inf
        channel = Channel(own_end)
        self._setup(channel.send)
        return process, channel, errors

    def _run(self) -> None:
        try:
            while True:
                start_s, request_wait_s, handlers = time.monotonic(), self._poll(), self._handlers
                if handlers is not None:
                    requests, self._requests = self._requests, []
                    for message in requests:
                        self._answer(handlers, message)
                    handlers.each_period()
                if self._channel.ended and not self._restart():
                    return
                is_late = self._until_s is not None and start_s >= self._until_s
                if is_late or start_s - self._received_s > self._silent_max_s:
                    self._process.kill()
                self._log_figures(start_s)
                while self._delayed_events and start_s >= self._delayed_events[0][0]:
                    self._event(self._delayed_events.pop(0)[1])
                # A flood uses at most half of a processor, so that the readers of the servo have the other half.
                if request_wait_s:
                    time.sleep(min(time.monotonic() - start_s - request_wait_s, REST_MAX_S))
        except Exception:
            self.failed = True
            log.exception("the thread that monitors the %s process failed", self.name)
        finally:
            self._process.kill()
            self._process.wait()
            self._channel.close()
            self._errors.close()

    def _poll(self) -> float:
        """Wait for messages and handle them; return the time waited, s, or 0.0 if none was a request."""
        poller = select.poll()
        poller.register(self._channel.fileno(), select.POLLIN | (select.POLLOUT if self._channel.has_queued else 0))
        start_s = time.monotonic()
        poller.poll(PERIOD_S * 1000.0)
        waited_s, has_request = time.monotonic() - start_s, False
        self._channel.flush()
        for message in self._channel.receive():
            self._received_s = time.monotonic()
            has_request = self._take(message) or has_request
        return waited_s if has_request else 0.0

    def _take(self, message: Message) -> bool:
        match message.kind:
            case Kind.READY:
                self._ready = True
                due_s = time.monotonic() + RECONNECT_S
                self._delayed_events += [(due_s, text) for text in self._restart_reports]
                self._restart_reports.clear()
            case Kind.FIGURES:
                self._present_figures = msgspec.msgpack.decode(message.body, type=Figures)
            case Kind.LOG:
                log.warning("%s", message.body.decode(errors="replace"))
            case Kind.REQUEST:
                self._requests.append(message)
                return True
        return False

    def _answer(self, handlers: RequestHandlers, message: Message) -> None:
        answer = handlers.answer(message.key, message.body)
        is_sent = message.key == NO_CLIENT or (
            answer is not None and self._channel.send(Kind.ANSWER, message.key, answer)
        )
        if not is_sent:
            self._channel.send(Kind.DEFERRED, message.key)
        self._on_handled(message.body)

    def _restart(self) -> bool:
        """Start another process after one has exited; return False if none is needed."""
        self._on_exit()  # immediately, and again when the process can receive no more requests
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(EXIT_TIMEOUT_S)
        self._process.kill()
        code = self._process.wait()
        self._log_errors()
        if self._is_ending():
            return False
        if not self._ready:
            log.error("the %s process has ended with code %d before it was ready", self.name, code)
            self.failed = True
            return False
        self._channel.close()
        self._requests = [Message(Kind.REQUEST, NO_CLIENT, body) for body in self._on_exit()]
        effect = "; zero force until `arm`" if self._requests else ""
        self._earlier_figures, self._present_figures = msgspec.structs.replace(self.figures, subscribers=0), Figures()
        if time.monotonic() - self._started_s > STABLE_S:
            self._pause_s = 0.0
        else:
            self._lengthen_pause()
        while not self._start_next():
            self._lengthen_pause()
        if self._is_ending():
            return False
        self.restarts += 1
        text = f"the {self.name} process has ended with code {code} and was restarted: its peers reconnect{effect}"
        log.error("%s", text)
        self._restart_reports.append(text)
        return True

    def _log_errors(self) -> None:
        """Log the last part of the standard error of the process, and free its memory."""
        with self._errors:
            self._errors.seek(max(0, os.fstat(self._errors.fileno()).st_size - ERRORS_MAX))
            if text := self._errors.read().decode(errors="replace").strip():
                log.error("the %s process: %s", self.name, text)

    def _lengthen_pause(self) -> None:
        self._pause_s = min(2.0 * self._pause_s or PAUSE_S, PAUSE_MAX_S)

    def _start_next(self) -> bool:
        """Wait for the pause, then start a process unless the link is closing; return False if that fails."""
        due_s = time.monotonic() + self._pause_s
        while time.monotonic() < due_s and not self._is_ending():
            if (handlers := self._handlers) is not None:
                handlers.each_period()
            time.sleep(PERIOD_S)
        if self._is_ending():
            return True
        try:
            with self._replacing:
                self._process, self._channel, self._errors = self._start()
        except OSError as error:  # no file descriptor, process or memory is left
            if not self._restart_failed:
                self._restart_failed = True
                text = f"the {self.name} process cannot be started: {error}; retrying at least every {PAUSE_MAX_S:g} s"
                log.error("%s", text)
                self._event(text)
            return False
        self._restart_failed = False
        return True

    def _log_figures(self, now_s: float) -> None:
        figures = self.figures
        if now_s - self._logged_s < LOG_PERIOD_S or (figures.lost, figures.refused) == (
            self._logged.lost,
            self._logged.refused,
        ):
            return
        if figures.lost != self._logged.lost:
            log.warning("telemetry: subscribers were too slow %d times so far and lost messages", figures.lost)
        if figures.refused != self._logged.refused:
            log.warning("connections refused, or closed before their handshake, so far: %d", figures.refused)
        self._logged, self._logged_s = figures, now_s
