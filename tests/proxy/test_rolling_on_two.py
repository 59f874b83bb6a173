"""A fingertip that rolls on a floor and round an object at once, compared with the closed form of its path.

The object is symmetric about the z axis. The centre c moves on a circle about that axis, at the height r over the
floor, with the velocity v. Without slip at both contact points, the fingertip turns about the line through them:

    w = k (m - n),  v = r w x n,      n = +z and m the normals of floor and object

The hand moves exactly with the proxy, at a depth of 1 mm behind each contact: x = c - d n - d m. So nothing is wound
up, and the force is K d (n + m). As m rotates, the probe moves less than the proxy, at the floor, too.
"""

import numpy as np
import pytest
from helpers import meshes
from helpers.hostile_maps import part
from helpers.touching import R, engine, make_object, visit, write_part
from references.rotation import multiply, quaternion

from softfinger.proxy.record import AT

pytestmark = pytest.mark.plain

BALL, PILLAR, BOWL = 0.05, 0.03, 0.04
"""Radii, m."""
DEPTH, TURN, DESCENT = 1e-3, 0.5, 10
SHAPES = {
    "ball": (make_object("body", "sphere", radius_m=BALL, position_m=[0.0, 0.0, BALL]), (R - BALL) / (R + BALL)),
    "pillar": (make_object("body", "cylinder", radius_m=PILLAR), 0.0),
    "pipe": (make_object("body", "cylinder", radius_m=BOWL, inside=True), 0.0),
}
"""Object, and the vertical component of its normal at the fingertip."""
DISTANCES = {"ball": np.sqrt((BALL + R) ** 2 - (R - BALL) ** 2), "pillar": PILLAR + R, "pipe": BOWL - R}
"""Distances of the centre from the z axis, m."""


def deflections(body, distance, height, outward, ticks):
    """Difference (n,) m of a hand's force from that of two unwound springs, over the stiffness, at `distance` m from
    the z axis; the object's normal has this `height`, and points `outward` (+1) or inwards (-1)."""
    angles = np.linspace(0.0, TURN, ticks)
    radial = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    normals = outward * np.sqrt(1.0 - height**2) * radial + height * up
    centers = distance * radial + R * up
    axes = normals - up
    velocities = distance * np.cross(up, radial)
    rolls = np.cross(axes, up)
    rates = (np.einsum("ij,ij->i", velocities, rolls) / (R * np.einsum("ij,ij->i", rolls, rolls)))[:, None] * axes
    poses = np.empty((ticks, 7))
    poses[:, :3] = centers - DEPTH * normals - DEPTH * up
    poses[0, 3:] = (1.0, 0.0, 0.0, 0.0)
    for tick in range(1, ticks):
        turn = quaternion(0.5 * (rates[tick - 1] + rates[tick]) * TURN / (ticks - 1))
        poses[tick, 3:] = multiply(turn, poses[tick - 1, 3:])
    above = np.linspace(1.2 * DEPTH, 0.0, DESCENT)[:, None] * (normals[0] + up)
    points = np.concatenate([poses[0, :3] + above, poses[1:, :3]])
    orientations = np.concatenate([np.tile(poses[0, 3:], (DESCENT, 1)), poses[1:, 3:]])
    records = visit(engine(body, make_object("floor", "plane")), points, orientations)[DESCENT:]
    expected = 1000.0 * DEPTH * (normals[1:] + up)
    return np.linalg.norm(records[:, AT.force : AT.force + 3] - expected, axis=1) / 1000.0


def check_second_order(*path):
    """The path in a tick is straight: half the tick divides the error by four."""
    long, short = (deflections(*path, ticks).max() for ticks in (101, 201))
    assert short < 1e-7 and short < 0.3 * long + 1e-9


@pytest.mark.parametrize("shape", SHAPES)
def test_rolling_on_two_objects_deflects_nothing(shape):
    """Wound up by the rotation of the other contact's normal, it would deflect by a part of DEPTH x TURN = 500 um."""
    body, height = SHAPES[shape]
    check_second_order(body, DISTANCES[shape], height, -1.0 if shape == "pipe" else 1.0)


def test_rolling_on_a_heightmap_and_a_floor_deflects_nothing(tmp_path):
    """A ball half sunk in the floor, as a height map. Without its curvature, 400 um would remain on any pitch."""
    pitch, sunk, rim = 0.5e-3, 0.025, 0.046
    across = pitch * (np.arange(200) - 99.5)
    squares = across[:, None] ** 2 + across**2
    heights = np.sqrt(np.maximum(BALL**2 - squares, BALL**2 - rim**2)) - sunk
    height = (R + sunk) / (R + BALL)
    check_second_order(part(tmp_path, heights, pitch), np.sqrt((BALL + R) ** 2 - (R + sunk) ** 2), height, 1.0)


def test_rolling_on_a_mesh_and_a_floor_converges_to_the_ball(tmp_path):
    """Without the rotation of the normal round edges, 380 um would remain on any mesh."""
    _, height = SHAPES["ball"]
    errors = []
    for frequency in (16, 32):
        file = write_part(tmp_path, *meshes.geodesic(frequency, BALL), name=f"{frequency}.ply")
        body = make_object("body", "mesh", file=file, position_m=[0.0, 0.0, BALL])
        errors.append(deflections(body, DISTANCES["ball"], height, 1.0, 501).max())
    assert errors[1] < 0.5 * errors[0] and errors[1] < 30e-6
