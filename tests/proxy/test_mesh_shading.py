"""How far the direction of the force turns from tick to tick over a ball of triangles, shaded and not."""

import numpy as np
import pytest
from helpers import meshes
from helpers.touching import SLIPPERY, Array, R, engine, field, go, saved, thing

from softfinger.proxy.engine import Engine
from softfinger.proxy.record import AT

BALL = 0.05
DEPTH = 1e-3
DT = 1e-3
WAY = 0.012
PRESSED = 200


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Engine]:
    """5120 triangles, by shading, without friction: what turns is the normal alone."""
    file = saved(tmp_path_factory.mktemp("ball"), *meshes.geodesic(16, BALL))
    kinds = ("normals", "none")
    return {k: engine(thing("ball", "mesh", file=file, shading=k, material=SLIPPERY)) for k in kinds}


def turned(running: Engine, speed: float) -> Array:
    """Turn of the force in each tick, rad, which is N per N: pressed down, then dragged along a great circle, askew to
    the triangles, at a speed (m/s) of the proxy."""
    angles = np.concatenate([np.zeros(PRESSED), np.arange(round(WAY / (speed * DT))) * speed * DT / (BALL + R)])
    heights = np.full(len(angles), BALL + R - DEPTH)
    heights[:PRESSED] = np.linspace(BALL + R + 0.1 * DEPTH, BALL + R - DEPTH, PRESSED)
    begin = np.array([0.6, 0.48, 0.64])
    ahead = np.cross(begin, (0.3, -0.5, 0.8))
    ahead /= np.linalg.norm(ahead)
    ways = np.cos(angles)[:, None] * begin + np.sin(angles)[:, None] * ahead
    running.reset()
    forces = field(go(running, ways * heights[:, None]), AT.force)[PRESSED:]
    return np.linalg.norm(np.diff(forces / np.linalg.norm(forces, axis=1)[:, None], axis=0), axis=1)


@pytest.mark.parametrize("speed", [0.004, 0.02])
def test_a_shaded_ball_turns_the_force_as_the_ball_does(balls: dict[str, Engine], speed: float) -> None:
    """The ball's own normal turns by v dt / (R + r) in a tick. A shaded facet's turns as far, but only while the
    contact point is on it: round edges it stands still, and the normal with it. On a facet it goes as fast as the
    probe, and meets the ball's normals on a radius of R, not of R + r - d: it turns (R + r - d) / R = 1.18 times as
    fast. Five per cent are for triangles that are not all alike. In numbers: 0.08 mN per N at 4 mm/s, 0.4 at 20."""
    own = speed * DT / (BALL + R)
    steps = turned(balls["normals"], speed)
    assert steps.max() < 1.05 * (BALL + R - DEPTH) / BALL * own
    # All of the way the ball has turned is turned, over many triangles.
    assert steps.sum() == pytest.approx(own * len(steps), rel=0.05)


@pytest.mark.parametrize("speed", [0.004, 0.02])
def test_a_facet_that_is_not_shaded_turns_it_at_its_edges(balls: dict[str, Engine], speed: float) -> None:
    """All turning is done round the edges, where the probe is r - d away from what it turns about: it is faster than on
    the ball by (R + r - d) / (r - d), 6.6, and than on the shaded ball by more than four."""
    steps, shaded = turned(balls["none"], speed), turned(balls["normals"], speed)
    way = speed * DT * (BALL + R - DEPTH) / (BALL + R)
    # Askew over an edge it is less, straight over it this; a chord and its arc differ by the square of the angle.
    assert 0.95 < steps.max() * (R - DEPTH) / way < 1.001
    assert steps.max() > 4.0 * shaded.max()
    assert (steps < 1e-9).mean() > 0.5  # on a facet, nothing
