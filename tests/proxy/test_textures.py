"""Textures: heights and friction from a file, compared with closed forms of sampled and filtered waves. A fingertip of
10 mm on an object of 1000 N/m without damping; poses are far apart if nothing depends on the velocity."""

import math
import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Any

import numba
import numpy as np
import pytest
from conftest import merged
from helpers.examples import Cases, examples
from helpers.refusals import refusal
from helpers.touching import posed
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from references.rotation import matrix
from references.waves import REST, Wave, tail

from softfinger.config import schema
from softfinger.config.arrays.grids import read_grid
from softfinger.config.load import build, describe, load_scene
from softfinger.config.sources import FOLDERS
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.contact.texture import sample
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.record import AT, FREE
from softfinger.proxy.scene import build_scene
from softfinger.proxy.textures import FREQUENCY_MAX_HZ, compute_bounds, filter_texture
from softfinger.server.offline.summary import summarize_scene

pytestmark = pytest.mark.plain

Array = np.ndarray[Any, np.dtype[np.float64]]
Make = Callable[..., schema.Scene]

R, K, HEIGHT, DEPTH, SIZE, SPEED = 0.01, 1000.0, 2e-4, 1e-3, 0.02, 0.5
CUTOFF = SPEED / FREQUENCY_MAX_HZ
EPS = float(np.finfo(float).eps)
ROUNDING = 1e-11
"""N, or a fraction of 1 N: cancellation in a depth of 1 mm of coordinates of 20 mm and slopes of some hundred cells."""
OBLIQUE = Wave(48, 40, SIZE, 1.5 * SIZE, (3, -2))


def textured_scene(folder: Path, grid: Array, shape: Any = None, others: Any = (), **changes: Any) -> schema.Scene:
    """Return a scene with one textured object; changes are merged into its table."""
    file = folder / f"{len(list(folder.iterdir()))}.npy"
    np.save(file, grid)
    texture = {"file": str(file), "size_m": [SIZE, SIZE], "height_m": HEIGHT, "speed_m_per_s": SPEED}
    table = {"name": "table", "shape": "plane", "material": {"stiffness_n_per_m": K}, "texture": texture}
    entry = merged(merged(table, shape or {}), changes)
    tables = {"fingertip": {"radius_m": R}, "probe": {"velocity_time_constant_s": 0.0}}
    return build(schema.Scene, {**tables, "object": [entry, *others]}, "test")


@pytest.fixture
def scene(tmp_path: Path) -> Make:
    return partial(textured_scene, tmp_path)


def over_plane(count: int, depth: float = DEPTH, seed: int = 0) -> Array:
    points = np.random.default_rng(seed).uniform(-2.2 * SIZE, 2.2 * SIZE, (count, 3))
    points[:, 2] = R - depth
    return points


def forces(engine: Engine, points: Array) -> Array:
    return engine.run(posed(points))[:, AT.force : AT.force + 3]


def extent(wave: Wave) -> dict[str, Any]:
    return {"texture": {"size_m": [wave.width, wave.depth]}}


@pytest.mark.parametrize("wave", [OBLIQUE, Wave(64, 1, SIZE, SIZE, (4, 0)), Wave(3, 31, SIZE, SIZE, (0, 9))])
def test_force_on_a_wave_is_that_of_the_potential_in_closed_form(scene: Make, wave: Wave) -> None:
    """F = K (delta + h) (n - grad h), h = -H (1 - z), where z is the sampled wave after filter and spline."""
    points = over_plane(60)
    z, by_u, by_v = wave.texture(CUTOFF, points[:, 0], points[:, 1])
    load = K * (DEPTH - HEIGHT * (1.0 - z))
    expected = load[:, None] * np.stack([-HEIGHT * by_u, -HEIGHT * by_v, np.ones(60)], axis=1)
    got = forces(Engine(scene(wave.samples(), extent(wave))), points)
    samples = max(tail(t, n) for t, n in zip(wave.turns, (wave.columns, wave.rows), strict=True) if t)
    steepest = 2.0 * np.pi * wave.frequency() * HEIGHT * load.max()
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=samples * steepest + ROUNDING)
    assert np.abs(got[:, :2]).max() > 1e3 * (samples * steepest + ROUNDING)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("speed", [0.5, 0.75, 1.0, 1.5])
