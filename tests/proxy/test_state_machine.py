"""Free, rolling, sliding: exact conditions of transitions, noise that must not cause one, and the paper's rule. The
scene is that of test_contact_acceptance.py: f_N = 1 N at 1 mm, mu 0.6 / 0.5, K = 1000 N/m, 1 kHz."""

import numpy as np
import pytest
from conftest import paper_scene
from helpers.examples import Cases
from references.hand import on_plane, plane_engine, pressed
from references.rotation import matrix

from softfinger.proxy.engine import Engine
from softfinger.proxy.record import FREE, ROLLING, SLIDING

pytestmark = pytest.mark.plain

R = 0.01
EXACT = 1e-12
"""Rounding of some hundred additions of order 1e-2 m times 1000 N/m, N."""


def test_touch_is_the_first_tick_below_the_surface() -> None:
    engine = plane_engine()
    assert engine.step([0, 0, R], [1, 0, 0, 0]).mode == FREE
    step = engine.step([0, 0, R - 1e-9], [1, 0, 0, 0])
    assert (step.mode, step.cause, step.object) == (ROLLING, "touch", 0)


def test_theta_max_is_the_roll_the_hand_has_not_followed() -> None:
    """A hand that follows half the roll slides at twice theta_max: 0.12 rad instead of 0.06."""
    trace = on_plane(pressed().go(301, move=[0, -0.15 * R, 0], turn=[0.3, 0, 0]))
    assert trace.events == [(1, "touch"), (1 + int(np.ceil(0.12 / 0.3 * 301)), "theta_max")]


def test_theta_max_grows_with_the_normal_force() -> None:
    """theta_max = mu_s f_N / (k_tau r): pressing twice as deep doubles the roll that sticks."""
    for depth in (0.0005, 0.001, 0.002):
        trace = on_plane(pressed(depth).go(301, turn=[0, 0.3, 0]))
        assert trace.events == [(1, "touch"), (1 + int(np.ceil(0.6 * depth / R / 0.3 * 301)), "theta_max")]


def test_a_slow_slide_is_not_a_stop() -> None:
    trace = on_plane(pressed().go(100, move=[0.002, 0, 0]).go(1000, move=[0.0001, 0, 0]))
    assert trace.causes == ["touch", "drag"] and trace.tangential[-900:] == pytest.approx(0.5, rel=EXACT)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("resolution", "distance"), [(0.0, 0.05e-3), (1e-5, 0.05e-3), (1e-4, 0.3e-3)])
def test_reverse_sticks_after_a_tenth_or_three_encoder_steps(resolution: float, distance: float) -> None:
    """The larger of 10 % of the deflection of 0.5 mm and three encoder steps."""
    step_m = 23e-6
    hand = pressed().go(500, move=[0.025, 0, 0]).go(40, move=[-40 * step_m, 0, 0])
    trace = on_plane(hand, probe={"position_resolution_m": resolution})
    assert trace.events[2] == (hand.ends[1] + int(np.ceil(distance / step_m)), "reverse")
    assert (trace.mode[trace.events[2][0] :] == ROLLING).all()


def test_release_clears_everything() -> None:
    hand = pressed().go(100, move=[0.01, 0, 0], turn=[0, 0, 0.05]).go_to(1, [0.01, 0, R + 0.001])
    trace = on_plane(hand.go_to(1, [0.01, 0, R - 0.001]).go(5))
    out = trace.ends[2]
    assert trace.events[-2:] == [(out, "release"), (out + 1, "touch")]
    released = trace.steps[out]
    assert (released.mode, released.object, released.penetration) == (FREE, -1, 0.0)
    assert (released.spin, released.rolled, released.normal_force, released.tangential_force) == (0.0, 0.0, 0.0, 0.0)
    assert not released.force.any() and not released.torque.any()
    assert trace.force[out + 1 :] == pytest.approx(np.tile([0, 0, 1], (6, 1)), abs=EXACT)
    assert trace.torque[out + 1 :] == pytest.approx(np.zeros((6, 3)), abs=EXACT)


@pytest.mark.parametrize("drag", [0.0, 0.005])
def test_zero_normal_force_inside_is_not_a_release(drag: float) -> None:
    """Damping closes the friction cone, too."""
    hand = pressed(0.002).go(100, move=[drag, 0, 0]).go(30, move=[0.2 * drag, 0, 0.006])
    trace = on_plane(hand, material={"damping_ns_per_m": 10.0}, coupling={"damping_ns_per_m": 1.0})
    inside = (trace.poses[:, 2] < R) & (trace.normal_force == 0.0)
    assert inside.sum() >= 5 and (trace.mode[inside] != FREE).all() and not trace.tangential[inside].any()
    assert trace.causes.count("release") == 1


def test_a_hand_that_follows_gets_its_cone_back() -> None:
    """After a roll of 0.05 rad the hand may follow it and move 0.6 mm further before it slides."""
    trace = on_plane(pressed().go(50, turn=[0.05, 0, 0]).go(200, move=[0, -200 * 7e-6, 0]))
    start = trace.ends[1]
    assert trace.events == [(1, "touch"), (start + int(np.ceil(1.1e-3 / 7e-6)), "drag")]
    # The force crosses zero when the hand has caught up, and then opposes it.
    assert trace.force[start, 1] == pytest.approx(-0.5, abs=EXACT)
    assert trace.force[-1, 1] == pytest.approx(0.5, abs=EXACT)


