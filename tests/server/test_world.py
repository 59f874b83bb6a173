"""Simulated bodies in the daemon: published poses and loads, agreement with `simulate`, and failing simulations.

Compiles a servo for a key on a spring, with friction and rolling.
"""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
from helpers.allocations import HAS_COMPILER, counted
from helpers.daemons import QUIET, RecordSink, make_daemon, subscribed
from helpers.key_world import KEY, ROLLING, key_world
from helpers.telemetry_records import join, put, synthetic
from helpers.waits import eventually
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from softfinger.config import schema
from softfinger.config.load import apply_overrides, load_rig, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy import record
from softfinger.proxy.elastic.deformed import Deformed
from softfinger.proxy.record import AT
from softfinger.server.app import Daemon
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import simulate
from softfinger.server.recording.compare import READ_FIELDS, compare, compare_run
from softfinger.server.recording.run import load_run
from softfinger.server.services.scene_topics import Deformation
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import DEFORMATION, decode

pytestmark = pytest.mark.real_time

PRESSED_M = 1e-3
"""Depth of the recording in the key at rest."""


@pytest.fixture
def scene(tmp_path: Path) -> schema.Scene:
    return load_scene({"fingertip": {"radius_m": 0.01}, "rolling": ROLLING, "world": key_world(tmp_path)})


def make_rig(**changes: Any) -> schema.Rig:
    return load_rig("replay", QUIET | {"commands.endpoint": "off", "device.recording": "tap"} | changes)


def receive_heights(endpoint: str) -> Iterator[tuple[int, float]]:
    with subscribe(endpoint, ("world",), timeout_s=20.0) as samples:
        for sample in samples:
            (body,) = sample.bodies
            assert body.name == "key"
            assert body.orientation == (1.0, 0.0, 0.0, 0.0) and body.rate == (0.0, 0.0, 0.0)
            yield sample.tick, body.position[2]


def test_a_pressed_body_moves_and_is_published(scene: schema.Scene, tmp_path: Path) -> None:
    ticks = 1100
    recorder = RecordSink()
    with Daemon(make_rig(), scene, ticks, sinks=[recorder.sink]) as running:
        running.recordings.record(tmp_path / "a.mcap", "key")
        published = []
        running.start()
        for tick, height in receive_heights(running.publisher.endpoint):
            published.append((tick, height + 0.01))
            if not running.servo.is_running or tick > ticks - 60:
                break
        assert running.wait(60.0)
    order = [tick for tick, _ in published]
    assert order == sorted(set(order)) and len(order) > 10
    share = 500.0 / (500.0 + 300.0)
    assert min(down for _, down in published) == pytest.approx(-share * PRESSED_M, rel=0.3)  # a tap, so it oscillates
    assert published[-1][1] > -1e-4

    records = recorder.all
    poses = resample(load_poses("tap"), 1000.0)[:ticks]
    offline = simulate(make_tuning(scene, make_rig().guard), poses, 1000.0)
    for field in (slice(AT.force, AT.force + 3), slice(AT.proxy_position, AT.proxy_position + 3)):
        np.testing.assert_array_equal(records[:, field], offline[: len(records), field])
    assert np.abs(records[:, AT.force + 2]).max() > 0.1

    past = load_run(tmp_path / "a.mcap", READ_FIELDS)
    assert past.bodies.names == ("key",)
    assert len(past.bodies.ticks) > 10 and np.ptp(past.bodies.poses[:, 0, 2]) > 0.3 * share * PRESSED_M
    now = compare_run(past, scene, make_rig())
    outcome = compare(past, now, {"": {}}, 0.0)
    assert (outcome.different, outcome.largest["key.position"]) == (0, 0.0)
    past.bodies.poses[5, 0, 2] += 1e-12
    first = compare(past, now, {"": {}}, 0.0).first
    assert (first.tick, first.key) == (past.bodies.ticks[5], "key.position[2]")


FULL = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" iterations="50"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.1"/>
    <body name="key" pos="0 0 -0.01">
      <joint type="slide" axis="0 0 1" stiffness="300" damping="1" frictionloss="0.01" limited="true" range="-0.1 0"/>
      <geom name="key" type="box" size="0.02 0.02 0.01" mass="0.05"/>
    </body>
    <body pos="0.1 0 -0.07"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
    <body pos="0.1 0.01 -0.02"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
    <body pos="-0.1 0 -0.05"><freejoint/><geom type="ellipsoid" size="0.02 0.03 0.01"/></body>
  </worldbody>
