"""A box lifted from the page, in a browser: by the button, by one mouse with a wheel, and by two hands on keys.

Compiles the scene `lift-a-box`, as it is shipped.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from helpers.browser import Screen, eventually, why_none

from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import Daemon
from softfinger.server.remote import Client
from softfinger.server.viewer.gestures import LIFT_M
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.protocol import WORLD

pytestmark = [pytest.mark.real_time, pytest.mark.exhaustive, pytest.mark.skipif(bool(why_none()), reason=why_none())]

RIG = {"telemetry.endpoint": "tcp://127.0.0.1:*", "commands.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"}
RESTS_M = 0.02
"""Height of the middle of the box on the floor."""


@pytest.fixture(scope="module")
def daemon() -> Iterator[Daemon]:
    """Two hands that wait to be led, beside the box."""
    with Daemon(load_rig("simulated-hands", RIG), load_scene("lift-a-box"), scene_name="lift-a-box") as running:
        running.start()
        yield running


@pytest.fixture
def heights(daemon: Daemon) -> Iterator[object]:
    """How high the middle of the box is, m, whenever it is called."""
    with subscribe(daemon.publisher.endpoint, (WORLD,)) as samples:

        def height() -> float:
            newest = None
            while newest is None or (more := samples.receive(0.0)) is not None:
                newest = samples.receive(5.0) if newest is None else more
            return float(newest.data.bodies[0].position[2])

        yield height


@pytest.fixture(autouse=True)
def beside(client: Client, screen: Screen) -> None:
    """Each begins with the box on the floor and the hands beside it, and the camera where it was."""
    client.reset_world()  # first: the page draws anew
    for name, x in (("thumb", -0.04), ("index", 0.04)):
        client.hand((x, 0.0, 0.02), (1.0, 0.0, 0.0, 0.0), finger=name)
    assert eventually(lambda: abs(client.get_state().position[0] + 0.04) < 5e-4)
    screen.page.wait_for_timeout(3000.0)  # the page draws anew, and what it drew before takes no drag
    screen.tab("Hand")


def test_the_button_lifts_it(screen: Screen, heights) -> None:  # type: ignore[no-untyped-def]
    """As high as it says but for what the friction gives, and down again; the hands leave it."""
    screen.page.get_by_role("button", name="lift a box", exact=True).click()
    assert eventually(lambda: heights() > RESTS_M + 0.8 * LIFT_M)
    assert eventually(lambda: heights() < RESTS_M + 1e-3)
