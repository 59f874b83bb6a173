"""Free, rolling, sliding: each transition with its condition, and conditions that must not cause one.

The scene is that of test_contact_acceptance.py: f_N = 1 N at 1 mm, mu 0.6 / 0.5, K = 1000 N/m, 1 kHz.
"""

from __future__ import annotations

import numpy as np
import pytest
from conftest import SceneFactory
from helpers.examples import Cases
from references.hand import drive, pressed
from references.rotation import matrix

from softfinger.proxy.engine import Engine
from softfinger.proxy.record import CAUSE_NAMES, FREE, ROLLING, SLIDING

pytestmark = pytest.mark.plain

R = 0.01
EXACT = 1e-12
"""Rounding of some hundred additions of order 1e-2 m times 1000 N/m, N."""


def test_touch_is_the_first_tick_below_the_surface(plane_scene: SceneFactory) -> None:
    engine = Engine(plane_scene())
    assert engine.step([0, 0, R], [1, 0, 0, 0]).mode == FREE
    step = engine.step([0, 0, R - 1e-9], [1, 0, 0, 0])
    assert (step.mode, step.cause, step.object) == (ROLLING, "touch", 0)


def test_touch_starts_unwound(plane_scene: SceneFactory) -> None:
    engine = Engine(plane_scene())
    engine.step([-0.02, 0.01, R + 0.005], [1, 0, 0, 0])
    step = engine.step([0, 0, R - 0.001], [0.6, 0.48, 0.64, 0])
    assert step.cause == "touch"
    assert step.force == pytest.approx([0, 0, 1], abs=EXACT)
    assert step.torque == pytest.approx([0, 0, 0], abs=EXACT)
    assert (step.rolled, step.spin) == (0.0, 0.0)
    assert step.proxy_position == pytest.approx([0, 0, R], abs=EXACT)


def test_drag_begins_where_the_normal_force_drops(plane_scene: SceneFactory) -> None:
    hand = pressed(0.002).go(60, move=[0.5e-3, 0, 0])
    start = hand.at
    hand.go(100, move=[0, 0, 0.0015])
    trace = drive(Engine(plane_scene()), hand)
    cause = trace.events[1]
    # 0.6 * 1000 * depth = 0.5 N at a depth of 0.8333 mm, 77.8 of 15 um steps up.
    assert cause == (start + 78, "drag")
    assert (trace.tangential <= 0.6 * trace.normal_force * (1 + EXACT)).all()


def test_theta_max_is_the_roll_the_hand_has_not_followed(plane_scene: SceneFactory) -> None:
    """A hand that follows half the roll slides at twice theta_max: 0.12 rad instead of 0.06."""
    trace = drive(Engine(plane_scene()), pressed().go(301, move=[0, -0.15 * R, 0], turn=[0.3, 0, 0]))
    assert trace.events == [(1, "touch"), (1 + int(np.ceil(0.12 / 0.3 * 301)), "theta_max")]


def test_theta_max_grows_with_the_normal_force(plane_scene: SceneFactory) -> None:
    """theta_max = mu_s f_N / (k_tau r): pressing twice as deep doubles the roll that sticks."""
    for depth in (0.0005, 0.001, 0.002):
        trace = drive(Engine(plane_scene()), pressed(depth).go(301, turn=[0, 0.3, 0]))
        assert trace.events == [(1, "touch"), (1 + int(np.ceil(0.6 * depth / R / 0.3 * 301)), "theta_max")]


def test_stop_sticks_again_and_keeps_the_force(plane_scene: SceneFactory) -> None:
    """A stopped finger sticks once its filtered slip speed is below 0.5 mm/s; force and spin persist."""
    hand = pressed().go(500, move=[0.025, 0, 0], turn=[0, 0, 0.03])
    stop = hand.at
    hand.go(200)
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag", "stop"]
    # From 50 mm/s a low-pass of 10 ms takes 10 ms * ln(100) = 46 ms; its discrete form may differ by a tick or two.
    assert abs(trace.events[2][0] - stop - 46) <= 3
    assert trace.force[stop:] == pytest.approx(np.tile([-0.5, 0, 1], (201, 1)), abs=EXACT)
    assert trace.torque[stop:, 2] == pytest.approx(-0.05 * 0.03, abs=EXACT)


