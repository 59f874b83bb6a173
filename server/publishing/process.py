"""Main loop of the publisher: a single thread that handles ticks first, then the daemon's messages, then peers.

It ends with the daemon, on request, or by an abort in libzmq if a peer exhausts its memory.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import resource
import select
import signal
import time
from contextlib import ExitStack
from typing import Any, Final

import msgspec
import zmq

from softfinger.server.publishing.brake import Brake, takes_force_off
from softfinger.server.publishing.channel import Channel, Said
from softfinger.server.publishing.clients import Clients
from softfinger.server.publishing.front import LINGER_MS, Front, Gate, Lock, bound_resources
from softfinger.server.publishing.messages import Messages
from softfinger.server.publishing.readers import Readers
from softfinger.server.publishing.setup import PERIOD_S, Entrance, Figures, Kind, Setup, Shown
from softfinger.server.publishing.ticks import Rows

log: Final = logging.getLogger(__name__)

OUT_MAX: Final = 32
"""Unanswered requests passed to the daemon; further ones remain queued in libzmq, up to a limit for each client."""
QUIET_S: Final = 0.1
"""If ticks arrive at shorter intervals than this, a new subscriber waits for the next: libzmq would send the latest to
all."""
LOOK_S: Final = 1.0
"""Interval of the check of the folders of keys."""
ALONE_US: Final = 50_000
KILLED_US: Final = 1_000_000
RETRY_S: Final = 0.005
"""Interval of retries while the daemon does not read."""


class Publishing:
    """State of the publisher process.

    channel  to the daemon, from which `setup` has been received
    """

    def __init__(self, channel: Channel, setup: Setup, files: ExitStack) -> None:
        self._channel, self._out = channel, 0
        self._brake = Brake(setup.switch)
        self._rows = Rows(setup.memory, setup.begin, setup.bell)
        self._messages = Messages(setup.ticks, setup.shown)
        self._ticking = {topic.encode() for topic in (*setup.ticks.topics, setup.ticks.state)}
        self._ticked_s = -QUIET_S
        self._newest: dict[bytes, bytes] = {}
        """Message of each topic that a new subscriber is sent at once."""
        self._told = Figures()
        self._ended = False
        context: zmq.Context[Any] = zmq.Context()
        files.callback(context.destroy, LINGER_MS)
        gate = Gate(context, _authenticator(context, files) if any(each.key for each in setup.entrances) else None)
        self._readers: list[Readers] = []
        self._clients: list[Clients] = []
        self._hear()  # earlier messages are not sent to later subscribers, except the stored ones
        for entrance in setup.entrances:
            self._open(gate, entrance, setup.backlog)
        self._fronts: list[Front] = [*(each.front for each in self._readers), *(each.front for each in self._clients)]

    def _open(self, gate: Gate, entrance: Entrance, backlog: int) -> None:
        lock = _lock(entrance) if entrance.key else None
        if entrance.name == "telemetry":
            self._readers.append(Readers(gate, entrance, lock, backlog, self._asked))
            return
        number = bytes((len(self._clients),))

        def ask(kind: Kind, client: bytes, body: bytes) -> None:
            off = kind == Kind.REQUEST and takes_force_off(body)
            self._brake.count(int(off))
            if self._channel.say(kind, number + client, body):
                self._out += 1
            else:  # the daemon will not receive it
                self._brake.count(-int(off))

        self._clients.append(Clients(gate, entrance, lock, ask))

    def run(self) -> None:
        """Publish until the daemon requests the end or exits."""
        poll, bell = self._poll(), self._rows.bell
        renewed, look_s, keys_s = self._renewed(), 0.0, time.monotonic() + LOOK_S
        while not self._ended:
            timeout_s = RETRY_S if self._channel.waits else PERIOD_S
            happened = {number for number, _ in poll.poll(timeout_s * 1000.0)}
            if bell in happened:
                self._rows.heard()
            self._send_ticks()
            if self._channel.fileno() in happened:
                self._hear()
            self._channel.flush()
            self._attend()
            if happened - {bell, self._channel.fileno()}:
                for front in self._fronts:  # soon: libzmq's thread blocks once a thousand events are unread
                    front.look()
            now = time.monotonic()
            if now >= look_s:
                look_s = now + PERIOD_S
                self._look()
            if now >= keys_s:
                keys_s = now + LOOK_S
                for front in self._fronts:
                    front.look_at_keys()
            if self._renewed() != renewed:
                poll, renewed = self._poll(), self._renewed()

    def _poll(self) -> select.poll:
        poll = select.poll()
        poll.register(self._rows.bell, select.POLLIN)
        poll.register(self._channel.fileno(), select.POLLIN)
        for front in self._fronts:
            for socket in (front.socket, front.monitor):
                poll.register(socket.FD, select.POLLIN)
        return poll

    def _renewed(self) -> int:
        return sum(front.renewed for front in self._fronts)

    def _send_ticks(self) -> None:
        messages, newest, readers = self._messages, self._newest, self._readers
        for row in self._rows.take():
            for topic, body in messages.of(row):
                newest[topic] = body
                for each in readers:
                    each.send(topic, body)
            self._ticked_s = time.monotonic()

    def _attend(self) -> None:
        """Handle messages from peers.

        After a socket was used, its file descriptor does not signal messages that arrived earlier.
        """
        for readers in self._readers:
            readers.take()
        for clients in self._clients:
            if self._out < OUT_MAX:
                clients.take(OUT_MAX - self._out)

    def _asked(self, beginning: bytes) -> None:
        """Send the latest messages for a new subscription; libzmq sends them to all subscribers of the topic."""
        quiet = time.monotonic() - self._ticked_s >= QUIET_S
        for topic, body in self._newest.items():
            if topic.startswith(beginning) and (quiet or topic not in self._ticking):
                self._publish(topic, body)

    def _publish(self, topic: bytes, body: bytes) -> None:
        for readers in self._readers:
            readers.send(topic, body)

    def _hear(self) -> None:
        for said in self._channel.hear():
            self._obey(said)
        self._ended = self._ended or self._channel.ended

    def _obey(self, said: Said) -> None:
        match said.kind:
            case Kind.MESSAGE | Kind.RETAINED:
                self._send_ticks()  # the message follows from ticks that were written before it
                self._publish(said.key, said.body)
                if said.kind == Kind.RETAINED:
                    self._newest[said.key] = said.body
            case Kind.GREETING:
                self._newest[said.key] = said.body
            case Kind.ANSWER | Kind.LATE:
                self._clients[said.key[0]].answer(said.key[1:], said.body)
                self._out -= said.kind == Kind.ANSWER
            case Kind.LATER:
                self._out -= 1
            case Kind.SHOWN:
                self._send_ticks()
                self._messages.show(msgspec.msgpack.decode(said.body, type=Shown))
            case Kind.END:
                self._send_ticks()
                self._ended = True

    def _look(self) -> None:
        for front in self._fronts:
            front.look()
        figures = Figures(
            sum(each.subscribers for each in self._readers),
            sum(each.lost for each in self._readers),
            sum(front.refused for front in self._fronts),
            self._rows.lost,
        )
        if figures != self._told and self._channel.say(Kind.FIGURES, body=msgspec.msgpack.encode(figures)):
            self._told = figures


def _authenticator(context: zmq.Context[Any], files: ExitStack) -> Any:
    from zmq.auth.thread import ThreadAuthenticator

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    files.callback(authenticator.stop)
    return authenticator


def _lock(entrance: Entrance) -> Lock:
    from softfinger.server.gateway.allowed import Allowed
    from softfinger.server.keys import read_pair

    return Lock(read_pair(entrance.key), Allowed(entrance.folder))


class _ToDaemon(logging.Handler):
    """Handler that forwards log messages to the daemon."""

    def __init__(self, channel: Channel) -> None:
        super().__init__(logging.WARNING)
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        self._channel.say(Kind.SAID, body=self.format(record).encode()[:1024])


def run_promptly(priority: int) -> bool:
    """Request a real-time priority, so that a busy processor delays no tick; return whether it was granted.

    Threads created later inherit it.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:  # for the reason reported for the servo
        return False
    return True


