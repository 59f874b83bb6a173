"""Recordings with driven objects show them at their recorded poses."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from conftest import paper_mapping
from helpers.recorded import EPOCH_S, about, event, run

from softfinger.config.load import build, describe, load_scene
from softfinger.config.schema import Scene
from softfinger.server.recording.writer import RecordingFile
from softfinger.server.viewer.driven import DrivenPoses, RecordedBodies
from softfinger.server.viewer.page import Page
from softfinger.server.viewer.playback import RecordedPage, load

LID = {"name": "lid", "shape": "plane", "motion": {"kind": "driven"}, "position_m": [0.0, 0.0, 0.01]}
HALF = (0.5**0.5, 0.0, 0.0, 0.5**0.5)


def drive_event(tick: int, **changes: Any) -> dict[str, Any]:
    return event("command", "drive", tick, what=changes)


def test_events_set_the_poses_of_driven_objects() -> None:
    scene = build(Scene, paper_mapping(table=LID), "test scene")
    events = [
        drive_event(5, object="lid", position_m=[0.0, 0.0, 0.02], orientation_wxyz=list(HALF)),
        drive_event(6, object="chair", position_m=[1.0, 0.0, 0.0]),
        drive_event(7, object="lid", position_m="here"),
        drive_event(8, keys=2),
        event("command", "arm", 9, what={"object": "lid", "position_m": [1.0, 0.0, 0.0]}),
        drive_event(10, object="lid", position_m=[0.0, 1, 0.02]),
    ]
    drives = DrivenPoses(scene, events)
    rest, turned = ((0.0, 0.0, 0.01), (1.0, 0.0, 0.0, 0.0)), ((0.0, 0.0, 0.02), HALF)
    assert [drives.at(tick)[0] for tick in (0, 4, 5, 9)] == [rest, rest, turned, turned]
    assert drives.at(10) == {0: ((0.0, 1.0, 0.02), HALF)}
    assert DrivenPoses(load_scene("paper-plane"), events).at(10) == {}


def test_bodies_of_a_recording_have_their_recorded_poses(tmp_path: Path) -> None:
    scene = load_scene("turn-a-knob")
    file = tmp_path / "turned.mcap"
    with file.open("wb", buffering=0) as out:
        recording = RecordingFile(out, ("",), about(scene=describe(scene), scene_name="turn-a-knob"))
        recording.ticks(run())
        for tick, turn in ((100, (1.0, 0.0, 0.0, 0.0)), (500, HALF)):
            body = {"name": "knob", "position": (0.0, 0.0, 0.0075), "orientation": turn}
            body |= {"velocity": (0.0, 0.0, 0.0), "rate": (0.0, 0.0, 0.0)}
            world = {"schema": 1, "timestamp": EPOCH_S + tick / 1000.0, "tick": tick, "bodies": [body]}
            recording.message("world", world)
        recording.close()
    loaded = load(str(file), None)
    assert RecordedBodies(loaded.worlds).at(99) == {}
    with closing(Page("127.0.0.1", 0)) as page:
        for tick, pointer in ((499, (0.026, 0.0)), (500, (0.0, 0.026)), (1500, (0.0, 0.026))):
            RecordedPage(page, loaded, tick).step(0.0)
            assert page.bodies is not None
            np.testing.assert_allclose(page.bodies.poses[-1][0], [*pointer, 0.0085], atol=1e-9)
