"""Signed distance, nearest point, normal and curvature of every shape, at all scales, outside and inside."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from references.surface_points import Array, contacts, ellipsoid_foot, signed_distance, unit

from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact.rest.one_object import rest_on
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.shapes import closest, curvature, transport, travel

pytestmark = pytest.mark.plain

Triple = tuple[float, float, float]

EPS = float(np.finfo(np.float64).eps)

SHAPES: list[Any] = [
    model.Plane((0.6, 0.0, 0.8), 0.3), model.Sphere(0.7, 1.0), model.Sphere(0.7, -1.0), model.Cylinder(0.5, 1.0),
    model.Cylinder(0.5, -1.0), model.CappedCylinder(0.5, 0.8), model.Capsule(0.4, 0.9, 1.0),
    model.Capsule(0.4, 0.9, -1.0), model.Box((0.5, 0.9, 0.3)), model.Ellipsoid((0.9, 0.5, 0.7), 1.0),
    model.Ellipsoid((0.9, 0.6, 0.7), -1.0), model.Ellipsoid((0.8, 0.8, 0.5), 1.0), model.Torus(0.8, 0.3, 1.0),
    model.Torus(0.8, 0.3, -1.0),
]  # fmt: skip
NAMES = [f"{type(s).__name__}{'-inside' if getattr(s, 'side', 1.0) < 0 else ''}" for s in SHAPES]

BALL = ((1.0, 1.0, 1.0), -1.0)

every_shape = pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
scales = st.floats(-5.0, 3.0).map(lambda power: 10.0**power)
seeds = st.integers(0, 2**32 - 1)


@entry
def compiled_closest(shape, x):
    return closest(shape, x)


@entry
def compiled_curvature(shape, radius, point, normal):
    return curvature(shape, radius, point, normal)


@entry
def compiled_transport(shape, v, normal_from, normal_to):
    return transport(shape, v, normal_from, normal_to)


def triple(v: Array) -> Triple:
    x, y, z = (float(c) for c in v)
    return x, y, z


def size_of(shape: Any) -> float:
    return max(abs(v) for v in leaves(shape))


def leaves(shape: Any) -> list[float]:
    fields = shape._asdict()
    fields.pop("side", None)
    fields.pop("normal", None)
    return [leaf for item in fields.values() for leaf in (item if isinstance(item, tuple) else (item,))]


def scaled(shape: Any, factor: float) -> Any:
    fields = shape._asdict()
    for key, value in fields.items():
        if key not in {"side", "normal"}:
            fields[key] = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
    return type(shape)(**fields)


def random_shape(kind: type, rng: np.random.Generator, size: float) -> Any:
    a, b, c = (float(v) for v in size * 10.0 ** rng.uniform(-2.0, 0.0, 3))
    side = 1.0 if rng.random() < 0.5 else -1.0
    build = {
        model.Plane: lambda: model.Plane(triple(unit(rng)), a),
        model.Sphere: lambda: model.Sphere(a, side),
        model.Cylinder: lambda: model.Cylinder(a, side),
        model.Capsule: lambda: model.Capsule(a, b, side),
        model.CappedCylinder: lambda: model.CappedCylinder(a, b),
        model.Box: lambda: model.Box((a, b, c)),
        model.Ellipsoid: lambda: model.Ellipsoid((a, b, c), side),
        model.Torus: lambda: model.Torus(max(a, b), 0.9 * min(a, b), side),
    }
    return build[kind]()


KINDS = sorted({type(shape) for shape in SHAPES}, key=lambda kind: kind.__name__)
EXPLICIT = [kind for kind in KINDS if kind is not model.Ellipsoid]
kinds = st.sampled_from(KINDS)


def near_or_far(shape: Any, rng: np.random.Generator) -> Array:
    x = unit(rng) * size_of(shape) * 10.0 ** rng.uniform(-3.0, 1.5)
    return np.where(rng.random(3) < 0.15, 0.0, x)


@pytest.mark.scaled
@examples(150, 1250)
@given(kind=st.sampled_from(EXPLICIT), size=scales, seed=seeds)
def test_gap_is_the_signed_distance(kind: type, size: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = random_shape(kind, rng, size)
    for _ in range(8):
        x = near_or_far(shape, rng)
        gap, _, _ = compiled_closest(shape, triple(x))
        expected = getattr(shape, "side", 1.0) * signed_distance(shape, x)
        # A few roundings of numbers as large as the shape and the point.
        assert abs(gap - expected) <= 8 * EPS * max(size_of(shape), float(np.linalg.norm(x)))


@pytest.mark.scaled
@examples(150, 1500)
@given(kind=kinds, size=scales, seed=seeds)
def test_nearest_point_is_along_the_normal(kind: type, size: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = random_shape(kind, rng, size)
    x = near_or_far(shape, rng)
    gap, point, normal = compiled_closest(shape, triple(x))
    rounding = 16 * EPS * max(size_of(shape), float(np.linalg.norm(x)))
    assert math.hypot(*normal) == pytest.approx(1.0, abs=4 * EPS)
    if kind is model.Ellipsoid:
        a = np.array(shape.semi_axes)
        assert np.linalg.norm(point / a) == pytest.approx(1.0, abs=4 * EPS)
    else:
        assert signed_distance(shape, np.array(point)) == pytest.approx(0.0, abs=rounding)
    away = np.array(point) + gap * np.array(normal) - x
    # On an ellipsoid the rounding error of the normal grows with the ratio of its axes.
    sharp = max(shape.semi_axes) / min(shape.semi_axes) if kind is model.Ellipsoid else 1.0
    assert np.linalg.norm(away) <= rounding * sharp


@pytest.mark.scaled
@examples(80, 400)
@given(size=scales, flat=st.floats(0.0, 8.0), needle=st.floats(0.0, 8.0), seed=seeds)
def test_ellipsoid_to_machine_precision(size: float, flat: float, needle: float, seed: int) -> None:
    """Compared with 60 digits: axes up to 10^8 apart or equal, in planes of symmetry, at the centre, near and far."""
    rng = np.random.default_rng(seed)
    spread = min(1.0, 8.0 / max(flat + needle, 1e-9))
    axes = rng.permutation(size * np.array([1.0, 10.0 ** (-spread * flat), 10.0 ** (-spread * needle)]))
    if rng.random() < 0.2:
        axes[0] = axes[1]
    direction = np.where(rng.random(3) < 0.15, 0.0, unit(rng))
    reach = axes if rng.random() < 0.7 else np.full(3, axes.max())
    x = direction * reach * (10.0 ** rng.uniform(-3.0, 2.0) if rng.random() < 0.7 else 1.0 + rng.uniform(-1e-3, 1e-3))
    gap, point, normal = compiled_closest(model.Ellipsoid(triple(axes), 1.0), triple(x))
    expected_gap, expected_point, expected_normal = ellipsoid_foot(triple(axes), triple(x))
    extent = max(float(axes.max()), float(np.abs(x).max()))
    assert abs(gap - float(expected_gap)) <= 8 * EPS * extent
    for i in range(3):
        assert point[i] == pytest.approx(float(expected_point[i]), abs=1e-13 * float(axes.max()))
        assert normal[i] == pytest.approx(float(expected_normal[i]), abs=1e-12)


@pytest.mark.parametrize("off", [0.0, 1e-59, 1e-30, 1e-16, 1e-9])
@pytest.mark.parametrize("thin", [0.9, 0.1, 1e-4, 1e-8])
def test_ellipsoid_at_the_end_of_its_medial_surface(thin: float, off: float) -> None:
    """Near the centre of curvature of the sharpest end, close to a plane of symmetry, where convergence is slowest."""
    for axes, x in (
        ((1.0, thin, 1.0), (1.0 - thin * thin, off, 0.0)),
        ((1.0, thin, thin), ((1.0 - thin * thin) * (1.0 - 1e-15), off, off)),
        ((1.0, thin, 0.5), ((1.0 - thin * thin) * 0.6, off, (0.25 - thin * thin) / 0.5 * 0.8)),
    ):
        gap, point, normal = compiled_closest(model.Ellipsoid(axes, 1.0), x)
        # The nearest point is defined only to the root of rounding here; its distance and direction are exact.
        assert abs(gap - float(ellipsoid_foot(axes, x)[0])) <= 4 * EPS
        assert np.linalg.norm(np.array(point) + gap * np.array(normal) - x) <= 1e-15 / thin


@pytest.mark.parametrize("shape", [s for s in SHAPES if getattr(s, "side", 0.0) > 0.0])
def test_inside_negates_gap_and_normal(shape: Any) -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        x = triple(near_or_far(shape, rng))
        gap, point, normal = compiled_closest(shape, x)
        negated = compiled_closest(shape._replace(side=-shape.side), x)
        assert negated == (-gap, point, (-normal[0], -normal[1], -normal[2]))


SYMMETRIC: list[tuple[Any, Triple, float, Triple, Triple]] = [
    (model.Sphere(2.0, 1.0), (0.0, 0.0, 0.0), -2.0, (0.0, 0.0, 2.0), (0.0, 0.0, 1.0)),
    (model.Sphere(2.0, -1.0), (0.0, 0.0, 0.0), 2.0, (0.0, 0.0, 2.0), (0.0, 0.0, -1.0)),
    (model.Cylinder(2.0, 1.0), (0.0, 0.0, 5.0), -2.0, (2.0, 0.0, 5.0), (1.0, 0.0, 0.0)),
    (model.Capsule(2.0, 1.0, -1.0), (0.0, 0.0, 0.5), 2.0, (2.0, 0.0, 0.5), (-1.0, 0.0, 0.0)),
    (model.Capsule(2.0, 1.0, 1.0), (0.0, 0.0, 1.5), -1.5, (0.0, 0.0, 3.0), (0.0, 0.0, 1.0)),
    (model.CappedCylinder(2.0, 3.0), (0.0, 0.0, 0.0), -2.0, (2.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    (model.CappedCylinder(2.0, 1.0), (0.0, 0.0, -0.5), -0.5, (0.0, 0.0, -1.0), (0.0, 0.0, -1.0)),
    (model.Box((3.0, 1.0, 2.0)), (0.0, 0.0, 0.0), -1.0, (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)),
    (model.Box((1.0, 1.0, 1.0)), (1.0, 1.0, 1.0), 0.0, (1.0, 1.0, 1.0), (1.0, 0.0, 0.0)),
    (model.Ellipsoid((3.0, 1.0, 2.0), 1.0), (0.0, 0.0, 0.0), -1.0, (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)),
    (model.Ellipsoid((1.0, 1.0, 1.0), -1.0), (0.0, 0.0, 0.0), 1.0, (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    (model.Torus(3.0, 1.0, 1.0), (3.0, 0.0, 0.0), -1.0, (3.0, 0.0, 1.0), (0.0, 0.0, 1.0)),
    (model.Torus(3.0, 1.0, 1.0), (0.0, 0.0, 0.0), 2.0, (2.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
]


@pytest.mark.parametrize(("shape", "x", "gap", "point", "normal"), SYMMETRIC)
def test_tied_nearest_points_are_resolved_deterministically(shape, x, gap, point, normal):
    assert compiled_closest(shape, x) == (gap, point, normal)


@pytest.mark.scaled
@examples(150, 1500)
@given(kind=kinds, size=scales, seed=seeds, x=st.tuples(*[st.floats(-1e100, 1e100)] * 3))
def test_any_place_gives_finite_numbers(kind: type, size: float, seed: int, x: Triple) -> None:
    shape = random_shape(kind, np.random.default_rng(seed), size)
    gap, point, normal = compiled_closest(shape, x)
    assert math.isfinite(gap) and math.hypot(*normal) == pytest.approx(1.0, abs=4 * EPS)
    assert all(math.isfinite(v) for v in point)
    k1, k2, d1 = compiled_curvature(shape, 0.01, point, normal)
    assert math.isfinite(k1) and math.isfinite(k2)
    assert math.hypot(*d1) == pytest.approx(1.0, abs=8 * EPS)


@pytest.mark.parametrize("x", [(5e-324, 0.0, 0.0), (1e-320, 1e-310, 0.0), (0.0, 1e-170, -1e-200), (1e-160, 1e-90, 0.1)])
@every_shape
def test_tiny_coordinates_count_as_zero(shape: Any, x: Triple) -> None:
    gap, point, normal = compiled_closest(shape, x)
    nothing = compiled_closest(shape, triple(np.where(np.abs(x) < 1e-80, 0.0, x)))
    # Rounding of lengths below 1 m.
    assert gap == pytest.approx(nothing[0], abs=4 * EPS)
    assert math.hypot(*normal) == pytest.approx(1.0, abs=4 * EPS) and all(math.isfinite(v) for v in point)


@pytest.mark.scaled
@examples(100, 1000)
@given(kind=kinds, size=scales, seed=seeds)
def test_curvature_of_the_offset_surface(kind: type, size: float, seed: int) -> None:
    """Matches k / (1 + r k), with 1 / r at edges, and for the ellipsoid the fundamental forms."""
    rng = np.random.default_rng(seed)
    shape = random_shape(kind, rng, size)
    for point, normal, (k1, k2), room in contacts(shape, rng):
        r = min(size_of(shape), 0.9 * room) * rng.uniform(0.01, 1.0)
        expected = [1.0 / r if math.isinf(k) else k / (1.0 + r * k) for k in (k1, k2)]
        curvatures = compiled_curvature(shape, r, triple(point), triple(normal))[:2]
        # The reference's fundamental forms lose as many digits as the squared ratio of the ellipsoid's axes has.
        assert sorted(curvatures) == pytest.approx(sorted(expected), rel=1e-8 if kind is model.Ellipsoid else 1e-12)


@every_shape
def test_curvature_against_finite_differences(shape: Any) -> None:
    """A step h of the fingertip's centre along a principal direction turns the normal by k h in that direction."""
    rng = np.random.default_rng(6)
    for _ in range(20):
        for point, normal, _, room in contacts(shape, rng):
            r = min(0.2, 0.5 * room)
            k1, k2, first = compiled_curvature(shape, r, triple(point), triple(normal))
            d1 = np.array(first)
            d2 = np.cross(normal, d1)
            assert abs(d1 @ normal) <= 4 * EPS and np.linalg.norm(d1) == pytest.approx(1.0, abs=4 * EPS)
            h, center = 1e-4, point + r * normal
            for k, d in ((k1, d1), (k2, d2)):
                ahead, behind = (np.array(compiled_closest(shape, triple(center + s * d))[2]) for s in (h, -h))
                # (k h)^2 with k up to 20 / m: truncation error of central differences, relative to k.
                assert np.linalg.norm((ahead - behind) / (2.0 * h) - k * d) <= 1e-4


