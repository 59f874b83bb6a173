"""Buttons of the page, tested in a browser with telemetry: gestures, gap, scale of arrows, light and dark."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.browser import Screen, eventually, why_none
from helpers.pages import daemon_of

from softfinger.server.remote import Client
from softfinger.server.viewer.gestures import ONE_FINGER, PRESS_N
from softfinger.server.viewer.nodes.looks import CM

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

RADIUS_M = 0.01


daemon = daemon_of("simulated-hand", "paper-plane")


def play(screen: Screen, name: str, client: Client) -> None:
    """Play a gesture, and wait until the finger has pressed and has left the plane."""
    screen.tab("Hand")
    button = screen.page.get_by_role("button", name=name, exact=True)
    button.focus()
    screen.page.keyboard.press("Enter")
    assert eventually(lambda: client.get_state().force[2] > 0.5 * PRESS_N), name
    assert eventually(lambda: client.get_state().force[2] == 0.0), name


def test_each_button_plays_its_gesture(screen: Screen, client: Client) -> None:
    """test_gestures.py shows the motion of each."""
    for name in ONE_FINGER:
        play(screen, name, client)


def test_a_key_stroke_cancels_a_gesture(screen: Screen, client: Client) -> None:
    screen.tab("Hand")
    start = client.get_state().position[2]
    screen.page.get_by_role("button", name="press", exact=True).click()
    screen.page.keyboard.press("u")
    place = np.array(client.get_state().position)
    assert eventually(lambda: _is_resting(client)), place
    assert client.get_state().force[2] == 0.0 and client.get_state().position[2] > 0.5 * start


def _is_resting(client: Client) -> bool:
    before = client.get_state()
    eventually(lambda: client.get_state().sequence > before.sequence + 1000)
    return float(np.linalg.norm(np.subtract(client.get_state().position, before.position))) < 1e-4


def test_lifting_a_box_needs_two_fingers(screen: Screen) -> None:
    screen.tab("Hand")
    screen.page.get_by_role("button", name="lift a box", exact=True).click()
    assert eventually(lambda: screen.shows("this needs two fingers and a box"))
    assert screen.shows("run --scene lift-a-box --view")


def test_gap_shadow_and_scale_are_shown(screen: Screen, client: Client) -> None:
    def is_right() -> bool:
        """Friction of the device stops the hand some hundredths of a millimetre from its target."""
        (shown,) = re.findall(r"gap (\d+\.\d) mm", screen.page.inner_text("body"))
        height = 1e3 * (client.get_state().position[2] - RADIUS_M)
        return height > 19.0 and float(shown) == pytest.approx(height, abs=0.06)

    client.hand((0.01, 0.0, 0.03), (1.0, 0.0, 0.0, 0.0))
    assert eventually(is_right)
    assert eventually(lambda: screen.shows("arrow: 0.3 N/cm"))
    x, y = screen.at((CM * 0.01, 0.0, 0.0))
    box = screen.page.locator("canvas").first.bounding_box()

    def shaded() -> bool:
        """A shadow has about 1000 pixels here; lines of its colour have some hundred."""
        row, column = round(y - box["y"]), round(x - box["x"])
        part = screen.picture()[max(row - 40, 0) : row + 40, max(column - 40, 0) : column + 40]
        return int(((part.max(axis=2) < 150) & (np.ptp(part, axis=2) < 40)).sum()) > 300

    assert eventually(shaded)
    client.hand((0.0, 0.0, 0.006), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: screen.shows("gap 0.0 mm"))
    client.hand((0.0, 0.0, -0.05), (1.0, 0.0, 0.0, 0.0))  # limited by the guard to 12 N: 60 mm at 2 N/cm
    assert eventually(lambda: client.get_state().force[2] > 10.1)
    assert eventually(lambda: screen.shows("arrow: 5 N/cm"))
    client.hand((0.0, 0.0, 0.02), (1.0, 0.0, 0.0, 0.0))


def brightness(screen: Screen) -> float:
    return float(screen.picture()[:20, :20].mean())


def test_light_and_dark_follow_the_browser_until_the_switch_is_used(screen: Screen) -> None:
    page = screen.page
    switch = page.get_by_role("switch", name="dark look")
    page.emulate_media(color_scheme="light")
    assert eventually(lambda: brightness(screen) > 240) and switch.get_attribute("aria-checked") == "false"
    page.emulate_media(color_scheme="dark")
    assert eventually(lambda: brightness(screen) < 40)
    assert eventually(lambda: switch.get_attribute("aria-checked") == "true")
    switch.focus()
    page.keyboard.press("Space")
    assert eventually(lambda: brightness(screen) > 240)
    page.reload()
    page.locator("canvas").first.wait_for()
    assert eventually(lambda: screen.shows("free") or screen.shows("sticking"))
    assert eventually(lambda: switch.get_attribute("aria-checked") == "false") and brightness(screen) > 240
    switch.click()
    assert eventually(lambda: brightness(screen) < 40)


def test_a_press_in_deep_contact_and_the_display_without_force(screen: Screen, client: Client) -> None:
    client.hand((0.0, 0.0, -0.02), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: client.get_state().force[2] > 5.0)
    client.ask("disarm")
    assert eventually(lambda: screen.shows("force off"))
    assert eventually(lambda: re.search(r"normal\s+0\.00 N", screen.page.inner_text("body")))
    client.ask("arm")
    assert eventually(lambda: not screen.shows("force off") and client.get_state().force[2] > 5.0)
    play(screen, "press", client)
    assert not screen.shows("no object is below")


def test_the_slider_follows_a_gesture(screen: Screen, client: Client) -> None:
    screen.tab("Hand")
    assert eventually(lambda: _is_resting(client))  # the gesture of another test may still lead the hand
    client.hand((0.0, 0.0, 0.012), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: abs(client.get_state().position[2] - 0.012) < 3e-4)
    screen.page.get_by_role("button", name="press", exact=True).click()
    field = screen.page.locator("xpath=//label[normalize-space()='z, mm']/following::input[@type='text'][1]")
    heights = set[float]()
    assert eventually(lambda: heights.add(float(field.input_value())) or (min(heights) < 10.0 and max(heights) > 20.0))
