"""Points of surfaces from parameters and formulas. Shapes are the kernels' named tuples; nothing else of the kernels is
used."""

from collections.abc import Iterator
from decimal import Decimal, localcontext
from typing import Any, NamedTuple

import numpy as np

from references.rotation import Array
from softfinger.proxy.kernels import model

AT_MOST = 0.9
"""Share of a feature that is sampled, so that small steps stay on it."""


class Contact(NamedTuple):
    """Surface point (3,) m, unit normal, principal curvatures 1/m, and the largest fingertip that fits, m."""

    point: Array
    normal: Array
    curvatures: tuple[float, float]
    room: float


def contacts(shape: Any, rng: np.random.Generator) -> Iterator[Contact]:
    u, angle, along = unit(rng), rng.uniform(-np.pi, np.pi), rng.uniform(-AT_MOST, AT_MOST)
    around = np.array([np.cos(angle), np.sin(angle), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    side = getattr(shape, "side", 1.0)
    free = np.inf
    match shape:
        case model.Plane(normal, offset):
            n = np.array(normal)
            yield Contact(offset * n + np.cross(n, u), n, (0.0, 0.0), free)
        case model.Sphere(radius, _):
            yield Contact(radius * u, side * u, (side / radius, side / radius), room(side, radius))
        case model.Cylinder(radius, _):
            point = radius * around + 3.0 * radius * along * z
            yield Contact(point, side * around, (side / radius, 0.0), room(side, radius))
        case model.Capsule(radius, half, _):
            point = radius * around + half * along * z
            yield Contact(point, side * around, (side / radius, 0.0), room(side, radius))
            end = u if abs(u[2]) > 0.1 else z
            point = np.copysign(half, end[2]) * z + radius * end
            yield Contact(point, side * end, (side / radius, side / radius), room(side, radius))
        case model.CappedCylinder(radius, half):
            yield Contact(radius * around + half * along * z, around, (1.0 / radius, 0.0), free)
            up = np.copysign(1.0, u[2]) * z
            yield Contact(radius * along * around + half * up, up, (0.0, 0.0), free)
            fan = np.pi / 4 * (1.0 + along)
            rim = np.cos(fan) * around + np.sin(fan) * up
            yield Contact(radius * around + half * up, rim, (np.inf, np.cos(fan) / radius), free)
        case model.Box(half):
            h, signs = np.array(half), np.where(rng.random(3) < 0.5, -1.0, 1.0)
            order, inner = rng.permutation(3), rng.uniform(-AT_MOST, AT_MOST, 3)
            for sharp, curvatures in ((1, (0.0, 0.0)), (2, (np.inf, 0.0)), (3, (np.inf, np.inf))):
                fixed = np.isin(np.arange(3), order[:sharp])
                normal = np.where(fixed, signs * (0.1 + np.abs(u)), 0.0)
                yield Contact(h * np.where(fixed, signs, inner), normal / np.linalg.norm(normal), curvatures, free)
        case model.Ellipsoid(axes, _):
            a = np.array(axes)
            normal = u / a
            k = ellipsoid_curvatures(a, u)
            n = side * normal / np.linalg.norm(normal)
            yield Contact(a * u, n, (side * k[0], side * k[1]), room(side, a.min() ** 2 / a.max()))
        case model.Torus(major, minor, _):
            tube = rng.uniform(-np.pi, np.pi)
            n = np.cos(tube) * around + np.sin(tube) * z
            level = major + minor * np.cos(tube)
            yield Contact(
                major * around + minor * n,
                side * n,
                (side / minor, side * np.cos(tube) / level),
                minor if side < 0.0 else major - minor,
            )
        case _:
            raise TypeError(f"no reference for {shape!r}")


def room(side: float, radius: float) -> float:
    """Largest fingertip at a place that bends with `radius`: any from outside."""
    return radius if side < 0.0 else np.inf


def unit(rng: np.random.Generator) -> Array:
    """A random direction (3,)."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def ellipsoid_curvatures(a: Array, u: Array) -> tuple[float, float]:
    """Principal curvatures, 1/m, at a * u from the first and second fundamental form of (s, t) -> a * u(s, t)."""
    north = np.eye(3)[np.argmin(np.abs(u))]
    s = np.cross(u, north)
    s /= np.linalg.norm(s)
    t = np.cross(u, s)
    # Along great circles u'' = -u, and the mixed derivative of the two is zero.
    first = np.array([[a * s @ (a * s), a * s @ (a * t)], [a * s @ (a * t), a * t @ (a * t)]])
    normal = u / a / np.linalg.norm(u / a)
    second = np.eye(2) * float(a * u @ normal)
    low, high = sorted(np.linalg.eigvals(np.linalg.solve(first, second)).real)
    return float(high), float(low)


def signed_distance(shape: Any, x: Array) -> float:
    """Distance of x (3,) from a solid, m, negative in it, by formulas that need no nearest point."""
    level = float(np.hypot(x[0], x[1]))
    match shape:
        case model.Plane(normal, offset):
            return float(np.dot(normal, x) - offset)
        case model.Sphere(radius, _):
            return float(np.linalg.norm(x)) - radius
        case model.Cylinder(radius, _):
            return level - radius
        case model.Capsule(radius, half, _):
            return float(np.hypot(level, max(abs(x[2]) - half, 0.0))) - radius
        case model.CappedCylinder(radius, half):
            beyond = np.array([level - radius, abs(x[2]) - half])
        case model.Box(half):
            beyond = np.abs(x) - np.array(half)
        case model.Torus(major, minor, _):
            return float(np.hypot(level - major, x[2])) - minor
        case _:
            raise TypeError(f"no formula for {shape!r}")
    return float(np.linalg.norm(np.maximum(beyond, 0.0)) + min(beyond.max(), 0.0))


def ellipsoid_foot(axes: tuple[float, ...], x: tuple[float, ...]) -> tuple[Decimal, list[Decimal], list[Decimal]]:
    """Signed distance, nearest point and outward normal of an ellipsoid in 60 digits, by bisection.

    Of points at equal distances, the one on the positive side.
    """
    with localcontext() as context:
        context.prec = 60
        a, y = [Decimal(v) for v in axes], [abs(Decimal(v)) for v in x]
        shortest = min(a)
        excess = [v * v - shortest * shortest for v in a]

        def quotients(s: Decimal) -> list[Decimal]:
            return [a[i] * y[i] / (s + excess[i]) if y[i] else Decimal(0) for i in range(3)]

        def outside(s: Decimal) -> bool:
            return sum(q * q for q in quotients(s)) > 1

        low = max(Decimal(0), *(a[i] * y[i] - excess[i] for i in range(3)))
        high = low + sum(a[i] * y[i] for i in range(3))
        if low > 0 or outside(low):
            for _ in range(220):
                middle = (low + high) / 2
                low, high = (middle, high) if outside(middle) else (low, middle)
            q = quotients(high)
        else:
            q = quotients(Decimal(0))
            q[a.index(shortest)] = max(Decimal(0), 1 - sum((v * v for v in q), Decimal(0))).sqrt()
        signs = [1 if v >= 0 else -1 for v in x]
        point = [sign * length * part for sign, length, part in zip(signs, a, q, strict=True)]
        gradient = [sign * part / length for sign, length, part in zip(signs, a, q, strict=True)]
        steepness = sum((v * v for v in gradient), Decimal(0)).sqrt()
        normal = [v / steepness for v in gradient]
        gap = sum(((Decimal(x[i]) - point[i]) * normal[i] for i in range(3)), Decimal(0))
        return gap, point, normal