@pytest.mark.parametrize("ratio", [1.0, 1e2, 1e5, 1e8])
def test_curvature_at_the_ends_of_long_ellipsoids(ratio: float) -> None:
    """At the ends of the axes the radii of curvature are a^2 / c, for flat and needle-like ellipsoids."""
    axes = np.array([1e-5, 1e-5 * ratio, 1e-5 * math.sqrt(ratio)])
    shape = model.Ellipsoid(triple(axes), 1.0)
    for i in range(3):
        end = np.eye(3)[i]
        r = 1e-5
        k1, k2, _ = compiled_curvature(shape, r, triple(axes * end), triple(end))
        bends = [axes[j] ** 2 / axes[i] for j in range(3) if j != i]
        assert sorted((k1, k2)) == pytest.approx(sorted(1.0 / (r + bend) for bend in bends), rel=16 * EPS)


@every_shape
def test_curvature_at_edges_tolerates_rounded_normals(shape: Any) -> None:
    rng = np.random.default_rng(8)
    for point, normal, _, room in contacts(shape, rng):
        r = min(0.2, 0.5 * room)
        exact = compiled_curvature(shape, r, triple(point), triple(normal))
        turned = compiled_curvature(shape, r, triple(point), triple(normal + 1e-15 * rng.uniform(-1.0, 1.0, 3)))
        assert turned[:2] == pytest.approx(exact[:2], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("slope", [1e-6, 0.1])
def test_edges_have_a_fan_of_normals(slope: float) -> None:
    """A normal that is 1e-6 off a face's belongs to the edge: curvature 1 / r across it and 0 along it."""
    n = triple(np.array([slope, 0.0, 1.0]) / math.hypot(slope, 1.0))
    assert compiled_curvature(model.Box((0.5, 0.9, 0.3)), 0.1, (0.5, 0.2, 0.3), n)[:2] == (10.0, 0.0)
    rim = compiled_curvature(model.CappedCylinder(0.5, 0.8), 0.1, (0.5, 0.0, 0.8), n)
    assert rim[:2] == pytest.approx((10.0, n[0] / (0.5 + 0.1 * n[0])), rel=4 * EPS)
    end = compiled_curvature(model.Capsule(0.4, 0.9, 1.0), 0.1, (0.4, 0.0, 0.9), (n[2], 0.0, n[0]))
    assert end[:2] == pytest.approx((2.0, 2.0), rel=4 * EPS)


@pytest.mark.parametrize("shape", [s for s in SHAPES if getattr(s, "side", 1.0) < 0.0 or isinstance(s, model.Torus)])
def test_a_fingertip_that_does_not_fit_has_finite_curvature(shape: Any) -> None:
    rng = np.random.default_rng(9)
    # The last case is a spherical ellipsoid that is filled exactly.
    for hollow, radius in [
        *((shape, length) for length in leaves(shape)),
        (shape, 10.0),
        (model.Ellipsoid(*BALL), 1.0),
    ]:
        for point, normal, *_ in contacts(hollow, rng):
            k1, k2, _ = compiled_curvature(hollow, radius, triple(point), triple(normal))
            assert math.isfinite(k1) and math.isfinite(k2)


@pytest.mark.scaled
@examples(100, 500)
@given(seed=seeds, nearness=st.floats(-17.0, 0.0), opposite=st.booleans())
def test_transport_is_the_smallest_rotation(seed: int, nearness: float, opposite: bool) -> None:
    rng = np.random.default_rng(seed)
    before, v = unit(rng), unit(rng)
    after = (-before if opposite else before) + 10.0**nearness * unit(rng)
    after /= np.linalg.norm(after)
    across = np.cross(before, after)
    sine = np.linalg.norm(across)

    def carried(w: Array) -> Array:
        return np.array(compiled_transport(SHAPES[1], triple(w), triple(before), triple(after)))

    tangent = v - (v @ before) * before
    # The accuracy of the half-way plane depends on the length of the sum of the normals.
    slack = 16 * EPS / max(float(np.linalg.norm(before + after)), 1e-14)
    assume(slack < 0.1)
    assert abs(np.linalg.norm(carried(tangent)) - np.linalg.norm(tangent)) <= 16 * EPS
    assert np.linalg.norm(carried(before) - after) <= slack and abs(carried(tangent) @ after) <= slack
    if sine > 1e-8:
        axis = across / sine
        assert np.linalg.norm(carried(axis) - axis) <= slack + 16 * EPS / sine


def test_transport_between_opposite_normals() -> None:
    rng = np.random.default_rng(10)
    for _ in range(50):
        n = unit(rng)
        frame = np.array([compiled_transport(SHAPES[1], triple(e), triple(n), triple(-n)) for e in np.eye(3)]).T
        assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-14)
        assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-14)
        assert frame @ n == pytest.approx(-n, abs=1e-14)


