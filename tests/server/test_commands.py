"""Commands to a real daemon over real sockets: their effect on the force, and on nothing else."""

import asyncio
import contextlib
import json
import math
import subprocess
import threading
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from helpers.called import VerbResult, called
from helpers.daemons import QUIET, RecordSink, subscribed
from helpers.faulty_device import registered
from helpers.pressed import DEPTH_M, pressed_scene
from helpers.processes import COMMAND
from helpers.programs import Program, run_program
from helpers.two_fingers import pressed_by_two, two_devices
from helpers.waits import WAIT_S, eventually

from softfinger.config.errors import CommandRefused, ConfigError
from softfinger.config.load import describe, load_rig
from softfinger.config.schema import Scene
from softfinger.proxy.record import AT
from softfinger.server.app import Daemon
from softfinger.server.loop.guard import DISARMED, PAUSE_MAX_S
from softfinger.server.recording.reader import Event, read_contents
from softfinger.server.recording.summary import summarize
from softfinger.server.remote import Client as RemoteClient
from softfinger.server.services.command_handlers import EVENT_BYTES_MAX
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.client_requests import NoAnswer
from softfinger.server.wire.commands import METHODS
from softfinger.server.wire.control import AsyncControl, Control

pytestmark = pytest.mark.real_time

RAMP_S, SLEW = 0.05, 200.0
ROUNDING = 1e-12
"""Relative; a force results from about ten operations on numbers of similar size."""


STIFFNESS = "object.lid.top.material.stiffness_n_per_m"
PUSH = "effect.0.force_n"


class PressingSink(RecordSink):
    def is_whole(self) -> bool:
        """Return True if the guard passes the scene's force unchanged."""
        return self.force_n > 0.0 and self.latest(AT.servo_guard) == 0.0

    def latest(self, column: int) -> float:
        return float(self.batches[-1][-1, column])

    def wait_for_tick(self, tick: int) -> None:
        """Wait until a later tick is recorded."""
        assert eventually(lambda: self.latest(AT.tick) > tick)

    @property
    def megabytes(self) -> float:
        return sum(batch.nbytes for batch in self.batches) / 1e6

    @property
    def force_n(self) -> float:
        return float(self.force[2])


@pytest.fixture
def rig(monkeypatch):
    """Return a function that makes rigs of a pressing device; its full force in one tick exceeds the slew limit."""
    registered(monkeypatch)
    pressing = {
        "device.driver": "faulty", "guard.ramp_s": RAMP_S, "guard.force_slew_n_per_s": SLEW, "guard.force_max_n": 5.0,
        "commands.ramp_s": 0.0,
    }  # fmt: skip
    return lambda **changes: load_rig("replay", QUIET | pressing | changes)


@contextlib.contextmanager
def running(rig, scene: Scene | None = None) -> Iterator[tuple[Daemon, Control, PressingSink]]:
    """Run a daemon that presses with full force; yield it, a client, and the sink of records."""
    recorder = PressingSink()
    with Daemon(rig, scene or pressed_scene(), sinks=[recorder.sink], scene_name="pressed") as daemon:
        daemon.start()
        with Control(daemon.commands_endpoint, WAIT_S) as control:
            assert eventually(lambda: control.heartbeat() and recorder.is_whole())  # a rig may need heartbeats
            yield daemon, control, recorder
            daemon.stop()
            assert daemon.wait(60.0)


@contextlib.contextmanager
def events(daemon: Daemon) -> Iterator[Any]:
    with subscribed(daemon.publisher.endpoint, "event") as subscriber:
        assert eventually(lambda: daemon.publisher.figures.subscribers == 1)

        def next_event(kind: str, name: str = "") -> dict[str, Any]:
            event = {"kind": ""}
            while event["kind"] != kind or name not in ("", event["name"]):
                event = msgpack.unpackb(subscriber.recv_multipart()[1])
            return event

        yield next_event


def unchanged(rows: np.ndarray) -> bool:
    """Return True if contact force and device force are constant, ignoring ticks in which the guard was active."""
    device_force = rows[rows[:, AT.servo_guard] == 0.0, AT.force + 2]
    return len(device_force) > 0 and np.ptp(device_force) == 0.0 and np.ptp(rows[:, AT.contact_normal_force]) == 0.0


