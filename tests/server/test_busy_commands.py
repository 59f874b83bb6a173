"""Commands during compilations, floods and malformed messages of other clients; no force without heartbeats."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from helpers.pressed import pressed_scene
from helpers.processes import COMMAND, read_memory
from helpers.programs import run_program
from helpers.terminal import on_terminal
from helpers.waits import WAIT_S, eventually, repeated
from test_commands import STIFFNESS, events, rig, running, unchanged

from softfinger.config.errors import CommandRefused
from softfinger.config.load import describe, load_rig
from softfinger.proxy import progress as preparation
from softfinger.proxy.record import AT
from softfinger.server.services import scene_changes
from softfinger.server.services.command_handlers import CommandHandlers
from softfinger.server.services.command_service import CommandService
from softfinger.server.socket_process.command_clients import BURST
from softfinger.server.socket_process.force_off import SHORT_REQUEST_BYTES
from softfinger.server.socket_process.process import UNANSWERED_MAX
from softfinger.server.states import COMMANDED_REASON, NO_HEARTBEAT_REASON
from softfinger.server.wire import process_link
from softfinger.server.wire.client_requests import NoAnswer
from softfinger.server.wire.control import Control
from softfinger.server.wire.envelope import Request

__all__ = ["rig"]  # fixture

pytestmark = pytest.mark.real_time


@pytest.fixture
def slow_compiler(monkeypatch, tmp_path):
    """Compiler that reports its start, compiles a kernel, and never finishes."""
    program = tmp_path / "slow.py"
    program.write_text(
        "import os, sys, time\nsys.stdin.readline()\nprint('compiling kernel 3', flush=True)\n"
        f"open(r'{tmp_path}/' + str(os.getpid()), 'w').close()\ntime.sleep(1000)\n"
    )
    popen, module = subprocess.Popen, process_link.MODULE
    started = lambda words, **rest: popen(words if module in words else [*words[:1], program], **rest)  # noqa: E731
    monkeypatch.setattr(scene_changes.subprocess, "Popen", started)
    monkeypatch.setattr(scene_changes.ServoThread, "has_compiled", staticmethod(lambda tuning: False))
    return lambda: [int(path.name) for path in tmp_path.glob("[0-9]*")]


def alive(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def test_a_scene_that_is_compiled_delays_nothing(rig, slow_compiler):
    words = [*COMMAND, "ctl", "set_scene", "scene=sphere", "--endpoint"]
    with (
        running(rig()) as (daemon, control, recorder),
        on_terminal([*words, daemon.commands_endpoint]) as (asking, pieces),
        ThreadPoolExecutor() as pool,
        Control(daemon.commands_endpoint) as second,
    ):
        assert any("set_scene: compiling kernel 3" in piece for piece in pieces)
        with preparation.display("building the mesh of ball", 4) as report_progress:
            report_progress(1)
            assert any("set_scene: building the mesh of ball 25%" in piece for piece in pieces)
        control.timeout_s = WAIT_S
        assert control.heartbeat().timeout_ms == 0 and control.disarm().armed is False
        assert eventually(lambda: recorder.force_n == 0.0)
        answer = pool.submit(second.set_scene, "sphere")
        assert any("superseded: " in piece for piece in pieces)
        assert asking.wait(60) == 12
        assert eventually(lambda: len(slow_compiler()) == 2 and sum(map(alive, slow_compiler())) == 1)
        control.stop()
        assert daemon.wait(60.0)
        daemon.close()
        assert not any(map(alive, slow_compiler()))
        with pytest.raises(CommandRefused):
            answer.result(60.0)


def test_a_client_gets_its_answer_after_a_kill_of_the_commands_process(rig, slow_compiler):
    with (
        running(rig()) as (daemon, control, _),
        Control(daemon.commands_endpoint, WAIT_S) as first,
        first._socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED) as connections,
        ThreadPoolExecutor() as pool,
    ):
        answer = pool.submit(first.set_scene, "sphere")
        assert eventually(lambda: len(slow_compiler()) == 1)
        while connections.poll(0):
            connections.recv_multipart()
        killed = daemon.publisher.pids["commands"]
        os.kill(killed, signal.SIGKILL)
        assert eventually(lambda: daemon.publisher.pids["commands"] != killed)
        assert control.heartbeat().timeout_ms == 0
        assert connections.poll(1000.0 * WAIT_S), "the client does not reconnect"
        control.timeout_s = 1.0
        with pytest.raises(NoAnswer):  # the compiler never finishes
            control.set_scene("cylinder")
        with pytest.raises(CommandRefused, match=r"^superseded: "):
            answer.result()


def test_endless_scene_requests_do_not_block_other_clients(rig, slow_compiler):
    request = {"command_id": "x", "method": "set_scene", "params": {"scene": "sphere"}}
    with running(rig()) as (daemon, control, _), zmq.Context() as context, context.socket(zmq.DEALER) as asking:
        asking.linger, asking.rcvtimeo = 0, 10_000
        asking.connect(daemon.commands_endpoint)
        for number in range(UNANSWERED_MAX + 1):
            asking.send_multipart([b"", msgpack.packb(request)])
            if number:
                assert msgpack.unpackb(asking.recv_multipart()[1])["error"].startswith("superseded: ")
        control.timeout_s = 10.0
        assert control.heartbeat().timeout_ms == 0


def test_a_failed_compilation_is_reported(rig, monkeypatch):
    popen, failing = subprocess.Popen, [sys.executable, "-c", "raise SystemExit('no room')"]
    monkeypatch.setattr(scene_changes.ServoThread, "has_compiled", staticmethod(lambda tuning: False))
    with running(rig()) as (_, control, recorder):
        monkeypatch.setattr(scene_changes.subprocess, "Popen", lambda words, **rest: popen(failing, **rest))
        with pytest.raises(CommandRefused, match=r"^failed: the scene could not be compiled"):
            control.set_scene("sphere")
        monkeypatch.setattr(scene_changes.subprocess, "Popen", refuse_process)
        with pytest.raises(CommandRefused, match=r"^refused: the system refused: \[Errno 11\] no process is left"):
            control.set_scene("sphere")
        assert control.get_state().active_field == "pressed" and recorder.force_n > 1.9


def refuse_process(*_, **__):
    raise BlockingIOError(11, "no process is left")


def test_the_compiler_exits_when_its_input_is_closed():
    words = [sys.executable, "-P", "-m", "softfinger.server.services.scene_changes"]
    scene = json.dumps(describe(pressed_scene())) + "\n"
    completed = run_program(words, input=scene)
    assert completed.returncode == 1 and "Traceback" not in completed.stderr


def test_a_flooding_client_gets_busy_and_other_clients_are_answered(rig):
    request = msgpack.packb({"command_id": "x", "method": "get_state", "params": {}})
    with running(rig()) as (daemon, control, _), zmq.Context() as context, context.socket(zmq.DEALER) as flood:
        flood.linger = 0
        flood.connect(daemon.commands_endpoint)

        def pour() -> None:
            with contextlib.suppress(zmq.Again):
                for _ in range(2 * BURST):
                    flood.send_multipart([b"", request], zmq.NOBLOCK)

        with repeated(pour, 0.001):
            for _ in range(20):
                control.heartbeat()
                time.sleep(0.02)
        errors = set()
        while flood.poll(200) and errors != {None, "busy"}:
            error = msgpack.unpackb(flood.recv_multipart()[1])["error"]
            errors.add(error and error.partition(":")[0])
    assert errors == {None, "busy"}


FEW_MESSAGES = {"telemetry.every": 1000}
"""Publish few messages: the publisher buffers the latest ones, 40 MB after 40 s."""


def resident_mb() -> float:
    return read_memory(os.getpid()) / 1e6


def deep(levels: int, inner: bytes = b"\x90") -> bytes:
    return b"\x91" * levels + inner


def request_bytes(random: np.random.Generator) -> list[bytes]:
    noise = random.bytes(int(random.integers(0, 60)))
    good = {"command_id": "f", "method": "set_params", "params": {STIFFNESS: -1.0}}
    packed = bytearray(msgpack.packb(good))
    packed[random.integers(len(packed))] = random.integers(256)
    method = str(random.choice(["drive", "mark", "set_scene", "set_params"]))
    nested = {"command_id": noise.hex(), "method": method, "params": {"scene": msgpack.unpackb(deep(30))}}
    kinds = (
        [b"", noise],
        [b"", deep(int(random.integers(1, 3000)))],
        [b"", bytes([random.choice([0xDD, 0xDF, 0xDB, 0xC6, 0xC9])]) + b"\xff" * 4],  # claimed sizes up to 4 GiB
        [noise] * int(random.integers(1, 5)),
        [b"", msgpack.packb(good | {"params": {random.bytes(9).hex(): noise}})],
        [b"", msgpack.packb(good | {"method": noise.hex()})],
        [b"", bytes(packed)],
        [b"", msgpack.packb(nested)],
        [b"", msgpack.packb(good)],
    )
    return kinds[random.integers(len(kinds))]


@pytest.mark.scaled
def test_bad_messages_change_nothing(rig, cases):
    clients, per_client = cases(4, 20), cases(500, 5000)
    with running(rig(**FEW_MESSAGES)) as (daemon, control, recorder), zmq.Context() as context:
        before, first = control.describe()["scene"], daemon.servo.ticks
        # The clients' threads are in this process; measure once all of them run.
        at_work = threading.Barrier(clients + 1)
        failures: list[str] = []

        def attack(seed: int) -> None:
            random = np.random.default_rng(seed)
            with context.socket(zmq.DEALER) as dealer:
                dealer.linger = 0
                dealer.connect(daemon.commands_endpoint)
                answers = 0
                for number in range(per_client):
                    if number == per_client // 10:
                        at_work.wait()
                    dealer.send_multipart(request_bytes(random))
                    while number - answers > 50 or (number == per_client - 1 and answers < per_client):
                        if not dealer.poll(60_000):
                            failures.append(f"{seed}: {answers} answers to {number} messages")
                            return
                        answer = msgpack.unpackb(dealer.recv_multipart()[1])
                        if answer["success"]:
                            failures.append(str(answer))
                        answers += 1

        threads = [threading.Thread(target=attack, args=(seed,)) for seed in range(clients)]
        for thread in threads:
            thread.start()
        at_work.wait()
        memory_mb, recorded_mb = resident_mb(), recorder.megabytes
        while any(thread.is_alive() for thread in threads):
            control.heartbeat()
            time.sleep(0.05)
        grown_mb = resident_mb() - memory_mb - (recorder.megabytes - recorded_mb)
        assert not failures, failures[:3]
        assert control.describe()["scene"] == before
        assert unchanged(recorder.since(first))
    # Of 90 000 messages a leak of 200 bytes for each would be 18 MB. With few messages the allocator reserves some MB
    # for any number of them; a leak of 5 kB for each would be as much.
    assert grown_mb < cases(9, 18), grown_mb


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
    publisher = SimpleNamespace(set_preparing=None, commands=SimpleNamespace())
    return SimpleNamespace(**({"replace": None, "publisher": publisher, "event": lambda *_, **__: None} | actions))


def pack(method: str, **params: Any) -> bytes:
    return msgpack.packb({"command_id": "a", "method": method, "params": params})


def test_an_invalid_request_does_not_count_as_a_heartbeat():
    alive = []
    for body in (b"\xc1", None, pack("no_such_method"), pack("heartbeat")):
        reasons: set[str] = set()
        commands = make_service(  # no request received so far
            disarm=reasons.add, arm=reasons.discard, is_inhibited_by=reasons.__contains__, is_requested=True,
            set_deadline=lambda time_ns: None,
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
    commands = make_service(is_inhibited_by=lambda why: False, set_deadline=deadlines_ns.append)
    commands._note_alive(time.monotonic())
    assert commands._receive(b"client", pack("mark", label="x", data={"a": "x" * SHORT_REQUEST_BYTES})) is None
    arrived_s = time.monotonic()
    assert b"bad_params: data has more" in commands._answer_queued(*commands._queue.get())
    assert deadlines_ns[0] < deadlines_ns[-1] <= 1e9 * (arrived_s + 10.0)
    commands._parse(pack("heartbeat"), 0.0)  # a request that waited longer
    assert deadlines_ns[-1] == deadlines_ns[-2]
