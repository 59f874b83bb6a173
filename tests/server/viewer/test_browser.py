"""The page in a browser: it shows the scene, its colours show the contact, and its controls change the daemon."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.browser import SIZE, Screen, coloured, eventually, served, why_none
from helpers.pages import daemon_of

from softfinger.server.app import Daemon
from softfinger.server.offline.simulate import run_recording
from softfinger.server.recording.results import write_blocks
from softfinger.server.remote import Client
from softfinger.server.viewer.nodes.looks import CM

pytestmark = [pytest.mark.real_time, pytest.mark.system, pytest.mark.skipif(bool(why_none()), reason=why_none())]

ROLL, SPIN, SLIDE = 4300, 7000, 9000
"""Ticks of the shipped recording: in the middle of its roll, in its spin, and in its slide."""


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
    assert colours[SPIN]["blue"] > 100 and colours[SPIN]["red"] < 30
    assert colours[SLIDE]["blue"] < 30


daemon = daemon_of("simulated-hand", "paper-plane")


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
    assert eventually(lambda: 880.0 < canvas_width() < 900.0)
    assert eventually(lambda: plots.count() == 3)
    page.set_viewport_size({"width": 390, "height": 844})
    assert eventually(lambda: canvas_width() == 390.0)
    page.reload()
    page.locator("canvas").first.wait_for()
    assert eventually(lambda: page.evaluate("() => Boolean(window.__viserMutable?.nodeRefFromName['/objects'])"))
    # A phone shows 2 cm on both sides of the fingertip, as wide windows do.
    assert eventually(lambda: all(0.0 < screen.at((x, 0.0, 0.6))[0] < 390.0 for x in (-2.0, 2.0)))
    page.set_viewport_size({"width": 1280, "height": 800})
    assert eventually(lambda: 880.0 < canvas_width() < 900.0)
    assert eventually(lambda: plots.count() == 3)
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

    assert eventually(moved, every_s=1.0)
    assert eventually(lambda: client.get_state().force[2] > 0.3)
    assert eventually(lambda: any(screen.shows(state) for state in ("sticking", "rolling", "sliding")))


def test_a_slider_changes_the_material_of_the_daemon(screen: Screen, client: Client) -> None:
    """A number next to it sets the stiffness; both coefficients of friction keep their ratio. Screen readers get its
    name."""

    def material() -> dict[str, object]:
        table: dict[str, object] = client.describe()["scene"]["object"][0]["material"]
        return table

    screen.tab("Feel")
    assert eventually(lambda: screen.page.get_by_role("slider", name="stiffness, N/m").count() == 1)
    screen.fill("stiffness, N/m", "740")
    assert eventually(lambda: material()["stiffness_n_per_m"] == 740.0)
    screen.fill("friction", "0.3")
    assert eventually(lambda: material()["friction"] == {"static": 0.3, "kinetic": pytest.approx(0.25)})