def test_ripple_above_the_cutoff_is_removed(scene: Make, speed: float) -> None:
    """A wave of 2 mm fades with the stroke speed as the filter prescribes, to 0.01 at the cutoff."""
    wave = Wave(100, 1, SIZE, SIZE, (10, 0))
    cutoff = speed / FREQUENCY_MAX_HZ
    load = forces(Engine(scene(wave.samples(), texture={"speed_m_per_s": speed})), over_plane(400))[:, 2]
    ripple = 0.5 * np.ptp(load) / (0.5 * K * HEIGHT)
    # Ten samples per wave: none on the crest. The spline retains sinc^4 of 0.1, with an image of 1 / 9^4 of it.
    sampled = np.sinc(0.1) ** 4 / np.cos(np.pi / 10.0)
    assert ripple == pytest.approx(sampled * REST ** ((cutoff / 2e-3) ** 2), rel=1e-3)
    assert ripple < REST or cutoff < 2e-3


@pytest.mark.parametrize(("border", "rows"), [("period", 24), ("clamp", 24), ("period", 1), ("clamp", 1)])
def test_filter_is_the_gaussian_mean_of_the_extended_array(border: str, rows: int) -> None:
    grid = np.random.default_rng(1).uniform(0.0, 1.0, (rows, 18))
    pitch, cutoff = (1.0e-3, 0.8e-3), 6.0e-3
    repeats = border == "period"
    # Gaussian with the transform REST^((cutoff f)^2) = exp(-2 (pi sigma f)^2).
    sigma = cutoff * np.sqrt(-np.log(REST) / 2.0) / np.pi
    expected = grid
    for axis, step in ((1, pitch[0]), (0, pitch[1])):
        reach = int(np.ceil(9.0 * sigma / step))  # exp(-40) is below rounding
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / sigma) ** 2)
        pads = [(reach, reach) if axis == k else (0, 0) for k in (0, 1)]
        wide = np.pad(expected, pads, mode="wrap" if repeats else "symmetric")
        lines = [np.convolve(line, weights / weights.sum(), "valid") for line in (wide if axis else wide.T)]
        expected = np.array(lines) if axis else np.array(lines).T
    # Sampled at 2.9 and 3.6 spacings per sigma, a Gaussian has the continuous transform to rounding wherever the
    # filter's gain matters: exp(-2 (pi sigma / spacing)^2) is 1e-72, and exp(-20) at the array's limit.
    np.testing.assert_allclose(filter_texture(grid, pitch, cutoff, (repeats, repeats)), expected, rtol=0.0, atol=1e-13)


