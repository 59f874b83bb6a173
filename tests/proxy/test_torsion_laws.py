"""Moment about the normal: its limits, and the proxy with a rotational degree of freedom. One type of law per scene. On
the plane of test_contact_acceptance.py: f_N = 1 N at 1 mm, k_z = 0.05 N m/rad, mu_t = 4 mm, 1 kHz."""

from typing import Any

import numpy as np
import pytest
from conftest import merged, paper_mapping
from helpers.examples import Cases, examples
from hypothesis import given
from references.hand import on_plane, plane_engine, pressed
from references.laws import SPEED, Array, handling

from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.kernels import model
from softfinger.proxy.laws import compile_friction_laws, compile_normal_laws, compile_torsion_laws

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
