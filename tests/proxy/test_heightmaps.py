"""Height maps: spline compared with closed forms, closest point with brute force, scenes with other shapes."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hostile_maps import grid_of, part
from helpers.touching import SMOOTH, Array, R, engine, make_object, posed, visit
from hypothesis import given, settings
from hypothesis import strategies as st
from references.rotation import quaternion

from softfinger.proxy.heightmaps import bound_curvature, compile_heightmap, thin_map
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact.rolling import roll
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics import rotations
from softfinger.proxy.kernels.shapes import curvature
from softfinger.proxy.kernels.shapes.heightmap.nearest import QUERY_BUDGET, find_nearest_from
from softfinger.proxy.kernels.shapes.heightmap.surface import compute_height, find_foot
from softfinger.proxy.kernels.shapes.heightmap.tiles import count_tiles, find_tile, is_farther
from softfinger.proxy.record import AT

pytestmark = pytest.mark.plain


@entry
def compiled_heights(shape, places, results):
    for k in range(len(places)):
        h = compute_height(shape, places[k, 0], places[k, 1])
        results[k, 0], results[k, 1], results[k, 2] = h.z, h.s, h.t
        results[k, 3], results[k, 4], results[k, 5] = h.ss, h.st, h.tt


@entry
def compiled_nearest(shape, points, budget, results):
    for k in range(len(points)):
        x = (points[k, 0], points[k, 1], points[k, 2])
        near = find_nearest_from(shape, x, x, budget)
        results[k, 0] = near.gap
        results[k, 1], results[k, 2], results[k, 3] = near.point
        results[k, 4], results[k, 5], results[k, 6] = near.normal


@entry
def compiled_curvature(shape, radius, point, normal):
    return curvature(shape, radius, point, normal)


@entry
def compiled_roll(method, shape, radius, center, normal, turn):
    return roll(method, shape, radius, center, normal, turn)


def sampled(rows: int, columns: int, pitch: float, f: Callable[[Array, Array], Array]) -> Array:
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * pitch for n in (columns, rows))
    return f(*np.meshgrid(x, y))


def heights_of(shape: model.Heightmap, x: Array, y: Array) -> Array:
    """Return h, h_x, h_y, h_xx, h_xy, h_yy (n, 6) in m at positions in m."""
    places = np.column_stack([x / shape.pitch + 0.5 * shape.columns, y / shape.pitch + 0.5 * shape.rows])
    results = np.empty((len(places), 6))
    compiled_heights(shape, places, results)
    return results * [shape.pitch, 1.0, 1.0, *[1.0 / shape.pitch] * 3]


def nearest(shape: model.Heightmap, points: Array, budget: int = 10**7) -> Array:
    """Return gap, point and normal (n, 7), by default with a budget that is never exhausted."""
    results = np.empty((len(points), 7))
    compiled_nearest(shape, np.ascontiguousarray(points, dtype=float), budget, results)
    return results


def everywhere(shape: model.Heightmap, fine: int) -> Array:
    return grid_of(
        shape,
        *(
            (np.arange(0.0, count * fine + 1.0) / fine - 0.5 * count) * shape.pitch
            for count in (shape.columns, shape.rows)
        ),
    )


def cap_of(radius: float, x: Array, y: Array) -> Array:
    """Return the top of a ball with its highest point at the origin; level where it would be steep."""
    return np.sqrt(np.maximum(radius**2 - x * x - y * y, 0.25 * radius**2)) - radius


def waves(x: Array, y: Array) -> Array:
    return 0.002 * np.sin(x / 0.008) * np.cos(y / 0.006)


NOISE = np.random.default_rng(1)
MAPS: dict[str, tuple[float, Array]] = {
    "hills": (1e-3, sampled(70, 90, 1e-3, lambda x, y: 2.0 * waves(x, y))),
    "ripple": (1e-4, sampled(150, 200, 1e-4, lambda x, y: 0.1 * waves(4.0 * x, 4.0 * y))),
    "noise": (4e-4, 1e-4 * NOISE.normal(size=(80, 64))),
    "rubble": (2e-3, 1e-3 * NOISE.normal(size=(40, 50))),
}
"""Smooth on the scale of a fingertip; finer than it; random pixels, finer and coarser than it."""

SHAPES = {name: compile_heightmap(heights, pitch) for name, (pitch, heights) in MAPS.items()}


@pytest.mark.parametrize("name", MAPS)
def test_the_surface_is_a_sum_of_b_splines(name: str) -> None:
    """Everywhere, also beyond the rim, heights equal NumPy's evaluation of the coefficients by truncated powers."""
    shape = SHAPES[name]
    half = 0.6 * np.array([shape.columns, shape.rows]) * shape.pitch
    x, y = (np.random.default_rng(9).uniform(-extent, extent, 20) for extent in half)
    expected = grid_of(shape, x, y)
    # Sums of 16 terms of about the map's height, in two orders.
    np.testing.assert_allclose(heights_of(shape, *expected[:, :2].T)[:, 0], expected[:, 2], rtol=0, atol=1e-17)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", MAPS)
