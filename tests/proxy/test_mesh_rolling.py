"""A fingertip that rolls over the edge between two facets, compared with the closed form of its path.

The ridge is along y, the facets are at +-a from the horizontal. The centre is straight ahead above a facet, and moves
round the ridge in between. With the angular velocity w per tick, r = 10 mm:

    facet  c' = r w x n                              n constant
    ridge  c' = r w x n,  n = (sin b, 0, cos b)      b' = w_y, so y = y_0 - r (w_z cos b + w_x sin b) / w_y + const
"""

from typing import get_args

import numpy as np
import pytest
from helpers.touching import R, engine, make_object, spun, visit, write_part

from softfinger.config.schema.contact import RollingMethod
from softfinger.proxy.record import AT

pytestmark = pytest.mark.plain

METHODS = get_args(RollingMethod)
DEPTH = 1e-3
DESCENT = 10
"""Ticks in which the fingertip descends, before it rolls."""
TICK_RAD = 2e-3
CLEAR = 3
"""Ticks on each facet, besides those round the ridge."""


def roof(half_angle, length=0.05):
    """Return two facets of two triangles each, `half_angle` rad from horizontal, on both sides of a ridge along y."""
    x, z = length * np.cos(half_angle), -length * np.sin(half_angle)
    vertices = [(side * abs(side) * x, y, abs(side) * z) for side in (-1, 0, 1) for y in (-length, length)]
    return np.array(vertices), np.array([(0, 2, 3), (0, 3, 1), (2, 4, 5), (2, 5, 3)])


def rolled_path(half_angle, w, phase):
    """Return the centres (n, 3) m and normals (n, 3) of a roll by `w` (3,) rad per tick over the ridge of a roof.

    phase  in ticks, time from a tick to the arrival at the ridge
    """
    arrival = CLEAR + phase
    departure = arrival + 2.0 * half_angle / w[1]
    t = np.arange(np.ceil(departure) + CLEAR)
    b = np.clip(w[1] * (t - arrival) - half_angle, -half_angle, half_angle)
    normals = np.stack([np.sin(b), 0.0 * b, np.cos(b)], axis=1)
    sideways = (w[2] * (np.cos(half_angle) - np.cos(b)) - w[0] * (np.sin(b) + np.sin(half_angle))) / w[1]
    centers = R * (normals + sideways[:, None] * np.array([0.0, 1.0, 0.0]))
    before, after = np.minimum(t - arrival, 0.0)[:, None], np.maximum(t - departure, 0.0)[:, None]
    return centers + R * before * np.cross(w, normals[0]) + R * after * np.cross(w, normals[-1]), normals


def deflections(folder, half_angle, w, phase, method, *others):
    """Return the deflections (n,) m of a fingertip led exactly on the path of its roll."""
    file = write_part(folder, *roof(half_angle))
    running = engine(make_object("roof", "mesh", file=file), *others, rolling={"method": method})
    centers, normals = rolled_path(half_angle, w, phase)
    height = np.linspace(1e-4, -DEPTH, DESCENT)[:, None]
    points = np.concatenate([centers[0] + height * normals[0], (centers - DEPTH * normals)[1:]])
    angles = np.linalg.norm(w) * np.maximum(np.arange(len(points)) - DESCENT + 1.0, 0.0)
    records = visit(running, points, spun(w / np.linalg.norm(w), angles))[DESCENT:]
    assert records[:, AT.contact_normal_force] == pytest.approx(1000.0 * DEPTH, rel=1e-6)
    return np.linalg.norm(records[:, AT.force : AT.force + 3] - 1000.0 * DEPTH * normals[1:], axis=1) / 1000.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("half_angle", [2e-4, 0.01, 0.1])
def test_rolling_over_an_edge_deflects_nothing(tmp_path, half_angle, method):
    """If the tick that leaves the ridge were lost, it would deflect by up to DEPTH x TICK_RAD = 2 um."""
    np.save(tmp_path / "hills.npy", np.zeros((4, 4)))
    box = make_object("box", "box", size_m=[0.01, 0.01, 0.01], position_m=[0.0, 0.0, -3.0])
    file = str(tmp_path / "hills.npy")
    hills = make_object("hills", "heightmap", file=file, pitch_m=0.01, level_m=1.0, position_m=[0.0, 0.0, -3.0])
    for phase, others in ((0.2, ()), (0.5, (box,)), (0.9, () if method == "rotation_vector" else (hills,))):
        deflected = deflections(tmp_path, half_angle, np.array([0.0, TICK_RAD, 0.0]), phase, method, *others)
        assert deflected.max() < third_order(half_angle, np.array([0.0, TICK_RAD, 0.0]))


@pytest.mark.parametrize("method", ["midpoint", "montana_rk4", "montana_rk45", "rotation_vector"])
@pytest.mark.parametrize("half_angle", [2e-4, 0.01, 0.1])
def test_rolling_with_spin_over_an_edge_has_second_order(tmp_path, half_angle, method):
    """Oblique, with a rotation about the normal as large as the roll. The midpoint rule does not see an edge in the
    second half of a tick: an error of r w_n w_y (1 - t)^2 / 2 for the arrival at t, at most r w_n w_y / 8."""
    w = TICK_RAD * np.array([0.5, 0.8, 1.0])
    allowed = R * np.linalg.norm(w) * w[1] / 8.0 + third_order(half_angle, w)
    for phase in (0.2, 0.5, 0.9):
        assert deflections(tmp_path, half_angle, w, phase, method).max() < allowed


def third_order(half_angle, w):
    """Return the sum of errors r |w|^3 of the ticks round the ridge, and of the one that leaves it, m."""
    return (1.0 + 2.0 * half_angle / w[1]) * R * np.linalg.norm(w) ** 3
