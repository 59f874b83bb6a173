"""Two fingers controlled together: keys close them, and a drag of one moves the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.viewer.hand import BOTH, HandCommands, HandControls, MovableFinger
from softfinger.server.viewer.inputs import MAX_STEP_M, Nudge, TwoHands
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.viewer.target import Target, mirror_motion, move_towards

viser = pytest.importorskip("viser")
pytestmark = pytest.mark.plain

GRIP = 0.002
PLACES = {"thumb": (-0.04, 0.0, 0.02), "index": (0.04, 0.0, 0.02)}


@pytest.fixture
def led_hand() -> Iterator[tuple[HandControls, dict[str, Target | None]]]:
    server = viser.ViserServer(port=0, verbose=False)
    sent: dict[str, Target | None] = {}
    try:

        def hold(finger: str, on_target: Callable[[Target], None], failed: Callable[[], None]) -> None:
            on_target(Target(np.subtract(PLACES[finger], (0.0, 0.0, GRIP)), (1.0, 0.0, 0.0, 0.0)))

        hand = HandControls(server.gui, server.scene, HandCommands(sent.__setitem__, hold))
        reach = np.full(3, 0.2)
        hand.change([MovableFinger(name, 0.01, -reach, reach) for name in PLACES])
        for name, place in PLACES.items():
            row = np.zeros(RECORD_SIZE)
            row[AT.probe_position : AT.probe_position + 3], row[AT.probe_orientation] = place, 1.0
            hand.update_pose(name, row)
        yield hand, sent
    finally:
        server.stop()


def locate(sent: dict[str, Any]) -> dict[str, list[float]]:
    return {name: np.round(target.position, 9).tolist() for name, target in sent.items()}


def test_a_motion_is_mirrored_along_the_line_between_fingers() -> None:
    line = np.array([2.0, 0.0, 0.0])
    assert mirror_motion(np.array([0.3, 0.4, 0.5]), line).tolist() == [-0.3, 0.4, 0.5]
    assert mirror_motion(np.array([0.3, 0.4, 0.5]), 0.0 * line).tolist() == [0.3, 0.4, 0.5]
    assert move_towards(np.array([1.0, 0.0, 0.0]), np.zeros(3), 2.0).tolist() == [0.0, 0.0, 0.0]


def test_keys_close_two_fingers_and_move_both(led_hand: tuple[HandControls, dict[str, Target | None]]) -> None:
    hand, sent = led_hand
    hand.nudge(Nudge(close=0.001))
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.018], "index": [0.039, 0.0, 0.018]}
    hand.nudge(Nudge(z=0.001))
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.019], "index": [0.039, 0.0, 0.019]}
    hand._finger.value = "thumb"
    hand.nudge(Nudge(z=0.001))
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.02], "index": [0.039, 0.0, 0.019]}


def test_each_hand_moves_one_finger(led_hand: tuple[HandControls, dict[str, Target | None]]) -> None:
    hand, sent = led_hand
    hand._finger.value = "index"
    hand.nudge_each(Nudge(x=0.001), Nudge(y=0.002), 0.0)
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.018], "index": [0.04, 0.002, 0.018]}
    hand.nudge_each(Nudge(), Nudge(y=-0.002), 0.001)
    assert locate(sent)["thumb"][0] == pytest.approx(-0.038, abs=2e-6)  # towards a middle offset by 1 mm: cos of 1/40
    assert locate(sent)["index"][0] == pytest.approx(0.039, abs=2e-6)


def test_moving_one_finger_holds_the_other(led_hand: tuple[HandControls, dict[str, Target | None]]) -> None:
    """Otherwise a hand that follows a recording would continue with it; both start at their targets."""
    hand, sent = led_hand
    hand._finger.value = "index"
    hand.nudge(Nudge(z=0.001))
    assert locate(sent) == {"index": [0.04, 0.0, 0.019]}
    assert hand.target("thumb").position == pytest.approx([-0.04, 0.0, 0.018])


def test_a_slider_moves_the_target_by_its_change(led_hand: tuple[HandControls, dict[str, Target | None]]) -> None:
    """A slider shows the finger's position; a change of 5 mm shifts the target by 5 mm."""
    hand, sent = led_hand
    assert hand._finger.value == BOTH and hand._sliders[2].value == pytest.approx(20.0)
    for x in (-38.0, -35.0):
        for slider, value in zip(hand._sliders, (x, 0.0, 20.0, 0.0, 0.0, 0.0), strict=True):
            slider.value = value
        hand._on_slider(SimpleNamespace(client=1))
    assert locate(sent) == {"thumb": [-0.035, 0.0, 0.018]}