def test_transport_on_a_plane_is_the_identity() -> None:
    assert compiled_transport(SHAPES[0], (0.1, 0.2, 0.3), (0.6, 0.0, 0.8), (0.6, 0.0, 0.8)) == (0.1, 0.2, 0.3)


@every_shape
def test_a_slip_ends_at_the_point_nearest_to_the_displaced_probe(shape: Any) -> None:
    """The displaced probe is below it along the normal, also after slips as long as the shape, outside and inside."""
    rng, pose, settled = np.random.default_rng(3), model.Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), 0
    for _ in range(100):
        for point, normal, _, room in contacts(shape, rng):
            r = min(0.2, 0.5 * room)
            start, lengths = point + r * normal, 10.0 ** rng.uniform(-5.0, -0.5, 2)
            probe, deflection = start - lengths[0] * r * normal, lengths[1] * np.cross(normal, unit(rng))
            end = rest_on(shape, pose, r, triple(probe), triple(start), triple(deflection), triple(normal))
            if np.dot(end[1], normal) <= 0.5:
                continue  # on another side: the proxy moves round the object in more than one tick
            off = np.cross(probe + deflection - end[0], end[1])
            assert np.linalg.norm(off) <= 8 * EPS and abs(compiled_closest(shape, end[0])[0] - r) <= 8 * EPS
            settled += 1
    assert settled > 80


