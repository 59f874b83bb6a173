"""Cases of `softfinger accuracy`: surfaces, methods, the standard motion, and the list of cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import atan, cos, pi, sin
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.drivers.quaternions import conjugate, exp, multiply
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.shapes import closest
from softfinger.tools.measure import Array
from softfinger.tools.options import MOTIONS, Motion

RADIUS_M: Final = 0.01
"""Radius of the fingertip in every case; curvature ratios are set by the size of the surface."""
DURATION_S: Final = 1.0
MAX_ANGLE_RAD: Final = 20.0
"""A motion ends before the finger turns by more than this; on a plane it would only move further away."""
MIN_TICKS: Final = 4
PASSES: Final = 20
QUICK_PASSES: Final = 5
SWEEP_RATE_HZ: Final = 1000.0
TURN_RATES: Final = (2.0, 0.2, 20.0, 200.0, 3000.0)
"""rad/s. A hand turns at 2, quickly at 20; 3000 at 1 kHz is nearly half a turn per step."""
CURVATURE_RATIOS: Final = (0.01, 0.1, 0.9, 10.0, 100.0)
SPIN_RATIOS: Final = (0.5, 0.0, 0.1, 10.0)
TILT_RAD: Final = 1.2
SPIN_RAD: Final = 0.8
SWAY_RAD: Final = 0.4
"""Amplitudes of the changing motion. Its rates are set by its frequencies."""
CHANGING_STEP_RAD: Final = 1.0
"""Longest step of a changing motion that is measured; longer steps would skip its changes."""
TRAVEL: Final = (0.5, 0.3, 0.8)
"""Initial direction of the finger, projected onto the tangent plane. It is not an axis of any surface."""


class StudiedSurface(NamedTuple):
    """Surface of a few centimetres.

    shape    kernel shape
    size     m     smallest radius of curvature; half the shortest edge for a box, 0 for a plane
    near     (3,)  m, the path starts at the point of the shape nearest to this one
    largest        curvature ratio r / size below which the fingertip fits everywhere on the path
    """

    shape: Any
    size: float
    near: model.Vec3
    largest: float


_NO_LIMIT: Final = float("inf")
# Starts are so close to an edge, an end or the crest of the tube that every path of some tenths of a radian crosses it.
# The inside of a box and of a cylinder with ends consists of planes and an inside cylinder, so it has no rows here.
SURFACES: Final[dict[str, StudiedSurface]] = {
    "plane": StudiedSurface(model.Plane((0.0, 0.0, 1.0), 0.0), 0.0, (0.04, 0.02, 0.03), 0.0),
    "sphere": StudiedSurface(model.Sphere(0.05, 1.0), 0.05, (0.04, 0.02, 0.03), _NO_LIMIT),
    "sphere-inside": StudiedSurface(model.Sphere(0.05, -1.0), 0.05, (0.04, 0.02, 0.03), 1.0),
    "cylinder": StudiedSurface(model.Cylinder(0.03, 1.0), 0.03, (0.04, 0.02, 0.0), _NO_LIMIT),
    "cylinder-inside": StudiedSurface(model.Cylinder(0.03, -1.0), 0.03, (0.02, 0.01, 0.0), 1.0),
    "capped-cylinder": StudiedSurface(model.CappedCylinder(0.02, 0.01), 0.02, (0.03, 0.01, 0.004), _NO_LIMIT),
    "capsule": StudiedSurface(model.Capsule(0.02, 0.01, 1.0), 0.02, (0.03, 0.01, 0.004), _NO_LIMIT),
    "capsule-inside": StudiedSurface(model.Capsule(0.03, 0.01, -1.0), 0.03, (0.02, 0.01, 0.004), 1.0),
    "box": StudiedSurface(model.Box((0.02, 0.015, 0.01)), 0.01, (0.015, 0.002, 0.03), _NO_LIMIT),
    "ellipsoid": StudiedSurface(model.Ellipsoid((0.05, 0.03, 0.02), 1.0), 0.008, (0.04, 0.02, 0.03), _NO_LIMIT),
    "ellipsoid-inside": StudiedSurface(
        model.Ellipsoid((0.06, 0.05, 0.04), -1.0), 0.04**2 / 0.06, (0.02, 0.01, 0.015), 1.0
    ),
    # A fingertip thicker than the tube fits everywhere but in the hole.
    "torus": StudiedSurface(model.Torus(0.05, 0.02, 1.0), 0.02, (0.06, 0.03, 0.01), 1.5),
    "torus-inside": StudiedSurface(model.Torus(0.05, 0.02, -1.0), 0.02, (0.05, 0.025, 0.003), 1.0),
}  # fmt: skip

TOLERANCE: Final = 1e-9
"""Tolerance of `montana_rk45`."""

METHODS: Final[dict[str, Any]] = {
    "euler_zxz": model.EulerZxz(),
    "euler_zyx": model.EulerZyx(),
    "rotation_vector": model.RotationVector(),
    "midpoint": model.Midpoint(),
    "montana_rk4": model.MontanaRk4(),
    "montana_rk45": model.MontanaRk45(TOLERANCE),
}
"""Kernel nodes by name."""


def has_method(surface: str, method: str) -> bool:
    """Return whether the method supports the surface; `rotation_vector` needs a closed form."""
    return method != "rotation_vector" or not isinstance(SURFACES[surface].shape, model.Ellipsoid | model.Torus)


class RollingCase(NamedTuple):
    """One measurement, in plain values that can be sent to another process.

    rate_hz                servo rate; a step is its inverse
    turn_rate       rad/s  largest angular velocity of the fingertip
    curvature_ratio        r over the size of the surface; None for the size in SURFACES
    spin_ratio             spin over roll, at the start
    passes                 repetitions of the motion for timing
    """

    surface: str
    method: str
    motion: Motion
    rate_hz: float
    turn_rate: float
    curvature_ratio: float | None
    spin_ratio: float
    passes: int


def count_ticks(case: RollingCase) -> int:
    return max(MIN_TICKS, round(case.rate_hz * min(DURATION_S, MAX_ANGLE_RAD / case.turn_rate)))


def compute_ratio(surface: str, ratio: float | None) -> float:
    """Return the curvature ratio r / size of a surface, 0 for a plane."""
    size = SURFACES[surface].size
    return ratio if ratio is not None else (RADIUS_M / size if size else 0.0)


def make_contact(surface: str, ratio: float | None) -> tuple[Any, model.Vec3, model.Vec3]:
    """Return the shape with that curvature ratio, and centre (3,) m and normal (3,) of the first contact."""
    surface_case = SURFACES[surface]
    scale = 1.0 if ratio is None else RADIUS_M / (surface_case.size * ratio)
    shape = surface_case.shape if scale == 1.0 else scale_shape(surface_case.shape, scale)
    _, point, n = closest(shape, tuple(scale * x for x in surface_case.near))
    normal = (float(n[0]), float(n[1]), float(n[2]))
    x, y, z = (float(p + RADIUS_M * c) for p, c in zip(point, normal, strict=True))
    return shape, (x, y, z), normal


def scale_shape(shape: Any, scale: float) -> Any:
    """Return the shape with all lengths multiplied by `scale`."""
    lengths = {name: value for name, value in shape._asdict().items() if name not in ("side", "normal")}
    return shape._replace(
        **{
            name: tuple(scale * v for v in value) if isinstance(value, tuple) else scale * value
            for name, value in lengths.items()
        }
    )


def find_rolling_axis(normal: model.Vec3) -> Array:
    """Return the unit tangent (3,) about which the finger rolls at first, so that it starts along TRAVEL."""
    axis = np.cross(normal, TRAVEL)
    return np.asarray(axis / np.linalg.norm(axis))


def compute_angular_velocity(case: RollingCase, normal: model.Vec3) -> Callable[[float], Array]:
    """Return w(t) (3,) rad/s in the object frame; see `compute_orientations` for the motion."""
    n, e = np.array(normal), find_rolling_axis(normal)
    roll_rate, spin_rate = compute_rates(case)
    if case.motion == "constant":
        w = roll_rate * e + spin_rate * n
        return lambda _: w
    a, b, across = roll_rate / TILT_RAD, spin_rate / SPIN_RAD, np.cross(n, e)

    def changing(t: float) -> Array:
        sway, spin = SWAY_RAD * (1.0 - cos(a * t)), SPIN_RAD * sin(b * t)
        turned = roll_rate * cos(a * t) * (cos(spin) * e + sin(spin) * across) + spin_rate * cos(b * t) * n
        along = np.dot(turned, across) * across
        swayed = cos(sway) * (turned - along) + sin(sway) * np.cross(across, turned) + along
        return np.asarray(swayed + SWAY_RAD * a * sin(a * t) * across)

    return changing


def compute_rates(case: RollingCase) -> tuple[float, float]:
    """Return the rates of roll and spin at the start, rad/s, for the given size and ratio."""
    angle = atan(case.spin_ratio)
    return case.turn_rate * cos(angle), case.turn_rate * sin(angle)


def compute_orientations(case: RollingCase, normal: model.Vec3, times: Array) -> Array:
    """Return the orientations (n, 4) of the fingertip at `times` (n,) s.

    "constant" turns at one angular velocity. "changing" is a product of three oscillations: a tilt about a tangent
    axis, a spin about the first normal, and a sway about the other tangent axis, applied in this order. Tilt and spin
    start at their full rate, sway starts at rest. Two poses do not determine this motion.
    """
    n, e = np.array(normal), find_rolling_axis(normal)
    roll_rate, spin_rate = compute_rates(case)
    if case.motion == "constant":
        w = roll_rate * e + spin_rate * n
        return exp(times[:, None] * w)
    a, b = roll_rate / TILT_RAD, spin_rate / SPIN_RAD
    at = times[:, None]
    tilt, spin = exp(TILT_RAD * np.sin(a * at) * e), exp(SPIN_RAD * np.sin(b * at) * n)
    sway = exp(SWAY_RAD * (1.0 - np.cos(a * at)) * np.cross(n, e))
    return multiply(sway, multiply(spin, tilt))


def compute_turns(q: Array) -> Array:
    """Return the shortest rotations (n - 1, 4) from each of the orientations `q` (n, 4) to the next."""
    steps = multiply(q[1:], conjugate(q[:-1]))
    return np.ascontiguousarray(np.where(steps[:, :1] < 0.0, -steps, steps))


class Sweep(NamedTuple):
    """Values to measure.

    All servo rates are measured at the first rotation rate, the first spin ratio and the original size of the surfaces.
    The other values of a parameter are measured one at a time, at SWEEP_RATE_HZ, unless the sweep is `quick`.
    """

    surfaces: Sequence[str]
    methods: Sequence[str]
    rates_hz: Sequence[float]
    quick: bool


def list_cases(sweep: Sweep) -> list[RollingCase]:
    """Return the cases, ordered so that cases with the same reference path are consecutive.

    Curvature ratios at which the fingertip does not fit are left out, and steps that are too long: two poses determine
    neither the sense of half a turn nor a fast change.
    """
    turn, spin, passes = TURN_RATES[0], SPIN_RATIOS[0], QUICK_PASSES if sweep.quick else PASSES
    rolling_cases = []
    for surface in sweep.surfaces:
        variants: list[tuple[float, float, float | None, float]] = [(f, turn, None, spin) for f in sweep.rates_hz]
        if not sweep.quick:
            ratios = (ratio for ratio in CURVATURE_RATIOS if ratio < SURFACES[surface].largest)
            variants += [(SWEEP_RATE_HZ, rate, None, spin) for rate in TURN_RATES[1:]]
            variants += [(SWEEP_RATE_HZ, turn, ratio, spin) for ratio in ratios]
            variants += [(SWEEP_RATE_HZ, turn, None, ratio) for ratio in SPIN_RATIOS[1:]]
        for motion in MOTIONS:
            for rate, turn_rate, ratio, spin_ratio in variants:
                if turn_rate / rate >= (CHANGING_STEP_RAD if motion == "changing" else pi):
                    continue
                rolling_cases += [
                    RollingCase(surface, m, motion, rate, turn_rate, ratio, spin_ratio, passes)
                    for m in sweep.methods
                    if has_method(surface, m)
                ]
    return rolling_cases