def test_every_method_answers(rig):
    with running(rig()) as (daemon, control, recorder), events(daemon) as next_event:
        state = control.get_state()
        assert state.active_field == "pressed" and state.position[2] == 0.009
        assert state.force[2] == pytest.approx(1000.0 * DEPTH_M + 1.0, rel=ROUNDING)
        assert 0.0 <= time.monotonic() - state.timestamp < 60.0
        assert control.heartbeat().timeout_ms == 0
        changed = control.set_params({STIFFNESS: 500.0, PUSH: [0.0, 0.0, 1.0]})
        assert {key: (c.before, c.after) for key, c in changed.changed.items()} == {STIFFNESS: (1000.0, 500.0)}
        assert next_event("command", "set_params")["what"] == {STIFFNESS: {"from": 1000.0, "to": 500.0}}
        assert control.mark("trial 7", {"hand": "left"}).tick > 0
        message = next_event("mark")
        assert (message["label"], message["data"]) == ("trial 7", {"hand": "left"}) and message["command_id"]
        assert control.disarm().armed is False and next_event("command")["name"] == "disarm"
        assert control.arm().armed is True and next_event("command")["what"] == {"armed": True}
        moved = control.drive("lid.top", (0.0, 0.0, 0.0005))
        assert next_event("command", "drive")["what"] == {"object": "lid.top", "position_m": [0.0, 0.0, 0.0005]}
        recorder.wait_for_tick(moved.tick)
        # 0.5 mm of stroke towards the finger, on a spring of 500 N/m
        normal = pytest.approx(500.0 * (DEPTH_M + 0.0005), rel=ROUNDING)
        assert eventually(lambda: recorder.latest(AT.contact_normal_force) == normal)
        reply = control.describe()
        assert reply["scene"]["object"][0]["position_m"] == [0.0, 0.0, 0.0005] and reply["scene_name"] == "pressed"
        assert reply["rig"]["guard"]["force_slew_n_per_s"] == SLEW and set(reply["commands"]["methods"]) == set(METHODS)
        assert reply["wire"]["schema"] == 1 and reply["versions"]["numba"] and reply["compiled"]["model"]
        assert json.dumps(reply)
        set_scene = control.set_scene("frictionless-plane", {"object.0.material.stiffness_n_per_m": 900.0}, "ice")
        replaced = next_event("lifecycle")
        assert (replaced["name"], replaced["first"]) == ("replaced", set_scene.tick)
        assert next_event("command")["what"]["scene"] == "ice"
        assert control.get_state().active_field == set_scene.active_field == "ice"
        assert daemon.rendering.scene.object[0].material.stiffness_n_per_m == 900.0
        assert control.stop().shutting_down is True
        assert daemon.wait(60.0)


def test_a_parameter_changes_along_its_ramp(rig):
    with running(rig(**{"commands.ramp_s": 0.1})) as (daemon, control, recorder):
        first = daemon.servo.ticks
        changed = control.set_params({STIFFNESS: 500.0})
        assert (changed.changed[STIFFNESS].after, changed.ramp_s) == (500.0, 0.1)
        assert control.describe()["scene"]["object"][0]["material"]["stiffness_n_per_m"] == 500.0
        recorder.wait_for_tick(changed.tick + 110)
        normal = recorder.since(first - 1)[:, AT.contact_normal_force]
        assert control.get_state().force[2] == pytest.approx(500.0 * DEPTH_M + 1.0, rel=ROUNDING)
        control.set_params({STIFFNESS: 1500.0})
        turned = control.set_params({STIFFNESS: 1000.0})  # within the ramp, unless this thread is late
        recorder.wait_for_tick(turned.tick + 110)
        whole = recorder.since(first - 1)[:, AT.contact_normal_force]
    assert normal[0] == pytest.approx(1000.0 * DEPTH_M, rel=ROUNDING)
    assert normal[-1] == pytest.approx(500.0 * DEPTH_M, rel=ROUNDING)
    assert np.abs(np.diff(normal)).max() <= 500.0 * DEPTH_M / 100 * (1.0 + 1e-9)  # differences of about 1 in 200
    assert np.abs(np.diff(whole)).max() <= 1000.0 * DEPTH_M / 100 * (1.0 + 1e-9)
    assert whole[-1] == pytest.approx(1000.0 * DEPTH_M, rel=ROUNDING)


