"""Shipped scenes with moving bodies, each played by its simulated hand and checked by mechanics and energy."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.called import read_stdout
from helpers.simulated_hands import DT, SimulatedHands
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from softfinger.config.load import describe, load_rig, load_scene
from softfinger.config.schema import Rig, Scene
from softfinger.config.sources import FOLDERS, list_shipped
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.scene import build_scene
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.scene_messages import SceneMessages
from softfinger.server.offline.simulate import simulate
from softfinger.server.recording.writer import list_package_versions
from softfinger.server.viewer.driven import RecordedBodies
from softfinger.server.viewer.playback import load

pytestmark = pytest.mark.plain
PLAIN_ONLY = pytest.mark.skipif(not PLAIN, reason="would compile a minute for each scene; `make test` plays them")

RADIUS = 0.01
G = 9.81


def test_every_scene_with_bodies_has_hands_that_play_it() -> None:
    worlds = [name for name in list_shipped(Scene) if "[world]" in (FOLDERS[Scene] / f"{name}.toml").read_text("utf-8")]
    assert len(worlds) == 8 and {f"simulated-{name}" for name in worlds} <= set(list_shipped(Rig))


@PLAIN_ONLY
def test_torsion_turns_a_knob() -> None:
    hands = SimulatedHands("turn-a-knob")
    hands.until(2.9)
    lag = 0.002 / 0.05  # friction of the bearing over the torsional stiffness
    assert hands.data.qpos[0] == pytest.approx(1.0 - lag, abs=1e-3)  # MuJoCo's friction yields by 0.0004


@PLAIN_ONLY
def test_without_torsion_a_knob_does_not_turn() -> None:
    scene = describe(load_scene("turn-a-knob"))
    del scene["world"]["geom"][0]["material"]["torsion"]
    del scene["object"]  # the geoms, with their torsion
    hands = SimulatedHands("turn-a-knob", scene)
    records = hands.until(1.9)[""]
    assert records["contact.normal_force"].max() > 1.0
    assert hands.data.qpos[0] == 0.0


@PLAIN_ONLY
def test_a_drawer_is_pulled_open_and_pushed_shut() -> None:
    hands = SimulatedHands("open-a-drawer")
    last = hands.until(2.9)[""][-1]
    inner_face = 0.024  # of the handle, shut: 5 mm before the finger
    depth = last["force"][1] / 1000.0
    assert 0.0 < depth <= 0.4 / 1000.0  # friction balances the remaining pull
    opened = inner_face - (last["probe.position"][1] - RADIUS + depth)
    assert hands.data.qpos[0] == pytest.approx(opened, abs=2e-5)  # MuJoCo's friction creeps
    assert opened == pytest.approx(0.094, abs=1e-3)
    hands.until(4.8)
    assert hands.data.qpos[0] == pytest.approx(0.0, abs=1e-4)


@PLAIN_ONLY
def test_a_door_follows_the_finger_and_closes_by_its_spring() -> None:
    hands = SimulatedHands("open-a-door")
    last = hands.until(2.2)[""][-1]
    x, y = last["probe.position"][:2] - np.array([-0.08, 0.0])  # from the hinge
    angle = hands.data.qpos[0]
    face, along = -(y * math.cos(angle) - x * math.sin(angle)), y * math.sin(angle) + x * math.cos(angle)
    assert face == pytest.approx(RADIUS + 0.004 - last["contact.penetration"], abs=1e-5)
    sideways = last["contact.tangential_force"] * 0.004  # friction acts on the face, in front of the hinge
    assert last["contact.normal_force"] * along == pytest.approx(0.06 * angle, abs=sideways + 1e-4)
    assert angle > math.radians(25.0)
    hands.until(4.6)
    assert abs(hands.data.qpos[0]) < 1e-3


@PLAIN_ONLY
def test_a_button_clicks_at_the_load_of_its_dome() -> None:
    depth = np.linspace(0.0, 0.003, 3001)
    height = 0.0015 - depth
    side = np.hypot(0.006, height)
    dome = 14000.0 * (2.0 * math.hypot(0.006, 0.0015) - 2.0 * side) * 2.0 * height / side
    force = 600.0 * depth + dome - 0.02 * G
    top = int(force[:1500].argmax())
    hands = SimulatedHands("press-a-button")
    pressed = hands.until(1.9)[""]["force"][:, 2]
    assert pressed[:1500].max() == pytest.approx(force[top], rel=0.03)  # pressed with up to 8 mm/s, against dampers
    snap = int(pressed.argmax())
    assert pressed[snap : snap + 60].min() < 0.75 * pressed[snap]
    assert hands.data.qpos[0] < -0.002
    hands.until(3.1)
    assert hands.data.qpos[0] > -0.0003


@PLAIN_ONLY
def test_a_pencil_rolls_half_as_far_as_the_finger() -> None:
    hands = SimulatedHands("roll-a-pencil")
    start = hands.until(1.15)[""]["probe.position"][-1, 0]
    place, turn = hands.data.qpos[0], 2.0 * math.atan2(hands.data.qpos[5], hands.data.qpos[3])
    end = hands.until(2.35)[""]["probe.position"][-1, 0]
    rolled = 2.0 * math.atan2(hands.data.qpos[5], hands.data.qpos[3]) - turn
    travel = hands.data.qpos[0] - place
    assert end - start > 0.0099 and travel == pytest.approx(0.5 * (end - start), rel=0.02)
    sunk = 0.004 - hands.data.qpos[2]  # into MuJoCo's soft table, so that it rolls on a smaller radius
    assert travel / 0.004 < rolled < travel / (0.004 - sunk)


@PLAIN_ONLY
def test_a_ball_rolls_back_and_rests_at_the_bottom() -> None:
    """Its oscillation takes 2 pi sqrt(7 (R - r) / (5 g)); friction and facets limit its rest position."""
    hands = SimulatedHands("ball-in-a-bowl")
    hands.until(2.15)
    assert hands.data.qpos[0] > 0.005  # pushed up the side and rolling back
    crossed = []
    for tick in range(2150, 3100, 5):
        before = hands.data.qpos[0]
        hands.until(1e-3 * tick + 5e-3)
        if before > 0.0 >= hands.data.qpos[0]:
            crossed.append(tick)
    period = 2.0 * math.pi * math.sqrt(7.0 * (0.1 - 0.015) / (5.0 * G))
    assert 1e-3 * (crossed[1] - crossed[0]) == pytest.approx(period, rel=0.05)  # the bowl has facets of 2 mm
    hands.until(6.2)
    # rolling friction of 0.1 mm, and half a facet's slope
    bound = (0.0001 / 0.015 + 0.5 * 0.002 / 0.1) * (0.1 - 0.015)
    assert np.hypot(*hands.data.qpos[:2]) < bound and np.abs(hands.data.qvel[:3]).max() < 0.01


@pytest.mark.exhaustive
def test_three_boxes_are_stacked_and_stay() -> None:
    hands = SimulatedHands("stack-boxes")
    records = hands.until(4.3)
    assert all(record["force"][-1].tolist() == [0.0, 0.0, 0.0] for record in records.values())
    boxes = hands.data.xpos[1:]
    soft = 0.0004  # MuJoCo's contacts under the weight above
    for place, (x, y, z) in enumerate(boxes):
        assert (x, y) == pytest.approx((0.0, 0.06), abs=2e-4)
        assert z == pytest.approx(0.015 + 0.03 * place, abs=soft * (place + 1))
    upright = hands.data.xmat[1:].reshape(3, 3, 3)[:, 2, 2]
    assert np.degrees(np.arccos(np.clip(upright, -1.0, 1.0))).max() < 0.5
    assert np.abs(hands.data.qvel).max() < 1e-3


SECONDS = {
    "turn-a-knob": 1.0, "open-a-drawer": 1.5, "open-a-door": 1.0, "press-a-button": 1.5, "roll-a-pencil": 1.0,
    "ball-in-a-bowl": 1.8, "lift-a-box": 1.0, "stack-boxes": 1.5,
}  # fmt: skip
"""Time (s) until each hand has pressed, rolled or pushed for some tenths of a second."""


@PLAIN_ONLY
@pytest.mark.parametrize(
    "name",
    [
        scene_id if scene_id == "turn-a-knob" else pytest.param(scene_id, marks=pytest.mark.exhaustive)
        for scene_id in SECONDS
    ],
)
def test_scenes_played_by_hands_are_replayed_exactly(name: str, tmp_path: Path) -> None:
    file, seconds = str(tmp_path / "run.mcap"), SECONDS[name]
    hands = ["--scene", name, "--device", "simulated", "--duration", str(seconds)]
    assert "no contact" not in read_stdout("simulate", *hands, "--out", file)
    replay, scene = ["replay", file, "--tolerance", "0", "--json"], ["--scene", name, "--rig", f"simulated-{name}"]
    content = json.loads(read_stdout(*replay, *scene))
    assert content["equal"] and content["compared"] == round(seconds / DT)
    assert json.loads(read_stdout(*replay)) == content  # the file has scene and rig


@PLAIN_ONLY
def test_simulate_stores_the_poses_of_bodies(tmp_path: Path) -> None:
    file, name = tmp_path / "run.mcap", "turn-a-knob"
    read_stdout("simulate", "--scene", name, "--device", "simulated", "--duration", "1.5", "--out", str(file))
    with file.open("rb") as opened:
        decoded = make_reader(opened, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        messages = [(channel.topic, message.log_time, data) for _, channel, message, data in decoded]
    worlds = [(time_ns, data) for topic, time_ns, data in messages if topic == "world"]
    ticks = [data.tick for _, data in worlds]
    assert ticks[:3] == [0, 17, 34] and set(np.diff(ticks[:-1])) == {16, 17} and ticks[-1] == 1499
    hands = SimulatedHands(name)
    for time_ns, data in worlds[::10]:
        (body,) = data.bodies
        hands.until((data.tick + 1) * DT)
        assert time_ns == round(data.tick * DT * 1e9)
        assert body.name == "knob" and list(body.orientation) == hands.data.xquat[1].tolist()
        assert body.rate[2] == pytest.approx(hands.data.qvel[0], abs=1e-12)
    frames = [data.rotation for topic, _, data in messages if topic == "tf" and data.child_frame_id == "body/knob"]
    assert [turn.z for turn in frames] == [data.bodies[0].orientation[3] for _, data in worlds]
    assert frames[0].z == 0.0 and abs(frames[-1].z) > 0.01
    recording = load(str(file), None)
    assert recording.scene == load_scene(name) and recording.name == name
    assert recording.notes["versions"] == list_package_versions()
    assert RecordedBodies(recording.worlds).at(1499)["knob"][1] == tuple(worlds[-1][1].bodies[0].orientation)


def test_messages_of_an_elastic_object_follow_its_loads() -> None:
    scene, tuning = load_scene("press-a-pad"), load_scene("paper-plane")
    records = np.zeros((200, 1, RECORD_SIZE))
    records[:, 0, AT.tick] = np.arange(200)
    records[40:70, 0, AT.contact_mode] = 1.0
    records[40:70, 0, AT.contacts0_force + 2] = 0.5
    messages = SceneMessages(scene, 1000.0)
    parts = [(first, part.stop - part.start) for first, part in messages.split(build_scene(tuning), 0, records)]
    assert sum(count for _, count in parts) == 200 and parts[:3] == [(0, 1), (1, 17), (18, 17)]
    sent = [(topic, content["tick"], len(content["loads"])) for topic, content in messages.pending]
    assert sent == [("deformation", 50, 1), ("deformation", 84, 0)]


R, HALF, MASS, STIFFNESS, PRESS = 0.008, 0.02, 0.1, 500.0, 3.0
BOX = f"""
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="box" pos="0 0 {HALF}">
      <freejoint/><geom name="box" type="box" size="0.02 0.02 0.02" mass="{MASS}"/>
    </body>
  </worldbody>