def test_friction_opposes_the_slip_not_the_hand() -> None:
    """A sliding finger that rolls faster than the hand moves is pushed forward: slip is v - r w x n."""
    # Surface speed of the roll: -50 mm/s along y; the hand moves at -20 mm/s: the fingertip's skin slips along +y.
    trace = on_plane(pressed().go(500, move=[0, -0.01, 0], turn=[2.5, 0, 0]))
    assert trace.causes == ["touch", "theta_max"] and trace.force[-1] == pytest.approx([0, -0.5, 1], abs=EXACT)


def test_paper_row_rolling_is_kept() -> None:
    """f_N > 0, mu^2 f_N^2 - f_T^2 > 0 and no slip: rolling continues under every load inside the cone."""
    hand = pressed()
    for angle in np.linspace(0, 2 * np.pi, 9):
        hand.go_to(20, [0.59e-3 * np.cos(angle), 0.59e-3 * np.sin(angle), R - 0.001])
    trace = on_plane(hand)
    assert ((0.6 * trace.normal_force[1:]) ** 2 - trace.tangential[1:] ** 2 > 0.0).all()
    assert (trace.mode[1:] == ROLLING).all()
    # No slip: the proxy does not move from the first contact point.
    assert trace.proxy[1:, :2] == pytest.approx(0.0, abs=1e-17)


def test_paper_row_rolling_is_switched_to_sliding() -> None:
    """f_N > 0, mu^2 f_N^2 - f_T^2 = 0 and a_T not 0: rolling switches to sliding on that tick."""
    trace = on_plane(pressed().go(100, move=[100 * 7e-6, 0, 0]))
    tick = trace.events[1][0]
    assert trace.events[1:] == [(tick, "drag")]
    assert (0.6 * trace.normal_force[tick]) ** 2 - trace.tangential[tick] ** 2 == pytest.approx(0.0, abs=EXACT)
    assert ((0.6 * trace.normal_force[1:tick]) ** 2 > trace.tangential[1:tick] ** 2).all()
    assert (trace.mode[1:tick] == ROLLING).all()
    # a_T: the proxy moves on this tick and not before.
    assert trace.proxy[tick, 0] > 1e-7 and trace.proxy[1:tick, 0] == pytest.approx(0.0, abs=1e-17)


def test_paper_row_sliding_is_kept() -> None:
    """f_N > 0 and mu_S^2 f_N^2 - f_T^2 = 0: sliding continues at any speed and under a changing load."""
    hand = pressed().go(40, move=[0.002, 0, 0]).go(300, move=[0.002, 0.01, -0.001]).go(300, move=[-0.001, 0.03, 0.0015])
    trace = on_plane(hand)
    assert trace.causes == ["touch", "drag"]
    sliding = slice(trace.events[1][0] + 1, None)
    assert trace.tangential[sliding] == pytest.approx(0.5 * trace.normal_force[sliding], rel=EXACT)
    assert (trace.mode[sliding] == SLIDING).all()


def test_paper_row_sliding_is_switched_to_rolling() -> None:
    """f_N > 0, mu_S^2 f_N^2 - f_T^2 > 0 and v_T = 0: sliding switches to rolling once the slip ends."""
    # Pressed deeper on the spot: the cone exceeds the force, and nothing moves along the plane.
    trace = on_plane(pressed().go(100, move=[0.005, 0, 0]).go(200, move=[0, 0, -0.0005]))
    assert trace.causes == ["touch", "drag", "stop"]
    tick, stop = trace.events[2][0], trace.ends[1]
    assert (0.5 * trace.normal_force[tick]) ** 2 > trace.tangential[tick] ** 2
    assert np.diff(trace.proxy[stop:, 0]) == pytest.approx(0.0, abs=1e-17)
    assert (trace.mode[tick:] == ROLLING).all()


def test_paper_row_contact_is_broken() -> None:
    """f_N = 0 and a_N > 0, the finger leaves the plane: rolling and sliding both end on that tick."""
    for drag in (0.0, 0.005):
        trace = on_plane(pressed().go(50, move=[drag, 0, 0]).go_to(7, [drag, 0, R + 1e-3]))
        broken = next(tick for tick, cause in trace.events if cause == "release")
        separating = (trace.normal_force == 0.0) & (np.diff(trace.poses[:, 2], prepend=R) > 0.0)
        assert broken == int(np.flatnonzero(separating[2:])[0]) + 2
        assert trace.poses[broken, 2] >= R > trace.poses[broken - 1, 2]
        assert trace.mode[broken - 1] == (SLIDING if drag else ROLLING) and (trace.mode[broken:] == FREE).all()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("depth", [1e-4, 1e-3, 5e-3])