def test_events_of_every_command_are_recorded(rig, tmp_path):
    published = []
    with (
        running(rig(**{"recording.directory": str(tmp_path)})) as (daemon, control, _),
        subscribe(daemon.publisher.endpoint, ["event"]) as subscription,
    ):
        assert eventually(lambda: daemon.publisher.figures.subscribers == 1)
        control.record_start("all.mcap")

        def try_zero() -> Any:
            with contextlib.suppress(CommandRefused):  # while the force is fading out
                return control.zero((0.0, 0.0, 0.001))

        def assert_refused(request: Any) -> None:
            with pytest.raises(CommandRefused):
                request()

        requests = {
            "set_params": lambda: control.set_params({STIFFNESS: 500.0, PUSH: [0.0, 0.0, 1.0]}),
            "mark": lambda: control.mark("trial 7", {"hand": "left", "n": 1}),
            "set_prompt": lambda: control.set_prompt("trial 7", choices=("first", "second")),
            "get_prompt": control.get_prompt,
            "answer": lambda: control.answer("first"),
            "disarm": control.disarm,
            "zero": lambda: eventually(try_zero),
            "arm": control.arm,
            "drive": lambda: control.drive("lid.top", (0.0, 0.0, 0.0005)),
            "set_scene": lambda: control.set_scene("frictionless-plane"),
            "get_state": control.get_state,
            "describe": control.describe,
            "heartbeat": control.heartbeat,
            "reset_world": lambda: assert_refused(control.reset_world),
            "mesh": lambda: assert_refused(lambda: control.mesh(7)),
            "hand": lambda: assert_refused(lambda: control.hand((0.0, 0.0, 0.1))),
            "hold": lambda: assert_refused(control.hold),
        }
        for request in requests.values():
            request()
        assert set(METHODS) - set(requests) == {"record_start", "record_stop", "stop"}
        control.mark("the last")
        while not published or published[-1].get("label") != "the last":
            published.append(subscription.receive(60.0).as_map())
        stopped = control.record_stop()
    assert stopped.error == "" and stopped.dropped == 0
    assert eventually(lambda: summarize(tmp_path / "all.mcap")["whole"])
    recorded = [part.event for part in read_contents(tmp_path / "all.mcap") if isinstance(part, Event)]
    own = {"schema", "timestamp", "tick"}  # time of writing differs

    def select_comparable(events):
        """Return the events of commands without time and order; contact and guard events follow from ticks."""
        kinds, recording = ("command", "mark", "lifecycle"), ("record_start", "record_stop")
        recorder = [entry for entry in events if entry["kind"] in kinds and entry["name"] not in recording]
        return sorted(json.dumps({key: entry[key] for key in sorted(entry.keys() - own)}) for entry in recorder)

    assert len(select_comparable(published)) >= 8
    assert select_comparable(recorded) == select_comparable(published)


def test_a_telemetry_endpoint_selects_the_daemon_to_command(rig, tmp_path):
    """A client refuses to command another daemon; only `disarm`, the safe error, is sent before this check."""

    def on(telemetry: str, commands: str | None = None) -> Any:
        own = {} if commands is None else {"commands.endpoint": f"ipc://{tmp_path}/{commands}"}
        return running(rig(**{"telemetry.endpoint": f"ipc://{tmp_path}/{telemetry}", **own}))

    with on("one", "elsewhere") as (_, _, first), on("other", "one.commands") as (_, _, second):
        with (
            RemoteClient(f"ipc://{tmp_path}/one", timeout_s=WAIT_S) as client,
            pytest.raises(ConfigError, match=r"telemetry on ipc://.*/other, not on .*/one: give its command endpoint"),
        ):
            client.arm()
        assert first.force_n > 0.0 and second.force_n > 0.0
        with RemoteClient(f"ipc://{tmp_path}/one", f"ipc://{tmp_path}/elsewhere", timeout_s=WAIT_S) as client:
            client.disarm()
        assert eventually(lambda: first.force_n == 0.0) and second.force_n > 0.0
    with on("usual") as (_, _, recorder), RemoteClient(f"ipc://{tmp_path}/usual", timeout_s=WAIT_S) as client:
        assert (tmp_path / "usual.commands").stat().st_mode & 0o777 == 0o600
        client.disarm()
        assert eventually(lambda: recorder.force_n == 0.0)
    assert not (tmp_path / "usual.commands").exists()