@pytest.mark.parametrize("depth", [0.06, 0.09, 0.0999])
@pytest.mark.parametrize(
    ("shape", "point", "distance"),
    [(model.Sphere(0.7, 1.0), (0.0, 0.0, 0.7), 0.7), (model.Box((0.5, 0.9, 0.3)), (0.5, 0.2, 0.3), 0.0)],
)
def test_a_slip_of_a_deep_contact_turns_the_normal_no_faster(
    shape: Any, point: Triple, distance: float, depth: float
) -> None:
    """By atan(s / (R + r / 2)) for a slip s, as at a depth of r / 2: an edge (R = 0) would have no limit."""
    r, slip = 0.1, 0.02
    normal = np.array([1.0, 0.0, 1.0]) / math.sqrt(2.0) if distance == 0.0 else np.array([0.0, 0.0, 1.0])
    start, across = point + r * normal, np.cross(normal, (0.0, 1.0, 0.0))
    pose = model.Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    lengths = triple(start - depth * normal), triple(start), triple(slip * across), triple(normal)
    _, up, _ = rest_on(shape, pose, r, *lengths)
    assert math.acos(float(np.dot(up, normal))) == pytest.approx(math.atan(slip / (distance + 0.5 * r)), rel=1e-12)


@every_shape
def test_results_scale_with_the_size(shape: Any) -> None:
    """Scaling by powers of two, from about 1e-5 to 1e3 m, scales all results exactly: no length is built in."""
    rng = np.random.default_rng(11)
    for _ in range(40):
        x = near_or_far(shape, rng)
        gap, point, normal = compiled_closest(shape, triple(x))
        k1, k2, d1 = compiled_curvature(shape, 0.125, point, normal)
        for factor in (2.0**-16, 2.0**10):
            large = scaled(shape, factor)
            g, p, n = compiled_closest(large, triple(factor * x))
            assert (g, p, n) == (factor * gap, triple(factor * np.array(point)), normal)
            assert compiled_curvature(large, factor * 0.125, p, n) == (k1 / factor, k2 / factor, d1)


