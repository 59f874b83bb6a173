"""A box lifted in a browser by button, mouse and keys; compiles the shipped scene `lift-a-box`."""

import time
from collections.abc import Iterator

import numpy as np
import pytest
from helpers.browser import Screen, eventually, why_none
from helpers.pages import daemon_of

from softfinger.server.app import Daemon
from softfinger.server.remote import Client
from softfinger.server.viewer.hand import TARGET_VALID_S
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.protocol import WORLD

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

GRIP_N, NOTCHES = 2.0, 20
"""Notches of the wheel, or key strokes, of 1 mm: 10 to the box and 10 into it, at 3 mm/N of contact and hand."""
RESTS_M = 0.02
"""Height of the centre of the box on the floor."""


daemon = daemon_of("simulated-hands", "lift-a-box")


@pytest.fixture
def heights(daemon: Daemon) -> Iterator[object]:
    with subscribe(daemon.publisher.endpoint, (WORLD,)) as samples:

        def height() -> float:
            newest = None
            while newest is None or (more := samples.receive(0.0)) is not None:
                newest = samples.receive(5.0) if newest is None else more
            return float(newest.data.bodies[0].position[2])

        yield height


@pytest.fixture(autouse=True)
def hands_next_to_box(client: Client, screen: Screen) -> None:
    """Each test starts with the box on the floor and the hands next to it. The page may still move the hands: a gesture
    opens them after the box is down, and the end of a drag may arrive late. So the fixture repeats until they stay
    longer than the page remembers its targets."""

    def stay() -> bool:
        for name, x in (("thumb", -0.04), ("index", 0.04)):
            client.hand((x, 0.0, 0.02), (1.0, 0.0, 0.0, 0.0), finger=name)
        time.sleep(TARGET_VALID_S + 0.5)
        return abs(client.get_state().position[0] + 0.04) < 5e-4

    assert eventually(stay)
    client.reset_world()
    screen.tab("Hand")


def test_a_pinch_with_the_wheel_lifts_the_box(screen: Screen, client: Client, heights) -> None:
    mouse, keyboard = screen.page.mouse, screen.page.keyboard
    x, y = screen.at(tuple(CM * np.array(client.get_state().position)))
    corner = screen.at((0.0, 0.0, 0.0))
    keyboard.down("Shift")
    mouse.move(x, y)
    mouse.down()
    mouse.move(x, y - 4)
    for _ in range(NOTCHES):
        mouse.wheel(0, 100)
        screen.page.wait_for_timeout(100.0)
    assert eventually(lambda: client.get_state().force[0] < -GRIP_N)
    assert screen.at((0.0, 0.0, 0.0)) == pytest.approx(corner, abs=0.5)
    for distance in range(8, 90, 4):
        mouse.move(x, y - distance)
    assert eventually(lambda: heights() > RESTS_M + 0.015)
    for _ in range(NOTCHES):
        mouse.wheel(0, -100)
    assert eventually(lambda: heights() < RESTS_M + 1e-3)
    mouse.up()
    keyboard.up("Shift")


def test_a_drag_continues_while_the_world_is_reset(screen: Screen, client: Client) -> None:
    mouse = screen.page.mouse
    x, y = screen.at(tuple(CM * np.array(client.get_state().position)))
    mouse.move(x, y)
    mouse.down()
    for distance in (4, 8, 12):
        mouse.move(x - distance, y)
    assert eventually(lambda: client.get_state().position[0] < -0.042)
    began = client.describe()["since"]
    client.reset_world()
    assert eventually(lambda: client.describe()["since"] > began)
    screen.page.wait_for_timeout(1000.0)  # time in which it would be recreated
    for distance in (16, 20, 24):
        mouse.move(x - distance, y)
    assert eventually(lambda: client.get_state().position[0] < -0.046)
    mouse.up()


def test_two_hands_on_keys_lift_the_box(screen: Screen, client: Client, heights) -> None:
    keyboard = screen.page.keyboard
    corner = screen.at((0.0, 0.0, 0.0))
    for _ in range(NOTCHES):
        keyboard.press("d")
        keyboard.press("j")
    assert eventually(lambda: client.get_state().force[0] < -GRIP_N)
    keyboard.down("e")
    keyboard.down("u")
    lifted = eventually(lambda: heights() > RESTS_M + 0.02, every_s=0.02)
    keyboard.up("e")
    keyboard.up("u")
    assert lifted
    assert screen.at((0.0, 0.0, 0.0)) == pytest.approx(corner, abs=0.5)
    assert all(screen.shows(word) for word in ("left hand", "right hand", "wheel"))
