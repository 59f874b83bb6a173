"""Moment about the normal: its limits, the limit surface that it shares with the tangential force, and the proxy with a
rotational degree of freedom. One type of law per scene. On the plane of test_contact_acceptance.py: f_N = 1 N at 1 mm,
mu 0.6 / 0.5, k_z = 0.05 N m/rad, mu_t = 4 mm, 1 kHz."""

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from conftest import merged, paper_mapping
from helpers.examples import Cases, examples
from hypothesis import example, given
from hypothesis import strategies as st
from references.hand import on_plane, plane_engine, pressed
from references.laws import ANISOTROPIC, SPEED, Array, check_random_handling, handling

from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.numerics.ellipsoid import LAST_STEP_DISTANCE, limit_distance, multiplier, shrink
from softfinger.proxy.laws import compile_friction_laws, compile_normal_laws, compile_torsion_laws
from softfinger.proxy.record import ROLLING, SLIDING

pytestmark = pytest.mark.plain

R = 0.01
EXACT = 1e-14
"""Bound on the rounding of several hundred additions of angles of 0.1 rad times 0.05 N m/rad, N m."""

PROXY = {"model": "soft_finger_proxy", "kinetic_friction_length_m": 0.003}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("depth", [2e-4, 1e-3, 3e-3])
@pytest.mark.parametrize("exponent", [None, 0.0, 0.2, 1.0 / 3.0])
def test_moment_saturates_at_the_torsional_limit(depth: float, exponent: float | None) -> None:
    """In both directions the moment grows as k_z phi up to mu_t f_N, or mu_t f_N (f_N / 1 N)^gamma."""
    load = 1000 * depth
    limit = 0.004 * load ** (1 + (exponent or 0.0))
    for sign in (1, -1):
        trace = on_plane(pressed(depth).go(175, turn=[0, 0, sign * 0.7]), material={"torsion": {"exponent": exponent}})
        expected = -sign * np.minimum(0.05 * np.linspace(0, 0.7, 176), limit)
        assert trace.torque[1:, 2] == pytest.approx(expected, abs=EXACT)
        assert trace.force[1:] == pytest.approx(np.tile([0.0, 0.0, load], (176, 1)), abs=1e-12)
        assert trace.causes == ["touch"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("torsion", [{}, {"exponent": 0.3}, PROXY], ids=["linear", "power", "proxy"])
def test_lifting_reduces_the_moment_permanently(torsion: dict[str, Any]) -> None:
    hand = pressed(0.002).go(100, turn=[0, 0, 0.1]).go(100, move=[0, 0, 0.0018]).go(100, move=[0, 0, -0.0018])
    trace = on_plane(hand, material={"torsion": torsion})
    _, wound, lifted, _ = trace.ends
    assert trace.torque[wound, 2] == pytest.approx(-0.005, abs=EXACT)
    limit = 0.004 * 0.2 ** (1 + torsion.get("exponent", 0.0)) * (0.75 if torsion is PROXY else 1.0)
    assert trace.torque[lifted, 2] == pytest.approx(-limit, rel=1e-12)
    assert trace.torque[-1, 2] == pytest.approx(-limit, rel=1e-12)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("torsion", [{}, {"exponent": 0.3}, PROXY], ids=["linear", "power", "proxy"])
def test_torsion_without_friction(torsion: dict[str, Any]) -> None:
    hand = pressed(0.0015).go(300, turn=[0, 0, 0.3]).go(300, move=[0.01, 0, 0.0005], turn=[0, 0, -0.2])
    smooth = on_plane(hand, rolling=None, material={"friction": None, "torsion": torsion})
    rough = on_plane(hand, material={"torsion": torsion})
    assert smooth.tangential.max() == 0.0 and np.abs(smooth.torque[:, :2]).max() == 0.0
    # The moment turns about z with the finger, so the bits are equal.
    assert (smooth.torque[:, 2] == rough.torque[:, 2]).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_turning_proxy_sticks_slips_and_sticks_again(sign: int) -> None:
    hand = pressed().go(499, turn=[0, 0, sign * 0.5]).go(200).go(300, turn=[0, 0, sign * 0.3])
    trace = on_plane(hand, material={"torsion": PROXY})
    _, stop, slip_tick, _ = trace.ends
    moment = -sign * trace.torque[:, 2]
    # 499 ticks for 0.5 rad: 0.08 rad is between two ticks.
    peak = int(moment[:stop].argmax())
    assert peak == 1 + int(np.ceil(0.08 / 0.5 * 499)) and moment[peak] == pytest.approx(0.004, rel=1e-12)
    assert moment[1:peak] == pytest.approx(0.05 * 0.5 / 499 * np.arange(peak - 1), abs=EXACT)
    assert moment[peak + 1 : slip_tick + 1] == pytest.approx(0.003, rel=1e-12)
    assert moment[slip_tick:].max() == pytest.approx(0.004, rel=1e-12)
    assert moment[-1] == pytest.approx(0.003, rel=1e-12)
    # The proxy follows the probe except for the wound angle.
    assert abs(trace.steps[-1].spin) == pytest.approx(0.06, rel=1e-12) and trace.causes == ["touch"]


def test_turning_proxy_sticks_on_a_reversal() -> None:
    trace = on_plane(pressed().go(300, turn=[0, 0, 0.3]).go(300, turn=[0, 0, -0.3]), material={"torsion": PROXY})
    back = trace.torque[trace.ends[1] :, 2]
    assert back.max() == pytest.approx(0.004, rel=1e-12) and back[-1] == pytest.approx(0.003, rel=1e-12)
    peak = int(back.argmax())
    assert np.diff(back[:peak]) == pytest.approx(0.05 * 1e-3, abs=EXACT)


def test_friction_and_torsion_have_independent_limits() -> None:
    trace = on_plane(pressed().go(400, move=[0.02, 0, 0], turn=[0, 0, 0.8]), material={"torsion": PROXY})
    assert trace.tangential.max() == pytest.approx(0.6, rel=1e-12)
    assert trace.tangential[-1] == pytest.approx(0.5, rel=1e-12)
    assert trace.torque[:, 2].min() == pytest.approx(-0.004, rel=1e-12)
    assert trace.torque[-1, 2] == pytest.approx(-0.003, rel=1e-12)


@pytest.mark.scaled
def test_equal_limits_give_the_independent_model() -> None:
    """The kinetic limit defaults to the static one, and then every tick equals that of the independent model."""
    independent = plane_engine()
    proxy = plane_engine(material={"torsion": {"model": "soft_finger_proxy"}})

    @examples(10, 50)
    @given(handling())
    def check(poses: Array) -> None:
        independent.reset()
        proxy.reset()
        assert (independent.run(poses) == proxy.run(poses)).all()

    check()


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("kinetic", [0.003, 0.004])
def test_turning_proxy_does_not_chatter_at_rest(cases: Cases, kinetic: float) -> None:
    hand, rng = pressed().go(300, turn=[0, 0, 0.3]), np.random.default_rng(3)
    rest = hand.at
    flicker = 1e-3 * rng.integers(-1, 2, cases(1000, 3000))
    for change in np.diff(flicker, prepend=0.0):
        hand.go(1, turn=[0, 0, change])
    engine = plane_engine(material={"torsion": {**PROXY, "kinetic_friction_length_m": kinetic}})
    spin = engine.run(np.array(hand.poses))["contact.spin"][rest + 200 :]
    # While the proxy sticks, the wind-up follows the flicker, so their difference is constant.
    anchor = spin - flicker[199:]
    assert np.ptp(anchor) < 1e-12


HERTZ, TORSION = model.PowerNormal(1000.0 * 0.001**-0.5, 1.5, 0.0), model.Torsion(0.05, 0.004)


def objects_of(*materials: dict[str, Any]) -> Scene:
    """Return a scene of the paper's plane, and of planes with these changes of its material."""
    mapping = paper_mapping()
    (table,) = mapping["object"]
    others = [merged(table, {"name": f"object {n}", "material": changes}) for n, changes in enumerate(materials)]
    return build(Scene, mapping | {"object": [table, *others]}, "test scene")


def directed(static: float, kinetic: float, speed: float, viscous: float) -> model.AnisotropicFriction:
    law = model.SpeedFriction(static, kinetic, model.Stribeck(speed), viscous)
    return model.AnisotropicFriction(law, (1.0, 0.0, 0.0), 1.0, 1.0, 1.0, 1.0)


def test_objects_of_a_scene_share_one_law() -> None:
    assert compile_normal_laws(objects_of({"normal": {"exponent": 1.5, "damping_s_per_m": 0.5}})) == [
        model.HuntCrossley(model.PowerNormal(1000.0, 1.0, 0.0), 0.0),
        model.HuntCrossley(HERTZ, 0.5),
    ]
    rich = {"static": 0.4, "kinetic": 0.3, "direction_x": [1.0, 0.0, 0.0], **SPEED}
    laws = [directed(0.6, 0.5, 0.0, 0.0), directed(0.4, 0.3, 0.05, 0.5), directed(0.0, 0.0, 0.0, 0.0)]
    assert compile_friction_laws(objects_of({"friction": rich}, {"friction": None})) == laws
    assert compile_torsion_laws(objects_of({"torsion": PROXY}, {"torsion": None})) == [
        model.SoftFingerProxy(TORSION, 1.0),
        model.SoftFingerProxy(TORSION, 0.75),
        model.SoftFingerProxy(model.Torsion(1.0, 0.0), 1.0),
    ]
    with pytest.raises(ConfigError, match="use limit_surface for all objects with torsion, or for none"):
        objects_of({"torsion": {"model": "limit_surface"}})


F, TAU = 0.5, 0.004
"""Semi-axes of the kinetic limit surface under 1 N, N and N m."""
COUPLED = {"torsion": {"model": "limit_surface"}}
sizes = st.floats(-12, 12).map(lambda exponent: 10.0**exponent)
components = st.floats(-1e3, 1e3)


@pytest.mark.scaled
@examples(100, 1000)
@given(st.tuples(components, components, components), st.tuples(sizes, sizes, sizes))
@example((0.999999, 2.0, 0.0), (10.0**2.6875, 10.0**11.9375, 1.0))
@example((0.9999999999988552, 0.09066218073012366, 0.0), (2.3e-7, 1.3e11, 1.0))
def test_nearest_point_is_on_the_surface_and_straight_below(y, weight):
    m = multiplier(limit_distance(y), weight)
    p = shrink(limit_distance(y), weight, m)
    if np.linalg.norm(y) <= 1.0:
        assert (m, p) == (0.0, y)
        return
    # The multiplier is the only unknown: a point of this form on the surface is the nearest one.
    assert np.linalg.norm(p) == pytest.approx(1.0, abs=1e-14)
    assert m >= 0.0
    exact = np.array(y) / (1.0 + np.array(weight) * m)
    # Newton's method approaches from outside and never overshoots. The final scaling changes
    # the point by the last step squared, 1e-18, over the distance of any of its components from the surface.
    some = [np.linalg.norm(np.array(y)[list(which)]) for n in (1, 2) for which in combinations(range(3), n)]
    apart = min(abs(size - 1.0) for size in some)
    assert np.array(p) == pytest.approx(exact, rel=1e-13 if apart > 1e-4 else LAST_STEP_DISTANCE, abs=1e-300)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("speed", [0.0, 0.002, 0.02, 0.2])
@pytest.mark.parametrize("rate", [-50.0, 0.5, 5.0])
def test_steady_slip_divides_the_limit(speed: float, rate: float) -> None:
    """Slip at v and spin at omega give f = F^2 v / N and tau = tau_max^2 omega / N, N = |(F v, tau_max omega)|."""
    # Time for the springs to reach their final ratio: ten wind-ups of the slower one.
    seconds = min(10 * 0.08 / abs(rate), 10 * 0.5e-3 / speed if speed > 0.0 else np.inf) + 0.3
    ticks = int(1000 * seconds)
    poses = pressed().poses
    for i in range(1, ticks + 1):
        angle = rate * i / 2000
        poses.append(np.array([speed * i / 1000, 0, R - 0.001, np.cos(angle), 0, 0, np.sin(angle)]))
    records = plane_engine(material=COUPLED).run(np.array(poses))
    norm = np.hypot(F * speed, TAU * rate)
    # If the slip is almost all spin, the force turns slowly: an error of 1e-6 of F remains in the slowest case.
    assert records["force"][-1, 0] == pytest.approx(-(F**2) * speed / norm, abs=1e-6)
    assert records["torque"][-1, 2] == pytest.approx(-(TAU**2) * rate / norm, abs=1e-8)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("heading", [0.3, 2.0])
def test_steady_slip_on_an_anisotropic_surface(heading: float) -> None:
    """With semi-axes a, b, t, force and moment are (a^2 v_x, b^2 v_y, t^2 omega) / |(a v_x, b v_y, t omega)|."""
    velocity, rate = 0.02 * np.array([np.cos(heading), np.sin(heading)]), 4.0
    hand = pressed().go(400, move=[*(0.4 * velocity), 0], turn=[0, 0, 0.4 * rate])
    trace = on_plane(hand, material={**COUPLED, "friction": ANISOTROPIC})
    a, b = 0.5 * 0.9, 0.5 * 0.4
    norm = np.linalg.norm([a * velocity[0], b * velocity[1], TAU * rate])
    expected = -np.array([a**2 * velocity[0], b**2 * velocity[1]]) / norm
    assert trace.force[-1, :2] == pytest.approx(expected, abs=1e-8)
    assert trace.torque[-1, 2] == pytest.approx(-(TAU**2) * rate / norm, abs=1e-10)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_a_wound_finger_breaks_loose_earlier(share: float) -> None:
    """If torsion uses a share s of its limit, a drag slides at sqrt(1 - s^2) of the static limit."""
    hand = pressed().go(100, turn=[0, 0, share * 0.08]).go(200, move=[200 * 7e-6, 0, 0])
    trace = on_plane(hand, material=COUPLED)
    slide, start = trace.events[1], trace.ends[1]
    assert slide == (start + int(np.ceil(0.6e-3 * np.sqrt(1 - share**2) / 7e-6)), "drag")
    # On that tick the load is at most one step of the drag outside, and is projected back to the static surface.
    on = (trace.tangential[slide[0]] / 0.6) ** 2 + (trace.torque[slide[0], 2] / TAU) ** 2
    assert on == pytest.approx(1.0, abs=1e-12)


def test_no_coupling_inside_the_limit_surface() -> None:
    hand = pressed().go(50, move=[2e-4, 0, 0]).go(50, turn=[0, 0, 0.04]).go(50, turn=[0.01, 0, 0])
    drag = pressed().go(100, move=[0.01, 0, 0]).go(20).go(100, move=[-0.01, 0, 0])
    spin = pressed().go(100, turn=[0, 0, 0.3]).go(100, turn=[0, 0, -0.5])
    for motion in (hand, drag, spin):
        coupled, alone = on_plane(motion, material=COUPLED), on_plane(motion)
        assert coupled.force == pytest.approx(alone.force, abs=1e-12)
        assert coupled.torque == pytest.approx(alone.torque, abs=1e-14) and coupled.events == alone.events


@pytest.mark.scaled
def test_load_stays_within_the_limit_surface() -> None:
    """For random hand motions, (f_T / mu_s f_N)^2 + (tau_n / tau_max)^2 is at most one."""
    engine = plane_engine(material=COUPLED, coupling={"damping_ns_per_m": 1.0})

    # 90 hands of about 130 ticks: 10^4 cases.
    def check(records: Array) -> None:
        normal = records["contact.normal_force"]
        force, moment = records["contact.tangential_force"], records["torque"][:, 2]
        pushed = normal > 0.0
        assert (force[~pushed] == 0.0).all() and (moment[~pushed] == 0.0).all()
        on = (force[pushed] / (0.6 * normal[pushed])) ** 2 + (moment[pushed] / (0.004 * normal[pushed])) ** 2
        assert (on <= 1.0 + 1e-9).all()

    check_random_handling(engine, 8, 90, check)


def test_a_spin_after_a_slide_continues_to_slip() -> None:
    trace = on_plane(pressed().go(200, move=[0.01, 0, 0]).go(1000, turn=[0, 0, 5.0]), material=COUPLED)
    assert trace.causes == ["touch", "drag"] and (trace.mode[300:] == SLIDING).all()
    assert trace.tangential[-1] < 1e-6 and trace.torque[-1, 2] == pytest.approx(-TAU, rel=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("spin", [0.0, 0.4])
def test_at_rest_on_the_surface_it_does_not_chatter(cases: Cases, spin: float) -> None:
    hand, rng = pressed().go(200, move=[0.01, 0, 0], turn=[0, 0, spin]), np.random.default_rng(5)
    x = hand.x.copy()
    for _ in range(cases(1000, 3000)):
        hand.go_to(1, x + 1e-5 * np.array([*rng.integers(-1, 2, 2), 0]))
    trace = on_plane(hand, material=COUPLED, probe={"position_resolution_m": 1e-5})
    assert trace.causes == ["touch", "drag", "stop"] and trace.mode[-1] == ROLLING


@pytest.mark.sampled(2)
@pytest.mark.parametrize("length", [0.0, 1e-12, 1.0])
@pytest.mark.parametrize("kinetic", [0.0, 0.5])
def test_flat_surfaces_are_finite(length: float, kinetic: float) -> None:
    material = {
        "torsion": {"model": "limit_surface", "friction_length_m": length},
        "friction": {"static": kinetic * 1.2, "kinetic": kinetic},
    }
    hand = pressed().go(200, move=[0.01, 0.003, 0], turn=[0, 0, 1.0]).go(50, move=[0, 0, 0.0009999]).go(3)
    records = plane_engine(material=material).run(np.array(hand.poses))
    assert np.isfinite(records).all()
    normal = records["contact.normal_force"]
    assert (records["contact.tangential_force"] <= 1.2 * kinetic * normal * (1 + 1e-12)).all()
    assert (np.abs(records["torque"][:, 2]) <= length * normal * (1 + 1e-12)).all()
