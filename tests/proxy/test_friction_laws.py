"""Friction laws compared with their closed forms, and properties common to all of them. On the plane of
test_contact_acceptance.py: f_N = 1 N at 1 mm, mu 0.6 / 0.5, K = 1000 N/m, 1 kHz."""

from typing import Any

import numpy as np
import pytest
from references import laws
from references.hand import Hand, on_plane, plane_engine, pressed
from references.laws import ANISOTROPIC, LAWS, rolling
from references.rotation import matrix, multiply, quaternion

pytestmark = pytest.mark.plain

R = 0.01
EXACT = 1e-12
"""Bound on the rounding error of several hundred additions of order 1e-2 m times 1000 N/m, N."""


@pytest.mark.sampled(3)
@pytest.mark.parametrize("depth", [1e-4, 1e-3, 4e-3])
@pytest.mark.parametrize("speed", [0.002, 0.05, 0.5])
def test_ramp_peaks_at_static_and_slides_at_kinetic_friction(depth: float, speed: float) -> None:
    ticks = int(0.84 * depth / (speed / 1000)) + 20  # 1.4 times the distance to the peak, plus a margin
    trace = on_plane(pressed(depth).go(ticks, move=[ticks * speed / 1000, 0, 0]))
    assert trace.causes == ["touch", "drag"]
    slide, load = trace.events[1][0], 1000 * depth
    # The contract is 0.1 %; the remaining error is the rounding of z, 1e-18 m in 1e-4 m.
    assert trace.tangential.max() == pytest.approx(0.6 * load, rel=1e-12)
    assert trace.tangential[slide] == pytest.approx(0.6 * load, rel=1e-12) and len(trace.tangential) > slide + 3
    assert trace.tangential[slide + 1 :] == pytest.approx(0.5 * load, rel=1e-12)


@pytest.mark.parametrize("stiffness", [1e1, 1e3, 1e6])
@pytest.mark.parametrize("depth", [1e-6, 1e-3])
def test_forces_contain_no_length_margin(stiffness: float, depth: float) -> None:
    hand = pressed(depth).go(10, move=[0.3 * depth, 0, 0]).go(70, move=[7 * depth, 0, 0])
    trace = on_plane(hand, **{name: {"stiffness_n_per_m": stiffness} for name in ("material", "coupling")})
    # Positions of 1e-2 m are rounded to 2e-18 m; the bound allows ten such errors.
    rounding = stiffness * 2e-17
    assert trace.normal_force[1:] == pytest.approx(stiffness * depth, abs=rounding)
    assert trace.force[hand.ends[1], 0] == pytest.approx(-0.3 * stiffness * depth, abs=rounding)
    assert trace.force[-1, 0] == pytest.approx(-0.5 * stiffness * depth, abs=rounding)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("law", list(LAWS))
def test_steady_slide_has_no_ripple(law: str) -> None:
    hand = pressed().go(700, move=[0.035, 0.021, 0], turn=[0, 0, 0.7])
    records = plane_engine(material=LAWS[law], rolling=rolling(law)).run(np.array(hand.poses))
    # The low-passed speeds have settled to 1e-13 after thirty time constants.
    steady = records["force"][-350:, :2]
    assert np.abs(np.diff(steady, axis=0)).max() < 1e-11
    assert np.abs(np.fft.rfft(steady - steady.mean(axis=0), axis=0))[-1].max() / len(steady) < 1e-11


@pytest.mark.sampled(2)
@pytest.mark.parametrize("speed", [0.005, 0.05, 0.15, 0.4])
@pytest.mark.parametrize(
    ("friction", "coefficient"),
    [
        ({"stribeck_speed_m_per_s": 0.05}, lambda v: 0.5 + 0.1 * np.exp(-((v / 0.05) ** 2))),
        ({"viscous_s_per_m": 0.5}, lambda v: 0.5 + 0.5 * v),
        (laws.SPEED, lambda v: 0.5 + 0.1 * np.exp(-((v / 0.05) ** 2)) + 0.5 * v),
    ],
    ids=["stribeck", "viscous", "both"],
)
def test_friction_follows_the_slip_speed(speed: float, friction: dict[str, float], coefficient: Any) -> None:
    """A steady slide at v has mu_d + (mu_s - mu_d) exp(-(v / v_s)^2) + c v, after a peak of mu_s at break-away."""
    ticks = int(2e-3 / speed * 1000) + 500
    trace = on_plane(pressed().go(ticks, move=[speed * ticks / 1000, 0, 0]), material={"friction": friction})
    assert trace.causes == ["touch", "drag"]
    assert trace.tangential[trace.events[1][0]] == pytest.approx(0.6, rel=EXACT)
    # Transient left after fifty time constants of the speed's low-pass, at worst slowed by the Stribeck curve.
    assert trace.tangential[-1] == pytest.approx(coefficient(speed), rel=1e-8)


