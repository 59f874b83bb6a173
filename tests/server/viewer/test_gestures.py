"""Motions of the hand without a page: gestures, the contacts that they cause, and two fingers controlled together."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.simulated_hands import SimulatedHands

from softfinger import ContactMode
from softfinger.drivers.simulated.plant import PlantInputs
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.step_result import Step
from softfinger.server.offline.closed_loop import DrivenPlant
from softfinger.server.viewer import gestures
from softfinger.server.viewer.hand import BOTH, HandCommands, HandControls, MovableFinger
from softfinger.server.viewer.inputs import MAX_STEP_M, Nudge, TwoHands
from softfinger.server.viewer.nodes.looks import CM
from softfinger.server.viewer.target import Target, mirror_motion, move_towards

pytestmark = pytest.mark.plain

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
FRAME_S = 0.04
START = (0.0, 0.0, 0.02)
RADIUS, RATE_HZ = 0.01, 100.0
STEP_N = 1000.0 * gestures.APPROACH_SPEED_M_PER_S / RATE_HZ
"""Change of force per frame on the plane of 1000 N/m."""


def make_stage(target: Callable[[str], Target], force: Callable[[str], float]) -> gestures.Stage:
    return gestures.Stage(target, lambda finger: target(finger).position, force, lambda _: RADIUS, lambda _: 0.0)


@cache
def play_gesture(name: str, start: tuple[float, float, float]) -> list[Step]:
    engine = Engine("paper-plane", rate_hz=RATE_HZ)
    targets, steps = {"": Target(np.array(start), IDENTITY)}, list[Step]()
    stage = make_stage(targets.__getitem__, lambda finger: steps[-1].normal_force if steps else 0.0)
    gesture = gestures.ONE_FINGER[name](stage, "")
    goals = next(gesture)
    while True:
        targets.update(goals)
        target = targets[""]
        steps.append(engine.step(position=target.position.tolist(), orientation=list(target.orientation)))
        try:
            goals = gesture.send(1.0 / RATE_HZ)
        except StopIteration:
            assert target.position[2] > RADIUS + gestures.HOVER_M  # it has left the plane
            return steps


@pytest.mark.parametrize("name", gestures.ONE_FINGER)
def test_a_gesture_presses_with_the_nominal_force(name: str) -> None:
    """The excess is at most the change within one frame."""
    most = max(step.normal_force for step in play_gesture(name, START))
    assert gestures.PRESS_N <= most < gestures.PRESS_N + 1.01 * STEP_N


def test_each_gesture_causes_its_motion() -> None:
    """A ball of 10 mm rolls by displacement over radius in both directions. A slide moves the contact, less the
    sticking drag of 0.6 mm at 1 N. A spin winds it up to friction_length times the load, 4 mN m."""
    most = {
        name: (
            max(abs(step.rolled) for step in steps),
            max(float(np.linalg.norm(step.point[:2])) for step in steps if step.mode != ContactMode.FREE),
            max(abs(step.torsion) for step in steps),
        )
        for name in gestures.ONE_FINGER
        for steps in [play_gesture(name, START)]
    }
    assert most["press"] == (0.0, 0.0, 0.0)
    assert most["roll"][0] == pytest.approx(2.0 * gestures.ROLL_M / RADIUS, rel=0.01)
    assert most["roll"][1] == pytest.approx(gestures.ROLL_M, rel=0.02) and most["roll"][2] < 1e-6
    assert gestures.SLIDE_M - 1.5e-3 < most["slide"][1] < gestures.SLIDE_M
    assert most["slide"][0] < 0.02 and most["slide"][2] < 1e-6
    assert most["spin"][1] < 1e-6 and 0.004 * gestures.PRESS_N <= most["spin"][2] < 0.004 * 1.3 * gestures.PRESS_N
    assert most["spin"][2] < gestures.SPIN_RAD * 0.05  # it has slipped about the normal


class MovableHands(SimulatedHands):
    def __init__(self) -> None:
        super().__init__("lift-a-box")
        places = {"thumb": -0.04, "index": 0.04}
        self.goals = {name: np.array([x, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0]) for name, x in places.items()}
        hands = list[DrivenPlant]()
        for hand, goal in zip(self._hands, self.goals.values(), strict=True):
            intention = hand.drive.intention._replace(length=1.0, loop=0.0)
            hands.append(DrivenPlant(hand.plant, PlantInputs(intention, goal, hand.drive.line)))
        self._hands = tuple(hands)


@pytest.mark.exhaustive
@pytest.mark.skipif(not PLAIN, reason="would compile a minute; plain Python plays it in half of that")
def test_a_lift_raises_a_box_and_puts_it_down() -> None:
    hands, forces, passed = MovableHands(), {"thumb": 0.0, "index": 0.0}, 0.0
    stage = make_stage(lambda finger: Target(hands.goals[finger][:3].copy(), IDENTITY), forces.__getitem__)
    back: list[bool] = []
    box = gestures.LiftedBox(lambda: hands.data.qpos[:3].copy(), 0.02, lambda: back.append(True))
    gesture, heights, tilts, most = gestures.lift(stage, "thumb", "index", box), [], [], 0.0
    goals = next(gesture)
    with suppress(StopIteration):
        while True:
            for finger, target in goals.items():
                hands.goals[finger][:3] = target.position
            passed += FRAME_S
            for finger, rows in hands.until(passed).items():
                forces[finger] = float(np.asarray(rows)[-1, AT.contact_normal_force])
            most = max(most, *forces.values())
            heights.append(float(hands.data.qpos[2]))
            tilts.append(abs(float(hands.data.qpos[3])))
            goals = gesture.send(FRAME_S)
    assert back == [True] and gestures.GRIP_N <= most < 2.0 * gestures.GRIP_N
    # 1 N of weight deflects two contacts and two hands of 1000 N/m each by 1 mm
    assert max(heights) == pytest.approx(0.02 + gestures.LIFT_M, abs=2e-3)
    assert heights[-1] == pytest.approx(0.02, abs=5e-4) and min(tilts) > np.cos(np.radians(1.0))
    assert forces == {"thumb": 0.0, "index": 0.0}


def test_the_width_of_a_box_depends_on_its_rotation() -> None:
    """Edges of 20 and 40 mm, turned by 30 degrees: the sum of their projections."""
    size, turn = (0.02, 0.04, 0.01), (np.cos(np.pi / 12).item(), 0.0, 0.0, np.sin(np.pi / 12).item())
    wide = 0.5 * (0.02 * np.cos(np.pi / 6) + 0.04 * np.sin(np.pi / 6))
    assert gestures.compute_half_width(size, turn) == pytest.approx(wide, rel=1e-12)


GRIP = 0.002
PLACES = {"thumb": (-0.04, 0.0, 0.02), "index": (0.04, 0.0, 0.02)}
LedHand = tuple[HandControls, dict[str, Target | None]]


@pytest.fixture
def led_hand() -> Iterator[LedHand]:
    viser = pytest.importorskip("viser")
    server = viser.ViserServer(port=0, verbose=False)
    sent: dict[str, Target | None] = {}
    try:

        def hold(finger: str, on_target: Callable[[Target], None], failed: Callable[[], None]) -> None:
            on_target(Target(np.subtract(PLACES[finger], (0.0, 0.0, GRIP)), IDENTITY))

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


def test_keys_close_two_fingers_and_move_both(led_hand: LedHand) -> None:
    hand, sent = led_hand
    hand.nudge(Nudge(close=0.001))
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.018], "index": [0.039, 0.0, 0.018]}
    hand.nudge(Nudge(z=0.001))
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.019], "index": [0.039, 0.0, 0.019]}
    hand._finger.value = "thumb"
    hand.nudge(Nudge(z=0.001))
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.02], "index": [0.039, 0.0, 0.019]}


def test_each_hand_moves_one_finger(led_hand: LedHand) -> None:
    hand, sent = led_hand
    hand._finger.value = "index"
    hand.nudge_each(Nudge(x=0.001), Nudge(y=0.002), 0.0)
    assert locate(sent) == {"thumb": [-0.039, 0.0, 0.018], "index": [0.04, 0.002, 0.018]}
    hand.nudge_each(Nudge(), Nudge(y=-0.002), 0.001)
    assert locate(sent)["thumb"][0] == pytest.approx(-0.038, abs=2e-6)  # towards a middle offset by 1 mm: cos of 1/40
    assert locate(sent)["index"][0] == pytest.approx(0.039, abs=2e-6)


def test_moving_one_finger_holds_the_other(led_hand: LedHand) -> None:
    """Otherwise a hand that follows a recording would continue with it; both start at their targets."""
    hand, sent = led_hand
    hand._finger.value = "index"
    hand.nudge(Nudge(z=0.001))
    assert locate(sent) == {"index": [0.04, 0.0, 0.019]}
    assert hand.target("thumb").position == pytest.approx([-0.04, 0.0, 0.018])


def test_a_slider_moves_the_target_by_its_change(led_hand: LedHand) -> None:
    hand, sent = led_hand
    assert hand._finger.value == BOTH and hand._sliders[2].value == pytest.approx(20.0)
    for x in (-38.0, -35.0):
        for slider, value in zip(hand._sliders, (x, 0.0, 20.0, 0.0, 0.0, 0.0), strict=True):
            slider.value = value
        hand._on_slider(SimpleNamespace(client=1))
    assert locate(sent) == {"thumb": [-0.035, 0.0, 0.018]}


def test_steps_before_the_hands_are_held_are_queued(led_hand: LedHand) -> None:
    hand, sent = led_hand
    answers: list[tuple[str, Callable[[Target], None], Callable[[], None]]] = []
    hand._commands = hand._commands._replace(hold=lambda *request: answers.append(request))
    for _ in range(3):
        hand.nudge(Nudge(z=0.001))
    assert [finger for finger, _, _ in answers] == list(PLACES) and not sent
    for finger, on_target, _ in answers:
        on_target(Target(np.array(PLACES[finger]), IDENTITY))
    assert locate(sent) == {"thumb": [-0.04, 0.0, 0.023], "index": [0.04, 0.0, 0.023]}
    hand._release()
    hand.nudge(Nudge(z=0.001))
    assert len(answers) == 4 and list(sent.values()) == [None, None]
    answers[-1][2]()
    answers[-2][1](Target(np.array(PLACES["thumb"]), IDENTITY))
    assert list(sent.values()) == [None, None]


def drag(hand: HandControls, phase: str, end: np.ndarray, how: str) -> None:
    eye = SimpleNamespace(camera=SimpleNamespace(position=CM * np.array([0.0, 0.0, 10.0])))
    ball = CM * np.array(PLACES["thumb"])
    event = SimpleNamespace(phase=phase, client=eye, start_position=ball, end_position=end)
    hand.hold_then(partial(hand._on_drag, "thumb", event, how))


def test_a_drag_moves_both_fingers_and_the_wheel_closes_them(led_hand: LedHand) -> None:
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


def test_a_pinch_drag_moves_both_fingers_together(led_hand: LedHand) -> None:
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
