"""Main loop of a process with ZeroMQ sockets.

A single thread handles ticks first, then the daemon's messages, then peers.

It ends with the daemon, on request, by an abort in libzmq if a peer exhausts its memory, or by SIGPROF if libzmq does
not return. The daemon then starts it again.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import resource
import select
import signal
import socket
import time
from contextlib import ExitStack
from typing import Final

import msgspec

from softfinger.server.socket_process.channel import Channel, Message
from softfinger.server.socket_process.channel_messages import (
    PERIOD_S,
    REQUESTS_PERIOD_S,
    REST_MAX_S,
    Figures,
    Kind,
    ListeningSocket,
    ProcessSetup,
    StateInfo,
)
from softfinger.server.socket_process.command_clients import REQUESTS_PER_TURN, CommandClients, RequestQueue
from softfinger.server.socket_process.force_off import ForceOffCounter, takes_force_off
from softfinger.server.socket_process.peer_socket import (
    COMMANDS_MEMORY_MAX,
    LINGER_MS,
    MEMORY_MAX,
    KeyLock,
    PeerSocket,
    SocketContext,
    bound_resources,
    open_context,
)
from softfinger.server.socket_process.subscribers import Subscribers
from softfinger.server.socket_process.tick_messages import RowReader, TickEncoder

log: Final = logging.getLogger(__name__)

UNANSWERED_MAX: Final = 32
"""Unanswered requests passed to the daemon; further ones wait here, so that one that turns the force off has its effect
while the daemon is busy."""
QUIET_S: Final = 0.1
"""If ticks arrive at shorter intervals than this, a new subscriber waits for the next: libzmq would send the latest to
all."""
KEY_CHECK_S: Final = 1.0
"""Interval of the check of the folders of keys."""
MAX_BUSY_US: Final = 50_000
KILL_US: Final = 1_000_000
STUCK_S: Final = 0.5
"""CPU time of one step after which the process ends. libzmq walks its tree of all topics for each connection that
closes: after a flood of topics for up to a minute, in which no tick would be sent."""
EVENTS_IN_TURN: Final = 32
"""Connection events handled before ticks, messages and requests have their turn."""
RETRY_S: Final = 0.005
"""Interval of retries while the daemon does not read."""


class SocketServer:
    """State of the process; it sends ticks if it has an endpoint of telemetry.

    channel  to the daemon, from which `setup` has been received
    """

    def __init__(self, channel: Channel, setup: ProcessSetup, files: ExitStack) -> None:
        self._channel, self._unanswered = channel, 0
        self._waiting = RequestQueue()
        self._force_off = ForceOffCounter(setup.switch)
        self._rows = RowReader(setup.memory, setup.begin, setup.bell)
        self._encoder = TickEncoder(setup.ticks, setup.state_info)
        self._tick_topics = {topic.encode() for topic in (*setup.ticks.topics, setup.ticks.state)}
        self._last_tick_s = -QUIET_S
        self._latest: dict[bytes, bytes] = {}
        """Message of each topic that a new subscriber is sent at once."""
        self._ended = False
        socket_context = open_context(files, LINGER_MS, any(listener.key for listener in setup.listeners))
        self._subscribers: list[Subscribers] = []
        self._clients: list[CommandClients] = []
        self._receive()  # before there are subscribers: only messages that are stored for them have an effect
        for listener in setup.listeners:
            self._open(socket_context, listener, setup.backlog)
        self._peer_sockets: list[PeerSocket] = [
            *(subscribers.peers for subscribers in self._subscribers),
            *(clients.peers for clients in self._clients),
        ]
        self._renewals = [files.enter_context(socket.socket(fileno=listener.renewals)) for listener in setup.listeners]
        """For each of `_peer_sockets`: all listeners of a process have the same name."""

    def _open(self, socket_context: SocketContext, listener: ListeningSocket, backlog: int) -> None:
        lock = _make_lock(listener) if listener.key else None
        if listener.name == "telemetry":
            self._subscribers.append(Subscribers(socket_context, listener, lock, backlog, self._send_latest))
            return
        number = bytes((len(self._clients),))
        self._clients.append(
            CommandClients(
                socket_context,
                listener,
                lock,
                lambda client, body, too_much: self._accept(number + client, body, too_much),
            )
        )

    def _accept(self, client: bytes, body: bytes, too_much: bool) -> bool:
        """Queue a request, or return False; if it turns the force off, the loop does so now."""
        accepted = self._waiting.add(client, body, too_much)
        if accepted and takes_force_off(body):
            self._force_off.count(1)
        return accepted

    def _pass_on(self) -> None:
        """Pass queued requests to the daemon, until too many are unanswered."""
        while self._waiting and self._unanswered < UNANSWERED_MAX:
            client, body = self._waiting.pop()
            if self._channel.send(Kind.REQUEST, client, body):
                self._unanswered += 1
            elif takes_force_off(body):  # the daemon will not receive it
                self._force_off.count(-1)

    def run(self) -> None:
        """Publish until the daemon requests the end or exits."""
        poll, bell = self._poll(), self._rows.bell
        renewals, report_s, keys_s = self._count_renewals(), 0.0, time.monotonic() + KEY_CHECK_S
        has_events, requests, period_s = False, 0, REQUESTS_PERIOD_S if self._clients else PERIOD_S
        while not self._ended:
            limit_step()
            is_due = has_events or requests >= REQUESTS_PER_TURN
            timeout_s = 0.0 if is_due else RETRY_S if self._channel.has_queued else period_s
            ready = {number for number, _ in poll.poll(timeout_s * 1000.0)}
            start_s = time.monotonic()
            if bell in ready:
                os.eventfd_read(bell)  # orders the loads of rows after the stores that precede the signal
            self._send_ticks()
            if self._channel.fileno() in ready:
                self._receive()
            self._channel.flush()
            requests = self._handle_peers()
            if self._clients:
                self._force_off.reset_time()
            if has_events or ready - {bell, self._channel.fileno()}:
                # Soon: libzmq's thread blocks once a thousand events are unread. Few: they must not delay requests.
                has_events = sum(peers.process_events(EVENTS_IN_TURN) for peers in self._peer_sockets) > 0
            now = time.monotonic()
            if now >= report_s:
                report_s = now + PERIOD_S
                self._report_figures()
                self._rebind()
            if now >= keys_s:
                keys_s = now + KEY_CHECK_S
                for peers in self._peer_sockets:
                    peers.refresh_keys()
            if self._count_renewals() != renewals:
                poll, renewals = self._poll(), self._count_renewals()
            if requests:  # a flood uses at most half of a processor
                time.sleep(min(time.monotonic() - start_s, REST_MAX_S))

    def _poll(self) -> select.poll:
        poll = select.poll()
        if self._subscribers:  # another process would miss the signal that this one resets
            poll.register(self._rows.bell, select.POLLIN)
        poll.register(self._channel.fileno(), select.POLLIN)
        for peers in self._peer_sockets:
            for peer_socket in (peers.socket, peers.monitor):
                poll.register(peer_socket.FD, select.POLLIN)
        return poll

    def _count_renewals(self) -> int:
        return sum(peers.renewals for peers in self._peer_sockets)

    def _send_ticks(self) -> None:
        if not self._subscribers:
            return
        for row in self._rows.take():
            limit_step()
            for topic, body in self._encoder.encode_row(row):
                self._latest[topic] = body
                self._publish(topic, body)
            self._last_tick_s = time.monotonic()

    def _handle_peers(self) -> int:
        """Handle messages from peers; return the number of requests.

        After a socket was used, its file descriptor does not signal messages that arrived earlier.
        """
        for subscribers in self._subscribers:
            subscribers.take()
        requests = sum(clients.take() for clients in self._clients)
        self._pass_on()
        return requests

    def _send_latest(self, prefix: bytes) -> None:
        """Send the latest messages for a new subscription; libzmq sends them to all subscribers of the topic."""
        quiet = time.monotonic() - self._last_tick_s >= QUIET_S
        for topic, body in self._latest.items():
            if topic.startswith(prefix) and (quiet or topic not in self._tick_topics):
                self._publish(topic, body)

    def _publish(self, topic: bytes, body: bytes) -> None:
        for subscribers in self._subscribers:
            subscribers.send(topic, body)

    def _receive(self) -> None:
        for message in self._channel.receive():
            self._handle(message)
        self._ended = self._ended or self._channel.ended

    def _handle(self, message: Message) -> None:
        match message.kind:
            case Kind.MESSAGE | Kind.RETAINED:
                self._send_ticks()  # the message follows from ticks that were written before it
                self._publish(message.key, message.body)
                if message.kind == Kind.RETAINED:
                    self._latest[message.key] = message.body
            case Kind.GREETING:
                self._latest[message.key] = message.body
            case Kind.ANSWER | Kind.DEFERRED_ANSWER:
                self._clients[message.key[0]].answer(message.key[1:], message.body)
                self._unanswered -= message.kind == Kind.ANSWER
            case Kind.DEFERRED:
                self._unanswered -= 1
            case Kind.STATE_INFO:
                self._send_ticks()
                self._encoder.set_state_info(msgspec.msgpack.decode(message.body, type=StateInfo))
            case Kind.END:
                self._send_ticks()
                self._ended = True

    def _rebind(self) -> None:
        """Accept connections to the listening sockets that the daemon has bound in place of removed ones."""
        for renewals, peers in zip(self._renewals, self._peer_sockets, strict=True):
            with contextlib.suppress(BlockingIOError):
                for fd in socket.recv_fds(renewals, 1, 1)[1]:
                    peers.bind_again(fd)
                    os.close(fd)

    def _report_figures(self) -> None:
        for peers in self._peer_sockets:
            peers.process_events(EVENTS_IN_TURN)
        figures = Figures(
            sum(subscribers.connection_count for subscribers in self._subscribers),
            sum(subscribers.lost for subscribers in self._subscribers),
            sum(peers.refused for peers in self._peer_sockets),
            self._rows.lost,
        )
        self._channel.send(Kind.FIGURES, body=msgspec.msgpack.encode(figures))  # always: it is a sign of life, too


def _make_lock(listener: ListeningSocket) -> KeyLock:
    from softfinger.server.keys import read_pair
    from softfinger.server.socket_process.allowed import AllowedKeys

    return KeyLock(read_pair(listener.key), AllowedKeys(listener.folder))


class _DaemonLogHandler(logging.Handler):
    """Handler that forwards log messages to the daemon."""

    def __init__(self, channel: Channel) -> None:
        super().__init__(logging.WARNING)
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        self._channel.send(Kind.LOG, body=self.format(record).encode()[:1024])


def request_priority(priority: int) -> bool:
    """Request a real-time priority for this and later threads, and so for ticks; return whether it was granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:  # for the reason reported for the servo
        return False
    return True


