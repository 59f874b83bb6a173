"""The page in a browser: its picture, buttons, keys, touch, gamepad and menus, with one daemon; menus come last."""

import re
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from helpers.browser import SIZE, Screen, coloured, eventually, served, shown, why_none
from helpers.pages import daemon_of

from softfinger.config.schema.contact import RollingMethod
from softfinger.server.app import Daemon
from softfinger.server.offline.simulate import run_recording
from softfinger.server.recording.results import write_blocks
from softfinger.server.remote import Client
from softfinger.server.viewer.gestures import ONE_FINGER, PRESS_N
from softfinger.server.viewer.inputs import KEYS, MAX_SPEED_M_PER_S, SPIN_RAD_S, Nudge, parse_gamepad
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.viewer.tuning import NO_ROLLING

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

ROLL, SPIN, SLIDE = 4300, 7000, 9000
"""Ticks of the shipped recording: in the middle of its roll, in its spin, and in its slide."""
RADIUS_M = 0.01
PAD = """(axes) => {
    const buttons = Array.from({length: 17}, () => ({pressed: false, value: 0}));
    navigator.getGamepads = () => [{connected: true, mapping: "standard", axes, buttons}];
}"""
NO_PAD = "() => { navigator.getGamepads = () => [] }"

daemon = daemon_of("simulated-hand", "paper-plane")


def test_invalid_gamepad_text_moves_nothing() -> None:
    invalid = ("", "a b", "1 2 3", "1 nan 0 0 0 0 0 0 0", "1 0.1 0 0 0 0 0 0 0")
    assert {parse_gamepad(text) for text in invalid} == {Nudge()}
    assert parse_gamepad("1 9 0 0 0 0 1 0 0") == Nudge(x=MAX_SPEED_M_PER_S, spin=SPIN_RAD_S)


def test_no_key_has_two_functions() -> None:
    used = [(key, modifier) for key, modifier, _ in KEYS.values()]
    assert len(set(used)) == len(used) and not {key for key, _ in used} & set("WASDQE")


