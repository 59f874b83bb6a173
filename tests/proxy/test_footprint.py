"""Contact patch of a soft fingertip: its radius, torsion, rolling resistance and energy. On the plane of
conftest.paper_mapping: r = 10 mm, f_N = 1 N at 1 mm, mu .6 / .5, 1 kHz."""

from math import gamma, pi
from typing import Any

import numpy as np
import pytest
from helpers.examples import Cases
from references.hand import Hand, drive, plane_engine, pressed
from references.laws import Array, axis_angles, check_random_handling, work_of_the_hand
from references.rotation import matrix
from scipy.integrate import quad

from softfinger.proxy.engine import Engine
from softfinger.proxy.laws import compute_lever
from softfinger.proxy.record import AT

pytestmark = pytest.mark.plain

R, K, G, MU = 0.01, 1000.0, 45e3, 0.6
HERTZ: dict[str, Any] = {"shear_modulus_pa": G}
POWER: dict[str, Any] = {"shear_modulus_pa": G, "radius_m": 0.004, "exponent": 0.2, "pressure_exponent": 4.0}
FOLLOWS: dict[str, Any] = {"stiffness_nm_per_rad": None, "friction_length_m": None}
"""Changes that remove the torsion parameters of the paper's material."""
LEVER = {"Hertz": 3.0 * pi / 16.0, "power": gamma(0.75) * gamma(1.75) / gamma(0.5)}
"""Lever over a: 3 pi / 16, and B(3/4, 5/4) / B(1/2, 5/4) for the pressure (1 - x^4)^(1/4)."""
PATCHES = {"Hertz": HERTZ, "power": POWER}


def radius(name: str, load: Any) -> Any:
    """Radius a, m: Hertz's for a sphere on a rigid flat, with a Poisson ratio of 1/2, or c f^gamma."""
    if name == "power":
        return 0.004 * np.asarray(load) ** 0.2
    young, poisson = 2.0 * G * 1.5, 0.5
    return (3.0 * np.asarray(load) * R * (1.0 - poisson**2) / (4.0 * young)) ** (1.0 / 3.0)


def soft(patch: dict[str, Any], **changes: Any) -> Engine:
    return plane_engine(fingertip={"patch": patch}, **{"material": {"torsion": FOLLOWS}} | changes)


def run(engine: Engine, hand: Hand) -> Array:
    engine.reset()
    return engine.run(np.array(hand.poses))


@pytest.mark.parametrize("name", list(PATCHES))
def test_radius_is_the_closed_form(name: str) -> None:
    records = run(soft(PATCHES[name]), Hand([0, 0, R + 0.001]).go(90, [0, 0, -0.009]))
    load, radii = records["contact.normal_force"], records["contact.patch_radius"]
    touching = load > 0.0
    assert touching.sum() == 80 and (radii[~touching] == 0.0).all()
    # Rounding of r - z limits the depth to five digits less than float64.
    assert radii[touching] == pytest.approx(radius(name, load[touching]), rel=1e-12)
    assert (np.diff(radii[touching]) > 0.0).all()


def test_an_elastic_object_adds_its_compliance() -> None:
    """The contact modulus is 1/E* = (1 - nu^2) (1/E_1 + 1/E_2); the torsional stiffness uses 1/G = 1/G_1 + 1/G_2."""
    modulus = 200e3
    engine = soft(HERTZ, material={"torsion": FOLLOWS, "shear_modulus_pa": modulus})
    records = run(engine, pressed(0.002).go(10, turn=[0, 0, 1e-3]))
    effective = 1.0 / (0.75 * (1.0 / (3.0 * G) + 1.0 / (3.0 * modulus)))
    a = (3.0 * 2.0 * R / (4.0 * effective)) ** (1.0 / 3.0)
    assert records["contact.patch_radius"][-1] == pytest.approx(a, rel=1e-12)
    stiffness = 16.0 / 3.0 * a**3 / (1.0 / G + 1.0 / modulus)
    assert records["contact.torsion"][-1] == pytest.approx(-stiffness * 1e-3, rel=1e-9)


