"""Friction scaled by a texture: compared with closed forms of sampled and filtered waves."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.touching import posed
from test_textures import CUTOFF, DEPTH, HEIGHT, OBLIQUE, ROUNDING, K, Make, R, textured_scene

from softfinger.config import schema
from softfinger.config.load import build, describe
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import AT, SLIDING

pytestmark = pytest.mark.plain


@pytest.fixture
def scene(tmp_path: Path) -> Make:
    return partial(textured_scene, tmp_path)


FRICTION = {"static": 0.6, "kinetic": 0.5}

LAWS: dict[str, dict[str, Any]] = {
    "coulomb": {},
    "viscous": {"viscous_s_per_m": 2.0},
    "alike in all directions": {"direction_x": [1.0, 0.0, 0.0]},
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("law", list(LAWS))
def test_sliding_friction_depends_on_the_sliding_point(scene: Make, law: str) -> None:
    """Friction is mu(u, v) f_N at the contact point at the start of the tick, mu = mu_d times low + (high - low) z."""
    low, high = 0.4, 1.6
    texture = {"height_m": None, "friction_scale": [low, high], "size_m": [OBLIQUE.width, OBLIQUE.depth]}
    friction = {"stiffness_n_per_m": K, "friction": FRICTION | LAWS[law]}
    engine = Engine(scene(OBLIQUE.samples(), texture=texture, material=friction))
    x = np.linspace(0.0, 0.03, 400)
    rows = engine.run(posed(np.stack([x, 0.4 * x, R - DEPTH + 0.0 * x], axis=1)))
    slides = np.flatnonzero(rows["contact.mode"] == SLIDING)[20:]  # the first 20 decay from static friction
    before = rows[slides - 1, AT.proxy_position : AT.proxy_position + 3]
    z, _, _ = OBLIQUE.texture(CUTOFF, before[:, 0], before[:, 1])
    got = rows[slides, AT.contact_tangential_force]
    if law == "viscous":  # the slip speed is low-passed: its ripple is 3 % of the speed of the stroke
        speed = np.hypot(1.0, 0.4) * 0.03 / 399 * 1e3
        coefficient, rtol = FRICTION["kinetic"] + 2.0 * speed, 0.1
        assert coefficient > 1.3 * FRICTION["kinetic"]
    else:
        coefficient, rtol = FRICTION["kinetic"], 1e-9  # tail of the closed form's series
    np.testing.assert_allclose(got, coefficient * (low + (high - low) * z) * K * DEPTH, rtol=rtol)
    assert len(slides) > 200 and np.ptp(got) > 0.3
    np.testing.assert_allclose(rows[:, AT.force + 2], K * DEPTH, atol=ROUNDING)  # no heights


@pytest.mark.parametrize(("x0", "value"), [(-0.25, 1.0 / 3.0), (0.25, 2.0 / 3.0)])
def test_static_friction_is_scaled_too(scene: Make, x0: float, value: float) -> None:
    """The drag reaches mu_s times the factor of the sticking point, from a spline of 0, 1, 0, 1."""
    texture = {"height_m": None, "friction_scale": [0.5, 2.0], "size_m": [1.0, 1.0]}
    engine = Engine(scene(np.array([[0.0, 1.0]]), texture=texture, material={"friction": FRICTION}))
    x = x0 + np.linspace(0.0, 3e-3, 600)
    rows = engine.run(posed(np.stack([x, 0.0 * x, R - DEPTH + 0.0 * x], axis=1)))
    breaks = int(np.argmax(rows["contact.mode"] == SLIDING))
    # On the level crest and floor of a wave of 1 m, a filter of 1 mm removes 5e-6.
    limit = FRICTION["static"] * (0.5 + 1.5 * value) * K * DEPTH
    assert rows[breaks, AT.contact_tangential_force] == pytest.approx(limit, rel=1e-5)


@pytest.mark.parametrize("patch", [None, {"shear_modulus_pa": 45e3, "radius_m": 0.004, "exponent": 0.0}])
def test_the_torsional_limit_is_scaled_as_friction_is(scene: Make, patch: dict[str, float] | None) -> None:
    """With the factor 0.5 + 1.5 2/3 a spin slips at 1.5 times mu_t f_N, or mu_s 3 pi / 16 a f_N of a patch."""
    texture = {"height_m": None, "friction_scale": [0.5, 2.0], "size_m": [1.0, 1.0]}
    material = {"friction": FRICTION, "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004}}
    made = scene(np.array([[0.0, 1.0]]), texture=texture, material=material)
    made = build(schema.Scene, describe(made) | {"fingertip": {"radius_m": R, "patch": patch}}, "scaled")
    x = np.full(100, 0.25)
    poses = posed(np.stack([x, 0.0 * x, R - DEPTH + 0.0 * x], axis=1))
    half = np.linspace(0.0, 1.0, 100)  # 2 rad: both springs have slipped by then
    poses[:, 3], poses[:, 6] = np.cos(half), np.sin(half)
    rows = Engine(made).run(poses)
    length = 0.004 if patch is None else FRICTION["static"] * 3.0 * np.pi / 16.0 * 0.004
    # As above, the filter removes 5e-6 of the wave.
    assert rows[-1, AT.contact_torsion] == pytest.approx(-1.5 * length * K * DEPTH, rel=1e-5)


def test_friction_and_heights_from_one_texture(scene: Make) -> None:
    """Sliding over a texture with heights, friction is mu_d times the factor times the resulting normal force."""
    texture = {"friction_scale": [0.5, 1.5], "size_m": [OBLIQUE.width, OBLIQUE.depth]}
    engine = Engine(scene(OBLIQUE.samples(), texture=texture, material={"friction": FRICTION}))
    x = np.linspace(0.0, 0.03, 400)
    points = np.stack([x, 0.4 * x, R - DEPTH + 0.0 * x], axis=1)
    rows = engine.run(posed(points))
    slides = np.flatnonzero(rows["contact.mode"] == SLIDING)[20:]
    z, by_u, by_v = OBLIQUE.texture(CUTOFF, points[slides, 0], points[slides, 1])
    load = K * (DEPTH - HEIGHT * (1.0 - z))
    np.testing.assert_allclose(rows[slides, AT.contact_normal_force], load, rtol=1e-9)
    before = rows[slides - 1, AT.proxy_position : AT.proxy_position + 3]
    factor = 0.5 + OBLIQUE.texture(CUTOFF, before[:, 0], before[:, 1])[0]
    drag = 0.5 * factor * load
    np.testing.assert_allclose(rows[slides, AT.contact_tangential_force], drag, rtol=1e-9)
    # The remaining tangential force is due to the slope.
    rest = rows[slides, AT.force : AT.force + 2] + (load * HEIGHT)[:, None] * np.stack([by_u, by_v], axis=1)
    np.testing.assert_allclose(np.linalg.norm(rest, axis=1), drag, rtol=1e-8)
