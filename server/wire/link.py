"""The publisher's process as the daemon has it: started, told, heard, and started again when it has ended.

One thread looks after it, and receives what its peers ask. Nobody waits for it: what is said to it while it is away, or
while it does not read, is kept in a bounded queue or left out.
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
"""How often `each_period` is called where nobody asks anything."""
REST_MAX_S: Final = 0.002
"""Longest rest after requests were received: what takes longer waits for its turn in another thread."""
SOUND_S: Final = 10.0
"""One that has run for so long is started again at once."""
PAUSE_S: Final = 0.1
PAUSE_MAX_S: Final = 5.0
"""How long to wait before the next start: doubled each time that one ends early, up to this."""
LOG_PERIOD_S: Final = 10.0
"""How seldom it is told what peers lose: a peer must not fill the log."""
BACK_S: Final = 1.0
"""How long after a start subscribers are there again, to be told of it."""
END_S: Final = 1.0
"""How long after its end was asked for the process is ended by force."""
MODULE: Final = "softfinger.server.publishing"


class Answering(NamedTuple):
    """Who answers requests; both are called in the thread of the link, and raise nothing.

    answer       is given a client, its request (None: not two frames), and whether it asks too much; returns the
                 answer, or None if that comes later, by `reply`; waits for nobody
    each_period  is called every PERIOD_S or sooner
    """

    answer: Callable[[bytes, bytes | None, bool], bytes | None]
    each_period: Callable[[], None]


class Link:
    """The process, from now on until `close`.

    setup  what it is told at the start: a new one for each, for rows have gone on
    last   says what has to be said to each new one, after that
    files  that it needs, by number
    event  called with what has happened to it, in words
    obeyed called with each request that was answered, or waits for its turn
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
        """How often it was started again."""
        self._news: list[tuple[float, str]] = []
        """What has happened to it, and when to tell."""
        self.failed = False
        """It cannot be started, or the thread that looks after it has ended by an error of its own."""
        self._until_s: float | None = None
        self._replacing = threading.Lock()
        """Held where one process takes the place of another: what is said meanwhile is said to the next."""
        self._process, self._channel = self._start()
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)
        self._thread.start()

    # --- what is said -----------------------------------------------------------------------------------

    def say(self, kind: Kind, key: bytes = b"", body: bytes = b"") -> bool:
        """Say something to the process, from any thread; False where it is left out."""
        with self._replacing:
            return self._channel.say(kind, key, body)

    def reply(self, client: bytes, body: bytes) -> None:
        """Answer a client later than at once; from any thread. One that has gone gets nothing."""
        self.say(Kind.LATE, client, body)

    def serve(self, answering: Answering | None) -> None:
        """Answer requests from here on; None: nobody does any more."""
        self._answering = answering

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def figures(self) -> Figures:
        """What all of the processes have counted, and the subscribers of now."""
        before, now = self._before, self._now
        return Figures(
            now.subscribers, before.lost + now.lost, before.refused + now.refused, before.missed + now.missed
        )

    def close(self, linger_s: float) -> None:
        """Have it send what is under way, for at most `linger_s`, and end. Once."""
        self.say(Kind.END)
        self._until_s = time.monotonic() + linger_s + END_S
        self._thread.join(linger_s + 2.0 * END_S)

    def _ending(self) -> bool:
        return self._until_s is not None

    # --- the thread -------------------------------------------------------------------------------------

    def _start(self) -> tuple[subprocess.Popen[bytes], Channel]:
        with ExitStack() as undo:
            ours, its = map(undo.enter_context, socket.socketpair())
            # A session of its own: Ctrl-C and the end of a terminal are for the daemon, and this ends with the channel.
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
                if asked:  # a flood has half of the time of one processor at most, and the servo's readers the rest
                    time.sleep(min(time.monotonic() - begun - asked, REST_MAX_S))
        except Exception:
            self.failed = True
            log.exception("telemetry: the thread that looks after the publisher failed")
        finally:
            self._process.kill()
            self._process.wait()
            self._channel.close()

    def _listen(self) -> float:
        """Wait for the process, and do what it says; returns how long it waited, s, or 0.0 where nobody asked."""
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
        """Do what the process says; whether it was a request."""
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
        """Start another process in the place of one that has ended; False where none is to follow."""
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