def test_it_is_no_larger_than_the_fingertip() -> None:
    assert run(soft({"shear_modulus_pa": 1e3}), pressed(0.005))["contact.patch_radius"][-1] == R


@pytest.mark.parametrize(("k", "published"), [(2.0, 1.5), (3.0, 1.24), (4.0, 1.1441), (100.0, 1.0)])
def test_the_pressures_lever_is_its_integral(k: float, published: float) -> None:
    """The lever is the mean distance from the centre, by quadrature; the scale is that of Xydas and Kao's table."""
    area, _ = quad(lambda x: 2.0 * x * (1.0 - x**k) ** (1.0 / k), 0.0, 1.0, epsabs=1e-13)
    moment, _ = quad(lambda x: 2.0 * x * x * (1.0 - x**k) ** (1.0 / k), 0.0, 1.0, epsabs=1e-13)
    # The table has three digits at k = 3; k = 100 is nearly a uniform pressure.
    assert 1.0 / area == pytest.approx(published, abs=1e-3)
    assert compute_lever(k) == pytest.approx(moment / area, rel=1e-10)
    assert compute_lever(2.0) == pytest.approx(3.0 * pi / 16.0, rel=1e-14)
    assert compute_lever(k) < 2.0 / 3.0  # the lever of a uniform pressure


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", list(PATCHES))
@pytest.mark.parametrize("depth", [1e-4, 1e-3, 6e-3])
def test_torsion_is_elastic_up_to_the_friction_of_the_patch(name: str, depth: float) -> None:
    """The moment is -16/3 G a^3 phi, limited to mu times the lever times a f_N."""
    records = run(soft(PATCHES[name]), pressed(depth).go(400, turn=[0, 0, 2.0]))
    load = K * depth
    a = radius(name, load)
    expected = np.minimum(16.0 / 3.0 * G * a**3 * np.linspace(0.0, 2.0, 401), MU * LEVER[name] * a * load)
    assert records["contact.torsion"][1:] == pytest.approx(-expected, rel=1e-9, abs=1e-15)
    assert records["torque"][:, 2] == pytest.approx(records["contact.torsion"], abs=1e-18)


def test_torsional_stiffness_of_a_hertzian_patch_is_load_times_radius() -> None:
    """On a rigid flat 16/3 G a^3 = f_N r, independent of the pad's modulus."""
    for modulus in (1e4, 1e5, 1e7):
        records = run(soft({"shear_modulus_pa": modulus}), pressed(0.002).go(1, turn=[0, 0, 1e-6]))
        assert records["contact.torsion"][-1] == pytest.approx(-2.0 * R * 1e-6, rel=1e-9)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", list(PATCHES))
def test_steady_slip_and_spin_are_on_the_limit_surface_of_the_patch(name: str) -> None:
    """f_T = F^2 v / N, tau = M^2 omega / N, N = sqrt((F v)^2 + (M omega)^2), with F = mu_d f_N and M of the patch."""
    engine = soft(PATCHES[name], material={"torsion": {**FOLLOWS, "model": "limit_surface"}})
    v, omega = 0.02, 5.0
    records = run(engine, pressed().go(2000, move=[2 * v, 0, 0], turn=[0, 0, 2 * omega]))
    force, moment = 0.5, MU * LEVER[name] * float(radius(name, 1.0))
    size = np.hypot(force * v, moment * omega)
    # The steady state is approached over deflections of 0.5 mm; the slide is twenty times as long.
    assert records["contact.tangential_force"][-1] == pytest.approx(force**2 * v / size, rel=1e-6)
    assert records["contact.torsion"][-1] == pytest.approx(-(moment**2) * omega / size, rel=1e-6)


