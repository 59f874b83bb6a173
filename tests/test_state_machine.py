"""Free, rolling, sliding: each transition with its condition, and what must not cause one.

The scene is that of test_contact_acceptance.py: f_N = 1 N at 1 mm, mu 0.6 / 0.5, K = 1000 N/m, 1 kHz.
"""

from __future__ import annotations

import numpy as np
import pytest
from conftest import SceneFactory
from references.hand import Hand, drive

from softfinger.proxy.engine import Engine
from softfinger.proxy.state import CAUSE_NAMES, FREE, ROLLING, SLIDING

R = 0.01
EXACT = 1e-12
"""Rounding of some hundred additions of order 1e-2 m times 1000 N/m, N."""


def pressed(depth: float = 0.001) -> Hand:
    """A hand that was free on its first tick and is pressed in from its second."""
    return Hand([0.0, 0.0, R + 0.001]).go_to(1, [0.0, 0.0, R - depth])


# --- the transitions -------------------------------------------------------------------------------


def test_touch_is_the_first_tick_below_the_surface(plane_scene: SceneFactory) -> None:
    """Contact begins where the gap falls under the radius, and not on it."""
    engine = Engine(plane_scene())
    assert engine.step([0, 0, R], [1, 0, 0, 0]).mode == FREE
    step = engine.step([0, 0, R - 1e-9], [1, 0, 0, 0])
    assert (step.mode, step.cause, step.object) == (ROLLING, "touch", 0)


def test_touch_starts_unwound(plane_scene: SceneFactory) -> None:
    """A finger that lands moving and turning feels only the normal force on that tick."""
    engine = Engine(plane_scene())
    engine.step([-0.02, 0.01, R + 0.005], [1, 0, 0, 0])
    step = engine.step([0, 0, R - 0.001], [0.6, 0.48, 0.64, 0])
    assert step.cause == "touch"
    assert step.force == pytest.approx([0, 0, 1], abs=EXACT)
    assert step.torque == pytest.approx([0, 0, 0], abs=EXACT)
    assert (step.rolled, step.spin) == (0.0, 0.0)
    assert step.proxy_position == pytest.approx([0, 0, R], abs=EXACT)


@pytest.mark.parametrize("depth", [0.0005, 0.001, 0.003])
def test_drag_begins_at_the_static_cone(plane_scene: SceneFactory, depth: float) -> None:
    """A finger dragged without turning sticks until K times the way reaches mu_s f_N."""
    step_m = 7e-6  # 0.6 of no depth tried is a multiple of it
    trace = drive(Engine(plane_scene()), pressed(depth).go(400, move=[400 * step_m, 0, 0]))
    slide = 1 + int(np.ceil(0.6 * depth / step_m))
    assert trace.events == [(1, "touch"), (slide, "drag")]
    assert trace.force[1:slide, 0] == pytest.approx(-1000 * step_m * np.arange(slide - 1), abs=EXACT)
    assert trace.tangential[slide] == pytest.approx(0.6 * trace.normal_force[slide], rel=EXACT)


