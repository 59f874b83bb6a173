"""Keys, touch screen, gamepad (replaced by a script) and menus of the page change the daemon, in a browser."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from helpers.browser import Screen, eventually, why_none
from helpers.pages import daemon_of

from softfinger.config.schema.contact import RollingMethod
from softfinger.server.remote import Client
from softfinger.server.viewer.inputs import KEYS, MAX_SPEED_M_PER_S, SPIN_RAD_S, Nudge, parse_gamepad
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.viewer.tuning import NO_ROLLING

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

PAD = """(axes) => {
    const buttons = Array.from({length: 17}, () => ({pressed: false, value: 0}));
    navigator.getGamepads = () => [{connected: true, mapping: "standard", axes, buttons}];
}"""
NO_PAD = "() => { navigator.getGamepads = () => [] }"


daemon = daemon_of("simulated-hand", "paper-plane")


def get_position(client: Client) -> np.ndarray:
    return np.array(client.get_state().position)


def test_keys_move_the_hand(screen: Screen, client: Client) -> None:
    start = get_position(client)

    def went_right() -> bool:
        screen.page.keyboard.press("l")
        return bool((get_position(client) - start)[0] > 0.003)

    assert eventually(went_right, every_s=0.3)

    def pressed() -> bool:
        screen.page.keyboard.press("o")
        return client.get_state().force[2] > 0.2

    assert eventually(pressed, every_s=0.3)
    assert eventually(lambda: screen.page.keyboard.press("u") or client.get_state().force[2] == 0.0, every_s=0.3)


def test_touch_moves_the_hand(screen: Screen, client: Client) -> None:
    start = get_position(client)

    def moved() -> bool:
        screen.touch(screen.at(tuple(CM * get_position(client))), (-40.0, 0.0))
        return float(np.linalg.norm((get_position(client) - start)[:2])) > 0.002

    assert eventually(moved, every_s=1.0)


def test_a_gamepad_moves_the_hand(screen: Screen, client: Client) -> None:
    field = screen.page.locator("xpath=//label[normalize-space()='gamepad']")
    assert eventually(lambda: not field.is_visible())
    start = get_position(client)
    screen.page.evaluate(PAD, [0.0, -1.0, 0.0, 0.0])
    assert eventually(lambda: (get_position(client) - start)[1] > 0.004)
    assert field.is_visible()
    screen.page.evaluate(PAD, [0.05, -0.05, 0.0, 0.0])  # released stick
    assert eventually(lambda: resting(client))
    screen.page.evaluate(NO_PAD)


def resting(client: Client) -> bool:
    return float(np.linalg.norm(client.get_state().velocity)) < 1e-4


@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", [*get_args(RollingMethod)[1:], get_args(RollingMethod)[0], NO_ROLLING])
def test_a_rolling_method_is_rendered_by_the_daemon(screen: Screen, client: Client, method: str) -> None:
    screen.tab("Feel")
    screen.choose("rolling", method)
    wanted = None if method == NO_ROLLING else method
    assert eventually(lambda: (client.describe()["scene"].get("rolling") or {}).get("method") == wanted)
    since = client.describe()["since"]
    assert eventually(lambda: client.get_state().sequence > since)
    chosen = screen.page.locator("xpath=//label[normalize-space()='rolling']/following::input[1]")
    assert eventually(lambda: chosen.input_value() == method)


def test_a_scene_is_rendered_or_refused(screen: Screen, client: Client) -> None:
    screen.tab("Feel")
    screen.choose("scene", "frictionless-plane")
    assert eventually(lambda: client.describe()["scene_name"] == "frictionless-plane")
    screen.choose("scene", "pinch")
    assert eventually(lambda: screen.shows("Not done:"))
    assert client.describe()["scene_name"] == "frictionless-plane"
    scene = screen.page.locator("xpath=//label[normalize-space()='scene']/following::input[1]")
    assert eventually(lambda: scene.input_value() == "frictionless-plane")


def test_invalid_gamepad_text_moves_nothing() -> None:
    assert {parse_gamepad(text) for text in ("", "a b", "1 2 3", "1 nan 0 0 0 0 0 0 0", "1 0.1 0 0 0 0 0 0 0")} == {
        Nudge()
    }
    assert parse_gamepad("1 9 0 0 0 0 1 0 0") == Nudge(x=MAX_SPEED_M_PER_S, spin=SPIN_RAD_S)


def test_no_key_has_two_functions() -> None:
    used = [(key, modifier) for key, modifier, _ in KEYS.values()]
    assert len(set(used)) == len(used) and not {key for key, _ in used} & set("WASDQE")
