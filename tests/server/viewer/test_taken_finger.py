"""A finger of simulated hands that lift a box, taken over in a browser: the box does not fall."""

from __future__ import annotations

import pytest
from helpers.browser import Screen, eventually, why_none
from helpers.pages import daemon_of

from softfinger.server.app import Daemon
from softfinger.server.remote import Client
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.protocol import WORLD

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

HIGH_M = 0.06


daemon = daemon_of("simulated-lift-a-box", "lift-a-box")


def test_taking_one_finger_holds_the_box(daemon: Daemon, screen: Screen, client: Client) -> None:
    screen.tab("Hand")
    with subscribe(daemon.publisher.endpoint, (WORLD,)) as samples:

        def height() -> float:
            newest = samples.receive(5.0)
            while (more := samples.receive(0.0)) is not None:
                newest = more
            return float(newest.data.bodies[0].position[2])

        def pass_ticks(count: int) -> None:
            begin = client.get_state().sequence
            assert eventually(lambda: client.get_state().sequence > begin + count)

        def take_finger() -> bool:
            """Return True if the page was fast enough: the hands put the box down soon."""
            if height() < HIGH_M:
                return False
            screen.page.keyboard.press("w")
            pass_ticks(2000)
            if height() < HIGH_M:
                screen.page.get_by_role("button", name="let go", exact=True).click()
                return False
            return True

        assert eventually(take_finger, every_s=0.0)
        hangs = height()
        assert client.get_state().force[0] < -1.0
        pass_ticks(3000)  # long enough for the hands to put it down
        assert height() == pytest.approx(hangs, abs=2e-4)
