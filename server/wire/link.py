"""The daemon's side of the publisher process: starts it, exchanges messages with it, and restarts it if it exits.

A single thread monitors it and receives the requests of its clients. No other thread waits for it: messages to it are
queued or dropped while it is restarted or does not read.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final, NamedTuple

import msgspec

from softfinger.server.publishing.channel import Channel, Said
from softfinger.server.publishing.setup import Figures, Kind, Setup

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 0.02
"""Interval of calls of `each_period` without requests."""
REST_MAX_S: Final = 0.002
"""Longest pause after requests were received; slow requests are queued for another thread."""
SOUND_S: Final = 10.0
"""A process that has run for this long is restarted without a pause."""
PAUSE_S: Final = 0.1
PAUSE_MAX_S: Final = 5.0
"""Pause before a restart: doubled each time the process exits early, up to this."""
LOG_PERIOD_S: Final = 10.0
"""Shortest interval of log messages about peers: a peer must not fill the log."""
BACK_S: Final = 1.0
"""Time after a restart until subscribers have reconnected, and can receive an event about it."""
END_S: Final = 1.0
"""Time after a request to end until the process is killed."""
MODULE: Final = "softfinger.server.publishing"


class Answering(NamedTuple):
    """Handlers of requests; both are called in the thread of the link, and must not raise.

    answer       is called with a client, its request (None: not two frames), and whether it sends too many; returns the
                 answer, or None if `reply` sends it later; must not wait
    each_period  is called every PERIOD_S or sooner
    """

    answer: Callable[[bytes, bytes | None, bool], bytes | None]
    each_period: Callable[[], None]


class Link:
    """Publisher process, from construction until `close`.

    setup   returns the setup of a new process: another one each time, as the row to start with changes
    last    sends the messages that each new process needs after its setup
    files   file descriptors that the process inherits
    event   is called with a description of each failure of the process
    obeyed  is called with each request that was answered or queued
    """

    def __init__(
        self,
        setup: Callable[[], Setup],
        last: Callable[[Callable[[Kind, bytes, bytes], object]], None],
        files: list[int],
        event: Callable[[str], None],
        obeyed: Callable[[bytes], None],
    ) -> None:
        self._setup, self._last, self._files, self._event = setup, last, list(files), event
        self._obeyed = obeyed
        self._answering: Answering | None = None
        self._before, self._now = Figures(), Figures()
        self._logged, self._logged_s = Figures(), -LOG_PERIOD_S
        self._since_s = 0.0
        self._pause_s = 0.0
        self._ready = self._waits = False
        """`_ready`: a process has been ready. `_waits`: a restart failed, and was reported."""
        self.restarts = 0
        """Number of restarts."""
        self._news: list[tuple[float, str]] = []
        """Events about the process, with the time at which to send them."""
        self.failed = False
        """The process cannot be started, or the thread that monitors it has failed."""
        self._until_s: float | None = None
        self._replacing = threading.Lock()
        """Locked while one process replaces another, so that a message is sent to the new one."""
        self._process, self._channel = self._start()
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)
        self._thread.start()

    # --- messages to the process ------------------------------------------------------------------------

    def say(self, kind: Kind, key: bytes = b"", body: bytes = b"") -> bool:
        """Send a message to the process, from any thread; False if it is dropped."""
        with self._replacing:
            return self._channel.say(kind, key, body)

    def reply(self, client: bytes, body: bytes) -> None:
        """Send a deferred answer to a client; from any thread. It is dropped if the client has disconnected."""
        self.say(Kind.LATE, client, body)

    def serve(self, answering: Answering | None) -> None:
        """Set the handlers of requests; None: requests are no longer answered."""
        self._answering = answering

    @property
    def pid(self) -> int:
        """Process id of the publisher."""
        return self._process.pid

    @property
    def figures(self) -> Figures:
        """Totals of all processes so far, and the present number of subscribers."""
        before, now = self._before, self._now
        return Figures(
            now.subscribers, before.lost + now.lost, before.refused + now.refused, before.missed + now.missed
        )

    def close(self, linger_s: float) -> None:
        """End the process after it has sent its queued messages, for at most `linger_s`. Call it once."""
        self.say(Kind.END)
        self._until_s = time.monotonic() + linger_s + END_S
        self._thread.join(linger_s + 2.0 * END_S)

    def _ending(self) -> bool:
        return self._until_s is not None

    # --- the thread -------------------------------------------------------------------------------------

    def _start(self) -> tuple[subprocess.Popen[bytes], Channel]:
        with ExitStack() as undo:
            ours, its = map(undo.enter_context, socket.socketpair())
            # A separate session: Ctrl-C and the end of a terminal are handled by the daemon; this process ends with the
            # channel.
            process = subprocess.Popen(
                [sys.executable, "-m", MODULE, str(its.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
                pass_fds=[its.fileno(), *self._files],
            )
            its.close()
            undo.pop_all()
        self._since_s = time.monotonic()
        channel = Channel(ours)
        channel.say(Kind.SETUP, body=msgspec.msgpack.encode(self._setup()))
        self._last(channel.say)
        return process, channel

    def _run(self) -> None:
        try:
            while True:
                begun, asked = time.monotonic(), self._listen()
                if self._channel.ended and not self._follow():
                    return
                if self._until_s is not None and begun >= self._until_s:
                    self._process.kill()
                if self._answering is not None:
                    self._answering.each_period()
                self._tell(begun)
                while self._news and begun >= self._news[0][0]:
                    self._event(self._news.pop(0)[1])
                if asked:  # a flood uses at most half of a processor, and the servo's readers the rest
                    time.sleep(min(time.monotonic() - begun - asked, REST_MAX_S))
        except Exception:
            self.failed = True
            log.exception("telemetry: the thread that looks after the publisher failed")
        finally:
            self._process.kill()
            self._process.wait()
            self._channel.close()

    def _listen(self) -> float:
        """Wait for messages and handle them; return the time waited, s, or 0.0 if none was a request."""
        waiting = select.poll()
        waiting.register(self._channel.fileno(), select.POLLIN | (select.POLLOUT if self._channel.waits else 0))
        begun = time.monotonic()
        waiting.poll(PERIOD_S * 1000.0)
        waited_s, asked = time.monotonic() - begun, False
        self._channel.flush()
        for said in self._channel.hear():
            asked = self._take(said) or asked
        return waited_s if asked else 0.0

    def _take(self, said: Said) -> bool:
        """Handle a message; return whether it was a request."""
        match said.kind:
            case Kind.READY:
                self._ready = True
            case Kind.FIGURES:
                self._now = msgspec.msgpack.decode(said.body, type=Figures)
            case Kind.SAID:
                log.warning("%s", said.body.decode(errors="replace"))
            case Kind.REQUEST | Kind.TOO_MUCH | Kind.MALFORMED:
                answering = self._answering
                body = None if said.kind == Kind.MALFORMED else said.body
                answer = None
                if answering is not None:
                    answer = answering.answer(said.key, body, said.kind == Kind.TOO_MUCH)
                if answer is None or not self._channel.say(Kind.ANSWER, said.key, answer):
                    self._channel.say(Kind.LATER, said.key)
                if said.kind == Kind.REQUEST:
                    self._obeyed(said.body)
                return True
        return False

    def _follow(self) -> bool:
        """Start another process after one has exited; return False if none is needed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        self._process.kill()
        code = self._process.wait()
        if self._ending():
            return False
        if not self._ready:
            log.error("telemetry: the publisher has ended with code %d before it was ready", code)
            self.failed = True
            return False
        self._channel.close()
        self._before, self._now = msgspec.structs.replace(self.figures, subscribers=0), Figures()
        if time.monotonic() - self._since_s > SOUND_S:
            self._pause_s = 0.0
        else:
            self._lengthen_pause()
        while not self._start_next():
            self._lengthen_pause()
        if self._ending():
            return False
        self.restarts += 1
        said = f"the publisher has ended with code {code} and was started again: subscribers and clients connect anew"
        log.error("%s", said)
        self._news.append((time.monotonic() + BACK_S, said))
        return True

    def _lengthen_pause(self) -> None:
        self._pause_s = min(2.0 * self._pause_s or PAUSE_S, PAUSE_MAX_S)

    def _start_next(self) -> bool:
        """Wait for the pause, then start a process unless the link is closing; return False if that fails."""
        due_s = time.monotonic() + self._pause_s
        while time.monotonic() < due_s and not self._ending():
            if self._answering is not None:
                self._answering.each_period()
            time.sleep(PERIOD_S)
        if self._ending():
            return True
        try:
            with self._replacing:
                self._process, self._channel = self._start()
        except OSError as error:  # no file descriptor, process or memory is left
            if not self._waits:
                self._waits = True
                said = f"the publisher cannot be started: {error}; it is tried again every {PAUSE_MAX_S:g} s or sooner"
                log.error("%s", said)
                self._event(said)
            return False
        self._waits = False
        return True

    def _tell(self, now_s: float) -> None:
        figures = self.figures
        if now_s - self._logged_s < LOG_PERIOD_S or (figures.lost, figures.refused) == (
            self._logged.lost,
            self._logged.refused,
        ):
            return
        if figures.lost != self._logged.lost:
            log.warning("telemetry: subscribers were too slow %d times so far, and have lost messages", figures.lost)
        if figures.refused != self._logged.refused:
            log.warning("%d connections of peers refused so far", figures.refused)
        self._logged, self._logged_s = figures, now_s