DIRECTED = {"direction_x": [1.0, 0.0, 0.0], "static_scale": [1.0, 1.0], "kinetic_scale": [0.25, 0.5]}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("viscosity", [0.5, 9.0, 14.0, 100.0])
@pytest.mark.parametrize(("friction", "axis", "scale"), [({}, 0, 1.0), (DIRECTED, 0, 0.25), (DIRECTED, 1, 0.5)])
def test_viscous_friction_has_one_time_constant(viscosity, friction, axis, scale):
    """The coupling K and the low-pass (T0 = 10 ms) are in series with the damper c f_N, so the force of a steady drag
    approaches (mu_d + c v) f_N exponentially with T0 + c f_N / K; in a tick of dt by the factor T / (T + dt)."""
    speed, constant = 0.07, 0.01 + scale * viscosity * 1.0 / 1000.0
    final = scale * (0.5 + viscosity * speed)
    # A drag of the steady deflection, and until 1e-3 of the force is missing.
    ticks = int((final * 1e-3 / speed + 8.0 * constant) * 1000)
    hand = pressed().go(ticks, move=speed * ticks / 1000 * np.eye(3)[axis])
    records = plane_engine(material={"friction": friction | {"viscous_s_per_m": viscosity}}).run(np.array(hand.poses))
    missing = final - records["contact.tangential_force"]
    assert abs(missing[-1]) < 0.01 * final
    late = missing[-round(1000 * constant) :]  # the last time constant: it slips in every tick
    np.testing.assert_allclose(late[1:] / late[:-1], constant / (constant + 1e-3), rtol=1e-7)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("viscosity", [0.5, 100.0])
@pytest.mark.parametrize("law", list(LAWS))
def test_no_viscosity_makes_the_force_alternate(law: str, viscosity: float) -> None:
    """At 2 cm/s, 0.5 rad/s, 10 N and K = 100 N/m the damper is up to 1000 times slower than a tick."""
    friction = (LAWS[law].get("friction", {}) or {}) | {"viscous_s_per_m": viscosity}
    friction.pop("stribeck_speed_m_per_s", None)  # friction that decreases with the speed sticks and slips
    material = {**LAWS[law], "friction": friction, "stiffness_n_per_m": 1e4}
    coupling = {"stiffness_n_per_m": 100.0, "damping_ns_per_m": 0.0}
    hand = pressed().go(4000, move=[0.08, 0.04, 0], turn=[0, 0, 2.0])
    records = plane_engine(material=material, coupling=coupling, rolling=None).run(np.array(hand.poses))
    assert (records["contact.mode"][-500:] == 2.0).all()
    steps = np.diff(records["force"][-500:, :2], axis=0)
    # Each step is at most the spring times the motion of the tick, and no step turns back.
    assert np.linalg.norm(steps, axis=1).max() < 100.0 * 1e-3 * np.hypot(0.02, 0.01) * (1.0 + EXACT)
    assert (np.sum(steps[1:] * steps[:-1], axis=1) > -EXACT).all()


def test_friction_follows_the_slip_and_not_the_hand() -> None:
    """A finger that rotates without translating slips at r omega, and its friction coefficient follows that speed."""
    trace = on_plane(pressed().go(800, turn=[0.8 * 4.0, 0, 0]), material={"friction": {"viscous_s_per_m": 0.5}})
    assert trace.causes == ["touch", "theta_max"]
    assert trace.tangential[-1] == pytest.approx(0.5 + 0.5 * 4.0 * R, rel=1e-8)