def limit_step() -> None:
    """Allow STUCK_S of CPU time until the next call; beyond that the system ends the process by SIGPROF."""
    signal.setitimer(signal.ITIMER_PROF, STUCK_S)


def drop_priority_when_busy() -> None:
    """Drop the priority of all threads if one uses a processor for MAX_BUSY_US without a pause, as in a flood by peers.

    After KILL_US the system ends the process.
    """
    # listed here, because peers may later have used up all file descriptors
    threads = [int(thread_id) for thread_id in os.listdir("/proc/self/task")]

    def drop_priority(*_: object) -> None:
        for thread in threads:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
        log.warning("telemetry: the publisher is too busy for a real-time priority and continues without it")

    signal.signal(signal.SIGXCPU, drop_priority)
    resource.setrlimit(resource.RLIMIT_RTTIME, (MAX_BUSY_US, KILL_US))


def run_process(channel: Channel) -> None:
    """Run the process for the daemon at the other end, until either ends."""
    logging.getLogger().addHandler(_DaemonLogHandler(channel))
    setup = _receive_setup(channel)
    if setup is None:
        return
    has_priority = setup.priority > 0 and request_priority(setup.priority)
    with ExitStack() as files:
        server = SocketServer(channel, setup, files)
        bound_resources(COMMANDS_MEMORY_MAX if setup.listeners[0].name == "commands" else MEMORY_MAX)
        if has_priority:
            drop_priority_when_busy()
        channel.send(Kind.READY)
        # Objects created for a tick are freed with it; long-lived ones have been created before.
        gc.freeze()
        gc.disable()
        server.run()


def _receive_setup(channel: Channel) -> ProcessSetup | None:
    """Return the first message from the daemon; None if the daemon has exited."""
    while not channel.ended:
        select.select([channel], [], [])
        for message in channel.receive():
            if message.kind == Kind.SETUP:
                return msgspec.msgpack.decode(message.body, type=ProcessSetup)
    return None