@pytest.mark.parametrize("searched", [model.Mesh, model.Heightmap])
def test_closest_is_not_defined_for_meshes_and_height_maps(searched: Any) -> None:
    """`closest` cannot report an incomplete search, so it is not defined for shapes that need one."""
    with pytest.raises(TypeError, match="closest is not defined"):
        closest(searched(*searched._fields), (0.0, 0.0, 0.0))


def on_a_ring(rng: np.random.Generator) -> Array:
    angle = rng.uniform(-np.pi, np.pi)
    return 0.8 * np.array([np.cos(angle), np.sin(angle), 0.0])


THIN: dict[str, tuple[Any, Callable[[np.random.Generator], Array]]] = {
    "box": (model.Box((0.5, 0.9, 0.001)), lambda rng: rng.uniform(-1.0, 1.0, 3) * [0.5, 0.9, 0.001]),
    "coin": (model.CappedCylinder(0.5, 0.001), lambda rng: rng.uniform(-0.4, 0.4, 3) * [1.0, 1.0, 0.0]),
    "needle": (model.Capsule(0.002, 0.9, 1.0), lambda rng: rng.uniform(-1.0, 1.0, 3) * [0.0, 0.0, 0.9]),
    "ring": (model.Torus(0.8, 0.002, 1.0), on_a_ring),
}
"""Shapes, and a function that returns a random point inside, for a path to cross."""
SAMPLED = 400
"""Points of a path that the reference samples."""


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", THIN)
def test_no_path_crosses_a_thin_object(name: str) -> None:
    """A path that takes the fingertip clearly inside is stopped outside; it may be nearly parallel to the object."""
    (shape, within), rng, radius, stopped = THIN[name], np.random.default_rng(8), 0.002, 0
    for _ in range(400):
        through = within(rng)
        flat = unit(rng) * [1.0, 1.0, 10.0 ** rng.uniform(-2.0, 0.0)]
        half = 10.0 ** rng.uniform(-2.5, -1.0) * flat / np.linalg.norm(flat)
        start, end = through - half, through + half
        outside = [signed_distance(shape, x) > 1.02 * radius for x in (start, end)]
        if not all(outside):
            continue
        shares = np.linspace(0.0, 1.0, SAMPLED)
        nearest = min(signed_distance(shape, start + share * (end - start)) for share in shares)
        share = travel(shape, triple(start), triple(end), radius, False)
        if nearest < 0.9 * radius:
            stopped += 1
            assert share < 1.0, (start, end, nearest)
        if share < 1.0:
            assert signed_distance(shape, start + share * (end - start)) > radius * (1.0 - 1e-6)
    assert stopped > 50