@pytest.mark.parametrize(("back", "cause"), [(0.0, "stop"), (0.0012, "reverse")])
def test_a_fast_slip_sticks_when_the_static_cone_can_hold_it(back: float, cause: str) -> None:
    hand = pressed().go(200, move=[0.2, 0, 0]).go(6, move=[-back, 0, 0]).go(300)
    trace, stop = on_plane(hand, material={"friction": {"viscous_s_per_m": 1.0}}), hand.ends[1]
    assert trace.causes == ["touch", "drag", cause] and trace.tangential[stop] > 1.4
    after = trace.events[2][0]
    assert (trace.tangential[after:] <= 0.6 * (1 + EXACT)).all()
    assert np.ptp(trace.tangential[max(after, stop + 6) :]) < EXACT


@pytest.mark.sampled(3)
@pytest.mark.parametrize("heading", np.linspace(0, 2 * np.pi, 9)[:-1] + 0.1)
def test_anisotropic_slide_dissipates_the_most(heading: float) -> None:
    """The friction force of a steady slip along (x, y) is (a^2 x, b^2 y) / |(a x, b y)|, which dissipates the most."""
    direction = np.array([np.cos(heading), np.sin(heading)])
    trace = on_plane(pressed().go(600, move=[*(0.03 * direction), 0]), material={"friction": ANISOTROPIC})
    a, b = 0.5 * 0.9, 0.5 * 0.4
    expected = -np.array([a**2 * direction[0], b**2 * direction[1]]) / np.hypot(a * direction[0], b * direction[1])
    # The deflection turns to its final direction within a few deflection lengths of slip; the slide is sixty long.
    assert trace.force[-1, :2] == pytest.approx(expected, abs=1e-9) and trace.causes == ["touch", "drag"]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("heading", [0.0, 0.7, np.pi / 2, 4.0])
def test_anisotropic_drag_breaks_loose_on_the_ellipse(heading: float) -> None:
    """The force peaks at mu_s f_N times the scale of its direction, on the first tick on which the drag exceeds it."""
    direction = np.array([np.cos(heading), np.sin(heading)])
    trace = on_plane(pressed().go(300, move=[*(0.0021 * direction), 0]), material={"friction": ANISOTROPIC})
    slide = trace.events[1][0]
    size = np.hypot(trace.force[:, 0] / 1.0, trace.force[:, 1] / 0.5)
    assert size[slide] == pytest.approx(0.6, rel=EXACT) and size.max() == pytest.approx(0.6, rel=EXACT)
    assert slide == 1 + int(np.ceil(0.6e-3 / np.hypot(direction[0], direction[1] / 0.5) / 7e-6))


def test_anisotropy_turns_with_the_object() -> None:
    turn = multiply([0.8, 0.6, 0.0, 0.0], quaternion([0.0, 0.0, 0.7]))
    rotation = matrix(turn)
    straight = pressed().go(300, move=[0.01, 0.006, 0])
    turned = Hand(rotation @ straight.poses[0][:3])
    turned.poses = [np.concatenate([rotation @ pose[:3], [1, 0, 0, 0]]) for pose in straight.poses]
    material = {"friction": ANISOTROPIC}
    first = on_plane(straight, material=material)
    second = on_plane(turned, material=material, table={"orientation_wxyz": list(turn)})
    assert second.force == pytest.approx(first.force @ rotation.T, abs=1e-11) and second.causes == first.causes


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "table",
    [
        {"shape": "box", "size_m": [0.2, 0.2, 0.04], "position_m": [0.0, 0.0, -0.02]},
        {"shape": "cylinder", "radius_m": 0.1, "length_m": 0.04, "position_m": [0.0, 0.0, -0.02]},
        {"shape": "sphere", "radius_m": 1e3, "position_m": [0.0, 0.0, -1e3]},
    ],
    ids=["box", "cylinder", "sphere"],
)
def test_anisotropy_turns_with_every_kind_of_object(table: dict[str, Any]) -> None:
    turn = list(quaternion([0.0, 0.0, 0.7]))
    material, hand = {"friction": ANISOTROPIC}, pressed().go(200, move=[0.004, 0.002, 0])
    plane = on_plane(hand, material=material, table={"orientation_wxyz": turn})
    turned = on_plane(hand, material=material, table={**table, "orientation_wxyz": turn})
    # The sphere of 1 km drops by 1e-8 m at 4 mm, and its normal turns by 4e-6 rad.
    assert turned.force == pytest.approx(plane.force, abs=2e-5)
    straight = on_plane(hand, material=material)
    assert np.abs(plane.force - straight.force).max() > 0.05