def give_way_when_busy() -> None:
    """Drop the priority of all threads if one uses a processor for ALONE_US without a pause, as in a flood by peers.

    After KILLED_US the system ends the process.
    """
    threads = [int(each) for each in os.listdir("/proc/self/task")]  # now: later, peers may have used up all files

    def give_way(*_: object) -> None:
        for thread in threads:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
        log.warning("telemetry: the publisher is too busy to have a priority, and goes on without")

    signal.signal(signal.SIGXCPU, give_way)
    resource.setrlimit(resource.RLIMIT_RTTIME, (ALONE_US, KILLED_US))


def publish(channel: Channel) -> None:
    """Run the publisher for the daemon at the other end, until either ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the daemon sends a last message
        signal.signal(number, signal.SIG_IGN)
    logging.getLogger().addHandler(_ToDaemon(channel))
    setup = _setup(channel)
    if setup is None:
        return
    prompt = setup.priority > 0 and run_promptly(setup.priority)
    with ExitStack() as files:
        publishing = Publishing(channel, setup, files)
        bound_resources()
        if prompt:
            give_way_when_busy()
        channel.say(Kind.READY)
        # Objects created for a tick are freed with it; long-lived ones have been created before.
        gc.freeze()
        gc.disable()
        publishing.run()


def _setup(channel: Channel) -> Setup | None:
    """Return the first message from the daemon; None if the daemon has exited."""
    while not channel.ended:
        select.select([channel], [], [])
        for said in channel.hear():
            if said.kind == Kind.SETUP:
                return msgspec.msgpack.decode(said.body, type=Setup)
    return None