def test_steps_before_the_hands_are_held_are_queued(led_hand: tuple[HandControls, dict[str, Target | None]]) -> None:
    hand, sent = led_hand
    answers: list[tuple[str, Callable[[Target], None], Callable[[], None]]] = []
    hand._commands = hand._commands._replace(hold=lambda *request: answers.append(request))
    for _ in range(3):
        hand.nudge(Nudge(z=0.001))
    assert [finger for finger, _, _ in answers] == list(PLACES) and not sent
    for finger, on_target, _ in answers:
        on_target(Target(np.array(PLACES[finger]), (1.0, 0.0, 0.0, 0.0)))
    assert locate(sent) == {"thumb": [-0.04, 0.0, 0.023], "index": [0.04, 0.0, 0.023]}
    hand._release()
    hand.nudge(Nudge(z=0.001))
    assert len(answers) == 4 and list(sent.values()) == [None, None]
    answers[-1][2]()
    answers[-2][1](Target(np.array(PLACES["thumb"]), (1.0, 0.0, 0.0, 0.0)))
    assert list(sent.values()) == [None, None]


def drag(hand: HandControls, phase: str, end: np.ndarray, how: str) -> None:
    eye = SimpleNamespace(camera=SimpleNamespace(position=CM * np.array([0.0, 0.0, 10.0])))
    ball = CM * np.array(PLACES["thumb"])
    event = SimpleNamespace(phase=phase, client=eye, start_position=ball, end_position=end)
    hand.hold_then(partial(hand._on_drag, "thumb", event, how))


def test_a_drag_moves_both_fingers_and_the_wheel_closes_them(
    led_hand: tuple[HandControls, dict[str, Target | None]],
) -> None:
    hand, sent = led_hand
    ball = CM * np.array(PLACES["thumb"])
    drag(hand, "start", ball, "move")
    drag(hand, "update", ball + CM * np.array([0.01, 0.005, 0.0]), "move")
    assert locate(sent)["thumb"] == pytest.approx([-0.03, 0.005, 0.018])
    assert locate(sent)["index"] == pytest.approx([0.05, 0.005, 0.018])
    hand.nudge_each(Nudge(), Nudge(), 0.004)
    drag(hand, "end", ball + CM * np.array([0.0, 0.005, 0.0]), "move")
    assert locate(sent)["thumb"] == pytest.approx([-0.036, 0.005, 0.018])
    assert locate(sent)["index"] == pytest.approx([0.036, 0.005, 0.018])


def test_a_pinch_drag_moves_both_fingers_together(led_hand: tuple[HandControls, dict[str, Target | None]]) -> None:
    """Touch screens have no wheel: a drag by 10 mm inwards and 5 mm sideways mirrors the other finger."""
    hand, sent = led_hand
    ball = CM * np.array(PLACES["thumb"])
    for phase, end in (("start", ball), ("end", ball + CM * np.array([0.01, 0.005, 0.0]))):
        drag(hand, phase, end, "pinch")
    assert locate(sent)["thumb"] == pytest.approx([-0.03, 0.005, 0.018])
    assert locate(sent)["index"] == pytest.approx([0.03, 0.005, 0.018])


def test_increments_of_two_hands_are_applied_once_and_clamped() -> None:
    text_field = SimpleNamespace(value="")

    class Gui:
        def add_html(self, content: str) -> None: ...

        def add_text(self, name: str, value: str) -> Any:
            return SimpleNamespace(on_update=lambda call: text_field.__dict__.update(call=call))

    hands = TwoHands(Gui())

    def enter_text(text: str) -> tuple[Nudge, Nudge, float] | None:
        hands._field.value = text
        text_field.call(SimpleNamespace(client=1))
        return hands.increment()

    assert enter_text("1 a 1 0 0 0 2 0 0.5") == (Nudge(x=0.001), Nudge(y=0.002), 0.0005)
    assert enter_text("2 b 1 0 0 0 0 0 0") == (Nudge(x=0.001), Nudge(), 0.0)
    left_hand, right_hand, close = enter_text("9 a 4 0 0 0 2 0 0.5") or pytest.fail("nothing")
    assert left_hand.x == pytest.approx(0.003) and (right_hand, close) == (Nudge(), 0.0)
    assert (enter_text("9 c 1e9 0 0 0 -1e9 0 0") or pytest.fail("nothing"))[0].x == MAX_STEP_M
    for bad in ("", "1 a", "1 a 1 2 3", "1 a 1 2 3 4 5 6 nan", "1 a x 2 3 4 5 6 7", "1 a 1 2 3 4 5 6 7 8"):
        assert enter_text(bad) is None