def test_several_fingers_are_commanded_together(rig):
    """F_z = k d + f of each finger, armed and driven; another assignment of devices to fingers is refused."""
    device, scene = {"driver": "faulty"}, pressed_by_two()
    swapped = describe(scene)
    swapped["finger"].reverse()
    refused = [
        ("set_params", {"finger.0.device": "ring"}, "add [devices.ring]"),
        ("set_params", {"finger.0.name": "ring", "finger.0.device": "thumb"}, "name and device of a finger cannot be"),
        ("set_params", {"finger.thumb.radius_m": 0.01, "finger.0.radius_m": 0.01}, "set twice"),
        ("set_scene", {"scene": "sphere"}, "use a rig with [device]"),
        ("set_scene", {"scene": swapped}, "(index, thumb) differ from the running ones (thumb, index)"),
    ]
    with running(two_devices(device, device, guard=describe(rig())["guard"]), scene) as (_, control, recorder):

        def has_forces(*wanted: float) -> bool:
            forces = pytest.approx(wanted, rel=ROUNDING)
            return eventually(lambda: recorder.batches[-1][-1].reshape(2, -1)[:, AT.force + 2] == forces)

        assert has_forces(2.0, 1.5)
        assert control.get_state().force[2] == pytest.approx(2.0, rel=ROUNDING)
        reply = control.describe()
        assert [finger["name"] for finger in reply["fingers"]] == ["thumb", "index"]
        assert all(finger["device"] == reply["device"] for finger in reply["fingers"]) and reply["device"]["name"]
        control.set_params({STIFFNESS: 500.0})
        assert has_forces(1.5, 1.25)
        assert set(control.set_params({"finger.index.radius_m": 0.0105}).changed) == {"finger.index.radius_m"}
        assert has_forces(1.5, 1.75)
        control.drive("lid.top", (0.0, 0.0, 0.0005))
        assert has_forces(1.75, 2.0)
        control.disarm()
        assert has_forces(0.0, 0.0)
        control.arm()
        assert has_forces(1.75, 2.0)
        for method, params, words in refused:
            with pytest.raises(CommandRefused, match=r"^bad_params: ") as answer:
                control.ask(method, params)
            assert words in str(answer.value), answer.value
        assert has_forces(1.75, 2.0)
        control.set_scene(describe(scene))
        assert has_forces(2.0, 1.5)