def test_the_surface_interpolates_every_pixel(name: str) -> None:
    pitch, heights = MAPS[name]
    x, y, z = thin_map(heights, pitch, 10**6)
    at_x, at_y = np.meshgrid(x, y)
    results = heights_of(compile_heightmap(heights, pitch), at_x.ravel(), at_y.ravel())[:, 0]
    # Rounding of the coefficients' recursion, which does not grow.
    np.testing.assert_allclose(results, z.ravel(), rtol=0, atol=1e-14 * np.abs(z).max() + 1e-17)


def test_the_spline_converges_as_a_cubic_does() -> None:
    """Halving the pitch divides errors by 16, of slopes by 8, of second derivatives by 4: away from the rim, where the
    natural spline is of second order and its influence decreases by 3.7 per pixel."""
    x, y = NOISE.uniform(-0.01, 0.01, (2, 2000))
    a, b = x / 0.008, y / 0.006
    exact = 0.002 * np.column_stack([
        np.sin(a) * np.cos(b), np.cos(a) * np.cos(b) / 0.008, -np.sin(a) * np.sin(b) / 0.006,
        -np.sin(a) * np.cos(b) / 0.008**2, -np.cos(a) * np.sin(b) / 0.008 / 0.006, -np.sin(a) * np.cos(b) / 0.006**2,
    ])  # fmt: skip
    errors = []
    for pitch in (1e-3, 5e-4, 2.5e-4):
        count = round(0.06 / pitch)
        results = heights_of(compile_heightmap(sampled(count, count, pitch, waves), pitch), x, y)
        errors.append(np.sqrt(np.square(results - exact).mean(axis=0)))
    orders = 0.5 * np.log2(errors[0] / errors[-1])
    # The orders hold in the limit; for these pitches to 0.1.
    assert orders[0] > 3.9 and (orders[1:3] > 2.9).all() and (orders[3:] > 1.9).all(), orders


def test_planes_are_exact_and_paraboloids_away_from_the_rim() -> None:
    """The zero curvature at the rim is exact for a plane; its influence vanishes within 30 pixels."""
    x, y = NOISE.uniform(-0.02, 0.02, (2, 200))
    plane = heights_of(compile_heightmap(sampled(41, 41, 1e-3, lambda x, y: 0.3 * x - 0.2 * y + 1e-3), 1e-3), x, y)
    np.testing.assert_allclose(plane[:, 0], 0.3 * x - 0.2 * y + 1e-3, atol=1e-16)
    np.testing.assert_allclose(plane[:, 1:3] - [0.3, -0.2], 0.0, atol=1e-14)
    bowl = heights_of(compile_heightmap(sampled(101, 101, 1e-3, lambda x, y: 10.0 * x * x - 5.0 * x * y), 1e-3), x, y)
    np.testing.assert_allclose(bowl[:, 0], 10.0 * x * x - 5.0 * x * y, atol=1e-15)
    np.testing.assert_allclose(bowl[:, 3:] - [20.0, -5.0, 0.0], 0.0, atol=1e-9)


def test_map_is_level_beyond_the_rim_with_continuous_curvature() -> None:
    pitch, heights = MAPS["hills"]
    shape = compile_heightmap(heights, pitch)
    x = np.linspace(0.04, 0.06, 20001)
    results = heights_of(shape, x, np.full_like(x, 0.0123))
    outside = x > 0.5 * shape.columns * pitch - pitch
    # Rounding of h'', divided by the square of the pitch.
    np.testing.assert_allclose(np.ptp(results[outside], axis=0), 0.0, atol=1e-10)
    np.testing.assert_allclose(results[outside][:, [1, 3, 4]], 0.0, atol=1e-10)
    # One step is 1 um: a continuous value changes by its derivative times that; h'' by h''' < 2e5 / m^2 at the rim.
    assert np.abs(np.diff(results[:, 3])).max() < 0.2 + 1e-9 and np.abs(np.diff(results[:, 1])).max() < 1e-3


