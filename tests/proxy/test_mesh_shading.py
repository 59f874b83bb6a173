"""Turn of the force direction per tick on a triangulated sphere, with and without shading."""

import numpy as np
import pytest
from helpers import meshes
from helpers.touching import SLIPPERY, Array, R, engine, make_object, visit, write_part

from softfinger.proxy.engine import Engine

BALL = 0.05
DEPTH = 1e-3
DT = 1e-3
WAY = 0.012
PRESSED = 200


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Engine]:
    """Engines with 5120 triangles, one for each shading, without friction: only the normal turns."""
    file = write_part(tmp_path_factory.mktemp("ball"), *meshes.geodesic(16, BALL))
    kinds = ("normals", "none")
    return {k: engine(make_object("ball", "mesh", file=file, shading=k, material=SLIPPERY)) for k in kinds}


def turned(running: Engine, speed: float) -> Array:
    """Turn of the force per tick, rad, which equals N per N. The hand presses down, then drags at a speed (m/s) of the
    proxy along a great circle, oblique to the triangles."""
    angles = np.concatenate([np.zeros(PRESSED), np.arange(round(WAY / (speed * DT))) * speed * DT / (BALL + R)])
    heights = np.full(len(angles), BALL + R - DEPTH)
    heights[:PRESSED] = np.linspace(BALL + R + 0.1 * DEPTH, BALL + R - DEPTH, PRESSED)
    begin = np.array([0.6, 0.48, 0.64])
    ahead = np.cross(begin, (0.3, -0.5, 0.8))
    ahead /= np.linalg.norm(ahead)
    ways = np.cos(angles)[:, None] * begin + np.sin(angles)[:, None] * ahead
    running.reset()
    forces = visit(running, ways * heights[:, None])["force"][PRESSED:]
    return np.linalg.norm(np.diff(forces / np.linalg.norm(forces, axis=1)[:, None], axis=0), axis=1)


@pytest.mark.parametrize("speed", [0.004, 0.02])
def test_a_shaded_mesh_turns_the_force_like_a_sphere(balls: dict[str, Engine], speed: float) -> None:
    """The force turns per tick by at most 1.18 times v dt / (R + r), the turn of the sphere's normal.

    A shaded facet's normal turns as far as the sphere's, but only while the contact point is on the facet: round edges
    both are constant. On a facet the contact point moves as fast as the probe and meets the sphere's normals at a
    radius of R instead of R + r - d, so it turns (R + r - d) / R = 1.18 times as fast. Triangles of unequal size add
    five per cent. In numbers: 0.08 mN per N at 4 mm/s, 0.4 at 20.
    """
    own = speed * DT / (BALL + R)
    steps = turned(balls["normals"], speed)
    assert steps.max() < 1.05 * (BALL + R - DEPTH) / BALL * own
    # The sum over many triangles is the turn of the sphere's normal.
    assert steps.sum() == pytest.approx(own * len(steps), rel=0.05)


@pytest.mark.parametrize("speed", [0.004, 0.02])
def test_an_unshaded_mesh_turns_the_force_at_its_edges(balls: dict[str, Engine], speed: float) -> None:
    """The normal turns only round edges, (R + r - d) / (r - d) = 6.6 times as fast as on the sphere. There the probe is
    at r - d from the edge. It is also more than four times as fast as on the shaded mesh."""
    steps, shaded = turned(balls["none"], speed), turned(balls["normals"], speed)
    travel = speed * DT * (BALL + R - DEPTH) / (BALL + R)
    # The maximum is for a path straight over an edge; a chord differs from its arc by the square of the angle.
    assert 0.95 < steps.max() * (R - DEPTH) / travel < 1.001
    assert steps.max() > 4.0 * shaded.max()
    assert (steps < 1e-9).mean() > 0.5  # no turn on a facet