REFUSED = [
    ("set_params", {"object.0.material.stiffness_n_per_m": -1.0}, "bad_params", "must be a number from 0.001"),
    ("set_params", {"object.0.material.stiffness_n_per_m": math.nan}, "bad_params", "must be a number"),
    ("set_params", {STIFFNESS: 800.0, "object.0.material.stifness": 1.0}, "bad_params", "did you mean 'stiffness"),
    ("set_params", {STIFFNESS: 800.0, "object.lid.colour": 1.0}, "bad_params", "object.lid"),
    ("set_params", {STIFFNESS: 800.0, "object.0.material.stiffness_n_per_m": 700.0}, "bad_params", "set twice"),
    ("set_params", {STIFFNESS: 800.0, "object.0.material.friction": {"static": 0.6, "kinetic": 0.5}}, "bad_params",
     "another model"),
    ("set_params", {STIFFNESS: 800.0, PUSH: [0.0, 0.0, 1e9]}, "bad_params", "effect[0].force_n"),
    ("set_params", {}, "bad_params", "length >= 1"),
    ("set_prompt", {"colour": "red"}, "bad_params", "colour: Expected `str` like #3366cc, or empty"),
    ("set_params", {"a" * 257: 1}, "bad_params", "length <= 256"),
    ("set_scene", {"scene": "sphre"}, "bad_params", "did you mean 'sphere'"),
    ("set_scene", {"scene": "/etc/passwd"}, "bad_params", "as a complete map"),
    ("set_scene", {"scene": {"object": []}}, "bad_params", "fingertip: is missing"),
    ("set_scene", {"scene": "sphere", "overrides": {"object.7.name": "x"}}, "bad_params", "there is no object[7]"),
    ("set_scene", {"scene": {"fingertip": {"radius_m": 0.01}, "world": {"model": "none.xml"}}}, "bad_params",
     "none.xml: cannot be read"),
    ("reset_world", {}, "refused", "no [world]"),
    ("drive", {"object": "table", "position_m": [0, 0, 0]}, "bad_params", "objects are lid.top"),
    ("drive", {"object": 1, "position_m": [0, 0, 0]}, "bad_params", "objects are lid.top"),
    ("drive", {"object": -1, "position_m": [0, 0, 0]}, "bad_params", ">= 0"),
    ("drive", {"object": 0, "position_m": [0, 0]}, "bad_params", "length 3"),
    ("drive", {"object": 0, "position_m": [0, 0, 1e9]}, "bad_params", "object[0].position_m"),
    ("drive", {"object": 0, "position_m": [0, 0, 0], "orientation_wxyz": [0, 0, 0, 0]}, "bad_params", "all zero"),
    ("arm", {"now": True}, "bad_params", "unknown field"),
    ("mark", {"label": ""}, "bad_params", "length >= 1"),
    ("mark", {"label": "x", "data": {"text": "y" * EVENT_BYTES_MAX}}, "bad_params", "more than 1024 bytes"),
    ("zero", {}, "refused", "disarm first"),
    ("zero", {"position_m": [0, 0, math.nan]}, "bad_params", "position_m"),
    ("zero", {"finger": "thumb"}, "bad_params", "there is no finger 'thumb'"),
    ("tare", {}, "unknown_method", "methods are get_state"),
]  # fmt: skip


def test_refused_commands_name_the_error_and_change_nothing(rig):
    with running(rig()) as (daemon, control, recorder):
        before, first = control.describe(), daemon.servo.ticks
        for method, params, name, words in REFUSED:
            with pytest.raises(CommandRefused, match=f"^{name}: ") as refused:
                control.ask(method, params)
            assert words in str(refused.value), refused.value
        after = control.describe()
        assert all(before[key] == after[key] for key in ("scene", "scene_name", "rig", "armed"))
        recorder.wait_for_tick(first + 20)
        assert unchanged(recorder.since(first))


def test_parameters_set_together_are_never_torn(rig):
    """k d + f is the same in every tick while both change every other tick; each pair is active for many ticks."""
    pairs = [(1000.0, 1.0), (500.0, 1.5), (250.0, 1.75), (1500.0, 0.5)]
    with running(rig()) as (daemon, control, recorder):
        first, requests = daemon.servo.ticks, 400
        for number in range(requests):
            stiffness, push = pairs[number % 4]
            tick = daemon.servo.ticks
            control.set_params({STIFFNESS: stiffness, PUSH: [0.0, 0.0, push]})
            while daemon.servo.ticks < tick + 2:
                time.sleep(0.0002)
        rows = recorder.since(first)
    rows = rows[rows[:, AT.servo_guard] == 0.0]
    normal = rows[:, AT.contact_normal_force]
    np.testing.assert_allclose(rows[:, AT.force + 2], 2.0, rtol=ROUNDING)
    assert np.isin(np.round(normal, 9), [k * DEPTH_M for k, _ in pairs]).all()
    assert np.count_nonzero(np.diff(normal)) > 0.5 * requests > 100