</mujoco>
"""
COUNT = """
import ctypes, sys
sys.path.insert(0, sys.argv[1])
from helpers.faulty_device import FaultyDevice, Options
from helpers.key_world import ROLLING, RUBBER
from softfinger.config.load import load_rig, load_scene
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tuning import make_tuning
shim = ctypes.CDLL(None)
shim.allocations.restype = ctypes.c_long
world = {"model": sys.argv[2], "geom": [{"name": "key", "material": RUBBER}]}
scene = load_scene({"fingertip": {"radius_m": 0.01}, "rolling": ROLLING, "world": world})
def count(ticks):
    seen, device = [], FaultyDevice(Options())
    def prepare():
        seen.append(shim.allocations())
        return lambda: seen.append(shim.allocations())
    servo = ServoThread([device], make_tuning(scene, load_rig("replay").guard, [device.info]), 1000.0, ticks, prepare)
    servo.compile()
    servo.start()
    assert servo.join(60.0).ending == 1
    servo.close()
    return seen[1] - seen[0], servo.tuning.scene.bodies.block.owner.data.ncon
count(10)
few, many = count(10), count(3000)
print(few[0], many[0], many[1])
"""


@pytest.mark.skipif(not HAS_COMPILER, reason="counting calls of malloc needs a C compiler to build the shim")
def test_the_step_of_bodies_allocates_nothing(tmp_path: Path) -> None:
    (tmp_path / "full.xml").write_text(FULL)
    few, many, contacts = map(int, counted(tmp_path, COUNT, str(Path(__file__).parents[1]), "full.xml").split())
    assert contacts > 4 and few > 0  # the shim does count: entering the loop from Python allocates
    assert many == few


HOME = """
  <actuator><motor joint="slide"/></actuator>
  <keyframe><key name="home" qpos="-0.015" ctrl="-4.5"/></keyframe>