def test_roll_spin_and_slide_have_different_colours(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    write_blocks(file, [""], [run_recording("press-roll-spin-drag")[:, None]])
    colours = {}
    with served(str(file)) as screen:
        assert eventually(lambda: screen.shows("tick 0"))
        for tick in (ROLL, SPIN, SLIDE):
            screen.fill("time, s", str(tick / 1000.0))
            assert eventually(lambda tick=tick: screen.shows(f"tick {tick}"))
            wanted = {ROLL: "blue", SPIN: "orange", SLIDE: "red"}[tick]
            colours[tick] = eventually(lambda w=wanted: (counts := coloured(screen.picture()))[w] > 100 and counts)
            assert colours[tick], f"no {wanted} at tick {tick}"
    # A dot of 2 mm has about 30 pixels here, an arrow or an arc some hundred.
    assert colours[ROLL]["red"] < 30 and colours[ROLL]["orange"] < 30
    assert colours[SPIN]["blue"] > 100 and colours[SPIN]["red"] < 30 and colours[SLIDE]["blue"] < 30


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
    assert eventually(is_right) and eventually(lambda: screen.shows("arrow: 0.3 N/cm"))
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


def test_the_page_shows_the_rendered_scene(screen: Screen) -> None:
    assert eventually(lambda: screen.shows("free"))
    for name in ("Hand", "Feel", "Show", "Plots"):
        screen.tab(name)
    screen.tab("Hand")
    assert eventually(lambda: (screen.picture().std(axis=(0, 1)) > 5.0).all())


def test_the_layout_fits_the_window(screen: Screen) -> None:
    page, plots = screen.page, screen.page.locator(".uplot:visible")  # plots of a tab remain after it was opened

    def canvas_width() -> float:
        return float(page.locator("canvas").first.bounding_box()["width"])

    page.set_viewport_size({"width": 1280, "height": 800})
    assert eventually(lambda: 880.0 < canvas_width() < 900.0) and eventually(lambda: plots.count() == 3)
    page.set_viewport_size({"width": 390, "height": 844})
    assert eventually(lambda: canvas_width() == 390.0)
    page.reload()
    page.locator("canvas").first.wait_for()
    assert eventually(lambda: page.evaluate("() => Boolean(window.__viserMutable?.nodeRefFromName['/objects'])"))
    # A phone shows 2 cm on both sides of the fingertip, as wide windows do.
    assert eventually(lambda: all(0.0 < screen.at((x, 0.0, 0.6))[0] < 390.0 for x in (-2.0, 2.0)))
    page.set_viewport_size({"width": 1280, "height": 800})
    assert eventually(lambda: 880.0 < canvas_width() < 900.0) and eventually(lambda: plots.count() == 3)
    boxes = [plots.nth(index).bounding_box() for index in range(3)]
    assert all(box["y"] + box["height"] <= 800.0 for box in boxes), boxes
    screen.tab("Show")
    for label in ("pause picture", "contact normals", "arrow, N/cm"):
        assert page.get_by_text(label, exact=True).bounding_box()["height"] < 30.0, label  # two lines have 40
    page.set_viewport_size(dict(zip(("width", "height"), SIZE, strict=True)))


def test_the_page_shows_the_scene_in_preparation(screen: Screen, daemon: Daemon) -> None:
    daemon.publisher.set_preparing("compiling kernel 12")
    assert eventually(lambda: screen.shows("the daemon prepares: compiling kernel 12"))
    daemon.publisher.set_preparing("")
    assert eventually(lambda: not screen.shows("the daemon prepares"))


def test_a_drag_of_the_mouse_moves_the_hand_of_the_daemon(screen: Screen, client: Client) -> None:
    height = client.get_state().position[2]

    def ball() -> tuple[float, float]:
        x, y, z = client.get_state().position
        return screen.at((CM * x, CM * y, CM * z))

    def pressed() -> bool:
        screen.drag(ball(), (0.0, 30.0), "Shift")
        state = client.get_state()
        return state.force[2] > 0.3 and state.position[2] < height

    assert eventually(pressed, every_s=1.0)
    before = client.get_state().position

    def moved() -> bool:
        screen.drag(ball(), (40.0, 0.0))
        return float(np.linalg.norm(np.subtract(client.get_state().position, before)[:2])) > 0.002

    assert eventually(moved, every_s=1.0) and eventually(lambda: client.get_state().force[2] > 0.3)
    assert eventually(lambda: any(screen.shows(state) for state in ("sticking", "rolling", "sliding")))


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
    assert eventually(lambda: np.linalg.norm(client.get_state().velocity) < 1e-4)
    screen.page.evaluate(NO_PAD)


def test_a_slider_changes_the_material_of_the_daemon(screen: Screen, client: Client) -> None:

    def material() -> dict[str, object]:
        table: dict[str, object] = client.describe()["scene"]["object"][0]["material"]
        return table

    screen.tab("Feel")
    assert eventually(lambda: screen.page.get_by_role("slider", name="stiffness, N/m").count() == 1)
    screen.fill("stiffness, N/m", "740")
    assert eventually(lambda: material()["stiffness_n_per_m"] == 740.0)
    screen.fill("friction", "0.3")
    assert eventually(lambda: material()["friction"] == {"static": 0.3, "kinetic": pytest.approx(0.25)})


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


GREY, WHITE = 240.0, 250.0
"""An object's colour is below GREY; the empty background is above WHITE."""
TRIANGLES = """name => {
    let found = 0;
    window.__viserMutable.nodeRefFromName[name]?.traverse(node => { found += (node.geometry?.index?.count ?? 0) / 3; });
    return found;
}"""
"""Triangles that are drawn, not those of the message."""


def get_colour(screen: Screen, point: tuple[float, float, float]) -> Any:
    box = screen.page.locator("canvas").first.bounding_box()
    x, y = screen.at((CM * point[0], CM * point[1], CM * point[2]))
    row, column = round(y - box["y"]), round(x - box["x"])
    return screen.picture()[row - 2 : row + 3, column - 2 : column + 3].mean(axis=(0, 1))


def test_a_height_map_is_drawn_and_touched(screen: Screen, client: Client) -> None:
    client.ask("set_scene", {"scene": "heightmap"})
    switch = screen.page.get_by_role("switch", name="dark look")
    if switch.get_attribute("aria-checked") == "true":
        switch.click()
    shown(screen.page, screen.page.url)  # as a page that is opened now
    client.ask("hand", {"position_m": [0.0, 0.0, 0.02]})
    assert eventually(lambda: screen.page.evaluate(TRIANGLES, "/objects/0") == 2 * 63 * 63)
    assert eventually(lambda: get_colour(screen, (0.0, -0.03, 0.0)).max() < GREY)
    assert get_colour(screen, (0.025, 0.0, 0.03)).min() > WHITE
    heights = iter(np.arange(0.02, 0.0, -0.001).tolist())
    while client.get_state().force[2] <= 0.7:
        client.ask("hand", {"position_m": [0.0, 0.0, next(heights)]})
        time.sleep(0.1)
    assert client.get_state().field_state["object"] == 0
    assert eventually(lambda: screen.shows("sticking") and coloured(screen.picture())["blue"] > 60)