def gauss(begin: Array, end: Array, pitch: float) -> tuple[Array, Array]:
    """Return points and steps (n, 3) of a quadrature along an edge of a box, exact up to degree 7 in each cell."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    (axis,) = np.flatnonzero(end - begin)
    low, high = sorted((begin[axis], end[axis]))
    borders = np.arange(np.ceil(low / pitch), high / pitch) * pitch
    cuts = np.concatenate([[low], borders[(borders > low) & (borders < high)], [high]])
    middle, half = 0.5 * (cuts[1:] + cuts[:-1]), 0.5 * np.diff(cuts)
    at = (middle[:, None] + half[:, None] * nodes).ravel()
    points, steps = np.tile(begin, (len(at), 1)), np.zeros((len(at), 3))
    points[:, axis] = at
    steps[:, axis] = np.sign(end[axis] - begin[axis]) * (half[:, None] * weights).ravel()
    return points, steps


@pytest.mark.parametrize("seed", range(5))
def test_work_on_a_closed_path_over_a_frictionless_texture_is_zero(scene: Make, seed: int) -> None:
    """Along the edges of a box, into and out of the object, where the force is a polynomial in each cell: exact."""
    rng = np.random.default_rng(seed)
    count = 15  # odd: the spline's pieces end at integer cells from the centre
    engine = Engine(scene(rng.uniform(size=(count, count))))
    (x0, x1), (y0, y1), (z0, z1) = (*rng.uniform(-SIZE, SIZE, (2, 2)), R - rng.uniform(HEIGHT, 2e-3, 2))
    corners = [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1), (x0, y0, z1), (x0, y0, z0)]
    pairs = [gauss(np.array(a), np.array(b), SIZE / count) for a, b in pairwise(corners)]
    points, steps = (np.concatenate(part) for part in zip(*pairs, strict=True))
    work = (forces(engine, points) * steps).sum(axis=1)
    # The force is accurate to the rounding of 20 mm coordinates in a depth of 0.2 mm, a hundred times that of a number.
    assert abs(work.sum()) < 100.0 * EPS * np.abs(work).sum()
    upright = work[steps[:, 2] != 0.0].sum()
    assert abs(upright) > 1e6 * 100.0 * EPS * np.abs(work).sum()  # work of the vertical edges only


def test_valleys_have_no_force_until_the_finger_reaches_them(scene: Make) -> None:
    wave = Wave(64, 1, SIZE, SIZE, (2, 0))
    depth = 0.3 * HEIGHT
    points = over_plane(200, depth)
    z, _, _ = wave.texture(CUTOFF, points[:, 0], points[:, 1])
    rows = Engine(scene(wave.samples())).run(posed(points))
    expected = K * np.maximum(depth - HEIGHT * (1.0 - z), 0.0)
    np.testing.assert_allclose(rows[:, AT.force + 2], expected, rtol=0.0, atol=ROUNDING)
    assert (expected == 0.0).any() and (expected > 0.0).any() and (rows["contact.mode"] != FREE).all()
    np.testing.assert_array_equal(rows[expected == 0.0][:, AT.force : AT.force + 3], 0.0)


def test_damping_dissipates_along_the_slope(scene: Make) -> None:
    """Damping B reduces the force by B (m . v) m with m = n - grad h, so its power is -B (m . v)^2."""
    damping, dt = 2.0, 1e-3
    grid = OBLIQUE.samples()
    engines = [Engine(scene(grid, extent(OBLIQUE), material={"damping_ns_per_m": b})) for b in (0.0, damping)]
    points = over_plane(30)
    steps = np.random.default_rng(3).uniform(-2e-4, 2e-4, (30, 3))  # up to 0.2 m/s: the spring force remains larger
    for point, step in zip(points, steps, strict=True):
        without, having = (engine.run(posed(np.stack([point - step, point])))[1] for engine in engines)
        elastic = without[AT.force : AT.force + 3]
        m = elastic / elastic[2]
        expected = elastic - damping * (m @ step) / dt * m
        np.testing.assert_allclose(having[AT.force : AT.force + 3], expected, rtol=0.0, atol=ROUNDING)


SHAPES: dict[str, dict[str, Any]] = {
    "box": {"shape": "box", "size_m": [0.05, 0.06, 0.07]},
    "cylinder": {"shape": "cylinder", "radius_m": 0.03},
    "cylinder with ends": {"shape": "cylinder", "radius_m": 0.03, "length_m": 0.08},
    "hollow cylinder": {"shape": "cylinder", "radius_m": 0.03, "inside": True},
}
AROUND = 2.0 * np.pi * 0.03 / 8.0


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("name", list(SHAPES))
def test_force_is_the_gradient_of_its_potential_on_every_shape(scene: Make, cases: Cases, name: str) -> None:
    """F = -grad (f_N^2 / 2K) by central differences, on faces, sides and ends, near and beyond edges."""
    wave = Wave(24, 24, AROUND, SIZE, (3, 2))
    engine = Engine(scene(wave.samples(), SHAPES[name] | extent(wave)))
    bare = Engine(scene(wave.samples(), SHAPES[name] | {"texture": None}))

    def forces_at(of: Engine, x: Array) -> Any:
        of.reset()
        return of.step(x, [1.0, 0.0, 0.0, 0.0])

    rng, step, checked, textured = np.random.default_rng(5), 2e-7, 0, 0
    wanted = cases(50, 150)
    while checked < wanted:
        x = rng.uniform(-0.05, 0.05, 3)
        even = forces_at(bare, x)
        if not 3e-4 < even.penetration < 1.2e-3:
            continue
        here = forces_at(engine, x)
        sides = [(forces_at(engine, x + step * e), forces_at(engine, x - step * e)) for e in np.eye(3)]
        slope = [(up.normal_force**2 - down.normal_force**2) / (2.0 * K) / (2.0 * step) for up, down in sides]
        # Truncation: step^2 / 6 times K d h''' of waves of 5 mm and of the fade of 1 mm, 3e-7 N; rounding of an energy
        # of 1e-3 J over the step, 1e-12 N.
        np.testing.assert_allclose(here.force, -np.array(slope), rtol=0.0, atol=1e-6)
        checked += 1
        textured += np.linalg.norm(here.force - even.force) > 0.02
    assert textured > wanted // 7


@pytest.mark.parametrize("inside", [False, True])
def test_wave_round_a_cylinder(scene: Make, inside: bool) -> None:
    """u is the arc length from x; under a probe at rho from the axis it changes R / rho times as fast."""
    radius, wave = 0.03, Wave(32, 4, AROUND, SIZE, (2, 0))
    engine = Engine(scene(wave.samples(), SHAPES["hollow cylinder" if inside else "cylinder"] | extent(wave)))
    angle = np.linspace(-np.pi, np.pi, 41)
    rho = radius - R + DEPTH if inside else radius + R - DEPTH
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    around = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    z, by_u, _ = wave.texture(CUTOFF, radius * angle, 0.0 * angle)
    load = K * (DEPTH - HEIGHT * (1.0 - z))[:, None]
    expected = load * ((-out if inside else out) - (HEIGHT * by_u * radius / rho)[:, None] * around)
    atol = tail(2, 32) * 2.0 * np.pi * wave.frequency() * HEIGHT * load.max() * radius / rho + ROUNDING
    np.testing.assert_allclose(forces(engine, rho * out), expected, rtol=0.0, atol=atol)


@pytest.mark.parametrize(
    ("face", "u", "v"), [((1, 0, 0), 1, 2), ((0, -1, 0), 0, 2), ((0, 0, 1), 0, 1), ((0, 0, -1), 0, 1)]
)
@pytest.mark.parametrize("inside", [False, True])
def test_each_face_of_a_box_has_the_two_other_coordinates(scene, face, u, v, inside):
    """u and v are the remaining coordinates in the order x, y, z from the centre of the face, outside and inside."""
    wave = OBLIQUE
    engine = Engine(scene(wave.samples(), SHAPES["box"] | extent(wave) | {"inside": inside}))
    normal = -np.array(face, float) if inside else np.array(face, float)
    half = 0.5 * abs(np.array(SHAPES["box"]["size_m"]) @ face)
    at = np.zeros((20, 3))
    at[:, [u, v]] = np.random.default_rng(7).uniform(-0.01, 0.01, (20, 2))  # away from the fade and from other walls
    z, by_u, by_v = wave.texture(CUTOFF, at[:, u], at[:, v])
    expected = np.tile(normal, (20, 1))
    expected[:, u], expected[:, v] = -HEIGHT * by_u, -HEIGHT * by_v
    expected *= K * (DEPTH - HEIGHT * (1.0 - z))[:, None]
    got = forces(engine, at + half * np.array(face) + (R - DEPTH) * normal)
    atol = tail(2, 48) * 2.0 * np.pi * wave.frequency() * HEIGHT + ROUNDING
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=atol)


TURN = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])


def test_texture_moves_with_the_pose_of_its_object(scene: Make) -> None:
    grid, place, points = OBLIQUE.samples(), np.array([0.02, -0.03, 0.01]), over_plane(40)
    pose = {"position_m": place.tolist(), "orientation_wxyz": TURN.tolist()}
    at_rest = forces(Engine(scene(grid, extent(OBLIQUE))), points)
    moved = forces(Engine(scene(grid, extent(OBLIQUE), **pose)), points @ matrix(TURN).T + place)
    np.testing.assert_allclose(moved, at_rest @ matrix(TURN).T, rtol=0.0, atol=ROUNDING)


def test_texture_moves_with_a_moving_object(scene: Make) -> None:
    motion = {"kind": "sinusoid", "translation_m": [0.02, 0.01, 0.0], "frequency_hz": 1.5}
    engine = Engine(scene(OBLIQUE.samples(), extent(OBLIQUE), motion=motion))
    point, count = np.array([0.003, 0.001, R - DEPTH]), 700
    away = np.sin(2.0 * np.pi * 1.5 * 1e-3 * np.arange(1, count + 1))[:, None] * [0.02, 0.01, 0.0]
    riding = forces(engine, point + away)
    z, by_u, by_v = (float(part[0]) for part in OBLIQUE.texture(CUTOFF, point[0], point[1]))
    expected = K * (DEPTH - HEIGHT * (1.0 - z)) * np.array([-HEIGHT * by_u, -HEIGHT * by_v, 1.0])
    atol = tail(2, 48) * 2.0 * np.pi * OBLIQUE.frequency() * HEIGHT + 10.0 * ROUNDING  # the time is a sum of 700 ticks
    np.testing.assert_allclose(riding, np.tile(expected, (count, 1)), rtol=0.0, atol=atol)


def test_walls_of_a_corner_have_separate_textures(scene: Make) -> None:
    """A textured floor, a bare wall and another textured wall give the sum of their separate forces."""
    grid = OBLIQUE.samples()
    stuff = {"material": {"stiffness_n_per_m": 2.0 * K}}
    wall = {"name": "wall", "shape": "plane", "orientation_wxyz": [1.0, 0.0, 1.0, 0.0]} | stuff
    (second,) = describe(scene(grid, extent(OBLIQUE), texture={"height_m": 0.5 * HEIGHT}))["object"]
    second |= {"name": "back", "orientation_wxyz": [1.0, -1.0, 0.0, 0.0]}
    at = np.array([[R - 1e-3, R - 0.8e-3, R - 1.2e-3], [R - 0.7e-3, R - 1.1e-3, R - 0.9e-3]])
    together = Engine(scene(grid, extent(OBLIQUE), others=(wall, second)))
    alone = [
        Engine(scene(grid, extent(OBLIQUE))),
        Engine(build(schema.Scene, {"fingertip": {"radius_m": R}, "object": [wall]}, "wall")),
        Engine(build(schema.Scene, {"fingertip": {"radius_m": R}, "object": [second]}, "back")),
    ]
    for x in at:
        # Start in free space: a first pose inside several objects touches only the deepest.
        path = np.stack([x + 2e-3, x, x])
        got = together.run(posed(path))[-1, AT.force : AT.force + 3]
        expected = sum(engine.run(posed(path))[-1, AT.force : AT.force + 3] for engine in alone)
        np.testing.assert_allclose(got, expected, rtol=0.0, atol=ROUNDING)
        together.reset()


def test_clamped_border_is_level(scene: Make) -> None:
    grid = np.random.default_rng(2).uniform(size=(9, 12))
    engine = Engine(scene(grid, texture={"border": "clamp"}))
    y = np.linspace(-0.4 * SIZE, 0.4 * SIZE, 15)
    near, far = (forces(engine, np.stack([x + 0.0 * y, y, R - DEPTH + 0.0 * y], axis=1)) for x in (0.7 * SIZE, 90.0))
    # 90 m away the coordinate of a cell is accurate to 1e-11 of a cell.
    np.testing.assert_allclose(far, near, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(near[:, 0], 0.0, atol=ROUNDING)
    assert np.ptp(near[:, 2]) > 1e-3


def test_clamped_border_of_a_cylinder_is_level_and_repeats_around_it(scene: Make) -> None:
    grid = np.random.default_rng(2).uniform(size=(9, 12))
    engine = Engine(scene(grid, SHAPES["cylinder"], texture={"border": "clamp", "size_m": [AROUND, SIZE]}))
    angle = np.linspace(0.1, 0.1 + np.pi / 4.0, 9)
    out = (0.03 + R - DEPTH) * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    inside, near, far = (forces(engine, np.add(out, [0.0, 0.0, z])) for z in (0.3 * SIZE, 0.7 * SIZE, 9.0))
    # 9 m away the coordinate of a cell is accurate to 1e-12 of a cell.
    np.testing.assert_allclose(far, near, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(near[:, 2], 0.0, atol=ROUNDING)
    for force in (inside, near):
        load = np.linalg.norm(force, axis=1)
        assert load[0] == pytest.approx(load[-1], abs=1e-9) and np.ptp(load) > 1e-3


@examples(40, 100)
@given(
    grid=arrays.arrays(np.float64, st.tuples(st.integers(1, 7), st.integers(2, 7)), elements=st.floats(-1e3, 1e3)),
    u=st.floats(-1e200, 1e200),
    v=st.floats(-1.0, 1.0),
    border=st.sampled_from(["period", "clamp"]),
)
def test_texture_stays_between_its_minimum_and_maximum(tmp_path_factory, grid, u, v, border):
    if grid.min() == grid.max():
        grid.flat[0] += 1.0
    built = build_scene(textured_scene(tmp_path_factory.mktemp("grid"), grid, texture={"border": border}))
    value = sample(built.objects.body.texture, u, v).value
    assert -4.0 * EPS <= value <= 1.0 + 4.0 * EPS  # weights sum to 1 up to rounding


def test_array_is_referenced_by_its_address_and_may_be_replaced(scene: Make) -> None:
    """The type of a scene does not depend on the array, and `tune` replaces it without compiling."""
    small, large = (build_scene(scene(np.random.default_rng(0).uniform(size=shape))) for shape in ((2, 2), (300, 200)))
    assert len(flatten(small)) == len(flatten(large)) and numba.typeof(small) == numba.typeof(large)
    first, second = scene(OBLIQUE.samples(), extent(OBLIQUE)), scene(-OBLIQUE.samples(), extent(OBLIQUE))
    engine, points = Engine(first), over_plane(10)
    before = forces(engine, points)
    engine.tune(second)
    np.testing.assert_array_equal(forces(engine, points), forces(Engine(second), points))
    engine.tune(first)
    np.testing.assert_array_equal(forces(engine, points), before)


def test_files_are_relative_to_their_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The documented array and scene load from another working directory; the summary of `check` has their values."""
    page = (Path(__file__).parents[2] / "docs" / "model" / "texture.md").read_text("utf-8")
    blocks = [dedent(match[0]) for match in re.finditer(r"(?:^    .*\n|^\n(?=    ))+", page, re.MULTILINE)]
    program, table = blocks[:2]
    monkeypatch.chdir(tmp_path)
    exec(program, {})
    (tmp_path / "trunk.toml").write_text(table)
    monkeypatch.chdir("/")
    loaded = load_scene(tmp_path / "trunk.toml")
    texture = build_scene(loaded).objects.body.texture
    assert (texture.columns, texture.rows, texture.period_u) == (128.0, 128.0, 1.0)
    # ten times around, up to rounding
    assert texture.per_u == pytest.approx(10 * 128 / (2.0 * np.pi * 0.05), rel=1e-15)
    assert build(schema.Scene, describe(loaded), "again") == loaded
    missing = load_scene(tmp_path / "trunk.toml", {"object.0.texture.file": "/no/such.npy"})
    message = "object 'trunk': texture.file: /no/such.npy: cannot be read: No such"
    assert message in refusal(build_scene, missing)
    summary = dict(summarize_scene(loaded))
    assert summary["    filter"].startswith("Gaussian, 0.01 left at a wavelength of 0.0004 m: 0.2 m/s at 500 Hz")
    values = texture.values.array
    assert f"{3e-4 * np.ptp(values):.3g} m after the filter" in summary["    height"]
    # The steepest slope in the summary is an upper bound of the same magnitude as the measured one.
    places = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 2))
    steepest = max(math.hypot(s.by_u, s.by_v) for s in (sample(texture, u, v) for u, v in places)) * 3e-4
    _, slope, bend = compute_bounds(loaded.object[0])
    assert 0.3 * slope < steepest < slope
    step = 1e-6
    bends = [abs(sample(texture, u + step, v).by_u - sample(texture, u - step, v).by_u) for u, v in places]
    assert 0.1 * bend < max(bends) * 3e-4 / (2.0 * step) < bend


def test_shipped_ribs_are_a_cosine() -> None:
    grid = read_grid(FOLDERS[schema.Scene] / "ribs.csv")
    expected = 0.5 + 0.5 * np.cos(2.0 * np.pi * (np.arange(16) + 0.5) / 16.0)
    np.testing.assert_allclose(grid, expected[None], rtol=0.0, atol=5.1e-7)  # six digits