@pytest.mark.scaled
def test_pressing_on_a_wound_finger_keeps_its_energy(cases: Cases) -> None:
    """Load changes preserve phi^2 k_z, so the moment scales with sqrt(k_z) and load cycles lose nothing."""
    hand = pressed(0.002).go(50, turn=[0, 0, 0.02]).go(50, move=[0, 0, -0.004]).go(50, move=[0, 0, 0.004])
    _, wound, hard, _ = hand.ends
    for _ in range(cases(300, 1000)):
        hand.go(3, move=[0, 0, -4e-4]).go(3, move=[0, 0, 4e-4])
    moment = run(soft(HERTZ), hand)["contact.torsion"]
    assert moment[wound] == pytest.approx(-2.0 * R * 0.02, rel=1e-9)
    assert moment[hard] == pytest.approx(moment[wound] * 3.0**0.5, rel=1e-9)
    # At most six thousand roots and products, each rounded.
    assert moment[-1] == pytest.approx(moment[wound], rel=1e-11)


def test_rolling_resistance_is_elastic_up_to_its_limit() -> None:
    """The moment against a roll is 3/16 alpha r f_N theta up to 3/16 alpha a f_N, both ways, and constant at rest."""
    alpha, load = 0.3, 2.0
    engine = soft(HERTZ | {"rolling_loss": alpha}, rolling=None, material={"friction": None, "torsion": None})
    hand = pressed(0.002).go(500, turn=[1.0, 0, 0]).go(100).go(500, turn=[-1.0, 0, 0])
    (_, limit_tick, rest, _), records = hand.ends, run(engine, hand)
    limit = 3.0 / 16.0 * alpha * float(radius("Hertz", load)) * load
    rolled = np.linspace(0.0, 1.0, 501)
    torque = records["torque"]
    expected = np.minimum(3.0 / 16.0 * alpha * R * load * rolled, limit)
    assert torque[1 : limit_tick + 1, 0] == pytest.approx(-expected, rel=1e-9, abs=1e-15)
    assert np.ptp(torque[limit_tick : rest + 1, 0]) == 0.0 and torque[-1, 0] == pytest.approx(limit, rel=1e-9)
    assert np.abs(torque[:, 1:]).max() < 1e-15


def test_work_of_a_long_roll_is_the_loss_factor_times_the_angle() -> None:
    """The work of a long roll is 3/16 alpha a f_N theta, less the energy stored in the wound spring."""
    alpha, load, turn = 0.5, 1.0, 3.0
    engine = soft(HERTZ | {"rolling_loss": alpha}, rolling=None, material={"friction": None, "torsion": None})
    records = run(engine, pressed().go(1, [0, 0, 0]).go(1000, turn=[0, turn, 0]))
    a = float(radius("Hertz", load))
    limit = 3.0 / 16.0 * alpha * a * load
    work = work_of_the_hand(records)
    # The spring winds up over a / r, for half of the work; the tolerance is one step of 3 mrad.
    assert work[-1] - work[2] == pytest.approx(limit * (turn - 0.5 * a / R), abs=limit * 6e-3)


@pytest.mark.scaled
def test_patch_in_the_fingertips_frame_is_the_rotated_world_frame() -> None:
    """Normal and stretch equal the world's, rotated by the measured orientation; the patch centre is -r normal."""
    engine = soft(HERTZ, table={"shape": "sphere", "radius_m": 0.05, "position_m": [0.0, 0.0, -0.05]})

    def check(records: Array) -> None:
        records = records[records["contact.mode"] != 0]
        to_world = np.array([matrix(q) for q in records["probe.orientation"]]).reshape(-1, 3, 3)
        normal, inside = records["contact.normal"], records["contact.patch_normal"]
        behind = records["proxy.position"] - records["probe.position"]
        tangent = behind - np.sum(behind * normal, axis=1)[:, None] * normal
        stretch = records["contact.patch_stretch"]
        # Rounding of a dozen products of numbers of order 1, and of lengths of 10 mm.
        assert np.allclose(np.einsum("nij,nj->ni", to_world, inside), normal, rtol=0.0, atol=1e-14)
        assert np.allclose(np.einsum("nij,nj->ni", to_world, stretch), tangent, rtol=0.0, atol=1e-15)
        assert np.allclose(records["contact.finger_point"], -R * inside, rtol=0.0, atol=1e-16)

    check_random_handling(engine, 8, 300, check)