def test_drag_begins_where_the_normal_force_drops(plane_scene: SceneFactory) -> None:
    """A finger held aside starts to slide when lifting takes mu_s f_N below the held force."""
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
    """A finger that stops sticks once its filtered slip speed is under 0.5 mm/s; force and spin stay."""
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
    """Sliding at 0.1 mm/s, well under the speed at which a stop is seen, goes on sliding."""
    hand = pressed().go(100, move=[0.002, 0, 0]).go(3000, move=[0.0003, 0, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag"]
    assert trace.tangential[-2900:] == pytest.approx(0.5, rel=EXACT)


@pytest.mark.parametrize(("resolution", "way"), [(0.0, 0.05e-3), (1e-5, 0.05e-3), (1e-4, 0.3e-3)])
def test_reverse_sticks_after_a_tenth_or_three_encoder_steps(
    plane_scene: SceneFactory, resolution: float, way: float
) -> None:
    """A reversal sticks when the deflection of 0.5 mm has fallen by 10 %, or by three encoder steps if that is more."""
    hand = pressed().go(500, move=[0.025, 0, 0])
    turn = hand.at
    step_m = 23e-6
    hand.go(40, move=[-40 * step_m, 0, 0])
    trace = drive(Engine(plane_scene(probe={"position_resolution_m": resolution})), hand)
    assert trace.events[2] == (turn + int(np.ceil(way / step_m)), "reverse")
    assert (trace.mode[trace.events[2][0] :] == ROLLING).all()


def test_a_turn_across_the_slide_is_not_a_reversal(plane_scene: SceneFactory) -> None:
    """Turning the corner by 90 degrees while sliding keeps sliding, and the force swings round with the motion."""
    hand = pressed().go(200, move=[0.01, 0, 0]).go(400, move=[0, 0.02, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag"]
    assert trace.tangential[202:] == pytest.approx(0.5, rel=EXACT)
    assert trace.force[-1] == pytest.approx([0, -0.5, 1], abs=1e-6)


def test_release_clears_everything(plane_scene: SceneFactory) -> None:
    """Leaving ends the contact at the surface with zero force, and the next touch knows nothing of the last."""
    hand = pressed().go(100, move=[0.01, 0, 0], turn=[0, 0, 0.05])
    hand.go_to(1, [0.01, 0, R + 0.001])
    out = hand.at
    hand.go_to(1, [0.01, 0, R - 0.001]).go(5)
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events[-2:] == [(out, "release"), (out + 1, "touch")]
    gone = trace.steps[out]
    assert (gone.mode, gone.object, gone.penetration) == (FREE, -1, 0.0)
    assert (gone.spin, gone.rolled, gone.normal_force, gone.tangential_force) == (0.0, 0.0, 0.0, 0.0)
    assert not gone.force.any()
    assert not gone.torque.any()
    assert trace.force[out + 1 :] == pytest.approx(np.tile([0, 0, 1], (6, 1)), abs=EXACT)
    assert trace.torque[out + 1 :] == pytest.approx(np.zeros((6, 3)), abs=EXACT)


def test_release_from_sliding_at_the_surface(plane_scene: SceneFactory) -> None:
    """A slide that lifts off ends exactly where the gap is the radius, with one event."""
    hand = pressed().go(100, move=[0.005, 0, 0]).go(203, move=[0.01, 0, 0.002])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.causes == ["touch", "drag", "release"]
    out = trace.events[-1][0]
    assert trace.poses[out, 2] >= R > trace.poses[out - 1, 2]


def test_zero_normal_force_inside_is_not_a_release(plane_scene: SceneFactory) -> None:
    """A finger that withdraws so fast that damping cancels the force is still in contact until it is out."""
    scene = plane_scene(material={"damping_ns_per_m": 10.0})
    trace = drive(Engine(scene), pressed(0.002).go(10).go(30, move=[0, 0, 0.006]))
    inside = (trace.poses[:, 2] < R) & (trace.normal_force == 0.0)
    assert inside.sum() >= 5
    assert (trace.mode[inside] != FREE).all()
    assert trace.causes.count("release") == 1


# --- the sign rule ---------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, -1, 0], [0.6, 0.8, 0]])
def test_an_honest_roll_never_slides(plane_scene: SceneFactory, axis: list[float]) -> None:
    """Three radians rolled to and fro with the hand on the contact: touch is the only event."""
    along = R * np.cross(axis, [0, 0, 1])
    hand = pressed()
    for angle in (3.0, -2.0, 0.7, -0.01, 1.2):
        hand.go(400, move=angle * along, turn=angle * np.asarray(axis))
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events == [(1, "touch")]
    assert trace.tangential.max() < 1e-11


def test_a_roll_followed_with_a_lag_never_slides(plane_scene: SceneFactory) -> None:
    """A hand drawn along by the coupling, 0.4 mm behind for a whole radian, keeps rolling under a steady force."""
    hand = pressed().go(40, turn=[0.04, 0, 0]).go(1000, move=[0, -R, 0], turn=[1, 0, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events == [(1, "touch")]
    # Were the whole roll counted and not what the hand lags, this would have slid at 0.06 rad.
    assert trace.force[41:] == pytest.approx(np.tile([0, -0.4, 1], (1001, 1)), abs=1e-11)


def test_a_hand_that_follows_gets_its_cone_back(plane_scene: SceneFactory) -> None:
    """After a roll of 0.05 rad the hand may follow it and go on by 0.6 mm before it slides."""
    hand = pressed().go(50, turn=[0.05, 0, 0])
    start = hand.at
    hand.go(200, move=[0, -200 * 7e-6, 0])
    trace = drive(Engine(plane_scene()), hand)
    assert trace.events == [(1, "touch"), (start + int(np.ceil(1.1e-3 / 7e-6)), "drag")]
    # The force crosses zero where the hand has caught up, and then opposes it.
    assert trace.force[start, 1] == pytest.approx(-0.5, abs=EXACT)
    assert trace.force[-1, 1] == pytest.approx(0.5, abs=EXACT)


def test_drag_against_a_roll_does_not_wind_up(plane_scene: SceneFactory) -> None:
    """Rolling one way while dragging the other is bounded by the cone however long it goes on."""
    trace = drive(Engine(plane_scene()), pressed().go(2000, move=[0, 0.05, 0], turn=[5, 0, 0]))
    assert len(trace.events) == 2
    assert trace.tangential.max() == pytest.approx(0.6, rel=EXACT)
    assert trace.tangential[-1] == pytest.approx(0.5, rel=EXACT)


def test_friction_opposes_the_slip_not_the_hand(plane_scene: SceneFactory) -> None:
    """A sliding finger that rolls faster than the hand moves is pushed forward: slip is v - r w x n."""
    # Surface speed of the roll: -50 mm/s along y; the hand goes -20 mm/s: the fingertip's skin slips along +y.
    trace = drive(Engine(plane_scene()), pressed().go(500, move=[0, -0.01, 0], turn=[2.5, 0, 0]))
    assert trace.causes == ["touch", "theta_max"]
    assert trace.force[-1] == pytest.approx([0, -0.5, 1], abs=EXACT)


# --- the paper's two failure modes -----------------------------------------------------------------


def test_rolling_moves_the_contact_on_the_object(plane_scene: SceneFactory) -> None:
    """A classical proxy moves the contact on the finger only and lets it slip; here it moves on both alike."""
    trace = drive(Engine(plane_scene()), pressed().go(300, move=[0, -0.3 * R, 0], turn=[0.3, 0, 0]))
    on_plane = trace.steps[-1].point - trace.steps[1].point
    before, after = trace.steps[1].finger_point, trace.steps[-1].finger_point
    on_finger = R * np.arccos(np.clip(before @ after / R**2, -1, 1))
    # The two arcs are equally long: rolling without slip. arccos near 0.3 rad is good to 1e-15 / sin(0.3).
    assert np.linalg.norm(on_plane) == pytest.approx(on_finger, rel=1e-12)
    assert on_finger == pytest.approx(0.3 * R, rel=1e-12)
    assert SLIDING not in trace.mode


def test_any_tangential_force_is_not_enough_to_slide(plane_scene: SceneFactory) -> None:
    """The coupling's own force while rolling does not end rolling: up to theta_max the contact stays rolling."""
    trace = drive(Engine(plane_scene()), pressed().go(590, turn=[0.059, 0, 0]))
    assert (trace.mode[1:] == ROLLING).all()
    assert trace.tangential[-1] == pytest.approx(0.59, abs=EXACT)


# --- chatter and bounds ----------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [1e-4, 1e-3, 5e-3])
def test_a_quantised_slide_does_not_chatter(plane_scene: SceneFactory, depth: float) -> None:
    """A drag seen through encoders of 10 um and tremor of one step slips once and sticks once."""
    hand, rng = pressed(depth), np.random.default_rng(7)
    way = np.concatenate([np.linspace(0, 0.03, 600), np.full(200, 0.03)])
    for i, x in enumerate(way):
        noise = 1e-5 * rng.integers(-1, 2) if i < 600 else 0.0
        hand.go_to(1, [1e-5 * round(x / 1e-5) + noise, 0, R - depth])
    trace = drive(Engine(plane_scene(probe={"position_resolution_m": 1e-5})), hand)
    assert trace.causes == ["touch", "drag", "stop"]


def test_random_motion_keeps_the_bounds(plane_scene: SceneFactory) -> None:
    """Whatever the hand does, force stays in the static cone, torsion in its limit, the proxy outside, modes lawful."""
    rng = np.random.default_rng(11)
    lawful = {
        "touch": (FREE, ROLLING),
        "drag": (ROLLING, SLIDING),
        "theta_max": (ROLLING, SLIDING),
        "stop": (SLIDING, ROLLING),
        "reverse": (SLIDING, ROLLING),
    }
    seen: set[str] = set()
    for _ in range(12):
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
            seen.add(step.cause)
    # Otherwise the loop above would prove less than it says.
    assert seen == set(CAUSE_NAMES)
