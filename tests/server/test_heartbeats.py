"""Heartbeats, and the requests that count as one: without them there is no force."""

import time
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest
from helpers.waits import eventually, repeated
from test_commands import events, rig, running

from softfinger.config.load import load_rig
from softfinger.proxy.record import AT
from softfinger.server.services.command_handlers import CommandHandlers
from softfinger.server.services.commands import CommandService
from softfinger.server.socket_process.brake import SHORT_REQUEST_BYTES
from softfinger.server.states import COMMANDED_REASON, NO_HEARTBEAT_REASON
from softfinger.server.wire.control import Control
from softfinger.server.wire.envelope import Request

__all__ = ["rig"]  # fixture

pytestmark = pytest.mark.real_time


def test_without_a_heartbeat_there_is_no_force_until_the_next(rig):
    with running(rig(**{"commands.heartbeat_s": 0.5})) as (daemon, control, recorder), events(daemon) as next_event:
        assert control.heartbeat().timeout_ms == 500
        assert next_event("command", "heartbeat_missed")["what"] == {"after_s": 0.5}
        assert eventually(lambda: recorder.force_n == 0.0)
        assert control.describe()["armed"] is False and recorder.force_n == 0.0
        control.heartbeat()
        assert next_event("command")["what"] == {"armed": True}
        with Control(daemon.commands_endpoint) as second, repeated(second.heartbeat, 0.05):
            assert eventually(lambda: recorder.force_n > 1.9)
            control.disarm()
            assert eventually(lambda: recorder.force_n == 0.0)
            control.heartbeat()
            time.sleep(0.2)
            assert recorder.force_n == 0.0 and control.describe()["armed"] is False


def test_a_late_request_does_not_hide_a_missed_heartbeat(rig, monkeypatch):
    """The force remains off if a request arrives after the heartbeat was missed, but before the periodic check."""
    monkeypatch.setattr(CommandService, "_check_periodically", lambda self: None)
    with running(rig(**{"commands.heartbeat_s": 0.5})) as (daemon, control, recorder):
        assert eventually(lambda: control.heartbeat() and recorder.force_n > 1.9)
        assert eventually(lambda: recorder.force_n == 0.0)
        assert control.describe()["armed"] is False
        assert daemon.rendering.force.is_inhibited_by(NO_HEARTBEAT_REASON)
        assert control.heartbeat() and daemon.rendering.force.is_requested


def test_a_heartbeat_does_not_rearm_after_a_disarm(rig):
    with running(rig(**{"commands.heartbeat_s": 0.5})) as (daemon, control, recorder), events(daemon) as next_event:
        control.disarm()
        assert eventually(lambda: daemon.rendering.force.is_inhibited_by(NO_HEARTBEAT_REASON))
        control.heartbeat()
        assert next_event("command", "heartbeat")["what"] == {"armed": False}
        tick = daemon.servo.ticks
        recorder.wait_for_tick(tick + 100)
        assert not recorder.since(tick)[:, AT.force : AT.force + 3].any()
        assert control.arm().armed is True


def make_service(**force: Any) -> CommandService:
    """Return a service without sockets, for a force with these methods; it requires a heartbeat every 10 s."""
    rendering = SimpleNamespace(
        rig=load_rig("replay", {"commands.heartbeat_s": 10.0}),
        disarm=force.pop("disarm", None),
        arm=force.pop("arm", None),
        force=SimpleNamespace(**force),
    )
    return CommandService("ipc:///nowhere", rendering, make_actions(), "none")


def make_actions(**actions: Any) -> SimpleNamespace:
    publisher = SimpleNamespace(set_preparing=None)
    return SimpleNamespace(**({"replace": None, "publisher": publisher, "event": lambda *_, **__: None} | actions))


def pack(method: str, **params: Any) -> bytes:
    return msgpack.packb({"command_id": "a", "method": method, "params": params})


def test_an_invalid_request_does_not_count_as_a_heartbeat():
    alive = []
    for body in (b"\xc1", None, pack("no_such_method"), pack("heartbeat")):
        reasons: set[str] = set()
        commands = make_service(  # no request received so far
            disarm=reasons.add, arm=reasons.discard, is_inhibited_by=reasons.__contains__, end_at=lambda time_ns: None,
            is_requested=True,
        )  # fmt: skip
        assert commands._receive(b"client", body) is not None
        commands._check_heartbeat()
        alive.append(not reasons)
    assert alive == [False, False, False, True]


def test_a_stop_whose_event_cannot_be_published_ends_the_run():
    acts: list[str] = []

    def event(*words: object, **fields: object) -> None:
        raise MemoryError

    rendering = SimpleNamespace(force=SimpleNamespace(inhibit=acts.append))
    actions = make_actions(event=event, stop=lambda: acts.append("stop"))
    with pytest.raises(MemoryError):
        CommandHandlers("ipc:///nowhere", rendering, actions, "none").stop(Request("a", "stop", None))
    assert acts == [COMMANDED_REASON, "stop"]


def test_a_queued_request_counts_as_a_sign_of_life_from_its_arrival():
    deadlines_ns: list[int] = []
    commands = make_service(is_inhibited_by=lambda why: False, end_at=deadlines_ns.append)
    commands._note_alive(time.monotonic())
    assert commands._receive(b"client", pack("mark", label="x", data={"a": "x" * SHORT_REQUEST_BYTES})) is None
    arrived_s = time.monotonic()
    assert b"bad_params: data has more" in commands._answer_queued(*commands._queue.get())
    assert deadlines_ns[0] < deadlines_ns[-1] <= 1e9 * (arrived_s + 10.0)
    commands._parse(pack("heartbeat"), 0.0)  # a request that waited longer
    assert deadlines_ns[-1] == deadlines_ns[-2]