@pytest.mark.parametrize("radius", [0.02, -0.03])
def test_curvature_of_a_ball_and_of_a_bowl(radius: float) -> None:
    """1 / (R + r) in all directions, on a cap and in a bowl, to second order in the pitch."""

    def cap(x: Array, y: Array) -> Array:
        return math.copysign(1.0, radius) * (np.sqrt(radius**2 - x * x - y * y) - abs(radius))

    errors = []
    for pitch in (4e-4, 2e-4):
        shape = compile_heightmap(sampled(round(0.02 / pitch), round(0.02 / pitch), pitch, cap), pitch)
        point = (0.004, -0.003, float(cap(np.array(0.004), np.array(-0.003))))
        up = np.add(point, [0.0, 0.0, radius])
        normal = tuple(float(c) for c in math.copysign(1.0, radius) * up / np.linalg.norm(up))
        k1, k2, d1 = compiled_curvature(shape, R, point, normal)
        assert math.hypot(*d1) == pytest.approx(1.0) and np.dot(d1, normal) == pytest.approx(0.0, abs=1e-4)
        errors.append(max(abs(k1 - 1.0 / (radius + R)), abs(k2 - 1.0 / (radius + R))))
    assert errors[1] < 0.3 * errors[0] and errors[1] < 1e-2 / abs(radius)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", MAPS)
def test_the_nearest_point_is_the_closest_of_all(name: str) -> None:
    """No point of a grid of 3 x 3 per pixel is closer; the gap has the sign of the height."""
    pitch, heights = MAPS[name]
    shape, rng = compile_heightmap(heights, pitch), np.random.default_rng(3)
    surface = everywhere(shape, 3)
    half = 0.5 * pitch * np.array(heights.shape[::-1])
    over = np.ptp(heights)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (60, 2)) * half, rng.uniform(-over, 0.012 + over, 60)])
    results = nearest(shape, points)
    level = heights_of(shape, points[:, 0], points[:, 1])[:, 0]
    np.testing.assert_array_equal(np.sign(results[:, 0]), np.sign(points[:, 2] - level))
    for x, (gap, *rest) in zip(points, results, strict=True):
        least = float(np.linalg.norm(surface - x, axis=1).min())
        assert abs(gap) <= least * (1.0 + 1e-12)  # rounding of the search
        # The brute-force search is as coarse as its grid: a sixth of a pitch along, and the rise of the map over that.
        assert abs(abs(gap) - least) <= pitch
        point, normal = np.array(rest[:3]), np.array(rest[3:])
        np.testing.assert_allclose(point + gap * normal, x, rtol=0, atol=1e-14)
        z, slope_x, slope_y = heights_of(shape, point[:1], point[1:2])[0, :3]
        upward = np.array([-slope_x, -slope_y, 1.0]) / math.sqrt(1.0 + slope_x**2 + slope_y**2)
        assert z == pytest.approx(point[2], abs=1e-15)
        # The foot is accurate to at worst 1e-7 of the pitch, and the direction of its normal accordingly.
        np.testing.assert_allclose(normal, upward, rtol=0, atol=1e-6)


def test_a_tile_ruled_out_by_its_tangent_plane_is_farther() -> None:
    shape, rng = SHAPES["hills"], np.random.default_rng(8)
    ruled_out = convex = 0
    for _ in range(1000):
        level = int(rng.integers(0, 3))
        half = 0.5 * (1 << level)
        i, j = (int(rng.integers(0, count_tiles(count, level))) for count in (shape.columns, shape.rows))
        middle = (2.0 * i + 1.0) * half, (2.0 * j + 1.0) * half
        p = (middle[0] + rng.normal(0.0, 4.0), middle[1] + rng.normal(0.0, 4.0), rng.uniform(0.0, 8.0))
        tile = find_tile(shape, p, level, i, j)
        if not tile.convex:
            continue
        convex += 1
        foot = find_foot(shape, p, *(at + rng.uniform(-half, half) for at in middle))
        square = foot.squared_distance * rng.uniform(0.3, 1.0)
        if is_farther(p, tile, foot, square):
            ruled_out += 1
            along = np.linspace(-half, half, 7)
            least = min(
                find_foot(shape, p, middle[0] + a, middle[1] + b).squared_distance for a in along for b in along
            )
            assert least >= square * (1.0 - 1e-9)  # rounding
    assert 50 < ruled_out < convex - 50