def test_disarm_fades_out_and_arm_fades_in(rig):
    with running(rig()) as (daemon, control, recorder):
        first = daemon.servo.ticks
        assert control.disarm().armed is False
        assert eventually(lambda: recorder.latest(AT.servo_guard) == DISARMED)
        silent = daemon.servo.ticks
        control.set_params({STIFFNESS: 2000.0})
        recorder.wait_for_tick(control.set_scene("frictionless-plane").tick + 100)
        assert not recorder.since(silent)[:, AT.force : AT.force + 3].any()
        armed = daemon.servo.ticks
        assert control.arm().armed is True
        assert eventually(lambda: recorder.force_n > 0.99)
        again = daemon.servo.ticks
        for _ in range(20):
            control.disarm()
            control.arm()
        assert eventually(lambda: recorder.force_n > 0.99)
        rows = recorder.since(first)
        rises = np.diff(np.linalg.norm(rows[:, AT.force : AT.force + 3], axis=1))
        rises = rises[rows[1:, AT.dt] <= PAUSE_MAX_S]  # after a stall the guard starts from zero
        assert rises.max() <= SLEW / 1000.0 * (1.0 + ROUNDING)
        rows = rows[(rows[:, AT.tick] >= armed) & (rows[:, AT.tick] < again)]
        fading = rows[(rows[:, AT.force + 2] > 0.0) & (rows[:, AT.force + 2] < 0.999)]
        # The ramp's ticks; the last one has the full force.
        assert len(fading) >= RAMP_S * 1000.0 - 1


def test_a_late_answer_is_not_assigned_to_the_next_request():
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        server.linger, server.rcvtimeo = 0, 10_000
        port = server.bind_to_random_port("tcp://127.0.0.1")

        def serve() -> None:
            for client, empty, body in [server.recv_multipart() for _ in range(2)]:
                request = msgpack.unpackb(body)
                answer = {"command_id": request["command_id"], "success": True, "result": {"of": request["method"]}}
                server.send_multipart([client, empty, msgpack.packb(answer)])

        serving = threading.Thread(target=serve)
        serving.start()
        with Control(f"tcp://127.0.0.1:{port}", 0.05) as control:
            with pytest.raises(NoAnswer):
                control.ask("first")
            control.timeout_s = 10.0
            assert control.ask("second") == {"of": "second"}
        serving.join()


def test_asyncio_client(rig):
    async def talk(endpoint: str) -> None:
        async with AsyncControl(endpoint, WAIT_S) as control:
            scene = asyncio.create_task(control.set_scene("frictionless-plane"))
            states = await asyncio.gather(*(control.get_state() for _ in range(20)))
            assert len(states) == 20
            assert (await scene).active_field == "frictionless-plane"
            with pytest.raises(CommandRefused, match=r"^refused: object ice is not driven"):
                await control.drive("ice", (0.0, 0.0, 0.0))
            assert (await control.disarm()).armed is False and (await control.stop()).shutting_down

    with running(rig()) as (daemon, _, _):
        asyncio.run(talk(daemon.commands_endpoint))
        assert daemon.wait(60.0)


def test_stop_ends_a_daemon_process(tmp_path):
    ends = ["--endpoint", "tcp://127.0.0.1:*", "--commands", f"ipc://{tmp_path}/c"]
    with Program([*COMMAND, "run", "--realtime", "off", *ends], stderr=subprocess.PIPE, text=True) as daemon:
        try:
            lines = []
            while not any(f"commands on ipc://{tmp_path}/c" in line for line in lines):
                lines.append(daemon.stderr.readline())
                assert lines[-1]

            def ctl(*arguments: str) -> VerbResult:
                return called("ctl", *arguments, "--endpoint", f"ipc://{tmp_path}/c", "--timeout", "240")

            state = ctl("get_state", "--json")
            while "no tick yet" in state.stderr:
                state = ctl("get_state", "--json")
            assert json.loads(state.stdout)["active_field"] == "paper-plane", state.stderr
            changed = ctl("set_params", "object.table.material.stiffness_n_per_m=800")
            assert changed.returncode == 0 and '"to": 800' in changed.stdout
            refused = ctl("set_params", "object.table.material.stiffness_n_per_m=hard")
            assert refused.returncode == 12 and "bad_params: " in refused.stderr
            assert "no such file" in ctl("set_scene", "scene=nosuch.toml").stderr
            assert ctl("mark", "label=go").returncode == 0
            assert "unknown method 'get_sate' (did you mean 'get_state'?)" in ctl("get_sate").stderr
            assert "write key=value" in ctl("mark", "label").stderr
            assert ctl("stop").stdout == "shutting_down: true\n"
            assert daemon.wait(60) == 0
        finally:
            daemon.kill()
    silent = run_program([*COMMAND, "ctl", "heartbeat", "--endpoint", f"ipc://{tmp_path}/c", "--timeout", "0.2"])
    assert silent.returncode == 9 and "softfinger run" in silent.stderr