MODELS: dict[str, dict[str, Any]] = {
    "independent": {},
    "limit_surface": {"model": "limit_surface"},
    "soft_finger_proxy": {"model": "soft_finger_proxy"},
}


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("name", list(PATCHES))
@pytest.mark.parametrize("kind", list(MODELS))
def test_contact_creates_no_energy_under_changing_loads(name: str, kind: str) -> None:
    """The work of spin is tested separately: the rounding of the press would hide an error in it."""
    patch = PATCHES[name] | {"rolling_loss": 0.4}
    engine = soft(patch, material={"torsion": FOLLOWS | MODELS[kind]})

    def check(records: Array) -> None:
        stretch = records["proxy.position"] - records["probe.position"]
        a = records["contact.patch_radius"]
        k_z = 16.0 / 3.0 * G * a**3
        touching = records["contact.mode"] != 0
        stored = K * np.sum(stretch**2, axis=1) + k_z * records["contact.spin"] ** 2
        # Rounding of several hundred terms of up to 1e-2 J.
        assert (work_of_the_hand(records) - 0.5 * touching * stored).min() >= -1e-15 * len(records)
        turned = axis_angles(records["probe.orientation"])[:, 2]
        spun = np.concatenate([[0.0], -np.cumsum(records["contact.torsion"][1:] * turned)])
        # The same for terms of up to 1e-4 J.
        assert (spun - 0.5 * k_z * records["contact.spin"] ** 2).min() >= -1e-17 * len(records)

    check_random_handling(engine, 8, 300, check)


@pytest.mark.scaled
def test_rolling_resistance_creates_no_energy_under_changing_loads() -> None:
    """The work against rolling is never less than the energy M^2 / 2 k of its spring, with k = 3/16 alpha r f_N."""
    alpha = 0.4
    engine = soft(HERTZ | {"rolling_loss": alpha}, rolling=None, material={"friction": None, "torsion": None})

    def check(records: Array) -> None:
        torque = records["torque"]
        turned = axis_angles(records["probe.orientation"])
        work = np.concatenate([[0.0], -np.cumsum(np.sum(torque[1:] * turned, axis=1))])
        stiffness = 3.0 / 16.0 * alpha * R * records["contact.normal_force"]
        stored = 0.5 * np.sum(torque**2, axis=1) / np.where(stiffness > 0.0, stiffness, 1.0)
        # Rounding of several hundred terms of up to 1e-4 J.
        assert (work - stored).min() >= -1e-17 * len(records)

    check_random_handling(engine, 8, 300, check)


def test_a_patch_without_torsion_changes_no_force() -> None:
    hand = pressed().go(200, move=[0.004, 0, -0.001], turn=[0.1, 0, 0]).go(100, turn=[0, 0, 0.3])
    plain = drive(plane_engine(material={"torsion": None}), hand)
    soft_one = drive(soft(HERTZ, material={"torsion": None}), hand)
    assert (plain.force == soft_one.force).all() and (plain.torque == soft_one.torque).all()


def test_each_finger_has_the_patch_of_a_single_finger() -> None:
    tips = {name: {"radius_m": R, "patch": patch | {"rolling_loss": 0.4}} for name, patch in PATCHES.items()}
    material = {"torsion": FOLLOWS}
    fingers = [{"name": name, **tip} for name, tip in tips.items()]
    both = plane_engine(fingertip=None, finger=fingers, material=material)
    poses = np.array(pressed().go(100, move=[0.004, 0, -0.001], turn=[0.1, 0, 0.3]).poses)
    records = both.run(dict.fromkeys(tips, poses))
    for name, tip in tips.items():
        alone = plane_engine(fingertip=tip, material=material).run(poses)
        assert np.array_equal(records[name], alone) and alone[-1, AT.contact_patch_radius] > 0.0
