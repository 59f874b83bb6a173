"""A mesh and a height map from a running daemon, drawn in a browser and touched there."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from helpers.browser import Screen, coloured, eventually, why_none
from helpers.pages import daemon_of

from softfinger.server.remote import Client
from softfinger.server.viewer.nodes.looks import CM

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

GREY, WHITE = 240.0, 250.0
"""An object's colour is below GREY; the empty background is above WHITE."""
TRIANGLES = """name => {
    let found = 0;
    window.__viserMutable.nodeRefFromName[name]?.traverse(node => { found += (node.geometry?.index?.count ?? 0) / 3; });
    return found;
}"""
"""Triangles that are drawn, not those of the message."""


daemon = daemon_of("simulated-hand", "heightmap")


def count_triangles(screen: Screen) -> float:
    return float(screen.page.evaluate(TRIANGLES, "/objects/0"))


def get_colour(screen: Screen, point: tuple[float, float, float]) -> Any:
    box = screen.page.locator("canvas").first.bounding_box()
    x, y = screen.at((CM * point[0], CM * point[1], CM * point[2]))
    row, column = round(y - box["y"]), round(x - box["x"])
    return screen.picture()[row - 2 : row + 3, column - 2 : column + 3].mean(axis=(0, 1))


def touch_until_shown(screen: Screen, client: Client) -> bool:
    for height in np.arange(0.02, 0.0, -0.001).tolist():
        client.ask("hand", {"position_m": [0.0, 0.0, height]})
        time.sleep(0.1)
        if client.get_state().force[2] > 0.7:
            break
    assert client.get_state().field_state["object"] == 0
    return bool(eventually(lambda: screen.shows("sticking") and coloured(screen.picture())["blue"] > 60))


def test_a_height_map_is_drawn_and_touched(screen: Screen, client: Client) -> None:
    client.ask("hand", {"position_m": [0.0, 0.0, 0.02]})
    assert eventually(lambda: count_triangles(screen) == 2 * 63 * 63)
    assert eventually(lambda: get_colour(screen, (0.0, -0.03, 0.0)).max() < GREY)
    assert get_colour(screen, (0.025, 0.0, 0.03)).min() > WHITE
    assert touch_until_shown(screen, client)