def test_gap_to_a_tilted_plane_is_its_closed_form() -> None:
    shape = compile_heightmap(sampled(80, 60, 1e-3, lambda x, y: 0.3 * x + 0.1 * y), 1e-3)
    points = np.random.default_rng(5).uniform([-0.015, -0.02, -0.01], [0.015, 0.02, 0.015], (500, 3))
    normal = np.array([-0.3, -0.1, 1.0]) / math.sqrt(1.1)
    np.testing.assert_allclose(nearest(shape, points)[:, 0], points @ normal, rtol=0, atol=1e-16)


def test_gap_to_a_cap_converges_with_fourth_order() -> None:
    directions = np.random.default_rng(6).uniform([-0.1, -0.1, 1.0], [0.1, 0.1, 1.0], (200, 3))
    out = np.random.default_rng(7).uniform(0.058, 0.072, (200, 1))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * out - [0.0, 0.0, 0.06]
    errors = []
    for pitch in (2e-3, 1e-3):
        heights = sampled(round(0.06 / pitch), round(0.06 / pitch), pitch, lambda x, y: cap_of(0.06, x, y))
        errors.append(np.abs(nearest(compile_heightmap(heights, pitch), points)[:, 0] - out[:, 0] + 0.06).max())
    assert errors[1] < errors[0] / 14.0 and errors[0] < 2e-9


def test_the_gap_is_never_too_large_if_all_points_are_equally_near() -> None:
    """At the centre of a bowl no tile can be ruled out, and tiles beyond the budget count with their bound."""

    def bowl(x: Array, y: Array) -> Array:
        return 0.02 - np.sqrt(np.maximum(0.02**2 - x * x - y * y, 1e-6))

    shape = compile_heightmap(sampled(300, 300, 1e-4, bowl) + 1e-9 * NOISE.normal(size=(300, 300)), 1e-4)
    points = np.array([0.0, 0.0, 0.02]) + 1e-5 * NOISE.normal(size=(20, 3))
    surface = everywhere(shape, 1)
    for x, gap in zip(points, nearest(shape, points, QUERY_BUDGET)[:, 0], strict=True):
        assert 0.0 < gap <= np.linalg.norm(surface - x, axis=1).min()


@settings(derandomize=True, max_examples=1000 if settings.get_current_profile_name() == "full" else 150, deadline=None)
@given(name=st.sampled_from(list(MAPS)), x=st.tuples(*[st.floats(-1e100, 1e100)] * 3))
def test_any_place_gives_finite_numbers(name: str, x: tuple[float, float, float]) -> None:
    shape = SHAPES[name]
    results = nearest(shape, np.array([x]))[0]
    assert np.isfinite(results).all() and np.linalg.norm(results[4:]) == pytest.approx(1.0, abs=1e-15)
    k1, k2, d1 = compiled_curvature(shape, R, tuple(results[1:4]), tuple(results[4:]))
    assert math.isfinite(k1) and math.isfinite(k2) and math.hypot(*d1) == pytest.approx(1.0, abs=1e-14)
    with np.errstate(invalid="ignore"):  # NumPy warns, compiled code does not
        nearest(shape, np.array([[math.nan, x[1], x[2]], [x[0], math.inf, math.nan]]))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("size", [(1, 2), (2, 1), (2, 2), (1, 40), (3, 5)])
def test_small_maps_and_profiles_are_maps(size: tuple[int, int]) -> None:
    heights = 1e-3 * NOISE.normal(size=size)
    shape = compile_heightmap(heights, 1e-3)
    x, y, z = thin_map(heights, 1e-3, 100)
    at_x, at_y = np.meshgrid(x, y)
    np.testing.assert_allclose(heights_of(shape, at_x.ravel(), at_y.ravel())[:, 0], z.ravel(), atol=1e-17)
    if size[0] == 1:
        assert np.ptp(heights_of(shape, np.full(9, 2e-4), np.linspace(-1.0, 1.0, 9)), axis=0).max() < 1e-12
    points = NOISE.uniform(-0.01, 0.01, (20, 3))
    surface = everywhere(shape, 64)
    for point, gap in zip(points, nearest(shape, points)[:, 0], strict=True):
        # Beyond the rim the surface continues, but the brute-force search covers only the cells.
        if (np.abs(point[:2]) < 0.5e-3 * np.array([shape.columns, shape.rows])).all():
            assert abs(gap) == pytest.approx(np.linalg.norm(surface - point, axis=1).min(), abs=2e-5)