def test_anisotropy_turns_with_a_turning_object() -> None:
    disk = {"shape": "cylinder", "radius_m": 0.1, "length_m": 0.04, "position_m": [0.0, 0.0, -0.02]}
    quarter = {"motion": {"kind": "turntable", "axis": [0.0, 0.0, 1.0], "rate_rad_per_s": np.pi / 2}}
    material = {"friction": ANISOTROPIC}
    # The disk turns for one second before the touch; the drag is so short that the disk turns by only 0.03 rad during
    # it.
    above = Hand([0.0, 0.0, R + 0.001]).go(1000).go_to(1, [0.0, 0.0, R - 0.001]).go(20, move=[0.002, 0, 0])
    moving = on_plane(above, material=material, table={**disk, **quarter})
    turned = on_plane(above, material=material, table=disk | {"orientation_wxyz": [*quaternion([0, 0, np.pi / 2])]})
    # The slip is up to 0.03 rad off the short axis; the force turns (a / b)^2 times as much, 0.15 rad of 0.2 N.
    assert moving.force == pytest.approx(turned.force, abs=0.04) and moving.tangential[-1] < 0.25


def test_a_direction_along_the_normal_still_gives_two_axes() -> None:
    material = {"friction": {**ANISOTROPIC, "direction_x": [0.0, 0.0, 1.0]}}
    trace = on_plane(pressed().go(300, move=[0.02, 0, 0]), material=material)
    assert np.isfinite(trace.force).all()
    assert trace.tangential[-1] in (pytest.approx(0.45, rel=1e-9), pytest.approx(0.2, rel=1e-9))


def test_equal_scales_are_no_anisotropy() -> None:
    hand = pressed().go(200, move=[0.004, 0.003, 0]).go(100, turn=[0.2, -0.1, 0]).go(200, move=[-0.004, 0.001, 0.0005])
    plain = on_plane(hand)
    round_ = on_plane(hand, material={"friction": {"direction_x": [0.3, 1.0, 0.0]}})
    assert round_.force == pytest.approx(plain.force, abs=EXACT) and round_.events == plain.events


@pytest.mark.sampled(2)
@pytest.mark.scaled
@pytest.mark.parametrize("law", list(LAWS))
def test_force_stays_in_the_cone_and_creates_no_energy(law: str) -> None:
    engine = plane_engine(material=LAWS[law], rolling=rolling(law))
    scale = np.array([1.0, 0.5]) if "anisotropic" in law else np.ones(2)
    kinetic = np.array([0.9, 0.4]) if "anisotropic" in law else np.ones(2)

    # 90 hands of about 130 ticks are 10^4 cases.
    def check(records: laws.Array) -> None:
        force, normal = records["force"][:, :2], records["contact.normal_force"]
        assert np.isfinite(records).all()
        assert (normal >= 0.0).all()
        size = np.linalg.norm(force / scale, axis=1)
        limit = 0.6 * normal
        if "speed" in law:
            # Bound on the slip per tick: 1.5 mm of hand and 0.3 rad of skin, on both axes.
            fastest = 0.6 + 0.5 * (np.sqrt(2) * 1.5 + 3.0)
            size = np.minimum(size, np.linalg.norm(force / kinetic, axis=1))
            limit = fastest * normal
        assert (size <= limit * (1 + EXACT)).all()
        # The torsional limit scales with the load: 1 N at a depth of 1 mm.
        largest = 0.004 * normal * (normal**0.3 if "power" in law else 1.0)
        assert (np.abs(records["torque"][:, 2]) <= largest * (1 + EXACT)).all()
        # Several hundred terms of up to 1e-2 J each.
        assert (laws.work_of_the_hand(records) - laws.stored_energy(records)).min() > -1e-14

    laws.check_random_handling(engine, 8, 90, check)
