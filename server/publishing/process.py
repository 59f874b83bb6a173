"""The publisher's loop: one thread, ticks first, then what the daemon says, then what peers do.

It ends with the daemon, when it is told to, and by libzmq's own hand where a peer takes more than there is.
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
"""Requests that the daemon has and has not answered; more wait in libzmq, so many for each client."""
QUIET_S: Final = 0.1
"""Where a tick comes sooner than this, whoever subscribes waits for the next: libzmq would send the newest to all."""
LOOK_S: Final = 1.0
"""How often the folders of keys are looked at."""
ALONE_US: Final = 50_000
KILLED_US: Final = 1_000_000
RETRY_S: Final = 0.005
"""How soon a daemon that does not read is tried again."""


class Publishing:
    """Everything that the process has open.

    channel  to the daemon, which has said `setup`
    """

    def __init__(self, channel: Channel, setup: Setup, files: ExitStack) -> None:
        self._channel, self._out = channel, 0
        self._brake = Brake(setup.switch)
        self._rows = Rows(setup.memory, setup.begin, setup.bell)
        self._messages = Messages(setup.ticks, setup.shown)
        self._ticking = {topic.encode() for topic in (*setup.ticks.topics, setup.ticks.state)}
        self._ticked_s = -QUIET_S
        self._newest: dict[bytes, bytes] = {}
        """Of each topic what whoever subscribes is sent at once."""
        self._told = Figures()
        self._ended = False
        context: zmq.Context[Any] = zmq.Context()
        files.callback(context.destroy, LINGER_MS)
        gate = Gate(context, _authenticator(context, files) if any(each.key for each in setup.entrances) else None)
        self._readers: list[Readers] = []
        self._clients: list[Clients] = []
        self._hear()  # what came meanwhile is for nobody who comes from here on, but for what is kept of it
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
            else:  # the daemon will not hear of it
                self._brake.count(-int(off))

        self._clients.append(Clients(gate, entrance, lock, ask))

    def run(self) -> None:
        """Publish until the daemon says that it ends, or is gone."""
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
                for front in self._fronts:  # soon: libzmq's thread waits where nobody takes note of a thousand of them
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
        """Take what peers have sent. A socket that was used tells nothing by its file that had come before."""
        for readers in self._readers:
            readers.take()
        for clients in self._clients:
            if self._out < OUT_MAX:
                clients.take(OUT_MAX - self._out)

    def _asked(self, beginning: bytes) -> None:
        """Send the newest messages to who subscribes; libzmq sends them to all who have subscribed to the topic."""
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
                self._send_ticks()  # it follows from ticks that were written before it was said
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
    """Has the daemon log what is to be said."""

    def __init__(self, channel: Channel) -> None:
        super().__init__(logging.WARNING)
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        self._channel.say(Kind.SAID, body=self.format(record).encode()[:1024])


def run_promptly(priority: int) -> bool:
    """Ask for a real-time priority, with which a busy processor holds up no tick; threads that are made later have it,
    too. Whether it was granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:  # for the reason that the servo is told
        return False
    return True


def give_way_when_busy() -> None:
    """Where a thread keeps a processor for ALONE_US, as when peers flood it, all go on without a priority; after
    KILLED_US the process is ended."""
    threads = [int(each) for each in os.listdir("/proc/self/task")]  # now: later peers may have all files

    def give_way(*_: object) -> None:
        for thread in threads:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
        log.warning("telemetry: the publisher is too busy to have a priority, and goes on without")

    signal.signal(signal.SIGXCPU, give_way)
    resource.setrlimit(resource.RLIMIT_RTTIME, (ALONE_US, KILLED_US))


def publish(channel: Channel) -> None:
    """Be the publisher of the daemon at the other end, until either ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # as a service is ended: the daemon has a last word
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
        # What is made for a tick goes with it; what is kept was made before.
        gc.freeze()
        gc.disable()
        publishing.run()


def _setup(channel: Channel) -> Setup | None:
    """What the daemon says first; None where it has gone."""
    while not channel.ended:
        select.select([channel], [], [])
        for said in channel.hear():
            if said.kind == Kind.SETUP:
                return msgspec.msgpack.decode(said.body, type=Setup)
    return None