</mujoco>
"""
"""The motor balances the spring: 300 N/m times 15 mm."""


def test_bodies_are_reset_by_command(scene: schema.Scene, tmp_path: Path) -> None:
    text = KEY.replace("<joint", '<joint name="slide"').replace("</mujoco>", HOME)
    (tmp_path / "key.xml").write_text(text)
    at_home = apply_overrides(scene, {"world.keyframe": "home"}, "test")
    with Daemon(make_rig(**{"commands.endpoint": f"ipc://{tmp_path}/c"}), at_home) as running:
        running.start()
        samples = receive_heights(running.publisher.endpoint)
        start_heights = [height for _, height in itertools.islice(samples, 5)]
        running.servo.tuning.scene.bodies.block.owner.data.ctrl[0] = 0.0
        assert next(height for _, height in samples if height > -0.015)
        with Control(f"ipc://{tmp_path}/c") as control:
            tick = control.reset_world().tick
        after = [height for at, height in itertools.islice(samples, 60) if at >= tick]
        assert len(after) > 10
        assert start_heights + after == pytest.approx([-0.025] * len(start_heights + after), abs=1e-9)


SLEW = 20.0
"""N/s, slow enough to see the force ramp to zero."""


def test_failing_bodies_are_released_and_reset(scene: schema.Scene, tmp_path: Path) -> None:
    recorder = RecordSink()
    changes = {"commands.endpoint": f"ipc://{tmp_path}/c", "guard.force_slew_n_per_s": SLEW, "guard.ramp_s": 0.1}
    with Daemon(make_rig(**changes), scene, sinks=[recorder.sink]) as running:
        running.start()
        with (
            Control(f"ipc://{tmp_path}/c") as control,
            subscribe(running.publisher.endpoint, ("event",), timeout_s=60.0) as events,
        ):
            resets = [control.reset_world().tick]
            while events.receive(0.1) is None:  # until the subscription is active
                control.mark("begin")
            for failure in ("huge value", "solver", "huge value"):
                owner = running.servo.tuning.scene.bodies.block.owner
                wait_for(running, running.servo.ticks + 1500)  # the key is pressed in each
                if failure == "huge value":
                    owner.data.qvel[0] = math.inf
                else:
                    owner.model.opt.solver = 77
                message = next(e.message for e in events if (e.kind, e.name) == ("fault", "bodies"))
                assert failure in message and "softfinger ctl reset_world" in message and "key.xml" in message
                let_go = running.servo.ticks
                wait_for(running, let_go + 1500)
                resets.append(control.reset_world().tick)
                together = recorder.all
                quiet = together[(together[:, AT.tick] > let_go + 100) & (together[:, AT.tick] < resets[-1])]
                assert len(quiet) > 1000
                assert not quiet[:, [AT.contact_mode, AT.force, AT.force + 1, AT.force + 2]].any()
            wait_for(running, resets[-1] + 1500)
            assert running.servo.is_running
    together = recorder.all
    force, tick = together[:, AT.force + 2], together[:, AT.tick]
    assert np.abs(np.diff(force)).max() <= SLEW * 1e-3 + 1e-12
    for begin in resets:
        forces = np.abs(force[(tick >= begin) & (tick < begin + 1400)])
        assert forces.max() > 0.05 and forces[0] <= SLEW * 1e-3


def wait_for(running: Daemon, ticks: int) -> None:
    """Wait until the servo has run this many ticks."""
    assert eventually(lambda: running.servo.ticks >= ticks or not running.servo.is_running) and running.servo.is_running


def test_bodies_that_exceed_the_tick_are_released(scene: schema.Scene) -> None:
    hasty = msgspec.structs.replace(scene, world=msgspec.structs.replace(scene.world, budget_us=1.0))
    with Daemon(make_rig(), hasty) as running:
        running.start()
        wait_for(running, 500)
        owner = running.servo.tuning.scene.bodies.block.owner
        assert "budget_us = 1;" in str(owner.failure)
        wait_for(running, running.servo.ticks + 50)


def test_a_step_by_address_equals_that_of_mujoco(scene: schema.Scene) -> None:
    tuning, away = make_tuning(scene, make_rig().guard), [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    owner = tuning.scene.bodies.block.owner
    owner.model.opt.gravity[2] = -9.81
    simulate(tuning, np.array([away] * 150), 1000.0)
    data = mujoco.MjData(owner.model)
    mujoco.mj_step1(owner.model, data)
    for _ in range(150):
        mujoco.mj_step2(owner.model, data)
        mujoco.mj_step1(owner.model, data)
    np.testing.assert_array_equal(owner.data.qpos, data.qpos)
    assert data.qpos[0] < -1e-4


FORCE = (0.1, -0.2, 1.5)


def make_press(count: int) -> Any:
    rows = synthetic(count)
    for name in ("contacts0.force", "contacts1.force", "contacts2.force", "contact.displacement"):
        put(rows, name, 0.0)
    pressing = rows[100 : count - 100]
    put(pressing, "contact.mode", record.ROLLING)
    put(pressing, "contact.object", 0)
    put(pressing, "contacts0.force", FORCE)
    put(pressing, "contacts0.point", (0.003, 0.002, -0.0005))
    put(pressing, "contact.displacement", (0.0, 0.0, -0.0005))
    put(pressing[200:], "contacts0.force", (0.1, -0.2, 1.5 + 1e-5))  # below the published resolution
    return rows


def test_loads_are_sent_when_they_change_and_recorded_as_they_are_sent(tmp_path: Path) -> None:
    changes = {"commands.endpoint": "off", "device.recording": "tap"}
    path, messages = tmp_path / "a.mcap", []
    with (
        make_daemon(scene="press-a-pad", changes=changes) as daemon,
        subscribed(daemon.publisher.endpoint, DEFORMATION, "event") as socket,
    ):
        daemon.recordings.record(path, "press-a-pad")
        join(daemon.publisher, socket)
        # The daemon is not started; these ticks arrive in batches as from a hand.
        for batch in np.array_split(make_press(600), 60):
            daemon.deformation.sink.take(batch, 0)
        daemon.publisher.event("test", "end")
        while (frames := socket.recv_multipart())[0] != b"event":
            messages.append(decode(*frames))
        sent: list[tuple[int, int]] = []

        def publish(topic: str, tick: int, content: dict[str, Any]) -> None:
            sent.append((tick, len(content["loads"])))

        changing = Deformation(daemon.rendering, [""], publish)
        rows = make_press(1200)
        rows[:, AT.contacts0_force] = np.linspace(1.0, 2.0, len(rows))
        for row in rows:
            changing.sink.take(row[None], 0)
        with subscribed(daemon.publisher.endpoint, DEFORMATION) as late:  # a late subscriber gets the last message
            assert late.poll(60_000) and decode(*late.recv_multipart()).loads == ()
    ticks = [tick for tick, count in sent if count]
    assert (ticks[0], sent[-1][1]) == (100, 0) and set(np.diff(ticks)) == {17}
    assert [len(message.loads) for message in messages] == [1, 0]
    assert messages[0].tick < 120 and 500 <= messages[1].tick < 520
    (load,) = messages[0].loads
    assert (load.finger, load.object, load.patch_radius) == ("", 0, 0.0075)
    # The object is at z = -0.02 m and not turned.
    assert load.force == pytest.approx([-x for x in FORCE], rel=1e-12)
    assert load.point == pytest.approx((0.003, 0.002, 0.02), abs=1e-12)

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        recorded = [(schema, message) for schema, _, _, message in reader.iter_decoded_messages(topics=[DEFORMATION])]
    assert {schema.name for schema, _ in recorded if schema is not None} == {"softfinger.Deformation"}
    assert [message.tick for _, message in recorded] == [message.tick for message in messages]
    assert tuple(recorded[0][1].loads[0].force) == load.force and not recorded[1][1].loads

    surface = Deformed.of_scene("press-a-pad")
    moved = surface.at(messages[0].loads) - surface.vertices
    deepest = int(moved[:, 2].argmin())
    assert np.linalg.norm(surface.vertices[deepest] - load.point) < load.patch_radius
    assert moved[deepest, 2] < -1e-4 and (surface.at(messages[1].loads) == surface.vertices).all()