def test_the_tightest_valley_is_bounded() -> None:
    """For a bowl z = x^2 / (2 R) it is 1 / R, despite its end at the rim."""
    heights = sampled(30, 80, 1e-3, lambda x, y: x * x / (2.0 * 0.05))
    assert bound_curvature(heights, 1e-3) == pytest.approx(20.0, rel=0.3)  # a bound, looser near the rim
    assert bound_curvature(sampled(30, 30, 1e-3, lambda x, y: 0.1 * x), 1e-3) == pytest.approx(0.0, abs=1e-9)


def stroke(seed: int, ticks: int, reach: float, low: float, high: float) -> Array:
    rng, t = np.random.default_rng(seed), np.arange(ticks)

    def wander() -> Array:
        return sum(np.sin(2e-2 * t * rng.uniform(0.1, 1.0) + rng.uniform(0.0, 6.0)) for _ in range(4)) / 4.0

    turned = np.cumsum(rng.normal(size=(ticks, 3)) * 0.004, axis=0)
    z = low + (high - low) * 0.5 * (1.0 + wander())
    return posed(np.column_stack([reach * wander(), reach * wander(), z]), quaternion(turned))


SWAY = {"kind": "sinusoid", "translation_m": [0.002, 0.0, 0.001], "rotation_rad": 0.05, "axis": [0.6, 0.8, 0.0],
        "frequency_hz": 1.5}  # fmt: skip


@pytest.mark.parametrize(("keys", "modes"), [({}, {0.0, 1.0, 2.0}), ({"motion": SWAY}, {0.0, 2.0})])
def test_a_level_map_is_the_plane(tmp_path: Path, keys: dict[str, Any], modes: set[float]) -> None:
    poses = stroke(2, 1500, 0.03, 0.0085, 0.0125) if not keys else stroke(3, 1000, 0.006, 0.0085, 0.0115)
    height = 0.0 if keys else 0.002
    floor = part(tmp_path, np.full((40, 40), height), 1e-3, position_m=[0.0, 0.0, -height], **keys)
    level, plane = (engine(config).run(poses) for config in (floor, make_object("plane", "plane", **keys)))
    assert modes <= set(plane["contact.mode"])
    np.testing.assert_allclose(level, plane, rtol=0, atol=1e-12)


def test_a_cap_equals_the_ball(tmp_path: Path) -> None:
    poses = stroke(4, 750, 0.006, 0.0085, 0.0105)
    ball = engine(make_object("ball", "sphere", radius_m=0.06, position_m=[0.0, 0.0, -0.06])).run(poses)
    over = engine(part(tmp_path, sampled(60, 60, 1e-3, lambda x, y: cap_of(0.06, x, y)), 1e-3)).run(poses)
    assert {0.0, 1.0, 2.0} <= set(ball["contact.mode"])
    np.testing.assert_array_equal(over["contact.mode"], ball["contact.mode"])
    # While sliding, both leave the remainder of two iterations to the next tick: 40 nm, and 40 uN of a spring of 1
    # N/mm.
    np.testing.assert_allclose(over["proxy.position"], ball["proxy.position"], rtol=0, atol=2e-7)
    np.testing.assert_allclose(over["force"], ball["force"], rtol=0, atol=2e-4)


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("name", ["hills", "ripple", pytest.param("noise", marks=pytest.mark.exhaustive), "rubble"])
def test_the_proxy_is_never_inside(name: str, tmp_path: Path, cases: Callable[[int, int], int]) -> None:
    """With friction, torsion and rolling, deep and shallow, also over the rim."""
    pitch, heights = MAPS[name]
    half, over = 0.5 * pitch * min(heights.shape), np.ptp(heights)
    poses = stroke(6, cases(600, 25_000), 1.2 * half, R - 0.6 * over - 2e-4, R + over)[:: cases(2, 1)]
    records = engine(part(tmp_path, heights, pitch)).run(poses)
    touches = records[:, AT.contact_mode] > 0
    gaps = nearest(compile_heightmap(heights, pitch), records["proxy.position"][touches])[:, 0]
    assert 0.1 < touches.mean() < 0.98
    assert gaps.min() >= R * (1.0 - 1e-9)  # tolerance of contact, see sweep.TOUCHING
    assert np.isfinite(records).all()
    # Coulomb: the tangential force is within the friction cone.
    normal = records[touches, AT.contact_normal_force]
    assert (records[touches, AT.contact_tangential_force] <= 0.6 * normal + 1e-12).all()


