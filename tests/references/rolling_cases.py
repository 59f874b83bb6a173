"""Shapes, methods and starting contacts that the rolling tests share, and the kernel compiled to be called."""

from typing import Any

import numpy as np

from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact.rolling import Roll, roll
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics import rotations
from softfinger.proxy.kernels.shapes import closest

RADIUS = 0.01

SMOOTH = {
    "plane": model.Plane((0.6, 0.0, 0.8), 0.02),
    "sphere": model.Sphere(0.05, 1.0),
    "hollow sphere": model.Sphere(0.05, -1.0),
    "cylinder": model.Cylinder(0.03, 1.0),
    "hollow cylinder": model.Cylinder(0.03, -1.0),
    "ellipsoid": model.Ellipsoid((0.05, 0.03, 0.02), 1.0),
    "hollow ellipsoid": model.Ellipsoid((0.06, 0.05, 0.04), -1.0),
    "torus": model.Torus(0.05, 0.02, 1.0),
    "hollow torus": model.Torus(0.05, 0.02, -1.0),
}
PIECED = {
    "capsule": model.Capsule(0.02, 0.01, 1.0),
    "hollow capsule": model.Capsule(0.03, 0.01, -1.0),
    "capped cylinder": model.CappedCylinder(0.02, 0.01),
    "box": model.Box((0.02, 0.015, 0.01)),
}
SHAPES: dict[str, Any] = {**SMOOTH, **PIECED}

METHODS: dict[str, Any] = {
    "euler_zxz": model.EulerZxz(),
    "euler_zyx": model.EulerZyx(),
    "rotation_vector": model.RotationVector(),
    "midpoint": model.Midpoint(),
    "montana_rk4": model.MontanaRk4(),
    "montana_rk45": model.MontanaRk45(1e-12),
}


def has_closed_form(shape: Any) -> bool:
    """Whether `rotation_vector` is there for the shape."""
    return not isinstance(shape, model.Ellipsoid | model.Torus)


def pairs() -> list[tuple[str, str]]:
    return [(m, s) for m in METHODS for s in SHAPES if m != "rotation_vector" or has_closed_form(SHAPES[s])]


def touching(shape: Any, rng: np.random.Generator, radius: float = RADIUS) -> tuple[model.Vec3, model.Vec3]:
    spread = 0.002 if getattr(shape, "side", 1.0) < 0 else 0.05
    x = tuple(float(v) for v in rng.normal(0, spread, 3))
    if isinstance(shape, model.Torus):
        angle = rng.uniform(0, 2 * np.pi)
        x = (shape.major * np.cos(angle) + x[0], shape.major * np.sin(angle) + x[1], 0.1 * x[2] + 0.001)
    _, point, n = closest(shape, x)
    return tuple(float(p + radius * c) for p, c in zip(point, n, strict=True)), tuple(map(float, n))


def rotation(rng: np.random.Generator, low: float = 0.0, high: float = np.pi) -> model.Vec3:
    w = rng.normal(size=3)
    return tuple(float(v) for v in w * rng.uniform(low, high) / np.linalg.norm(w))


def rolled_by(method: Any, shape: Any, center: model.Vec3, normal: model.Vec3, w: Any, ticks: int = 1) -> Roll:
    """The roll by a rotation vector, in so many equal ticks; spin is that of all of them."""
    turn = rotations.exp(tuple(float(v) / ticks for v in w))
    spin = 0.0
    for _ in range(ticks):
        out = roll(method, shape, RADIUS, center, normal, turn)
        center, normal, spin = out.center, out.normal, spin + out.spin
    return out._replace(spin=spin)


@entry
def roll_long(method: Any, shape: Any, radius: float, center: Any, normal: Any, w: Any, ticks: int) -> Any:
    """Roll for many ticks by |w| rad about a wandering axis; return the largest distance (m) from the surface, that of
    the normal's length from 1, and the last step."""
    off, stretched = 0.0, 0.0
    turn = rotations.exp(w)
    out = Roll(center, normal, (0.0, 0.0, 0.0), 0.0, 0.0, True)
    wander = rotations.exp((3e-3, 1e-3, 2e-3))
    for i in range(ticks):
        if i % 64 == 0:
            w = rotations.rotate(wander, w)
            turn = rotations.exp(w)
        out = roll(method, shape, radius, center, normal, turn)
        center, normal = out.center, out.normal
        x = (center[0] - radius * normal[0], center[1] - radius * normal[1], center[2] - radius * normal[2])
        gap, _, _ = closest(shape, x)
        off = max(off, abs(gap))
        size = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
        stretched = max(stretched, abs(size - 1.0))
    return off, stretched, out