def test_a_quantised_slide_does_not_chatter(depth: float) -> None:
    hand, rng = pressed(depth), np.random.default_rng(7)
    path = np.concatenate([np.linspace(0, 0.03, 600), np.full(200, 0.03)])
    for i, x in enumerate(path):
        noise = 1e-5 * rng.integers(-1, 2) if i < 600 else 0.0
        hand.go_to(1, [1e-5 * round(x / 1e-5) + noise, 0, R - depth])
    assert on_plane(hand, probe={"position_resolution_m": 1e-5}).causes == ["touch", "drag", "stop"]


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("kinetic", [0.5, 0.6])
@pytest.mark.parametrize("resolution", [0.0, 1e-5])
@pytest.mark.parametrize("slide", [0.0, 0.01])
def test_a_finger_at_rest_does_not_chatter(cases: Cases, kinetic: float, resolution: float, slide: float) -> None:
    hand, rng = pressed(), np.random.default_rng(13)
    hand.go(200, move=[slide, 0, 0])
    rest, x = hand.at, hand.x.copy()
    for _ in range(cases(1000, 3000)):
        hand.go_to(1, x + 1e-5 * rng.integers(-1, 2, 3))
    trace = on_plane(hand, material={"friction": {"kinetic": kinetic}}, probe={"position_resolution_m": resolution})
    assert trace.causes == (["touch", "drag", "stop"] if slide else ["touch"])
    assert (trace.mode[rest + 500 :] == ROLLING).all()


def test_the_stop_band_is_half_a_millimetre_a_second() -> None:
    """A slip stops only if its low-passed speed enters the band of 0.5 mm/s and the finger rests."""
    # One tick of slip at 50 mm/s between pauses: each adds 4.5 mm/s to the low-passed speed, which a pause of n ticks
    # multiplies by 1.1^-n. It enters the band after 24 ticks at the earliest.
    for pause, sticks in ((20, False), (80, True)):
        hand = pressed().go(100, move=[0.005, 0, 0])
        for _ in range(10):
            hand.go(1, move=[50e-6, 0, 0]).go(pause)
        assert ("stop" in on_plane(hand).causes) == sticks


@pytest.mark.parametrize("seed", range(5))
def test_touch_has_no_tangential_force_under_damping(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = paper_scene(
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


def test_letter_agrees_in_the_papers_cases() -> None:
    turned = on_plane(pressed().go(500, turn=[0.05, 0, 0]), **LETTER)
    assert turned.causes == ["touch"] and turned.force[-1] == pytest.approx([0, -0.5, 1], abs=EXACT)
    for motion, cause in (({"turn": [0.5, 0, 0]}, "theta_max"), ({"move": [0.01, 0, 0]}, "drag")):
        letter = on_plane(pressed().go(501, **motion), **LETTER)
        default = on_plane(pressed().go(501, **motion))
        assert letter.causes == ["touch", cause] and letter.events == default.events
        assert letter.tangential[-1] == pytest.approx(0.5, rel=EXACT)


@pytest.mark.parametrize(
    ("ticks", "turn", "move", "load"), [(1, [0, 1e-6, 0], [-0.025, 0, 0], 25.0), (50, [0.05, 0, 0], [0, 0.01, 0], 10.5)]
)
def test_letter_winds_up_without_end(ticks: int, turn: list[float], move: list[float], load: float) -> None:
    """A roll below theta_max against the drag, even of one microradian, disables sliding: 25 N at f_N = 1 N."""
    trace = on_plane(pressed().go(ticks, turn=turn).go(500, move=move), **LETTER)
    assert trace.causes == ["touch"] and trace.tangential[-1] == pytest.approx(load, rel=1e-5)


def test_letter_slides_a_finger_that_follows() -> None:
    """The literal rule counts the entire roll, so a finger that follows its roll perfectly slides at theta_max."""
    hand = pressed().go(1001, move=[0, -R, 0], turn=[1, 0, 0])
    assert on_plane(hand, **LETTER).events[1] == (1 + int(np.ceil(0.06 * 1001)), "theta_max")


def test_letter_pushes_through_a_reversal() -> None:
    """Friction is exactly mu_d f_N and drives a reversing hand, which creates energy."""
    trace = on_plane(pressed().go(200, move=[0.01, 0, 0]).go(200, move=[-0.01, 0, 0]), **LETTER)
    turn = trace.ends[1]
    assert trace.force[turn:, 0] == pytest.approx(-0.5, rel=EXACT)
    work = -np.sum(trace.force[turn + 1 :, 0] * np.diff(trace.poses[turn:, 0]))
    assert work == pytest.approx(-0.5 * 0.01, rel=1e-9)


def test_letter_never_sticks_after_an_exact_stop() -> None:
    """The force is on the cone and never inside it, so a finger at rest continues to slide."""
    trace = on_plane(pressed().go(200, move=[0.01, 0, 0]).go(500), **LETTER)
    assert trace.causes == ["touch", "drag"] and (trace.mode[-400:] == SLIDING).all()


def test_letter_sticks_where_the_cone_grows_at_rest() -> None:
    trace = on_plane(pressed().go(200, move=[0.01, 0, 0]).go(1).go(10, move=[0, 0, -0.0001]), **LETTER)
    assert trace.events[2:] == [(trace.ends[1] + 2, "stop")]