def test_a_groove_touches_the_fingertip_on_both_sides(tmp_path: Path) -> None:
    pitch = 2e-4
    heights = sampled(100, 101, pitch, lambda x, y: 0.002 * (1.0 - np.cos(2 * np.pi * x / 0.008)))
    groove = engine(part(tmp_path, heights, pitch, material=SMOOTH), rolling=None)
    surface = everywhere(compile_heightmap(heights, pitch), 4)
    surface = surface[np.abs(surface[:, 1]) < 5e-3]
    low, high = 0.0, 0.03  # height at which the ball rests, by bisection with brute force
    for _ in range(50):
        middle = 0.5 * (low + high)
        inside = np.linalg.norm(surface - [0.0, 0.0, middle], axis=1).min() < R and middle < 0.02
        low, high = (middle, high) if inside else (low, middle)
    down = np.column_stack([np.full(300, 1e-4), np.zeros(300), np.linspace(0.02, high - 0.001, 300)])
    records = visit(groove, np.vstack([down, np.tile(down[-1], (50, 1))]))
    # The brute-force search samples the walls every 50 um: 0.1 um in height. The probe is 0.1 mm off the centre.
    np.testing.assert_allclose(records["proxy.position"][-1], [0.0, 0.0, high], atol=2e-6)
    np.testing.assert_allclose(records["force"][-1], [-0.1, 0.0, 1.0], atol=3e-3)


def test_a_thin_ridge_is_not_jumped_over(tmp_path: Path) -> None:
    heights = np.zeros((60, 60))
    heights[:, 30] = 0.02
    ridge = engine(part(tmp_path, heights, 5e-4), rolling=None)
    start, end = [-0.02, 0.0, 0.0105], [0.03, 0.0, 0.0095]
    records = visit(ridge, [start, start, end, end, end, end])
    assert (records["proxy.position"][2:, 0] < 0.0).all() and (records[2:, AT.contact_mode] > 0).all()


@pytest.mark.scaled
def test_height_maps_next_to_a_wall(tmp_path: Path, cases: Callable[[int, int], int]) -> None:
    """A level map agrees with a plane to 1e-11 m, the tolerance of resting on two objects.

    The wall has no friction: it could hold the proxy exactly on the floor, which is then touched or not, by rounding.
    """
    grip: dict[str, Any] = {"material": {"torsion": None}}
    bare = {"torsion": None, "friction": None}
    wall = make_object("wall", "plane", orientation_wxyz=[math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0], material=bare)
    poses = stroke(8, 2000, 0.012, 0.0085, 0.0115)[: cases(100, 2000)]
    floors = part(tmp_path, np.zeros((40, 40)), 1e-3, **grip), make_object("plane", "plane", **grip)
    level, plane = (engine(floor, wall, rolling=None).run(poses) for floor in floors)
    assert (plane["contacts1.object"] >= 0).any()
    np.testing.assert_allclose(level["force"], plane["force"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(level["proxy.position"], plane["proxy.position"], rtol=0, atol=1e-11)


METHODS = [model.EulerZxz(), model.EulerZyx(), model.Midpoint(), model.MontanaRk4(), model.MontanaRk45(1e-10)]
BALL = model.Sphere(0.06, 1.0)


@pytest.mark.parametrize("method", METHODS, ids=lambda method: type(method).__name__)
def test_every_method_rolls_over_a_cap_as_over_a_ball(method: Any) -> None:
    shape = compile_heightmap(sampled(60, 60, 1e-3, lambda x, y: cap_of(0.06, x, y)), 1e-3)
    at, on = ((0.0, 0.0, R), (0.0, 0.0, 1.0)), ((0.0, 0.0, 0.06 + R), (0.0, 0.0, 1.0))
    for k in range(100):
        turn = rotations.exp((0.01 * math.cos(0.05 * k), 0.01 * math.sin(0.05 * k), 0.004))
        at, on = (compiled_roll(method, body, R, *place, turn)[:2] for body, place in ((shape, at), (BALL, on)))
    assert abs(on[0][0]) > 1e-3  # it has moved
    np.testing.assert_allclose(np.add(at[0], [0.0, 0.0, 0.06]), on[0], rtol=0, atol=2e-8)
