"""Contacts that gestures cause, without a page: a stiff hand follows them on the paper's plane."""

from __future__ import annotations

from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from helpers.simulated_hands import SimulatedHands

from softfinger import ContactMode
from softfinger.drivers.simulated.plant import PlantInputs
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.record import AT
from softfinger.proxy.step_result import Step
from softfinger.server.offline.closed_loop import DrivenPlant
from softfinger.server.viewer import gestures
from softfinger.server.viewer.nodes.glyphs import IDENTITY
from softfinger.server.viewer.target import Target

pytestmark = pytest.mark.plain

FRAME_S = 0.04
START = (0.0, 0.0, 0.02)
RADIUS, RATE_HZ = 0.01, 100.0
STEP_N = 1000.0 * gestures.APPROACH_SPEED_M_PER_S / RATE_HZ
"""Change of force per frame on the plane of 1000 N/m."""


@cache
def play_gesture(name: str, start: tuple[float, float, float]) -> list[Step]:
    engine = Engine("paper-plane", rate_hz=RATE_HZ)
    targets, steps = {"": Target(np.array(start), IDENTITY)}, list[Step]()
    stage = gestures.Stage(
        lambda finger: targets[finger],
        lambda finger: targets[finger].position,
        lambda finger: steps[-1].normal_force if steps else 0.0,
        lambda finger: RADIUS,
        lambda point: 0.0,
    )
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


class MovableFinger(SimulatedHands):
    def __init__(self) -> None:
        super().__init__("lift-a-box")
        places = {"thumb": -0.04, "index": 0.04}
        self.goals = {name: np.array([x, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0]) for name, x in places.items()}
        self._hands = tuple(
            DrivenPlant(
                hand.plant, PlantInputs(hand.drive.intention._replace(length=1.0, loop=0.0), goal, hand.drive.line)
            )
            for hand, goal in zip(self._hands, self.goals.values(), strict=True)
        )


@pytest.mark.exhaustive
@pytest.mark.skipif(not PLAIN, reason="would compile a minute; plain Python plays it in half of that")
def test_a_lift_raises_a_box_and_puts_it_down() -> None:
    hands, forces, passed = MovableFinger(), {"thumb": 0.0, "index": 0.0}, 0.0
    stage = gestures.Stage(
        lambda finger: Target(hands.goals[finger][:3].copy(), IDENTITY),
        lambda finger: hands.goals[finger][:3],
        forces.__getitem__,
        lambda finger: RADIUS,
        lambda point: 0.0,
    )
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
