"""Several fingers and a driven object in a browser: the page draws the poses of the daemon."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from helpers.browser import Screen, eventually, why_none
from helpers.two_fingers import NAMES, two_devices, two_fingers

from softfinger.server.app import Daemon
from softfinger.server.remote import Client
from softfinger.server.viewer.driven import CONTROL_SIZE_CM
from softfinger.server.viewer.nodes.looks import CM

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

MATERIAL = {"stiffness_n_per_m": 1000.0}
TABLE = {"name": "table", "shape": "plane", "material": MATERIAL}
LID = {
    "name": "lid",
    "shape": "box",
    "position_m": [0.0, 0.0, 0.06],
    "size_m": [0.02, 0.02, 0.02],
    "motion": {"kind": "driven"},
    "material": MATERIAL,
}
NODE = "name => window.__viserMutable.nodeRefFromName[name]?.position.toArray()"
"""Position of the drawn node, not of the message."""


@pytest.fixture(scope="module")
def daemon() -> Iterator[Daemon]:
    hand = {"driver": "simulated", "recording": "tap", "loop": True}
    rig = two_devices(hand, hand, commands={"endpoint": "tcp://127.0.0.1:*"})
    with Daemon(rig, two_fingers(object=[TABLE, LID]), scene_name="two") as running:
        running.start()
        yield running


def is_at(screen: Screen, node: str, place: list[float], within_m: float) -> bool:
    position: Any = screen.page.evaluate(NODE, node)
    return position is not None and bool(np.allclose(np.array(position) / CM, place, atol=within_m))


def test_each_finger_has_a_ball_that_moves_independently(screen: Screen, client: Client) -> None:
    assert eventually(lambda: all(screen.shows(f"{name}: ") for name in NAMES))
    places = {"thumb": [0.03, 0.0, 0.04], "index": [-0.03, 0.01, 0.05]}
    for name, place in places.items():
        client.ask("hand", {"finger": name, "position_m": place})
    for name, place in places.items():
        tip = f"/fingers/{name}/tip"
        assert eventually(lambda tip=tip, place=place: is_at(screen, tip, place, 1e-3)), name
    client.ask("hand", {"finger": "thumb", "release": True})


def get_lid(client: Client) -> list[float]:
    position: list[float] = client.describe()["scene"]["object"][1]["position_m"]
    return position


def pull(screen: Screen, client: Client) -> None:
    x, y, z = (CM * part for part in get_lid(client))
    screen.drag(screen.at((x + 0.7 * CONTROL_SIZE_CM, y, z)), (40.0, 0.0))


def test_handles_drive_an_object(screen: Screen, client: Client) -> None:
    assert eventually(lambda: is_at(screen, "/objects/1", [0.0, 0.0, 0.06], 1e-6))
    client.ask("drive", {"object": "lid", "position_m": [-0.02, 0.0, 0.03]})
    assert eventually(lambda: is_at(screen, "/objects/1", [-0.02, 0.0, 0.03], 1e-6))
    assert screen.page.evaluate(NODE, "/handles/1") is None
    screen.tab("Hand")
    screen.page.get_by_label("move objects").click()
    assert eventually(lambda: is_at(screen, "/handles/1", [-0.02, 0.0, 0.03], 1e-6))
    assert screen.page.evaluate(NODE, "/handles/0") is None

    def moved() -> bool:
        pull(screen, client)
        return get_lid(client)[0] > -0.015

    assert eventually(moved, every_s=1.0)
    assert get_lid(client)[1:] == pytest.approx([0.0, 0.03], abs=1e-6)
    assert eventually(lambda: is_at(screen, "/objects/1", get_lid(client), 1e-5))