</mujoco>
"""
SCENE: dict[str, Any] = {
    "finger": [{"name": name, "radius_m": R} for name in ("thumb", "index")],
    "coupling": {
        "stiffness_n_per_m": STIFFNESS, "damping_ns_per_m": 1.0, "torsional_damping_nms_per_rad": 1.5e-3,
    },
    "rolling": {"method": "midpoint"},
    "passivity": {"mode": "observe"},
}  # fmt: skip
MATERIAL = {
    "stiffness_n_per_m": STIFFNESS,
    "damping_ns_per_m": 2.0,
    "friction": {"static": 0.8, "kinetic": 0.7},
    "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
}
RISE = 0.05


def make_transition(ticks: NDArray[np.int64], first: int, length: int) -> NDArray[np.float64]:
    """Return a transition from 0 to 1 with continuous acceleration."""
    u = np.clip((ticks - first) / length, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


@PLAIN_ONLY
def test_lowering_a_box_and_a_closed_cycle_generate_no_contact_energy(tmp_path: Path) -> None:
    (tmp_path / "box.xml").write_text(BOX)
    scene = load_scene(SCENE | {"world": {"model": str(tmp_path / "box.xml"), "material": MATERIAL}})
    ticks = np.arange(1200)
    poses = np.zeros((len(ticks), 2, 7))
    depth = PRESS / STIFFNESS * (make_transition(ticks, 0, 100) - make_transition(ticks, 1000, 100))
    for finger, side in enumerate((-1.0, 1.0)):
        poses[:, finger, 0], poses[:, finger, 3] = side * (HALF + R + 1e-3 - depth * (1.0 + 1e-3 / depth.max())), 1.0
        poses[:, finger, 2] = HALF + RISE * (make_transition(ticks, 200, 300) - make_transition(ticks, 600, 300))
    records = simulate(make_tuning(scene, load_rig("replay", {"guard.ramp_s": 0.01}).guard), poses, 1000.0)
    observed, force = records[:, :, AT.passivity_energy], records[:, :, AT.force : AT.force + 3]
    by_hands = -np.einsum("tfi,tfi->tf", force[:-1], np.diff(poses[:, :, :3], axis=0)).cumsum(axis=0)
    weight = 0.5 * MASS * 9.81 * RISE
    lifted, lowered = by_hands[550] - by_hands[150], by_hands[950] - by_hands[550]
    np.testing.assert_allclose(lifted, weight, rtol=0.05)  # plus the work of the dampers
    np.testing.assert_allclose(lowered, -weight, rtol=0.05)
    assert np.ptp(observed[150:950], axis=0).max() < 0.05 * weight  # the sag is 0.4 mJ, the dampers take 0.5 mJ
    assert observed.min() > -1e-9
    assert (by_hands[-1] > 0.0).all() and not force[-1].any()
