"""Surfaces made of boxes: a seam is as a plane, and has the energy of two springs."""

from itertools import pairwise

import numpy as np
import pytest
from helpers import touching
from test_patches import GRIP, LIMP, SOFT, R, engine, line, material, poses, wall

from softfinger.config.errors import ConfigError
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.engine import Engine

pytestmark = pytest.mark.plain


def tile(name, x, y=0.0, edge=0.1, stuff=None):
    return {
        "name": name,
        "shape": "box",
        "size_m": [edge, edge, 0.1],
        "position_m": [x, y, -0.05],
        "material": stuff or material(),
    }


SEAM = [tile("left", -0.05), tile("right", 0.05)]


def test_a_seam_between_unequal_boxes_gives_the_difference_of_their_springs():
    """Crossing at depth d does no work; pressing on one box and lifting on the other (K1 - K2) d^2 / 2."""
    slick, stiffness, deep = {"static": 0.0, "kinetic": 0.0}, (1000.0, 300.0), 0.001
    boxes = [box | {"material": material(slick, stiffness_n_per_m=k)} for box, k in zip(SEAM, stiffness, strict=True)]
    running = engine(*boxes)

    def work(*corners):
        """Work of the hand along a path, J; on each segment the force is linear or perpendicular to the path."""
        path = np.vstack([corners[0], *(line(a, b, 100) for a, b in pairwise(corners))])
        force = running.run(poses(path))["force"]
        running.reset()
        return -np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(path, axis=0))

    (over_stiff, stiff), (over_soft, soft) = ([(x, 0.0, R), (x, 0.0, R - deep)] for x in (-0.005, 0.005))
    gained = 0.5 * (stiffness[0] - stiffness[1]) * deep**2  # 0.35 mJ
    # Sums of hundreds of terms up to 1e-5 J.
    assert work(over_stiff, stiff, soft, stiff, over_stiff) == pytest.approx(0.0, abs=1e-15)
    assert work(over_soft, soft, stiff, over_stiff, over_soft) == pytest.approx(-gained, abs=1e-15)
    assert work(over_stiff, stiff, soft, over_soft, over_stiff) == pytest.approx(gained, abs=1e-15)


def tiled(edge, stuff, side=10):
    at = edge * (np.arange(side) - 0.5 * (side - 1))
    return [tile(f"tile {i} {j}", x, y, edge, stuff) for i, x in enumerate(at) for j, y in enumerate(at)]


def all_over():
    t = np.linspace(0.0, 20.0, 4000)
    points = np.stack([0.014 * np.sin(1.3 * t), 0.014 * np.sin(1.7 * t), R - 0.0006 + 0.001 * np.sin(2.9 * t)], axis=1)
    return poses(points, np.stack([0.9 * np.sin(1.1 * t), 0.9 * np.sin(1.9 * t), 0.5 * np.sin(2.3 * t)], axis=1))


def deep():
    """Return the same path down to 20 mm depth: the edge of a single tile would release the proxy there."""
    path = all_over()
    path[:, 2] = np.linspace(R + 0.001, R - 0.02, len(path))
    return path


WAYS = {"all over": all_over, "deep": deep, "recording": lambda: resample(load_poses("press-roll-spin-drag"), 1000.0)}

SEAMS = 0.0061
"""Distance of the seams, m. The recording turns back at 6 mm. A roll that ends less than 0.2 nm behind a seam has the
normal of the edge for a tick, 2e-8 rad off."""


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize(("path", "tip"), [*((path, {}) for path in WAYS), ("all over", SOFT)])
def test_a_tiled_surface_equals_a_plane(cases, path, tip):
    stuff = material(GRIP, LIMP)
    whole = WAYS[path]()
    path = whole[:: len(whole) // cases(200, len(whole))]
    plane = engine(wall("plane", (0, 0, 1), stuff), **tip).run(path)
    boxes = engine(*tiled(SEAMS, stuff), **tip).run(path)
    assert len(set(boxes["contact.object"])) > 5  # many of them, and free space
    # Rolling by u over a seam lowers the proxy by u^2 / 2 r. If that is below the rounding of r (u < 0.2 nm), the next
    # box is not closer: the contact point stays at the edge, and the normal is off by u / r, which is 4e-9 N m at 20 mm
    # and 20 N.
    for name, tolerance in (("force", 1e-11), ("proxy.position", 1e-11), ("contact.point", 2e-10), ("torque", 4e-9)):
        # Rounding of 20 mm times 1000 N/m, summed over thousands of ticks.
        np.testing.assert_allclose(boxes[name], plane[name], rtol=0, atol=tolerance)
    for name in ("contact.mode", "contact.rolled", "contact.spin", "contact.torsion", "contact.patch_radius"):
        np.testing.assert_allclose(boxes[name], plane[name], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("edge", "heading"), [(0.006, 1.0), (0.006, -1.0), (0.9, 1.0)])
@pytest.mark.parametrize("behind", [0.0, 1e-13, 3e-11, 1e-10, 1.5e-10, 1e-9])
@pytest.mark.parametrize("onward", [1.0, -1.0], ids=["onward", "back"])
def test_a_roll_may_end_a_tick_just_behind_a_seam(edge, heading, behind, onward):
    """Rolled to `behind` m past the seam, then on or back, 8 nm per tick: as on a plane, no motion is lost."""
    steps = 8e-9 * np.concatenate([np.zeros(2), np.ones(5), onward * np.ones(5)])
    y = heading * (behind - 4e-8 + np.cumsum(steps))
    turned = np.outer(-(y - y[0]) / R, [1.0, 0.0, 0.0])
    path = poses(np.stack([np.zeros(12), y, np.full(12, R - 0.001)], axis=1), turned)
    tiles = tiled(edge, material(), side=2)
    plane, boxes = engine(wall("plane", (0, 0, 1), material())).run(path), engine(*tiles).run(path)
    # Rounding of 0.9 m times 1000 N/m. The normal of the edge is off by `behind` / r, up to rounding, for a tick, which
    # displaces the probe by that angle times its depth of 1 mm. A lost step would be 8e-7 N.
    np.testing.assert_allclose(boxes["force"], plane["force"], rtol=0, atol=1e-12 + 1.2 * behind / R)


def test_another_number_of_objects_is_another_scene():
    more, fewer = (touching.scene_with(*tiled(0.004, material(), side)) for side in (4, 3))
    with pytest.raises(ConfigError, match="other parts"):
        Engine(more).tune(fewer)