def test_a_slow_slide_is_not_a_stop(plane_scene: SceneFactory) -> None:
    hand = pressed().go(100, move=[0.002, 0, 0]).go(1000, move=[0.0001, 0, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag"]
    assert trace.tangential[-900:] == pytest.approx(0.5, rel=EXACT)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("resolution", "distance"), [(0.0, 0.05e-3), (1e-5, 0.05e-3), (1e-4, 0.3e-3)])
def test_reverse_sticks_after_a_tenth_or_three_encoder_steps(
    plane_scene: SceneFactory, resolution: float, distance: float
) -> None:
    """A reversal sticks when the deflection of 0.5 mm has decreased by 10 %, or by three encoder steps if that is
    more."""
    hand = pressed().go(500, move=[0.025, 0, 0])
    turn = hand.at
    step_m = 23e-6
    hand.go(40, move=[-40 * step_m, 0, 0])
    trace = drive(Engine(plane_scene(probe={"position_resolution_m": resolution})), hand)
    assert trace.events[2] == (turn + int(np.ceil(distance / step_m)), "reverse")
    assert (trace.mode[trace.events[2][0] :] == ROLLING).all()


def test_a_turn_across_the_slide_is_not_a_reversal(plane_scene: SceneFactory) -> None:
    hand = pressed().go(200, move=[0.01, 0, 0]).go(400, move=[0, 0.02, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag"]
    assert trace.tangential[202:] == pytest.approx(0.5, rel=EXACT)
    assert trace.force[-1] == pytest.approx([0, -0.5, 1], abs=1e-6)


def test_release_clears_everything(plane_scene: SceneFactory) -> None:
    hand = pressed().go(100, move=[0.01, 0, 0], turn=[0, 0, 0.05])
    hand.go_to(1, [0.01, 0, R + 0.001])
    out = hand.at
    hand.go_to(1, [0.01, 0, R - 0.001]).go(5)
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events[-2:] == [(out, "release"), (out + 1, "touch")]
    released = trace.steps[out]
    assert (released.mode, released.object, released.penetration) == (FREE, -1, 0.0)
    assert (released.spin, released.rolled, released.normal_force, released.tangential_force) == (0.0, 0.0, 0.0, 0.0)
    assert not released.force.any()
    assert not released.torque.any()
    assert trace.force[out + 1 :] == pytest.approx(np.tile([0, 0, 1], (6, 1)), abs=EXACT)
    assert trace.torque[out + 1 :] == pytest.approx(np.zeros((6, 3)), abs=EXACT)


def test_zero_normal_force_inside_is_not_a_release(plane_scene: SceneFactory) -> None:
    scene = plane_scene(material={"damping_ns_per_m": 10.0})
    trace = drive(Engine(scene), pressed(0.002).go(10).go(30, move=[0, 0, 0.006]))
    inside = (trace.poses[:, 2] < R) & (trace.normal_force == 0.0)
    assert inside.sum() >= 5
    assert (trace.mode[inside] != FREE).all()
    assert trace.causes.count("release") == 1


@pytest.mark.sampled(1)
@pytest.mark.parametrize("axis", [[1, 0, 0], [0, -1, 0], [0.6, 0.8, 0]])
def test_a_followed_roll_never_slides(plane_scene: SceneFactory, axis: list[float]) -> None:
    along = R * np.cross(axis, [0, 0, 1])
    hand = pressed()
    for angle in (3.0, -2.0, 0.7, -0.01, 1.2):
        hand.go(150, move=angle * along, turn=angle * np.asarray(axis))
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events == [(1, "touch")]
    assert trace.tangential.max() < 1e-11


def test_a_roll_followed_with_a_lag_never_slides(plane_scene: SceneFactory) -> None:
    """A hand that lags 0.4 mm behind the roll for a radian rolls under a constant force, without a slide."""
    hand = pressed().go(40, turn=[0.04, 0, 0]).go(1000, move=[0, -R, 0], turn=[1, 0, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events == [(1, "touch")]
    # A rule that counts the roll instead of the lag would slide at 0.06 rad.
    assert trace.force[41:] == pytest.approx(np.tile([0, -0.4, 1], (1001, 1)), abs=1e-11)


def test_a_hand_that_follows_gets_its_cone_back(plane_scene: SceneFactory) -> None:
    """After a roll of 0.05 rad the hand may follow it and move 0.6 mm further before it slides."""
    hand = pressed().go(50, turn=[0.05, 0, 0])
    start = hand.at
    hand.go(200, move=[0, -200 * 7e-6, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events == [(1, "touch"), (start + int(np.ceil(1.1e-3 / 7e-6)), "drag")]
    # The force crosses zero when the hand has caught up, and then opposes it.
    assert trace.force[start, 1] == pytest.approx(-0.5, abs=EXACT)
    assert trace.force[-1, 1] == pytest.approx(0.5, abs=EXACT)


def test_drag_against_a_roll_does_not_wind_up(plane_scene: SceneFactory) -> None:
    trace = drive(Engine(plane_scene()), pressed().go(2000, move=[0, 0.05, 0], turn=[5, 0, 0]))
    assert len(trace.events) == 2
    assert trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
    assert trace.tangential[-1] == pytest.approx(0.5, rel=EXACT)


def test_friction_opposes_the_slip_not_the_hand(plane_scene: SceneFactory) -> None:
    """A sliding finger that rolls faster than the hand moves is pushed forward: slip is v - r w x n."""
    # Surface speed of the roll: -50 mm/s along y; the hand moves at -20 mm/s: the fingertip's skin slips along +y.
    trace = drive(Engine(plane_scene()), pressed().go(500, move=[0, -0.01, 0], turn=[2.5, 0, 0]))
    assert trace.causes == ["touch", "theta_max"]
    assert trace.force[-1] == pytest.approx([0, -0.5, 1], abs=EXACT)


# Conditions on the normal force f_N, the hand's tangential force f_T and their cone, the normal distance a_N and the
# tangential motion a_T, v_T, checked on the tick that meets them and on the next.


def test_paper_row_contact_is_broken(plane_scene: SceneFactory) -> None:
    """f_N = 0 and a_N > 0, separating: rolling and sliding both end on that tick."""
    for drag in (0.0, 0.005):
        hand = pressed().go(50, move=[drag, 0, 0])
        trace = drive(Engine(plane_scene()), hand.go_to(7, [drag, 0, R + 1e-3]))
        broken = next(tick for tick, cause in trace.events if cause == "release")
        separating = (trace.normal_force == 0.0) & (np.diff(trace.poses[:, 2], prepend=R) > 0.0)
        assert broken == int(np.flatnonzero(separating[2:])[0]) + 2
        assert trace.poses[broken, 2] >= R > trace.poses[broken - 1, 2]
        assert trace.mode[broken - 1] == (SLIDING if drag else ROLLING)
        assert (trace.mode[broken:] == FREE).all()


def test_paper_row_rolling_is_kept(plane_scene: SceneFactory) -> None:
    """f_N > 0, mu^2 f_N^2 - f_T^2 > 0 and no slip: rolling continues under every load inside the cone."""
    hand = pressed()
    for angle in np.linspace(0, 2 * np.pi, 9):
        hand.go_to(20, [0.59e-3 * np.cos(angle), 0.59e-3 * np.sin(angle), R - 0.001])
    trace = drive(Engine(plane_scene()), hand)
    assert ((0.6 * trace.normal_force[1:]) ** 2 - trace.tangential[1:] ** 2 > 0.0).all()
    assert (trace.mode[1:] == ROLLING).all()
    # No slip: the proxy does not move from the first contact point.
    assert trace.proxy[1:, :2] == pytest.approx(0.0, abs=1e-17)


def test_paper_row_rolling_is_switched_to_sliding(plane_scene: SceneFactory) -> None:
    """f_N > 0, mu^2 f_N^2 - f_T^2 = 0 and a_T not 0: rolling switches to sliding on that tick."""
    trace = drive(Engine(plane_scene()), pressed().go(100, move=[100 * 7e-6, 0, 0]))
    tick = trace.events[1][0]
    assert trace.events[1:] == [(tick, "drag")]
    assert (0.6 * trace.normal_force[tick]) ** 2 - trace.tangential[tick] ** 2 == pytest.approx(0.0, abs=EXACT)
    assert ((0.6 * trace.normal_force[1:tick]) ** 2 > trace.tangential[1:tick] ** 2).all()
    assert (trace.mode[1:tick] == ROLLING).all()
    # a_T: the proxy moves on this tick and not before.
    assert trace.proxy[tick, 0] > 1e-7
    assert trace.proxy[1:tick, 0] == pytest.approx(0.0, abs=1e-17)


def test_paper_row_sliding_is_kept(plane_scene: SceneFactory) -> None:
    """f_N > 0 and mu_S^2 f_N^2 - f_T^2 = 0: sliding continues at any speed and under a changing load."""
    hand = pressed().go(40, move=[0.002, 0, 0]).go(300, move=[0.002, 0.01, -0.001]).go(300, move=[-0.001, 0.03, 0.0015])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag"]
    sliding = slice(trace.events[1][0] + 1, None)
    assert trace.tangential[sliding] == pytest.approx(0.5 * trace.normal_force[sliding], rel=EXACT)
    assert (trace.mode[sliding] == SLIDING).all()


def test_paper_row_sliding_is_switched_to_rolling(plane_scene: SceneFactory) -> None:
    """f_N > 0, mu_S^2 f_N^2 - f_T^2 > 0 and v_T = 0: sliding switches to rolling once the slip ends."""
    hand = pressed().go(100, move=[0.005, 0, 0])
    stop = hand.at
    # Pressed deeper on the spot: the cone exceeds the force, and nothing moves along the plane.
    hand.go(200, move=[0, 0, -0.0005])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag", "stop"]
    tick = trace.events[2][0]
    assert (0.5 * trace.normal_force[tick]) ** 2 > trace.tangential[tick] ** 2
    assert np.diff(trace.proxy[stop:, 0]) == pytest.approx(0.0, abs=1e-17)
    assert (trace.mode[tick:] == ROLLING).all()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("depth", [1e-4, 1e-3, 5e-3])
def test_a_quantised_slide_does_not_chatter(plane_scene: SceneFactory, depth: float) -> None:
    hand, rng = pressed(depth), np.random.default_rng(7)
    path = np.concatenate([np.linspace(0, 0.03, 600), np.full(200, 0.03)])
    for i, x in enumerate(path):
        noise = 1e-5 * rng.integers(-1, 2) if i < 600 else 0.0
        hand.go_to(1, [1e-5 * round(x / 1e-5) + noise, 0, R - depth])
    trace = drive(Engine(plane_scene(probe={"position_resolution_m": 1e-5})), hand)
    assert trace.causes == ["touch", "drag", "stop"]


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("kinetic", [0.5, 0.6])
@pytest.mark.parametrize("resolution", [0.0, 1e-5])
@pytest.mark.parametrize("slide", [0.0, 0.01])
def test_a_finger_at_rest_does_not_chatter(
    plane_scene: SceneFactory, cases: Cases, kinetic: float, resolution: float, slide: float
) -> None:
    hand, rng = pressed(), np.random.default_rng(13)
    hand.go(200, move=[slide, 0, 0])
    rest, x = hand.at, hand.x.copy()
    for _ in range(cases(1000, 3000)):
        hand.go_to(1, x + 1e-5 * rng.integers(-1, 2, 3))
    scene = plane_scene(material={"friction": {"kinetic": kinetic}}, probe={"position_resolution_m": resolution})
    trace = drive(Engine(scene), hand)
    assert trace.causes == (["touch", "drag", "stop"] if slide else ["touch"])
    assert (trace.mode[rest + 500 :] == ROLLING).all()


def test_the_stop_band_is_half_a_millimetre_a_second(plane_scene: SceneFactory) -> None:
    """A slip stops only if its low-passed speed enters the band of 0.5 mm/s and the finger rests."""
    # One tick of slip at 50 mm/s between pauses: each adds 4.5 mm/s to the low-passed speed, which a pause of n ticks
    # multiplies by 1.1^-n. It enters the band after 24 ticks at the earliest.
    for pause, sticks in ((20, False), (80, True)):
        hand = pressed().go(100, move=[0.005, 0, 0])
        for _ in range(10):
            hand.go(1, move=[50e-6, 0, 0]).go(pause)
        trace = drive(Engine(plane_scene()), hand)
        assert ("stop" in trace.causes) == sticks


@pytest.mark.parametrize("seed", range(5))
def test_touch_has_no_tangential_force_under_damping(plane_scene: SceneFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = plane_scene(
        coupling={"damping_ns_per_m": 1e3},
        material={"friction": {"static": 10.0, "kinetic": 10.0}},
        table={"orientation_wxyz": list(rng.normal(size=4)), "position_m": list(rng.normal(0, 0.1, 3))},
    )
    normal = matrix(scene.object[0].orientation_wxyz)[:, 2]
    origin = np.array(scene.object[0].position_m)
    tangent = np.cross(normal, rng.normal(size=3))
    engine = Engine(scene)
    for _ in range(20):
        engine.step(origin + 0.02 * normal + 0.1 * rng.normal() * tangent, [1, 0, 0, 0])
        step = engine.step(origin + 0.009 * normal + 0.01 * rng.normal() * tangent, rng.normal(size=4))
        assert step.cause == "touch"
        # Rounding of positions of 0.1 m, 3e-17 m, with a damper of 1e6 N/m in this tick.
        assert step.tangential_force < 1e-9
        engine.step(origin + 0.02 * normal, [1, 0, 0, 0])


LETTER = {"rolling": {"state_machine": "paper"}}


def test_letter_agrees_in_the_papers_cases(plane_scene: SceneFactory) -> None:
    turned = drive(Engine(plane_scene(**LETTER)), pressed().go(500, turn=[0.05, 0, 0]))
    assert turned.causes == ["touch"]
    assert turned.force[-1] == pytest.approx([0, -0.5, 1], abs=EXACT)
    for motion, cause in (({"turn": [0.5, 0, 0]}, "theta_max"), ({"move": [0.01, 0, 0]}, "drag")):
        letter = drive(Engine(plane_scene(**LETTER)), pressed().go(501, **motion))
        default = drive(Engine(plane_scene()), pressed().go(501, **motion))
        assert letter.causes == ["touch", cause]
        assert letter.events == default.events
        assert letter.tangential[-1] == pytest.approx(0.5, rel=EXACT)


def test_letter_counter_tilt_disables_sliding(plane_scene: SceneFactory) -> None:
    """A roll of one microradian against the drag disables sliding: 25 N at f_N = 1 N."""
    hand = pressed().go(1, turn=[0, 1e-6, 0]).go(500, move=[-0.025, 0, 0])
    trace = drive(Engine(plane_scene(**LETTER)), hand)
    assert trace.causes == ["touch"]
    assert trace.tangential[-1] == pytest.approx(25.0, rel=1e-5)


def test_letter_winds_up_without_end(plane_scene: SceneFactory) -> None:
    """Dragging against a roll below theta_max loads the coupling far outside the cone."""
    hand = pressed().go(50, turn=[0.05, 0, 0]).go(500, move=[0, 0.01, 0])
    trace = drive(Engine(plane_scene(**LETTER)), hand)
    assert trace.causes == ["touch"]
    assert trace.tangential[-1] == pytest.approx(10.5, rel=1e-9)


def test_letter_pushes_through_a_reversal(plane_scene: SceneFactory) -> None:
    """Friction is exactly mu_d f_N and drives a reversing hand, which creates energy."""
    hand = pressed().go(200, move=[0.01, 0, 0])
    turn = hand.at
    hand.go(200, move=[-0.01, 0, 0])
    trace = drive(Engine(plane_scene(**LETTER)), hand)
    assert trace.force[turn:, 0] == pytest.approx(-0.5, rel=EXACT)
    work = -np.sum(trace.force[turn + 1 :, 0] * np.diff(trace.poses[turn:, 0]))
    assert work == pytest.approx(-0.5 * 0.01, rel=1e-9)


def test_letter_sticks_where_the_cone_grows_at_rest(plane_scene: SceneFactory) -> None:
    hand = pressed().go(200, move=[0.01, 0, 0])
    stop = hand.at
    trace = drive(Engine(plane_scene(**LETTER)), hand.go(1).go(10, move=[0, 0, -0.0001]))
    assert trace.events[2:] == [(stop + 2, "stop")]


@pytest.mark.scaled
def test_random_motion_keeps_the_bounds(plane_scene: SceneFactory, cases: Cases) -> None:
    """Under random motion the force stays in the static cone, torsion within its limit, the proxy outside, and
    transitions are valid."""
    rng = np.random.default_rng(11)
    lawful = {
        "touch": (FREE, ROLLING),
        "drag": (ROLLING, SLIDING),
        "theta_max": (ROLLING, SLIDING),
        "stop": (SLIDING, ROLLING),
        "reverse": (SLIDING, ROLLING),
    }
    causes: set[str] = set()
    for _ in range(cases(2, 12)):
        hand = pressed(0.001)
        for _ in range(30):
            goal = [*(hand.x[:2] + rng.normal(0, 2e-3, 2)), R - rng.uniform(-0.0004, 0.003)]
            moving = rng.random() < 0.7
            turn = rng.normal(0, 0.2, 3)
            hand.go(int(rng.integers(2, 80)), move=moving * (goal - hand.x), turn=moving * turn)
        scene = plane_scene(material={"damping_ns_per_m": 1.0}, coupling={"damping_ns_per_m": 1.0})
        trace = drive(Engine(scene), hand)
        assert (trace.normal_force >= 0.0).all()
        assert (trace.tangential <= 0.6 * trace.normal_force * (1 + EXACT)).all()
        assert (np.abs(trace.torque[:, 2]) <= 0.004 * trace.normal_force * (1 + EXACT)).all()
        assert (trace.proxy[:, 2] >= R - EXACT).all()
        for before, step in zip([FREE, *trace.mode[:-1]], trace.steps, strict=True):
            if step.cause == "none":
                assert step.mode == before
            elif step.cause == "release":
                assert (before != FREE, step.mode) == (True, FREE)
            else:
                assert (before, step.mode) == lawful[step.cause]
            causes.add(step.cause)
    # Every cause must have occurred, otherwise the loop above would check less.
    assert causes == set(CAUSE_NAMES) - {"restart"}  # which is for meshes
